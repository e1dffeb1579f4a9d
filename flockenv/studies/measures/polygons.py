"""Polygons of measured areas: validation, clipping by half-planes, and containment of points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.core.errors import printable
from flockenv.geometry.shapes.outlines import area, crossing

__all__ = ["Corners", "contains", "cut", "is_convex_polygon", "rectangle", "valid_polygon"]

Floats = NDArray[np.float64]
Corners = list[tuple[float, float]]
"""A polygon while it is clipped: plain numbers, as there are many polygons of few corners."""


def valid_polygon(name: str, polygon: ArrayLike, is_convex: bool = False) -> Floats:
    """Return a polygon (n, 2), m, counter-clockwise; raise ValueError if it has no area or crosses itself."""
    vertices = np.asarray(polygon, np.float64)
    if vertices.ndim != 2 or vertices.shape[1:] != (2,) or len(vertices) < 3 or not np.isfinite(vertices).all():
        raise ValueError(f"{name} = {printable(vertices.tolist())}: must be at least three corners (x, y), all finite")
    if area(vertices) == 0 or crossing(vertices) is not None:
        raise ValueError(f"{name} = {printable(vertices.tolist())}: must enclose an area, and its edges must not cross")
    vertices = vertices if area(vertices) > 0 else vertices[::-1].copy()
    if is_convex and not is_convex_polygon(vertices):
        raise ValueError(f"{name} = {printable(vertices.tolist())}: must be convex")
    return vertices


def rectangle(low: Sequence[float] | Floats, high: Sequence[float] | Floats) -> Floats:
    """Return the corners of a rectangle along the axes, (4, 2), counter-clockwise."""
    return np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])], np.float64)


def is_convex_polygon(polygon: Floats) -> bool:
    """Return True if a counter-clockwise polygon (n, 2) is convex."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    after = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    return bool((turns >= -1e-12 * np.abs(turns).max()).all())


def contains(polygon: Floats, points: Floats) -> NDArray[np.bool_]:
    """Return which points (..., 2) lie in a polygon (n, 2), by the parity of the edges that a ray from each crosses.

    A point on an edge that two polygons share lies in exactly one of them.
    """
    x, y = points[..., 0], points[..., 1]
    inside = np.zeros(points.shape[:-1], np.bool_)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 <= y) != (y1 <= y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def cut(corners: Corners, nx: float, ny: float, bound: float) -> Corners:
    """Return the part of a convex polygon in the half-plane nx x + ny y <= bound.

    Source: Sutherland & Hodgman 1974, Comm. ACM 17, 32.
    """
    kept: Corners = []
    if not corners:
        return kept
    x0, y0 = corners[-1]
    before = nx * x0 + ny * y0 - bound
    for x1, y1 in corners:
        here = nx * x1 + ny * y1 - bound
        if (here > 0) != (before > 0):
            t = before / (before - here)
            kept.append((x0 + t * (x1 - x0), y0 + t * (y1 - y0)))
        if here <= 0:
            kept.append((x1, y1))
        x0, y0, before = x1, y1, here
    return kept
