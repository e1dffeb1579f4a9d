"""Euler with the mean of the old and the new velocity: the step of the lectures."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.integrators.base import Integrator, carried
from flockenv.kernels import kernel, like

__all__ = ["AveragedVelocity"]


@kernel
def advance(
    acceleration: Any, context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int,
    end: int,
) -> None:  # fmt: skip
    """x += h (v + v')/2 with v' = v + h a: exact under a constant force."""
    a, half = stages[0], like(dt, 0.5)
    acceleration(context, pos, vel, time, a)
    for i in range(np.uint64(first), np.uint64(end)):
        old = vel[i]
        vel[i] = old + dt * a[i]
        pos[i] = carried(pos[i] + dt * half * (old + vel[i]), dt, flow, i)


class AveragedVelocity(Integrator):
    """Averaged-velocity step, order 1, one evaluation; exact under a constant force, pumps energy into oscillations."""

    kind: Literal["averaged_velocity"] = "averaged_velocity"
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
    stages: ClassVar[int] = 1
    evaluations: ClassVar[int] = 1
    asks_first: ClassVar[bool] = True
