"""Progress of compilation: how long each kernel took, and a line on the terminal while one is compiled.

A kernel is compiled at its first call, once per machine: its code is then in the cache folder (see `section`). On a
terminal a line names the kernel and, when it is done, the time it took; FLOCKENV_QUIET=1 turns this off.
"""

from __future__ import annotations

import os
import sys
from time import perf_counter
from typing import Any, NamedTuple

from numba.core import event

from flockenv.jit.lock import OneAtATime
from flockenv.jit.numba_patches import front_end, lowering

__all__ = ["Compiled", "compiled_kernels", "unapplied_patches"]


class Compiled(NamedTuple):
    """One kernel that this process compiled."""

    kernel: str  # the name of its entry point, such as "scene_step"
    what: str  # its title; for a scene: dimension, space, effects and method
    seconds: float


_done: list[Compiled] = []


def compiled_kernels() -> tuple[Compiled, ...]:
    """Return the kernels that this process has compiled so far; empty if all came from the cache."""
    return tuple(_done)


def unapplied_patches() -> tuple[str, ...]:
    """Return the titles of the patches that are not applied because the installed numba's source differs."""
    every = [
        *((each.title, each.reads) for each in front_end.PATCHES),
        ("lowering", lowering.READS),
    ]
    return tuple(title for title, reads in every if not front_end.is_known_source(reads))


class _Watch(event.Listener):
    """Listener that times numba's compilation of each entry point, which includes the laws inside it."""

    def __init__(self) -> None:
        self.began: dict[int, float] = {}

    def on_start(self, event: Any) -> None:
        """Store the start time and print the line."""
        function = _entry_point(event)
        if function is not None:
            self.began[id(event.data["dispatcher"])] = perf_counter()
            folder = _folder(event.data["dispatcher"])
            _print(f"flockenv: compiling {_kernel_title(event.data['dispatcher'])} (once; kept in {folder}) ...")

    def on_end(self, event: Any) -> None:
        """Record the duration and complete the line."""
        function = _entry_point(event)
        began = self.began.pop(id(event.data["dispatcher"]), None)
        if function is not None and began is not None:
            seconds = perf_counter() - began
            _done.append(Compiled(function.__name__, _kernel_title(event.data["dispatcher"]), seconds))
            _print(f" {seconds:.1f} s\n")


def _entry_point(event: Any) -> Any:
    """Return the function of an event if it is an entry point with a disk cache, otherwise None."""
    dispatcher = event.data["dispatcher"]
    ours = isinstance(getattr(dispatcher, "_cache", None), OneAtATime)
    return dispatcher.py_func if ours else None


def _kernel_title(dispatcher: Any) -> str:
    """Return the title of an entry point, or the first line of its docstring, or its name."""
    text: str = vars(dispatcher).get("title") or dispatcher.py_func.__doc__ or dispatcher.py_func.__name__
    return text.split("\n")[0]


def _folder(dispatcher: Any) -> str:
    folder: str = dispatcher._cache.cache_path
    return folder.replace(os.path.expanduser("~"), "~", 1)


def _print(text: str) -> None:
    if sys.stderr is not None and sys.stderr.isatty() and not os.environ.get("FLOCKENV_QUIET"):
        sys.stderr.write(text)
        sys.stderr.flush()


event.register("numba:compile", _Watch())  # type: ignore[no-untyped-call]  # numba has no types here
