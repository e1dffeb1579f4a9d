"""Cache lines: prefetches, and streaming stores that bypass the caches.

A store to a line that is not in a cache waits until that line is read, even if all of it is overwritten. So lines are
prefetched before they are written. If the output is larger than the caches, it is computed in scratch, which fits, and
copied by streaming stores line by line, without reading the target.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.np import arrayobj
from numpy.typing import NDArray

from flockenv.jit.cpu import LINE
from flockenv.jit.intrinsics import generate_prefetch, intrinsic_or_python

__all__ = [
    "array_of",
    "check_contiguous",
    "generate_streaming_store",
    "prefetch",
    "store_fence",
    "stream_store",
    "zeros",
]


def zeros(shape: int | tuple[int, ...], dtype: Any = np.float64) -> NDArray[Any]:
    """Return zeros aligned to a cache line, so that no vector register is loaded from two lines."""
    kind, count = np.dtype(dtype), math.prod(shape) if isinstance(shape, tuple) else shape
    room = np.zeros(count * kind.itemsize + LINE, np.uint8)
    first = -room.__array_interface__["data"][0] % LINE
    return np.ndarray(shape, kind, room, first)


def check_contiguous(array: Any) -> None:
    """Raise TypingError unless an array type is contiguous (C layout)."""
    if array.layout != "C":
        raise TypingError(f"{array} must be contiguous")


def array_of(context: Any, builder: Any, kind: Any, value: Any = None) -> Any:
    """Return numba's structure of an array, initialised with `value` if given."""
    make: Any = arrayobj.make_array
    return make(kind)(context, builder, value) if value is not None else make(kind)(context, builder)


def _prefetch(typing_context: Any, array: Any, part: Any, parts: Any) -> Any:
    """Prefetch part `part` of `parts` equal parts of a contiguous array that is written soon.

    A store waits for a line that is not in a cache. Prefetching all lines at once would wait as well: a processor can
    load only about a dozen lines at a time.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        old = array_of(context, builder, array, arguments[0])
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
            generate_prefetch(builder, builder.gep(data, [at]))
        return context.get_dummy_value()

    return types.void(array, part, parts), generate


prefetch: Any = intrinsic_or_python(_prefetch, lambda array, part, parts: None)


def generate_streaming_store(builder: Any, vector: Any, place: Any, size: int) -> None:
    """Generate a streaming store of a vector of `size` bytes to an address that is a multiple of `size`.

    The caller must write whole cache lines, so that none has to be read first.
    """
    stored = builder.store(vector, place, align=size)
    stored.set_metadata("nontemporal", builder.module.add_metadata([ir.IntType(32)(1)]))


def _stream_store(typing_context: Any, to: Any, at: Any, source: Any) -> Any:
    """Copy an array into `to`, from flat index `at` on, by streaming stores; both are contiguous.

    Whole cache lines bypass the caches; a partial line at either end does not. Other threads see the numbers after
    `store_fence`.
    """
    check_contiguous(to)
    check_contiguous(source)
    if to.dtype != source.dtype:
        raise TypingError(f"{source} is copied into {to}: their dtypes differ")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, old = (array_of(context, builder, signature.args[k], arguments[k]) for k in (0, 2))
        word, number = old.nitems.type, context.get_data_type(to.dtype)
        size = context.get_abi_sizeof(number)
        side = LINE // size
        vector = ir.VectorType(number, side).as_pointer()
        start = builder.gep(target.data, [arguments[1]])
        beside = builder.and_(builder.neg(builder.ptrtoint(start, word)), word(LINE - 1))  # bytes to the next line
        head = builder.udiv(beside, word(size))
        head = builder.select(builder.icmp_unsigned("<", head, old.nitems), head, old.nitems)
        rest = builder.urem(builder.sub(old.nitems, head), word(side))
        tail = builder.sub(old.nitems, rest)
        each: Any = cgutils.for_range_slice
        with each(builder, head, tail, word(side)) as (k, _):
            here, there = (builder.bitcast(builder.gep(base, [k]), vector) for base in (old.data, start))
            generate_streaming_store(builder, builder.load(here, align=size), there, LINE)
        for begin, end in ((word(0), head), (tail, old.nitems)):
            with each(builder, begin, end, word(1)) as (k, _):
                builder.store(builder.load(builder.gep(old.data, [k])), builder.gep(start, [k]))
        return context.get_dummy_value()

    return types.void(to, types.uint64, source), generate


def _stream_store_in_python(to: Any, at: Any, source: Any) -> None:
    to.reshape(-1)[int(at) : int(at) + source.size] = source.reshape(-1)


stream_store: Any = intrinsic_or_python(_stream_store, _stream_store_in_python)


def _store_fence(typing_context: Any) -> Any:
    """Wait until all stores, streaming stores included, are visible to other threads."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


store_fence: Any = intrinsic_or_python(_store_fence, lambda: None)
