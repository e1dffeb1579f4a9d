"""numba's compiler as our functions use it: entry points whole, and what is only ever inlined without machine code.

numba makes machine code, and a wrapper for Python, of every compiled function, and optimises each to the end before it
optimises its caller. Laws and kernels are parts of an entry point and of nothing else; that work was half of the time a
scene took to compile. (The steps below are numba's own, less those; they are internals of numba, and tests notice when
they change.)
"""

from __future__ import annotations

import functools
import types
from typing import Any

import numba
from numba import _dynfunc  # type: ignore[attr-defined]  # compiled
from numba.core import compiler, compiler_machinery, typed_passes

from flockenv.frontend import lighter, spared

__all__ = ["Inlined", "Whole"]

_register: Any = compiler_machinery.register_pass  # numba is untyped
_Native: Any = typed_passes.NativeLowering
_Compiler: Any = compiler.CompilerBase
_Passes: Any = compiler.DefaultPassBuilder


@functools.cache
def _refusal() -> int:
    """Return the address of what runs when Python calls one: it takes no arguments, and says so."""

    def part_of_a_kernel() -> None:
        raise TypeError("this function is a part of kernels and is not called alone; call its py_func")

    refuse: Any = numba.njit(part_of_a_kernel)
    refuse.compile(())
    made = next(iter(refuse.overloads.values()))
    return int(made.library.get_pointer_to_function(made.fndesc.llvm_cpython_wrapper_name))


def _optimise_a_little(library: Any) -> None:
    """Run the cheap passes only: the caller's are the ones that count."""
    codegen = library._codegen
    passes, builder = codegen._module_pass_manager(
        loop_vectorize=False, slp_vectorize=False, opt=codegen._opt_level, cost="cheap"
    )
    passes.run(library._final_module, builder)


def _finalise_unmade(library: Any) -> None:
    """End like numba does, but hand nothing to the engine that makes machine code."""
    library._finalize_dynamic_globals()
    library._verify_declare_only_symbols()
    library._finalized = True


@_register(mutates_CFG=True, analysis_only=False)
class _Lowering(_Native):  # type: ignore[misc]
    """Lowering without machine code."""

    _name = "lowering_to_be_inlined"

    def run_pass(self, state: Any) -> bool:
        """Lower, and register the function for its callers."""
        state.flags.no_compile = True
        state.flags.no_cpython_wrapper = True
        state.flags.no_cfunc_wrapper = True
        codegen = state.targetctx.codegen()
        state.library = library = codegen.create_library(state.func_id.func_qualname)
        library._optimize_final_module = types.MethodType(_optimise_a_little, library)
        library._finalize_final_module = types.MethodType(_finalise_unmade, library)
        super().run_pass(state)
        lowered = state["cr"]
        # callers find a function by an object of its own; called from Python, this one says what it is
        name = lowered.fndesc.qualname.split(".")[-1]
        stub = _dynfunc.make_function(lowered.fndesc.lookup_module(), name, "", _refusal(), lowered.env, (library,))
        state.targetctx.insert_user_function(stub, lowered.fndesc, [library])
        state["cr"] = lowered._replace(cfunc=stub)
        return True


class Whole(_Compiler):  # type: ignore[misc]
    """numba's pipeline, less what frontend spares it: how an entry point is compiled."""

    def define_pipelines(self) -> list[Any]:
        """Return the passes."""
        passes = _Passes.define_nopython_pipeline(self.state)
        passes.passes = self._chosen(spared(passes.passes))
        passes.finalize()
        return [passes]

    def _chosen(self, passes: list[Any]) -> list[Any]:
        return passes

    def _compile_core(self) -> Any:
        with lighter():
            return super()._compile_core()


class Inlined(Whole):
    """The same with that lowering."""

    def _chosen(self, passes: list[Any]) -> list[Any]:
        return [(_Lowering if p is _Native else p, text) for p, text in passes]
