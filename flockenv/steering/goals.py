"""Laws for one agent without others: seek, flee, arrive, wander, match a velocity or heading, dock."""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, axis, cross, dot, lateral, norm, perpendicular, scale, select, sub, unit

__all__ = [
    "arrive",
    "dock",
    "face",
    "flee",
    "match_velocity",
    "seek",
    "target_speed",
    "to_world_axes",
    "wander",
    "wander_turn",
]


@law
def seek(offset: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Head for a point at full speed: S = V unit(offset) - v, m/s (Reynolds 1999).

    offset: to the point, m; velocity: of the agent, m/s; max_speed: V, m/s.
    """
    return sub(scale(unit(offset), max_speed), velocity)


@law
def flee(offset: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Head away from a point at full speed; exactly at it, keep the present direction (Reynolds 1999).

    offset: to the point, m; velocity: of the agent, m/s; max_speed: V, m/s.
    """
    away = scale(unit(offset), -max_speed)
    onward = scale(unit(velocity), max_speed)
    return sub(select(dot(offset, offset) > like(max_speed, 0.0), away, onward), velocity)


@law
def arrive(offset: Vec, velocity: Vec, max_speed: float, slow_radius: float) -> Vec:
    """Seek, slowing down linearly within slow_radius [m] to a stop at the point (Reynolds 1999).

    offset: to the point, m; velocity: of the agent, m/s; max_speed: V, m/s.

    This is feasible if slow_radius >= V^2 m / F_max: the ramp requires that deceleration at its edge.
    """
    distance = norm(offset)
    ramped = max_speed * (distance / slow_radius)
    return sub(scale(unit(offset), ramped if ramped < max_speed else max_speed), velocity)


@law
def wander_turn(target: Vec, noise: Vec, rate: float, dt: float) -> Vec:
    """Return the wander target, moved on its unit sphere by a small random displacement.

    `noise` is uniform in [-1, 1] per axis, `rate` in 1/sqrt(s): scaled with sqrt(dt), the walk does not depend on dt.
    """
    moved = unit(add(target, scale(noise, rate * np.sqrt(dt))))
    return select(dot(moved, moved) > like(rate, 0.0), moved, target)


@law
def to_world_axes(own: Vec, velocity: Vec) -> Vec:
    """Return in world axes a vector given in those of an agent at this velocity: (forward, left[, up]).

    own: a vector in any unit; velocity: of the agent, m/s.

    Left is level unless the agent flies straight up; at standstill forward is the x axis.
    """
    moving = unit(velocity)
    forward = select(dot(moving, moving) > like(own[0], 0.0), moving, axis(moving, 0))
    if len(own) == 2:
        return add(scale(forward, own[0]), scale((-forward[1], forward[0]), own[1]))
    else:
        left = scale(perpendicular(forward), like(own[0], -1.0))
        aside = add(scale(left, own[1]), scale(cross(forward, left), own[2]))
        return add(scale(forward, own[0]), aside)


@law
def wander(target: Vec, velocity: Vec, max_speed: float, ahead: float) -> Vec:
    """Seek the target on a unit sphere whose centre is `ahead` (in its radii) of the agent (Reynolds 1999).

    velocity: of the agent, m/s; max_speed: V, m/s.

    `target` is in the agent's own frame: (forward, left) or (forward, left, up). At standstill, forward is the x axis.
    """
    goal = add(to_world_axes(target, velocity), to_world_axes(scale(axis(target, 0), ahead), velocity))
    return sub(scale(unit(goal), max_speed), velocity)


@law
def match_velocity(velocity: Vec, target_velocity: Vec) -> Vec:
    """Take on a velocity: S = v_t - v, m/s (Reynolds 1987).

    velocity: of the agent, m/s; target_velocity: m/s.
    """
    return sub(target_velocity, velocity)


@law
def target_speed(velocity: Vec, speed: float) -> Vec:
    """Take on a speed in the present direction: S = (v_t - |v|) unit(v), m/s; 0 at standstill.

    velocity: of the agent, m/s; speed: v_t, m/s.
    """
    return scale(unit(velocity), speed - norm(velocity))


@law
def face(velocity: Vec, heading: Vec) -> Vec:
    """Turn the velocity towards `heading` at constant speed: S = |v| n sin(a), m/s, perpendicular to the velocity.

    a is the angle between the two and n points to the heading's side. If the heading is behind, S = |v| n; if straight
    behind, n points right. Under F = w S tan(a/2) falls as exp(-w t / m) from 90 degrees on.
    """
    forward, wanted = unit(velocity), unit(heading)
    aside = lateral(wanted, forward)
    behind = dot(wanted, forward) < like(aside[0], 0.0)
    noise = like(aside[0], 1e-10)
    sideways = select(dot(aside, aside) > noise, unit(aside), perpendicular(forward))
    return scale(select(behind, sideways, aside), norm(velocity))


@law
def dock(
    offset: Vec, velocity: Vec, direction: Vec, max_speed: float, gate: float, width: float, slow_radius: float
) -> Vec:
    """Arrive at a point while flying in a `direction`: through a gate `gate` [m] before it, then along its axis.

    offset: to the point, m; velocity: of the agent, m/s; direction: a unit vector; max_speed: V, m/s; slow_radius: m,
    as of `arrive`.

    In a cone about the axis, with its tip at the point and radius `width` [m] at the gate, the agent aims at the axis
    half-way to the point: its distance from the axis falls as the square of the distance to go, its angle linearly.
    Outside twice that cone it aims at the gate; from beyond the point, first at a point beside it. Reynolds 1999
    describes docking in words; the construction is ours.
    """
    o, e, half = like(gate, 0.0), like(gate, 1.0), like(gate, 0.5)
    forward = unit(direction)
    to_go, beside = dot(offset, forward), scale(lateral(offset, forward), like(gate, -1.0))
    aside = norm(beside)
    there = like(gate, 0.02) * width  # nearer than this, the agent has arrived, on either side
    wide = max(to_go * (width / gate), half * there)
    out = min(max(aside / wide - e, o), e)
    near = min(half * max(to_go, o), gate)
    behind = (to_go < o) & (norm(offset) > there)
    before = half * gate if behind else near + (gate - near) * out
    side = select(aside > like(gate, 1e-10) * norm(offset), unit(beside), perpendicular(forward))
    aim = sub(offset, scale(forward, before))
    aim = select(behind, add(aim, scale(side, half * gate)), aim)  # around the point, not through it
    length = norm(aim) + before
    ramped = max_speed * (length / slow_radius)
    return sub(scale(unit(aim), ramped if ramped < max_speed else max_speed), velocity)
