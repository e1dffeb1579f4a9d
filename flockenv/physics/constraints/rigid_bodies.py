"""Rigid bodies that spin: blocks with inertia, contacts with friction and restitution, and the forces of contacts."""

from __future__ import annotations

import warnings
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.geometry.shapes import Block, HalfSpace, Shape
from flockenv.geometry.space import Box
from flockenv.jit.section import entry
from flockenv.model.blocks import CORNERS, Blocks
from flockenv.model.scene_view import SceneView
from flockenv.model.state import WORK, Floats, State
from flockenv.physics.constraints.constraint import Constraint, Settler
from flockenv.physics.constraints.rigid_contacts import Contacts, Past
from flockenv.physics.constraints.rigid_motion import Solids
from flockenv.physics.constraints.rigid_solver import PAST
from flockenv.physics.constraints.rigid_step import Around, BodyRules, settle_bodies

__all__ = ["BodyContacts", "RigidBodies"]

WHERE = tuple(WORK.index(name) for name in ("impacts", "unsolved"))
"""Columns of State.work that are counted: contacts of steps, and steps that were not solved."""

PER_CONTACT, PER_SOLID = 73 + 6 * PAST, 60
"""Numbers of scratch memory for a contact, and for a block or the ground."""

THICK = 10.0
"""Half thickness of blocks in 2-D, in largest edges: no contact is along z."""


class BodyContacts(NamedTuple):
    """Contacts of rigid bodies in a step, C of them; those that exert no force included."""

    body: NDArray[np.int64]  # (C,) number of the body, over all groups of blocks in order
    other: NDArray[np.int64]  # (C,) number of the other body; -1 = an obstacle or a wall
    point: Floats  # (C, D) m
    normal: Floats  # (C, D) unit vector away from the other body
    force: Floats  # (C, D) N, on `body`: impulse over dt; -force acts on the other


class RigidBodies(Constraint):
    """The blocks of all groups with a network of `blocks` are rigid, solid, and spin; 2-D and 3-D.

    Forces on particles act on their block, whose momentum and angular momentum they change. A block that nothing
    touches keeps its momentum, angular momentum and energy to rounding. Blocks collide with each other, with blocks,
    half-spaces and round obstacles that stand still, and with the walls of a box, whose restitution is the space's.
    Restitution is the normal speed after an impact over that before; friction is Coulomb's cone.

    All contacts of a step are solved together by sweeps over them, extrapolated from sweep to sweep, until they hardly
    change. `Scene.contacts` returns their forces. Work counters: impacts (contacts of steps), unsolved.

    m dv/dt = F, dL/dt = T, L = J w: momentum, angular momentum L of a body with inertia J and angular velocity w (Euler
    1758; rotation: Austin, Krishnaprasad and Wang 1993). Contacts: projected Gauss-Seidel (Catto 2006) with Anderson's
    extrapolation (Walker and Ni 2011).

    Limits: contacts are found for motions along straight lines from the start of a step, so a block should not move
    further than its half edge in a step. Other agents, headings and speed limits are not considered, and no block
    breaks or deforms.
    """

    kind: Literal["rigid_bodies"] = "rigid_bodies"
    restitution: float = Field(default=0.0, ge=0, le=1, description="e: 0 = no bounce, 1 = no speed is lost")
    friction: float = Field(default=0.5, ge=0, description="Coulomb's coefficient")
    sweeps: int = Field(default=300, ge=1, le=1_000_000, description="most sweeps over all contacts; then a warning")

    def check(self, scene: SceneView) -> None:
        """Raise ValueError on a torus, in float32, without blocks, with a population, and before another constraint.

        Also in a box with agents that are no blocks, and for obstacles other than circles, blocks and half-spaces that
        stand still.
        """
        what = "kind = rigid_bodies"
        if sum(isinstance(other, RigidBodies) for other in scene.constraints) > 1:
            raise ValueError(f"{what}: there is another; a scene has at most one")
        if scene.constraints[-1] is not self and scene.constraints[-1].kind != "face_collisions":  # which refuses it
            raise ValueError(f"{what}: {scene.constraints[-1].kind} after it would deform blocks; it must be the last")
        if scene.space.periodic:
            raise ValueError(f"{what}: blocks do not wrap around a {scene.space.kind}; allowed: plane, box")
        if scene.dtype != "float64":
            raise ValueError(f"{what}: dtype = {scene.dtype} is too coarse for blocks at rest; allowed: float64")
        if scene.population:
            raise ValueError(f"{what}: population = {scene.population[0].kind}: particles of blocks all live")
        of_blocks = [isinstance(group.network, Blocks) for group in scene.groups]
        if not any(of_blocks):
            raise ValueError(f"{what}: no group has a network of blocks")
        if isinstance(scene.space, Box) and not all(of_blocks):
            raise ValueError(
                f"{what}: space = box: its walls are those of blocks only, but groups[{of_blocks.index(False)}] has "
                "none; a plane with half-spaces as obstacles has walls for both"
            )
        for k, shape in enumerate(scene.obstacles):
            if not (getattr(shape, "in_state", False) or (isinstance(shape, Block | HalfSpace) and _stands(shape))):
                raise ValueError(
                    f"{what}: obstacles[{k}] = {shape.kind} is none that blocks collide with; allowed: blocks, "
                    "half-spaces and circles that stand still and are not hollow"
                )

    def numbers(self, scene: SceneView) -> int:
        """Return the memory of contacts and bodies, in numbers per agent."""
        bodies = sum(len(group.network.centres) for group in scene.groups if isinstance(group.network, Blocks))
        solids = bodies + sum(isinstance(shape, Block) for shape in scene.obstacles) + 1
        return -(-(_places(bodies) * PER_CONTACT + solids * PER_SOLID) // int(scene.agents))

    def settler(self, scene: SceneView) -> Settler:
        """Return a function that corrects a step, with scratch memory of its own."""
        return BodySettler(self, scene)


def _places(bodies: int) -> int:
    """Return the number of contacts for which there is room at first."""
    return 16 * bodies + 16


def _stands(shape: Shape) -> bool:
    """Return True if an obstacle does not move, and is solid inside."""
    return not shape.moves and not getattr(shape, "hollow", False)


class BodySettler:
    """Correction of the steps of one scene; its scratch memory holds the contacts of the last one."""

    def __init__(self, record: RigidBodies, scene: SceneView) -> None:
        self.record, self.dimension, self.warned = record, scene.dimension, False
        self.solids, self.around = _solids_of(scene), _planes_of(scene, record.restitution)
        self.rules = BodyRules(float(record.restitution), float(record.friction), record.sweeps, float(scene.dt))
        self.where, self.report, self.lost = np.array(WHERE, np.int64), np.zeros(5, np.int64), np.zeros(2)
        self._make_room(_places(len(self.solids.first)))

    def _make_room(self, places: int) -> None:
        """Allocate room for `places` contacts."""
        past = Past(
            result=np.zeros((places, 3)), step=np.zeros((places, 3)), results=np.zeros((PAST, places, 3)),
            steps=np.zeros((PAST, places, 3)), products=np.zeros((PAST, PAST)), factor=np.zeros((PAST, PAST)),
            share=np.zeros(PAST), jump=np.zeros((places, 3)),
        )  # fmt: skip
        self.contacts = Contacts(
            body=np.zeros((places, 2), np.int64), point=np.zeros((places, 3)), way=np.zeros((places, 3, 3)),
            arm=np.zeros((2, places, 3, 3)), answer=np.zeros((2, places, 3, 3)), gap=np.zeros(places),
            bounce=np.zeros(places), aim=np.zeros(places), ease=np.zeros((places, 2)),
            impulse=np.zeros((2, places, 3)), step=np.zeros((places, 3)), past=past, clip=np.zeros((2, 16, 3)),
        )  # fmt: skip

    def __call__(self, x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
        """Correct the steps of worlds [first, end); return the first (world, agent) that is not finite, or (-1, -1)."""
        bad, unsolved, lost = (-1, -1), 0, np.zeros(2)
        while first < end:
            short = entry(settle_bodies)(
                x0, v0, state.x, state.v, state.obstacle_x, state.obstacle_radius, self.solids, self.contacts,
                self.around, self.rules, state.work, self.where, first, end, self.report, self.lost,
            )  # fmt: skip
            bad = (int(self.report[1]), int(self.report[2])) if bad[0] < 0 else bad
            unsolved, lost = unsolved + int(self.report[4]), np.maximum(lost, self.lost)
            if short < 0:
                break
            first = short
            self._make_room(2 * int(self.report[3]))
        if unsolved and not self.warned:
            self.warned = True
            warnings.warn(
                f"constraints: rigid_bodies: in a step, after sweeps = {self.record.sweeps} the last one still changed "
                f"speeds by {lost[0]:.2g} m/s, and the deepest overlap is {lost[1]:.2g} of the distance from a centre "
                "to a corner; more sweeps or shorter steps help",
                UnsolvedContactsWarning,
                stacklevel=2,
            )
        return bad

    def found(self) -> BodyContacts:
        """Return the contacts of the world that was corrected last."""
        c, d, bodies = self.contacts, self.dimension, len(self.solids.first)
        count = int(self.report[3])
        force = np.einsum("ck,ckd->cd", c.impulse[1, :count], c.way[:count]) / self.rules.dt
        other = np.where(c.body[:count, 1] < bodies, c.body[:count, 1], -1)
        return BodyContacts(
            c.body[:count, 0].copy(), other, c.point[:count, :d].copy(), c.way[:count, 0, :d].copy(), force[:, :d]
        )


def _solids_of(scene: SceneView) -> Solids:
    """Return the blocks of a scene, those that move first, with room for their motion."""
    d = scene.dimension
    sizes: list[Any] = []
    first: list[int] = []
    masses: list[float] = []
    for group, start in zip(scene.groups, scene.starts, strict=False):
        if isinstance(group.network, Blocks):
            first += range(start, start + group.size, group.network.each)
            sizes += [group.network.sides] * len(group.network.centres)
            masses += [float(group.mass) * group.network.each] * len(group.network.centres)  # type: ignore[arg-type]
    still = [shape for shape in scene.obstacles if isinstance(shape, Block)]
    bodies, n = len(first), len(first) + len(still) + 1
    half, light, axes = np.zeros((n, 3)), np.zeros(n), np.tile(np.eye(3), (n, 1, 1))
    half[: n - 1, :d] = 0.5 * np.array([*sizes, *(shape.size for shape in still)])
    light[:bodies] = 1 / np.array(masses)
    reach, centre = np.linalg.norm(half, axis=1), np.zeros((n, 3))
    reach[-1] = np.inf
    for k, shape in enumerate(still, bodies):
        centre[k, :d], axes[k, :d, :d] = shape.centre, shape.axes
    if d == 2:
        half[:, 2] = 2 * THICK * half.max()
    square, turning = half**2, np.zeros((n, 3))
    for k in range(3) if d == 3 else (2,):
        around = square[:bodies, (k + 1) % 3] + square[:bodies, (k + 2) % 3]
        turning[:bodies, k] = 3 * light[:bodies] / around
    signs = np.array([[1.0 if c >> k & 1 else -1.0 for k in range(3)] for c in range(8)])

    def zeros(*shape: int) -> Floats:
        return np.zeros((*shape, n, 3))

    return Solids(
        first=np.array(first, np.int64), corner=signs, half=half, reach=reach, light=light, turning=turning,
        share=np.array([CORNERS / 2**d, 1 - CORNERS]), centre=centre, axes=axes, before=zeros(2), free=zeros(2),
        speed=zeros(2), moved=zeros(), turn=zeros(), twist=zeros(), shift=zeros(2), push=zeros(2),
        touched=np.zeros(n, np.int64),
    )  # fmt: skip


def _planes_of(scene: SceneView, restitution: float) -> Around:
    """Return half-spaces, and the walls of a box."""
    d, planes = scene.dimension, list[tuple[Any, Any, float]]()
    planes += [(s.point, s.row(d), restitution) for s in scene.obstacles if isinstance(s, HalfSpace)]
    if isinstance(scene.space, Box):
        for axis in np.eye(d):
            planes += [(0 * axis, axis, scene.space.restitution)]
            planes += [(np.array(scene.space.size) * axis, -axis, scene.space.restitution)]
    point, normal = np.zeros((len(planes), 3)), np.zeros((len(planes), 3))
    for k, plane in enumerate(planes):
        point[k, :d], normal[k, :d] = plane[0], plane[1]
    return Around(point, normal, np.array([plane[2] for plane in planes], float))
