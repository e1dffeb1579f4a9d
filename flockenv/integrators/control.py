"""Steps that a method chooses by itself: as long as its error allows, the last one ending where the step ends.

An error is the distance between two results, of position and velocity together (m and m/s alike), of the agent who is
worst off; it is absolute, and what rounding alone may make of a coordinate is not counted. The next step is
h clip(0.9 (tolerance / error)^(1 / (p + 1)), 0.2, 5), after a step that was taken as after one that was not.

A world is given up, by a coordinate that is not a number, where TRIES steps in a row are not accepted, where a step
shorter than `least` is called for, or where one does not move the clock.
"""

from __future__ import annotations

from typing import NamedTuple

from flockenv.kernels import like, shared

__all__ = ["TRIES", "Clock", "begun", "excess", "judged"]

TRIES = 20
"""Steps in a row that may be rejected: each is at most a fifth of the one before if nothing else is known."""


class Clock(NamedTuple):
    """Where a method is within one step of the scene."""

    done: float  # s, since its beginning
    step: float  # s, to be tried next
    tries: int  # in a row, rejected
    accepted: int
    rejected: int
    lost: bool  # given up


@shared
def begun(dt: float) -> Clock:
    """Return the clock at the beginning of a step of the scene: all of it is tried at once."""
    return Clock(like(dt, 0.0), dt, 0, 0, 0, False)


@shared
def excess(difference: float, size: float, tiny: float) -> float:
    """Return the square of what a difference is beyond the rounding of a number of that size; NaN stays NaN."""
    beyond = abs(difference) - tiny * abs(size)
    return like(beyond, 0.0) if beyond <= like(beyond, 0.0) else beyond * beyond


@shared
def judged(clock: Clock, error: float, tolerance: float, least: float, dt: float, order: int) -> Clock:
    """Return the clock after a step with that error, in the sense of the module's text, was tried."""
    o, e = like(dt, 0.0), like(dt, 1.0)
    none = error <= o
    ratio = tolerance / (tolerance if none else error)
    factor = like(dt, 5.0) if none else like(dt, 0.9) * ratio ** (e / like(dt, order + 1))
    factor = min(factor, like(dt, 5.0)) if factor > like(dt, 0.2) else like(dt, 0.2)  # NaN: a fifth
    taken = error <= tolerance
    last = clock.step >= dt - clock.done
    done = (dt if last else clock.done + clock.step) if taken else clock.done
    step = min(clock.step * factor, dt - done)
    tries = 0 if taken else clock.tries + 1
    stuck = (not taken) & ((tries >= TRIES) | (step < least) | (done + step == done))
    accepted, rejected = clock.accepted + (1 if taken else 0), clock.rejected + (0 if taken else 1)
    return Clock(dt if stuck else done, step, tries, accepted, rejected, stuck)
