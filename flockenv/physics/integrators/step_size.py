"""Steps that a method chooses by itself: as long as its error allows, the last one ending where the step ends.

An error is the distance between two results, of position and velocity together (m and m/s alike), of the agent who is
worst off; it is absolute, and what rounding alone may make of a coordinate is not counted. The next step is
h clip(0.9 (tolerance / error)^(1 / (p + 1)), 0.2, 5), after a step that was taken as after one that was not.

Two rules more are for forces that jump, whose error falls as h and not as h^(p + 1): who is rejected again tries a
fifth, and as long as the clock has not come to where a rejected step would have ended no step is longer than the one
before. So a jump costs a rejected step for each factor of 5 between the steps before it and the one that meets it.

A world is given up, by a coordinate that is not a number, where TRIES steps in a row are not accepted, where a step
shorter than `least` is called for, where one does not move the clock, and where `most` steps have not come to its end.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import like, shared
from flockenv.physics.integrators.integrator import carried

__all__ = ["TRIES", "Clock", "add_slopes", "begun", "copy", "excess", "judged", "misfit", "slope_of"]

TRIES = 20
"""Steps in a row that may be rejected: each is at most a fifth of the one before if nothing else is known."""


class Clock(NamedTuple):
    """Where a method is within one step of the scene."""

    done: float  # s, since its beginning
    step: float  # s, to be tried next
    wary: float  # s, where the last rejected step would have ended
    tries: int  # in a row, rejected
    accepted: int
    rejected: int
    lost: bool  # given up


@shared
def begun(dt: float) -> Clock:
    """Return the clock at the beginning of a step of the scene: all of it is tried at once."""
    return Clock(like(dt, 0.0), dt, like(dt, 0.0), 0, 0, 0, False)


@shared
def excess(difference: float, size: float, tiny: float) -> float:
    """Return the square of what a difference is beyond the rounding of a number of that size; NaN stays NaN."""
    beyond = abs(difference) - tiny * abs(size)
    return like(beyond, 0.0) if beyond <= like(beyond, 0.0) else beyond * beyond


@shared
def _stretched(error: float, tolerance: float, dt: float, order: int) -> float:
    """Return how much longer the next step may be: from a fifth, also if the error is NaN, to five times."""
    none = error <= like(dt, 0.0)
    ratio = tolerance / (tolerance if none else error)
    factor = like(dt, 5.0) if none else like(dt, 0.9) * ratio ** (like(dt, 1.0) / like(dt, order + 1))
    return min(factor, like(dt, 5.0)) if factor > like(dt, 0.2) else like(dt, 0.2)


@shared
def judged(clock: Clock, error: float, limits: tuple[float, ...], dt: float, order: int) -> Clock:
    """Return the clock after a step with that error, in the sense of the module's text, was tried.

    limits: tolerance, least, most.
    """
    tolerance, least, most = limits
    taken = error <= tolerance
    last = clock.step >= dt - clock.done
    done = (dt if last else clock.done + clock.step) if taken else clock.done
    wary = clock.wary if taken else clock.done + clock.step
    factor = _stretched(error, tolerance, dt, order)
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
    """to = (x, v)."""
    for i in range(np.uint64(first), np.uint64(end)):
        to_x[i], to_v[i] = x[i], v[i]


@shared
def slope_of(x: Any, v: Any, flow: Any, first: int, end: int) -> None:
    """Write into x how positions change where velocities are v: what carries is as of the last acceleration."""
    for i in range(np.uint64(first), np.uint64(end)):
        x[i] = carried(v[i], like(v[i], 1.0), flow, i)


@shared
def add_slopes(x: Any, v: Any, weight: float, slope: Any, a: Any, first: int, end: int) -> None:
    """(x, v) += weight (slope, a)."""
    for i in range(np.uint64(first), np.uint64(end)):
        x[i] += weight * slope[i]
        v[i] += weight * a[i]


@shared
def misfit(squares: Any, x: Any, v: Any, other_x: Any, other_v: Any, first: int, end: int) -> None:
    """Write by which square each coordinate of a result is off another, beyond rounding; into other_x if need be."""
    tiny = like(x[0], 8 * np.finfo(x.dtype).eps)
    for i in range(np.uint64(first), np.uint64(end)):
        squares[i] = excess(x[i] - other_x[i], x[i], tiny) + excess(v[i] - other_v[i], v[i], tiny)
