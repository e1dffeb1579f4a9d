"""The results folder of jobs: a file for each record, and one for each command that says how far its jobs are."""

from __future__ import annotations

import json
import os
import platform
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.jobs.job import Failure, Job

__all__ = ["State", "Store"]

T = TypeVar("T")
EVERY = 1.0
"""s, between two versions of the file that says how far the work is."""
NAME = "state-{}.json"
KEYS = {"process", "host", "began", "written", "keys", "done", "running", "failed"}
"""Keys of that file."""
PROCESS_BEGAN = time.time()
"""When this process imported this module: a process id may be used again by a later process."""


class Store:
    """Records of jobs in a folder, each in a file named by the job's key; a file is complete or not there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, job: Job) -> Path:
        """Return the file of a job's record."""
        return self.folder / f"{job.key}.safetensors"

    def has(self, job: Job) -> bool:
        """Return True if a job's record is stored."""
        return self.path(job).is_file()

    def write(self, job: Job, record: bytes) -> None:
        """Store a record: written to a new file and renamed."""
        path = self.path(job)
        with new_folder(path.parent), replace_file(path) as file:
            file.write(record)

    def read(self, job: Job, of_bytes: Callable[[bytes], T]) -> T:
        """Return a stored record; raise ValueError, in one line that names the file, if it is damaged."""
        path = self.path(job)
        try:
            return of_bytes(path.read_bytes())
        except ValueError as error:
            raise ValueError(f"{path} is {error}; delete it, and the same command makes it anew") from None


@dataclass
class State:
    """How far the jobs of a command are, by key; written to the results folder while it runs, for `flockenv jobs`.

    command: the first word of the jobs' names, with the shard if it is one; it is part of the file's name.
    """

    folder: Path
    command: str
    keys: Sequence[str]
    done: set[str] = field(default_factory=set)
    running: set[str] = field(default_factory=set)
    failed: dict[str, str] = field(default_factory=dict)
    began: float = field(default_factory=time.time)

    def __post_init__(self) -> None:
        """Include earlier jobs of the same process, which may run its jobs in several parts."""
        self._path = self.folder / NAME.format(self.command)
        self._lock, self._written = threading.RLock(), 0.0
        self._timer: threading.Timer | None = None
        try:
            before = _content(self._path)
        except (OSError, ValueError):
            return
        if before["process"] == os.getpid() and before["began"] >= PROCESS_BEGAN:
            self.keys = list(dict.fromkeys([*before["keys"], *self.keys]))
            self.done |= set(before["done"])
            self.began = before["began"]

    def begin(self, key: str) -> None:
        """Enter the beginning of a job."""
        with self._lock:
            self.running.add(key)
        self.write()

    def finish(self, key: str, failure: Failure | None = None) -> None:
        """Enter the end of a job."""
        with self._lock:
            self.running.discard(key)
            self.failed.pop(key, None)
            self.done.discard(key)
            if failure is None:
                self.done.add(key)
            else:
                self.failed[key] = str(failure)
        self.write()

    def stop(self) -> None:
        """Enter that no job runs any more."""
        with self._lock:
            self.running.clear()
            if self._timer is not None:
                self._timer.cancel()
        self.write(force=True)

    def write(self, force: bool = False) -> None:
        """Write the file now if forced or if EVERY seconds have passed, otherwise by a thread when they have."""
        with self._lock:
            wait = EVERY - (time.monotonic() - self._written)
            if not force and wait > 0:
                if self._timer is None or not self._timer.is_alive():
                    self._timer = threading.Timer(wait, self.write, (True,))
                    self._timer.daemon = True
                    self._timer.start()
                return
            self._written = time.monotonic()
            content = {
                "process": os.getpid(), "host": platform.node(), "began": self.began, "written": time.time(),
                "keys": list(self.keys), "done": sorted(self.done), "running": sorted(self.running),
                "failed": self.failed,
            }  # fmt: skip
            with new_folder(self.folder), replace_file(self._path) as file:
                file.write((json.dumps(content, indent=1) + "\n").encode())

    @staticmethod
    def read(folder: Path) -> dict[str, Mapping[str, Any]]:
        """Return the content of the files of all commands, by command.

        Raises:
            ValueError: in one line, if there is none or one is damaged.
        """
        found = dict(_contents(folder))
        if not found:
            raise ValueError(f"{folder}: no jobs have run here")
        return found


def _contents(folder: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    before, after = NAME.split("{}")
    for path in sorted(folder.glob(NAME.format("*"))):
        try:
            yield path.name.removeprefix(before).removesuffix(after), _content(path)
        except ValueError as error:
            raise ValueError(f"{path} is damaged: {error}") from None


def _content(path: Path) -> Mapping[str, Any]:
    """Return the content of a file; raise ValueError if it is damaged."""
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict) or not set(content) >= KEYS:
        raise ValueError(f"must hold {', '.join(sorted(KEYS))}")
    return content
