"""Behaviours of crowds: unaligned collision avoidance, queueing, foraging, exploring a region."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import Behaviour, Moving, gains, top_speed
from flockenv.behaviours.wander import wander_force
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import scale, select, sub, unit, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Me, Other, Sight, Vector

__all__ = ["Explore", "Forage", "Queue", "UnalignedAvoidance"]


# --- unaligned collision avoidance ------------------------------------------------------------------------------------


@law
def no_collision(p: Any, me: Me) -> Vec:
    """Return the initial value: no collision, at time inf."""
    return (like(me.radius, np.inf),) + zero(me.pos)  # noqa: RUF005  # numba joins tuples, but does not unpack them


@law
def earliest_collision(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep the earliest predicted collision: (time, direction of evasion)."""
    clearance = me.radius + other.radius + p.margin
    time = steering.unaligned_threat(other.offset, me.vel, other.vel, clearance, p.horizon)
    away = steering.give_way(other.offset, me.vel, other.vel, time, like(clearance, 1.0))
    return select(time < acc[0], (time,) + away, acc)  # noqa: RUF005


@law
def give_way_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w (1 m/s) away from the predicted collision."""
    away: Vec
    if len(acc) == 3:
        away = (acc[1], acc[2])
    else:
        away = (acc[1], acc[2], acc[3])
    return scale(away, p.weight)


class UnalignedAvoidance(Behaviour):
    """Avoid the earliest predicted collision within `horizon` seconds: turn aside, and brake or speed up.

    Reynolds 1999.

    Limits: all agents are assumed to keep their velocities, and only the earliest collision is avoided. Agents that do
    not approach are not avoided, even if they overlap. It sees no obstacles, and its force is w or 0.
    """

    kind: Literal["unaligned_avoidance"] = "unaligned_avoidance"
    weight: float = Field(ge=0, description="N, steering force of an evasion")
    radius: float = Field(default=10.0, gt=0, description="m, range within which agents count")
    fov: float = Field(
        title="field of view", default=360.0, gt=0, le=360, description="degrees, full angle of the field of view"
    )
    horizon: float = Field(default=3.0, gt=0, description="s, look-ahead time")
    margin: float = Field(default=0.0, ge=0, description="m, clearance beyond both radii")
    group: int | None = Field(default=None, ge=0, description="group that it avoids (default: all)")
    pair_start: ClassVar[Law | None] = no_collision
    pair_law: ClassVar[Law | None] = earliest_collision
    finish_law: ClassVar[Law | None] = give_way_force
    demo_time: ClassVar[float] = 7.0
    demo: ClassVar[str | None] = """
dt: 0.05
groups:
  - {count: 4, radius: 0.3, max_speed: 1.6, max_force: 4, spawn: {low: [-5, -2], high: [-4, 2]}}
  - {count: 4, radius: 0.3, max_speed: 1.6, max_force: 4, spawn: {low: [-2, -5], high: [2, -4]}}
effects:
  - kind: steer
    group: 0
    behaviours:
      - {kind: unaligned_avoidance, weight: 4, margin: 0.2}
      - {kind: queue, weight: 2, target: [30, 0], speed: 1.2}
  - kind: steer
    group: 1
    behaviours:
      - {kind: unaligned_avoidance, weight: 4, margin: 0.2}
      - {kind: queue, weight: 2, target: [0, 30], speed: 1.2}
"""

    @property
    def sight(self) -> Sight:
        """Radius, field of view and group."""
        return Sight(self.radius, self.fov, group=self.group)

    def parameters(self) -> dict[str, float | Vec]:
        """Return weight, horizon and margin; the neighbour query uses the rest."""
        return {"weight": self.weight, "horizon": self.horizon, "margin": self.margin}

    def lookahead(self, speed: float) -> float:
        """Return the distance travelled within the horizon, m, at most the range of sight."""
        return min(speed * self.horizon, self.radius)

    def rates(self, groups: Sequence[Any], dimension: int) -> None:
        """Return None: its force is constant in size."""

    def sums(self, dimension: int) -> int:
        """Return the size of a time and a direction."""
        return 1 + dimension


# --- queue ------------------------------------------------------------------------------------------------------------


@law
def free_way(p: Any, me: Me) -> Vec:
    """Return the initial value: the direction to the door, and an infinite gap."""
    return unit(sub(p.target, me.pos)) + (like(me.radius, np.inf),)  # noqa: RUF005


@law
def shortest_gap(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep the shortest gap."""
    direction: Vec
    if len(acc) == 3:
        direction = (acc[0], acc[1])
    else:
        direction = (acc[0], acc[1], acc[2])
    clearance = me.radius + other.radius + p.margin
    gap = steering.queue_gap(direction, other.offset, other.vel, clearance, top_speed(p, me))
    nearest = acc[len(acc) - 1]
    return direction + (gap if gap < nearest else nearest,)  # noqa: RUF005


@law
def queue_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w (v_queue - v)."""
    direction: Vec
    if len(acc) == 3:
        direction = (acc[0], acc[1])
    else:
        direction = (acc[0], acc[1], acc[2])
    return scale(steering.queue(direction, me.vel, acc[len(acc) - 1], top_speed(p, me), p.headway), p.weight)


class Queue(Moving):
    """Seek a door, and slow down behind slower agents ahead, without pushing.

    Named in Reynolds 1999; the speed v_queue = gap / `headway` is that of Tordeux, Chraibi and Seyfried 2016.

    Limits: the path is straight, without obstacles. Every slower agent ahead blocks, oncoming ones also, so that two
    streams stop each other; and nothing keeps apart agents that stand side by side.
    """

    kind: Literal["queue"] = "queue"
    weight: float = Field(ge=0, description="kg/s, gain; at 4 m / headway or more it does not overshoot")
    target: Vector = Field(description="m, the door")
    headway: float = Field(default=0.8, gt=0, description="s, a gap is closed as exp(-t / headway)")
    margin: float = Field(default=0.0, ge=0, description="m, gap between bodies that stand in the queue")
    radius: float = Field(default=5.0, gt=0, description="m, range within which agents ahead block")
    group: int | None = Field(default=None, ge=0, description="group that it queues behind (default: all)")
    places: ClassVar[tuple[str, ...]] = ("target",)
    pair_start: ClassVar[Law | None] = free_way
    pair_law: ClassVar[Law | None] = shortest_gap
    finish_law: ClassVar[Law | None] = queue_force
    demo: ClassVar[str | None] = """
dt: 0.05
obstacles: [{centre: [0, 2.7], radius: 2}, {centre: [0, -2.7], radius: 2}]
groups: [{count: 12, radius: 0.25, max_force: 8, spawn: {low: [-8, -3], high: [-3, 3]}}]
effects:
  - kind: steer
    behaviours:
      - {kind: avoid_obstacles, weight: 6, horizon: 1.2, margin: 0.1}
      - {kind: separation, weight: 2, radius: 0.9}
      - {kind: queue, weight: 3, target: [20, 0], speed: 1.3, margin: 0.1}
"""

    @property
    def sight(self) -> Sight:
        """Radius and group, in all directions: ahead is relative to the door."""
        return Sight(self.radius, group=self.group)

    def parameters(self) -> dict[str, float | Vec]:
        """Return target, speed, weight, headway and margin; the neighbour query uses the rest."""
        names = ("weight", "headway", "margin")
        return {"target": self.target, "speed": self.limit, **{name: float(getattr(self, name)) for name in names}}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return w^2 = weight / (m headway), while a gap closes, and a damping of weight / m."""
        gain = gains(self.weight, groups, dimension)
        return gain / self.headway, gain

    def sums(self, dimension: int) -> int:
        """Return the size of a direction and a gap."""
        return dimension + 1


# --- forage -----------------------------------------------------------------------------------------------------------


@law
def no_food(p: Any, me: Me) -> Vec:
    """Return the initial value: no food found."""
    far = like(me.radius, np.inf)
    return (far, far) + zero(me.pos)  # noqa: RUF005


@law
def nearest_food(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep the nearest food, of two equally near that of lower index: (squared distance, index, offset)."""
    nearer = (other.square < acc[0]) | ((other.square == acc[0]) & (other.who < acc[1]))
    return select(nearer, (other.square, other.who) + other.offset, acc)  # noqa: RUF005


@law
def forage_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w (v_arrive - v) if there is food in sight, else F = w (v_wander - v)."""
    o = like(me.radius, 0.0)
    offset: Vec
    if len(acc) == 4:
        offset = (acc[2], acc[3])
    else:
        offset = (acc[2], acc[3], acc[4])
    speed = top_speed(p, me)
    feed = steering.arrive(offset, me.vel, speed, p.slow_radius)
    return select(acc[0] < like(o, np.inf), scale(feed, p.weight), wander_force(p, me))


class Forage(Moving):
    """Arrive at the nearest food in sight, and wander while there is none (named in Reynolds 1999).

    Limits: food is not eaten by it: an agent stays at the nearest food until an effect such as `grazing` or a sink
    of the population takes that away. It has no memory of food that is out of sight.
    """

    kind: Literal["forage"] = "forage"
    food: int = Field(ge=0, strict=True, description="group whose agents are food")
    radius: float = Field(default=3.0, gt=0, description="m, range within which food is seen")
    fov: float = Field(
        title="field of view", default=360.0, gt=0, le=360, description="degrees, full angle of the field of view"
    )
    slow_radius: float = Field(default=0.5, gt=0, description="m, distance from food within which it slows down")
    period: float = Field(default=2.0, gt=0, description="s, correlation time of its turns while it wanders")
    strength: float = Field(default=1.0, ge=0, description="m sideways per m ahead while it wanders")
    pair_start: ClassVar[Law | None] = no_food
    pair_law: ClassVar[Law | None] = nearest_food
    finish_law: ClassVar[Law | None] = forage_force
    demo_time: ClassVar[float] = 20.0
    demo: ClassVar[str | None] = """
dt: 0.05
space: {kind: torus, size: [16, 12]}
groups:
  - {count: 4, radius: 0.2, max_force: 4, spawn: {low: [0, 0], high: [16, 12], speed: [0.5, 1]}}
  - {count: 6, radius: 0.15, spawn: {low: [0, 0], high: [16, 12]}}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: forage, food: 1, weight: 2, speed: 1.2, radius: 2.5}]}
"""

    @property
    def sight(self) -> Sight:
        """Radius, field of view and group of food."""
        return Sight(self.radius, self.fov, group=self.food)

    def parameters(self) -> dict[str, float | Vec]:
        """Return speed, weight and the numbers of wandering; the neighbour query uses the rest."""
        names = ("weight", "slow_radius", "period", "strength")
        return {"speed": self.limit, **{name: float(getattr(self, name)) for name in names}}

    def sums(self, dimension: int) -> int:
        """Return the size of squared distance, index and offset of the nearest."""
        return 2 + dimension


# --- explore ----------------------------------------------------------------------------------------------------------


@law
def explore_force(p: Any, me: Me) -> Vec:
    """Return F = w (v_track - v)."""
    to_low, to_high = sub(me.pos, p.low), sub(p.high, me.pos)
    return scale(steering.explore(to_low, to_high, me.vel, top_speed(p, me), p.track), p.weight)


class Explore(Moving):
    """Sweep a region for ever along a closed comb of tracks, so that all of it comes into sight once per round.

    There is no memory of what was seen: the position determines the direction (steering.explore).

    Named in Reynolds 1999; the comb is ours.

    Limits: it sees no obstacles. In 3-D the comb lies in the plane of the first two axes, and every agent keeps its
    height. Agents overshoot at turns if `track` is less than V^2 m / max_force.
    """

    kind: Literal["explore"] = "explore"
    low: Vector = Field(description="m, lower corner of the region")
    high: Vector = Field(description="m, upper corner of the region")
    track: float = Field(
        gt=0, description="m, largest distance of tracks; a range of sight of 1.25 tracks misses nothing"
    )
    places: ClassVar[tuple[str, ...]] = ("low", "high")
    own_law: ClassVar[Law | None] = explore_force
    demo_time: ClassVar[float] = 60.0
    demo: ClassVar[str | None] = """
dt: 0.05
groups: [{count: 2, radius: 0.2, max_force: 4, spawn: {low: [2, 2], high: [8, 6]}}]
effects:
  - {kind: explore, weight: 5, low: [0, 0], high: [10, 8], speed: 1.2, track: 1.5}
"""

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the space is periodic, or the region is less than 3 tracks wide."""
        super().check(scene)
        if scene.space.periodic:
            raise ValueError(
                f"low = {self.low}: a region cannot lie in a space of kind {scene.space.kind!r}, which has no edges"
            )
        if any(b - a < 3 * self.track for a, b in zip(self.low[:2], self.high[:2], strict=True)):
            raise ValueError(
                f"high = {self.high}: must be at least 3 tracks = {3 * self.track:g} m above low, per axis"
            )
