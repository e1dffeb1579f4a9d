"""Impacts of one world within one step, one after another in the order of time.

Everybody flies along the parabola that the method has made of the step. The earliest impact of all is found, what it
does to those two is done, and their further ways are looked at anew: so a ball that has passed its momentum on meets
nobody whom it would not meet. Who would bounce for ever (a ball that comes to rest in ever smaller hops) is at rest at
the end of the series, if that lies within the step; from then on the surface carries it: what pushes it into the
surface is cancelled, and friction acts along it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.constraints.broad import image, near, vector, write
from flockenv.constraints.impact import POINT, along, bounced, ends_here, first_impact, flight, rubbed, surface
from flockenv.kernels import Vec, kernel
from flockenv.vec import add, dot, norm, scale, sub, unit

__all__ = ["Bodies", "Meetings", "Rules", "Things", "link", "play", "take_off"]


OBLIQUE = 0.6180339887498949
"""An axis in no special direction: coordinates weigh 1, this, and its square."""

ANEW = 4
"""How often two elastic bodies may come to rest in one step, and be driven into each other again."""


class Bodies(NamedTuple):
    """The bodies of one world on their way through a step; arrays of N rows."""

    start: Any  # (N, D) m, at the beginning of the step
    at: Any  # (N, D) m, at time `since`
    vel: Any  # (N, D) m/s, then
    acc: Any  # (N, D) m/s^2, from then on
    free: Any  # (N, D) m/s^2, where nothing carries it
    excess: Any  # (N, D) m/s, what the method calls velocity beyond that of the parabola
    since: Any  # (N,) s, from the beginning of the step
    reach: Any  # (N,) m, how far from the start it may come
    radius: Any  # (N,) m
    light: Any  # (N,) 1/kg, 0 = held in place
    living: Any  # (N,) 1 or 0
    moved: Any  # (N,) 1 if something has happened to it
    first: Any  # (N,) its last meeting, 2 c + side; -1 = none


class Meetings(NamedTuple):
    """Who may meet what; arrays of as many places as there is room for."""

    who: Any  # a body
    other: Any  # another body, or -1 - m for obstacle m
    time: Any  # s, when; inf = never
    hits: Any  # how often they have
    closed: Any  # within this step: 1 = they are at rest, 2 = they are not looked at any more
    following: Any  # (2, places) the next meeting of the same body, as in Bodies.first
    listed: Any  # 1 = among the active
    active: Any  # meetings that have a time, and some that have none any more
    todo: Any  # (2 places,) meetings whose time is to be found


class Things(NamedTuple):
    """The obstacles of one world; arrays of M rows."""

    table: Any  # their numbers, see flockenv/shapes/table.py
    row: Any  # (M,) where in the table; impact.POINT = it is round, and `size` says how large
    anchor: Any  # (M, D) m, what its row is relative to, before it has moved
    place: Any  # (M, D) m, where that is at the beginning of the step
    drift: Any  # (M, D) m/s, how fast it moves in this step
    size: Any  # (M,) m, the radius of what is round, 0 of others; negative = it is not there
    restitution: Any  # (M,) of its surface


class Rules(NamedTuple):
    """What happens at an impact."""

    seconds: float  # of the step
    restitution: float
    friction: float
    sticky: bool
    most: int  # impacts of the same two in one step
    anew: bool  # are further ways looked at anew after an impact?
    touch: float  # m, two that are this near touch
    pairs: bool  # do bodies meet each other at all?


@kernel
def _position(period: Vec, bodies: Bodies, i: int, t: float) -> Vec:
    s = t - bodies.since[i]
    return along(vector(period, bodies.at, i), vector(period, bodies.vel, i), vector(period, bodies.acc, i), s)


@kernel
def _velocity(period: Vec, bodies: Bodies, i: int, t: float) -> Vec:
    return add(vector(period, bodies.vel, i), scale(vector(period, bodies.acc, i), t - bodies.since[i]))


@kernel
def take_off(period: Vec, bodies: Bodies, i: int, seconds: float, moved: Vec, before: Vec, after: Vec) -> None:
    """Begin the way of body i through a step that led it `moved` m further and from one velocity to another."""
    v, a, excess = flight(seconds, moved, before, after)
    write(bodies.vel, i, v)
    write(bodies.acc, i, a)
    write(bodies.free, i, a)
    write(bodies.excess, i, excess)
    bodies.since[i] = 0.0
    bodies.moved[i] = 0
    bodies.first[i] = -1
    bodies.reach[i] = (norm(v) + 0.5 * norm(a) * seconds) * seconds


@kernel
def link(bodies: Bodies, meetings: Meetings, c: int) -> None:
    """Make a new meeting known to those who are part of it."""
    i, j = meetings.who[c], meetings.other[c]
    meetings.hits[c], meetings.closed[c], meetings.listed[c], meetings.time[c] = 0, 0, 0, np.inf
    meetings.following[0, c] = bodies.first[i]
    bodies.first[i] = 2 * c
    if j >= 0:
        meetings.following[1, c] = bodies.first[j]
        bodies.first[j] = 2 * c + 1


@kernel
def _relative(period: Vec, bodies: Bodies, things: Things, i: int, j: int, t: float) -> tuple[Vec, Vec, Vec]:
    """Return place, velocity and acceleration of body i as seen from body j or obstacle -1 - j, at time t."""
    x, v, a = _position(period, bodies, i, t), _velocity(period, bodies, i, t), vector(period, bodies.acc, i)
    if j >= 0:
        x, v = sub(x, _position(period, bodies, j, t)), sub(v, _velocity(period, bodies, j, t))
        a = sub(a, vector(period, bodies.acc, j))
    else:
        drift = vector(period, things.drift, -1 - j)
        x, v = sub(x, add(vector(period, things.place, -1 - j), scale(drift, t))), sub(v, drift)
    return image(period, x), v, a


@kernel
def _met(bodies: Bodies, things: Things, i: int, j: int) -> tuple[int, float]:
    """Return the row of what body i meets, and how near to it its centre comes."""
    if j >= 0:
        return POINT, bodies.radius[i] + bodies.radius[j]
    return things.row[-1 - j], bodies.radius[i] + things.size[-1 - j]


@kernel
def _together(period: Vec, bodies: Bodies, things: Things, i: int, j: int, touch: float, before: Any) -> None:
    """Let those who begin in touch with something begin with their velocities as they are, for the whole step.

    The half step by which a method of first order is ahead would take them into it, or away from it.
    """
    y, _, _ = _relative(period, bodies, things, i, j, 0.0)
    row, room = _met(bodies, things, i, j)
    if surface(things.table, row, y)[0] - room <= touch:
        _as_it_is(period, bodies, i, before)
        if j >= 0:
            _as_it_is(period, bodies, j, before)


@kernel
def _as_it_is(period: Vec, bodies: Bodies, i: int, before: Any) -> None:
    write(bodies.vel, i, vector(period, before, i))
    for k in range(len(period)):
        bodies.excess[i, k] = 0.0


@kernel
def play(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, count: int, before: Any
) -> tuple[int, int, int]:
    """Let everybody of one world fly through the step; return impacts, how many were cut short, and meetings in all.

    before (N, D) m/s: velocities at the beginning. More meetings than there is room for: the work is to be done anew.
    """
    for c in range(count):
        _together(period, bodies, things, meetings.who[c], meetings.other[c], rules.touch, before)
    todo, active, impacts, cut = count, 0, 0, 0
    for c in range(count):
        meetings.todo[c] = c
    while True:
        for k in range(todo):
            c = meetings.todo[k]
            active = _look(period, bodies, meetings, things, rules, c, active)
        best, active = _earliest(period, bodies, meetings, active)
        if best < 0:
            return impacts, cut, count
        impacts, when = impacts + 1, meetings.time[best]
        meetings.hits[best] += 1
        over = meetings.hits[best] % (rules.most + 1) == 0
        cut += 1 if over else 0
        _impact(period, bodies, meetings, things, rules, best, when, over)
        todo, meetings.time[best] = 0, np.inf
        anew = rules.anew or meetings.other[best] < 0 or meetings.closed[best] == 1  # who lies may still be hit
        for who in (meetings.who[best], meetings.other[best]):
            if who >= 0 and rules.anew:
                count = _widened(period, bodies, meetings, things, rules, who, when, count)
            if who >= 0:
                todo = _again(period, bodies, meetings, things, rules, who, when, anew, todo)
        if count > meetings.who.shape[0]:
            return impacts, cut, count


@kernel
def _earliest(period: Vec, bodies: Bodies, meetings: Meetings, active: int) -> tuple[int, int]:
    """Return the earliest meeting, -1 if there is none, and how many are active; those without a time are let go of."""
    best, k = -1, 0
    while k < active:
        c = meetings.active[k]
        if meetings.time[c] == np.inf:
            active -= 1
            meetings.listed[c] = 0
            meetings.active[k] = meetings.active[active]
            continue
        if best < 0 or meetings.time[c] < meetings.time[best]:
            best = c
        elif meetings.time[c] == meetings.time[best]:
            first = _height(period, bodies, meetings, c) < _height(period, bodies, meetings, best)
            best = c if first else best
        k += 1
    return best, active


@kernel
def _height(period: Vec, bodies: Bodies, meetings: Meetings, c: int) -> float:
    """Return a number by which meetings at the very same time are told apart, whatever the numbers of the bodies."""
    i, j = meetings.who[c], meetings.other[c]
    place, out = vector(period, bodies.start, i), 0.0
    if j >= 0:
        place = add(place, vector(period, bodies.start, j))
    for k in range(len(period)):
        out += place[k] * OBLIQUE**k
    return out


@kernel
def _look(period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, c: int, active: int) -> int:
    """Find when a meeting takes place; return how many have a time."""
    if meetings.closed[c] > 0:
        return active
    i, j = meetings.who[c], meetings.other[c]
    now = bodies.since[i] if j < 0 else max(bodies.since[i], bodies.since[j])
    y, v, a = _relative(period, bodies, things, i, j, now)
    row, room = _met(bodies, things, i, j)
    t = now + first_impact(things.table, row, y, v, a, rules.seconds - now, room, rules.touch)
    meetings.time[c] = t if t <= rules.seconds else np.inf
    if meetings.time[c] < np.inf and meetings.listed[c] == 0:
        meetings.active[active], meetings.listed[c] = c, 1
        active += 1
    return active


@kernel
def _again(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, i: int, t: float, anew: bool,
    todo: int,
) -> int:  # fmt: skip
    """List the meetings of body i to be looked at anew: all, or those with obstacles; then the others are over."""
    place = bodies.first[i]
    while place >= 0:
        c = place // 2
        if meetings.closed[c] == 1 and rules.anew and _hit_anew(period, bodies, meetings, things, rules, c, t):
            meetings.closed[c] = 0
        if anew or meetings.other[c] < 0:
            meetings.todo[todo] = c
            todo += 1
        else:
            meetings.closed[c] = 1 if meetings.closed[c] == 1 else 2
            meetings.time[c] = np.inf
        place = meetings.following[place % 2, c]
    return todo


@kernel
def _hit_anew(period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, c: int, t: float) -> bool:
    """Has a third one driven two elastic bodies into each other that came to rest, by more than the step itself does?

    They trembled too often; but what comes from outside they pass on. At most so often that a step has an end.
    """
    i, j = meetings.who[c], meetings.other[c]
    if j < 0 or rules.restitution < 1.0 or rules.sticky or meetings.hits[c] >= ANEW * (rules.most + 1):
        return False
    y, v, _ = _relative(period, bodies, things, i, j, t)
    hard = max(norm(vector(period, bodies.free, i)), norm(vector(period, bodies.free, j)))
    return bool(-dot(v, unit(y)) > hard * rules.seconds)


@kernel
def _impact(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, c: int, t: float, over: bool
) -> None:
    """Do what an impact does to those who take part; `over`: they have met too often, and are at rest from now on."""
    i, j = meetings.who[c], meetings.other[c]
    y, v, a = _relative(period, bodies, things, i, j, t)
    row, _ = _met(bodies, things, i, j)
    _, n = surface(things.table, row, y)
    left, push, w = rules.seconds - t, dot(a, n), -dot(v, n)
    restitution = rules.restitution if j >= 0 else things.restitution[-1 - j]
    rests = over or rules.sticky or ends_here(max(w, 0.0), push, restitution, left)
    if j >= 0 and restitution < 1.0:  # in a heap nobody is accelerated into his neighbour, and all are pressed together
        hard = max(norm(vector(period, bodies.free, i)), norm(vector(period, bodies.free, j)))
        rests = rests or w <= hard * rules.seconds
    change = sub(bounced(v, n, 0.0 if rests else restitution, rules.friction), v)
    if rules.sticky:
        change = scale(v, -1.0)
    if j >= 0:
        total = bodies.light[i] + bodies.light[j]
        share = bodies.light[i] / total if total > 0.0 else 0.0
        _go_on(period, bodies, i, t, scale(change, share))
        _go_on(period, bodies, j, t, scale(change, -(1.0 - share) if total > 0.0 else 0.0))
        if rests:
            meetings.closed[c] = 1
    else:
        _go_on(period, bodies, i, t, change if bodies.light[i] > 0.0 else scale(change, 0.0))
        if rests and bodies.light[i] > 0.0:
            _lie(period, bodies, things, rules, i, -1 - j, n, push, left)
            meetings.closed[c] = 1 if over else 0


@kernel
def _go_on(period: Vec, bodies: Bodies, i: int, t: float, change: Vec) -> None:
    """Change the velocity of body i at time t."""
    x, v = _position(period, bodies, i, t), _velocity(period, bodies, i, t)
    write(bodies.at, i, x)
    write(bodies.vel, i, add(v, change))
    write(bodies.acc, i, vector(period, bodies.free, i))
    bodies.since[i] = t
    bodies.moved[i] = 1


@kernel
def _lie(
    period: Vec, bodies: Bodies, things: Things, rules: Rules, i: int, m: int, n: Vec, push: float, left: float
) -> None:
    """Let obstacle m carry body i for the rest of the step: what pushes it in is cancelled, friction acts along it."""
    drift, a = vector(period, things.drift, m), vector(period, bodies.acc, i)
    side = sub(vector(period, bodies.vel, i), drift)
    if rules.sticky:
        write(bodies.acc, i, scale(a, 0.0))
        write(bodies.excess, i, scale(a, 0.0))
        return
    into = min(push, 0.0)
    a = sub(a, scale(n, into))
    most = rules.friction * -into * left
    after = rubbed(add(side, scale(a, left)), most) if most > 0.0 else add(side, scale(a, left))
    excess = vector(period, bodies.excess, i)
    excess = sub(excess, scale(n, dot(excess, n)))
    if most > 0.0:  # friction holds the velocity that the method speaks of, too
        excess = sub(rubbed(add(add(side, scale(a, left)), excess), most), after)
    write(bodies.excess, i, excess)
    write(bodies.acc, i, scale(sub(after, side), 1.0 / left) if left > 0.0 else scale(a, 0.0))


@kernel
def _widened(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, i: int, t: float, count: int
) -> int:
    """Add meetings of a body that may now come further than was thought; return how many there are."""
    d = image(period, sub(_position(period, bodies, i, t), vector(period, bodies.start, i)))
    left = rules.seconds - t
    v, a = vector(period, bodies.vel, i), vector(period, bodies.acc, i)
    reach = norm(d) + (norm(v) + 0.5 * norm(a) * left) * left
    if reach <= bodies.reach[i]:
        return count
    bodies.reach[i] = 1.5 * reach
    for m in range(things.row.shape[0]):
        if things.size[m] >= 0.0:
            count = _joined(bodies, meetings, i, -1 - m, count)
    for j in range(bodies.living.shape[0]):
        here = rules.pairs and bodies.living[j] > 0 and j != i and bodies.light[i] + bodies.light[j] > 0.0
        if here and near(period, bodies.start, bodies.radius, bodies.reach, i, j):
            count = _joined(bodies, meetings, i, j, count)
    return count


@kernel
def _joined(bodies: Bodies, meetings: Meetings, i: int, j: int, count: int) -> int:
    """Add the meeting of body i with body j, or obstacle -1 - j, if it is not there yet."""
    who, other = (i, j) if j < 0 else (min(i, j), max(i, j))
    place = bodies.first[i]
    while place >= 0:
        c = place // 2
        if meetings.who[c] == who and meetings.other[c] == other:
            return count
        place = meetings.following[place % 2, c]
    if count < meetings.who.shape[0]:
        meetings.who[count], meetings.other[count] = who, other
        link(bodies, meetings, count)
    return count + 1
