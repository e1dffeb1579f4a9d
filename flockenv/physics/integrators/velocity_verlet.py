"""Velocity Verlet, of order 2 also for forces that depend on velocity."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.jit.decorators import like
from flockenv.physics.integrators.integrator import Integrator, Method, Provided, carry

__all__ = ["VelocityVerlet"]


def advance(provided: Provided) -> Method:
    """Return the function `advance`: half a kick, a drift, half a kick.

    The second force is evaluated at a predicted velocity, as with the old one drag would reduce the order to 1.
    """
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
                vel[i] += half * a[i]
                pos[i] = carry(pos[i], half, flow, i)
            if stage == 0:
                for i in range(np.uint64(first), np.uint64(end)):
                    pos[i] += dt * vel[i]
                    x[i] = carry(pos[i], half, flow, i)
                    v[i] += dt * a[i]

    return advance


class VelocityVerlet(Integrator):
    """Velocity Verlet, order 2 with and without drag, two evaluations; bounded energy while h omega < 2.

    x' = x + h v + h^2 a / 2, v' = v + h (a + a(x', v + h a, t + h)) / 2 with a = a(x, v, t) (Verlet 1967; Swope,
    Andersen, Berens and Wilson 1982; the predicted velocity is ours).

    Limits: it is symplectic for forces of position alone.
    """

    kind: Literal["velocity_verlet"] = "velocity_verlet"
    order: ClassVar[int] = 2
    order_with_drag: ClassVar[int] = 2
    stages: ClassVar[int] = 3
    evaluations: ClassVar[int] = 2
