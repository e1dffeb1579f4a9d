"""All players in the same worlds: `python -m agents.compare` plays all tasks and compares the returns.

Writes results.json, table.md, comparison.png and replay.html. Needs no torch: learned policies run in numpy.
"""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

import flockenv
from agents import report
from agents.experiment import CONFIGS, Experiment, load_experiment
from agents.play import Player, episodes_of_bytes, members_of, play_job, players_in_order, players_of, usual_players
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.options import Debug, Delay, Dropped, Noise, Reach, Seen, TrustPickle
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.errors import nearest, printable
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.envs.disturbance import Disturbance
from flockenv.evaluation import WORLDS_PER_SEED, Episodes, task_digest, worlds_for
from flockenv.jobs import Job, Store, Work, engine_of, run_jobs
from flockenv.jobs.local_engine import LocalEngine
from flockenv.players import ALL_SEEDS, NAMES
from flockenv.players.policy import Policy
from flockenv.players.rules import load_tuned
from flockenv.tasks import TASKS, Task

__all__ = [
    "JOBS",
    "app",
    "compare",
    "experiment_of",
    "folder_of",
    "in_turn",
    "pick",
    "provenance",
    "split",
    "write_text",
]  # fmt: skip

ROOT = Path(__file__).resolve().parent.parent
WORLDS, SMOKE_WORLDS = 128, 16  # with ten seeds of each player, twice as many would take over two minutes
RESAMPLES, SMOKE_RESAMPLES = 10_000, 1_000
RECORDED = 0  # the world in the replay: the first, not a selected one
PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "pettingzoo")
FILES = ("results.json", "table.md", "comparison.png", "replay.html")
JOBS = "jobs"
"""Folder of the jobs' records, in the results folder."""
ROOM = 2**24
"""Bytes that all files take, approximately."""

Played = dict[str, dict[str, Episodes]]
"""The episodes of a task, by player and by the names of its runs, the one that ships first."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


def compare(
    tasks: Sequence[Task],
    players: Sequence[Player],
    worlds: int = WORLDS,
    seed: int = 0,
    resamples: int = RESAMPLES,
    trust_pickle: bool = False,
    work: Work | None = None,
    disturbance: Disturbance | None = None,
) -> tuple[report.Results, dict[str, Played]]:
    """Play every task with every player in the same worlds; return the results as plain data, and the episodes.

    A player NAME@* plays with the runs of all seeds, in the same worlds. work: where and how to run the jobs, one for
    each run (default: one after another in this process, and nothing is stored). disturbance: of the worlds, the same
    for every player (default: none).

    Raises:
        ValueError: a player cannot be loaded (before any episode), or jobs fail while playing; one line.
    """
    if work is None:
        with TemporaryDirectory(prefix="flockenv-jobs-") as folder:
            work = Work(Store(Path(folder)), LocalEngine(1))
            return compare(tasks, players, worlds, seed, resamples, trust_pickle, work, disturbance)
    began = perf_counter()
    first = worlds_for("evaluation", seed, worlds)
    fields = players_of(tasks, players)
    runs = {task.name: {player.name: members_of(player, task.name) for player in fields[task.name]} for task in tasks}
    policies = {
        task.name: {
            name: [run.policy(task, seed, trust_pickle) for run in each] for name, each in runs[task.name].items()
        }
        for task in tasks
    }
    jobs: dict[tuple[str, ...], Job] = {
        (task.name, name, run.spec): play_job(
            "compare", task, run, worlds, seed, None if number else RECORDED, trust_pickle, disturbance
        )
        for task in tasks for name, each in runs[task.name].items() for number, run in enumerate(each)
    }  # fmt: skip
    run_jobs(in_turn(jobs), work)
    episodes: dict[str, Played] = {task.name: {} for task in tasks}
    for (of_task, name, spec), job in jobs.items():
        episodes[of_task].setdefault(name, {})[spec] = work.store.read(job, episodes_of_bytes)
    results: report.Results = {
        "seed": seed,
        "worlds": worlds,
        "world_seeds": {"block": "evaluation", "first": first, "last": first + worlds - 1},
        "disturbance": (disturbance or Disturbance()).model_dump(),
        "bootstrap": {"resamples": resamples, "seed": seed, "interval": report.INTERVAL},
        "players": {player.name: player.spec for player in players},
        "tasks": {
            task.name: _task_results(task, episodes[task.name], policies[task.name], resamples, seed) for task in tasks
        },
        **provenance(),
    }
    results["wall_time_s"] = perf_counter() - began
    return results, episodes


def in_turn(jobs: Mapping[tuple[str, ...], Job]) -> list[Job]:
    """Return jobs, whose key begins with the task, so that neighbours are of different tasks: none waits for a kernel.

    The order within a task is kept.
    """
    rows: dict[str, list[Job]] = {}
    for (task, *_), job in jobs.items():
        rows.setdefault(task, []).append(job)
    return [job for column in zip_longest(*rows.values()) for job in column if job is not None]


def _task_results(
    task: Task, episodes: Played, policies: Mapping[str, Sequence[Policy]], resamples: int, seed: int
) -> report.Results:
    """Return the numbers of one task as plain data."""
    ships = {name: each[0] for name, each in policies.items()}
    differences = {name: getattr(policy, "differences", ()) for name, policy in ships.items()}
    return report.task_results(task_digest(task), episodes, _costs(task, ships), resamples, seed, differences)


def _costs(task: Task, policies: Mapping[str, Policy]) -> dict[str, report.Results]:
    """Return the cost of training or tuning one run of each player, as far as known: purpose, seconds, agent-steps."""
    costs = {}
    for name, policy in policies.items():
        card = getattr(policy, "card", None) or {}
        costs[name] = {key: card[key] for key in ("wall_time_s", "steps") if key in card}
        if steps := load_tuned(task.name, name).found.get("agent_steps"):
            costs[name] = {"of": "tuning", "steps": round(steps)}
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
        typer.Option(
            help=f"Players: {', '.join(NAMES)}, also with a seed (ppo@3) or of all seeds (ppo@*); a .py file with a "
            "predict, or a .safetensors. [the usual ones, of all seeds]"
        ),
    ] = None,
    seeds: Annotated[
        Literal["all", "shipped"], typer.Option(help="What NAME@* plays: all seeds, or the run that ships.")
    ] = "all",
    worlds: Annotated[int | None, typer.Option(help=f"Worlds per task, the same for every player. [{WORLDS}]")] = None,
    seed: Annotated[int, typer.Option(help="Block of evaluation worlds, 0 to 999.")] = 0,
    out: Annotated[str, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = "results",
    noise: Noise = 0.0,
    delay: Delay = 0,
    dropped: Dropped = 0.0,
    reach: Reach = None,
    seen: Seen = None,
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
    shard: ShardText = None,
    smoke: Annotated[bool, typer.Option("--smoke", help=f"A quick look: {SMOKE_WORLDS} worlds.")] = False,
    trust_pickle: TrustPickle = False,
    debug: Debug = False,
) -> None:
    """Play all tasks with all players in the same worlds, and compare their scores."""
    with report_errors("compare", STOPPED, debug), end_of_shard():
        folder = folder_of(out, FILES)
        chosen = [experiment_of(name).build() for name in pick("--tasks", split(tasks) or list(TASKS), TASKS)]
        specs = split(players) or usual_players(chosen, ALL_SEEDS)
        field = players_in_order([spec.removesuffix(ALL_SEEDS) if seeds == "shipped" else spec for spec in specs])
        count = worlds if worlds is not None else SMOKE_WORLDS if smoke else WORLDS
        if not 2 <= count <= WORLDS_PER_SEED:
            raise ValueError(f"--worlds {count}: must be from 2 to {WORLDS_PER_SEED}")
        resamples = SMOKE_RESAMPLES if smoke else RESAMPLES
        disturbance = Disturbance(noise=noise, delay=delay, dropped=dropped, range=reach, seen=seen)
        runner, part = engine_of(engine, processes, small=count < WORLDS), shard_of(shard)
        with job_bar() as progress:
            work = Work(Store(folder / JOBS), runner, fresh, progress, part)
            results, episodes = compare(chosen, field, count, seed, resamples, trust_pickle, work, disturbance)
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


def _file_writers(results: report.Results, episodes: Mapping[str, Played]) -> dict[str, Callable[[Path], None]]:
    """Return the function that writes each file."""
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


def _draw(path: Path, results: report.Results) -> None:
    from flockenv.evaluation.plots import write_chart

    columns = [report.chart_column(task, about) for task, about in results["tasks"].items()]
    note = f"{report.conditions(results)}, the same for every player; level differences are grey"
    write_chart(path, columns, "Hand-written steering against learning", note)


def _replay(path: Path, results: report.Results, episodes: Mapping[str, Played]) -> None:
    from flockenv.render.replay import Group, Panel, write_replay

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
    run_program("compare", app, STOPPED)
