"""Joints of walls: which ends of open chains are free, and which lie on another wall.

In a law that sums over the pieces of walls a corner acts once, even if several pieces share it, and only where it is
the nearest point of all of them. Within a chain this follows from its vertices; ends that lie on other chains are found
here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FREE", "NEVER", "SHARED", "joints"]

Floats = NDArray[np.float64]

FREE, SHARED, NEVER = 0.0, 1.0, 2.0
"""Codes of an end: FREE, it acts if nearest; SHARED, if also nearest of the joined piece; NEVER, it does not act."""

NEAR = 1e-6
"""Largest distance, m, at which two walls count as joined."""


def _lines(shape: Any) -> Floats | None:
    """Return the pieces of a shape's outline, (M, 2, D) m; None if it moves, is 3-D, or has no straight pieces."""
    if shape.moves or shape.laws not in ("chain", "block") or shape.dimension != 2:
        return None
    corners, around = shape.corners
    if around > 0 or len(corners) < 2:
        return None
    if shape.kind in ("wall", "capsule"):
        ring = np.concatenate([corners[:-1, None], corners[1:, None]], axis=1)
    else:
        edges = np.array(shape.polygons(corners.min(axis=0), corners.max(axis=0))[0])
        ring = np.stack([edges, np.roll(edges, -1, axis=0)], axis=1)
    return np.asarray(ring, float)


def _nearest(place: Floats, points: Floats, period: Floats | None) -> Floats:
    """Return the offsets from a point to others, by the minimum image of each axis with a period."""
    way = points - place
    return way if period is None else way - period * np.round(way / period)


def _touching(place: Floats, pieces: Floats, period: Floats | None) -> tuple[bool, Floats | None]:
    """Return if a point lies within a piece, and the direction of the piece that has it as an end, if any."""
    along = pieces[:, 1] - pieces[:, 0]
    first = _nearest(place, pieces.mean(axis=1), period) - along / 2  # offset to the image whose middle is nearest
    square = (along**2).sum(axis=1)
    share = np.clip(-(first * along).sum(axis=1) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    off = np.linalg.norm(first + share[:, None] * along, axis=1)
    length = np.sqrt(square)
    met = off <= NEAR
    ends = met & ((share * length <= NEAR) | ((1 - share) * length <= NEAR))
    inside = bool((met & ~ends).any())
    if not ends.any() or inside:
        return inside, None
    k = int(np.flatnonzero(ends)[0])
    away = along[k] if share[k] * length[k] <= NEAR else -along[k]
    return False, np.asarray(away / length[k] if length[k] > 0 else away)


class _Outlines:
    """The pieces of the outlines of all shapes, with bounding boxes, by which few have to be tested."""

    def __init__(self, shapes: Sequence[Any], period: Floats | None) -> None:
        self.period, self.pieces = period, [_lines(shape) for shape in shapes]
        self.straight = [k for k, pieces in enumerate(self.pieces) if pieces is not None]
        boxes = [pieces.reshape(-1, 2) for pieces in self.pieces if pieces is not None]
        low = np.array([box.min(axis=0) for box in boxes]).reshape(-1, 2)
        high = np.array([box.max(axis=0) for box in boxes]).reshape(-1, 2)
        self.middle, self.half = (low + high) / 2, (high - low) / 2 + 2 * NEAR

    def near(self, place: Floats) -> list[tuple[int, Floats]]:
        """Return the shapes (index, pieces) whose box contains a point, in order."""
        within = (np.abs(_nearest(place, self.middle, self.period)) <= self.half).all(axis=1)
        found = [self.straight[k] for k in np.flatnonzero(within)]
        return [(k, pieces) for k in found if (pieces := self.pieces[k]) is not None]

    def end(self, place: Floats, own: int, skip: int) -> list[float]:
        """Return the code of an end of chain `own`, and the direction of the piece sharing it; skip: its own piece."""
        code, way = FREE, np.zeros(len(place))
        for k, others in self.near(place):
            rest = np.delete(others, skip, axis=0) if k == own else others
            inside, along = _touching(place, rest, self.period) if len(rest) else (False, None)
            if inside or (along is not None and (k < own or (k == own and skip > 0))):
                return [NEVER, *np.zeros(len(place))]
            if along is not None:
                code, way = SHARED, along
        return [code, *way]


def joints(shapes: Sequence[Any], chains: Sequence[int], period: Floats | None = None) -> dict[int, list[float]]:
    """Return, for each open chain of `chains` (indices), a code and a direction (D) for its first and its last end.

    period: the edges of a torus, m. If two chains share an end, it belongs to the one that is listed first.
    """
    outlines, found = _Outlines(shapes, period), {}
    for k in chains:
        mine = outlines.pieces[k]
        if mine is None:
            found[k] = [FREE, *np.zeros(shapes[k].dimension)] * 2
        else:
            found[k] = outlines.end(mine[0, 0], k, 0) + outlines.end(mine[-1, 1], k, len(mine) - 1)
    return found
