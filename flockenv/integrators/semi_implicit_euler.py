"""Semi-implicit (symplectic) Euler: the velocity first, then the position with the new velocity."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.integrators.base import Integrator, carried
from flockenv.kernels import kernel

__all__ = ["SemiImplicitEuler"]


@kernel
def advance(
    acceleration: Any, context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int,
    end: int,
) -> None:  # fmt: skip
    """v += h a; x += h v, with the new v."""
    a = stages[0]
    acceleration(context, pos, vel, time, a)
    for i in range(np.uint64(first), np.uint64(end)):
        v = vel[i] + dt * a[i]
        vel[i] = v
        pos[i] = carried(pos[i] + dt * v, dt, flow, i)


class SemiImplicitEuler(Integrator):
    """Semi-implicit Euler, order 1, one evaluation; bounded energy while h omega < 2 (Reynolds' own step, 1999)."""

    kind: Literal["semi_implicit_euler"] = "semi_implicit_euler"
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
    stages: ClassVar[int] = 1
    evaluations: ClassVar[int] = 1
    asks_first: ClassVar[bool] = True
