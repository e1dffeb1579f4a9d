"""Lock of the disk cache: one process compiles a kernel, the others wait for its file."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock, Timeout

from flockenv.jit.lock import OneAtATime

MANY = """
from flockenv.jit.progress import compiled_kernels
from flockenv.physics.effects import Drag
from flockenv.scene import Group, Scene
from flockenv.geometry.space import Torus
scene = Scene(space=Torus(size=(9, 9)), groups=(Group(count=3),), effects=(Drag(rate=0.5),))
scene.step(scene.start(seed=0))
print(sum(each.kernel == "scene_step" for each in compiled_kernels()))
"""


class Disk:
    """A replacement for numba's cache of a function; several instances share one dictionary."""

    def __init__(self, kept: dict[str, str]) -> None:
        self.kept, self.asked, self.name = kept, 0, "a function"

    def load_overload(self, signature: str, context: Any) -> str | None:
        self.asked += 1
        return self.kept.get(signature)

    def save_overload(self, signature: str, compiled: str) -> None:
        if compiled == "no":
            raise OSError("disk full")
        self.kept[signature] = compiled


def two(tmp_path: Path, patience: float = 60.0) -> tuple[OneAtATime, OneAtATime]:
    kept: dict[str, str] = {}
    first, second = (OneAtATime(Disk(kept), tmp_path / "a.lock", patience) for _ in range(2))
    return first, second


def test_second_process_waits_for_the_file_of_the_first(tmp_path: Path) -> None:
    first, second = two(tmp_path)
    assert first.load_overload("f8", None) is None  # so that the first compiles
    found: list[str | None] = []
    waiter = threading.Thread(target=lambda: found.append(second.load_overload("f8", None)))
    waiter.start()
    waiter.join(0.3)
    assert waiter.is_alive() and not found
    first.save_overload("f8", "code")
    waiter.join(10)
    assert found == ["code"]
    assert second.load_overload("f4", None) is None  # the lock is free again
    assert first.name == "a function"


def test_failed_compilation_in_another_thread_does_not_block(tmp_path: Path) -> None:
    first, _ = two(tmp_path, patience=0.2)
    failed = threading.Thread(target=first.load_overload, args=("f8", None))
    failed.start()
    failed.join()
    assert first.load_overload("f4", None) is None
    first.save_overload("f4", "code")
    FileLock(tmp_path / "a.lock", timeout=0).acquire()


@pytest.mark.parametrize("how", ["the compiler raises", "the disk is full"])
def test_failed_compilation_does_not_block(tmp_path: Path, how: str) -> None:
    first, second = two(tmp_path)
    assert first.load_overload("f8", None) is None
    if how == "the disk is full":
        with pytest.raises(OSError, match="disk full"):
            first.save_overload("f8", "no")
    else:
        assert first.load_overload("f4", None) is None  # numba tries again with other types
        first.save_overload("f4", "code")
    assert second.load_overload("f8", None) is None
    second.save_overload("f8", "code")
    assert first.load_overload("f8", None) == "code"


def test_waiting_for_another_process_is_limited(tmp_path: Path) -> None:
    first, second = two(tmp_path, patience=0.1)
    assert first.load_overload("f8", None) is None
    assert second.load_overload("f8", None) is None
    second.save_overload("f8", "code")
    assert first.load_overload("f8", None) == "code"


def test_existing_entry_is_read_without_waiting(tmp_path: Path) -> None:
    first, second = two(tmp_path, patience=60.0)
    second.save_overload("f8", "code")
    assert first.load_overload("f4", None) is None
    assert second.load_overload("f8", None) == "code"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("busy", [False, True], ids=["idle", "compiling"])
def test_forked_process_has_its_own_lock(tmp_path: Path, busy: bool) -> None:
    """gymnasium's AsyncVectorEnv forks after its parent has used the lock."""
    first, _ = two(tmp_path, patience=0.2)
    if busy:
        assert first.load_overload("f8", None) is None
    child = os.fork()
    if child == 0:
        code = 1
        try:
            assert first.load_overload("f8", None) is None
            first.save_overload("f8", "code")
            code = 0
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    if not busy:
        assert first.load_overload("f8", None) is None
    with pytest.raises(Timeout):
        FileLock(tmp_path / "a.lock", timeout=0).acquire()  # the exit of the child did not release the parent's lock
    first.save_overload("f8", "code")
    FileLock(tmp_path / "a.lock", timeout=0).acquire()


@pytest.mark.slow
def test_one_of_three_simultaneous_processes_compiles(tmp_path: Path) -> None:
    environment = {**os.environ, "FLOCKENV_CACHE": str(tmp_path), "FLOCKENV_QUIET": "1"}
    command = [sys.executable, "-c", MANY]
    processes = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    printed = [process.communicate(timeout=300)[0] for process in processes]
    assert sorted(printed) == ["0\n", "0\n", "1\n"]
