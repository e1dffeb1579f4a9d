"""The surface of a scene's networks: the triangles that can be drawn, and that face_collisions lets collide."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flockenv.model.scene_view import SceneView

__all__ = ["faces_of", "whole_faces"]

Ints = NDArray[np.int32]


def faces_of(scene: SceneView) -> Ints:
    """Return the triangles of all networks and the outer ones of tetrahedra, (F, 3), by number of agent."""
    found = [np.zeros((0, 3), np.int32)]
    for group, first in zip(scene.groups, scene.starts, strict=False):
        elements = np.zeros((0, 2), np.int32) if group.network is None else group.network.elements(scene.dimension)
        if elements.shape[1] == 4:
            elements = _outer_sides(elements)
        if elements.shape[1] == 3:
            found.append(elements + np.int32(first))
    return np.concatenate(found)


def _outer_sides(elements: Ints) -> Ints:
    """Return the triangles that belong to one tetrahedron only."""
    sides = elements[:, [(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    return np.asarray(sides[np.sort(first[count == 1])])


def whole_faces(faces: Ints, broken: Ints) -> Ints:
    """Return the triangles (F', 3) that have none of the broken edges (E, 2)."""
    if not len(broken) or not len(faces):
        return faces
    size = 1 + int(max(faces.max(), broken.max()))

    def keys(ends: Ints) -> NDArray[np.int64]:
        low, high = np.sort(ends, axis=1).astype(np.int64).T
        return np.asarray(low * size + high)

    torn = [np.isin(keys(faces[:, list(side)]), keys(broken)) for side in ((0, 1), (1, 2), (2, 0))]
    return np.asarray(faces[~np.logical_or.reduce(torn)])
