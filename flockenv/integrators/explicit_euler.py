"""Explicit (forward) Euler, shown for what it is."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.integrators.base import Integrator, carried
from flockenv.kernels import kernel

__all__ = ["ExplicitEuler"]


@kernel
def advance(
    acceleration: Any, context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int,
    end: int,
) -> None:  # fmt: skip
    """x += h v; v += h a: both from the present."""
    a = stages[0]
    acceleration(context, pos, vel, time, a)
    for i in range(np.uint64(first), np.uint64(end)):
        pos[i] = carried(pos[i] + dt * vel[i], dt, flow, i)
        vel[i] += dt * a[i]


class ExplicitEuler(Integrator):
    """Explicit Euler, order 1, one evaluation; unstable for every undamped oscillation at every step size."""

    kind: Literal["explicit_euler"] = "explicit_euler"
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
    stages: ClassVar[int] = 1
    evaluations: ClassVar[int] = 1
    asks_first: ClassVar[bool] = True
