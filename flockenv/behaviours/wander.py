"""Wander: a random walk of smoothly varying direction, independent of the step size."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import Moving, top_speed
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.counter_rng import smooth, uniform
from flockenv.maths.vectors import add, dot, planar, scale, select, sub

__all__ = ["Wander"]

CHANNEL = 60_000
GOLDEN = 0.6180339887498949


@law
def _sideways(heading: Vec, left: float, up: float) -> Vec:
    """Return a sideways offset in the agent's own frame."""
    o = like(left, 0.0)
    if len(heading) == 2:
        return (o, left)
    else:
        return (o, left, up)


@law
def wander_force(p: Any, me: Any) -> Vec:
    """Return F = w (V unit(forward + strength (n1 left + n2 up)) - v) with n1, n2 smooth in time."""
    o, e = like(p.strength, 0.0), like(p.strength, 1.0)
    who = int(me.who)
    when = np.float64(me.time) / np.float64(p.period) + GOLDEN * who  # phases differ between agents
    left, up = like(e, smooth(me.key, when, who, CHANNEL)), like(e, smooth(me.key, when, who, CHANNEL + 1))
    # each agent at rest starts in a random direction
    begin = 2.0 * np.pi * uniform(me.key, 0, who, CHANNEL + 2)
    heading = select(dot(me.vel, me.vel) > o, me.vel, planar(me.vel, like(e, np.cos(begin)), like(e, np.sin(begin))))
    target = _sideways(heading, left * p.strength, up * p.strength)
    velocity = add(steering.wander(target, heading, top_speed(p, me), e), heading)
    return scale(sub(velocity, me.vel), p.weight)


class Wander(Moving):
    """Wander: seek a point ahead that moves to and fro sideways: S = V unit(f + strength n) - v.

    n is coherent noise (Perlin 1985) of each agent, in [-1, 1] per axis across its heading, as a function of time: the
    same walk for every dt. Reynolds 1999 displaces the point a little in each step; here it also moves continuously.

    Limits: the walk has no bounds and no memory, and sees nothing: agents spread for ever. Any other force turns the
    heading from which the walk goes on.
    """

    kind: Literal["wander"] = "wander"
    strength: float = Field(default=1.0, ge=0, description="m sideways per m ahead: 1 = up to 45 degrees")
    period: float = Field(default=1.0, gt=0, description="s, correlation time of its turns")
    own_law: ClassVar[Law | None] = wander_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 6, max_speed: 1, max_force: 4, spawn: {low: [-1, -1], high: [1, 1], speed: [1, 1]}}
effects:
  - {kind: wander, weight: 2, strength: 1, period: 1}
"""
    demo_time: ClassVar[float] = 12.0
