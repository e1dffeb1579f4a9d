"""The results folder of jobs: a file for each record, and one that says how far the work is."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.jobs.job import Failure, Job

__all__ = ["State", "Store"]

T = TypeVar("T")
EVERY = 1.0
"""s, between two versions of the file that says how far the work is."""
STATE = "state.json"
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
    """How far a run of jobs is, by key; written to the results folder while it runs, for `flockenv jobs`."""

    folder: Path
    keys: Sequence[str]
    done: set[str] = field(default_factory=set)
    running: set[str] = field(default_factory=set)
    failed: dict[str, str] = field(default_factory=dict)
    began: float = field(default_factory=time.time)
    written: float = 0.0

    def __post_init__(self) -> None:
        """Include earlier jobs of the same process, which may run its jobs in several parts."""
        try:
            before = self.read(self.folder)
        except ValueError:
            return
        if before.get("process") == os.getpid() and before.get("began", 0.0) >= PROCESS_BEGAN:
            self.keys = list(dict.fromkeys([*before["keys"], *self.keys]))
            self.done |= set(before["done"])
            self.failed |= before["failed"]
            self.began = before["began"]

    def finish(self, key: str, failure: Failure | None = None) -> None:
        """Enter the end of a job."""
        self.running.discard(key)
        self.done.add(key)
        if failure is not None:
            self.done.discard(key)
            self.failed[key] = str(failure)
        self.write()

    def write(self, force: bool = False) -> None:
        """Write the file, at most every EVERY seconds unless forced."""
        if not force and time.monotonic() - self.written < EVERY:
            return
        self.written = time.monotonic()
        content = {
            "process": os.getpid(), "began": self.began, "written": time.time(), "keys": list(self.keys),
            "done": sorted(self.done), "running": sorted(self.running), "failed": self.failed,
        }  # fmt: skip
        with new_folder(self.folder), replace_file(self.folder / STATE) as file:
            file.write((json.dumps(content, indent=1) + "\n").encode())

    @staticmethod
    def read(folder: Path) -> Mapping[str, Any]:
        """Return the content of the file; raise ValueError, in one line, if there is none or it is damaged."""
        path = folder / STATE
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if {"keys", "done", "running", "failed"} <= set(content):
                return content  # type: ignore[no-any-return]
            raise ValueError("keys are missing")
        except FileNotFoundError:
            raise ValueError(f"{folder}: no jobs have run here") from None
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from None
