"""Semi-implicit (symplectic) Euler: the velocity first, then the position with the new velocity."""

from __future__ import annotations

from typing import ClassVar, Literal

from flockenv.jit.decorators import kernel
from flockenv.physics.integrators.single_stage import OneStage

__all__ = ["SemiImplicitEuler"]


@kernel
def move(x: float, v: float, a: float, dt: float) -> tuple[float, float]:
    """Return x + h v' and v' = v + h a."""
    v = v + dt * a
    return x + dt * v, v


class SemiImplicitEuler(OneStage):
    """Semi-implicit Euler, order 1, one evaluation; bounded energy while h omega < 2 (Reynolds' own step, 1999).

    v' = v + h a(x, v, t), x' = x + h v' (de Vogelaere 1956; Hairer, Lubich and Wanner 2006, VI.3).

    Limits: with drag or other forces of the velocity it is no longer symplectic, and energy is that of a near system:
    it swings about the true one by an amount proportional to h.
    """

    kind: Literal["semi_implicit_euler"] = "semi_implicit_euler"
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
