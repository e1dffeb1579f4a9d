"""Attraction to a fixed point, or repulsion from it, by the inverse square of the distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import dot, scale, sub
from flockenv.model.state import State
from flockenv.physics.effects.effect import Effect, Me, Vector

__all__ = ["Attraction"]


@law
def attraction(p: Any, me: Me) -> Vec:
    """Return F = k d / (|d|^2 + s^2)^(3/2), d = centre - x; 0 at the centre, for any s."""
    towards = sub(p.centre, me.pos)
    square = dot(towards, towards)
    o, soft = like(square, 0.0), square + p.softening * p.softening
    cube = soft * np.sqrt(soft)
    return scale(towards, p.strength / cube if cube > o else o)  # a square may underflow before a distance does


class Attraction(Effect):
    """Attract all agents to a point with k / r^2, softened; a negative strength k repels.

    Conserves m v^2 / 2 - k / sqrt(r^2 + s^2), s the softening, and the angular momentum about the centre; with s = 0
    the orbits of one body are Kepler's. On a torus only the nearest image of the centre attracts.

    An inverse-square law (Newton 1687), softened as in Plummer 1911.

    Limits: without a softening the force has no bound near the centre, and an agent that passes it within one step is
    thrown out with energy it did not have. The centre takes up any momentum.
    """

    kind: Literal["attraction"] = "attraction"
    sentence: ClassVar[str] = "Attract all agents to {centre}"
    centre: Vector = Field(description="m, the point")
    strength: float = Field(description="k, N m^2; negative: repulsion")
    softening: float = Field(default=0.0, ge=0, description="s, m, distance below which it no longer grows as 1 / r^2")
    own_law: ClassVar[Law | None] = attraction
    places: ClassVar[tuple[str, ...]] = ("centre",)
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> NDArray[np.float64]:
        """Return the sum of -k / sqrt(r^2 + s^2) over all agents, (B,) J."""
        square = (offset(self.centre, state.pos) ** 2).sum(axis=-1)
        return np.asarray((-self.strength / np.sqrt(square + self.softening**2)).sum(axis=1))
