"""Comparison of players: all of them in the same held-out worlds of each task, as jobs, and their scores as plain data.

`flockenv compare` and `python -m agents.compare` show and write them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from flockenv.envs.disturbance import Disturbance
from flockenv.evaluation import Episodes, report, task_digest, worlds_for
from flockenv.jobs import Job, Store, Work, run_jobs
from flockenv.jobs.local_engine import LocalEngine
from flockenv.players.policy import Policy
from flockenv.players.rules import load_tuned
from flockenv.studies.play_jobs import Player, episodes_of_bytes, members_of, play_job, players_of
from flockenv.tasks import Task

__all__ = [
    "RECORDED", "RESAMPLES", "SMOKE_RESAMPLES", "SMOKE_WORLDS", "WORLDS", "Played", "compare", "in_turn",
]  # fmt: skip

WORLDS, SMOKE_WORLDS = 64, 16  # with ten seeds of most players, twice as many would take over two minutes
RESAMPLES, SMOKE_RESAMPLES = 10_000, 1_000
RECORDED = 0  # the world in the replay: the first, not a selected one

Played = dict[str, dict[str, Episodes]]
"""The episodes of a task, by player and by the names of its runs, the one that ships first."""


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
        "smoke": worlds < WORLDS or resamples < RESAMPLES,
        "players": {player.name: player.spec for player in players},
        "tasks": {
            task.name: _task_results(task, episodes[task.name], policies[task.name], resamples, seed) for task in tasks
        },
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
