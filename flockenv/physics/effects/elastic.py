"""Linear elasticity of a network's finite elements: M a + D v + K u = F, with the particles as the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import add, scale, sub
from flockenv.model.finite_elements import Material, blocks, stiffness
from flockenv.physics.effects.effect import Bonds, Effect, Me, all_masses, network_of

if TYPE_CHECKING:
    from flockenv.model.state import State

__all__ = ["Elastic"]

Floats = NDArray[np.float64]


@law
def rayleigh_mass(p: Any, me: Me) -> Vec:
    """Return F = -alpha m v, the part of the damping proportional to mass."""
    return scale(me.vel, -p.alpha * me.mass)


@law
def _stretch_force(u: Vec, number: Vec) -> Vec:
    """Return -K_ij u, with the block K_ij in the first numbers of a bond."""
    if len(u) == 2:
        return (-(number[0] * u[0] + number[1] * u[1]), -(number[2] * u[0] + number[3] * u[1]))
    else:
        return (
            -(number[0] * u[0] + number[1] * u[1] + number[2] * u[2]),
            -(number[3] * u[0] + number[4] * u[1] + number[5] * u[2]),
            -(number[6] * u[0] + number[7] * u[1] + number[8] * u[2]),
        )


@law
def _rest_offset(like_this: Vec, number: Vec) -> Vec:
    """Return the offset to the neighbour in the undeformed shape, the last numbers of a bond."""
    if len(like_this) == 2:
        return (number[4], number[5])
    else:
        return (number[9], number[10], number[11])


@law
def elastic(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return F_i = -K_ij ((u_j - u_i) + beta (v_j - v_i)), one neighbour's part of -(K (u + beta v))_i.

    Rows of K sum to zero, so only displacements relative to neighbours are needed.
    """
    stretch = sub(others[0].offset, _rest_offset(others[0].offset, number))
    return _stretch_force(add(stretch, scale(sub(others[0].vel, me.vel), p.beta)), number)


class Elastic(Effect):
    """Linear finite elements (bars, triangles in plane stress, tetrahedra) of a group's network, Rayleigh damping.

    The theory holds for small displacements: a large rotation stretches the body. Masses are those of the group's
    particles.
    """

    kind: Literal["elastic"] = "elastic"
    group: int = Field(default=0, ge=0, description="index of the group whose network it acts on")
    young: float = Field(ge=0, description="Pa, Young's modulus")
    poisson: float = Field(default=0.3, gt=-1, lt=0.5, description="Poisson's ratio; unused by bars")
    area: float = Field(default=1.0, gt=0, description="m^2, cross section of bars")
    thickness: float = Field(default=1.0, gt=0, description="m, thickness of triangles")
    alpha: float = Field(default=0.0, ge=0, description="alpha, 1/s, of the damping D = alpha M + beta K")
    beta: float = Field(default=0.0, ge=0, description="beta, s")
    own_law: ClassVar[Law | None] = rayleigh_mass
    bond_law: ClassVar[Law | None] = elastic
    strengths: ClassVar[tuple[str, ...]] = ("young", "alpha", "beta")

    @property
    def conserves_momentum(self) -> bool:  # type: ignore[override]  # damping proportional to mass does not
        """True without damping proportional to mass, which is an external force."""
        return self.alpha == 0

    def numbers(self, dimension: int) -> int:
        """Return the number of values of a bond: a block of K, and the undeformed offset to the neighbour."""
        return dimension * dimension + dimension

    def parameters(self) -> dict[str, float | Vec]:
        """Return the two damping coefficients; K is in the bonds."""
        return {"alpha": self.alpha, "beta": self.beta}

    def matrix(self, network: Any, dimension: int) -> Any:
        """Return K of a network, sparse, (D n, D n) N/m, particle after particle."""
        material = Material(young=self.young or 1.0, poisson=self.poisson, area=self.area, thickness=self.thickness)
        found = stiffness(network.rest_points(dimension), network.elements(dimension), material)
        return found if self.young else 0 * found

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return a bond for every pair of neighbours, in both directions."""
        first, network, _ = network_of(groups, self.group, dimension)
        near = blocks(self.matrix(network, dimension), network.rest_points(dimension))
        agent = np.repeat(np.arange(len(near.start) - 1), np.diff(near.start)) + first
        number = np.concatenate([near.block.reshape(len(agent), dimension**2), near.way], axis=1)
        return Bonds(agent.astype(np.int32), (near.partner[:, None] + first).astype(np.int32), number)

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats] | None:
        """Return bounds by Gershgorin's circles: w^2 is at most the largest row sum of |K| / m."""
        first, network, mass = network_of(groups, self.group, dimension)
        rows = np.asarray(abs(self.matrix(network, dimension)).sum(axis=1)).reshape(-1, dimension).max(axis=1)
        square = np.zeros(len(all_masses(groups, dimension)))
        square[first : first + len(mass)] = rows / mass
        damped = self.beta * square
        damped[first : first + len(mass)] += self.alpha * np.isfinite(mass)
        return square, damped

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return u . K u / 2, (B,) J."""
        first, network, mass = network_of(groups, self.group, state.shape[2])
        u = state.pos[:, first : first + len(mass)] - network.rest_points(state.shape[2])
        flat = u.reshape(len(u), -1)
        return np.asarray(0.5 * (flat * (self.matrix(network, state.shape[2]) @ flat.T).T).sum(axis=1))
