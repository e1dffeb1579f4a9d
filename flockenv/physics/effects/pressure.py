"""Pressure: repulsion and attraction of near agents, which lead to a given density."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import scale, select, sub, unit
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Effect, Me, Other, Sight
from flockenv.steering.others import ONE_PLACE

__all__ = ["Pressure"]

PACKED = 0.64
"""Fraction of space filled by spheres that are poured in and shaken (Scott & Kilgour 1969: 0.637)."""


@law
def pressure_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return (a^2 - r^2) / (r^2 + (a/8)^2) (1 - r^2/R^2)^2 away from a neighbour, or along the tie in one place."""
    e, square = like(other.square, 1.0), other.square
    rest = p.flat if len(me.pos) == 2 else p.solid
    near = e - square / (p.radius * p.radius)
    push = (rest - square) / (square + rest * like(square, 1 / 64)) * near * near
    apart = square > like(square, ONE_PLACE)
    return scale(unit(select(apart, scale(other.offset, -e), sub(me.tie, other.tie))), push)


@law
def pressure(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = strength times the sum."""
    return scale(sums, p.strength)


class Pressure(Effect):
    """Keep a constant density of agents, by forces between near neighbours that conserve momentum.

    F = K sum of (a^2 - r^2) / (r^2 + (a/8)^2) (1 - r^2/R^2)^2, away from each neighbour nearer than R: repulsion at
    distances below a, attraction beyond; finite at distance 0, smoothly 0 at R. a is the distance of neighbours in the
    packing of that density to which a crowd relaxes: rho = 2 / (sqrt(3) a^2) in the plane (triangles),
    0.64 / (pi a^3 / 6) in space (random close packing, which fills 64 %). The force has a potential, so another effect
    (`Drag`) must dissipate energy, or agents remain a gas. Too few agents to fill their space leave holes in it. This
    is not the pressure of smoothed particles, which is a function of both partners' densities, and needs a second pass
    over all pairs (Monaghan 1992). A mere sum over pairs has no preferred density in a mean field (its pressure grows
    with rho^2 for any force); here the distance a and the order of agents set the density, to a few percent.

    Limits: the density holds to a few per cent, for a crowd that fills its space. The force is 64 K at distance 0, so
    two agents that are pressed harder pass through each other, and without `drag` agents do not come to rest.
    """

    kind: Literal["pressure"] = "pressure"
    strength: float = Field(ge=0, description="K, N: about 3 K act at half the distance a, 64 K at distance 0")
    density: float = Field(gt=0, description="rho, agents per m^2, in 3-D per m^3")
    radius: float = Field(gt=0, description="R, m, of neighbours: between 1.1 a and 1.4 a")
    pair_law: ClassVar[Law | None] = pressure_pair
    finish_law: ClassVar[Law | None] = pressure
    conserves_momentum: ClassVar[bool] = True
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    @property
    def sight(self) -> Sight:
        """All directions, within the radius."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """Return D, the number of values in a vector."""
        return dimension

    def distance(self, dimension: int) -> float:
        """Return a, the distance of nearest neighbours at this density, m.

        dimension: 2 or 3.
        """
        if dimension == 2:
            return math.sqrt(2 / (math.sqrt(3) * self.density))
        return math.cbrt(PACKED * 6 / (math.pi * self.density))

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the radius is too small for attraction, or reaches second neighbours."""
        a = self.distance(scene.dimension)
        if not 1.1 * a <= self.radius <= 1.4 * a:
            raise ValueError(
                f"radius = {self.radius:g}: at this density nearest neighbours are a = {a:.4g} m apart; from 1.1 a = "
                f"{1.1 * a:.4g} to 1.4 a = {1.4 * a:.4g} m is allowed"
            )

    def parameters(self) -> dict[str, float | Vec]:
        """Return strength and radius, and a^2 in 2-D and in 3-D, of which the law reads one."""
        return {
            "strength": self.strength,
            "radius": self.radius,
            "flat": self.distance(2) ** 2,
            "solid": self.distance(3) ** 2,
        }
