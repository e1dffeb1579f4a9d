"""The method of Dormand and Prince (1980): order 5, with one of order 4 inside it that tells its error."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv.integrators.base import Integrator, carried, counted, largest, settings
from flockenv.integrators.control import begun, excess, judged
from flockenv.kernels import kernel, like

__all__ = ["DormandPrince"]

NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
"""When each stage is, in steps."""

WEIGHTS = (
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0),
    (3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0),
    (44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
"""What each stage adds of the slopes before it; the last stage is the result."""

ERRORS = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
"""The result less that of order 4, in slopes."""


@kernel
def advance(
    acceleration: Any, context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int,
    end: int,
) -> None:  # fmt: skip
    """Seven slopes, of which the last is the first of the next step: rows 2 to 8 of velocities, 9 to 15 of forces."""
    x, v, squares = stages[0], stages[1], stages[3]  # the second slope counts neither in the result nor in its error
    tolerance, least = settings(context)
    rounding = like(dt, 8 * np.finfo(pos.dtype).eps)
    clock, known = begun(dt), False
    while clock.done < dt:
        h = clock.step
        for stage in range(7):
            for i in range(np.uint64(first), np.uint64(end)):
                x[i], v[i] = pos[i], vel[i]
            for k in range(stage):
                slope, a, weight = stages[2 + k], stages[9 + k], h * like(h, WEIGHTS[stage][k])
                for i in range(np.uint64(first), np.uint64(end)):
                    x[i] += weight * slope[i]
                    v[i] += weight * a[i]
            if not (stage == 0 and known):
                acceleration(context, x, v, time + clock.done + h * like(h, NODES[stage]), stages[9 + stage])
                slope = stages[2 + stage]
                for i in range(np.uint64(first), np.uint64(end)):
                    slope[i] = carried(v[i], like(h, 1.0), flow, i)
        known = True
        for i in range(np.uint64(first), np.uint64(end)):
            off_x, off_v = like(h, 0.0), like(h, 0.0)
            for k in range(7):
                if k != 1:
                    off_x += like(h, ERRORS[k]) * stages[2 + k, i]
                    off_v += like(h, ERRORS[k]) * stages[9 + k, i]
            squares[i] = excess(h * off_x, x[i], rounding) + excess(h * off_v, v[i], rounding)
        square, where = largest(context, squares, first, end)
        error = np.sqrt(square)
        if error <= tolerance:
            for i in range(np.uint64(first), np.uint64(end)):
                pos[i], vel[i] = x[i], v[i]
                stages[2, i], stages[9, i] = stages[8, i], stages[15, i]
        clock = judged(clock, error, tolerance, least, dt, 4)
        if clock.lost:
            pos[where] = like(dt, np.nan)
    counted(context, clock.accepted, clock.rejected)


class DormandPrince(Integrator):
    """Dormand-Prince 5(4) with steps of its own within dt, 6 evaluations each and one more; for smooth forces."""

    kind: Literal["dormand_prince"] = "dormand_prince"
    tolerance: float = Field(default=1e-6, gt=0, description="error of one step, m and m/s, of the worst agent")
    least: float = Field(
        default=0.0, ge=0, description="s, smallest step; a world that needs a smaller one is given up"
    )
    order: ClassVar[int] = 5
    order_with_drag: ClassVar[int] = 5
    stages: ClassVar[int] = 16
    evaluations: ClassVar[int] = 7
    adaptive: ClassVar[bool] = True
