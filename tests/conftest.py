"""What every test runs under: no display, no randomness of the test runner's own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import hypothesis
import pytest

from flockenv.cli import terminal
from flockenv.jit import thread_pool
from tests.catalogue import TETHER, users_module

# Before anything imports pygame: a window is opened, but nowhere.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")

# Examples are the same in every run (a failure is nobody's bad luck), and a first call may compile for seconds.
hypothesis.settings.register_profile("flockenv", derandomize=True, deadline=None, database=None, max_examples=60)
hypothesis.settings.load_profile("flockenv")


# Where a test asks for threads all of them share all work, however little: how soon it is done is not what is tested.
thread_pool.AutoTuner.always, thread_pool._cores = True, 64

# Tests compare all of stderr. On a busy machine a kernel compiles for longer than the 3 s after which a line about
# progress is written; tests of that line set their own times.
terminal.FIRST = 3600.0


RARE = {
    "torus_3",
    "torus_single",
    "torus_single_rk4",
    "plane_single",
    "plane_3_single",
    "nearest_plane_3",
    "nearest_torus_single",
    "nearest_torus_3",
}
"""Kernels of catalogue.Variant that only slow tests compile."""

RARE_EFFECTS = {
    "alignment_cone", "cohesion_cone", "angular_springs", "elastic", "quadratic_drag", "carried",
    "wind", "obstacle_contact", "gravity",
}  # fmt: skip
"""Effects whose symmetries only slow tests try: each is a kernel, and each has quick tests of its own elsewhere."""

RARE_METHODS = {"averaged_velocity", "midpoint", "heun", "exponential_drag", "adaptive_rk4", "implicit_midpoint"}
"""Methods whose kernels only slow tests compile; in Python they are quick, but for the implicit ones."""

IN_SPACE_SLOW = {
    "test_behaviours_crowd", "test_behaviours_goals", "test_behaviours_paths", "test_behaviours_shapes", "test_effects",
    "test_fields", "test_neighbours", "test_springs", "test_steering",
}  # fmt: skip
"""Where a law is written once for the plane and for space: quick tests try the plane."""


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what compiles a kernel of its own for one more variant of what quick tests try already."""
    for item in items:
        given = getattr(getattr(item, "callspec", None), "params", {})
        named = [getattr(value, "name", value) for value in given.values()]
        in_space = given.get("dimension") == 3 and item.path.stem in IN_SPACE_SLOW
        rare = RARE | RARE_EFFECTS if item.path.stem == "test_effects" else RARE
        if any(isinstance(name, str) and name in rare for name in named) or in_space or _of_a_rare_method(given):
            item.add_marker(pytest.mark.slow)


def _of_a_rare_method(given: dict[str, Any]) -> bool:
    """True if it compiles a rare method, or solves the equations of an implicit one in Python."""
    kind, way = getattr(getattr(given.get("row"), "method", None), "kind", ""), given.get("way")
    return kind in RARE_METHODS and way is None if way != "python" else kind.startswith("implicit")


@pytest.fixture(scope="module")  # and forgotten afterwards: other files count the effects there are
def tether(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The effect of catalogue.TETHER."""
    with users_module(tmp_path_factory.mktemp("laws"), TETHER, "tethers") as module:
        yield module.Tether
