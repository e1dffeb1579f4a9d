"""Agents abreast: the numbers of many agents side by side, in the lanes of vector registers, and rows made of them.

What an agent sees is handed out as a row, but worked out for sixteen agents at a time: a loop over agents whose body
has no branch becomes vector code, while a loop over one agent's neighbours waits for every guess of how many there are.
So a task writes columns, one number of all agents after the other, and squares of them are turned into rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic
from numba.np import arrayobj

from flockenv.kernels import LINE, asked, kernel

__all__ = ["apart", "columns", "fetch", "into_rows", "packed"]

SIDE = LINE // 4
"""Single precision numbers in a vector register: squares of as many rows and columns are turned at once."""


def apart(count: int) -> int:
    """Return how far the columns of so many agents lie apart, in numbers; written into a source, it is a constant.

    So that LLVM sees columns that do not overlap, and does not ask. The same for many counts, for each is a kernel of
    its own; and no power of two, whose multiples share a place in the cache.
    """
    return max(64, 1 << (count - 1).bit_length()) + SIDE


def _in_one_piece(array: Any) -> None:
    """Refuse to compile for an array whose numbers need not lie side by side."""
    if array.layout != "C":
        raise TypingError(f"{array} must lie in one piece")


def _array(context: Any, builder: Any, kind: Any, value: Any = None) -> Any:
    """Return numba's structure of an array, of this value if there is one."""
    make: Any = arrayobj.make_array
    return make(kind)(context, builder, value) if value is not None else make(kind)(context, builder)


def _shown(context: Any, builder: Any, kind: Any, old: Any, shape: Any, strides: Any) -> Any:
    """Return the memory of an array under another shape."""
    fill: Any = arrayobj.populate_array
    new = _array(context, builder, kind)
    fill(new, data=old.data, shape=shape, strides=strides, itemsize=old.itemsize, meminfo=None)
    return new._getvalue()


def _bytes(context: Any, kind: Any) -> Any:
    """Return the size of one number of an array, as a constant of machine code."""
    return context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))


def _packed(typing_context: Any, array: Any) -> Any:
    """Return an array in one piece with the strides that follow from its shape, of which the last is a constant.

    A view of one world (D, B, N) -> (D, N) takes its strides from it, and its agents are known to lie side by side.
    """
    _in_one_piece(array)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = _array(context, builder, array, arguments[0])
        unpack: Any = cgutils.unpack_tuple
        shape = unpack(builder, old.shape, array.ndim)
        strides = [_bytes(context, array)]
        for count in reversed(shape[1:]):
            strides.insert(0, builder.mul(strides[0], count))
        return _shown(context, builder, array, old, shape, strides)

    return array(array), generate


packed: Any = intrinsic(_packed)


def _columns(typing_context: Any, flat: Any, count: Any, many: Any, distance: Any) -> Any:
    """Show scratch (at least many * distance,) as an array (count, many) whose columns lie in one piece each."""
    view = types.Array(flat.dtype, 2, "A")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = _array(context, builder, flat, arguments[0])
        n, m, step = (
            context.cast(builder, a, kind, types.intp)
            for a, kind in zip(arguments[1:], signature.args[1:], strict=True)
        )
        size = _bytes(context, flat)
        return _shown(context, builder, view, old, [n, m], [size, builder.mul(size, step)])

    return view(flat, count, many, distance), generate


columns: Any = intrinsic(_columns)


def _fetch(typing_context: Any, array: Any, part: Any, parts: Any) -> Any:
    """Ask for the memory of one of so many parts of an array in one piece, which will be written soon.

    Rows are written at a stretch, and a store waits for a line of memory that is not at hand. Asked for all at once,
    they would be waited for just so: what asks has room for a dozen lines.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = _array(context, builder, array, arguments[0])
        word = old.nitems.type
        n, m = (
            context.cast(builder, a, kind, types.intp)
            for a, kind in zip(arguments[1:], signature.args[1:], strict=True)
        )
        line = ir.Constant(word, LINE)
        lines = builder.udiv(builder.mul(old.nitems, old.itemsize), line)
        length = builder.mul(builder.add(builder.udiv(lines, m), ir.Constant(word, 1)), line)
        first = builder.mul(length, n)
        data = builder.bitcast(old.data, ir.IntType(8).as_pointer())
        each: Any = cgutils.for_range_slice
        with each(builder, first, builder.add(first, length), line) as (at, _):
            asked(builder, builder.gep(data, [at]))
        return context.get_dummy_value()

    return types.void(array, part, parts), generate


fetch: Any = intrinsic(_fetch)


def _turned_square(
    typing_context: Any, to: Any, at: Any, across: Any, many: Any, source: Any, place: Any, down: Any
) -> Any:
    """Copy 16 x 16 numbers turned: column k, from `place` + k * `down`, goes to every `across`-th from `at` + k.

    The first `many` rows of them are written.
    """
    _in_one_piece(to)
    _in_one_piece(source)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = ir.VectorType(context.get_data_type(to.dtype), SIDE)
        targets, sources = (_array(context, builder, kind, arguments[k]).data for k, kind in ((0, to), (4, source)))

        def line(base: Any, k: int, first: Any, step: Any) -> Any:
            here = builder.add(first, builder.mul(step, ir.Constant(step.type, k)))
            return builder.bitcast(builder.gep(base, [here]), vector.as_pointer())

        numbers = [builder.load(line(sources, k, *arguments[5:]), align=4) for k in range(SIDE)]
        for s in (1, 2, 4, 8):  # squares of 2 s, made of four squares of s: two change places
            low = [SIDE + k - s if k & s else k for k in range(SIDE)]
            high = [SIDE + k if k & s else k + s for k in range(SIDE)]
            masks = [ir.Constant(ir.VectorType(ir.IntType(32), SIDE), mask) for mask in (low, high)]
            for r in (r for r in range(SIDE) if not r & s):
                pair = numbers[r], numbers[r + s]
                numbers[r], numbers[r + s] = (builder.shuffle_vector(*pair, mask) for mask in masks)
        for k in range(SIDE):
            with builder.if_then(builder.icmp_unsigned(">", arguments[3], ir.Constant(arguments[3].type, k))):
                builder.store(numbers[k], line(targets, k, *arguments[1:3]), align=4)
        return context.get_dummy_value()

    return types.void(to, types.uint64, types.uint64, types.uint64, source, types.uint64, types.uint64), generate


_turn_square: Any = intrinsic(_turned_square)


@kernel
def into_rows(rows: Any, flat: Any, many: int, distance: int) -> None:
    """Copy columns, `distance` apart in scratch, into the first `many` numbers of rows (L, O) float32 in one piece.

    Squares at the end of a row overlap with those before them: what is copied twice is the same.
    """
    count, size, step = rows.shape[0], np.uint64(rows.shape[1]), np.uint64(distance)
    if many >= SIDE:
        for i in range(0, count, SIDE):
            row, left = np.uint64(i), np.uint64(count - i)
            for c in range(0, many, SIDE):
                column = np.uint64(min(c, many - SIDE))
                _turn_square(rows, row * size + column, size, left, flat, column * step + row, step)
    else:
        for i in range(count):
            for c in range(many):
                rows[i, c] = flat[np.uint64(c * distance + i)]
