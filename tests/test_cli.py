"""Command line: what it prints and writes; user errors print one line to stderr and exit with code 2."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from PIL import Image
from rich.progress import Progress
from typer.testing import CliRunner

import flockenv.studies.stress
from flockenv.cli import terminal
from flockenv.cli.main import app, main
from flockenv.cli.targets import complete_scene, is_scene
from flockenv.model.networks import Rope
from flockenv.model.state import State
from flockenv.physics.effects import EFFECTS
from flockenv.physics.effects.springs import Springs
from flockenv.physics.integrators import INTEGRATORS, ImplicitEuler, Integrator
from flockenv.players.policy import Policy, RandomPolicy
from flockenv.scene import Group, Scene
from flockenv.scene.stability import suggest_dt
from flockenv.scene.yaml_io import load_scene, schema
from flockenv.studies import cost_breakdown
from flockenv.studies.cost_breakdown import Cost, Explanation
from flockenv.studies.stress import Case, Value
from flockenv.tasks import TASKS

ROOT = Path(__file__).resolve().parent.parent
PARTICLES = str(ROOT / "configs" / "scenes" / "particles.yaml")

TINY = """\
space: {kind: torus, size: [9, 9]}
groups: [{count: 4, spawn: {speed: [1, 2]}}]
effects: [{kind: drag, rate: 0.5}]
dt: 0.01
"""

FLOCK = TINY.replace("{kind: drag, rate: 0.5}", "{kind: separation, weight: 1, radius: 2}")


@pytest.fixture(autouse=True)
def in_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(TINY)


def process(*arguments: str) -> list[str]:
    return [sys.executable, "-c", "import sys; from flockenv.cli.main import main; sys.exit(main())", *arguments]


ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


# --- list, schema, help -----------------------------------------------------------------------------------------------


def test_list_prints_all_tasks_effects_and_methods_with_a_description() -> None:
    done = CliRunner().invoke(app, ["list"])
    assert done.exit_code == 0
    names = [*TASKS, *EFFECTS, *INTEGRATORS, "plane", "torus", "box", "flockenv/Flock-v1", "flockenv/Pursuit-v0"]
    for name in names:
        assert re.search(rf"^{re.escape(name)} +\S+", done.stdout, re.MULTILINE), name
    assert "F = -c (v - u)" in done.stdout


def test_schema_prints_the_json_schema_of_scenes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == schema()


@pytest.mark.parametrize(
    "command",
    [
        "list",
        "run",
        "measure",
        "render",
        "explain",
        "accuracy",
        "stress",
        "experiment",
        "gallery",
        "validate",
        "import-mesh",
        "import-plan",
        "schema",
    ],
)
def test_help_of_every_command_shows_all_of_its_text(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Detects text in brackets, such as defaults, that rich drops as markup."""
    monkeypatch.setenv("TERMINAL_WIDTH", "500")
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 500)
    done = CliRunner().invoke(app, [command, "--help"])
    assert done.exit_code == 0
    assert "Usage:" in done.stdout
    shown = " ".join(done.stdout.split())
    for parameter in typer.main.get_command(app).commands[command].params:  # type: ignore[attr-defined]
        assert " ".join((parameter.help or "").replace("`", "").split()) in shown
        if isinstance(parameter.show_default, str):
            assert f"[default: ({parameter.show_default})]" in shown


def test_help_texts_leave_defaults_to_typer() -> None:
    for command in typer.main.get_command(app).commands.values():  # type: ignore[attr-defined]
        assert not [p.name for p in command.params if "[default" in (p.help or "")]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("render pur", ["pursuit"]),
        ("warmup path", ["path_follow"]),
        ("render ti", ["tiny.yaml"]),
        ("render ZZ", ["ZZ.YML"]),
        ("render zz", []),
    ],
)
def test_shell_completes_tasks_and_scene_files(words: str, expected: list[str]) -> None:
    Path("notes.txt").touch()
    Path("ZZ.YML").touch()
    done = subprocess.run(
        [sys.executable, "-c", "from flockenv.cli.main import app; app(prog_name='flockenv')"],
        env={**ENVIRONMENT, "_FLOCKENV_COMPLETE": "complete_bash", "COMP_WORDS": f"_ {words}", "COMP_CWORD": "2"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.split() == expected


@pytest.mark.parametrize("command", ["stress --cases N999", "validate riema9"])
def test_unknown_case_is_refused_with_the_nearest_names(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command.split()) == 2
    printed = capsys.readouterr().err
    assert re.search(r"unknown; the nearest of \d+: (.*, ){4}.*$", printed)
    assert len(printed) < 200


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"{flockenv.__version__}\n"


# --- run --------------------------------------------------------------------------------------------------------------


def test_run_prints_measures_and_writes_a_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "tiny.yaml", "--seed", "7", "--duration", "1", "--out", "results/deep/t.npz"]) == 0
    out = capsys.readouterr().out
    assert "4 agents, 100 steps of 0.01 s, seed 7" in out
    assert re.search(r"^speed +1\.\d+ +0\.\d+ +m/s, mean", out, re.MULTILINE)
    assert "0 neighbour queries" in out
    assert sorted(p.name for p in (tmp_path / "results" / "deep").iterdir()) == ["t.json", "t.npz"]

    with np.load("results/deep/t.npz", allow_pickle=False) as file:
        assert load_scene(str(file["scene"])) == load_scene(TINY)
        assert file["pos"].shape == file["vel"].shape == (11, 4, 2)
        assert file["time"] == pytest.approx(np.arange(11) * 0.1)
        assert int(file["seed"]) == 7
        # F = -c v and mass 1: v(t) = v(0) exp(-c t), to the accuracy of the first-order method
        assert file["vel"][-1] == pytest.approx(file["vel"][0] * np.exp(-0.5), rel=0.01)
        start = load_scene(TINY).start(7)
        assert np.array_equal(file["pos"][0], start.pos[0])

    summary = json.loads(Path("results/deep/t.json").read_text())
    assert summary["seed"] == 7 and summary["steps"] == 100 and summary["stopped"] == ""
    assert summary["measures"]["agents"] == {"start": 4.0, "end": 4.0}
    assert summary["work"]["neighbour_queries"] == 0


def test_runs_with_equal_seeds_are_equal(capsys: pytest.CaptureFixture[str]) -> None:
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert main(["run", "tiny.yaml", "--seed", seed, "--duration", "0.5", "--out", f"{name}.npz"]) == 0
    a, b, c = (np.load(f"{name}.npz")["pos"] for name in "abc")
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_run_without_out_writes_nothing(tmp_path: Path) -> None:
    assert main(["run", "tiny.yaml", "--duration", "0.1"]) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["tiny.yaml"]


def test_measures_without_a_meaning_in_a_scene_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    """Particles of a block are no flock, and overlap each other by design."""
    dice = "groups: [{radius: 0.1, network: {kind: blocks, sides: [0.1, 0.1], centres: [[0, 0]]}}]"
    Path("dice.yaml").write_text(f"{dice}\nconstraints: [{{kind: rigid_bodies}}]\n")
    for name, shown in (("tiny", True), ("dice", False)):
        assert main(["run", f"{name}.yaml", "--duration", "0"]) == 0
        out = capsys.readouterr().out
        assert [f"\n{measure} " in out for measure in ("agents", "polarisation", "volume")] == [True, shown, not shown]
        assert re.search(r"^contacts +0 +0 ", out, re.MULTILINE)


def test_duration_zero_makes_no_steps(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "tiny.yaml", "--duration", "0", "--out", "t.npz"]) == 0
    assert np.load("t.npz")["pos"].shape == (1, 4, 2)
    assert json.loads(Path("t.json").read_text())["agent_steps_per_s"] is None  # no NaN in JSON


def test_every_sets_the_interval_of_recorded_instants_and_the_last_is_included() -> None:
    assert main(["run", "tiny.yaml", "--duration", "0.5", "--every", "0.2", "--out", "t.npz"]) == 0
    assert np.load("t.npz")["time"] == pytest.approx([0, 0.2, 0.4, 0.5])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::flockenv.core.warnings.UnsolvedContactsWarning")
def test_run_and_render_print_the_number_of_unsolved_contacts(capsys: pytest.CaptureFixture[str]) -> None:
    heap = "{count: 25, radius: 0.1, spawn: {low: [0, 0], high: [1.25, 1.25], spacing: 0.25}}"
    rules = "effects: [{kind: gravity}]\nconstraints: [{kind: collisions, response: impulses, passes: %d}]\ndt: 0.01\n"
    text = f"dimension: 2\nspace: {{kind: box, size: [1.25, 5]}}\ngroups: [{heap}]\n{rules}"
    for passes, unsolved in ((2, True), (200, False)):
        Path("heap.yaml").write_text(text % passes)
        for command in (["run"], ["render", "--size", "64", "--force", "--out", "h.png"]):
            assert main([command[0], "heap.yaml", "--duration", "1", *command[1:]]) == 0
            assert bool(re.search(r", [\d,]+ times contacts left unsolved$", capsys.readouterr().out, re.M)) == unsolved


@pytest.mark.slow
def test_neighbours_are_queried_once_per_step_only_if_an_effect_needs_them(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["run", PARTICLES, "--duration", "0.2"]) == 0
    assert "; 0 neighbour queries, 0 candidate pairs" in capsys.readouterr().out
    Path("flock.yaml").write_text(FLOCK)
    assert main(["run", "flock.yaml", "--duration", "0.2"]) == 0
    assert "; 20 neighbour queries, " in capsys.readouterr().out


@pytest.mark.slow
def test_time_of_a_run_excludes_compilation(tmp_path: Path) -> None:
    """Otherwise the first run of a scene shows the speed of the compiler."""
    Path("new.yaml").write_text(TINY + "constraints: [{kind: collisions}]\n")
    code = (
        "from pathlib import Path; from flockenv.jit.progress import compiled_kernels;"
        "from flockenv.scene.yaml_io import load_scene;"
        "from flockenv.studies.trajectory import record; seen = [];"
        "record(load_scene(Path('new.yaml')), 0, 50, 10, lambda done: seen.append(len(compiled_kernels())));"
        "assert seen[0] == seen[-1] == len(compiled_kernels()) > 0, seen"
    )
    fresh = {**ENVIRONMENT, "FLOCKENV_CACHE": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", code], env=fresh, check=True)


def test_run_that_diverges_reports_it_and_writes_the_steps_before(capsys: pytest.CaptureFixture[str]) -> None:
    wild = TINY.replace("kind: drag, rate: 0.5", "kind: quadratic_drag, rate: 1e6")
    wild = wild.replace("torus, size: [9, 9]", "plane").replace("spawn: {", "spawn: {low: [0, 0], high: [9, 9], ")
    Path("wild.yaml").write_text(wild)
    assert main(["run", "wild.yaml", "--duration", "10", "--every", "0.01", "--out", "t.npz"]) == 1
    captured = capsys.readouterr()
    assert re.match(r"flockenv: world 0, agent \d: position or velocity is not finite in step ", captured.err)
    assert len(captured.err.splitlines()) == 1
    assert json.loads(Path("t.json").read_text())["stopped"].startswith("world 0, agent ")
    assert 1 <= len(np.load("t.npz")["time"]) < 1000


# --- interrupting -----------------------------------------------------------------------------------------------------


def interrupted(moment: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process that sends itself SIGINT once the progress bar of that name has advanced."""
    code = f"""
import contextlib, os, signal, sys
from flockenv.cli import films, main

signal.signal(signal.SIGINT, signal.default_int_handler)  # a background test run ignores SIGINT, as do its children

@contextlib.contextmanager
def progress(title, total, unit, first=""):
    def show(done):
        if title == {moment!r} and done > 2:
            os.kill(os.getpid(), signal.SIGINT)
    yield show

main.progress_bar = films.progress_bar = progress
sys.exit(main.main())
"""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def test_interrupted_run_writes_its_steps_and_exits_with_130(tmp_path: Path) -> None:
    done = interrupted("simulating", "run", "tiny.yaml", "--duration", "1e6", "--every", "1000", "--out", "t.npz")
    assert done.returncode == 130, done.stderr
    first, last = done.stderr.splitlines()
    assert re.fullmatch(r"flockenv: interrupted; measuring the state at \S+ s, Ctrl-C again ends it", first)
    assert re.fullmatch(r"flockenv: interrupted; results until \S+ s are shown", last)
    summary = json.loads(Path("t.json").read_text())
    assert summary["stopped"] == "interrupted"
    assert 0 < summary["steps"] < 1e8
    assert np.load("t.npz")["time"][-1] == pytest.approx(summary["time_s"])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.json", "t.npz", "tiny.yaml"]


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["simulating", "drawing"])
def test_interrupted_render_writes_no_file(moment: str, tmp_path: Path) -> None:
    done = interrupted(moment, "render", "tiny.yaml", "--duration", "10", "--out", "t.gif")
    assert (done.returncode, done.stderr) == (130, "flockenv: interrupted\n")
    assert [p.name for p in tmp_path.iterdir()] == ["tiny.yaml"]


# --- progress ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Report progress every 20 ms."""
    monkeypatch.setattr(terminal, "FIRST", 0.02)
    monkeypatch.setattr(terminal, "OFTEN", 0.02)


@pytest.mark.usefixtures("often")
def test_progress_is_written_as_lines_to_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    printed = ""

    def until(word: str) -> None:
        nonlocal printed
        last = time.monotonic() + 60
        while word not in printed:
            assert time.monotonic() < last, printed
            time.sleep(0.01)
            printed += capsys.readouterr().err

    with terminal.progress_bar("working", 10**14, "steps", "placing agents") as progress:
        until("placing agents: (")
        progress(0)
        time.sleep(0.02)
        progress(10)
        until("years left")
        progress(10**14)
    printed += capsys.readouterr().err
    waiting, working = (
        r"placing agents: \(\d+ s so far\)",
        r"working: 1e-11 % \(\d+ s so far, about [\d,]+ years left\)",
    )
    assert re.fullmatch(rf"({waiting}\n)+(working: \(\d+ s so far\)\n)*({working}\n)+", printed), printed


def test_quick_command_prints_no_progress(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "tiny.yaml", "--duration", "0.1"]) == 0
    assert capsys.readouterr().err == ""


class Stderr(io.StringIO):
    """Replacement of stderr; the event `arrived` is set once a line of progress is written."""

    def __init__(self) -> None:
        super().__init__()
        self.arrived = threading.Event()

    def write(self, text: str) -> int:
        count = super().write(text)
        if " so far" in self.getvalue():
            self.arrived.set()
        return count


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("command", [["measure", "--time", "0.1"], ["run", "--duration", "0.1"]], ids=lambda c: c[0])
def test_long_commands_print_progress(command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Independent of the machine's speed: the first update of progress waits until a line is written."""
    stderr, update = Stderr(), Progress.update

    def wait(bars: Progress, *given: Any, **more: Any) -> None:
        update(bars, *given, **more)
        assert stderr.arrived.wait(60)

    monkeypatch.setattr(sys, "stderr", stderr)
    monkeypatch.setattr(Progress, "update", wait)
    name, *options = command
    assert main([name, "tiny.yaml", *options]) == 0
    assert re.search(r"^\S.*: .*\(\d+ s so far.*\)$", stderr.getvalue(), re.MULTILINE)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0, "0 s"), (89, "89 s"), (91, "2 min"), (5399, "90 min"), (5401, "2 h"), (172799, "48 h"), (172801, "2 days"),
     (7e7, "2 years"), (1e12, "31,688 years")],
)  # fmt: skip
def test_duration_in_words(seconds: float, words: str) -> None:
    assert terminal.duration_text(seconds) == words


# --- render -----------------------------------------------------------------------------------------------------------


def test_scene_is_rendered_as_gif_png_and_html(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("s.gif", "s.PNG", "s.html"):
        assert main(["render", "tiny.yaml", "--duration", "0.4", "--size", "128", "--out", name]) == 0
    assert capsys.readouterr().out.startswith("s.gif: ")
    with Image.open("s.gif") as gif:
        assert getattr(gif, "n_frames", 1) == 11  # 25 a second
        assert gif.size[0] == 128
    with Image.open("s.PNG") as png:
        assert png.format == "PNG"
    assert '"player":' in Path("s.html").read_text()


def test_scene_in_a_plane_is_rendered() -> None:
    Path("plane.yaml").write_text(
        "groups: [{count: 3, spawn: {low: [0, 0], high: [1, 1], speed: [9, 9]}}]\neffects: [{kind: drag, rate: 0}]\n"
    )
    assert main(["render", "plane.yaml", "--duration", "1", "--size", "128", "--out", "p.html"]) == 0


def test_task_is_rendered_with_a_player_from_a_file() -> None:
    Path("still.py").write_text(
        "import numpy as np\n\n\ndef player(task):\n    class Still:\n"
        "        def predict(self, observation, state=None, episode_start=None, deterministic=False):\n"
        "            return np.zeros((len(np.atleast_2d(observation)), task.action_layout.size), np.float32), state\n"
        "    return Still()\n"
    )
    assert main(["render", "pursuit", "--player", "still.py", "--size", "96", "--out", "p.png"]) == 0
    assert main(["render", "pursuit", "--seed", "3", "--out", "p.html"]) == 0
    for name in ("rules", "ppo"):
        assert main(["render", "pursuit", "--player", name, "--out", f"{name}.html"]) == 0
        assert f'"player":"{name}"' in Path(f"{name}.html").read_text().replace('": "', '":"')
    with Image.open("p.png") as png:
        assert png.size[0] == 96


def test_a_shipped_policy_is_rendered_in_the_task_that_it_was_trained_on() -> None:
    """Bottleneck was trained with together=True; filterwarnings makes the warning about a difference an error."""
    assert main(["render", "bottleneck", "--player", "ppo", "--size", "64", "--out", "b.png"]) == 0


def test_a_task_is_rendered_with_a_disturbance(capsys: pytest.CaptureFixture[str]) -> None:
    for name, options in {"plain": (), "late": ("--delay", "5"), "noisy": ("--noise", "0.3")}.items():
        assert main(["render", "pursuit", "--player", "rules", "--out", f"{name}.html", *options]) == 0
    assert len({Path(f"{name}.html").read_text() for name in ("plain", "late", "noisy")}) == 3
    capsys.readouterr()
    Path("scene.yaml").write_text("groups: [{count: 1, spawn: {low: [0, 0], high: [1, 1]}}]\n")
    for what, options, text in (
        ("path_follow", ("--dropped", "0.1"), "dropped = 0.1: must be 0 for path_follow"),
        ("pursuit", ("--noise", "2"), "noise = 2.0"),
        ("scene.yaml", ("--delay", "1"), "--noise, --delay, --dropped, --range, --seen: for tasks only"),
        ("pursuit", ("--yaw", "30"), "--yaw, --tilt: for scenes only"),
        ("scene.yaml", ("--tilt", "30"), "--yaw, --tilt: for pictures and films; an HTML replay is turned by the"),
        ("scene.yaml", ("--tilt", "30", "--out", "x.png"), "yaw = 0, tilt = 30: for worlds in 3-D only"),
    ):
        assert main(["render", what, "--out", "x.html", *options]) == 2
        error = capsys.readouterr().err
        assert text in error and error.count("\n") == 1
    assert not Path("x.html").exists() and not Path("x.png").exists()


def test_several_players_are_drawn_side_by_side() -> None:
    command = ["render", "pursuit", "--player", "rules,textbook", "--size", "192", "--seed", "3"]
    for out in ("two.png", "two.gif", "two.html"):
        assert main([*command, "--out", out]) == 0
    for out in ("two.png", "two.gif"):
        with Image.open(out) as picture:
            left, right = (np.asarray(picture.convert("RGB"))[:, part] for part in (slice(96), slice(96, 192)))
            assert left.shape == right.shape and not np.array_equal(left, right)
    text = Path("two.html").read_text().replace('": "', '":"')
    assert '"player":"rules"' in text and '"player":"textbook"' in text


def test_zip_is_loaded_as_a_player_only_if_trusted(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(path: Path, trust_pickle: bool) -> Policy:
        assert trust_pickle
        return RandomPolicy(2, 0)

    monkeypatch.setitem(sys.modules, "flockenv.envs.sb3", SimpleNamespace(load_sb3_zip=load))  # without torch
    Path("mine.zip").write_bytes(b"")
    command = ["render", "pursuit", "--player", "mine.zip", "--out", "p.html"]
    assert main(command) == 2 and "pass --trust-pickle" in capsys.readouterr().err
    assert main([*command, "--trust-pickle"]) == 0 and Path("p.html").exists()


# --- explain ----------------------------------------------------------------------------------------------------------

COST = r"-?[\d.e+-]+ \[-?[\d.e+-]+, -?[\d.e+-]+\]( level| not measurable)? *"
"""Pattern of a measured difference of times with its interval."""


def test_cost_is_a_median_with_an_interval_and_level_if_that_contains_zero() -> None:
    clear, level = Cost.of(np.arange(1.0, 16.0)), Cost.of(np.arange(-7.0, 8.0))
    assert str(clear) == "8 [4, 12]"  # ranks 4 and 12 of 15: 96.5 % of all medians lie between (binomial)
    assert str(level) == "0 [-4, 4] level"
    disturbed = np.arange(1.0, 16.0)
    disturbed[-1] = 1e6  # another process slowed one round
    assert Cost.of(disturbed) == clear


@pytest.mark.parametrize(
    ("without_drag", "cost", "note"),
    [
        (9.0, "1 [1, 1]", ""),
        (10.0, "0 [0, 0] level", "level: the interval contains 0."),
        (10.3, "-0.3 [-0.3, -0.3] not measurable", "not measurable: the step took longer without the effect. Each"),
    ],
)
def test_explain_remarks_on_a_cost_that_is_not_above_zero(
    without_drag: float,
    cost: str,
    note: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Where the compiler puts code may make a step with one effect more the faster one, in every round."""
    taken = {2: 10.0, 1: without_drag, 0: 5.0}  # us per step, by number of effects

    class Timer:
        def __init__(self, scene: Scene, state: State) -> None:
            kinds = [effect.kind for effect in scene.effects]
            self._us = 7.0 if kinds == ["drag"] else taken[len(kinds)]

        def measure(self) -> float:
            return self._us

    monkeypatch.setattr(cost_breakdown, "_Timer", Timer)
    Path("two.yaml").write_text(TINY.replace("[{kind: drag", "[{kind: gravity}, {kind: drag"))
    assert main(["explain", "two.yaml"]) == 0
    out = capsys.readouterr().out
    assert re.search(rf"^drag\(rate=0.5\) +nothing +{re.escape(cost)} *$", out, re.MULTILINE)
    assert "An interval covers the rounds of this process" in out
    assert note in out
    assert [word in out for word in ("level: ", "not measurable: ")] == [note[:1] == "l", note[:1] == "n"]


@pytest.mark.slow
def test_explain_prints_what_effects_need_and_what_is_not_computed(capsys: pytest.CaptureFixture[str]) -> None:
    Path("flock.yaml").write_text(FLOCK)
    assert main(["explain", "flock.yaml"]) == 0
    flock = capsys.readouterr().out
    assert re.search(rf"^separation\(.*radius=2.0\) +neighbour query within 2 m +{COST}$", flock, re.MULTILINE)
    assert "Per step: 1 evaluations, 1 neighbour queries" in flock
    assert "neighbour query: no effect" not in flock

    assert main(["explain", "tiny.yaml"]) == 0
    drag = capsys.readouterr().out
    assert re.search(rf"^drag\(rate=0.5\) +nothing +{COST}$", drag, re.MULTILINE)
    assert "1 evaluations, 0 neighbour queries, 0 pairs, 0 obstacle tests" in drag
    assert "neighbour query: no effect needs neighbours" in drag
    assert "pass over obstacles (0): no effect needs them" in drag
    assert f"effects that are not listed: {', '.join(sorted(EFFECTS.keys() - {'drag'}))}" in " ".join(drag.split())
    assert "Largest stable step: 4 s (drag, agent 0), dt = 0.01 s" in drag  # |1 - h c / m| = 1
    assert "Largest stable step: no effect limits dt; contacts between agents may; dt = 0.01 s" in flock


def test_explain_names_the_effect_and_agent_that_limit_the_step() -> None:
    def limit(scene: Scene) -> str:
        return Explanation(scene, (), 0.0, 0.0, Cost(0, 0, 0), {}, (), suggest_dt(scene)).largest_step

    rope = Rope(links=4, length=4, pinned=("start",))
    scene = Scene(groups=(Group(network=rope),), effects=(Springs(stiffness=100),), dt=0.02)
    # three free particles between two springs: w^2 <= 2 (100 + 100) N/m / kg, and h w = 2 at the most
    assert limit(scene) == "0.1 s (springs, agent 1), dt = 0.02 s"
    assert limit(scene.with_effects()) == "no effect limits dt; contacts between agents may; dt = 0.02 s"
    assert limit(scene.model_copy(update={"integrator": ImplicitEuler()})) == (
        "any is stable with implicit_euler, dt = 0.02 s"
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_warning_is_one_line_without_a_source_location(capsys: pytest.CaptureFixture[str]) -> None:
    held = TINY.replace("{kind: drag, rate: 0.5}", "{kind: tether, centre: [0, 0], stiffness: 100}")
    Path("stiff.yaml").write_text(held.replace("dt: 0.01", "dt: 0.21"))
    assert main(["run", "stiff.yaml", "--duration", "0.21"]) == 0
    assert re.fullmatch(r"flockenv: warning: dt = 0\.21 s.*tether.*0\.2 s.*\n", capsys.readouterr().err)


# --- stress -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace the stress cases by two artificial ones; return the list of trials."""
    calls: list[str] = []

    def case(name: str, within: bool) -> Case:
        def trial(method: Integrator) -> Value:
            calls.append(f"{name} {method.kind}")
            return Value(0.5, within, "so it is")

        return Case(name, f"the scene of {name}", "none", trial)

    monkeypatch.setattr("flockenv.studies.stress.CASES", (case("X01", True), case("X02", False)))
    return calls


def test_stress_prints_values_and_failures(tried: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stress", "--methods", "rk4,heun"]) == 0
    assert tried == ["X01 rk4", "X02 rk4", "X01 heun", "X02 heun"]
    shown = capsys.readouterr().out
    for text in ("X01", "the scene of X02", "rk4", "heun", "0.5 ok", "0.5 FAILS", "so it is"):
        assert text in shown
    assert not list(Path().glob("*.json"))


@pytest.mark.slow
def test_stress_continues_with_the_findings_of_its_file(tried: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stress", "--methods", "rk4", "--out", "hard.png"]) == 0
    with Image.open("hard.png") as picture:
        assert picture.width > 100
    assert main(["stress", "--methods", "rk4,heun", "--cases", "X02", "--out", "hard.json"]) == 0
    assert tried == ["X01 rk4", "X02 rk4", "X02 heun"]
    kept = json.loads(Path("hard.json").read_text())
    assert sorted(f"{f['case']} {f['under']}" for f in kept["findings"]) == sorted(tried)
    kept["sources"] = "those of yesterday"
    Path("hard.json").write_text(json.dumps(kept))
    tried.clear()
    capsys.readouterr()
    assert main(["stress", "--methods", "rk4", "--out", "hard.json"]) == 2
    assert capsys.readouterr().err == (
        "flockenv: --out: hard.json contains findings (3) of another version of the code; --force starts again\n"
    )
    assert not tried and json.loads(Path("hard.json").read_text()) == kept
    assert main(["stress", "--methods", "rk4", "--cases", "X01", "--out", "hard.json", "--force"]) == 0
    assert tried == ["X01 rk4"]


def test_stress_does_not_overwrite_a_file_without_findings(
    tried: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("mine.json").write_text('{"life": "work"}')
    assert main(["stress", "--out", "mine.json"]) == 2
    assert capsys.readouterr().err == (
        "flockenv: --out: mine.json contains no findings of hard cases; --force overwrites it\n"
    )
    assert not tried and Path("mine.json").read_text() == '{"life": "work"}'


def test_interrupted_stress_writes_its_findings(
    tried: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(method: Integrator) -> Value:
        raise KeyboardInterrupt

    first = flockenv.studies.stress.CASES[0]
    monkeypatch.setattr("flockenv.studies.stress.CASES", (first, Case("X03", "stopped", "none", interrupted)))
    last = "flockenv: interrupted; results so far are shown, the same command continues\n"
    assert main(["stress", "--methods", "rk4", "--out", "hard.json"]) == 130
    assert capsys.readouterr().err == last
    assert main(["stress", "--methods", "rk4", "--out", "hard.png"]) == 130
    assert capsys.readouterr().err == f"flockenv: interrupted; drawing hard.png, Ctrl-C again ends it\n{last}"
    assert [f["case"] for f in json.loads(Path("hard.json").read_text())["findings"]] == ["X01"]


# --- user errors ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("run", "Missing argument 'SCENE'"),
        ("rnu tiny.yaml", "No such command 'rnu'. Did you mean 'run'?"),
        ("run tiny.yaml --sede 1", "No such option: --sede"),
        ("run tinny.yaml", "tinny.yaml: no such file, did you mean `tiny.yaml`?"),
        ("run .", ".: no such file (it is a folder)"),
        ("run tiny.yaml --seed -1", "Invalid value for '--seed'"),
        ("run tiny.yaml --seed 18446744073709551616", "Invalid value for '--seed'"),
        ("run tiny.yaml --seed 1.5", "Invalid value for '--seed'"),
        ("run tiny.yaml --seed abc", "Invalid value for '--seed'"),
        ("run tiny.yaml --duration -1", "--duration = -1: must be a finite number of seconds >= 0"),
        ("run tiny.yaml --duration nan", "--duration = nan: must be a finite number"),
        ("run tiny.yaml --duration inf", "--duration = inf: must be a finite number"),
        ("run tiny.yaml --duration 1e300", "--duration = 1e+300 s: too many steps"),
        (
            "run tiny.yaml --duration 0.015",
            "--duration = 0.015 s: must be a whole multiple of dt = 0.01 s, say 0.01 or 0.02",
        ),
        (
            "run tiny.yaml --every 0 --out x.npz",
            "--every = 0 s: must be a whole multiple of dt = 0.01 s, say 0.01 or 0.02",
        ),
        ("run tiny.yaml --duration 1e9 --every 0.1 --out x.npz", "10,000,000,001 instants of 4 agents need about"),
        ("run tiny.yaml --out x.gif", "--out 'x.gif': must end in .npz"),
        ("run tiny.yaml --out ../x.npz", "--out '../x.npz': must not go up with '..'"),
        ("run tiny.yaml --out /etc/x.npz", "--out '/etc/x.npz': must lie below "),
        ("run tiny.yaml --out a\0b.npz", "--out 'a\\x00b.npz': must be a name without control characters"),
        ("run tiny.yaml --out tiny.yaml/x.npz", "--out 'tiny.yaml/x.npz': '"),
        (f"run tiny.yaml --out {'x' * 300}.npz", "--out '"),
        ("run tiny.yaml --out con.npz", "--out 'con.npz': 'con.npz' is a reserved name"),
        ("render tiny.yaml", "Missing option '--out'"),
        ("render tiny.yaml --out x.avi", "--out 'x.avi': must end in .gif or .png or .html or .mp4 or .webp"),
        (
            "render tiny.yaml --out x.gfi",
            "--out 'x.gfi': must end in .gif or .png or .html or .mp4 or .webp, did you mean `.gif`?",
        ),
        ("render pursiut --out x.gif", "'pursiut': no such task, did you mean `pursuit`? ("),
        ("render pursuit --out x.gif --player nosuch", "player 'nosuch': unknown"),
        ("render pursuit --out x.gif --player rule", "player 'rule': unknown, did you mean `rules`?"),
        ("render pursuit --out x.gif --player reynolds", "player 'reynolds': is called 'rules'"),
        ("render pursuit --out x.gif --player orca", "there is no hand-written player 'orca' for 'pursuit'"),
        ("render pursuit --out x.gif --player no.safetensors", "player 'no.safetensors': no such file"),
        ("render pursuit --out x.gif --duration 3", "--duration = 3: only for scenes"),
        ("render tiny.yaml --out x.gif --size 1", "Invalid value for '--size'"),
        ("explain nothing.yaml", "nothing.yaml: no such file"),
        ("run boidz", "boidz: no such file, did you mean `boids`?"),
        ("render boidz --out x.gif", "'boidz': no such task, did you mean `boids`?"),
        ("render tinny.YAML --out x.png", "tinny.YAML: no such file, did you mean `tiny.yaml`?"),
        ("warmup tinny.YML", "tinny.YML: no such file, did you mean `tiny.yaml`?"),
        ("warmup pursiut", "'pursiut': no such task, did you mean `pursuit`? ("),
    ],
)
def test_user_error_is_one_line_with_exit_code_2_and_writes_nothing(
    arguments: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments.split(" ")) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"flockenv: {message}"), captured.err
    assert len(captured.err.splitlines()) == 1 and len(captured.err) < 600
    assert [p.name for p in tmp_path.iterdir()] == ["tiny.yaml"]


SCENE_COMMANDS = [
    "run - --duration 0", "measure - --time 0.1", "render - --out a.png --duration 0", "explain -", "warmup -",
    "render - --out a.html --duration 0",
    pytest.param("accuracy - --seconds 0.1 --steps 1,2,4,8", marks=pytest.mark.slow),  # one kernel for each method
]  # fmt: skip


@pytest.mark.parametrize("command", SCENE_COMMANDS)
def test_every_command_on_a_scene_reads_standard_input(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(TINY.encode())))
    assert main(command.split()) == 0
    assert "a.html" not in command or "<title>standard input</title>" in Path("a.html").read_text()


def test_a_scene_that_ships_is_read_by_name_and_a_file_of_that_name_comes_first(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert load_scene("boids") == load_scene(ROOT / "configs" / "scenes" / "boids.yaml") == load_scene(Path("boids"))
    assert is_scene("boids") and not is_scene("pursuit") and complete_scene("cloth_") == ["cloth_on_ball"]
    assert main(["run", "newtons_cradle", "--duration", "0"]) == 0
    assert " agents, 0 steps of " in capsys.readouterr().out
    Path("boids").write_text(TINY)
    assert load_scene("boids").agents == 4


def test_error_in_a_scene_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    Path("bad.yaml").write_text(TINY.replace("rate: 0.5", "rte: 0.5"))
    assert main(["run", "bad.yaml", "--out", "x.npz"]) == 2
    assert capsys.readouterr().err == (
        "flockenv: bad.yaml:3: effects[0].rte = 0.5: unknown key, did you mean `rate`? allowed here: kind, rate\n"
    )


def test_control_characters_in_names_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "\x1b[2Jx.yaml"]) == 2
    assert main(["render", "\x1b[2Jx", "--out", "x.gif"]) == 2
    assert main(["\x1b[2J"]) == 2
    assert "\x1b" not in capsys.readouterr().err


def test_existing_file_is_overwritten_only_with_force(capsys: pytest.CaptureFixture[str]) -> None:
    Path("t.json").write_text("mine")
    assert main(["run", "tiny.yaml", "--duration", "0", "--out", "t.npz"]) == 2
    assert re.match(r"flockenv: --out '.*t\.json': exists already; --force overwrites it", capsys.readouterr().err)
    assert Path("t.json").read_text() == "mine"
    assert not Path("t.npz").exists()
    assert main(["run", "tiny.yaml", "--duration", "0", "--out", "t.npz", "--force"]) == 0
    assert json.loads(Path("t.json").read_text())["steps"] == 0


def test_symbolic_link_out_of_the_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").symlink_to("/usr/share")
    assert main(["run", "tiny.yaml", "--duration", "0", "--out", "out/x.npz"]) == 2
    assert "must lie below" in capsys.readouterr().err


def test_debug_raises_the_exception(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="no such file"):
        main(["run", "nothing.yaml", "--debug"])
    with pytest.raises(ValueError, match="no such file"):
        main(["--debug", "run", "nothing.yaml"])


def test_unexpected_exception_is_reported_as_a_bug(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(source: object) -> None:
        raise KeyError("pos")

    monkeypatch.setattr("flockenv.scene.yaml_io.load_scene", broken)
    assert main(["run", "tiny.yaml"]) == 1
    assert capsys.readouterr().err == "flockenv: KeyError: 'pos' (a bug in flockenv; --debug shows where)\n"


def test_lack_of_memory_is_not_reported_as_a_bug(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def short(text: str) -> Any:
        def load(source: object) -> None:
            raise MemoryError(text) if text else MemoryError

        return load

    for text, message in (
        ("Unable to allocate 3. GiB for an array", "not enough memory: Unable to allocate 3. GiB for an array"),
        ("", "not enough memory: use fewer agents or worlds"),
    ):
        monkeypatch.setattr("flockenv.scene.yaml_io.load_scene", short(text))
        assert main(["run", "tiny.yaml"]) == 2
        assert capsys.readouterr().err == f"flockenv: {message}\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize(
    "command", [("list",), ("schema",), ("run", "tiny.yaml", "--duration", "0.1")], ids=lambda c: c[0]
)
def test_full_disk_at_standard_output_is_one_line(command: tuple[str, ...]) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(process(*command), env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, "flockenv: standard output: No space left on device\n")


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), OSError(5, "Input/output error", "x")])
def test_system_error_prints_nothing_to_standard_output(
    error: OSError, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr("flockenv.scene.yaml_io.load_scene", fail)
    assert main(["explain", "tiny.yaml"]) == 2
    where = "x: " if error.filename else ""
    assert capsys.readouterr() == ("", f"flockenv: {where}{error.strerror}\n")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["t.npz", "t.gif", "t.png", "t.html"])
def test_full_disk_is_one_line_with_the_file_and_leaves_no_files(name: str, tmp_path: Path) -> None:
    """A limit on file size replaces the full disk."""
    command = "run" if name.endswith("npz") else "render"
    code = (
        "import resource, sys; from flockenv.cli.main import main\n"
        "import flockenv.core.output_paths, matplotlib.font_manager\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200, 200)); sys.exit(main())"
    )
    arguments = (command, "tiny.yaml", "--duration", "0.2", "--out", f"deep/{name}")
    assert main([*arguments[:-1], name]) == 0  # compiles first, as a kernel exceeds the limit
    os.remove(name)
    Path("t.json").unlink(missing_ok=True)
    done = subprocess.run([sys.executable, "-c", code, *arguments], env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert re.fullmatch(rf"flockenv: cannot write '\S*deep/{re.escape(name)}': File too large\n", done.stderr)
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


def test_the_command_line_is_a_module_too() -> None:
    command = [sys.executable, "-m", "flockenv.cli.main", "play", "boidz"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch("flockenv: .*boidz.*did you mean .boids.*\n", done.stderr)


def test_no_arguments_show_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "Usage:" in capsys.readouterr().out


# --- as a process -----------------------------------------------------------------------------------------------------


def test_process_prints_errors_to_stderr_and_exits_with_2() -> None:
    done = subprocess.run(
        process("run", "tiny.yaml", "--duration", "-1"), env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "flockenv: --duration = -1: must be a finite number of seconds >= 0\n"


def test_closed_pipe_is_no_error() -> None:
    """`flockenv list | head -1`."""
    command = f"{sys.executable} -c 'import sys; from flockenv.cli.main import main; sys.exit(main())' list | head -1"
    done = subprocess.run(command, shell=True, env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("Tasks\n", "")


@pytest.mark.slow
def test_run_works_without_home_display_or_locale() -> None:
    bare = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "LANG": "C", "LC_ALL": "C", "TZ": "Mars/Phobos"}
    done = subprocess.run(
        process("run", "tiny.yaml", "--duration", "0.1"), env=bare, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "4 agents, 10 steps" in done.stdout
