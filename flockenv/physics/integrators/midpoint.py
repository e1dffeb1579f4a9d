"""The explicit midpoint method."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.jit.decorators import like
from flockenv.physics.integrators.integrator import Integrator, Method, Provided, carry

__all__ = ["Midpoint"]


def advance(provided: Provided) -> Method:
    """Return the function `advance`, which uses the slope half a step ahead for the whole step; see rk4."""
    acceleration = provided.acceleration

    def advance(
        context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int, end: int
    ) -> None:
        a, x, v, half = stages[0], stages[1], stages[2], like(dt, 0.5) * dt
        for i in range(np.uint64(first), np.uint64(end)):
            x[i], v[i] = pos[i], vel[i]
        for stage in range(2):
            acceleration(context, x, v, time if stage == 0 else time + half, a)
            if stage == 0:
                for i in range(np.uint64(first), np.uint64(end)):
                    x[i] = carry(pos[i] + half * vel[i], half, flow, i)
                    v[i] = vel[i] + half * a[i]
            else:
                for i in range(np.uint64(first), np.uint64(end)):
                    pos[i] = carry(pos[i] + dt * v[i], dt, flow, i)
                    vel[i] += dt * a[i]

    return advance


class Midpoint(Integrator):
    """Explicit midpoint, order 2, two evaluations; energy of an oscillation grows by (h omega)^4 / 4 per step.

    x' = x + h (v + h a / 2), v' = v + h a(x + h v / 2, v + h a / 2, t + h / 2) with a = a(x, v, t) (Runge 1895).

    Limits: an oscillation without damping gains energy; over many periods take velocity_verlet or rk4.
    """

    kind: Literal["midpoint"] = "midpoint"
    order: ClassVar[int] = 2
    order_with_drag: ClassVar[int] = 2
    stages: ClassVar[int] = 3
    evaluations: ClassVar[int] = 2
