"""Runge-Kutta of order 4 with steps of its own: each is made once whole and once in halves, and the halves count."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv.integrators.base import Integrator, carried, counted, largest, settings
from flockenv.integrators.control import begun, excess, judged
from flockenv.kernels import kernel, like

__all__ = ["AdaptiveRK4"]


@kernel
def advance(
    acceleration: Any, context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int,
    end: int,
) -> None:  # fmt: skip
    """Step doubling. The two results are not extrapolated: that would grow every oscillation (numerics.md, P04).

    The whole step and its first half begin with the same slope, and so does the next try if this one is rejected.
    """
    x, v, x0, v0, new_x, new_v, whole_x, whole_v = (
        stages[0], stages[1], stages[2], stages[3], stages[4], stages[5], stages[6], stages[7],
    )  # fmt: skip
    tolerance, least = settings(context)
    rounding = like(dt, 8 * np.finfo(pos.dtype).eps)
    clock, known = begun(dt), False
    while clock.done < dt:
        for part in range(3):  # the whole, its first half, its second half
            h = clock.step if part == 0 else clock.step / 2
            since = time + clock.done + (h if part == 2 else like(dt, 0.0))
            for i in range(np.uint64(first), np.uint64(end)):
                if part == 1:
                    whole_x[i], whole_v[i] = new_x[i], new_v[i]
                x0[i], v0[i] = (new_x[i], new_v[i]) if part == 2 else (pos[i], vel[i])
                x[i], v[i], new_x[i], new_v[i] = x0[i], v0[i], x0[i], v0[i]
            for stage in range(4):
                begins = stage == 0 and part < 2
                slope, a = (stages[8], stages[9]) if begins else (stages[10], stages[11])
                weight = h / 6 if stage == 0 or stage == 3 else h / 3
                ahead = h if stage == 2 else h / 2
                if not (begins and known):
                    when = since + (like(dt, 0.0) if stage == 0 else (h if stage == 3 else h / 2))
                    acceleration(context, x, v, when, a)
                    for i in range(np.uint64(first), np.uint64(end)):
                        slope[i] = carried(v[i], like(dt, 1.0), flow, i)
                    known = True
                for i in range(np.uint64(first), np.uint64(end)):
                    new_x[i] += weight * slope[i]
                    new_v[i] += weight * a[i]
                    x[i] = x0[i] + ahead * slope[i]
                    v[i] = v0[i] + ahead * a[i]
        squares = stages[11]
        for i in range(np.uint64(first), np.uint64(end)):
            squares[i] = excess(new_x[i] - whole_x[i], new_x[i], rounding)
            squares[i] += excess(new_v[i] - whole_v[i], new_v[i], rounding)
        square, where = largest(context, squares, first, end)
        error = np.sqrt(square)
        if error <= tolerance:
            known = False
            for i in range(np.uint64(first), np.uint64(end)):
                pos[i], vel[i] = new_x[i], new_v[i]
        clock = judged(clock, error, tolerance, least, dt, 4)
        if clock.lost:
            pos[where] = like(dt, np.nan)
    counted(context, clock.accepted, clock.rejected)


class AdaptiveRK4(Integrator):
    """Runge-Kutta of order 4 with steps of its own within dt, 11 evaluations each; costs most where forces jump."""

    kind: Literal["adaptive_rk4"] = "adaptive_rk4"
    tolerance: float = Field(default=1e-6, gt=0, description="error of one step, m and m/s, of the worst agent")
    least: float = Field(
        default=0.0, ge=0, description="s, smallest step; a world that needs a smaller one is given up"
    )
    order: ClassVar[int] = 4
    order_with_drag: ClassVar[int] = 4
    stages: ClassVar[int] = 12
    evaluations: ClassVar[int] = 11
    adaptive: ClassVar[bool] = True
