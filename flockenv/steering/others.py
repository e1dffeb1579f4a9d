"""Laws for an agent and others: prediction of a quarry, pursuit, evasion, separation, formations, hiding."""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import (
    add,
    axis,
    dot,
    lateral,
    limit,
    norm,
    opposite,
    perpendicular,
    scale,
    select,
    sub,
    unit,
    zero,
)
from flockenv.steering.goals import arrive, flee, match_velocity, seek, to_world_axes

__all__ = [
    "align",
    "approach_time",
    "cohere",
    "distance_time",
    "evade",
    "follow_leader",
    "hiding_place",
    "interception_time",
    "interpose",
    "keep_station",
    "offset_pursue",
    "opensteer_time",
    "passing_point",
    "pursue",
    "push_off",
    "separate",
    "separate_at",
    "shadow",
]

ONE_PLACE = 1e-30
"""m^2: agents nearer than 1e-15 m are in one place; 1 / square must not overflow, also in float32."""


@law
def distance_time(offset: Vec, max_speed: float, factor: float) -> float:
    """Predict by distance: T = factor |offset| / V, s. The simplest predictor of Reynolds 1999.

    offset: to the other, m; max_speed: V, m/s; factor: a number >= 0.
    """
    return factor * norm(offset) / max_speed


@law
def interception_time(offset: Vec, quarry_velocity: Vec, max_speed: float) -> float:
    """Predict exactly: the first time at which a pursuer at full speed V can meet the quarry, s.

    offset: to the quarry, m; quarry_velocity: m/s; max_speed: V, m/s.

    Smallest t > 0 of (w.w - V^2) t^2 + 2 p.w t + p.p = 0 with p = offset, w = quarry velocity, computed without
    cancellation; |p|/V if no interception exists.
    """
    a = dot(quarry_velocity, quarry_velocity) - max_speed * max_speed
    b = dot(offset, quarry_velocity)
    c = dot(offset, offset)
    o = like(c, 0.0)
    discriminant = b * b - a * c
    denominator = np.sqrt(discriminant if discriminant > o else o) - b
    exists = discriminant >= o and denominator > o
    return c / denominator if exists else np.sqrt(c) / max_speed  # type: ignore[no-any-return]


@law
def approach_time(offset: Vec, speed: float, longest: float) -> float:
    """Return |offset| / speed, s, the time that an agent at this speed takes to arrive; at most `longest` [s].

    The predictor of evasion in OpenSteer, which has no guard against a speed of 0.
    """
    distance = norm(offset)
    return distance / speed if distance < longest * speed else longest


@law
def cosine_sector(x: float) -> float:
    """Return 1, 0 or -1 for an angle with cosine x: within 45 degrees of 0, in between, or within 45 of 180."""
    edge = like(x, 0.707)
    return like(x, 1.0) if x > edge else (like(x, -1.0) if x < -edge else like(x, 0.0))


@law
def opensteer_time(offset: Vec, velocity: Vec, quarry_velocity: Vec, longest: float) -> float:
    """Predict as OpenSteer does: T = k |offset| / |v|, s, at most `longest` [s].

    offset: to the quarry, m; velocity: of the agent, m/s; quarry_velocity: m/s.

    k for a quarry ahead: 4 on a parallel course, 1.8 across, 0.85 opposite; beside: 1, 0.8, 4; behind: 0.5, 2, 2.
    """
    forward = unit(velocity)
    place, course = cosine_sector(dot(forward, unit(offset))), cosine_sector(dot(forward, unit(quarry_velocity)))
    o = like(place, 0.0)
    parallel = like(o, 4.0) if place > o else (like(o, 0.5) if place < o else like(o, 1.0))
    across = like(o, 1.8) if place > o else (like(o, 2.0) if place < o else like(o, 0.8))
    against = like(o, 0.85) if place > o else (like(o, 2.0) if place < o else like(o, 4.0))
    k = parallel if course > o else (against if course < o else across)
    time, speed = k * norm(offset), norm(velocity)
    return time / speed if time < longest * speed else longest


@law
def pursue(offset: Vec, velocity: Vec, quarry_velocity: Vec, max_speed: float, time: float) -> Vec:
    """Seek where the quarry will be after `time` [s], which a predictor returns (Reynolds 1999).

    offset: to the quarry, m; velocity: of the agent, m/s; quarry_velocity: m/s; max_speed: V, m/s.
    """
    return seek(add(offset, scale(quarry_velocity, time)), velocity, max_speed)


@law
def evade(offset: Vec, velocity: Vec, pursuer_velocity: Vec, max_speed: float, time: float) -> Vec:
    """Flee from where the pursuer will be after `time` [s] (Reynolds 1999).

    offset: to the pursuer, m; velocity: of the agent, m/s; pursuer_velocity: m/s; max_speed: V, m/s.
    """
    return flee(add(offset, scale(pursuer_velocity, time)), velocity, max_speed)


@law
def push_off(offset: Vec, square: float) -> Vec:
    """Return the push of a neighbour that is not in the same place, 1/m, given the squared distance; see `separate`."""
    return opposite(scale(offset, like(square, 1.0) / square))  # 0 for an infinite distance: a mask, not a branch


@law
def separate(offset: Vec, tie: Vec) -> Vec:
    """Return the push of a neighbour: away from it, weighted 1/distance, 1/m (Reynolds 1999). Sum over neighbours.

    offset: to the other, m.

    `tie` is the direction if the two coincide, a unit vector that is opposite for the other one.
    """
    return separate_at(offset, dot(offset, offset), tie)


@law
def separate_at(offset: Vec, square: float, tie: Vec) -> Vec:
    """Return the same as `separate`, given the squared distance, m^2; zero if it is infinite."""
    return select(square > like(square, ONE_PLACE), push_off(offset, square), tie)


@law
def align(velocity: Vec, mean_velocity: Vec) -> Vec:
    """Take on the neighbours' mean velocity: S = mean(v_j) - v, m/s (Reynolds 1999: the average, not the sum).

    velocity: of the agent, m/s; mean_velocity: of the neighbours, m/s.
    """
    return sub(mean_velocity, velocity)


@law
def cohere(mean_offset: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Seek the neighbours' centre, at `mean_offset` [m] (Reynolds 1999); return zero if the offset is zero.

    velocity: of the agent, m/s; max_speed: V, m/s.
    """
    found = dot(mean_offset, mean_offset) > like(max_speed, 0.0)
    return select(found, seek(mean_offset, velocity, max_speed), zero(velocity))


@law
def passing_point(offset: Vec, velocity: Vec, distance: float) -> Vec:
    """Return the offset of the point beside a neighbour, `distance` [m] from it towards this agent's path, to pass it.

    offset: to the other, m; velocity: of the agent, m/s.

    Seen from the neighbour it is perpendicular to the path; a neighbour dead ahead is passed on the right.
    """
    forward = unit(velocity)
    aside = lateral(offset, forward)
    noise = like(distance, 1e-10) * dot(offset, offset)
    toward = select(dot(aside, aside) > noise, unit(aside), scale(perpendicular(forward), like(distance, -1.0)))
    return sub(offset, scale(toward, distance))


@law
def offset_pursue(
    offset: Vec, velocity: Vec, quarry_velocity: Vec, max_speed: float, distance: float, time: float
) -> Vec:
    """Pass the quarry at a distance [m]: seek a point beside its predicted position, on this side (Reynolds 1999).

    offset: to the quarry, m; velocity: of the agent, m/s; quarry_velocity: m/s; max_speed: V, m/s; time: s.

    The distance is exact if `time` is predicted for the passing point, not for the quarry.
    """
    there = add(offset, scale(quarry_velocity, time))
    return seek(passing_point(there, velocity, distance), velocity, max_speed)


@law
def keep_station(
    offset: Vec, velocity: Vec, leader_velocity: Vec, place: Vec, max_speed: float, slow_radius: float
) -> Vec:
    """Arrive at a place in a leader's frame, (forward, left[, up]) in m, and keep it: a formation.

    offset: to the leader, m; velocity: of the agent, m/s; leader_velocity: m/s; max_speed: V, m/s; slow_radius: m, from
    which on the agent slows down.

    v_d = v_L + V min(1, d / slow_radius) towards the place, at most V. An agent that arrives at the predicted place,
    as in offset pursuit (Reynolds 1999), has v_d = 0 there and lags behind a moving leader.
    """
    station = add(offset, to_world_axes(place, leader_velocity))
    towards = arrive(station, zero(velocity), max_speed, slow_radius)
    return sub(limit(add(leader_velocity, towards), max_speed), velocity)


@law
def follow_leader(
    offset: Vec,
    velocity: Vec,
    leader_velocity: Vec,
    behind: float,
    ahead: float,
    aside: float,
    max_speed: float,
    slow_radius: float,
) -> Vec:
    """Keep station `behind` a leader [m]; an agent in the box in front of the leader moves out sideways.

    offset: to the leader, m; velocity: of the agent, m/s; leader_velocity: m/s; max_speed: V, m/s; slow_radius: m, as
    of `arrive`.

    The box is `ahead` long and `aside` to each side [m]; on its axis agents move to the leader's right
    (Reynolds 1999). Separation keeps neighbours apart.
    """
    o = like(behind, 0.0)
    forward = unit(leader_velocity)
    here = scale(offset, like(behind, -1.0))
    along, beside = dot(here, forward), lateral(here, forward)
    square = dot(beside, beside)
    in_the_way = (along > o) & (along < ahead) & (square < aside * aside)
    out = select(square > like(behind, 1e-20), unit(beside), perpendicular(forward))
    evasion = sub(scale(out, max_speed), lateral(velocity, forward))
    place = scale(axis(offset, 0), -behind)
    return select(in_the_way, evasion, keep_station(offset, velocity, leader_velocity, place, max_speed, slow_radius))


@law
def interpose(
    offset_a: Vec,
    velocity_a: Vec,
    offset_b: Vec,
    velocity_b: Vec,
    velocity: Vec,
    share: float,
    max_speed: float,
    slow_radius: float,
) -> Vec:
    """Arrive between two others: at the predicted point a fraction `share` from a to b (Reynolds 1999).

    offset_a, offset_b: to the two others, m; velocity_a, velocity_b: theirs, m/s; velocity: of the agent, m/s; share: 0
    to 1; max_speed: V, m/s; slow_radius: m, as of `arrive`.

    Both are extrapolated over the time to get between them at full speed.
    """
    now = add(offset_a, scale(sub(offset_b, offset_a), share))
    moving = add(velocity_a, scale(sub(velocity_b, velocity_a), share))
    time = norm(now) / max_speed
    return arrive(add(now, scale(moving, time)), velocity, max_speed, slow_radius)


@law
def shadow(
    offset: Vec, velocity: Vec, quarry_velocity: Vec, max_speed: float, distance: float, band: float, time: float
) -> Vec:
    """Pursue beyond `distance` + `band` [m], match speed and heading within `distance`, and mix both in between.

    offset: to the quarry, m; velocity: of the agent, m/s; quarry_velocity: m/s; max_speed: V, m/s; time: s, which a
    predictor returns.

    The shares change linearly over the band. Reynolds 1999 switches, which would need hysteresis and so a memory.
    """
    o, e = like(band, 0.0), like(band, 1.0)
    share = min(max((norm(offset) - distance) / band, o), e)
    nearer = scale(pursue(offset, velocity, quarry_velocity, max_speed, time), share)
    return add(nearer, scale(match_velocity(velocity, quarry_velocity), e - share))


@law
def hiding_place(offset: Vec, radius: float, margin: float, threat: Vec) -> Vec:
    """Return the offset [m] of the place behind a round obstacle, `margin` [m] from it, hidden from a threat.

    h = c + (radius + margin) unit(c - x_threat); `offset` leads to the obstacle's centre c, `threat` to the seeker.
    """
    return add(offset, scale(unit(sub(offset, threat)), radius + margin))
