"""Impacts of one world within one step, in the order of time.

Each body moves along a parabola through the method's step. The earliest impact of all is found, both
bodies respond, and their further paths are searched anew. If the infinite series of hops of a bouncing ball ends within
the step, the ball rests. From then on the surface carries the ball: the acceleration into the surface is cancelled, and
friction acts along it.

The number of impacts of one pair in one step is limited. Beyond the limit the two bodies stop (stalls.py): they keep
their velocities and do not move for the rest of the step. So time is lost, but neither energy nor order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.jit.decorators import Vec, kernel, routine
from flockenv.maths.vectors import add, dot, scale, sub
from flockenv.physics.constraints.bodies import (
    ANEW,
    DEEP,
    GIVEN_UP,
    RESTS,
    STOPPED,
    Bodies,
    Meetings,
    Rules,
    Things,
    contact_row,
    larger_acceleration,
    position,
    relative_motion,
    velocity,
    widen_reach,
    width,
)
from flockenv.physics.constraints.broad_phase import vector_at, write_vector
from flockenv.physics.constraints.impact import (
    bounce,
    comes_to_rest,
    first_impact,
    hops_within,
    slow_by_friction,
    surface_at,
)
from flockenv.physics.constraints.stalls import halt

__all__ = ["process_impacts", "start_touching"]

OBLIQUE = 0.6180339887498949
"""Weight of an axis in a generic direction: coordinates are weighted by 1, this, and its square."""

CALM = 0.01
"""A step is short for a body at rest if it would fall by less than this fraction of its radius."""

JOLTED = 3
"""Index in `lost` of the flag that the last impact changed velocities by more than the step; see `process_impacts`."""


@kernel
def start_touching(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, count: int, before: Any
) -> None:
    """Set the velocities of bodies that touch at the beginning to those before the step, `before` (N, D) m/s."""
    for c in range(count):
        _drop_half_step(period, bodies, things, meetings.who[c], meetings.other[c], rules.touch, before)


@kernel
def _drop_half_step(period: Vec, bodies: Bodies, things: Things, i: int, j: int, touch: float, before: Any) -> None:
    """Set two bodies in touch to their old velocities: a first-order method is half a step ahead or behind."""
    y, _, _ = relative_motion(period, bodies, things, i, j, 0.0)
    row, room = contact_row(bodies, things, i, j)
    if surface_at(things.table, row, y)[0] - room <= touch:
        _use_old_velocity(period, bodies, i, before)
        if j >= 0:
            _use_old_velocity(period, bodies, j, before)


@kernel
def _use_old_velocity(period: Vec, bodies: Bodies, i: int, before: Any) -> None:
    write_vector(bodies.vel, i, vector_at(period, before, i))
    for k in range(len(period)):
        bodies.excess[i, k] = 0.0


@routine
def process_impacts(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, count: int, lost: Any
) -> tuple[int, int, int]:
    """Move all bodies of one world through the step; return numbers of impacts, of cut ones, and of meetings.

    lost: incremented by the time for which stopped bodies did not move, s, the energy lost by bodies that came to rest
    at the limit, J, and the number of bodies that stopped. Entry JOLTED is 1 if the last impact changed velocities by
    more than the step does, else 0. If there are more meetings than capacity, the caller must repeat the work with more
    room.
    """
    todo, active, impacts, cut = count, 0, 0, 0
    for c in range(count):
        meetings.todo[c] = c
    while True:
        for k in range(todo):
            active = _find_time(period, bodies, meetings, things, rules, meetings.todo[k], active)
        best, active = _earliest(period, bodies, meetings, active)
        if best < 0:
            return impacts, cut, count
        when, meetings.time[best] = meetings.time[best], np.inf
        meetings.hits[best] += 1
        if _is_no_impact(bodies, meetings, rules, best):
            halt(period, bodies, meetings, things, rules, best, when, lost)
            cut, lost[JOLTED] = cut + 1, 1.0
        else:
            impacts += 1
            cut += _resolve_impact(period, bodies, meetings, things, rules, best, when, lost)
        todo, jolted = 0, lost[JOLTED] > 0.0
        for who in (meetings.who[best], meetings.other[best]):
            if who >= 0:
                count = widen_reach(period, bodies, meetings, things, rules, who, when, count)
                todo = _list_again(period, bodies, meetings, things, rules, who, when, jolted, todo)
        if count > meetings.who.shape[0]:
            return impacts, cut, count


@kernel
def _is_no_impact(bodies: Bodies, meetings: Meetings, rules: Rules, c: int) -> bool:
    """Return True if a meeting is no impact: impacts are not allowed, one body has stopped, or the two are at rest."""
    j = meetings.other[c]
    stopped = bodies.moved[meetings.who[c]] == STOPPED or (j >= 0 and bodies.moved[j] == STOPPED)
    return bool(rules.stops or stopped or meetings.closed[c] == RESTS)


@kernel
def _earliest(period: Vec, bodies: Bodies, meetings: Meetings, active: int) -> tuple[int, int]:
    """Return the earliest meeting, or -1, and the number of active ones; drop those without a time from the list."""
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
            first = _tie_breaker(period, bodies, meetings, c) < _tie_breaker(period, bodies, meetings, best)
            best = c if first else best
        k += 1
    return best, active


@kernel
def _tie_breaker(period: Vec, bodies: Bodies, meetings: Meetings, c: int) -> float:
    """Return a tie-breaker of simultaneous meetings that depends on positions, not on the indices of the bodies."""
    i, j = meetings.who[c], meetings.other[c]
    place, out = vector_at(period, bodies.start, i), 0.0
    if j >= 0:
        place = add(place, vector_at(period, bodies.start, j))
    for k in range(len(period)):
        out += place[k] * OBLIQUE**k
    return out


@kernel
def _find_time(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, c: int, active: int
) -> int:
    """Compute the time of a meeting; return the number of active meetings."""
    if meetings.closed[c] == GIVEN_UP:
        return active
    i, j = meetings.who[c], meetings.other[c]
    now = bodies.since[i] if j < 0 else max(bodies.since[i], bodies.since[j])
    y, v, a = relative_motion(period, bodies, things, i, j, now)
    row, room = contact_row(bodies, things, i, j)
    room = max(room - meetings.deep[c], 0.0)
    t = now + first_impact(things.table, row, y, v, a, rules.seconds - now, room, rules.touch)
    meetings.time[c] = t if t <= rules.seconds else np.inf
    if meetings.time[c] < np.inf and meetings.listed[c] == 0:
        meetings.active[active], meetings.listed[c] = c, 1
        active += 1
    return active


@kernel
def _list_again(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, i: int, t: float, jolted: bool,
    todo: int,
) -> int:  # fmt: skip
    """List the meetings of body i whose times are to be computed again; return the length of the list.

    Two bodies at rest need no search if no impact has moved them and the step is too short for them to overlap much.
    """
    calm = not jolted and larger_acceleration(period, bodies, i, -1) * rules.seconds**2 < CALM * bodies.radius[i]
    place = bodies.first[i]
    while place >= 0:
        c = place // 2
        if jolted and meetings.closed[c] == RESTS and _is_hit_again(period, bodies, meetings, things, rules, c, t):
            meetings.closed[c], meetings.deep[c] = 0, 0.0
        if not calm or meetings.closed[c] != RESTS:
            meetings.todo[todo] = c
            todo += 1
        place = meetings.following[place % 2, c]
    return todo


@kernel
def _is_hit_again(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, c: int, t: float
) -> bool:
    """Return True if a third body drives two at rest together, faster than the step's acceleration does.

    It returns False after a bounded number of hits, so that the step ends.
    """
    i, j = meetings.who[c], meetings.other[c]
    if meetings.hits[c] >= ANEW * (rules.most + 1):
        return False
    y, v, _ = relative_motion(period, bodies, things, i, j, t)
    row, _ = contact_row(bodies, things, i, j)
    _, n = surface_at(things.table, row, y)
    return bool(-dot(v, n) > larger_acceleration(period, bodies, i, j) * rules.seconds)


@kernel
def _resolve_impact(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, c: int, t: float, lost: Any
) -> int:
    """Change the velocities of the two bodies of an impact; return 1 if it exceeds the limit of impacts, else 0.

    Beyond the limit, two that approach more slowly than the velocity added by the step's acceleration are at rest from
    now on; faster ones respond, and stop.
    """
    i, j = meetings.who[c], meetings.other[c]
    y, v, a = relative_motion(period, bodies, things, i, j, t)
    row, _ = contact_row(bodies, things, i, j)
    gap, n = surface_at(things.table, row, y)
    left, push, w = rules.seconds - t, dot(a, n), -dot(v, n)
    restitution = rules.restitution if j >= 0 else things.restitution[-1 - j]
    over = meetings.hits[c] % ((rules.most if j < 0 else rules.again) + 1) == 0
    slow = w <= larger_acceleration(period, bodies, i, j) * rules.seconds
    rests = rules.sticky or comes_to_rest(max(w, 0.0), push, restitution, left) or hops_within(w, push, rules.touch)
    if j >= 0 and restitution < 1.0:  # in a heap contacts come to rest, and are solved together
        rests = rests or slow
    cut = over and not rests
    rests = rests or (over and slow)
    lost[JOLTED] = 0.0 if slow else 1.0
    change = sub(bounce(v, n, 0.0 if rests else restitution, rules.friction), v)
    if rules.sticky:
        change = scale(v, -1.0)
    total = bodies.light[i] + (bodies.light[j] if j >= 0 else 0.0)
    share = bodies.light[i] / total if total > 0.0 else 0.0
    _change_velocity(period, bodies, i, t, scale(change, share))
    if j >= 0:
        _change_velocity(period, bodies, j, t, scale(change, share - 1.0 if total > 0.0 else 0.0))
    if rests and j < 0 and bodies.light[i] > 0.0:
        _rest_on(period, bodies, things, rules, i, -1 - j, n, push, left)
    if cut and not slow:
        halt(period, bodies, meetings, things, rules, c, t, lost)
    elif rests and (j >= 0 or over):
        meetings.closed[c] = RESTS
        bodies.leans[i] = 1 if j >= 0 else bodies.leans[i]
        bodies.leans[max(j, 0)] = 1 if j >= 0 else bodies.leans[0]
        meetings.deep[c] = DEEP * width(bodies, i, j) + max(contact_row(bodies, things, i, j)[1] - gap, 0.0)
        lost[1] += 0.5 * w * w / total if cut and total > 0.0 else 0.0
    return 1 if cut else 0


@kernel
def _change_velocity(period: Vec, bodies: Bodies, i: int, t: float, change: Vec) -> None:
    """Change the velocity of body i at time t."""
    x, v = position(period, bodies, i, t), velocity(period, bodies, i, t)
    write_vector(bodies.at, i, x)
    write_vector(bodies.vel, i, add(v, change))
    write_vector(bodies.acc, i, vector_at(period, bodies.free, i))
    bodies.since[i] = t
    bodies.moved[i] = 1


@kernel
def _rest_on(
    period: Vec, bodies: Bodies, things: Things, rules: Rules, i: int, m: int, n: Vec, push: float, left: float
) -> None:
    """Let obstacle m carry body i for the rest of the step: no acceleration into it, friction along it."""
    drift, a = vector_at(period, things.drift, m), vector_at(period, bodies.acc, i)
    side = sub(vector_at(period, bodies.vel, i), drift)
    if rules.sticky:
        write_vector(bodies.acc, i, scale(a, 0.0))
        write_vector(bodies.excess, i, scale(a, 0.0))
        return
    into = min(push, 0.0)
    a = sub(a, scale(n, into))
    most = rules.friction * -into * left
    after = slow_by_friction(add(side, scale(a, left)), most) if most > 0.0 else add(side, scale(a, left))
    excess = vector_at(period, bodies.excess, i)
    excess = sub(excess, scale(n, dot(excess, n)))
    if most > 0.0:  # friction also acts on the method's excess of velocity
        excess = sub(slow_by_friction(add(add(side, scale(a, left)), excess), most), after)
    write_vector(bodies.excess, i, excess)
    write_vector(bodies.acc, i, scale(sub(after, side), 1.0 / left) if left > 0.0 else scale(a, 0.0))
