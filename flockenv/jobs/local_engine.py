"""The local engine: processes of this machine, each of which takes one job after another and ends with its parent."""

from __future__ import annotations

import functools
import logging
import os
import signal
import tempfile
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from multiprocessing.connection import wait as wait_for
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from flockenv.core import signals
from flockenv.core.available_memory import available_memory
from flockenv.jit.thread_pool import cores
from flockenv.jobs.engine import TRIES, Begun
from flockenv.jobs.job import Failure, Job, code_digest, execute

_log = logging.getLogger("flockenv.jobs")

__all__ = ["LocalEngine", "count_fitting", "guard_process_starts"]

LOG_END = 300
"""Characters of a process's output that a failure quotes."""

BLAS_THREADS = "OMP_NUM_THREADS"
"""Environment variable that OpenMP, OpenBLAS, MKL and torch read when they are loaded; the first three have variables
of their own, which go before it."""


class LocalEngine:
    """Runs jobs in a number of processes; 1: in this process, unless renew.

    renew: every job gets a new process. Each process is a pool of its own, so the end of one does not affect the
    jobs of others. There are fewer processes if jobs that run together would not fit into the available memory, and
    each uses its share of the cores for BLAS and OpenMP, unless OMP_NUM_THREADS is set.
    """

    def __init__(self, processes: int, renew: bool = False) -> None:
        self.processes, self.renew = processes, renew
        self._kept: tuple[list[_Worker], Path] | None = None

    @property
    def parallel(self) -> bool:
        """True if there are several processes."""
        return self.processes > 1

    @property
    def _in_this_process(self) -> bool:
        return self.processes == 1 and not self.renew

    def keep(self) -> AbstractContextManager[object]:
        """Keep the processes of all runs in a block until it ends, so that later runs need not start new ones."""
        return nullcontext() if self._in_this_process else self._keep()

    @contextmanager
    def _keep(self) -> Iterator[tuple[list[_Worker], Path]]:
        if self._kept is not None:
            yield self._kept
            return
        _start_tracker()
        with tempfile.TemporaryDirectory(prefix="flockenv-logs-") as logs, signals.remove_at_end(logs):
            workers: list[_Worker] = []
            self._kept = workers, Path(logs)
            try:
                yield self._kept
            finally:
                self._kept = None
                for worker in workers:
                    worker.end()

    def run(self, jobs: Iterable[Job], begun: Begun) -> Generator[tuple[Job, bytes | Failure], None, None]:
        """Yield each job with its record or its failure."""
        jobs = deque(jobs)
        processes = count_fitting(min(self.processes, len(jobs)), jobs)
        if self._in_this_process:
            for job in jobs:
                begun(job)
                yield job, execute(job.function, job.arguments, code_digest())
            return
        with self._keep() as (workers, logs):
            more = range(len(workers), processes)
            workers += [_Worker(logs / str(k), max(1, cores() // processes)) for k in more]
            working: dict[Future[bytes | Failure], tuple[Job, _Worker]] = {}
            try:
                yield from self._run(jobs, begun, workers[:processes], working)
            finally:
                for _, worker in working.values():  # the run was closed before these jobs had ended
                    worker.restart()

    def _run(
        self,
        waiting: deque[Job],
        begun: Begun,
        workers: Sequence[_Worker],
        working: dict[Future[bytes | Failure], tuple[Job, _Worker]],
    ) -> Generator[tuple[Job, bytes | Failure], None, None]:
        """Give each free process the next job, until all are done; `working` has those under way."""
        tries: Counter[str] = Counter()
        idle = list(workers)
        while waiting or working:
            while waiting and idle:
                job, worker = waiting.popleft(), idle.pop()
                begun(job)
                working[worker.submit(job)] = job, worker
            for future in wait(working, return_when=FIRST_COMPLETED).done:
                job, worker = working.pop(future)
                idle.append(worker)
                try:
                    record = future.result()
                except BrokenExecutor:
                    signals.raise_if_received()  # the signal that ended it was sent to the whole process group
                    tries[job.key] += 1
                    log = worker.restart()
                    if tries[job.key] < TRIES:
                        waiting.appendleft(job)
                        continue
                    record = Failure(f"its process ended {TRIES} times, perhaps for lack of memory", log)
                if self.renew:
                    worker.restart()
                yield job, record


class _Worker:
    """A process for jobs, which starts with its first job.

    threads: of BLAS and OpenMP.
    """

    def __init__(self, log: Path, threads: int) -> None:
        self._log, self._threads, self._processes = log, threads, list[BaseProcess]()
        self._pool = self._new_pool()

    def _new_pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, get_context("spawn"), _begin_worker, (str(self._log),))

    def submit(self, job: Job) -> Future[bytes | Failure]:
        """Give the process a job; it starts now if it does not run, or has ended since its last job."""
        work = functools.partial(_execute_with_log, job.function, job.arguments, code_digest())
        if self._processes:
            try:
                return self._pool.submit(work)
            except BrokenExecutor:
                self.restart()
        before = active_children()
        try:
            with guard_process_starts(), _environment({BLAS_THREADS: os.environ.get(BLAS_THREADS, str(self._threads))}):
                return self._pool.submit(work)
        finally:
            self._processes = [process for process in active_children() if process not in before]

    def restart(self) -> str:
        """End the process if it runs, and prepare a new one; return the end of its output since its last job began."""
        self.end()
        text = self._log.read_text(errors="replace") if self._log.exists() else ""
        self._log.unlink(missing_ok=True)
        self._processes, self._pool = [], self._new_pool()
        return " ".join(text.split())[-LOG_END:]

    def end(self) -> None:
        """End the process."""
        for process in self._processes:
            process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)


def count_fitting(processes: int, jobs: Iterable[Job]) -> int:
    """Return the number of processes, at least 1, whose jobs fit into the available memory; a log line if reduced."""
    need, room = max((job.memory for job in jobs), default=0), available_memory()
    if not need or room is None or need * processes <= room:
        return processes
    fitting = max(1, min(processes, room // need))
    if fitting < processes:
        sizes = f"a job needs about {need / 1e9:.2g} GB, {room / 1e9:.2g} GB are available"
        _log.warning("%d of %d processes: %s", fitting, processes, sizes)
    return fitting


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started in a block."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def guard_process_starts() -> Iterator[None]:
    """Let processes that are started in a block end with this one and ignore Ctrl-C, by inherited blocked signals."""
    with _environment({signals.PARENT: str(os.getpid())}):
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
    if os.name != "posix":
        return
    with _environment({"PYTHONWARNINGS": "ignore"}):
        resource_tracker.ensure_running()


def _begin_worker(log: str) -> None:
    """Make this process a worker: it writes to a log, leaves Ctrl-C to its parent, and ends when its parent ends."""
    signals.begin_worker()
    os.environ["FLOCKENV_QUIET"] = "1"
    written = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for standard in (1, 2):
        os.dup2(written, standard)
    os.close(written)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with_parent, args=(parent.sentinel,), daemon=True).start()


def _execute_with_log(function: Callable[..., bytes], arguments: tuple[Any, ...], code: str) -> bytes | Failure:
    """Run a job with an empty log, which is this process's standard output."""
    os.ftruncate(1, 0)
    return execute(function, arguments, code)


def _end_with_parent(sentinel: Any) -> None:
    """End this process when its parent has ended; a sentinel is ready then, even after SIGKILL."""
    wait_for([sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
