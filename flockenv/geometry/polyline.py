"""Paths: polylines, open or closed, as a table that laws read.

A path is one array: 1 if it is closed, else 0; its length (m); the edges of the torus it lies on (D, m; 0 if there is
none); then for each segment its middle (D, m), its direction (D), half its length (m) and the arc length at its middle
(m). On a torus segments and offsets follow the minimum image convention. `nearest` returns the point of the path
nearest to a position, `spine` the point at an arc length. Both loop over all segments: 100 take 0.2 us.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.geometry.space import Plane, Space
from flockenv.jit.decorators import Vec, kernel, law, like
from flockenv.jit.section import entry
from flockenv.maths.approximations import round_half_even
from flockenv.maths.vectors import add, dot, scale, select, zero

__all__ = [
    "Floats",
    "Table",
    "arc_difference",
    "distance_to_end",
    "nearest",
    "pieces",
    "project",
    "spine",
    "spine_points",
]

Floats = NDArray[np.float64]
Table = Any
"""A 1-D array of numbers, in the precision of the scene."""


def pieces(points: Sequence[Sequence[float]], closed: bool, space: Space | None = None) -> Floats:
    """Return the table of a path through `points` (P, D) m; raise ValueError that names the point if it is invalid."""
    at = np.asarray(points, np.float64)
    least = 3 if closed else 2
    if at.ndim != 2 or len(at) < least:
        raise ValueError(f"points: a {'closed' if closed else 'open'} path needs at least {least}")
    if not np.isfinite(at).all():
        raise ValueError("points: must be finite")
    space = space or Plane()
    to = np.roll(at, -1, axis=0) if closed else at[1:]
    steps = space.displacement(at if closed else at[:-1], to)
    length = np.linalg.norm(steps, axis=1)
    if not length.all():
        k = int(np.argmin(length)) + 1
        raise ValueError(f"points[{k % len(at)}] = {tuple(at[k % len(at)].tolist())}: is where the point before it is")
    ends = np.cumsum(length)
    begin = at if closed else at[:-1]
    edges = space.extent(at.shape[1]) if space.periodic else (0.0,) * at.shape[1]
    rows = np.column_stack([begin + steps / 2, steps / length[:, None], length / 2, ends - length / 2])
    return np.concatenate([[float(closed), ends[-1], *edges], rows.ravel()])


@law
def _nearest_image(table: Table, d: Vec, k: int) -> float:
    """Return coordinate k, d, of an offset: that of the nearest image if the path lies on a torus."""
    edge = table[2 + k]
    around = like(edge, 1.0) / edge if edge > like(edge, 0.0) else like(edge, 0.0)
    return d[k] - edge * round_half_even(d[k] * around)  # type: ignore[no-any-return]


@law
def _middle(table: Table, x: Vec, at: int) -> Vec:
    """Return the offset from x to the middle of the segment whose numbers begin at `at`."""
    if len(x) == 2:
        d = (table[at] - x[0], table[at + 1] - x[1])
        return (_nearest_image(table, d, 0), _nearest_image(table, d, 1))
    else:
        d3 = (table[at] - x[0], table[at + 1] - x[1], table[at + 2] - x[2])
        return (_nearest_image(table, d3, 0), _nearest_image(table, d3, 1), _nearest_image(table, d3, 2))


@law
def _direction(table: Table, x: Vec, at: int) -> Vec:
    if len(x) == 2:
        return (table[at + 2], table[at + 3])
    else:
        return (table[at + 3], table[at + 4], table[at + 5])


@law
def _clamp(s: float, half: float) -> float:
    return -half if s < -half else (half if s > half else s)


@law
def _without_first(found: Vec) -> Vec:
    """Return the vector without its first number."""
    if len(found) == 4:
        return (found[1], found[2], found[3])
    else:
        return (found[1], found[2], found[3], found[4])


@law
def nearest(table: Table, x: Vec) -> Vec:
    """Return the arc length of the path's point nearest to x, m, and the offset to it: (s, dx, dy[, dz]).

    Of several points that are equally near, it is the first along the path.
    """
    d = len(x)
    head, size = 2 + d, 2 * d + 2
    o = like(table[0], 0.0)
    best = (like(o, np.inf), o) + zero(x)  # noqa: RUF005  # numba joins tuples, but does not unpack them
    for k in range((len(table) - head) // size):
        at = head + k * size
        to, u = _middle(table, x, at), _direction(table, x, at)
        s = _clamp(-dot(to, u), table[at + size - 2])
        offset = add(to, scale(u, s))
        found = (dot(offset, offset), table[at + size - 1] + s) + offset  # noqa: RUF005
        best = select(found[0] < best[0], found, best)
    return _without_first(best)


@law
def spine(table: Table, x: Vec, s: float) -> Vec:
    """Return the offset from x to the point at arc length s, m; s is clamped if the path is open, wrapped if closed."""
    d = len(x)
    head, size = 2 + d, 2 * d + 2
    o, length = like(table[0], 0.0), table[1]
    s = s - length * np.floor(s / length) if table[0] > o else s
    best = (like(o, np.inf),) + zero(x)  # noqa: RUF005
    for k in range((len(table) - head) // size):
        at = head + k * size
        half, along = table[at + size - 2], s - table[at + size - 1]
        point = add(_middle(table, x, at), scale(_direction(table, x, at), _clamp(along, half)))
        found = (abs(along) - half,) + point  # noqa: RUF005
        best = select(found[0] < best[0], found, best)
    if len(x) == 2:
        return (best[1], best[2])
    else:
        return (best[1], best[2], best[3])


@law
def arc_difference(table: Table, begin: float, end: float) -> float:
    """Return the signed distance along the path from one arc length to another, m; the shorter one if it is closed."""
    s, length = end - begin, table[1]
    round_ = length * np.floor(s / length + like(s, 0.5))
    return s - round_ if table[0] > like(s, 0.0) else s


@law
def distance_to_end(table: Table, s: float, direction: float) -> float:
    """Return the distance to the end of an open path, m; inf if it is closed. direction: > 0 is forward."""
    o = like(s, 0.0)
    left = table[1] - s if direction > o else s
    return like(s, np.inf) if table[0] > o else left


@kernel
def _project(table: Any, points: Any, out: Any) -> None:
    for r in range(points.shape[0]):
        if points.shape[1] == 2:
            found = nearest(table, (points[r, 0], points[r, 1]))
            for k in range(3):
                out[r, k] = found[k]
        else:
            found3 = nearest(table, (points[r, 0], points[r, 1], points[r, 2]))
            for k in range(4):
                out[r, k] = found3[k]


@kernel
def _point(table: Any, s: Any, origin: Any, out: Any) -> None:
    for r in range(s.shape[0]):
        if out.shape[1] == 2:
            found = spine(table, (origin[0], origin[1]), s[r])
            for k in range(2):
                out[r, k] = found[k] + origin[k]
        else:
            found3 = spine(table, (origin[0], origin[1], origin[2]), s[r])
            for k in range(3):
                out[r, k] = found3[k] + origin[k]


def project(table: Floats, points: ArrayLike) -> tuple[Floats, Floats]:
    """Return arc lengths (...) m of the path's nearest points, and offsets to them, (..., D) m, in Python."""
    where = np.asarray(points, np.float64)
    flat = np.ascontiguousarray(where.reshape(-1, where.shape[-1]))
    out = np.empty((len(flat), where.shape[-1] + 1))
    entry(_project)(np.ascontiguousarray(table, np.float64), flat, out)
    return out[:, 0].reshape(where.shape[:-1]), out[:, 1:].reshape(where.shape)


def spine_points(table: Floats, s: ArrayLike, dimension: int) -> Floats:
    """Return the points at arc lengths s, (..., D) m, in Python."""
    lengths = np.asarray(s, np.float64)
    flat, out = np.ascontiguousarray(lengths.reshape(-1)), np.empty((lengths.size, dimension))
    entry(_point)(np.ascontiguousarray(table, np.float64), flat, np.zeros(dimension), out)
    return out.reshape((*lengths.shape, dimension))
