"""Threads for compiled code: how many there are, and how a piece of work is given to all of them.

One thread unless asked for more: waiting threads spin, and where another process has the second core that costs more
than it brings. `use_threads(2)`, or FLOCKENV_THREADS=2 in the environment. Results do not depend on the number. Work is
shared where that is sooner done (`Pace`): it is handed over in 20 microseconds, or, on a virtual machine, in 100.

On Linux the other threads keep off the core of the thread that shares its work: woken after a pause, they are put there
often, and two halves of the work are then done one after the other.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import queue
import statistics
import threading
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, TypeVar

__all__ = ["Pace", "share", "threads", "use_threads"]

T = TypeVar("T")

_MOST = 256

QUICKEST = 1e-8
"""s that a step of an agent takes at least, until it is known better."""

WAITING = 4e-5
"""s that a team of threads loses with each step of a world: they wait for each other, and for what others wrote."""

TRIALS = 15
"""How often nothing is shared, to see how long that takes."""

LONGEST = 3e-4
"""s: handing work over takes no longer, whatever else the cores were doing when that was tried."""

DOUBTED = 64
"""Where sharing spares little, one thread does every so many-th piece of work, to see how long it takes by now."""


class _Crew:
    """Threads that wait for work; made when first needed, and anew in a forked process, which has none of them."""

    def __init__(self, count: int) -> None:
        self.pid = os.getpid()
        self.desks: list[queue.SimpleQueue[Any]] = [queue.SimpleQueue() for _ in range(count - 1)]
        self.lock = threading.Lock()
        for k, desk in enumerate(self.desks):
            threading.Thread(target=_work, args=(desk,), daemon=True, name=f"flockenv-{k + 1}").start()


def _how_to_ask() -> Callable[[], int] | None:
    """Return what says on which core a thread runs, if the system says so and lets threads be kept off one."""
    if not hasattr(os, "sched_setaffinity"):
        return None
    try:
        ask: Callable[[], int] = ctypes.PyDLL(None).sched_getcpu
    except (AttributeError, OSError, TypeError):
        return None
    return ask


_asked = _how_to_ask()


def _here() -> tuple[int, set[int]]:
    """Return on which core this thread runs, and on which it may; (-1, none) where the system does not say."""
    if _asked is not None:
        with contextlib.suppress(OSError):
            return _asked(), os.sched_getaffinity(0)
    return -1, set()


class _Place:
    """Where the thread that makes it may run."""

    def __init__(self) -> None:
        self.kept: set[int] = set()

    def keep_off(self, core: int, cores: set[int], many: int) -> None:
        """Run on the caller's cores from now on, but not on that one, where `many` threads have one beside it."""
        others = cores - {core}
        kept = others if len(others) >= many else cores
        if kept and kept != self.kept:
            with contextlib.suppress(OSError):  # forbidden here: it runs where the system likes
                os.sched_setaffinity(0, kept)
            self.kept = kept


def _work(desk: queue.SimpleQueue[Any]) -> None:
    place = _Place()
    while True:
        job, done, here = desk.get()
        try:
            place.keep_off(*here)
            done.put((job(), None))
        except BaseException as error:
            done.put((None, error))


_count = 1
_crew: _Crew | None = None


def threads() -> int:
    """Return how many threads a step may use."""
    return _count


def use_threads(count: int) -> None:
    """Let every step from now on use up to `count` threads; ValueError unless it is a whole number from 1 to 256."""
    global _count
    if type(count) is not int or not 1 <= count <= _MOST:  # True is no number of threads
        raise ValueError(f"threads is {count!r}, must be a whole number from 1 to {_MOST}")
    _count = count


def _crew_of(count: int) -> _Crew:
    """Return a crew with work for `count` threads; two callers at once may make two, and each keeps to its own."""
    global _crew
    crew = _crew
    if crew is None or crew.pid != os.getpid() or len(crew.desks) < count - 1:
        crew = _crew = _Crew(max(count, _count))
    return crew


def share(jobs: Sequence[Callable[[], Any]]) -> list[Any]:
    """Run some jobs at the same time, the first in this thread; return what each returned, or raise what one raised.

    All of them run at once, so they may wait for each other. Returns when all have ended, whatever happens.
    """
    crew, here = _crew_of(len(jobs)), (*_here(), len(jobs) - 1)  # who is pinned keeps its helpers there
    done: list[queue.SimpleQueue[Any]] = [queue.SimpleQueue() for _ in jobs[1:]]
    with crew.lock:  # all desks in one go: two callers whose jobs wait for each other never get in each other's way
        for desk, job, answer in zip(crew.desks, jobs[1:], done, strict=False):
            desk.put((job, answer, here))
    try:
        first = jobs[0]()
    finally:
        rest = [answer.get() for answer in done]
    for _, error in rest:
        if error is not None:
            raise error
    return [first, *(result for result, _ in rest)]


def _tried() -> float:
    """Return how long it takes to hand nothing over, and to have the answer, s."""
    took = []
    for _ in range(TRIALS):
        began = perf_counter()
        share([int, int])
        took.append(perf_counter() - began)
    return min(statistics.median(took), LONGEST)


_toll: float | None = None


class Pace:
    """How long one thread takes for pieces of work of one kind, in steps of agents: are they sooner done by several?

    Learned from what one thread took; of the first piece nothing is, for it may have been compiled. So it is known
    after two, but what is large at any pace is shared at once. To hand work over takes twice as long as was tried:
    between two pieces threads fall asleep, and cores.
    """

    def __init__(self) -> None:
        self.each, self._done, self._shared = 0.0, 0, 0

    def worth(self, work: int, count: int, waits: int = 0) -> bool:
        """Are so many steps of agents sooner done by `count` threads? waits: of which they make how many together."""
        global _toll
        if _toll is None:
            _toll = _tried()
        spared, cost = max(self.each, QUICKEST) * work * (1 - 1 / count), 2 * _toll + waits * WAITING
        if spared <= cost:
            return False
        self._shared += 1
        return self._shared % DOUBTED != 0 or spared > 4 * cost

    def alone(self, work: int, job: Callable[[], T]) -> T:
        """Do so many steps of agents in this thread, and learn from it how long they take; return what the job does."""
        began = perf_counter()
        result = job()
        seconds = perf_counter() - began
        self._done += 1
        if self._done > 1 and work > 0:
            self.each += (seconds / work - self.each) * (1.0 if self.each == 0 else 0.25)
        return result


def _from_environment() -> None:
    text = os.environ.get("FLOCKENV_THREADS", "1")
    if not text.isdecimal() or not 1 <= int(text) <= _MOST:
        raise ValueError(f"FLOCKENV_THREADS is {text!r}, must be a whole number from 1 to {_MOST}")
    use_threads(int(text))


_from_environment()
