"""The bodies of one world during a step, their possible contacts, and their positions at any time of the step."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import Vec, kernel, routine
from flockenv.maths.vectors import add, norm, scale, sub
from flockenv.physics.constraints.broad_phase import balls_overlap, nearest_image, vector_at, write_vector
from flockenv.physics.constraints.impact import POINT, parabola_of, position_along

__all__ = [
    "ANEW",
    "DEEP",
    "GIVEN_UP",
    "RESTS",
    "STOPPED",
    "Bodies",
    "Meetings",
    "Rules",
    "Things",
    "add_to_lists",
    "contact_row",
    "larger_acceleration",
    "position",
    "relative_motion",
    "set_parabola",
    "velocity",
    "widen_reach",
    "width",
]  # fmt: skip

ANEW = 4
"""Number of times that two bodies at rest may be driven together again within one step."""

DEEP = 0.05
"""Overlap of two bodies that is allowed, as a fraction of a radius."""

RESTS = 1
"""Meetings.closed: the two are at rest relative to each other."""

GIVEN_UP = 2
"""Meetings.closed: the meeting is no longer searched in this step."""

STOPPED = 2
"""Bodies.moved: the body does not move for the rest of the step, unless an obstacle pushes it."""


class Bodies(NamedTuple):
    """The bodies of one world during a step; arrays of N rows."""

    start: Any  # (N, D) m, position at the beginning of the step
    at: Any  # (N, D) m, position at time `since`
    vel: Any  # (N, D) m/s, velocity at time `since`
    acc: Any  # (N, D) m/s^2, acceleration from `since` on
    free: Any  # (N, D) m/s^2, acceleration without contacts
    excess: Any  # (N, D) m/s, the method's velocity less that of the parabola; if stopped, the stored velocity
    since: Any  # (N,) s, from the beginning of the step
    reach: Any  # (N,) m, bound of the distance from the start
    radius: Any  # (N,) m
    light: Any  # (N,) 1/kg, 0 = held in place
    living: Any  # (N,) 1 or 0
    moved: Any  # (N,) 1 if an impact or contact has changed its path; or STOPPED
    leans: Any  # (N,) 1 if it has come to rest on another body in this step
    first: Any  # (N,) its last meeting, 2 c + side; -1 if it has none


class Meetings(NamedTuple):
    """Pairs of bodies, or of a body and an obstacle, that may touch; the length of the arrays is the capacity."""

    who: Any  # a body
    other: Any  # another body, or -1 - m for obstacle m
    time: Any  # s, time of the impact; inf = never
    hits: Any  # number of impacts so far
    closed: Any  # within this step: 0, RESTS or GIVEN_UP
    deep: Any  # m, how far the two may overlap before they stop
    following: Any  # (2, places) the next meeting of the same body, as in Bodies.first
    listed: Any  # 1 = among the active
    active: Any  # meetings with a time, and some that no longer have one
    todo: Any  # (2 places,) meetings whose time is to be computed
    near: Any  # (2, places) pairs found by the grid of obstacles, as numbers, and their order


class Things(NamedTuple):
    """The obstacles of one world; arrays of M rows."""

    table: Any  # the table of shapes, see flockenv/geometry/shapes/table.py
    row: Any  # (M,) its row in the table; impact.POINT = a disc or ball of radius `size`
    anchor: Any  # (M, D) m, origin of its row, before it has moved
    place: Any  # (M, D) m, that origin at the beginning of the step
    drift: Any  # (M, D) m/s, its velocity in this step
    size: Any  # (M,) m, radius of a disc or ball, 0 for other shapes; negative = absent
    restitution: Any  # (M,) of its surface
    moving: Any  # (K,) the obstacles that move
    cells: Any  # the grid over all obstacles, see flockenv/geometry/shapes/cells.py
    listed: Any  # (1,) 1 if the grid holds: there is one, and the round obstacles are where the scene has them


class Rules(NamedTuple):
    """Parameters of impacts and of the end of a step."""

    seconds: float  # of the step
    restitution: float
    friction: float
    sticky: bool
    most: int  # impacts of a body and an obstacle in one step
    again: int  # impacts of the same two bodies in one step
    touch: float  # m, gap at and below which two touch
    pairs: bool  # True if bodies collide with each other
    stops: bool  # True if there are no impacts, and bodies stop at contact


@kernel
def width(bodies: Bodies, i: int, j: int) -> float:
    """Return the smaller radius of two bodies, or that of the body if j is an obstacle, m."""
    return float(bodies.radius[i] if j < 0 else min(bodies.radius[i], bodies.radius[j]))


@kernel
def position(period: Vec, bodies: Bodies, i: int, t: float) -> Vec:
    """Return the position of body i at time t of the step, m."""
    s = t - bodies.since[i]
    return position_along(
        vector_at(period, bodies.at, i), vector_at(period, bodies.vel, i), vector_at(period, bodies.acc, i), s
    )


@kernel
def velocity(period: Vec, bodies: Bodies, i: int, t: float) -> Vec:
    """Return the velocity of body i at time t of the step, m/s."""
    return add(vector_at(period, bodies.vel, i), scale(vector_at(period, bodies.acc, i), t - bodies.since[i]))


@kernel
def set_parabola(period: Vec, bodies: Bodies, i: int, seconds: float, moved: Vec, before: Vec, after: Vec) -> None:
    """Set up the parabola of body i for a step that moved it by `moved` m and changed its velocity."""
    v, a, excess = parabola_of(seconds, moved, before, after)
    write_vector(bodies.vel, i, v)
    write_vector(bodies.acc, i, a)
    write_vector(bodies.free, i, a)
    write_vector(bodies.excess, i, excess)
    bodies.since[i] = 0.0
    bodies.moved[i], bodies.leans[i], bodies.first[i] = 0, 0, -1
    bodies.reach[i] = (norm(v) + 0.5 * norm(a) * seconds) * seconds


@kernel
def add_to_lists(bodies: Bodies, meetings: Meetings, c: int) -> None:
    """Initialise a new meeting, and add it to the lists of its bodies."""
    i, j = meetings.who[c], meetings.other[c]
    meetings.hits[c], meetings.closed[c], meetings.listed[c], meetings.time[c] = 0, 0, 0, np.inf
    meetings.deep[c] = 0.0
    meetings.following[0, c] = bodies.first[i]
    bodies.first[i] = 2 * c
    if j >= 0:
        meetings.following[1, c] = bodies.first[j]
        bodies.first[j] = 2 * c + 1


@kernel
def relative_motion(period: Vec, bodies: Bodies, things: Things, i: int, j: int, t: float) -> tuple[Vec, Vec, Vec]:
    """Return position, velocity and acceleration of body i relative to body j or obstacle -1 - j, at time t."""
    x, v, a = position(period, bodies, i, t), velocity(period, bodies, i, t), vector_at(period, bodies.acc, i)
    if j >= 0:
        x, v = sub(x, position(period, bodies, j, t)), sub(v, velocity(period, bodies, j, t))
        a = sub(a, vector_at(period, bodies.acc, j))
    else:
        drift = vector_at(period, things.drift, -1 - j)
        x, v = sub(x, add(vector_at(period, things.place, -1 - j), scale(drift, t))), sub(v, drift)
    return nearest_image(period, x), v, a


@kernel
def contact_row(bodies: Bodies, things: Things, i: int, j: int) -> tuple[int, float]:
    """Return the row of the shape that body i may touch, and the distance of its centre at contact, m."""
    if j >= 0:
        return POINT, bodies.radius[i] + bodies.radius[j]
    return things.row[-1 - j], bodies.radius[i] + things.size[-1 - j]


@kernel
def larger_acceleration(period: Vec, bodies: Bodies, i: int, j: int) -> float:
    """Return the larger free acceleration of two bodies, or that of the body if j is an obstacle, m/s^2."""
    hard = norm(vector_at(period, bodies.free, i))
    return float(max(hard, norm(vector_at(period, bodies.free, j))) if j >= 0 else hard)


@routine
def widen_reach(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, i: int, t: float, count: int
) -> int:
    """Enlarge the reach of body i if it may now go further, and add new meetings; return the number of meetings."""
    d = nearest_image(period, sub(position(period, bodies, i, t), vector_at(period, bodies.start, i)))
    left = rules.seconds - t
    v, a = vector_at(period, bodies.vel, i), vector_at(period, bodies.acc, i)
    reach = norm(d) + (norm(v) + 0.5 * norm(a) * left) * left
    if reach <= bodies.reach[i]:
        return count
    bodies.reach[i] = 1.5 * reach
    for m in range(things.row.shape[0]):
        if things.size[m] >= 0.0:
            count = _add_meeting(bodies, meetings, i, -1 - m, count)
    for j in range(bodies.living.shape[0]):
        here = rules.pairs and bodies.living[j] > 0 and j != i and bodies.light[i] + bodies.light[j] > 0.0
        if here and balls_overlap(period, bodies.start, bodies.radius, bodies.reach, i, j):
            count = _add_meeting(bodies, meetings, i, j, count)
    return count


@kernel
def _add_meeting(bodies: Bodies, meetings: Meetings, i: int, j: int, count: int) -> int:
    """Add the meeting of body i with body j, or obstacle -1 - j, if it is not listed; return the number of meetings."""
    who, other = (i, j) if j < 0 else (min(i, j), max(i, j))
    place = bodies.first[i]
    while place >= 0:
        c = place // 2
        if meetings.who[c] == who and meetings.other[c] == other:
            return count
        place = meetings.following[place % 2, c]
    if count < meetings.who.shape[0]:
        meetings.who[count], meetings.other[count] = who, other
        add_to_lists(bodies, meetings, count)
    return count + 1
