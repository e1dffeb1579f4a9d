"""Laws to avoid a circle or sphere ahead, and to stay in a box."""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import dot, lateral, perpendicular, scale, select, sub, unit, zero
from flockenv.steering.goals import seek

__all__ = ["avoid", "contain", "threat"]


@law
def threat(forward: Vec, offset: Vec, clearance: float, lookahead: float) -> float:
    """Return how far ahead [m] a straight path touches a circle or sphere, inf if not within `lookahead` [m].

    `forward` is a unit vector, `offset` leads to the centre, `clearance` is the sum of both radii (Reynolds 1999: the
    cylinder test). Inside the obstacle the threat is at 0.
    """
    along = dot(offset, forward)
    aside = lateral(offset, forward)
    room = clearance * clearance - dot(aside, aside)
    o = like(room, 0.0)
    entry = along - np.sqrt(room if room > o else o)
    inside = dot(offset, offset) < clearance * clearance
    hit = room > o and along > o and entry <= lookahead
    far = like(room, np.inf)
    return o if inside else (entry if hit else far)


@law
def avoid(forward: Vec, offset: Vec, clearance: float, max_speed: float) -> Vec:
    """Steer around a circle or sphere ahead (see `threat`): S = V sideways, away from its centre (Reynolds 1999).

    forward: the unit vector of the heading; offset: to the centre, m; clearance: the sum of both radii, m; max_speed:
    V, m/s.

    An obstacle dead ahead is passed on the right; an agent inside is steered straight out. The agent never brakes.
    """
    o = like(max_speed, 0.0)
    inside = dot(offset, offset) < clearance * clearance
    aside = lateral(offset, forward)
    # A lateral part that is rounding noise has no side: the obstacle counts as dead ahead.
    noise = like(max_speed, 1e-10) * dot(offset, offset)
    sideways = select(dot(aside, aside) > noise, scale(unit(aside), like(max_speed, -1.0)), perpendicular(forward))
    out = scale(unit(offset), like(max_speed, -1.0))
    out = select(dot(offset, offset) > o, out, forward)
    return scale(select(inside, out, sideways), max_speed)


@law
def _clamp(x: float, low: float, high: float) -> float:
    return low if x < low else (high if x > high else x)


@law
def contain(to_low: Vec, to_high: Vec, velocity: Vec, max_speed: float, time: float) -> Vec:
    """Stay in a box: if the position after `time` [s] is outside, seek the nearest one inside, else return zero.

    velocity: of the agent, m/s; max_speed: V, m/s.

    `to_low` and `to_high` are the distances to the lower and the upper wall per axis, m; negative beyond it
    (Reynolds 1999, containment).
    """
    step = scale(velocity, time)
    x = _clamp(step[0], -to_low[0], to_high[0])
    y = _clamp(step[1], -to_low[1], to_high[1])
    if len(velocity) == 2:
        return _return_change(step, (x, y), velocity, max_speed)
    else:
        return _return_change(step, (x, y, _clamp(step[2], -to_low[2], to_high[2])), velocity, max_speed)


@law
def _return_change(step: Vec, goal: Vec, velocity: Vec, max_speed: float) -> Vec:
    change = sub(goal, step)
    leaving = dot(change, change) > like(max_speed, 0.0)
    return select(leaving, seek(goal, velocity, max_speed), zero(velocity))
