"""A check, independent of the simulation, that no point passed a face and no edge an edge between two states.

All move along straight lines. For a part of the step a direction is searched along which the two things stay apart; the
proof that they do is exact: rational numbers, or floating-point ones with a margin far above their rounding error. A
part without such a direction is halved, down to 2^-DEPTH of the step; then the pair counts as crossed.
"""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["crossings"]

Array = NDArray[np.float64]
Ints = NDArray[np.integer[Any]]
DEPTH, ROUNDS, MARGIN = 30, 40, 1e-11


def crossings(before: Array, after: Array, faces: Ints, points: Ints | None = None) -> list[tuple[int, ...]]:
    """Return the pairs that crossed, or touched, as numbers of their vertices; before, after: (N, 3) m.

    points: vertices that are tested against faces (default: the corners of faces).
    """
    sides = np.sort(np.concatenate([faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    edges = np.unique(sides, axis=0)
    single = (np.unique(faces) if points is None else np.asarray(points))[:, None]
    found = []
    for one, other in ((single, faces), (edges, edges)):
        a, b = _near(before, after, one, other)
        left, right = one[a], other[b]
        apart = ~(left[:, :, None] == right[:, None, :]).any(axis=(1, 2))
        if one is other:
            apart &= a < b
        left, right = left[apart], right[apart]
        offsets = _offsets(before, left, right), _offsets(after, left, right)
        unclear = np.flatnonzero(~_apart(np.concatenate(offsets, axis=1)))
        exact = [
            [_exact(place[vertices[k]]) for place in (before, after) for vertices in (left, right)] for k in unclear
        ]
        found += [
            (*left[k].tolist(), *right[k].tolist())
            for k, numbers in zip(unclear, exact, strict=True)
            if not _proved(*numbers)
        ]
    return found


def _exact(places: Array) -> list[list[Fraction]]:
    """Return positions as rational numbers."""
    return [[Fraction(float(c)) for c in place] for place in places]


def _near(before: Array, after: Array, one: Ints, other: Ints) -> tuple[Ints, Ints]:
    """Return the pairs whose bounding balls and boxes over the step overlap."""
    centres, reaches, boxes = [], [], []
    for part in (one, other):
        places = np.concatenate([before[part], after[part]], axis=1)
        centres.append(places.mean(axis=1))
        reaches.append(np.linalg.norm(places - centres[-1][:, None], axis=2).max())
        boxes.append((places.min(axis=1), places.max(axis=1)))
    pairs = cKDTree(centres[0]).sparse_distance_matrix(cKDTree(centres[1]), 1.001 * sum(reaches), output_type="ndarray")
    a, b = pairs["i"], pairs["j"]
    (low, high), (other_low, other_high) = boxes
    meet = ((low[a] <= other_high[b]) & (other_low[b] <= high[a])).all(axis=1)
    return a[meet], b[meet]


def _offsets(place: Array, left: Ints, right: Ints) -> Array:
    """Return the offsets between all corners of each pair, (K, n, 3) m."""
    count = left.shape[1] * right.shape[1]
    return np.asarray(place[left][:, :, None] - place[right][:, None]).reshape(len(left), count, 3)


def _apart(offsets: Array) -> NDArray[np.bool_]:
    """Return True for each pair for which a direction was found along which all offsets, (K, n, 3), are positive.

    Directions: the axes, then those from 0 towards the nearest point of the hull of the offsets (Gilbert's iteration).
    """
    little = MARGIN * np.abs(offsets).max(axis=(1, 2), initial=0)[:, None]
    best = ((offsets.min(axis=1) > little) | (offsets.max(axis=1) < -little)).any(axis=1)
    todo = np.flatnonzero(~best)
    at = offsets[todo].mean(axis=1)
    for _ in range(ROUNDS):
        part = offsets[todo]
        along = (part @ at[:, :, None])[:, :, 0]
        worst, rows = along.argmin(axis=1), np.arange(len(todo))
        apart = along[rows, worst] > little[todo, 0] * np.linalg.norm(at, axis=1)
        best[todo[apart]] = True
        step = part[rows, worst] - at
        square = (step**2).sum(axis=1)
        share = np.clip(-(at * step).sum(axis=1) / np.where(square > 0, square, 1), 0, 1)
        at, todo = (at + share[:, None] * step)[~apart], todo[~apart]
    return np.asarray(best)


def _proved(l0: Any, r0: Any, l1: Any, r1: Any) -> bool:
    """Return True if it is proved, in rational numbers, that a pair stays apart."""
    parts = [(Fraction(0), Fraction(1), 0)]
    while parts:
        low, high, depth = parts.pop()
        hull = [_hull(l0, r0, l1, r1, t) for t in (low, high)]
        middle = np.array(_hull(l0, r0, l1, r1, (low + high) / 2), float)
        direction = [Fraction(float(c)) for c in _nearest(middle)]
        if all(sum(c * d for c, d in zip(off, direction, strict=True)) > 0 for off in hull[0] + hull[1]):
            continue
        if depth == DEPTH:
            return False
        half = (low + high) / 2
        parts += [(low, half, depth + 1), (half, high, depth + 1)]
    return True


def _hull(l0: Any, r0: Any, l1: Any, r1: Any, t: Fraction) -> list[list[Fraction]]:
    """Return the offsets between all corners of a pair at a time."""

    def at(p: Any, q: Any) -> list[list[Fraction]]:
        return [[a + t * (b - a) for a, b in zip(one, two, strict=True)] for one, two in zip(p, q, strict=True)]

    return [[a - b for a, b in zip(x, y, strict=True)] for x, y in itertools.product(at(l0, l1), at(r0, r1))]


def _nearest(offsets: Array) -> Array:
    """Return the point of the hull of a few offsets, (n, 3), nearest to 0, by comparing its corners and sides."""
    best = min(offsets, key=lambda p: float(p @ p))
    for count in (2, 3):
        for some in itertools.combinations(range(len(offsets)), count):
            base, sides = offsets[some[0]], offsets[list(some[1:])] - offsets[some[0]]
            share = np.linalg.lstsq(sides.T, -base, rcond=None)[0]
            if (share >= 0).all() and share.sum() <= 1:
                point = base + share @ sides
                best = min(best, point, key=lambda p: float(p @ p))
    return np.asarray(best)
