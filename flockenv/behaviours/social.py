"""Social forces between pedestrians: repulsion by distance, by ellipses, and by where both are going.

They are wishes: `Steer` says whose. Two who overlap as bodies are `Contact`'s business. See docs/social_forces.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv import steering
from flockenv.effects.base import Effect, Me, Other, Sight, all_masses, demand_group
from flockenv.kernels import Vec, law
from flockenv.vec import limit, scale, sub

__all__ = ["CircularRepulsion", "EllipticalRepulsion", "Sidestep", "Social"]

Floats = NDArray[np.float64]

HEAD_ON = """
dt: 0.02
groups:
  - {count: 3, mass: 80, radius: 0.3, desired_speed: 1.3, spawn: {low: [-6, -1], high: [-4, 1]}}
  - {count: 3, mass: 80, radius: 0.3, desired_speed: 1.3, spawn: {low: [4, -1], high: [6, 1]}}
effects:
  - {kind: course, group: 0, direction: [1, 0]}
  - {kind: course, group: 1, direction: [-1, 0]}
  - {kind: driving, tau: 0.5}
  - FORCE
"""


@law
def as_felt(p: Any, me: Me, sums: Vec) -> Vec:
    """The sum over all who are seen."""
    return sums


@law
def size_of(p: Any, me: Me) -> float:
    """Return A of this agent, N."""
    return p.strength + me.mass * p.acceleration  # type: ignore[no-any-return]


class Social(Effect):
    """What forces between pedestrians have in common: A in newtons, or in m/s^2 for everybody's own mass; or both."""

    strength: float = Field(default=0.0, ge=0, description="A, N")
    acceleration: float = Field(default=0.0, ge=0, description="A, m/s^2: the force is that times its own mass")
    most: float | None = Field(default=None, gt=0, description="N, that one of those it is about does at most")
    radius: float = Field(gt=0, description="m, who is further away is not looked at")
    group: int | None = Field(default=None, ge=0, description="whom it is about; none = all")
    occluded: bool = Field(default=False, description="whom an obstacle hides does nothing")
    steering: ClassVar[bool] = True
    strengths: ClassVar[tuple[str, ...]] = ("strength", "acceleration")
    finish_law: ClassVar[str | None] = "as_felt"

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        """Refuse one whose strength was forgotten; 0 is allowed where it is said."""
        if not {"strength", "acceleration"} & self.model_fields_set:
            raise ValueError("strength: missing; give strength, N, or acceleration, m/s^2")
        return self

    @property
    def sight(self) -> Sight:
        """Radius, whom, and whether walls hide them."""
        return Sight(self.radius, group=self.group, occluded=self.occluded)

    def parameters(self) -> dict[str, float | Vec]:
        """Its strength, and its bound."""
        most = math.inf if self.most is None else self.most
        return {"strength": self.strength, "acceleration": self.acceleration, "bound": most}

    def sums(self, dimension: int) -> int:
        """The force so far."""
        return dimension

    def check(self, scene: Any) -> None:
        """Refuse a group that is not there."""
        demand_group("group", self.group, scene.groups)
        super().check(scene)

    def _steepest(self, decay: float, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return w^2 = A (1 / m + 1 / m_other) / B of two who touch, (N,), the other the lightest, and no damping."""
        mass = all_masses(groups, dimension)
        none = np.zeros(len(mass))
        if len(mass) == 1:
            return none, none
        light = float(mass.min())
        held = ~np.isfinite(mass)
        one, other = self.strength / mass + self.acceleration, self.strength / light + self.acceleration
        return np.where(held, 0.0, (one + other) / decay), none


# --- by distance ------------------------------------------------------------------------------------------------------


@law
def pushed_by_distance(p: Any, me: Me, other: Other) -> Vec:
    """A w(phi) exp((r_ij - d) / B) n."""
    touching = p.bodies * (me.radius + other.radius)
    push = steering.repulsion(other.offset, sub(me.tie, other.tie), touching, p.decay)
    weight = steering.view_weight(steering.looking(me.aim, me.heading), other.offset, p.anisotropy)
    return limit(scale(push, weight * size_of(p, me)), p.bound)


class CircularRepulsion(Social):
    """Keep away from others: F = A w(phi) exp((r_ij - d) / B) n, with r_ij both radii, or 0 (`bodies: false`).

    Helbing, Farkas and Vicsek 2000 (A in N, with bodies, lambda = 1); the circular specification of Johansson, Helbing
    and Shukla 2007 (A in m/s^2, distances between centres, w = lambda + (1 - lambda)(1 + cos phi) / 2, phi from the way
    that it wants to go, or goes, to the other). It is not the opposite of what it does to the other: w differs.
    """

    kind: Literal["circular_repulsion"] = "circular_repulsion"
    decay: float = Field(gt=0, description="B, m, over which the force falls to 1/e")
    bodies: bool = Field(default=True, description="is the distance that between the surfaces, not the centres?")
    anisotropy: float = Field(default=1.0, ge=0, le=1, description="lambda, how much who is straight behind counts")
    pair_law: ClassVar[str | None] = "pushed_by_distance"
    demo: ClassVar[str | None] = HEAD_ON.replace(
        "FORCE", "{kind: circular_repulsion, strength: 2000, decay: 0.08, radius: 3}"
    )

    def parameters(self) -> dict[str, float | Vec]:
        """A, B, lambda."""
        shape = {"decay": self.decay, "bodies": float(self.bodies), "anisotropy": self.anisotropy}
        return {**super().parameters(), **shape}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """A / B over the reduced mass, where two bodies touch (or, of distances alone, are in one place).

        Where bodies overlap it is steeper, exp(overlap / B) times: that depends on the state.
        """
        return self._steepest(self.decay, groups, dimension)


# --- by ellipses ------------------------------------------------------------------------------------------------------


@law
def pushed_by_ellipse(p: Any, me: Me, other: Other) -> Vec:
    """A w (-B grad exp(-b / B))."""
    step = scale(sub(other.vel, scale(me.vel, p.relative)), p.step)
    push = steering.elliptical_repulsion(other.offset, step, sub(me.tie, other.tie), p.decay)
    way = steering.looking(me.aim, me.heading)
    weight = steering.view_weight(way, other.offset, p.anisotropy) * steering.in_cone(way, push, p.edge, p.outside)
    return limit(scale(push, weight * size_of(p, me)), p.bound)


class EllipticalRepulsion(Social):
    """Keep away from others and from where they step next: F = A w (-B grad exp(-b / B)).

    b is the smaller half axis of the ellipse through me with foci at the other and at the end of his step
    y = v_j dt (Helbing and Molnar 1995: A = V0 / sigma, B = sigma, and w = 1 in a field of view, `outside` out of it;
    elliptical I of Johansson, Helbing and Shukla 2007), or y = (v_j - v_i) dt (`relative`: elliptical II), with their
    w(phi) = lambda + (1 - lambda)(1 + cos phi) / 2. His step is what he does, not what he would like to.
    """

    kind: Literal["elliptical_repulsion"] = "elliptical_repulsion"
    decay: float = Field(gt=0, description="B, m, over which the force falls to 1/e")
    step: float = Field(ge=0, description="dt, s, how far ahead the step leads")
    relative: bool = Field(default=False, description="is the step that of the other relative to me?")
    anisotropy: float = Field(default=1.0, ge=0, le=1, description="lambda, how much who is straight behind counts")
    fov: float = Field(default=360.0, gt=0, le=360, description="degrees, 2 phi, full angle of the field of view")
    outside: float = Field(default=1.0, ge=0, le=1, description="c, how much what pushes from out of view counts")
    pair_law: ClassVar[str | None] = "pushed_by_ellipse"
    demo: ClassVar[str | None] = HEAD_ON.replace(
        "FORCE", "{kind: elliptical_repulsion, acceleration: 7, decay: 0.3, step: 2, fov: 200, outside: 0.5, radius: 5}"
    )

    def parameters(self) -> dict[str, float | Vec]:
        """A, B, the step, and how much who is where counts."""
        shape = {
            "decay": self.decay, "step": self.step, "relative": float(self.relative), "anisotropy": self.anisotropy,
            "edge": math.cos(math.radians(self.fov) / 2) if self.fov < 360 else -2.0, "outside": self.outside,
        }  # fmt: skip
        return {**super().parameters(), **shape}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """A / B over the reduced mass, as of somebody who stands; near the end of a step it may be steeper."""
        return self._steepest(self.decay, groups, dimension)


# --- by where both go -------------------------------------------------------------------------------------------------


@law
def stepped_aside(p: Any, me: Me, other: Other) -> Vec:
    """A (f_t t + f_n n)."""
    wish = steering.sidestep(
        other.offset, me.vel, other.vel, sub(other.tie, me.tie), p.importance, p.gamma, p.angular, p.forward, p.bias
    )
    return limit(scale(wish, size_of(p, me)), p.bound)


class Sidestep(Social):
    """Slow down before others and pass them on one side, as was measured (Moussaid et al. 2009, equations 4 to 7).

    D = lambda (v_i - v_j) + e_ij, t = unit(D), B = gamma |D|, theta the angle from t to e_ij in (-pi, pi], with B eps
    added: -A exp(-d / B - (n' B theta)^2) along t, and A exp(-d / B - (n B theta)^2) to the side where he is not.
    eps > 0 keeps right where he is dead ahead. In space it turns in the plane of t and e_ij: that is ours.
    """

    kind: Literal["sidestep"] = "sidestep"
    importance: float = Field(default=2.0, ge=0, description="lambda, s/m, of velocities against positions")
    gamma: float = Field(default=0.35, gt=0, description="s, B = gamma |D| m")
    angular: float = Field(default=2.0, ge=0, description="n, 1/m, of turning")
    forward: float = Field(default=3.0, ge=0, description="n', 1/m, of slowing down")
    bias: float = Field(default=0.005, ge=0, description="eps, 1/m: to the right")
    pair_law: ClassVar[str | None] = "stepped_aside"
    demo: ClassVar[str | None] = HEAD_ON.replace("FORCE", "{kind: sidestep, acceleration: 4.5, radius: 8}")

    def parameters(self) -> dict[str, float | Vec]:
        """A, and the numbers of the fit."""
        names = ("importance", "gamma", "angular", "forward", "bias")
        return {**super().parameters(), **{name: float(getattr(self, name)) for name in names}}
