"""Success over a whole episode, for tasks that only the time limit ends: the aim has to hold most of the time.

Such a task's `ended` returns whether the aim holds at this instant, which `write_aim_measures` stores; `aim_has_lasted`
computes success from their sums. The measures of such a task include MEASURES, its metrics METRICS.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from pydantic import Field

from flockenv.jit.decorators import kernel
from flockenv.tasks.task import Task

__all__ = ["MEASURES", "METRICS", "LastingTask", "aim_has_lasted", "write_aim_measures", "write_aim_metrics"]

MEASURES = ("holds", "judged", "held")
"""For one decision, each 1 or 0: the aim holds; it is judged, as after the settling time; both."""

METRICS = ("held", "success_at_end")
"""Share of the judged decisions in which the aim holds; whether it holds at the last one."""


@kernel
def write_aim_measures(p: Any, at: Any, step: int, holds: bool, numbers: Any) -> None:
    """Write the measures of a lasting aim, `step` decisions after the start."""
    judged = step > p.settled
    numbers[at.holds] = 1.0 if holds else 0.0
    numbers[at.judged] = 1.0 if judged else 0.0
    numbers[at.held] = 1.0 if holds and judged else 0.0


@kernel
def aim_has_lasted(p: Any, sums: Any) -> bool:
    """Return True if the aim has held in at least the share `lasting` of the judged decisions, and there is one."""
    return bool(sums.judged > 0.0 and sums.held >= p.lasting * sums.judged - 1e-4)


@kernel
def write_aim_metrics(at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write the metrics of a lasting aim; `held` has no value before a decision is judged."""
    if sums.judged > 0.0:
        numbers[at.held] = sums.held / sums.judged
    if steps > 0:
        numbers[at.success_at_end] = last.holds


class LastingTask(Task):
    """A task whose aim must hold in most decisions of an episode, not at its last instant alone."""

    lasting_aim: ClassVar[bool] = True

    settling: float = Field(default=5.0, ge=0, description="s, settling time, before which the aim is not judged")
    lasting: float = Field(
        default=0.9,
        gt=0,
        le=1,
        description="least share of the decisions after `settling` in which the aim must hold, for success",
    )

    def parameters(self) -> dict[str, float]:
        """Return the fields, and the number of decisions in the settling time."""
        return {**super().parameters(), "settled": float(math.ceil(self.settling / self.control_dt - 1e-6))}
