"""Blocks: agents side by side, as many as a vector register holds.

An array of vectors holds the first coordinates of the agents of a block, then their second ones, then their third ones,
and then the next block; an array of numbers holds one block after another. Indices are unsigned: for a signed index
numba checks whether it counts from the end, and the loop over the lanes would stay scalar.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.jit.decorators import Vec
from flockenv.jit.intrinsics import copy_lanes
from flockenv.jit.section import section

__all__ = [
    "arrays_of",
    "common_places",
    "into_blocks",
    "out_of_blocks",
    "place_of",
    "put_vector_of",
    "vector_of",
    "vector_of_lane",
]  # fmt: skip


@section
def vector_of_lane(dimension: int, width: int) -> Callable[..., Vec]:
    """Make `vector(blocks, place)`: return the vector whose first coordinate lies at `place` of an array of blocks."""
    one, two = np.uint64(width), np.uint64(2 * width)

    def vector(blocks: Any, place: Any) -> Any:
        if dimension == 2:
            return blocks[place], blocks[place + one]
        return blocks[place], blocks[place + one], blocks[place + two]

    return vector


@section
def put_vector_of(dimension: int, width: int) -> Callable[..., None]:
    """Make `put(blocks, place, vector)`: write a vector, its first coordinate at `place` of an array of blocks."""
    one, two = np.uint64(width), np.uint64(2 * width)

    def put(blocks: Any, place: Any, vector: Any) -> None:
        blocks[place] = vector[0]
        blocks[place + one] = vector[1]
        if dimension == 3:
            blocks[place + two] = vector[2]

    return put


@section
def common_places(dimension: int, width: int, masked: bool) -> Callable[..., tuple[Any, Any, Any]]:
    """Make `common(scratch, n, present, block)`: where bodies, `living` and `requested_force` of a block begin.

    In a large world numbers that all agents share are read from the first block, because large worlds are limited by
    memory bandwidth.
    """
    size, lanes = np.uint64(dimension * width), np.uint64(width)

    def common(scratch: Any, n: Any, present: Any, block: Any) -> Any:
        row, base = block * lanes, block * size
        if masked:
            whole = present == n and (block + np.uint64(1)) * lanes <= np.uint64(n)
            return row & scratch.spread[0], np.uint64(0) if whole else row, base & scratch.spread[1]
        return row, row, base

    return common


@section
def vector_of(dimension: int) -> Callable[..., Vec]:
    """Make `vector(array, b, m)`: return the vector at [:, b, m] of an array, as the centre of circle m of world b."""

    def vector(array: Any, b: Any, m: Any) -> Any:
        if dimension == 2:
            return array[0, b, m], array[1, b, m]
        return array[0, b, m], array[1, b, m], array[2, b, m]

    return vector


@section
def place_of(rows: int, width: int) -> Callable[[Any], Any]:
    """Make `place(i)`: return where the first of `rows` numbers of agent i lies in an array of blocks."""
    whole, lanes = np.uint64(rows * width), np.uint64(width)

    def place(i: Any) -> Any:
        return (i // lanes) * whole + i % lanes

    return place


@section
def into_blocks(dimension: int, width: int) -> Callable[..., None]:
    """Make `into_blocks(blocks, array, b, n, first, end)`: blocks = array[:, b], (D, N) of world b.

    Full blocks are copied a vector register at a time. The lanes beyond agent n are left as they are.
    """
    size = dimension * width

    def into(blocks: Any, array: Any, b: Any, n: Any, first: Any, end: Any) -> None:
        for block in range(first, end):
            for k in range(dimension):
                base = np.uint64(block * size + k * width)
                if (block + 1) * width <= n:
                    copy_lanes(blocks, base, array[k, b], np.uint64(block * width), width)
                else:
                    for lane in range(np.uint64(n - block * width)):
                        blocks[base + lane] = array[k, b][np.uint64(block * width) + lane]

    return into


@section
def out_of_blocks(dimension: int, width: int) -> Callable[..., None]:
    """Make `out_of_blocks(blocks, array, b, n, first, end)`: array[:, b] = blocks, the inverse of `into_blocks`."""
    size = dimension * width

    def out(blocks: Any, array: Any, b: Any, n: Any, first: Any, end: Any) -> None:
        for block in range(first, end):
            for k in range(dimension):
                base = np.uint64(block * size + k * width)
                if (block + 1) * width <= n:
                    copy_lanes(array[k, b], np.uint64(block * width), blocks, base, width)
                else:
                    for lane in range(np.uint64(n - block * width)):
                        array[k, b][np.uint64(block * width) + lane] = blocks[base + lane]

    return out


@section
def arrays_of(inner: bool) -> Callable[..., Any]:
    """Make `arrays(scratch, pos, vel)`: a tuple of arrays, positions, velocities and, if any, inner states.

    The arrays of scratch have the indices after these, see `lane_access.pick_items`.
    """
    if inner:
        return lambda scratch, pos, vel: (pos, vel) + scratch.inner  # noqa: RUF005  # numba adds tuples, and unpacks none
    return lambda scratch, pos, vel: (pos, vel)
