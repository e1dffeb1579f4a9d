"""What agents see of each other and of obstacles: the nearest few, written into slots of an observation row."""

from __future__ import annotations

import math
from typing import Any

from flockenv.kernels import kernel
from flockenv.tasks.base import Frame

__all__ = ["clip", "nearest_agents", "nearest_obstacles"]

_FAR = 1e30


@kernel
def clip(x: float) -> float:
    """Bound to [-1, 1]."""
    return min(max(x, -1.0), 1.0)


@kernel
def _keep_nearest(who: int, distance: float, found: int, slots: int, distances: Any, chosen: Any) -> int:
    """Insert one candidate into the sorted list of the nearest; return how many it holds now."""
    at = found
    while at > 0 and distances[at - 1] > distance:
        at -= 1
    if at >= slots:
        return found
    last = min(found, slots - 1)
    for k in range(last, at, -1):
        distances[k], chosen[k] = distances[k - 1], chosen[k - 1]
    distances[at], chosen[at] = distance, who
    return min(found + 1, slots)


@kernel
def nearest_agents(
    frame: Frame, i: int, first: int, end: int, reach: float, size: Any, slots: int, distances: Any, chosen: Any
) -> int:
    """Write the nearest living agents of [first, end) within `reach` m of agent i, nearest first; return how many.

    Equal distances keep the order of the indices. `size` (D,): edges of a periodic box, 0 = not periodic.
    """
    found = 0
    x, y = frame.pos[0, i], frame.pos[1, i]
    bound = reach * reach
    for j in range(first, end):
        if j != i and frame.alive[j]:
            dx = offset(x, frame.pos[0, j], size[0])
            dy = offset(y, frame.pos[1, j], size[1])
            square = dx * dx + dy * dy
            if square < bound:
                found = _keep_nearest(j, square, found, slots, distances, chosen)
                if found == slots:
                    bound = min(bound, distances[slots - 1])
    return found


@kernel
def offset(a: float, b: float, size: float) -> float:
    """Return b - a, the shortest way around a periodic axis of this size (0 = not periodic)."""
    d = b - a
    return d - size * math.floor(d / size + 0.5) if size > 0.0 else d


@kernel
def nearest_obstacles(frame: Frame, i: int, reach: float, size: Any, slots: int, distances: Any, chosen: Any) -> int:
    """Write the obstacles whose surface is nearest to agent i and within `reach` m; return how many."""
    found = 0
    for m in range(frame.rho.shape[0]):
        if frame.rho[m] > 0.0:
            dx = offset(frame.pos[0, i], frame.centre[0, m], size[0])
            dy = offset(frame.pos[1, i], frame.centre[1, m], size[1])
            gap = math.sqrt(dx * dx + dy * dy) - frame.rho[m]
            if gap < reach:
                found = _keep_nearest(m, gap, found, slots, distances, chosen)
    return found
