"""Lines of memory: asked for in good time, and written past the caches.

A store waits for a line of memory that is not at hand, which is then read in vain where all of it is written. So lines
are asked for before they are written; and where so much is written that it stays in no cache, it is made in scratch,
which does, and copied past the caches line by line: nothing is read.
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
from flockenv.jit.intrinsics import asked, intrinsic_or_python

__all__ = ["array_of", "fetch", "in_one_piece", "pour", "put_past", "settle", "zeros"]


def zeros(shape: int | tuple[int, ...], dtype: Any = np.float64) -> NDArray[Any]:
    """Return zeros that begin where a line does: no vector of theirs lies in two of them, in any process."""
    kind, count = np.dtype(dtype), math.prod(shape) if isinstance(shape, tuple) else shape
    room = np.zeros(count * kind.itemsize + LINE, np.uint8)
    first = -room.__array_interface__["data"][0] % LINE
    return np.ndarray(shape, kind, room, first)


def in_one_piece(array: Any) -> None:
    """Refuse to compile for an array whose numbers need not lie side by side."""
    if array.layout != "C":
        raise TypingError(f"{array} must lie in one piece")


def array_of(context: Any, builder: Any, kind: Any, value: Any = None) -> Any:
    """Return numba's structure of an array, of this value if there is one."""
    make: Any = arrayobj.make_array
    return make(kind)(context, builder, value) if value is not None else make(kind)(context, builder)


def _fetch(typing_context: Any, array: Any, part: Any, parts: Any) -> Any:
    """Ask for the memory of one of so many parts of an array in one piece, which is needed soon.

    Rows are written at a stretch, and a store waits for a line of memory that is not at hand. Asked for all at once,
    they would be waited for just so: what asks has room for a dozen lines.
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
            asked(builder, builder.gep(data, [at]))
        return context.get_dummy_value()

    return types.void(array, part, parts), generate


fetch: Any = intrinsic_or_python(_fetch, lambda array, part, parts: None)


def put_past(builder: Any, vector: Any, place: Any, size: int) -> None:
    """Generate what writes a vector of so many bytes past the caches, to a place whose address is a multiple of that.

    Whoever writes a line of memory writes all of it, so that nothing is read before.
    """
    stored = builder.store(vector, place, align=size)
    stored.set_metadata("nontemporal", builder.module.add_metadata([ir.IntType(32)(1)]))


def _poured(typing_context: Any, to: Any, at: Any, source: Any) -> Any:
    """Copy an array into another one, counted through from `at` on, past the caches; both are in one piece.

    Whole lines go past them, what begins or ends within a line does not. Other threads see all after `settle`.
    """
    in_one_piece(to)
    in_one_piece(source)
    if to.dtype != source.dtype:
        raise TypingError(f"{source} is poured into {to}: their numbers differ")

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
            put_past(builder, builder.load(here, align=size), there, LINE)
        for begin, end in ((word(0), head), (tail, old.nitems)):
            with each(builder, begin, end, word(1)) as (k, _):
                builder.store(builder.load(builder.gep(old.data, [k])), builder.gep(start, [k]))
        return context.get_dummy_value()

    return types.void(to, types.uint64, source), generate


def _poured_in_python(to: Any, at: Any, source: Any) -> None:
    to.reshape(-1)[int(at) : int(at) + source.size] = source.reshape(-1)


pour: Any = intrinsic_or_python(_poured, _poured_in_python)


def _settled(typing_context: Any) -> Any:
    """Wait until all that was written, past the caches too, is where other threads see it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


settle: Any = intrinsic_or_python(_settled, lambda: None)
