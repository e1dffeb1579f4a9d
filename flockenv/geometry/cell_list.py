"""Cell list: one neighbour query per evaluation of forces, at the largest interaction range of all pair forces.

A query sorts the living agents by cell if that is faster, and returns contiguous ranges of sorted candidates. No
neighbour list is built: the pair loop tests every candidate of a range against the interaction range. Brute force is
the query with one range. Several threads may share one query: each counts and places its own agents, and the resulting
order (by cell, then by agent number) does not depend on the number of threads.

In an unbounded space the cells divide the bounding box of the agents. One agent far away enlarges the cells until all
others share one. In that case the cells are folded: they are as wide as the reach, there are infinitely many, and they
share a fixed number of slots in memory, like the cells of a torus (`_folded_shape`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.space import torus_confine
from flockenv.jit.decorators import kernel
from flockenv.jit.intrinsics import prefetch_for_write, wait_for_team

__all__ = [
    "AHEAD", "DISTANT", "FEWEST_AGENTS", "FEWEST_ARRANGED", "FINEST", "MAX_RANGES", "STEPS_ARRANGED",
    "WORTH_ARRANGING", "begin_cells", "candidates", "cell_of", "count_cells", "divide_region", "grid_of",
    "order_records", "row_of", "tally_cells",
]  # fmt: skip

MAX_RANGES = 27
"""Most ranges of one query: 9 rows of cells in 3-D, each in three pieces if it wraps around twice."""

FEWEST_AGENTS = 96
"""Number of agents from which sorting saves more time than it takes."""

WORTH_ARRANGING = 2**14
"""Number of agents from which a call of several steps sorts them in memory first; fewer fit into the L1/L2 cache."""

FEWEST_ARRANGED = 2**12
"""The same for a team of threads, which with unsorted agents write to the same cache lines (false sharing)."""

STEPS_ARRANGED = 5
"""Least number of steps of a call for which sorting agents in memory saves time."""

DISTANT = 2**13
"""Number of agents from which records are prefetched; fewer fit into the L1/L2 cache."""

AHEAD = 48
"""Prefetch distance, in records; 16 to 64 make no difference."""

FINEST = 3
"""Most cells along x that a reach spans; small cells leave few candidates out of reach."""

CROWDED = 8
"""Cells are folded if more agents than this share one, in the mean over agents (2 if evenly distributed)."""

FOLDED_ROWS = 4
"""Rows of folded cells along each further axis: at least 3, so that a row and its two neighbours are distinct."""

_FARTHEST = 2.0**40  # cells from the origin: up to there rounding is less than the margin, and int64 suffices

_MARGIN = 1.001  # cells are this much wider than the reach, so that rounding never hides a neighbour

Ints = NDArray[np.int32]


@kernel
def _fit(cells: Any, count: int) -> tuple[int, int, int]:
    """Return the number of cells per axis, reduced to at most `count` in all: wider cells are also correct."""
    nx, ny, nz = cells
    total = float(nx) * float(ny) * float(nz)
    if total > count:
        dimension = 1.0 + (1.0 if ny > 1 else 0.0) + (1.0 if nz > 1 else 0.0)
        shrink = (count / total) ** (1.0 / dimension)
        nx, ny, nz = max(1, int(nx * shrink)), max(1, int(ny * shrink)), max(1, int(nz * shrink))
    while nx * ny * nz > count:  # an axis of one cell cannot shrink (e.g. agents in a line): shrink the longest
        if nx >= ny and nx >= nz:
            nx = max(1, count // (ny * nz))
        elif ny >= nz:
            ny = max(1, count // (nx * nz))
        else:
            nz = max(1, count // (nx * ny))
    return nx, ny, nz


@kernel
def _cells_along(length: float, reach: float) -> int:
    return int(min(max(1.0, length / (reach * _MARGIN)), 2.0**20))  # bounded first: 1e100 would overflow an integer


@kernel
def grid_of(lengths: Any, count: int, reach: float, periodic: bool) -> tuple[int, int, int, int, int]:
    """Return cells per axis (nx, ny, nz), at most `count` in all, the cells that a reach spans along x, and 0.

    The last number is 0 as these cells are not folded. All are 0 if brute force is as fast.
    """
    fine, nx, ny, nz = FINEST, _cells_along(lengths[0], reach / FINEST), _cells_along(lengths[1], reach), 1
    if len(lengths) == 3:
        nz = _cells_along(lengths[len(lengths) - 1], reach)
    while fine > 1 and float(nx) * float(ny) * float(nz) > count:
        fine -= 1
        nx = _cells_along(lengths[0], reach / fine)
    nx, ny, nz = _fit((nx, ny, nz), count)
    wide = max(1, nx // fine)
    few = periodic and (
        min(wide, ny) < 3 or (len(lengths) == 3 and nz < 3)
    )  # a row and its image would be the same row
    least = 36 if len(lengths) == 2 else 108
    return (0, 0, 0, 0, 0) if few or wide * ny * nz < least else (nx, ny, nz, fine, 0)


@kernel
def _spread(pos: Any, living: Any, first: int, end: int, lanes: int, d: int, k: int, bounds: Any, rank: int) -> None:
    """Write the least and the greatest coordinate k of the living agents in this thread's blocks."""
    low, high = np.inf, -np.inf
    for b in range(first, end):
        for lane in range(lanes):
            x = np.float64(pos[(b * d + k) * lanes + lane])
            here = living[b * lanes + lane] > 0
            low = x if here and x < low else low
            high = x if here and x > high else high
    bounds[rank, 2 * k], bounds[rank, 2 * k + 1] = low, high


@kernel
def _edge(k: int, team: int, bounds: Any) -> tuple[float, float]:
    """Return the least coordinate of all living agents along axis k, and their extent; (0, 1) if there are none."""
    low, high = np.inf, -np.inf
    for r in range(team):
        low, high = min(low, bounds[r, 2 * k]), max(high, bounds[r, 2 * k + 1])
    return (low, max(high - low, 1e-300)) if low <= high else (0.0, 1.0)


@kernel
def region(
    pos: Any, living: Any, first: int, end: int, lanes: int, rank: int, team: int, sync: Any, bounds: Any, size: Any,
    periodic: bool,
) -> Any:  # fmt: skip
    """Return the corner and the edges of the region to divide: the periodic box, or the agents' bounding box.

    Each thread of a team scans its own blocks [first, end); threads exchange their results through bounds (team, 6).
    """
    d = len(size)
    if not periodic:
        for k in range(d):
            _spread(pos, living, first, end, lanes, d, k, bounds, rank)
        wait_for_team(sync, team)
    if len(size) == 2:
        x, y = _edge(0, team, bounds), _edge(1, team, bounds)
        if periodic:
            x, y = (0.0, np.float64(size[0])), (0.0, np.float64(size[1]))
        return (x[0], y[0]), (x[1], y[1])
    else:
        x, y, z = _edge(0, team, bounds), _edge(1, team, bounds), _edge(2, team, bounds)
        if periodic:
            x, y, z = (0.0, np.float64(size[0])), (0.0, np.float64(size[1])), (0.0, np.float64(size[2]))
        return (x[0], y[0], z[0]), (x[1], y[1], z[1])


@kernel
def _part(x: float, low: float, pace: float, count: int) -> Any:
    """Return the index of the cell that contains x, of `count` along an axis; 0 for NaN. pace: cells per metre."""
    return min(max(np.int64((np.float64(x) - low) * pace), np.int64(0)), np.int64(count - 1))


@kernel
def divide_region(
    pos: Any, living: Any, first: int, end: int, lanes: int, rank: int, team: int, sync: Any, bounds: Any, size: Any,
    reach: float, periodic: bool, capacity: int,
) -> tuple[tuple[int, int, int, int, int], Any, Any]:  # fmt: skip
    """Return the cells as `grid_of` does, the corner of the divided region, and cells per metre along each axis."""
    low, lengths = region(pos, living, first, end, lanes, rank, team, sync, bounds, size, periodic)
    shape = grid_of(lengths, capacity, reach, periodic)
    if len(size) == 2:
        return shape, low, (shape[0] / lengths[0], shape[1] / lengths[1])
    else:
        return shape, low, (shape[0] / lengths[0], shape[1] / lengths[1], shape[2] / lengths[len(size) - 1])


@kernel
def cell_of(pos: Any, at: Any, lanes: Any, low: Any, pace: Any, size: Any, wraps: bool, shape: Any) -> tuple[Any, ...]:
    """Return the cell, along three axes, of the agent whose coordinates begin at `at`, `lanes` apart."""
    if len(size) == 2:
        x: Any = (pos[at], pos[at + lanes])
    else:
        x = (pos[at], pos[at + lanes], pos[at + lanes + lanes])
    if wraps:  # the cell must be that of the wrapped position: -1e-17 becomes 0, not a position in the last cell
        x, _ = torus_confine(size, size[0], x, x)
    if len(size) == 2:
        third: Any = np.int64(0)
    else:
        third = _part(x[len(size) - 1], low[len(size) - 1], pace[len(size) - 1], shape[2])
    return _part(x[0], low[0], pace[0], shape[0]), _part(x[1], low[1], pace[1], shape[1]), third


@kernel
def _find_cells(
    pos: Any, living: Any, first: int, end: int, lanes: int, low: Any, pace: Any, size: Any, wraps: bool, shape: Any,
    cell: Ints,
) -> None:  # fmt: skip
    """Write the cell of every agent of these blocks, vectorized over lanes; -1 for the dead."""
    d, w = np.uint64(len(size)), np.uint64(lanes)
    for block in range(np.uint64(first), np.uint64(end)):
        for l in range(w):  # noqa: E741  # a lane
            x, y, z = cell_of(pos, block * d * w + l, w, low, pace, size, wraps, shape)
            index = (z * shape[1] + y) * shape[0] + x
            cell[block * w + l] = np.int32(index) if living[block * w + l] > 0 else np.int32(-1)


@kernel
def count_cells(
    pos: Any, living: Any, first: int, end: int, lanes: int, rank: int, team: int, sync: Any, bounds: Any, size: Any,
    reach: float, periodic: bool, wraps: bool, capacity: int, cell: Ints, start: Ints, offset: Ints,
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Compute each agent's cell, and each cell's beginning in sorted order; return the cells as `grid_of` does.

    pos: blocks of (D, lanes) m, wrapped into the periodic box first if `wraps`; living (agents, padded) 0 or 1;
    [first, end): this thread's blocks; capacity: most cells.
    Writes cell (agents, padded), -1 for the dead; start (capacity + 1,): first sorted agent of each cell;
    offset (team, capacity): where this thread puts its next agent of each cell. Returns zeros for brute force.
    """
    shape, low, pace = divide_region(
        pos, living, first, end, lanes, rank, team, sync, bounds, size, reach, periodic, capacity
    )
    cells = shape[0] * shape[1] * shape[2]
    if cells == 0:
        return shape
    _find_cells(pos, living, first, end, lanes, low, pace, size, wraps, shape, cell)
    tally_cells(cell, first * lanes, end * lanes, rank, cells, offset)
    begin_cells(rank, team, sync, cells, start, offset)
    if periodic or not is_crowded(shape, pace, reach, start):
        return shape
    return count_folded(pos, living, first, end, lanes, rank, team, sync, size, reach, capacity, cell, start, offset)


@kernel
def is_crowded(shape: Any, pace: Any, reach: float, start: Ints) -> bool:
    """Return True if cells are much wider than the reach and many agents share one; pace: cells per metre per axis."""
    stretched = 1.0
    for k in range(len(pace)):
        stretched *= max(1.0, 1.0 / (pace[k] * reach))
    if stretched < 2.0:
        return False
    cells = np.uint64(shape[0] * shape[1] * shape[2])
    shared = 0.0
    for c in range(cells):
        here = np.float64(start[c + np.uint64(1)] - start[c])
        shared += here * here
    return bool(shared > CROWDED * np.float64(start[cells]))


@kernel
def _folded_shape(capacity: int, d: int) -> tuple[int, int, int, int, int]:
    """Return the shape of folded cells, at most `capacity` in all; its last number is more than 0.

    The cell (x, y, z) of an infinite lattice lies in row (y mod ny, z mod nz), at x + fold (y div ny) + twist (z div
    nz) modulo nx. So the neighbours of a cell are found as if every cell had a slot of its own; other agents in the
    same slots are out of reach. The shifts are irrational fractions of a row (the golden ratio; in 3-D, powers of the
    plastic number), so that a flock of any outline covers the slots evenly.
    """
    nz = FOLDED_ROWS if d == 3 else 1
    nx = max(1, capacity // (FOLDED_ROWS * nz))
    return nx, FOLDED_ROWS, nz, 1, max(1, int(nx * (0.5698402909980532 if d == 3 else 0.6180339887498949)))


@kernel
def _twist(shape: Any) -> Any:
    """Return the shift of a row, in cells, per turn along the third axis."""
    return np.int64(shape[0] * 0.7548776662466927)


@kernel
def _lattice(x: float, pace: float) -> Any:
    """Return the index of the cell of an infinite lattice that contains a coordinate."""
    return np.int64(math.floor(min(max(np.float64(x) * pace, -_FARTHEST), _FARTHEST)))


@kernel
def count_folded(
    pos: Any, living: Any, first: int, end: int, lanes: int, rank: int, team: int, sync: Any, size: Any, reach: float,
    capacity: int, cell: Ints, start: Ints, offset: Ints,
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Do the same as `count_cells`, with folded cells."""
    d, w, pace = np.uint64(len(size)), np.uint64(lanes), 1.0 / (reach * _MARGIN)
    shape = _folded_shape(capacity, len(size))
    for block in range(np.uint64(first), np.uint64(end)):
        for l in range(w):  # noqa: E741  # a lane
            at = block * d * w + l
            x, y, z = _lattice(pos[at], pace), _lattice(pos[at + w], pace), np.int64(0)
            if len(size) == 3:
                z = _lattice(pos[at + w + w], pace)
            row, deep = y % shape[1], z % shape[2]
            turns, layers = (
                ((y - row) // shape[1]) % shape[0],
                ((z - deep) // shape[2]) % shape[0],
            )  # products stay small
            x = (x + shape[4] * turns + _twist(shape) * layers) % shape[0]
            index = (deep * shape[1] + row) * shape[0] + x
            cell[block * w + l] = np.int32(index) if living[block * w + l] > 0 else np.int32(-1)
    cells = shape[0] * shape[1] * shape[2]
    tally_cells(cell, first * lanes, end * lanes, rank, cells, offset)
    begin_cells(rank, team, sync, cells, start, offset)
    return shape


@kernel
def tally_cells(cell: Ints, first: int, end: int, rank: int, cells: int, offset: Ints) -> None:
    """Write the number of agents of [first, end) in each cell."""
    for c in range(cells):
        offset[rank, c] = 0
    for i in range(first, end):
        c = cell[i]
        if c >= 0:
            offset[rank, c] += 1


@kernel
def begin_cells(rank: int, team: int, sync: Any, cells: int, start: Ints, offset: Ints) -> None:
    """Write the beginning of each cell in sorted order, and in `offset`, which holds counts, of each thread's part.

    This is a prefix sum. All threads of a team call it and one computes, between two barriers.
    """
    wait_for_team(sync, team)
    if rank == 0:
        total = np.int32(0)
        for c in range(np.uint64(cells)):
            start[c] = total
            here = offset[0, c]
            offset[0, c] = total
            total += here
            for r in range(1, team):
                here = offset[r, c]
                offset[r, c] = total
                total += here
        start[cells] = total
    wait_for_team(sync, team)


@kernel
def _key(records: Any, cell: Ints, ident: Any, at: Any) -> Any:
    """Return one integer that orders records by cell, then by agent number; the record begins at `at`."""
    place = np.uint64(records[at])
    return np.int64(cell[place]) * np.int64(2**32) + np.int64(ident[place])


@kernel
def order_records(
    records: Any, cell: Ints, ident: Any, length: int, first: int, end: int, late: Ints
) -> None:  # fmt: skip
    """Sort the records [first, end), already in the order of their cells, by agent number within each cell.

    Records have `length` numbers and begin with their place; cell and ident hold cells and agent numbers by place. Most
    records are in order. The others are first collected in `late` (scratch), without a branch, which would be
    mispredicted often. Records are prefetched AHEAD of use, as they have left the nearest caches since they were
    written.
    """
    if first >= end:
        return
    size, count, last = np.uint64(length), np.uint64(0), np.uint64(end)
    before = _key(records, cell, ident, np.uint64(first) * size)
    for k in range(np.uint64(first) + np.uint64(1), last):
        prefetch_for_write(records, (k + np.uint64(AHEAD)) * size)
        key = _key(records, cell, ident, k * size)
        late[count] = np.int32(k)
        count += np.uint64(1) if key < before else np.uint64(0)
        before = key
    for m in range(count):
        _settle(records, cell, ident, size, np.uint64(first), last, np.uint64(late[m]))


@kernel
def _settle(records: Any, cell: Ints, ident: Any, size: Any, first: Any, end: Any, k: Any) -> None:
    """Move record k back to its place in order, then those after it, until one is in order."""
    later = _key(records, cell, ident, k * size - size) > _key(records, cell, ident, k * size)
    while later:
        at = k * size
        key = _key(records, cell, ident, at)
        while later:
            for m in range(at, at + size):
                records[m - size], records[m] = records[m], records[m - size]
            at -= size
            later = at > first * size and _key(records, cell, ident, at - size) > key
        k += np.uint64(1)
        later = k < end and _key(records, cell, ident, k * size - size) > _key(records, cell, ident, k * size)


@kernel
def row_of(first: int, start: Ints, row: int, nx: int) -> int:
    """Return the row of cells that holds sorted agent `first`; the search begins at `row`."""
    while start[(row + 1) * nx] <= first:
        row += 1
    return row


@kernel
def candidates(
    first: int, end: int, row: int, at: int, shape: Any, start: Ints, periodic: bool, ranges: Any
) -> tuple[int, int]:
    """Write the ranges (from, to, wrapped) of sorted agents that are candidates of the block [first, end) of one row.

    `at` is a cell at or before that of `first`; the search begins there. Returns the number of ranges and the cell of
    `first`. A range is `wrapped` if it lies across the edge of a periodic box.
    """
    nx, ny, nz, fine, fold = shape
    while start[at + 1] <= first:
        at += 1
    last = at
    while start[last + 1] < end:
        last += 1
    west, east = at - row * nx - fine, last - row * nx + fine
    y, z = row % ny, row // ny
    found = 0
    for dz in range(-1 if nz > 1 else 0, 2 if nz > 1 else 1):
        for dy in range(-1, 2):
            yy, zz = y + dy, z + dz
            around = yy < 0 or yy >= ny or zz < 0 or zz >= nz
            if fold > 0:
                shift = fold * (yy // ny) + _twist(shape) * (zz // nz)
                yy, zz, begin = yy % ny, zz % nz, (west + shift) % nx
                found = _row_ranges(
                    (zz * ny + yy) * nx, begin, begin + east - west, nx, start, True, False, ranges, found
                )
                continue
            if periodic:
                yy, zz = (yy + ny) % ny, (zz + nz) % nz
            elif around:
                continue
            found = _row_ranges((zz * ny + yy) * nx, west, east, nx, start, periodic, around, ranges, found)
    return found, at


@kernel
def _row_ranges(
    base: int, west: int, east: int, nx: int, start: Ints, periodic: bool, around: bool, ranges: Any, found: int
) -> int:
    """Add the ranges of one row's cells, `west` to `east`; return the new number of ranges."""
    if not periodic:
        return _add(start[base + max(west, 0)], start[base + min(east, nx - 1) + 1], False, ranges, found)
    if east - west + 1 >= nx:
        return _add(start[base], start[base + nx], True, ranges, found)
    if west < 0:
        found = _add(start[base + nx + west], start[base + nx], True, ranges, found)
        west = 0
    if east >= nx:
        found = _add(start[base], start[base + east - nx + 1], True, ranges, found)
        east = nx - 1
    return _add(start[base + west], start[base + east + 1], around, ranges, found)


@kernel
def _add(first: int, end: int, wrapped: bool, ranges: Any, found: int) -> int:
    if end > first:
        ranges[found, 0], ranges[found, 1], ranges[found, 2] = first, end, 1 if wrapped else 0
        return found + 1
    return found
