"""Run jobs: those without a stored record, by an engine; every record is stored as soon as it is there."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from flockenv.jobs.engine import Engine
from flockenv.jobs.job import Failure, Job
from flockenv.jobs.store import State, Store

__all__ = ["FailedJobsError", "Work", "run_jobs"]

NAMED = 2
"""Failed jobs that an error names."""


class FailedJobsError(ValueError):
    """Some jobs have failed; all others are done and stored. `failures` has all of them by key, the text has a few."""

    def __init__(self, failures: dict[str, Failure], folder: Path) -> None:
        self.failures = failures
        lines = [f"{failure} (job {key})" for key, failure in list(failures.items())[:NAMED]]
        more = (
            [f"{len(failures) - NAMED} more, see `flockenv jobs {os.path.relpath(folder)}`"]
            if len(failures) > NAMED
            else []
        )
        super().__init__("; ".join([*lines, *more]))


@dataclass(frozen=True)
class Work:
    """Where the records of jobs are stored, what runs the jobs, and how.

    fresh: jobs whose record is stored are also run. progress: called with the number of jobs done, of all jobs, and the
    name of the last one.
    """

    store: Store
    engine: Engine
    fresh: bool = False
    progress: Callable[[int, int, str], None] = lambda done, most, name: None


def run_jobs(jobs: Sequence[Job], work: Work) -> None:
    """Run all jobs whose record is not stored yet, and store the records.

    Raises:
        FailedJobsError: after all others are done.
    """
    store = work.store
    missing = [job for job in jobs if work.fresh or not store.has(job)]
    state = State(store.folder, [job.key for job in jobs])
    state.done |= {job.key for job in jobs} - {job.key for job in missing}
    work.progress(len(jobs) - len(missing), len(jobs), "")
    failures: dict[str, Failure] = {}

    def begin(job: Job) -> None:
        state.running.add(job.key)
        state.write()

    state.write(force=True)
    if not missing:
        return
    try:
        with closing(work.engine.run(missing, begin)) as results:
            for done, (job, record) in enumerate(results, len(jobs) - len(missing) + 1):
                if isinstance(record, Failure):
                    failures[job.key] = record
                    state.finish(job.key, record)
                else:
                    store.write(job, record)
                    state.finish(job.key)
                work.progress(done, len(jobs), job.name)
    finally:
        state.running.clear()
        state.write(force=True)
    if failures:
        raise FailedJobsError(failures, store.folder)
