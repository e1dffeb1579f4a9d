"""The processor that machine code is made for: what it can do, and how many numbers lie side by side in it.

What numba is told of it counts (NUMBA_CPU_NAME, NUMBA_CPU_FEATURES, NUMBA_ENABLE_AVX), as far as it is written there:
what follows from a processor's name alone is not seen. FLOCKENV_REGISTER=32 or 64 says how many bytes lie side by side,
for whoever wants to know what another size does. Results are the same bits in either on one processor: lanes do not
know of each other. (How many pairs were met, `State.work`, follows from how many lanes there are.) On a processor with
other instructions they mostly are, too, but need not be: of a sum of products LLVM fuses which one it likes.
"""

from __future__ import annotations

import os

import numba
from numba.core import codegen

__all__ = ["FEATURES", "LINE", "REGISTER"]

LINE = 64
"""Bytes of a line of the cache; no vector register is longer."""


def _features() -> frozenset[str]:
    """Return what it can do, as LLVM names it."""
    told: str | None = numba.config.CPU_FEATURES  # type: ignore[attr-defined]  # made from the environment
    found: str = codegen.get_host_cpu_features() if told is None else told  # type: ignore[no-untyped-call]
    return frozenset(name[1:] for name in found.split(",") if name.startswith("+"))


def _register() -> int:
    """Return how many bytes lie side by side; ValueError where the environment asks for something else."""
    told = os.environ.get("FLOCKENV_REGISTER", "")
    if told not in ("", "32", "64"):
        raise ValueError(f"FLOCKENV_REGISTER = {told!r}: must be 32 or 64 (bytes side by side), or nothing")
    return int(told) if told else 64 if "avx512f" in FEATURES else 32


FEATURES = _features()
"""What it can do: "avx512f" and "avx2" make a difference here."""

REGISTER = _register()
"""Bytes of numbers side by side: a vector register; without AVX-512 one of AVX2, and elsewhere two of 16 bytes."""
