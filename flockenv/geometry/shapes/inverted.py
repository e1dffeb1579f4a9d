"""Laws of hollow shapes, free inside and solid outside: rooms, spheres and boxes that bodies stay in.

Rows are those of the solid shapes; distances and normals are theirs with the sign reversed. A ray ends where a body of
radius r touches the surface from inside: where its centre leaves the set of points deeper than r. For a circle, sphere,
capsule or block that set is the same shape, smaller by r; for a polygon, the inside without points within r of an edge.
All of these are exact; a distance field uses ray marching.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.shapes.block import half_edges, nearest_block, to_block_frame, to_world_frame
from flockenv.geometry.shapes.chain import crosses, nearest_chain, piece_facing, segment_hit, segment_share, vertex
from flockenv.geometry.shapes.field import STEPS, nearest_distance_field, on_grid
from flockenv.geometry.shapes.row_header import body_of
from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.grid import sample
from flockenv.maths.vectors import add, axis, dot, norm, scale, sub, unit

__all__ = [
    "hit_hollow_block", "hit_hollow_chain", "hit_hollow_distance_field", "nearest_hollow_block", "nearest_hollow_chain",
    "nearest_hollow_distance_field", "piece_hollow_block", "piece_hollow_chain", "pieces_hollow_block",
    "pieces_hollow_chain",
]  # fmt: skip


@law
def _invert(found: tuple[float, Vec]) -> tuple[float, Vec]:
    gap, normal = found
    return -gap, scale(normal, like(gap, -1.0))


@law
def nearest_hollow_chain(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface, m (negative outside), and the inward unit normal at its nearest point."""
    return _invert(nearest_chain(table, at, x))


@law
def nearest_hollow_block(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface, m (negative outside), and the inward unit normal at its nearest point."""
    return _invert(nearest_block(table, at, x))


@law
def nearest_hollow_distance_field(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface, m (negative outside), and the inward unit normal at its nearest point."""
    return _invert(nearest_distance_field(table, at, x))


@law
def _root(a: float, b: float, c: float) -> float:
    """Return the larger root of a t^2 + 2 b t + c, for a > 0, without cancellation; -inf if there is none."""
    o = like(a, 0.0)
    square = b * b - a * c
    root = np.sqrt(square if square > o else o)
    out = (root - b) / a if b <= o else -c / (root + b)
    return out if square >= o else like(a, -np.inf)


@law
def _capsule_exit(x: Vec, direction: Vec, a: Vec, b: Vec, radius: float) -> float:
    """Return the distance at which a ray from inside leaves a segment inflated by `radius`.

    It is the largest of the distances at which it leaves the sides of the tube and the circle or sphere around each
    end.
    """
    o, e = like(radius, 0.0), like(radius, 1.0)
    along, m = sub(b, a), sub(x, a)
    axle = unit(along)
    p, q = sub(m, scale(axle, dot(m, axle))), sub(direction, scale(axle, dot(direction, axle)))
    slope = dot(q, q)
    side = _root(slope if slope > o else e, dot(p, q), dot(p, p) - radius * radius)
    place = dot(m, along) + side * dot(direction, along)
    out = side if (slope > o) & (place >= o) & (place <= dot(along, along)) else o
    n = sub(x, b)
    first = _root(e, dot(m, direction), dot(m, m) - radius * radius)
    last = _root(e, dot(n, direction), dot(n, n) - radius * radius)
    out = first if first > out else out
    return last if last > out else out


@law
def hit_hollow_chain(table: Any, at: int, x: Vec, direction: Vec, clearance: float) -> float:
    """Return the distance along a unit `direction` at which a body of radius `clearance` touches it, m; inf if never.

    It is 0 if the body already overlaps.
    """
    body = body_of(at, x)
    count: Any = np.int64(table[body])
    radius = table[body + 1]
    o, far = like(radius, 0.0), like(radius, np.inf)
    moves = dot(direction, direction) > o
    if table[body + 2] > o:
        best, inside = far, False
        for j in range(count):
            a, b = vertex(table, at, j, x), vertex(table, at, j + 1 if j + 1 < count else 0, x)
            here = segment_hit(x, direction, a, b, clearance)
            best = here if here < best else best
            inside = inside != crosses(x, a, b)
        return best if inside else o
    else:
        a, b = vertex(table, at, 0, x), vertex(table, at, count - 1, x)
        room = radius - clearance
        off = sub(x, add(a, scale(sub(b, a), segment_share(x, a, b))))
        free = (room >= o) & (dot(off, off) <= room * room)
        out = _capsule_exit(x, direction, a, b, room) if moves else far
        return out if free else o


@law
def _exit_distance(y: float, d: float, h: float) -> float:
    """Return the distance at which a ray leaves [-h, h] along one axis."""
    o = like(h, 0.0)
    ends = h - y if d > o else -h - y
    return ends / d if d != o else like(h, np.inf)


@law
def hit_hollow_block(table: Any, at: int, x: Vec, direction: Vec, clearance: float) -> float:
    """Return the distance along a unit `direction` at which a body of radius `clearance` touches it, m; inf if never.

    It is 0 if the body already overlaps.
    """
    y, d, h = to_block_frame(table, at, x), to_block_frame(table, at, direction), half_edges(table, at, x)
    h0, h1 = h[0] - clearance, h[1] - clearance
    free = (abs(y[0]) <= h0) & (abs(y[1]) <= h1)
    a, b = _exit_distance(y[0], d[0], h0), _exit_distance(y[1], d[1], h1)
    out = a if a < b else b
    if len(x) == 3:
        h2 = h[2] - clearance
        free &= abs(y[2]) <= h2
        c = _exit_distance(y[2], d[2], h2)
        out = c if c < out else out
    return out if free else like(out, 0.0)


@law
def hit_hollow_distance_field(table: Any, at: int, x: Vec, direction: Vec, clearance: float) -> float:
    """Return the distance along a unit `direction` at which a body of radius `clearance` touches it, m; inf if never.

    It is 0 if the body already overlaps. Computed by ray marching as for the solid shape, to a hundredth of the grid's
    spacing.
    """
    grid = table[body_of(at, x) :]
    d = len(x)
    near, longest = grid[d] * like(clearance, 0.01), grid[d] * (grid[d + 1] + grid[d + 2] + grid[2 * d])
    o, most = like(clearance, 0.0), like(clearance, 0.9)
    way, room = o, o
    limit = norm(x) + longest + longest + clearance
    for _ in range(STEPS):
        spot = add(x, scale(direction, way))
        y = on_grid(grid, spot)
        room = -sample(grid, y, 0) - norm(sub(spot, y)) - clearance
        if (room < near) | (way > limit):
            break
        way += room * most
    return way if room < near else like(clearance, np.inf)


# --- piece by piece ---------------------------------------------------------------------------------------------------


@law
def pieces_hollow_chain(table: Any, at: int, x: Vec, gap: float) -> int:
    """Return the number of pieces that act: all sides of a polygon if x is inside, else one."""
    body = body_of(at, x)
    o = like(gap, 0.0)
    return np.int64(table[body]) if (table[body + 2] > o) & (gap >= o) else 1  # type: ignore[return-value]


@law
def piece_hollow_chain(table: Any, at: int, j: int, x: Vec, gap: float, out: Vec) -> tuple[float, Vec, bool]:
    """Return the distance to side j of a room, m, the inward unit normal, and whether the side acts."""
    body = body_of(at, x)
    o = like(gap, 0.0)
    if (table[body + 2] > o) & (gap >= o):
        # inside the room the chain's own distance is negative; passing 0 makes all of its sides act
        return piece_facing(table, at, j, x, o, out, like(gap, -1.0))
    return gap, out, True


@law
def pieces_hollow_block(table: Any, at: int, x: Vec, gap: float) -> int:
    """Return the number of faces that act: all if x is inside, else one."""
    return 2 * len(x) if gap >= like(gap, 0.0) else 1


@law
def piece_hollow_block(table: Any, at: int, j: int, x: Vec, gap: float, out: Vec) -> tuple[float, Vec, bool]:
    """Return the distance to face j of a room, m, and the inward unit normal; every face acts."""
    o, e = like(gap, 0.0), like(gap, 1.0)
    y, h = to_block_frame(table, at, x), half_edges(table, at, x)
    k, sign = j // 2, e if j % 2 == 0 else -e
    depth = h[0] - sign * y[0] if k == 0 else h[1] - sign * y[1]
    if len(x) == 3:
        depth = depth if k < 2 else h[2] - sign * y[2]
    if gap >= o:
        return depth, scale(to_world_frame(table, at, axis(x, k)), -sign), True
    return gap, out, True
