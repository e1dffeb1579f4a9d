"""Meshes of triangles: edges between two triangles, their angles, and material coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["dihedral_angles", "dihedrals", "material_gradients"]

Floats = NDArray[np.float64]


def dihedrals(triangles: NDArray[Any]) -> NDArray[np.int64]:
    """Return the edges between two triangles, (H, 4): the ends a, b, and the opposite corners c, d.

    The first triangle is (a, b, c) in its own order. Raises ValueError on an edge of more than two triangles.
    """
    size = int(triangles.max(initial=0)) + 1
    corners = np.concatenate([np.roll(triangles, -k, axis=1) for k in range(3)]).astype(np.int64)  # a, b, opposite
    key = np.minimum(corners[:, 0], corners[:, 1]) * size + np.maximum(corners[:, 0], corners[:, 1])
    order = np.argsort(key, kind="stable")
    key, corners = key[order], corners[order]
    crowded = np.flatnonzero(key[2:] == key[:-2])
    if len(crowded):
        a, b = np.sort(corners[crowded[0], :2]).tolist()
        raise ValueError(f"the edge of particles {a} and {b} is shared by three triangles; at most two are allowed")
    first = np.flatnonzero(key[1:] == key[:-1])
    return np.concatenate([corners[first], corners[first + 1, 2:]], axis=1)


def dihedral_angles(points: Floats, edges: NDArray[Any]) -> tuple[Floats, Floats]:
    """Return the angle between the normals at each edge (a, b, c, d), (H,) rad, and |e|^2 over the sum of two areas.

    The angle has the sign of (n x n') . (b - a), with the normals n of (a, b, c) and n' of (b, a, d); 0 if flat.
    """
    a, b, c, d = (points[edges[:, k]] for k in range(4))
    edge = b - a
    one, two = np.cross(edge, c - a), np.cross(d - a, edge)
    long = np.linalg.norm(edge, axis=1)
    sine = (np.cross(one, two) * edge).sum(axis=1) / np.where(long > 0, long, 1.0)
    areas = 0.5 * (np.linalg.norm(one, axis=1) + np.linalg.norm(two, axis=1))
    return np.arctan2(sine, (one * two).sum(axis=1)), long**2 / np.where(areas > 0, areas, 1.0)


def material_gradients(points: Floats, triangles: NDArray[Any], warp: ArrayLike | None) -> tuple[Floats, Floats]:
    """Return the gradients of (u, v) at each corner, (T, 3, 2) 1/m, and areas, (T,) m^2, of the rest shape (n, D).

    dx/du = sum over corners of gradient x. u runs along `warp`, projected onto the plane of each triangle, and v across
    it. Default: the first edge of the first triangle. Raises ValueError where `warp` is perpendicular to a triangle.
    """
    corners = points[triangles]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    along = np.asarray((one[0] if len(one) else np.eye(points.shape[1])[0]) if warp is None else warp, float)
    square_1, square_2, both = (one * one).sum(axis=1), (two * two).sum(axis=1), (one * two).sum(axis=1)
    determinant = square_1 * square_2 - both**2  # 4 A^2
    # coordinates of the projected warp in the basis of the two edges
    first, second = one @ along, two @ along
    s = (square_2 * first - both * second) / determinant
    t = (square_1 * second - both * first) / determinant
    u = s[:, None] * one + t[:, None] * two
    long = np.linalg.norm(u, axis=1)
    flat = np.flatnonzero(long <= 1e-9 * np.linalg.norm(along))
    if len(flat):
        raise ValueError(f"warp = {tuple(along.tolist())}: is perpendicular to triangle {flat[0]}")
    u /= long[:, None]
    across = two - (two * u).sum(axis=1, keepdims=True) * u
    sideways = one - (one * u).sum(axis=1, keepdims=True) * u
    longer = (across**2).sum(axis=1) >= (sideways**2).sum(axis=1)
    v = np.where(longer[:, None], across, -sideways)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    flat_1, flat_2 = (np.stack([(e * u).sum(axis=1), (e * v).sum(axis=1)], axis=1) for e in (one, two))
    edges = np.stack([flat_1, flat_2], axis=2)  # columns: material coordinates of the two edges, (T, 2, 2)
    inverse = np.linalg.inv(edges)  # rows: edges, columns: u and v
    gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    return gradient, np.sqrt(determinant) / 2
