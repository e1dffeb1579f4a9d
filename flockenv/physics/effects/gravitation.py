"""Inverse-square forces between all agents: proportional to the masses (Newton), or equal for every pair.

Both are softened (Plummer 1911): a body is not a point but a cloud of radius `softening`, so forces stay bounded when
agents pass through each other. Up to a few thousand agents the sum is exact; for more, far groups are combined into one
(Barnes & Hut 1986), unless `opening` is 0. Forces are opposite in every pair; with combined groups, momentum is
conserved only to the accuracy of the tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import scale
from flockenv.model.scene_view import SceneView
from flockenv.model.state import State
from flockenv.physics.effects.effect import Effect, Far, Me, all_masses

__all__ = ["Gravitation", "InverseSquare"]


@law
def _inverse_cube(p: Any, other: Far) -> float:
    """Return 1 / (d^2 + eps^2)^(3/2), 1/m^3, times the weight."""
    square = other.square + p.softening * p.softening
    return other.weight / (square * np.sqrt(square))  # type: ignore[no-any-return]  # np.sqrt keeps float32


@law
def gravitation(p: Any, me: Me, other: Far) -> Vec:
    """Return F = G m m_j d / (d^2 + eps^2)^(3/2)."""
    return scale(other.offset, p.constant * me.mass * _inverse_cube(p, other))


@law
def inverse_square(p: Any, me: Me, other: Far) -> Vec:
    """Return F = k d / (d^2 + eps^2)^(3/2)."""
    return scale(other.offset, p.strength * _inverse_cube(p, other))


class _Softened(Effect):
    """Base class of the two inverse-square forces, with their common fields."""

    softening: float = Field(ge=0, description="eps, m; 0 = point masses, without a bound of the force")
    opening: float = Field(
        default=0.5, ge=0, le=1,
        description="theta: a group of agents counts as one if narrower than theta times its distance; 0 = never",
    )  # fmt: skip
    conserves_momentum: ClassVar[bool] = True

    def _inverse_distances(self, state: State, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sum of w_i w_j / sqrt(d^2 + eps^2) over all living pairs, (B,), except those in one place."""
        pos, weights = state.pos.astype(np.float64), weight * state.alive
        found = np.zeros(len(pos))
        for i in range(pos.shape[1] - 1):
            square = ((pos[:, i + 1 :] - pos[:, i, None]) ** 2).sum(axis=-1)
            distance = np.sqrt(np.where(square > 0, square + self.softening**2, np.inf))
            found += weights[:, i] * (weights[:, i + 1 :] / distance).sum(axis=1)
        return found


class Gravitation(_Softened):
    """Newton's gravitation, softened: F_i = sum of G m_i m_j d / (d^2 + eps^2)^(3/2), d from i to j.

    Newton 1687; softening: Plummer 1911; groups of far bodies: Barnes and Hut 1986.

    Limits: with a softening of 0 close passages have no bound, and dt is not adapted to them: energy is lost or gained.
    Combined groups make forces of a pair not exactly opposite.
    """

    kind: Literal["gravitation"] = "gravitation"
    constant: float = Field(ge=0, description="G, N m^2/kg^2; in nature 6.674e-11")
    far_law: ClassVar[Law | None] = gravitation
    strengths: ClassVar[tuple[str, ...]] = ("constant",)

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if an agent has infinite mass, as its attraction would be infinite."""
        for k, group in enumerate(scene.groups):
            if not np.isfinite(group.masses(scene.dimension)).all():
                raise ValueError(
                    f"constant: groups[{k}] has particles that are pinned, by an infinite mass, which would pull "
                    "infinitely; unpin them"
                )

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> NDArray[np.float64]:
        """Return the sum of -G m_i m_j / sqrt(d^2 + eps^2) over all pairs, (B,) J."""
        return -self.constant * self._inverse_distances(state, all_masses(groups, state.shape[2]))


class InverseSquare(_Softened):
    """Attraction or repulsion of every pair, independent of mass: F_i = sum of k d / (d^2 + eps^2)^(3/2).

    Coulomb 1785; softening: Plummer 1911; groups of far agents: Barnes and Hut 1986.

    Limits: with a softening of 0 close passages have no bound, and dt is not adapted to them: energy is lost or gained.
    Combined groups make forces of a pair not exactly opposite.
    """

    kind: Literal["inverse_square"] = "inverse_square"
    strength: float = Field(description="k, N m^2; positive attracts, negative repels")
    far_law: ClassVar[Law | None] = inverse_square
    weighs_mass: ClassVar[bool] = False
    strengths: ClassVar[tuple[str, ...]] = ("strength",)

    def potential(self, groups: Sequence[Any], state: State, offset: Any) -> NDArray[np.float64]:
        """Return the sum of -k / sqrt(d^2 + eps^2) over all pairs, (B,) J."""
        return -self.strength * self._inverse_distances(state, np.ones(state.shape[1]))
