"""What one agent wants by itself: to be at a place or away from it, to stand still there, to roam."""

from __future__ import annotations

import numpy as np

from flockenv.kernels import Vec, law, like
from flockenv.vec import add, dot, norm, perpendicular, scale, select, sub, unit

__all__ = ["arrive", "flee", "seek", "wander", "wander_turn"]


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
