"""The error raised when a simulation diverges: world, agent, step, time and the effect that caused it."""

from __future__ import annotations

from typing import Any

__all__ = ["SimulationDiverged"]


class SimulationDiverged(FloatingPointError):  # noqa: N818  # the issue and its users call it so
    """A position or velocity is no longer finite; worlds that stayed finite have completed all steps.

    The diverged world keeps its state from before the call; the attributes hold the details.
    """

    state: Any = None
    """The state of all worlds when the call ended."""

    def __init__(
        self, world: int, agent: int, step: int, time: float, effect: str | None, dt: float, method: str,
        reason: str = "",
    ) -> None:  # fmt: skip
        """Set the attributes; step: since the start; time, dt: s; effect: of the largest acceleration, or None.

        reason: text that replaces the usual one, that a number is not finite.
        """
        self.world, self.agent, self.step, self.time, self.effect = world, agent, step, time, effect
        self.dt, self.method, self.reason = dt, method, reason
        super().__init__(world, agent, step, time, effect, dt, method, reason)  # so that it can be pickled

    def __str__(self) -> str:
        by = f", accelerated by {self.effect}" if self.effect else ""
        what = self.reason or "position or velocity is not finite"
        return (
            f"world {self.world}, agent {self.agent}: {what} in step {self.step}, "
            f"t = {self.time:g} s{by}; dt = {self.dt:g} s may be too large for {self.method}"
        )
