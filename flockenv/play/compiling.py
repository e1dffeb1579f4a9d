"""Compiling for the playground in a process of its own.

Compilation holds Python's global lock for seconds, and the server could not send frames meanwhile. A child process that
does the same work fills the cache of kernels instead; the server then loads them from there.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.context import SpawnProcess
from typing import TypeVar

from flockenv.core import signals
from flockenv.jit.lock import NotCachedError, only_cached
from flockenv.jobs.local_engine import guard_process_starts

__all__ = ["Compiler"]

T = TypeVar("T")

_log = logging.getLogger("flockenv.play")


class Compiler:
    """Does work whose kernels a child process compiles if they are not in the cache; for one thread at a time."""

    def __init__(self) -> None:
        self._process: SpawnProcess | None = None
        self._lock, self._closed = threading.Lock(), False

    def do(self, work: Callable[[], T], like: Callable[[], Callable[[], object]]) -> T:
        """Return the result of some work, which may be begun several times before it succeeds.

        like: returns a function without arguments, which is pickled and compiles the kernels of the work where it is
        called. If the child process fails, they are compiled here, with one line in the log.
        """
        with suppress(NotCachedError), only_cached():
            return work()
        reason = self._run(like())
        with suppress(NotCachedError), only_cached():
            return work()
        reason = reason or "the cache does not hold its kernels"
        if self._closed:
            raise RuntimeError("the server has ended")
        _log.warning("compiling in a process of its own failed (%s): compiling in the server", reason)
        return work()

    def _run(self, work: Callable[[], object]) -> str:
        """Do work in a child process, which ends with this one; return why it failed, "" if it did not."""
        process = get_context("spawn").Process(target=_begin, args=(work,), daemon=True)
        try:
            with self._lock, guard_process_starts():
                if self._closed:
                    return "the server has ended"
                process.start()
                self._process = process
        except Exception as error:  # what cannot be pickled, or no memory or processes left
            return " ".join(f"{type(error).__name__}: {error}".split())
        process.join()
        return f"exit code {process.exitcode}" if process.exitcode else ""

    def close(self) -> None:
        """End the child process if there is one, and start no other."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.terminate()


def _begin(work: Callable[[], object]) -> None:
    """Do work as a child process; the server then runs into the same error itself."""
    signals.begin_worker()
    try:
        work()
    except Exception:
        raise SystemExit(1) from None
