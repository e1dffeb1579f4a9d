"""Wall following at a distance, and containment within walls (Reynolds 1999)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv import steering
from flockenv.behaviours.behaviour import Moving, top_speed
from flockenv.geometry.shapes import AnyShape, pack_shapes
from flockenv.geometry.shapes.block import nearest_block
from flockenv.geometry.shapes.chain import nearest_chain
from flockenv.geometry.space import Torus
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, dot, lateral, norm, perpendicular, scale, select, sub, unit, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Me, Obstacle

__all__ = ["Contain", "FollowWall"]


@law
def predicted_offset(p: Any, me: Me) -> Vec:
    """Return the displacement after `time` s at the present velocity."""
    return scale(me.vel, p.time)


@law
def no_wall(p: Any, me: Me) -> Vec:
    """Return the initial value: a wall at infinity."""
    return (like(me.who, np.inf),) + zero(me.pos)  # noqa: RUF005  # numba joins tuples, but does not unpack them


@law
def nearest_wall(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Keep the nearest surface: (its distance from the predicted position, its normal)."""
    return select(abs(other.gap) < abs(acc[0]), (other.gap,) + other.normal, acc)  # noqa: RUF005


@law
def wall_reach(p: Any, me: Me) -> float:
    """Return the range of sight around the predicted position, m."""
    return p.range + norm(me.vel) * p.time  # type: ignore[no-any-return]


@law
def follow_wall_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w S, which seeks q + D n, with q the point of the wall nearest to the predicted position."""
    o, e = like(me.who, 0.0), like(me.who, 1.0)
    normal: Vec
    if len(acc) == 3:
        normal = (acc[1], acc[2])
    else:
        normal = (acc[1], acc[2], acc[3])
    near = abs(acc[0]) < p.range
    step = scale(me.vel, p.time)
    gap = acc[0] if near else o
    crossed = gap - dot(step, normal) < o  # the prediction is behind a thin wall: its own side counts
    normal, gap = scale(normal, -e if crossed else e), -gap if crossed else gap
    still = dot(step, step) <= o
    onward = select(still, scale(perpendicular(normal), p.time * top_speed(p, me)), step)
    goal = add(onward, scale(normal, p.distance - gap))
    force = scale(steering.seek(goal, me.vel, top_speed(p, me)), p.weight)
    return select(near, force, zero(force))


class FollowWall(Moving):
    """Follow the nearest surface at `distance`: seek the point off the wall beside the predicted position.

    It keeps to the side on which it arrives; at rest it starts with the wall on its right. Around a corner it turns as
    sharply as its force allows: with `time` of about 2 m / w it does not cut corners.

    Reynolds 1999, wall following.

    Limits: the nearest surface counts, so in a passage narrower than two distances an agent may change over to the
    other wall. Without a wall in range the force is 0.
    """

    kind: Literal["follow_wall"] = "follow_wall"
    distance: float = Field(gt=0, description="m, from the wall to its centre")
    time: float = Field(default=0.5, gt=0, description="s, look-ahead time")
    range: float = Field(default=5.0, gt=0, description="m, range within which walls are seen")
    obstacle_from: ClassVar[Law | None] = predicted_offset
    obstacle_start: ClassVar[Law | None] = no_wall
    obstacle_law: ClassVar[Law | None] = nearest_wall
    obstacle_finish: ClassVar[Law | None] = follow_wall_force
    obstacle_reach: ClassVar[Law | None] = wall_reach
    demo: ClassVar[str | None] = """
groups:
- count: 2
  radius: 0.15
  max_speed: 2
  max_force: 20
  spawn: {low: [2, 0.8], high: [3, 1.2], speed: [1, 1], heading: [1, 0]}
obstacles:
- {kind: polygon, vertices: [[0, 2], [8, 2], [8, 7], [5, 7], [5, 4.5], [0, 4.5]]}
effects:
- {kind: steer, behaviours: [{kind: follow_wall, weight: 8, distance: 0.8, time: 0.25}]}
"""

    def fold_size(self, dimension: int) -> int:
        """Return the size of a distance and a normal."""
        return 1 + dimension


# --- containment ------------------------------------------------------------------------------------------------------


@law
def contain_force(p: Any, me: Me, now: float, gap: float, out: Vec) -> Vec:
    """Return F = w S: turn along the wall that it would cross, brake if head-on; from outside, go straight back."""
    o, e = like(me.who, 0.0), like(me.who, 1.0)
    aside = scale(lateral(out, me.heading), -e)
    straight = dot(aside, aside) < like(me.who, 1e-6)
    side = select(straight, perpendicular(me.heading), unit(aside))
    ahead = dot(out, me.heading)
    brake = scale(me.vel, -(ahead * ahead if ahead > o else o))
    turn = add(scale(side, top_speed(p, me)), brake)
    home = sub(scale(out, -top_speed(p, me)), me.vel)
    force = scale(select(now + me.radius > o, home, turn), p.weight)
    return select(gap + me.radius > o, force, zero(force))


@law
def contain_chain(p: Any, me: Me) -> Vec:
    """Return the force for a circle, a polygon or another chain."""
    x = _table_offset(p.table, me.pos)
    now, away = nearest_chain(p.table, 0, x)
    gap, out = nearest_chain(p.table, 0, add(x, scale(me.vel, p.time)))
    beyond = now + me.radius > like(me.who, 0.0)
    return contain_force(p, me, now, now if beyond else gap, select(beyond, away, out))


@law
def contain_block(p: Any, me: Me) -> Vec:
    """Return the force for a block."""
    x = _table_offset(p.table, me.pos)
    now, away = nearest_block(p.table, 0, x)
    gap, out = nearest_block(p.table, 0, add(x, scale(me.vel, p.time)))
    beyond = now + me.radius > like(me.who, 0.0)
    return contain_force(p, me, now, now if beyond else gap, select(beyond, away, out))


@law
def _table_offset(table: Any, x: Vec) -> Vec:
    if len(x) == 2:
        return (x[0] - table[2], x[1] - table[3])
    else:
        return (x[0] - table[2], x[1] - table[3], x[2] - table[4])


class Contain(Moving):
    """Stay within a shape: zero while the position `time` seconds ahead is inside, else steer along the wall there.

    The inward normal's part across the heading steers; head-on there is none, so the agent brakes and keeps right. From
    outside, an agent heads straight back in. Reynolds 1999, containment.

    The predicted position is p = x + T v, T = `time`.

    Limits: a steering force is no wall. Agents that turn along the surface cross it by about half the length of a step,
    max_speed dt / 2, and by a little at corners. They cross it further if `weight` or max_force is too small to turn
    within `time`, or if others push. Agents that must never leave need a hollow obstacle and `collisions`.
    """

    kind: Literal["contain"] = "contain"
    within: AnyShape = Field(
        description="a circle (or sphere), a block, a polygon; bodies may protrude by about max_speed dt / 2"
    )
    time: float = Field(default=1.0, gt=0, description="s, look-ahead time")
    tabled: ClassVar[bool] = True
    demo: ClassVar[str | None] = """
groups:
- {count: 8, radius: 0.15, max_speed: 2, max_force: 12, spawn: {low: [3, 3], high: [5, 5], speed: [1.5, 2]}}
effects:
- kind: steer
  behaviours:
  - kind: contain
    weight: 5
    within: {kind: polygon, vertices: [[0, 0], [8, 0], [8, 8], [4, 6], [0, 8]]}
"""

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        """Raise ValueError if the shape is no circle, block or polygon, moves, or is hollow."""
        if self.within.kind not in ("circle", "block", "polygon"):
            raise ValueError(f"within.kind = {self.within.kind}: must be one of circle, block, polygon")
        if self.within.moves or self.within.form.startswith("hollow"):
            raise ValueError("within: must stand still and be solid; the body stays inside it")
        return self

    @property
    def own_law(self) -> Law | None:  # type: ignore[override]  # which law it is depends on the shape
        """The law for this form of shape."""
        return contain_block if self.within.form == "block" else contain_chain

    def parameters(self) -> dict[str, float | Vec]:
        """Return all parameters but the shape, which is in the table."""
        return {"speed": self.limit, "weight": self.weight, "time": self.time}

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return the row of the shape."""
        return pack_shapes([self.within], scene.dimension)[0]

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the space is a torus, which has no outside, or the dimension differs."""
        super().check(scene)
        if isinstance(scene.space, Torus):
            raise ValueError("kind = contain: a torus has no outside; only a plane or a box is allowed")
        if self.within.dimension != scene.dimension:
            raise ValueError(f"within: lies in {self.within.dimension} dimensions, but dimension = {scene.dimension}")
