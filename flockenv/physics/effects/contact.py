"""Contact forces of soft bodies: springs, dampers and friction, only while two bodies overlap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, dot, norm, scale, select, sub, unit, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Effect, Me, Obstacle, Other, Sight, all_masses
from flockenv.steering.others import ONE_PLACE

__all__ = ["Contact", "ObstacleContact", "restitution"]

Floats = NDArray[np.float64]


@law
def normal_force(p: Any, overlap: float, parting: float, reduced: float) -> float:
    """Return the normal force, k d - c u with u the speed of separation; at least 0 unless adhesive.

    With a largest speed of separation U, k d becomes min(k d, U sqrt(k m)) (1 - u / U).
    """
    o, e = like(overlap, 0.0), like(overlap, 1.0)
    root = np.sqrt(p.stiffness * reduced)
    push, most = p.stiffness * overlap, root / p.ease
    push = most if most < push else push  # without a largest speed `most` is inf or NaN
    push = push * max(e - p.ease * max(parting, o), o)
    force = push - (p.damping + p.ratio * (root + root)) * parting
    return force if (force > o) | (p.adhesive > o) else o


@law
def friction_force(p: Any, overlap: float, force: float, slip: Vec) -> Vec:
    """Return the friction -kappa d s against the slip s, at most mu times the normal force."""
    o = like(overlap, 0.0)
    rate, speed, most = p.friction * overlap, norm(slip), p.grip * max(force, o)
    slides = (p.grip >= o) & (rate * speed > most)
    return scale(slip, -(most / speed if slides else rate))


@law
def contact_force(p: Any, normal: Vec, overlap: float, vel: Vec, reduced: float) -> Vec:
    """Return the force on a body that overlaps another; normal: away from the other; vel: relative to the other."""
    parting = dot(vel, normal)
    force = normal_force(p, overlap, parting, reduced)
    slip = sub(vel, scale(normal, parting))
    total = add(scale(normal, force), friction_force(p, overlap, force, slip))
    return select(overlap > like(overlap, 0.0), total, zero(vel))


@law
def zero_force(p: Any, me: Me) -> Vec:
    """Return the zero vector, the start of the sum over obstacles."""
    return zero(me.pos)


@law
def add_obstacle_force(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Return the sum with the force of one obstacle added, which counts as infinitely heavy."""
    return add(acc, contact_force(p, other.normal, me.radius - other.gap, sub(me.vel, other.vel), me.mass))


@law
def contact_reach(p: Any, me: Me) -> float:
    """Return the agent's radius, m, as obstacles beyond it do not touch."""
    return me.radius


@law
def total_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return the force, the sum over all obstacles."""
    return acc


@law
def pair_force(p: Any, me: Me, other: Other) -> Vec:
    """Return the force of one neighbour; two agents in one place part along their ties."""
    e = like(other.square, 1.0)
    apart = other.square > like(other.square, ONE_PLACE)
    normal = unit(select(apart, scale(other.offset, -e), sub(me.tie, other.tie)))
    overlap = me.radius + other.radius - np.sqrt(other.square)
    return contact_force(p, normal, overlap, sub(me.vel, other.vel), e / (e / me.mass + e / other.mass))


def restitution(ratio: float, adhesive: bool = False) -> float:
    """Return the coefficient of restitution of a contact with damping `ratio`, as a fraction of critical damping.

    An adhesive contact ends when the bodies no longer overlap; any other when it would begin to pull, a little earlier.
    """
    if not 0 <= ratio < math.inf:
        raise ValueError(f"ratio is {ratio!r}, must be a number >= 0")
    if ratio >= 1:  # no oscillation: the time until the force is 0 is acosh(2 ratio^2 - 1) / root
        if adhesive:
            return 0.0
        root = math.sqrt(ratio**2 - 1)
        return math.exp(-2.0) if root < 1e-6 else math.exp(-ratio / root * math.acosh(2 * ratio**2 - 1))
    root = math.sqrt(1 - ratio**2)
    late = math.pi if adhesive else math.pi - math.atan2(2 * ratio * root, 1 - 2 * ratio**2)
    return math.exp(-ratio / root * late)


class _Solid(Effect):
    """Base class with the fields that both kinds of contact have."""

    stiffness: float = Field(ge=0, description="k, N/m, force per overlap")
    damping: float = Field(default=0.0, ge=0, description="c, kg/s, force per speed of approach")
    ratio: float = Field(
        default=0.0, ge=0, description="additional damping, as a fraction of critical damping for the masses"
    )
    adhesive: bool = Field(default=False, description="True: the damper may pull, until the bodies no longer overlap")
    friction: float = Field(default=0.0, ge=0, description="kappa, kg/(m s), against slip, per metre of overlap")
    coulomb: float | None = Field(
        default=None, ge=0, description="mu, largest friction as a fraction of the normal force (default: no limit)"
    )
    most: float | None = Field(
        default=None,
        gt=0,
        description="U, m/s, largest speed of separation by the spring (default: no limit)",
    )
    strengths: ClassVar[tuple[str, ...]] = ("stiffness", "damping", "ratio", "friction")
    contact: ClassVar[bool] = True

    def parameters(self) -> dict[str, float | Vec]:
        """Return the fields as numbers; grip is mu, or -1 without a limit; ease is 1 / U, or 0 without a limit."""
        return {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "ratio": self.ratio,
            "adhesive": float(self.adhesive),
            "friction": self.friction,
            "grip": -1.0 if self.coulomb is None else self.coulomb,
            "ease": 0.0 if self.most is None else 1 / self.most,
        }

    def _rates(self, per_mass: Floats) -> tuple[Floats, Floats]:
        """Return w^2, 1/s^2, and damping, 1/s, of contacts; per_mass: 1 / reduced mass, (N,) 1/kg."""
        square = self.stiffness * per_mass
        return square, self.damping * per_mass + 2 * self.ratio * np.sqrt(square)


class ObstacleContact(_Solid):
    """A body that overlaps an obstacle by d is pushed out, F = max(0, k d - c v.n) n, n the outward normal.

    The elastic part is the contact force of Helbing, Farkas and Vicsek 2000 (k g(r - d)); it never pulls, unless
    adhesive. Their friction, -kappa d (v . t) t, opposes the slip; it is stable in steps of less than 2 m / (kappa d).
    A body of mass m with speed v relative to the obstacle penetrates by at most v sqrt(m / k). For `most` see
    `Contact`.

    Limits: an obstacle is a spring: a body whose centre passes a thin wall within a step, or is pressed in by a force
    above k times its radius, leaves on the other side. Friction is proportional to the slip, so nothing holds a body at
    rest on a slope.
    """

    kind: Literal["obstacle_contact"] = "obstacle_contact"
    sentence: ClassVar[str] = "Bodies that overlap an obstacle are pushed out"
    obstacle_start: ClassVar[Law | None] = zero_force
    obstacle_law: ClassVar[Law | None] = add_obstacle_force
    obstacle_finish: ClassVar[Law | None] = total_force
    obstacle_reach: ClassVar[Law | None] = contact_reach

    def fold_size(self, dimension: int) -> int:
        """Return D, the number of values in a force."""
        return dimension

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return w^2 = k / m and (c + 2 ratio sqrt(k m)) / m of a body in one obstacle, without friction."""
        return self._rates(1 / all_masses(groups, dimension))


@law
def sum_of_contacts(p: Any, me: Me, sums: Vec) -> Vec:
    """Return the force, the sum over all neighbours."""
    return sums


class Contact(_Solid):
    """Two bodies that overlap by d repel each other, F = max(0, k d - c u) n, with friction -kappa d s.

    u is their speed of separation along the normal n, s their slip across it. Without damping it is the contact of
    Helbing, Farkas and Vicsek 2000 (k = 1.2e5 kg/s^2, kappa = 2.4e5 kg/(m s)): k g(2r - d) n + kappa g(2r - d) dv t.
    With `ratio` the coefficient of restitution is the same for all masses, `restitution(ratio, adhesive)`. A contact
    lasts pi sqrt(m / k), m the reduced mass, and needs 30 steps (CoarseContactWarning); friction is stable in steps of
    less than 2 m / (kappa d). Bodies do not spin: friction dissipates slip, and so angular momentum.

    `most` = U limits the speed at which bodies that overlap at the start separate: the spring force is at most U sqrt(k
    m), times 1 - u / U during separation, so no pair separates faster than U (damping as in Hunt and Crossley 1975).
    Impacts at up to U penetrate no deeper than where the limit begins; those at v << U lose v / (3 U) of their speed.

    Limits: bodies are springs: two that meet faster than the sum of their radii times the root of k / m pass through
    each other. Friction is proportional to the slip, without a static part: a heap creeps.
    """

    kind: Literal["contact"] = "contact"
    sentence: ClassVar[str] = "Bodies that overlap repel each other"
    radius: float | None = Field(
        default=None,
        gt=0,
        description="m, distance of neighbours (default: the largest at which two bodies touch)",
    )
    pair_law: ClassVar[Law | None] = pair_force
    finish_law: ClassVar[Law | None] = sum_of_contacts
    conserves_momentum: ClassVar[bool] = True

    @property
    def sight(self) -> Sight:
        """All directions, within the radius."""
        return Sight(math.inf if self.radius is None else self.radius)  # see Scene.contact_distance

    @property
    def reach(self) -> float:
        """The given radius, m; 0 if the radius depends on the bodies."""
        return self.radius or 0.0

    def sums(self, dimension: int) -> int:
        """Return D, the number of values in a force."""
        return dimension

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if `radius` is less than the distance at which bodies touch, or the torus is too small."""
        super().check(scene)
        touch = scene.contact_distance if scene.agents > 1 else 0.0
        if self.radius is not None and self.radius < touch:
            raise ValueError(f"radius = {self.radius:g}: must be at least {touch:g} m, where two bodies touch")
        if scene.space.periodic and touch > min(scene.space.extent(scene.dimension)) / 2:
            raise ValueError(
                f"kind = {self.kind}: two bodies touch at up to {touch:g} m; at most half the torus's shortest edge, "
                f"{min(scene.space.extent(scene.dimension)) / 2:g} m, is allowed"
            )

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return w^2 = k / m and (c + 2 ratio sqrt(k m)) / m of one contact, m reduced with the lightest other."""
        mass = all_masses(groups, dimension)
        if len(mass) == 1:
            return np.zeros(1), np.zeros(1)
        light, next_ = np.sort(mass)[:2]
        return self._rates(np.where(np.isfinite(mass), 1 / mass + 1 / np.where(mass == light, next_, light), 0.0))
