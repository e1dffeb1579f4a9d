"""Report of agents.transfer: settings, cells and times as plain data, from which tables and sentences are made."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from agents.transfer_verdict import LEAST_ROUNDS, count_text, length_text, settings_of_note, title, verdict
from flockenv.core.warnings import UnstableStepWarning
from flockenv.evaluation import bootstrap, task_digest
from flockenv.evaluation.report import Results, conditions, grid, interval_fields, interval_text, number_text, table_of
from flockenv.physics.integrators import INTEGRATORS
from flockenv.scene.stability import suggest_dt
from flockenv.tasks import Task

__all__ = ["Cell", "Clock", "Setting", "markdown", "show", "task_results"]

ASKED = """\
Policies were trained, and rules tuned, with one integration method and one time step. This page shows whether their
scores survive a more or less accurate solution of the same worlds, and what accuracy costs. Players decide as often as
before; only the motion between two decisions is computed differently."""

READING = """\
Where the steering force is the only force on learners between two decisions, it is constant. Velocity Verlet, as every
method of second order, then solves a decision exactly, in one step, up to a speed limit or a wall; the error that
remains falls only with dt. The two Euler methods are off by half a step. After a decision of n steps under a constant
force, a body that began at rest has moved (1 + 1/n) times the exact distance under semi-implicit Euler, as if the force
had acted earlier, and (1 - 1/n) times under explicit Euler, as if later. The scores of players change by this effect.
With contact, a step may also be too long to be stable; such settings are named.

"Trained" is the setting of the comparison, in float64. The shipped policies learned in float32 with the same method and
step, which `--methods semi_implicit_euler:float32` plays."""

NOTES = """\
Return: the mean reward of a world's learners, summed over its episode. A difference is the mean over the same worlds
against the same player under the setting that it was made for, with a 95 % percentile bootstrap interval over worlds;
"(level)": the interval contains 0. Of many intervals without a true difference, one in twenty misses 0 by chance.
A player of several seeds is the one that ships: intervals do not contain the luck of training or of the search.
Error: the distance of learners, after one second of the same actions, from their positions under RK4 with at least 64
steps per decision (median over worlds and learners). Evaluations: of the force, per simulated second. Time: physics,
observations and rewards of one world for one simulated second, in a batch on one thread, without compiling and without
the policy. It is the median of interleaved rounds (least-most), each the median of its steps in a separate process;
"rounds overlap" means that these ranges do.

Lead: a player's mean return minus that of random actions, in the trained setting. A loss in another setting is given as
a share of this lead, so that tasks can be compared; the player keeps the rest. Its interval is that of the loss, with
the lead as a fixed number. A player survives a setting if it keeps at least 95 %."""


KEPT = {"kept": "difference", "kept_low": "ci_low", "kept_high": "ci_high"}
"""Share of its lead over random that a player keeps, and its interval, and the differences that they are made of."""


@dataclass(frozen=True)
class Setting:
    """How motion is computed: integration method, precision, and number of steps per decision."""

    method: str
    dtype: str
    substeps: int

    @classmethod
    def of_training(cls, task: Task) -> Setting:
        """Return the setting of a task's config, with which its players were trained."""
        return cls(task.integrator.kind, task.dtype, task.substeps)

    def applied_to(self, task: Task) -> Task:
        """Return the task with this setting; the same task, to the last bit of dt, if it has this setting."""
        changes: dict[str, Any] = {"dtype": self.dtype}
        if self.method != task.integrator.kind:
            changes["integrator"] = INTEGRATORS[self.method]()
        if self.substeps != task.substeps:
            changes["dt"] = task.control_dt / self.substeps
        return task.model_copy(update=changes)

    @property
    def solver(self) -> str:
        """Method and precision, which determine the compiled code."""
        return f"{self.method}{' float32' if self.dtype == 'float32' else ''}"

    @property
    def name(self) -> str:
        """'rk4 /4': four steps per decision."""
        return f"{self.solver} /{self.substeps}"


@dataclass(frozen=True, eq=False)
class Cell:
    """Scores of one player under one setting, by world, (B,)."""

    returns: NDArray[np.float64]
    success: NDArray[np.bool_]


@dataclass
class Clock:
    """Times and errors of the replayed actions, by name of the setting."""

    rounds: list[dict[str, float]] = field(default_factory=list)  # s per step of all worlds
    error_mm: dict[str, float] = field(default_factory=dict)


def task_results(
    task: Task,
    settings: Sequence[Setting],
    cells: Mapping[tuple[Setting, str], Cell],
    clock: Clock,
    again: Mapping[str, Cell],
    resamples: int,
    seed: int,
) -> Results:
    """Return the results of one task as plain data; the first setting is that of training."""
    names = list(again)
    found: Results = {}
    for setting in settings:
        dt, method = setting.applied_to(task).dt, INTEGRATORS[setting.method]
        each = next(len(cells[setting, name].returns) for name in names) * task.control_dt
        times = [1e6 * times[setting.name] / each for times in clock.rounds]
        found[setting.name] = {
            "method": setting.method,
            "dtype": setting.dtype,
            "substeps": setting.substeps,
            "dt": dt,
            "evaluations_per_s": method.evaluations / dt,
            "adaptive": method.adaptive,
            "unstable": is_unstable(setting.applied_to(task)),
            "us_per_s": float(np.median(times)),
            "us_low": min(times),
            "us_high": max(times),
            "error_mm": clock.error_mm[setting.name],
            "players": {name: _player(cells, setting, settings[0], name, resamples, seed) for name in names},
            "leads": {
                f"{names[-1]} - {other}": _difference(cells[setting, names[-1]], cells[setting, other], resamples, seed)
                for other in names[:-1]
            },
        }
    results = {
        "digest": task_digest(task),
        "control_dt": task.control_dt,
        "trained": settings[0].name,
        "rounds": len(clock.rounds),
        "settings": found,
        "again": {
            name: float(np.abs(cell.returns - cells[settings[0], name].returns).max()) for name, cell in again.items()
        },
    }
    return {**results, "verdict": verdict(task.name, results)}


def is_unstable(task: Task) -> bool:
    """Return True if the step of a task is longer than the largest that is stable at any time in its scene."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstableStepWarning)
        return task.dt > suggest_dt(task.scene).dt


def _player(
    cells: Mapping[tuple[Setting, str], Cell], setting: Setting, trained: Setting, name: str, resamples: int, seed: int
) -> Results:
    """Return the scores of a player in a setting, and the share of its lead over random that it keeps there."""
    cell, before = cells[setting, name], cells[trained, name]
    found = {
        **interval_fields("mean", "mean", bootstrap(cell.returns, "mean", resamples, seed)),
        "success_rate": float(cell.success.mean()),
        **_difference(cell, before, resamples, seed),
    }
    if name == "random" or (trained, "random") not in cells:
        return found
    lead = float((before.returns - cells[trained, "random"].returns).mean())
    if lead <= 0:
        return found  # there is no lead to keep
    kept = {key: 1.0 + found[of] / lead for key, of in KEPT.items()}
    return {**found, **kept}


def _difference(first: Cell, second: Cell, resamples: int, seed: int) -> Results:
    gain = bootstrap(first.returns - second.returns, "mean", resamples, seed)
    return {**interval_fields("difference", "ci", gain), "separated": gain.low > 0 or gain.high < 0}


# --- tables -----------------------------------------------------------------------------------------------------------


def _costs(about: Results) -> list[str]:
    calls = number_text(about["evaluations_per_s"])
    return [
        about["method"] + (" float32" if about["dtype"] == "float32" else ""),
        f"{about['dt']:.4g}",
        f"≥ {calls}" if about["adaptive"] else calls,
        f"{number_text(about['us_per_s'])} ({number_text(about['us_low'])}-{number_text(about['us_high'])})",
        length_text(about["error_mm"]),
    ]


def _scores(results: Results, name: str, players: Sequence[str]) -> list[str]:
    found = results["settings"][name]["players"]
    if name == results["trained"]:
        return [interval_text(found[p], "mean", "mean") for p in players]
    return [
        interval_text(found[p], "difference", "ci") + ("" if found[p]["separated"] else " (level)") for p in players
    ]


def cells_of(results: Results, players: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of all settings: the trained one first, with its returns, then differences."""
    header = ["method", "dt, s", "evaluations", "µs", "error", *players]
    rows = [[*_costs(about), *_scores(results, name, players)] for name, about in results["settings"].items()]
    return header, rows


def short_cells_of(results: Results) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the settings of note, with the reasons for which they are shown."""
    players = list(results["again"])
    header = ["setting", "method", "dt, s", "evaluations", "µs", "error", *players]
    rows = [
        [", ".join(reasons), *_costs(results["settings"][name]), *_scores(results, name, players)]
        for name, reasons in settings_of_note(results).items()
    ]
    return header, rows


def show(results: Results) -> None:
    """Print a table per task on the last player, and then the verdict on each task."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=160)
    for task, about in results["tasks"].items():
        header, rows = cells_of(about, list(about["again"])[-1:])
        console.print(table_of(task, header, rows))
    for about in results["tasks"].values():
        console.print(about["verdict"], markup=False)


def markdown(results: Results) -> str:
    """Return the page in Markdown: counts over all tasks, the picture, and per task a sentence and a short table."""
    seeds = f"{results['world_seeds']['first']} to {results['world_seeds']['last']}"
    held_out = f"{conditions(results)}, seeds {seeds}: held out, those of the comparison."
    tasks = results["tasks"]
    parts = ["# Policies under other integration methods and steps", count_text(tasks), ASKED]
    parts += [f"{held_out} `python -m agents.transfer` makes this page; transfer.json has every setting."]
    parts += ["![Share of its lead over random that a policy gains or loses in each setting](transfer.png)"]
    for task, about in tasks.items():
        parts += [f"## {task}", about["verdict"].removeprefix(f"{task}: "), *_note_on_steps(about)]
        parts += [grid(*short_cells_of(about))]
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    machine = f"{results['machine']['system']}, {results['machine']['cores']} cores"
    notes = f"{NOTES} {_repetition(tasks)} {_rounds(tasks)}"
    return "\n\n".join([*parts, "## Conclusions", READING, "---", notes, f"Made with {versions} on {machine}.\n"])


def _note_on_steps(about: Results) -> list[str]:
    """Return a line on settings whose steps are too long to be stable at all times, if there are any."""
    long = ", ".join(title(each) for each in about["settings"].values() if each["unstable"])
    return [f"Longer than the largest step that is stable in every contact: {long}."] if long else []


def _rounds(tasks: Results) -> str:
    """Return the number of rounds of timing as text, and that too few of them are not compared."""
    fewest = min(about["rounds"] for about in tasks.values())
    return f"Rounds of timing: {fewest}{'' if fewest >= LEAST_ROUNDS else ', too few to compare times'}."


def _repetition(tasks: Results) -> str:
    """Return, in words, whether the trained settings, played a second time, had the same returns."""
    most = max(value for about in tasks.values() for value in about["again"].values())
    same = "had the same returns to the last bit" if most == 0 else f"differed by up to {most:.3g} in a world"
    return f"Played a second time, the trained settings {same}."
