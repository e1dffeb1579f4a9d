"""Steering around round obstacles (Reynolds 1999, "steer to avoid"): zero unless something is really in the way."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv import steering
from flockenv.effects.base import Effect, Me, Other
from flockenv.kernels import Vec, law, like
from flockenv.vec import norm, scale, select, zero

__all__ = ["AvoidObstacles"]


@law
def nothing(p: Any, me: Me) -> Vec:
    """No threat yet: at infinity."""
    o, far = like(me.who, 0.0), like(me.who, np.inf)
    return (far, o) + zero(me.pos)  # noqa: RUF005  # numba joins tuples, but does not unpack them


@law
def nearest_threat(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep the obstacle that the straight path touches first: (distance, clearance, offset)."""
    clearance = me.radius + other.radius + p.margin
    distance = steering.threat(me.heading, other.offset, clearance, norm(me.vel) * p.horizon)
    return select(distance < acc[0], (distance, clearance) + other.offset, acc)  # noqa: RUF005


@law
def around(p: Any, me: Me, acc: Vec) -> Vec:
    """F = w (1 m/s) sideways, away from the threat's centre."""
    offset: Vec
    if len(acc) == 4:
        offset = (acc[2], acc[3])
    else:
        offset = (acc[2], acc[3], acc[4])
    wish = steering.avoid(me.heading, offset, acc[1], like(me.who, 1.0))
    return scale(select(acc[0] < like(me.who, np.inf), wish, zero(me.pos)), p.weight)


class AvoidObstacles(Effect):
    """Steer sideways around the obstacle that the straight path would touch first within `horizon` seconds."""

    kind: Literal["avoid_obstacles"] = "avoid_obstacles"
    weight: float = Field(ge=0, description="N, the force of an evasion")
    horizon: float = Field(default=2.0, gt=0, description="s, how far ahead it looks at the present speed")
    margin: float = Field(default=0.0, ge=0, description="m, clearance beyond both radii")
    demo: ClassVar[str | None] = """
groups:
  - {count: 7, radius: 0.2, max_speed: 2, spawn: {low: [0, -2.5], high: [1, 2.5], speed: [2, 2], heading: [1, 0]}}
effects: [{kind: avoid_obstacles, weight: 5, horizon: 1.5, margin: 0.2}]
obstacles: [{centre: [6, 0.5], radius: 1}, {centre: [9, -1.5], radius: 0.8}, {centre: [11, 2], radius: 1}]
dt: 0.02
"""
    steering: ClassVar[bool] = True
    obstacle_start: ClassVar[str | None] = "nothing"
    obstacle_law: ClassVar[str | None] = "nearest_threat"
    obstacle_finish: ClassVar[str | None] = "around"

    def lookahead(self, speed: float) -> float:
        """As far as it comes within the horizon."""
        return speed * self.horizon

    def folded(self, dimension: int) -> int:
        """Distance, clearance and offset of the nearest threat."""
        return 2 + dimension
