"""Paths and flow fields (Reynolds 1999): follow a path, stay on it, follow a field of velocities on a grid.

A path is a tube: straight pieces, its spine, and a radius. An agent that will still be inside in `time` seconds is not
steered.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv import steering
from flockenv.behaviours.behaviour import Behaviour, Moving, gains, top_speed
from flockenv.geometry import polyline
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths import grid
from flockenv.maths.vectors import add, norm, scale, select, sub, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Me, Vector

__all__ = ["FollowFlow", "FollowPath", "StayOnPath"]

SLOWEST = 0.25
"""Smallest speed for the look-ahead, as a share of top speed: an agent at rest also needs a target ahead."""


MOST_PLACES = 500
"""Most points of a path in pictures."""


@law
def _offset_part(found: Vec) -> Vec:
    """Return the offset part of a result of `polyline.nearest`."""
    if len(found) == 3:
        return (found[1], found[2])
    else:
        return (found[1], found[2], found[3])


@law
def follow_path_force(p: Any, me: Me) -> Vec:
    """Return F = w S of following the path."""
    top = top_speed(p, me)
    o, way = like(top, 0.0), like(top, p.way)
    now = polyline.nearest(p.table, me.pos)
    then = polyline.nearest(p.table, add(me.pos, scale(me.vel, p.time)))
    gained = way * polyline.arc_difference(p.table, now[0], then[0]) - p.keep * top * p.time
    ahead = p.time * max(norm(me.vel), like(top, SLOWEST) * top)
    target = polyline.spine(p.table, me.pos, now[0] + way * ahead)
    change = steering.follow_path(norm(_offset_part(then)) - p.radius, gained, target, me.vel, top)
    slow = max(p.slow_radius, like(top, 1e-9))
    end = polyline.spine(p.table, me.pos, p.table[1] if way > o else o)
    arriving = polyline.distance_to_end(p.table, now[0], way) < p.slow_radius
    return scale(select(arriving, steering.arrive(end, me.vel, top, slow), change), p.weight)


@law
def stay_on_path_force(p: Any, me: Me) -> Vec:
    """Return F = w S of staying on the path."""
    step = scale(me.vel, p.time)
    to_spine = _offset_part(polyline.nearest(p.table, add(me.pos, step)))
    beyond = norm(to_spine) - p.radius
    change = steering.stay_on_path(beyond, add(step, to_spine), me.vel, top_speed(p, me))
    return scale(change, p.weight)


@law
def _grid_centre(table: Any, x: Vec) -> Vec:
    """Return the centre of a grid."""
    d = len(x)
    half = like(x[0], 0.5) * table[d]
    e = like(x[0], 1.0)
    if len(x) == 2:
        return (table[0] + half * (table[3] - e), table[1] + half * (table[4] - e))
    else:
        x0, x1 = table[0] + half * (table[4] - e), table[1] + half * (table[5] - e)
        return (x0, x1, table[2] + half * (table[6] - e))


@law
def follow_flow_force(p: Any, me: Me) -> Vec:
    """Return F = w (u - v), 0 outside the grid."""
    there = add(me.pos, scale(me.vel, p.time))
    at = add(sub(there, p.centre), _grid_centre(p.table, there))  # on a torus p.centre is the nearest image
    change = steering.follow_flow(grid.sample_vector(p.table, at, 0), me.vel)
    return scale(select(grid.covers(p.table, at), change, zero(me.vel)), p.weight)


class _OnPath(Moving):
    """Base of the behaviours on a path: a tube, and a look-ahead time."""

    tabled: ClassVar[bool] = True
    places: ClassVar[tuple[str, ...]] = ("points",)
    heads_for: ClassVar[bool] = False

    points: Annotated[tuple[Vector, ...], Field(min_length=2, max_length=1024)] = Field(
        description="m, corners of its spine; on a torus each piece takes the shortest path"
    )
    closed: bool = Field(default=False, description="True if the last point is joined to the first")
    radius: float = Field(gt=0, description="m, radius of the tube")
    time: float = Field(default=0.5, ge=0, description="s, look-ahead time")

    @model_validator(mode="after")
    def _check_path(self) -> _OnPath:
        """Raise ValueError if points differ in dimension, or two coincide."""
        for k, point in enumerate(self.points):
            if len(point) != len(self.points[0]):
                raise ValueError(f"points[{k}] = {point}: must have {len(self.points[0])} numbers, as points[0] has")
        polyline.pieces(self.points, self.closed)
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """Return all parameters but the path itself, which is in the table."""
        return {"speed": self.limit, "weight": self.weight, "radius": self.radius, "time": self.time}

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return the pieces of the path."""
        return polyline.pieces(self.points, self.closed, scene.space)

    def path_to_draw(self, scene: SceneView) -> tuple[tuple[Vec, ...], float] | None:
        """Return the tube for pictures: points half a radius apart, at most MOST_PLACES pieces, and the radius."""
        path = scene.table_of(self)
        count = min(math.ceil(path[1] / (0.5 * self.radius)), MOST_PLACES)
        along = polyline.spine_points(path, np.linspace(0.0, path[1], count + 1), scene.dimension)
        return tuple(map(tuple, scene.space.wrap(along).tolist())), self.radius

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the path has another dimension, or a piece has no length on a torus."""
        if len(self.points[0]) != scene.dimension:
            raise ValueError(
                f"points[0] = {self.points[0]}: has {len(self.points[0])} numbers, but dimension = {scene.dimension}"
            )
        super().check(scene)
        scene.table_of(self)


class FollowPath(_OnPath):
    """Follow a path in one direction: zero while the agent makes progress inside the tube, else seek the spine ahead.

    In Reynolds' version any progress is enough, so an agent coasts for ever at whatever speed it has; here it must
    progress at `keep` times top speed. Two groups with opposite directions are traffic. At the end of an open path the
    agent seeks the end, or arrives at it within `slow_radius`.

    Reynolds 1999, path following.

    Limits: it has no memory: where pieces of the path cross or come near each other, the nearest one counts, and an
    agent may change over. Inside the tube nothing keeps agents apart.
    """

    kind: Literal["follow_path"] = "follow_path"
    time: float = Field(default=0.5, gt=0, description="s, look-ahead time")
    way: Literal[1, -1] = Field(default=1, description="1: in the order of the points; -1: reversed")
    keep: float = Field(
        default=0.5, ge=0, lt=1, description="share of top speed below which an agent is steered on; 0 = never"
    )
    slow_radius: float = Field(
        default=0.0, ge=0, description="m, distance from the end of an open path at which it brakes"
    )
    own_law: ClassVar[Law | None] = follow_path_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 5, max_speed: 2, max_force: 6, spawn: {low: [3, 0], high: [9, 3], speed: [0.5, 1.5]}}
  - {count: 5, max_speed: 2, max_force: 6, role: evader, spawn: {low: [3, 6], high: [9, 9], speed: [0.5, 1.5]}}
effects:
  - kind: steer
    group: 0
    behaviours:
      - {kind: unaligned_avoidance, weight: 8, horizon: 1.5, margin: 0.2}
      - {kind: follow_path, weight: 4, radius: 0.6, speed: 2, closed: true,
         points: [[1, 1], [6, 2.5], [11, 1], [12, 5], [10, 9], [6, 7.5], [2, 9], [0, 5]]}
  - kind: steer
    group: 1
    behaviours:
      - {kind: unaligned_avoidance, weight: 8, horizon: 1.5, margin: 0.2}
      - {kind: follow_path, weight: 4, radius: 0.6, speed: 2, closed: true, way: -1,
         points: [[1, 1], [6, 2.5], [11, 1], [12, 5], [10, 9], [6, 7.5], [2, 9], [0, 5]]}
"""

    @property
    def ramp(self) -> float | None:
        """The slow radius of an open path; None if the path is closed or the radius is 0."""
        return None if self.closed or self.slow_radius == 0 else self.slow_radius

    def parameters(self) -> dict[str, float | Vec]:
        """Return the parameters of the path, with direction, progress and slow radius."""
        own = {"way": float(self.way), "keep": float(self.keep), "slow_radius": float(self.slow_radius)}
        return super().parameters() | own


class StayOnPath(_OnPath):
    """Stay in a path's tube, in either direction: seek the nearest spine if the position after `time` s is outside.

    Reynolds 1999, path following.

    Limits: inside the tube the force is 0: an agent at rest stays at rest. Where pieces of the path cross, the nearest
    one counts.
    """

    kind: Literal["stay_on_path"] = "stay_on_path"
    own_law: ClassVar[Law | None] = stay_on_path_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 12, max_speed: 2, max_force: 6, spawn: {low: [2, 2], high: [10, 6], speed: [1, 2]}}
effects:
  - kind: steer
    behaviours:
      - {kind: stay_on_path, weight: 4, radius: 1, speed: 2, points: [[-12, 4], [0, 4], [6, 2], [12, 4], [24, 4]]}
"""


class FollowFlow(Behaviour):
    """Follow a field of velocities on a grid, linear in between: F = w (u - v), 0 outside the grid.

    Reynolds 1999, flow field following.

    Limits: the field does not change in time, and outside the grid no force brings an agent back. Obstacles have to be
    part of the field.
    """

    kind: Literal["follow_flow"] = "follow_flow"
    centre: Vector = Field(description="m, centre of the grid")
    spacing: float = Field(gt=0, description="m, between points of the grid")
    counts: tuple[Annotated[int, Field(ge=2, le=1024)], ...] = Field(
        min_length=2, max_length=3, description="points along each axis"
    )
    velocities: tuple[Vector, ...] = Field(description="m/s, at all points; the last axis varies fastest")
    time: float = Field(default=0.2, ge=0, description="s, look-ahead time")
    tabled: ClassVar[bool] = True
    places: ClassVar[tuple[str, ...]] = ("centre",)
    heads_for: ClassVar[bool] = False
    own_law: ClassVar[Law | None] = follow_flow_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 15, max_speed: 2, max_force: 4, spawn: {low: [1, 1], high: [9, 9]}}
effects:
  - {kind: follow_flow, weight: 4, centre: [5, 5], spacing: 5, counts: [3, 3],
     velocities: [[1.8, -0.6], [0.6, -1.2], [-0.6, -1.8], [1.2, 0.6], [0, 0], [-1.2, -0.6], [0.6, 1.8], [-0.6, 1.2],
                  [-1.8, 0.6]]}
"""

    @model_validator(mode="after")
    def _check_grid(self) -> FollowFlow:
        """Raise ValueError if the number of velocities is not that of points, or dimensions differ."""
        d = len(self.centre)
        if len(self.counts) != d:
            raise ValueError(f"counts = {self.counts}: must have {d} numbers, as centre has")
        if len(self.velocities) != math.prod(self.counts):
            raise ValueError(f"velocities: {len(self.velocities)}, must be {math.prod(self.counts)}, one at each point")
        for k, velocity in enumerate(self.velocities):
            if len(velocity) != d or not all(map(math.isfinite, velocity)):
                raise ValueError(f"velocities[{k}] = {velocity}: must be {d} finite numbers")
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """Return all parameters but the grid, which is in the table."""
        return {"weight": self.weight, "centre": tuple(map(float, self.centre)), "time": self.time}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return w^2 = weight s / m and damping weight (1 + s time) / m, s the sum of the largest slopes per axis."""
        field = np.reshape(self.velocities, (*self.counts, -1))
        slope = sum(np.linalg.norm(np.diff(field, axis=k), axis=-1).max() for k in range(len(self.counts)))
        gain, slope = gains(self.weight, groups, dimension), slope / self.spacing
        return gain * slope, gain * (1 + slope * self.time)

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return the grid."""
        low = np.array(self.centre) - self.spacing * (np.array(self.counts) - 1) / 2
        return grid.pack_grid(np.reshape(self.velocities, (*self.counts, -1)), low.tolist(), self.spacing)
