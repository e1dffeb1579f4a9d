"""Who is near whom: one query per instant, at the largest reach, shared by every law that asks.

A query puts the living agents in order (by cell where that pays, else by index) and answers with contiguous ranges of
candidates. No neighbour list is ever built: a sweep meets every candidate of a range, and each law keeps those within
its own radius. Brute force is the query with one range.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.kernels import kernel

__all__ = ["LANES", "MAX_RANGES", "block_end", "candidates", "sort_agents"]

LANES = 16
"""Agents that a sweep handles side by side."""

MAX_RANGES = 27
"""Ranges of one query: 9 rows of cells in 3-D, each in three pieces where it wraps around twice."""

_FEWEST_AGENTS = 96  # below this, sorting costs more than it saves
_MARGIN = 1.001  # cells are this much wider than the reach, so that rounding never hides a neighbour

Ints = NDArray[np.int64]


@kernel
def _grid(lengths: Any, count: int, reach: float, periodic: bool, shape: Ints) -> bool:
    """Choose how many cells each axis gets; False if cells would not pay."""
    dimension = len(lengths)
    cells = 1.0
    for k in range(dimension):
        per_axis = min(max(1.0, math.floor(lengths[k] / (reach * _MARGIN))), 2.0**20)
        shape[k] = int(per_axis)
        cells *= per_axis
    if cells > count:  # no more cells than agents: wider cells are still right
        shrink = (count / cells) ** (1.0 / dimension)
        cells = 1.0
        for k in range(dimension):
            shape[k] = max(1, int(shape[k] * shrink))
            cells *= shape[k]
    while cells > count:  # an axis of one cell could not shrink (a queue of people): the longest gives way for it
        longest = 0
        for k in range(1, dimension):
            longest = k if shape[k] > shape[longest] else longest
        cells /= shape[longest]
        shape[longest] = max(1, int(count / cells))
        cells = round(cells) * float(shape[longest])
    for k in range(dimension):
        if periodic and shape[k] < 3:  # a row and its image would be the same row
            return False
    for k in range(dimension, 3):
        shape[k] = 1
    return bool(cells >= 4 * 3**dimension)


@kernel
def _cell(pos: Any, i: int, low: Any, lengths: Any, periodic: bool, shape: Ints) -> int:
    index = 0
    for k in range(len(lengths) - 1, -1, -1):
        part = (pos[k, i] - low[k]) / lengths[k]
        if periodic:
            part -= math.floor(part)
        index = index * shape[k] + min(max(int(part * shape[k]), 0), shape[k] - 1)
    return index


@kernel
def sort_agents(
    pos: Any, alive: Any, reach: float, size: Any, periodic: bool, order: Ints, cell: Ints, start: Ints, shape: Ints
) -> int:
    """Write into `order` the living agents, by cell if that pays; return how many there are.

    pos (D, N) m; order (N,); cell (2N,): of agents in index order, then in sorted order; start (N + 2,): first sorted
    agent of each cell; shape (3,): cells per axis, shape[0] = 0 for brute force. `size` is the box of a periodic space.
    """
    n = pos.shape[1]
    count = 0
    for i in range(n):
        if alive[i]:
            order[count] = i
            count += 1
    shape[0] = 0
    if count < _FEWEST_AGENTS:
        return count
    low, lengths = _bounds(pos, order[:count], size, periodic)
    if not _grid(lengths, count, reach, periodic, shape):
        shape[0] = 0
        return count
    cells = shape[0] * shape[1] * shape[2]
    for c in range(cells + 1):
        start[c] = 0
    for k in range(count):
        c = _cell(pos, order[k], low, lengths, periodic, shape)
        cell[k] = c
        start[c + 1] += 1
    for c in range(cells):
        start[c + 1] += start[c]
    for k in range(count):  # a stable counting sort; `start` ends up shifted by one cell and is put back below
        c = cell[k]
        cell[n + start[c]] = k
        start[c] += 1
    for c in range(cells, 0, -1):
        start[c] = start[c - 1]
    start[0] = 0
    for k in range(count):  # sorted position -> (agent, its cell)
        from_ = cell[n + k]
        cell[n + k] = order[from_] * (cells + 1) + cell[from_]
    for k in range(count):
        order[k] = cell[n + k] // (cells + 1)
        cell[n + k] = cell[n + k] % (cells + 1)
    return count


@kernel
def _bounds(pos: Any, agents: Ints, size: Any, periodic: bool) -> Any:
    """Return the corner and the edges of the region to divide: the box, or where the agents are."""
    low = np.zeros(3)
    lengths = np.ones(3)
    for k in range(pos.shape[0]):
        if periodic:
            lengths[k] = size[k]
        else:
            least, most = pos[k, agents[0]], pos[k, agents[0]]
            for i in agents:
                least = min(least, pos[k, i])
                most = max(most, pos[k, i])
            low[k] = least
            lengths[k] = max(most - least, 1e-300)
    if len(size) == 2:
        return (low[0], low[1]), (lengths[0], lengths[1])
    else:
        return (low[0], low[1], low[2]), (lengths[0], lengths[1], lengths[2])


@kernel
def block_end(first: int, count: int, n: int, cell: Ints, start: Ints, shape: Ints) -> int:
    """Return where the block of lanes that begins at sorted agent `first` ends: after 16, or with its row of cells."""
    end = min(first + LANES, count)
    if shape[0] > 0:
        row = cell[n + first] // shape[0]
        end = min(end, start[(row + 1) * shape[0]])
    return end


@kernel
def candidates(
    first: int, end: int, count: int, n: int, cell: Ints, start: Ints, shape: Ints, periodic: bool, ranges: Ints
) -> int:
    """Write the ranges [from, to) of sorted agents that may be near the block [first, end); return how many."""
    if shape[0] == 0:
        ranges[0, 0], ranges[0, 1] = 0, count
        return 1
    nx, ny, nz = shape[0], shape[1], shape[2]
    row = cell[n + first] // nx
    y, z = row % ny, row // ny
    west, east = cell[n + first] % nx - 1, cell[n + end - 1] % nx + 1
    found = 0
    for dz in range(-1 if nz > 1 else 0, 2 if nz > 1 else 1):
        for dy in range(-1, 2):
            yy, zz = y + dy, z + dz
            if periodic:
                yy, zz = (yy + ny) % ny, (zz + nz) % nz
            elif yy < 0 or yy >= ny or zz < 0 or zz >= nz:
                continue
            found = _row_ranges((zz * ny + yy) * nx, west, east, nx, start, periodic, ranges, found)
    return found


@kernel
def _row_ranges(base: int, west: int, east: int, nx: int, start: Ints, periodic: bool, ranges: Ints, found: int) -> int:
    """Add the pieces of one row of cells between west and east."""
    if not periodic or east - west + 1 >= nx:
        west, east = (0, nx - 1) if periodic else (max(west, 0), min(east, nx - 1))
    if west < 0:
        found = _add(start[base + nx + west], start[base + nx], ranges, found)
        west = 0
    if east >= nx:
        found = _add(start[base], start[base + east - nx + 1], ranges, found)
        east = nx - 1
    return _add(start[base + west], start[base + east + 1], ranges, found)


@kernel
def _add(first: int, end: int, ranges: Ints, found: int) -> int:
    if end > first:
        ranges[found, 0], ranges[found, 1] = first, end
        return found + 1
    return found
