"""Euler with the mean of the old and the new velocity."""

from __future__ import annotations

from typing import ClassVar, Literal

from flockenv.jit.decorators import kernel, like
from flockenv.physics.integrators.single_stage import OneStage

__all__ = ["AveragedVelocity"]


@kernel
def move(x: float, v: float, a: float, dt: float) -> tuple[float, float]:
    """Return x + h (v + v')/2 and v' = v + h a, exact under a constant force."""
    new = v + dt * a
    return x + dt * like(dt, 0.5) * (v + new), new


class AveragedVelocity(OneStage):
    """Averaged-velocity step, order 1, one evaluation; exact under a constant force, adds energy to oscillations.

    v' = v + h a(x, v, t), x' = x + h (v + v') / 2: the formulas of uniform acceleration (Galileo 1638), step by step.

    Limits: it is exact under a constant force only.
    """

    kind: Literal["averaged_velocity"] = "averaged_velocity"
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
