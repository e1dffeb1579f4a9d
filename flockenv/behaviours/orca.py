"""Reciprocal collision avoidance among agents and round obstacles in 2-D: ORCA as a behaviour."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numba.extending import overload
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import Moving, top_speed
from flockenv.jit.decorators import OPTIONS, Law, Vec, law, like
from flockenv.maths.vectors import scale, select, sub, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Me, Other, Sight, Vector
from flockenv.steering import orca

__all__ = ["Orca"]


def with_inserted(slots: Vec, new: Vec) -> Vec:
    """Return the slots with a new one inserted by its power distance, |offset|^2 - radius^2; the last is dropped."""
    size = len(new)
    listed: Vec = ()
    for k in range(0, len(slots), size):
        old = slots[k : k + size]
        near, far = (new, old) if _power_distance(new) < _power_distance(old) else (old, new)
        listed, new = (*listed, *near), far
    return listed


def _power_distance(slot: Vec) -> float:
    return slot[0] * slot[0] + slot[1] * slot[1] - slot[4] * slot[4]


@overload(with_inserted, jit_options=OPTIONS)
def _with_inserted(slots, new):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    """Return `with_inserted` unrolled for the number of slots, with selects instead of branches, for SIMD lanes."""
    size, lines = len(new), ["def sort_in(slots, new):"]
    held = [f"c{j}" for j in range(size)]
    lines.append(f"    {', '.join(held)} = new")
    kept_ = []
    for k in range(0, len(slots), size):
        old = [f"slots[{k + j}]" for j in range(size)]
        lines.append(
            f"    near = c0 * c0 + c1 * c1 - c4 * c4 < {old[0]} * {old[0]} + {old[1]} * {old[1]} - {old[4]} * {old[4]}"
        )
        for j in range(size):
            lines.append(f"    k{k + j}, c{j} = (c{j}, {old[j]}) if near else ({old[j]}, c{j})")
            kept_.append(f"k{k + j}")
    lines.append(f"    return ({', '.join(kept_)},)")
    namespace: dict[str, Any] = {}
    exec("\n".join(lines), namespace)  # noqa: S102  # their number is part of the type
    return namespace["sort_in"]


@law
def no_neighbours(p: Any, me: Me) -> Vec:
    """Return six empty slots."""
    far, o, e = like(me.radius, np.inf), like(me.radius, 0.0), like(me.radius, 1.0)
    empty = (far, far, o, o, -e, o)
    return empty + empty + empty + empty + empty + empty


@law
def insert_agent(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep an agent if it is among the nearest; one in the same place is moved a little to one side."""
    one_place = other.square <= like(other.square, 1e-12)
    to = select(one_place, scale(sub(me.tie, other.tie), like(other.square, -1e-6)), other.offset)
    return with_inserted(acc, (to[0], to[1], other.vel[0], other.vel[1], other.radius, like(other.square, 0.5)))


@law
def insert_obstacle(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep an obstacle if it is among the nearest; the agent makes all of the change."""
    o = like(other.square, 0.0)
    return with_inserted(acc, (other.offset[0], other.offset[1], o, o, other.radius, like(other.square, 1.0)))


@law
def orca_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w (v_orca - v), with arrival as the preferred velocity."""
    speed = top_speed(p, me)
    desired = steering.arrive(sub(p.target, me.pos), zero(me.vel), speed, p.slow_radius)
    top = min(p.hurry * speed, me.max_speed)
    return scale(orca.orca(me.vel, desired, me.radius + p.margin, top, p.horizon, p.step, p.turn, acc), p.weight)


class Orca(Moving):
    """Arrive at a point with the velocity nearest to the preferred one that is collision-free for `horizon` seconds.

    Optimal reciprocal collision avoidance (van den Berg et al. 2011) among the six nearest agents and obstacles.
    It selects a velocity: without inertia (weight = m / dt, no max_force) agents that all use it never touch.

    Limits: of agents and obstacles in range the six nearest count, a seventh is not seen. Half of every evasion is left
    to the other agent, also if that does not give way. Where no velocity is free, the one with the least violation is
    taken, and bodies may touch.
    """

    kind: Literal["orca"] = "orca"
    weight: float = Field(ge=0, description="kg/s, gain; m / dt reaches the velocity in one step")
    target: Vector = Field(description="m, the goal, in 2-D")
    hurry: float = Field(default=1.2, ge=1, description="top speed of an evasion, times `speed`; at most max_speed")
    slow_radius: float = Field(default=0.5, gt=0, description="m, distance within which it slows down")
    radius: float = Field(default=8.0, gt=0, description="m, range within which agents count")
    horizon: float = Field(default=3.0, gt=0, description="s, time for which the velocity is collision-free")
    step: float = Field(default=0.1, gt=0, description="s, time within which overlaps are resolved")
    margin: float = Field(default=0.0, ge=0, description="m, clearance beyond both radii")
    turn: float = Field(
        default=0.05,
        ge=0,
        le=1.5,
        description="rad, turn to the right of a blocked preferred velocity, against deadlock",
    )
    group: int | None = Field(default=None, ge=0, description="group that it avoids (default: all)")
    places: ClassVar[tuple[str, ...]] = ("target",)
    pair_start: ClassVar[Law | None] = no_neighbours
    pair_law: ClassVar[Law | None] = insert_agent
    obstacle_law: ClassVar[Law | None] = insert_obstacle
    finish_law: ClassVar[Law | None] = orca_force
    demo: ClassVar[str | None] = """
dt: 0.05
obstacles: [{centre: [0, 0], radius: 0.6}]
groups:
  - {count: 5, radius: 0.3, spawn: {low: [-6, -2.5], high: [-4, 2.5]}}
  - {count: 5, radius: 0.3, spawn: {low: [4, -2.5], high: [6, 2.5]}}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: orca, weight: 10, target: [20, 0], speed: 1.2}]}
  - {kind: steer, group: 1, behaviours: [{kind: orca, weight: 10, target: [-20, 0], speed: 1.2}]}
"""

    @property
    def sight(self) -> Sight:
        """Radius and group."""
        return Sight(self.radius, group=self.group)

    def parameters(self) -> dict[str, float | Vec]:
        """Return target, speed and the numbers of ORCA; the neighbour query uses the rest."""
        names = ("weight", "hurry", "slow_radius", "horizon", "step", "margin", "turn")
        return {"target": self.target, "speed": self.limit, **{name: float(getattr(self, name)) for name in names}}

    def lookahead(self, speed: float) -> float:
        """Return the distance travelled within the horizon, m, at most the range of sight."""
        return min(speed * self.horizon, self.radius)

    def check(self, scene: SceneView) -> None:
        """Raise ValueError in 3-D, or if an obstacle is not a round, solid one that stands still."""
        if scene.dimension != 2:
            raise ValueError(f"kind = orca: dimension = {scene.dimension}, must be 2")
        for k, obstacle in enumerate(scene.obstacles):
            if not obstacle.in_state:
                what = ", which moves or is hollow" if obstacle.kind == "circle" else ""
                raise ValueError(
                    f"kind = orca: only sees solid circles at rest; obstacles[{k}].kind = {obstacle.kind}{what}"
                )
        super().check(scene)

    def sums(self, dimension: int) -> int:
        """Return how many numbers are kept: those of six slots."""
        return 6 * orca.SLOT
