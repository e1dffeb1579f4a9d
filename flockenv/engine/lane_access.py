"""Reading and writing several numbers at once, at places that are constants of a plan.

A section knows where the numbers of an agent lie: side by side in a record, or each in a row of its own. It holds those
places as tuples of integers, and each function below compiles to one load or store per number, without a loop or a
call.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types

from flockenv.jit.intrinsics import intrinsic_or_python
from flockenv.jit.memory import array_of

__all__ = [
    "add_where",
    "choose",
    "copy_each",
    "fill",
    "gather",
    "gather_each",
    "pick_items",
    "places_each",
    "scatter",
    "scatter_each",
]

_tuple_of: Callable[..., Any] = types.BaseTuple.from_types
_WORD = ir.IntType(64)


def _constants(numbers: Any, name: str) -> list[int]:
    """Return the integers of a tuple that a function holds; numba retries with literals if they are not known yet."""
    if not all(isinstance(number, types.IntegerLiteral) for number in numbers):
        raise numba.TypingError(f"{name}: {numbers}, must be a tuple of integers that are constants of the function")
    return [int(number.literal_value) for number in numbers]


def _pointers(context: Any, builder: Any, kind: Any, array: Any, at: Any, places: list[int]) -> tuple[list[Any], int]:
    """Return pointers to the numbers of an array at some places behind `at`, and the size of a number, bytes."""
    data, size = array_of(context, builder, kind, array).data, context.get_abi_sizeof(context.get_data_type(kind.dtype))
    return [builder.gep(data, [builder.add(at, _WORD(place))]) for place in places], size


def _gather(typing_context: Any, array: Any, at: Any, places: Any) -> Any:
    """Return the numbers of an array at some places behind `at`, as a tuple; 0 for a negative place."""
    wanted = _constants(places, "places")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointers, size = _pointers(context, builder, signature.args[0], arguments[0], arguments[1], wanted)
        none = ir.Constant(context.get_data_type(array.dtype), 0)
        found = [
            builder.load(pointer, align=size) if place >= 0 else none
            for place, pointer in zip(wanted, pointers, strict=True)
        ]
        return context.make_tuple(builder, signature.return_type, found)

    return _tuple_of([array.dtype] * len(wanted))(array, types.uint64, places), generate


def _gather_in_python(array: Any, at: Any, places: tuple[int, ...]) -> tuple[Any, ...]:
    return tuple(array[int(at) + place] if place >= 0 else array.dtype.type(0) for place in places)


gather: Any = intrinsic_or_python(_gather, _gather_in_python)


def _scatter(typing_context: Any, array: Any, at: Any, places: Any, numbers: Any) -> Any:
    """Write the numbers of a tuple to some places of an array behind `at`."""
    wanted = _constants(places, "places")
    if len(wanted) != len(numbers):
        raise numba.TypingError(f"scatter: {numbers} to {len(wanted)} places, must be as many")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointers, size = _pointers(context, builder, signature.args[0], arguments[0], arguments[1], wanted)
        for k, pointer in enumerate(pointers):
            value = context.cast(builder, builder.extract_value(arguments[3], k), numbers[k], array.dtype)
            builder.store(value, pointer, align=size)
        return context.get_dummy_value()

    return types.void(array, types.uint64, places, numbers), generate


def _scatter_in_python(array: Any, at: Any, places: tuple[int, ...], numbers: Any) -> None:
    for place, number in zip(places, numbers, strict=True):
        array[int(at) + place] = number


scatter: Any = intrinsic_or_python(_scatter, _scatter_in_python)


def _fill(typing_context: Any, array: Any, at: Any, places: Any, number: Any) -> Any:
    """Write one number to some places of an array behind `at`."""
    wanted = _constants(places, "places")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointers, size = _pointers(context, builder, signature.args[0], arguments[0], arguments[1], wanted)
        for pointer in pointers:
            builder.store(arguments[3], pointer, align=size)
        return context.get_dummy_value()

    return types.void(array, types.uint64, places, array.dtype), generate


def _fill_in_python(array: Any, at: Any, places: tuple[int, ...], number: Any) -> None:
    for place in places:
        array[int(at) + place] = number


fill: Any = intrinsic_or_python(_fill, _fill_in_python)


def _add_where(typing_context: Any, some: Any, array: Any, at: Any, places: Any, numbers: Any, nothing: Any) -> Any:
    """Add the numbers of a tuple to those of an array at some places behind `at` if `some`, else `nothing`, -0.

    The sum takes a selected summand: from a selection between sums LLVM makes a masked store, and the sum stays in
    memory. x + -0 is x for every x, so this becomes one masked addition.
    """
    wanted = _constants(places, "places")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointers, size = _pointers(context, builder, signature.args[1], arguments[1], arguments[2], wanted)
        for k, pointer in enumerate(pointers):
            value = context.cast(builder, builder.extract_value(arguments[4], k), numbers[k], array.dtype)
            added = builder.select(arguments[0], value, arguments[5])
            builder.store(builder.fadd(builder.load(pointer, align=size), added), pointer, align=size)
        return context.get_dummy_value()

    return types.void(types.boolean, array, types.uint64, places, numbers, array.dtype), generate


def _add_where_in_python(
    some: bool, array: Any, at: Any, places: tuple[int, ...], numbers: Any, nothing: Any
) -> None:  # fmt: skip
    for place, number in zip(places, numbers, strict=True):
        array[int(at) + place] += number if some else nothing


add_where: Any = intrinsic_or_python(_add_where, _add_where_in_python)


def _choose(typing_context: Any, condition: Any, numbers: Any, others: Any) -> Any:
    """Return one of two tuples of numbers, without a branch."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pairs = (tuple(builder.extract_value(arguments[j], k) for j in (1, 2)) for k in range(numbers.count))
        found = [builder.select(arguments[0], one, other) for one, other in pairs]
        return context.make_tuple(builder, signature.return_type, found)

    return numbers(types.boolean, numbers, numbers), generate


choose: Any = intrinsic_or_python(_choose, lambda condition, numbers, others: numbers if condition else others)


def _pick_items(typing_context: Any, given: Any, more: Any, indices: Any) -> Any:
    """Return a tuple of some items of two tuples or records; indices count through the first, then the second."""
    wanted, many = _constants(indices, "indices"), len(given)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        found = [
            builder.extract_value(arguments[0], k) if k < many else builder.extract_value(arguments[1], k - many)
            for k in wanted
        ]
        return context.make_tuple(builder, signature.return_type, found)

    return _tuple_of([given[k] if k < many else more[k - many] for k in wanted])(given, more, indices), generate


pick_items: Any = intrinsic_or_python(
    _pick_items, lambda given, more, indices: tuple((*given, *more)[k] for k in indices)
)


def _places_each(typing_context: Any, starts: Any, which: Any, further: Any) -> Any:
    """Return a tuple of places: `starts[which[k]] + further[k]`."""
    chosen_starts, offsets = _constants(which, "which"), _constants(further, "further")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pairs = zip(chosen_starts, offsets, strict=True)
        found = [builder.add(builder.extract_value(arguments[0], k), _WORD(offset)) for k, offset in pairs]
        return context.make_tuple(builder, signature.return_type, found)

    given, found = (_tuple_of([types.uint64] * len(numbers)) for numbers in (starts, which))
    return found(given, which, further), generate


def _places_in_python(starts: Any, which: Any, further: Any) -> tuple[int, ...]:
    return tuple(int(starts[start]) + offset for start, offset in zip(which, further, strict=True))


places_each: Any = intrinsic_or_python(_places_each, _places_in_python)


def _gather_each(typing_context: Any, arrays: Any, starts: Any, which: Any, further: Any) -> Any:
    """Return a tuple with one number of each array: that at `starts[which[k]] + further[k]` of array k."""
    chosen_starts, offsets = _constants(which, "which"), _constants(further, "further")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        found = []
        for k, (start, offset) in enumerate(zip(chosen_starts, offsets, strict=True)):
            array, at = (builder.extract_value(arguments[j], n) for j, n in ((0, k), (1, start)))
            (pointer,), size = _pointers(context, builder, arrays[k], array, at, [offset])
            found.append(builder.load(pointer, align=size))
        return context.make_tuple(builder, signature.return_type, found)

    many = types.UniTuple(types.uint64, len(starts))  # type: ignore[no-untyped-call]
    return _tuple_of([array.dtype for array in arrays])(arrays, many, which, further), generate


def _gather_each_in_python(arrays: Any, starts: Any, which: Any, further: Any) -> tuple[Any, ...]:
    places = zip(arrays, which, further, strict=True)
    return tuple(array[int(starts[start]) + offset] for array, start, offset in places)


gather_each: Any = intrinsic_or_python(_gather_each, _gather_each_in_python)


def _scatter_each(typing_context: Any, arrays: Any, starts: Any, which: Any, further: Any, numbers: Any) -> Any:
    """Write one number of a tuple to each array: to `starts[which[k]] + further[k]` of array k."""
    chosen_starts, offsets = _constants(which, "which"), _constants(further, "further")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        for k, (start, offset) in enumerate(zip(chosen_starts, offsets, strict=True)):
            array, at = (builder.extract_value(arguments[j], n) for j, n in ((0, k), (1, start)))
            (pointer,), size = _pointers(context, builder, arrays[k], array, at, [offset])
            value = context.cast(builder, builder.extract_value(arguments[4], k), numbers[k], arrays[k].dtype)
            builder.store(value, pointer, align=size)
        return context.get_dummy_value()

    many = types.UniTuple(types.uint64, len(starts))  # type: ignore[no-untyped-call]
    return types.void(arrays, many, which, further, numbers), generate


def _scatter_each_in_python(arrays: Any, starts: Any, which: Any, further: Any, numbers: Any) -> None:
    for array, start, offset, number in zip(arrays, which, further, numbers, strict=True):
        array[int(starts[start]) + offset] = number


scatter_each: Any = intrinsic_or_python(_scatter_each, _scatter_each_in_python)


def _copy_each(
    typing_context: Any, to: Any, at: Any, places: Any, arrays: Any, starts: Any, which: Any, further: Any, width: Any
) -> Any:
    """Copy `width` numbers of each array, from `starts[which[k]] + further[k]` on, to `at + places[k]`, as vectors."""
    targets, chosen_starts, offsets = (
        _constants(numbers, name) for numbers, name in ((places, "places"), (which, "which"), (further, "further"))
    )
    (wide,) = _constants((width,), "width")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.get_data_type(to.dtype)
        vector = ir.VectorType(number, wide).as_pointer()
        pointers, size = _pointers(context, builder, signature.args[0], arguments[0], arguments[1], targets)
        for k, (start, offset) in enumerate(zip(chosen_starts, offsets, strict=True)):
            array, begin = (builder.extract_value(arguments[j], n) for j, n in ((3, k), (4, start)))
            (source,), _ = _pointers(context, builder, arrays[k], array, begin, [offset])
            there = builder.bitcast(pointers[k], vector)
            builder.store(builder.load(builder.bitcast(source, vector), align=size), there, align=size)
        return context.get_dummy_value()

    if any(array.dtype != to.dtype for array in arrays):
        raise numba.TypingError(f"copy_each: {arrays} into {to}, must have one dtype")
    many = types.UniTuple(types.uint64, len(starts))  # type: ignore[no-untyped-call]
    return types.void(to, types.uint64, places, arrays, many, which, further, width), generate


def _copy_each_in_python(
    to: Any, at: Any, places: Any, arrays: Any, starts: Any, which: Any, further: Any, width: int
) -> None:  # fmt: skip
    for place, array, start, offset in zip(places, arrays, which, further, strict=True):
        begin = int(starts[start]) + offset
        to[int(at) + place : int(at) + place + width] = array[begin : begin + width]


copy_each: Any = intrinsic_or_python(_copy_each, _copy_each_in_python)
