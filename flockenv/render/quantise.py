"""Positions and headings of agents as small integers, for replays and for the frames of the playground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["ABSENT", "BEYOND", "DIRECTIONS", "LEVELS", "RESTING", "quantise_headings", "quantise_positions"]

Floats = NDArray[np.floating[Any]]

#: Headings are 0 to 253, anticlockwise from +x; the other two values: an agent at rest, and one that is not shown.
DIRECTIONS: Final = 254
RESTING: Final = 254
ABSENT: Final = 255
#: Positions are stored up to this share of the region's extent beyond [low, high]; farther agents are moved there.
BEYOND: Final = 0.5
LEVELS: Final = 65535


#: Agents at a time, whose temporary arrays stay in the caches: ten times faster than all of 100,000 at once.
_BLOCK: Final = 4096


def quantise_positions(
    pos: Floats, low: Sequence[float] | Floats, high: Sequence[float] | Floats
) -> NDArray[np.uint16]:
    """Return positions, (D, N) m, as (D, N) levels over the region [low, high], (D,) m, and BEYOND around it."""
    out = np.empty(pos.shape, np.uint16)
    for axis, (least, most) in enumerate(zip(low, high, strict=True)):
        extent = most - least
        first, last = least - BEYOND * extent, most + BEYOND * extent
        for begin in range(0, pos.shape[1], _BLOCK):
            part = slice(begin, begin + _BLOCK)
            level = np.clip(pos[axis, part], first, last)
            level -= first
            level /= last - first
            level *= LEVELS
            out[axis, part] = np.rint(level, out=level)
    return out


def quantise_headings(aim: Floats, shown: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the directions of vectors in the x-y plane, (2 or 3, N), as (N,) numbers; RESTING for a vector of 0.

    shown (N,): False for agents that are ABSENT.
    """
    out = np.empty(aim.shape[1], np.uint8)
    for begin in range(0, aim.shape[1], _BLOCK):
        part = slice(begin, begin + _BLOCK)
        x, y = aim[0, part], aim[1, part]
        turn = np.arctan2(y, x)
        turn *= DIRECTIONS / (2.0 * np.pi)
        np.rint(turn, out=turn)
        turn += DIRECTIONS * (turn < 0)
        turn[turn >= DIRECTIONS] = 0
        turn[(x == 0) & (y == 0)] = RESTING
        turn[~shown[part]] = ABSENT
        out[part] = turn
    return out
