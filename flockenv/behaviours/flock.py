"""The three rules of a flock (Reynolds 1987), each an effect of its own; together they share one neighbour query.

Each has its own radius and field of view, and uses all neighbours there (metric) or the nearest few (topological;
Ballerini et al. 2008, doi 10.1073/pnas.0711437105: starlings interact with six or seven). An agent at rest has no
heading and sees in all directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import gains
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import scale, select, sub, zero
from flockenv.physics.effects.effect import Effect, Me, Other, Sight
from flockenv.steering import others

__all__ = ["Alignment", "Cohesion", "Separation"]


@law
def separation_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return the repulsion from one neighbour."""
    return others.separate_at(other.offset, other.square, sub(me.tie, other.tie))


@law
def separation_apart(p: Any, me: Me, other: Other) -> Vec:
    """Return the repulsion from a neighbour in another position."""
    return others.push_off(other.offset, other.square)


@law
def separation(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w times the sum of repulsions."""
    return scale(sums, p.weight)


@law
def alignment_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return the velocity of one neighbour."""
    return other.vel


@law
def _mean_of_sums(sums: Vec) -> tuple[Vec, bool]:
    """Return the vector part of the sums divided by their count, the last entry, and True if the count is positive."""
    e = like(sums[0], 1.0)
    count = sums[len(sums) - 1]
    found = count > like(e, 0.0)
    share = e / count if found else like(e, 0.0)
    if len(sums) == 3:
        return (sums[0] * share, sums[1] * share), found
    else:
        return (sums[0] * share, sums[1] * share, sums[2] * share), found


@law
def alignment(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w (mean v_j - v), 0 without neighbours."""
    mean, found = _mean_of_sums(sums)
    return select(found, scale(steering.align(me.vel, mean), p.weight), zero(mean))


@law
def cohesion_pair(p: Any, me: Me, other: Other) -> Vec:
    """Return the offset of one neighbour."""
    return other.offset


@law
def cohesion(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w (mean x_j - x)."""
    mean, _ = _mean_of_sums(sums)
    return scale(mean, p.weight)


class _FlockRule(Effect):
    """Base of the three rules."""

    steering: ClassVar[bool] = True
    always: ClassVar[bool] = False

    weight: float
    radius: float = Field(gt=0, description="m, range within which neighbours count")
    fov: float = Field(
        title="field of view", default=360.0, gt=0, le=360, description="degrees, full angle of the field of view"
    )
    nearest: int | None = Field(
        default=None, ge=1, le=32, description="topological: number of nearest neighbours that count (default: all)"
    )
    group: int | None = Field(default=None, ge=0, description="group whose agents count (default: all)")
    occluded: bool = Field(default=False, description="True if obstacles hide agents")

    @property
    def sight(self) -> Sight:
        """Radius, field of view, number, group and occlusion."""
        return Sight(self.radius, self.fov, self.nearest, self.group, self.occluded)

    def parameters(self) -> dict[str, float | Vec]:
        """Return the weight; the neighbour query uses the rest."""
        return {"weight": self.weight}


class Separation(_FlockRule):
    """Keep away from near neighbours: F = w sum of (x - x_j)/|x - x_j|^2.

    Reynolds 1987 and 1999.

    Limits: the force of a neighbour is w / r without an upper bound as r goes to 0, and falls from w / radius to 0 at
    the radius. r is a distance of centres: the radii of bodies do not count. It is a sum, so it grows with the number
    of neighbours.
    """

    kind: Literal["separation"] = "separation"
    sentence: ClassVar[str] = "Keep away from neighbours within {radius}"
    weight: float = Field(ge=0, description="N m, force of a neighbour times its distance")
    demo: ClassVar[str | None] = """
groups: [{count: 14, radius: 0.15, spawn: {low: [0, 0], high: [3, 3]}}]
effects:
  - {kind: separation, weight: 0.5, radius: 2.5}
  - {kind: drag, rate: 1}
dt: 0.02
"""
    pair_law: ClassVar[Law | None] = separation_pair
    apart_law: ClassVar[Law | None] = separation_apart
    finish_law: ClassVar[Law | None] = separation
    vanishes: ClassVar[bool] = True

    @property
    def conserves_momentum(self) -> bool:  # type: ignore[override]  # a rule with a view cone is not mutual
        """True if it has a full field of view and uses all neighbours: then the forces of a pair are opposite."""
        return self.fov >= 360.0 and self.nearest is None and self.group is None  # occlusion is mutual

    def sums(self, dimension: int) -> int:
        """Return how many numbers are summed: D, a vector."""
        return dimension


class Alignment(_FlockRule):
    """Match the mean velocity of the neighbours: F = w (mean v_j - v).

    Reynolds 1987 and 1999.

    Limits: no speed is preferred: velocities of different directions cancel in the mean, and the flock slows down. The
    distance of a neighbour does not matter, so the force jumps if one crosses the radius.
    """

    kind: Literal["alignment"] = "alignment"
    sentence: ClassVar[str] = "Match the mean velocity of neighbours within {radius}"
    weight: float = Field(ge=0, description="kg/s, force per difference of velocities")
    demo: ClassVar[str | None] = """
groups: [{count: 14, radius: 0.15, spawn: {low: [0, 0], high: [6, 6], speed: [0.5, 1.5]}}]
effects: [{kind: alignment, weight: 0.7, radius: 5, fov: 300}]
dt: 0.02
"""
    pair_law: ClassVar[Law | None] = alignment_pair
    finish_law: ClassVar[Law | None] = alignment
    averages: ClassVar[bool] = True

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return no oscillation, and a damping of 2 w / m, that of two agents that see only each other."""
        damping = gains(2 * self.weight, groups, dimension)
        return np.zeros(len(damping)), damping

    def sums(self, dimension: int) -> int:
        """Return how many numbers are summed: D, a vector."""
        return dimension


class Cohesion(_FlockRule):
    """Stay with the neighbours: F = w (mean x_j - x).

    Reynolds 1987 and 1999.

    Limits: the force is a spring of rest length 0 without damping: alone, agents swing through their common centre, and
    nothing keeps them apart. It grows with the distance up to w times the radius, and jumps if a neighbour crosses it.
    """

    kind: Literal["cohesion"] = "cohesion"
    sentence: ClassVar[str] = "Stay with the neighbours within {radius}"
    weight: float = Field(ge=0, description="N/m, force per distance from the centre of the neighbours")
    demo: ClassVar[str | None] = """
groups: [{count: 14, radius: 0.15, spawn: {low: [0, 0], high: [9, 9], speed: [0.2, 1]}}]
effects:
  - {kind: cohesion, weight: 0.6, radius: 5, fov: 300}
  - {kind: drag, rate: 0.4}
dt: 0.02
"""
    pair_law: ClassVar[Law | None] = cohesion_pair
    finish_law: ClassVar[Law | None] = cohesion
    averages: ClassVar[bool] = True

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return w^2 = 2 w / m, that of two agents that see only each other, and no damping."""
        square = gains(2 * self.weight, groups, dimension)
        return square, np.zeros(len(square))

    def sums(self, dimension: int) -> int:
        """Return how many numbers are summed: D, a vector."""
        return dimension
