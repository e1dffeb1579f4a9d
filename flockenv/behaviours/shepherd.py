"""Shepherding: drive a group to a place from behind (Strombom et al. 2014)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import Moving, top_speed
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import scale, select, sub, zero
from flockenv.physics.effects.effect import Me, Members, Vector

__all__ = ["Shepherd"]


@law
def shepherd_force(p: Any, me: Me, flock: Members) -> Vec:
    """Return F = w S: arrive behind the stray member, or else behind the whole `flock`; 0 without members."""
    n, o = flock.size, like(flock.size, 0.0)
    together, driving = p.spacing * np.cbrt(n * n), p.spacing * np.sqrt(n)
    place = steering.herding_offset(flock.centre, flock.farthest, sub(p.goal, me.pos), together, p.spacing, driving)
    force = scale(steering.arrive(place, me.vel, top_speed(p, me), p.slow_radius), p.weight)
    return select(n > o, force, zero(me.pos))


class Shepherd(Moving):
    """Drive a group to a place: arrive behind its stray, else behind the whole group, as seen from the place.

    If the member farthest from the centre of the N living ones is more than r_a N^(2/3) m from it, the target is r_a
    behind that member, seen from the centre; else r_a sqrt(N) behind the centre, seen from the goal (Strombom et al.
    2014). In the paper a shepherd also slows down near a sheep and moves with noise; that is left to other behaviours
    (`separation` keeps a shepherd off). Without living members the force is zero.

    Limits: it knows where all members are, at any distance and behind walls. Several shepherds of one group go to the
    same place. It does not walk around the group, so it may pass through it.
    """

    kind: Literal["shepherd"] = "shepherd"
    group: int = Field(ge=0, description="group that it drives")
    goal: Vector = Field(description="m, place to which it drives the group")
    spacing: float = Field(gt=0, description="r_a, m, spacing of the members")
    slow_radius: float = Field(gt=0, description="m, distance from its target within which it slows down")
    group_law: ClassVar[Law | None] = shepherd_force
    places: ClassVar[tuple[str, ...]] = ("goal",)
    demo: ClassVar[str | None] = """
groups:
  - {count: 8, max_speed: 0.8, max_force: 3, spawn: {low: [-3, -2], high: [1, 2]}}
  - {count: 1, max_speed: 2, max_force: 8, spawn: {low: [-8, -5], high: [-7, -4]}}
effects:
  - kind: steer
    group: 0
    behaviours:
      - {kind: evade, weight: 6, group: 1, radius: 4}
      - {kind: separation, weight: 0.6, radius: 1, group: 0}
      - {kind: cohesion, weight: 3, radius: 6, group: 0}
  - {kind: drag, rate: 1}
  - kind: steer
    group: 1
    behaviours:
      - {kind: shepherd, weight: 8, group: 0, goal: [8, 3], spacing: 0.8, slow_radius: 1}
"""
    demo_time: ClassVar[float] = 35.0

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """Return the first agent of the group, and one past its last."""
        return {"first": float(starts[self.group]), "end": float(starts[self.group + 1])}
