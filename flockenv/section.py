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
import inspect
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import numba
from numba.core import types
from numba.extending import intrinsic

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

__all__ = [
    "entry",
    "entry_of",
    "entry_point",
    "in_turn",
    "joined_from",
    "record",
    "section",
    "several",
    "tuple_from",
    "vector",
]

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


@functools.cache
def several(count: int, item: Callable[[Any, int], Any]) -> Callable[[Any, int], tuple[Any, ...]]:
    """Return `items(array, at)`: a tuple of `count` items, item(array, at), item(array, at + 1), ...

    Up to four, or the two halves, since numba compiles calls within calls.
    """
    half = count // 2
    before = several(half, item) if count > 4 else None
    after = several(count - half, item) if count > 4 else None

    def items(array: Any, at: int) -> tuple[Any, ...]:
        if before is not None:
            return before(array, at) + after(array, at + half)  # type: ignore[misc]  # there are both or none
        if count == 1:
            return (item(array, at),)
        if count == 2:
            return item(array, at), item(array, at + 1)
        if count == 3:
            return item(array, at), item(array, at + 1), item(array, at + 2)
        return item(array, at), item(array, at + 1), item(array, at + 2), item(array, at + 3)

    return kernel(items)


def _calls(functions: tuple[Any, ...], joined: bool, plain: Callable[..., Any]) -> Any:
    """Return what calls some functions with its own arguments, one after the other, and makes one tuple of it all.

    joined: each returns a tuple, and those are joined. Nothing comes of functions that return nothing. An intrinsic:
    a function of numba's own for each of them took half as long to compile as what they call.
    """
    signature = inspect.signature(python_of(functions[0]))
    plain.__signature__ = signature  # type: ignore[attr-defined]
    if IN_PYTHON:
        return plain

    def calls(typing_context: Any, *given: Any) -> Any:
        given = tuple(map(types.unliteral, given))
        kinds = [typing_context.resolve_value_type(function) for function in functions]
        ways = [typing_context.resolve_function_type(kind, given, {}) for kind in kinds]
        returned: list[Any] = [one for way in ways for one in (way.return_type if joined else [way.return_type])]
        nothing = types.none in returned

        def generate(context: Any, builder: Any, own: Any, arguments: Any) -> Any:
            found = []
            for kind, way in zip(kinds, ways, strict=True):
                handed = zip(arguments, given, way.args, strict=True)
                result = context.get_function(kind, way)(builder, [context.cast(builder, *one) for one in handed])
                parts = range(len(way.return_type)) if joined else []
                found += [builder.extract_value(result, k) for k in parts] if joined else [result]
            return context.get_dummy_value() if nothing else context.make_tuple(builder, own.return_type, found)

        whole: Any = types.none if nothing else types.BaseTuple.from_types(returned)  # type: ignore[no-untyped-call]
        return whole(*given), generate

    first = inspect.Parameter("typing_context", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    calls.__signature__ = signature.replace(parameters=[first, *signature.parameters.values()])  # type: ignore[attr-defined]
    made: Any = intrinsic(calls)
    made.py_func = plain  # what it holds is part of what a section is known by
    return made


@functools.cache
def tuple_from(*functions: Callable[..., Any]) -> Callable[..., tuple[Any, ...]]:
    """Return a function that makes a tuple of what each of some functions returns for its arguments."""
    if not functions:
        return kernel(lambda *given: ())
    return _calls(functions, False, lambda *given: tuple(function(*given) for function in functions))  # type: ignore[no-any-return]


@functools.cache
def joined_from(*functions: Callable[..., tuple[Any, ...]]) -> Callable[..., tuple[Any, ...]]:
    """Return a function that joins the tuples that some functions return for its arguments."""
    return _calls(functions, True, lambda *given: sum((function(*given) for function in functions), ()))  # type: ignore[no-any-return]


@functools.cache
def in_turn(*functions: Callable[..., None]) -> Callable[..., None]:
    """Return a function that calls some functions, one after the other, with its arguments; they return nothing."""

    def plain(*given: Any) -> None:
        for function in functions:
            function(*given)

    return _calls(functions, False, plain) if functions else kernel(lambda *given: None)


@functools.cache
def vector(dimension: int) -> Callable[[Any, int], Vec]:
    """Return a function that reads a vector of two or three numbers of an array, from a place on."""

    def vector_at(array: Any, at: int) -> Vec:
        if dimension == 2:
            return array[at], array[at + 1]
        return array[at], array[at + 1], array[at + 2]

    return kernel(vector_at)
