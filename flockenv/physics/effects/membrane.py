"""Triangle cloth: stretch and shear within triangles, and bending over the edges between them.

Each condition C has the energy k C^2 / 2 and is damped along its gradient (Baraff and Witkin 1998, sections 4 and 4.5).
Their weights of C by area are chosen so that stiffness does not depend on the mesh. The forces of a condition on its
particles sum to zero, and so do their moments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, cross, dot, norm, scale, select, sub, zero
from flockenv.model.triangles import dihedral_angles, dihedrals, material_gradients
from flockenv.physics.effects.angular_springs import wrap_angle
from flockenv.physics.effects.effect import Bonds, Effect, Me, Stencils, Vector, all_masses, network_of

if TYPE_CHECKING:
    from flockenv.model.scene_view import SceneView
    from flockenv.model.state import State

__all__ = ["Bending", "Membrane"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


def _triangles_only(elements: Ints, group: int) -> Ints:
    """Return the elements of a network, (T, 3); raise ValueError if they are bars or tetrahedra."""
    if len(elements) and elements.shape[1] != 3:
        kind = {2: "bars", 4: "tetrahedra"}[elements.shape[1]]
        raise ValueError(f"group = {group}: its network has {kind}; triangles are needed, as of a cloth or a mesh")
    return elements.reshape(-1, 3)


def _check_network(group: int, scene: SceneView) -> None:
    """Raise ValueError if the network of a group is a mesh that is not sound."""
    _, network, _ = network_of(scene.groups, group, scene.dimension)
    _triangles_only(network.elements(scene.dimension), group)
    try:
        network.check_elements(scene.dimension)
    except ValueError as error:
        raise ValueError(f"group = {group}: in its network {error}") from None


# --- stretch and shear ------------------------------------------------------------------------------------------------


@law
def _unit_or_zero(a: Vec) -> tuple[Vec, float]:
    """Return a / |a|, 0 for a = 0, and |a|."""
    o, long = like(a[0], 0.0), norm(a)
    return scale(a, like(o, 1.0) / long if long > o else o), long


@law
def membrane(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return the force of a triangle on its first corner, from the energy of its stretch and shear.

    w_u = dx/du and w_v = dx/dv are linear in the corners, and the energy is
    E = A (k (|w_u| - 1)^2 + k (|w_v| - 1)^2 + s (w_u . w_v)^2) / 2.
    """
    one, two = others[0], others[1]
    vel_1, vel_2 = sub(one.vel, me.vel), sub(two.vel, me.vel)
    wu = add(scale(one.offset, number[0]), scale(two.offset, number[1]))
    wv = add(scale(one.offset, number[2]), scale(two.offset, number[3]))
    rate_u = add(scale(vel_1, number[0]), scale(vel_2, number[1]))
    rate_v = add(scale(vel_1, number[2]), scale(vel_2, number[3]))
    along_u, long_u = _unit_or_zero(wu)
    along_v, long_v = _unit_or_zero(wv)
    e, tau = like(number[0], 1.0), number[6]
    pull_u = number[4] * (long_u - e + tau * dot(along_u, rate_u))
    pull_v = number[4] * (long_v - e + tau * dot(along_v, rate_v))
    shear = number[5] * (dot(wu, wv) + tau * (dot(rate_u, wv) + dot(wu, rate_v)))
    by_u, by_v = number[0] + number[1], number[2] + number[3]  # minus the gradients at the first corner
    return add(
        scale(add(scale(along_u, pull_u), scale(wv, shear)), by_u),
        scale(add(scale(along_v, pull_v), scale(wu, shear)), by_v),
    )


@law
def membrane_derivative(local: Any, number: Any, s: int) -> None:
    """Write the derivatives of a triangle's forces; numbers are those of `membrane`.

    -A k g_p g_q (d d^T + (1 - 1 / |w|) (1 - d d^T)) for each of w_u and w_v, with d = w / |w|, and the product of the
    gradients of shear. Left out are the second term if w is compressed, and the second derivative of shear.
    """
    d = local.at.shape[1]
    for p in range(3):
        gu_p = number[s, p - 1] if p > 0 else -(number[s, 0] + number[s, 1])
        gv_p = number[s, p + 1] if p > 0 else -(number[s, 2] + number[s, 3])
        for q in range(3):
            gu_q = number[s, q - 1] if q > 0 else -(number[s, 0] + number[s, 1])
            gv_q = number[s, q + 1] if q > 0 else -(number[s, 2] + number[s, 3])
            square_u, square_v = 0.0, 0.0
            for k in range(d):
                wu = number[s, 0] * local.at[1, k] + number[s, 1] * local.at[2, k]
                wv = number[s, 2] * local.at[1, k] + number[s, 3] * local.at[2, k]
                square_u += wu * wu
                square_v += wv * wv
            per_u = 1.0 / np.sqrt(square_u) if square_u > 0.0 else 0.0
            per_v = 1.0 / np.sqrt(square_v) if square_v > 0.0 else 0.0
            across = gu_p * gu_q * max(1.0 - per_u, 0.0) + gv_p * gv_q * max(1.0 - per_v, 0.0)
            for a in range(d):
                wu_a = number[s, 0] * local.at[1, a] + number[s, 1] * local.at[2, a]
                wv_a = number[s, 2] * local.at[1, a] + number[s, 3] * local.at[2, a]
                for b in range(d):
                    wu_b = number[s, 0] * local.at[1, b] + number[s, 1] * local.at[2, b]
                    wv_b = number[s, 2] * local.at[1, b] + number[s, 3] * local.at[2, b]
                    outer_u, outer_v = per_u * per_u * wu_a * wu_b, per_v * per_v * wv_a * wv_b
                    shear = number[s, 5] * (gu_p * wv_a + gv_p * wu_a) * (gu_q * wv_b + gv_q * wu_b)
                    damped = number[s, 4] * (gu_p * gu_q * outer_u + gv_p * gv_q * outer_v) + shear
                    bent = across if a == b else 0.0
                    bent -= (
                        gu_p * gu_q * max(1.0 - per_u, 0.0) * outer_u + gv_p * gv_q * max(1.0 - per_v, 0.0) * outer_v
                    )
                    local.by_position[p * d + a, q * d + b] = -damped - number[s, 4] * bent
                    local.by_velocity[p * d + a, q * d + b] = -number[s, 6] * damped


@law
def membrane_strain(local: Any, number: Any, s: int) -> tuple[float, float]:
    """Return |w_u| and |w_v| of a triangle, which are 1 at rest; numbers are those of `membrane`."""
    square_u, square_v = 0.0, 0.0
    for k in range(local.at.shape[1]):
        wu = number[s, 0] * local.at[1, k] + number[s, 1] * local.at[2, k]
        wv = number[s, 2] * local.at[1, k] + number[s, 3] * local.at[2, k]
        square_u += wu * wu
        square_v += wv * wv
    return np.sqrt(square_u), np.sqrt(square_v)


class Membrane(Effect):
    """Stretch and shear of the triangles of a group's network, in the material coordinates (u, v) of its rest shape.

    A condition of stretch is sqrt(A) (|dx/du| - 1), and the same for v; that of shear is sqrt(A) dx/du . dx/dv. A is
    the area of the triangle at rest (Baraff and Witkin weight by A itself, which makes a finer mesh softer). Damping
    acts along the gradients of the conditions, so rigid motions are not damped.

    The energy of a triangle is E = A (k (|dx/du| - 1)^2 + k (|dx/dv| - 1)^2 + s (dx/du . dx/dv)^2) / 2: Baraff and
    Witkin 1998, sections 4.1 to 4.4.

    Limits: a triangle is a plane of constant strain, without resistance to bending and without a side: it may turn
    inside out, and fold through itself unless `face_collisions` acts. Rates are those of the undeformed shape.
    """

    kind: Literal["membrane"] = "membrane"
    group: int = Field(default=0, ge=0, description="index of the group whose network it acts on")
    stretch: float = Field(ge=0, description="N/m, along warp and weft: force per width and strain")
    shear: float = Field(default=0.0, ge=0, description="N/m, of the angle between warp and weft")
    damping: float = Field(default=0.0, ge=0, description="s, damping of each condition over its stiffness")
    warp: Vector | None = Field(
        default=None, description="direction of u in the rest shape (default: the first edge of its first triangle)"
    )
    bond_law: ClassVar[Law | None] = membrane
    derivative: ClassVar[Law | None] = membrane_derivative
    strain_law: ClassVar[Law | None] = membrane_strain
    partners: ClassVar[int] = 2
    strengths: ClassVar[tuple[str, ...]] = ("stretch", "shear")
    conserves_momentum: ClassVar[bool] = True

    def check(self, scene: SceneView) -> None:
        """Raise ValueError also if the group has no network of triangles, or one that is not sound."""
        super().check(scene)
        _check_network(self.group, scene)

    def numbers(self, dimension: int) -> int:
        """Return 7: gradients of u and of v at the two partners, stretch and shear stiffness times area, damping."""
        return 7

    def parameters(self) -> dict[str, float | Vec]:
        """Return no parameters: every triangle has numbers of its own."""
        return {}

    def triangles(self, groups: Sequence[Any], dimension: int) -> tuple[Ints, Floats, Floats]:
        """Return the corners of triangles, (T, 3) agents, gradients of u and v there, (T, 3, 2) 1/m, and areas, m^2.

        groups: of the scene, in its order; dimension: 2 or 3.
        """
        first, network, _ = network_of(groups, self.group, dimension)
        corners, points = network.elements(dimension), network.rest_points(dimension)
        corners = _triangles_only(corners, self.group)
        if self.warp is not None and len(self.warp) != dimension:
            raise ValueError(f"warp = {self.warp}: has {len(self.warp)} numbers, but dimension = {dimension}")
        gradient, area = material_gradients(points, corners, self.warp)
        return (corners + first).astype(np.int32), gradient, area

    def _rows(self, groups: Sequence[Any], dimension: int, turn: int) -> tuple[Ints, Floats]:
        """Return the corners of each triangle from corner `turn` on, and their numbers."""
        corners, gradient, area = self.triangles(groups, dimension)
        corners, gradient = np.roll(corners, -turn, axis=1), np.roll(gradient, -turn, axis=1)
        each = [gradient[:, 1, 0], gradient[:, 2, 0], gradient[:, 1, 1], gradient[:, 2, 1]]
        number = np.stack([*each, self.stretch * area, self.shear * area, np.full(len(area), self.damping)], axis=1)
        return corners, number

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return three rows for every triangle, one for each corner."""
        corners, number = (
            np.concatenate(part) for part in zip(*(self._rows(groups, dimension, k) for k in range(3)), strict=True)
        )
        return Bonds(corners[:, 0], corners[:, 1:], number)

    def stencils(self, groups: Sequence[Any], dimension: int) -> Stencils:
        """Return the corners of every triangle."""
        return Stencils(*self._rows(groups, dimension, 0))

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats] | None:
        """Return bounds for the undeformed shape: row sums of the norms of second derivatives, over the masses."""
        corners, gradient, area = self.triangles(groups, dimension)
        mass, long = all_masses(groups, dimension), np.abs(gradient)
        both = long.sum(axis=2)
        stretch = self.stretch * (long * long.sum(axis=1, keepdims=True)).sum(axis=2)
        rows = (stretch + self.shear * both * both.sum(axis=1, keepdims=True)) * area[:, None]
        square = np.bincount(corners.ravel(), rows.ravel(), len(mass)) / mass
        return square, self.damping * square

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return the energy of all conditions, (B,) J."""
        corners, gradient, area = self.triangles(groups, state.shape[2])
        base = state.pos[:, corners[:, 0]]
        edges = np.stack([offset(base, state.pos[:, corners[:, k]]) for k in (1, 2)], axis=2)  # (B, T, 2, D)
        w = np.einsum("btkd,tku->btud", edges, gradient[:, 1:])
        stretch = (np.linalg.norm(w, axis=-1) - 1) ** 2
        shear = (w[:, :, 0] * w[:, :, 1]).sum(axis=-1) ** 2
        return np.asarray((0.5 * area * (self.stretch * stretch.sum(axis=-1) + self.shear * shear)).sum(axis=1))


# --- bending ----------------------------------------------------------------------------------------------------------


@law
def _gradients(b: Vec, c: Vec, d: Vec) -> tuple[Vec, Vec, Vec, Vec, Vec, Vec]:
    """Return the normals of the triangles (a, b, c) and (b, a, d) with a = 0, and the gradients of their angle.

    The gradients are those at a, b, c and d (Bridson, Marino and Fedkiw 2003, section 4).
    """
    o, e = like(b[0], 0.0), like(b[0], 1.0)
    one, two = cross(b, c), cross(d, b)
    bb, square_1, square_2 = dot(b, b), dot(one, one), dot(two, two)
    sound = (bb > o) & (square_1 > o) & (square_2 > o)
    long, per = np.sqrt(bb), e / bb if sound else o
    at_c = scale(one, -long / square_1 if sound else o)
    at_d = scale(two, -long / square_2 if sound else o)
    share_c, share_d = dot(b, c) * per, dot(b, d) * per
    at_b = scale(add(scale(at_c, share_c), scale(at_d, share_d)), -e)
    at_a = scale(add(add(at_b, at_c), at_d), -e)
    return one, two, at_a, at_b, at_c, at_d


@law
def bending(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return -k (angle - rest + tau d angle / dt) d angle / dx of an edge between two triangles, on one of its corners.

    Role 0 is an end of the edge, with the other end and the two opposite corners as partners; role 1 is an opposite
    corner, with the two ends and the other opposite corner.
    """
    o, end = like(number[0], 0.0), number[3] < like(number[0], 0.5)
    x, y, z = others[0], others[1], others[2]
    none = zero(x.offset)
    base, base_vel = select(end, none, x.offset), select(end, me.vel, x.vel)
    b = sub(select(end, x.offset, y.offset), base)
    c = sub(select(end, y.offset, none), base)
    d = sub(z.offset, base)
    vel_b = sub(select(end, x.vel, y.vel), base_vel)
    vel_c, vel_d = sub(select(end, y.vel, me.vel), base_vel), sub(z.vel, base_vel)
    one, two, at_a, at_b, at_c, at_d = _gradients(b, c, d)
    long = norm(b)
    angle = np.arctan2(dot(cross(one, two), b) * (like(o, 1.0) / long if long > o else o), dot(one, two))
    rate = dot(at_b, vel_b) + dot(at_c, vel_c) + dot(at_d, vel_d)
    moment = -number[0] * (wrap_angle(angle - number[1]) + number[2] * rate)
    return scale(select(end, at_a, at_c), moment)


@law
def bending_derivative(local: Any, number: Any, s: int) -> None:
    """Write -k g g^T and -k tau g g^T with the gradient g of the angle; its second derivative is left out."""
    at = local.at
    b, c, d = (at[1, 0], at[1, 1], at[1, 2]), (at[2, 0], at[2, 1], at[2, 2]), (at[3, 0], at[3, 1], at[3, 2])
    found = _gradients(b, c, d)
    gradient = found[2] + found[3] + found[4] + found[5]
    for p in range(12):
        for q in range(12):
            both = number[s, 0] * gradient[p] * gradient[q]
            local.by_position[p, q], local.by_velocity[p, q] = -both, -number[s, 2] * both


class Bending(Effect):
    """Bending of the triangles of a group's network, by the angle between the normals of neighbouring triangles.

    The condition is C = |e| / sqrt(A + A') (angle - rest angle) for the edge e between triangles of areas A and A'. The
    stiffness is then the flexural rigidity of a sheet that has the shape of a cylinder, bent along the sides of its
    cells, and does not depend on their size (compare Grinspun et al. 2003, Discrete shells). In 3-D only.

    Limits: under load a sheet also folds along the diagonals of its cells: a strip of cells that are r times as wide as
    long has s / (s + r^2) of that rigidity along its length, s = (r + 1 / r)^2. This is 4/5 of it if cells are square,
    and more if they are longer. It acts on angles between triangles alone, so a border bends freely, and a triangle
    that shrinks to a line has none. Rates are those of the undeformed shape.
    """

    kind: Literal["bending"] = "bending"
    group: int = Field(default=0, ge=0, description="index of the group whose network it acts on")
    stiffness: float = Field(ge=0, description="N m, flexural rigidity")
    damping: float = Field(default=0.0, ge=0, description="s, damping of each condition over its stiffness")
    bond_law: ClassVar[Law | None] = bending
    derivative: ClassVar[Law | None] = bending_derivative
    partners: ClassVar[int] = 3
    strengths: ClassVar[tuple[str, ...]] = ("stiffness",)
    conserves_momentum: ClassVar[bool] = True

    def check(self, scene: SceneView) -> None:
        """Raise ValueError also if the group has no network of triangles, or one that is not sound."""
        super().check(scene)
        _check_network(self.group, scene)

    def numbers(self, dimension: int) -> int:
        """Return 4: stiffness, rest angle, damping, and role (0: end of the edge, 1: opposite corner)."""
        return 4

    def parameters(self) -> dict[str, float | Vec]:
        """Return no parameters: every edge has numbers of its own."""
        return {}

    def stencils(self, groups: Sequence[Any], dimension: int) -> Stencils:
        """Return the two ends of every edge between triangles, and the opposite corners."""
        first, network, _ = network_of(groups, self.group, dimension)
        corners, points = network.elements(dimension), network.rest_points(dimension)
        if dimension != 3:
            raise ValueError(f"kind = bending: needs dimension = 3, it is {dimension}")
        corners = _triangles_only(corners, self.group)
        try:
            edges = dihedrals(corners)
        except ValueError as error:
            raise ValueError(f"group = {self.group}: {error}") from None
        angle, weight = dihedral_angles(points, edges)
        number = np.stack([self.stiffness * weight, angle, np.full(len(edges), self.damping)], axis=1)
        return Stencils((edges + first).astype(np.int32), np.concatenate([number, np.zeros((len(edges), 1))], axis=1))

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return four rows for every edge: for its ends, and for the opposite corners."""
        agent, number, _ = self.stencils(groups, dimension)
        orders = [(0, 1, 2, 3), (1, 0, 3, 2), (2, 0, 1, 3), (3, 1, 0, 2)]
        rows = np.concatenate([agent[:, order] for order in orders])
        role = np.repeat([0.0, 0.0, 1.0, 1.0], len(agent))
        return Bonds(rows[:, 0], rows[:, 1:], np.concatenate([np.tile(number[:, :3], (4, 1)), role[:, None]], axis=1))

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats] | None:
        """Return bounds for the undeformed shape: row sums of k |g_p| |g_q|, over the masses."""
        agent, number, _ = self.stencils(groups, dimension)
        first, network, _ = network_of(groups, self.group, dimension)
        points, masses = network.rest_points(dimension), all_masses(groups, dimension)
        a, b, c, d = (points[agent[:, k] - first] for k in range(4))
        edge = np.linalg.norm(b - a, axis=1)
        per_c, per_d = (edge / np.linalg.norm(np.cross(b - a, far - a), axis=1) for far in (c, d))
        share_c, share_d = (((far - a) * (b - a)).sum(axis=1) / edge**2 for far in (c, d))
        ends = [
            np.abs(1 - share_c) * per_c + np.abs(1 - share_d) * per_d,
            np.abs(share_c) * per_c + np.abs(share_d) * per_d,
        ]
        sizes = np.stack([*ends, per_c, per_d], axis=1)
        rows = number[:, :1] * sizes * sizes.sum(axis=1, keepdims=True)
        square = np.bincount(agent.ravel(), rows.ravel(), len(masses)) / masses
        return square, self.damping * square

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return the sum of k (angle - rest)^2 / 2 over all edges, (B,) J."""
        agent, number, _ = self.stencils(groups, state.shape[2])
        base = state.pos[:, agent[:, 0]]
        at = np.stack([offset(base, state.pos[:, agent[:, k]]) for k in range(4)], axis=2)  # (B, E, 4, 3)
        every = np.arange(4 * len(agent)).reshape(-1, 4)
        off = np.stack([dihedral_angles(each.reshape(-1, 3), every)[0] for each in at]) - number[:, 1]
        off -= 2 * np.pi * np.floor(off / (2 * np.pi) + 0.5)
        return np.asarray((0.5 * number[:, 0] * off**2).sum(axis=1))
