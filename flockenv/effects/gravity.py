"""Uniform gravity."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from flockenv.effects.base import Effect, Me, Vector
from flockenv.kernels import Vec, law
from flockenv.vec import scale

__all__ = ["Gravity"]


@law
def gravity(p: Any, me: Me) -> Vec:
    """F = m g."""
    return scale(p.acceleration, me.mass)


class Gravity(Effect):
    """Everybody falls alike, F = m g: without other forces x = x0 + v0 t + g t^2 / 2. What is held in place stays."""

    kind: Literal["gravity"] = "gravity"
    acceleration: Vector = Field(default=(0.0, -9.81), description="m/s^2, which is N per kg; as many as dimensions")
    own_law: ClassVar[str | None] = "gravity"
    strengths: ClassVar[tuple[str, ...]] = ("acceleration",)
