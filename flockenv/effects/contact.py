"""Obstacles that are solid: a damped spring, only while a body is in one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.effects.base import Effect, Me, Obstacle, all_masses
from flockenv.kernels import Vec, law, like
from flockenv.vec import add, dot, scale, sub, zero

__all__ = ["ObstacleContact"]

Floats = NDArray[np.float64]


@law
def untouched(p: Any, me: Me) -> Vec:
    """No force yet."""
    return zero(me.pos)


@law
def pushed_out(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Add max(0, k overlap - c v.n) n, if there is an overlap; v relative to the obstacle."""
    o = like(me.radius, 0.0)
    overlap = me.radius - other.gap
    force = p.stiffness * overlap - p.damping * dot(sub(me.vel, other.vel), other.normal)
    return add(acc, scale(other.normal, force if (overlap > o) & (force > o) else o))


@law
def touching(p: Any, me: Me) -> float:
    """Its radius."""
    return me.radius


@law
def of_all(p: Any, me: Me, acc: Vec) -> Vec:
    """All of them at once."""
    return acc


class ObstacleContact(Effect):
    """A body that overlaps an obstacle by d is pushed out of it, F = max(0, k d - c v.n) n; n leads out.

    v is relative to the obstacle. The elastic part is the contact force of Helbing, Farkas and Vicsek 2000
    (k g(r - d)); it never pulls. A body of mass m that comes at v goes in by at most v sqrt(m / k).
    """

    kind: Literal["obstacle_contact"] = "obstacle_contact"
    stiffness: float = Field(ge=0, description="k, N/m")
    damping: float = Field(default=0.0, ge=0, description="c, kg/s")
    strengths: ClassVar[tuple[str, ...]] = ("stiffness", "damping")
    obstacle_start: ClassVar[str | None] = "untouched"
    obstacle_law: ClassVar[str | None] = "pushed_out"
    obstacle_finish: ClassVar[str | None] = "of_all"
    obstacle_reach: ClassVar[str | None] = "touching"

    def folded(self, dimension: int) -> int:
        """The force so far."""
        return dimension

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """w^2 = k / m, and c / m, of a body in one obstacle."""
        mass = all_masses(groups, dimension)
        return self.stiffness / mass, self.damping / mass
