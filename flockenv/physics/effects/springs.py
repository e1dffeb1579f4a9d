"""Springs of a network, between two particles, along their distance; about angles see `angular_springs`.

Rest lengths are those of the network's undeformed shape, until a spring yields. The forces on both ends sum to zero.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import axis, dot, norm, scale, select, sub
from flockenv.model.networks import BEND, SHEAR
from flockenv.model.networks import Springs as Joints
from flockenv.physics.effects.effect import Bonds, Effect, Me, Stencils, all_masses, network_of

if TYPE_CHECKING:
    from flockenv.model.scene_view import SceneView
    from flockenv.model.state import State

__all__ = ["Springs"]

Floats = NDArray[np.float64]


@law
def _towards(me: Me, other: Any) -> tuple[Vec, float]:
    """Return the unit vector to the other end and its distance; two ends in one place part along the first axis."""
    o, length = like(other.offset[0], 0.0), norm(other.offset)
    apart = length > o
    aside = scale(axis(other.offset, 0), like(o, 1.0) if me.who < other.who else like(o, -1.0))
    return select(apart, scale(other.offset, like(o, 1.0) / length if apart else o), aside), length


@law
def spring(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return F = (k (l - L) + c (v_j - v) . d) d, along the unit vector d to the other end (Witkin & Baraff 1997).

    Two ends in one place part along the first axis: the one with the higher index in the positive direction.
    """
    other = others[0]
    along, length = _towards(me, other)
    return scale(along, number[0] * (length - number[2]) + number[1] * dot(sub(other.vel, me.vel), along))


@law
def _curve_force(number: Vec, extension: float, rest: float) -> float:
    """Return k L f((l - L) / L) for an extension l - L: the slope at rest, and its change past each kink of the curve.

    number: the slope at rest, damping, rest length, and for each kink its strain and the change of slope, times k.
    """
    o, force = like(extension, 0.0), number[0] * extension
    for place in range(3, len(number) - 1, 2):
        past = extension - rest * number[place]
        outwards = past if number[place] >= o else -past
        force += number[place + 1] * (outwards if outwards > o else o)
    return force


@law
def curved_spring(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return the force of a spring with a strain-stress curve; the damping and the direction are those of `spring`."""
    other = others[0]
    along, length = _towards(me, other)
    force = _curve_force(number, length - number[2], number[2])
    return scale(along, force + number[1] * dot(sub(other.vel, me.vel), along))


@law
def _per_length(local: Any) -> tuple[float, float]:
    """Return the distance of the two ends of a stencil, and one over it; 0 if it is 0."""
    length = 0.0
    for k in range(local.at.shape[1]):
        length += local.at[1, k] * local.at[1, k]
    length = np.sqrt(length)
    return length, 1.0 / length if length > 0.0 else 0.0


@law
def _write_blocks(local: Any, per: float, stiffness: float, across: float, damping: float) -> None:
    """Write the derivatives of the forces on two ends, from those along d and across it, and the damping along d."""
    d, apart = local.at.shape[1], per > 0.0
    for a in range(d):
        along_a = local.at[1, a] * per if apart else (1.0 if a == 0 else 0.0)
        for b in range(d):
            outer = along_a * (local.at[1, b] * per if apart else (1.0 if b == 0 else 0.0))
            slope = (stiffness - across) * outer + (across if a == b else 0.0)
            damp = damping * outer
            local.by_position[a, b] = local.by_position[d + a, d + b] = -slope
            local.by_position[a, d + b] = local.by_position[d + a, b] = slope
            local.by_velocity[a, b] = local.by_velocity[d + a, d + b] = -damp
            local.by_velocity[a, d + b] = local.by_velocity[d + a, b] = damp


@law
def spring_derivative(local: Any, number: Any, s: int) -> None:
    """Write the derivatives of a spring's forces on its two ends; the last number is the rest length L.

    dF_i/dx_j = k d d^T + k (1 - L / l) (1 - d d^T) and dF_i/dv_j = c d d^T. The second term is left out if the spring
    is compressed, where it would be negative (Choi and Ko 2002), and so is the derivative of d in the damping. A broken
    spring, of infinite rest length, has none.
    """
    _, per = _per_length(local)
    rest = number[s, number.shape[1] - 1]
    whole = 1.0 if rest < np.inf else 0.0
    across = max(1.0 - rest * per, 0.0) if per > 0.0 or rest == 0.0 else 0.0
    _write_blocks(local, per, whole * number[s, 0], number[s, 0] * across, whole * number[s, 1])


@law
def curved_derivative(local: Any, number: Any, s: int) -> None:
    """Write the derivatives of a spring with a strain-stress curve: k f' along it, and F / l across it if that is > 0.

    At a kink the slope is the one nearer to rest. The last number is the rest length; a broken spring has none.
    """
    length, per = _per_length(local)
    rest = number[s, number.shape[1] - 1]
    if rest == np.inf:
        _write_blocks(local, 0.0, 0.0, 0.0, 0.0)
        return
    extension = length - rest
    slope, force = number[s, 0], number[s, 0] * extension
    for place in range(3, number.shape[1] - 1, 2):
        past = extension - rest * number[s, place]
        side = 1.0 if number[s, place] >= 0.0 else -1.0
        if side * past > 0.0:
            slope += side * number[s, place + 1]
            force += number[s, place + 1] * side * past
    across = max(force * per, 0.0) if per > 0.0 else (slope if rest == 0.0 else 0.0)
    _write_blocks(local, per, slope, across, number[s, 1])


@law
def spring_strain(local: Any, number: Any, s: int) -> tuple[float, float]:
    """Return the length of a spring over its rest length, the last number, twice; 0 without one, or if it is broken."""
    length, _ = _per_length(local)
    rest = number[s, number.shape[1] - 1]
    strain = length / rest if 0.0 < rest < np.inf else 0.0
    return strain, strain


@law
def lasting_spring(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return the force of a spring with the last number as rest length; 0 if that is infinite: it is broken."""
    o, rest = like(number[0], 0.0), number[3]
    whole = rest < like(rest, np.inf)
    force = spring(p, me, others, (number[0], number[1], rest if whole else o))
    return select(whole, force, scale(force, o))


@law
def lasting_curved_spring(p: Any, me: Me, others: Any, number: Vec) -> Vec:
    """Return the force of a spring with a curve, whose strain is that over the last number; see `lasting_spring`."""
    o, rest, other = like(number[0], 0.0), number[-1], others[0]
    whole = rest < like(rest, np.inf)
    now = rest if whole else o
    along, length = _towards(me, other)
    force = _curve_force(number, length - now, now) + number[1] * dot(sub(other.vel, me.vel), along)
    return scale(along, force if whole else o)


@law
def length_after_yielding(p: Any, me: Me, others: Any, number: Vec) -> float:
    """Return the rest length after a step at which the spring is l long; inf if it breaks, and stays broken.

    Beyond an elastic strain |l / L - 1| of p.yields the rest length L follows, so that this strain is not exceeded
    (ideal plasticity). It breaks if l exceeds the first rest length by more than the share p.breaks.
    """
    one, never = like(number[0], 1.0), like(number[0], np.inf)
    length, rest = norm(others[0].offset), number[-1]
    longer, shorter = one + p.yields, one - p.yields
    follows = length / longer if length > rest * longer else (length / shorter if length < rest * shorter else rest)
    whole = (rest < never) & ((length - number[2]) <= number[2] * p.breaks)
    return follows if whole else never


Curve = Annotated[tuple[tuple[float, float], ...], Field(min_length=2, max_length=64)]
"""Points of a strain-stress curve, (strain, force over k L)."""


class Springs(Effect):
    """Damped springs along the edges of a group's network: F = k (l - L) + c dl/dt towards the other end.

    With a `curve`, F = k L f((l - L) / L) + c dl/dt: f is linear between its points, and goes on with the first and the
    last slope. It is stress over Young's modulus, if k = E A / L for a fibre of cross section A.

    With `yield_strain` a spring that is strained further takes a new rest length for good; with `break_strain` one that
    is longer breaks, and exerts no force any more. `State.bonds` holds the present rest lengths, inf of broken springs.
    The work of yielding and the energy of a spring that breaks are dissipated.

    Springs: Hooke 1678; cloth of springs along, across and beyond cells: Provot 1995.

    Limits: they act along edges alone: nothing resists folding, and a triangle or cell of springs that is inside out is
    at rest there (`altitude_springs`, `angular_springs`, `elastic`). Two ends may pass through each other.
    """

    kind: Literal["springs"] = "springs"
    group: int = Field(default=0, ge=0, description="index of the group whose network it acts on")
    stiffness: float = Field(ge=0, description="N/m, of edges")
    shear: float | None = Field(default=None, ge=0, description="N/m, of springs across cells (default: as edges)")
    bend: float | None = Field(default=None, ge=0, description="N/m, of springs over two edges (default: as edges)")
    damping: float = Field(default=0.0, ge=0, description="kg/s, along each spring")
    ratio: float = Field(default=0.0, ge=0, description="more damping, as a fraction of each spring's critical one")
    rest: float = Field(default=1.0, ge=0, description="rest lengths over those of the network; 0 = rest length 0")
    curve: Curve | None = Field(
        default=None,
        description="points of strain (l - L) / L and force over k L, not falling, 0 at 0 (default: [0, 0], [1, 1])",
    )
    yield_strain: float | None = Field(
        default=None,
        gt=0,
        description="largest elastic strain (l - L) / L in size; beyond it L changes (default: none)",
    )
    break_strain: float | None = Field(
        default=None, gt=0, description="strain over the first rest length at which a spring breaks (default: never)"
    )
    strain_law: ClassVar[Law | None] = spring_strain
    strengths: ClassVar[tuple[str, ...]] = ("stiffness", "shear", "bend", "damping", "ratio")
    conserves_momentum: ClassVar[bool] = True

    @field_validator("curve")
    @classmethod
    def _check_curve(cls, curve: Curve | None) -> Curve | None:
        """Raise ValueError unless strains increase, forces do not fall, and there is none at rest."""
        for k, (before, after) in enumerate(itertools.pairwise(curve or ())):
            if not after[0] > before[0]:
                raise ValueError(
                    f"strain {after[0]:g} of point {k + 1} is not larger than {before[0]:g}, the one before"
                )
            if after[1] < before[1]:
                raise ValueError(f"force {after[1]:g} of point {k + 1} is less than {before[1]:g}, the one before")
        if curve is not None:
            strain, force = np.array(curve).T
            slopes = np.diff(force) / np.diff(strain)
            place = int((strain[1:-1] < 0).sum())  # of the part that holds strain 0, perhaps beyond the points
            at_rest = force[place] - slopes[place] * strain[place]
            if abs(at_rest) > 1e-9 * np.abs(force).max():
                raise ValueError(
                    f"force at strain 0 is {at_rest:g}; must be 0, as rest lengths are those without force"
                )
        return curve

    @property
    def lasts(self) -> bool:
        """True if springs yield or break, so that their rest lengths are part of the state."""
        return self.yield_strain is not None or self.break_strain is not None

    @property
    def bond_law(self) -> Law:  # type: ignore[override]  # depends on what springs keep
        """The law of a spring, by a curve or without, with a constant or a present rest length."""
        if self.curve is not None:
            return lasting_curved_spring if self.lasts else curved_spring
        return lasting_spring if self.lasts else spring

    @property
    def bond_keep_law(self) -> Law | None:  # type: ignore[override]
        """The law of the present rest length, if springs yield or break."""
        return length_after_yielding if self.lasts else None

    @property
    def derivative(self) -> Law | None:  # type: ignore[override]
        """The law of the derivatives, by a curve or without."""
        return spring_derivative if self.curve is None else curved_derivative

    def numbers(self, dimension: int) -> int:
        """Return 3: stiffness, damping, rest length; 2 for each kink; and 1, the present length, if springs last."""
        return 3 + self._kinks.size + self.lasts

    @property
    def _slopes(self) -> Floats:
        """The slopes of the curve, from the lowest strain on; that of Hooke is 1."""
        strain, force = np.array(self.curve or ((0.0, 0.0), (1.0, 1.0))).T
        return np.asarray(np.diff(force) / np.diff(strain))

    @property
    def _kinks(self) -> Floats:
        """The strain of each kink of the curve and the change of slope there, (K, 2)."""
        strain = [point[0] for point in (self.curve or ())[1:-1]]
        return np.array([strain, np.diff(self._slopes)]).T

    def _slope_at_rest(self, side: Literal["left", "right"]) -> float:
        """Return the slope of the curve just below strain 0, or just above."""
        return float(self._slopes[np.searchsorted(self._kinks[:, 0], 0.0, side)])

    def parameters(self) -> dict[str, float | Vec]:
        """Return the strains at which springs yield and break, if any does: inf for never."""
        strains = {"yields": self.yield_strain, "breaks": self.break_strain}
        return {name: math.inf if strain is None else strain for name, strain in strains.items()} if self.lasts else {}

    def check(self, scene: SceneView) -> None:
        """Raise ValueError also if two effects would keep the rest lengths of one network."""
        super().check(scene)
        same = [e for e in scene.effects if isinstance(e, Springs) and e.lasts and e.group == self.group]
        if self.lasts and len(same) > 1:
            raise ValueError(
                f"group = {self.group}: {len(same)} effects let its springs yield or break; at most one may"
            )

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return two rows for every spring, one for each end."""
        first, network, mass = network_of(groups, self.group, dimension)
        springs = network.springs(dimension)
        stiffness, i, j = self._stiffness(springs), springs.i, springs.j
        light = 1 / mass[i] + 1 / mass[j]  # 1/kg; two held ends do not oscillate
        reduced = np.divide(1.0, light, out=np.zeros_like(light), where=light > 0)
        firm = stiffness * self._slope_at_rest("right")
        damping = self.damping + 2 * self.ratio * np.sqrt(firm * reduced)
        rest = self.rest * springs.rest
        kinks = [part for strain, turn in self._kinks for part in (np.full(len(rest), strain), turn * stiffness)]
        every = [stiffness * self._slope_at_rest("left"), damping, rest, *kinks, rest]
        number = np.stack(every[: self.numbers(dimension)], axis=1)
        agent, partner = np.concatenate([i, j]) + first, np.concatenate([j, i]) + first
        kept = np.tile(np.arange(len(i)) + self.first_kept(groups, dimension), 2) if self.lasts else None
        return Bonds(agent.astype(np.int32), partner[:, None].astype(np.int32), np.concatenate([number, number]), kept)

    def _stiffness(self, springs: Joints) -> Floats:
        """Return the stiffness of each spring by its role, N/m."""
        stiffness = np.full(len(springs.i), self.stiffness)
        for role, value in ((SHEAR, self.shear), (BEND, self.bend)):
            if value is not None:
                stiffness[springs.role == role] = value
        return stiffness

    def first_kept(self, groups: Sequence[Any], dimension: int) -> int:
        """Return where in State.bonds the rest lengths of its group begin: behind those of all networks before.

        groups: of the scene, in its order; dimension: 2 or 3.
        """
        return springs_before(groups[: self.group], dimension)

    def stencils(self, groups: Sequence[Any], dimension: int) -> Stencils:
        """Return the two ends of every spring; the last number is the present rest length, and so it is if constant."""
        bonds = self.bonds(groups, dimension)
        half = len(bonds.agent) // 2
        ends = np.stack([bonds.agent[:half], bonds.partner[:half, 0]], axis=1)
        number = bonds.number[:half]
        if bonds.kept is None:
            return Stencils(ends, np.concatenate([number, number[:, 2:3]], axis=1))
        return Stencils(ends, number, bonds.kept[:half])

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats] | None:
        """Return bounds by Gershgorin's circles: w^2 <= 2 sum k / m (k: steepest slope), and damping <= 2 sum c / m."""
        bonds, mass = self.bonds(groups, dimension), all_masses(groups, dimension)
        _, network, _ = network_of(groups, self.group, dimension)
        stiffest = np.tile(self._stiffness(network.springs(dimension)) * self._slopes.max(), 2)
        swing, damp = (np.bincount(bonds.agent, each, len(mass)) for each in (stiffest, bonds.number[:, 1]))
        return 2 * swing / mass, 2 * damp / mass

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return the energy of all springs that are not broken, (B,) J: sum of k (l - L)^2 / 2 without a curve."""
        bonds = self.bonds(groups, state.shape[2])
        half = len(bonds.agent) // 2
        i, j, number = bonds.agent[:half], bonds.partner[:half, 0], bonds.number[:half]
        length = np.linalg.norm(offset(state.pos[:, i], state.pos[:, j]), axis=-1)
        rest = number[:, 2]
        if bonds.kept is not None and state.bonds.shape[1]:
            rest = state.bonds[:, bonds.kept[:half]]  # type: ignore[assignment]
            rest = np.where(np.isfinite(rest), rest, length)
        energy = 0.5 * number[:, 0] * (length - rest) ** 2
        for k, (strain, _) in enumerate(self._kinks):
            side = 1.0 if strain >= 0 else -1.0
            energy += side * 0.5 * number[:, 4 + 2 * k] * np.maximum(side * (length - rest * (1 + strain)), 0.0) ** 2
        return np.asarray(energy.sum(axis=1))


def springs_before(groups: Sequence[Any], dimension: int) -> int:
    """Return the number of springs of the networks of some groups."""
    return sum(len(group.network.springs(dimension).i) for group in groups if group.network is not None)
