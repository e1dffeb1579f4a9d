"""Behaviours towards the nearest of a group: pursue, evade, offset_pursue, shadow, match_velocity (Reynolds 1999)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import AboutNearest, Moving, mean_nearest, top_speed
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import norm, scale, select, zero
from flockenv.physics.effects.effect import Me

__all__ = ["PREDICTORS", "Evade", "MatchVelocity", "OffsetPursue", "Predicting", "Pursue", "Shadow"]

PREDICTORS = ("distance", "opensteer", "exact")


@law
def prediction_time(p: Any, distance: float, table: float, exact: float) -> float:
    """Return the prediction time of the selected predictor, s, at most p.longest."""
    e = like(distance, 1.0)
    time = distance if p.method < e else (table if p.method < e + e else exact)
    return time if time < p.longest else p.longest


@law
def pursuer_time(p: Any, me: Me, offset: Vec, velocity: Vec) -> float:
    """Return the prediction time of a pursuer, s."""
    top = top_speed(p, me)
    distance = steering.distance_time(offset, top, p.factor)
    table = steering.opensteer_time(offset, me.vel, velocity, p.longest)
    return prediction_time(p, distance, table, steering.interception_time(offset, velocity, top))


@law
def evader_time(p: Any, me: Me, offset: Vec, velocity: Vec) -> float:
    """Return the prediction time of an evader, s: "exact" is when the pursuer at its speed can intercept it."""
    top, theirs = top_speed(p, me), norm(velocity)
    distance = steering.distance_time(offset, top, p.factor)
    table = steering.approach_time(offset, theirs, p.longest)
    least = like(top, 1e-6) * top  # a pursuer at rest has no such time
    back = scale(offset, like(top, -1.0))
    return prediction_time(
        p, distance, table, steering.interception_time(back, me.vel, theirs if theirs > least else least)
    )


@law
def pursue_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w (V unit(x_q + v_q T - x) - v)."""
    offset, velocity, found = mean_nearest(sums)
    time = pursuer_time(p, me, offset, velocity)
    change = steering.pursue(offset, me.vel, velocity, top_speed(p, me), time)
    return select(found, scale(change, p.weight), zero(change))


@law
def evade_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w (V unit(x - x_p - v_p T) - v)."""
    offset, velocity, found = mean_nearest(sums)
    time = evader_time(p, me, offset, velocity)
    change = steering.evade(offset, me.vel, velocity, top_speed(p, me), time)
    return select(found, scale(change, p.weight), zero(change))


@law
def offset_pursue_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w S: pursue a point beside the quarry."""
    offset, velocity, found = mean_nearest(sums)
    time = pursuer_time(p, me, steering.passing_point(offset, me.vel, p.distance), velocity)
    change = steering.offset_pursue(offset, me.vel, velocity, top_speed(p, me), p.distance, time)
    return select(found, scale(change, p.weight), zero(change))


@law
def shadow_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w S: pursue from afar, match velocity near by."""
    offset, velocity, found = mean_nearest(sums)
    time = pursuer_time(p, me, offset, velocity)
    change = steering.shadow(offset, me.vel, velocity, top_speed(p, me), p.distance, p.band, time)
    return select(found, scale(change, p.weight), zero(change))


@law
def match_velocity_force(p: Any, me: Me, sums: Vec) -> Vec:
    """Return F = w (v_j - v)."""
    _, velocity, found = mean_nearest(sums)
    return select(found, scale(steering.match_velocity(me.vel, velocity), p.weight), zero(velocity))


class Predicting(AboutNearest, Moving):
    """Base of behaviours that predict the path of another agent."""

    predictor: Literal["distance", "opensteer", "exact"] = Field(
        default="exact",
        description="prediction time: factor d / V, OpenSteer's table, or time to interception",
    )
    factor: float = Field(default=1.0, ge=0, description="of the predictor by distance, T = factor d / V")
    longest: float = Field(default=10.0, ge=0, description="s, longest prediction")

    def parameters(self) -> dict[str, float | Vec]:
        """Return the behaviour's numbers; the predictor is one of them."""
        return {**super().parameters(), "method": float(PREDICTORS.index(self.predictor))}


class Pursue(Predicting):
    """Seek the predicted position of the nearest of a group: S = V unit(x_q + v_q T - x) - v (Reynolds 1999).

    T is factor d / V (distance), OpenSteer's k d / |v| with k by position and heading of the quarry (opensteer), or the
    earliest interception time if the quarry goes straight on (exact).

    Limits: it aims to pass through the quarry and does not brake; a quarry that turns is not where it was predicted. It
    follows the nearest one in sight, which may change from step to step, and knows no obstacles.
    """

    kind: Literal["pursue"] = "pursue"
    finish_law: ClassVar[Law | None] = pursue_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 4, max_speed: 2, max_force: 10, role: pursuer, spawn: {low: [-6, -5], high: [-5, -1]}}
  - {count: 1, max_speed: 1, role: evader, spawn: {low: [-3, 3], high: [-3, 3], speed: [1, 1], heading: [1, 0]}}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: pursue, weight: 10, group: 1, radius: 30}]}
"""
    demo_time: ClassVar[float] = 6.0


class Evade(Predicting):
    """Flee from the predicted position of the nearest of a group: S = V unit(x - x_p - v_p T) - v (Reynolds 1999).

    T is factor d / V (distance), d / |v_p| (opensteer), or the time at which the pursuer at its speed can intercept it
    (exact).

    Limits: it flees from the nearest pursuer alone, perhaps towards a second one, and knows no walls. Without one in
    sight the force is 0, and the agent goes on.
    """

    kind: Literal["evade"] = "evade"
    predictor: Literal["distance", "opensteer", "exact"] = Field(
        default="opensteer", description="prediction time: factor d / V, d / |v_p|, or time to interception"
    )
    finish_law: ClassVar[Law | None] = evade_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 1, max_speed: 1.5, max_force: 4, role: pursuer, spawn: {low: [-6, 0], high: [-6, 0], speed: [1, 1]}}
  - {count: 6, max_speed: 1.3, max_force: 4, role: evader, spawn: {low: [-3, -2], high: [1, 2]}}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: pursue, weight: 10, group: 1, radius: 30}]}
  - {kind: steer, group: 1, behaviours: [{kind: evade, weight: 10, group: 0, radius: 4}]}
"""


class OffsetPursue(Predicting):
    """Pass the nearest of a group at a distance: seek a point beside its predicted position (Reynolds 1999).

    Limits: the side is chosen anew in every step, and a quarry dead ahead is passed on the right. After it has passed,
    it turns back to pass again.
    """

    kind: Literal["offset_pursue"] = "offset_pursue"
    distance: float = Field(ge=0, description="m, distance at which it passes")
    finish_law: ClassVar[Law | None] = offset_pursue_force
    demo: ClassVar[str | None] = """
groups:
  - count: 6
    max_speed: 2
    max_force: 10
    role: pursuer
    spawn: {low: [-8, -3], high: [-6, 3], speed: [1, 2], heading: [1, 0]}
  - {count: 1, max_speed: 1, role: evader, spawn: {low: [0, 0], high: [0, 0]}}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: offset_pursue, weight: 10, group: 1, radius: 30, distance: 1}]}
"""
    demo_time: ClassVar[float] = 4.5


class Shadow(Predicting):
    """Approach the nearest of a group, then move along with it: pursue from afar, match its velocity near by.

    Pursuit fades linearly from distance + band to distance, within which it only matches, so that it does not chatter.
    Described in Reynolds 1999, where the two alternate; to do that with hysteresis would need a memory.

    Limits: within the distance it only matches the velocity: it does not move away from a quarry that comes nearer.
    Another agent that becomes the nearest is followed from then on.
    """

    kind: Literal["shadow"] = "shadow"
    distance: float = Field(ge=0, description="m, within which it only matches speed and heading")
    band: float = Field(default=1.0, gt=0, description="m, width beyond `distance` over which pursuit grows")
    finish_law: ClassVar[Law | None] = shadow_force
    copies: ClassVar[bool] = True
    demo: ClassVar[str | None] = """
groups:
  - {count: 4, max_speed: 2, max_force: 10, role: pursuer, spawn: {low: [-8, -4], high: [-6, 4]}}
  - count: 1
    max_speed: 1
    max_force: 2
    role: evader
    spawn: {low: [-4, 0], high: [-4, 0], speed: [1, 1], heading: [1, 0]}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: shadow, weight: 10, group: 1, radius: 30, distance: 1.5}]}
  - {kind: steer, group: 1, behaviours: [{kind: wander, weight: 2}]}
"""
    demo_time: ClassVar[float] = 12.0


class MatchVelocity(AboutNearest):
    """Match the velocity of the nearest of a group: S = v_j - v (Reynolds 1987).

    Limits: only the velocity is matched: the distance is left as it is, and of several neighbours only the nearest
    counts.
    """

    kind: Literal["match_velocity"] = "match_velocity"
    finish_law: ClassVar[Law | None] = match_velocity_force
    copies: ClassVar[bool] = True
    demo: ClassVar[str | None] = """
groups:
  - {count: 5, max_speed: 2, max_force: 4, spawn: {low: [-6, -4], high: [-5, 4], speed: [0, 1]}}
  - {count: 1, role: learner, spawn: {low: [-6, 0], high: [-6, 0], speed: [1, 1], heading: [1, 0.2]}}
effects:
  - {kind: steer, group: 0, behaviours: [{kind: match_velocity, weight: 1, group: 1, radius: 30}]}
"""
