"""Paths: where a run was at some instants, and how far two of them are apart, agent by agent."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockenv.model.state import WORK

__all__ = ["Floats", "Path", "apart", "farthest", "largest", "reach", "unmatched"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Path:
    """Where a run was at some instants."""

    pos: Floats  # (K, N, D) m
    vel: Floats  # (K, N, D) m/s
    who: NDArray[np.int64] | None = None  # (K, N) identity of the agent in each slot, -1 = none lives there
    work: NDArray[np.int64] | None = None  # (len(WORK),) what was counted, see State.work

    def counted(self, what: str) -> int:
        """Return one work counter; `what` is a name in WORK."""
        return 0 if self.work is None else int(self.work[WORK.index(what)])


def apart(path: Path, other: Path, displacement: Callable[[Floats, Floats], Floats]) -> Floats:
    """Return how far every agent of a path is from where another has it, (K, N) m, the shortest way.

    Where agents are born and die they are compared by identity: what lives in one path alone is NaN.
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


def unmatched(path: Path, other: Path) -> int:
    """Return how many agents live in one of two paths alone, at the instant at which they are most."""
    if path.who is None or other.who is None:
        return 0
    return max(
        len(np.setxor1d(mine[mine >= 0], theirs[theirs >= 0])) for mine, theirs in zip(path.who, other.who, strict=True)
    )


def reach(path: Path, start: Floats, displacement: Callable[[Floats, Floats], Floats]) -> float:
    """Return how far the farthest agent goes from `start`, (N, D), or from where it is first seen after birth, m."""
    if path.who is None:
        return largest(np.linalg.norm(displacement(path.pos, start), axis=-1))
    most, first = 0.0, {int(who): start[who] for who in range(len(start))}
    for who, pos in zip(path.who, path.pos, strict=True):
        for slot in np.flatnonzero(who >= 0):
            begun = first.setdefault(int(who[slot]), pos[slot])
            most = max(most, float(np.linalg.norm(displacement(pos[slot], begun))))
    return most


def largest(values: Floats) -> float:
    """Return the largest of some numbers; NaN if one is NaN, or if there are none."""
    return float(np.max(values)) if np.size(values) else math.nan


def farthest(off: Floats) -> float:
    """Return the largest distance of agents that live in both paths, m; NaN if none does."""
    return largest(off[~np.isnan(off)])
