"""Tiles: the memory order of agents in a large world, and the agents that have left their home tile since a sort.

A tile is a square (in 3-D a cube) of some 250 agents, made of whole cells. Within a tile agents lie in memory by agent
number. So cells that contain only agents of their own tile, written by one thread, are in order without sorting. Only
the few cells with agents from another tile, or filled by several threads, have to be sorted.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.cell_list import Ints, begin_cells, cell_of, count_folded, divide_region, is_crowded, tally_cells
from flockenv.jit.decorators import kernel
from flockenv.jit.intrinsics import prefetch_for_write

__all__ = [
    "FAR_FROM_HOME", "HOME", "TILE", "count_from_home_tiles", "count_tiles", "find_home_tiles", "order_cells",
    "order_shared",
]  # fmt: skip

TILE = 256
"""Mean number of agents per tile."""

HOME = 8
"""Numbers per block that describe the home tiles of its agents, see `find_home_tiles`; the last is unused."""

FAR_FROM_HOME = 4
"""If more than 1 in 4 agents has left its home tile, all records are sorted instead of only those agents' cells."""

PART = 64
"""Blocks whose cells are computed, then counted, together: they stay in the L1 cache in between."""

BATCH = 64
"""Cells that are tested together for agents of several threads."""

AHEAD = (48, 24, 8)
"""Prefetch distances, in cells: of a cell's beginning, its first record, and the numbers of its agents."""

FEW = 8
"""Most agents of a cell whose numbers are prefetched, as a cell of thousands is listed once for each of them."""

ASKED = 16
"""Prefetch distance of positions, in blocks."""

_AWAY = 2**30  # more than any cell: marks the cell of an agent outside its home tile, between two passes over a part


@kernel
def _edge(shape: Any, capacity: int) -> int:
    """Return the width of a tile, in rows of cells."""
    cells = float(shape[0]) * float(shape[1]) * float(shape[2])
    volume = TILE * cells / capacity / shape[3]
    return max(1, int((np.sqrt(volume) if shape[2] == 1 else np.cbrt(volume)) + 0.5))


@kernel
def _tiles(shape: Any, edge: int) -> tuple[int, int, int]:
    """Return the number of tiles along each axis."""
    return (shape[0] - 1) // (edge * shape[3]) + 1, (shape[1] - 1) // edge + 1, (shape[2] - 1) // edge + 1


@kernel
def count_tiles(
    pos: Any, living: Any, first: int, end: int, lanes: int, rank: int, team: int, sync: Any, bounds: Any, size: Any,
    reach: float, periodic: bool, wraps: bool, capacity: int, cell: Ints, start: Ints, offset: Ints,
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Do the same as `count_cells`, with tiles instead of cells; return the shape of the grid of cells."""
    shape, low, pace = divide_region(
        pos, living, first, end, lanes, rank, team, sync, bounds, size, reach, periodic, capacity
    )
    if shape[0] == 0:
        return shape
    edge, d, w = _edge(shape, capacity), np.uint64(len(size)), np.uint64(lanes)
    along, up, deep = _tiles(shape, edge)
    row, rows = 1.0 / (edge * shape[3]), 1.0 / edge
    for block in range(np.uint64(first), np.uint64(end)):
        for l in range(w):  # noqa: E741  # a lane
            x, y, z = cell_of(pos, block * d * w + l, w, low, pace, size, wraps, shape)
            # a product, as an integer division does not vectorize: with 0.5 added it is never close to an integer
            x, y, z = np.int64((x + 0.5) * row), np.int64((y + 0.5) * rows), np.int64((z + 0.5) * rows)
            index = (z * up + y) * along + x
            cell[block * w + l] = np.int32(index) if living[block * w + l] > 0 else np.int32(-1)
    tally_cells(cell, first * lanes, end * lanes, rank, along * up * deep, offset)
    begin_cells(rank, team, sync, along * up * deep, start, offset)
    return shape


@kernel
def find_home_tiles(first: int, end: int, lanes: int, n: int, shape: Any, start: Ints, home_tiles: Ints) -> None:
    """Write the home tiles of each block after sorting; start: the first agent of each tile.

    home_tiles (blocks * HOME,): the number of agents in the first of two tiles, then the lowest cell along each of
    three axes, of that tile and of the other. A block with agents of more tiles has none: all of its agents count as
    displaced.
    """
    edge = _edge(shape, n)
    along, up, _ = _tiles(shape, edge)
    tile = 0
    for block in range(first, end):
        begin, last, at = block * lanes, min(block * lanes + lanes, n) - 1, block * HOME
        while start[tile + 1] <= begin:
            tile += 1
        other = tile
        while start[other + 1] <= last:
            other += 1
        few = start[other] <= start[tile + 1]  # no agents in between
        home_tiles[at] = start[tile + 1] - begin
        for k in range(2):
            t = other if k > 0 else tile
            home_tiles[at + 1 + 3 * k] = (t % along) * edge * shape[3] if few else -_AWAY
            home_tiles[at + 2 + 3 * k] = (t // along) % up * edge
            home_tiles[at + 3 + 3 * k] = (t // along) // up * edge


@kernel
def count_from_home_tiles(
    pos: Any, living: Any, first: int, end: int, lanes: int, rank: int, team: int, sync: Any, bounds: Any, size: Any,
    reach: float, periodic: bool, wraps: bool, capacity: int, home_tiles: Ints, displaced: Ints, tally: Any, cell: Ints,
    start: Ints, offset: Ints,
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Do the same as `count_cells` if all `capacity` agents live and lie in tiles; list those outside their home tile.

    The cells of such agents are written to `displaced` (agents, padded), from this thread's first agent on; their
    number to tally[team + rank].
    """
    shape, low, pace = divide_region(
        pos, living, first, end, lanes, rank, team, sync, bounds, size, reach, periodic, capacity
    )
    cells = shape[0] * shape[1] * shape[2]
    if cells == 0:
        return shape
    for c in range(cells):
        offset[rank, c] = 0
    up = np.int64(_edge(shape, capacity))
    across, away = up * shape[3], np.uint64(first * lanes)
    d, w, none = np.uint64(len(size)), np.uint64(lanes), np.int64(0)
    for begin in range(first, end, PART):
        until = min(begin + PART, end)
        for block in range(np.uint64(begin), np.uint64(until)):
            at, later = block * np.uint64(HOME), block + np.uint64(ASKED)
            for k in range(d):
                prefetch_for_write(pos, (later * d + k) * w)
            prefetch_for_write(cell, later * w)
            first_of_two = np.uint64(home_tiles[at])
            x0, y0, z0 = _corner(home_tiles, at + np.uint64(1))
            x1, y1, z1 = _corner(home_tiles, at + np.uint64(4))
            for l in range(w):  # noqa: E741  # a lane
                x, y, z = cell_of(pos, block * d * w + l, w, low, pace, size, wraps, shape)
                index = (z * shape[1] + y) * shape[0] + x
                one = l < first_of_two
                dx, dy, dz = x - (x0 if one else x1), y - (y0 if one else y1), z - (z0 if one else z1)
                home = (dx >= none) & (dx < across) & (dy >= none) & (dy < up) & (dz >= none) & (dz < up)
                index = index if home else index + np.int64(_AWAY)
                cell[block * w + l] = np.int32(index) if block * w + l < np.uint64(capacity) else np.int32(-1)
        for i in range(np.uint64(begin * lanes), np.uint64(until * lanes)):
            c = cell[i]
            is_displaced = c >= np.int32(_AWAY)
            c -= np.int32(_AWAY) if is_displaced else np.int32(0)
            cell[i] = c
            displaced[away] = c
            away += np.uint64(1) if is_displaced else np.uint64(0)
            if c >= 0:
                offset[rank, c] += 1
    tally[team + rank] = np.int64(away) - first * lanes
    begin_cells(rank, team, sync, cells, start, offset)
    if periodic or not is_crowded(shape, pace, reach, start):
        return shape
    tally[team + rank] = (end - first) * lanes  # folded cells are not parts of tiles
    return count_folded(pos, living, first, end, lanes, rank, team, sync, size, reach, capacity, cell, start, offset)


@kernel
def _corner(home_tiles: Ints, at: Any) -> tuple[Any, Any, Any]:
    """Return the lowest cell of a tile along each axis."""
    return np.int64(home_tiles[at]), np.int64(home_tiles[at + np.uint64(1)]), np.int64(home_tiles[at + np.uint64(2)])


@kernel
def order_cells(
    records: Any, length: int, ident: Any, start: Ints, offset: Ints, rank: int, listed: Ints, begin: int, end: int
) -> None:
    """Sort the records of each cell of listed[begin:end] by agent number, if only this thread has filled the cell.

    Records have `length` numbers and begin with their place; ident holds agent numbers by place; offset holds the end
    of each thread's part, and -1 for a cell once it is sorted, as a cell is listed once per displaced agent in it.
    """
    size, last, before = np.uint64(length), np.uint64(end), max(rank - 1, 0)
    mine = np.uint64(rank * offset.shape[1])
    for m in range(np.uint64(begin), last):
        c = _cell_ahead(listed, m, AHEAD[0], last)
        prefetch_for_write(start, c)
        prefetch_for_write(offset, mine + c)
        prefetch_for_write(records, np.uint64(start[_cell_ahead(listed, m, AHEAD[1], last)]) * size)
        c = _cell_ahead(listed, m, AHEAD[2], last)
        for k in range(np.uint64(start[c]), np.uint64(min(start[c + np.uint64(1)], start[c] + FEW))):
            prefetch_for_write(ident, np.uint64(records[k * size]))
        c = np.uint64(listed[m])
        first, beyond = start[c], start[c + np.uint64(1)]
        alone = (offset[rank, c] == beyond) & ((rank == 0) | (offset[before, c] == first))
        _order(records, size, ident, np.uint64(first), np.uint64(beyond if alone else first))
        offset[rank, c] = np.int32(-1) if alone else offset[rank, c]


@kernel
def _cell_ahead(listed: Ints, m: Any, ahead: int, end: Any) -> Any:
    """Return the cell `ahead` entries later in the list, or the last one."""
    return np.uint64(listed[min(m + np.uint64(ahead), end - np.uint64(1))])


@kernel
def order_shared(
    records: Any, length: int, ident: Any, start: Ints, offset: Ints, team: int, first: int, end: int
) -> None:
    """Sort the records of those cells of [first, end) that several threads have filled, by agent number."""
    size = np.uint64(length)
    for r in range(team - 1):
        for begin in range(first, end, BATCH):  # shared cells are rare, so a whole batch is tested at once
            until, shared = min(begin + BATCH, end), np.int32(0)
            for c in range(np.uint64(begin), np.uint64(until)):
                shared |= np.int32((start[c] < offset[r, c]) & (offset[r, c] < start[c + np.uint64(1)]))
            for c in range(np.uint64(begin), np.uint64(until if shared > 0 else begin)):
                if start[c] < offset[r, c] < start[c + np.uint64(1)]:
                    _order(records, size, ident, np.uint64(start[c]), np.uint64(start[c + np.uint64(1)]))


@kernel
def _order(records: Any, size: Any, ident: Any, first: Any, end: Any) -> None:
    """Sort the records [first, end) by agent number (insertion sort: most are in order)."""
    for k in range(first + np.uint64(1), end):
        at, least = k * size, first * size
        who = ident[np.uint64(records[at])]
        while at > least and ident[np.uint64(records[at - size])] > who:
            for m in range(at, at + size):
                records[m - size], records[m] = records[m], records[m - size]
            at -= size
