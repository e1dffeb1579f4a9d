"""The target processor of machine code: its features, and the width of its vector registers.

numba's settings (NUMBA_CPU_NAME, NUMBA_CPU_FEATURES, NUMBA_ENABLE_AVX) take precedence, but only features that are
listed: those implied by a processor's name alone are not detected. FLOCKENV_REGISTER=32 or 64 sets the register width
in bytes, for experiments. On one processor the results are bit-identical in both widths, as lanes are independent. (The
number of pairs evaluated, `State.work`, does depend on the number of lanes.) On a processor with other instructions
they may differ in rare cases: LLVM chooses which product of a sum it fuses.
"""

from __future__ import annotations

import os

import numba
from numba.core import codegen

__all__ = ["FEATURES", "LINE", "REGISTER"]

LINE = 64
"""Bytes of a cache line; no vector register is longer."""


def _features() -> frozenset[str]:
    """Return the processor's features by their names in LLVM."""
    setting: str | None = numba.config.CPU_FEATURES  # type: ignore[attr-defined]  # made from the environment
    found: str = codegen.get_host_cpu_features() if setting is None else setting  # type: ignore[no-untyped-call]
    return frozenset(name[1:] for name in found.split(",") if name.startswith("+"))


def _register_width() -> int:
    """Return the register width in bytes; ValueError if FLOCKENV_REGISTER is neither 32 nor 64 nor empty."""
    setting = os.environ.get("FLOCKENV_REGISTER", "")
    if setting not in ("", "32", "64"):
        raise ValueError(f"FLOCKENV_REGISTER = {setting!r}: must be 32 or 64 (bytes of a register), or empty")
    return int(setting) if setting else 64 if "avx512f" in FEATURES else 32


FEATURES = _features()
"""Features of the processor; only "avx512f" and "avx2" make a difference here."""

REGISTER = _register_width()
"""Bytes of a vector register: 64 with AVX-512, otherwise 32 (one of AVX2, or two of 16 bytes)."""
