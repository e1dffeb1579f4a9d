"""Flow through a line: its crossings by agent, time and direction; the flow, 1/(m s); the time gaps."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Crossings", "Flow", "crossings", "cumulative", "flow", "time_gaps"]

Floats = NDArray[np.float64]

PIECE = 2_000_000
"""Agent-instants that are processed together."""


class Crossings(NamedTuple):
    """All crossings of a line, in the order of time."""

    time: Floats  # (C,) s
    agent: NDArray[np.int64]  # (C,)
    sign: NDArray[np.int64]  # (C,) 1: to the right, seen from the line's first end towards its second; -1: to the left


class Flow(NamedTuple):
    """Flow through a line over some time; `forward` is to its right."""

    forward: int
    backward: int  # crossings to the left
    rate: float  # 1/s, (forward - backward) / the whole time
    specific: float  # 1/(m s), rate / width
    passing: float  # 1/s, (n - 1) / (t_n - t_1) of forward crossings; NaN for fewer than two


def crossings(
    time: ArrayLike,
    pos: ArrayLike,
    line: ArrayLike,
    alive: ArrayLike | None = None,
    identity: ArrayLike | None = None,
    period: ArrayLike = (0.0, 0.0),
) -> Crossings:
    """Return the crossings of a line; paths between two instants are straight.

    time (T,) s, increasing; pos (T, N, 2) m; line (2, 2) m, from its first end to its second; alive (T, N) and identity
    (T, N): a slot whose agent is dead at one of two instants, or another agent at the second, has no path between them;
    period (2,) m of a periodic world, in which the shortest path is taken; 0 = not periodic. An agent that ends exactly
    on the line has crossed it if it came from the right, not from the left; so where two lines join end to end, each
    crossing belongs to one of them, up to rounding.
    Raises ValueError if shapes do not match, the line has length 0, or times do not increase.
    """
    when, where = np.asarray(time, np.float64), np.asarray(pos, np.float64)
    ends = _check_line(line)
    if where.ndim != 3 or where.shape[2] != 2 or when.shape != where.shape[:1]:
        raise ValueError(f"pos: of shape {where.shape}, time of {when.shape}: must be (T, N, 2) and (T,)")
    if (np.diff(when) <= 0).any():
        raise ValueError("time: must grow from instant to instant")
    there = np.ones(where.shape[:2], np.bool_) if alive is None else np.asarray(alive, np.bool_)
    same = None if identity is None else np.asarray(identity)
    around = np.asarray(period, np.float64)
    piece, found = max(1, PIECE // max(1, where.shape[1])), []
    for begin in range(0, len(when) - 1, piece):
        at = slice(begin, begin + piece + 1)
        moved = there[at][1:] & there[at][:-1]
        if same is not None:
            moved &= same[at][1:] == same[at][:-1]
        found += _crossings_between(when[at], where[at], ends, moved, around)
    times, agents, signs = (np.concatenate(each) for each in zip(*found, strict=True)) if found else _NOBODY
    order = np.lexsort((agents, times))
    return Crossings(times[order], agents[order], signs[order])


_NOBODY = (np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64))


def _crossings_between(
    time: Floats, pos: Floats, line: Floats, moved: NDArray[np.bool_], period: Floats
) -> list[tuple[Floats, NDArray[np.int64], NDArray[np.int64]]]:
    """Return times, agents and signs of crossings of the line and of its images, over some instants."""
    move = pos[1:] - pos[:-1]
    move -= period * np.round(move / np.where(period > 0, period, np.inf))
    begin, along = pos[:-1], line[1] - line[0]
    found = []
    for shift in product(*[(0, -1, 1) if length > 0 else (0,) for length in period]):
        first, second = line + np.array(shift) * period
        to = begin - first
        side = along[0] * to[..., 1] - along[1] * to[..., 0]
        then = side + along[0] * move[..., 1] - along[1] * move[..., 0]
        k, i = np.nonzero(((side >= 0) != (then >= 0)) & moved)
        share = side[k, i] / (side[k, i] - then[k, i])
        place = begin[k, i] + share[:, None] * move[k, i]
        on = ((place - first) @ along >= 0) & ((place - second) @ along < 0)
        k, i, share = k[on], i[on], share[on]
        sign = np.where(side[k, i] >= 0, 1, -1)
        found.append((time[k] + share * (time[k + 1] - time[k]), i.astype(np.int64), sign.astype(np.int64)))
    return found


def _check_line(line: ArrayLike) -> Floats:
    ends = np.asarray(line, np.float64)
    if ends.shape != (2, 2) or not np.isfinite(ends).all() or (ends[0] == ends[1]).all():
        raise ValueError(f"line = {ends.tolist()}: must be two different ends (x, y), all finite")
    return ends


def flow(found: Crossings, width: float, seconds: float) -> Flow:
    """Return the flow through a line of some width, m, over a time, s.

    found: the crossings, by `crossings`; width: m; seconds: s.

    rate = N / seconds and specific = rate / width, with N = forward less backward; `passing` is what experiments at
    bottlenecks call J (Seyfried et al. 2009, Transp. Sci. 43, 395): it leaves out the time before the first crossing
    and after the last. Raises ValueError if width or time is not positive.
    """
    for name, value in (("width", width), ("seconds", seconds)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value:g}: must be a finite number > 0")
    forward = found.time[found.sign > 0]
    net = len(forward) - int((found.sign < 0).sum())
    lasts = len(forward) > 1 and forward[-1] > forward[0]
    passing = (len(forward) - 1) / (forward[-1] - forward[0]) if lasts else np.nan
    return Flow(len(forward), len(forward) - net, net / seconds, net / seconds / width, float(passing))


def cumulative(found: Crossings) -> tuple[Floats, NDArray[np.int64]]:
    """Return N(t): times (C,), s, and forward less backward crossings just after each, (C,).

    found: the crossings, by `crossings`.
    """
    return found.time, np.cumsum(found.sign)


def time_gaps(found: Crossings, sign: int = 1) -> Floats:
    """Return the times between successive crossings of one sign, s, in their order: C - 1 for C such crossings.

    found: the crossings, by `crossings`; sign: 1 for forward crossings, -1 for backward ones.

    Source: Kretz, Gruenebohm, Schreckenberg 2006, J. Stat. Mech. P10014 (arXiv physics/0610077).
    """
    return np.diff(found.time[found.sign == sign])
