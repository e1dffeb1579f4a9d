"""Base of repulsive forces: strength and upper bound."""

from __future__ import annotations

import math
from typing import ClassVar, Self

from pydantic import Field, model_validator

from flockenv.jit.decorators import Vec
from flockenv.physics.effects.effect import Effect

__all__ = ["Push"]


class Push(Effect):
    """A force of strength A: in newtons, or in m/s^2 times the agent's mass; or the sum of both."""

    strength: float = Field(default=0.0, ge=0, description="A, N, factor of the force, the same for all masses")
    acceleration: float = Field(default=0.0, ge=0, description="A, m/s^2: the force is that times its own mass")
    most: float | None = Field(
        default=None, gt=0, description="N, largest force from one neighbour or wall, before weighting"
    )
    steering: ClassVar[bool] = True
    strengths: ClassVar[tuple[str, ...]] = ("strength", "acceleration")

    @model_validator(mode="after")
    def _check_strength(self) -> Self:
        """Raise ValueError if no strength is given; an explicit 0 is allowed."""
        if not {"strength", "acceleration"} & self.model_fields_set:
            raise ValueError("strength: missing; give strength, N, or acceleration, m/s^2")
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """Return strength and bound of the force."""
        most = math.inf if self.most is None else self.most
        return {"strength": self.strength, "acceleration": self.acceleration, "bound": most}
