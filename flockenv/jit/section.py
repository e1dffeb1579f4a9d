"""Sections: kernels built from Python functions for a kernel plan; machine code is cached by a digest of the plan.

A section is a factory: it takes a plan (laws as functions, counts, flags) and returns a function that uses them as free
variables. numba treats those as constants: it removes the branches that they exclude before type inference, and
inlines the laws. Its own disk cache never finds such a function again; here the cache has an explicit key: the plan,
with the code of every law in it, the sources of all laws and sections, and the register width. So if the machine code
is cached, no function is built.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import types
from numba.extending import intrinsic

from flockenv.core.address_space import COMPILING, IN_USE, LOADING, require_room
from flockenv.jit import cpu
from flockenv.jit.cache_folder import cache_folder
from flockenv.jit.checked_store import Store
from flockenv.jit.decorators import FAST, IN_PYTHON, Vec, kernel, python_of
from flockenv.jit.law_errors import explain_errors
from flockenv.jit.lock import OneAtATime, require_cached
from flockenv.jit.machine_code import MachineCode
from flockenv.jit.pipeline import Whole
from flockenv.jit.private_folder import ensure_private
from flockenv.jit.sources import description, functions_in, laws_digest, texts_outside
from flockenv.jit.startup import import_numba_before_scipy

__all__ = [
    "call_in_turn",
    "concatenation_from",
    "digest_of",
    "entry",
    "entry_of",
    "read_several",
    "record",
    "section",
    "set_title",
    "tuple_from",
    "vector",
    "without_dispatch",
]

_njit: Any = numba.njit  # numba's stubs do not know `_nrt`


def section(make: Callable[..., Callable[..., Any]]) -> Callable[..., Callable[..., Any]]:
    """Decorate a section that makes parts of kernels: `section(*plan)` is one, built once for each plan."""

    @functools.lru_cache(maxsize=4096, typed=True)
    @functools.wraps(make)
    def build_once(*plan: Any) -> Callable[..., Any]:
        return kernel(make(*plan))

    return build_once


def entry_of(make: Callable[..., Callable[..., Any]]) -> Callable[..., Callable[..., Any]]:
    """Decorate a section that makes entry points: `section(*plan)` is one, which Python calls, built once per plan.

    The plan contains laws, numbers, text, types, and tuples of those. The function is not built if the machine code of
    an equal plan is cached.
    """

    @functools.lru_cache(maxsize=512, typed=True)
    @functools.wraps(make)
    def build_once(*plan: Any) -> Callable[..., Any]:
        return _entry(make, plan)

    return build_once


def without_dispatch(function: Any) -> Callable[..., Any]:
    """Return a compiled entry point without numba's type dispatch, which takes half of the time of a short call.

    The caller must pass the same argument types each time, with contiguous arrays: types are not checked any more. A
    function that was compiled for several combinations of types is returned unchanged.
    """
    compiled = list(getattr(function, "overloads", {}).values())
    return compiled[0].entry_point if len(compiled) == 1 else function  # type: ignore[no-any-return]


def set_title(entry_point: Callable[..., Any], title: str) -> Callable[..., Any]:
    """Return the entry point with the title shown while it compiles; only the first call sets the title."""
    vars(entry_point).setdefault("title", title)
    return entry_point


@functools.cache
def entry(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel, or a Python function, as an entry point of its own."""
    return _entry(python_of, (function,))


def digest_of(plan: Any) -> str:
    """Return a digest of all that a plan's code depends on: the code of its laws, the repr of its numbers."""
    modules = {each.__module__ for each in functions_in(plan)}
    text = f"{description(plan)}{laws_digest()}{texts_outside(modules)}"
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _entry(make: Callable[..., Callable[..., Any]], plan: tuple[Any, ...]) -> Callable[..., Any]:
    """Return the entry point that a factory builds from a plan; its machine code is read from the checked store.

    The store also holds what numba needs before the function is built, mainly the names of its arguments.
    """
    if IN_PYTHON:
        return make(*plan)
    import_numba_before_scipy()
    digest, store = digest_of((make, plan, cpu.REGISTER)), Store(cache_folder())
    stand_in = _stand_in(store.read(f"{digest}.plan"))
    require_cached(stand_in)
    function = stand_in or make(*plan)
    if stand_in is None:
        store.write(f"{digest}.plan", _stand_in_data(function))
    name = f"{function.__name__.strip('_')}_{digest}"
    compiled = _njit(fastmath=set(FAST), error_model="numpy", nogil=True, _nrt=False, pipeline_class=Whole)(function)
    lock = ensure_private(store.folder / "locks") / f"{name}.lock"
    compiled._cache = _LateBuilt(MachineCode(store, name), lock, compiled, make, plan)
    compiled._compiler.compile = explain_errors(compiled._compiler.compile, plan)
    compiled.made_of = make, plan
    return compiled  # type: ignore[no-any-return]


def _stand_in_data(function: Callable[..., Any]) -> bytes:
    """Return the data from which a stand-in for a function is built, as JSON."""
    parameters = list(inspect.signature(function).parameters)
    data = (function.__name__, function.__qualname__, function.__module__, function.__doc__, parameters)
    return json.dumps(data).encode()


def _stand_in(data: bytes | None) -> Callable[..., Any] | None:
    """Return a function with the stored name, docstring and parameters, for numba only; it is never called."""
    if data is None:
        return None

    def stand_in() -> None:
        raise AssertionError("a stand-in is never compiled")

    stand_in.__name__, stand_in.__qualname__, stand_in.__module__, stand_in.__doc__, parameters = json.loads(data)
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    stand_in.__signature__ = inspect.Signature([inspect.Parameter(name, kind) for name in parameters])  # type: ignore[attr-defined]
    return stand_in


class _LateBuilt(OneAtATime):
    """Machine code of an entry point; its function is built only if the code for its argument types is not cached."""

    def __init__(
        self, cache: Any, lock: Path, compiled: Any, make: Callable[..., Callable[..., Any]], plan: tuple[Any, ...]
    ) -> None:
        super().__init__(cache, lock)
        self._compiled, self._make_function, self._plan = compiled, make, plan

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the cached code; if there is none, build the function to compile and return None.

        Raises MemoryError if too little address space is left to load or compile it: LLVM would abort the process.
        """
        require_room(f"to load a compiled kernel, {IN_USE}", LOADING)
        found = super().load_overload(signature, context)
        if found is None:
            try:
                require_room(f"to compile a kernel, {IN_USE}", COMPILING)
            except MemoryError:
                self.release()
                raise
            function = self._make_function(*self._plan)
            self._compiled.py_func = self._compiled._compiler.py_func = function
        return found


def record(names: tuple[str, ...]) -> Any:
    """Return the namedtuple type with these fields; cached machine code finds it by its name in this module."""
    wrong = [name for name in names if "__" in name or name.endswith("_")]
    if wrong:
        raise ValueError(f"record: {wrong[0]!r} must have no two underscores, and none at its end")
    return __getattr__("__".join(["Record", *(names or ("nothing",))]))


def __getattr__(name: str) -> Any:
    """Return the namedtuple type with the fields that its name lists, as cached machine code looks it up."""
    kind, *names = name.split("__")
    if kind != "Record" or not all(names):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return globals().setdefault(name, namedtuple(name, names, module=__name__))


@functools.cache
def read_several(count: int, item: Callable[[Any, int], Any]) -> Callable[[Any, int], tuple[Any, ...]]:
    """Return `items(array, at)`: a tuple of `count` items, item(array, at), item(array, at + 1), ...

    More than four are split into two halves, as numba compiles nested calls.
    """
    half = count // 2
    before = read_several(half, item) if count > 4 else None
    after = read_several(count - half, item) if count > 4 else None

    def items(array: Any, at: int) -> tuple[Any, ...]:
        if before is not None:
            return before(array, at) + after(array, at + half)  # type: ignore[misc]  # both are set or neither
        if count == 1:
            return (item(array, at),)
        if count == 2:
            return item(array, at), item(array, at + 1)
        if count == 3:
            return item(array, at), item(array, at + 1), item(array, at + 2)
        return item(array, at), item(array, at + 1), item(array, at + 2), item(array, at + 3)

    return kernel(items)


def _call_all(functions: tuple[Any, ...], joined: bool, plain: Callable[..., Any]) -> Any:
    """Return a function that calls `functions` in turn with its own arguments and returns a tuple of their results.

    joined: each returns a tuple, and these are concatenated. If all return None, so does the function. It is an
    intrinsic: one numba function for each of them took half as long to compile as the functions that they call.
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
        silent = [way.return_type == types.none for way in ways]
        nothing = all(silent)
        if any(silent) and not nothing:
            which = python_of(functions[silent.index(True)]).__name__
            raise numba.TypingError(f"{which} returns nothing, but functions combined with it return something")

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
    together: Any = intrinsic(calls)
    together.py_func = plain  # its free variables are part of a section's digest
    return together


@functools.cache
def tuple_from(*functions: Callable[..., Any]) -> Callable[..., tuple[Any, ...]]:
    """Return a function that returns the tuple of the results of `functions` for its arguments."""
    if not functions:
        return kernel(lambda *given: ())
    return _call_all(functions, False, lambda *given: tuple(function(*given) for function in functions))  # type: ignore[no-any-return]


@functools.cache
def concatenation_from(*functions: Callable[..., tuple[Any, ...]]) -> Callable[..., tuple[Any, ...]]:
    """Return a function that concatenates the tuples that `functions` return for its arguments."""
    return _call_all(functions, True, lambda *given: sum((function(*given) for function in functions), ()))  # type: ignore[no-any-return]


@functools.cache
def call_in_turn(*functions: Callable[..., None]) -> Callable[..., None]:
    """Return a function that calls `functions` in turn with its arguments; they return None."""

    def plain(*given: Any) -> None:
        for function in functions:
            function(*given)

    return _call_all(functions, False, plain) if functions else kernel(lambda *given: None)


@functools.cache
def vector(dimension: int) -> Callable[[Any, int], Vec]:
    """Return a function that reads a vector of two or three numbers from an array, from an index on."""

    def vector_at(array: Any, at: int) -> Vec:
        if dimension == 2:
            return array[at], array[at + 1]
        return array[at], array[at + 1], array[at + 2]

    return kernel(vector_at)
