"""Evacuation times."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.studies.measures.throughput import Crossings

__all__ = ["evacuation_time", "last_crossing", "leaving_times"]

Floats = NDArray[np.float64]


def leaving_times(time: ArrayLike, inside: ArrayLike) -> Floats:
    """Return the first instant of each agent (N,) after its last one inside, s; NaN if it never was or still is inside.

    time (T,) s; inside (T, N): True for agents that are alive and inside the region that they leave.
    """
    when, here = np.asarray(time, np.float64), np.asarray(inside, np.bool_)
    if here.ndim != 2 or when.shape != here.shape[:1]:
        raise ValueError(f"inside: of shape {here.shape}, time of {when.shape}: must be (T, N) and (T,)")
    out = np.full(here.shape[1], np.nan)
    if not len(when):
        return out
    last = len(when) - 1 - np.argmax(here[::-1], axis=0)
    left = here.any(axis=0) & (last < len(when) - 1)
    out[left] = when[last[left] + 1]
    return out


def last_crossing(found: Crossings, agents: int) -> Floats:
    """Return the time of each agent's last crossing of a line, (N,) s, if that is forward; else NaN.

    found: the crossings, by `crossings`; agents: their number N.
    """
    out = np.full(agents, np.nan)
    out[found.agent] = np.where(found.sign > 0, found.time, np.nan)  # in the order of time: the last one remains
    return out


def evacuation_time(left: ArrayLike, share: float = 1.0) -> float:
    """Return when a share of all agents is out, s; NaN if that share is not reached by the end of the run.

    left (N,) s, when each agent left, NaN = not yet. share in (0, 1]: 1 = all, .95 = all but the last twentieth, which
    depends less on a single straggler. Raises ValueError for any other share, or without agents.
    """
    times = np.asarray(left, np.float64)
    if not 0 < share <= 1 or not len(times):
        raise ValueError(f"share = {share:g} of {len(times)}: must be in (0, 1], of at least one agent")
    needed = math.ceil(share * len(times) - 1e-9)
    out = np.sort(times[np.isfinite(times)])
    return float(out[needed - 1]) if len(out) >= needed else np.nan
