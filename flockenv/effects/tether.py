"""Springs to a fixed point, and a field of pendulums: forces of one agent by itself that have a potential energy."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.effects.base import Effect, Me
from flockenv.kernels import Vec, law, like
from flockenv.space import Torus
from flockenv.vec import add, scale, sub, unit

__all__ = ["Swing", "Tether"]

Floats = NDArray[np.floating[Any]]


@law
def tether(p: Any, me: Me) -> Vec:
    """F = -k (|d| - L) unit(d) - c v with d from the centre to the agent; no direction, and no force of L, at d = 0."""
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
    """F = -s sin((x - c) / l) along each axis."""
    return scale(_sines(scale(sub(me.pos, p.centre), like(p.length, 1.0) / p.length)), -p.strength)


class _Centred(Effect):
    """What forces about a fixed point have in common."""

    centre: tuple[float, ...] = Field(min_length=2, max_length=3, description="m")

    def check(self, scene: Any) -> None:
        """Refuse a centre of another dimension, and a torus, on which there is no single way to a point."""
        if len(self.centre) != scene.dimension:
            raise ValueError(f"centre = {self.centre}: dimension = {scene.dimension}")
        if isinstance(scene.space, Torus):
            raise ValueError(f"centre = {self.centre}: there is no single way to a point on a torus; use plane or box")


class Tether(_Centred):
    """A damped spring to a fixed point, F = -k (|d| - L) unit(d) - c v: with L = 0 an oscillator, w^2 = k / m."""

    kind: Literal["tether"] = "tether"
    stiffness: float = Field(ge=0, description="k, N/m")
    damping: float = Field(default=0.0, ge=0, description="c, kg/s")
    rest: float = Field(default=0.0, ge=0, description="L, m, where the spring pulls no more")
    own_law: ClassVar[str | None] = "tether"
    strengths: ClassVar[tuple[str, ...]] = ("stiffness", "damping")

    def potential(self, pos: Floats, mass: Floats) -> Floats:
        """k (|d| - L)^2 / 2, J; what the damper takes is not in it."""
        stretch = np.linalg.norm(pos - np.array(self.centre), axis=-1) - self.rest
        return np.asarray(0.5 * self.stiffness * stretch**2)


class Swing(_Centred):
    """A pendulum along each axis, F = -s sin((x - c) / l): the angle is (x - c) / l, w^2 = s / (m l) for small ones."""

    kind: Literal["swing"] = "swing"
    strength: float = Field(ge=0, description="s, N; of a pendulum in gravity: m g")
    length: float = Field(default=1.0, gt=0, description="l, m")
    own_law: ClassVar[str | None] = "swing"
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    def potential(self, pos: Floats, mass: Floats) -> Floats:
        """s l sum over the axes of 1 - cos((x - c) / l), J."""
        angles = (pos - np.array(self.centre)) / self.length
        return np.asarray(self.strength * self.length * (1 - np.cos(angles)).sum(axis=-1))
