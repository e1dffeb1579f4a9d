"""A faster front end of numba: caches and short cuts while it compiles our kernels.

More than half of the compile time of a kernel is spent in numba's Python code. The resulting machine code is the same,
instruction for instruction. The patches are active only while one of our functions compiles, under numba's own lock,
and are undone afterwards. Each patch lists the functions of numba that it relies on, with digests of their source: if
one of them differs (another version of numba), the patch is left out and numba works unchanged.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple

from numba.core import (
    compiler_lock,
    dispatcher,
    event,
    ir,
    postproc,
    targetconfig,
    transforms,
    types,
)
from numba.core.types import functions

from flockenv.core.errors import nearest, printable
from flockenv.jit.startup import no_garbage_collection

__all__ = [
    "LEFT_OUT",
    "PATCHES",
    "Patch",
    "applies",
    "apply_patches",
    "is_known_source",
]

LEFT_OUT = "FLOCKENV_NUMBA_ALONE"
"""Environment variable with the names of patches to leave out, separated by commas; `all` leaves out every one."""

# numba is untyped
_canonical: Any = transforms.canonicalize_cfg
_lock: Any = compiler_lock.global_compiler_lock


class Known(NamedTuple):
    """A function of numba, with the digest of the source that a patch was tested with."""

    owner: Any
    name: str
    digest: str


class Patch(NamedTuple):
    """A patch: `owner.name` is replaced by `make(original)`."""

    owner: Any
    name: str
    make: Callable[[Any], Any]
    reads: tuple[Known, ...]

    @property
    def title(self) -> str:
        """Name of the patch, in lists and in LEFT_OUT: with its module, since classes share names."""
        if inspect.ismodule(self.owner):
            return f"{self.owner.__name__}.{self.name}".removeprefix("numba.core.")
        return f"{self.owner.__module__}.{self.owner.__name__}.{self.name}".removeprefix("numba.core.")


def digest(owner: Any, name: str) -> str:
    """Return a digest of the source of `owner.name`; "" if there is no such function."""
    try:
        return hashlib.sha256(inspect.getsource(vars(owner)[name]).encode()).hexdigest()[:12]
    except (KeyError, OSError, TypeError):
        return ""


@functools.cache
def is_known_source(reads: tuple[Known, ...]) -> bool:
    """Return True if the source of every function is the one that the patch was tested with."""
    return all(digest(known.owner, known.name) == known.digest for known in reads)


def applies(title: str, reads: tuple[Known, ...]) -> bool:
    """Return True if a patch is applied: numba's source is as tested, and LEFT_OUT does not contain its title.

    Raise ValueError for a name in LEFT_OUT that is not the title of a patch.
    """
    left_out = [name for name in os.environ.get(LEFT_OUT, "").split(",") if name]
    allowed = ["all", "lowering", *(each.title for each in PATCHES)]
    for name in left_out:
        if name not in allowed:
            raise ValueError(f"{LEFT_OUT}: {printable(name)}: unknown{nearest(name, allowed)} ({', '.join(allowed)})")
    return is_known_source(reads) and title not in left_out and "all" not in left_out


# --- cached: the implementation of a call with given types ------------------------------------------------------------

_remembered: dict[int, tuple[Any, dict[Any, Any]]] = {}  # by id of the function type, which is stored to keep it alive


def _memory(function: Any) -> dict[Any, Any]:
    kept = _remembered.get(id(function))
    if kept is None:
        kept = _remembered[id(function)] = function, {}
    return kept[1]


def _call(context: Any, args: Any, kws: Any) -> tuple[Any, ...]:
    """Return the cache key of a resolution beside the function: argument types, and the flags of the caller.

    Types are compared by identity: numba keeps one object for equal types, and hashing a record of arrays takes long.
    """
    named = tuple((name, id(kind)) for name, kind in kws.items()) if kws else ()
    return id(context), tuple(map(id, args)), named, _flags_number()


def _objects(context: Any, args: Any, kws: Any) -> tuple[Any, ...]:
    """Return the objects that a key of `_call` stands for."""
    return context, *args, *(kws.values() if kws else ())


_known_flags: list[dict[str, Any] | None] = []


def _flags_number() -> int:
    """Return a number for the flags of the caller, the same for equal flags; numba's hash is the same for all flags."""
    flags = targetconfig.ConfigStack.top_or_none()  # type: ignore[no-untyped-call]
    options = None if flags is None else flags._values
    for number, known in enumerate(_known_flags):
        if known == options:
            return number
    _known_flags.append(None if options is None else dict(options))
    return len(_known_flags) - 1


class _Resolved(NamedTuple):
    """A cached resolution."""

    signature: Any
    implementation: Any  # key of the compiled form among those of an operator
    alive: tuple[Any, ...]  # the objects of which the cache key holds the identities


def _cached_signature(function: Any, call: tuple[Any, ...]) -> Any:
    """Return the cached signature, None if there is none."""
    known = _memory(function).get(call)
    if known is None:
        return None
    if isinstance(function, functions.Dispatcher):
        return known.signature if known.signature.args in function.dispatcher.overloads else None
    function._impl_keys[known.signature.args] = known.implementation
    return known.signature


def _cache_calls(resolve: Any) -> Any:
    """Cache the resolution of operators such as `+`: numba tries dozens of templates, several times for every `+`."""

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        call = _call(context, args, kws)
        signature = _cached_signature(self, call)
        if signature is None:
            signature = resolve(self, context, args, kws)
            if signature is not None and signature.args in self._impl_keys:
                _memory(self)[call] = _Resolved(
                    signature, self._impl_keys[signature.args], _objects(context, args, kws)
                )
        return signature

    return get_call_type


def _cache_laws(resolve: Any) -> Any:
    """Cache the signature of a compiled function for given types while its compiled form exists.

    Calls with literal numbers share the code of other calls; numba compiles a function anew for each literal.
    """

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        args = _without_literals(args)
        call = _call(context, args, kws)
        signature = _cached_signature(self, call)
        if signature is None:
            signature = resolve(self, context, args, kws)
            if signature is not None:
                _memory(self)[call] = _Resolved(signature, None, _objects(context, args, kws))
        return signature

    return get_call_type


def _without_literals(args: Any) -> tuple[Any, ...]:
    """Return the types of numbers for those of literals, unless a tuple of several types may be indexed by one."""
    return tuple(args if any(isinstance(kind, types.Tuple) for kind in args) else map(types.unliteral, args))


# --- cheaper: the same result, computed faster ------------------------------------------------------------------------


LOCKS = ("numba:compiler_lock", "numba:llvm_lock")
"""Kinds of events of which numba measures times."""


def _no_timers(_: Any) -> Any:
    """Measure no times of locks: numba informs two timers for each enclosing function, with every nested call."""
    return lambda kind, callback: nullcontext()


def _for_listeners(inform: Any) -> Any:
    """Make an event only if there is a listener; of a lock, only if it is no timer, see `_no_timers`.

    numba makes two events of a lock for every call of LLVM. So a TimingListener of a user measures nothing of locks
    while our kernels compile.
    """

    def event_of(kind: str, *args: Any, **kwargs: Any) -> None:
        if any(kind not in LOCKS or type(each) is not event.TimingListener for each in event._registered[kind]):
            inform(kind, *args, **kwargs)

    return event_of


def _list_variables(_: Any) -> Any:
    """List the variables of an instruction in one walk: numba makes a list for every field and every list in it."""

    def _rec_list_vars(self: Any, val: Any) -> list[Any]:
        found: list[Any] = []
        _add_variables(val.values() if isinstance(val, dict) else (val,), found)
        return found

    return _rec_list_vars


_PLAIN = frozenset((str, int, float, bool, type(None), ir.Loc))
"""Types of fields of instructions that hold no variables."""


def _add_variables(fields: Any, found: list[Any]) -> None:
    for each in fields:
        if isinstance(each, ir.Var):
            found.append(each)
        elif type(each) in _PLAIN:
            continue
        elif isinstance(each, ir.Inst):
            found += each.list_vars()  # type: ignore[no-untyped-call]
        elif isinstance(each, (list, tuple)):
            _add_variables(each, found)
        elif isinstance(each, dict):
            _add_variables(each.values(), found)


def _lifetimes_on_demand(slowly: Any) -> Any:
    """Compute the lifetimes of variables only on demand: numba computes them after each of its passes.

    `block_entry_vars` is needed only for generators and Python objects, which kernels do not have.
    """

    def run(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        function = self.func_ir
        if function.is_generator:
            slowly(self, emit_dels, extend_lifetimes)
            return
        function.blocks = _canonical(function.blocks)
        function.variable_lifetime = postproc.VariableLifetime(function.blocks)  # type: ignore[no-untyped-call]
        function.generator_info = None
        if emit_dels:
            self._insert_var_dels(extend_lifetimes=extend_lifetimes)

    return run


PATCHES = (
    Patch(functions.BaseFunction, "get_call_type", _cache_calls, (
        Known(functions.BaseFunction, "get_call_type", "6559c167bfc0"),
        Known(functions.BaseFunction, "get_impl_key", "ebed5750a018"),
        Known(targetconfig.TargetConfig, "__init__", "7167e496c1f7"),
    )),
    Patch(functions.Dispatcher, "get_call_type", _cache_laws, (
        Known(functions.Dispatcher, "get_call_type", "ae1ef289d128"),
        Known(dispatcher._DispatcherBase, "get_call_template", "f15b62d0e9c0"),
        Known(targetconfig.TargetConfig, "__init__", "7167e496c1f7"),
    )),
    Patch(event, "install_timer", _no_timers, (Known(event, "install_timer", "754d2f8aad8c"),)),
    Patch(event, "start_event", _for_listeners, (
        Known(event, "start_event", "ee296d6ff362"), Known(event, "broadcast", "0c3ca6589b31"),
    )),
    Patch(event, "end_event", _for_listeners, (
        Known(event, "end_event", "1f3727213c76"), Known(event, "broadcast", "0c3ca6589b31"),
    )),
    Patch(ir.Inst, "_rec_list_vars", _list_variables, (
        Known(ir.Inst, "_rec_list_vars", "054700e9100b"), Known(ir.Stmt, "list_vars", "da90b4d7fc05"),
        Known(ir.Expr, "list_vars", "a32a9eae072e"),
    )),
    Patch(postproc.PostProcessor, "run", _lifetimes_on_demand, (Known(postproc.PostProcessor, "run", "e1a8e77d6f17"),)),
)  # fmt: skip
"""All patches of functions."""


@functools.cache
def _replacements() -> tuple[tuple[Any, str, Any, Any], ...]:
    """Return (owner, name, original, patch) of all patches that apply to this numba."""
    found = []
    for trick in PATCHES:
        if applies(trick.title, trick.reads):
            numbas = vars(trick.owner)[trick.name]
            found.append((trick.owner, trick.name, numbas, trick.make(numbas)))
    return tuple(found)


_depth = 0


@contextmanager
def apply_patches() -> Iterator[None]:
    """Apply the patches, and disable garbage collection, in a block that compiles: a kernel leaves up to 100 MB."""
    global _depth
    with _lock, no_garbage_collection():
        if _depth == 0:
            for owner, name, _, ours in _replacements():
                setattr(owner, name, ours)
        _depth += 1
        try:
            yield
        finally:
            _depth -= 1
            if _depth == 0:
                for owner, name, numbas, _ in _replacements():
                    setattr(owner, name, numbas)
