"""Check that a command has enough address space: if not, one line is printed before a library fails.

If the address space is limited (`ulimit -v`, batch systems), numpy and llvmlite fail to load with errors that do not
mention memory, and loading OpenBLAS never returns.
"""

from __future__ import annotations

import mmap
import os
import sys

__all__ = ["require"]

LIBRARIES, PER_CORE = 570 * 2**20, 20 * 2**20
"""Bytes of address space that a command needs: measured on two cores, with 8 MiB of stack for each BLAS thread."""


def require(command: str) -> None:
    """Exit with code 2 and a one-line message if the address space for the command's libraries is not available."""
    if not command or os.name != "posix":
        return
    needed = LIBRARIES + PER_CORE * (os.cpu_count() or 1)
    try:
        mmap.mmap(-1, needed, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, 0).close()  # PROT_NONE: reserved, never committed
    except (OSError, MemoryError):
        text = f"at least {needed / 1e9:.2g} GB of address space are needed beside Python's own{_limit()}"
        print(f"{command}: not enough memory: {text}", file=sys.stderr)
        raise SystemExit(2) from None


def _limit() -> str:
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return "" if limit == resource.RLIM_INFINITY else f", {limit / 1e9:.2g} GB are allowed (ulimit -v)"
