"""Functions that hard cases share: a start by hand, and a collector of expected warnings."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from flockenv.core.warnings import CoarseContactWarning, UnstableStepWarning
from flockenv.model.state import State
from flockenv.scene import Scene

__all__ = ["TOO_LONG", "collect_step_warnings", "start_with"]

TOO_LONG = (UnstableStepWarning, CoarseContactWarning)
"""Warnings of a step that is too long."""


def start_with(scene: Scene, pos: Any, vel: Any) -> State:
    """Return a scene's start with one world's positions and velocities, (N, D) m and m/s."""
    return scene.start(0).with_motion(np.asarray(pos, float)[None], np.asarray(vel, float)[None])


@contextmanager
def collect_step_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """Collect warnings of steps that are too long, in cases beyond a limit on purpose; all others are shown."""
    with warnings.catch_warnings(record=True) as caught:
        for kind in TOO_LONG:
            warnings.simplefilter("always", kind)
        yield caught
