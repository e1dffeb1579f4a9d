"""Functions that hard cases share: a start by hand, the energy of a fall, and a collector of expected warnings."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from flockenv.core.warnings import CoarseContactWarning, UnstableStepWarning
from flockenv.model.state import State
from flockenv.physics.effects import Gravity
from flockenv.scene import Scene

__all__ = ["TOO_LONG", "collect_step_warnings", "energy_of_a_fall", "start_with"]

TOO_LONG = (UnstableStepWarning, CoarseContactWarning)
"""Warnings of a step that is too long."""


def start_with(scene: Scene, pos: Any, vel: Any) -> State:
    """Return a scene's start with one world's positions and velocities, (N, D) m and m/s."""
    return scene.start(0).with_motion(np.asarray(pos, float)[None], np.asarray(vel, float)[None])


def energy_of_a_fall(scene: Scene, steps: int) -> tuple[State, float]:
    """Return the end of a fall from rest, and the most energy on the way, motion and strain, per work of gravity."""
    start = state = scene.start(0)
    most, free = 0.0, np.where(np.isfinite(scene.body.mass), scene.body.mass, 0.0)
    (gravity,) = (effect for effect in scene.effects if isinstance(effect, Gravity))
    for _ in range(steps):
        state = scene.step(state)
        energy = float(0.5 * free @ (state.vel[0] ** 2).sum(axis=1))
        for effect in scene.effects:
            stored = effect.potential(scene.groups, state, scene.space.displacement)
            energy += float(stored[0]) if effect is not gravity and stored is not None else 0.0
        work = float(((state.pos - start.pos)[0] @ gravity.acceleration) @ free)
        most = max(most, energy / max(work, 1e-12))
    return state, most


@contextmanager
def collect_step_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """Collect warnings of steps that are too long, in cases beyond a limit on purpose; all others are shown."""
    with warnings.catch_warnings(record=True) as caught:
        for kind in TOO_LONG:
            warnings.simplefilter("always", kind)
        yield caught
