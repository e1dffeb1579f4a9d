"""Obstacles that faces collide with: their points, edges and faces, and how they move."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.closest_points import closest_point_face, closest_segments, weighted
from flockenv.geometry.shapes import Block, Capsule, Circle, HalfSpace, Shape, TriangleMesh, Wall
from flockenv.jit.decorators import Vec, kernel
from flockenv.jit.section import entry
from flockenv.maths.vectors import dot
from flockenv.model.network import element_edges, pairs_of
from flockenv.model.scene_view import SceneView
from flockenv.physics.constraints.collisions import Collisions

__all__ = ["MOTION", "Solids", "check_obstacles", "depths_in", "solids_of"]

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]

MOTION = 8
"""Numbers of the motion of a vertex, in the order of Shape.motion in 3-D."""

SIDES = (1, 2, 4)
"""Bits of a corner's number: on which side of a block it is along each axis."""


class Solids(NamedTuple):
    """K vertices of obstacles that are not part of the state, and what they span."""

    place: Floats  # (K, 3) m, by the fields of the obstacle
    edges: Ints  # (E, 2)
    faces: Ints  # (F, 3)
    radius: Floats  # (K,) m
    motion: Floats  # (K, MOTION)
    owner: Ints  # (K,) number of the obstacle in the scene

    @property
    def start(self) -> Floats:
        """Positions at time 0, (K, 3) m."""
        return self.place + self.motion[:, 3:6] * np.sin(self.motion[:, 7:])


def solids_of(obstacles: Sequence[Shape]) -> Solids:
    """Return all obstacles that faces collide with, but those in the state."""
    found = [(k, shape, *_spanned(shape)) for k, shape in enumerate(obstacles) if not shape.in_state and _solid(shape)]
    counts = [len(corners) for _, _, corners, _, _ in found]
    first = [0, *itertools.accumulate(counts)]
    pairs = [edge + before for (_, _, _, edge, _), before in zip(found, first, strict=False)]
    faces = [face + before for (_, _, _, _, face), before in zip(found, first, strict=False)]

    def per_vertex(values: list[Any], width: tuple[int, ...]) -> Floats:
        return np.repeat(np.array(values, float).reshape(len(found), *width), counts, axis=0)

    return Solids(
        place=np.concatenate([np.zeros((0, 3)), *(corners for _, _, corners, _, _ in found)]),
        edges=np.concatenate([np.zeros((0, 2), np.int32), *pairs]).astype(np.int32),
        faces=np.concatenate([np.zeros((0, 3), np.int32), *faces]).astype(np.int32),
        radius=per_vertex([getattr(shape, "radius", 0.0) for _, shape, *_ in found], ()),
        motion=per_vertex([shape.motion for _, shape, *_ in found], (MOTION,)),
        owner=per_vertex([k for k, *_ in found], ()).astype(np.int32),
    )


def _solid(shape: Shape) -> bool:
    """Return True if faces collide with a shape."""
    return isinstance(shape, Circle | Capsule | Wall | Block | TriangleMesh) and not shape.is_hollow


def _spanned(shape: Shape) -> tuple[Floats, Ints, Ints]:
    """Return the vertices of a shape, (K, 3) m, its edges and its faces."""
    none = np.zeros((0, 3), np.int32)
    if isinstance(shape, Block):
        edges = [(c, c | bit) for c in range(8) for bit in SIDES if not c & bit]
        squares = [(c, c | u, c | u | v, c | v) for u, v in ((1, 2), (1, 4), (2, 4)) for c in (0, 7 - u - v)]
        faces = [(a, b, c) for a, *rest in squares for b, c in itertools.pairwise(rest)]
        return shape.extremes, np.array(edges, np.int32), np.array(faces, np.int32)
    if isinstance(shape, TriangleMesh):
        used, number = np.unique(shape.triangles, return_inverse=True)
        rows: Ints = np.asarray(number.reshape(-1, 3), np.int32)
        return np.array(shape.vertices)[used], pairs_of(element_edges(rows, len(used)), len(used)), rows
    if isinstance(shape, Wall):
        points = np.array(shape.vertices)
    else:
        points = np.array([shape.start, shape.end] if isinstance(shape, Capsule) else [shape.anchor])
    along = np.arange(len(points), dtype=np.int32)
    return points, np.stack([along[:-1], along[1:]], axis=1), none


def depths_in(shape: Shape, points: Floats, faces: Ints) -> Floats:
    """Return how deep each face, (F, 3) of points (n, 3) m, is inside a circle, capsule or wall at time 0, (F,) m.

    0 outside, and in other shapes.
    """
    if not isinstance(shape, Circle | Capsule | Wall) or shape.is_hollow:
        return np.zeros(len(faces))
    core, pairs, _ = _spanned(shape)
    distances = np.empty(len(faces))
    entry(_write_distances)(points[faces] - shape.shift(0.0), core, core[pairs], distances)
    return np.asarray(np.maximum(shape.radius - distances, 0.0))


@kernel
def _point(rows: Any, r: int, k: int) -> Vec:
    """Return rows[r, k] as a vector."""
    return (rows[r, k, 0], rows[r, k, 1], rows[r, k, 2])


@kernel
def _write_distances(corners: Any, core: Any, parts: Any, out: Any) -> None:
    """Write the distance of each face, (F, 3, 3), to the nearest of points (K, 3) and segments (S, 2, 3), m.

    Of a face and a segment that do not meet, two edges are nearest, or an end of the segment.
    """
    for f in range(out.shape[0]):
        a, b, c = _point(corners, f, 0), _point(corners, f, 1), _point(corners, f, 2)
        least = np.inf
        for k in range(core.shape[0]):
            p = (core[k, 0], core[k, 1], core[k, 2])
            apart = weighted(closest_point_face(p, a, b, c), p, a, b, c)
            least = min(least, dot(apart, apart))
        for s in range(parts.shape[0]):
            q, r = _point(parts, s, 0), _point(parts, s, 1)
            for one, two in ((a, b), (b, c), (c, a)):
                off = weighted(closest_segments(q, r, one, two), q, r, one, two)
                least = min(least, dot(off, off))
        out[f] = np.sqrt(least)


def check_obstacles(scene: SceneView, before: Sequence[Any]) -> None:
    """Raise ValueError on an obstacle that faces would go through; before: the constraints listed earlier.

    What leaves a convex region free is solid for faces if it is for their particles.
    """
    particles = any(isinstance(other, Collisions) and other.obstacles for other in before)
    for k, shape in enumerate(scene.obstacles):
        if _solid(shape):
            continue
        what = f"kind = face_collisions: obstacles[{k}] = {'hollow ' if shape.is_hollow else ''}{shape.kind}"
        if not isinstance(shape, HalfSpace | Circle | Capsule | Block):
            raise ValueError(
                f"{what}: faces would go through it; allowed: circles, capsules, walls, blocks, meshes and "
                "half-spaces; obstacles = False turns collisions of faces with all of them off"
            )
        if not particles:
            raise ValueError(f"{what}: only particles collide with it, by collisions, which must be listed before")
