"""All players in the same worlds: `python -m agents.compare` plays all tasks and compares the returns.

Tasks are those of configs/training, and players play with all their seeds; `flockenv compare` is the same for an
installed package. Writes results.json, table.md, comparison.png and replay.html. Needs no torch: learned policies run
in numpy.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Annotated, Literal

import typer

from agents.experiment import CONFIGS, Experiment, load_experiment
from flockenv.cli.compare import (
    FILES,
    JOBS,
    file_writers,
    folder_of,
    pick,
    show_comparison,
    split,
    valid_worlds,
    versions,
    write_text,
)
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.options import Debug, Delay, Dropped, Noise, Reach, Seen, TrustPickle
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.envs.disturbance import Disturbance
from flockenv.evaluation import report
from flockenv.jobs import Store, Work, engine_of
from flockenv.players import ALL_SEEDS, NAMES
from flockenv.studies.comparison import RESAMPLES, SMOKE_RESAMPLES, SMOKE_WORLDS, WORLDS, compare, in_turn
from flockenv.studies.play_jobs import players_in_order, usual_players
from flockenv.tasks import TASKS

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

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


def experiment_of(name: str) -> Experiment:
    """Return the config of a task: the settings with which its players were trained and tuned."""
    path = CONFIGS / f"{name}.yaml"
    return load_experiment(path) if path.is_file() else Experiment(task=name)


def provenance() -> report.Results:
    """Return the data that are needed to reproduce the numbers."""
    changes = _git("status", "--porcelain")
    git = {"commit": _git("rev-parse", "HEAD"), "changed": None if changes is None else bool(changes)}
    return {**versions(), "git": git}


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
        count = valid_worlds(worlds if worlds is not None else SMOKE_WORLDS if smoke else WORLDS)
        resamples = SMOKE_RESAMPLES if smoke else RESAMPLES
        disturbance = Disturbance(noise=noise, delay=delay, dropped=dropped, range=reach, seen=seen)
        runner, part = engine_of(engine, processes, small=count < WORLDS), shard_of(shard)
        with job_bar() as progress:
            work = Work(Store(folder / JOBS), runner, fresh, progress, part)
            results, episodes = compare(chosen, field, count, seed, resamples, trust_pickle, work, disturbance)
        results |= provenance()
        write_all_or_none(folder, file_writers(results, episodes))
    show_comparison(results, folder)


if __name__ == "__main__":
    run_program("compare", app, STOPPED)
