"""Settings of all tests: no display, no randomness of the test runner."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

from flockenv.cli import terminal
from flockenv.jit import thread_pool
from tests.catalogue import TETHER, users_module
from tests.ray_venv import new_venv

# Before pygame is imported: windows open without a display.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")

# Examples are the same in every run, so that failures can be repeated. A first call may compile for seconds.
hypothesis.settings.register_profile("flockenv", derandomize=True, deadline=None, database=None, max_examples=60)
hypothesis.settings.load_profile("flockenv")


# numba keeps millions of objects alive, and each collection visits them.
gc.set_threshold(5_000, 20, 20)

# In tests with threads, all threads share all work, however little, because tests do not measure speed.
thread_pool.AutoTuner.always, thread_pool._cores = True, 64

# Tests compare all of stderr. On a busy machine a kernel compiles for longer than the 3 s after which a line about
# progress is written; tests of that line set their own times.
terminal.FIRST = 3600.0


RARE = {
    "torus_3",
    "torus_single",
    "torus_single_rk4",
    "plane_3_single",
    "nearest_plane_3",
    "nearest_torus_single",
}
"""Kernels of catalogue.Variant that only slow tests compile."""

RARE_EFFECTS = {
    "altitude_springs", "angular_springs", "membrane", "bending", "elastic", "elastic_corotated", "springs_yielding",
    "carried", "wind", "obstacle_contact",
}  # fmt: skip
"""Effects whose symmetries only slow tests try: their kernels are compiled for them, and quick tests are elsewhere."""

RARE_METHODS = {
    "averaged_velocity",
    "midpoint",
    "heun",
    "exponential_drag",
    "adaptive_rk4",
    "implicit_midpoint",
    "linearly_implicit_euler",
}
"""Methods whose kernels only slow tests compile; quick tests run those in Python that are not implicit."""

IN_SPACE_SLOW = {
    "test_behaviours_crowd", "test_behaviours_goals", "test_behaviours_paths", "test_behaviours_shapes", "test_effects",
    "test_fields", "test_neighbours", "test_springs", "test_steering",
}  # fmt: skip
"""Files that test laws written once for 2-D and 3-D: quick tests try 2-D."""


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests as slow that compile a kernel for one more variant of a quick test."""
    for item in items:
        given = getattr(getattr(item, "callspec", None), "params", {})
        named = [getattr(value, "name", value) for value in given.values()]
        in_space = given.get("dimension") == 3 and item.path.stem in IN_SPACE_SLOW
        rare = RARE | RARE_EFFECTS if item.path.stem == "test_effects" else RARE
        if any(isinstance(name, str) and name in rare for name in named) or in_space or _of_a_rare_method(given):
            item.add_marker(pytest.mark.slow)


def _of_a_rare_method(given: dict[str, Any]) -> bool:
    """Return True if a test compiles a rare method, or solves the equations of an implicit one in Python."""
    kind, way = getattr(getattr(given.get("row"), "method", None), "kind", ""), given.get("way")
    return kind in RARE_METHODS and way is None if way != "python" else kind.startswith("implicit")


@pytest.fixture(scope="module")  # removed afterwards: other files count all known effects
def tether(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Yield the class of the effect in catalogue.TETHER."""
    with users_module(tmp_path_factory.mktemp("laws"), TETHER, "tethers") as module:
        yield module.Tether


@pytest.fixture(scope="session")  # of test_ray.py and test_rllib.py: it takes a minute to install
def ray_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a new virtual environment with Ray."""
    return new_venv(tmp_path_factory.mktemp("ray") / "venv")
