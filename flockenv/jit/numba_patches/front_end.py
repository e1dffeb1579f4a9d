"""A faster front end of numba: caches and short cuts while it compiles our kernels.

Four fifths of the compile time of a kernel are spent in numba's Python code. The resulting machine code is the same,
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
from contextlib import contextmanager
from typing import Any, NamedTuple

from numba.core import (
    base,
    compiler_lock,
    dispatcher,
    inline_closurecall,
    ir,
    postproc,
    ssa,
    targetconfig,
    transforms,
    untyped_passes,
)
from numba.core.compiler_machinery import register_pass
from numba.core.ir_utils import fixup_var_define_in_scope
from numba.core.types import functions

from flockenv.core.errors import nearest, printable
from flockenv.jit.startup import no_garbage_collection

__all__ = [
    "LEFT_OUT",
    "PATCHES",
    "REPLACED_PASSES",
    "Patch",
    "ReplacedPass",
    "applies",
    "apply_patches",
    "is_known_source",
    "replace_passes",
]

LEFT_OUT = "FLOCKENV_NUMBA_ALONE"
"""Environment variable with the names of patches to leave out, separated by commas; `all` leaves out every one."""

# numba is untyped
_canonical: Any = transforms.canonicalize_cfg
_fixup: Any = fixup_var_define_in_scope
_lock: Any = compiler_lock.global_compiler_lock
_register: Any = register_pass
_Closures: Any = untyped_passes.InlineClosureLikes
_Processor: Any = postproc.PostProcessor


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
    allowed = ["all", "lowering", *(each.title for each in (*PATCHES, *REPLACED_PASSES))]
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
    """Return the cache key of a resolution beside the function: argument types, and the flags of the caller."""
    flags = targetconfig.ConfigStack.top_or_none()  # type: ignore[no-untyped-call]
    return context, tuple(args), tuple(kws.items()) if kws else (), flags


def _cached_signature(function: Any, call: tuple[Any, ...]) -> Any:
    """Return the cached signature, None if there is none."""
    known = _memory(function).get(call)
    if known is None:
        return None
    if isinstance(function, functions.Dispatcher):
        return known if known.args in function.dispatcher.overloads else None
    signature, function._impl_keys[signature.args] = known
    return signature


def _cache_calls(resolve: Any) -> Any:
    """Cache the resolution of operators such as `+`: numba tries dozens of templates, several times for every `+`."""

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        call = _call(context, args, kws)
        signature = _cached_signature(self, call)
        if signature is None:
            signature = resolve(self, context, args, kws)
            if signature is not None and signature.args in self._impl_keys:
                _memory(self)[call] = signature, self._impl_keys[signature.args]
        return signature

    return get_call_type


def _cache_laws(resolve: Any) -> Any:
    """Cache the signature of a compiled function for given types while its compiled form exists."""

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        call = _call(context, args, kws)
        signature = _cached_signature(self, call)
        if signature is None:
            signature = resolve(self, context, args, kws)
            if signature is not None:
                _memory(self)[call] = signature
        return signature

    return get_call_type


# --- cheaper: the same result, computed faster ------------------------------------------------------------------------


def _faster_values(_: Any) -> Any:
    """Return a faster `values` of flags: the cached defaults, updated with the set values."""
    defaults: dict[Any, dict[str, Any]] = {}

    def values(self: Any) -> dict[str, Any]:
        cls = type(self)
        if cls not in defaults:
            defaults[cls] = {name: option.default for name, option in cls.options.items()}
        values: dict[str, Any] = defaults[cls] | self._values
        return values

    return values


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


def _refresh_if_new(refresh: Any) -> Any:
    """Refresh registries only if there are new declarations: numba goes through all of them for each function."""
    seen: dict[int, int] = {}  # by id of the registries, which the copies of a target share

    def refresh_if_new(self: Any) -> None:
        known = sum(
            len(getattr(registry, kind))
            for context in (self, getattr(self, "typing_context", None) or self)
            for registry, loader in list(context._registries.items())
            for kind in loader.registry_items
        )
        if seen.get(id(self._registries)) != known:
            refresh(self)
            seen[id(self._registries)] = known

    return refresh_if_new


def _rewrite_where_used(slowly: Any) -> Any:
    """Rewrite only the blocks that contain a variable: numba goes through all blocks for each variable."""

    def names(block: Any) -> frozenset[str]:
        known = vars(block).get("_flockenv_names")
        if known is None or known[0] is not block.body:
            found = frozenset(variable.name for statement in block.body for variable in statement.list_vars())
            known = block._flockenv_names = block.body, found
        return known[1]  # type: ignore[no-any-return]

    def rewrite(blocks: Any, states: Any, handler: Any) -> Any:
        name = states["varname"]
        return {
            label: slowly({label: block}, states, handler)[label] if name in names(block) else block
            for label, block in blocks.items()
        }

    return rewrite


PATCHES = (
    Patch(functions.BaseFunction, "get_call_type", _cache_calls, (
        Known(functions.BaseFunction, "get_call_type", "6559c167bfc0"),
        Known(functions.BaseFunction, "get_impl_key", "ebed5750a018"),
    )),
    Patch(functions.Dispatcher, "get_call_type", _cache_laws, (
        Known(functions.Dispatcher, "get_call_type", "ae1ef289d128"),
        Known(dispatcher._DispatcherBase, "get_call_template", "f15b62d0e9c0"),
    )),
    Patch(targetconfig.TargetConfig, "values", _faster_values, (
        Known(targetconfig.TargetConfig, "values", "12a29dc810f6"),
        Known(targetconfig._MetaTargetConfig, "__init__", "f2ff91c25728"),
    )),
    Patch(postproc.PostProcessor, "run", _lifetimes_on_demand, (Known(postproc.PostProcessor, "run", "e1a8e77d6f17"),)),
    Patch(ssa, "_run_block_rewrite", _rewrite_where_used, (
        Known(ssa, "_run_ssa", "c497422bcf04"),
        Known(ssa, "_run_block_rewrite", "d17efdbed570"),
        Known(ssa, "_run_ssa_block_pass", "b48d590f81cc"),
        Known(ssa, "_fresh_vars", "4a4d13bc0ec5"),
        Known(ssa, "_fix_ssa_vars", "3f183045a535"),
        Known(ssa._FreshVarHandler, "on_assign", "922c4f980745"),
        Known(ssa._FreshVarHandler, "on_other", "565e6211fbcb"),
        Known(ssa._FixSSAVars, "on_assign", "af50633e775a"),
        Known(ssa._FixSSAVars, "on_other", "a17f1fff547c"),
        Known(ssa._FixSSAVars, "_fix_var", "9735dd01ed8f"),
    )),
    Patch(base.BaseContext, "refresh", _refresh_if_new, (
        Known(base.BaseContext, "refresh", "83e8f5cc63a7"),
        Known(base.BaseContext, "install_registry", "bdaf4e9db8fe"),
    )),
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


# --- passes that find nothing to do -----------------------------------------------------------------------------------


@_register(mutates_CFG=True, analysis_only=False)
class ClosuresIfAny(_Closures):  # type: ignore[misc]
    """numba's pass that inlines closures, comprehensions and stencils, skipped if a function has none of them."""

    _name = "inline_closure_likes_if_any"

    def run_pass(self, state: Any) -> bool:
        """Run numba's pass, or only its final steps if there is nothing to inline."""
        if any(_may_be_inlined(statement) for b in state.func_ir.blocks.values() for statement in b.body):
            return bool(super().run_pass(state))
        _Processor(state.func_ir).run()
        _fixup(state.func_ir.blocks)
        return True


def _may_be_inlined(statement: Any) -> bool:
    value = getattr(statement, "value", None)
    if isinstance(value, ir.Expr):
        return value.op in ("make_function", "build_list") or (value.op == "getattr" and value.attr in _INLINED)
    if isinstance(value, (ir.Global, ir.FreeVar)):
        return value.name in _INLINED or getattr(value.value, "__name__", "") in _INLINED
    return False


_INLINED = ("reduce", "stencil")


class ReplacedPass(NamedTuple):
    """A pass of numba and its replacement."""

    numbas: Any
    ours: Any
    reads: tuple[Known, ...]

    @property
    def title(self) -> str:
        """Name of the patch, in lists and in LEFT_OUT."""
        return self.numbas.__name__  # type: ignore[no-any-return]


REPLACED_PASSES = (
    ReplacedPass(_Closures, ClosuresIfAny, (
        Known(_Closures, "run_pass", "b61f17f30105"),
        Known(inline_closurecall.InlineClosureCallPass, "run", "d826ba18dd63"),
    )),
)  # fmt: skip


@functools.cache
def _places() -> dict[Any, Any]:
    return {pair.numbas: pair.ours for pair in REPLACED_PASSES if applies(pair.title, pair.reads)}


def replace_passes(passes: list[tuple[Any, str]]) -> list[tuple[Any, str]]:
    """Return numba's list of passes with the replaced ones exchanged."""
    return [(_places().get(each, each), text) for each, text in passes]
