"""A job: a function of its arguments, with a key that names everything its result depends on."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import platform
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from flockenv.core.address_space import shortage
from flockenv.jit import cpu

__all__ = ["Failure", "Job", "code_digest", "execute"]

PACKAGES = ("numpy", "numba", "llvmlite", "scipy", "gymnasium", "torch", "stable-baselines3", "sb3-contrib")
"""Packages whose version results may depend on; one that is not installed has the version "none"."""

SETTINGS = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NUMBA_DISABLE_JIT", "NUMBA_OPT")
"""Environment variables on which the last bits of results may depend."""


@dataclass(frozen=True, eq=False)
class Job:
    """One piece of work.

    name: path of readable words, "compare/pursuit/rules". function: of a module, found there by its name; it is called
    with `arguments`, which are pickled, and returns the record as bytes. about: all that the record depends on besides
    the code, the versions and the processor, as JSON. memory: bytes that its process needs, approximately; 0: unknown.
    warm_up: a function and its arguments, which compiles the kernels of the job; equal ones are called once per node.
    """

    name: str
    function: Callable[..., bytes]
    arguments: tuple[Any, ...]
    about: Any
    memory: int = 0
    warm_up: tuple[Callable[..., object], tuple[Any, ...]] | None = None

    @functools.cached_property
    def key(self) -> str:
        """The name, with a digest of `about`, of the code, of the versions and of the processor."""
        text = json.dumps([self.name, self.about, code_digest()], sort_keys=True, allow_nan=False)
        return f"{self.name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


@dataclass(frozen=True)
class Failure:
    """Why a job has no result: an error of its function, or the end of its process in every attempt."""

    text: str
    log: str = ""  # the end of what its process wrote, if the process ended
    trace: str = ""  # the traceback of an error

    def __str__(self) -> str:
        return f"{self.text}; it wrote: {self.log}" if self.log else self.text


def execute(function: Callable[..., bytes], arguments: tuple[Any, ...], code: str) -> bytes | Failure:
    """Call a job's function in this process; return its record, or a failure if it raises an error.

    code: the digest of the code that the job's key was made with; a process with other code refuses the job.

    Raises:
        MemoryError, OSError, ImportError, RuntimeError: lack of memory, which the next job would meet as well.
    """
    if code != code_digest():
        return Failure("this process has other code, other versions or another processor than that of the command")
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:
        if shortage(error) is not None:
            raise
        text = str(error) if isinstance(error, (ValueError, OSError)) else f"{type(error).__name__}: {error}"
        return Failure(" ".join(text.split()), trace=traceback.format_exc())


@functools.cache
def code_digest() -> str:
    """Return a digest of the code of flockenv and agents, and of the versions, settings and processor."""
    package = Path(__file__).resolve().parent.parent
    around = [platform.python_version(), sorted(cpu.FEATURES), cpu.REGISTER]
    around += [[name, _version(name)] for name in PACKAGES] + [[name, os.environ.get(name)] for name in SETTINGS]
    digest = hashlib.sha256(json.dumps(around).encode())
    for folder in (package, package.parent / "agents"):
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{path.relative_to(folder).as_posix()} ".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "none"
