"""Where walls are joined: of an open chain, whether its ends are free, or lie on another wall.

A law that meets walls piece by piece meets a corner once, however many pieces share it: it acts where it is nearest to
all of them. Within a chain that follows from its vertices; ends that lie on other chains are found here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FREE", "NEVER", "SHARED", "joints"]

Floats = NDArray[np.float64]

FREE, SHARED, NEVER = 0.0, 1.0, 2.0
"""Of an end: it acts where it is nearest; where it is nearest to another's piece too; another shape acts there."""

NEAR = 1e-6
"""m, that two walls may be apart and still be joined."""


def _lines(shape: Any) -> Floats | None:
    """Return the pieces of a shape's outline, (M, 2, D) m, if it stands still and is made of straight ones."""
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
    """Return points less a place, by the shortest way."""
    way = points - place
    return way if period is None else way - period * np.round(way / period)


def _touching(place: Floats, pieces: Floats, period: Floats | None) -> tuple[bool, Floats | None]:
    """Return whether a place lies within one of the pieces, and the way along the one that it is an end of."""
    along = pieces[:, 1] - pieces[:, 0]
    first = _nearest(place, pieces.mean(axis=1), period) - along / 2  # of the image whose middle is nearest
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


def _end(place: Floats, own: int, pieces: Sequence[Floats | None], skip: int, period: Floats | None) -> list[float]:
    """Return what an end of chain `own` is, and the way along the piece that shares it; `skip`: its own piece."""
    code, way = FREE, np.zeros(len(place))
    for k, others in enumerate(pieces):
        if others is None:
            continue
        rest = np.delete(others, skip, axis=0) if k == own else others
        inside, along = _touching(place, rest, period) if len(rest) else (False, None)
        if inside or (along is not None and (k < own or (k == own and skip > 0))):
            return [NEVER, *np.zeros(len(place))]
        if along is not None:
            code, way = SHARED, along
    return [code, *way]


def joints(shapes: Sequence[Any], k: int, period: Floats | None = None) -> list[float]:
    """Return what the first and the last end of the open chain `shapes[k]` are: a code, and a way (D), each.

    period: the edges of a torus, m. Of two chains that share an end the one that is listed first has it.
    """
    dimension = shapes[k].dimension
    mine = _lines(shapes[k])
    if mine is None:
        return [FREE, *np.zeros(dimension)] * 2
    pieces = [_lines(shape) for shape in shapes]
    first = _end(mine[0, 0], k, pieces, 0, period)
    return first + _end(mine[-1, 1], k, pieces, len(mine) - 1, period)
