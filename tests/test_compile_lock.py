"""One process compiles a kernel, the others wait for what it writes."""

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
from flockenv.jit.progress import compiled
from flockenv.physics.effects import Drag
from flockenv.scene import Group, Scene
from flockenv.geometry.space import Torus
scene = Scene(space=Torus(size=(9, 9)), groups=(Group(count=3),), effects=(Drag(rate=0.5),))
scene.step(scene.start(seed=0))
print(sum(each.kernel == "scene_step" for each in compiled()))
"""


class Disk:
    """What numba's cache of a function does, in a dictionary that several share."""

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


def test_who_comes_second_waits_for_what_the_first_writes(tmp_path: Path) -> None:
    first, second = two(tmp_path)
    assert first.load_overload("f8", None) is None  # it is up to the first
    found: list[str | None] = []
    waiter = threading.Thread(target=lambda: found.append(second.load_overload("f8", None)))
    waiter.start()
    waiter.join(0.3)
    assert waiter.is_alive() and not found
    first.save_overload("f8", "code")
    waiter.join(10)
    assert found == ["code"]
    assert second.load_overload("f4", None) is None  # and the lock is free again
    assert first.name == "a function"


def test_a_compilation_that_fails_in_another_thread_holds_nobody_up(tmp_path: Path) -> None:
    first, _ = two(tmp_path, patience=0.2)
    failed = threading.Thread(target=first.load_overload, args=("f8", None))
    failed.start()
    failed.join()
    assert first.load_overload("f4", None) is None
    first.save_overload("f4", "code")
    FileLock(tmp_path / "a.lock", timeout=0).acquire()


@pytest.mark.parametrize("how", ["the compiler raises", "the disk is full"])
def test_a_compilation_that_fails_holds_nobody_up(tmp_path: Path, how: str) -> None:
    first, second = two(tmp_path)
    assert first.load_overload("f8", None) is None
    if how == "the disk is full":
        with pytest.raises(OSError, match="disk full"):
            first.save_overload("f8", "no")
    else:
        assert first.load_overload("f4", None) is None  # tried again, with other types
        first.save_overload("f4", "code")
    assert second.load_overload("f8", None) is None
    second.save_overload("f8", "code")
    assert first.load_overload("f8", None) == "code"


def test_nobody_is_waited_for_without_end(tmp_path: Path) -> None:
    first, second = two(tmp_path, patience=0.1)
    assert first.load_overload("f8", None) is None
    assert second.load_overload("f8", None) is None
    second.save_overload("f8", "code")
    assert first.load_overload("f8", None) == "code"


def test_what_is_there_is_read_without_waiting(tmp_path: Path) -> None:
    first, second = two(tmp_path, patience=60.0)
    second.save_overload("f8", "code")
    assert first.load_overload("f4", None) is None
    assert second.load_overload("f8", None) == "code"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nobody forks here")
@pytest.mark.parametrize("busy", [False, True], ids=["idle", "compiling"])
def test_a_forked_process_has_a_lock_of_its_own(tmp_path: Path, busy: bool) -> None:
    """As gymnasium's AsyncVectorEnv forks, with what its parent has begun to use."""
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
        FileLock(tmp_path / "a.lock", timeout=0).acquire()  # the child's end has freed nothing of its parent's
    first.save_overload("f8", "code")
    FileLock(tmp_path / "a.lock", timeout=0).acquire()


@pytest.mark.slow
def test_of_three_processes_that_begin_together_one_compiles(tmp_path: Path) -> None:
    environment = {**os.environ, "FLOCKENV_CACHE": str(tmp_path), "FLOCKENV_QUIET": "1"}
    command = [sys.executable, "-c", MANY]
    processes = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    said = [process.communicate(timeout=300)[0] for process in processes]
    assert sorted(said) == ["0\n", "0\n", "1\n"]
