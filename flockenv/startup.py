"""What a process does once: it imports folders and reads kernels. Nobody looks for garbage meanwhile."""

from __future__ import annotations

import contextlib
import gc
import importlib
import pkgutil
from collections.abc import Iterable, Iterator

__all__ = ["import_all", "nothing_to_collect"]


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


def import_all(package: str, path: Iterable[str]) -> None:
    """Import every module of a package's folder: what is written there registers itself."""
    with nothing_to_collect():
        for module in pkgutil.iter_modules(path):
            importlib.import_module(f"{package}.{module.name}")
