"""Step-size control: substeps as long as the error allows, the last of which ends with the scene's step.

The error is the distance between two results, of position and velocity together (m and m/s alike), of the worst agent;
it is absolute, and excludes differences that may be rounding of a coordinate. The next substep is
h clip(0.9 (tolerance / error)^(1 / (p + 1)), 0.2, 5), after accepted and after rejected substeps.

Two more rules are for forces that jump, whose error falls as h and not as h^(p + 1): a second rejection in a row
reduces the substep to a fifth, and until the clock reaches the end of the last rejected substep no substep is longer
than the one before. So a jump costs one rejection for each factor of 5 between the substeps before it and across it.

A world is given up as diverged, by a NaN coordinate, after TRIES rejections in a row, if a substep shorter than `least`
is needed, if a substep does not advance the time, or if `most` substeps have not reached the end.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import like, shared
from flockenv.physics.integrators.integrator import carry

__all__ = [
    "TRIES",
    "Clock",
    "add_slopes",
    "copy",
    "excess_square",
    "initial_clock",
    "next_clock",
    "slope_of",
    "write_errors",
]

TRIES = 20
"""Number of rejections in a row at which a world is given up; from the second on, each divides the substep by 5."""


class Clock(NamedTuple):
    """State of the step-size control within one step of the scene."""

    done: float  # s, since its beginning
    step: float  # s, to be tried next
    wary: float  # s, end of the last rejected substep
    tries: int  # number of rejections in a row
    accepted: int
    rejected: int
    lost: bool  # given up


@shared
def initial_clock(dt: float) -> Clock:
    """Return the clock at the beginning of a scene's step; the first substep is the whole step."""
    return Clock(like(dt, 0.0), dt, like(dt, 0.0), 0, 0, 0, False)


@shared
def excess_square(difference: float, size: float, tiny: float) -> float:
    """Return the square of a difference minus the rounding of a number of that size; NaN stays NaN."""
    beyond = abs(difference) - tiny * abs(size)
    return like(beyond, 0.0) if beyond <= like(beyond, 0.0) else beyond * beyond


@shared
def _step_factor(error: float, tolerance: float, dt: float, order: int) -> float:
    """Return the factor of the next substep, from 1/5 (also if the error is NaN) to 5."""
    none = error <= like(dt, 0.0)
    ratio = tolerance / (tolerance if none else error)
    factor = like(dt, 5.0) if none else like(dt, 0.9) * ratio ** (like(dt, 1.0) / like(dt, order + 1))
    return min(factor, like(dt, 5.0)) if factor > like(dt, 0.2) else like(dt, 0.2)


@shared
def next_clock(clock: Clock, error: float, limits: tuple[float, ...], dt: float, order: int) -> Clock:
    """Return the clock after a substep with that error; for the rules see the module.

    limits: tolerance, least, most.
    """
    tolerance, least, most = limits
    taken = error <= tolerance
    last = clock.step >= dt - clock.done
    done = (dt if last else clock.done + clock.step) if taken else clock.done
    wary = clock.wary if taken else clock.done + clock.step
    factor = _step_factor(error, tolerance, dt, order)
    factor = like(dt, 0.2) if clock.tries > 0 and not taken else factor
    factor = min(factor, like(dt, 1.0)) if done < wary else factor
    step = min(clock.step * factor, dt - done)
    tries = 0 if taken else clock.tries + 1
    stuck = (not taken) & ((tries >= TRIES) | (step < least) | (done + step == done))
    accepted, rejected = clock.accepted + (1 if taken else 0), clock.rejected + (0 if taken else 1)
    stuck = stuck | ((done < dt) & (like(dt, accepted + rejected) >= most))
    return Clock(dt if stuck else done, step, wary, tries, accepted, rejected, stuck)


# --- over the coordinates [first, end) --------------------------------------------------------------------------------


@shared
def copy(to_x: Any, to_v: Any, x: Any, v: Any, first: int, end: int) -> None:
    """Copy positions and velocities: to = (x, v)."""
    for i in range(np.uint64(first), np.uint64(end)):
        to_x[i], to_v[i] = x[i], v[i]


@shared
def slope_of(x: Any, v: Any, flow: Any, first: int, end: int) -> None:
    """Write into x the rate of change of positions: v and the flow, as of the last acceleration."""
    for i in range(np.uint64(first), np.uint64(end)):
        x[i] = carry(v[i], like(v[i], 1.0), flow, i)


@shared
def add_slopes(x: Any, v: Any, weight: float, slope: Any, a: Any, first: int, end: int) -> None:
    """Add a weighted slope: (x, v) += weight (slope, a)."""
    for i in range(np.uint64(first), np.uint64(end)):
        x[i] += weight * slope[i]
        v[i] += weight * a[i]


@shared
def write_errors(squares: Any, x: Any, v: Any, other_x: Any, other_v: Any, first: int, end: int) -> None:
    """Write the squared difference of two results, minus rounding, per coordinate; `squares` may be other_x."""
    tiny = like(x[0], 8 * np.finfo(x.dtype).eps)
    for i in range(np.uint64(first), np.uint64(end)):
        squares[i] = excess_square(x[i] - other_x[i], x[i], tiny) + excess_square(v[i] - other_v[i], v[i], tiny)
