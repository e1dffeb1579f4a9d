"""The time at which a body on a parabola first touches a surface, and its velocity after the impact.

Laws for one body, relative to a surface; lengths in m, times in s. The surface is a row of a table of shapes
(flockenv/geometry/shapes/table.py), or a point: two round bodies touch if the distance of their centres is the sum of
their radii, their `room`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.shapes.dispatch import hit_shape, nearest_shape
from flockenv.geometry.shapes.round import ray_hit
from flockenv.jit.decorators import Vec, kernel, law, routine
from flockenv.maths.vectors import add, axis, dot, norm, scale, select, sub, unit

__all__ = [
    "POINT",
    "bounce",
    "comes_to_rest",
    "first_impact",
    "hops_within",
    "parabola_of",
    "position_along",
    "slow_by_friction",
    "surface_at",
]  # fmt: skip

POINT = -1
"""The row number that stands for a point."""

CHORDS = 8
"""Largest number of chords of a path."""

POLISH = 40
"""Most steps of Newton's method after a chord has hit; two or three are usual."""


@routine
def surface_at(table: Any, at: int, y: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface of a shape or a point, m, and the unit normal there, from y relative to it."""
    if at >= 0:
        return nearest_shape(table, at, y)
    far = norm(y)
    return far, select(far > 0.0, unit(y), axis(y, 0))


@routine
def _ray_hit(table: Any, at: int, y: Vec, direction: Vec, room: float) -> float:
    """Return the distance along the unit vector `direction` after which a body of radius `room` touches, m."""
    if at >= 0:
        return hit_shape(table, at, y, direction, room)
    return ray_hit(scale(y, -1.0), direction, room)


@law
def position_along(x: Vec, v: Vec, a: Vec, t: float) -> Vec:
    """Return x + v t + a t^2 / 2."""
    return add(x, scale(add(v, scale(a, 0.5 * t)), t))


@law
def parabola_of(dt: float, moved: Vec, before: Vec, after: Vec) -> tuple[Vec, Vec, Vec]:
    """Return velocity at the beginning of a step and acceleration, and the method's final velocity less the parabola's.

    The parabola leads `moved` m further in a step over which the method changed velocity from `before` to `after`. The
    velocity of a first-order method is half a step ahead or behind, but its points lie on a parabola
    (flockenv/geometry/space.py).
    """
    a = scale(sub(after, before), 1.0 / dt)
    excess = sub(sub(after, scale(moved, 1.0 / dt)), scale(a, 0.5 * dt))
    return sub(before, excess), a, excess


@law
def _earliest_contact(w: float, a: float, far: float, touch: float) -> float:
    """Return the time from which a body that now touches may have a new contact: 0 = now, inf = never.

    w, a: velocity and acceleration along the outward normal. A motion into the surface by less than half of `touch`
    until `far` is rounding, and no impact; otherwise a sliding body would hop repeatedly.
    """
    fall = -a if a < 0.0 else 0.0
    if not (0.5 * fall * far - w) * far > 0.5 * touch:
        return np.inf
    return w / fall if w > 0.0 else 0.0  # the top of a hop, or now


@routine
def first_impact(table: Any, at: int, y: Vec, v: Vec, a: Vec, far: float, room: float, touch: float) -> float:
    """Return the time of first contact, up to `far` s, of a body at y with velocity v and acceleration a, or inf.

    Contact is a gap of at most `touch`, m. The path is divided into chords, which differ from it by at most a hundredth
    of the room. Each chord is followed exactly; if one hits, the time is refined on the parabola. A body that already
    overlaps and goes deeper touches now; one that leaves touches only when it comes back.
    """
    gap, n = surface_at(table, at, y)
    if gap - room > touch:
        if gap - room > (norm(v) + 0.5 * norm(a) * far) * far + touch:
            return np.inf  # it does not reach the surface
        return _follow_path(table, at, y, v, a, 0.0, far, room, room, touch)
    top = _earliest_contact(dot(v, n), dot(a, n), far, touch)
    if top <= 0.0:
        return 0.0
    away = min(top, far)  # until then it leaves the surface, but may hit another part of the same shape
    t = _follow_path(table, at, y, v, a, 0.0, away, room, gap - 1e-9 * room - touch, touch)
    if t < np.inf or top >= far:
        return t
    if surface_at(table, at, position_along(y, v, a, top))[0] - room <= touch:  # it never left the surface
        return min(2.0 * top, far)
    return _follow_path(table, at, y, v, a, top, far, room, room, touch)


@routine
def _follow_path(
    table: Any, at: int, y: Vec, v: Vec, a: Vec, begin: float, far: float, room: float, seen: float,
    touch: float,
) -> float:  # fmt: skip
    """Return the time in [begin, far] at which the path reaches the surface, or inf; chords have room `seen`."""
    bend = norm(a) * (far - begin) * (far - begin) / 8.0
    chords = int(min(1.0 + np.sqrt(bend / (0.01 * room + 1e-12)), CHORDS * 1.0))
    each = (far - begin) / chords
    for c in range(chords):
        since = begin + c * each
        here = position_along(y, v, a, since)
        chord = sub(position_along(y, v, a, since + each), here)
        length = norm(chord)
        hit = _ray_hit(table, at, here, unit(chord), max(seen, 0.0)) if length > 0.0 else np.inf
        if hit <= length:
            t = _refine_time(table, at, y, v, a, since, since + each, room, since + each * hit / length)
            gap, n = surface_at(table, at, position_along(y, v, a, t))
            if gap - room <= touch + 1e-9 * room and dot(add(v, scale(a, t)), n) < 0.0:
                return t
    return np.inf


@kernel
def _refine_time(
    table: Any, at: int, y: Vec, v: Vec, a: Vec, early: float, late: float, room: float, t: float
) -> float:  # fmt: skip
    """Return the time near t, within [early, late], at which the surface is reached, by a safeguarded Newton's method.

    If the body is beyond the surface at `late`, bisection replaces each Newton step that leaves the bracket: a chord
    may hit while the body still rises.
    """
    through = surface_at(table, at, position_along(y, v, a, late))[0] < room
    for _ in range(POLISH):
        gap, n = surface_at(table, at, position_along(y, v, a, t))
        off, w = gap - room, dot(add(v, scale(a, t)), n)
        if off > 0.0:
            early = t
        elif through:
            late = t
        step = t - off / w if w < 0.0 else late + 1.0
        if not early <= step <= late:
            if not through:
                break
            step = 0.5 * (early + late)
        done = abs(step - t) <= 1e-15 * late
        t = step
        if done:
            break
    return t


@law
def bounce(c: Vec, n: Vec, restitution: float, friction: float) -> Vec:
    """Return the velocity after an impact at velocity c relative to a surface of normal n; c if it does not approach.

    The normal part is reversed and multiplied by `restitution`. Coulomb friction reduces the tangential part by at most
    `friction` times the change of the normal part, and never reverses it.
    """
    w = -dot(c, n)
    if w <= 0.0:
        return c
    side = add(c, scale(n, w))
    return add(slow_by_friction(side, friction * (1.0 + restitution) * w), scale(n, restitution * w))


@law
def slow_by_friction(side: Vec, most: float) -> Vec:
    """Return a velocity along a surface, reduced by `most` m/s, or zero if it is slower than that."""
    speed = norm(side)
    return scale(side, 1.0 - most / speed if speed > most else 0.0)


@law
def hops_within(w: float, push: float, touch: float) -> bool:
    """Return True if a body of speed w, m/s, hops at most `touch`, m, high under an acceleration `push` < 0."""
    return push < 0.0 and w * w <= -2.0 * push * touch


@law
def comes_to_rest(w: float, push: float, restitution: float, left: float) -> bool:
    """Return True if all further bounces on a plane end within `left` s, each at `restitution` = e times the speed.

    A body of speed w > 0, accelerated by `push` < 0 into the plane, bounces for 2 e w / (-push (1 - e)) s.
    """
    return push < 0.0 and 2.0 * restitution * w <= -push * (1.0 - restitution) * left
