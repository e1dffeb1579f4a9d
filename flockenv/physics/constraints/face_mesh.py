"""What face_collisions lets collide: the points, edges and faces of a scene, and checks of them at the start."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.box_tree import BoxTree, build_tree
from flockenv.geometry.mesh_checks import first_piercing
from flockenv.model.network import element_edges, keys_of, pairs_of
from flockenv.model.scene_view import SceneView
from flockenv.model.surface import faces_of
from flockenv.physics.constraints.face_obstacles import MOTION, Solids, depths_in, solids_of

__all__ = ["FaceMesh", "check_intersections", "edges_of", "make_mesh", "shortest_height"]

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]

SHALLOW = 1e-9
"""A face may begin this deep in an obstacle, by rounding; as a share of the largest coordinate."""


class FaceMesh(NamedTuple):
    """V vertices: N agents, then M round obstacles of the state, then those of other obstacles; and what they span."""

    faces: Any  # (F, 3)
    edges: Any  # (E, 2)
    points: Any  # (P,) vertices that are tested against faces
    face_tree: BoxTree
    edge_tree: BoxTree
    light: Any  # (V,) 1/kg; 0 for obstacles, and particles that are held in place
    radius: Any  # (V,) m; 0 for the vertices of faces
    place: Any  # (V, 3) m, of the vertices of obstacles that are not in the state; the others are 0
    motion: Any  # (V, MOTION) of the same vertices; the others are 0
    sides: Any  # (F', 3) the edges of each face of a network; these faces, and their E' edges, come first
    bond: Any  # (E',) the spring of an edge of a network, as State.bonds counts them; -1 if there is none
    whole_faces: Any  # (F,) 1, or 0 if an edge is broken
    whole_edges: Any  # (E,) 1, or 0 if no face of it is whole


def edges_of(faces: Ints) -> Ints:
    """Return the edges of triangles, each once, (E, 2)."""
    size = int(faces.max(initial=0)) + 1
    return pairs_of(element_edges(faces, size), size)


def rest_of(scene: SceneView) -> Floats:
    """Return the initial positions of the particles of networks, (N, 3) m; 0 for other agents."""
    place = np.zeros((scene.agents, 3))
    for group, first in zip(scene.groups, scene.starts, strict=False):
        if group.network is not None:
            place[first : first + group.size] = group.network.points(3)
    return place


def shortest_height(scene: SceneView) -> float:
    """Return the smallest height of a face of a network at the start, m."""
    a, b, c = rest_of(scene)[faces_of(scene)].transpose(1, 0, 2)
    longest = np.maximum.reduce([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))])
    return float((np.linalg.norm(np.cross(b - a, c - a), axis=1) / longest).min())


def make_mesh(scene: SceneView, obstacles: bool) -> FaceMesh:
    """Return all that may collide in a scene."""
    solids = solids_of(scene.obstacles if obstacles else ())
    n, m = scene.agents, len(scene.circles) if obstacles else 0
    faces, edges, place = _with_solids(scene, solids, n + m)
    radius = np.concatenate([np.asarray(scene.body.radius, float), np.zeros(m), solids.radius])
    radius[np.unique(faces_of(scene))] = 0.0
    light = np.zeros(len(place))
    light[:n] = np.where(np.isfinite(scene.body.mass), 1 / np.asarray(scene.body.mass, float), 0.0)
    corners = np.zeros(n, bool)
    corners[_inner_corners(scene)] = True
    points = np.concatenate([np.flatnonzero(~corners), np.arange(n, len(place))])
    trees = build_tree(place[faces].mean(axis=1)), build_tree(place[edges].mean(axis=1))
    motion = np.concatenate([np.zeros((n + m, MOTION)), solids.motion])
    whole = np.ones(len(faces), np.int8), np.ones(len(edges), np.int8)
    return FaceMesh(faces, edges, points.astype(np.int32), *trees, light, radius, place, motion, *_bonds(scene), *whole)


def _bonds(scene: SceneView) -> tuple[Ints, Ints]:
    """Return the edges of each face, (F', 3), and the spring of each edge, (E',), or -1, of networks."""
    faces, n = faces_of(scene), scene.agents
    own = keys_of(edges_of(faces), n)
    sides = [np.searchsorted(own, keys_of(faces[:, pair], n)) for pair in ([0, 1], [1, 2], [2, 0])]
    drawn = keys_of(scene.edges, n)
    order = np.argsort(drawn)
    at = np.minimum(np.searchsorted(drawn[order], own), max(len(drawn) - 1, 0))
    found = drawn[order][at] == own if len(drawn) else np.zeros(len(own), bool)
    springs = scene.edge_springs[order][at] if len(drawn) else np.zeros(len(own))
    return np.stack(sides, axis=1).astype(np.int32), np.where(found, springs, -1).astype(np.int32)


def _with_solids(scene: SceneView, solids: Solids, first: int) -> tuple[Ints, Ints, Floats]:
    """Return the faces, the edges and the positions of networks and of solids, whose first vertex is `first`."""
    faces, place = faces_of(scene), rest_of(scene)
    between = np.zeros((first - scene.agents, 3))
    return (
        np.concatenate([faces, solids.faces + np.int32(first)]),
        np.concatenate([edges_of(faces), solids.edges + np.int32(first)]),
        np.concatenate([place, between, solids.place]),
    )


def _inner_corners(scene: SceneView) -> NDArray[np.int64]:
    """Return the particles of networks that have faces, without being a corner of one: inside of tetrahedra."""
    inner = []
    used = np.unique(faces_of(scene))
    for group, first in zip(scene.groups, scene.starts, strict=False):
        own = np.arange(first, first + group.size)
        if group.network is not None and np.isin(own, used).any():
            inner.append(np.setdiff1d(own, used))
    return np.concatenate([np.zeros(0, np.int64), *inner])


def check_intersections(scene: SceneView, obstacles: bool) -> None:
    """Raise ValueError if an edge passes through a face at the start, or a particle or a face lies in an obstacle."""
    solids, n = solids_of(scene.obstacles if obstacles else ()), scene.agents
    faces, edges, place = _with_solids(scene, solids._replace(place=solids.start), n)
    found = first_piercing(place, edges, faces, n)

    def name(what: str, particles: Ints) -> str:
        if particles[0] >= n:
            return f"obstacles[{solids.owner[particles[0] - n]}]"
        *most, last = particles.tolist()
        return f"the {what} {', '.join(map(str, most))} and {last}"

    if found is not None:
        raise ValueError(
            f"kind = face_collisions: at the start {name('edge between particles', edges[found[0]])} passes through "
            f"{name('face of', faces[found[1]])}; meshes must not intersect"
        )
    for k in np.unique(solids.owner[solids.faces[:, 0]]):
        shape = scene.obstacles[k]
        surely = -getattr(shape, "grid_spacing", 0.0)  # m; distances to a mesh are not exact
        inside = shape.gap(rest_of(scene) - shape.shift(0.0)) < surely
        for i in np.intersect1d(np.flatnonzero(inside), faces_of(scene)):
            raise ValueError(f"kind = face_collisions: at the start particle {i} is inside obstacles[{k}]")
    if obstacles:
        _refuse_faces_in_round_obstacles(scene)


def _refuse_faces_in_round_obstacles(scene: SceneView) -> None:
    """Raise ValueError if a face is nearer to the core of a circle, capsule or wall than the radius, at the start."""
    faces, points = faces_of(scene), rest_of(scene)
    shallow = SHALLOW * max(1.0, float(np.abs(points).max(initial=0.0)))
    for k, shape in enumerate(scene.obstacles):
        depths = depths_in(shape, points, faces)
        if depths.max(initial=0.0) > shallow:
            deepest = int(depths.argmax())
            a, b, c = faces[deepest].tolist()
            raise ValueError(
                f"kind = face_collisions: at the start the face of {a}, {b} and {c} is {depths[deepest]:.4g} m inside "
                f"obstacles[{k}] = {shape.kind}; faces must begin outside of obstacles"
            )
