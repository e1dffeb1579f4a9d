"""Success over a whole episode, for tasks that nothing but the time limit ends: the aim has to last.

Such a task's `ended` returns whether the aim holds at this instant, which `judge` writes among the measures; success is
what `lasts` returns of their sums. A task of this kind has MEASURES and METRICS last.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from pydantic import Field

from flockenv.jit.decorators import kernel
from flockenv.tasks.task import Task

__all__ = ["MEASURES", "METRICS", "LastingTask", "judge", "lasts", "tell_lasting"]

MEASURES = ("holds", "judged", "held")
"""Of one decision, 1 or 0: the aim holds; it is judged, for the agents have had time to settle; both."""

METRICS = ("held", "success_at_end")
"""Share of the judged decisions in which the aim holds; whether it holds at the last one."""


@kernel
def judge(p: Any, step: int, holds: bool, numbers: Any, first: int) -> None:
    """Write the measures of a lasting aim from number `first` on, `step` decisions after the start."""
    judged = step > p.without_dispatch
    numbers[first] = 1.0 if holds else 0.0
    numbers[first + 1] = 1.0 if judged else 0.0
    numbers[first + 2] = 1.0 if holds and judged else 0.0


@kernel
def lasts(p: Any, sums: Any) -> bool:
    """Return True if the aim has held in the share `lasting` of the judged decisions, and there is one."""
    return bool(sums.judged > 0.0 and sums.held >= p.lasting * sums.judged - 1e-4)


@kernel
def tell_lasting(sums: Any, last: Any, steps: int, numbers: Any, first: int) -> None:
    """Write the metrics of a lasting aim from number `first` on; `held` has no value before a decision is judged."""
    if sums.judged > 0.0:
        numbers[first] = sums.held / sums.judged
    if steps > 0:
        numbers[first + 1] = last.holds


class LastingTask(Task):
    """A task whose aim must hold in most decisions of an episode, not at its last instant alone."""

    lasting_aim: ClassVar[bool] = True

    settling: float = Field(default=5.0, ge=0, description="s, after which it is judged whether the aim holds")
    lasting: float = Field(
        default=0.9, gt=0, le=1, description="share of the decisions after that in which the aim must hold: success"
    )

    def parameters(self) -> dict[str, float]:
        """The fields, and after how many decisions the aim is judged."""
        return {**super().parameters(), "settled": float(math.ceil(self.settling / self.control_dt - 1e-6))}
