"""Hide: keep an obstacle between the agent and a seeker (Reynolds 1999)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import AboutNearest, Moving, mean_nearest, top_speed
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, dot, norm, scale, select, zero
from flockenv.physics.effects.effect import Me, Obstacle

__all__ = ["Hide"]


@law
def seeker_offset(p: Any, me: Me, sums: Vec) -> Vec:
    """Return the offset of the seeker's predicted position, m; 0 if there is no seeker."""
    offset, velocity, found = mean_nearest(sums)
    time = steering.approach_time(offset, norm(velocity), p.longest)
    return select(found, add(offset, scale(velocity, time)), zero(offset))


@law
def no_place(p: Any, me: Me, threat: Vec) -> Vec:
    """Return the initial value: no hiding place, infinitely far; and the offset of the seeker, `threat`, m."""
    return (like(me.radius, np.inf),) + zero(threat) + threat  # noqa: RUF005  # numba joins tuples, does not unpack them


@law
def _place_and_threat(acc: Vec) -> tuple[Vec, Vec]:
    """Return the offsets of the nearest hiding place and of the seeker."""
    if len(acc) == 5:
        return (acc[1], acc[2]), (acc[3], acc[4])
    else:
        return (acc[1], acc[2], acc[3]), (acc[4], acc[5], acc[6])


@law
def _nearer_place(p: Any, me: Me, other: Obstacle, acc: Vec, near: bool) -> Vec:
    """Keep the nearest hiding place behind an obstacle; one that is not near has none."""
    goal, threat = _place_and_threat(acc)
    place = steering.hiding_place(other.offset, other.radius, me.radius + p.margin, threat)
    square = dot(place, place)
    nearer = (square < acc[0]) & (other.radius > like(square, 0.0)) & near  # round obstacles only
    return (square if nearer else acc[0],) + select(nearer, place, goal) + threat  # noqa: RUF005


@law
def nearest_place(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Keep the nearest hiding place behind an obstacle."""
    return _nearer_place(p, me, other, acc, True)


@law
def nearest_place_in_range(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Keep the nearest hiding place behind an obstacle within range."""
    return _nearer_place(p, me, other, acc, other.gap <= p.range)


@law
def place_reach(p: Any, me: Me) -> float:
    """Return the distance within which obstacles are considered, m."""
    return p.range  # type: ignore[no-any-return]


@law
def hide_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w S: arrive at the place; flee if there is none; 0 without a seeker."""
    goal, threat = _place_and_threat(acc)
    top, o = top_speed(p, me), like(me.radius, 0.0)
    there = steering.arrive(goal, me.vel, top, p.slow_radius)
    change = select(acc[0] < like(o, np.inf), there, steering.flee(threat, me.vel, top))
    return select(dot(threat, threat) > o, scale(change, p.weight), zero(change))


class Hide(AboutNearest, Moving):
    """Arrive at the nearest place behind a round obstacle, seen from the nearest of a group; evade if there is none.

    The place is c + (radius + own radius + margin) unit(c - x_s) (Reynolds 1999; yuka), x_s the seeker's position after
    min(longest, d / |v_s|). Combine it with avoid_obstacles for obstacles on the path. The nearest place may be behind
    any obstacle, so without a `range` the cost is linear in their number; with one, a grid finds those near.

    Limits: only circles and spheres that stand still and are solid hide. It is no test of sight: whether the seeker
    looks, or sees the place from elsewhere, does not count, and of several seekers only the nearest does.
    """

    kind: Literal["hide"] = "hide"
    margin: float = Field(default=0.5, ge=0, description="m, gap between an obstacle and the hidden agent")
    slow_radius: float = Field(gt=0, description="m, distance from the place within which it slows down")
    longest: float = Field(default=0.5, ge=0, description="s, longest prediction of the seeker")
    range: float | None = Field(
        default=None, gt=0, description="m, within which obstacles hide (default: any distance)"
    )
    finish_law: ClassVar[Law | None] = seeker_offset
    obstacle_start: ClassVar[Law | None] = no_place
    obstacle_finish: ClassVar[Law | None] = hide_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 4, max_speed: 2, max_force: 10, role: evader, spawn: {low: [-2, -6], high: [2, -4]}}
  - {count: 1, max_speed: 0.5, role: pursuer, spawn: {low: [-8, 0], high: [-8, 0], speed: [0.5, 0.5], heading: [0, 1]}}
obstacles: [{centre: [-2, -1], radius: 1}, {centre: [2.5, 0], radius: 0.8}]
effects:
  - kind: steer
    group: 0
    behaviours:
      - {kind: avoid_obstacles, weight: 8, horizon: 1}
      - {kind: separation, weight: 1, radius: 0.7}
      - {kind: hide, weight: 8, group: 1, radius: 30, slow_radius: 1}
"""

    @property
    def obstacle_law(self) -> Law | None:  # type: ignore[override]  # depends on the range
        """The law with a range, or without."""
        return nearest_place if self.range is None else nearest_place_in_range

    @property
    def obstacle_reach(self) -> Law | None:  # type: ignore[override]
        """The range, as a law; None without."""
        return None if self.range is None else place_reach

    def fold_size(self, dimension: int) -> int:
        """Return the size of squared distance, and offsets of the nearest place and of the seeker."""
        return 1 + 2 * dimension
