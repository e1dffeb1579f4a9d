"""Report of agents.transfer: settings, cells and times as plain data, from which tables and sentences are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from agents.report import Results, grid, interval_fields, interval_text, number_text, table_of
from flockenv.evaluation import bootstrap, task_digest
from flockenv.physics.integrators import INTEGRATORS
from flockenv.tasks import Task

__all__ = [
    "Cell", "Clock", "Setting", "cheapest_accurate", "markdown", "most_accurate", "show", "task_results", "verdict",
]  # fmt: skip

SURVIVES = 0.95
"""A policy survives if it keeps this share of its lead over random in its worst setting."""
NOTHING = 1e-6
"""mm: an error below this is rounding."""

ASKED = """\
Policies were trained, and rules tuned, with one integration method and one time step. This page shows whether their
scores survive a more or less accurate solution of the same worlds, and what accuracy costs. Players decide as often as
before; only the motion between two decisions is computed differently."""

READING = """\
In these tasks the only force between two decisions is the constant steering force. So every method of second order
solves a decision exactly, in one step, up to a speed limit or a wall. Midpoint, velocity Verlet and RK4 therefore agree
to rounding. Their remaining error comes from the speed limit and falls only with dt, so RK4's additional evaluations
have no benefit. The two Euler methods are off by half a step. After a decision of n steps under a constant force, a
body that began at rest has moved (1 + 1/n) times the exact distance under semi-implicit Euler, as if the force had
acted earlier, and (1 - 1/n) times under explicit Euler, as if later. The scores of players change by this effect.

"Trained" is the setting of the comparison, in float64. The shipped policies learned in float32 with the same method and
step. Their own setting is thus the float32 row of that step, which makes no relevant difference."""

NOTES = """\
Return: the mean reward of a world's learners, summed over its episode. A difference is the mean over the same worlds
against the same player under the setting that it was made for, with a 95 % percentile bootstrap interval over worlds;
"(level)": the interval contains 0. Of many intervals without a true difference, one in twenty misses 0 by chance.
Error: the distance of learners, after one second of the same actions, from their positions under RK4 with 64 steps per
decision (median over worlds and learners). Evaluations: of the force, per simulated second. Time: physics, observations
and rewards of one world for one simulated second, in a batch on one thread, without compiling and without the policy.
It is the median of interleaved rounds (least-most), each the median of its steps in a separate process; "rounds
overlap" means that these ranges do. The machine was shared with other work. A policy survives if it keeps 95 % of its
lead over random in its worst setting."""


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
            "us_per_s": float(np.median(times)),
            "us_low": min(times),
            "us_high": max(times),
            "error_mm": clock.error_mm[setting.name],
            "players": {
                name: _player(cells[setting, name], cells[settings[0], name], resamples, seed) for name in names
            },
            "leads": {
                f"{names[-1]} - {other}": _difference(cells[setting, names[-1]], cells[setting, other], resamples, seed)
                for other in names[:-1]
            },
        }
    results = {
        "digest": task_digest(task),
        "control_dt": task.control_dt,
        "trained": settings[0].name,
        "settings": found,
        "again": {
            name: float(np.abs(cell.returns - cells[settings[0], name].returns).max()) for name, cell in again.items()
        },
    }
    return {**results, "verdict": verdict(task.name, results)}


def _player(cell: Cell, trained: Cell, resamples: int, seed: int) -> Results:
    return {
        **interval_fields("mean", "mean", bootstrap(cell.returns, "mean", resamples, seed)),
        "success_rate": float(cell.success.mean()),
        **_difference(cell, trained, resamples, seed),
    }


def _difference(first: Cell, second: Cell, resamples: int, seed: int) -> Results:
    gain = bootstrap(first.returns - second.returns, "mean", resamples, seed)
    return {**interval_fields("difference", "ci", gain), "separated": gain.low > 0 or gain.high < 0}


# --- sentences --------------------------------------------------------------------------------------------------------


def most_accurate(results: Results) -> str:
    """Return the cheapest of the settings whose error is within a tenth of the least, or is rounding."""
    settings = results["settings"]
    least = max(NOTHING, 1.1 * min(about["error_mm"] for about in settings.values()))
    return _cheapest(settings, least)


def cheapest_accurate(results: Results) -> str:
    """Return the cheapest setting that has at most a tenth of the error of the trained one."""
    settings = results["settings"]
    least = min(about["error_mm"] for about in settings.values())
    return _cheapest(settings, max(NOTHING, least, settings[results["trained"]]["error_mm"] / 10))


def _cheapest(settings: Results, error_mm: float) -> str:
    enough = [name for name, about in settings.items() if about["error_mm"] <= error_mm]
    return min(enough, key=lambda name: settings[name]["us_per_s"])


def verdict(task: str, results: Results) -> str:
    """Return a sentence on the last player: whether it keeps its scores, and what accuracy costs."""
    settings, trained = results["settings"], results["settings"][results["trained"]]
    pilot = list(trained["players"])[-1]
    best, cheap = most_accurate(results), cheapest_accurate(results)
    fine, saving = settings[best], settings[cheap]
    claims = [_survival(results, pilot)]
    text = f"solved to {length_text(fine['error_mm'])} ({title(fine)}; trained: {length_text(trained['error_mm'])})"
    rates = [about["players"][pilot]["success_rate"] for about in (fine, trained)]
    change = f"{_change(fine['players'][pilot])}, success {rates[0]:.0%} against {rates[1]:.0%}"
    claims.append(f"{text} it {change}, and {_standing(fine, pilot)}")
    claims.append(
        f"at most a tenth of the trained error ({title(saving)}: {length_text(saving['error_mm'])}) costs "
        + _times(saving, trained)
        + (f"; the least error costs {_times(fine, trained)}" if best != cheap else "; no other has less error")
    )
    return f"{task}: " + "; ".join(claims) + "."


def _survival(results: Results, pilot: str) -> str:
    """Return, in words, the change of a policy's score in its worst setting, and the share of its lead over random."""
    settings = results["settings"]
    name = min(settings, key=lambda s: settings[s]["players"][pilot]["difference"])
    worst, trained = settings[name]["players"], settings[results["trained"]]["players"]
    if name == results["trained"]:
        return f"{pilot} does nowhere worse than where it was made"
    text = f"in its worst setting ({title(settings[name])}) it {_change(worst[pilot])}"
    if "random" not in worst or pilot == "random":
        return f"{pilot}: {text}"
    kept = (worst[pilot]["mean"] - worst["random"]["mean"]) / (trained[pilot]["mean"] - trained["random"]["mean"])
    says = "survives every setting" if kept >= SURVIVES else "does not survive every setting"
    return f"{pilot} {says}: {text} and keeps {100 * kept:.0f} % of its lead over random"


def _change(player: Results) -> str:
    if not player["separated"]:
        return f"is level with itself, {interval_text(player, 'difference', 'ci')}"
    verb = "gains" if player["difference"] > 0 else "loses"
    sign = 1.0 if player["difference"] > 0 else -1.0
    low, high = sorted((sign * player["ci_low"], sign * player["ci_high"]))
    size = {"difference": sign * player["difference"], "ci_low": low, "ci_high": high}
    return f"{verb} {interval_text(size, 'difference', 'ci')}"


def _standing(about: Results, pilot: str) -> str:
    """Return a comparison of the policy with the last of the other players, in words."""
    if not about["leads"]:
        return "no other player took part"
    pair, lead = list(about["leads"].items())[-1]
    place = "level with" if not lead["separated"] else "ahead of" if lead["difference"] > 0 else "behind"
    return f"is {place} {pair.removeprefix(f'{pilot} - ')} ({interval_text(lead, 'difference', 'ci')})"


def _times(about: Results, trained: Results) -> str:
    alike = about["us_low"] <= trained["us_high"] and trained["us_low"] <= about["us_high"]
    ratio = about["us_per_s"] / trained["us_per_s"]
    return f"{ratio:.2f} times the time" + (" (rounds overlap)" if alike else "")


def title(about: Results) -> str:
    """Return a setting as text: 'rk4, dt 0.0125 s'."""
    precision = " float32" if about["dtype"] == "float32" else ""
    return f"{about['method']}{precision}, dt {about['dt']:.4g} s"


def length_text(millimetres: float) -> str:
    """Return a length as text: '74 mm', '0.66 mm' or, below NOTHING, 'rounding'."""
    return (
        "rounding"
        if millimetres < NOTHING
        else f"{millimetres:.2g} mm"
        if millimetres < 100
        else f"{millimetres:.0f} mm"
    )


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
        return [f"{interval_text(found[p], 'mean', 'mean')} (trained)" for p in players]
    return [
        interval_text(found[p], "difference", "ci") + ("" if found[p]["separated"] else " (level)") for p in players
    ]


def cells_of(results: Results, players: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: one row per setting; the trained one first, with its returns, then again."""
    header = ["method", "dt, s", "evaluations", "µs", "error", *players]
    rows = [[*_costs(about), *_scores(results, name, players)] for name, about in results["settings"].items()]
    again = [f"{results['again'][p]:.3f}" for p in players]
    rows.insert(1, ["the same, played again", *rows[0][1:3], "", "", *again])
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
    """Return the page in Markdown."""
    seeds = f"{results['world_seeds']['first']} to {results['world_seeds']['last']}"
    held_out = f"{results['worlds']} worlds per task, seeds {seeds}: held out, those of the comparison."
    about = [ASKED, f"{held_out} `python -m agents.transfer` makes this page."]
    parts = ["# Policies under other integration methods and steps", *about, "![Differences and times](transfer.png)"]
    parts += [f"* **{task}**{about['verdict'].removeprefix(task)}" for task, about in results["tasks"].items()]
    for task, about in results["tasks"].items():
        parts += [f"## {task}", grid(*cells_of(about, list(about["again"])))]
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    machine = f"{results['machine']['system']}, {results['machine']['cores']} cores"
    return "\n\n".join([*parts, "## Conclusions", READING, "---", NOTES, f"Made with {versions} on {machine}.\n"])
