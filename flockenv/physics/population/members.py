"""Member: one record of a scene's population, an emitter or a sink."""

from __future__ import annotations

from typing import Any, ClassVar

from flockenv.core.record import Record
from flockenv.model.scene_view import SceneView

__all__ = ["POPULATION", "Member", "check_dimensions", "demand_group"]

POPULATION: dict[str, type[Member]] = {}
"""Every emitter and sink by its kind; a class registers itself when it is defined."""


class Member(Record):
    """An emitter, which creates agents, or a sink, which removes them, at the end of a step."""

    kind: str
    looks_back: ClassVar[bool] = False
    """True if the member reads the positions of all agents before the step."""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        if "kind" in vars(cls).get("__annotations__", {}):
            POPULATION[cls.model_fields["kind"].default] = cls

    def check(self, scene: SceneView) -> None:
        """Raise ValueError, beginning with the field's name, if the scene does not suit this member."""

    def feeds(self, group: int) -> bool:
        """Return True if the member creates agents of this group."""
        return False


def demand_group(scene: SceneView, which: int | None) -> None:
    """Raise ValueError if the group does not exist."""
    count = len(scene.groups)
    if which is not None and which >= count:
        known = f"the scene has {count}, counted from 0" if count > 1 else "the scene has one, group 0"
        raise ValueError(f"group = {which}: {known}; did you mean {count - 1}?")


def check_dimensions(scene: SceneView, **given: tuple[float, ...] | None) -> None:
    """Raise ValueError if the length of a vector is not the scene's dimension."""
    for name, value in given.items():
        if value is not None and len(value) != scene.dimension:
            raise ValueError(f"{name} = {value}: has {len(value)} numbers, but dimension = {scene.dimension}")
