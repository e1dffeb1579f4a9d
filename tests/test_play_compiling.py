"""Compiling for the playground: a child process fills the cache, and the server goes on if that process fails."""

from __future__ import annotations

import functools
import json
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flockenv.jit.lock import NotCachedError, OneAtATime, only_cached, require_cached
from flockenv.jit.progress import compiled_kernels
from flockenv.play.compiling import Compiler
from flockenv.play.messages import read_message
from flockenv.play.session import Session
from flockenv.scene.yaml_io import load_scene

RARE = """\
space: {kind: torus, size: [9, 9]}
groups: [{count: 3, spawn: {speed: [1, 2]}}]
effects: [{kind: drag, rate: 0.5}, {kind: drag, rate: 0.25}, {kind: drag, rate: 0.125}]
"""
"""A scene that no other test steps, so that this process has not loaded its kernel."""


class Empty:
    """A cache of a function that holds nothing."""

    def load_overload(self, signature: str, context: Any) -> None:
        return None


def needs(path: Path, calls: list[str]) -> str:
    """Do work whose only kernel is cached once there is a file."""
    calls.append("begun")
    require_cached(path.name if path.exists() else None)
    return path.name


def leaves(path: Path) -> Callable[[], Callable[[], object]]:
    return lambda: functools.partial(Path.touch, path)


def test_a_missing_kernel_is_refused_without_waiting_for_a_lock(tmp_path: Path) -> None:
    first, second = (OneAtATime(Empty(), tmp_path / "a.lock", 60.0) for _ in range(2))
    assert first.load_overload("f8", None) is None  # it holds the lock
    with only_cached(), pytest.raises(NotCachedError, match="a kernel must be compiled"):
        second.load_overload("f8", None)


def test_a_child_process_fills_the_cache(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, calls = tmp_path / "kernel", list[str]()
    assert Compiler().do(lambda: needs(path, calls), leaves(path)) == "kernel"
    assert len(calls) == 2 and not caplog.records
    assert Compiler().do(lambda: needs(path, calls), lambda: pytest.fail("nothing is missing")) == "kernel"


@pytest.mark.parametrize(
    ("work", "reason"),
    [
        (functools.partial(os._exit, 3), "exit code 3"),
        (lambda: None, "pickle"),
        pytest.param(int, "cache", marks=pytest.mark.slow),
    ],
)
def test_a_child_process_that_fails_is_one_line_in_the_log(
    work: Callable[[], object], reason: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "flockenv.play")
    path, calls = tmp_path / "kernel", list[str]()
    assert Compiler().do(lambda: needs(path, calls), lambda: work) == "kernel"
    (line,) = [record.getMessage() for record in caplog.records]
    assert reason in line and "\n" not in line


def test_a_server_that_ends_compiles_nothing(tmp_path: Path) -> None:
    compiler, path, calls = Compiler(), tmp_path / "kernel", list[str]()
    compiler.close()
    with pytest.raises(RuntimeError, match="the server has ended"):
        compiler.do(lambda: needs(path, calls), leaves(path))
    assert not path.exists()


@pytest.mark.slow
def test_the_kernels_of_a_world_and_of_an_edit_are_compiled_in_the_child_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLOCKENV_CACHE", str(tmp_path / "cache"))
    session, compiler = Session(), Compiler()
    session.open_scene(load_scene(RARE), "rare")
    before = compiled_kernels()
    assert session.room is not None
    compiler.do(session.compile, session.twin)
    session.room.step(2)
    value = {"kind": "drag", "rate": 0.0625}
    message = read_message(json.dumps({"type": "edit", "edit": {"kind": "add", "path": "effects", "value": value}}))
    compiler.do(functools.partial(session.prepare, message), functools.partial(session.twin, message))()
    session.room.step(2)
    assert len(session.room.lanes[0].record.effects) == 4 and session.room.tick == 4
    assert compiled_kernels() == before
