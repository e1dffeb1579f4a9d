"""Boxes of any orientation, and half-spaces. See shapes/table.py for their layout in a table.

After the row header (see row_header.py), a block has its half edges (D, m) and its axes (D unit vectors of D numbers);
a half-space has its outward unit normal. `x` is the position of the agent relative to the anchor: the centre of a
block, or a point of the surface of a half-space.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.shapes.chain import segment_hit
from flockenv.geometry.shapes.round import ray_hit
from flockenv.geometry.shapes.row_header import body_of, vector_at
from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, axis, dot, norm, scale, select, sub, unit

__all__ = [
    "box_hit", "box_nearest", "half_edges", "hit_block", "hit_half_space", "nearest_block", "nearest_half_space",
    "to_block_frame", "to_world_frame",
]  # fmt: skip


@law
def half_edges(table: Any, at: int, x: Vec) -> Vec:
    """Return half the edges of a block, m."""
    return vector_at(table, body_of(at, x), x)


@law
def _axis(table: Any, at: int, k: int, x: Vec) -> Vec:
    return vector_at(table, body_of(at, x) + (k + 1) * len(x), x)


@law
def to_block_frame(table: Any, at: int, x: Vec) -> Vec:
    """Return x in the frame of a block's axes."""
    if len(x) == 2:
        return (dot(_axis(table, at, 0, x), x), dot(_axis(table, at, 1, x), x))
    else:
        return (dot(_axis(table, at, 0, x), x), dot(_axis(table, at, 1, x), x), dot(_axis(table, at, 2, x), x))


@law
def to_world_frame(table: Any, at: int, y: Vec) -> Vec:
    """Return a vector y, given in the frame of a block's axes, in the frame of the world."""
    out = add(scale(_axis(table, at, 0, y), y[0]), scale(_axis(table, at, 1, y), y[1]))
    if len(y) == 2:
        return out
    else:
        return add(out, scale(_axis(table, at, 2, y), y[2]))


@law
def _excess(y: float, h: float) -> float:
    """Return y less the nearest number in [-h, h]; 0 inside."""
    return y - h if y > h else (y + h if y < -h else like(y, 0.0))


@law
def _depth(y: float, h: float) -> float:
    return abs(y) - h


@law
def _signed_axis(y: float, k: int, x: Vec) -> Vec:
    return scale(axis(x, k), like(y, 1.0) if y >= like(y, 0.0) else like(y, -1.0))


@law
def box_nearest(y: Vec, h: Vec) -> tuple[float, Vec]:
    """Return the distance to an axis-aligned box around 0, m (negative inside), and its outward unit normal."""
    x_, y_ = _depth(y[0], h[0]), _depth(y[1], h[1])
    wide = x_ > y_
    deepest, face = x_ if wide else y_, select(wide, _signed_axis(y[0], 0, y), _signed_axis(y[1], 1, y))
    out: Vec
    if len(y) == 2:
        out = (_excess(y[0], h[0]), _excess(y[1], h[1]))
    else:
        out = (_excess(y[0], h[0]), _excess(y[1], h[1]), _excess(y[2], h[2]))
        z_ = _depth(y[2], h[2])
        tall = z_ > deepest
        deepest, face = z_ if tall else deepest, select(tall, _signed_axis(y[2], 2, y), face)
    outside = dot(out, out) > like(deepest, 0.0)
    return norm(out) if outside else deepest, select(outside, unit(out), face)


@law
def _slab(y: float, d: float, h: float) -> tuple[float, float]:
    """Return the interval of a line between two opposite faces: (from, to), in units of its direction."""
    o, far = like(h, 0.0), like(h, np.inf)
    moves = d != o
    rate = d if moves else like(h, 1.0)
    a, b = (-h - y) / rate, (h - y) / rate
    a, b = (a, b) if a < b else (b, a)
    between = abs(y) <= h
    return a if moves else (-far if between else far), b if moves else (far if between else -far)


@law
def box_hit(y: Vec, d: Vec, h: Vec) -> float:
    """Return the distance along d to an axis-aligned box around 0, m: 0 from inside, inf if missed."""
    a, b = _slab(y[0], d[0], h[0])
    c, e = _slab(y[1], d[1], h[1])
    first, last = c if c > a else a, e if e < b else b
    if len(y) == 3:
        c, e = _slab(y[2], d[2], h[2])
        first, last = c if c > first else first, e if e < last else last
    o = like(first, 0.0)
    return (first if first > o else o) if (first <= last) & (last >= o) else like(o, np.inf)


@law
def _rounded_square(y: Vec, d: Vec, h: Vec, r: float) -> float:
    """Return the distance along a ray to a rectangle inflated by r, the union of two rectangles and four circles."""
    a, b = box_hit(y, d, (h[0] + r, h[1])), box_hit(y, d, (h[0], h[1] + r))
    best = a if a < b else b
    for corner in range(4):
        place = (h[0] if corner & 1 else -h[0], h[1] if corner & 2 else -h[1])
        here = ray_hit(sub(place, y), d, r)
        best = here if here < best else best
    return best


@law
def _rounded_cube(y: Vec, d: Vec, h: Vec, r: float) -> float:
    """Return the distance along a ray to a box inflated by r, the union of three boxes and twelve round edges."""
    a, b = box_hit(y, d, (h[0] + r, h[1], h[2])), box_hit(y, d, (h[0], h[1] + r, h[2]))
    c = box_hit(y, d, (h[0], h[1], h[2] + r))
    best = a if a < b else b
    best = c if c < best else best
    for edge in range(4):
        p, q = (edge & 1) * 2 - 1, (edge & 2) - 1
        u, v, w = h[0] * like(r, p), h[1] * like(r, p), h[1] * like(r, q)
        s = h[2] * like(r, q)
        x_ = segment_hit(y, d, (-h[0], v, s), (h[0], v, s), r)
        y_ = segment_hit(y, d, (u, -h[1], s), (u, h[1], s), r)
        z_ = segment_hit(y, d, (u, w, -h[2]), (u, w, h[2]), r)
        best = x_ if x_ < best else best
        best = y_ if y_ < best else best
        best = z_ if z_ < best else best
    return best


@law
def nearest_block(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface, m (negative inside), and the outward unit normal at its nearest point."""
    gap, normal = box_nearest(to_block_frame(table, at, x), half_edges(table, at, x))
    return gap, to_world_frame(table, at, normal)


@law
def hit_block(table: Any, at: int, x: Vec, direction: Vec, clearance: float) -> float:
    """Return the distance along a unit `direction` at which a body of radius `clearance` touches it, m; inf if never.

    It is 0 if the body already overlaps.
    """
    y, d, h = to_block_frame(table, at, x), to_block_frame(table, at, direction), half_edges(table, at, x)
    if len(x) == 2:
        return _rounded_square(y, d, h, clearance)
    else:
        return _rounded_cube(y, d, h, clearance)


@law
def nearest_half_space(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the plane, m (negative behind it), and its normal."""
    normal = vector_at(table, body_of(at, x), x)
    return dot(x, normal), normal


@law
def hit_half_space(table: Any, at: int, x: Vec, direction: Vec, clearance: float) -> float:
    """Return the distance along a unit `direction` at which a body of radius `clearance` touches it, m; inf if never.

    It is 0 if the body already overlaps.
    """
    normal = vector_at(table, body_of(at, x), x)
    room, speed = dot(x, normal) - clearance, dot(direction, normal)
    o = like(room, 0.0)
    return o if room < o else (room / -speed if speed < o else like(o, np.inf))
