"""Explicit (forward) Euler."""

from __future__ import annotations

from typing import ClassVar, Literal

from flockenv.jit.decorators import kernel
from flockenv.physics.integrators.single_stage import OneStage

__all__ = ["ExplicitEuler"]


@kernel
def move(x: float, v: float, a: float, dt: float) -> tuple[float, float]:
    """Return x + h v and v + h a, both from the old values."""
    return x + dt * v, v + dt * a


class ExplicitEuler(OneStage):
    """Explicit Euler, order 1, one evaluation; unstable for every undamped oscillation at every step size.

    x' = x + h v, v' = v + h a(x, v, t) (Euler 1768).

    Limits: every undamped oscillation grows by the root of 1 + (h omega)^2 per step: for orbits and springs take
    another method.
    """

    kind: Literal["explicit_euler"] = "explicit_euler"
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
