"""numba's compiler pipelines: entry points are compiled completely, inlined functions without machine code.

Loops over lanes, `for l in range(np.uint64(16))` with a literal count, remain loops until LLVM vectorises them. It
would unroll short ones before that, and rarely vectorises the result: for a block of agents in float64 some laws were
computed lane by lane. For the same reason short loops may be vectorised with a run-time check for overlapping arrays
(`_short_loops`).

numba generates machine code and a Python wrapper for every compiled function, and fully optimises each before its
caller. Laws and kernels are only ever parts of an entry point; that work was half of the compile time of a scene. (The
steps below are numba's own without it; they are internals of numba, and tests detect when they change.)
"""

from __future__ import annotations

import functools
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba
from llvmlite import binding  # type: ignore[import-untyped]
from llvmlite import ir as llvm
from numba import _dynfunc  # type: ignore[attr-defined]  # compiled
from numba.core import analysis, compiler, compiler_machinery, ir, lowering, typed_passes

from flockenv.jit.numba_patches.front_end import apply_patches
from flockenv.jit.numba_patches.lowering import Brief, BriefPart, insert_part, is_brief

__all__ = ["Inlined", "Whole"]

_register: Any = compiler_machinery.register_pass  # numba is untyped
_Native: Any = typed_passes.NativeLowering
_Compiler: Any = compiler.CompilerBase
_Passes: Any = compiler.DefaultPassBuilder
_Lower: Any = lowering.Lower
_loops_of: Any = analysis.compute_cfg_from_blocks
_Value: Any = llvm.values.MDValue

FEWEST_LANES = 4
"""Smallest number of iterations of a loop over lanes."""

LONG = 16
"""LLVM's default: it does not vectorise shorter loops that need a check for overlapping arrays."""

LLVMS = range(15, 23)
"""Versions of LLVM with the option for shorter loops; other versions may end the process on an unknown option."""

DEEPEST = 6_000
"""Python's recursion limit while one of our functions compiles."""

_depth = 0


@contextmanager
def _short_loops() -> Iterator[None]:
    """Vectorise short loops, too, while one of our functions compiles: under numba's lock, see `apply_patches`."""
    global _depth
    known = binding.llvm_version_info[0] in LLVMS
    if known and _depth == 0:
        binding.set_option("flockenv", f"--vectorizer-min-trip-count={FEWEST_LANES}")
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1
        if known and _depth == 0:
            binding.set_option("flockenv", f"--vectorizer-min-trip-count={LONG}")


@contextmanager
def _deep_recursion() -> Iterator[None]:
    """Raise Python's recursion limit: numba needs about 24 Python calls per nested call, and the default is 1,000."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(max(before, DEEPEST))
    try:
        yield
    finally:
        sys.setrecursionlimit(before)


@functools.cache
def _refusal_address() -> int:
    """Return the address of the wrapper that runs if Python calls a part of a kernel: it raises TypeError."""

    def part_of_a_kernel() -> None:
        raise TypeError("this function is a part of kernels and is not called alone; call its py_func")

    refuse: Any = numba.njit(part_of_a_kernel)
    refuse.compile(())
    made = next(iter(refuse.overloads.values()))
    return int(made.library.get_pointer_to_function(made.fndesc.llvm_cpython_wrapper_name))


def _optimise_defined_functions(library: Any, module: Any) -> None:
    """Run LLVM's function passes like numba, but not on declarations, for which numba sets up passes in vain."""
    module.data_layout = library._codegen._data_layout
    for function in module.functions:
        if not function.is_declaration:
            passes, builder = library._codegen._function_pass_manager()
            passes.run(function, builder)


def _optimise_cheaply(library: Any) -> None:
    """Run only the cheap passes: the code is optimised again in the caller."""
    codegen = library._codegen
    passes, builder = codegen._module_pass_manager(
        loop_vectorize=False, slp_vectorize=False, opt=codegen._opt_level, cost="cheap"
    )
    passes.run(library._final_module, builder)


def _finalise_without_code(library: Any) -> None:
    """Finalise a library like numba, but do not add it to the execution engine, which generates machine code.

    numba's two checks of names are made once, for the entry point, into which every part is linked.
    """
    library._finalized = True


class _LoopId(_Value):  # type: ignore[misc]
    """LLVM's identifier of a loop: distinct metadata whose first operand is itself."""

    def descr(self, buf: list[str]) -> None:
        """Write the metadata as text."""
        parts = ", ".join(part.get_reference() for part in (self, *self.operands))
        buf += (f"distinct !{{ {parts} }}", "\n")

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)


class _LanesStay(_Lower):  # type: ignore[misc]
    """Lowering that disables LLVM's unrolling of loops over lanes."""

    def lower_function_body(self) -> Any:
        """Lower, and mark the back edges of loops over lanes."""
        self._ends: dict[Any, Any] = {}
        entry = super().lower_function_body()
        graph = _loops_of(self.blocks)
        for loop in graph.loops().values():
            if _lanes(self.func_ir, self.blocks, loop.header) >= FEWEST_LANES:
                lasts = [self._ends[last] for last, _ in graph.predecessors(loop.header) if last in loop.body]
                self._mark_not_unrolled([last.terminator for last in lasts])
        return entry

    def lower_block(self, block: Any) -> None:
        """Lower a block, and store the LLVM block where it ends."""
        super().lower_block(block)
        self._ends[next(offset for offset, other in self.blocks.items() if other is block)] = self.builder.basic_block

    def _mark_not_unrolled(self, ways_back: list[Any]) -> None:
        """Mark a loop on its back edges: it is not unrolled, but its vectorised form may be."""
        module = self.module

        def metadata(text: str, *more: Any) -> Any:
            return module.add_metadata([llvm.MetaDataString(module, text), *more])

        stay = metadata("llvm.loop.unroll.disable")
        then = metadata(
            "llvm.loop.vectorize.followup_vectorized", metadata("llvm.loop.isvectorized", llvm.IntType(32)(1))
        )
        name = _LoopId(module, [stay, then], name=str(len(module.metadata)))
        for way_back in ways_back:
            way_back.set_metadata("llvm.loop", name)


class _BriefLanesStay(_LanesStay, BriefPart):
    """The same with shorter LLVM code, see `lowering`."""


def _lanes(code: Any, blocks: Any, header: Any) -> int:
    """Return the number of iterations of a loop over `range(np.uint64(literal))`; 0 for any other loop."""
    block = blocks[header]
    if len(block.body) == 1 and isinstance(block.body[0], ir.Jump):  # numba inserts an empty block before it
        block = blocks[block.body[0].target]
    values = [line.value for line in block.body if isinstance(line, ir.Assign) and isinstance(line.value, ir.Expr)]
    try:
        iterator = next(value.value for value in values if value.op == "iternext")
        over = _call_argument(code, code.get_definition(iterator).value, "range")
        number = code.get_definition(_call_argument(code, over, "uint64"))
        return int(number.value) if isinstance(number, (ir.Const, ir.Global, ir.FreeVar)) else 0
    except (AttributeError, KeyError, StopIteration, TypeError, ValueError):  # KeyError: defined in several places
        return 0


def _call_argument(code: Any, variable: Any, name: str) -> Any:
    """Return the only argument of the call of `name` that defines a variable; TypeError if there is no such call."""
    call = code.get_definition(variable)
    function = code.get_definition(call.func)
    if len(call.args) != 1 or name != (function.attr if isinstance(function, ir.Expr) else function.name):
        raise TypeError
    return call.args[0]


@_register(mutates_CFG=True, analysis_only=False)
class _Lowering(_Native):  # type: ignore[misc]
    """Lowering of a part of kernels: LLVM code for its callers to inline, but no machine code."""

    _name = "lowering_to_be_inlined"

    @property
    def lowering_class(self) -> Any:
        """The class that lowers the function."""
        return _BriefLanesStay if is_brief() else _LanesStay

    def run_pass(self, state: Any) -> bool:
        """Lower, and register the function for its callers."""
        state.flags.no_compile = True
        state.flags.no_cpython_wrapper = True
        state.flags.no_cfunc_wrapper = True
        codegen = state.targetctx.codegen()
        state.library = library = codegen.create_library(state.func_id.func_qualname)
        library._optimize_functions = types.MethodType(_optimise_defined_functions, library)
        library._optimize_final_module = types.MethodType(_optimise_cheaply, library)
        library._finalize_final_module = types.MethodType(_finalise_without_code, library)
        super().run_pass(state)
        lowered = state["cr"]
        # callers find a function by a function object; if Python calls this one, it raises an error that explains it
        name = lowered.fndesc.qualname.split(".")[-1]
        stub = _dynfunc.make_function(
            lowered.fndesc.lookup_module(), name, "", _refusal_address(), lowered.env, (library,)
        )
        insert = insert_part if is_brief() else type(state.targetctx).insert_user_function
        insert(state.targetctx, stub, lowered.fndesc, (library,))
        state["cr"] = lowered._replace(cfunc=stub)
        return True


@_register(mutates_CFG=True, analysis_only=False)
class _Entry(_Native):  # type: ignore[misc]
    """Lowering of an entry point."""

    _name = "lowering_of_an_entry"

    @property
    def lowering_class(self) -> Any:
        """The class that lowers the function."""
        return Brief if is_brief() else _Lower


class Whole(_Compiler):  # type: ignore[misc]
    """Compiler of entry points: numba's pipeline with another lowering."""

    _lowering = _Entry

    def define_pipelines(self) -> list[Any]:
        """Return the pipeline as a list of one pass manager."""
        passes = _Passes.define_nopython_pipeline(self.state)
        passes.passes = [(self._lowering if p is _Native else p, text) for p, text in passes.passes]
        passes.finalize()
        return [passes]

    def _compile_core(self) -> Any:
        with apply_patches(), _short_loops(), _deep_recursion():
            return super()._compile_core()


class Inlined(Whole):
    """The same pipeline without machine code, for functions that are inlined."""

    _lowering = _Lowering
