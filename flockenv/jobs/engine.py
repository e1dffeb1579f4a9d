"""Engines: what runs jobs; processes of this machine, or Ray."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager
from typing import Protocol

from flockenv.jobs.job import Failure, Job

__all__ = ["ENGINES", "TRIES", "Engine", "engine_of"]

ENGINES = ("local", "ray")

TRIES = 3
"""Attempts to run a job whose process ends, before it counts as failed."""

Begun = Callable[[Job], None]
"""Called when a job is given to a process."""


class Engine(Protocol):
    """Runs jobs in any order."""

    @property
    def parallel(self) -> bool:
        """True if several jobs may run at a time, which changes the times that they measure."""
        ...

    def run(self, jobs: Iterable[Job], begun: Begun) -> Generator[tuple[Job, bytes | Failure], None, None]:
        """Yield each job with its record or its failure; closing the generator ends all work."""
        ...

    def keep(self) -> AbstractContextManager[object]:
        """Keep what a run starts until the end of a block, for later runs in it."""
        ...


def engine_of(name: str, processes: int | None = None, small: bool = False, renew: bool = False) -> Engine:
    """Return an engine by name.

    processes: of a local engine (default: one for each core; 1 if the work is `small`, as processes take long to
    start). renew: a local engine gives every job a new process.

    Raises:
        ValueError: unknown name, or Ray is not installed.
    """
    if name == "local":
        from flockenv.jit.thread_pool import cores
        from flockenv.jobs.local_engine import LocalEngine

        return LocalEngine(processes or (1 if small else cores()), renew)
    if name == "ray":
        from flockenv.jobs.ray_engine import RayEngine

        return RayEngine()
    from flockenv.core.errors import nearest, printable

    raise ValueError(f"--engine {printable(name)}: unknown{nearest(name, ENGINES)}; allowed: {', '.join(ENGINES)}")
