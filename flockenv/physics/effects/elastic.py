"""Elasticity of a network's finite elements, with the particles as the nodes: linear, or corotated.

Linear: M a + D v + K u = F. Corotated: each element measures its strain in axes that turn with it, so that it is not
strained by a rotation of any size (Mueller & Gross 2004, Interactive virtual materials, 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.polar import nearest_rotation
from flockenv.maths.vectors import add, dot, scale, sub
from flockenv.model.finite_elements import Material, blocks, contents, gradients, stiffness
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


@law
def _times(columns: Any, x: Vec) -> Vec:
    """Return M x of a matrix, given by its columns."""
    if len(x) == 2:
        return add(scale(columns[0], x[0]), scale(columns[1], x[1]))
    else:
        return add(add(scale(columns[0], x[0]), scale(columns[1], x[1])), scale(columns[2], x[2]))


@law
def _inner(a: Any, b: Any) -> float:
    """Return a : b, the sum of the products of all entries of two matrices."""
    if len(a) == 2:
        return dot(a[0], b[0]) + dot(a[1], b[1])
    else:
        return dot(a[0], b[0]) + dot(a[1], b[1]) + dot(a[2], b[2])


@law
def _of_corners(edges: Any, number: Vec) -> Any:
    """Return the columns of the sum of e_j g_j' over an element's other corners: of x, its deformation gradient."""
    if len(edges) == 2:
        a, b = edges
        return (
            add(scale(a, number[2]), scale(b, number[4])),
            add(scale(a, number[3]), scale(b, number[5])),
        )
    else:
        a, b, c = edges
        return (
            add(add(scale(a, number[2]), scale(b, number[5])), scale(c, number[8])),
            add(add(scale(a, number[3]), scale(b, number[6])), scale(c, number[9])),
            add(add(scale(a, number[4]), scale(b, number[7])), scale(c, number[10])),
        )


@law
def _offsets(others: Any) -> Any:
    """Return the edges from a corner to the others."""
    if len(others) == 2:
        return others[0].offset, others[1].offset
    else:
        return others[0].offset, others[1].offset, others[2].offset


@law
def _velocities(others: Any, v: Vec) -> Any:
    """Return the velocities of the other corners relative to v."""
    if len(others) == 2:
        return sub(others[0].vel, v), sub(others[1].vel, v)
    else:
        return sub(others[0].vel, v), sub(others[1].vel, v), sub(others[2].vel, v)


@law
def _sum_of_gradients(v: Vec, number: Vec) -> Vec:
    """Return the sum of the gradients of the other corners, in the dimension of v."""
    if len(v) == 2:
        return (number[2] + number[4], number[3] + number[5])
    else:
        return (
            number[2] + number[5] + number[8],
            number[3] + number[6] + number[9],
            number[4] + number[7] + number[10],
        )


@law
def _elastic_pull(F: Any, R: Any, normal: Vec, first: float, second: float) -> Vec:
    """Return (2 G (F - R) + L tr(R' F - 1) R) g, with L = first and G = second times the volume."""
    trace = first * (_inner(R, F) - like(first, len(F)))
    return add(scale(sub(_times(F, normal), _times(R, normal)), second + second), scale(_times(R, normal), trace))


@law
def _viscous_pull(F: Any, rate: Any, normal: Vec, first: float, second: float) -> Vec:
    """Return F (2 G E' + L tr E') g of the rate of Green's strain, E' = (F' dF + dF' F) / 2; 0 for any rotation."""
    along, across = _times(F, normal), _times(rate, normal)
    if len(F) == 2:
        inner: Vec = (dot(F[0], across) + dot(rate[0], along), dot(F[1], across) + dot(rate[1], along))
    else:
        inner = (
            dot(F[0], across) + dot(rate[0], along), dot(F[1], across) + dot(rate[1], along),
            dot(F[2], across) + dot(rate[2], along),
        )  # fmt: skip
    return add(scale(_times(F, inner), second), scale(along, first * _inner(F, rate)))


@law
def corotated(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return the force of an element on one corner, f = V (P + P_damping) g, g the sum of the others' gradients.

    P = R (2 G (S - 1) + L tr(S - 1)) with F = R S is the gradient of V (G |S - 1|^2 + L tr(S - 1)^2 / 2) by F. It is
    linear in S, also where S has a negative eigenvalue: an element that is inside out is pushed back through its plane.
    """
    F, rate = _of_corners(_offsets(others), number), _of_corners(_velocities(others, me.vel), number)
    normal = _sum_of_gradients(me.vel, number)
    force = _elastic_pull(F, nearest_rotation(F), normal, number[0], number[1])
    return add(force, scale(_viscous_pull(F, rate, normal, number[0], number[1]), p.beta))


class Elastic(Effect):
    """Finite elements (bars, triangles in plane stress, tetrahedra) of a group's network, with Rayleigh damping.

    strain = linear holds for small displacements: a large rotation stretches the body. strain = corotated, of triangles
    in 2-D and tetrahedra in 3-D, holds for rotations of any size at small strains; an element that is turned inside out
    recovers. Both are the same at small displacements. Masses are those of the group's particles.

    The force is F = -K (u + beta v) - alpha M v, u the displacements. Elements of constant strain: Turner, Clough,
    Martin and Topp 1956; corotated: Mueller and Gross 2004; damping: Rayleigh 1877.

    Limits: strain = linear is wrong for rotations (one by an angle phi counts as a compression by 1 - cos phi), both
    are for small strains, and nothing yields or breaks. Nodes are the only bodies: surfaces need `face_collisions`.
    """

    kind: Literal["elastic"] = "elastic"
    group: int = Field(default=0, ge=0, description="index of the group whose network it acts on")
    young: float = Field(ge=0, description="Pa, Young's modulus")
    poisson: float = Field(default=0.3, gt=-1, lt=0.5, description="Poisson's ratio; unused by bars")
    strain: Literal["linear", "corotated"] = Field(
        default="linear", description="linear: for small displacements; corotated: also for large rotations"
    )
    area: float = Field(default=1.0, gt=0, description="m^2, cross section of bars")
    thickness: float = Field(default=1.0, gt=0, description="m, thickness of triangles")
    alpha: float = Field(
        default=0.0, ge=0, description="alpha, 1/s, part of the damping D = alpha M + beta K proportional to mass"
    )
    beta: float = Field(default=0.0, ge=0, description="beta, s, part of D proportional to stiffness")
    own_law: ClassVar[Law | None] = rayleigh_mass
    strengths: ClassVar[tuple[str, ...]] = ("young", "alpha", "beta")

    @property
    def bond_law(self) -> Law:  # type: ignore[override]  # depends on the strain
        """The law of one block of K, or of one corner of an element."""
        return corotated if self.strain == "corotated" else elastic

    @property
    def conserves_momentum(self) -> bool:  # type: ignore[override]  # damping proportional to mass does not
        """True without damping proportional to mass, which is an external force."""
        return self.alpha == 0

    def numbers(self, dimension: int) -> int:
        """Return the number of values of a bond: a block of K and an offset; or two moduli and gradients of corners."""
        return dimension * dimension + (2 if self.strain == "corotated" else dimension)

    def partner_count(self, dimension: int) -> int:
        """Return the number of partners of a bond: one neighbour; or the other corners of an element."""
        return dimension if self.strain == "corotated" else 1

    def parameters(self) -> dict[str, float | Vec]:
        """Return the two damping coefficients; stiffness is in the bonds."""
        return {"alpha": self.alpha, "beta": self.beta}

    @property
    def _material(self) -> Material:
        """The material; with a modulus of 1 Pa if it has none."""
        return Material(young=self.young or 1.0, poisson=self.poisson, area=self.area, thickness=self.thickness)

    def matrix(self, network: Any, dimension: int) -> Any:
        """Return K of a network, sparse, (D n, D n) N/m, particle after particle.

        network: n particles; dimension: D, 2 or 3.
        """
        found = stiffness(network.rest_points(dimension), network.elements(dimension), self._material)
        return found if self.young else 0 * found

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return a bond for every pair of neighbours, in both directions; or for every corner of every element."""
        first, network, _ = network_of(groups, self.group, dimension)
        if self.strain == "corotated":
            return self._corner_bonds(first, network, dimension)
        near = blocks(self.matrix(network, dimension), network.rest_points(dimension))
        agent = np.repeat(np.arange(len(near.start) - 1), np.diff(near.start)) + first
        number = np.concatenate([near.block.reshape(len(agent), dimension**2), near.way], axis=1)
        return Bonds(agent.astype(np.int32), (near.partner[:, None] + first).astype(np.int32), number)

    def _corner_bonds(self, first: int, network: Any, dimension: int) -> Bonds:
        """Return a row for each corner: the other corners; L and G times the volume, and the others' gradients."""
        elements, gradient, moduli = self._elements(network, dimension)
        agent, partner, number = [], [], []
        for corner in range(dimension + 1):
            others = [k for k in range(dimension + 1) if k != corner]
            agent.append(elements[:, corner] + first)
            partner.append(elements[:, others] + first)
            number.append(np.concatenate([moduli, gradient[:, others].reshape(len(elements), -1)], axis=1))
        return Bonds(
            np.concatenate(agent).astype(np.int32), np.concatenate(partner).astype(np.int32), np.concatenate(number)
        )

    def _elements(self, network: Any, dimension: int) -> tuple[NDArray[np.int32], Floats, Floats]:
        """Return elements (E, D + 1), their gradients (E, D + 1, D) 1/m, and L and G times their volumes, (E, 2) N m.

        Raises ValueError if the elements do not fill space.
        """
        points, elements = network.rest_points(dimension), network.elements(dimension)
        if elements.shape[1] != dimension + 1:
            names = {2: "bars", 3: "triangles", 4: "tetrahedra"}
            raise ValueError(
                f"strain = corotated: in {dimension} dimensions it needs {names[dimension + 1]}, and this network "
                f"({network.kind}) has {names[elements.shape[1]]}"
            )
        material = self._material
        volume = contents(points, elements) * material.section(dimension + 1) * (self.young > 0)
        return elements, gradients(points, elements), np.outer(volume, material.lame(dimension + 1))

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats] | None:
        """Return bounds by Gershgorin's circles: w^2 is at most the largest row sum of |K| / m.

        Of corotated elements they hold for the undeformed shape in any orientation, by the norms of the blocks of K.
        """
        first, network, mass = network_of(groups, self.group, dimension)
        square = np.zeros(len(all_masses(groups, dimension)))
        square[first : first + len(mass)] = self._row_sums(network, dimension) / mass
        damped = self.beta * square
        damped[first : first + len(mass)] += self.alpha * np.isfinite(mass)
        return square, damped

    def _row_sums(self, network: Any, dimension: int) -> Floats:
        """Return the largest row sum of |K| of each particle, (n,) N/m; corotated: the sum of its blocks' norms."""
        if self.strain == "linear":
            rows = np.asarray(abs(self.matrix(network, dimension)).sum(axis=1))
            return np.asarray(rows.reshape(-1, dimension).max(axis=1))
        self._elements(network, dimension)  # raises ValueError
        tied = self.matrix(network, dimension).tobsr((dimension, dimension))
        sizes = np.linalg.norm(tied.data, ord=2, axis=(1, 2))
        row = np.repeat(np.arange(network.size), np.diff(tied.indptr))
        return np.asarray(np.bincount(row, sizes, network.size), np.float64)

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return u . K u / 2, (B,) J; corotated: the sum of V (G |S - 1|^2 + L tr(S - 1)^2 / 2)."""
        first, network, mass = network_of(groups, self.group, state.shape[2])
        if self.strain == "corotated":
            return self._corotated_potential(first, network, state, offset)
        u = state.pos[:, first : first + len(mass)] - network.rest_points(state.shape[2])
        flat = u.reshape(len(u), -1)
        return np.asarray(0.5 * (flat * (self.matrix(network, state.shape[2]) @ flat.T).T).sum(axis=1))

    def _corotated_potential(self, first: int, network: Any, state: State, offset: Any) -> Floats:
        """Return the energy, (B,) J, from the singular values of the deformation gradients."""
        elements, gradient, moduli = self._elements(network, state.shape[2])
        corners = elements + first
        edges = offset(state.pos[:, corners[:, :1]], state.pos[:, corners[:, 1:]])
        F = np.einsum("beji,ejk->beik", edges, gradient[:, 1:])
        size = np.linalg.svd(F, compute_uv=False)
        size[..., -1] *= np.where(np.linalg.det(F) < 0, -1, 1)
        strain = size - 1
        energy = moduli[:, 1] * (strain**2).sum(axis=-1) + moduli[:, 0] * strain.sum(axis=-1) ** 2 / 2
        return np.asarray(energy.sum(axis=1))
