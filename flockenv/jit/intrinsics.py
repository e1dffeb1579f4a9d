"""Operations that Python cannot express: vector copies, prefetches, atomic sums and barriers of threads.

Each is an intrinsic of numba, or a plain function if kernels run in Python (NUMBA_DISABLE_JIT=1).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np import arrayobj

from flockenv.jit import cpu
from flockenv.jit.cpu import LINE
from flockenv.jit.decorators import IN_PYTHON, kernel

__all__ = [
    "copy_lanes",
    "count_as_float",
    "count_if",
    "generate_prefetch",
    "intrinsic_or_python",
    "literal_value",
    "prefetch_for_write",
    "tuple_as_array",
    "unaliased",
    "wait_for_team",
]


def intrinsic_or_python(generate: Callable[..., Any], plain: Callable[..., Any]) -> Any:
    """Return an intrinsic or, with NUMBA_DISABLE_JIT=1, where kernels are plain Python, the function `plain`."""
    return plain if IN_PYTHON else intrinsic(generate)


def literal_value(number: Any, name: str) -> int:
    """Return an integer literal's value; otherwise raise TypingError, so that numba retries with literal types."""
    if not isinstance(number, types.IntegerLiteral):
        raise numba.TypingError(f"{name}: {number}, must be an integer literal")
    return int(number.literal_value)


def _unaliased(typing_context: Any) -> Any:
    """Declare, at the top of an entry point, that its array arguments do not overlap (C's `restrict`).

    Without it LLVM must assume that a sum it writes may be an input it reads, and keeps both out of registers: a factor
    of three in the pair loop. The caller of such an entry point must ensure it; Scene and World do, by allocating.

    The entry point may use the longest vector registers: on most Intel processors LLVM would halve them for the sake of
    surrounding code. Its stack is aligned for a register (LLVM's default is 16 bytes): otherwise a spilled register
    lies across two cache lines in some processes and not in others.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        for argument in builder.function.args:
            if isinstance(argument.type, ir.PointerType) and argument.name.startswith("arg."):
                argument.add_attribute("noalias")
        attributes = builder.function.attributes
        if isinstance(attributes, set):  # added verbatim: `add` of llvmlite accepts no attributes with values
            set.add(attributes, f'"prefer-vector-width"="{8 * LINE}"')
            set.add(attributes, '"stackrealign"')
        return context.get_dummy_value()

    return types.void(), generate


unaliased: Any = intrinsic_or_python(_unaliased, lambda: None)


def _copy_lanes(typing_context: Any, to: Any, at: Any, source: Any, place: Any, width: Any) -> Any:
    """Copy `width` numbers from source[place] on to to[at] on, as one vector, independent of loop vectorisation.

    Both arrays have one axis and are contiguous; indices are unsigned, and the width is a literal.
    """
    if to.dtype != source.dtype or (to.layout, source.layout, to.ndim, source.ndim) != ("C", "C", 1, 1):
        raise numba.TypingError(f"copy_lanes: {source} into {to}, must be contiguous 1-D arrays of one dtype")
    wide = literal_value(width, "width")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        make: Any = arrayobj.make_array
        number = context.get_data_type(signature.args[0].dtype)
        size = context.get_abi_sizeof(number)
        vector = ir.VectorType(number, wide).as_pointer()

        def pointer(k: int) -> Any:
            data = make(signature.args[k])(context, builder, arguments[k]).data
            return builder.bitcast(builder.gep(data, [arguments[k + 1]]), vector)

        builder.store(builder.load(pointer(2), align=size), pointer(0), align=size)
        return context.get_dummy_value()

    return types.void(to, types.uint64, source, types.uint64, width), generate


def _copy_in_python(to: Any, at: Any, source: Any, place: Any, width: int) -> None:
    to[int(at) : int(at) + width] = source[int(place) : int(place) + width]


copy_lanes: Any = intrinsic_or_python(_copy_lanes, _copy_in_python)


def generate_prefetch(builder: Any, address: Any) -> None:
    """Generate a prefetch, for writing, of the cache line at an address; an invalid address has no effect."""
    byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
    declare: Any = cgutils.get_or_insert_function
    kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
    prefetch = declare(builder.module, kind, "llvm.prefetch.p0i8")
    builder.call(prefetch, [builder.bitcast(address, byte), flag(1), flag(3), flag(1)])  # to write; near; data


def _prefetch_for_write(typing_context: Any, array: Any, place: Any) -> Any:
    """Prefetch the cache line of array[place], `place` a flat index, for a write that follows soon.

    Accesses in random order wait for one line after another; lines that are prefetched early load in parallel.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        make: Any = arrayobj.make_array
        data = make(signature.args[0])(context, builder, arguments[0]).data
        generate_prefetch(builder, builder.gep(data, [arguments[1]]))
        return context.get_dummy_value()

    return types.void(array, types.uint64), generate


prefetch_for_write: Any = intrinsic_or_python(_prefetch_for_write, lambda array, place: None)


def _tuple_as_array(typing_context: Any, numbers: Any) -> Any:
    """Return the numbers of a tuple as an array that a law may write; it is valid while the law's caller runs.

    It is on the stack, as laws allocate nothing. A law must not return it.
    """
    if not isinstance(numbers, types.UniTuple):
        raise numba.TypingError(f"stacked: {numbers}, must be a tuple of numbers of one dtype")
    array = types.Array(numbers.dtype, 1, "C")
    on_stack: Any = cgutils.alloca_once_value
    fill: Any = arrayobj.populate_array

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        make: Any = arrayobj.make_array
        number = context.get_data_type(numbers.dtype)
        place = on_stack(builder, arguments[0])
        made = make(array)(context, builder)
        size, count = (context.get_constant(types.intp, n) for n in (context.get_abi_sizeof(number), numbers.count))
        data = builder.bitcast(place, number.as_pointer())
        fill(made, data=data, shape=[count], strides=[size], itemsize=size, meminfo=None)
        return made._getvalue()

    return array(numbers), generate


tuple_as_array: Any = intrinsic_or_python(_tuple_as_array, np.array)


def _count_if(typing_context: Any, number: Any, flag: Any) -> Any:
    """Return the counter `number`, 0 at the start, incremented if `flag` is set; `count_as_float` reads it.

    With AVX-512 it is a float: a masked addition of 1 is one instruction. Otherwise its bits are an integer, from which
    the result of the comparison, -1 if the flag is set, is subtracted directly.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        real = arguments[0].type
        if cpu.REGISTER == LINE:
            return builder.fadd(arguments[0], builder.select(arguments[1], real(1.0), real(-0.0)))
        whole = ir.IntType(8 * context.get_abi_sizeof(arguments[0].type))
        more = builder.zext(arguments[1], whole)
        return builder.bitcast(builder.add(builder.bitcast(arguments[0], whole), more), arguments[0].type)

    return number(number, types.boolean), generate


def _count_as_float(typing_context: Any, number: Any) -> Any:
    """Return the count of a counter of `count_if` as a float."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if cpu.REGISTER == LINE:
            return arguments[0]
        real, whole = arguments[0].type, ir.IntType(8 * context.get_abi_sizeof(arguments[0].type))
        counted = builder.bitcast(arguments[0], whole)
        return builder.sitofp(builder.trunc(counted, ir.IntType(32)) if whole.width > 32 else counted, real)

    return number(number), generate


count_if: Any = intrinsic_or_python(_count_if, lambda number, flag: number + type(number)(flag))

count_as_float: Any = intrinsic_or_python(_count_as_float, lambda number: number)


def _atomic_fetch_add(typing_context: Any, array: Any, amount: Any) -> Any:
    """Atomically add to array[0]; return its previous value."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        make: Any = arrayobj.make_array
        place = make(signature.args[0])(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", place, arguments[1], "seq_cst")

    return types.int64(array, types.int64), generate


def _fetch_add_in_python(array: Any, amount: int) -> int:
    before = int(array[0])
    array[0] += amount
    return before


_fetch_add: Any = intrinsic_or_python(
    _atomic_fetch_add, _fetch_add_in_python
)  # Any: numba's stubs say that it never returns

_PATIENCE = 2000  # loops of waiting before the thread yields its core

_yield_core: Any = numba.njit(lambda: 0)

if os.name == "posix":
    _yield_core = types.ExternalFunction("sched_yield", types.int32())


@kernel
def wait_for_team(sync: Any, team: int) -> None:
    """Wait until all `team` threads that work on one world arrive (a barrier); sync: one int64, 0 at the start."""
    if team > 1:
        arrived = _fetch_add(sync, 1) + 1
        all_here = (arrived + team - 1) // team * team
        rounds = 0
        while _fetch_add(sync, 0) < all_here:
            rounds += 1
            if rounds > _PATIENCE:
                _yield_core()
