"""Counts of living agents near a position, by a cell list of one world, for sinks and clearings only.

Effects have a query of their own, over blocks of SIMD lanes, before a step. This one runs at the end of a step, for any
positions, and most scenes do not use it.
"""

from __future__ import annotations

import math
from typing import Any

from flockenv.jit.decorators import kernel

__all__ = ["count_near", "sort_living"]


@kernel
def _wrap(p: float, size: float) -> float:
    """Return a coordinate wrapped into [0, size); unchanged if size is 0, for an axis that is not periodic."""
    return p - size * math.floor(p / size) if size > 0.0 else p


@kernel
def _bounds(x: Any, alive: Any, b: int, first: int, end: int, period: Any, grid: Any) -> None:
    """Write the lower corner of living agents of slots [first, end), grid[0], and their extent, grid[1]; (4, 3)."""
    for k in range(x.shape[0]):
        low, high = math.inf, -math.inf
        for i in range(first, end):
            if alive[b, i]:
                p = float(x[k, b, i])
                low, high = min(low, p), max(high, p)
        grid[0, k] = low if low <= high else 0.0
        grid[1, k] = high - low if low <= high else 0.0
        if period[k] > 0.0:
            grid[0, k], grid[1, k] = 0.0, period[k]


@kernel
def _divide_cells(d: int, reach: float, most: int, grid: Any) -> int:
    """Write the number of cells per axis, grid[2], each at least `reach` wide; return their number, at most `most`."""
    for k in range(3):
        grid[2, k] = 1.0
    for k in range(d):
        grid[2, k] = min(max(1.0, math.floor(grid[1, k] / (reach * 1.001))), 1e6)
    while grid[2, 0] * grid[2, 1] * grid[2, 2] > most:
        widest = 0
        for k in range(1, d):
            widest = k if grid[2, k] > grid[2, widest] else widest
        grid[2, widest] = math.floor((grid[2, widest] + 1.0) / 2.0)
    for k in range(3):
        grid[3, k] = grid[2, k] / grid[1, k] if k < d and grid[1, k] > 0.0 else 0.0
    return int(grid[2, 0] * grid[2, 1] * grid[2, 2])


@kernel
def _cell_along(p: float, k: int, grid: Any) -> int:
    """Return the index of the cell along an axis that holds coordinate p."""
    c: int = math.floor((p - grid[0, k]) * grid[3, k])
    return min(max(c, 0), int(grid[2, k]) - 1)


@kernel
def sort_living(
    x: Any, alive: Any, b: int, first: int, end: int, reach: float, period: Any, grid: Any, cell: Any, start: Any,
    order: Any,
) -> None:  # fmt: skip
    """List living agents of slots [first, end) by cell; cells are at least `reach` [m] wide.

    period (3,): m, 0 for axes that are not periodic. Writes grid (4, 3): corner, edges, cells, cells per metre; order
    (N,): their slots; start (N + 1,): the first of each cell. cell (N,) is scratch memory.
    """
    d = x.shape[0]
    _bounds(x, alive, b, first, end, period, grid)
    cells = _divide_cells(d, reach, max(end - first, 1), grid)
    for c in range(cells + 1):
        start[c] = 0
    for i in range(first, end):
        cell[i] = -1
        if alive[b, i]:
            c = 0
            for j in range(d):
                k = d - 1 - j
                c = c * int(grid[2, k]) + _cell_along(_wrap(float(x[k, b, i]), period[k]), k, grid)
            cell[i] = c
            start[c + 1] += 1
    for c in range(cells):
        start[c + 1] += start[c]
    for j in range(end - first):  # backwards: `start` of each cell is decremented to its beginning
        i = end - 1 - j
        if cell[i] >= 0:
            start[cell[i] + 1] -= 1
            order[start[cell[i] + 1]] = i
    # start[c + 1] is now the first of cell c
    for c in range(cells):
        start[c] = start[c + 1]
    total = 0
    for i in range(first, end):
        total += 1 if cell[i] >= 0 else 0
    start[cells] = total


@kernel
def _neighbour_cell(c: int, turn: int, count: int, periodic: bool) -> int:
    """Return cell c - 1, c or c + 1 along an axis, for `turn` 0, 1 or 2; -1 if there is none."""
    if periodic:
        if turn >= count:  # each of one or two cells is visited once
            return -1
        return (c + turn - (1 if count > 2 else 0)) % count
    c += turn - 1
    return c if 0 <= c < count else -1


@kernel
def count_near(
    x: Any, b: int, place: Any, reach: float, most: int, period: Any, grid: Any, start: Any, order: Any, born: Any,
    identity: Any, elder_than: int,
) -> int:  # fmt: skip
    """Return the number of listed agents within `reach` of a position (3,), m; counting stops at `most` + 1.

    elder_than: a slot, to count only agents born before its agent (of two born at the same time, the one of lower
    identity is the elder); -1 = all.
    """
    d, found = x.shape[0], 0
    nx, ny, nz = int(grid[2, 0]), int(grid[2, 1]), int(grid[2, 2])
    cx = math.floor((_wrap(place[0], period[0]) - grid[0, 0]) * grid[3, 0])
    cy = math.floor((_wrap(place[1], period[1]) - grid[0, 1]) * grid[3, 1])
    cz = math.floor((_wrap(place[2], period[2]) - grid[0, 2]) * grid[3, 2]) if d == 3 else 0
    for tz in range(3):
        z = _neighbour_cell(cz, tz, nz, period[2] > 0.0) if d == 3 else (0 if tz == 0 else -1)
        for ty in range(3):
            y = _neighbour_cell(cy, ty, ny, period[1] > 0.0)
            for tx in range(3):
                x_ = _neighbour_cell(cx, tx, nx, period[0] > 0.0)
                if x_ < 0 or y < 0 or z < 0:
                    continue
                c = (z * ny + y) * nx + x_
                for at in range(start[c], start[c + 1]):
                    i = order[at]
                    square = 0.0
                    for k in range(d):
                        offset = float(x[k, b, i]) - place[k]
                        offset -= period[k] * math.floor(offset / period[k] + 0.5) if period[k] > 0.0 else 0.0
                        square += offset * offset
                    if square > reach * reach:
                        continue
                    if elder_than >= 0:
                        older = born[b, i] < born[b, elder_than] or (
                            born[b, i] == born[b, elder_than] and identity[b, i] < identity[b, elder_than]
                        )
                        if not older:
                            continue
                    found += 1
                    if found > most:
                        return found
    return found
