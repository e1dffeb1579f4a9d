"""Heun's method, the explicit trapezoidal rule."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.jit.decorators import like
from flockenv.physics.integrators.integrator import Integrator, Method, Provided, carry

__all__ = ["Heun"]


def advance(provided: Provided) -> Method:
    """Return the function `advance`, with the mean of the present slope and that after an Euler step; see rk4."""
    acceleration = provided.acceleration

    def advance(
        context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int, end: int
    ) -> None:
        a, x, v, half = stages[0], stages[1], stages[2], like(dt, 0.5) * dt
        for i in range(np.uint64(first), np.uint64(end)):
            x[i], v[i] = pos[i], vel[i]
        for stage in range(2):
            acceleration(context, x, v, time if stage == 0 else time + dt, a)
            for i in range(np.uint64(first), np.uint64(end)):
                slope = v[i]
                pos[i] = carry(pos[i] + half * slope, half, flow, i)
                vel[i] += half * a[i]
                x[i] = carry(x[i] + dt * slope, dt, flow, i)
                v[i] += dt * a[i]

    return advance


class Heun(Integrator):
    """Heun, order 2, two evaluations; energy of an oscillation grows by (h omega)^4 / 4 per step.

    x' = x + h (v + w) / 2, v' = v + h (a + a(x + h v, w, t + h)) / 2 with w = v + h a and a = a(x, v, t) (Heun 1900).

    Limits: an oscillation without damping gains energy; over many periods take velocity_verlet or rk4.
    """

    kind: Literal["heun"] = "heun"
    order: ClassVar[int] = 2
    order_with_drag: ClassVar[int] = 2
    stages: ClassVar[int] = 3
    evaluations: ClassVar[int] = 2
