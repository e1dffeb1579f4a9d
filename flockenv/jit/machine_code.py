"""Machine code of kernels in a checked store: a disk cache like numba's own, but of verified files.

numba's cache unpickles what it finds, and unpickling runs code. This one has numba's methods and one file for every
combination of argument types and processor. A file is unpickled only after its owner and its digest were verified.
"""

from __future__ import annotations

import hashlib
import pickle
import warnings
from typing import Any

import llvmlite  # type: ignore[import-untyped]
from llvmlite import binding
from numba.core.compiler import CompileResult
from numba.core.errors import NumbaWarning
from numba.core.serialize import dumps

from flockenv.jit.checked_store import Store

__all__ = ["MachineCode"]


def _without_callers_part(reduced: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return numba's reduced form of an entry point without the data for compiled callers, as it has none.

    Omitted are the code of its functions, of which empty ones remain for those that Python calls, and the environments
    of its parts, which contain no Python objects: three quarters of a file.
    """
    (name, kind, (code, _)), described, *rest, _ = reduced
    assert kind == "object", f"numba keeps machine code as {kind!r}, expected 'object'"
    called = described.llvm_func_name, described.llvm_cpython_wrapper_name, described.llvm_cfunc_wrapper_name
    text = "\n".join(f'define void @"{function}"() {{ ret void }}' for function in called)
    text += f'\n@"{described.env_name}" = global i8* null'
    named = bytes(binding.parse_assembly(text).as_bitcode())
    return ((name, kind, (code, named)), described, *rest, ())


class MachineCode:
    """Disk cache of one function's compiled forms, under a name that includes the digest of its sources."""

    def __init__(self, store: Store, name: str) -> None:
        self._store, self._name = store, name
        self.cache_path = str(store.folder)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled form for these argument types and this processor; None if the store has none."""
        context.refresh()
        data = self._store.read(self._file(signature, context.codegen()))
        if data is None:
            return None
        kept_signature, parts = pickle.loads(data)  # noqa: S301  # its owner and its digest were verified
        rebuild: Any = CompileResult._rebuild
        return rebuild(context, *parts) if kept_signature == signature else None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Store a compiled form unless it contains addresses that are valid only in this process."""
        if compiled.library.has_dynamic_globals or any(not loop.can_cache for loop in compiled.lifted):
            said = f"{self._name}: contains addresses, so every process compiles it again"
            warnings.warn(said, NumbaWarning, stacklevel=2)
            return
        pickled: Any = dumps
        self._store.write(
            self._file(signature, compiled.codegen), pickled((signature, _without_callers_part(compiled._reduce())))
        )

    def flush(self) -> None:
        """Do nothing, as a function that is compiled again replaces the stored form."""

    def _file(self, signature: Any, codegen: Any) -> str:
        text = repr((signature, codegen.magic_tuple(), llvmlite.__version__))
        return f"{self._name}.{hashlib.sha256(text.encode()).hexdigest()[:20]}.nbc"
