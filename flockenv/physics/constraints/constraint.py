"""Constraint: a condition on the end of every step, for any method; applied after the method, in the scene's order.

A force changes motion; a constraint restricts it by correcting the end of a step: no agent is in a wall, a rod keeps
its length. A constraint is passed positions and velocities before the step, and may change those after it. It works on
all worlds of a batch in one compiled call that is the same for all scenes of a dimension and a precision: nothing is
compiled per scene, and a scene without constraints has no overhead.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from flockenv.core.record import Record
from flockenv.model.scene_view import SceneView
from flockenv.model.state import Floats, State

__all__ = ["CONSTRAINTS", "Constraint", "Settler"]

CONSTRAINTS: dict[str, type[Constraint]] = {}
"""Every constraint by its kind; a class registers itself when it is defined."""

Settler = Callable[[Floats, Floats, State, int, int], tuple[int, int]]
"""settle(x0, v0, state, first, end): correct the step of worlds [first, end) that began at x0, v0 (D, B, N), in place.

state.tick has been incremented already. Returns the first (world, agent) whose position or velocity is not finite, or
(-1, -1). It owns its scratch memory, so it must be used by one thread only.
"""


class Constraint(Record):
    """A condition that the end of every step of a scene satisfies."""

    kind: str

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        if "kind" in vars(cls).get("__annotations__", {}):
            CONSTRAINTS[cls.model_fields["kind"].default] = cls

    def check(self, scene: SceneView) -> None:
        """Raise ValueError, beginning with the field's name, if the scene does not suit this constraint."""

    def calls_for(self) -> tuple[str, ...]:
        """Return the names of what the scene must compute for the constraint, as for effects."""
        return ()

    def numbers(self, scene: SceneView) -> int:
        """Return the scratch memory, in numbers per agent.

        scene: that has this constraint.
        """
        return 0

    @abstractmethod
    def settler(self, scene: SceneView) -> Settler:
        """Return a function that corrects a step, with scratch memory of its own.

        scene: that has this constraint.
        """
