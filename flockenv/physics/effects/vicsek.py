"""Vicsek's model: each agent takes on the mean direction of its neighbours, with an error."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import add, dot, scale, select, sub, unit
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Effect, Me, Other, Sight

__all__ = ["Vicsek"]

CHANNEL = 70_000
METHODS = ("explicit_euler", "semi_implicit_euler")
"""Methods with one evaluation of the force per step and final velocity v + dt F / m."""


@law
def vicsek_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return the velocity of one neighbour."""
    return other.vel


@law
def vicsek(p: Any, me: Any, sums: Vec) -> Vec:
    """Return F = m (v' - v) / dt, v' = v0 R(xi) unit(sum of v_j), the agent included; 0 if alone and at rest."""
    o, e = like(p.speed, 0.0), like(p.speed, 1.0)
    course = add(sums, me.vel)
    ahead = unit(select(dot(course, course) > o, course, me.vel))
    step = int(np.floor(np.float64(me.time) / np.float64(p.step) + 0.5))
    error = p.noise * like(e, uniform(me.key, step, int(me.who), CHANNEL) - 0.5)
    c, s = np.cos(error), np.sin(error)
    then = scale((ahead[0] * c - ahead[1] * s, ahead[0] * s + ahead[1] * c), p.speed)
    return scale(sub(then, me.vel), p.share * me.mass / p.step)


class Vicsek(Effect):
    """Agents take on the mean direction within `radius`, own included, with an error: v' = v0 R(xi) unit(sum of v_j).

    xi is uniform in [-eta/2, eta/2]: a function of (seed, world, step, agent). The model is a map, not a force, and is
    written as the force m (v' - v) / step, with which one step of an Euler method with dt = step is exactly the map;
    other methods, and other dt, raise ValueError. Under explicit_euler positions move with the old velocity, x' = x + v
    dt, as in the paper; under semi_implicit_euler with the new one, as in many later works. If the sum of velocities is
    0, the agent keeps its direction. In 2-D only.

    Source: Vicsek, Czirok, Ben-Jacob, Cohen, Shochet 1995, Phys. Rev. Lett. 75, 1226, eqs. 1 and 2.

    Limits: it is a map, so masses cancel, and v0 is kept only if no other force acts. Neighbours are those within r in
    all directions, at any density, and bodies have no size.
    """

    kind: Literal["vicsek"] = "vicsek"
    speed: float = Field(gt=0, description="v0, m/s, constant, of every agent")
    radius: float = Field(gt=0, description="r, m, of neighbours")
    noise: float = Field(ge=0, le=2 * math.pi, description="eta, rad, the range of the error: 2 pi = no order")
    step: float = Field(default=1.0, gt=0, description="s, the time of one update; dt must be the same")
    share: float = Field(default=1.0, ge=0, le=1, description="fraction of the change per update; 1 = Vicsek's")
    pair_law: ClassVar[Law | None] = vicsek_pair
    finish_law: ClassVar[Law | None] = vicsek
    strengths: ClassVar[tuple[str, ...]] = ("share",)

    @property
    def sight(self) -> Sight:
        """All directions, within the radius."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """Return D, for a vector."""
        return dimension

    def calls_for(self) -> tuple[str, ...]:
        """Return the names of the neighbour query and of random numbers."""
        return (*super().calls_for(), "random numbers")

    def check(self, scene: SceneView) -> None:
        """Raise ValueError in 3-D, for methods but explicit_euler and semi_implicit_euler, and if dt is not `step`."""
        if scene.dimension != 2:
            raise ValueError(f"kind = vicsek: dimension = {scene.dimension}, must be 2")
        if scene.integrator.kind not in METHODS:
            raise ValueError(
                f"kind = vicsek: is a map from step to step, integrator.kind = {scene.integrator.kind} needs a "
                f"force; allowed: {', '.join(METHODS)}"
            )
        if abs(scene.dt - self.step) > 1e-12 * self.step:
            raise ValueError(f"step = {self.step:g}: dt = {scene.dt:g} s, must be the same")
        super().check(scene)
