"""The command line of flockenv.

list | run | play | compare | measure | render | explain | accuracy | stress | experiment | gallery | validate | jobs
| warmup | schema

Errors are one line on stderr. Exit codes: 0, 1 (a run failed), 2 (bad input), 130 (interrupted).
"""

from __future__ import annotations

import functools
import json
import math
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, get_args

import typer

import flockenv
from flockenv.cli.compare import compare
from flockenv.cli.films import Shutter, film_episodes, write_picture
from flockenv.cli.import_mesh import import_mesh
from flockenv.cli.import_plan import import_plan
from flockenv.cli.jobs import jobs
from flockenv.cli.measure import measure
from flockenv.cli.options import Debug, Delay, Dropped, Noise, Reach, Seen, TrustPickle
from flockenv.cli.play import play
from flockenv.cli.studies import accuracy, experiment, gallery, stress
from flockenv.cli.targets import SceneFile, complete_target, is_scene
from flockenv.cli.terminal import (
    DIVERGED,
    INTERRUPTED,
    OK,
    EarlyEnd,
    Force,
    Seed,
    announce_rest,
    describe_error,
    flush_output,
    name_stdout_errors,
    new_console,
    print_error,
    progress_bar,
    relative_path,
    show_table,
)
from flockenv.cli.validate import validate
from flockenv.core import signals
from flockenv.core.errors import nearest, printable
from flockenv.core.yaml_paths import title_of
from flockenv.players import NAMES, trained_task

if TYPE_CHECKING:
    from rich.console import Console

    from flockenv.envs.disturbance import Disturbance
    from flockenv.model.state import State
    from flockenv.render import Panel
    from flockenv.scene import Scene
    from flockenv.studies.trajectory import Trajectory

# Nothing that simulates, draws or learns is imported at the top, so that `flockenv --help` takes a fifth of a second.

__all__ = ["app", "main"]

PICTURES = (".gif", ".png", ".html", ".mp4", ".webp")
FPS = 25.0  # of a scene's GIF
RECORDED_EVERY = 0.1  # s, rounded to whole steps


app = typer.Typer(
    help="Steering agents: hand-written rules and learned policies in the same worlds.",
    no_args_is_help=True,
    rich_markup_mode="markdown",  # in "rich", text in brackets is read as a style and vanishes
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Duration = Annotated[float, typer.Option(metavar="S", help="Simulated time in seconds, a whole multiple of dt.")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit code: 0, 1 (a run failed), 2 (bad input), 130 (interrupted).

    `--debug`, anywhere, shows tracebacks instead of one line. Without `arguments` it runs sys.argv as the main program
    and handles signals.
    """
    if arguments is not None:
        return _run(list(arguments))
    with signals.handle_signals("flockenv"):
        code = _run(sys.argv[1:])
    if code == signals.exit_code():
        signals.exit_now(code)
    return code


def _run(words: Sequence[str]) -> int:
    debug = "--debug" in words
    signals.set_message("")  # discard the text of an earlier command of this process
    try:
        with warnings.catch_warnings(), name_stdout_errors():
            warnings.showwarning = _warn
            code = app([w for w in words if w != "--debug"], prog_name="flockenv", standalone_mode=False)
        flush_output()
        # typer turns a KeyboardInterrupt into this code without a message
        return _report_interrupt() if code == INTERRUPTED else int(code or OK)
    except (typer.Abort, KeyboardInterrupt):
        return _report_interrupt()
    except EarlyEnd as end:
        return _report_interrupt(str(end)) if end.code == INTERRUPTED else _report_error(str(end), end.code)
    except Exception as error:
        if debug:
            raise
        return _report_error(*describe_error(error))


def _report_interrupt(text: str = "") -> int:
    """Print the line about the signal that ended the command, `text` if given; return the exit code."""
    if text:
        signals.set_message(text)
    if line := signals.take_message():
        print(line, file=sys.stderr)
    return signals.exit_code()


def _warn(message: Warning | str, *place: object, **more: object) -> None:
    """Print a warning in one line, like an error, without its line of source code."""
    _report_error(f"warning: {message}", OK)


def _report_error(text: str, code: int) -> int:
    print_error("flockenv", text)
    return code


def _show_version(asked: bool) -> None:
    if asked:
        print(flockenv.__version__)
        raise typer.Exit


@app.callback()
def _define_options(
    debug: Debug = False,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_show_version)
    ] = False,
) -> None:
    """Define the options of every command; `main` has already removed --debug."""


@app.command("list")
def listing() -> None:
    """List tasks with their ids, scenes, effects, behaviours, methods, emitters, sinks and spaces, a sentence each."""
    import gymnasium
    import pettingzoo

    from flockenv.behaviours import BEHAVIOURS
    from flockenv.geometry.space import AnySpace
    from flockenv.physics.effects import EFFECTS
    from flockenv.physics.integrators import INTEGRATORS
    from flockenv.physics.population import POPULATION
    from flockenv.play.gallery import entries
    from flockenv.steering.arbitration import ARBITRATIONS
    from flockenv.tasks import TASKS

    console = new_console()
    single = [env_id for env_id in gymnasium.registry if env_id.startswith("flockenv/")]
    many = [env_id for env_id in pettingzoo.parallel_registry if env_id.startswith("flockenv/")]
    show_table(console, "Tasks", ((name, _first_sentence(task)) for name, task in TASKS.items()))
    show_table(console, "gymnasium.make, gymnasium.make_vec", ((env_id, "one learner") for env_id in single))
    show_table(console, 'pettingzoo.make("parallel" or "aec", ...)', ((env_id, "many learners") for env_id in many))
    scenes = ((each.name, _sentence_of(each.description)) for each in entries() if each.kind == "scene")
    show_table(console, "Scenes", sorted(scenes))
    effects = {kind: effect for kind, effect in EFFECTS.items() if kind not in BEHAVIOURS}
    show_table(console, "Effects", ((kind, _first_sentence(effect)) for kind, effect in sorted(effects.items())))
    show_table(console, "Behaviours", ((kind, _first_sentence(effect)) for kind, effect in sorted(BEHAVIOURS.items())))
    show_table(console, "Arbitrations", ((kind, _first_sentence(how)) for kind, how in sorted(ARBITRATIONS.items())))
    show_table(console, "Integrators", ((kind, _first_sentence(each)) for kind, each in sorted(INTEGRATORS.items())))
    show_table(console, "Population", ((kind, _first_sentence(member)) for kind, member in sorted(POPULATION.items())))
    spaces = get_args(get_args(AnySpace)[0])
    show_table(console, "Spaces", ((space.model_fields["kind"].default, _first_sentence(space)) for space in spaces))


@app.command()
def run(
    scene: SceneFile,
    seed: Seed = 0,
    duration: Duration = 10.0,
    out: Annotated[
        str | None,
        typer.Option(
            metavar="X.npz|X.csv|X.parquet",
            help="File for the trajectory, all of it or a table of positions for PedPy; a summary goes to X.json.",
        ),
    ] = None,
    every: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time between recorded instants in seconds.", show_default="about 0.1"),
    ] = None,
    force: Force = False,
) -> None:
    """Run a scene, show measures such as speed and polarisation, and write the trajectory if --out is given."""
    from flockenv.core.output_paths import valid_file
    from flockenv.scene.yaml_io import load_scene
    from flockenv.studies.trajectory import whole_steps
    from flockenv.studies.trajectory_table import SUFFIXES, require_writer

    loaded = load_scene(Path(scene))
    path = valid_file(out, [".npz", *SUFFIXES], force, beside=".json") if out is not None else None
    if path is not None:
        require_writer(path.suffix)
    steps = whole_steps("--duration", duration, loaded.dt)
    usual = max(1, round(RECORDED_EVERY / loaded.dt))
    stride = usual if every is None else whole_steps("--every", every, loaded.dt, 1)
    trajectory = _record(loaded, seed, steps, stride if path is not None else max(1, steps))
    if trajectory.stopped == "interrupted":
        announce_rest(f"measuring the state at {trajectory.last.time[0]:.3g} s")
    console = new_console()
    _show_measures(console, trajectory)
    if path is not None:
        beside = trajectory.save(path)
        console.print(f"{len(trajectory.step)} instants in {relative_path(path)}, summary in {relative_path(beside)}")
    if trajectory.stopped:
        text = f"{trajectory.stopped}; results until {trajectory.last.time[0]:g} s are shown"
        raise EarlyEnd(text, INTERRUPTED if trajectory.stopped == "interrupted" else DIVERGED)


@app.command()
def render(
    what: Annotated[
        str,
        typer.Argument(
            metavar="SCENE|TASK",
            help="A scene or task of `flockenv list`, or a scene file (- for standard input).",
            autocompletion=complete_target,
        ),
    ],
    out: Annotated[
        str, typer.Option(metavar="X.gif|X.png|X.html|X.mp4|X.webp", help="Output file; a PNG shows the end.")
    ],
    player: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE,...",
            help=f"Player of a task: {', '.join(NAMES)}, with a seed (ppo@3), or a file (.safetensors, .py, .zip); "
            "several play the same world, side by side.",
        ),
    ] = "random",
    seed: Seed = 0,
    duration: Annotated[
        float | None,
        typer.Option(metavar="S", help="Simulated seconds of a scene; a task plays to its end.", show_default="10"),
    ] = None,
    size: Annotated[int, typer.Option(min=64, max=4096, help="Width of a picture in pixels.")] = 600,
    shutter: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            metavar="SHARE",
            help="Motion blur of a scene: a picture is the mean over this share of the "
            "time since the one before, as in a film camera (0.5).",
        ),
    ] = 0.0,
    yaw: Annotated[
        float,
        typer.Option(metavar="DEG", help="Turn a 3-D scene about its z axis, -360 to 360 degrees."),
    ] = 0.0,
    tilt: Annotated[
        float,
        typer.Option(metavar="DEG", help="Lower the view of a 3-D scene: 0 from above, 90 from the side, to 180."),
    ] = 0.0,
    noise: Noise = 0.0,
    delay: Delay = 0,
    dropped: Dropped = 0.0,
    reach: Reach = None,
    seen: Seen = None,
    trust_pickle: TrustPickle = False,
    force: Force = False,
) -> None:
    """Draw a scene, or an episode of a task with a player, as GIF, PNG, HTML replay, MP4 (extra `video`) or WebP.

    A task has the arguments with which its policy was trained.
    """
    from flockenv.core.atomic_files import new_folder
    from flockenv.core.output_paths import valid_file
    from flockenv.envs.disturbance import Disturbance
    from flockenv.render.video import require_encoder

    path = valid_file(out, PICTURES, force)
    require_encoder(path.suffix)
    disturbance = Disturbance(noise=noise, delay=delay, dropped=dropped, range=reach, seen=seen)
    if is_scene(what):
        if disturbance:
            raise ValueError(
                "--noise, --delay, --dropped, --range, --seen: for tasks only; in a scene no player observes"
            )
        if shutter and path.suffix.lower() == ".html":
            raise ValueError(f"--shutter {shutter:g}: for pictures and films; an HTML replay has no motion blur")
        if (yaw or tilt) and path.suffix.lower() == ".html":
            raise ValueError("--yaw, --tilt: for pictures and films; an HTML replay is turned by the pointer")
        panel, fps, blur, left = _film_scene(what, 10.0 if duration is None else duration, seed, shutter, (yaw, tilt))
        panels, title = [panel], title_of(what)
    else:
        if shutter:
            raise ValueError(f"--shutter {shutter:g}: for scenes only; a task shows one instant per decision")
        if yaw or tilt:
            raise ValueError("--yaw, --tilt: for scenes only; tasks are in 2-D")
        blur = Shutter()
        panels, fps = _film_task(what, player, seed, duration, trust_pickle, disturbance)
        title, left = what, ""
    with new_folder(path.parent):
        write_picture(path, panels, title, fps, size, blur)
    end = max(panel.snapshots[-1].time for panel in panels)
    new_console().print(f"{relative_path(path)}: {path.stat().st_size:,} bytes, {end:g} s{left}")


def _film_task(
    name: str, player: str, seed: int, duration: float | None, trust_pickle: bool, disturbance: Disturbance
) -> tuple[list[Panel], float]:
    """Return an episode of each of the players (a,b) in the same world, as panels, and the frames per second."""
    if duration is not None:
        raise ValueError(f"--duration = {duration:g}: only for scenes; an episode of a task ends by itself")
    return film_episodes(trained_task(name), player.split(","), seed, trust_pickle, disturbance)


@app.command()
def explain(scene: SceneFile) -> None:
    """Show the effects of a scene: what each one needs, what it costs per step, and which features are left out."""
    from flockenv.scene.yaml_io import load_scene
    from flockenv.studies import cost_breakdown

    loaded = load_scene(Path(scene))
    with progress_bar("compiling and timing", len(loaded.effects) + 2, "variants") as progress:
        breakdown = cost_breakdown.explain(loaded, progress=progress)
    console = new_console()
    rows = [(row.name, ", ".join(row.calls_for) or "nothing", str(row.cost)) for row in breakdown.rows]
    rows.append(("shared by several effects", "", str(breakdown.shared)))
    rows.append((breakdown.remaining_parts, "", f"{breakdown.rest:.3g}"))
    title = f"One step of {loaded.agents:,} agents: {breakdown.step:.3g} us"
    show_table(console, title, rows, ("effect", "calls for", "costs us/step [95 % interval]"))
    for note in breakdown.notes:
        console.print(note)
    counts = (f"{number:g} {name.replace('_', ' ')}" for name, number in breakdown.work.items())
    console.print(f"Per step: {', '.join(counts)}")
    console.print(f"Largest stable step: {breakdown.largest_step}")
    if breakdown.shares:
        shares = [(k, name, "-" if math.isnan(x) else f"{x:.3g}") for k, name, x in breakdown.shares]
        show_table(console, "Mean share of each behaviour's steering granted", shares, ("effect", "behaviour", "share"))
    left_out = ([line] for line in breakdown.left_out)
    show_table(console, "Left out, because nothing in the scene needs it", left_out, [""])


app.command()(play)
app.command()(compare)
app.command()(measure)
app.command()(accuracy)
app.command()(stress)
app.command()(experiment)
app.command()(gallery)
app.command()(validate)
app.command()(import_mesh)
app.command()(import_plan)
app.command()(jobs)


@app.command()
def warmup(
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="TASK|SCENE",
            help="What to compile: names of `flockenv list`, or scene files; - for a scene from standard input.",
            show_default="every task",
            autocompletion=complete_target,
        ),
    ] = None,
    dtype: Annotated[
        str | None, typer.Option(metavar="float32|float64", help="Precision, instead of that of the task or scene.")
    ] = None,
) -> None:
    """Compile the kernels of tasks and scenes in advance, so that the first step is fast; show how long each took."""
    from flockenv.envs.world import first_step
    from flockenv.jit.progress import compiled_kernels, unapplied_patches
    from flockenv.scene.yaml_io import load_scene
    from flockenv.tasks import TASKS

    names = what or sorted(TASKS)
    if dtype not in (None, "float32", "float64"):
        raise ValueError(
            f"--dtype = {printable(dtype)}: allowed: float32, float64{nearest(dtype, ('float32', 'float64'))}"
        )
    change = {} if dtype is None else {"dtype": dtype}
    jobs: list[tuple[str, Callable[[], None]]] = []
    for name in names:
        if is_scene(name):
            scene = load_scene(Path(name)).model_copy(update=change)
            jobs.append((name, functools.partial(_first_step_of_scene, scene)))
        else:
            jobs.append((name, functools.partial(first_step, TASKS[name](**change))))
    rows = []
    with progress_bar("compiling", len(jobs), "kernels") as progress:
        for done, (name, job) in enumerate(jobs):
            progress(done)
            before, start = len(compiled_kernels()), perf_counter()
            job()
            seconds, new = perf_counter() - start, compiled_kernels()[before:]
            note = f"compiled in {sum(k.seconds for k in new):.1f} s" if new else "was in the cache"
            rows.append((name, note, f"{seconds:.1f}"))
    show_table(new_console(), "First steps", rows, ("of", "", "s"))
    if unapplied_patches():
        import numba

        new_console().print(
            f"numba {numba.__version__}: compiling takes longer, as flockenv leaves out patches that were tested with "
            f"another version: {', '.join(unapplied_patches())}"
        )


def _first_step_of_scene(scene: Scene) -> None:
    scene.step(scene.start(0))


@app.command()
def schema() -> None:
    """Print the JSON Schema of a scene, for completion and checking of YAML in editors."""
    from flockenv.scene.yaml_io import schema as json_schema

    print(json.dumps(json_schema(), indent=0, allow_nan=False))  # a line for each value; indents were a fifth of it


def _first_sentence(kind: type) -> str:
    """Return the first sentence of a class's docstring."""
    return _sentence_of(" ".join((kind.__doc__ or "").split("\n\n")[0].split()))


def _sentence_of(text: str) -> str:
    """Return the first sentence of a text."""
    found = re.match(r".*?\.(?=\s+[A-Z]|$)", text)
    return found[0] if found else text


def _record(scene: Scene, seed: int, steps: int, every: int) -> Trajectory:
    from flockenv.studies.trajectory import record

    with progress_bar("simulating", steps, "steps", f"placing {scene.agents:,} agents, compiling") as progress:
        return record(scene, seed, steps, every, progress)


def _show_measures(console: Console, trajectory: Trajectory) -> None:
    from flockenv.studies.measures import MEASURES

    def text(value: float) -> str:
        return f"{value:.4g}" if math.isfinite(value) else "-"

    scene, time = trajectory.scene, float(trajectory.last.time[0])
    instants = 1 if trajectory.last is trajectory.first else 2
    with progress_bar("measuring", instants * scene.agents, "agents", f"measuring {scene.agents:,} agents") as progress:
        measured = trajectory.measures(progress)
    meant = {name: values for name, values in measured.items() if not all(map(math.isnan, values))}
    rows = [(name, text(a), text(b), MEASURES[name]) for name, (a, b) in meant.items()]
    title = f"{scene.agents:,} agents, {int(trajectory.step[-1]):,} steps of {scene.dt:g} s, seed {trajectory.seed}"
    show_table(console, title, rows, ("measure", "t = 0 s", f"t = {time:g} s", "unit"))
    work = {"neighbour queries": "neighbour_queries", "candidate pairs": "pairs", "obstacle tests": "obstacle_tests"}
    counts = ", ".join(f"{trajectory.last.count_of(name):,} {words}" for words, name in work.items())
    counts += _unsolved_text(trajectory.last)
    console.print(f"{text(trajectory.rate / 1e6)} million agent-steps/s ({trajectory.wall:.3g} s); {counts}")
    console.print(f"digest of the last state: {trajectory.last.digest}")


def _unsolved_text(state: State) -> str:
    """Return the number of contacts that a run left unsolved, to be appended to a line; "" if there are none."""
    count = state.count_of("unsolved")
    return f", {count:,} times contacts left unsolved" if count else ""


def _film_scene(
    file: str, duration: float, seed: int, share: float, camera: tuple[float, float]
) -> tuple[Panel, float, Shutter, str]:
    """Return the run of a scene as a panel, its frames per second, the shutter, and the text about unsolved contacts.

    share: of the time of a frame in which the shutter is open. camera: yaw and tilt, degrees.
    """
    from flockenv.render import Panel, turned
    from flockenv.render.camera import check_camera
    from flockenv.scene.yaml_io import load_scene
    from flockenv.studies.trajectory import whole_steps

    scene = load_scene(Path(file))
    check_camera(*camera, scene.dimension)
    every = max(1, round(1.0 / (FPS * scene.dt)))
    blur = Shutter.of(share, every)
    part = every // blur.parts
    trajectory = _record(scene, seed, whole_steps("--duration", duration, scene.dt), part)
    if trajectory.stopped == "interrupted":
        raise KeyboardInterrupt
    snapshots = [turned(shot, *camera) for shot in trajectory.snapshots(title=title_of(file))]
    panel = Panel("", snapshots, None, trajectory.stopped)
    return panel, 1.0 / (part * blur.parts * scene.dt), blur, _unsolved_text(trajectory.last)


if __name__ == "__main__":
    raise SystemExit(main())
