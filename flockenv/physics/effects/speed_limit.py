"""A speed limit as a smooth force: every method keeps its order, and results do not depend on the step length."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import dot, scale
from flockenv.physics.effects.effect import Effect, Me, all_masses

__all__ = ["SpeedLimit"]


@law
def speed_limit(p: Any, me: Me) -> Vec:
    """Return F = -B 16 s^8 / (15 + s^8) v / V, s = |v| / V."""
    square = dot(me.vel, me.vel) / (p.speed * p.speed)
    fourth = square * square
    # in this form it is 0 at rest, and 16 where s^8 overflows
    share = like(square, 16.0) / (like(square, 1.0) + like(square, 15.0) / (fourth * fourth))
    return scale(me.vel, -p.strength / p.speed * share)


class SpeedLimit(Effect):
    """Brake agents that approach a speed V, F = -B 16 s^8 / (15 + s^8) v / V with s = |v| / V.

    The force is B at V, so an agent driven by a force B reaches V in the end, by 2 B 1.087 V, by 4 B 1.189 V, by 8 B
    1.319 V; it is 14 % of B at 0.8 V and 0.2 % at V / 2. For high speeds it is a linear drag, 16 B / V: this bounds its
    stiffness, so any step of less than m V / (8 B) is stable. `Group.max_speed` is the hard limit: it holds exactly,
    and clips the result of a step, so that with it every method is of order 1.

    The function is ours.

    Limits: it is soft: with a stronger drive than B agents are faster than V, and below V they are braked as well. The
    velocity is that in space, not relative to a medium.
    """

    kind: Literal["speed_limit"] = "speed_limit"
    sentence: ClassVar[str] = "Brake agents that approach {speed}"
    speed: float = Field(gt=0, description="V, m/s, at which the braking force is B")
    strength: float = Field(ge=0, description="B, N, braking force at speed V")
    own_law: ClassVar[Law | None] = speed_limit
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return w^2 = 0, as nothing oscillates, and the damping 16 B / (m V), the largest force over speed."""
        damping = 16 * self.strength / self.speed / all_masses(groups, dimension)
        return np.zeros(len(damping)), damping
