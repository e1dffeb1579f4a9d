"""Threads for compiled code: how many there are, and how a piece of work is given to all of them.

One thread unless asked for more: waiting threads spin, and where another process has the second core that costs more
than it brings. `use_threads(2)`, or FLOCKENV_THREADS=2 in the environment. Results do not depend on the number. Work is
shared where that is sooner done (`Choice`): to hand it over takes 20 microseconds, or, on a virtual machine, 100. More
threads than there are cores wait for each other in vain: there are never more at work.

On Linux the other threads keep off the core of the thread that shares its work: woken after a pause, they are put there
often, and two halves of the work are then done one after the other.
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

__all__ = ["Choice", "Choices", "at_work", "share", "threads", "use_threads"]

T = TypeVar("T")

_MOST = 256

SHORTEST = 4e-5
"""s: what one thread has done by then is not shared; to hand it over takes 20 microseconds, on some machines 100."""

LARGEST = 500_000
"""Steps of agents, each of which takes some 10 ns at least: so much work is surely sooner done by several threads."""

TRIAL = 3
"""Pieces of work by which a way to do it is judged: the best of all but the first."""

AGAIN, SELDOM = 64, 4096
"""After so many pieces of work what was slower is tried again; each time that it still is, after twice as many."""

RISE = 1.25
"""Who is held up by something else once is not thought that much slower: only this much, at most."""


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
_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_crew: _Crew | None = None
_in_python = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")  # numba itself takes long to import


def threads() -> int:
    """Return how many threads a step may use."""
    return _count


def at_work() -> int:
    """Return how many threads a step uses if that is faster: at most one per core, and one in plain Python.

    There, counting who has arrived is not one indivisible operation.
    """
    return 1 if _in_python else min(_count, _cores)


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


class Choice:
    """Is work of one kind and size sooner done by one thread or by several? Both are tried, and, seldom, tried again.

    What is sooner done depends on how the system wakes threads and on what else its cores do, so it is not worked out
    but seen. The first piece of a trial does not count: kernels are compiled in it, threads made, or woken.
    """

    always = False  # share everything: tests do, which are about results

    def __init__(self) -> None:
        self.took = [math.inf, math.inf]  # s, by one thread and by several
        self._tried, self._left, self._least = 0, TRIAL, math.inf  # which way, how many pieces yet, and their best
        self._wait, self._pause = 0, AGAIN

    @property
    def best(self) -> int:
        """What is sooner done, as far as is known: 0 by one thread, 1 by several."""
        return int(self.took[1] < self.took[0])

    def several(self) -> bool:
        """Are several threads to do the next piece of work?"""
        if not self._left:
            if self._wait > 0:
                self._wait -= 1
                return bool(self.best)
            self._try(1 - self.best)
        if self._tried and self.took[0] < SHORTEST:
            self._left, self._wait = 0, self._pause
            return False
        return bool(self._tried)

    def made(self, alone: Callable[[], T], shared: Callable[[], T], surely: bool = False) -> T:
        """Do a piece of work in one of two ways, and remember how long it took; return what it returns.

        surely: shared it is sooner done, and it is so large that it is never tried otherwise.
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
            self._judge()
        return result

    def _try(self, way: int) -> None:
        self._tried, self._left, self._least = way, TRIAL, math.inf

    def _judge(self) -> None:
        """Take over what a trial has shown; try the other way if it never was, else wait."""
        before, self.took[self._tried] = self.best, self._least
        if self.took[1] == math.inf:
            self._try(1)
        else:
            self._pause = AGAIN if self.best != before else min(2 * self._pause, SELDOM)
            self._wait = self._pause


class Choices(dict[tuple[Any, ...], Choice]):
    """A choice for each kind of work, and for each size, up to a factor of two."""

    def of(self, kind: str, work: int, count: int) -> Choice:
        """Return that of so many steps of agents and so many threads."""
        key = kind, work.bit_length(), count
        return self.get(key) or self.setdefault(key, Choice())


def _from_environment() -> None:
    text = os.environ.get("FLOCKENV_THREADS", "1")
    if not text.isdecimal() or not 1 <= int(text) <= _MOST:
        raise ValueError(f"FLOCKENV_THREADS is {text!r}, must be a whole number from 1 to {_MOST}")
    use_threads(int(text))


_from_environment()
