"""Sorted lists of the nearest, updated as candidates come: as squares and places, or as keys that hold both.

A list is a tuple of numbers, which lie lane beside lane in scratch; each function below compiles to comparisons and
selections, without a loop or a branch, so that lists stay in vector registers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types

from flockenv.jit.intrinsics import intrinsic_or_python

__all__ = ["AT_ONCE", "exchanges", "insert", "insert_distance", "merge"]

AT_ONCE = 4
"""The number of keys that are inserted into a list at once."""

_tuple_of: Callable[..., Any] = types.BaseTuple.from_types


def _insert(typing_context: Any, numbers: Any, far: Any, place: Any) -> Any:
    """Return a list, sorted distances and then their places, with a distance and its place inserted."""
    many = len(numbers) // 2

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        found = [builder.extract_value(arguments[0], k) for k in range(2 * many)]
        come = arguments[1:]
        for k in range(many):
            both = found[k], found[many + k]
            closer = builder.fcmp_ordered("<", come[0], both[0])
            found[k], found[many + k] = (builder.select(closer, *pair) for pair in zip(come, both, strict=True))
            come = [builder.select(closer, *pair) for pair in zip(both, come, strict=True)]
        return context.make_tuple(builder, signature.return_type, found)

    number = numbers[0]
    return _tuple_of([number] * (2 * many))(numbers, number, number), generate


def _insert_in_python(numbers: tuple[Any, ...], far: Any, place: Any) -> tuple[Any, ...]:
    many, found = len(numbers) // 2, list(numbers)
    for k in range(many):
        if far < found[k]:
            found[k], found[many + k], far, place = far, place, found[k], found[many + k]
    return tuple(found)


insert: Any = intrinsic_or_python(_insert, _insert_in_python)


def _insert_distance(typing_context: Any, numbers: Any, far: Any) -> Any:
    """Return a list of sorted distances with one inserted; the largest drops out."""
    many = len(numbers)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        found, come = [builder.extract_value(arguments[0], k) for k in range(many)], arguments[1]
        for k, near in enumerate(found):
            closer = builder.fcmp_ordered("<", come, near)
            found[k], come = builder.select(closer, come, near), builder.select(closer, near, come)
        return context.make_tuple(builder, signature.return_type, found)

    return numbers(numbers, numbers[0]), generate


def _insert_distance_in_python(numbers: tuple[Any, ...], far: Any) -> tuple[Any, ...]:
    found = list(numbers)
    for k, near in enumerate(numbers):
        if far < near:
            found[k], far = far, near
    return tuple(found)


insert_distance: Any = intrinsic_or_python(_insert_distance, _insert_distance_in_python)


def exchanges(many: int, come: int) -> Iterator[tuple[int, int]]:
    """Yield the exchanges that insert `come` numbers, at most AT_ONCE, into a sorted list of `many` before them.

    Each is two places, which are swapped unless the first holds the lesser number. Then the first `many` are the least
    of all, in order. Inserting one by one into a list of seven takes 13 instructions a key, and this 8. The new numbers
    are sorted; the lesser of the list's last and the first new one, and so on, are the nearest; and this bitonic
    sequence is sorted in as many rounds as its length has bits (Batcher, "Sorting networks and their applications",
    AFIPS 1968).
    """
    for a, b in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2)):
        if b < come:
            yield many + a, many + b
    for c in range(min(come, many)):
        yield many - 1 - c, many + c
    length = 1 << (many - 1).bit_length()  # as if padded to that length with the least numbers
    half, missing = length // 2, length - many
    while half:
        for k in range(missing, length):
            if not k & half:
                yield k - missing, k - missing + half
        half //= 2


def _merge(typing_context: Any, numbers: Any, come: Any) -> Any:
    """Return a list of keys (stored as float32) with new keys inserted; its length stays the same."""
    many = len(numbers)
    if len(come) != AT_ONCE or set(come) != {types.uint32} or set(numbers) != {types.float32}:
        raise numba.TypingError(f"merged: {come} into {numbers}, must be AT_ONCE uint32 keys into float32 numbers")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        found = [builder.bitcast(builder.extract_value(arguments[0], k), ir.IntType(32)) for k in range(many)]
        found += [builder.extract_value(arguments[1], k) for k in range(len(come))]
        for a, b in exchanges(many, len(come)):
            one, other = found[a], found[b]
            first = builder.icmp_unsigned("<", one, other)
            found[a], found[b] = builder.select(first, one, other), builder.select(first, other, one)
        numbers_ = [builder.bitcast(key, ir.FloatType()) for key in found[:many]]
        return context.make_tuple(builder, signature.return_type, numbers_)

    return numbers(numbers, come), generate


def _merge_in_python(numbers: tuple[Any, ...], come: tuple[Any, ...]) -> tuple[Any, ...]:
    found = [*(np.float32(number).view(np.uint32) for number in numbers), *come]
    for a, b in exchanges(len(numbers), len(come)):
        found[a], found[b] = min(found[a], found[b]), max(found[a], found[b])
    return tuple(key.view(np.float32) for key in found[: len(numbers)])


merge: Any = intrinsic_or_python(_merge, _merge_in_python)
