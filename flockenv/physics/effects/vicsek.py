"""Vicsek's flock: nobody has a force, everybody flies as his neighbours do on the whole, with an error."""

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
"""Under these one evaluation of the force is one step, and v + dt F / m its end."""


@law
def vicsek_pair(p: Any, me: Me, other: Other) -> Vec:
    """One velocity."""
    return other.vel


@law
def vicsek(p: Any, me: Any, sums: Vec) -> Vec:
    """F = m (v' - v) / dt with v' = v0 R(xi) unit(sum of v_j), himself among them; he who is alone at rest stays so."""
    o, e = like(p.speed, 0.0), like(p.speed, 1.0)
    course = add(sums, me.vel)
    ahead = unit(select(dot(course, course) > o, course, me.vel))
    step = int(np.floor(np.float64(me.time) / np.float64(p.step) + 0.5))
    error = p.noise * like(e, uniform(me.key, step, int(me.who), CHANNEL) - 0.5)
    c, s = np.cos(error), np.sin(error)
    then = scale((ahead[0] * c - ahead[1] * s, ahead[0] * s + ahead[1] * c), p.speed)
    return scale(sub(then, me.vel), p.share * me.mass / p.step)


class Vicsek(Effect):
    """Take on the mean direction of all within reach, oneself too, with an error: v' = v0 R(xi) unit(sum of v_j).

    xi is uniform in [-eta/2, eta/2]: a function of (seed, world, step, agent). It is a map and no force, given as the
    force m (v' - v) / step that makes exactly this map of one step of an Euler method with dt = step; other methods,
    and other dt, are refused. Under explicit_euler positions move with the old velocity, x' = x + v dt, as in the
    paper; under semi_implicit_euler with the new one, as many later works do. Whose sum of velocities is 0 keeps his
    direction. In the plane.

    Source: Vicsek, Czirok, Ben-Jacob, Cohen, Shochet 1995, Phys. Rev. Lett. 75, 1226, eqs. 1 and 2.
    """

    kind: Literal["vicsek"] = "vicsek"
    speed: float = Field(gt=0, description="v0, m/s, of everybody, always")
    radius: float = Field(gt=0, description="r, m, neighbours are nearer than this")
    noise: float = Field(ge=0, le=2 * math.pi, description="eta, rad, the range of the error: 2 pi = no order at all")
    step: float = Field(default=1.0, gt=0, description="s, the time of one update; dt must be the same")
    share: float = Field(default=1.0, ge=0, le=1, description="of the change that one update makes; 1 = Vicsek's")
    pair_law: ClassVar[Law | None] = vicsek_pair
    finish_law: ClassVar[Law | None] = vicsek
    strengths: ClassVar[tuple[str, ...]] = ("share",)

    @property
    def sight(self) -> Sight:
        """All around."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """A vector."""
        return dimension

    def calls_for(self) -> tuple[str, ...]:
        """Neighbours, and one random number each."""
        return (*super().calls_for(), "random numbers")

    def check(self, scene: SceneView) -> None:
        """Refuse space, and what makes no such map of a step."""
        if scene.dimension != 2:
            raise ValueError(f"kind = vicsek: dimension = {scene.dimension}, must be 2")
        if scene.integrator.kind not in METHODS:
            raise ValueError(
                f"kind = vicsek: is a map from step to step, integrator.kind = {scene.integrator.kind} asks for a "
                f"force; allowed: {', '.join(METHODS)}"
            )
        if abs(scene.dt - self.step) > 1e-12 * self.step:
            raise ValueError(f"step = {self.step:g}: dt = {scene.dt:g} s, must be the same")
        super().check(scene)
