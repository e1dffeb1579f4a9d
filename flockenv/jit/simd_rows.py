"""SIMD over agents: numbers of many agents side by side in the lanes of vector registers, and rows made from them.

An observation is returned as a row per agent, but computed for a register of agents at a time: a loop over agents
without branches becomes vector code, while a loop over one agent's neighbours is slowed by every mispredicted count of
neighbours. So a task writes columns, each one number of all agents, and square blocks of them are transposed into rows.
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
from flockenv.jit.intrinsics import intrinsic_or_python, literal_value
from flockenv.jit.memory import array_of, check_contiguous

__all__ = [
    "PAIR",
    "SIDE",
    "as_contiguous",
    "column_distance",
    "columns",
    "flatten",
    "float_as_key",
    "into_rows",
    "key_as_float",
    "key_of",
    "order_keys",
    "pick",
    "same_key",
    "tag_of",
    "take",
]  # fmt: skip

SIDE = LINE // 4
"""Single precision numbers in a cache line and in the longest vector register: agents in a block."""

SHORT = 8
"""Most registers of a table that is looked up in registers."""

SQUARE = cpu.REGISTER // 4
"""Single precision numbers in a vector register: the side of the square blocks that are transposed."""

PAIR = 2 * SIDE
"""Arrays of agents in lanes are padded to a multiple of this many agents."""


def column_distance(count: int) -> int:
    """Return the distance between columns of `count` agents, in numbers; in a kernel it is a constant.

    A constant lets LLVM prove that columns do not overlap, without checks at run time. Many counts share one distance,
    as each distance needs its own kernel. It is no power of two: such columns compete for the same cache sets.
    """
    return max(64, 1 << (count - 1).bit_length()) + SIDE


def _view(context: Any, builder: Any, kind: Any, old: Any, shape: Any, strides: Any) -> Any:
    """Return a view of an array with another shape and strides."""
    fill: Any = arrayobj.populate_array
    new = array_of(context, builder, kind)
    fill(new, data=old.data, shape=shape, strides=strides, itemsize=old.itemsize, meminfo=None)
    return new._getvalue()


def _bytes(context: Any, kind: Any) -> Any:
    """Return the size of one number of an array, as a constant of machine code."""
    return context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))


def _as_contiguous(typing_context: Any, array: Any) -> Any:
    """Return a contiguous array with strides computed from its shape, of which the last is a constant.

    A view of one world, (D, B, N) -> (D, N), has strides derived from these, so LLVM knows that its agents are
    adjacent.
    """
    check_contiguous(array)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = array_of(context, builder, array, arguments[0])
        unpack: Any = cgutils.unpack_tuple
        shape = unpack(builder, old.shape, array.ndim)
        strides = [_bytes(context, array)]
        for count in reversed(shape[1:]):
            strides.insert(0, builder.mul(strides[0], count))
        return _view(context, builder, array, old, shape, strides)

    return array(array), generate


as_contiguous: Any = intrinsic_or_python(_as_contiguous, lambda array: array)


def _flatten(typing_context: Any, array: Any) -> Any:
    """Return a flat view of a contiguous array."""
    check_contiguous(array)
    view = types.Array(array.dtype, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = array_of(context, builder, array, arguments[0])
        return _view(context, builder, view, old, [old.nitems], [_bytes(context, array)])

    return view(array), generate


flatten: Any = intrinsic_or_python(_flatten, lambda array: array.reshape(-1))


def _columns(typing_context: Any, flat: Any, count: Any, many: Any, distance: Any) -> Any:
    """Return a view (count, many) of scratch (at least many * distance,) whose columns are contiguous."""
    view = types.Array(flat.dtype, 2, "A")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = array_of(context, builder, flat, arguments[0])
        n, m, step = (
            context.cast(builder, a, kind, types.intp)
            for a, kind in zip(arguments[1:], signature.args[1:], strict=True)
        )
        size = _bytes(context, flat)
        return _view(context, builder, view, old, [n, m], [size, builder.mul(size, step)])

    return view(flat, count, many, distance), generate


def _columns_in_python(flat: Any, count: int, many: int, distance: int) -> Any:
    step = flat.itemsize
    return np.lib.stride_tricks.as_strided(flat, (int(count), int(many)), (step, step * int(distance)))


columns: Any = intrinsic_or_python(_columns, _columns_in_python)


def _lookup(builder: Any, vector: Any, size: int) -> tuple[int, Any]:
    """Return the table size of the look-up instruction and the call that generates it; (0, None) if there is none.

    The instruction takes the low bits of the indices, and one register of the table, or two.
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


def _look_up(builder: Any, part: Any, named: Any, vector: Any, size: int, count: Any) -> Any:
    """Generate the look-up of the indices `named` in a table that `part` reads, PAIR entries at a time."""
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


def _read_each(builder: Any, part: Any, named: Any, vector: Any) -> Any:
    """Generate code that reads the entries of the indices `named` one by one."""
    found = ir.Constant(vector, ir.Undefined)
    for k in range(vector.count):
        here = builder.zext(builder.extract_element(named, ir.IntType(32)(k)), ir.IntType(64))
        found = builder.insert_element(found, part(here, vector.element), ir.IntType(32)(k))
    return found


def _pick(
    typing_context: Any, to: Any, at: Any, beside: Any, table: Any, first: Any, length: Any, many: Any, count: Any,
    who: Any, place: Any, width: Any,
) -> Any:  # fmt: skip
    """Gather `width` entries of each of `many` rows of a table of `count` agents, at the indices `who[place]` and on.

    The first row begins at table[first], the next `length` later, and may be read up to a multiple of PAIR. Its entries
    are written to to[at] and on, those of the next row `beside` later. All arrays are contiguous, with flat indices.
    Short rows are looked up in registers if the processor has the instruction; otherwise entries are read one by one.
    """
    for array in (to, table, who):
        check_contiguous(array)
    wide = literal_value(width, "width")

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
                        each(begin, named, _look_up, size, arguments[7])
                with long:
                    each(begin, named, _read_each)
        return context.get_dummy_value()

    number = types.uint64
    given = (to, number, number, table, number, number, number, number, who, number, width)
    return types.void(*given), generate


def _pick_in_python(
    to: Any, at: Any, beside: Any, table: Any, first: Any, length: Any, many: Any, count: Any, who: Any, place: Any,
    width: int,
) -> None:  # fmt: skip
    named = who.reshape(-1)[int(place) : int(place) + width].astype(np.int64)
    for r in range(int(many)):
        row = table.reshape(-1)[int(first) + r * int(length) :]
        start = int(at) + r * int(beside)
        to.reshape(-1)[start : start + width] = row[named]


pick: Any = intrinsic_or_python(_pick, _pick_in_python)


# A key: a squared distance, in single precision, whose low bits are replaced by a place (an index). The bits of numbers
# >= 0 sort like unsigned integers, which are compared in half the time, and each place stays with its square. NaN sorts
# last.


def _key_of(typing_context: Any, square: Any, place: Any, tags: Any) -> Any:
    """Return the key (uint32) of a float32 square >= 0 and a place; `tags` is the mask of the bits of places."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(32))
        return builder.or_(builder.and_(bits, builder.not_(arguments[2])), arguments[1])

    return types.uint32(types.float32, types.int32, types.int32), generate


def _float_as_key(typing_context: Any, number: Any) -> Any:
    """Return the key whose bits are stored as a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.uint32(types.float32), generate


def _key_as_float(typing_context: Any, key: Any) -> Any:
    """Return the float32 with the bits of a key."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.uint32), generate


def _tag_of(typing_context: Any, key: Any, tags: Any) -> Any:
    """Return the place (int32) in a key."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.and_(*arguments)

    return types.int32(types.uint32, types.int32), generate


def _same_key(typing_context: Any, one: Any, other: Any, tags: Any) -> Any:
    """Return True if two keys differ only in their places: it is then unknown which square is smaller."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        one, other, tags = arguments
        return builder.icmp_unsigned("==", builder.or_(one, tags), builder.or_(other, tags))

    return types.boolean(types.uint32, types.uint32, types.int32), generate


def _order_keys(typing_context: Any, one: Any, other: Any) -> Any:
    """Return two keys, the smaller one first."""
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
float_as_key: Any = intrinsic_or_python(_float_as_key, lambda number: np.float32(number).view(np.uint32))
key_as_float: Any = intrinsic_or_python(_key_as_float, lambda key: np.uint32(key).view(np.float32))
tag_of: Any = intrinsic_or_python(_tag_of, lambda key, tags: np.int32(key & np.uint32(tags)))
same_key: Any = intrinsic_or_python(_same_key, lambda one, other, tags: (one ^ other) & ~np.uint32(tags) == 0)
order_keys: Any = intrinsic_or_python(_order_keys, lambda one, other: (min(one, other), max(one, other)))


@kernel
def take(to: Any, table: Any, who: Any, count: int) -> None:
    """Gather the first R rows of a table (.., N') of `count` agents at the indices `who` (K, N) into to (R, K, N).

    N and N' are multiples of PAIR, and indices beyond the last agent are also below `count`.
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


def _transpose_one_square(
    typing_context: Any, to: Any, at: Any, across: Any, many: Any, source: Any, place: Any, down: Any
) -> Any:
    """Transpose a square: read line k at `place` + k `down`, write line j of the result at `at` + j `across`.

    Its side is SQUARE; only the first `many` lines of the result are written.
    """
    check_contiguous(to)
    check_contiguous(source)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = ir.VectorType(context.get_data_type(to.dtype), SQUARE)
        targets, sources = (array_of(context, builder, kind, arguments[k]).data for k, kind in ((0, to), (4, source)))

        def line(base: Any, k: int, first: Any, step: Any) -> Any:
            here = builder.add(first, builder.mul(step, ir.Constant(step.type, k)))
            return builder.bitcast(builder.gep(base, [here]), vector.as_pointer())

        numbers = [builder.load(line(sources, k, *arguments[5:]), align=4) for k in range(SQUARE)]
        sides = [1 << k for k in range(SQUARE.bit_length() - 1)]
        for s in sides:  # in each square of side 2 s, swap the two off-diagonal squares of side s
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


def _transpose_in_python(to: Any, at: Any, across: Any, many: Any, source: Any, place: Any, down: Any) -> None:
    rows, numbers = to.reshape(-1), source.reshape(-1)
    for i in range(min(int(many), SQUARE)):
        start, first = int(at) + i * int(across), int(place) + i
        rows[start : start + SQUARE] = numbers[first : first + SQUARE * int(down) : int(down)][:SQUARE]


_transpose_square: Any = intrinsic_or_python(_transpose_one_square, _transpose_in_python)


@kernel
def into_rows(rows: Any, flat: Any, many: int, distance: int) -> None:
    """Copy columns, `distance` apart in scratch, into the first `many` numbers of contiguous rows (L, O) float32.

    The last square of a row may overlap with the one before it: the same numbers are written twice.
    """
    count, size, step = rows.shape[0], np.uint64(rows.shape[1]), np.uint64(distance)
    if many >= SQUARE:
        for i in range(0, count, SQUARE):
            row, left = np.uint64(i), np.uint64(count - i)
            for c in range(0, many, SQUARE):
                column = np.uint64(min(c, many - SQUARE))
                _transpose_square(rows, row * size + column, size, left, flat, column * step + row, step)
    else:
        for i in range(count):
            for c in range(many):
                rows[i, c] = flat[np.uint64(c * distance + i)]
