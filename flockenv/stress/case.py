"""Case: a hard scene as a function of the method that is to survive it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from flockenv.integrators import Integrator
from flockenv.scene import Scene
from flockenv.stability import CoarseContactWarning, UnstableStepWarning
from flockenv.state import State

__all__ = ["TOO_LONG", "Case", "Value", "quietly", "started"]

TOO_LONG = (UnstableStepWarning, CoarseContactWarning)
"""What says that a step is too long."""


@dataclass(frozen=True)
class Value:
    """What a case came to, and whether that is within its bound."""

    number: float
    holds: bool
    note: str = ""


@dataclass(frozen=True)
class Case:
    """A hard scene: its name in numerics.md, what happens in it, what is demanded, and how it is tried."""

    name: str
    title: str
    bound: str
    trial: Callable[[Integrator], Value]
    methods: tuple[str, ...] = ()
    """Kinds of methods that it is tried under; none = all."""

    def under(self, method: Integrator) -> bool:
        """Is it tried under a method?"""
        return not self.methods or method.kind in self.methods


def started(scene: Scene, pos: Any, vel: Any) -> State:
    """Return a scene's start with one world's positions and velocities, (N, D) m and m/s."""
    return scene.start(0).with_motion(np.asarray(pos, float)[None], np.asarray(vel, float)[None])


@contextmanager
def quietly() -> Iterator[list[warnings.WarningMessage]]:
    """Collect warnings of steps that are too long where a case goes beyond a limit on purpose; all others pass on."""
    with warnings.catch_warnings(record=True) as caught:
        for kind in TOO_LONG:
            warnings.simplefilter("always", kind)
        yield caught
