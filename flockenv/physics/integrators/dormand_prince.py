"""The method of Dormand and Prince (1980): order 5, with an embedded one of order 4 for the error."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.jit.decorators import like
from flockenv.physics.integrators.adaptive import Adaptive
from flockenv.physics.integrators.integrator import Method, Provided
from flockenv.physics.integrators.step_size import add_slopes, copy, initial_clock, next_clock, slope_of, write_errors

__all__ = ["DormandPrince"]

NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
"""Time of each stage, in steps."""

WEIGHTS = (
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0),
    (3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0),
    (44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
"""Weights of the slopes before each stage; the last stage is the result."""

ERRORS = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
"""Weights of the slopes in the result minus that of order 4."""


def advance(provided: Provided) -> Method:
    """Return the function `advance` with seven slopes, of which the last is the first of the next step.

    Rows 2 to 8 of the stages are slopes of positions, rows 9 to 15 slopes of velocities.
    """
    acceleration, settings = provided.acceleration, provided.settings
    largest, count_substeps = provided.largest, provided.count_substeps

    def advance(
        context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int, end: int
    ) -> None:
        x, v = stages[0], stages[1]
        other_x, other_v = stages[3], stages[10]  # the second slope has weight 0 in the result and in its error
        limits = settings(context)
        clock, known = initial_clock(dt), False
        while clock.done < dt:
            h = clock.step
            for stage in range(7):
                copy(x, v, pos, vel, first, end)
                for k in range(stage):
                    add_slopes(x, v, h * like(h, WEIGHTS[stage][k]), stages[2 + k], stages[9 + k], first, end)
                if stage > 0 or not known:
                    acceleration(context, x, v, time + clock.done + h * like(h, NODES[stage]), stages[9 + stage])
                    slope_of(stages[2 + stage], v, flow, first, end)
            copy(other_x, other_v, x, v, first, end)
            for k in range(7):
                if k != 1:
                    add_slopes(other_x, other_v, -h * like(h, ERRORS[k]), stages[2 + k], stages[9 + k], first, end)
            write_errors(other_x, x, v, other_x, other_v, first, end)
            square, where = largest(context, other_x, first, end)
            error, known = np.sqrt(square), True
            if error <= limits[0]:
                copy(pos, vel, x, v, first, end)
                copy(stages[2], stages[9], stages[8], stages[15], first, end)
            clock = next_clock(clock, error, limits, dt, 4)
            if clock.lost:
                pos[where] = like(dt, np.nan)
        count_substeps(context, clock.accepted, clock.rejected)

    return advance


class DormandPrince(Adaptive):
    """Dormand-Prince 5(4) with adaptive substeps within dt, 6 evaluations each and one more; for smooth forces.

    y' = y + h (b1 k1 + ... + b7 k7) for y = (x, v) and slopes k = (v, a); the error is e = h |sum of (b - c) k|, with
    the weights c of order 4; the next substep is h (tolerance / e)^(1/5), times 0.9 (Dormand and Prince 1980).

    Limits: substeps follow the worst agent of a world, so one fast agent makes all slow, and threads do not share a
    world. Noise, constraints and limits still act once per dt.
    """

    kind: Literal["dormand_prince"] = "dormand_prince"
    order: ClassVar[int] = 5
    order_with_drag: ClassVar[int] = 5
    stages: ClassVar[int] = 16
    evaluations: ClassVar[int] = 7
