"""Social forces between pedestrians, and between pedestrians and walls, as accelerations or as shares.

Sources: Helbing and Molnar 1995 (Phys. Rev. E 51:4282); Helbing, Farkas and Vicsek 2000 (Nature 407:487); Johansson,
Helbing and Shukla 2007 (arXiv 0810.4587); Moussaid et al. 2009 (Proc. R. Soc. B 276:2755), 2010 (PLoS ONE 5:e10047) and
2011 (PNAS 108:6884). docs/social_forces.md has their values, and the differences between them.

`offset` is always other minus self: repulsion acts along -offset. `aim` is the unit vector of the desired
direction. `tie` is a unit vector, opposite for the other agent, along which two agents in one place part.
"""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.approximations import atan2, exp
from flockenv.maths.vectors import add, cross, dot, lateral, norm, perpendicular, scale, select, sub, unit
from flockenv.steering.others import ONE_PLACE

__all__ = [
    "attraction",
    "collision_distance",
    "cone_weight",
    "elliptical_direction",
    "elliptical_repulsion",
    "gaze_direction",
    "gaze_turn",
    "repulsion",
    "sidestep",
    "unit_away",
    "view_weight",
]

NO_SIDE = 1e-14
"""Squared length below which the sum of two nearly opposite directions is only rounding."""


@law
def gaze_direction(aim: Vec, heading: Vec) -> Vec:
    """Return the direction in which an agent looks: its aim, else its velocity; 0 if it has neither.

    aim: the desired direction, or 0; heading: the unit vector of the velocity, or 0.

    The length is arbitrary: laws use the direction alone.
    """
    return select(dot(aim, aim) > like(aim[0], 0.0), aim, heading)


@law
def view_weight(direction: Vec, offset: Vec, least: float) -> float:
    """Return lambda + (1 - lambda)(1 + cos phi) / 2: 1 straight ahead, lambda behind.

    least: lambda, 0 to 1.

    phi lies between `direction` and `offset`, which leads to the other (Johansson, Helbing and Shukla 2007: cos phi is
    -n . e with n from the other to me). Without a direction, or if both are in one place, it is 1.
    """
    e, half = like(least, 1.0), like(least, 0.5)
    long = dot(offset, offset) * dot(direction, direction)
    known = long > like(least, 0.0)
    cosine = dot(direction, offset) / np.sqrt(long) if known else e
    return least + (e - least) * half * (e + cosine)


@law
def cone_weight(direction: Vec, force: Vec, cosine: float, outside: float) -> float:
    """Return 1 if the source of a repulsive `force` is within the field of view, else `outside`; 1 without a direction.

    direction: e, a unit vector, or 0; cosine: cos phi; outside: c, 0 to 1.

    w = 1 if e . (-f) >= |f| cos phi, else c; 2 phi is the full angle (Helbing and Molnar 1995, equation 8).
    """
    ahead, square = -dot(direction, force), dot(direction, direction)
    seen = (ahead >= np.sqrt(dot(force, force) * square) * cosine) | (square <= like(cosine, 0.0))
    return like(cosine, 1.0) if seen else outside


@law
def unit_away(offset: Vec, tie: Vec) -> tuple[Vec, float]:
    """Return the unit vector away from the other, or the tie if both are in one place, and the distance, m."""
    square = dot(offset, offset)
    apart = square > like(square, ONE_PLACE)
    away = select(apart, scale(offset, like(square, -1.0)), tie)
    long = dot(away, away)
    length = np.sqrt(long)
    o, e = like(square, 0.0), like(square, 1.0)
    return scale(away, e / length if long > o else o), length if apart else o


@law
def repulsion(offset: Vec, tie: Vec, size: float, decay: float) -> Vec:
    """Return exp((size - d) / B) away from the other; `size` is the sum of both radii, or 0 (of distances alone).

    offset: to the other, m; tie: the direction for two in one place; decay: B, m.

    Helbing, Farkas and Vicsek 2000; the circular specification of Johansson, Helbing and Shukla 2007.
    """
    away, distance = unit_away(offset, tie)
    return scale(away, exp((size - distance) / decay))


@law
def elliptical_repulsion(offset: Vec, step: Vec, tie: Vec, decay: float) -> Vec:
    """Return -B grad exp(-b / B), away from the other and from the end of its `step` y; times A: an acceleration.

    offset: to the other, m; tie: a unit vector; decay: B, m.

    b = sqrt((|d| + |d - y|)^2 - |y|^2) / 2 is the smaller half axis of the ellipse through this agent i with foci at
    the other agent j and at the end of its step, d from j to i. y is the step of j, v_j dt (Helbing and Molnar 1995;
    elliptical I of Johansson et al. 2007), or relative to i, (v_j - v_i) dt (elliptical II). Without cancellation: b =
    sqrt(p q) |u + w| / 2 and grad b = (p + q) / (2 sqrt(p q)) unit(u + w), with p u = d and q w = d - y.

    If i stands on the step of j, it has no direction, and it grows as 1 / sqrt(q) at the end of the step: the direction
    is then the tie, and (p + q) / (2 sqrt(p q)) is at most 500.
    """
    out, size = elliptical_direction(offset, step, tie, decay)
    return scale(out, size)


@law
def elliptical_direction(offset: Vec, step: Vec, tie: Vec, decay: float) -> tuple[Vec, float]:
    """Return direction and size of `elliptical_repulsion`."""
    o, e, half = like(decay, 0.0), like(decay, 1.0), like(decay, 0.5)
    d = scale(offset, -e)
    ahead = sub(d, step)
    p, q = norm(d), norm(ahead)
    sides = add(unit(d), unit(ahead))
    square = dot(sides, sides)
    mean = np.sqrt(p * q)
    b = half * mean * np.sqrt(square)
    floor = like(decay, 1e-3) * (p + q)
    ratio = half * (p + q) / (mean if mean > floor else floor)
    across = lateral(tie, unit(step))
    there = p * p > like(decay, ONE_PLACE)
    out = select(square > like(decay, NO_SIDE), unit(sides), unit(across))
    # in one place, without a direction, it is as strong as without a step
    return select(there, out, unit(tie)), (ratio if there else e) * exp(-(b if there else o) / decay)


@law
def sidestep(
    offset: Vec, velocity: Vec, other_velocity: Vec, tie: Vec,
    importance: float, gamma: float, angular: float, forward: float, bias: float,
) -> Vec:  # fmt: skip
    """Slow down before a neighbour and turn to one side of it; times A: an acceleration.

    offset: to the neighbour j, m; velocity: v_i, m/s; other_velocity: v_j, m/s; tie: the direction e for two in one
    place.

    D = lambda (v_i - v_j) + e, with e from i to j, t = unit(D), B = gamma |D|; theta is the angle from t to e in
    (-pi, pi], positive if j is to the left of t; -exp(-d / B - (n' B theta)^2) along t, and away from the side of j,
    exp(-d / B - (n B theta)^2) across it. The side bias theta + B eps, wrapped again, selects the right if j is dead
    ahead (Moussaid et al. 2009, equations 4 to 7). In 3-D the turn is in the plane of t and e (ours).

    importance: lambda, s/m; gamma: s (B = gamma |D| m); angular: n; forward: n'; bias: eps.
    """
    o, e = like(gamma, 0.0), like(gamma, 1.0)
    square = dot(offset, offset)
    distance = np.sqrt(square)
    towards = unit(select(square > like(square, ONE_PLACE), offset, tie))
    d = add(scale(sub(velocity, other_velocity), importance), towards)
    t, size = unit(d), norm(d)
    least = like(gamma, 1e-6)
    b = gamma * size
    b = b if b > least else least
    side, theta = _side_and_angle(towards, t)
    theta = theta + b * bias
    pi = like(gamma, np.pi)
    theta = theta - (pi + pi) if theta > pi else theta
    turn, slow = angular * b * theta, forward * b * theta
    near = distance / b
    sign = e if theta > o else (-e if theta < o else o)
    along, across = -exp(-near - slow * slow), -sign * exp(-near - turn * turn)
    return add(scale(t, along), scale(side, across))


@law
def _side_and_angle(towards: Vec, t: Vec) -> tuple[Vec, float]:
    """Return a unit vector across t and the angle from t towards it: to the left in 2-D, to the other's side in 3-D.

    In 3-D a neighbour dead ahead, or any if t is 0, counts as left, so that it is passed on the right.
    """
    if len(t) == 2:
        left: Vec = (-t[1], t[0])
        return left, atan2(dot(left, towards), dot(t, towards))
    else:
        aside = lateral(towards, t)
        noise = like(t[0], NO_SIDE)
        side = select(dot(aside, aside) > noise, unit(aside), scale(perpendicular(t), like(t[0], -1.0)))
        return side, atan2(dot(side, towards), dot(t, towards))


@law
def attraction(offset: Vec, decay: float) -> Vec:
    """Return exp(-d / B) towards a place; times A it is the pull of a potential that grows to A B far away.

    offset: to the place, m; d is its length; decay: B, m.

    Helbing and Molnar 1995 have such a potential, W(d, t), without a formula; this one is ours.
    """
    return scale(unit(offset), exp(-norm(offset) / decay))


@law
def gaze_turn(heading: Vec, offset: Vec, half: float) -> float:
    """Return the angle by which the head must turn to see what is at `offset`, rad: the part beyond `half` the view.

    heading: the unit vector of the direction in which the agent looks, or 0; half: half the field of view, rad.

    Moussaid et al. 2010, alpha of the gaze; 0 at standstill.
    """
    o = like(half, 0.0)
    if len(offset) == 2:
        turn = heading[0] * offset[1] - heading[1] * offset[0]
        aside = abs(turn)
    else:
        aside = norm(cross(heading, offset))
    angle = atan2(aside, dot(heading, offset)) - half
    return angle if (angle > o) & (dot(heading, heading) > o) else o


@law
def collision_distance(direction: Vec, offset: Vec, other_velocity: Vec, clearance: float, speed: float) -> float:
    """Return the free distance along a unit vector at `speed` until contact with a moving neighbour, m; or inf.

    direction: the unit vector e; offset: to the neighbour, m; other_velocity: its velocity, m/s; clearance: the sum of
    both radii, m; speed: v, m/s.

    The smallest t >= 0 with |x_j + v_j t - v t e| = clearance, times v; e the direction (f(alpha) of Moussaid, Helbing
    and Theraulaz 2011); 0 for two that overlap and approach.
    """
    o, far = like(speed, 0.0), like(speed, np.inf)
    closing = sub(scale(direction, speed), other_velocity)
    a, b, c = dot(closing, closing), dot(offset, closing), dot(offset, offset) - clearance * clearance
    room = b * b - a * c
    meets = (b > o) & (room >= o)
    below = b + np.sqrt(room if room > o else o)
    time = c / (below if below > o else like(speed, 1.0))
    return speed * (time if time > o else o) if meets else far
