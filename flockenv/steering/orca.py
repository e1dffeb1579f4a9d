"""Optimal reciprocal collision avoidance (ORCA) in a plane: the collision-free velocity nearest to the desired one.

Each neighbour forbids a half-plane of velocities, and both agents take their share of the change: if both keep to it,
they do not touch within the horizon. The velocity nearest to the desired one within all half-planes and the speed limit
is a linear programme with a round bound, solved line by line. If no velocity is allowed, the least forbidden is taken.

Source: van den Berg, Guy, Lin, Manocha, "Reciprocal n-Body Collision Avoidance" (ISRR 2009, Springer 2011,
doi 10.1007/978-3-642-19457-3_1), sections 4 and 5. A half-plane is (normal, bound) here: normal . v >= bound.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.jit.decorators import Numbers, Vec, law, like
from flockenv.jit.intrinsics import tuple_as_array
from flockenv.maths.vectors import add, axis, dot, limit, norm, scale, select, sub, unit

__all__ = ["SLOT", "half_plane", "orca", "orca_change"]

SLOT = 6
"""Numbers of one neighbour in `orca`: offset (2) m, velocity (2) m/s, radius m (< 0: empty slot), share."""

_PARALLEL = 1e-6  # sine below which two lines count as parallel
_SLACK = 1e-5  # m/s by which parallel lines may contradict each other, from rounding


@law
def half_plane(
    velocity: Vec, offset: Vec, other_velocity: Vec, clearance: float, share: float, horizon: float, step: float
) -> Vec:
    """Return (n_x, n_y, bound): velocities with n . v >= bound do not lead to a touch within `horizon` [s].

    `clearance` [m] is the sum of both radii, `share` this agent's part of the change: 1/2 for a neighbour
    that does the same, 1 for one that does not give way. Agents that overlap part within `step` [s]. Head-on, both
    keep right.
    """
    o, e = like(clearance, 0.0), like(clearance, 1.0)
    relative, square, contact = sub(velocity, other_velocity), dot(offset, offset), clearance * clearance
    apart = square > contact
    time = horizon if apart else step
    w = sub(relative, scale(offset, e / time))  # from the centre of the round end of the forbidden cone
    back = dot(w, offset)
    at_end = (not apart) | ((back < o) & (back * back > contact * dot(w, w)))
    out = select(dot(w, w) > o, unit(w), scale(unit(offset), -e))
    out = select(dot(out, out) > o, out, axis(offset, 0))
    side = e if offset[0] * w[1] - offset[1] * w[0] > o else -e  # of the cone: 1 = its left
    leg = np.sqrt(square - contact if apart else o)
    per_square = e / square if apart else o
    edge = scale(
        (offset[0] * leg - side * offset[1] * clearance, offset[1] * leg + side * offset[0] * clearance), per_square
    )
    across = (-side * edge[1], side * edge[0])
    normal = select(at_end, out, across)
    lack = clearance / time - norm(w) if at_end else -dot(relative, across)
    return (normal[0], normal[1], dot(normal, velocity) + share * lack)


@law
def _best_on_line(lines: Any, count: int, normal: Vec, bound: float, desired: Vec, top: float, outward: bool) -> Any:
    """Return if a part of a line is within the first `count` half-planes and the speed limit, and its best point.

    The best is nearest to the desired velocity or, if `outward`, furthest in its direction.
    """
    o, little = like(bound, 0.0), like(bound, _PARALLEL)
    along, base = (normal[1], -normal[0]), scale(normal, bound)
    room = top * top - bound * bound
    high = np.sqrt(room if room > o else o)
    low, fits = -high, room >= o
    for j in range(count):
        other = (lines[3 * j], lines[3 * j + 1])
        slope, lack = dot(other, along), lines[3 * j + 2] - dot(other, base)
        if abs(slope) <= little:
            fits = fits & (lack <= like(bound, _SLACK))
        elif slope > o:
            low = max(low, lack / slope)
        else:
            high = min(high, lack / slope)
    best = dot(desired, along)
    end = high if best > o else low
    t = end if outward else min(max(best, low), high)
    return fits & (low <= high), add(base, scale(along, t))


@law
def _nearest_velocity(lines: Any, count: int, desired: Vec, top: float, outward: bool) -> Any:
    """Return the number of half-planes kept, up to the first that cannot be kept, and the velocity."""
    found = scale(desired, top) if outward else limit(desired, top)
    for i in range(count):
        normal, bound = (lines[3 * i], lines[3 * i + 1]), lines[3 * i + 2]
        if dot(normal, found) < bound:
            fits, better = _best_on_line(lines, i, normal, bound, desired, top, outward)
            if not fits:
                return i, found
            found = better
    return count, found


@law
def _least_violation(lines: Any, count: int, hard: int, kept: int, found: Vec, top: float, relaxed: Any) -> Vec:
    """Return the velocity whose worst violation is least: all soft half-planes recede equally until it is allowed.

    The first `hard` half-planes recede only if they alone allow no velocity.
    """
    worst = like(top, 0.0)
    for i in range(kept, count):
        normal, bound = (lines[3 * i], lines[3 * i + 1]), lines[3 * i + 2]
        if bound - dot(normal, found) > worst:
            m = 0
            for j in range(i):
                stays = (j < hard) & (i >= hard)
                other, limit_ = (lines[3 * j], lines[3 * j + 1]), lines[3 * j + 2]
                apart = other if stays else sub(other, normal)  # where j is violated at most as much as i
                length = norm(apart)
                if length > like(top, _PARALLEL):
                    relaxed[3 * m], relaxed[3 * m + 1] = apart[0] / length, apart[1] / length
                    relaxed[3 * m + 2] = (limit_ if stays else limit_ - bound) / length
                    m += 1
            all_kept, better = _nearest_velocity(relaxed, m, normal, top, True)
            if all_kept == m:  # otherwise rounding prevents an improvement
                found = better
            worst = bound - dot(normal, found)
    return found


@law
def orca(
    velocity: Vec, desired: Vec, radius: float, max_speed: float, horizon: float, step: float, turn: float,
    neighbours: Numbers,
) -> Vec:  # fmt: skip
    """Take on the velocity nearest to the desired one that keeps clear of neighbours for `horizon` s: S, m/s.

    `neighbours` holds SLOT numbers of each. Half-planes of neighbours with share 1 (obstacles, agents that do not give
    way) are never relaxed in favour of others. A desired velocity that is not free is turned right by `turn` [rad], so
    that symmetric encounters do not stop; a free one is returned as it is, up to `max_speed`.
    """
    given, lines, relaxed = tuple_as_array(neighbours), tuple_as_array(neighbours), tuple_as_array(neighbours)
    request = (desired, max_speed, turn)
    return orca_change(velocity, radius, request, horizon, step, given, len(neighbours) // SLOT, lines, relaxed)


@law
def orca_change(
    velocity: Vec, radius: float, request: Any, horizon: float, step: float, given: Any, slots: int, lines: Any,
    relaxed: Any,
) -> Vec:  # fmt: skip
    """Return the same as `orca`, for `slots` neighbours in an array.

    request: (desired, max_speed, turn); lines, relaxed: scratch.
    """
    desired, max_speed, turn = request
    count, hard, free = 0, 0, True
    for soft in range(2):
        for k in range(slots):
            at = SLOT * k
            if given[at + 4] >= like(radius, 0.0) and (given[at + 5] < like(radius, 1.0)) == (soft == 1):
                offset, other = (given[at], given[at + 1]), (given[at + 2], given[at + 3])
                line = half_plane(velocity, offset, other, radius + given[at + 4], given[at + 5], horizon, step)
                lines[3 * count], lines[3 * count + 1], lines[3 * count + 2] = line[0], line[1], line[2]
                free = free & (line[0] * desired[0] + line[1] * desired[1] >= line[2])
                count += 1
        hard = hard if soft == 1 else count
    aside = like(radius, 0.0) if free else turn
    turned = (desired[0] + aside * desired[1], desired[1] - aside * desired[0])
    kept, found = _nearest_velocity(lines, count, turned, max_speed, False)
    if kept < count:
        found = _least_violation(lines, count, hard, kept, found, max_speed, relaxed)
    return sub(found, velocity)
