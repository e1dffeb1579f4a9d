"""Reference solution of a scene: the best one that respects all of the scene, with an estimate of its error.

In this order: a closed form, if the problem has one; scipy's DOP853 on the scene's laws, if nothing acts between
its steps; else the scene's own steps, with its constraints, births and deaths, much finer than any that is measured,
with impacts found in the order of time (`response: earliest`). The error of own steps is estimated by Richardson
extrapolation: three runs, each in twice as many steps as the one before, give the order of convergence to a limit. Most
of their steps end together, so what happens at the ends of steps (impacts, births) may be late by the same time in all
three. Three further runs, whose steps end at other times, confirm the order or show that it is an accident.
Source: Roache 1998, Verification and Validation in Computational Science and Engineering, ch. 5 (grid convergence).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flockenv.physics.constraints import Collisions
from flockenv.physics.integrators import RK4
from flockenv.studies.accuracy.dop853 import NotSmoothError, integrate_twice
from flockenv.studies.accuracy.paths import Floats, Path, largest_distance, reach
from flockenv.studies.accuracy.problem import FINER, Problem

__all__ = ["COARSE", "LEAST_FINER", "Reference", "find_reference", "reference_by_own_steps"]

LEAST_FINER = 4
"""Least ratio of the finest measured step to the step of a reference by own steps."""

MOST_WORK = 100_000_000
"""Most agent-steps in the finest run of such a reference; if more are needed, its steps are coarser."""

BETWEEN_STEPS = 500
"""Cost of what acts between two steps of a scene, as a number of agents whose step takes as long."""

COARSE = 0.1
"""A path with errors above this share of the distance that agents move is no approximation."""

ROUNDING, ROUNDING_STEP = 1e-12, 1e-16
"""m, or share of the distance that agents move: smaller differences of runs, in all or per step, are rounding."""

SETTLED, HIGHEST = 0.5, RK4.order + 0.5
"""Least and highest order at which runs are taken to converge to a limit; a higher one than the method's is chance."""

TOLERANCE = 0.2
"""Largest deviation of a distance between two runs from the one that the order predicts, as a share of the distance."""

FURTHER = (3.303, 3.618, 3.9)
"""About how much longer the steps of the further runs are: less than 4, as runs are stable in steps 4 times as long."""

MARGIN = 2.0
"""Error of a reference without an order, as a multiple of its largest distance from another run."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference position of every agent at the instants of a problem."""

    kind: str  # "closed form", "DOP853", "event-exact steps" or "own steps"
    path: Path
    error: float  # m, estimated error at any instant
    reach: float  # m, largest distance that an agent moves
    note: str = ""  # how it was found, and why no better reference was possible


def find_reference(problem: Problem, finer: int | None = None) -> Reference:
    """Return the best available reference.

    finer: see `reference_by_own_steps`. Raises ValueError if there is none: the scene diverges even in the finest
    steps, or does not converge to one path.
    """
    if problem.exact is not None:
        pos, vel = zip(*(problem.exact(t) for t in problem.times), strict=True)
        path = Path(np.array(pos, float), np.array(vel, float))
        return Reference("closed form", path, 0.0, _reach(problem, path))
    try:
        path, error, note = integrate_twice(problem)
    except NotSmoothError as reason:
        return reference_by_own_steps(problem, finer, str(reason))
    return Reference("DOP853", path, error, _reach(problem, path), note)


def reference_by_own_steps(problem: Problem, finer: int | None = None, reason: str = "") -> Reference:
    """Return the reference of the whole scene by its own steps with RK4.

    finer: ratio of the finest measured step to that of the reference, a multiple of 4 (default: 64, or the largest
    within MOST_WORK). Raises ValueError if the scene diverges or does not converge to one path.
    """
    fine = problem.with_impacts_in_order
    many = max(
        affordable_ratio(problem) if finer is None else finer, LEAST_FINER * problem.stability_divisor(RK4(), FINER)
    )
    steps = problem.steps[-1] * many
    counts = _step_counts(steps, len(problem.times))
    try:
        path, *coarser = (fine.path(RK4(), n) for n in counts)
    except FloatingPointError as fault:
        raise ValueError(f"no reference: {reason}; and in steps of its own: {fault}") from None
    off, gone = [problem.distances(path, each) for each in coarser], _reach(problem, path)
    before = largest_distance(problem.distances(*coarser[:2]))
    apart = {steps / n: largest_distance(each) for n, each in zip(counts[1:], off, strict=True)}
    converges, error = _convergence(before, apart, max(ROUNDING, ROUNDING_STEP * steps) * max(1.0, gone))
    _refuse_no_limit(problem, steps, np.fmax.reduce(off), error, gone)
    exactly = any(isinstance(each, Collisions) and each.response == "earliest" for each in fine.scene.constraints)
    found = [reason, f"RK4 in {steps:,} steps, dt/{many} of the finest", converges]
    found += ["impacts in the order of time"] if exactly else []
    note = "; ".join(each for each in found + _deviation_notes(path) if each)
    return Reference("event-exact steps" if exactly else "own steps", path, error, gone, note)


def _deviation_notes(path: Path) -> list[str]:
    """Return notes on deviations of a run from its scene: contacts left unsolved, births without a free slot."""
    unsolved, refused = path.count_of("unsolved"), path.count_of("births_refused")
    found = [f"{unsolved:,} contacts unsolved"] if unsolved else []
    slots = f"{refused:,} births found no free slot, so which agents are born depends on the step"
    return found + ([slots] if refused else [])


def affordable_ratio(problem: Problem) -> int:
    """Return the largest ratio of the finest measured step to that of a reference within MOST_WORK."""
    ends = problem.scene.constraints or problem.scene.population
    work = (problem.scene.agents + (BETWEEN_STEPS if ends else 0)) * problem.steps[-1]
    finer = FINER
    while finer > LEAST_FINER and work * finer > MOST_WORK:
        finer //= 2
    return finer


def _step_counts(steps: int, instants: int) -> list[int]:
    """Return the numbers of steps of all runs: `steps`, a half and a quarter of it, then those of the further runs.

    Each is a multiple of the number of instants. Between two instants, no step of a further run ends with one of the
    finest run. There are fewer than three further runs if steps are few.
    """
    many, further = steps // instants, list[int]()
    for ratio in FURTHER:
        free = (n for n in range(math.ceil(many / ratio), many) if math.gcd(n, many) == 1 and n not in further)
        further += itertools.islice(free, 1)
    return [steps, steps // 2, steps // 4, *(n * instants for n in further)]


def _convergence(before: float, apart: Mapping[float, float], rounding: float) -> tuple[str, float]:
    """Return how runs converge, in words, and the error of the finest, m.

    before: distance between the runs in steps 4 and 2 times as long, m. apart: distances of the finest run from each
    other one, m, by the ratio of their steps. Richardson: with order q the error of the finest is apart[2] / (2^q - 1).
    Orders above 1 are not relied upon, as forces may jump and bodies may hit. Without an order that all runs confirm,
    and if only rounding is left, the error is MARGIN times the largest distance.
    """
    last, largest = max(apart[2], rounding), float(np.max([before, *apart.values()]))
    if not largest > rounding:
        return f"{largest:.1e} m from coarser runs, which is rounding", MARGIN * largest
    order = math.log2(max(before, rounding) / last)
    if SETTLED <= order <= HIGHEST and all(
        abs(distance - last * (ratio**order - 1) / (2**order - 1)) <= TOLERANCE * distance + rounding
        for ratio, distance in apart.items()
    ):
        return f"{apart[2]:.1e} m from half as many, order {order:.1f}", last / (2 ** min(order, 1.0) - 1)
    return f"{largest:.1e} m from coarser runs, no order: a path that jumps", MARGIN * largest


def _refuse_no_limit(problem: Problem, steps: int, off: Floats, error: float, gone: float) -> None:
    """Raise ValueError, with a horizon to try, if a scene does not converge with shorter steps."""
    if math.isnan(error):
        raise ValueError(f"seconds = {problem.seconds:g}: no agent lives at any instant at which runs are compared")
    if error <= COARSE * gone or error == 0:
        return
    by_instant = np.maximum.accumulate(np.nan_to_num(off).max(axis=1))
    kept = problem.times[by_instant <= 1e-2 * gone]
    advice = f"try --seconds {kept[-1]:.3g}" if len(kept) else "try a shorter horizon, or shorter steps"
    raise ValueError(
        f"no reference over {problem.seconds:g} s: RK4 in {steps:,} steps and in fewer end up to "
        f"{by_instant[-1]:.1e} m apart, of {gone:.1e} m that the farthest agent goes (a jump occurs on one path and "
        f"not on the other, and what follows differs); {advice}"
    )


def _reach(problem: Problem, path: Path) -> float:
    return reach(path, problem.start.pos[0], problem.scene.space.displacement)
