"""Euler with the mean of the old and the new velocity: the step of the lectures."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.integrators.base import Integrator
from flockenv.kernels import kernel, like

__all__ = ["AveragedVelocity"]


@kernel
def advance(acceleration: Any, context: Any, pos: Any, vel: Any, dt: float, stages: Any, first: int, end: int) -> None:
    """x += h (v + v')/2 with v' = v + h a: exact under a constant force."""
    a, half = stages[0], like(dt, 0.5)
    acceleration(context, pos, vel, a)
    for i in range(np.uint64(first), np.uint64(end)):
        old = vel[i]
        vel[i] = old + dt * a[i]
        pos[i] += dt * half * (old + vel[i])


class AveragedVelocity(Integrator):
    """Averaged-velocity step, order 1, one evaluation; exact under a constant force, pumps energy into oscillations."""

    kind: Literal["averaged_velocity"] = "averaged_velocity"
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
    stages: ClassVar[int] = 1
    evaluations: ClassVar[int] = 1
