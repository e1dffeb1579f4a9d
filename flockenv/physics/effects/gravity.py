"""Uniform gravity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import scale
from flockenv.model.state import State
from flockenv.physics.effects.effect import Effect, Me, Vector, all_masses

__all__ = ["Gravity"]


@law
def gravity(p: Any, me: Me) -> Vec:
    """Return F = m g."""
    return scale(p.acceleration, me.mass)


class Gravity(Effect):
    """Uniform gravity, F = m g: without other forces x = x0 + v0 t + g t^2 / 2. Pinned particles stay.

    Galileo 1638.

    Limits: it does not depend on the height, and acts on every agent of finite mass, whatever its group.
    """

    kind: Literal["gravity"] = "gravity"
    sentence: ClassVar[str] = "Gravity of {acceleration}"
    acceleration: Vector = Field(default=(0.0, -9.81), description="m/s^2, or N per kg; one number per dimension")
    own_law: ClassVar[Law | None] = gravity
    strengths: ClassVar[tuple[str, ...]] = ("acceleration",)

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> NDArray[np.float64]:
        """Return the sum of -m g . x over all agents of finite mass, (B,) J."""
        mass = all_masses(groups, state.shape[2])
        fall = np.where(np.isfinite(mass), mass, 0.0)
        return np.asarray(-(state.pos @ np.array(self.acceleration) * fall).sum(axis=1))
