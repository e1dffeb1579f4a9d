"""Parallel work on many jobs by a few processes, each of which takes one job after another and ends with its parent."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from typing import Any, TypeVar

from flockenv.core import signals

__all__ = ["Tell", "announce_parent", "guard_process_starts", "serve", "side_by_side"]

Job = TypeVar("Job")
Done = TypeVar("Done")

Tell = Callable[..., None]
"""Called with reports of progress, of any form."""


def side_by_side(work: Callable[[Job, Tell], Done], jobs: Sequence[Job], processes: int, tell: Tell) -> Iterator[Done]:
    """Yield the result of every job, in their order, computed by a number of processes.

    Args:
        work: a function of a module (it is found by name there), called with a job and a function that takes reports.
        jobs: the arguments of `work`; they and the results are pickled between processes.
        processes: number of processes; each imports the main module, so a script needs `if __name__ == "__main__":`.
        tell: called with the reports of all processes, by another thread; not again once it has raised.

    Raises:
        OSError: a process was ended from outside.
        KeyboardInterrupt: the same, by a signal that this process also received.
        Exception: the first that `work` or `tell` raises. The other processes end then, and also whenever this one
        ends.
    """
    context = get_context("spawn")
    if os.name == "posix":
        _start_tracker()
    with _forward_news(context, tell) as (sender, turn, trouble):
        others, workers = active_children(), []
        at_work: list[Future[Done]] = []
        with ProcessPoolExecutor(processes, context, _begin_worker, (sender, turn)) as pool:
            try:
                with guard_process_starts():
                    at_work += [pool.submit(_do_job, work, job) for job in jobs]
                    workers += [process for process in active_children() if process not in others]
                for working in at_work:
                    wait((working, trouble), return_when=FIRST_COMPLETED)
                    if trouble.done():
                        break
                    yield working.result()
            except BrokenExecutor:
                signals.raise_if_received()  # the signal that ended a worker was sent to the whole process group
                raise OSError("one of the processes was ended from outside; is there enough memory?") from None
            finally:
                if len(at_work) < len(jobs) or not all(working.done() for working in at_work):
                    for process in workers:
                        process.terminate()
    if trouble.done():
        trouble.result()


@contextmanager
def _forward_news(context: Any, tell: Tell) -> Iterator[tuple[Connection, Any, Future[None]]]:
    """Pass the reports of other processes on to `tell`, in a thread of its own, while the block lasts.

    Yields the connection to which they send reports, the lock that a process holds while it sends, and a future that
    has the error of `tell`, if it raised one; after that no more reports are passed on.
    """
    receiver, sender = context.Pipe(duplex=False)
    trouble: Future[None] = Future()

    def listen() -> None:
        while True:
            try:
                news = receiver.recv()
            except Exception:  # no process is left to report or to finish
                return
            if news is None:
                return
            try:
                if not trouble.done():
                    tell(*news)
            except BaseException as error:
                trouble.set_exception(error)

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    try:
        yield sender, context.Lock(), trouble
    finally:
        sender.send(None)  # closing the pipe ends the thread as well, unless a process has not opened its end
        sender.close()
        listener.join()
        receiver.close()


@contextmanager
def announce_parent() -> Iterator[None]:
    """Set the environment so that processes that are started in a block end when this one ends."""
    before = os.environ.get(signals.PARENT)
    os.environ[signals.PARENT] = str(os.getpid())
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(signals.PARENT, None)
        else:
            os.environ[signals.PARENT] = before


@contextmanager
def guard_process_starts() -> Iterator[None]:
    """Let processes that are started in a block end with this one and ignore Ctrl-C, by inherited blocked signals."""
    with announce_parent():
        if os.name != "posix":
            yield
            return
        _start_tracker()  # it unblocks signals, so it must be there before they are blocked
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_tracker() -> None:
    """Start Python's resource tracker, which removes semaphores that processes leave behind, with warnings off."""
    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore"
    try:
        resource_tracker.ensure_running()
    finally:
        del os.environ["PYTHONWARNINGS"]
        if before is not None:
            os.environ["PYTHONWARNINGS"] = before


_tell: Tell
"""In a worker process: the function that sends reports to the parent."""


def _begin_worker(sender: Connection, turn: Any) -> None:
    """Prepare a worker process: set up its reports, and its end with the parent."""
    global _tell

    def tell(*news: Any) -> None:
        with turn:
            sender.send(news)

    _tell = tell
    serve()


def serve() -> None:
    """Make this process a worker: it leaves Ctrl-C to its parent, and ends when its parent ends."""
    signals.begin_worker()
    os.environ["FLOCKENV_QUIET"] = "1"
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with_parent, args=(parent.sentinel,), daemon=True).start()


def _end_with_parent(sentinel: int) -> None:
    """End this process when its parent has ended; a sentinel is ready then, even after SIGKILL."""
    wait_for([sentinel])
    os.kill(os.getpid(), signal.SIGTERM)


def _do_job(work: Callable[[Job, Tell], Done], job: Job) -> Done:
    return work(job, _tell)
