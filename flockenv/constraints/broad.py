"""Who may touch whom within a step: pairs whose bounding balls overlap, found by the common neighbour query.

A ball is around where a body is at the beginning, as wide as the body and as the way that it may go. The grid is as
coarse as the balls of most bodies; the few that go much further than they are wide are compared with everybody.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.kernels import Vec, kernel, law
from flockenv.neighbours import candidates, count_cells
from flockenv.vec import dot, sub

__all__ = ["image", "nearby", "vector", "write"]


@law
def vector(size: Vec, array: Any, i: int) -> Vec:
    """Return row i of an array (N, D); `size` says what D is."""
    if len(size) == 2:
        return (array[i, 0], array[i, 1])
    else:
        return (array[i, 0], array[i, 1], array[i, 2])


@law
def write(array: Any, i: int, x: Vec) -> None:
    """Set row i of an array (N, D)."""
    for k in range(len(x)):
        array[i, k] = x[k]


@law
def _shift(d: float, period: float) -> float:
    return d - period * np.floor(d / period + 0.5) if period > 0.0 else d


@law
def image(period: Vec, d: Vec) -> Vec:
    """Return the shortest of an offset and its images; a period of 0 has none."""
    if len(d) == 2:
        return (_shift(d[0], period[0]), _shift(d[1], period[1]))
    else:
        return (_shift(d[0], period[0]), _shift(d[1], period[1]), _shift(d[2], period[2]))


@kernel
def near(period: Vec, at: Any, radius: Any, reach: Any, i: int, j: int) -> bool:
    """Do the balls of two bodies overlap?"""
    d = image(period, sub(vector(period, at, j), vector(period, at, i)))
    room = radius[i] + radius[j] + reach[i] + reach[j]
    return dot(d, d) <= room * room


@kernel
def _common_reach(living: Any, radius: Any, reach: Any, n: int, many: Any) -> float:
    """Return how far balls reach of those that are no exception, m: four times as far as half of all at most.

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
    return 2.0 ** (k + 1 - 32)


@kernel
def nearby(
    period: Vec, at: Any, living: Any, radius: Any, reach: Any, n: int, grid: Any, order: Any, cell: Any, start: Any,
    offset: Any, bounds: Any, sync: Any, ranges: Any, first: Any, second: Any,
) -> int:  # fmt: skip
    """Write the pairs (first, second) whose balls overlap, the lower number first; return how many there are.

    at (N, D) m; living, radius, reach (N,); `first` and `second` are written as far as they go: more pairs than that
    are counted only. The rest is scratch of the query.
    """
    size, periodic = period, period[0] > 0.0
    common = _common_reach(living, radius, reach, n, grid)
    found, capacity = 0, first.shape[0]
    present = 0
    for i in range(n):  # those that are met by cells; the others are compared with everybody
        usual = living[i] > 0 and radius[i] + reach[i] <= common
        grid[i] = 1 if usual else 0
        present += 1 if usual else 0
    shape = count_cells(
        at.reshape(-1),
        grid,
        0,
        n,
        1,
        0,
        1,
        sync,
        bounds,
        size,
        2.0 * common,
        periodic,
        periodic,
        n,
        cell,
        start,
        offset,
    )
    cells = shape[0] * shape[1] * shape[2]
    if cells == 0:
        k = 0
        for i in range(n):
            if grid[i] > 0:
                order[k] = i
                k += 1
    else:
        for i in range(n):
            if grid[i] > 0:
                order[offset[0, cell[i]]] = i
                offset[0, cell[i]] += 1
    line, spot = 0, 0
    for p in range(present):
        i = order[p]
        if cells == 0:
            ranges[0, 0], ranges[0, 1], count = p + 1, present, 1
        else:
            while start[(line + 1) * shape[0]] <= p:
                line += 1
            count, spot = candidates(p, p + 1, line, max(spot, line * shape[0]), shape, start, periodic, ranges)
        for r in range(count):
            for q in range(ranges[r, 0], ranges[r, 1]):
                j = order[q]
                if (cells == 0 or j > i) and near(period, at, radius, reach, i, j):
                    if found < capacity:
                        first[found], second[found] = min(i, j), max(i, j)
                    found += 1
    for i in range(n):
        if living[i] > 0 and grid[i] == 0:
            for j in range(n):
                if living[j] > 0 and j != i and (grid[j] > 0 or j > i) and near(period, at, radius, reach, i, j):
                    if found < capacity:
                        first[found], second[found] = min(i, j), max(i, j)
                    found += 1
    return found
