"""The Ray engine: jobs as Ray tasks, on this machine or on every node of a cluster.

The cluster is that of the environment variable RAY_ADDRESS, as for any program of Ray; without it a local Ray is
started. Ray places the tasks, repeats those whose process or node ends, and moves records through its object store.
"""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

from flockenv.core import signals
from flockenv.jobs.engine import TRIES, Begun
from flockenv.jobs.job import Failure, Job, code_digest, execute

__all__ = ["RayEngine", "import_ray", "start_ray"]

AHEAD = 2
"""Tasks per core of the cluster that are submitted at a time; the driver holds no more records than that."""

POLL = 0.2
"""s, after which the driver looks for a signal that has arrived while Ray waits."""

LOG_END = 300
"""Characters of Ray's report on a process that ended."""


class RayEngine:
    """Runs each job as a Ray task with one core."""

    parallel = True

    def __init__(self) -> None:
        self._ray = import_ray("--engine ray")

    def run(self, jobs: Iterable[Job], begun: Begun) -> Generator[tuple[Job, bytes | Failure], None, None]:
        """Yield each job with its record or its failure."""
        with self.keep():
            yield from self._run(jobs, begun)

    @contextmanager
    def keep(self) -> Iterator[None]:
        """Stay connected until the end of a block: to the cluster, or to a local one that is started."""
        started = start_ray(self._ray)
        try:
            yield
        finally:
            if started:
                self._ray.shutdown()

    def _run(self, jobs: Iterable[Job], begun: Begun) -> Generator[tuple[Job, bytes | Failure], None, None]:
        ray = self._ray
        task = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_execute)
        running: dict[Any, Job] = {}
        jobs, code = list(jobs), code_digest()
        waiting = iter(jobs)
        try:
            self._warm_up(jobs)
            largest = self._largest_memory()
            while True:
                for job in islice(waiting, self._room(len(running))):
                    placed = task.options(memory=min(job.memory, largest)) if job.memory else task
                    running[placed.remote(job.function, job.arguments, code, os.getcwd())] = job
                    begun(job)
                if not running:
                    return
                signals.raise_if_received()
                for reference in ray.wait(list(running), num_returns=1, timeout=POLL)[0]:
                    yield running.pop(reference), self._result(reference)
        finally:
            for reference in running:
                ray.cancel(reference, force=True)

    def _warm_up(self, jobs: Iterable[Job]) -> None:
        """Compile kernels on every node, each kernel in one task, and wait for the end of all tasks.

        These are the kernels that more jobs need than there are nodes: jobs that run at the same time on a node would
        wait for one compilation. An error is left to the job that meets it again.
        """
        ray, nodes = self._ray, [node for node in self._ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
        counts = Counter(job.warm_up for job in jobs if job.warm_up is not None)
        task, placed_on = ray.remote(num_cpus=1, max_retries=0)(_call), self._placed_on
        running = [
            task.options(scheduling_strategy=placed_on(node["NodeID"])).remote(*warm_up, os.getcwd())
            for warm_up, count in counts.items() if count > len(nodes) for node in nodes
        ]  # fmt: skip
        try:
            while running:
                signals.raise_if_received()
                running = ray.wait(running, num_returns=len(running), timeout=POLL)[1]
        finally:
            for reference in running:
                ray.cancel(reference, force=True)

    def _placed_on(self, node: str) -> Any:
        """Return the strategy that places a task on a node."""
        return self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(node, soft=False)

    def _largest_memory(self) -> int:
        """Return the memory of the largest node, bytes; a job that needs more gets all of it."""
        return max(int(node["Resources"].get("memory", 0)) for node in self._ray.nodes() if node["Alive"])

    def _room(self, running: int) -> int:
        """Return how many more tasks may be submitted; the cluster may grow and shrink."""
        cores = int(self._ray.cluster_resources().get("CPU", 1))
        return max(0, AHEAD * max(1, cores) - running)

    def _result(self, reference: Any) -> bytes | Failure:
        """Return the record of a finished task, or its failure."""
        errors = self._ray.exceptions
        try:
            return self._ray.get(reference)  # type: ignore[no-any-return]
        except errors.RayTaskError as error:
            return Failure(" ".join(str(error.cause or error).split()))
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError) as error:
            return Failure(f"its process or node ended {TRIES} times", " ".join(str(error).split())[-LOG_END:])
        except errors.RayError as error:
            return Failure(f"Ray: {type(error).__name__}: {' '.join(str(error).split())[:LOG_END]}")


def _execute(function: Callable[..., bytes], arguments: tuple[Any, ...], code: str, folder: str) -> bytes | Failure:
    """Run a job in a process of Ray."""
    _begin_task(folder)
    return execute(function, arguments, code)


def _call(function: Callable[..., object], arguments: tuple[Any, ...], folder: str) -> None:
    """Call a function in a process of Ray."""
    _begin_task(folder)
    function(*arguments)


def _begin_task(folder: str) -> None:
    """Go to the driver's folder if this machine has it, as arguments may name files; write nothing about kernels."""
    os.environ["FLOCKENV_QUIET"] = "1"
    if os.path.isdir(folder):
        os.chdir(folder)


def start_ray(ray: Any) -> bool:
    """Connect to the cluster, or start a local one; return True if this process was not connected before."""
    if ray.is_initialized():
        return False
    address = os.environ.get("RAY_ADDRESS", "local")
    own = {"include_dashboard": False} if address == "local" else {}
    ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
    signals.take_handlers_back()  # Ray handles SIGTERM, and would print its own stack
    return True


def import_ray(option: str) -> Any:
    """Return the module ray; raise ValueError, in one line that begins with the option, if it is not installed."""
    try:
        import ray  # type: ignore[import-not-found, unused-ignore]
        import ray.exceptions  # type: ignore[import-not-found, unused-ignore]
        import ray.util.scheduling_strategies  # type: ignore[import-not-found, unused-ignore]
    except ImportError as error:
        raise ValueError(f"{option}: {error}; install the extra: pip install 'flockenv[ray]'") from None
    return ray
