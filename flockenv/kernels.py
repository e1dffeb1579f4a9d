"""The one door to compiled code: laws and kernels are marked here; what Python calls of them is made in `section`.

numba's own disk cache never finds a closure again, and does not notice that a law has changed which a cached function
calls. So machine code is kept under a digest of all that it depends on: the functions of an entry point, what they
hold, and all sources of laws. A second process compiles nothing; an edited law compiles anew, always. What is read from
the cache folder was verified (`private_folder`, `checked_store`).
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.cpython.unsafe.tuple import tuple_setitem
from numba.extending import intrinsic, overload, register_jitable
from numba.np import arrayobj

from flockenv import (
    compilation,  # noqa: F401  # tells how long compiling takes
    frontend,
    inlining,
    lowering,
    processor,
)
from flockenv.inlining import Inlined
from flockenv.private_folder import first_private, prepared

__all__ = [
    "FAST",
    "IN_PYTHON",
    "LINE",
    "OPTIONS",
    "Law",
    "Numbers",
    "Vec",
    "ask_for",
    "asked",
    "cache_folder",
    "code_text",
    "copy_lanes",
    "described",
    "finite",
    "functions_in",
    "held",
    "intrinsic_or_python",
    "kernel",
    "law",
    "laws_digest",
    "like",
    "python_of",
    "replaced",
    "routine",
    "settled",
    "shared",
    "sources_of_code",
    "stacked",
    "tallied",
    "tally_of",
    "texts_outside",
    "unaliased",
    "unfused",
    "wait_for_team",
    "written",
]

F = TypeVar("F", bound=Callable[..., Any])

Law = Callable[..., Any]
"""A law, as records hold it: a function marked `law`, `kernel` or `unfused`."""

Vec = tuple[float, ...]
"""A vector inside a law: a tuple of D floats, D = 2 or 3."""

Numbers = tuple[float, ...]
"""As many numbers as there are: a tuple of floats of any length, the same for all agents."""

# Fused multiply-add and nothing else. The rest of fastmath gave no speed here and took much: with `arcp` and `afn` a
# division in a vector register is an estimate and a scalar one is exact, so that results depend on how agents are
# divided among threads; with `reassoc` and `nsz` a NaN check (x - x == 0) folds to True.
FAST = frozenset({"contract"})
# _nrt=False: no reference counts. Arrays belong to the caller of the entry point, for as long as it runs; counting
# every view of them with a locked instruction took nine tenths of the time of a world of 32 agents. So nothing compiled
# here may allocate (numba says so when it compiles): scratch is an argument.
OPTIONS: Any = {
    "forceinline": True, "fastmath": set(FAST), "error_model": "numpy", "nogil": True, "_nrt": False,
    "pipeline_class": Inlined,
}  # fmt: skip
_njit: Any = numba.njit  # numba's stubs do not know `_nrt`

IN_PYTHON: bool = numba.config.DISABLE_JIT  # type: ignore[attr-defined]  # made from the environment
"""True with NUMBA_DISABLE_JIT=1: kernels run in plain Python, for a debugger."""
if IN_PYTHON:
    np.seterr(all="ignore")  # as machine code does: infinities and NaN are values, unsigned integers wrap


def _marked(function: F, **options: Any) -> F:
    """Mark a part of kernels. numba asks for its signature twice, which takes longer than all else: it is told."""
    function.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
    return cast(F, _njit(**{**OPTIONS, **options})(function))


def law(function: F) -> F:
    """Mark a scalar law: branch-free if it can be, inlined into whatever loop calls it, never called on its own.

    For numba the same as `kernel`; the two words tell readers what is physics, and what is a part of the engine.
    """
    return _marked(function)


def unfused(function: F) -> F:
    """Mark a law that must give the same bits in every loop it is inlined into: no multiply is fused with an add."""
    return _marked(function, fastmath=False)


def kernel(function: F) -> F:
    """Mark a part of a kernel, that reads and writes arrays or puts laws together; compiled with what calls it."""
    return _marked(function)


def routine(function: F) -> F:
    """Mark a function that a kernel calls from several places, and that is compiled once for all of them."""
    return _marked(function, forceinline=False)


def shared(function: F) -> F:
    """Mark a law that Python calls too, as it stands: what a method's `advance` needs, which runs in both."""
    mark: Any = register_jitable
    return cast(F, mark(**OPTIONS)(function))


def like(x: float, constant: float) -> float:
    """Return `constant` in the precision of `x`: a bare 0.5 would turn a float32 law into a float64 one."""
    return type(x)(constant)


def replaced(numbers: tuple[float, ...], k: int, x: float) -> tuple[float, ...]:
    """Return the numbers with x in place k."""
    return (*numbers[:k], x, *numbers[k + 1 :])


@overload(replaced, jit_options=OPTIONS)
def _replaced(numbers, k, x):  # type: ignore[no-untyped-def]
    return lambda numbers, k, x: tuple_setitem(numbers, k, x)  # type: ignore[call-arg]


@law
def finite(x: float) -> bool:
    """Is x a number, neither NaN nor infinite?"""
    return abs(x) < like(x, math.inf)


@overload(like, jit_options=OPTIONS)
def _like(x, constant):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    to = types.float32 if x == types.float32 else types.float64
    return lambda x, constant: to(constant)


def intrinsic_or_python(generate: Callable[..., Any], plain: Callable[..., Any]) -> Any:
    """Return an intrinsic; with NUMBA_DISABLE_JIT=1, which runs kernels in plain Python, what it does there."""
    return plain if IN_PYTHON else intrinsic(generate)


def _unaliased(typing_context: Any) -> Any:
    """Promise, at the top of an entry point, that its array arguments do not overlap (C's `restrict`).

    Without it LLVM must assume that a sum it writes may be an input it reads, and keeps both out of registers: a factor
    of three in a sweep. Whoever calls such an entry point keeps the promise; Scene and World do, by allocating.

    Its loops may use the longest registers there are: on most of Intel's processors LLVM would halve them, for the sake
    of code around them. And its stack begins where a register may lie (LLVM leaves it at 16 bytes): else one that is
    put there for a while lies across two lines of the cache, in one process and not in the next.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        for argument in builder.function.args:
            if isinstance(argument.type, ir.PointerType) and argument.name.startswith("arg."):
                argument.add_attribute("noalias")
        attributes = builder.function.attributes
        if isinstance(attributes, set):  # written as they stand; but `add` of llvmlite's knows none that has a value
            set.add(attributes, f'"prefer-vector-width"="{8 * LINE}"')
            set.add(attributes, '"stackrealign"')
        return context.get_dummy_value()

    return types.void(), generate


unaliased: Any = intrinsic_or_python(_unaliased, lambda: None)


def _add_at_once(typing_context: Any, array: Any, amount: Any) -> Any:
    """Add to array[0] in one indivisible step; return what was there before."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        make: Any = arrayobj.make_array
        place = make(signature.args[0])(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", place, arguments[1], "seq_cst")

    return types.int64(array, types.int64), generate


def written(number: Any, name: str) -> int:
    """Return an integer that is known while compiling; numba tries again with its value if it did not tell it."""
    if not isinstance(number, types.IntegerLiteral):
        raise numba.TypingError(f"{name}: {number}, must be written as a number")
    return int(number.literal_value)


def _added_in_python(array: Any, amount: int) -> int:
    before = int(array[0])
    array[0] += amount
    return before


_fetch_add: Any = intrinsic_or_python(_add_at_once, _added_in_python)  # Any: numba's stubs say that it never returns

LINE = 64
"""Bytes of a line of the cache; no vector register is longer."""


def _copy_lanes(typing_context: Any, to: Any, at: Any, source: Any, place: Any, width: Any) -> Any:
    """Copy `width` numbers, from `place` on, to where `at` is: as one vector, whatever becomes of loops.

    Both arrays have one axis and lie in one piece; places are counted without a sign, and the width is written down.
    """
    if to.dtype != source.dtype or (to.layout, source.layout, to.ndim, source.ndim) != ("C", "C", 1, 1):
        raise numba.TypingError(f"copy_lanes: {source} into {to}, must be one row of the same numbers, in one piece")
    wide = written(width, "width")

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


def _copied_in_python(to: Any, at: Any, source: Any, place: Any, width: int) -> None:
    to[int(at) : int(at) + width] = source[int(place) : int(place) + width]


copy_lanes: Any = intrinsic_or_python(_copy_lanes, _copied_in_python)


def asked(builder: Any, address: Any) -> None:
    """Generate what asks for the line of memory at an address, to write into it; of no memory it asks for nothing."""
    byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
    declare: Any = cgutils.get_or_insert_function
    kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
    prefetch = declare(builder.module, kind, "llvm.prefetch.p0i8")
    builder.call(prefetch, [builder.bitcast(address, byte), flag(1), flag(3), flag(1)])  # to write; near; data


def _ask_for(typing_context: Any, array: Any, place: Any) -> Any:
    """Ask for the line of memory around array[place], or the place of so many numbers in all, to be written soon.

    Places that are read and written in no order are waited for one after the other; asked for in good time, together.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        make: Any = arrayobj.make_array
        data = make(signature.args[0])(context, builder, arguments[0]).data
        asked(builder, builder.gep(data, [arguments[1]]))
        return context.get_dummy_value()

    return types.void(array, types.uint64), generate


ask_for: Any = intrinsic_or_python(_ask_for, lambda array, place: None)


def _stacked(typing_context: Any, numbers: Any) -> Any:
    """Return the numbers of a tuple as an array that a law may write, for as long as its caller runs.

    It lies on the stack: laws allocate nothing. A law never returns it.
    """
    if not isinstance(numbers, types.UniTuple):
        raise numba.TypingError(f"stacked: {numbers}, must be a tuple of numbers of one kind")
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


stacked: Any = intrinsic_or_python(_stacked, np.array)


def _tallied(typing_context: Any, number: Any, flag: Any) -> Any:
    """Return a number that counts, 0 at the start, with one more counted if the flag is up; `tally_of` reads it.

    With AVX-512 it is the number itself: to add 1 under a mask is one instruction. Elsewhere its bits are a whole
    number, from which what was compared is taken away as it is: -1 where the flag is up.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        real = arguments[0].type
        if processor.REGISTER == LINE:
            return builder.fadd(arguments[0], builder.select(arguments[1], real(1.0), real(-0.0)))
        whole = ir.IntType(8 * context.get_abi_sizeof(arguments[0].type))
        more = builder.zext(arguments[1], whole)
        return builder.bitcast(builder.add(builder.bitcast(arguments[0], whole), more), arguments[0].type)

    return number(number, types.boolean), generate


def _tally(typing_context: Any, number: Any) -> Any:
    """Return how many were counted there, as a number."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if processor.REGISTER == LINE:
            return arguments[0]
        real, whole = arguments[0].type, ir.IntType(8 * context.get_abi_sizeof(arguments[0].type))
        counted = builder.bitcast(arguments[0], whole)
        return builder.sitofp(builder.trunc(counted, ir.IntType(32)) if whole.width > 32 else counted, real)

    return number(number), generate


tallied: Any = intrinsic_or_python(_tallied, lambda number, flag: number + type(number)(flag))
tally_of: Any = intrinsic_or_python(_tally, lambda number: number)

_PATIENCE = 2000  # rounds of waiting before the core is offered to other threads

_give_way: Any = numba.njit(lambda: 0)
if os.name == "posix":
    _give_way = types.ExternalFunction("sched_yield", types.int32())


@kernel
def wait_for_team(sync: Any, team: int) -> None:
    """Wait until all `team` threads that work on one world have come here; sync: one int64, 0 at the start."""
    if team > 1:
        arrived = _fetch_add(sync, 1) + 1
        all_here = (arrived + team - 1) // team * team
        rounds = 0
        while _fetch_add(sync, 0) < all_here:
            rounds += 1
            if rounds > _PATIENCE:
                _give_way()


def cache_folder() -> Path:
    """Return the folder of machine code, checked; FLOCKENV_CACHE names another one.

    Falls back to a folder under the system's temporary one where the home folder cannot be written or is not private.

    Raises:
        OSError: the folder that FLOCKENV_CACHE names can be changed by other users, or none can be written.
    """
    named = os.environ.get("FLOCKENV_CACHE")
    if named:
        try:
            return prepared(Path(named))
        except OSError as error:
            reason = error.strerror or error
            raise type(error)(f"FLOCKENV_CACHE = {named}: refused for compiled kernels: {reason}") from error
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or os.path.expanduser("~/.cache")
    user = os.geteuid() if hasattr(os, "geteuid") else "cache"
    return first_private(Path(home) / "flockenv", Path(tempfile.gettempdir()), f"flockenv-{user}")


def sources_of_code() -> Iterator[tuple[Path, bytes]]:
    """Yield every source of the package that holds laws or records of theirs, or says how code is made of them."""
    how = [Path(str(module.__file__)) for module in (sys.modules[__name__], inlining, frontend, lowering)]
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        text = path.read_bytes()
        told = b"from flockenv.kernels import" in text or b"from flockenv.section import" in text
        if told or path in how or path.parent.name in ("sweep", "tasks"):
            yield path, text


@functools.cache
def laws_digest() -> str:
    """Digest `sources_of_code`.

    An edit to one means new files, never stale machine code. Nothing of the machine is in it: results are the same.
    """
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    for _, text in sources_of_code():
        digest.update(text)
    return digest.hexdigest()


def texts_outside(modules: set[str]) -> str:
    """Return the text of the modules outside flockenv among these, and of those whose laws they use."""
    todo = set(modules)
    done: set[str] = set()
    texts = []
    while todo - done:
        name = min(todo - done)
        done.add(name)
        module = sys.modules.get(name)
        if module is None or name.split(".")[0] in ("flockenv", "numpy", "numba", "collections", "math"):
            continue
        path, laws = Path(getattr(module, "__file__", None) or ""), [v for v in vars(module).values() if _is_law(v)]
        # a notebook has no file: its functions are as they are now
        texts.append(path.read_text(encoding="utf-8") if path.suffix == ".py" else "".join(map(code_text, laws)))
        todo |= {python_of(law).__module__ for law in laws}
    return "".join(texts)


def python_of(function: Any) -> Any:
    """Return the Python function of a law, kernel or entry point."""
    return getattr(function, "py_func", function)


def _is_law(value: Any) -> bool:
    return hasattr(value, "py_func")


def code_text(function: Any) -> str:
    """Return the code of a function as text: the same for the same code, and another one after an edit."""

    def text(code: CodeType) -> str:
        inner = [text(each) if isinstance(each, CodeType) else each for each in code.co_consts]
        return repr((code.co_name, code.co_code, code.co_names, inner))

    return text(python_of(function).__code__)


def held(python: FunctionType) -> tuple[Any, ...]:
    """Return the values of a function's free variables."""
    return tuple(cell.cell_contents for cell in python.__closure__ or ())


def functions_in(part: Any) -> Iterator[FunctionType]:
    """Yield a Python function and all that it holds."""
    python = python_of(part)
    if isinstance(python, FunctionType):
        yield python
        part = held(python)
    for inner in part if isinstance(part, tuple) else ():
        yield from functions_in(inner)


def described(part: Any) -> str:
    """Write out what machine code depends on: code and what it holds, numbers as they print, arrays by their bytes."""
    python = python_of(part)
    if isinstance(python, FunctionType):
        return _described(python)
    if isinstance(part, tuple):
        return f"({', '.join(map(described, part))})"
    return f"{part.dtype} {part.shape} {part.tobytes()!r}" if isinstance(part, np.ndarray) else repr(part)


@functools.lru_cache(maxsize=4096)
def _described(python: FunctionType) -> str:
    """Write out a function as `described` does, by a digest: what holds it twice stays short."""
    told = f"{code_text(python)} {described(held(python))}"
    return f"{python.__module__}.{python.__qualname__} {hashlib.sha256(told.encode()).hexdigest()}"


def settled(function: Any) -> Callable[..., Any]:
    """Return an entry point that was called, without numba's look at the type of every argument: half of a short call.

    For a caller whose arguments have the same types each time, arrays in one piece: types are not looked at any more.
    One that was called with several types is returned as it is.
    """
    compiled = list(getattr(function, "overloads", {}).values())
    return compiled[0].entry_point if len(compiled) == 1 else function  # type: ignore[no-any-return]
