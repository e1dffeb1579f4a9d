"""Chains of segments: capsules, walls along a polyline, polygons (closed, solid inside, 2-D).

After the row header (see row_header.py), a chain has the number of its vertices; its radius, m (half its thickness); 1
if it is closed (the last vertex is joined to the first, and the inside is solid), else 0; the vertices, relative to the
anchor; and, if it is open, its two ends (see joints.py). A chain of one vertex is a circle or sphere. `x` is the
position of the agent relative to the anchor.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.shapes.round import ray_hit
from flockenv.geometry.shapes.row_header import body_of, bound_of, vector_at
from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, axis, dot, perpendicular, scale, select, sub, unit

__all__ = [
    "crosses", "end_acts", "hit_chain", "nearest_chain", "piece_chain", "piece_facing", "pieces_chain",
    "segment_hit", "segment_share", "vertex",
]  # fmt: skip


@law
def segment_share(x: Vec, a: Vec, b: Vec) -> float:
    """Return the parameter, 0 (at a) to 1 (at b), of the point of a segment that is nearest to x."""
    along = sub(b, a)
    o, e = like(x[0], 0.0), like(x[0], 1.0)
    square = dot(along, along)
    share = dot(sub(x, a), along) / square if square > o else o
    return o if share < o else (e if share > e else share)


@law
def _side_hit(m: Vec, direction: Vec, along: Vec, radius: float) -> float:
    """Return the distance along a ray to a tube around a line; inf if missed. m: offset of its origin from the line."""
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
    """Return the distance along a unit `direction` to a segment inflated by `radius`, m: 0 from inside, inf if missed.

    It is the least of the distances to the sides of the tube and to a circle or sphere around each end.
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
    """Return vertex j, relative to the anchor."""
    return vector_at(table, body_of(at, x) + 3 + len(x) * j, x)


@law
def crosses(x: Vec, a: Vec, b: Vec) -> bool:
    """Return True if the ray from x in direction +x crosses the segment."""
    rise = b[1] - a[1]
    between = (a[1] > x[1]) != (b[1] > x[1])
    slope = rise if between else like(rise, 1.0)
    return between & (x[0] < a[0] + (b[0] - a[0]) * ((x[1] - a[1]) / slope))


@law
def nearest_chain(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface, m (negative inside), and the outward unit normal at its nearest point.

    If x is exactly on the line, the normal points to the right of the segment from a to b: out of a polygon.
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

    It is 0 if the body already overlaps.
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


# --- piece by piece ---------------------------------------------------------------------------------------------------


@law
def pieces_chain(table: Any, at: int, x: Vec, gap: float) -> int:
    """Return the number of pieces that act on an agent at distance `gap`, m; 1 inside a solid polygon."""
    body = body_of(at, x)
    count = np.int64(table[body])
    closed = table[body + 2] > like(gap, 0.0)
    edges = count if closed else max(count - 1, 1)
    return 1 if closed & (gap < like(gap, 0.0)) else edges  # type: ignore[return-value]  # an int to numba


@law
def _corner_acts(table: Any, at: int, j: int, x: Vec) -> bool:
    """Return True if the corner at the start of edge j acts, being the nearest point also of the adjoining edge."""
    body = body_of(at, x)
    count: Any = np.int64(table[body])
    closed = table[body + 2] > like(x[0], 0.0)
    before = j - 1 if j > 0 else count - 1
    if (j > 0) | closed:
        corner = vertex(table, at, j, x)
        return dot(sub(x, corner), sub(vertex(table, at, before, x), corner)) <= like(x[0], 0.0)
    return end_acts(table, at, 0, x)


@law
def end_acts(table: Any, at: int, which: int, x: Vec) -> bool:
    """Return True if the first (0) or last (1) end of an open chain, nearest point of its piece, acts on x."""
    body = body_of(at, x)
    count: Any = np.int64(table[body])
    place = body + 3 + len(x) * count + which * (1 + len(x))
    corner = vertex(table, at, 0 if which == 0 else count - 1, x)
    code = table[place]
    nearest = dot(sub(x, corner), vector_at(table, place + 1, x)) <= like(code, 0.0)
    acts: bool = (code < like(code, 0.5)) | ((code < like(code, 1.5)) & nearest)
    return acts


@law
def piece_chain(table: Any, at: int, j: int, x: Vec, gap: float, out: Vec) -> tuple[float, Vec, bool]:
    """Return the distance to piece j, m, the unit normal there, and whether the piece acts; see `piece_facing`."""
    return piece_facing(table, at, j, x, gap, out, like(gap, 1.0))


@law
def piece_facing(table: Any, at: int, j: int, x: Vec, gap: float, out: Vec, facing: float) -> tuple[float, Vec, bool]:
    """Return the distance to piece j, m, the unit normal there, and whether the piece acts.

    A piece acts if the foot of the perpendicular lies on it; a corner acts once, if it is the nearest point of all
    pieces that join there; of a polygon, only sides that face x act. So forces do not depend on how a wall is cut into
    pieces. gap, out: distance and normal of the whole chain, used inside a solid polygon. facing: 1 if solid, -1 if
    hollow.
    """
    body = body_of(at, x)
    count: Any = np.int64(table[body])
    radius = table[body + 1]
    o, e = like(radius, 0.0), like(radius, 1.0)
    closed = table[body + 2] > o
    if (count < 2) | (closed & (gap < o)):
        return gap, out, True
    last = j + 1 >= count
    a = vertex(table, at, j, x)
    b = vertex(table, at, 0 if last else j + 1, x)
    along = sub(b, a)
    share = segment_share(x, a, b)
    off = sub(x, add(a, scale(along, share)))
    square = dot(off, off)
    side = perpendicular(unit(along))
    faces = (dot(off, side) * facing >= o) | (share <= o) | (share >= e)
    acts = (share > o) & (share < e)
    if share <= o:
        acts = _corner_acts(table, at, j, x)
    elif share >= e:
        acts = (not closed) & (j + 2 >= count) & end_acts(table, at, 1, x)
    apart = square > like(square, 1e-24)
    normal = select(apart, unit(off), scale(side, facing))
    return np.sqrt(square) - radius, normal, acts & (faces | (not closed))
