"""All players in the same worlds: `python -m agents.compare` plays all tasks and compares the returns.

Writes results.json, table.md, comparison.png and replay.html. Needs no torch: learned policies run in numpy.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import flockenv
from agents import report
from agents.experiment import CONFIGS, Experiment, load_experiment
from agents.processes import Tell, side_by_side
from flockenv.cli.terminal import report_errors, run_program, show_progress
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.errors import nearest, printable
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.core.warnings import OtherTaskWarning
from flockenv.evaluation import WORLDS_PER_SEED, Episodes, rollout, task_digest, worlds_for
from flockenv.players import NAMES, load_player, other_tasks
from flockenv.players.files import SUFFIXES, PlayerError
from flockenv.players.policy import Policy
from flockenv.players.rules import load_tuned
from flockenv.tasks import TASKS, Task

__all__ = [
    "Player",
    "app",
    "blame",
    "compare",
    "experiment_of",
    "folder_of",
    "pick",
    "players_in_order",
    "players_of",
    "provenance",
    "split",
    "usual_players",
    "write_text",
]  # fmt: skip

ROOT = Path(__file__).resolve().parent.parent
WORLDS, SMOKE_WORLDS = 256, 16
RESAMPLES, SMOKE_RESAMPLES = 10_000, 1_000
TOLD_EVERY = 0.1  # s, between two reports of one player's progress from another process
RECORDED = 0  # the world in the replay: the first, not a selected one
PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "pettingzoo")
FILES = ("results.json", "table.md", "comparison.png", "replay.html")
ROOM = 2**24
"""Bytes that all files take, approximately."""
NAME = re.compile(r"\w[\w.+-]{0,39}")
"""A player's name becomes a key, a table cell, a label and a piece of HTML."""

Plays = Mapping[str, Mapping[str, Policy]]  # task -> player -> policy
Advance = Callable[[str, str, int, int], None]  # task, player, steps done, steps at most

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@dataclass(frozen=True)
class Player:
    """A player: its specification (a known name or a file), and its name in the tables."""

    spec: str
    name: str

    @classmethod
    def of(cls, spec: str) -> Player:
        """Return a player; a file is named by its stem. Raise ValueError for a stem that is not valid in tables."""
        name = Path(spec).stem if Path(spec).suffix.lower() in SUFFIXES else spec
        if not NAME.fullmatch(name):
            raise ValueError(f"--players {printable(spec)}: a name is up to 40 letters, digits and _ . + -")
        return cls(spec, name)

    def policy(self, task: Task, seed: int, trust_pickle: bool = False) -> Policy:
        """Return the policy, ready to play a task; raise ValueError, in one line with its name, if it cannot."""
        with blame(self.name, task, ValueError), warnings.catch_warnings():
            warnings.simplefilter("ignore", OtherTaskWarning)  # the results list the differences
            return load_player(self.spec, task, seed, trust_pickle)


def compare(
    tasks: Sequence[Task],
    players: Sequence[Player],
    worlds: int = WORLDS,
    seed: int = 0,
    resamples: int = RESAMPLES,
    trust_pickle: bool = False,
    advance: Advance = lambda task, player, done, most: None,
) -> tuple[report.Results, dict[str, dict[str, Episodes]]]:
    """Play every task with every player in the same worlds; return the results as plain data, and the episodes.

    From 256 worlds on, tasks are played in parallel, by a process for each core: a script that calls this then needs
    `if __name__ == "__main__":`, like any that starts processes, and `advance` is called by another thread.

    Raises:
        ValueError: a player cannot be loaded (before any episode), or fails while playing; one line.
    """
    began = perf_counter()
    first = worlds_for("evaluation", seed, worlds)
    fields = players_of(tasks, players)
    plays = {
        task.name: {player.name: player.policy(task, seed, trust_pickle) for player in fields[task.name]}
        for task in tasks
    }
    jobs = [_Job(task, fields[task.name], worlds, seed, resamples, trust_pickle) for task in tasks]
    played = dict(zip((task.name for task in tasks), _play_all(jobs, plays, advance), strict=True))
    episodes = {name: each for name, (each, _) in played.items()}
    results: report.Results = {
        "seed": seed,
        "worlds": worlds,
        "world_seeds": {"block": "evaluation", "first": first, "last": first + worlds - 1},
        "bootstrap": {"resamples": resamples, "seed": seed, "interval": "95 % percentile; proportions: 95 % Wilson"},
        "players": {player.name: player.spec for player in players},
        "tasks": {name: about for name, (_, about) in played.items()},
        **provenance(),
    }
    results["wall_time_s"] = perf_counter() - began
    return results, episodes


def usual_players(tasks: Sequence[Task]) -> list[str]:
    """Return the default players: all named ones that can play one of the tasks."""
    return [name for name in NAMES if any(not other_tasks(name, task.name) for task in tasks)]


def players_of(tasks: Sequence[Task], players: Sequence[Player]) -> dict[str, list[Player]]:
    """Return the players of each task by its name: all except hand-written ones of other tasks in this comparison.

    Raises:
        ValueError: a task without a player.
    """
    fields = {task.name: [player for player in players if not _is_left_out(player, task, tasks)] for task in tasks}
    for task, field in fields.items():
        if not field:
            names = ", ".join(player.name for player in players)
            raise ValueError(f"task {task!r}: no player for it; these play other tasks only: {names}")
    return fields


def _is_left_out(player: Player, task: Task, tasks: Sequence[Task]) -> bool:
    """Return True for a hand-written player of other tasks, one of which is in this comparison."""
    of = other_tasks(player.spec, task.name)
    return any(other.name in of for other in tasks)


@dataclass(frozen=True)
class _Job:
    """One task: its players, the number of worlds, and the settings of the statistics."""

    task: Task
    players: Sequence[Player]
    worlds: int
    seed: int
    resamples: int
    trust_pickle: bool

    @property
    def first(self) -> int:
        """Seed of the first world."""
        return worlds_for("evaluation", self.seed, self.worlds)


Played = tuple[dict[str, Episodes], report.Results]


def _play_all(jobs: Sequence[_Job], plays: Plays, advance: Advance) -> Iterator[Played]:
    """Yield the result of every job; with enough work, jobs run in parallel, in a process for each core."""
    cores = min(os.cpu_count() or 1, len(jobs))
    if cores < 2 or jobs[0].worlds < WORLDS:
        return (_play(job, plays[job.task.name], advance) for job in jobs)
    return side_by_side(_play_in_process, jobs, cores, advance)


def _play_in_process(job: _Job, tell: Tell) -> Played:
    """Run a job in a worker process; the players are loaded there from their specifications."""
    last = [0.0]

    def advance(*news: Any) -> None:
        done, most = news[2:]
        if done in (1, most) or perf_counter() - last[0] > TOLD_EVERY:
            last[0] = perf_counter()
            tell(*news)

    tell(job.task.name, job.players[0].name, 0, job.task.horizon)  # a process has begun; it may compile first
    policies = {player.name: player.policy(job.task, job.seed, job.trust_pickle) for player in job.players}
    return _play(job, policies, advance)


def _play(job: _Job, policies: Mapping[str, Policy], advance: Advance) -> Played:
    """Play the same worlds of one task with every player; return the episodes by player, and the report's numbers."""
    task, episodes = job.task, {}
    for name, policy in policies.items():

        def progress(done: int, most: int, name: str = name) -> None:
            advance(task.name, name, done, most)

        with blame(name, task):
            episodes[name] = rollout(task, policy, job.worlds, job.first, record=RECORDED, progress=progress)
    costs = _costs(task, policies)
    differences = {name: getattr(policy, "differences", ()) for name, policy in policies.items()}
    return episodes, report.task_results(task_digest(task), episodes, costs, job.resamples, job.seed, differences)


@contextmanager
def blame(player: str, task: Task, *clear: type[Exception]) -> Iterator[None]:
    """Add player and task to an error that its `predict` raises or its actions cause; `clear` errors stay as they are.

    A PlayerError names the file already; the task is added.
    """
    try:
        yield
    except clear:
        raise
    except PlayerError as error:
        raise PlayerError(f"{error} (task {task.name!r})") from error
    except (Exception, SystemExit) as error:
        raise ValueError(f"player {player!r}, task {task.name!r}: {type(error).__name__}: {error}") from error


def _costs(task: Task, policies: Mapping[str, Policy]) -> dict[str, report.Results]:
    """Return the cost of training or tuning each player, as far as known: purpose, wall time in s, agent-steps."""
    costs = {}
    for name, policy in policies.items():
        card = getattr(policy, "card", None) or {}
        costs[name] = {key: card[key] for key in ("wall_time_s", "steps") if key in card}
    steps = load_tuned(task.name).found.get("agent_steps")
    if steps and "rules" in policies:
        costs["rules"] = {"of": "tuning", "steps": round(steps)}
    return costs


def experiment_of(name: str) -> Experiment:
    """Return the config of a task: the settings with which its players were trained and tuned."""
    path = CONFIGS / f"{name}.yaml"
    return load_experiment(path) if path.is_file() else Experiment(task=name)


def provenance() -> report.Results:
    """Return the data that are needed to reproduce the numbers."""
    changes = _git("status", "--porcelain")
    versions = {"flockenv": flockenv.__version__, "python": platform.python_version()}
    return {
        "versions": {**versions, **{name: _version(name) for name in PACKAGES}},
        "git": {"commit": _git("rev-parse", "HEAD"), "changed": None if changes is None else bool(changes)},
        "machine": {"system": platform.platform(), "cores": os.cpu_count()},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _git(*command: str) -> str | None:
    """Return the output of git for this checkout; None without git or a commit."""
    try:
        answer = subprocess.run(["git", "-C", str(ROOT), *command], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None


@app.command()
def main(
    tasks: Annotated[list[str] | None, typer.Option(help="Tasks, by comma or repeated. [all]")] = None,
    players: Annotated[
        list[str] | None,
        typer.Option(help=f"Players: {', '.join(NAMES)}, a .py file with a predict, or a .safetensors."),
    ] = None,
    worlds: Annotated[int | None, typer.Option(help=f"Worlds per task, the same for every player. [{WORLDS}]")] = None,
    seed: Annotated[int, typer.Option(help="Block of evaluation worlds, 0 to 999.")] = 0,
    out: Annotated[str, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = "results",
    smoke: Annotated[bool, typer.Option("--smoke", help=f"A quick look: {SMOKE_WORLDS} worlds.")] = False,
    trust_pickle: Annotated[
        bool, typer.Option("--trust-pickle", help="Also load Stable-Baselines3 zips, which executes the code in them.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show a traceback if something goes wrong.")] = False,
) -> None:
    """Play all tasks with all players in the same worlds, and compare their scores."""
    with report_errors("compare", "interrupted, nothing written", debug):
        folder = folder_of(out, FILES)
        chosen = [experiment_of(name).build() for name in pick("--tasks", split(tasks) or list(TASKS), TASKS)]
        field = players_in_order(split(players) or usual_players(chosen))
        count = worlds if worlds is not None else SMOKE_WORLDS if smoke else WORLDS
        if not 2 <= count <= WORLDS_PER_SEED:
            raise ValueError(f"--worlds {count}: must be from 2 to {WORLDS_PER_SEED}")
        resamples = SMOKE_RESAMPLES if smoke else RESAMPLES
        with _bars(chosen, len(field)) as advance:
            results, episodes = compare(chosen, field, count, seed, resamples, trust_pickle, advance)
        results["smoke"] = smoke
        write_all_or_none(folder, _file_writers(results, episodes))
    _show(results, folder)


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


def pick(option: str, names: Sequence[str], allowed: Mapping[str, object]) -> list[str]:
    """Return the names without repeats; ValueError for one that is not allowed."""
    for name in names:
        if name not in allowed:
            hint = nearest(name[:200], allowed)
            raise ValueError(f"{option} {printable(name)}: unknown{hint}; allowed: {', '.join(allowed)}")
    return list(dict.fromkeys(names))


def players_in_order(specs: Sequence[str]) -> list[Player]:
    """Return the players in the order of the tables: named ones as in NAMES, then files in the given order."""
    field = [Player.of(spec) for spec in dict.fromkeys(specs)]
    names = [player.name for player in field]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise ValueError(f"--players: two players are called {twice!r}; rename a file")
    return sorted(field, key=lambda player: NAMES.index(player.spec) if player.spec in NAMES else len(NAMES))


@contextmanager
def _bars(tasks: Sequence[Task], players: int) -> Iterator[Advance]:
    """Show a progress bar per task on a terminal; otherwise write a line per player and task."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description:<24}"), BarColumn(40), TimeElapsedColumn())
    with show_progress(Progress(*columns, console=console, transient=True)) as progress:
        bars = {task.name: progress.add_task(task.name, total=players * task.horizon, start=False) for task in tasks}
        played: dict[str, list[str]] = {task.name: [] for task in tasks}

        def advance(task: str, player: str, done: int, most: int) -> None:
            before = played[task]
            if player not in before:
                before.append(player)
                progress.start_task(bars[task])
                if not console.is_terminal:
                    console.print(f"{task}: {player} plays", highlight=False)
            progress.update(bars[task], completed=(len(before) - 1) * most + done, description=f"{task}: {player}")

        yield advance
        for task in tasks:
            progress.update(bars[task.name], completed=players * task.horizon)


def _file_writers(
    results: report.Results, episodes: Mapping[str, Mapping[str, Episodes]]
) -> dict[str, Callable[[Path], None]]:
    """Return the function that writes each file."""
    writers: tuple[Callable[[Path], None], ...] = (
        lambda path: write_text(path, report.json_text(results)),
        lambda path: write_text(path, report.markdown(results)),
        lambda path: _draw(path, results, episodes),
        lambda path: _replay(path, results, episodes),
    )
    return dict(zip(FILES, writers, strict=True))


def write_text(path: Path, text: str) -> None:
    """Write text with the same bytes on every system."""
    path.write_text(text, encoding="utf-8", newline="\n")


def _draw(path: Path, results: report.Results, episodes: Mapping[str, Mapping[str, Episodes]]) -> None:
    from flockenv.evaluation.plots import write_chart

    columns = [report.chart_column(task, about, episodes[task]) for task, about in results["tasks"].items()]
    note = f"{results['worlds']} worlds per task, the same for every player; level differences are grey"
    write_chart(path, columns, "Hand-written steering against learning", note)


def _replay(path: Path, results: report.Results, episodes: Mapping[str, Mapping[str, Episodes]]) -> None:
    from flockenv.render.replay import Group, Panel, write_replay

    groups = [
        Group(task, [Panel(name, *_replay_parts(played)) for name, played in players.items()])
        for task, players in episodes.items()
    ]
    first = results["world_seeds"]["first"] + RECORDED
    write_replay(path, groups, f"The same world under each player (seed {first})")


def _replay_parts(played: Episodes) -> tuple[Any, ...]:
    """Return the data of an episode for a replay: instants, return so far, and outcome."""
    recording = played.recording
    assert recording is not None  # every rollout here is recorded
    outcome = "success" if played.success[recording.world] else "no success"
    return recording.snapshots, recording.returns, f"{outcome} after {recording.snapshots[-1].time:.1f} s"


def _show(results: report.Results, folder: Path) -> None:
    """Print the tables, and then the verdict on each task."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=160)  # a pipe has no width; with 80 every cell would wrap
    for task, about in results["tasks"].items():
        console.print(*report.player_tables(task, about))
    for task, about in results["tasks"].items():
        console.print(about["verdict"], markup=False)
        for line in report.differences(task, about):
            console.print(line, markup=False)
    console.print(f"\n{results['wall_time_s']:.0f} s; {', '.join(FILES)} are in {folder}", markup=False)


if __name__ == "__main__":
    run_program("compare", app, "interrupted, nothing written")
