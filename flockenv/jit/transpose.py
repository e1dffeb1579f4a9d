"""Conversion between records of agents and SIMD lanes, a block of agents at a time, by shuffles.

Sorting moves one record per agent, which is one access to distant memory; computations use lanes, which hold one number
of many agents side by side.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types

from flockenv.jit import cpu
from flockenv.jit.cpu import LINE
from flockenv.jit.intrinsics import intrinsic_or_python, literal_value
from flockenv.jit.memory import array_of, generate_streaming_store

__all__ = ["out_of_records", "put_lines", "put_records"]

Vectors = list[Any]
_several: Any = types.UniTuple


def _power_of_two(length: int) -> int:
    """Return the smallest power of two >= `length`, the number of rows that are transposed."""
    return 1 << (length - 1).bit_length()


def _transpose(builder: Any, rows: Vectors) -> Vectors:
    """Return the numbers of P vectors of W lanes, both powers of two, lane by lane: P of lane 0, P of lane 1, ...

    Each of log2 P passes interleaves the first half of the vectors, laid end to end, with the second half.
    """
    half, width = len(rows) // 2, rows[0].type.count
    first = [k // 2 + (k % 2) * width for k in range(width)]
    masks = [_mask(first), _mask([k + width // 2 for k in first])]
    for _ in range(len(rows).bit_length() - 1):
        pairs = zip(rows[:half], rows[half:], strict=True)
        rows = [builder.shuffle_vector(*pair, mask) for pair in pairs for mask in masks]
    return rows


def _transpose_back(builder: Any, rows: Vectors) -> Vectors:
    """Undo `_transpose`."""
    width = rows[0].type.count
    masks = [_mask([2 * k + odd for k in range(width)]) for odd in (0, 1)]
    for _ in range(len(rows).bit_length() - 1):
        rows = [builder.shuffle_vector(*rows[k : k + 2], mask) for mask in masks for k in range(0, len(rows), 2)]
    return rows


def _mask(places: list[int]) -> Any:
    return ir.Constant(ir.VectorType(ir.IntType(32), len(places)), places)


def _part(builder: Any, vector: Any, first: int, count: int) -> Any:
    """Return `count` numbers of a vector, from `first` on."""
    return builder.shuffle_vector(vector, vector, _mask([first + k for k in range(count)]))


def _pointer(builder: Any, data: Any, place: Any, kind: Any) -> Any:
    return builder.bitcast(builder.gep(data, [place]), kind.as_pointer())


def _put_records(
    typing_context: Any, records: Any, sources: Any, places: Any, width: Any, cell: Any, first: Any, offset: Any,
    spare: Any,
) -> Any:  # fmt: skip
    """Write the records of `width` agents from `first` on, each to the next place of its cell, and advance that place.

    A record is the agent's index and one number from each source; in source k the numbers of these agents lie side by
    side from `places[k]` on. cell: int32, -1 for an agent without one: its record is written to place `spare`, behind
    all others. offset: int32, the next place of each cell. All arrays are contiguous.
    """
    wide, many = literal_value(width, "width"), 1 + sources.count
    size = _power_of_two(many)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, cells, offsets = (array_of(context, builder, signature.args[k], arguments[k]).data for k in (0, 4, 6))
        array, real = signature.args[1].dtype, context.get_data_type(signature.args[0].dtype)
        itemsize = context.get_abi_sizeof(real)
        side = min(wide, cpu.REGISTER // itemsize)  # lanes of a register
        vector, word, whole = ir.VectorType(real, side), ir.IntType(64), ir.IntType(32)
        several = ir.VectorType(whole, side)

        def rows(begin: int) -> Iterator[Any]:
            here = builder.add(arguments[5], word(begin))
            agent = builder.insert_element(ir.Constant(several, ir.Undefined), builder.trunc(here, whole), whole(0))
            agents = builder.shuffle_vector(agent, agent, _mask([0] * side))
            yield builder.sitofp(builder.add(agents, _mask(list(range(side)))), vector)
            for k in range(sources.count):
                data = array_of(context, builder, array, builder.extract_value(arguments[1], k)).data
                place = builder.add(builder.extract_value(arguments[2], k), word(begin))
                yield builder.load(_pointer(builder, data, place, vector), align=itemsize)
            for _ in range(many, size):
                yield ir.Constant(vector, ir.Undefined)

        flat: Vectors = []
        for begin in range(0, wide, side):
            flat += _transpose(builder, list(rows(begin)))
        starts = []  # computed before any record is stored, so that no store delays the next address
        for k in range(wide):
            c = builder.load(builder.gep(cells, [builder.add(arguments[5], word(k))]))
            none = builder.icmp_signed("<", c, whole(0))
            there = builder.gep(offsets, [builder.zext(builder.select(none, whole(0), c), word)])
            place = builder.load(there)
            builder.store(builder.add(place, builder.zext(builder.not_(none), whole)), there)
            place = builder.select(none, builder.trunc(arguments[7], whole), place)
            starts.append(builder.mul(builder.zext(place, word), word(many)))
        for k, start in enumerate(starts):
            for done in range(0, many, side):  # a record may be longer than a register
                count, at = min(many - done, side), k * size + done
                part = _part(builder, flat[at // side], at % side, count)
                where = _pointer(builder, to, builder.add(start, word(done)), part.type)
                builder.store(part, where, align=itemsize)
        return context.get_dummy_value()

    numbers = _several(types.uint64, sources.count)
    return types.void(records, sources, numbers, width, cell, types.uint64, offset, types.uint64), generate


def _records_in_python(
    records: Any, sources: Any, places: Any, width: int, cell: Any, first: Any, offset: Any, spare: Any
) -> None:
    many = 1 + len(sources)
    for lane in range(width):
        agent = int(first) + lane
        c = cell[agent]
        place = int(spare) if c < 0 else int(offset[c])
        if c >= 0:
            offset[c] += 1
        records[place * many] = agent
        for k, source in enumerate(sources):
            records[place * many + 1 + k] = source[int(places[k]) + lane]


put_records: Any = intrinsic_or_python(_put_records, _records_in_python)


def _put_lines(
    typing_context: Any, lines: Any, sources: Any, places: Any, width: Any, to: Any, first: Any, length: Any, spare: Any
) -> Any:  # fmt: skip
    """Write the numbers of `width` agents from `first` on, one from each source, as whole cache lines.

    This differs from `_put_records` in that a record is `length` numbers, aligned whole cache lines, and is written to
    place `to` (int32, in records; -1 for place `spare`). The numbers behind that of the last source are undefined.
    Streaming stores bypass the caches, so that lines, far from each other, are not read before they are written.
    """
    wide, many, piece = literal_value(width, "width"), sources.count, literal_value(length, "length")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data, where = (array_of(context, builder, signature.args[k], arguments[k]).data for k in (0, 4))
        array, real = signature.args[1].dtype, context.get_data_type(signature.args[0].dtype)
        itemsize = context.get_abi_sizeof(real)
        side = min(wide, cpu.REGISTER // itemsize)
        size = max(_power_of_two(many), LINE // itemsize)
        vector, word = ir.VectorType(real, side), ir.IntType(64)

        def row(k: int, begin: int) -> Any:
            if k >= many:
                return ir.Constant(vector, ir.Undefined)
            source = array_of(context, builder, array, builder.extract_value(arguments[1], k)).data
            place = builder.add(builder.extract_value(arguments[2], k), word(begin))
            return builder.load(_pointer(builder, source, place, vector), align=itemsize)

        for begin in range(0, wide, side):
            flat = _transpose(builder, [row(k, begin) for k in range(size)])
            for lane in range(side):
                here = builder.add(arguments[5], word(begin + lane))
                place = builder.sext(builder.load(builder.gep(where, [here])), word)
                place = builder.select(builder.icmp_signed("<", place, word(0)), arguments[7], place)
                start = builder.mul(place, word(piece))
                for done in range(0, piece, side):
                    pointer = _pointer(builder, data, builder.add(start, word(done)), vector)
                    generate_streaming_store(builder, flat[(lane * size + done) // side], pointer, side * itemsize)
        return context.get_dummy_value()

    numbers = _several(types.uint64, sources.count)
    return types.void(lines, sources, numbers, width, to, types.uint64, length, types.uint64), generate


def _lines_in_python(
    lines: Any, sources: Any, places: Any, width: int, to: Any, first: Any, length: int, spare: Any
) -> None:
    for lane in range(width):
        place = to[int(first) + lane]
        start = (int(spare) if place < 0 else int(place)) * length
        for k, source in enumerate(sources):
            lines[start + k] = source[int(places[k]) + lane]


put_lines: Any = intrinsic_or_python(_put_lines, _lines_in_python)


def _out_of_records(typing_context: Any, numbers: Any, places: Any, at: Any, width: Any, records: Any) -> Any:
    """Read the records of `width` agents from record `at` on; write number k of each to `numbers` from `places[k]` on.

    `places` has one entry for the agent's index and one for each number after it. The array must extend behind the last
    record, up to the next power of two of a record's length.
    """
    wide, many = literal_value(width, "width"), places.count
    size = _power_of_two(many)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, source = (array_of(context, builder, signature.args[k], arguments[k]).data for k in (0, 4))
        real, word = context.get_data_type(signature.args[0].dtype), ir.IntType(64)
        itemsize = context.get_abi_sizeof(real)
        side = min(wide, cpu.REGISTER // itemsize)  # lanes of a register
        vector = ir.VectorType(real, side)

        def piece(lane: int, done: int, count: int) -> Any:
            start = builder.mul(builder.add(arguments[2], word(lane)), word(many))
            place = builder.add(start, word(done))
            return builder.load(_pointer(builder, source, place, ir.VectorType(real, count)), align=itemsize)

        for first in range(0, wide, side):
            flat = []
            for k in range(size):  # the numbers in a register come from one record or from several
                lane, done = divmod(k * side, size)
                parts = [piece(first + lane + j, done, min(size, side)) for j in range(max(1, side // size))]
                while len(parts) > 1:
                    both = _mask(list(range(2 * parts[0].type.count)))
                    parts = [builder.shuffle_vector(*parts[j : j + 2], both) for j in range(0, len(parts), 2)]
                flat.append(parts[0])
            for k, row in enumerate(_transpose_back(builder, flat)[:many]):
                place = builder.add(builder.extract_value(arguments[1], k), word(first))
                builder.store(row, _pointer(builder, to, place, vector), align=itemsize)
        return context.get_dummy_value()

    numbered = _several(types.uint64, places.count)
    return types.void(numbers, numbered, types.uint64, width, records), generate


def _out_of_records_in_python(numbers: Any, places: Any, at: Any, width: int, records: Any) -> None:
    many = len(places)
    for lane in range(width):
        for k, place in enumerate(places):
            numbers[int(place) + lane] = records[(int(at) + lane) * many + k]


out_of_records: Any = intrinsic_or_python(_out_of_records, _out_of_records_in_python)
