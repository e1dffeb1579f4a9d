"""Transfer of policies to other integrators: `python -m agents.transfer [TASK...]` plays the same worlds with each.

Every player plays the held-out worlds of agents.compare under each integration method, step and precision. It decides
as often as before; only the motion between two decisions is computed differently. Then the same actions are replayed
and timed under each setting. Returns and times are stored in runs/transfer at once: after an interruption the same
command continues. Writes transfer.json, transfer.md and transfer.png.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from agents import report, transfer_report
from agents.compare import (
    experiment_of,
    folder_of,
    pick,
    players_in_order,
    players_of,
    provenance,
    split,
    usual_players,
    write_text,
)
from agents.processes import announce_parent, guard_process_starts, serve
from agents.transfer_cache import (
    KEPT,
    Plan,
    all_cells,
    jobs,
    play_again,
    play_missing,
    rounds_missing,
    run_clock,
    run_round,
)
from agents.transfer_report import Setting
from flockenv.cli.terminal import report_errors, run_program, show_progress
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.errors import nearest, printable
from flockenv.evaluation import WORLDS_PER_SEED, worlds_for
from flockenv.physics.integrators import INTEGRATORS
from flockenv.tasks import TASKS, Task

__all__ = ["app"]

WORLDS, ROUNDS, RESAMPLES = 128, 5, 10_000
METHODS = ("semi_implicit_euler", "explicit_euler", "midpoint", "velocity_verlet", "rk4", "semi_implicit_euler:float32")
SUBSTEPS = (1, 2, 4, 8)
MOST_SUBSTEPS = 1000
FILES = ("transfer.json", "transfer.md", "transfer.png")

STOPPED = f"interrupted; what was played is in {KEPT}, and the same command goes on"

Advance = Callable[[str, int], None]
"""Called with a text about the work done, and the number of cells or rounds of timing."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


# --- the command line -------------------------------------------------------------------------------------------------


@app.command()
def main(
    tasks: Annotated[list[str] | None, typer.Argument(metavar="TASK", help="Tasks. [all]")] = None,
    players: Annotated[list[str] | None, typer.Option(help="Players, as in agents.compare.")] = None,
    methods: Annotated[
        list[str] | None,
        typer.Option(help="Integrators; KIND:float32 in single precision. [" + ",".join(METHODS) + "]"),
    ] = None,
    substeps: Annotated[
        list[str] | None, typer.Option(help="Physics steps per decision. [" + ",".join(map(str, SUBSTEPS)) + "]")
    ] = None,
    worlds: Annotated[int, typer.Option(help="Worlds per task, the same for every player.")] = WORLDS,
    rounds: Annotated[int, typer.Option(help="Rounds in which wall time is measured.")] = ROUNDS,
    seed: Annotated[int, typer.Option(help="Block of evaluation worlds, 0 to 999.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes that compile and play; 1: only this one.")] = min(
        2, os.cpu_count() or 1
    ),
    out: Annotated[str, typer.Option(help=f"Folder for {', '.join(FILES)}.")] = "results",
    trust_pickle: Annotated[
        bool, typer.Option("--trust-pickle", help="Also load Stable-Baselines3 zips, which executes the code in them.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show a traceback if something goes wrong.")] = False,
) -> None:
    """Play the same worlds with integrators of different accuracy; show the effect on each policy, and the cost."""
    with report_errors("transfer", STOPPED, debug):
        folder = folder_of(out, FILES)
        _check("--worlds", worlds, 2, WORLDS_PER_SEED)
        _check("--rounds", rounds, 1, 1000)
        _check("--workers", workers, 1, 64)
        worlds_for("evaluation", seed, worlds)
        chosen = [experiment_of(name).build() for name in pick("TASK", split(tasks) or list(TASKS), TASKS)]
        fields = players_of(chosen, players_in_order(split(players) or usual_players(chosen)))
        solvers, steps = _solvers(split(methods) or list(METHODS)), _substeps(split(substeps), SUBSTEPS)
        plans = [
            Plan(task, _settings(task, solvers, steps), tuple(fields[task.name]), worlds, seed, rounds, trust_pickle)
            for task in chosen
        ]
        results = _measure(plans, workers)
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


def _substeps(texts: Sequence[str], usual: Sequence[int]) -> list[int]:
    for text in texts:
        if not (text.isascii() and text.isdigit() and 1 <= int(text[:9]) <= MOST_SUBSTEPS):
            raise ValueError(f"--substeps {printable(text)}: must be an integer from 1 to {MOST_SUBSTEPS}")
    return sorted({int(text) for text in texts} or usual)


def _settings(task: Task, solvers: Sequence[tuple[str, str]], substeps: Sequence[int]) -> tuple[Setting, ...]:
    """Return the settings to play; the first is that of training, even if it is not selected."""
    chosen = [Setting(method, dtype, steps) for method, dtype in solvers for steps in substeps]
    return tuple(dict.fromkeys([Setting.of_training(task), *chosen]))


def _measure(plans: Sequence[Plan], workers: int) -> report.Results:
    """Play the missing episodes, time the settings, and return everything as plain data."""
    began = perf_counter()
    for plan in plans:
        for player in plan.players:
            plan.policy(player, plan.task)  # players that cannot be loaded are rejected before any plays
    missing, rounds = [job for plan in plans for job in jobs(plan)], rounds_missing(plans)
    steps = sum(len(settings) * len(plan.players) for plan, settings in missing) + len(rounds) * len(plans)
    with _bar(steps) as advance:
        for function, work, processes in ((play_missing, missing, workers), (run_round, rounds, 1)):
            with _process_map(processes if workers > 1 else 0, work) as map_:
                for what, done in map_(function, work):
                    advance(what, done)
    about = {
        plan.task.name: transfer_report.task_results(
            plan.task,
            plan.settings,
            all_cells(plan),
            run_clock(plan, plan.rounds),
            play_again(plan),
            RESAMPLES,
            plan.seed,
        )
        for plan in plans
    }
    first, worlds, seed = plans[0].first, plans[0].worlds, plans[0].seed
    return {
        "seed": seed,
        "worlds": worlds,
        "world_seeds": {"block": "evaluation", "first": first, "last": first + worlds - 1},
        "bootstrap": {"resamples": RESAMPLES, "seed": seed, "interval": "95 % percentile"},
        "players": {player.name: player.spec for plan in plans for player in plan.players},
        "tasks": about,
        **provenance(),
        "wall_time_s": perf_counter() - began,
    }


@contextmanager
def _process_map(processes: int, work: Sequence[Any]) -> Iterator[Callable[[Any, Iterable[Any]], Iterable[Any]]]:
    """Yield a function like `map`, which uses a number of processes that end with this one, or this process if none.

    A single worker process is replaced by a new one after each piece of work.
    """
    if not (processes and work):
        yield map
        return
    count = min(processes, len(work))
    with announce_parent():  # a thread of the pool starts new ones later
        with guard_process_starts():
            pool = get_context("spawn").Pool(count, serve, maxtasksperchild=1 if processes == 1 else None)
        with pool:
            yield pool.imap_unordered


@contextmanager
def _bar(steps: int) -> Iterator[Advance]:
    """Show one bar on a terminal; otherwise write a line per kernel and per round."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description:<44}"), BarColumn(30), TimeElapsedColumn())
    with show_progress(Progress(*columns, console=console, transient=True)) as progress:
        bar = progress.add_task("compiling and playing", total=steps)

        def advance(what: str, done: int) -> None:
            progress.update(bar, advance=done, description=what)
            if not console.is_terminal:
                console.print(f"{what}: done", highlight=False)

        yield advance


def _draw(path: Path, results: report.Results) -> None:
    from agents.transfer_chart import write_chart

    write_chart(path, results)


if __name__ == "__main__":
    run_program("transfer", app, STOPPED)
