"""Altitude springs of tetrahedra: between each corner and the opposite face, and between opposite edges.

Their lengths have the sign of the volume: a tetrahedron that is inside out is pushed back through its faces. Springs
along edges alone cannot tell it from its mirror image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, cross, dot, opposite, scale, sub, zero
from flockenv.physics.effects.effect import Bonds, Effect, Me, all_masses, network_of

if TYPE_CHECKING:
    from flockenv.model.state import State

__all__ = ["AltitudeSprings"]

Floats = NDArray[np.float64]

SOFT = 0.1
"""An area A counts as sqrt(A^2 + (SOFT A_rest)^2): over a face that shrinks to a line forces would have no bound."""

ORDERS = ((0, 1, 2, 3), (1, 0, 3, 2), (2, 0, 1, 3), (3, 0, 2, 1))
"""Orders of the corners that begin with each of them and leave the sign of the volume."""

SETS = ((0,), (1,), (2,), (3,), (0, 1), (0, 2), (0, 3))
"""The corners on one side of each height: a corner over its face, or an edge over the opposite one."""


@law
def _resist(
    six: float, rate: float, slope: Vec, e: Vec, f: Vec, de: Vec, df: Vec, reach: Vec, k: float, c: float, rest: float,
    soft: float,
) -> Vec:  # fmt: skip
    """Return -(k (h - rest) + c dh/dt) dh/dx, the force on a corner x, of the height h = six / |e x f|.

    six, rate, slope: 6 V, its rate, and its gradient by x. de, df: rates of e and f. reach: d (e x f) = reach x dx.
    """
    o, one = like(six, 0.0), like(six, 1.0)
    normal = cross(e, f)
    size = np.sqrt(dot(normal, normal) + soft)
    per_size = one / size if size > o else o
    normal = scale(normal, per_size)
    height = six * per_size
    growth = (rate - height * dot(normal, add(cross(de, f), cross(e, df)))) * per_size
    # n . (reach x dx) = (n x reach) . dx
    gradient = scale(sub(slope, scale(cross(normal, reach), height)), per_size)
    return scale(gradient, -(k * (height - rest) + c * growth))


@law
def altitude_spring(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return the force on one corner of a tetrahedron by its seven heights, the gradient of sum k (h - rest)^2 / 2.

    The others are in an order in which the volume is positive at rest. Numbers: stiffness of altitudes and of opposite
    edges, damping, and (rest, softness) of each height, the corner's first. Sources: Molino, Bridson, Teran &
    Fedkiw 2003, A crystalline, red green strategy for meshing highly deformable objects with tetrahedra; Selle, Lentine
    & Fedkiw 2008, A mass spring model for hair simulation, 4.
    """
    B, C, D = others[0].offset, others[1].offset, others[2].offset
    b, c, d = sub(others[0].vel, me.vel), sub(others[1].vel, me.vel), sub(others[2].vel, me.vel)
    k, k2, r, o = number[0], number[1], number[2], zero(B)
    across = cross(C, D)
    six = dot(B, across)
    rate = dot(b, across) + dot(c, cross(D, B)) + dot(d, cross(B, C))
    slope = opposite(cross(sub(C, B), sub(D, B)))
    CB, DC, BD, cb, dc, bd = sub(C, B), sub(D, C), sub(B, D), sub(c, b), sub(d, c), sub(b, d)
    force = _resist(six, rate, slope, CB, opposite(BD), cb, opposite(bd), o, k, r, number[3], number[4])
    force = add(force, _resist(six, rate, slope, D, C, d, c, opposite(DC), k, r, number[5], number[6]))
    force = add(force, _resist(six, rate, slope, B, D, b, d, opposite(BD), k, r, number[7], number[8]))
    force = add(force, _resist(six, rate, slope, C, B, c, b, opposite(CB), k, r, number[9], number[10]))
    force = add(force, _resist(six, rate, slope, B, DC, b, dc, DC, k2, r, number[11], number[12]))
    force = add(force, _resist(six, rate, slope, C, BD, c, bd, BD, k2, r, number[13], number[14]))
    return add(force, _resist(six, rate, slope, D, CB, d, cb, CB, k2, r, number[15], number[16]))


class AltitudeSprings(Effect):
    """Damped springs across the tetrahedra of a group's network: from corners to faces, and between opposite edges.

    With `springs` along the edges, a tetrahedron that is turned inside out recovers. In 3-D only.

    The energy is E = sum of k (h - L)^2 / 2 over the seven heights h of a tetrahedron, L their lengths at rest (Molino,
    Bridson, Teran and Fedkiw 2003; edges: Selle, Lentine and Fedkiw 2008).

    Limits: they do not act along edges, so they need `springs` beside them. Rates are those of the undeformed shape:
    flattened elements are stiffer.
    """

    kind: Literal["altitude_springs"] = "altitude_springs"
    group: int = Field(default=0, ge=0, description="index of the group whose network it acts on")
    stiffness: float = Field(ge=0, description="N/m, between a corner and the opposite face")
    across: float | None = Field(default=None, ge=0, description="N/m, between opposite edges (default: as stiffness)")
    damping: float = Field(default=0.0, ge=0, description="kg/s, along each spring")
    bond_law: ClassVar[Law | None] = altitude_spring
    partners: ClassVar[int] = 3
    strengths: ClassVar[tuple[str, ...]] = ("stiffness", "across", "damping")
    conserves_momentum: ClassVar[bool] = True

    def numbers(self, dimension: int) -> int:
        """Return 17: two stiffnesses, damping, rest length and softness of seven heights."""
        return 3 + 2 * len(SETS)

    def parameters(self) -> dict[str, float | Vec]:
        """Return no parameters: every tetrahedron has numbers of its own."""
        return {}

    @property
    def _stiffness(self) -> Floats:
        """The stiffness of each height, (7,) N/m."""
        across = self.stiffness if self.across is None else self.across
        return np.array([self.stiffness] * 4 + [across] * 3)

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return a row for each corner of each tetrahedron."""
        first, tetrahedra, corners = self._tetrahedra(groups, dimension)
        soft = (SOFT * _areas(corners)) ** 2
        rest = _lengths(corners, soft)
        agent, partner, number = [], [], []
        for order in ORDERS:
            mine = [*order, *(_height_of(order[0], other) for other in order[1:])]
            each = np.stack([rest[:, mine], soft[:, mine]], axis=2).reshape(len(rest), -1)
            moduli = np.tile([self._stiffness[0], self._stiffness[-1], self.damping], (len(rest), 1))
            agent.append(tetrahedra[:, order[0]] + first)
            partner.append(tetrahedra[:, order[1:]] + first)
            number.append(np.concatenate([moduli, each], axis=1))
        return Bonds(
            np.concatenate(agent).astype(np.int32), np.concatenate(partner).astype(np.int32), np.concatenate(number)
        )

    def _tetrahedra(self, groups: Sequence[Any], dimension: int) -> tuple[int, NDArray[np.int32], Floats]:
        """Return the first agent, the tetrahedra (E, 4), and their corners at rest, (E, 4, 3) m.

        Raises ValueError if the network has other elements.
        """
        first, network, _ = network_of(groups, self.group, dimension)
        elements = network.elements(dimension)
        if elements.shape[1] != 4:
            what = {2: "bars", 3: "triangles"}[elements.shape[1]]
            raise ValueError(f"group = {self.group}: needs tetrahedra, and its network ({network.kind}) has {what}")
        return first, elements, network.rest_points(dimension)[elements]

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats] | None:
        """Return bounds for the undeformed shape: sums of the largest eigenvalues of a particle's elements."""
        first, tetrahedra, corners = self._tetrahedra(groups, dimension)
        mass, gram = all_masses(groups, dimension), (1 + 5 * SOFT**2) * _gram(corners)
        found = []
        for moduli in (self._stiffness, np.full(len(SETS), self.damping)):
            largest = np.linalg.eigvalsh(gram * np.sqrt(np.outer(moduli, moduli)))[:, -1]
            found.append(np.bincount((tetrahedra + first).ravel(), np.repeat(largest, 4), len(mass)) / mass)
        return found[0], found[1]

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return the sum of k (h - rest)^2 / 2 over all heights, (B,) J."""
        first, tetrahedra, corners = self._tetrahedra(groups, state.shape[2])
        soft = (SOFT * _areas(corners)) ** 2
        at = state.pos[:, tetrahedra + first]
        now = at[:, :, :1] + offset(at[:, :, :1], at)
        off = _lengths(now, soft) - _lengths(corners, soft)
        return np.asarray((0.5 * self._stiffness * off**2).sum(axis=(1, 2)))


def _height_of(a: int, b: int) -> int:
    """Return which of the heights, in the order of SETS, lies between the edge of two corners and the opposite edge."""
    return next(k for k, members in enumerate(SETS) if {a, b} in (set(members), {0, 1, 2, 3} - set(members)) and k > 3)


def _gram(corners: Floats) -> Floats:
    """Return the scalar products of the gradients of all heights, without softness, (E, 7, 7).

    1/h is the length of the gradient n of the sum of the barycentric coordinates of the corners on one side, and
    dh/dx_j = (n . g_j / n . n) n / |n| with g_j the gradient of that of corner j.
    """
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    normal = np.stack([gradient[:, members].sum(axis=1) for members in SETS], axis=1)
    size = np.linalg.norm(normal, axis=2, keepdims=True)
    weight, unit_normal = np.einsum("esi,eji->esj", normal, gradient) / size**2, normal / size
    return np.asarray((weight @ weight.transpose(0, 2, 1)) * (unit_normal @ unit_normal.transpose(0, 2, 1)))


def _areas(corners: Floats) -> Floats:
    """Return the areas of the parallelograms over which heights are measured, (..., 7) m^2; corners (..., 4, 3)."""
    found = []
    for members in SETS:
        others = [k for k in range(4) if k not in members]
        if len(members) == 1:
            e, f = (corners[..., other, :] - corners[..., others[0], :] for other in others[1:])
        else:
            e, f = (corners[..., j, :] - corners[..., i, :] for i, j in (members, others))
        found.append(np.linalg.norm(np.cross(e, f), axis=-1))
    return np.stack(found, axis=-1)


def _lengths(corners: Floats, soft: Floats) -> Floats:
    """Return the seven heights of each tetrahedron, (..., 7) m, with the sign of its volume."""
    six = np.linalg.det(corners[..., 1:, :] - corners[..., :1, :])
    return np.asarray(six[..., None] / np.sqrt(_areas(corners) ** 2 + soft))
