"""Social groups and attractions of pedestrians: walking groups, friends, windows and performers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.social import Social, strength_of
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.approximations import exp
from flockenv.maths.vectors import add, limit, norm, scale, select, sub, unit, zero
from flockenv.physics.effects.effect import Effect, Me, Other, Sight, Vector, all_masses
from flockenv.steering.others import ONE_PLACE

__all__ = ["Friends", "Interest", "WalkingGroup"]


# --- attraction -------------------------------------------------------------------------------------------------------


@law
def remaining_interest(p: Any, time: float) -> float:
    """Return the remaining share of an interest that began at `since`: exp(-(t - t0) / T), 0 before."""
    o = like(time, 0.0)
    age = time - p.since
    return exp(-age * p.fading) if age >= o else o


@law
def interest_force(p: Any, me: Me) -> Vec:
    """Return A exp(-d / B) exp(-(t - t0) / T) towards the place."""
    pull = scale(
        steering.attraction(sub(p.target, me.pos), p.decay), strength_of(p, me) * remaining_interest(p, me.time)
    )
    near = norm(sub(p.target, me.pos)) < p.radius
    return select(near, pull, zero(me.pos))


class Interest(Effect):
    """Attraction to a place, as to a window or a performer, that fades: F = A exp(-d / B) exp(-(t - t0) / T) n.

    It is -grad W of a potential that grows with the distance and fades with time, as required by Helbing and Molnar
    1995 (equation 7). They give neither form nor numbers: both are ours.

    Limits: the pull jumps from A exp(-radius / B) to 0 at the radius, and reverses at the place, about which agents
    swing: nothing damps it. It begins and fades for all agents at the same time.
    """

    kind: Literal["interest"] = "interest"
    target: Vector = Field(description="m, place of attraction")
    strength: float = Field(default=0.0, ge=0, description="A, N, pull at the place itself, the same for all masses")
    acceleration: float = Field(default=0.0, ge=0, description="A, m/s^2: the force is that times its own mass")
    decay: float = Field(gt=0, description="B, m, over which the pull falls to 1/e")
    fades: float | None = Field(default=None, gt=0, description="T, s, in which interest falls to 1/e (default: never)")
    since: float = Field(default=0.0, ge=0, description="t0, s, when it begins")
    radius: float = Field(default=20.0, gt=0, description="m, range of the attraction")
    steering: ClassVar[bool] = True
    strengths: ClassVar[tuple[str, ...]] = ("strength", "acceleration")
    places: ClassVar[tuple[str, ...]] = ("target",)
    own_law: ClassVar[Law | None] = interest_force
    demo: ClassVar[str | None] = """
dt: 0.02
groups: [{count: 5, mass: 80, radius: 0.25, desired_speed: 1.3, spawn: {low: [-6, -2], high: [-3, 2]}}]
effects:
  - {kind: course, direction: [1, 0]}
  - {kind: driving, tau: 0.5}
  - {kind: circular_repulsion, strength: 2000, decay: 0.08, radius: 3}
  - {kind: interest, target: [0, 3], acceleration: 4, decay: 3, fades: 4}
"""

    def parameters(self) -> dict[str, float | Vec]:
        """Return place, strength, range and fading."""
        fading = 0.0 if self.fades is None else 1 / self.fades
        numbers = {
            name: float(getattr(self, name)) for name in ("strength", "acceleration", "decay", "since", "radius")
        }
        return {"target": self.target, "fading": fading, **numbers}


@law
def friend_attraction(p: Any, me: Me, other: Other) -> Vec:
    """Return exp(-d / B) towards the neighbour, cut so that A times it is at most the bound."""
    return limit(steering.attraction(other.offset, p.decay), p.bound / strength_of(p, me))


@law
def friends_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return A exp(-(t - t0) / T) times the sum."""
    return scale(sums, strength_of(p, me) * remaining_interest(p, me.time))


class Friends(Social):
    """Attraction to the agents of a group, that fades: F = A exp(-(t - t0) / T) sum exp(-d / B) n.

    The attraction of Helbing and Molnar 1995 (equation 7) to friends; form and numbers are ours, see `interest`.

    Limits: every agent of the group is a friend, and the sum has no upper bound in their number. The pull of each
    reverses where the two are in one place, and nothing keeps them apart.
    """

    kind: Literal["friends"] = "friends"
    decay: float = Field(gt=0, description="B, m, over which the pull falls to 1/e")
    fades: float | None = Field(default=None, gt=0, description="T, s, in which interest falls to 1/e (default: never)")
    since: float = Field(default=0.0, ge=0, description="t0, s, when it begins")
    pair_law: ClassVar[Law | None] = friend_attraction
    finish_law: ClassVar[Law | None] = friends_force
    demo: ClassVar[str | None] = """
dt: 0.02
groups:
  - {count: 4, mass: 80, radius: 0.25, desired_speed: 1.3, spawn: {low: [-6, -3], high: [-3, 3]}}
  - count: 1
    mass: 80
    radius: 0.25
    desired_speed: 1.3
    role: learner
    spawn: {low: [0, 2.5], high: [0, 2.5]}
effects:
  - {kind: course, group: 0, direction: [1, 0]}
  - {kind: driving, tau: 0.5}
  - {kind: steer, group: 0, behaviours: [{kind: friends, group: 1, acceleration: 4, decay: 3, fades: 4, radius: 10}]}
  - {kind: circular_repulsion, strength: 2000, decay: 0.08, radius: 3}
"""

    def parameters(self) -> dict[str, float | Vec]:
        """Return strength, range and fading."""
        fading = 0.0 if self.fades is None else 1 / self.fades
        return {**super().parameters(), "decay": self.decay, "since": self.since, "fading": fading}


# --- walking groups ---------------------------------------------------------------------------------------------------


@law
def _party(p: Any, who: float) -> float:
    """Return the index of the party of an agent."""
    return np.floor((who - p.first) / p.party)  # type: ignore[no-any-return]


@law
def party_sums(p: Any, me: Me, other: Other) -> Vec:
    """Return count 1, offset, and repulsion direction if too near, of a neighbour; 0 if it is of another party."""
    o, e = like(other.square, 0.0), like(other.square, 1.0)
    mine = _party(p, me.who) == _party(p, other.who)
    near = mine & (other.square < p.distance * p.distance)
    apart = other.square > like(other.square, ONE_PLACE)
    away = unit(select(apart, scale(other.offset, -e), sub(me.tie, other.tie)))
    none = zero(other.offset)
    return (e if mine else o,) + select(mine, other.offset, none) + select(near, away, none)  # noqa: RUF005


@law
def party_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return m (-beta1 alpha v + beta2 q_A U + beta3 sum q_R W)."""
    o, e = like(me.mass, 0.0), like(me.mass, 1.0)
    others = sums[0]
    to: Vec
    away: Vec
    if len(sums) == 5:
        to, away = (sums[1], sums[2]), (sums[3], sums[4])
    else:
        to, away = (sums[1], sums[2], sums[3]), (sums[4], sums[5], sums[6])
    centre = scale(to, e / (others + e))  # of the party, including itself
    alpha = steering.gaze_turn(me.heading, to, p.edge)
    far = norm(centre) > others * like(me.mass, 0.5)  # (N - 1) / 2 m
    change = add(scale(me.vel, -p.gaze * alpha), scale(unit(centre), p.cohesion if far else o))
    has = (others > o) & (me.who >= p.first) & (me.who < p.end)
    return select(has, scale(add(change, scale(away, p.repulsion)), me.mass), zero(me.vel))


class WalkingGroup(Effect):
    """Walk in small parties of a group: its agents 0 to `party` - 1 are one party, the next are another, and so on.

    Moussaid et al. 2010: F = m (-beta1 alpha v + beta2 q_A U + beta3 sum q_R W). alpha is the angle by which an agent
    must turn its head to see the centre of the others. U points to the centre of the party, if that is further than
    (N - 1) / 2 m (N members), and W away from each member nearer than `distance`. Combine it with a repulsion from all
    agents.

    Limits: parties are runs of consecutive indices, so a newborn agent belongs to that of its index. Members beyond the
    radius are lost to it. At standstill the gaze has no direction and brakes nothing, and each pull or push begins with
    a jump.
    """

    kind: Literal["walking_group"] = "walking_group"
    sentence: ClassVar[str] = "Walk in small parties of {party}"
    group: int | None = Field(
        default=None, ge=0, strict=True, description="group that walks in parties (default: all, counted consecutively)"
    )
    party: int = Field(ge=2, strict=True, description="N, size of a party; the last may be smaller")
    gaze: float = Field(default=4.0, ge=0, description="beta1, 1/(s rad), braking by the angle of gaze")
    cohesion: float = Field(default=3.0, ge=0, description="beta2, m/s^2, towards the centre")
    repulsion: float = Field(default=1.0, ge=0, description="beta3, m/s^2, from each member that is too near")
    distance: float = Field(default=0.8, gt=0, description="m between centres, below which members repel")
    fov: float = Field(
        title="field of view", default=180.0, gt=0, le=360, description="degrees, full angle of view without turning"
    )
    radius: float = Field(default=20.0, gt=0, description="m, range within which members count")
    steering: ClassVar[bool] = True
    always: ClassVar[bool] = False
    strengths: ClassVar[tuple[str, ...]] = ("gaze", "cohesion", "repulsion")
    pair_law: ClassVar[Law | None] = party_sums
    finish_law: ClassVar[Law | None] = party_force
    demo: ClassVar[str | None] = """
dt: 0.02
groups: [{count: 9, mass: 80, radius: 0.25, desired_speed: 1.2, spawn: {low: [-6, -4], high: [-3, 4]}}]
effects:
  - {kind: course, direction: [1, 0]}
  - {kind: driving, tau: 0.5}
  - {kind: sidestep, acceleration: 4.5, radius: 8}
  - {kind: walking_group, group: 0, party: 3}
"""

    @property
    def sight(self) -> Sight:
        """The agents of the group, in all directions."""
        return Sight(self.radius, group=self.group)

    def parameters(self) -> dict[str, float | Vec]:
        """Return beta1 to beta3, the size of a party and its distance."""
        names = ("party", "gaze", "cohesion", "repulsion", "distance")
        return {"edge": math.radians(self.fov) / 2, **{name: float(getattr(self, name)) for name in names}}

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """Return the first agent of the group, and one past its last."""
        first, end = (0, starts[-1]) if self.group is None else starts[self.group : self.group + 2]
        return {"first": float(first), "end": float(end)}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return no oscillation, and damping beta1 times the largest turn of a head, pi less half the field of view."""
        most = self.gaze * (math.pi - math.radians(self.fov) / 2)
        damping = np.where(np.isfinite(all_masses(groups, dimension)), most, 0.0)
        return np.zeros(len(damping)), damping

    def sums(self, dimension: int) -> int:
        """Return how many numbers are summed: count, offset and repulsion."""
        return 1 + 2 * dimension
