"""Solid faces: cloth and surfaces of solids that nothing passes through, themselves and each other included."""

from __future__ import annotations

import warnings
from typing import Literal

import numpy as np
from pydantic import Field

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.geometry.box_tree import DEEPEST
from flockenv.jit.section import entry
from flockenv.model.scene_view import SceneView
from flockenv.model.state import WORK, Floats, State
from flockenv.model.surface import faces_of
from flockenv.physics.constraints.constraint import Constraint, Settler
from flockenv.physics.constraints.face_contacts import Contacts, Motion, Pairs
from flockenv.physics.constraints.face_mesh import check_intersections, make_mesh, shortest_height
from flockenv.physics.constraints.face_obstacles import check_obstacles, solids_of
from flockenv.physics.constraints.face_step import FaceRules, FaceScratch, settle_faces
from flockenv.physics.constraints.face_zones import SUMS, Zones
from flockenv.physics.constraints.rigid_bodies import RigidBodies

__all__ = ["FaceCollisions"]

WHERE = tuple(
    WORK.index(name) for name in ("face_passes", "impacts", "impact_zones", "largest_zone", "stopped", "unsolved")
)
"""Columns of State.work that are counted, in the order of face_step."""

THICKEST = 1 / 3
"""Largest thickness, in smallest heights of a face: faces next to each other must not touch at rest."""


class FaceCollisions(Constraint):
    """Faces are solid: the triangles of cloth and meshes, and the surfaces of tetrahedra; 3-D.

    No point passes a face, and no edge another, of the same network or of two, along the straight lines from the start
    to the end of a step. Agents without faces are balls of their radius. Obstacles of any size are solid for faces,
    also if they move: circles, capsules, walls, blocks, meshes. Half-spaces and hollow shapes need `collisions` of
    particles, listed before; other obstacles are refused. A face with a broken edge spring is no longer solid.

    What comes nearer than `thickness` is moved apart gently, and what approaches is stopped by an inelastic impulse
    with Coulomb friction, in passes over all that touch (Bridson, Fedkiw and Anderson 2002). What `passes` do not
    resolve moves as a rigid body in this step: an impact zone. A zone that holds a pinned particle or an obstacle
    moves as that does. So, if given motions leave room, nothing intersects after a step; otherwise a warning says so.
    Momentum is conserved. Work counters: face_passes, impacts, impact_zones, largest_zone. `Scene.collision_forces`
    returns the force on each agent.

    After the impulses every contact has g >= 0 at the end of the step, g = w1 n . x1 + ... + w4 n . x4 - d: the
    distance of point and face or of two edges, less the sum d of their radii.

    Limits: contacts are inelastic: nothing bounces. Paths are straight within a step, so a fast rotation has errors.
    Impact zones are rigid, and freeze fast crumpling for a step; shorter steps or more passes help.
    """

    kind: Literal["face_collisions"] = "face_collisions"
    thickness: float | None = Field(
        default=None, gt=0, description="m, distance that is kept (default: a tenth of the smallest height of a face)"
    )
    friction: float = Field(default=0.0, ge=0, description="Coulomb's coefficient")
    obstacles: bool = Field(default=True, description="True if faces collide with obstacles")
    passes: int = Field(default=20, ge=1, le=10_000, description="most passes in a step; then impact zones")

    def check(self, scene: SceneView) -> None:
        """Raise ValueError in 2-D, on a torus, in float32, without faces, and beside `rigid_bodies`.

        Also before another constraint, for faces that intersect at the start, and for a thickness above a third of a
        face's smallest height.
        """
        what = "kind = face_collisions"
        if scene.dimension != 3:
            raise ValueError(f"{what}: dimension = {scene.dimension}: there are faces in 3 dimensions only")
        if sum(isinstance(other, FaceCollisions) for other in scene.constraints) > 1:
            raise ValueError(f"{what}: there is another; a scene has at most one")
        if any(isinstance(other, RigidBodies) for other in scene.constraints):
            raise ValueError(
                f"{what}: the blocks of rigid_bodies do not collide with faces; leave one of the two out, or make a "
                "block an obstacle, which may move"
            )
        if scene.constraints[-1] is not self:
            raise ValueError(f"{what}: {scene.constraints[-1].kind} after it would move faces; it must be the last")
        if scene.space.periodic:
            raise ValueError(f"{what}: faces do not wrap around a {scene.space.kind}; allowed: plane, box")
        if scene.dtype != "float64":
            raise ValueError(f"{what}: dtype = {scene.dtype} is too coarse for thin gaps; allowed: float64")
        if not len(faces_of(scene)):
            raise ValueError(f"{what}: no group has a network with faces: cloth, or a mesh of triangles or tetrahedra")
        self._check_shapes(scene)

    def _check_shapes(self, scene: SceneView) -> None:
        """Raise ValueError on meshes that are not sound, on obstacles that are not solid, and on intersections."""
        for k, group in enumerate(scene.groups):
            if group.network is not None:
                try:
                    group.network.check_elements(3)
                except ValueError as error:
                    raise ValueError(f"kind = face_collisions: in the network of groups[{k}] {error}") from None
        if self.obstacles:
            check_obstacles(scene, scene.constraints[:-1])
        check_intersections(scene, self.obstacles)
        most = THICKEST * shortest_height(scene)
        if self.thickness is not None and self.thickness > most:
            raise ValueError(
                f"thickness = {self.thickness:g} m: at most {most:.4g} m is allowed, a third of the smallest height of "
                "a face"
            )

    def numbers(self, scene: SceneView) -> int:
        """Return the scratch memory, in numbers per agent."""
        solids = solids_of(scene.obstacles if self.obstacles else ())
        more = 120 * (len(faces_of(scene)) + len(solids.faces)) + (40 + SUMS) * len(solids.place)
        return 40 + SUMS + -(-more // int(scene.agents))

    def settler(self, scene: SceneView) -> Settler:
        """Return a function that corrects a step, with scratch memory of its own."""
        return _FaceSettler(self, scene)


class _FaceSettler:
    """Correction of the steps of one scene, with scratch memory of its own."""

    def __init__(self, record: FaceCollisions, scene: SceneView) -> None:
        self.record, self.warned = record, False
        self.mesh = make_mesh(scene, record.obstacles)
        thickness = record.thickness or 0.1 * shortest_height(scene)
        self.rules = FaceRules(float(thickness), float(record.friction), record.passes, float(scene.dt))
        self.circles = len(scene.circles) if record.obstacles else 0
        v = len(self.mesh.light)
        self.motion = Motion(*(np.zeros((v, 3)) for _ in range(3)), *(np.zeros(v, np.int64) for _ in range(3)))
        self.zones = Zones(
            parent=np.zeros(v, np.int64), size=np.zeros(v, np.int64), still=np.zeros(v, np.int64),
            held=np.zeros(v, np.int64), before=np.zeros((v, 3)), speed=np.zeros((v, 3)), sums=np.zeros((v, SUMS)),
        )  # fmt: skip
        self.where, self.report = np.array(WHERE, np.int64), np.zeros(5, np.int64)
        self._make_room(4 * len(self.mesh.edges) + 64)

    def _make_room(self, places: int) -> None:
        """Allocate room for `places` pairs and contacts."""
        most = max(len(self.mesh.edge_tree.order), len(self.mesh.face_tree.order))
        pairs = Pairs(
            np.zeros((places, 4), np.int32), np.zeros(places, np.int32), np.zeros(DEEPEST, np.int64),
            np.zeros(most, np.int32), np.zeros((2, 3)),
        )  # fmt: skip
        contacts = Contacts(
            np.zeros((places, 4), np.int32), np.zeros((places, 4)), np.zeros((places, 3)), np.zeros(places),
            np.zeros(places, np.int64),
        )  # fmt: skip
        self.scratch = FaceScratch(self.motion, pairs, contacts, self.zones, np.zeros(len(WHERE), np.int64))

    def __call__(self, x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
        """Correct the steps of worlds [first, end); return the first (world, agent) that is not finite, or (-1, -1)."""
        bad, stopped, unsolved, m = (-1, -1), 0, 0, self.circles
        while first < end:
            short = entry(settle_faces)(
                x0, state.x, state.v, state.alive, np.ascontiguousarray(state.obstacle_x[:, :, :m]),
                np.ascontiguousarray(state.obstacle_radius[:, :m]), state.tick, state.bonds, self.mesh, self.scratch,
                self.rules, state.work, self.where, first, end, self.report,
            )  # fmt: skip
            world, agent, needed, *lost = (int(k) for k in self.report)
            stopped, unsolved = stopped + lost[0], unsolved + lost[1]
            bad = (world, agent) if bad[0] < 0 else bad
            if short < 0:
                break
            first = short
            self._make_room(2 * needed)
        if (stopped or unsolved) and not self.warned:
            self.warned = True
            warnings.warn(self._warning_text(stopped, unsolved), UnsolvedContactsWarning, stacklevel=2)
        return bad

    def _warning_text(self, stopped: int, unsolved: int) -> str:
        text = f"constraints: face_collisions: in a step, after passes = {self.record.passes}"
        if stopped:
            text += f", {stopped} particles in impact zones that touch an obstacle, a pin or themselves stood still"
            text += " or moved with it"
        if unsolved:
            text += (
                f"{' and' if stopped else ','} {unsolved} pairs of faces and points, or edges, touched from its start"
            )
        return text + "; shorter steps or more passes help"
