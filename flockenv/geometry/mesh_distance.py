"""Signed distances to a closed surface of triangles, exact up to rounding, by a bounding volume hierarchy.

The nearest triangle is found from the top of the tree down, nearer boxes first. The sign is that of the offset from the
nearest point along the normal there; on an edge the normal is the sum of those of both faces, on a vertex their sum
weighted by their angles. So it is right at every point outside and inside.
Source: Baerentzen and Aanaes 2005, Signed distance computation using the angle weighted pseudonormal.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.box_tree import DEEPEST, BoxTree, build_tree, set_boxes
from flockenv.geometry.closest_points import closest_point_face, weighted
from flockenv.jit.decorators import Numbers, Vec, kernel
from flockenv.jit.section import entry
from flockenv.maths.vectors import dot

__all__ = ["distances_to_mesh"]

Floats = NDArray[np.float64]


class _Surface(NamedTuple):
    """T triangles of a closed surface that faces outwards."""

    tree: BoxTree
    corner: Floats  # (T, 3, 3) m
    normal: Floats  # (T, 7, 3) of the face, of the edges opposite to its corners, of its corners; of any length


def distances_to_mesh(points: Floats, triangles: NDArray[np.int64], places: Floats) -> Floats:
    """Return the distances of places (P, 3) m to a surface of points (n, 3) m and triangles (T, 3); negative inside."""
    corner = points[triangles]
    tree = build_tree(corner.mean(axis=1))
    set_boxes(tree, corner)
    surface = _Surface(tree, corner, _normals(points, triangles))
    out = np.empty(len(places))
    entry(_write_distances)(surface, np.ascontiguousarray(places, float), np.empty(DEEPEST, np.int64), out)
    return out


def _normals(points: Floats, triangles: NDArray[np.int64]) -> Floats:
    """Return the normals of each triangle's face, edges and corners, (T, 7, 3)."""
    corner = points[triangles]
    face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    edges = np.stack([np.roll(triangles, -1 - k, axis=1)[:, :2] for k in range(3)], axis=1)  # opposite to corner k
    _, edge = np.unique(np.sort(edges.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    of_edge, of_point = np.zeros((edge.max() + 1, 3)), np.zeros_like(points)
    np.add.at(of_edge, edge.ravel(), np.repeat(face, 3, axis=0))
    for k in range(3):
        u, v = (corner[:, (k + turn) % 3] - corner[:, k] for turn in (1, 2))
        angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))
        np.add.at(of_point, triangles[:, k], angle[:, None] * face)
    return np.concatenate([face[:, None], of_edge[edge.reshape(-1, 3)], of_point[triangles]], axis=1)


@kernel
def _row(rows: Any, r: int, k: int) -> Vec:
    """Return rows[r, k] as a vector."""
    return (rows[r, k, 0], rows[r, k, 1], rows[r, k, 2])


@kernel
def _square_to_box(box: Any, k: int, p: Vec) -> float:
    """Return the squared distance of a point to box k, m^2; infinite if it is empty."""
    square = 0.0
    for c in range(3):
        off = max(box[k, c] - p[c], p[c] - box[k, 3 + c], 0.0)
        square += off * off
    return square


@kernel
def _weights(surface: Any, t: int, p: Vec) -> Numbers:
    """Return the weights of p and the corners of triangle t in the offset from its closest point to p."""
    return closest_point_face(p, _row(surface.corner, t, 0), _row(surface.corner, t, 1), _row(surface.corner, t, 2))


@kernel
def _offset(surface: Any, t: int, w: Numbers, p: Vec) -> Vec:
    """Return the offset from the closest point of triangle t to p, m."""
    return weighted(w, p, _row(surface.corner, t, 0), _row(surface.corner, t, 1), _row(surface.corner, t, 2))


@kernel
def _nearest_triangle(surface: Any, p: Vec, first: int, stack: Any) -> int:
    """Return the triangle nearest to a point; the search is short if `first` is near."""
    box, order = surface.tree.box, surface.tree.order
    best, leaves, depth = first, order.shape[0], 1
    off = _offset(surface, first, _weights(surface, first, p), p)
    least = dot(off, off)
    stack[0] = 0
    while depth > 0:
        depth -= 1
        k = stack[depth]
        if _square_to_box(box, k, p) >= least:
            continue
        if k >= leaves - 1:
            t = order[k - leaves + 1]
            off = _offset(surface, t, _weights(surface, t, p), p)
            square = dot(off, off)
            if square < least:
                best, least = t, square
        else:
            one, two = 2 * k + 1, 2 * k + 2
            if _square_to_box(box, one, p) < _square_to_box(box, two, p):
                one, two = two, one
            stack[depth], stack[depth + 1] = one, two  # the nearer one is taken first
            depth += 2
    return best


@kernel
def _part(w: Numbers) -> int:
    """Return the place of the normal at a closest point: 0 in the face, 1 + k on an edge, 4 + k in corner k."""
    zeros = (1 if w[1] == 0.0 else 0) + (1 if w[2] == 0.0 else 0) + (1 if w[3] == 0.0 else 0)
    if zeros == 0:
        return 0
    if zeros == 1:
        return 1 if w[1] == 0.0 else (2 if w[2] == 0.0 else 3)
    return 4 if w[1] != 0.0 else (5 if w[2] != 0.0 else 6)


@kernel
def _write_distances(surface: Any, places: Any, stack: Any, out: Any) -> None:
    """Write the signed distance of each place."""
    t = 0
    for i in range(places.shape[0]):
        p = (places[i, 0], places[i, 1], places[i, 2])
        t = _nearest_triangle(surface, p, t, stack)
        w = _weights(surface, t, p)
        off = _offset(surface, t, w, p)
        side = dot(off, _row(surface.normal, t, _part(w)))
        far = np.sqrt(dot(off, off))
        out[i] = far if side >= 0.0 else -far
