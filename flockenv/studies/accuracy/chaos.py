"""Sensitivity: how fast two nearly equal starts diverge, and the longest time over which runs can be compared."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from flockenv.model.state import State
from flockenv.physics.integrators import RK4
from flockenv.studies.accuracy.problem import FINER, Problem

__all__ = ["PERTURBATION", "Sensitivity", "find_sensitivity"]

PERTURBATION = 1e-12
"""m and m/s, or share of the largest coordinate: perturbation of the start."""

MOST_GROWTH = 1e8
"""Largest growth of a perturbation before the horizon is refused: 1e-12 m have become 0.1 mm then."""


@dataclass(frozen=True)
class Sensitivity:
    """Growth of a perturbation of the start."""

    growth: float  # largest factor by which the perturbation grows
    error: float  # m, its size then
    rate: float  # 1/s, average growth rate ln(growth) / time; 0 if it did not grow


def find_sensitivity(problem: Problem) -> Sensitivity:
    """Return the growth of a tiny perturbation of the start until the end.

    Raises ValueError, with a horizon to try, if it grows so much that no two computers could agree on any position.
    """
    start = problem.start
    shift = PERTURBATION * max(1.0, float(np.abs(start.pos).max()))
    steps = problem.steps[-1] * problem.stability_divisor(RK4(), FINER)
    try:
        paths = [problem.path(RK4(), steps, begin) for begin in (start, _shift_start(start, shift))]
    except FloatingPointError as error:
        raise ValueError(f"the finest steps given, {problem.seconds / steps:g} s, are too long: {error}") from None
    off = np.nan_to_num(problem.distances(*paths))
    growth = np.maximum.accumulate(off.max(axis=1)) / shift
    if not growth[-1] <= MOST_GROWTH:
        kept = problem.times[growth <= 1e-2 * MOST_GROWTH]
        advice = f"try {kept[-1]:.3g} s" if len(kept) else "try a shorter one"
        over = int(np.argmax(~(growth <= MOST_GROWTH)))
        per = problem.times[over] / math.log(growth[over])
        raise ValueError(
            f"seconds = {problem.seconds:g}: too long, because the scene is chaotic: a difference of {shift:.0e} m "
            f"at the start grows {growth[-1]:.1e}-fold until the end (e-fold in {per:.2g} s), whatever the method; "
            f"{advice}"
        )
    rate = max(0.0, math.log(max(growth[-1], 1.0)) / problem.seconds)
    return Sensitivity(float(growth[-1]), float(growth[-1] * shift), rate)


def _shift_start(start: State, shift: float) -> State:
    """Return a start with positions changed by `shift` m and velocities by `shift` m/s, at random.

    An agent at rest stays at rest, as its heading could change by any angle.
    """
    change = np.random.default_rng(0).choice([-shift, shift], size=(2, *start.x.shape)) / math.sqrt(len(start.x))
    moves = (start.v != 0).any(axis=0)
    return dataclasses.replace(start, x=start.x + change[0], v=start.v + np.where(moves, change[1], 0.0))
