"""Repulsion from a wall before contact: a force that falls exponentially with the distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.geometry.space import Torus
from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import dot, scale, sub, unit
from flockenv.model.scene_view import SceneView
from flockenv.model.state import State
from flockenv.physics.effects.effect import Effect, Me, Vector

__all__ = ["WallRepulsion"]

SHORTEST, LONGEST = 1e-15, 1e15
"""Bounds of the length of a normal, outside of which its square may be 0 or infinite in float32."""


@law
def wall_repulsion(p: Any, me: Me) -> Vec:
    """Return F = A exp(-d / B) n."""
    n = unit(p.normal)
    return scale(n, p.strength * np.exp(-dot(sub(me.pos, p.point), n) / p.decay))


class WallRepulsion(Effect):
    """A straight wall repels all agents along its normal n, F = A exp(-d / B) n.

    d is the distance from the wall, negative behind it, where the force grows further. A body driven against it with
    desired speed v0 and relaxation time tau rests at d = B ln(A tau / (m v0)), which it approaches without oscillation
    if v0 tau / B <= 1/4. Helbing and Molnar 1995 (A = U0 / R, B = R); Helbing, Farkas and Vicsek 2000 without contact
    (their A times exp(radius / B)); Kretz, arXiv 1507.02566.

    Limits: the wall has no end, and bodies have no size. Behind it the force grows as exp(|d| / B) without bound, and
    dt is not tested for it: an agent that a long step takes far behind is thrown back without an upper bound on its
    speed.
    """

    kind: Literal["wall_repulsion"] = "wall_repulsion"
    point: Vector = Field(description="m, any point of the wall")
    normal: Vector = Field(description="direction of the force, of any length")
    strength: float = Field(ge=0, description="A, N, force at the wall itself")
    decay: float = Field(gt=0, description="B, m, over which the force falls to 1/e")
    own_law: ClassVar[Law | None] = wall_repulsion
    places: ClassVar[tuple[str, ...]] = ("point",)
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    @model_validator(mode="after")
    def _check_normal(self) -> Self:
        """Raise ValueError if the normal has no length."""
        if not SHORTEST <= math.hypot(*self.normal) <= LONGEST:
            raise ValueError(
                f"normal = {self.normal}: must be a direction, not all 0, of length {SHORTEST:g} to {LONGEST:g}"
            )
        return self

    def check(self, scene: SceneView) -> None:
        """Raise ValueError also on a torus, where the path away from the wall leads behind it, to the largest force."""
        super().check(scene)
        if isinstance(scene.space, Torus):
            raise ValueError(
                f"kind = {self.kind}: on a torus a wall has no inner and outer side; only a plane or a box is allowed"
            )

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> NDArray[np.float64]:
        """Return the sum of A B exp(-d / B) over all agents, (B,) J."""
        n = np.array(self.normal) / math.hypot(*self.normal)
        distance = offset(self.point, state.pos) @ n
        return np.asarray((self.strength * self.decay * np.exp(-distance / self.decay)).sum(axis=1))
