"""Interpolation on a regular grid: fields of velocities, distances and potentials.

A grid is one array (a table), which can be passed to a law: the lowest corner (D, m), the spacing (m), the number
of points along each axis (D), the number of values per point (K), then these values, the last axis fastest. `pack_grid`
builds a table from an array; the laws read it at any position. Unless stated otherwise, a position outside the grid is
clamped to the nearest point on its edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.jit.decorators import Vec, kernel, law, like
from flockenv.jit.section import entry

__all__ = [
    "MOST_POINTS",
    "Floats",
    "Table",
    "covers",
    "pack_grid",
    "points_of",
    "sample",
    "sample_points",
    "sample_vector",
]

Floats = NDArray[np.float64]
Table = Any
"""One axis of numbers, in the precision of the scene."""
MOST_POINTS = 2**22
"""Most points of a grid in a scene: with a distance and a direction each, 100 MB in 2-D."""


def pack_grid(values: ArrayLike, low: Sequence[float], spacing: float) -> Floats:
    """Return the table of `values` (nx, ny[, nz], K) at low + spacing (i, j[, k]); ValueError if they form no grid."""
    array = np.asarray(values, np.float64)
    d = len(low)
    if array.ndim != d + 1:
        raise ValueError(f"values: shape {array.shape}, must have {d} axes of points, then one of numbers")
    if min(array.shape[:d]) < 2 or array.shape[d] < 1:
        raise ValueError(
            f"values: shape {array.shape}, must have at least 2 points along each axis, and a number for each point"
        )
    if not spacing > 0:
        raise ValueError(f"spacing = {spacing:g}, must be positive")
    if not np.isfinite(array).all():
        raise ValueError("values: must be finite")
    header = [*low, spacing, *array.shape[:d], array.shape[d]]
    return np.concatenate([np.array(header, np.float64), array.ravel()])


def points_of(low: Sequence[float], spacing: float, counts: Sequence[int]) -> Floats:
    """Return the positions of a grid's points, (nx, ny[, nz], D) m."""
    axes = [low[k] + spacing * np.arange(counts[k]) for k in range(len(low))]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


@law
def _cell_along(table: Table, x: float, d: int, k: int) -> tuple[Any, float]:
    """Return the cell that contains x along axis k, and the position in it from 0 (lower edge) to 1 (upper)."""
    o, e = like(x, 0.0), like(x, 1.0)
    last = table[d + 1 + k] - e
    at = (x - table[k]) / table[d]
    at = at if at > o else o  # NaN also becomes 0
    at = at if at < last else last
    cell = np.int64(at)
    most = np.int64(last) - 1
    cell = cell if cell < most else most
    return cell, at - like(x, cell)  # type: ignore[arg-type,operator]  # an integer that `like` converts to float


@law
def sample(table: Table, x: Vec, k: int) -> float:
    """Return value k of a grid at x, interpolated linearly along each axis (bilinear, trilinear)."""
    e = like(x[0], 1.0)
    if len(x) == 2:
        i, a = _cell_along(table, x[0], 2, 0)
        j, b = _cell_along(table, x[1], 2, 1)
        step = np.int64(table[5])
        row = np.int64(table[4]) * step
        at = 6 + i * row + j * step + k
        low = table[at] * (e - b) + table[at + step] * b
        return low * (e - a) + (table[at + row] * (e - b) + table[at + row + step] * b) * a  # type: ignore[no-any-return]
    else:
        i, a = _cell_along(table, x[0], 3, 0)
        j, b = _cell_along(table, x[1], 3, 1)
        m, c = _cell_along(table, x[2], 3, 2)
        step = np.int64(table[7])
        row = np.int64(table[6]) * step
        slab = np.int64(table[5]) * row
        at = 8 + i * slab + j * row + m * step + k
        up = at + slab
        low = (table[at] * (e - c) + table[at + step] * c) * (e - b)
        low += (table[at + row] * (e - c) + table[at + row + step] * c) * b
        high = (table[up] * (e - c) + table[up + step] * c) * (e - b)
        high += (table[up + row] * (e - c) + table[up + row + step] * c) * b
        return low * (e - a) + high * a  # type: ignore[no-any-return]


@law
def sample_vector(table: Table, x: Vec, k: int) -> Vec:
    """Return the vector of the D values from k on of a grid at x."""
    if len(x) == 2:
        return (sample(table, x, k), sample(table, x, k + 1))
    else:
        return (sample(table, x, k), sample(table, x, k + 1), sample(table, x, k + 2))


@law
def _covers_axis(table: Table, x: float, d: int, k: int) -> bool:
    return (x >= table[k]) & (x <= table[k] + table[d] * (table[d + 1 + k] - like(x, 1.0)))  # type: ignore[no-any-return]


@law
def covers(table: Table, x: Vec) -> bool:
    """Return True if x is inside the grid, its edge included; False if x is NaN."""
    if len(x) == 2:
        return _covers_axis(table, x[0], 2, 0) & _covers_axis(table, x[1], 2, 1)
    else:
        return _covers_axis(table, x[0], 3, 0) & _covers_axis(table, x[1], 3, 1) & _covers_axis(table, x[2], 3, 2)


@kernel
def _sample_all(table: Any, points: Any, out: Any) -> None:
    """Write every value of a grid at every point; points (R, D), out (R, K)."""
    for r in range(points.shape[0]):
        for k in range(out.shape[1]):
            if points.shape[1] == 2:
                out[r, k] = sample(table, (points[r, 0], points[r, 1]), k)
            else:
                out[r, k] = sample(table, (points[r, 0], points[r, 1], points[r, 2]), k)


def sample_points(table: Floats, points: ArrayLike) -> Floats:
    """Return the values (..., K) of a grid at points (..., D); for Python, not for laws."""
    where = np.ascontiguousarray(points, np.float64)
    d = where.shape[-1]
    flat = where.reshape(-1, d)
    out = np.empty((len(flat), int(table[2 * d + 1])))
    entry(_sample_all)(np.ascontiguousarray(table, np.float64), flat, out)
    return out.reshape((*where.shape[:-1], -1))
