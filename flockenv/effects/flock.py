"""The three rules of a flock (Reynolds 1987), each an effect of its own; together they share one sweep.

Each looks within its own radius and field of view. Someone at standstill has no heading and sees all around.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv import steering
from flockenv.effects.base import Effect, Me, Other
from flockenv.kernels import Vec, law, like
from flockenv.vec import dot, planar, scale, select, zero

__all__ = ["Alignment", "Cohesion", "Separation"]


@law
def sees(p: Any, me: Me, other: Other) -> bool:
    """Within the radius, and inside the field of view: offset . heading >= cos(fov / 2) |offset|."""
    ahead = dot(other.offset, me.heading)
    # an offset below 1e-162 m has a negative `ahead` and no square: who sees all around must see it too
    still = (dot(me.heading, me.heading) <= like(ahead, 0.0)) | (p.cos_half_fov < like(ahead, -1.0))
    seen = (ahead >= p.cos_half_fov * np.sqrt(other.square)) | still
    return (other.square < p.radius * p.radius) & seen  # type: ignore[no-any-return]


@law
def tie(me: Me, other: Other) -> Vec:
    """A unit vector for two agents in one place: differs from pair to pair, opposite for the two of a pair.

    A rational point of the half circle, t -> ((1 - t^2), 2t) / (1 + t^2), with t from the golden ratio of both indices.
    """
    e = like(me.who, 1.0)
    a, b = (me.who, other.who) if me.who < other.who else (other.who, me.who)
    turn = a * like(e, 0.6180339887) + b * like(e, 0.7548776662)
    t = turn - np.floor(turn)
    t = t + t - e
    sign = e if me.who < other.who else -e
    share = sign / (e + t * t)
    return planar(me.pos, (e - t * t) * share, (t + t) * share)


@law
def separation_pair(p: Any, me: Me, other: Other) -> Vec:
    """One push."""
    return select(sees(p, me, other), steering.separate(other.offset, tie(me, other)), zero(me.pos))


@law
def separation(p: Any, me: Me, sums: Vec) -> Vec:
    """F = w sum of pushes."""
    return scale(sums, p.weight)


@law
def alignment_pair(p: Any, me: Me, other: Other) -> Vec:
    """One velocity, and one more neighbour."""
    here = sees(p, me, other)
    v = select(here, other.vel, zero(me.pos))
    one = like(me.who, 1.0) if here else like(me.who, 0.0)
    return v + (one,)  # noqa: RUF005  # numba joins tuples, but does not unpack them


@law
def _mean(sums: Vec) -> tuple[Vec, bool]:
    """Divide the vector part of the sums by their count, the last."""
    e = like(sums[0], 1.0)
    count = sums[len(sums) - 1]
    some = count > like(e, 0.0)
    share = e / count if some else like(e, 0.0)
    if len(sums) == 3:
        return (sums[0] * share, sums[1] * share), some
    else:
        return (sums[0] * share, sums[1] * share, sums[2] * share), some


@law
def alignment(p: Any, me: Me, sums: Vec) -> Vec:
    """F = w (mean v_j - v), 0 without neighbours."""
    mean, some = _mean(sums)
    return select(some, scale(steering.align(me.vel, mean), p.weight), zero(mean))


@law
def cohesion_pair(p: Any, me: Me, other: Other) -> Vec:
    """One offset, and one more neighbour."""
    here = sees(p, me, other)
    d = select(here, other.offset, zero(me.pos))
    one = like(me.who, 1.0) if here else like(me.who, 0.0)
    return d + (one,)  # noqa: RUF005


@law
def cohesion(p: Any, me: Me, sums: Vec) -> Vec:
    """F = w (mean x_j - x)."""
    mean, _ = _mean(sums)
    return scale(mean, p.weight)


class _FlockRule(Effect):
    """What the three rules have in common."""

    weight: float
    radius: float = Field(gt=0, description="m, neighbours are nearer than this")
    fov: float = Field(default=360.0, gt=0, le=360, description="degrees, full angle of the field of view")
    steering: ClassVar[bool] = True

    @property
    def reach(self) -> float:
        """The radius."""
        return self.radius

    def parameters(self) -> dict[str, float]:
        """Weight, radius, and the cosine of half the field of view (-2 for all around: no rounding can hide anyone)."""
        half = -2.0 if self.fov >= 360.0 else math.cos(math.radians(self.fov) / 2.0)
        return {"weight": self.weight, "radius": self.radius, "cos_half_fov": half}


class Separation(_FlockRule):
    """Keep away from near neighbours: F = w sum of (x - x_j)/|x - x_j|^2."""

    kind: Literal["separation"] = "separation"
    weight: float = Field(ge=0, description="N m")
    pair_law: ClassVar[str | None] = "separation_pair"
    finish_law: ClassVar[str | None] = "separation"

    @property
    def conserves_momentum(self) -> bool:  # type: ignore[override]  # a rule with a view cone is not mutual
        """True with eyes all around: then everybody pushes back as he is pushed."""
        return self.fov >= 360.0

    def sums(self, dimension: int) -> int:
        """A vector."""
        return dimension


class Alignment(_FlockRule):
    """Fly as the neighbours do: F = w (mean v_j - v)."""

    kind: Literal["alignment"] = "alignment"
    weight: float = Field(ge=0, description="kg/s")
    pair_law: ClassVar[str | None] = "alignment_pair"
    finish_law: ClassVar[str | None] = "alignment"

    def sums(self, dimension: int) -> int:
        """A vector and a count."""
        return dimension + 1


class Cohesion(_FlockRule):
    """Stay with the neighbours: F = w (mean x_j - x)."""

    kind: Literal["cohesion"] = "cohesion"
    weight: float = Field(ge=0, description="N/m")
    pair_law: ClassVar[str | None] = "cohesion_pair"
    finish_law: ClassVar[str | None] = "cohesion"

    def sums(self, dimension: int) -> int:
        """A vector and a count."""
        return dimension + 1
