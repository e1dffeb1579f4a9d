"""Implicit (backward) Euler: stable for every damped motion at every step, but inaccurate."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.physics.integrators.implicit import Implicit
from flockenv.physics.integrators.integrator import Method, Provided

__all__ = ["ImplicitEuler"]


def advance(provided: Provided) -> Method:
    """Return the function `advance`, which copies positions from row 0 of stages, velocities from row 1."""

    def advance(
        context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int, end: int
    ) -> None:
        for i in range(np.uint64(first), np.uint64(end)):
            pos[i], vel[i] = stages[0, i], stages[1, i]

    return advance


class ImplicitEuler(Implicit):
    """Implicit Euler, order 1: v' = v + h a(x', v'), x' = x + h v'; an oscillation loses 1/(1 + h^2 w^2) per step.

    Curtiss and Hirschfelder 1952.

    Limits: Newton's method has to solve each step: where forces jump it may fail, and then the step is halved, at most
    three times, before the world counts as diverged. It damps all fast motion, also that which should last.
    """

    kind: Literal["implicit_euler"] = "implicit_euler"
    order: ClassVar[int] = 1
    order_with_drag: ClassVar[int] = 1
    share: ClassVar[float] = 1.0
