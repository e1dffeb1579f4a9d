"""Forces of pins and of collisions on agents, computed only in steps whose forces are read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.model.state import Floats, State
from flockenv.physics.constraints.constraint import Settler

__all__ = ["CollisionForces", "PinForces", "WatchedSettler"]


class CollisionForces(NamedTuple):
    """Forces on all agents in a step, mean over it; 0 for those that are dead or held, and without such a constraint.

    An impulse does not change the velocity of an agent that is held: the force on it is missing in sums.
    """

    bodies: Floats  # (N, D) N, of `collisions`
    faces: Floats  # (N, D) N, of `face_collisions`


class PinForces(NamedTuple):
    """Forces that hold P particles, pinned ones and those of `moves`."""

    agent: NDArray[np.int64]  # (P,) ascending
    force: Floats  # (P, D) N, on the particle


class WatchedSettler:
    """A constraint that saves the change of velocity that it makes."""

    def __init__(self, settler: Settler) -> None:
        self.settler = settler
        self.change: Floats = np.zeros(0)  # (D, B, N) m/s

    def __call__(self, x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
        """Correct the steps of worlds [first, end) as the constraint does."""
        before = state.v.copy()
        bad = self.settler(x0, v0, state, first, end)
        self.change = state.v - before
        return bad
