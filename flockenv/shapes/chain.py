"""Segments one after another: capsules, walls along a line, polygons (closed, and solid inside, in the plane).

A chain is some numbers of a table: a head (see head.py), how many vertices there are, how far around the line
it is thick (m), 1 if the last vertex is joined to the first and what lies within is solid; then the vertices, relative
to the anchor. A chain of one vertex is a circle or sphere. `x` is where the agent is, relative to the anchor.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.kernels import Vec, law, like
from flockenv.shapes.head import body_of, bound_of, vector_at
from flockenv.shapes.round import ray_hit
from flockenv.vec import add, axis, dot, perpendicular, scale, select, sub, unit

__all__ = ["crosses", "hit_chain", "nearest_chain", "segment_hit", "segment_share", "vertex"]


@law
def segment_share(x: Vec, a: Vec, b: Vec) -> float:
    """Return how far from a to b the point of the segment lies that is nearest to x, from 0 to 1."""
    along = sub(b, a)
    o, e = like(x[0], 0.0), like(x[0], 1.0)
    square = dot(along, along)
    share = dot(sub(x, a), along) / square if square > o else o
    return o if share < o else (e if share > e else share)


@law
def _side_hit(m: Vec, direction: Vec, along: Vec, radius: float) -> float:
    """Return where a ray touches the sides of a tube around a line, inf if it does not; `m` leads from the line."""
    o, far = like(radius, 0.0), like(radius, np.inf)
    if len(m) == 2:
        across = perpendicular(along)
        away, speed = dot(m, across), dot(direction, across)
        away, speed = (away, speed) if away > o else (-away, -speed)
        return (away - radius) / -speed if (speed < o) & (away >= radius) else far
    else:
        axle = unit(along)
        p, q = sub(m, scale(axle, dot(m, axle))), sub(direction, scale(axle, dot(direction, axle)))
        a, b, c = dot(q, q), dot(p, q), dot(p, p) - radius * radius
        square = b * b - a * c
        return c / (np.sqrt(square) - b) if (square >= o) & (b < o) & (c >= o) else far


@law
def segment_hit(x: Vec, direction: Vec, a: Vec, b: Vec, radius: float) -> float:
    """Return the distance along a unit `direction` to whatever is within `radius` of a segment, m; inf if missed.

    From inside it is 0. The sides of the tube, and a circle or sphere around each end.
    """
    o, far = like(radius, 0.0), like(radius, np.inf)
    along, m = sub(b, a), sub(x, a)
    square = dot(along, along)
    side = _side_hit(m, direction, along, radius)
    at = dot(m, along) + (side if side < far else o) * dot(direction, along)
    side = side if (square > o) & (at >= o) & (at <= square) else far
    first, last = ray_hit(sub(a, x), direction, radius), ray_hit(sub(b, x), direction, radius)
    near = sub(m, scale(along, segment_share(x, a, b)))
    out = side if side < first else first
    out = out if out < last else last
    return o if dot(near, near) < radius * radius else out


@law
def vertex(table: Any, at: int, j: int, x: Vec) -> Vec:
    """Return its vertex j, from the anchor."""
    return vector_at(table, body_of(at, x) + 3 + len(x) * j, x)


@law
def crosses(x: Vec, a: Vec, b: Vec) -> bool:
    """Does the line from x to the right cross the segment?"""
    rise = b[1] - a[1]
    between = (a[1] > x[1]) != (b[1] > x[1])
    slope = rise if between else like(rise, 1.0)
    return between & (x[0] < a[0] + (b[0] - a[0]) * ((x[1] - a[1]) / slope))


@law
def nearest_chain(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface, m (negative inside), and the outward unit normal at its nearest point.

    On the very line the normal is across it: to the right of a segment from a to b, which is out of a polygon.
    """
    body = body_of(at, x)
    count, radius = np.int64(table[body]), table[body + 1]
    closed = table[body + 2] > like(radius, 0.0)
    e = like(radius, 1.0)
    best, away, side, inside = like(radius, np.inf), sub(x, x), axis(x, 0), False
    edges: Any = count if closed or count < 2 else count - 1
    for j in range(edges):
        a = vertex(table, at, j, x)
        b = vertex(table, at, j + 1 if j + 1 < count else 0, x)
        off = sub(x, add(a, scale(sub(b, a), segment_share(x, a, b))))
        square = dot(off, off)
        nearer = square < best
        best, away = square if nearer else best, select(nearer, off, away)
        side = select(nearer, perpendicular(unit(sub(b, a))), side)
        inside = inside != (closed & crosses(x, a, b))
    sign = -e if inside else e
    apart = best > like(best, 1e-24)
    return sign * np.sqrt(best) - radius, select(apart, scale(unit(away), sign), side)


@law
def hit_chain(table: Any, at: int, x: Vec, direction: Vec, clearance: float) -> float:
    """Return the distance along a unit `direction` at which a body of radius `clearance` touches it, m; inf if never.

    From where it overlaps already it is 0.
    """
    body = body_of(at, x)
    count, room = np.int64(table[body]), table[body + 1] + clearance
    closed = table[body + 2] > like(room, 0.0)
    best = like(room, np.inf)
    middle, around = bound_of(table, at, x)
    if ray_hit(sub(middle, x), direction, around + clearance) == best:
        return best
    inside = False
    edges: Any = count if closed or count < 2 else count - 1
    for j in range(edges):
        a = vertex(table, at, j, x)
        b = vertex(table, at, j + 1 if j + 1 < count else 0, x)
        here = segment_hit(x, direction, a, b, room)
        best = here if here < best else best
        inside = inside != (closed & crosses(x, a, b))
    return like(best, 0.0) if inside else best
