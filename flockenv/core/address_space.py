"""Checks that enough address space is left, and the one line about an error for lack of memory.

If the address space is limited (`ulimit -v`, batch systems), numpy and llvmlite fail to load with errors that do not
mention memory, loading OpenBLAS never returns, and LLVM and libgomp abort the process. So the address space is checked
before each such step. The sizes were measured on two cores, with 8 MiB of stack for each thread, and have a margin.
"""

from __future__ import annotations

import errno
import mmap
import os
import sys
from collections.abc import Sequence

__all__ = ["COMPILING", "IN_USE", "LOADING", "TRAINING", "require", "require_room", "shortage"]

LIBRARIES, PER_CORE = 570 * 2**20, 20 * 2**20
"""Bytes that a command needs for its libraries, and for each BLAS thread."""

COMPILING = 340 * 2**20
"""Bytes that compiling a kernel needs: 260 MiB for that of configs/scenes/stampede.yaml."""

LOADING = 32 * 2**20
"""Bytes that loading a compiled kernel needs, with the start of LLVM: 10 MiB."""

TORCH = 720 * 2**20
"""Bytes that torch, Stable-Baselines3 and what they import need: 690 MiB."""

IN_USE = "in addition to what is in use"
"""The end of a purpose: the bytes are needed in addition."""

TRAINING = 300 * 2**20 + 72 * 2**20 * (os.cpu_count() or 1)
"""Bytes that training needs after all imports, with a stack and 64 MiB of heap for each thread: 390 MiB."""


def require(command: str) -> None:
    """Exit with code 2 and a one-line message if the address space for the command's libraries is not available.

    From then on the import of torch is checked in the same way.
    """
    if command and os.name == "posix":
        _require_or_exit(command, LIBRARIES + PER_CORE * (os.cpu_count() or 1), "beside Python's own")
        sys.meta_path.insert(0, _TorchCheck(command))


def require_room(purpose: str, needed: int) -> None:
    """Raise MemoryError, in one line, unless `needed` bytes of address space are left.

    purpose: what they are needed for, as the end of the line: "to compile a kernel, in addition to what is in use".
    """
    if os.name != "posix":
        return
    try:
        mmap.mmap(-1, needed, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, 0).close()  # PROT_NONE: reserved, never committed
    except (OSError, MemoryError):
        text = f"at least {needed / 1e9:.2g} GB of address space are needed {purpose}"
        raise MemoryError(text + _limit()) from None


def shortage(error: BaseException) -> str | None:
    """Return what failed, in one line, if an error is about lack of memory; None for any other error."""
    text = _failure(error)
    return text if text is None or "(ulimit -v)" in text else f"{text}{_limit()}"


def _failure(error: BaseException) -> str | None:
    text = next(iter(str(error).splitlines()), "")
    if isinstance(error, MemoryError):
        return text or "use fewer agents or worlds"
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return str(error.strerror) if error.filename is None else f"{error.filename}: {error.strerror}"
    if isinstance(error, ImportError) and "failed to map segment" in text and _limit():
        return text
    if isinstance(error, SystemError) and text == "error return without exception set":
        return "none is left for a call of a function"  # how CPython 3.11 ends a call that gets no memory
    if isinstance(error, RuntimeError) and "can't start new thread" in text:
        return "no further thread can be started (ulimit -v, ulimit -u)"
    if isinstance(error, RuntimeError) and "DefaultCPUAllocator: " in text:
        return f"torch: {text.partition('DefaultCPUAllocator: ')[2]}"
    return None


class _TorchCheck:
    """Finder of modules that finds none, but ends the command before torch is imported into too little memory."""

    def __init__(self, command: str) -> None:
        self._command = command

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: object = None) -> None:
        """Return None: the next finder is tried; exit if `name` is torch and there is too little room for it."""
        if name == "torch":
            _require_or_exit(self._command, TORCH, f"to import torch, {IN_USE}")


def _require_or_exit(command: str, needed: int, purpose: str) -> None:
    try:
        require_room(purpose, needed)
    except MemoryError as error:
        print(f"{command}: not enough memory: {error}", file=sys.stderr)  # noqa: T201  # a command, and it ends here
        raise SystemExit(2) from None


def _limit() -> str:
    """Return the limit of the address space as the end of a line; "" if there is none."""
    if os.name != "posix":
        return ""
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return "" if limit == resource.RLIM_INFINITY else f", {limit / 1e9:.2f} GB are allowed (ulimit -v)"
