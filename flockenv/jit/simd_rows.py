"""Agents abreast: the numbers of many agents side by side, in the lanes of vector registers, and rows made of them.

What an agent sees is handed out as a row, but worked out for a register of agents at a time: a loop over agents whose
body has no branch becomes vector code, while a loop over one agent's neighbours waits for every guess of how many there
are. So a task writes columns, one number of all agents after the other, and squares of them are turned into rows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.np import arrayobj

from flockenv.jit import cpu
from flockenv.jit.cpu import LINE
from flockenv.jit.decorators import kernel
from flockenv.jit.intrinsics import intrinsic_or_python, written
from flockenv.jit.memory import array_of, in_one_piece

__all__ = [
    "PAIR", "SIDE", "apart", "columns", "in_one_row", "into_rows", "key_of", "key_read", "key_written", "ordered",
    "packed", "pick", "same_key", "tag_of", "take",
]  # fmt: skip

SIDE = LINE // 4
"""Single precision numbers in a line, and in the longest vector register: so many agents are shown side by side."""

SHORT = 8
"""A table of more registers is not looked up in registers."""

SQUARE = cpu.REGISTER // 4
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


packed: Any = intrinsic_or_python(_packed, lambda array: array)


def _in_one_row(typing_context: Any, array: Any) -> Any:
    """Show an array in one piece as one row of numbers."""
    in_one_piece(array)
    view = types.Array(array.dtype, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = array_of(context, builder, array, arguments[0])
        return _shown(context, builder, view, old, [old.nitems], [_bytes(context, array)])

    return view(array), generate


in_one_row: Any = intrinsic_or_python(_in_one_row, lambda array: array.reshape(-1))


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


def _columns_in_python(flat: Any, count: int, many: int, distance: int) -> Any:
    step = flat.itemsize
    return np.lib.stride_tricks.as_strided(flat, (int(count), int(many)), (step, step * int(distance)))


columns: Any = intrinsic_or_python(_columns, _columns_in_python)


def _lookup(builder: Any, vector: Any, size: int) -> tuple[int, Any]:
    """Return how many numbers are looked up at once in registers as long as that, and the instruction; 0 if none can.

    It takes the last bits of who is named, and one register of a table, or two.
    """
    declare: Any = cgutils.get_or_insert_function
    index = ir.VectorType(ir.IntType(8 * size), vector.count)
    if "avx512f" in cpu.FEATURES and vector.count * size == 64:
        name = f"llvm.x86.avx512.vpermi2var.p{'s' if size == 4 else 'd'}.512"
        call = declare(builder.module, ir.FunctionType(vector, [vector, index, vector]), name)
        return 2 * vector.count, lambda named, table: builder.call(call, [table[0], named, table[1]])
    if "avx2" in cpu.FEATURES and (vector.count, size) == (8, 4):
        call = declare(builder.module, ir.FunctionType(vector, [vector, index]), "llvm.x86.avx2.permps")
        return vector.count, lambda named, table: builder.call(call, [table[0], named])
    return 0, None


def _looked_up(builder: Any, part: Any, named: Any, vector: Any, size: int, count: Any) -> Any:
    """Generate the look-up of those named in a table whose registers `part` reads: all of it, a PAIR at a time."""
    step, lookup = _lookup(builder, vector, size)
    word = ir.IntType(64)
    named = named if size == 4 else builder.sext(named, ir.VectorType(word, vector.count))

    def edge(begin: Any) -> Any:
        first = begin if size == 8 else builder.trunc(begin, named.type.element)
        edge = builder.insert_element(ir.Constant(named.type, ir.Undefined), first, ir.IntType(32)(0))
        return builder.shuffle_vector(edge, edge, ir.Constant(ir.VectorType(ir.IntType(32), vector.count), None))

    def among(first: Any, found: Any) -> Any:
        for at in range(0, PAIR, step):
            begin = builder.add(first, word(at))
            table = [part(builder.add(begin, word(k)), vector) for k in range(0, step, vector.count)]
            here = lookup(named, table)
            found = builder.select(builder.icmp_signed(">=", named, edge(begin)), here, found) if found else here
        return found

    on_stack: Any = cgutils.alloca_once_value
    steps: Any = cgutils.for_range_slice
    found = on_stack(builder, among(word(0), None))
    with steps(builder, word(PAIR), count, word(PAIR)) as (first, _):
        builder.store(among(first, builder.load(found)), found)
    return builder.load(found)


def _read(builder: Any, part: Any, named: Any, vector: Any) -> Any:
    """Generate what reads those named one by one."""
    found = ir.Constant(vector, ir.Undefined)
    for k in range(vector.count):
        here = builder.zext(builder.extract_element(named, ir.IntType(32)(k)), ir.IntType(64))
        found = builder.insert_element(found, part(here, vector.element), ir.IntType(32)(k))
    return found


def _picks(
    typing_context: Any, to: Any, at: Any, beside: Any, table: Any, first: Any, length: Any, many: Any, count: Any,
    who: Any, place: Any, width: Any,
) -> Any:  # fmt: skip
    """Write what `many` rows of a table of `count` agents say of `width` of them: of those that who[place] and on name.

    The first row begins at table[first], the next `length` further, and may be read in whole multiples of PAIR; what it
    says comes to to[at] and on, then `beside` further. All lies in one piece, and places are counted through. Short
    rows are looked up in registers, where a processor can do that; else agents are read one by one.
    """
    for array in (to, table, who):
        in_one_piece(array)
    wide = written(width, "width")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number, word = context.get_data_type(to.dtype), ir.IntType(64)
        size = context.get_abi_sizeof(number)
        vector = ir.VectorType(number, min(wide, cpu.REGISTER // size))
        step, _ = _lookup(builder, vector, size)
        few = builder.icmp_unsigned("<=", arguments[7], word(SHORT * vector.count if step else 0))
        rows: Any = cgutils.for_range_slice

        def pointer(k: int, here: Any, kind: Any) -> Any:
            data = array_of(context, builder, signature.args[k], arguments[k]).data
            return builder.bitcast(builder.gep(data, [here]), kind.as_pointer())

        def each(begin: int, named: Any, say: Callable[..., Any], *more: Any) -> None:
            with rows(builder, word(0), arguments[6], word(1)) as (r, _):
                row = builder.add(arguments[4], builder.mul(r, arguments[5]))

                def part(here: Any, kind: Any) -> Any:
                    return builder.load(pointer(3, builder.add(row, here), kind), align=size)

                says = say(builder, part, named, vector, *more)
                place = builder.add(builder.add(arguments[1], word(begin)), builder.mul(r, arguments[2]))
                builder.store(says, pointer(0, place, vector), align=size)

        for begin in range(0, wide, vector.count):
            names = ir.VectorType(ir.IntType(32), vector.count)
            named = builder.load(pointer(8, builder.add(arguments[9], word(begin)), names), align=4)
            with builder.if_else(few) as (short, long):
                with short:
                    if step:
                        each(begin, named, _looked_up, size, arguments[7])
                with long:
                    each(begin, named, _read)
        return context.get_dummy_value()

    number = types.uint64
    given = (to, number, number, table, number, number, number, number, who, number, width)
    return types.void(*given), generate


def _picked_in_python(
    to: Any, at: Any, beside: Any, table: Any, first: Any, length: Any, many: Any, count: Any, who: Any, place: Any,
    width: int,
) -> None:  # fmt: skip
    named = who.reshape(-1)[int(place) : int(place) + width].astype(np.int64)
    for r in range(int(many)):
        row = table.reshape(-1)[int(first) + r * int(length) :]
        start = int(at) + r * int(beside)
        to.reshape(-1)[start : start + width] = row[named]


pick: Any = intrinsic_or_python(_picks, _picked_in_python)


# A key: a square, in single precision, whose last bits are a place. Of numbers that are not negative the bits are in
# order as integers without a sign, of which a register is compared in half the time; and what is known of one moves
# with it. NaN comes after all of them.


def _key_of(typing_context: Any, square: Any, place: Any, tags: Any) -> Any:
    """Return the key (uint32) of a float32 square, not negative, and a place; `tags` has all bits that a place may."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(32))
        return builder.or_(builder.and_(bits, builder.not_(arguments[2])), arguments[1])

    return types.uint32(types.float32, types.int32, types.int32), generate


def _key_read(typing_context: Any, number: Any) -> Any:
    """Return the key that lies where a float32 may."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.uint32(types.float32), generate


def _key_written(typing_context: Any, key: Any) -> Any:
    """Return a key as what lies where a float32 may."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.uint32), generate


def _tag_of(typing_context: Any, key: Any, tags: Any) -> Any:
    """Return the place (int32) in a key."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.and_(*arguments)

    return types.int32(types.uint32, types.int32), generate


def _same_key(typing_context: Any, one: Any, other: Any, tags: Any) -> Any:
    """Say whether two keys differ in their places alone: then which square is smaller is not known."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        one, other, tags = arguments
        return builder.icmp_unsigned("==", builder.or_(one, tags), builder.or_(other, tags))

    return types.boolean(types.uint32, types.uint32, types.int32), generate


def _ordered(typing_context: Any, one: Any, other: Any) -> Any:
    """Return two keys, the lesser one first."""
    pair: Any = types.UniTuple

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        one, other = arguments
        first = builder.icmp_unsigned("<", one, other)
        both = builder.select(first, one, other), builder.select(first, other, one)
        return context.make_tuple(builder, signature.return_type, both)

    return pair(types.uint32, 2)(types.uint32, types.uint32), generate


def _key_in_python(square: Any, place: Any, tags: Any) -> Any:
    return (np.float32(square).view(np.uint32) & ~np.uint32(tags)) | np.uint32(place)


key_of: Any = intrinsic_or_python(_key_of, _key_in_python)
key_read: Any = intrinsic_or_python(_key_read, lambda number: np.float32(number).view(np.uint32))
key_written: Any = intrinsic_or_python(_key_written, lambda key: np.uint32(key).view(np.float32))
tag_of: Any = intrinsic_or_python(_tag_of, lambda key, tags: np.int32(key & np.uint32(tags)))
same_key: Any = intrinsic_or_python(_same_key, lambda one, other, tags: (one ^ other) & ~np.uint32(tags) == 0)
ordered: Any = intrinsic_or_python(_ordered, lambda one, other: (min(one, other), max(one, other)))


@kernel
def take(to: Any, table: Any, who: Any, count: int) -> None:
    """Write into to (R, K, N) what the first R rows of a table (.., N') of `count` agents say of those listed, (K, N).

    N and N' are multiples of PAIR, and whom the lists name beyond the last agent is below `count`, too.
    """
    many, listed, n = np.uint64(to.shape[0]), np.uint64(who.shape[0]), np.uint64(who.shape[1])
    if np.uint64(count) <= np.uint64(SHORT * cpu.REGISTER // 4):
        beside, length, agents = listed * n, np.uint64(table.shape[1]), np.uint64(count)
        for i in range(np.uint64(0), listed * n, np.uint64(SIDE)):
            pick(to, i, beside, table, np.uint64(0), length, many, agents, who, i, SIDE)
    else:
        for r in range(many):
            for s in range(listed):
                for i in range(n):
                    to[r, s, i] = table[r, np.uint64(who[s, i])]


def _turned_square(
    typing_context: Any, to: Any, at: Any, across: Any, many: Any, source: Any, place: Any, down: Any
) -> Any:
    """Copy a square of numbers turned: column k, from `place` + k * `down`, goes to every `across`-th from `at` + k.

    Its side is SQUARE; the first `many` rows of it are written.
    """
    in_one_piece(to)
    in_one_piece(source)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = ir.VectorType(context.get_data_type(to.dtype), SQUARE)
        targets, sources = (array_of(context, builder, kind, arguments[k]).data for k, kind in ((0, to), (4, source)))

        def line(base: Any, k: int, first: Any, step: Any) -> Any:
            here = builder.add(first, builder.mul(step, ir.Constant(step.type, k)))
            return builder.bitcast(builder.gep(base, [here]), vector.as_pointer())

        numbers = [builder.load(line(sources, k, *arguments[5:]), align=4) for k in range(SQUARE)]
        sides = [1 << k for k in range(SQUARE.bit_length() - 1)]
        for s in sides:  # of four squares of s in one of 2 s, two are swapped
            low = [SQUARE + k - s if k & s else k for k in range(SQUARE)]
            high = [SQUARE + k if k & s else k + s for k in range(SQUARE)]
            masks = [ir.Constant(ir.VectorType(ir.IntType(32), SQUARE), mask) for mask in (low, high)]
            for r in (r for r in range(SQUARE) if not r & s):
                pair = numbers[r], numbers[r + s]
                numbers[r], numbers[r + s] = (builder.shuffle_vector(*pair, mask) for mask in masks)
        for k in range(SQUARE):
            with builder.if_then(builder.icmp_unsigned(">", arguments[3], ir.Constant(arguments[3].type, k))):
                builder.store(numbers[k], line(targets, k, *arguments[1:3]), align=4)
        return context.get_dummy_value()

    return types.void(to, types.uint64, types.uint64, types.uint64, source, types.uint64, types.uint64), generate


def _turned_in_python(to: Any, at: Any, across: Any, many: Any, source: Any, place: Any, down: Any) -> None:
    rows, numbers = to.reshape(-1), source.reshape(-1)
    for i in range(min(int(many), SQUARE)):
        start, first = int(at) + i * int(across), int(place) + i
        rows[start : start + SQUARE] = numbers[first : first + SQUARE * int(down) : int(down)][:SQUARE]


_turn_square: Any = intrinsic_or_python(_turned_square, _turned_in_python)


@kernel
def into_rows(rows: Any, flat: Any, many: int, distance: int) -> None:
    """Copy columns, `distance` apart in scratch, into the first `many` numbers of rows (L, O) float32 in one piece.

    Squares at the end of a row overlap with those before them: what is copied twice is the same.
    """
    count, size, step = rows.shape[0], np.uint64(rows.shape[1]), np.uint64(distance)
    if many >= SQUARE:
        for i in range(0, count, SQUARE):
            row, left = np.uint64(i), np.uint64(count - i)
            for c in range(0, many, SQUARE):
                column = np.uint64(min(c, many - SQUARE))
                _turn_square(rows, row * size + column, size, left, flat, column * step + row, step)
    else:
        for i in range(count):
            for c in range(many):
                rows[i, c] = flat[np.uint64(c * distance + i)]
