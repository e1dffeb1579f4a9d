"""What a process does once: it imports folders and reads kernels. Nobody looks for garbage meanwhile, nor for scipy."""

from __future__ import annotations

import contextlib
import gc
import importlib
import pkgutil
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import Any

__all__ = ["import_all", "nothing_to_collect", "numba_before_scipy"]

_one_at_a_time = threading.Lock()


@contextlib.contextmanager
def nothing_to_collect() -> Iterator[None]:
    """Keep Python from looking for garbage where nearly all that is made stays: it would walk through it repeatedly.

    It took a seventh of the time until a process's first step.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def import_all(package: str, path: Iterable[str], but: str = "") -> None:
    """Import every module of a package's folder, but for one: what is written there registers itself."""
    with nothing_to_collect():
        for module in pkgutil.iter_modules(path):
            if module.name != but:
                importlib.import_module(f"{package}.{module.name}")


def numba_before_scipy() -> None:
    """Have numba load what it knows of arrays without scipy.linalg, a tenth of the time until a process's first step.

    It imports scipy.linalg there to see that it can be imported, and does so again where it is used: whoever compiles
    np.dot has it imported then.
    """
    name = "numba.np.arraymath"
    if name in sys.modules:
        return
    with _one_at_a_time:
        linalg: Any = importlib.import_module("numba.np.linalg")
        asks = getattr(linalg, "ensure_blas", None)
        if name in sys.modules or asks is None:
            return
        linalg.ensure_blas = lambda: None
        try:
            importlib.import_module(name)
        finally:
            linalg.ensure_blas = asks
