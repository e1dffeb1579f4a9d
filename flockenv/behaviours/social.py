"""Social forces between pedestrians: repulsion by distance, by ellipses, and by both velocities.

They are steering forces; `Steer` selects the group. `Contact` handles bodies that overlap. See docs/social_forces.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.repulsion import Push
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.approximations import exp
from flockenv.maths.vectors import dot, limit, scale, select, sub, unit
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Me, Other, Sight, all_masses, demand_group
from flockenv.steering import social

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
def total_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return the sum over all visible neighbours."""
    return sums


@law
def strength_of(p: Any, me: Me) -> float:
    """Return A of this agent, N."""
    return p.strength + me.mass * p.acceleration  # type: ignore[no-any-return]


class Social(Push):
    """Base of forces between pedestrians: strength, range, group and visibility."""

    radius: float = Field(gt=0, description="m, range within which neighbours count")
    group: int | None = Field(default=None, ge=0, description="group that it interacts with (default: all)")
    occluded: bool = Field(default=False, description="True if obstacles hide neighbours")
    finish_law: ClassVar[Law | None] = total_force

    @property
    def sight(self) -> Sight:
        """Radius, group and occlusion."""
        return Sight(self.radius, group=self.group, occluded=self.occluded)

    def sums(self, dimension: int) -> int:
        """Return how many numbers are summed: D, a force."""
        return dimension

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the group does not exist."""
        demand_group("group", self.group, scene.groups)
        super().check(scene)

    def _steepest(self, decay: float, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return w^2 = A (1 / m + 1 / m_other) / B of a pair in touch, (N,), the other the lightest; and no damping."""
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
def circular_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return f n and the distinct entries of f n n^T: f = A exp((r_ij - d) / B), n away from the neighbour."""
    n, distance = social.unit_away(other.offset, sub(me.tie, other.tie))
    force = strength_of(p, me) * exp((p.bodies * (me.radius + other.radius) - distance) * p.slope)
    force = force if force < p.bound else p.bound
    return _force_products(n, force)


@law
def _force_products(n: Vec, force: float) -> Vec:
    f = scale(n, force)
    if len(n) == 2:
        return (f[0], f[1], f[0] * n[0], f[0] * n[1], f[1] * n[1])
    else:
        return (f[0], f[1], f[2], f[0] * n[0], f[0] * n[1], f[0] * n[2], f[1] * n[1], f[1] * n[2], f[2] * n[2])


@law
def circular_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return the sum of w f n; w = lambda + (1 - lambda)(1 - n . e) / 2 is linear in n, so it follows from the sums."""
    e, half = like(me.mass, 1.0), like(me.mass, 0.5)
    gaze = unit(steering.gaze_direction(me.aim, me.heading))
    push: Vec
    along: Vec
    if len(sums) == 5:
        push = (sums[0], sums[1])
        along = (sums[2] * gaze[0] + sums[3] * gaze[1], sums[3] * gaze[0] + sums[4] * gaze[1])
    else:
        push = (sums[0], sums[1], sums[2])
        along = (
            sums[3] * gaze[0] + sums[4] * gaze[1] + sums[5] * gaze[2],
            sums[4] * gaze[0] + sums[6] * gaze[1] + sums[7] * gaze[2],
            sums[5] * gaze[0] + sums[7] * gaze[1] + sums[8] * gaze[2],
        )
    rest = half * (e - p.anisotropy)
    weighed = sub(scale(push, p.anisotropy + rest), scale(along, rest))
    return select(dot(gaze, gaze) > like(me.mass, 0.0), weighed, push)


class CircularRepulsion(Social):
    """Keep away from others: F = A w(phi) exp((r_ij - d) / B) n, with r_ij both radii, or 0 (`bodies: false`).

    Helbing, Farkas and Vicsek 2000 (A in N, with bodies, lambda = 1); the circular specification of Johansson, Helbing
    and Shukla 2007 (A in m/s^2, distances between centres, w = lambda + (1 - lambda)(1 + cos phi) / 2, phi the angle
    from its aim, or else its heading, to the other). The forces of a pair are not opposite: w differs.

    Limits: at the radius the force jumps to 0. It is at most A exp(r_ij / B) and has no damping: bodies that are
    pressed together harder pass through each other, unless a `contact` acts as well. If they overlap, the stable step
    is shorter than that of bodies in touch.
    """

    kind: Literal["circular_repulsion"] = "circular_repulsion"
    decay: float = Field(gt=0, description="B, m, over which the force falls to 1/e")
    bodies: bool = Field(default=True, description="True: distance between surfaces; False: between centres")
    anisotropy: float = Field(default=1.0, ge=0, le=1, description="lambda, weight of neighbours straight behind")
    pair_law: ClassVar[Law | None] = circular_pair
    finish_law: ClassVar[Law | None] = circular_force
    demo: ClassVar[str | None] = HEAD_ON.replace(
        "FORCE", "{kind: circular_repulsion, strength: 2000, decay: 0.08, radius: 3}"
    )

    def parameters(self) -> dict[str, float | Vec]:
        """Return A, B and lambda."""
        shape = {"slope": 1 / self.decay, "bodies": float(self.bodies), "anisotropy": self.anisotropy}
        return {**super().parameters(), **shape}

    def sums(self, dimension: int) -> int:
        """Return how many numbers are summed: a vector and a symmetric matrix."""
        return dimension + dimension * (dimension + 1) // 2

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return w^2 = A / B over the reduced mass, for two bodies in touch (in one place if `bodies` is False).

        If bodies overlap it is steeper, exp(overlap / B) times: that depends on the state.
        """
        return self._steepest(self.decay, groups, dimension)


# --- by ellipses ------------------------------------------------------------------------------------------------------


@law
def elliptical_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return A w (-B grad exp(-b / B))."""
    step = scale(sub(other.vel, scale(me.vel, p.relative)), p.step)
    out, size = social.elliptical_direction(other.offset, step, sub(me.tie, other.tie), p.decay)
    gaze = steering.gaze_direction(me.aim, me.heading)
    weight = steering.view_weight(gaze, other.offset, p.anisotropy) * steering.cone_weight(gaze, out, p.edge, p.outside)
    force = size * strength_of(p, me)
    return scale(out, weight * (force if force < p.bound else p.bound))


class EllipticalRepulsion(Social):
    """Keep away from others and from the ends of their next steps: F = A w (-B grad exp(-b / B)).

    b is the semi-minor axis of the ellipse through the agent with foci at the neighbour and at the end of the
    neighbour's step y = v_j dt (Helbing and Molnar 1995: A = V0 / sigma, B = sigma, and w = 1 in a field of view,
    `outside` out of it; elliptical I of Johansson, Helbing and Shukla 2007), or y = (v_j - v_i) dt (`relative`:
    elliptical II), with their w(phi) = lambda + (1 - lambda)(1 + cos phi) / 2. The step uses the actual velocity, not
    the desired one.

    Limits: at the end of the neighbour's step the force grows as 1 over the root of the distance, up to 500 times A,
    and on the step it has no direction. Bodies have no size in it, and it has no damping.
    """

    kind: Literal["elliptical_repulsion"] = "elliptical_repulsion"
    decay: float = Field(gt=0, description="B, m, over which the force falls to 1/e")
    step: float = Field(ge=0, description="dt, s, duration of the step")
    relative: bool = Field(default=False, description="True: step by relative velocity")
    anisotropy: float = Field(default=1.0, ge=0, le=1, description="lambda, weight of neighbours straight behind")
    fov: float = Field(
        title="field of view",
        default=360.0,
        gt=0,
        le=360,
        description="degrees, 2 phi, full angle of the field of view",
    )
    outside: float = Field(default=1.0, ge=0, le=1, description="c, weight of forces from outside the field of view")
    pair_law: ClassVar[Law | None] = elliptical_pair
    demo: ClassVar[str | None] = HEAD_ON.replace(
        "FORCE", "{kind: elliptical_repulsion, acceleration: 7, decay: 0.3, step: 2, fov: 200, outside: 0.5, radius: 5}"
    )

    def parameters(self) -> dict[str, float | Vec]:
        """Return A, B, the step and the weights by direction."""
        shape = {
            "decay": self.decay, "step": self.step, "relative": float(self.relative), "anisotropy": self.anisotropy,
            "edge": math.cos(math.radians(self.fov) / 2) if self.fov < 360 else -2.0, "outside": self.outside,
        }  # fmt: skip
        return {**super().parameters(), **shape}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return w^2 = A / B over the reduced mass, for a neighbour at rest; near a step's end it may be steeper."""
        return self._steepest(self.decay, groups, dimension)


# --- by both velocities -----------------------------------------------------------------------------------------------


@law
def sidestep_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return A (f_t t + f_n n)."""
    change = steering.sidestep(
        other.offset, me.vel, other.vel, sub(other.tie, me.tie), p.importance, p.gamma, p.angular, p.forward, p.bias
    )
    return limit(scale(change, strength_of(p, me)), p.bound)


class Sidestep(Social):
    """Slow down before others and pass them on one side, as fitted to experiments (Moussaid et al. 2009, eq. 4 to 7).

    F = -A exp(-d / B - (n' B theta)^2) t + A exp(-d / B - (n B theta)^2) s, s to the side away from the neighbour, with
    D = lambda (v_i - v_j) + e_ij, t = unit(D), B = gamma |D|, and theta the angle from t to e_ij in (-pi, pi], to which
    B eps is added. If the neighbour is dead ahead, eps > 0 keeps right. In 3-D the agent turns in the plane of t and
    e_ij (ours).

    Limits: it was fitted to single pairs in a corridor, and sums over all others. d is a distance of centres: without a
    contact force bodies overlap in a crowd. It sees no walls.
    """

    kind: Literal["sidestep"] = "sidestep"
    importance: float = Field(default=2.0, ge=0, description="lambda, s/m, weight of relative velocity")
    gamma: float = Field(default=0.35, gt=0, description="s, B = gamma |D| m")
    angular: float = Field(default=2.0, ge=0, description="n, 1/m, of turning")
    forward: float = Field(default=3.0, ge=0, description="n', 1/m, of slowing down")
    bias: float = Field(default=0.005, ge=0, description="eps, 1/m: to the right")
    pair_law: ClassVar[Law | None] = sidestep_pair
    demo: ClassVar[str | None] = HEAD_ON.replace("FORCE", "{kind: sidestep, acceleration: 4.5, radius: 8}")

    def parameters(self) -> dict[str, float | Vec]:
        """Return A, and the numbers of the fit."""
        names = ("importance", "gamma", "angular", "forward", "bias")
        return {**super().parameters(), **{name: float(getattr(self, name)) for name in names}}
