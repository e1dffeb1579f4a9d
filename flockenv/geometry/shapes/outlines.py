"""Polygons (n, 2) of shapes, for pictures, and computations on their vertices, in numpy."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "area",
    "band",
    "crossing",
    "distinct",
    "half_plane",
    "hull",
    "inflated_hull",
    "silhouette",
    "strips",
    "width",
]

Floats = NDArray[np.float64]
ROUND = 48
"""Corners of a circle in pictures."""

SHORTEST = 1e-6
"""Fraction of a polyline's size: a shorter piece has no accurate direction in single precision."""


def area(vertices: Floats) -> float:
    """Return the area of a polygon (n, 2), positive if it runs counter-clockwise."""
    x, y = vertices.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def distinct(vertices: Floats) -> Floats:
    """Return the vertices (n, D) of a polyline without those that coincide with the one before."""
    shortest = SHORTEST * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    kept = [0]
    for k in range(1, len(vertices)):
        if np.linalg.norm(vertices[k] - vertices[kept[-1]]) > shortest:
            kept.append(k)
    return np.asarray(vertices[kept])


def crossing(vertices: Floats) -> tuple[int, int] | None:
    """Return two edges of a polygon (n, 2) that cross, touch or overlap, each by its first vertex; None if none do."""
    n = len(vertices)
    a, b = vertices, np.roll(vertices, -1, axis=0)
    for i in range(n):
        if (a[i] == b[i]).all():
            return i, (i + 1) % n
        turn = _turn(a[i], b[i], a), _turn(a[i], b[i], b)
        other = _turn(a, b, a[i]), _turn(a, b, b[i])
        apart = (turn[0] * turn[1] > 0) | (other[0] * other[1] > 0)
        low, high = np.minimum(a, b), np.maximum(a, b)
        apart |= (low > high[i]).any(axis=1) | (high < low[i]).any(axis=1)
        following = (i + 1) % n
        back = float((b[i] - a[i]) @ (b[following] - a[following])) < 0
        if turn[1][following] == 0 and back:
            return i, following  # the next edge runs back along this one
        apart[[i, following, (i - 1) % n]] = True
        if not apart.all():
            return i, int(np.flatnonzero(~apart)[0])
    return None


def _turn(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the cross product of b - a and c - a: positive if c lies on the left of the line from a to b."""
    return np.asarray(
        (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
    )


def hull(points: Floats) -> Floats:
    """Return the convex hull of points (n, 2), counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted(set(map(tuple, points.tolist())))
    half: list[list[tuple[float, float]]] = []
    for run in (ordered, ordered[::-1]):
        chain: list[tuple[float, float]] = []
        for p in run:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2:]
                if (bx - ax) * (p[1] - ay) - (by - ay) * (p[0] - ax) > 0:
                    break
                chain.pop()
            chain.append(p)
        half.append(chain[:-1])
    return np.array(half[0] + half[1])


def width(polygon: Floats) -> float:
    """Return the width of a convex polygon (n, 2), m: the least distance of parallel lines around it; 0 if concave."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    after = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    if turns.min() * turns.max() < 0:
        return 0.0
    normal = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    along = polygon @ normal.T  # (n, edges)
    return float(np.ptp(along, axis=0).min())


def inflated_hull(points: Floats, radius: float) -> Floats:
    """Return the convex hull of one or two points (n, 2), inflated by `radius`, as a polygon."""
    return _inflated_hull(tuple(map(tuple, points.tolist())), radius).copy()


@functools.lru_cache(maxsize=1024)  # an animation draws the same walls in every frame
def _inflated_hull(places: tuple[tuple[float, ...], ...], radius: float) -> Floats:
    points = np.array(places)
    turn = np.linspace(0, 2 * np.pi, ROUND, endpoint=False)
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return hull((points[:, None] + ring).reshape(-1, 2))


def band(vertices: Floats, width: float) -> Floats:
    """Return a strip along the outside of a closed polygon (n, 2), as one polygon that runs around it and back."""
    inner = vertices if area(vertices) > 0 else vertices[::-1]
    along = np.roll(inner, -1, axis=0) - inner
    out = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
    both = out + np.roll(out, 1, axis=0)
    # corners are mitred, with a limit, as sharp ones would become spikes
    outer = inner + width * both / np.maximum((both**2).sum(axis=1, keepdims=True) / 2, 0.5)
    return np.concatenate([outer, outer[:1], inner[:1], inner[::-1]])


def half_plane(point: Floats, direction: Floats, low: Floats, high: Floats) -> list[Floats]:
    """Return the part of a region behind a line, as a polygon; no polygon if the direction is 0 (a floor)."""
    if not direction.any():
        return []
    box = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    side = (box - point) @ direction
    kept: list[Floats] = []
    for k in range(4):
        a, b, p, q = side[k - 1], side[k], box[k - 1], box[k]
        if (a > 0) != (b > 0):
            kept.append(p + (q - p) * (a / (a - b)))
        if b <= 0:
            kept.append(q)
    return [np.array(kept)] if len(kept) > 2 else []


def strips(distances: Floats, low: Sequence[float], spacing: float) -> list[Floats]:
    """Return rectangles that cover the points with negative distances on a grid (nx, ny)."""
    found = []
    for i, column in enumerate(distances < 0):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], column, [False]]).astype(int)))
        x = low[0] + spacing * (i + np.array([-0.5, 0.5, 0.5, -0.5]))
        for first, end in edges.reshape(-1, 2).tolist():
            y = low[1] + spacing * (np.array([first, first, end, end]) - 0.5)
            found.append(np.stack([x, y], axis=1))
    return found


def silhouette(shape: Any, point: Floats, clearance: float) -> tuple[Floats, Floats]:
    """Return the left and right ends of a shape's outline, inflated by `clearance`, as seen from a point; m.

    Lines from the point through these ends are tangents of the circles around the shape's corners.
    """
    corners, radius = shape.corners
    if len(point) != 2 or shape.dimension != 2:
        raise ValueError(
            f"silhouette: a {shape.kind} in {shape.dimension}-D; only in 2-D does the outline have two ends"
        )
    if shape.is_hollow:
        raise ValueError(f"silhouette: a hollow {shape.kind} surrounds the point, its outline has no ends")
    if not len(corners):
        raise ValueError(f"silhouette: a {shape.kind} has no corners")
    radius += clearance
    if float(shape.gap(point)) <= clearance:
        raise ValueError(f"silhouette: point = {point.tolist()} m is not outside of the shape")
    offset = corners - point
    distance = np.linalg.norm(offset, axis=1)
    middle = offset.mean(axis=0)
    base = math.atan2(middle[1], middle[0])
    bearing = (np.arctan2(offset[:, 1], offset[:, 0]) - base + np.pi) % (2 * np.pi) - np.pi
    half = np.arcsin(np.minimum(1, radius / distance))
    reach = np.sqrt(np.maximum(distance**2 - radius**2, 0))
    left, right = int(np.argmax(bearing + half)), int(np.argmin(bearing - half))
    ends = [(left, bearing[left] + half[left]), (right, bearing[right] - half[right])]
    first, last = (point + reach[k] * np.array([math.cos(base + a), math.sin(base + a)]) for k, a in ends)
    return first, last
