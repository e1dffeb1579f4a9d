"""The `compare` command: players in the same held-out worlds of each task, and the files of a comparison."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

import flockenv
from flockenv.cli.jobs import STOPPED, EngineName, Processes
from flockenv.cli.options import Delay, Dropped, Noise, Reach, Seen, TrustPickle
from flockenv.cli.terminal import job_bar
from flockenv.core import signals
from flockenv.core.errors import nearest, printable
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.players import NAMES

if TYPE_CHECKING:
    from flockenv.evaluation import Episodes
    from flockenv.evaluation.report import Results
    from flockenv.studies.comparison import Played
    from flockenv.tasks import Task

__all__ = [
    "FILES", "JOBS", "changes_of", "compare", "file_writers", "folder_of", "pick", "show_comparison", "split",
    "valid_worlds", "versions", "write_text",
]  # fmt: skip

FILES = ("results.json", "table.md", "comparison.png", "replay.html")
JOBS = "jobs"
"""Folder of the jobs' records, in the results folder."""
PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "pettingzoo")
ROOM = 2**24
"""Bytes that all files take, approximately."""


def compare(
    tasks: Annotated[list[str] | None, typer.Argument(metavar="TASK", help="Tasks.", show_default="all")] = None,
    players: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE,...",
            help=f"Players: {', '.join(NAMES)}, with a seed (ppo@3) or of all seeds (ppo@*), or files (.safetensors, "
            ".py, .zip).",
            show_default="the usual ones",
        ),
    ] = None,
    changed: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="TASK.ARGUMENT=VALUE", help="Another argument of a task; repeatable."),
    ] = None,
    worlds: Annotated[int | None, typer.Option(metavar="N", help="Worlds per task.", show_default="64")] = None,
    seed: Annotated[int, typer.Option(help="Block of evaluation worlds, 0 to 999.")] = 0,
    out: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER", help=f"Folder for {', '.join(FILES)}, and for what was played: if the command is "
            "interrupted, it continues from there.", show_default="writes nothing",
        ),
    ] = None,
    noise: Noise = 0.0,
    delay: Delay = 0,
    dropped: Dropped = 0.0,
    reach: Reach = None,
    seen: Seen = None,
    engine: EngineName = "local",
    processes: Processes = None,
    trust_pickle: TrustPickle = False,
) -> None:  # fmt: skip
    """Play tasks with several players in the same worlds, and compare their scores.

    Tasks have the arguments with which their policies were trained, but for those of --set. No player was trained or
    tuned in these worlds.
    """
    from flockenv.core.atomic_files import write_all_or_none
    from flockenv.envs.disturbance import Disturbance
    from flockenv.jobs import Store, Work, engine_of
    from flockenv.players import trained_task
    from flockenv.studies import comparison
    from flockenv.studies.play_jobs import players_in_order, usual_players
    from flockenv.tasks import TASKS

    folder = folder_of(out, FILES) if out is not None else None
    names = pick("TASK", tasks or list(TASKS), TASKS)
    changes = changes_of(changed or [], names)
    chosen = [_changed(trained_task(name), changes.get(name, {})) for name in names]
    field = players_in_order(split([players] if players is not None else []) or usual_players(chosen))
    count = valid_worlds(comparison.WORLDS if worlds is None else worlds)
    disturbance = Disturbance(noise=noise, delay=delay, dropped=dropped, range=reach, seen=seen)
    runner = engine_of(engine, processes, small=count < comparison.WORLDS)
    if folder is not None:
        signals.set_message(STOPPED)
    with TemporaryDirectory(prefix="flockenv-jobs-") as passing, job_bar() as progress:
        work = Work(Store(Path(passing) if folder is None else folder / JOBS), runner, False, progress)
        results, episodes = comparison.compare(
            chosen, field, count, seed, trust_pickle=trust_pickle, work=work, disturbance=disturbance
        )
    results |= versions()
    if changes:
        results["changes"] = changes
    if folder is not None:
        write_all_or_none(folder, file_writers(results, episodes))
    show_comparison(results, folder)


def versions() -> Results:
    """Return the versions and the machine on which the numbers depend."""
    own = {"flockenv": flockenv.__version__, "python": platform.python_version()}
    return {
        "versions": {**own, **{name: _version(name) for name in PACKAGES}},
        "machine": {"system": platform.platform(), "cores": os.cpu_count()},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def valid_worlds(count: int) -> int:
    """Return a number of worlds; raise ValueError, in one line, if it is not possible."""
    from flockenv.evaluation import WORLDS_PER_SEED

    if not 2 <= count <= WORLDS_PER_SEED:
        raise ValueError(f"--worlds {count}: must be from 2 to {WORLDS_PER_SEED}")
    return count


def folder_of(text: str, files: Sequence[str]) -> Path:
    """Return the folder of --out; raise ValueError or OSError if these files cannot be written there."""
    folder = valid_path(text)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {printable(text)}: is a file, must be a folder")
    for name in files:
        valid_file(str(folder / name), (Path(name).suffix,), force=True)
    check_room(folder / files[0], ROOM)
    return folder


def split(values: Sequence[str] | None) -> list[str]:
    """Return the values of an option, which may be separated by commas or repeated."""
    return [part.strip() for value in values or () for part in value.split(",") if part.strip()]


def changes_of(texts: Sequence[str], tasks: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return the arguments of --set, TASK.ARGUMENT=VALUE each, by task; ValueError, in one line, for another text."""
    from flockenv.scene.yaml_io import parse_scalar

    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        path, sign, value = text.partition("=")
        task, dot, key = path.strip().partition(".")
        if not sign or not dot:
            raise ValueError(f"--set {printable(text)}: must be TASK.ARGUMENT=VALUE, such as crossing.agents=24")
        pick("--set", [task], tasks)
        found.setdefault(task, {})[key] = parse_scalar(value.strip())
    return found


def _changed(task: Task, changes: Mapping[str, Any]) -> Task:
    """Return a task with other arguments; ValueError, in one line, if it refuses them."""
    if not changes:
        return task
    try:
        new = type(task)(**{**task.model_dump(mode="json"), **changes})
        new.scene  # noqa: B018  # it is made now, and refuses an unstable time step
    except ValueError as error:
        raise ValueError(f"--set: {error}") from None
    return new


def pick(option: str, names: Sequence[str], allowed: Collection[str]) -> list[str]:
    """Return the names without repeats; ValueError for one that is not allowed."""
    for name in names:
        if name not in allowed:
            hint = nearest(name[:200], allowed)
            raise ValueError(f"{option} {printable(name)}: unknown{hint}; allowed: {', '.join(allowed)}")
    return list(dict.fromkeys(names))


def file_writers(results: Results, episodes: Mapping[str, Played]) -> dict[str, Callable[[Path], None]]:
    """Return the function that writes each of FILES."""
    from flockenv.evaluation import report

    writers: tuple[Callable[[Path], None], ...] = (
        lambda path: write_text(path, report.json_text(results)),
        lambda path: write_text(path, report.markdown(results)),
        lambda path: _draw(path, results),
        lambda path: _replay(path, results, episodes),
    )
    return dict(zip(FILES, writers, strict=True))


def write_text(path: Path, text: str) -> None:
    """Write text with the same bytes on every system."""
    path.write_text(text, encoding="utf-8", newline="\n")


def _draw(path: Path, results: Results) -> None:
    from flockenv.evaluation import report
    from flockenv.evaluation.plots import write_chart

    columns = [report.chart_column(task, about) for task, about in results["tasks"].items()]
    note = f"{report.conditions(results)}, the same for every player; level differences are grey"
    write_chart(path, columns, "Hand-written steering against learning", note)


def _replay(path: Path, results: Results, episodes: Mapping[str, Played]) -> None:
    from flockenv.render.replay import Group, Panel, write_replay
    from flockenv.studies.comparison import RECORDED

    groups = [
        Group(task, [Panel(name, *_replay_parts(next(iter(runs.values())))) for name, runs in players.items()])
        for task, players in episodes.items()
    ]
    first = results["world_seeds"]["first"] + RECORDED
    write_replay(path, groups, f"The same world under each player (seed {first})")


def _replay_parts(played: Episodes) -> tuple[Any, ...]:
    """Return the data of an episode for a replay: instants, return so far, and outcome."""
    recording = played.recording
    assert recording is not None  # of the run that ships, or of the only one
    outcome = "success" if played.success[recording.world] else "no success"
    return recording.snapshots, recording.returns, f"{outcome} after {recording.snapshots[-1].time:.1f} s"


def show_comparison(results: Results, folder: Path | None) -> None:
    """Print the tables, and then the verdict on each task; folder: where the files are."""
    from flockenv.evaluation import report

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=160)  # a pipe has no width; with 80 every cell would wrap
    for task, about in results["tasks"].items():
        console.print(*report.player_tables(task, about))
    console.print(f"{report.MICROSECONDS}\n", highlight=False)
    for task, about in results["tasks"].items():
        console.print(about["verdict"], markup=False)
        for line in report.differences(task, about):
            console.print(line, markup=False)
    written = "" if folder is None else f"; {', '.join(FILES)} are in {folder}"
    console.print(f"\n{results['wall_time_s']:.0f} s{written}", markup=False)
