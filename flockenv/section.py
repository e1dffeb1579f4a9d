"""Sections: entry points made of Python functions, whose machine code is kept under a digest of all that they hold.

A section is a factory: it takes a plan (laws as functions, counts, flags) and returns a function that uses them as free
variables. numba takes those for constants: it drops the branches that they rule out before it looks at types, and
inlines the laws. Its own disk cache never finds such a function again; here the key is written out instead: the code of
the function and of all functions that it holds, the numbers that it holds, the sources of all laws, and the width of
registers.
"""

from __future__ import annotations

import functools
import hashlib
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import numba

from flockenv import processor
from flockenv.checked_store import Store
from flockenv.inlining import Whole
from flockenv.kernels import (
    FAST,
    IN_PYTHON,
    Vec,
    cache_folder,
    described,
    functions_in,
    kernel,
    laws_digest,
    python_of,
    texts_outside,
)
from flockenv.machine_code import MachineCode
from flockenv.private_folder import prepared
from flockenv.startup import numba_before_scipy
from flockenv.turns import OneAtATime

__all__ = ["entry", "entry_of", "entry_point", "in_turn", "record", "section", "several", "tuple_from", "vector"]

_njit: Any = numba.njit  # numba's stubs do not know `_nrt`


def section(make: Callable[..., Callable[..., Any]]) -> Callable[..., Callable[..., Any]]:
    """Decorate a section whose functions kernels call: `section(*plan)` is a part of them, made once for each plan."""

    @functools.lru_cache(maxsize=4096, typed=True)
    @functools.wraps(make)
    def made(*plan: Any) -> Callable[..., Any]:
        return kernel(make(*plan))

    return made


def entry_of(make: Callable[..., Callable[..., Any]]) -> Callable[..., Callable[..., Any]]:
    """Decorate a section whose functions Python calls: `section(*plan)` is an entry point, made once for each plan."""

    @functools.lru_cache(maxsize=512, typed=True)
    @functools.wraps(make)
    def made(*plan: Any) -> Callable[..., Any]:
        return entry_point(make(*plan))

    return made


@functools.cache
def entry(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel as an entry point of its own."""
    return entry_point(python_of(kernel))


def entry_point(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a Python function as an entry point: its machine code is read from the checked store, or compiled there.

    It may hold functions, numbers, text, arrays, types, and tuples of those.
    """
    if IN_PYTHON:
        return function
    numba_before_scipy()
    modules = {each.__module__ for each in functions_in(function)}
    told = f"{described(function)}{laws_digest()}{texts_outside(modules)}{processor.REGISTER}"
    digest = hashlib.sha256(told.encode()).hexdigest()[:20]
    store, name = Store(cache_folder()), f"{function.__name__.strip('_')}_{digest}"
    compiled = _njit(fastmath=set(FAST), error_model="numpy", nogil=True, _nrt=False, pipeline_class=Whole)(function)
    compiled._cache = OneAtATime(MachineCode(store, name), prepared(store.folder / "locks") / f"{name}.lock")
    return compiled  # type: ignore[no-any-return]


def record(names: tuple[str, ...]) -> Any:
    """Return the type of a record with these fields; machine code that takes one finds it under its name here."""
    return __getattr__("__".join(["Record", *(names or ("nothing",))]))


def __getattr__(name: str) -> Any:
    """Make the type of a record whose name lists its fields."""
    kind, *names = name.split("__")
    if kind != "Record" or not all(names):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return globals().setdefault(name, namedtuple(name, names, module=__name__))


def several(count: int, item: Callable[[Any, int], Any]) -> Callable[[Any], Any]:
    """Return a function that makes a tuple of `count` items, item(array, 0), item(array, 1), ..."""
    return _several(0, count, item)


@functools.cache
def _several(first: int, count: int, item: Callable[[Any, int], Any]) -> Callable[[Any], Any]:
    """Make the items from the first on: up to four, or the two halves, since numba compiles calls within calls."""
    half, second, third, last = count // 2, first + 1, first + 2, first + count - 1
    before = _several(first, half, item) if count > 4 else None
    after = _several(first + half, count - half, item) if count > 4 else None

    def items(array: Any) -> Any:
        if before is not None:
            return before(array) + after(array)  # type: ignore[misc]  # there are both or none
        if count == 1:
            return (item(array, first),)
        if count == 2:
            return (item(array, first), item(array, last))
        if count == 3:
            return (item(array, first), item(array, second), item(array, last))
        return (item(array, first), item(array, second), item(array, third), item(array, last))

    return kernel(items)


@functools.cache
def tuple_from(*functions: Callable[..., Any]) -> Callable[..., tuple[Any, ...]]:
    """Return a function that makes a tuple of what each of some functions returns for its arguments."""
    if not functions:
        return kernel(lambda *given: ())
    before, last = tuple_from(*functions[:-1]) if functions[1:] else None, functions[-1]

    def items(*given: Any) -> Any:
        if before is None:
            return (last(*given),)
        return before(*given) + (last(*given),)  # noqa: RUF005  # numba adds tuples, and unpacks none

    return kernel(items)


@functools.cache
def in_turn(*functions: Callable[..., Any]) -> Callable[..., None]:
    """Return a function that calls some functions, one after the other, with its arguments."""
    before, last = in_turn(*functions[:-1]) if functions[1:] else None, functions[-1] if functions else None

    def call(*given: Any) -> None:
        if before is not None:
            before(*given)
        if last is not None:
            last(*given)

    return kernel(call)


@functools.cache
def vector(dimension: int) -> Callable[[Any, int], Vec]:
    """Return a function that reads a vector of two or three numbers of an array, from a place on."""

    def vector_at(array: Any, at: int) -> Vec:
        if dimension == 2:
            return array[at], array[at + 1]
        return array[at], array[at + 1], array[at + 2]

    return kernel(vector_at)
