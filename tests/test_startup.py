"""Start of a process: garbage collection is enabled afterwards, and heavy modules are imported when they are needed."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Iterator
from typing import ClassVar

import pytest

from flockenv.core.record import Record
from flockenv.jit.startup import no_garbage_collection


@pytest.fixture(autouse=True)
def collecting() -> Iterator[None]:
    gc.enable()
    yield
    gc.enable()


def test_garbage_collection_is_enabled_again_afterwards() -> None:
    with no_garbage_collection(), no_garbage_collection():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(KeyError), no_garbage_collection():
        raise KeyError
    assert gc.isenabled()


def test_disabled_garbage_collection_stays_disabled() -> None:
    gc.disable()
    with no_garbage_collection():
        pass
    assert not gc.isenabled()


@pytest.mark.parametrize("module", ["flockenv.tasks", "flockenv.scene", "flockenv.envs.single", "flockenv.envs.sb3"])
def test_garbage_collection_is_enabled_after_the_first_import_of_any_module(module: str) -> None:
    code = f"import gc, {module}; assert gc.isenabled(); assert 'pursuit' in __import__('flockenv').TASKS"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_linear_algebra_is_imported_only_when_a_kernel_needs_it() -> None:
    code = """
import sys, threading
import numba, numpy as np
from flockenv.jit.startup import import_numba_before_scipy
line = threading.Barrier(4)
threads = [threading.Thread(target=lambda: (line.wait(), import_numba_before_scipy())) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert sys.modules["numba.np.linalg"].ensure_blas.__name__ == "ensure_blas"
from flockenv.scene import Group, Scene
from flockenv.geometry.space import Torus
scene = Scene(space=Torus(size=(9.0, 9.0)), groups=(Group(count=2),))
scene.step(scene.start(0))
assert "numba.np.arraymath" in sys.modules and "scipy.linalg" not in sys.modules
a, b = np.arange(9.0).reshape(3, 3), np.arange(3.0)
assert (numba.njit(lambda a, b: np.dot(a, b))(a, b) == a @ b).all()
assert (numba.njit(lambda a, b: np.convolve(a, b))(b, b) == np.convolve(b, b)).all()
assert "scipy.linalg" in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_class_variables_of_records_are_evaluated_once_and_are_no_fields() -> None:
    class Base(Record):
        shade: ClassVar[str] = "grey"
        size: float = 1.0

    class Child(Base):
        weight: float = 2.0

    assert Base.__annotations__["shade"] is ClassVar
    assert list(Child.model_fields) == ["size", "weight"]
    assert (Child.shade, Child(weight=3)) == ("grey", Child(size=1.0, weight=3.0))
    with pytest.raises(ValueError, match="shade"):
        Child(shade="red")  # type: ignore[call-arg]
