"""Collisions of bodies with obstacles, walls and each other."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.geometry.cell_list import MAX_RANGES
from flockenv.geometry.shapes import HalfSpace, pack_shapes
from flockenv.geometry.shapes.cells import FEWEST_ROWS, cells_of
from flockenv.geometry.space import Box, Torus
from flockenv.jit.section import entry
from flockenv.model.scene_view import SceneView
from flockenv.model.state import WORK, Floats, State
from flockenv.physics.constraints.bodies import Bodies, Meetings, Rules, Things
from flockenv.physics.constraints.collision_step import COUNTED, LOST, collide
from flockenv.physics.constraints.constraint import Constraint, Settler
from flockenv.physics.constraints.contacts import Contacts, Ends
from flockenv.physics.constraints.impact import POINT
from flockenv.physics.constraints.step_end import LEFT, RAISED, SUNK
from flockenv.physics.constraints.touching import Touching, find_touching
from flockenv.physics.effects.effect import separation_directions

__all__ = ["Collisions", "Finder"]

Finder = Callable[[State, Floats, Floats, Floats, float, float, Touching], None]
"""find(state, x, v, flow, begun, seconds, touching): write the contacts of a single world, as `find_touching` does."""


TOUCH = 1e-12
"""m, gap at and below which two bodies touch, but for the rounding of their positions."""


class Collisions(Constraint):
    """Collisions of solid bodies, discs or balls, with obstacles, the walls of a box, and each other.

    The time of an impact within a step is computed on a parabola through the method's step, which is exact under
    constant forces, for bodies of any speed. The responses:

    - "earliest": the earliest impact of all is resolved, both bodies continue from there, their further paths are
      searched anew, and so on; nothing is missed, and an elastic ball keeps its energy.
    - "back_up": the same with at most 30 impacts of the same two bodies in a step, whatever `most` is.
    - "impulses": at the end of a step all bodies in touch exchange impulses, in passes, until none approach each other.
      For heaps and crowds. A body whose path is blocked stops there, and has its impact in the next step.
    - "project": one such pass, and a body inside another or an obstacle is put on the surface. The cheapest; it loses
      energy at every impact, friction holds no body in place, and bodies that overlap are moved apart even against
      gravity.

    No body passes another. Beyond the limit of impacts in a step, the two bodies stop: they keep their velocities and
    do not move for the rest of the step, and bodies that run into them also stop. So time is lost, but neither energy
    nor momentum; "stopped" counts such bodies, and a warning gives the time. Two that approach more slowly than the
    velocity added by the step's acceleration come to rest instead; the warning gives the energy lost.

    All responses end with passes over near bodies, so that none overlap. Restitution e is the normal speed after an
    impact over that before; friction is Coulomb's. A ball dropped from h bounces to e^2 h, and is at rest after
    sqrt(2 h / g) (1 + e) / (1 - e); a body sticks on an incline up to tan(angle) = friction. Bodies do not spin.
    `Scene.collision_forces` returns the force on each agent.

    An impact changes the velocity relative to the surface to u' = u - (1 + e) (u . n) n, less the friction. Impacts in
    the order of time: Alder and Wainwright 1959; impulses: Guendelman, Bridson and Fedkiw 2003, in passes accelerated
    as in Silcowitz, Niebe and Erleben 2010.

    Limits: bodies are discs or balls that do not spin. It acts after the method, so forces do not see the impacts
    within a step. Heaps need many `passes`, and rows of bodies in touch many impacts; if there are more than allowed, a
    warning counts the contacts that are left.
    """

    kind: Literal["collisions"] = "collisions"
    response: Literal["earliest", "back_up", "impulses", "project"] = Field(
        default="earliest", description="method by which impacts are resolved"
    )
    agents: bool = Field(default=True, description="True if bodies hit each other")
    obstacles: bool = Field(default=True, description="True if they hit obstacles, and the walls of a box")
    restitution: float = Field(default=0.5, ge=0, le=1, description="e: 0 = soft, 1 = elastic")
    friction: float = Field(default=0.0, ge=0, description="Coulomb's coefficient, along surfaces")
    sticky: bool = Field(default=False, description="True if bodies that touch stay together (glue)")
    most: int = Field(default=100, ge=1, description="impacts of the same pair in one step; then both stop")
    passes: int = Field(default=200, ge=1, description="passes over all contacts at the end of a step")
    part_speed: float | None = Field(
        default=None, gt=0, description="m/s, speed at which overlapping bodies are moved apart (default: at once)"
    )
    capacity: ClassVar[int] = 4
    """Initial capacity, in meetings per agent."""
    again: ClassVar[int] = 30
    """Limit of impacts of the same two bodies in one step under `back_up`."""

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the scene has two such constraints, or bodies too wide for a periodic box."""
        if sum(isinstance(other, Collisions) for other in scene.constraints) > 1:
            raise ValueError("kind = collisions: there is another; a scene has at most one")
        widest = max(group.widest for group in scene.groups)
        if isinstance(scene.space, Torus) and 4 * widest > min(scene.space.extent(scene.dimension)):
            raise ValueError(
                f"kind = collisions: bodies of radius {widest:g} m meet their own images on a torus of size "
                f"{scene.space.extent(scene.dimension)}; at most a quarter of its shortest edge is allowed"
            )

    def calls_for(self) -> tuple[str, ...]:
        """Return the names of the neighbour query and of obstacles, if they are used."""
        needs = ("neighbour query", self.agents), ("obstacles", self.obstacles)
        return tuple(what for what, needed in needs if needed)

    def numbers(self, scene: SceneView) -> int:
        """Return the memory of bodies, ends and meetings, in numbers per agent; twice if the method solves contacts."""
        once = int(8 * scene.dimension + 12 + self.capacity * (14 + 4 * scene.dimension))
        return 2 * once if scene.integrator.linearises else once

    def settler(self, scene: SceneView) -> Settler:
        """Return a function that corrects a step."""
        return _Settler(self, scene)

    def finder(self, scene: SceneView) -> Finder | None:
        """Return a function that finds the contacts with obstacles at the beginning of a step; None without any.

        scene: that has this constraint.
        """
        settler = _Settler(self, scene)
        return settler.find if len(settler.things.row) else None


class _Settler:
    """Correction of the steps of one scene, with scratch memory of its own."""

    def __init__(self, record: Collisions, scene: SceneView) -> None:
        n, d = scene.agents, scene.dimension
        self.record, self.scene, self.warned = record, scene, False
        self.period = (
            tuple(float(s) for s in scene.space.extent(scene.dimension)) if scene.space.periodic else (0.0,) * d
        )
        start, at, vel, acc, free, excess = (np.zeros((n, d)) for _ in range(6))
        body = scene.body
        light = np.where(np.isfinite(body.mass), 1 / np.asarray(body.mass, float), 0.0)
        self.bodies = Bodies(
            start=start, at=at, vel=vel, acc=acc, free=free, excess=excess, since=np.zeros(n), reach=np.zeros(n),
            radius=np.asarray(body.radius, np.float64), light=light, living=np.zeros(n, np.int64),
            moved=np.zeros(n, np.int64), leans=np.zeros(n, np.int64), first=np.full(n, -1),
        )  # fmt: skip
        self.ends = Ends(np.zeros((n, d)), np.zeros((n, d)), separation_directions(n, d))
        self.before, self.reach = np.zeros((n, d)), np.zeros(n)
        self.query = (
            np.zeros(max(n, 64), np.int64), np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n + 1, np.int32),
            np.zeros((1, n), np.int32), np.zeros((1, 6)), np.zeros(8, np.int64), np.zeros((MAX_RANGES, 3), np.int64),
        )  # fmt: skip
        self.things, self.given = self._obstacles(), self._given_circles()
        self.report, self.lost = np.zeros(COUNTED, np.int64), np.zeros(LOST)
        self._make_room(record.capacity * n + 64)

    def _make_room(self, places: int) -> None:
        """Allocate room for `places` meetings."""
        d = self.scene.dimension

        def zeros(*shape: int) -> NDArray[np.int64]:
            return np.zeros(shape, np.int64)

        self.meetings = Meetings(
            who=zeros(places), other=zeros(places), time=np.zeros(places), hits=zeros(places), closed=zeros(places),
            deep=np.zeros(places), following=zeros(2, places), listed=zeros(places), active=zeros(places),
            todo=zeros(2 * places), near=zeros(2, places),
        )  # fmt: skip
        self.contacts = Contacts(
            who=zeros(places), other=zeros(places), normal=np.zeros((places, d)), allowed=np.zeros(places),
            open=zeros(places), push=np.zeros(places), rub=np.zeros((places, d)), was=np.zeros((places, d + 1)),
            search=np.zeros((places, d + 1)), rank=np.zeros(places), order=zeros(places),
        )  # fmt: skip

    def _obstacles(self) -> Things:
        """Return the obstacles: round ones, with positions of each world, then other shapes, then walls of a box."""
        scene, d = self.scene, self.scene.dimension
        shapes, given = list(scene.shapes), self.record.restitution
        restitution = [given] * (len(scene.circles) + len(shapes))
        if isinstance(scene.space, Box):
            for k in range(d):
                for side in (0, 1):
                    point = [0.0] * d
                    point[k] = side * scene.space.extent(scene.dimension)[k]
                    out = [0.0] * d
                    out[k] = 1.0 - 2.0 * side
                    shapes.append(HalfSpace(point=tuple(point), direction=tuple(out)))
                    restitution.append(scene.space.restitution)
        if not self.record.obstacles:
            shapes, restitution = [], []
        table, where = pack_shapes(shapes, d)
        rows = []
        for at, count in where.values():
            for _ in range(count):
                rows.append(at)
                at += int(table[at])
        circles = scene.circles if self.record.obstacles else ()
        every = [*circles, *(shapes[int(table[at + 1])] for at in rows)]
        anchor, elastic = np.zeros((len(every), d)), np.array(restitution, float)
        for k, at in enumerate(rows, len(circles)):
            anchor[k], elastic[k] = table[at + 2 : at + 2 + d], restitution[len(circles) + int(table[at + 1])]
        moving = [k for k, shape in enumerate(every) if shape.moves]
        return Things(
            table=np.append(table, 0.0), row=np.array([POINT] * len(circles) + rows, np.int64), anchor=anchor,
            place=anchor.copy(), drift=np.zeros(anchor.shape), size=np.zeros(len(every)), restitution=elastic,
            moving=np.array(moving, np.int64), cells=self._grid_over(every), listed=np.zeros(1, np.int64),
        )  # fmt: skip

    def _grid_over(self, obstacles: list[Any]) -> Floats:
        """Return the grid over all obstacles, whose rows are their numbers; empty if there are few."""
        if len(obstacles) < FEWEST_ROWS:
            return np.zeros(0)
        return cells_of(obstacles, range(len(obstacles)), np.array(self.period) if self.period[0] > 0 else None)

    def _given_circles(self) -> tuple[Floats, Floats]:
        """Return centres (D, 1, M), m, and radii (1, M), m, of the round obstacles of the scene, in its precision."""
        scene, given = self.scene, self.scene.circles if self.record.obstacles else ()
        centre = np.array([circle.centre for circle in given], scene.dtype).reshape(-1, scene.dimension)
        return centre.T[:, None], np.array([[circle.radius for circle in given]], scene.dtype)

    def _choose_grid(self, centre: Floats, radius: Floats) -> None:
        """Use the grid, if there is one, and if the round obstacles of all worlds are where the scene has them."""
        things, expected = self.things, self.given
        same = len(things.cells) > 0 and radius.shape[1] == expected[1].shape[1]
        same = same and bool((radius == expected[1]).all() and (centre == expected[0]).all())
        if same and not things.listed[0]:
            many = radius.shape[1]
            things.place[:many], things.size[:many] = expected[0][:, 0].T, expected[1][0]
        things.listed[0] = same

    def __call__(self, x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
        """Correct the steps of worlds [first, end); return the first (world, agent) that is not finite, or (-1, -1)."""
        r = self.record
        rules = Rules(
            self.scene.dt, r.restitution, r.friction, r.sticky, r.most,
            min(r.again, r.most) if r.response == "back_up" else r.most, TOUCH, r.agents, False,
        )  # fmt: skip
        circles = slice(None) if r.obstacles else slice(0, 0)
        self._choose_grid(state.obstacle_x[:, :, circles], state.obstacle_radius[:, circles])
        spread = np.inf if r.part_speed is None else r.part_speed * self.scene.dt
        bad, unsolved, lost = (-1, -1), 0, np.zeros(LOST)
        while first < end:
            short = entry(collide)(
                self.period, x0, v0, state.x, state.v, state.alive, state.tick, state.obstacle_x[:, :, circles],
                state.obstacle_radius[:, circles], self.bodies, self.meetings, self.things, self.contacts, self.ends,
                self.before, self.reach, *self.query, rules, r.response in ("earliest", "back_up"),
                r.response == "project", r.passes, spread, first, end, state.work, WORK.index("impacts"), self.report,
                self.lost,
            )  # fmt: skip
            world, agent, needed = (int(k) for k in self.report[:3])
            most = np.maximum(lost, self.lost)
            unsolved, lost = unsolved + int(self.report[4]), lost + self.lost
            lost[[LEFT, SUNK]] = most[[LEFT, SUNK]]
            bad = (world, agent) if bad[0] < 0 else bad
            if short < 0:
                break
            first = short
            self._make_room(2 * needed)
        if unsolved and not self.warned:
            self.warned = True
            warnings.warn(self._warning_text(unsolved, lost), UnsolvedContactsWarning, stacklevel=2)
        return bad

    def find(
        self, state: State, x: Floats, v: Floats, flow: Floats, begun: float, seconds: float, touching: Touching
    ) -> None:
        """Write the contacts of a single world in a step of `seconds` from `begun`, s; see `find_touching`."""
        r, circles = self.record, slice(None) if self.record.obstacles else slice(0, 0)
        given = state.obstacle_x[:, :, circles], state.obstacle_radius[:, circles]
        self._choose_grid(*given)
        rules = Rules(seconds, r.restitution, r.friction, r.sticky, r.most, r.most, TOUCH, r.agents, False)
        exact = 8 * float(np.finfo(state.x.dtype).eps)
        while True:
            needed = entry(find_touching)(
                self.period, x, v, flow, state.alive[0], *given, self.bodies, self.meetings, self.things, self.ends,
                self.reach, rules, exact, begun, touching,
            )  # fmt: skip
            if needed <= len(self.meetings.who):
                return
            self._make_room(2 * int(needed))

    def _warning_text(self, unsolved: int, lost: NDArray[np.float64]) -> str:
        """Return the warning about a step; `lost`: see event_driven.process_impacts and step_end.py."""
        r, seconds, joules, stopped = self.record, float(lost[0]), float(lost[1]), float(lost[2])
        text = (
            f"constraints: collisions: in a step {unsolved} impacts or worlds with contacts were not solved within "
            f"most = {r.most} and passes = {r.passes}"
        )
        if self.period[0] > 0:
            text += ", or a body went further than a quarter of the torus"
        if stopped > 0:
            early = seconds / stopped
            text += f"; {stopped:.0f} bodies stopped {early:.3g} s before its end, and keep their velocities"
        if joules > 0:
            text += f"; {joules:.3g} J lost by bodies that came to rest"
        if lost[RAISED] > 0:
            text += f"; up to {lost[RAISED]:.3g} J gained by bodies that were moved apart"
        if lost[LEFT] > 0:
            text += f"; the last pass still changed velocities, by up to {lost[LEFT]:.2g} m/s"
        if r.response in ("impulses", "project"):
            text += f"; the deepest overlap is {lost[SUNK]:.2g} of a radius"
        return text
