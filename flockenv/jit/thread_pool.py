"""Thread pool for compiled code: the number of threads, and how work is distributed among them.

The default is one thread: waiting threads spin, which costs more than it gains if another process uses the second core.
Set it by `use_threads(2)`, or FLOCKENV_THREADS=2 in the environment. Results do not depend on the number. Work is
distributed if that is faster (`AutoTuner`): it takes 20 microseconds, or 100 on a virtual machine. More threads than
cores would only wait for each other, so at most one per core is used.

On Linux the pool's threads avoid the core of the calling thread: woken after a pause, they are often scheduled there,
and two halves of the work would then run one after the other.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import queue
import threading
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, TypeVar

__all__ = ["AutoTuner", "AutoTuners", "run_parallel", "threads", "usable_threads", "use_threads"]

T = TypeVar("T")

_MOST = 256

SHORTEST = 4e-5
"""s: shorter work is not distributed, as distribution takes 20 microseconds, on some machines 100."""

LARGEST = 500_000
"""Agent-steps, of at least some 10 ns each, from which several threads are always faster."""

TRIAL = 3
"""Pieces of work in a trial of one alternative; its time is the best of all but the first."""

AGAIN, SELDOM = 64, 4096
"""Pieces of work until the slower alternative is tried again, doubled up to SELDOM each time it is still slower."""

RISE = 1.25
"""Largest factor by which one measurement raises a time, so that a single disturbance counts little."""


class _ThreadPool:
    """Pool of threads that wait for work; it is created at first use, and again in a forked process."""

    def __init__(self, count: int) -> None:
        self.pid = os.getpid()
        self.desks: list[queue.SimpleQueue[Any]] = [queue.SimpleQueue() for _ in range(count - 1)]
        self.lock = threading.Lock()
        for k, desk in enumerate(self.desks):
            threading.Thread(target=_work, args=(desk,), daemon=True, name=f"flockenv-{k + 1}").start()


def _core_getter() -> Callable[[], int] | None:
    """Return the function that returns the current thread's core; None if the system has none, or no affinities."""
    if not hasattr(os, "sched_setaffinity"):
        return None
    try:
        ask: Callable[[], int] = ctypes.PyDLL(None).sched_getcpu
    except (AttributeError, OSError, TypeError):
        return None
    return ask


_current_core_number = _core_getter()


def _current_core() -> tuple[int, set[int]]:
    """Return the core that this thread runs on, and the cores that it may run on; (-1, empty set) if unknown."""
    if _current_core_number is not None:
        with contextlib.suppress(OSError):
            return _current_core_number(), os.sched_getaffinity(0)
    return -1, set()


class _Place:
    """CPU affinity of the thread that creates it."""

    def __init__(self) -> None:
        self.kept: set[int] = set()

    def avoid_core(self, core: int, cores: set[int], many: int) -> None:
        """Run on the caller's `cores` from now on, without `core` if at least `many` others are left."""
        others = cores - {core}
        kept = others if len(others) >= many else cores
        if kept and kept != self.kept:
            with contextlib.suppress(OSError):  # not permitted: the system chooses the core
                os.sched_setaffinity(0, kept)
            self.kept = kept


def _work(desk: queue.SimpleQueue[Any]) -> None:
    place = _Place()
    while True:
        job, done, here = desk.get()
        try:
            place.avoid_core(*here)
            done.put((job(), None))
        except BaseException as error:
            done.put((None, error))


_count = 1


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_cores = cores()
_pool: _ThreadPool | None = None
_in_python = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")  # numba itself takes long to import


def threads() -> int:
    """Return the number of threads that a step may use."""
    return _count


def usable_threads() -> int:
    """Return the number of threads that a step uses if this is faster: at most one per core; 1 in plain Python.

    In plain Python the barrier's counter is not atomic.
    """
    return 1 if _in_python else min(_count, _cores)


def use_threads(count: int) -> None:
    """Set the largest number of threads of a step; raise ValueError unless it is an integer from 1 to 256."""
    global _count
    if type(count) is not int or not 1 <= count <= _MOST:  # True is not a number of threads
        raise ValueError(f"threads is {count!r}, must be an integer from 1 to {_MOST}")
    _count = count


def _pool_of(count: int) -> _ThreadPool:
    """Return a pool for `count` threads; two callers at once may create two, and each uses its own."""
    global _pool
    pool = _pool
    if pool is None or pool.pid != os.getpid() or len(pool.desks) < count - 1:
        pool = _pool = _ThreadPool(max(count, _count))
    return pool


def run_parallel(jobs: Sequence[Callable[[], Any]]) -> list[Any]:
    """Run jobs in parallel, the first in this thread; return their results, or raise the error of one of them.

    All of them run at the same time, so they may wait for each other. Returns, or raises, only after all have ended.
    """
    pool, here = (
        _pool_of(len(jobs)),
        (*_current_core(), len(jobs) - 1),
    )  # a pinned caller keeps the pool's threads on its cores
    done: list[queue.SimpleQueue[Any]] = [queue.SimpleQueue() for _ in jobs[1:]]
    with pool.lock:  # all queues under one lock: the jobs of two callers, which wait for each other, never interleave
        for desk, job, answer in zip(pool.desks, jobs[1:], done, strict=False):
            desk.put((job, answer, here))
    try:
        first = jobs[0]()
    finally:
        rest = [answer.get() for answer in done]
    for _, error in rest:
        if error is not None:
            raise error
    return [first, *(result for result, _ in rest)]


class AutoTuner:
    """Choice between one thread and several for work of one kind and size; both are timed, and rarely timed again.

    The faster one depends on how the system wakes threads and on the load of its cores, so it is measured. The first
    piece of work of a trial does not count, as it includes compilation and the start of threads.
    """

    always = False  # distribute everything: for tests of results

    def __init__(self) -> None:
        self.took = [math.inf, math.inf]  # s, by one thread and by several
        self._tried, self._left, self._least = 0, TRIAL, math.inf  # alternative on trial, pieces left, best time
        self._wait, self._pause = 0, AGAIN

    @property
    def best(self) -> int:
        """The alternative that was faster so far: 0 one thread, 1 several."""
        return int(self.took[1] < self.took[0])

    def several(self) -> bool:
        """Return True if several threads are to do the next piece of work."""
        if not self._left:
            if self._wait > 0:
                self._wait -= 1
                return bool(self.best)
            self._start_trial(1 - self.best)
        if self._tried and self.took[0] < SHORTEST:
            self._left, self._wait = 0, self._pause
            return False
        return bool(self._tried)

    def run(self, alone: Callable[[], T], shared: Callable[[], T], surely: bool = False) -> T:
        """Call `alone` or `shared`, record the time it took, and return its result.

        surely: the work is so large that `shared` is called without a trial.
        """
        if surely or self.always:
            return shared()
        k = int(self.several())
        began = perf_counter()
        result = (alone, shared)[k]()
        seconds = perf_counter() - began
        if not self._left or k != self._tried:
            self.took[k] = min(seconds, RISE * self.took[k])
            return result
        self._left -= 1
        if self._left < TRIAL - 1:
            self._least = min(self._least, seconds)
        if not self._left:
            self._end_trial()
        return result

    def _start_trial(self, way: int) -> None:
        self._tried, self._left, self._least = way, TRIAL, math.inf

    def _end_trial(self) -> None:
        """Record the time of a trial; start that of the other alternative if it never ran, otherwise wait."""
        before, self.took[self._tried] = self.best, self._least
        if self.took[1] == math.inf:
            self._start_trial(1)
        else:
            self._pause = AGAIN if self.best != before else min(2 * self._pause, SELDOM)
            self._wait = self._pause


class AutoTuners(dict[tuple[Any, ...], AutoTuner]):
    """One `AutoTuner` for each kind of work, size (in powers of two) and number of threads."""

    def of(self, kind: str, work: int, count: int) -> AutoTuner:
        """Return the tuner for `work` agent-steps and `count` threads."""
        key = kind, work.bit_length(), count
        return self.get(key) or self.setdefault(key, AutoTuner())


def _from_environment() -> None:
    text = os.environ.get("FLOCKENV_THREADS", "1")
    if not text.isdecimal() or not 1 <= int(text) <= _MOST:
        raise ValueError(f"FLOCKENV_THREADS is {text!r}, must be an integer from 1 to {_MOST}")
    use_threads(int(text))


_from_environment()
