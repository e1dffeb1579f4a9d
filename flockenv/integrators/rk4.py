"""The classical Runge-Kutta method of order 4."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from flockenv.integrators.base import Integrator
from flockenv.kernels import kernel

__all__ = ["RK4"]


@kernel
def _stage(pos: Any, vel: Any, h: float, dx: Any, dv: Any, x: Any, v: Any) -> None:
    """x = pos + h dx; v = vel + h dv. In this order, so that dx may be v itself."""
    for k in range(pos.shape[0]):
        for i in range(pos.shape[1]):
            x[k, i] = pos[k, i] + h * dx[k, i]
            v[k, i] = vel[k, i] + h * dv[k, i]


@kernel
def _gather(weight: float, v: Any, a: Any, dx: Any, dv: Any) -> None:
    for k in range(v.shape[0]):
        for i in range(v.shape[1]):
            dx[k, i] += weight * v[k, i]
            dv[k, i] += weight * a[k, i]


@kernel
def advance(acceleration: Any, context: Any, pos: Any, vel: Any, dt: float, stages: Any) -> None:
    """Four slopes, weighted 1, 2, 2, 1."""
    a, x, v, dx, dv = stages[0], stages[1], stages[2], stages[3], stages[4]
    dx[...] = 0
    dv[...] = 0
    half, sixth = dt / 2, dt / 6
    acceleration(context, pos, vel, a)
    _gather(sixth, vel, a, dx, dv)
    _stage(pos, vel, half, vel, a, x, v)
    acceleration(context, x, v, a)
    _gather(2 * sixth, v, a, dx, dv)
    _stage(pos, vel, half, v, a, x, v)
    acceleration(context, x, v, a)
    _gather(2 * sixth, v, a, dx, dv)
    _stage(pos, vel, dt, v, a, x, v)
    acceleration(context, x, v, a)
    _gather(sixth, v, a, dx, dv)
    for k in range(pos.shape[0]):
        for i in range(pos.shape[1]):
            pos[k, i] += dx[k, i]
            vel[k, i] += dv[k, i]


class RK4(Integrator):
    """Classical Runge-Kutta, order 4, four evaluations; of order 1 where a limit or a view cone makes forces jump."""

    kind: Literal["rk4"] = "rk4"
    order: ClassVar[int] = 4
    order_with_drag: ClassVar[int] = 4
    stages: ClassVar[int] = 5
    evaluations: ClassVar[int] = 4
