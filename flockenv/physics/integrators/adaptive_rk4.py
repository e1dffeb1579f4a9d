"""Runge-Kutta of order 4 with adaptive substeps by step doubling; the result is that of two half steps."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.jit.decorators import like
from flockenv.physics.integrators.adaptive import Adaptive
from flockenv.physics.integrators.integrator import Method, Provided
from flockenv.physics.integrators.step_size import add_slopes, copy, initial_clock, next_clock, slope_of, write_errors

__all__ = ["AdaptiveRK4"]


def advance(provided: Provided) -> Method:
    """Return the function `advance`, which compares one step with two half steps.

    The two results are not extrapolated, as that would amplify every oscillation. The whole step, its first half, and
    the next try after a rejection begin with the same slope.
    """
    acceleration, settings = provided.acceleration, provided.settings
    largest, count_substeps = provided.largest, provided.count_substeps

    def advance(
        context: Any, pos: Any, vel: Any, flow: Any, time: float, dt: float, stages: Any, first: int, end: int
    ) -> None:
        x, v, x0, v0, new_x, new_v = stages[0], stages[1], stages[2], stages[3], stages[4], stages[5]
        whole_x, whole_v = stages[6], stages[7]
        limits = settings(context)
        clock, known = initial_clock(dt), False
        while clock.done < dt:
            for part in range(3):  # the whole, its first half, its second half
                h = clock.step if part == 0 else clock.step / 2
                since = time + clock.done + (h if part == 2 else like(dt, 0.0))
                if part == 1:
                    copy(whole_x, whole_v, new_x, new_v, first, end)
                if part < 2:
                    copy(new_x, new_v, pos, vel, first, end)
                copy(x0, v0, new_x, new_v, first, end)
                for stage in range(4):
                    begins = stage == 0 and part < 2
                    slope, a = (stages[8], stages[9]) if begins else (stages[10], stages[11])
                    if not (begins and known):
                        ahead = like(dt, 0.0) if stage == 0 else (h if stage == 3 else h / 2)
                        copy(x, v, x0, v0, first, end)
                        if stage > 0:  # from the slope of the stage before
                            before = 8 if stage == 1 and part < 2 else 10
                            add_slopes(x, v, ahead, stages[before], stages[before + 1], first, end)
                        acceleration(context, x, v, since + ahead, a)
                        slope_of(slope, v, flow, first, end)
                        known = True
                    add_slopes(new_x, new_v, h / 6 if stage == 0 or stage == 3 else h / 3, slope, a, first, end)
            write_errors(whole_x, new_x, new_v, whole_x, whole_v, first, end)
            square, where = largest(context, whole_x, first, end)
            error = np.sqrt(square)
            if error <= limits[0]:
                known = False
                copy(pos, vel, new_x, new_v, first, end)
            clock = next_clock(clock, error, limits, dt, 4)
            if clock.lost:
                pos[where] = like(dt, np.nan)
        count_substeps(context, clock.accepted, clock.rejected)

    return advance


class AdaptiveRK4(Adaptive):
    """Runge-Kutta of order 4 with adaptive substeps within dt, 11 evaluations each; slowest where forces jump.

    The error of a substep h is e = |y(h) - y(h/2, h/2)|, of one step and of two half steps of RK4 (Kutta 1901); the
    next substep is h (tolerance / e)^(1/5), times 0.9 (Hairer, Norsett and Wanner 1993, II.4).

    Limits: substeps follow the worst agent of a world, so one fast agent makes all slow, and threads do not share a
    world. Noise, constraints and limits still act once per dt.
    """

    kind: Literal["adaptive_rk4"] = "adaptive_rk4"
    order: ClassVar[int] = 4
    order_with_drag: ClassVar[int] = 4
    stages: ClassVar[int] = 12
    evaluations: ClassVar[int] = 11
