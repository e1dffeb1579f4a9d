"""Startup of a process: imports of whole folders and of numba, without garbage collection and without scipy."""

from __future__ import annotations

import contextlib
import gc
import importlib
import pkgutil
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import Any

__all__ = ["import_all", "import_numba_before_scipy", "no_garbage_collection"]

_one_at_a_time = threading.Lock()


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Disable garbage collection in a block whose objects nearly all stay alive.

    Collection traverses them repeatedly, and took a seventh of the time until a process's first step.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def import_all(package: str, path: Iterable[str], but: str = "") -> None:
    """Import every module of a package's folder except `but`, so that the classes defined there register themselves."""
    with no_garbage_collection():
        for module in pkgutil.iter_modules(path):
            if module.name != but:
                importlib.import_module(f"{package}.{module.name}")


def import_numba_before_scipy() -> None:
    """Import numba's array functions without scipy.linalg, which took a tenth of the time until a process's first step.

    numba imports scipy.linalg there only to check that it is available, and imports it again on use: when np.dot is
    compiled.
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
