"""Transfer of policies to other integrators: `python -m agents.transfer [TASK...]` plays the same worlds with each.

Every player plays the held-out worlds of agents.compare under each integration method, step and precision. It decides
as often as before; only the motion between two decisions is computed differently. Then the same actions are replayed
and timed under each setting. Every job's record is stored at once: after an interruption the same command continues.
Writes transfer.json, transfer.md and transfer.png.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from agents import transfer_report
from agents.compare import (
    JOBS,
    experiment_of,
    folder_of,
    pick,
    provenance,
    split,
    write_text,
)
from agents.transfer_jobs import Plan, clock_of, jobs_by_kernel, read_again, read_cells, round_jobs
from agents.transfer_report import Setting
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.options import Debug, Delay, Dropped, Noise, Reach, Seen, TrustPickle
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.errors import nearest, printable
from flockenv.envs.disturbance import Disturbance
from flockenv.evaluation import WORLDS_PER_SEED, report, worlds_for
from flockenv.jobs import Store, Work, engine_of, run_jobs
from flockenv.jobs.local_engine import LocalEngine
from flockenv.physics.integrators import INTEGRATORS
from flockenv.studies.play_jobs import players_in_order, players_of
from flockenv.tasks import TASKS, Task

__all__ = ["app"]

WORLDS, ROUNDS, RESAMPLES = 128, 5, 10_000
PLAYERS = ("random", "rules", "ppo")
METHODS = ("semi_implicit_euler", "explicit_euler", "velocity_verlet")
SUBSTEPS = (0.5, 1.0, 4.0)
"""Physics steps per decision, as multiples of the trained number."""
MOST_SUBSTEPS = 1000
FILES = ("transfer.json", "transfer.md", "transfer.png")

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


# --- the command line -------------------------------------------------------------------------------------------------


@app.command()
def main(
    tasks: Annotated[list[str] | None, typer.Argument(metavar="TASK", help="Tasks. [all]")] = None,
    players: Annotated[
        list[str] | None, typer.Option(help="Players, as in agents.compare. [" + ",".join(PLAYERS) + "]")
    ] = None,
    methods: Annotated[
        list[str] | None,
        typer.Option(help="Integrators; KIND:float32 in single precision. [" + ",".join(METHODS) + "]"),
    ] = None,
    substeps: Annotated[
        list[str] | None, typer.Option(help="Physics steps per decision. [half, once and 4 times those of training]")
    ] = None,
    worlds: Annotated[int, typer.Option(help="Worlds per task, the same for every player.")] = WORLDS,
    rounds: Annotated[int, typer.Option(help="Rounds in which wall time is measured.")] = ROUNDS,
    seed: Annotated[int, typer.Option(help="Block of evaluation worlds, 0 to 999.")] = 0,
    noise: Noise = 0.0,
    delay: Delay = 0,
    dropped: Dropped = 0.0,
    reach: Reach = None,
    seen: Seen = None,
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
    shard: ShardText = None,
    out: Annotated[str, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = "results",
    trust_pickle: TrustPickle = False,
    debug: Debug = False,
) -> None:
    """Play the same worlds with integrators of different accuracy; show the effect on each policy, and the cost."""
    with report_errors("transfer", STOPPED, debug), end_of_shard():
        folder = folder_of(out, FILES)
        _check("--worlds", worlds, 2, WORLDS_PER_SEED)
        _check("--rounds", rounds, 1, 1000)
        worlds_for("evaluation", seed, worlds)
        chosen = [experiment_of(name).build() for name in pick("TASK", split(tasks) or list(TASKS), TASKS)]
        fields = players_of(chosen, players_in_order(split(players) or PLAYERS))
        solvers, steps = _solvers(split(methods) or list(METHODS)), _substeps(split(substeps))
        disturbance = Disturbance(noise=noise, delay=delay, dropped=dropped, range=reach, seen=seen)
        plans = [
            Plan(
                task, _settings(task, solvers, steps), tuple(fields[task.name]), worlds, seed, rounds, trust_pickle,
                disturbance,
            )
            for task in chosen
        ]  # fmt: skip
        runner, part = engine_of(engine, processes), shard_of(shard)
        with job_bar() as progress:
            measured = _measure(plans, Work(Store(folder / JOBS), runner, fresh, progress, part))
        results = report.all_rounded(measured)
        write_all_or_none(folder, {
            "transfer.json": lambda path: write_text(path, report.json_text(results)),
            "transfer.md": lambda path: write_text(path, transfer_report.markdown(results)),
            "transfer.png": lambda path: _draw(path, results),
        })  # fmt: skip
    transfer_report.show(results)
    typer.echo(f"{results['wall_time_s']:.0f} s; {', '.join(FILES)} are in {folder}")


def _check(option: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise ValueError(f"{option} {value}: must be from {least} to {most}")


def _solvers(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return kinds of integrators with their precision; raise ValueError for one that is unknown or not playable."""
    allowed = [kind for kind, method in INTEGRATORS.items() if not method.solves]
    found = []
    for name in names:
        kind, _, dtype = name.partition(":")
        if kind not in allowed:
            hint = nearest(kind[:200], allowed)
            raise ValueError(f"--methods {printable(name)}: no method of a task{hint}; allowed: {', '.join(allowed)}")
        if dtype not in ("", "float64", "float32"):
            raise ValueError(f"--methods {printable(name)}: the precision must be float64 or float32")
        found.append((kind, dtype or "float64"))
    return list(dict.fromkeys(found))


def _substeps(texts: Sequence[str]) -> list[int]:
    """Return numbers of steps per decision, without repeats; raise ValueError for one that is out of range."""
    for text in texts:
        if not (text.isascii() and text.isdigit() and 1 <= int(text[:9]) <= MOST_SUBSTEPS):
            raise ValueError(f"--substeps {printable(text)}: must be an integer from 1 to {MOST_SUBSTEPS}")
    return sorted({int(text) for text in texts})


def _settings(task: Task, solvers: Sequence[tuple[str, str]], substeps: Sequence[int]) -> tuple[Setting, ...]:
    """Return the settings to play; the first is that of training, even if it is not selected.

    substeps: steps per decision (default: SUBSTEPS times those of training).
    """
    counts = substeps or sorted({max(1, round(factor * task.substeps)) for factor in SUBSTEPS})
    chosen = [Setting(method, dtype, steps) for method, dtype in solvers for steps in counts]
    return tuple(dict.fromkeys([Setting.of_training(task), *chosen]))


def _measure(plans: Sequence[Plan], work: Work) -> report.Results:
    """Play the missing episodes, time the settings on this machine, and return everything as plain data."""
    began = perf_counter()
    for plan in plans:
        for player in plan.players:
            plan.policy(player, plan.task)  # players that cannot be loaded are rejected before any plays
    jobs, rounds = jobs_by_kernel(plans), round_jobs(plans)
    run_jobs(list(jobs.values()), work)  # a shard ends here: it does not time
    run_jobs(rounds, dataclasses.replace(work, engine=LocalEngine(1, renew=True)))
    about = {
        plan.task.name: transfer_report.task_results(
            plan.task, plan.settings, read_cells(plan, jobs, work.store), clock_of(plan, rounds, work.store),
            read_again(plan, jobs, work.store), RESAMPLES, plan.seed,
        )
        for plan in plans
    }  # fmt: skip
    first, worlds, seed = plans[0].first, plans[0].worlds, plans[0].seed
    return {
        "seed": seed,
        "worlds": worlds,
        "world_seeds": {"block": "evaluation", "first": first, "last": first + worlds - 1},
        "disturbance": (plans[0].disturbance or Disturbance()).model_dump(),
        "bootstrap": {"resamples": RESAMPLES, "seed": seed, "interval": "95 % percentile"},
        "players": {player.name: player.spec for plan in plans for player in plan.players},
        "tasks": about,
        **provenance(),
        "wall_time_s": perf_counter() - began,
    }


def _draw(path: Path, results: report.Results) -> None:
    from agents.transfer_chart import write_chart

    write_chart(path, results)


if __name__ == "__main__":
    run_program("transfer", app, STOPPED)
