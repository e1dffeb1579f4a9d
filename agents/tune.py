"""Search for better parameters of the rules: `python -m agents.tune configs/training/pursuit.yaml`.

A plain search: random parameter sets and the textbook's, played on tuning worlds; the best quarter goes on to twice as
many worlds, each with a slightly changed copy, for a few rounds. The parameters found, and the agent-steps spent, are
written to flockenv/players/tuned/TASK.json; the default budget is of the order of that of PPO.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from agents.experiment import Experiment, load_experiment, one_line_errors
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes
from flockenv.cli.terminal import job_bar, run_program
from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.evaluation import rollout, worlds_for
from flockenv.jobs import Job, Store, Work, engine_of, records, run_jobs
from flockenv.players.rules import RULES, TUNED, RulesPlayer, as_dict
from flockenv.players.rules.parameter import ranges_of
from flockenv.tasks import Task

__all__ = ["app", "search"]

ROOM = 2**16
"""Bytes: more than the file takes."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)


def search(experiment: Experiment, work: Work) -> tuple[dict[str, float], dict[str, float]]:
    """Return the best parameters, and the agent-steps and scores of the search.

    work: stores and runs the jobs, one for each set of parameters in each round; its progress counts those of all
    rounds.
    """
    task, s = experiment.build(), experiment.search
    rng = np.random.default_rng(s.seed)
    parameters = RULES[task.name][1]
    ranges, textbook = ranges_of(parameters), as_dict(parameters())
    pool = [textbook, *({k: float(rng.uniform(*r)) for k, r in ranges.items()} for _ in range(s.candidates - 1))]
    worlds, played, steps, best_score = s.worlds, 0, 0, -np.inf
    total = _count_plays(s.candidates, s.rounds)
    for round_ in range(s.rounds):

        def progress(done: int, most: int, name: str, before: int = played) -> None:
            work.progress(before + done, total, name)

        scores = _scores(task, pool, worlds, s.seed, replace(work, progress=progress))
        played, steps = played + len(pool), steps + sum(spent for _, spent in scores)
        scored = sorted(zip((score for score, _ in scores), pool, strict=True), key=lambda pair: -pair[0])
        best_score = scored[0][0]
        keep = [candidate for _, candidate in scored[: max(2, len(scored) // 4)]]
        spread = 0.25 / (round_ + 1)
        pool = [*keep, *(_vary(keep[k % len(keep)], ranges, spread, rng) for k in range(len(keep)))]
        worlds *= 2
    found = {"agent_steps": float(steps), "tuning_mean": best_score, "tuning_worlds": float(worlds // 2)}
    found["textbook_mean"] = _score(task, textbook, worlds // 2, s.seed)[0]
    return {k: float(np.round(v, 4)) for k, v in scored[0][1].items()}, found


def _scores(
    task: Task, pool: Sequence[dict[str, float]], worlds: int, seed: int, work: Work
) -> list[tuple[float, int]]:
    """Return the mean return of each set of parameters on tuning worlds, and the agent-steps it took."""
    settings = [type(task).__name__, task.model_dump(mode="json")]
    jobs = [
        Job(f"tune/{task.name}/{worlds}-worlds", _play, (task, values, worlds, seed), [settings, values, worlds, seed])
        for values in pool
    ]
    run_jobs(jobs, work)
    return [work.store.read(job, lambda data: records.from_bytes(data, ())) for job in jobs]


def _play(task: Task, values: dict[str, float], worlds: int, seed: int) -> bytes:
    """Return the score of a set of parameters as bytes."""
    return records.to_bytes(_score(task, values, worlds, seed))


def _count_plays(candidates: int, rounds: int) -> int:
    """Return how many parameter sets are played in all rounds."""
    pool, total = candidates, 0
    for _ in range(rounds):
        total += pool
        pool = 2 * max(2, pool // 4)
    return total


def _vary(base: dict[str, float], ranges: dict[str, tuple[float, float]], spread: float, rng: Any) -> dict[str, float]:
    """Return a set of parameters near another: each moved by a share of its range."""
    return {k: float(np.clip(base[k] + spread * (hi - lo) * rng.normal(), lo, hi)) for k, (lo, hi) in ranges.items()}


def _score(task: Task, values: dict[str, float], worlds: int, seed: int) -> tuple[float, int]:
    """Return the mean return on tuning worlds, and the agent-steps it took.

    The mean is used, as in the paired differences of the comparison: a failure in one world out of ten must count.
    """
    episodes = rollout(
        task, RulesPlayer(task, RULES[task.name][1](**values)), worlds, worlds_for("tuning", seed, worlds)
    )
    return float(np.mean(episodes.returns)), int(np.sum(episodes.lengths) * task.learners)


def write(path: Path, task: str, parameters: dict[str, float], found: dict[str, float]) -> None:
    """Write the parameters that the search found for a task, completely or not at all."""
    content = {"task": task, "parameters": parameters, "found": found}
    with new_folder(path.parent), replace_file(path) as file:
        file.write((json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


@app.command()
def main(
    config: Annotated[Path, typer.Argument(help="an experiment, such as configs/training/pursuit.yaml")],
    out: Annotated[Path | None, typer.Option(help="default: flockenv/players/tuned/TASK.json")] = None,
    jobs: Annotated[Path, typer.Option(help="Folder for the records of jobs.")] = Path("results/jobs"),
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
) -> None:
    """Search the rules' parameters and write what was found."""
    with one_line_errors():
        experiment = load_experiment(config)
        task = experiment.build()
        target = TUNED / f"{task.name}.json" if out is None else valid_file(str(out), (".json",), force=True)
        check_room(target, ROOM)
        store, runner = Store(valid_path(str(jobs), "--jobs")), engine_of(engine, processes)
    with one_line_errors(), job_bar("compiling and playing", lines=False) as progress:
        rules, found = search(experiment, Work(store, runner, fresh, progress))
    console.print(f"{task.name}: found {json.dumps(rules)}", markup=False, highlight=False, soft_wrap=True)
    with one_line_errors():
        write(target, task.name, rules, found)
    gained = f"mean return {found['textbook_mean']:.3f} (textbook) -> {found['tuning_mean']:.3f}"
    console.print(f"{target}: {gained}, {found['agent_steps']:,.0f} agent-steps")


if __name__ == "__main__":
    run_program("tune", app, STOPPED)
