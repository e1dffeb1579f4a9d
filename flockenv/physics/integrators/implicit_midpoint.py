"""Implicit midpoint: half a step of implicit Euler, extrapolated to a whole one; conserves linear oscillations."""

from __future__ import annotations

from typing import ClassVar, Literal

from flockenv.physics.integrators.implicit import Implicit
from flockenv.physics.integrators.implicit_euler import advance

__all__ = ["ImplicitMidpoint", "advance"]


class ImplicitMidpoint(Implicit):
    """Implicit midpoint, order 2; symplectic, stable at every step, undamped: stiff modes keep oscillating.

    x' = x + h (v + v') / 2, v' = v + h a((x + x') / 2, (v + v') / 2, t + h / 2): the Gauss method of one stage (Butcher
    1964).

    Limits: Newton's method has to solve each step: where forces jump it may fail, and then the step is halved, at most
    three times, before the world counts as diverged. Stiff modes that are not resolved keep their energy and swing for
    ever.
    """

    kind: Literal["implicit_midpoint"] = "implicit_midpoint"
    order: ClassVar[int] = 2
    order_with_drag: ClassVar[int] = 2
    share: ClassVar[float] = 0.5
