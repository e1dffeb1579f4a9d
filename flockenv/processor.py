"""The processor that machine code is made for: what it can do, and how many numbers lie side by side in it.

What numba is told of it counts (NUMBA_CPU_NAME, NUMBA_CPU_FEATURES, NUMBA_ENABLE_AVX), for that is what LLVM knows.
Results are the same bits on every processor that fuses multiplications with additions: lanes do not know of each other.
"""

from __future__ import annotations

import numba
from numba.core import codegen

__all__ = ["FEATURES", "REGISTER"]


def _features() -> frozenset[str]:
    """Return what it can do, as LLVM names it."""
    told: str | None = numba.config.CPU_FEATURES  # type: ignore[attr-defined]  # made from the environment
    found: str = codegen.get_host_cpu_features() if told is None else told  # type: ignore[no-untyped-call]
    return frozenset(name[1:] for name in found.split(",") if name.startswith("+"))


FEATURES = _features()
"""What it can do: "avx512f" and "avx2" make a difference here."""

REGISTER = 64 if "avx512f" in FEATURES else 32
"""Bytes of numbers side by side: a vector register; without AVX-512 one of AVX2, and elsewhere two of 16 bytes."""
