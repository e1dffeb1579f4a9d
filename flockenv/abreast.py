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
from numba.extending import intrinsic
from numba.np import arrayobj

from flockenv.kernels import LINE, kernel
from flockenv.lines import array_of, in_one_piece

__all__ = [
    "PAIR", "SIDE", "apart", "columns", "into_rows", "key_of", "key_read", "key_written", "looked_up", "packed", "pick",
    "same_key", "tag_of", "take",
]  # fmt: skip

SIDE = LINE // 4
"""Single precision numbers in a vector register: squares of as many rows and columns are turned at once."""

PAIR = 2 * SIDE
"""Agents up to a multiple of which arrays go on that are shown side by side, whoever is there."""


def apart(count: int) -> int:
    """Return how far the columns of so many agents lie apart, in numbers; written into a source, it is a constant.

    So that LLVM sees columns that do not overlap, and does not ask. The same for many counts, for each is a kernel of
    its own; and no power of two, whose multiples share a place in the cache.
    """
    return max(64, 1 << (count - 1).bit_length()) + SIDE


def _shown(context: Any, builder: Any, kind: Any, old: Any, shape: Any, strides: Any) -> Any:
    """Return the memory of an array under another shape."""
    fill: Any = arrayobj.populate_array
    new = array_of(context, builder, kind)
    fill(new, data=old.data, shape=shape, strides=strides, itemsize=old.itemsize, meminfo=None)
    return new._getvalue()


def _bytes(context: Any, kind: Any) -> Any:
    """Return the size of one number of an array, as a constant of machine code."""
    return context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))


def _packed(typing_context: Any, array: Any) -> Any:
    """Return an array in one piece with the strides that follow from its shape, of which the last is a constant.

    A view of one world (D, B, N) -> (D, N) takes its strides from it, and its agents are known to lie side by side.
    """
    in_one_piece(array)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = array_of(context, builder, array, arguments[0])
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
        old = array_of(context, builder, flat, arguments[0])
        n, m, step = (
            context.cast(builder, a, kind, types.intp)
            for a, kind in zip(arguments[1:], signature.args[1:], strict=True)
        )
        size = _bytes(context, flat)
        return _shown(context, builder, view, old, [n, m], [size, builder.mul(size, step)])

    return view(flat, count, many, distance), generate


columns: Any = intrinsic(_columns)


def _looks_up(typing_context: Any) -> Any:
    """Say whether numbers are looked up in registers, `pick`; a constant of machine code."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.get_constant(types.boolean, _permutes(context))

    return types.boolean(), generate


looked_up: Any = intrinsic(_looks_up)


def _permutes(context: Any) -> bool:
    """Is machine code made for a processor with AVX-512?"""
    return "+avx512f" in getattr(context.codegen(), "_tm_features", "").split(",")


def _picks(
    typing_context: Any, to: Any, at: Any, table: Any, first: Any, count: Any, who: Any, place: Any
) -> Any:  # fmt: skip
    """Write a register of numbers from to[at] on: those that the int32 from who[place] on name, of a table of `count`.

    The table begins at table[first], may be read in whole pairs of registers, and is looked up a pair at a time. All
    lies in one piece, and places are counted through. Where `_permutes` says no, nothing is written.
    """
    for array in (to, table, who):
        in_one_piece(array)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if not _permutes(context):
            return context.get_dummy_value()
        number = context.get_data_type(to.dtype)
        size = context.get_abi_sizeof(number)
        lanes, whole, word = LINE // size, ir.IntType(8 * size), ir.IntType(64)
        vector, index = ir.VectorType(number, lanes), ir.VectorType(whole, lanes)
        declare: Any = cgutils.get_or_insert_function
        name = f"llvm.x86.avx512.vpermi2var.p{'s' if size == 4 else 'd'}.512"
        permuted = declare(builder.module, ir.FunctionType(vector, [vector, index, vector]), name)

        def pointer(k: int, here: Any, kind: Any = vector) -> Any:
            data = array_of(context, builder, signature.args[k], arguments[k]).data
            return builder.bitcast(builder.gep(data, [here]), kind.as_pointer())

        named = builder.load(pointer(5, arguments[6], ir.VectorType(ir.IntType(32), lanes)), align=4)
        named = named if size == 4 else builder.sext(named, index)

        def looked_up(begin: Any) -> Any:
            here = [builder.add(arguments[3], builder.add(begin, word(k))) for k in (0, lanes)]
            low, high = (builder.load(pointer(2, each), align=size) for each in here)
            return builder.call(permuted, [low, named, high])

        on_stack: Any = cgutils.alloca_once_value
        found = on_stack(builder, looked_up(word(0)))  # of a number, the last bits are looked at
        pairs: Any = cgutils.for_range_slice
        with pairs(builder, word(2 * lanes), arguments[4], word(2 * lanes)) as (begin, _):
            edge = builder.insert_element(ir.Constant(index, ir.Undefined), builder.trunc(begin, whole), word(0))
            edges = builder.shuffle_vector(edge, edge, ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes))
            here = builder.icmp_unsigned(">=", named, edges)
            builder.store(builder.select(here, looked_up(begin), builder.load(found)), found)
        builder.store(builder.load(found), pointer(0, arguments[1]), align=size)
        return context.get_dummy_value()

    return types.void(to, types.uint64, table, types.uint64, types.uint64, who, types.uint64), generate


pick: Any = intrinsic(_picks)


# A key: a square, in single precision, whose last bits are a place. Of numbers that are not negative the bits are in
# order as integers, of which a register is compared in half the time; and what is known of one moves with it.


def _key_of(typing_context: Any, square: Any, place: Any, tags: Any) -> Any:
    """Return the key (int32) of a float32 square, not negative, and a place; `tags` has all bits that a place may."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(32)
        bits = builder.bitcast(arguments[0], word)
        return builder.or_(builder.and_(bits, builder.not_(arguments[2])), builder.trunc(arguments[1], word))

    return types.int32(types.float32, types.uint64, types.int32), generate


def _key_read(typing_context: Any, number: Any) -> Any:
    """Return the key that lies where a float32 may."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(types.float32), generate


def _key_written(typing_context: Any, key: Any) -> Any:
    """Return a key as what lies where a float32 may."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


def _tag_of(typing_context: Any, key: Any, tags: Any) -> Any:
    """Return the place (int32) in a key."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.and_(*arguments)

    return types.int32(types.int32, types.int32), generate


def _same_key(typing_context: Any, one: Any, other: Any, tags: Any) -> Any:
    """Say whether two keys differ in their places alone: then which square is smaller is not known."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        one, other, tags = arguments
        return builder.icmp_unsigned("==", builder.or_(one, tags), builder.or_(other, tags))

    return types.boolean(types.int32, types.int32, types.int32), generate


key_of: Any = intrinsic(_key_of)
key_read: Any = intrinsic(_key_read)
key_written: Any = intrinsic(_key_written)
tag_of: Any = intrinsic(_tag_of)
same_key: Any = intrinsic(_same_key)


@kernel
def take(to: Any, table: Any, who: Any, count: int) -> None:
    """Write into to (R, K, N) what the first R rows of a table (.., N') of `count` agents say of those listed, (K, N).

    N and N' are multiples of PAIR, and whom the lists name beyond the last agent is below `count`, too. While a row of
    the table is a few registers long, a register of agents is looked up in it at once (with AVX-512).
    """
    many, listed, n = np.uint64(to.shape[0]), np.uint64(who.shape[0]), np.uint64(who.shape[1])
    lanes, length = np.uint64(LINE // to.itemsize), np.uint64(table.shape[1])
    if looked_up() and np.uint64(count) <= np.uint64(8) * lanes:
        for i in range(np.uint64(0), n, lanes):
            for s in range(listed):
                for r in range(many):
                    pick(to, (r * listed + s) * n + i, table, r * length, np.uint64(count), who, s * n + i)
    else:
        for r in range(many):
            for s in range(listed):
                for i in range(n):
                    to[r, s, i] = table[r, np.uint64(who[s, i])]


def _turned_square(
    typing_context: Any, to: Any, at: Any, across: Any, many: Any, source: Any, place: Any, down: Any
) -> Any:
    """Copy 16 x 16 numbers turned: column k, from `place` + k * `down`, goes to every `across`-th from `at` + k.

    The first `many` rows of them are written.
    """
    in_one_piece(to)
    in_one_piece(source)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = ir.VectorType(context.get_data_type(to.dtype), SIDE)
        targets, sources = (array_of(context, builder, kind, arguments[k]).data for k, kind in ((0, to), (4, source)))

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
