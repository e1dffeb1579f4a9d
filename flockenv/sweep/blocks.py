"""Blocks: agents side by side, as many as a vector register holds.

An array of vectors has, one after the other, the first coordinates of the agents of a block, their second ones, their
third ones, and then the next block; an array of numbers has those of one block after those of another. Indices are
counted without a sign: of a signed one numba asks whether it counts from the end, and the loop over the lanes would
stay scalar.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.np import arrayobj

from flockenv.kernels import Numbers, Vec, copy_lanes, intrinsic_or_python, written
from flockenv.section import section

__all__ = ["into_blocks", "numbers_of_lane", "out_of_blocks", "place_of", "vector_of_lane"]


def _apart(typing_context: Any, array: Any, place: Any, step: Any, count: Any) -> Any:
    """Return `count` numbers of an array, from a place on, each `step` further; both are written down in the source."""
    many, further = written(count, "count"), written(step, "step")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        make: Any = arrayobj.make_array
        data = make(signature.args[0])(context, builder, arguments[0]).data
        size, word = context.get_abi_sizeof(context.get_data_type(array.dtype)), ir.IntType(64)
        places = [builder.add(arguments[1], word(k * further)) for k in range(many)]
        found = [builder.load(builder.gep(data, [at]), align=size) for at in places]
        return context.make_tuple(builder, signature.return_type, found)

    numbers: Any = types.BaseTuple.from_types([array.dtype] * many)  # type: ignore[no-untyped-call]
    return numbers(array, types.uint64, step, count), generate


def _apart_in_python(array: Any, place: Any, step: int, count: int) -> Numbers:
    return tuple(array[int(place) + k * step] for k in range(count))


_numbers_apart: Any = intrinsic_or_python(_apart, _apart_in_python)


@section
def numbers_of_lane(count: int, width: int) -> Callable[..., Numbers]:
    """Make `numbers(blocks, place)`: so many numbers of a lane of an array of blocks, the first of which is there."""
    return lambda blocks, place: _numbers_apart(blocks, place, width, count)


@section
def vector_of_lane(dimension: int, width: int) -> Callable[..., Vec]:
    """Make `vector(blocks, place)`: the vector whose first coordinate lies at `place` of an array of blocks."""
    one, two = np.uint64(width), np.uint64(2 * width)

    def vector(blocks: Any, place: Any) -> Any:
        if dimension == 2:
            return blocks[place], blocks[place + one]
        return blocks[place], blocks[place + one], blocks[place + two]

    return vector


@section
def place_of(rows: int, width: int) -> Callable[[Any], Any]:
    """Make `place(i)`: where the first of `rows` numbers of agent i lies in an array of blocks."""
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
    """Make `out_of_blocks(blocks, array, b, n, first, end)`: array[:, b] = blocks, the other way round."""
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
