"""Liquids: viscosity and surface tension, central forces between near agents, beside a `Pressure`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import dot, scale, sub
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Effect, Me, Other, Sight, all_masses
from flockenv.steering.others import ONE_PLACE

__all__ = ["SurfaceTension", "Viscosity"]

FEWEST_WITHIN = 12
"""Neighbours within the radius, on average, from which the closed forms hold: two shells of the triangular lattice."""


@law
def nearness(p: Any, square: float) -> float:
    """Return 1 - r / R, at least 0."""
    o, e = like(square, 0.0), like(square, 1.0)
    return max(e - np.sqrt(square) / p.radius, o)  # type: ignore[no-any-return]


@law
def viscosity_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return (1 - r/R)^2 (n . (v_j - v_i)) n, n the unit vector to a neighbour; 0 in one place."""
    near = nearness(p, other.square)
    rate = dot(other.offset, sub(other.vel, me.vel)) / max(other.square, like(other.square, ONE_PLACE))
    return scale(other.offset, near * near * rate)


@law
def cohesion_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return (1 - q)^2 (q - z) towards a neighbour, q = r / R; 0 in one place."""
    near, square = nearness(p, other.square), other.square
    e, z = like(square, 1.0), p.flat_rest if len(me.pos) == 2 else p.solid_rest
    pull = near * near * (e - near - z)
    return scale(other.offset, pull / np.sqrt(max(square, like(square, ONE_PLACE))))


def _moment(power: int, low: float) -> float:
    """Return the integral of q^power (1 - q)^2 from `low` to 1."""
    return sum(c * (1 - low ** (power + k)) / (power + k) for k, c in ((1, 1), (2, -2), (3, 1)))


@law
def by_strength(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = strength times the sum."""
    return scale(sums, p.flat if len(me.pos) == 2 else p.solid)


class _Liquid(Effect):
    """Base class: the liquid that both effects are written for."""

    density: float = Field(gt=0, description="rho, agents per m^2, in 3-D per m^3, of the liquid")
    radius: float = Field(gt=0, description="R, m, of neighbours: about twice the distance of nearest ones")
    finish_law: ClassVar[Law | None] = by_strength
    vanishes: ClassVar[bool] = True
    conserves_momentum: ClassVar[bool] = True
    always: ClassVar[bool] = False

    @property
    def sight(self) -> Sight:
        """All directions, within the radius."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """Return D, the number of values in a vector."""
        return dimension

    def pair_strength(self, dimension: int) -> float:
        """Return the factor of the pair force with which the closed form has the given value.

        dimension: 2 or 3.
        """
        raise NotImplementedError

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the radius has too few neighbours in it for the closed form."""
        super().check(scene)
        ball = math.pi if scene.dimension == 2 else 4 / 3 * math.pi
        least = (FEWEST_WITHIN / (ball * self.density)) ** (1 / scene.dimension)
        if self.radius < least:
            raise ValueError(
                f"radius = {self.radius:g}: at this density fewer than {FEWEST_WITHIN} neighbours are within it; at "
                f"least {least:.4g} m is allowed"
            )

    def parameters(self) -> dict[str, float | Vec]:
        """Return the radius, and the strengths in 2-D and in 3-D, of which the law reads one."""
        return {"radius": self.radius, "flat": self.pair_strength(2), "solid": self.pair_strength(3)}


class Viscosity(_Liquid):
    """Slow down neighbours relative to each other, as the viscosity of a liquid does, along the line between them.

    F = g sum of (1 - r/R)^2 (n . (v_j - v_i)) n, n the unit vector to a neighbour nearer than R: the dissipative force
    of Espanol and Warren 1995, with the kernel of Groot and Warren 1997. It conserves momentum and, being central,
    angular momentum; it takes g (1 - r/R)^2 (n . (v_j - v_i))^2 W of energy from each pair, and vanishes in uniform
    motion and in rotation as a body. g follows from the viscosity: eta = pi g rho^2 R^4 / 480 in the plane,
    2 pi g rho^2 R^5 / 1575 in space, for neighbours that are evenly distributed. A shear flow of wave number k decays
    as exp(-eta k^2 t / (rho m)). Motion of the agents across a flow adds to the viscosity, as in a gas.

    Limits: it acts along the line between two agents only, so the closed form holds for many evenly distributed
    neighbours: near a surface or in a thin film the viscosity is lower.
    """

    kind: Literal["viscosity"] = "viscosity"
    sentence: ClassVar[str] = "Neighbours slow down relative to each other, as in a viscous liquid"
    viscosity: float = Field(ge=0, description="eta, kg/s, in 3-D Pa s")
    pair_law: ClassVar[Law | None] = viscosity_pair
    strengths: ClassVar[tuple[str, ...]] = ("viscosity",)

    def pair_strength(self, dimension: int) -> float:
        """Return g, kg/s."""
        share = math.pi * self.radius**4 / 480 if dimension == 2 else 2 * math.pi * self.radius**5 / 1575
        return self.viscosity / (share * self.density**2)

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return w^2 = 0, and the largest damping of any motion of a liquid of the given density, 2 g W / (D m).

        W = rho times the integral of (1 - r/R)^2: pi rho R^2 / 6 in the plane, 2 pi rho R^3 / 15 in space.
        """
        weight = math.pi * self.radius**2 / 6 if dimension == 2 else 2 * math.pi * self.radius**3 / 15
        damping = 2 * self.pair_strength(dimension) * self.density * weight / dimension / all_masses(groups, dimension)
        return np.zeros(len(damping)), damping


class SurfaceTension(_Liquid):
    """Attract neighbours, so that a liquid contracts to drops and its surface is under tension.

    F = K sum of (1 - q)^2 (q - z) towards each neighbour nearer than R, q = r / R: attraction beyond z R, repulsion at
    smaller distances (pairwise forces of Tartakovsky and Panchenko 2016). Both numbers follow from neighbours that are
    evenly distributed outside a hole with room for one agent, d < r < R. z, slightly above 1/2 in the plane and 4/7 in
    space, makes the virial 0: the force has no share in the pressure, and only a surface is pulled. K makes Fowler's
    integral (1937) for the surface the given tension: in the plane sigma = K rho^2 R^4 / 3 times the integral of
    q^3 (1 - q)^2 (q - z), in space pi K rho^2 R^5 / 8 times that of q^4. Momentum and angular momentum are conserved. A
    `Pressure` beside it keeps the density; agents in perfect order are a soft solid, which a `Fluctuation` melts.

    Limits: the closed form holds inside a liquid of the given density with a surface that is wide compared with R:
    small drops and thin films have another tension. It has no contact angle with walls.
    """

    kind: Literal["surface_tension"] = "surface_tension"
    sentence: ClassVar[str] = "Neighbours attract each other, so that the surface of a liquid is under tension"
    tension: float = Field(ge=0, description="sigma, N, in 3-D N/m")
    pair_law: ClassVar[Law | None] = cohesion_pair
    strengths: ClassVar[tuple[str, ...]] = ("tension",)

    def hole(self, dimension: int) -> float:
        """Return d / R, where a disc or ball of radius d has room for one agent.

        dimension: 2 or 3.
        """
        ball = math.pi if dimension == 2 else 4 / 3 * math.pi
        return float((ball * self.density) ** (-1 / dimension)) / self.radius

    def rest(self, dimension: int) -> float:
        """Return z, the distance without force as a fraction of R.

        dimension: 2 or 3.
        """
        low = self.hole(dimension)
        return _moment(dimension + 1, low) / _moment(dimension, low)

    def pair_strength(self, dimension: int) -> float:
        """Return K, N."""
        low, z, n = self.hole(dimension), self.rest(dimension), dimension + 1
        share = (1 / 3 if dimension == 2 else math.pi / 8) * (_moment(n + 1, low) - z * _moment(n, low))
        return self.tension / (share * self.density**2 * self.radius ** (n + 1))

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the largest w^2 of any motion of a liquid of the given density, and no damping.

        Twice the sum over neighbours of the stiffness along and across the line to them, where it is positive.
        """
        q, z = (np.arange(1000) + 0.5) / 1000, self.rest(dimension)
        along, across = (1 - q) * (1 + 2 * z - 3 * q), (1 - q) ** 2 * (q - z) / q
        stiff = (np.maximum(along, 0) + (dimension - 1) * np.maximum(across, 0)) / dimension
        within = (2 * math.pi * q if dimension == 2 else 4 * math.pi * q**2) * (q > self.hole(dimension))
        whole = self.density * self.radius ** (dimension - 1) * float((stiff * within).mean())
        square = 2 * self.pair_strength(dimension) * whole / all_masses(groups, dimension)
        return square, np.zeros(len(square))

    def parameters(self) -> dict[str, float | Vec]:
        """Return the radius, strengths and distances without force, those in 2-D and in 3-D."""
        return super().parameters() | {"flat_rest": self.rest(2), "solid_rest": self.rest(3)}
