"""How long it takes until people are out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.studies.measures.throughput import Crossings

__all__ = ["evacuation_time", "last_crossing", "leaving_times"]

Floats = NDArray[np.float64]


def leaving_times(time: ArrayLike, inside: ArrayLike) -> Floats:
    """Return the first instant after which nobody of (N,) is seen inside again, s; NaN of who still is, or never was.

    time (T,) s; inside (T, N): who is where he is to leave, and alive.
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
    """Return when each of so many crossed a line for good, (N,) s: his last crossing, if that is forward; else NaN."""
    out = np.full(agents, np.nan)
    out[found.agent] = np.where(found.sign > 0, found.time, np.nan)  # in the order of time: the last one stays
    return out


def evacuation_time(left: ArrayLike, share: float = 1.0) -> float:
    """Return when so large a share of all is out, s; NaN if at the end of the run it is not.

    left (N,) s, when each left, NaN = not yet. share in (0, 1]: 1 = all, .95 = all but the last twentieth, which
    depends less on a single straggler. Raises ValueError, of one line, for another share, or nobody.
    """
    times = np.asarray(left, np.float64)
    if not 0 < share <= 1 or not len(times):
        raise ValueError(f"share = {share:g} of {len(times)}: must be in (0, 1], of somebody")
    needed = math.ceil(share * len(times) - 1e-9)
    out = np.sort(times[np.isfinite(times)])
    return float(out[needed - 1]) if len(out) >= needed else np.nan
