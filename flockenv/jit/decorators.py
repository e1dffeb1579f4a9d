"""Decorators of compiled code (laws, kernels, ...), and the few helper functions that laws and kernels use.

Entry points, which Python calls, are made in `section`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import types
from numba.cpython.unsafe.tuple import tuple_setitem
from numba.extending import overload, register_jitable

from flockenv.jit import progress  # noqa: F401  # shows how long compiling takes
from flockenv.jit.pipeline import Inlined

__all__ = [
    "FAST",
    "IN_PYTHON",
    "OPTIONS",
    "Law",
    "Numbers",
    "Vec",
    "finite",
    "kernel",
    "law",
    "like",
    "python_of",
    "replace_at",
    "routine",
    "shared",
    "unfused",
]

F = TypeVar("F", bound=Callable[..., Any])

Law = Callable[..., Any]
"""A law, as records hold it: a function marked `law`, `kernel` or `unfused`."""

Vec = tuple[float, ...]
"""A vector inside a law: a tuple of D floats, D = 2 or 3."""

Numbers = tuple[float, ...]
"""A tuple of floats of any length, the same for all agents."""

# Fused multiply-add and nothing else. The rest of fastmath gave no speed here and did harm: with `arcp` and `afn` a
# division in a vector register is an estimate and a scalar one is exact, so that results depend on how agents are
# divided among threads; with `reassoc` and `nsz` a NaN check (x - x == 0) folds to True.
FAST = frozenset({"contract"})
"""Flags of fast mathematics that kernels are compiled with."""

# _nrt=False: no reference counts. The caller of the entry point owns the arrays while it runs; counting every view of
# them with a locked instruction took nine tenths of the time of a world of 32 agents. So nothing compiled here may
# allocate (numba reports it when it compiles): scratch is an argument.
OPTIONS: Any = {
    "forceinline": True, "fastmath": set(FAST), "error_model": "numpy", "nogil": True, "_nrt": False,
    "pipeline_class": Inlined,
}  # fmt: skip
"""Options of numba that kernels are compiled with."""

_njit: Any = numba.njit  # numba's stubs do not know `_nrt`

IN_PYTHON: bool = numba.config.DISABLE_JIT  # type: ignore[attr-defined]  # made from the environment
"""True with NUMBA_DISABLE_JIT=1: kernels run in plain Python, for a debugger."""

if IN_PYTHON:
    np.seterr(all="ignore")  # as in machine code: infinities and NaN are values, unsigned integers wrap


def _compile_part(function: F, **options: Any) -> F:
    """Compile a part of kernels with numba, with its signature cached, which numba would compute twice."""
    function.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
    return cast(F, _njit(**{**OPTIONS, **options})(function))


def law(function: F) -> F:
    """Mark a scalar law: branch-free if possible, inlined into the loop that calls it, never called from Python.

    function: of one agent, with tuples of D floats as vectors.

    For numba it is the same as `kernel`; the two names distinguish physics from engine.
    """
    return _compile_part(function)


def unfused(function: F) -> F:
    """Mark a law that must give the same bits in every loop it is inlined into: no multiply is fused with an add.

    function: as of `law`.
    """
    return _compile_part(function, fastmath=False)


def kernel(function: F) -> F:
    """Mark a part of a kernel that reads and writes arrays or combines laws; it is inlined into its callers.

    function: in the part of Python that numba compiles.
    """
    return _compile_part(function)


def routine(function: F) -> F:
    """Mark a function that kernels call from several places; it is compiled once and not inlined."""
    return _compile_part(function, forceinline=False)


def shared(function: F) -> F:
    """Mark a law that Python code also calls, uncompiled: for example a method's `advance`.

    function: as of `law`.
    """
    mark: Any = register_jitable
    return cast(F, mark(**OPTIONS)(function))


def python_of(function: Any) -> Any:
    """Return the Python function of a law, kernel or entry point."""
    return getattr(function, "py_func", function)


def like(x: float, constant: float) -> float:
    """Return `constant` in the precision of `x`: a literal 0.5 would make a float32 law compute in float64."""
    return type(x)(constant)


@overload(like, jit_options=OPTIONS)
def _like(x, constant):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    to = types.float32 if x == types.float32 else types.float64
    return lambda x, constant: to(constant)


def replace_at(numbers: tuple[float, ...], k: int, x: float) -> tuple[float, ...]:
    """Return the numbers with the k-th replaced by x."""
    return (*numbers[:k], x, *numbers[k + 1 :])


@overload(replace_at, jit_options=OPTIONS)
def _replace_at(numbers, k, x):  # type: ignore[no-untyped-def]
    return lambda numbers, k, x: tuple_setitem(numbers, k, x)  # type: ignore[call-arg]


@law
def finite(x: float) -> bool:
    """Return True if x is neither NaN nor infinite."""
    return abs(x) < like(x, math.inf)
