"""Lock of the disk cache: one process compiles a kernel while others wait; a dozen workers start as fast as one.

With numba alone, every process that does not find a kernel on the disk compiles it; workers of a vectorised
environment, or of a test run, would all compile the same ones at the same time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockenv.jit.startup import no_garbage_collection

if TYPE_CHECKING:
    from filelock import FileLock

__all__ = ["PATIENCE", "NotCachedError", "OneAtATime", "only_cached", "require_cached"]

PATIENCE = 120.0
"""Longest wait, s, for another process, which may have stopped while compiling."""

_only_cached: ContextVar[bool] = ContextVar("only_cached", default=False)


class NotCachedError(RuntimeError):
    """A kernel that is not in the cache was needed in a block of `only_cached`."""


@contextmanager
def only_cached() -> Iterator[None]:
    """Let no kernel be compiled by this thread in a block: one that is not in the cache raises NotCachedError."""
    token = _only_cached.set(True)
    try:
        yield
    finally:
        _only_cached.reset(token)


def require_cached(found: object) -> None:
    """Raise NotCachedError if nothing was found in the cache, in a block of `only_cached`."""
    if found is None and _only_cached.get():
        raise NotCachedError("a kernel must be compiled")


class OneAtATime:
    """A function's disk cache in which only one process at a time compiles a missing entry."""

    def __init__(self, cache: Any, lock: Path, patience: float = PATIENCE) -> None:
        self._cache, self._path, self._patience = cache, lock, patience
        self._made: dict[int, FileLock] = {}

    def _make(self) -> FileLock:
        from filelock import FileLock  # imported here: a process that only reads the cache does not need it

        # shared by all threads: numba compiles in one at a time, and one may have to release the lock of another
        return FileLock(self._path, timeout=self._patience, thread_local=False)

    @property
    def _lock(self) -> FileLock:
        """The lock object of this process; one inherited by a fork is kept, as its deletion might release the lock."""
        if os.getpid() not in self._made:
            self._made[os.getpid()] = self._make()
        return self._made[os.getpid()]

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the entry on the disk, waiting while another process writes it; None if the caller must compile.

        Raises NotCachedError instead, without waiting, in a block of `only_cached`.
        """
        if os.getpid() in self._made:
            self.release()  # left by a compilation that failed
        found = self._read(signature, context)
        if found is not None:
            return found
        require_cached(found)
        try:
            self._lock.acquire()
        except OSError:  # timed out, or locking is impossible here: each process compiles for itself
            return None
        found = self._read(signature, context)
        if found is not None:
            self._lock.release()
        return found

    @no_garbage_collection()
    def _read(self, signature: Any, context: Any) -> Any:
        return self._cache.load_overload(signature, context)

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Write the compiled code and release the lock."""
        try:
            self._cache.save_overload(signature, compiled)
        finally:
            self.release()

    def release(self) -> None:
        """Release the lock, however often this process has acquired it."""
        self._lock.release(force=True)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)
