"""Behaviours relative to others: formation, leader following, interposing between two (Reynolds 1999)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import AboutNearest, Moving, mean_nearest, top_speed
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import norm, scale, select, zero
from flockenv.physics.effects.effect import Me, Other, Sight

__all__ = ["FollowLeader", "Formation", "Interpose"]


@law
def _station(p: Any, offset: Vec) -> Vec:
    """Return the station in the leader's frame."""
    if len(offset) == 2:
        return (p.ahead, p.left)
    else:
        return (p.ahead, p.left, p.up)


@law
def formation_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w (v_L + V min(1, d / d_slow) unit(d) - v)."""
    offset, velocity, found = mean_nearest(sums)
    place, top = _station(p, offset), top_speed(p, me)
    change = steering.keep_station(offset, me.vel, velocity, place, top, p.slow_radius)
    return select(found, scale(change, p.weight), zero(change))


@law
def follow_leader_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w S: stay behind the leader, and out of its path."""
    offset, velocity, found = mean_nearest(sums)
    behind = p.distance + p.headway * norm(velocity)
    change = steering.follow_leader(offset, me.vel, velocity, behind, p.ahead, p.aside, top_speed(p, me), p.slow_radius)
    return select(found, scale(change, p.weight), zero(change))


@law
def _two_agents(acc: Vec) -> tuple[Vec, Vec]:
    """Return (squared distance, offset, velocity) of the first and of the second agent."""
    if len(acc) == 10:
        return acc[:5], acc[5:]
    else:
        return acc[:7], acc[7:]


@law
def _choose(condition: bool, a: Vec, b: Vec) -> Vec:
    """Return a where the condition holds, else b, of 5 or 7 numbers."""
    if len(a) == 5:
        return select(condition, a, b)
    else:
        return select(condition, a[:4], b[:4]) + select(condition, a[4:], b[4:])


@law
def _offset_and_velocity(one: Vec) -> tuple[Vec, Vec]:
    """Return offset and velocity, 0 if there is no agent."""
    if len(one) == 5:
        return (one[1], one[2]), (one[3], one[4])
    else:
        return (one[1], one[2], one[3]), (one[4], one[5], one[6])


@law
def no_agents(p: Any, me: Me) -> Vec:
    """Return the initial value: both infinitely far."""
    o = zero(me.pos)
    none = (like(me.radius, np.inf),) + o + o  # noqa: RUF005
    return none + none


@law
def nearest_two(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep the nearest of each group; if both are the same group, its two nearest."""
    a, b = _two_agents(acc)
    it = (other.square,) + other.offset + other.vel  # noqa: RUF005
    in_a = (other.who >= p.first) & (other.who < p.end)
    in_b = (other.who >= p.other_first) & (other.who < p.other_end)
    nearer = in_a & (other.square < a[0])
    left = _choose(nearer, a, it)  # the one that is not kept as a: if both are one group, it is the candidate for b
    return _choose(nearer, it, a) + _choose(in_b & (left[0] < b[0]), left, b)


@law
def interpose_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w S, 0 unless both are visible."""
    a, b = _two_agents(acc)
    far = like(me.max_speed, np.inf)
    both = (a[0] < far) & (b[0] < far)
    offset_a, velocity_a = _offset_and_velocity(a)
    offset_b, velocity_b = _offset_and_velocity(b)
    top = top_speed(p, me)
    change = steering.interpose(offset_a, velocity_a, offset_b, velocity_b, me.vel, p.share, top, p.slow_radius)
    return select(both, scale(change, p.weight), zero(change))


class Formation(AboutNearest, Moving):
    """Keep a station in the frame of the nearest of a group: S = v_L + V min(1, d / d_slow) unit(d) - v.

    The formation variant of offset pursuit (Reynolds 1999). Arriving at the predicted station, as in yuka, would lag
    behind: at the station itself its desired velocity is zero. A leader at rest faces along the x axis.

    Limits: all agents under one record share one station. Stations turn at once with the leader's velocity, so the
    outer ones cannot follow a sharp turn, and they jump if a leader at rest starts in another direction than x.
    """

    kind: Literal["formation"] = "formation"
    ahead: float = Field(description="m, station ahead of the leader; negative = behind")
    left: float = Field(default=0.0, description="m, to its left; negative = to its right")
    up: float = Field(default=0.0, description="m, above it, in 3-D")
    slow_radius: float = Field(gt=0, description="d_slow, m, distance within which it slows down")
    finish_law: ClassVar[Law | None] = formation_force
    demo: ClassVar[str | None] = """
groups:
  - count: 1
    max_speed: 1
    max_force: 2
    role: learner
    spawn: {low: [-6, 0], high: [-6, 0], speed: [1, 1], heading: [1, 0]}
  - {count: 1, max_speed: 2, max_force: 10, spawn: {low: [-9, 3], high: [-9, 3]}}
  - {count: 1, max_speed: 2, max_force: 10, spawn: {low: [-9, -3], high: [-9, -3]}}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: wander, weight: 1, strength: 0.7, period: 2}]}
  - kind: steer
    group: 1
    behaviours: [{kind: formation, weight: 10, group: 0, radius: 30, ahead: -1, left: 1, slow_radius: 1}]
  - kind: steer
    group: 2
    behaviours: [{kind: formation, weight: 10, group: 0, radius: 30, ahead: -1, left: -1, slow_radius: 1}]
"""
    demo_time: ClassVar[float] = 12.0


class FollowLeader(AboutNearest, Moving):
    """Stay behind the nearest of a group, and out of its path: agents in the box in front of it move out sideways.

    The target is D = distance + headway x leader's speed behind it (Reynolds 1999). Separation keeps followers apart.

    Limits: all followers have the same target and need `separation`. Around a leader at rest there is no box, and the
    target lies behind it along the x axis.
    """

    kind: Literal["follow_leader"] = "follow_leader"
    distance: float = Field(gt=0, description="m, behind the leader")
    headway: float = Field(default=0.0, ge=0, description="s, added distance per m/s of the leader's speed")
    ahead: float = Field(default=2.0, ge=0, description="m, length of the box in front of the leader")
    aside: float = Field(default=0.5, ge=0, description="m, half the width of the box")
    slow_radius: float = Field(gt=0, description="m, distance within which it slows down")
    finish_law: ClassVar[Law | None] = follow_leader_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 1, max_speed: 1, role: learner, spawn: {low: [-6, 0], high: [-6, 0], speed: [1, 1], heading: [1, 0]}}
  - {count: 6, max_speed: 2, max_force: 8, spawn: {low: [-5.5, -1.5], high: [-3, 1.5]}}
effects:
  - kind: steer
    group: 1
    arbitration: {kind: blend}
    behaviours:
      - {kind: follow_leader, weight: 8, group: 0, radius: 30, distance: 1, slow_radius: 1}
      - {kind: separation, weight: 3, radius: 1}
"""
    demo_time: ClassVar[float] = 10.0


class Interpose(Moving):
    """Arrive between the nearest of one group and the nearest of another, at the predicted time of arrival.

    If both are the same group, between its two nearest (Reynolds 1999; T = d / V). Zero unless both are visible.

    Limits: both are assumed to go straight on. The force is 0 unless an agent of each group is in sight, and obstacles
    between them are not seen.
    """

    kind: Literal["interpose"] = "interpose"
    group: int = Field(ge=0, description="the first group")
    other: int = Field(ge=0, description="the other group, or the same")
    radius: float = Field(gt=0, description="m, range of sight")
    fov: float = Field(
        title="field of view", default=360.0, gt=0, le=360, description="degrees, full angle of the field of view"
    )
    share: float = Field(default=0.5, ge=0, le=1, description="share of the path from the first to the other")
    slow_radius: float = Field(gt=0, description="m, distance within which it slows down")
    pair_start: ClassVar[Law | None] = no_agents
    pair_law: ClassVar[Law | None] = nearest_two
    finish_law: ClassVar[Law | None] = interpose_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 1, max_speed: 2, max_force: 10, role: learner, spawn: {low: [-4, -4], high: [-4, -4]}}
  - {count: 1, max_speed: 1, max_force: 2, spawn: {low: [-3, 3], high: [-3, 3], speed: [1, 1], heading: [1, 0]}}
  - {count: 1, max_speed: 1, max_force: 2, spawn: {low: [-3, -1], high: [-3, -1], speed: [1, 1], heading: [1, 0]}}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: interpose, weight: 10, group: 1, other: 2, radius: 30, slow_radius: 1}]}
"""

    @property
    def sight(self) -> Sight:
        """All agents: its law tests the groups."""
        return Sight(self.radius, self.fov)

    def sums(self, dimension: int) -> int:
        """Return how many numbers are kept: squared distance, offset and velocity, of two agents."""
        return 2 * (1 + 2 * dimension)

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """Return the first agent of each group, and one past its last."""
        names = ("first", "end", "other_first", "other_end")
        ends = (starts[self.group], starts[self.group + 1], starts[self.other], starts[self.other + 1])
        return dict(zip(names, map(float, ends), strict=True))
