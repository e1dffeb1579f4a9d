"""Surfaces as pieces from which points can be drawn, with a probability proportional to their size.

A piece has 14 numbers: the cumulative size of all pieces up to it (m in 2-D, m^2 in 3-D); 0 if it is flat, 1 for the
side of a tube, 2 for the two ends of a tube or a ball; then the geometry. Flat: a corner, the two edges from there (one
in 2-D), and a sign for the outer side. Round: both ends of the tube's line, and its radius.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes.outlines import area

__all__ = ["COLUMNS", "pieces"]

Floats = NDArray[np.float64]
COLUMNS = 14
FLAT, SIDE, ENDS = 0.0, 1.0, 2.0


def pieces(shape: Any) -> Floats:
    """Return the pieces of a shape's surface, (n, 14).

    Raise ValueError if the shape is unbounded, hollow, or has a grid of distances.
    """
    if shape.form == "block":
        found = _block(shape)
    elif shape.kind == "polygon":
        found = _polygon(shape)
    elif shape.form == "chain":
        found = _chain(shape)
    else:
        why = "has no end" if shape.kind == "half_space" else "has distances on a grid"
        why = "is hollow" if shape.is_hollow else why
        raise ValueError(
            f"shape.kind = {shape.kind}: {why}, its surface cannot be drawn from; allowed: circle, capsule, wall, "
            "polygon, block"
        )
    rows = np.array(found)
    rows[:, 0] = np.cumsum(rows[:, 0])
    return rows


def _in_3d(vector: Any) -> list[float]:
    flat = [float(x) for x in vector]
    return flat + [0.0] * (3 - len(flat))


def _flat_piece(corner: Any, u: Any, v: Any, size: float, sign: float = 1.0) -> list[float]:
    return [size, FLAT, *_in_3d(corner), *_in_3d(u), *_in_3d(v), sign, 0.0, 0.0]


def _polygon(shape: Any) -> list[list[float]]:
    """Return the edges of a polygon, counter-clockwise: the right of an edge is outside."""
    corners = np.array(shape.vertices)
    corners = corners if area(corners) > 0 else corners[::-1]
    edges = np.roll(corners, -1, axis=0) - corners
    return [_flat_piece(a, e, (), math.hypot(*e)) for a, e in zip(corners, edges, strict=True)]


def _block(shape: Any) -> list[list[float]]:
    """Return the edges of a rectangle, or the faces of a box."""
    d, centre = shape.dimension, np.array(shape.centre)
    edges = shape.axes * np.array(shape.size)[:, None]  # one row each
    found = []
    for k in range(d):
        others = [edges[j] for j in range(d) if j != k]
        for side in (-0.5, 0.5):
            corner = centre + side * edges[k] - 0.5 * sum(others)
            u, v = others[0], others[1] if d == 3 else ()
            out = np.cross(u, v) if d == 3 else np.array([u[1], -u[0]])
            size = math.prod(float(np.linalg.norm(e)) for e in others)
            found.append(_flat_piece(corner, u, v, size, float(np.sign(out @ edges[k] * side))))
    return found


def _chain(shape: Any) -> list[list[float]]:
    """Return the sides and the ends of each segment of a thick line; the ends only for a circle or sphere."""
    if shape.kind == "circle":
        line, radius = [shape.centre, shape.centre], shape.radius
    else:
        line = [shape.start, shape.end] if shape.kind == "capsule" else list(shape.vertices)
        radius = shape.radius
    around = 2.0 if shape.dimension == 2 else 2.0 * math.pi * radius
    ends = 2.0 * math.pi * radius if shape.dimension == 2 else 4.0 * math.pi * radius**2
    found = []
    for a, b in itertools.pairwise(line):
        length = math.dist(a, b)
        # a line without thickness has no area in 3-D: its length is used
        size = length * (around if around > 0 else 1.0)
        for kind, measure in ((SIDE, size), (ENDS, ends)):
            if measure > 0:
                found.append([measure, kind, *_in_3d(a), *_in_3d(b), radius, *[0.0] * 5])
    if not found:
        raise ValueError(f"shape.kind = {shape.kind}: a point has no surface; give it a radius")
    return found
