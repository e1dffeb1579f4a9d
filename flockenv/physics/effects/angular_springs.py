"""Springs of a network about the angles of three particles, the hinges.

Rest angles are those of the network's undeformed shape. The forces on the three particles sum to zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, dot, norm, scale, select, sub
from flockenv.physics.effects.effect import Bonds, Effect, Me, all_masses, network_of

if TYPE_CHECKING:
    from flockenv.model.state import State

__all__ = ["AngularSprings", "wrap_angle"]

Floats = NDArray[np.float64]


@law
def _turn_left(a: Vec) -> Vec:
    """Return a 2-D vector turned a quarter to the left."""
    return (-a[1], a[0])


@law
def _angle_and_gradients(a: Vec, b: Vec) -> tuple[float, Vec, Vec]:
    """Return the angle from arm a to arm b and its gradients, d angle / da and d angle / db.

    In 2-D the angle has a sign; in 3-D it is between 0 and pi, and the gradients of collinear arms are 0.
    """
    o, e = like(a[0], 0.0), like(a[0], 1.0)
    aa, bb = dot(a, a), dot(b, b)
    sound = (aa > o) & (bb > o)
    per_a, per_b = e / aa if sound else o, e / bb if sound else o
    if len(a) == 2:
        angle = np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
        return angle, scale(_turn_left(a), -per_a), scale(_turn_left(b), per_b)
    else:
        across = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
        sine, cosine = norm(across), dot(a, b)
        bent = sine > o
        share = e / sine if bent else o
        # (b - (a . b / a . a) a) / |a x b| is a unit vector over |a|
        to_b = scale(sub(b, scale(a, cosine * per_a)), -share)
        to_a = scale(sub(a, scale(b, cosine * per_b)), -share)
        return np.arctan2(sine, cosine), to_b, to_a


@law
def wrap_angle(angle: float) -> float:
    """Return the angle wrapped into [-pi, pi)."""
    turn = like(angle, 2 * np.pi)
    return angle - turn * np.floor(angle / turn + like(angle, 0.5))  # type: ignore[no-any-return]


@law
def angular_spring(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return M = -k (angle - rest) - c d angle / dt as forces on the two ends, and the reaction on the apex."""
    near, far = others[0], others[1]
    role, half = number[3], like(number[0], 0.5)
    first, apex = role < half, (role > half) & (role < like(half, 1.5))
    # arms and their velocities, from the apex: an end's first partner is the apex, its second the other end
    back, beyond = scale(near.offset, like(half, -1.0)), sub(far.offset, near.offset)
    moves, passes = sub(me.vel, near.vel), sub(far.vel, near.vel)
    a = select(apex, near.offset, select(first, back, beyond))
    b = select(apex, far.offset, select(first, beyond, back))
    va = select(apex, sub(near.vel, me.vel), select(first, moves, passes))
    vb = select(apex, sub(far.vel, me.vel), select(first, passes, moves))
    angle, grows_a, grows_b = _angle_and_gradients(a, b)
    rate = dot(grows_a, va) + dot(grows_b, vb)
    moment = -number[0] * wrap_angle(angle - number[2]) - number[1] * rate
    on_a, on_b = scale(grows_a, moment), scale(grows_b, moment)
    both = scale(add(on_a, on_b), like(half, -1.0))
    return select(apex, both, select(first, on_a, on_b))


class AngularSprings(Effect):
    """Damped springs about the hinges of a group's network: a moment k (angle - rest angle) at each apex.

    The moment is M = -k (a - L) - c da/dt, a the angle and L that at rest: the angle term of molecular mechanics
    (Brooks et al. 1983), here damped.

    Limits: in 3-D the angle has no sign: a hinge that is bent through straight is not brought back, and one that is
    exactly straight, but bent at rest, has no direction to return in. Nothing resists torsion. Rates are those of the
    undeformed shape.
    """

    kind: Literal["angular_springs"] = "angular_springs"
    group: int = Field(default=0, ge=0, description="index of the group whose network it acts on")
    stiffness: float = Field(ge=0, description="N m/rad, moment per change of the angle")
    damping: float = Field(default=0.0, ge=0, description="N m s/rad, moment per rate of the angle")
    bond_law: ClassVar[Law | None] = angular_spring
    partners: ClassVar[int] = 2
    strengths: ClassVar[tuple[str, ...]] = ("stiffness", "damping")
    conserves_momentum: ClassVar[bool] = True

    def numbers(self, dimension: int) -> int:
        """Return 4: stiffness, damping, rest angle, and role (0: first end, 1: apex, 2: second end)."""
        return 4

    def parameters(self) -> dict[str, float | Vec]:
        """Return no parameters: every hinge has numbers of its own."""
        return {}

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return rows for the first ends, the apexes and the second ends of all hinges."""
        first, network, _ = network_of(groups, self.group, dimension)
        hinges, points = network.hinges(dimension), network.rest_points(dimension)
        a, b = points[hinges[:, 0]] - points[hinges[:, 1]], points[hinges[:, 2]] - points[hinges[:, 1]]
        rest = _angles(a, b)
        i, apex, k = (hinges + first).T
        number = [np.full(len(rest), self.stiffness), np.full(len(rest), self.damping), rest]
        roles = [np.stack([*number, np.full(len(rest), float(role))], axis=1) for role in range(3)]
        partner = [np.stack(pair, axis=1) for pair in ((apex, k), (i, k), (apex, i))]
        return Bonds(np.concatenate([i, apex, k]), np.concatenate(partner).astype(np.int32), np.concatenate(roles))

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats] | None:
        """Return bounds for the undeformed shape: row sums of k |d angle/dx| |d angle/dy| over the hinges."""
        first, network, _ = network_of(groups, self.group, dimension)
        hinges, points, mass = network.hinges(dimension), network.rest_points(dimension), all_masses(groups, dimension)
        per_a, per_b = (1 / np.linalg.norm(points[hinges[:, end]] - points[hinges[:, 1]], axis=1) for end in (0, 2))
        gradients = np.stack([per_a, per_a + per_b, per_b]) * 2 * (per_a + per_b)
        rows = np.bincount((hinges + first).T.ravel(), gradients.ravel(), len(mass)) / mass
        return self.stiffness * rows, self.damping * rows

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return the sum of k (angle - rest)^2 / 2 over all hinges, (B,) J."""
        bonds = self.bonds(groups, state.shape[2])
        third = len(bonds.agent) // 3
        i, apex, k = bonds.agent[:third], bonds.agent[third : 2 * third], bonds.agent[2 * third :]
        angle = _angles(offset(state.pos[:, apex], state.pos[:, i]), offset(state.pos[:, apex], state.pos[:, k]))
        off = angle - bonds.number[:third, 2]
        off -= 2 * np.pi * np.floor(off / (2 * np.pi) + 0.5)
        return np.asarray((0.5 * bonds.number[:third, 0] * off**2).sum(axis=1))


def _angles(a: Floats, b: Floats) -> Floats:
    """Return the angles from a to b, (..., D): with a sign in 2-D, between 0 and pi in 3-D."""
    along = (a * b).sum(axis=-1)
    if a.shape[-1] == 2:
        return np.asarray(np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], along))
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), along))
