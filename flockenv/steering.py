"""Reynolds' verbs, one law each, for one agent: every sweep, scripted agent and hand-written player calls these.

A steering law returns the change of velocity it asks for, S = v_desired - v, in m/s; the caller turns it into a force
with a gain in kg/s (m/tau makes `seek` Helbing's driving force). `offset` is always other minus self. Laws take tuples
of D = 2 or 3 floats and are finite for every finite input, at standstill and at zero distance too.
Over arrays of rows they are called through `flockenv.rows.rows(law)`.

Sources: Reynolds, "Flocks, Herds, and Schools" (SIGGRAPH 1987); "Steering Behaviors for Autonomous Characters"
(GDC 1999). The sign of seek is the paper's figure, not its pseudo-code, which flees.
"""

from __future__ import annotations

import numpy as np

from flockenv.kernels import Vec, law, like
from flockenv.vec import add, dot, lateral, norm, perpendicular, scale, select, sub, unit, zero

__all__ = [
    "align",
    "arrive",
    "avoid",
    "cohere",
    "contain",
    "distance_time",
    "evade",
    "flee",
    "interception_time",
    "pursue",
    "seek",
    "separate",
    "threat",
    "wander",
    "wander_turn",
]


@law
def seek(offset: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Head for a point at full speed: S = V unit(offset) - v, m/s (Reynolds 1999)."""
    return sub(scale(unit(offset), max_speed), velocity)


@law
def flee(offset: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Head away from a point at full speed; on the very point, go on as before (Reynolds 1999)."""
    away = scale(unit(offset), -max_speed)
    onward = scale(unit(velocity), max_speed)
    return sub(select(dot(offset, offset) > like(max_speed, 0.0), away, onward), velocity)


@law
def arrive(offset: Vec, velocity: Vec, max_speed: float, slow_radius: float) -> Vec:
    """Seek, slowing down linearly within slow_radius [m] to stand still at the point (Reynolds 1999).

    Feasible if slow_radius >= V^2 m / F_max: the ramp asks for that deceleration at its edge.
    """
    distance = norm(offset)
    ramped = max_speed * (distance / slow_radius)
    return sub(scale(unit(offset), ramped if ramped < max_speed else max_speed), velocity)


@law
def distance_time(offset: Vec, max_speed: float, factor: float) -> float:
    """Predict by distance: T = factor |offset| / V, s. The simplest predictor of Reynolds 1999."""
    return factor * norm(offset) / max_speed


@law
def interception_time(offset: Vec, quarry_velocity: Vec, max_speed: float) -> float:
    """Predict exactly: the first time at which a pursuer at full speed V can meet the quarry, s.

    Smallest t > 0 of (w.w - V^2) t^2 + 2 p.w t + p.p = 0 with p = offset, w = quarry velocity, in the form that does
    not cancel; |p|/V where no interception exists.
    """
    a = dot(quarry_velocity, quarry_velocity) - max_speed * max_speed
    b = dot(offset, quarry_velocity)
    c = dot(offset, offset)
    o = like(c, 0.0)
    discriminant = b * b - a * c
    denominator = np.sqrt(discriminant if discriminant > o else o) - b
    exists = discriminant >= o and denominator > o
    return c / denominator if exists else np.sqrt(c) / max_speed  # type: ignore[no-any-return]


@law
def pursue(offset: Vec, velocity: Vec, quarry_velocity: Vec, max_speed: float, time: float) -> Vec:
    """Seek where the quarry will be after `time` [s], as a predictor says (Reynolds 1999)."""
    return seek(add(offset, scale(quarry_velocity, time)), velocity, max_speed)


@law
def evade(offset: Vec, velocity: Vec, pursuer_velocity: Vec, max_speed: float, time: float) -> Vec:
    """Flee from where the pursuer will be after `time` [s] (Reynolds 1999)."""
    return flee(add(offset, scale(pursuer_velocity, time)), velocity, max_speed)


@law
def wander_turn(target: Vec, noise: Vec, rate: float, dt: float) -> Vec:
    """Move the wander target on its unit sphere by one small random displacement; returns the new target.

    `noise` is uniform in [-1, 1] per axis, `rate` in 1/sqrt(s): scaled with sqrt(dt), the walk does not depend on dt.
    """
    moved = unit(add(target, scale(noise, rate * np.sqrt(dt))))
    return select(dot(moved, moved) > like(rate, 0.0), moved, target)


@law
def wander(target: Vec, velocity: Vec, max_speed: float, ahead: float) -> Vec:
    """Seek the target on a unit sphere carried `ahead` (in its radii) of the agent (Reynolds 1999).

    `target` is in the agent's own frame: (forward, left) or (forward, left, up). At standstill, forward is the x axis.
    """
    moving = unit(velocity)
    still = dot(moving, moving) <= like(max_speed, 0.0)
    o, e = like(max_speed, 0.0), like(max_speed, 1.0)
    forward: Vec
    left: Vec
    if len(target) == 2:
        forward = select(still, (e, o), moving)
        left = (-forward[1], forward[0])
        goal = add(scale(forward, target[0] + ahead), scale(left, target[1]))
    else:
        forward = select(still, (e, o, o), moving)
        left = scale(perpendicular(forward), -e)
        up = (
            forward[1] * left[2] - forward[2] * left[1],
            forward[2] * left[0] - forward[0] * left[2],
            forward[0] * left[1] - forward[1] * left[0],
        )
        goal = add(add(scale(forward, target[0] + ahead), scale(left, target[1])), scale(up, target[2]))
    return sub(scale(unit(goal), max_speed), velocity)


@law
def separate(offset: Vec, tie: Vec) -> Vec:
    """One neighbour's push: away from it, weighted 1/distance, 1/m (Reynolds 1999). Sum over neighbours.

    `tie` is the direction to take where the two coincide, a unit vector that is opposite for the other one.
    """
    square = dot(offset, offset)
    apart = square > like(square, 1e-30)  # nearer than 1e-15 m is one place: 1/square must not overflow, in float32 too
    return select(apart, scale(offset, like(square, -1.0) / square), tie)


@law
def align(velocity: Vec, mean_velocity: Vec) -> Vec:
    """Take on the neighbours' mean velocity: S = mean(v_j) - v, m/s (Reynolds 1999: the average, not the sum)."""
    return sub(mean_velocity, velocity)


@law
def cohere(mean_offset: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Seek the neighbours' centre, at `mean_offset` [m] (Reynolds 1999). Without offset there is nothing to seek."""
    some = dot(mean_offset, mean_offset) > like(max_speed, 0.0)
    return select(some, seek(mean_offset, velocity, max_speed), zero(velocity))


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
    """Steer around the circle or sphere that `threat` found: sideways, away from its centre, at V m/s (Reynolds 1999).

    Dead ahead everybody keeps right; inside, the way is straight out. It never brakes.
    """
    o = like(max_speed, 0.0)
    inside = dot(offset, offset) < clearance * clearance
    aside = lateral(offset, forward)
    # A lateral part of rounding noise has no side: treat it as dead ahead.
    noise = like(max_speed, 1e-10) * dot(offset, offset)
    sideways = select(dot(aside, aside) > noise, scale(unit(aside), like(max_speed, -1.0)), perpendicular(forward))
    out = scale(unit(offset), like(max_speed, -1.0))
    out = select(dot(offset, offset) > o, out, forward)
    return scale(select(inside, out, sideways), max_speed)


@law
def _clamped(x: float, low: float, high: float) -> float:
    return low if x < low else (high if x > high else x)


@law
def contain(to_low: Vec, to_high: Vec, velocity: Vec, max_speed: float, time: float) -> Vec:
    """Stay in a box: if the place after `time` [s] is outside, seek the nearest place inside, else ask for nothing.

    `to_low` and `to_high` are the distances to the lower and the upper wall per axis, m; negative beyond it
    (Reynolds 1999, containment).
    """
    step = scale(velocity, time)
    x = _clamped(step[0], -to_low[0], to_high[0])
    y = _clamped(step[1], -to_low[1], to_high[1])
    if len(velocity) == 2:
        return _return(step, (x, y), velocity, max_speed)
    else:
        return _return(step, (x, y, _clamped(step[2], -to_low[2], to_high[2])), velocity, max_speed)


@law
def _return(step: Vec, goal: Vec, velocity: Vec, max_speed: float) -> Vec:
    change = sub(goal, step)
    leaving = dot(change, change) > like(max_speed, 0.0)
    return select(leaving, seek(goal, velocity, max_speed), zero(velocity))
