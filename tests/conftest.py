"""What every test runs under: no display, no randomness of the test runner's own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import hypothesis
import pytest

from tests.catalogue import TETHER, users_module

# Before anything imports pygame: a window is opened, but nowhere.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")

# Examples are the same in every run (a failure is nobody's bad luck), and a first call may compile for seconds.
hypothesis.settings.register_profile("flockenv", derandomize=True, deadline=None, database=None, max_examples=60)
hypothesis.settings.load_profile("flockenv")


@pytest.fixture(scope="module")  # and forgotten afterwards: other files count the effects there are
def tether(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The effect of catalogue.TETHER."""
    with users_module(tmp_path_factory.mktemp("laws"), TETHER, "tethers") as module:
        yield module.Tether
