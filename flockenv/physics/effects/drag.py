"""Drag, linear and quadratic: a force against the velocity relative to the medium."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import norm, scale, sub
from flockenv.physics.effects.effect import Effect, Me, Stencils, all_masses

__all__ = ["Drag", "QuadraticDrag"]


@law
def drag(p: Any, me: Me) -> Vec:
    """Return F = -c (v - u)."""
    return scale(sub(me.vel, me.medium), -p.rate)


@law
def quadratic_drag(p: Any, me: Me) -> Vec:
    """Return F = -c |v - u| (v - u)."""
    relative = sub(me.vel, me.medium)
    return scale(relative, -p.rate * norm(relative))


@law
def drag_derivative(local: Any, number: Any, s: int) -> None:
    """Write dF/dv = -c 1; that of the medium's velocity is left out."""
    for a in range(local.at.shape[1]):
        for b in range(local.at.shape[1]):
            local.by_position[a, b] = 0.0
            local.by_velocity[a, b] = -number[s, 0] if a == b else 0.0


class Drag(Effect):
    """Linear drag, F = -c (v - u) in a medium of velocity u: without other forces v = v0 exp(-c t / m).

    The resistance of a slow body in a viscous fluid (Stokes 1851).

    Limits: it is the resistance at low Reynolds numbers; a fast body leaves a wake, and has that of `quadratic_drag`. c
    is the same for all agents, whatever their radius.
    """

    kind: Literal["drag"] = "drag"
    rate: float = Field(ge=0, description="c, kg/s, force per speed relative to the medium")
    own_law: ClassVar[Law | None] = drag
    derivative: ClassVar[Law | None] = drag_derivative
    strengths: ClassVar[tuple[str, ...]] = ("rate",)
    linear_drag: ClassVar[str | None] = "rate"

    def stencils(self, groups: Sequence[Any], dimension: int) -> Stencils:
        """Return every agent by itself."""
        count = sum(group.size for group in groups)
        return Stencils(np.arange(count, dtype=np.int32)[:, None], np.full((count, 1), self.rate))

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return w^2 = 0, as nothing oscillates, and the damping c / m."""
        damping = self.rate / all_masses(groups, dimension)
        return np.zeros(len(damping)), damping


class QuadraticDrag(Effect):
    """Quadratic drag (of a body with a wake), F = -c |v - u| (v - u) in a medium of velocity u.

    Under gravity g the speed of fall is v tanh(g t / v), with v = sqrt(m g / c) in the end.

    Newton 1687, Principia, book II.

    Limits: an explicit Euler step reverses the velocity relative to the medium if h c |v| / m > 1, and diverges if it
    is above 2: the limit depends on the speed, so it is not tested.
    """

    kind: Literal["quadratic_drag"] = "quadratic_drag"
    rate: float = Field(ge=0, description="c, kg/m: half of density x cross-section x drag coefficient")
    own_law: ClassVar[Law | None] = quadratic_drag
    strengths: ClassVar[tuple[str, ...]] = ("rate",)
