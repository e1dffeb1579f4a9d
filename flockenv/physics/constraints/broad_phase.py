"""Pairs that may touch within a step: their bounding balls overlap, found by the common neighbour query.

A ball is centred at the start of the step; its radius is that of the body plus the distance that it may move. The cell
size is that of the balls of most bodies; the few with much larger balls are compared with all bodies.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.cell_list import candidates, count_cells, row_of
from flockenv.jit.decorators import Vec, kernel, law
from flockenv.maths.approximations import round_half_even
from flockenv.maths.vectors import dot, sub

__all__ = [
    "balls_overlap",
    "displacement_near",
    "list_near_pairs",
    "load_vector",
    "nearest_image",
    "vector_at",
    "write_vector",
]


@law
def vector_at(size: Vec, array: Any, i: int) -> Vec:
    """Return row i of an array (N, D); D is the length of `size`."""
    if len(size) == 2:
        return (array[i, 0], array[i, 1])
    else:
        return (array[i, 0], array[i, 1], array[i, 2])


@law
def write_vector(array: Any, i: int, x: Vec) -> None:
    """Set row i of an array (N, D)."""
    for k in range(len(x)):
        array[i, k] = x[k]


@kernel
def load_vector(size: Vec, array: Any, b: int, i: int) -> Vec:
    """Return the vector of agent i of world b in an array (D, B, N), in double precision; D is the length of `size`."""
    if len(size) == 2:
        return (np.float64(array[0, b, i]), np.float64(array[1, b, i]))
    else:
        return (np.float64(array[0, b, i]), np.float64(array[1, b, i]), np.float64(array[2, b, i]))


@law
def _shift(d: float, period: float) -> float:
    return d - period * round_half_even(d / period) if period > 0.0 else d


@law
def nearest_image(period: Vec, d: Vec) -> Vec:
    """Return the shortest periodic image of an offset; a period of 0 has no images."""
    if len(d) == 2:
        return (_shift(d[0], period[0]), _shift(d[1], period[1]))
    else:
        return (_shift(d[0], period[0]), _shift(d[1], period[1]), _shift(d[2], period[2]))


@law
def displacement_near(period: Vec, apart: Vec, guess: Vec) -> Vec:
    """Return the displacement of a step whose ends are `apart`: the periodic image nearest to a guess."""
    off = sub(apart, guess)
    return sub(apart, sub(off, nearest_image(period, off)))


@kernel
def balls_overlap(period: Vec, at: Any, radius: Any, reach: Any, i: int, j: int) -> bool:
    """Return True if the balls of two bodies overlap."""
    d = nearest_image(period, sub(vector_at(period, at, j), vector_at(period, at, i)))
    room = radius[i] + radius[j] + reach[i] + reach[j]
    return bool(dot(d, d) <= room * room)


@kernel
def _common_reach(living: Any, radius: Any, reach: Any, n: int, many: Any) -> float:
    """Return the largest ball radius without outliers, m: the largest within the power of two that covers 98 %.

    many: scratch (>= 64,), a histogram over powers of two.
    """
    for k in range(64):
        many[k] = 0
    present = 0
    for i in range(n):
        if living[i] > 0:
            ball = radius[i] + reach[i]
            many[min(max(np.int64(np.log2(max(ball, 1e-9))) + 32, 0), 63)] += 1
            present += 1
    k, seen = 0, 0
    while k < 63 and seen + many[k] < 0.98 * present:
        seen += many[k]
        k += 1
    limit, widest = 2.0 ** (k + 1 - 32), 0.0
    for i in range(n):
        ball = radius[i] + reach[i]
        widest = max(widest, ball if living[i] > 0 and ball <= limit else 0.0)
    return 1.000001 * widest if widest > 0.0 else limit  # cells as small as possible


@kernel
def list_near_pairs(
    period: Vec, at: Any, living: Any, radius: Any, reach: Any, n: int, grid: Any, order: Any, cell: Any, start: Any,
    offset: Any, bounds: Any, sync: Any, ranges: Any, first: Any, second: Any,
) -> int:  # fmt: skip
    """Write the pairs (first, second) whose balls overlap, the lower number first; return how many there are.

    at (N, D) m; living, radius, reach (N,). Pairs beyond the capacity of `first` and `second` are counted but not
    written. The other arrays are scratch memory of the query.
    """
    periodic = period[0] > 0.0
    common = _common_reach(living, radius, reach, n, grid)
    present = _mark(living, radius, reach, n, common, grid)
    shape = count_cells(
        at.reshape(-1), grid, 0, n, 1, 0, 1, sync, bounds, period, 2.0 * common, periodic, periodic, n, cell, start,
        offset,
    )  # fmt: skip
    cells = shape[0] * shape[1] * shape[2]
    _arrange(grid, cell, offset, n, cells, order)
    found, line, spot, count = 0, 0, 0, 1
    for p in range(present):
        if cells == 0:
            ranges[0, 0], ranges[0, 1] = p + 1, present
        else:
            line = row_of(p, start, line, shape[0])
            count, spot = candidates(p, p + 1, line, max(spot, line * shape[0]), shape, start, periodic, ranges)
        for r in range(count):
            for q in range(ranges[r, 0], ranges[r, 1]):
                if cells == 0 or order[q] > order[p]:
                    found = _write_pair(period, at, radius, reach, order[p], order[q], found, first, second)
    for i in range(n):
        if living[i] > 0 and grid[i] == 0:
            for j in range(n):
                if living[j] > 0 and j != i and (grid[j] > 0 or j > i):
                    found = _write_pair(period, at, radius, reach, i, j, found, first, second)
    return found


@kernel
def _mark(living: Any, radius: Any, reach: Any, n: int, common: float, grid: Any) -> int:
    """Mark the bodies for the cell list (the others are compared with all bodies); return their number."""
    present = 0
    for i in range(n):
        grid[i] = 1 if living[i] > 0 and radius[i] + reach[i] <= common else 0
        present += grid[i]
    return present


@kernel
def _arrange(grid: Any, cell: Any, offset: Any, n: int, cells: int, order: Any) -> None:
    """List the marked bodies in the order of their cells; by number if there are no cells."""
    at = 0
    for i in range(n):
        if grid[i] > 0:
            to = at
            if cells > 0:
                to = offset[0, cell[i]]
                offset[0, cell[i]] += 1
            order[to] = i
            at += 1


@kernel
def _write_pair(
    period: Vec, at: Any, radius: Any, reach: Any, i: int, j: int, found: int, first: Any, second: Any
) -> int:
    """Count a pair if its balls overlap, and write it if there is room; return the number of pairs."""
    if not balls_overlap(period, at, radius, reach, i, j):
        return found
    if found < first.shape[0]:
        first[found], second[found] = min(i, j), max(i, j)
    return found + 1
