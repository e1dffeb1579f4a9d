"""Springs to a fixed point, and pendulums along the axes: forces with a potential energy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, scale, sub, unit
from flockenv.model.state import State
from flockenv.physics.effects.effect import Effect, Me, Vector, all_masses

__all__ = ["Swing", "Tether"]

Floats = NDArray[np.float64]


@law
def tether(p: Any, me: Me) -> Vec:
    """Return F = -k (|d| - L) unit(d) - c v, with d from the centre to the agent; unit(d) is 0 at d = 0."""
    d = sub(me.pos, p.centre)
    spring = add(scale(d, -p.stiffness), scale(unit(d), p.stiffness * p.rest))
    return sub(spring, scale(me.vel, p.damping))


@law
def _sines(a: Vec) -> Vec:
    """Return the sine of each coordinate."""
    if len(a) == 2:
        return (np.sin(a[0]), np.sin(a[1]))
    else:
        return (np.sin(a[0]), np.sin(a[1]), np.sin(a[2]))


@law
def swing(p: Any, me: Me) -> Vec:
    """Return F = -s sin((x - c) / l) along each axis."""
    return scale(_sines(scale(sub(me.pos, p.centre), like(p.length, 1.0) / p.length)), -p.strength)


class _Centred(Effect):
    """Base class of forces about a fixed point; on a torus, about its nearest image."""

    centre: Vector = Field(description="m, the fixed point")
    places: ClassVar[tuple[str, ...]] = ("centre",)


class Tether(_Centred):
    """A damped spring to a fixed point, F = -k (|d| - L) unit(d) - c v: with L = 0 an oscillator, w^2 = k / m.

    Hooke 1678.

    Limits: with a rest length the direction jumps at the centre, where the force is 0. The damping is
    relative to space, not to a medium.
    """

    kind: Literal["tether"] = "tether"
    stiffness: float = Field(ge=0, description="k, N/m, force per stretch")
    damping: float = Field(default=0.0, ge=0, description="c, kg/s, force per speed")
    rest: float = Field(default=0.0, ge=0, description="L, m, rest length")
    own_law: ClassVar[Law | None] = tether
    strengths: ClassVar[tuple[str, ...]] = ("stiffness", "damping")

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return w^2 = k / m, and damping c / m."""
        mass = all_masses(groups, dimension)
        return self.stiffness / mass, self.damping / mass

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return the sum of k (|d| - L)^2 / 2 over all agents, (B,) J."""
        stretch = np.linalg.norm(offset(self.centre, state.pos), axis=-1) - self.rest
        return np.asarray((0.5 * self.stiffness * stretch**2).sum(axis=1))


class Swing(_Centred):
    """A pendulum along each axis, F = -s sin((x - c) / l): the angle is (x - c) / l, w^2 = s / (m l) for small ones.

    Huygens 1673.

    Limits: it is the force of a pendulum on a coordinate, along each axis by itself: the agent moves on a straight
    line, not on an arc, and in all directions it is no spherical pendulum. Beyond |x - c| = pi l it pulls to the next
    minimum.
    """

    kind: Literal["swing"] = "swing"
    strength: float = Field(ge=0, description="s, N; of a pendulum in gravity: m g")
    length: float = Field(default=1.0, gt=0, description="l, m, length of the pendulum")
    own_law: ClassVar[Law | None] = swing
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return w^2 = s / (m l), that of small oscillations, and damping 0."""
        square = self.strength / self.length / all_masses(groups, dimension)
        return square, np.zeros(len(square))

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> Floats:
        """Return the sum of s l (1 - cos((x - c) / l)) over all agents and axes, (B,) J."""
        angles = offset(self.centre, state.pos) / self.length
        return np.asarray(self.strength * self.length * (1 - np.cos(angles)).sum(axis=(1, 2)))
