"""Paths: positions of a run at some instants, and the distances between two paths, agent by agent."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockenv.model.state import WORK

__all__ = ["Floats", "Path", "count_unmatched", "distances", "largest_distance", "largest_value", "reach"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Path:
    """Positions and velocities of a run at some instants."""

    pos: Floats  # (K, N, D) m
    vel: Floats  # (K, N, D) m/s
    who: NDArray[np.int64] | None = None  # (K, N) identity of the agent in each slot, -1 = empty slot
    work: NDArray[np.int64] | None = None  # (len(WORK),) work counters, see State.work

    def count_of(self, what: str) -> int:
        """Return one work counter; `what` is a name in WORK."""
        return 0 if self.work is None else int(self.work[WORK.index(what)])


def distances(path: Path, other: Path, displacement: Callable[[Floats, Floats], Floats]) -> Floats:
    """Return the distance of every agent between two paths, (K, N) m, along the shortest path.

    If agents are born and die, they are compared by identity: NaN for agents that live in only one path.
    """
    if path.who is None or other.who is None:
        return np.asarray(np.linalg.norm(displacement(path.pos, other.pos), axis=-1))
    off = np.full(path.who.shape, np.nan)
    for k, (mine, theirs) in enumerate(zip(path.who, other.who, strict=True)):
        _, i, j = np.intersect1d(mine, theirs, return_indices=True)
        both = mine[i] >= 0
        i, j = i[both], j[both]
        off[k, i] = np.linalg.norm(displacement(path.pos[k, i], other.pos[k, j]), axis=-1)
    return off


def count_unmatched(path: Path, other: Path) -> int:
    """Return the number of agents that live in only one of two paths, at the instant with most of them."""
    if path.who is None or other.who is None:
        return 0
    return max(
        len(np.setxor1d(mine[mine >= 0], theirs[theirs >= 0])) for mine, theirs in zip(path.who, other.who, strict=True)
    )


def reach(path: Path, start: Floats, displacement: Callable[[Floats, Floats], Floats]) -> float:
    """Return the largest distance of an agent from `start`, (N, D), or from its first position after birth, m."""
    if path.who is None:
        return largest_value(np.linalg.norm(displacement(path.pos, start), axis=-1))
    most, first = 0.0, {int(who): start[who] for who in range(len(start))}
    for who, pos in zip(path.who, path.pos, strict=True):
        for slot in np.flatnonzero(who >= 0):
            begun = first.setdefault(int(who[slot]), pos[slot])
            most = max(most, float(np.linalg.norm(displacement(pos[slot], begun))))
    return most


def largest_value(values: Floats) -> float:
    """Return the largest of some numbers; NaN if one is NaN, or if there are none."""
    return float(np.max(values)) if np.size(values) else math.nan


def largest_distance(off: Floats) -> float:
    """Return the largest distance of agents that live in both paths, m; NaN if there are none."""
    return largest_value(off[~np.isnan(off)])
