"""Run jobs: those without a stored record, by an engine; every record is stored as soon as it is there."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from flockenv.core.errors import printable
from flockenv.jobs.engine import Engine
from flockenv.jobs.job import Failure, Job
from flockenv.jobs.store import State, Store

__all__ = ["FailedJobsError", "Shard", "ShardDone", "Work", "run_jobs"]

NAMED = 2
"""Failed jobs that an error names."""


class FailedJobsError(ValueError):
    """Some jobs have failed; all others are done and stored. `failures` has all of them by key, the text has a few."""

    def __init__(self, failures: dict[str, Failure], folder: Path) -> None:
        self.failures = failures
        for failure in failures.values():
            if failure.trace:
                self.add_note(failure.trace)  # shown with --debug
        lines = [f"{failure} (job {key})" for key, failure in list(failures.items())[:NAMED]]
        if len(failures) > NAMED:
            lines.append(f"{len(failures) - NAMED} more, see `flockenv jobs {_relative(folder)}`")
        super().__init__("; ".join(lines))


@dataclass(frozen=True)
class Shard:
    """A share of a list of jobs: every `count`-th from number `index` on, so that `count` shards have each job once."""

    index: int
    count: int

    @classmethod
    def of_text(cls, text: str) -> Shard:
        """Return the shard of "I/N"; raise ValueError, in one line, for anything else."""
        found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
        if found is None or int(found[1]) >= int(found[2]):
            allowed = "must be I/N with I from 0 to N - 1, such as 0/4 to 3/4 (sbatch --array=0-3)"
            raise ValueError(f"--shard {printable(text)}: {allowed}")
        return cls(int(found[1]), int(found[2]))

    def of(self, jobs: Sequence[Job]) -> list[Job]:
        """Return the share of a list."""
        return list(jobs[self.index :: self.count])


class ShardDone(Exception):  # noqa: N818  # not an error: another call collects the records
    """The share of the jobs is done and stored; the text has their number."""

    def __init__(self, shard: Shard, jobs: int, all_jobs: int, folder: Path) -> None:
        stored = f"{jobs} of {all_jobs} jobs, stored in {_relative(folder)}"
        super().__init__(f"shard {shard.index}/{shard.count}: {stored}; the same command without --shard collects them")


@dataclass(frozen=True)
class Work:
    """Where the records of jobs are stored, what runs the jobs, and how.

    fresh: jobs whose record is stored are also run. progress: called with the number of jobs that have ended, the
    number of all jobs, and the name and the outcome of the last one. shard: of the jobs to run (default: all).
    """

    store: Store
    engine: Engine
    fresh: bool = False
    progress: Callable[[int, int, str], None] = lambda done, most, name: None
    shard: Shard | None = None


def run_jobs(jobs: Sequence[Job], work: Work) -> None:
    """Run all jobs whose record is not stored yet, and store the records.

    Raises:
        FailedJobsError: after all others are done.
        ShardDone: all jobs of a shard are done, which is only a part of the work.
    """
    if work.shard is None:
        _run_missing(jobs, work, _command(jobs))
        return
    share, shard = work.shard.of(jobs), work.shard
    _run_missing(share, work, f"{_command(jobs)}-{shard.index}-of-{shard.count}")
    raise ShardDone(shard, len(share), len(jobs), work.store.folder)


def _run_missing(jobs: Sequence[Job], work: Work, command: str) -> None:
    """Run the jobs whose record is not stored yet; command: the name of the file that says how far they are."""
    store = work.store
    missing = [job for job in jobs if work.fresh or not store.has(job)]
    state = State(store.folder, command, [job.key for job in jobs])
    state.done |= {job.key for job in jobs} - {job.key for job in missing}
    work.progress(len(jobs) - len(missing), len(jobs), "")
    failures: dict[str, Failure] = {}

    state.write(force=True)
    if not missing:
        return
    try:
        with closing(work.engine.run(missing, lambda job: state.begin(job.key))) as results:
            for done, (job, record) in enumerate(results, len(jobs) - len(missing) + 1):
                if isinstance(record, Failure):
                    failures[job.key] = record
                    state.finish(job.key, record)
                else:
                    store.write(job, record)
                    state.finish(job.key)
                work.progress(done, len(jobs), f"{job.name}: {'failed' if job.key in failures else 'done'}")
    finally:
        state.stop()
    if failures:
        raise FailedJobsError(failures, store.folder)


def _relative(folder: Path) -> Path:
    """Return a folder, relative to the current one if it is below it."""
    here, full = Path.cwd().resolve(), folder.resolve()
    return full.relative_to(here) if full.is_relative_to(here) else folder


def _command(jobs: Sequence[Job]) -> str:
    """Return the first word of the jobs' names: "transfer" of transfer-clock/round-1."""
    return jobs[0].name.split("/")[0].split("-")[0] if jobs else "none"
