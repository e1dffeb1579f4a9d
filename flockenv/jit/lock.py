"""One process compiles a kernel, the others wait for what it writes: a dozen workers start as fast as one.

numba lets every process that misses a kernel on the disk compile it. Workers of a vectorised environment, or of a test
run, all miss the same ones at the same time.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockenv.jit.startup import nothing_to_collect

if TYPE_CHECKING:
    from filelock import FileLock

__all__ = ["PATIENCE", "OneAtATime"]

PATIENCE = 120.0
"""Seconds that somebody else's compilation is waited for; whoever stopped in the middle of one keeps nobody longer."""


class OneAtATime:
    """A function's cache on the disk, of which one process at a time may have missed an entry."""

    def __init__(self, cache: Any, lock: Path, patience: float = PATIENCE) -> None:
        self._cache, self._path, self._patience = cache, lock, patience
        self._made: dict[int, FileLock] = {}

    def _make(self) -> FileLock:
        from filelock import FileLock  # here: who only reads need not wait for it

        # of all threads: numba compiles in one at a time, and the next one may have to let go of what another left
        return FileLock(self._path, timeout=self._patience, thread_local=False)

    @property
    def _lock(self) -> FileLock:
        """The lock as this process has it. One that a fork has inherited is left alone: to drop it might free it."""
        if os.getpid() not in self._made:
            self._made[os.getpid()] = self._make()
        return self._made[os.getpid()]

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return what is on the disk, if need be as soon as another process has written it; None: it is up to you."""
        if os.getpid() in self._made:
            self._lock.release(force=True)  # of a compilation that failed
        found = self._read(signature, context)
        if found is not None:
            return found
        try:
            self._lock.acquire()
        except OSError:  # waited for too long, or nothing can be locked here: each compiles for himself
            return None
        found = self._read(signature, context)
        if found is not None:
            self._lock.release()
        return found

    @nothing_to_collect()
    def _read(self, signature: Any, context: Any) -> Any:
        return self._cache.load_overload(signature, context)

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Write what was compiled, and let others read it."""
        try:
            self._cache.save_overload(signature, compiled)
        finally:
            self._lock.release(force=True)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)
