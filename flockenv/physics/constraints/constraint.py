"""Constraint: what a step must end with, whichever method made it; applied after the method, in the scene's order.

A force says how motion changes; a constraint says what motion may not do, and mends the end of a step: nobody is in a
wall, a rod keeps its length. It is given where everybody was before the step and how fast, and may change where they
are and how fast. It works on all worlds of a batch in one compiled call that is the same for all scenes of a dimension
and a precision: nothing is compiled per scene, and a scene without constraints does not know of them.
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
"""settle(x0, v0, state, first, end): mend the step of worlds [first, end) that began at x0, v0 (D, B, N), in place.

state.tick has been counted on already. Returns the first (world, agent) whose place or velocity is no number, or
(-1, -1). It has scratch of its own, and so belongs to one thread.
"""


class Constraint(Record):
    """What every step of a scene must end with."""

    kind: str

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        if "kind" in vars(cls).get("__annotations__", {}):
            CONSTRAINTS[cls.model_fields["kind"].default] = cls

    def check(self, scene: SceneView) -> None:
        """Refuse a scene that this cannot be demanded of: ValueError that begins with the field's name."""

    def calls_for(self) -> tuple[str, ...]:
        """What it makes a scene compute beside itself, in words, as effects say it."""
        return ()

    def numbers(self, scene: SceneView) -> int:
        """How many numbers of scratch it takes per agent."""
        return 0

    @abstractmethod
    def settler(self, scene: SceneView) -> Settler:
        """Return what mends a step, with scratch of its own."""
