"""Linear drag: the medium takes away speed relative to it."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from flockenv.effects.base import Effect, Me
from flockenv.kernels import Vec, law
from flockenv.vec import scale, sub

__all__ = ["Drag"]


@law
def drag(p: Any, me: Me) -> Vec:
    """F = -c (v - u)."""
    return scale(sub(me.vel, me.medium), -p.rate)


class Drag(Effect):
    """Linear drag, F = -c (v - u) in a medium that moves with u: without other forces v = v0 exp(-c t / m)."""

    kind: Literal["drag"] = "drag"
    rate: float = Field(ge=0, description="c, kg/s")
    own_law: ClassVar[str | None] = "drag"
    strengths: ClassVar[tuple[str, ...]] = ("rate",)
    linear_drag: ClassVar[str | None] = "rate"
