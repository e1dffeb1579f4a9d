"""Among many who want to get somewhere: unaligned collision avoidance, a queue, foraging, sweeping a region."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import Behaviour, Moving, gains, top_speed
from flockenv.behaviours.wander import wandered
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import scale, select, sub, unit, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Me, Other, Sight, Vector

__all__ = ["Explore", "Forage", "Queue", "UnalignedAvoidance"]


# --- unaligned collision avoidance ------------------------------------------------------------------------------------


@law
def no_meeting(p: Any, me: Me) -> Vec:
    """Nobody is met yet, at any time."""
    return (like(me.radius, np.inf),) + zero(me.pos)  # noqa: RUF005  # numba joins tuples, but does not unpack them


@law
def first_meeting(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep whom I meet first: (time, where to give way to)."""
    clearance = me.radius + other.radius + p.margin
    time = steering.unaligned_threat(other.offset, me.vel, other.vel, clearance, p.horizon)
    away = steering.give_way(other.offset, me.vel, other.vel, time, like(clearance, 1.0))
    return select(time < acc[0], (time,) + away, acc)  # noqa: RUF005


@law
def giving_way(p: Any, me: Me, acc: Vec) -> Vec:
    """F = w (1 m/s) away from the meeting."""
    away: Vec
    if len(acc) == 3:
        away = (acc[1], acc[2])
    else:
        away = (acc[1], acc[2], acc[3])
    return scale(away, p.weight)


class UnalignedAvoidance(Behaviour):
    """Give way to whom one would meet first within `horizon` seconds: aside, and braking or speeding up."""

    kind: Literal["unaligned_avoidance"] = "unaligned_avoidance"
    weight: float = Field(ge=0, description="N, the force with which it gives way")
    radius: float = Field(default=10.0, gt=0, description="m, who is further away is not looked at")
    fov: float = Field(default=360.0, gt=0, le=360, description="degrees, full angle of the field of view")
    horizon: float = Field(default=3.0, gt=0, description="s, how far ahead it looks")
    margin: float = Field(default=0.0, ge=0, description="m, clearance beyond both radii")
    group: int | None = Field(default=None, ge=0, description="to whom it gives way; none = all")
    pair_start: ClassVar[Law | None] = no_meeting
    pair_law: ClassVar[Law | None] = first_meeting
    finish_law: ClassVar[Law | None] = giving_way
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
        """Radius, field of view, whom."""
        return Sight(self.radius, self.fov, group=self.group)

    def parameters(self) -> dict[str, float | Vec]:
        """How strongly, how far ahead, how wide: who is seen is the sweep's business."""
        return {"weight": self.weight, "horizon": self.horizon, "margin": self.margin}

    def lookahead(self, speed: float) -> float:
        """As far as it comes within the horizon, and as it sees."""
        return min(speed * self.horizon, self.radius)

    def rates(self, groups: Sequence[Any], dimension: int) -> None:
        """None: it pushes aside with one and the same force."""

    def sums(self, dimension: int) -> int:
        """A time and a direction."""
        return 1 + dimension


# --- queue ------------------------------------------------------------------------------------------------------------


@law
def free_way(p: Any, me: Me) -> Vec:
    """The way to the door, and nobody on it."""
    return unit(sub(p.target, me.pos)) + (like(me.radius, np.inf),)  # noqa: RUF005


@law
def held_up(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep the shortest gap."""
    way: Vec
    if len(acc) == 3:
        way = (acc[0], acc[1])
    else:
        way = (acc[0], acc[1], acc[2])
    clearance = me.radius + other.radius + p.margin
    gap = steering.queue_gap(way, other.offset, other.vel, clearance, top_speed(p, me))
    nearest = acc[len(acc) - 1]
    return way + (gap if gap < nearest else nearest,)  # noqa: RUF005


@law
def queueing(p: Any, me: Me, acc: Vec) -> Vec:
    """F = w (v_queue - v)."""
    way: Vec
    if len(acc) == 3:
        way = (acc[0], acc[1])
    else:
        way = (acc[0], acc[1], acc[2])
    return scale(steering.queue(way, me.vel, acc[len(acc) - 1], top_speed(p, me), p.headway), p.weight)


class Queue(Moving):
    """Seek a door, and slow down behind whoever is near, ahead on the way there, and slower: no pushing."""

    kind: Literal["queue"] = "queue"
    weight: float = Field(ge=0, description="kg/s, gain; 4 m / headway or more overshoots nothing")
    target: Vector = Field(description="m, the door")
    headway: float = Field(default=0.8, gt=0, description="s, a gap is closed as exp(-t / headway)")
    margin: float = Field(default=0.0, ge=0, description="m, left between bodies that stand in the queue")
    radius: float = Field(default=5.0, gt=0, description="m, who is further away holds up nobody")
    group: int | None = Field(default=None, ge=0, description="behind whom it queues; none = all")
    places: ClassVar[tuple[str, ...]] = ("target",)
    pair_start: ClassVar[Law | None] = free_way
    pair_law: ClassVar[Law | None] = held_up
    finish_law: ClassVar[Law | None] = queueing
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
        """Radius, whom; what is ahead is ahead on the way to the door."""
        return Sight(self.radius, group=self.group)

    def parameters(self) -> dict[str, float | Vec]:
        """Where to, how fast, how close: who is seen is the sweep's business."""
        names = ("weight", "headway", "margin")
        return {"target": self.target, "speed": self.limit, **{name: float(getattr(self, name)) for name in names}}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Damping of weight / m; while a gap closes, w^2 = weight / (m headway)."""
        gain = gains(self.weight, groups, dimension)
        return gain / self.headway, gain

    def sums(self, dimension: int) -> int:
        """The way and the gap."""
        return dimension + 1


# --- forage -----------------------------------------------------------------------------------------------------------


@law
def no_food(p: Any, me: Me) -> Vec:
    """Nothing found yet."""
    far = like(me.radius, np.inf)
    return (far, far) + zero(me.pos)  # noqa: RUF005


@law
def nearest_food(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep the nearest, of two the one with the lower number: (square, who, offset)."""
    nearer = (other.square < acc[0]) | ((other.square == acc[0]) & (other.who < acc[1]))
    return select(nearer, (other.square, other.who) + other.offset, acc)  # noqa: RUF005


@law
def foraging(p: Any, me: Me, acc: Vec) -> Vec:
    """F = w (v_arrive - v) if there is food in sight, else F = w (v_wander - v)."""
    o = like(me.radius, 0.0)
    offset: Vec
    if len(acc) == 4:
        offset = (acc[2], acc[3])
    else:
        offset = (acc[2], acc[3], acc[4])
    speed = top_speed(p, me)
    feed = steering.arrive(offset, me.vel, speed, p.slow_radius)
    return select(acc[0] < like(o, np.inf), scale(feed, p.weight), wandered(p, me))


class Forage(Moving):
    """Arrive at the nearest food in sight, and wander as long as there is none (Reynolds 1999 names it)."""

    kind: Literal["forage"] = "forage"
    food: int = Field(ge=0, strict=True, description="the group whose agents are food")
    radius: float = Field(default=3.0, gt=0, description="m, food is seen within this")
    fov: float = Field(default=360.0, gt=0, le=360, description="degrees, full angle of the field of view")
    slow_radius: float = Field(default=0.5, gt=0, description="m, it slows down within this of its food")
    period: float = Field(default=2.0, gt=0, description="s, how long it remembers to which side it turned")
    strength: float = Field(default=1.0, ge=0, description="m aside per m ahead: how far it turns while it wanders")
    pair_start: ClassVar[Law | None] = no_food
    pair_law: ClassVar[Law | None] = nearest_food
    finish_law: ClassVar[Law | None] = foraging
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
        """Radius, field of view, food."""
        return Sight(self.radius, self.fov, group=self.food)

    def parameters(self) -> dict[str, float | Vec]:
        """How fast, and how it wanders: who is seen is the sweep's business."""
        names = ("weight", "slow_radius", "period", "strength")
        return {"speed": self.limit, **{name: float(getattr(self, name)) for name in names}}

    def sums(self, dimension: int) -> int:
        """Square of the distance, who, and where the nearest is."""
        return 2 + dimension


# --- explore ----------------------------------------------------------------------------------------------------------


@law
def sweeping(p: Any, me: Me) -> Vec:
    """F = w (v_track - v)."""
    to_low, to_high = sub(me.pos, p.low), sub(p.high, me.pos)
    return scale(steering.explore(to_low, to_high, me.vel, top_speed(p, me), p.track), p.weight)


class Explore(Moving):
    """Sweep a region for ever along a closed comb of tracks, so that everything comes into sight once per round.

    What was seen already is no state: where one is says where to go (steering.explore).
    """

    kind: Literal["explore"] = "explore"
    low: Vector = Field(description="m, lower corner of the region")
    high: Vector = Field(description="m, upper corner of the region")
    track: float = Field(gt=0, description="m, tracks lie at most so far apart; sight of 1.25 tracks misses nothing")
    places: ClassVar[tuple[str, ...]] = ("low", "high")
    own_law: ClassVar[Law | None] = sweeping
    demo_time: ClassVar[float] = 60.0
    demo: ClassVar[str | None] = """
dt: 0.05
groups: [{count: 2, radius: 0.2, max_force: 4, spawn: {low: [2, 2], high: [8, 6]}}]
effects:
  - {kind: explore, weight: 5, low: [0, 0], high: [10, 8], speed: 1.2, track: 1.5}
"""

    def check(self, scene: SceneView) -> None:
        """Refuse a region that has no edges or no area, and tracks that are too narrow to turn."""
        super().check(scene)
        if scene.space.periodic:
            raise ValueError(f"low = {self.low}: a region has edges; space.kind = {scene.space.kind!r} has none")
        if any(b - a < 3 * self.track for a, b in zip(self.low[:2], self.high[:2], strict=True)):
            raise ValueError(
                f"high = {self.high}: must be at least 3 tracks = {3 * self.track:g} m above low, per axis"
            )
