"""Linear drag: the medium is at rest and takes speed away."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from flockenv.effects.base import Effect, Me
from flockenv.kernels import Vec, law
from flockenv.vec import scale

__all__ = ["Drag"]


@law
def drag(p: Any, me: Me) -> Vec:
    """F = -c v."""
    return scale(me.vel, -p.rate)


class Drag(Effect):
    """Linear drag, F = -c v: without other forces v = v0 exp(-c t / m)."""

    kind: Literal["drag"] = "drag"
    rate: float = Field(ge=0, description="c, kg/s")
    own_law: ClassVar[str | None] = "drag"
