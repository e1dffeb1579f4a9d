"""The classical Runge-Kutta method of order 4."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.jit.decorators import like
from flockenv.physics.integrators.integrator import Integrator, Method, Provided, carry

__all__ = ["RK4"]


def advance(provided: Provided) -> Method:
    """Return the function `advance`: four slopes, weighted 1, 2, 2, 1, each at a stage reached by the one before.

    The acceleration is called in one place of the code, so that it is compiled once and not four times.
    """
    acceleration = provided.acceleration

    def advance(
        context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int, end: int
    ) -> None:
        a, x, v, x0, v0 = stages[0], stages[1], stages[2], stages[3], stages[4]
        for i in range(np.uint64(first), np.uint64(end)):
            x0[i], v0[i], x[i], v[i] = pos[i], vel[i], pos[i], vel[i]
        for stage in range(4):
            weight = dt / 6 if stage == 0 or stage == 3 else dt / 3
            ahead = dt if stage == 2 else dt / 2
            when = time + (like(dt, 0.0) if stage == 0 else (dt if stage == 3 else dt / 2))
            acceleration(context, x, v, when, a)
            for i in range(np.uint64(first), np.uint64(end)):
                slope = v[i]
                pos[i] = carry(pos[i] + weight * slope, weight, flow, i)
                vel[i] += weight * a[i]
                x[i] = carry(x0[i] + ahead * slope, ahead, flow, i)
                v[i] = v0[i] + ahead * a[i]

    return advance


class RK4(Integrator):
    """Classical Runge-Kutta, order 4, four evaluations; of order 1 if a limit or a view cone makes forces jump.

    y' = y + h (k1 + 2 k2 + 2 k3 + k4) / 6 for y = (x, v) and slopes k = (v, a): k1 at y, k2 at y + h k1 / 2, k3 at y +
    h k2 / 2, k4 at y + h k3 (Kutta 1901).

    Limits: it is not symplectic: an oscillation loses (h omega)^6 / 72 of its energy per step.
    """

    kind: Literal["rk4"] = "rk4"
    order: ClassVar[int] = 4
    order_with_drag: ClassVar[int] = 4
    stages: ClassVar[int] = 5
    evaluations: ClassVar[int] = 4
