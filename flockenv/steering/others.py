"""What an agent wants about others: where a quarry will be, to meet it, to keep off, to stay with neighbours."""

from __future__ import annotations

import numpy as np

from flockenv.kernels import Vec, law, like
from flockenv.steering.goals import flee, seek
from flockenv.vec import add, dot, norm, scale, select, sub, zero

__all__ = ["align", "cohere", "distance_time", "evade", "interception_time", "pursue", "separate"]


@law
def distance_time(offset: Vec, max_speed: float, factor: float) -> float:
    """Predict by distance: T = factor |offset| / V, s. The simplest predictor of Reynolds 1999."""
    return factor * norm(offset) / max_speed


@law
def interception_time(offset: Vec, quarry_velocity: Vec, max_speed: float) -> float:
    """Predict exactly: the first time at which a pursuer at full speed V can meet the quarry, s.

    Smallest t > 0 of (w.w - V^2) t^2 + 2 p.w t + p.p = 0 with p = offset, w = quarry velocity, in the form that does
    not cancel; |p|/V where no interception exists.
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
def pursue(offset: Vec, velocity: Vec, quarry_velocity: Vec, max_speed: float, time: float) -> Vec:
    """Seek where the quarry will be after `time` [s], as a predictor says (Reynolds 1999)."""
    return seek(add(offset, scale(quarry_velocity, time)), velocity, max_speed)


@law
def evade(offset: Vec, velocity: Vec, pursuer_velocity: Vec, max_speed: float, time: float) -> Vec:
    """Flee from where the pursuer will be after `time` [s] (Reynolds 1999)."""
    return flee(add(offset, scale(pursuer_velocity, time)), velocity, max_speed)


@law
def separate(offset: Vec, tie: Vec) -> Vec:
    """One neighbour's push: away from it, weighted 1/distance, 1/m (Reynolds 1999). Sum over neighbours.

    `tie` is the direction to take where the two coincide, a unit vector that is opposite for the other one.
    """
    square = dot(offset, offset)
    apart = square > like(square, 1e-30)  # nearer than 1e-15 m is one place: 1/square must not overflow, in float32 too
    return select(apart, scale(offset, like(square, -1.0) / square), tie)


@law
def align(velocity: Vec, mean_velocity: Vec) -> Vec:
    """Take on the neighbours' mean velocity: S = mean(v_j) - v, m/s (Reynolds 1999: the average, not the sum)."""
    return sub(mean_velocity, velocity)


@law
def cohere(mean_offset: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Seek the neighbours' centre, at `mean_offset` [m] (Reynolds 1999). Without offset there is nothing to seek."""
    some = dot(mean_offset, mean_offset) > like(max_speed, 0.0)
    return select(some, seek(mean_offset, velocity, max_speed), zero(velocity))
