"""One step of many worlds, mended: who may meet whom, impacts in the order of time or all at once, overlaps parted."""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.constraints.broad import image, loaded, nearby, vector, write
from flockenv.constraints.contacts import NEARLY, Contacts, Ends, gather, impacts, part, press
from flockenv.constraints.events import Bodies, Meetings, Rules, Things, link, play, take_off
from flockenv.constraints.impact import along, surface
from flockenv.kernels import Vec, kernel
from flockenv.shapes.head import bound_of, shift_of
from flockenv.vec import add, axis, dot, norm, scale, sub, zero

__all__ = ["COUNTED", "collide"]

COUNTED = 5
"""Numbers that a call reports: world, agent, meetings in all, impacts, and what was cut short or left unsolved."""

UNSOLVED = 0.1
"""Part of the velocity that a step adds with which somebody may still go into somebody else."""

DEEP = 0.05
"""Part of a radius by which two may still overlap."""

EXACT = 8 * 2.0**-52
"""Rounding of a coordinate, times how large it is."""


@kernel
def _led(period: Vec, apart: Vec, guess: Vec) -> Vec:
    """Return how far a step has led somebody to a place `apart` from where he was: the image nearest to a guess."""
    off = sub(apart, guess)
    return sub(apart, sub(off, image(period, off)))


@kernel
def _goes_round(period: Vec, way: float) -> bool:
    """May two who go so far, m, come to where one is met that is not the nearest image of the other?"""
    least = np.inf
    for k in range(len(period)):
        least = min(least, period[k])
    return bool(4.0 * way > least > 0.0)


@kernel
def _board(
    period: Vec, x0: Any, v0: Any, x: Any, v: Any, alive: Any, b: int, bodies: Bodies, ends: Ends, before: Any,
    seconds: float,
) -> tuple[float, float, float, Vec]:  # fmt: skip
    """Take all bodies of world b aboard; return their largest coordinate, speed, acceleration, and the mean of that."""
    far, fast, hard, mean = 0.0, 0.0, 0.0, zero(period)
    for i in range(x.shape[2]):
        bodies.living[i] = 1 if alive[b, i] else 0
        begun, done = loaded(period, x0, b, i), loaded(period, x, b, i)
        was, now = loaded(period, v0, b, i), loaded(period, v, b, i)
        write(bodies.start, i, begun)
        write(bodies.at, i, begun)
        write(before, i, was)
        write(ends.pos, i, done)
        write(ends.vel, i, now)
        moved = _led(period, sub(done, begun), scale(add(was, now), 0.5 * seconds))
        take_off(period, bodies, i, seconds, moved, was, now)
        if bodies.living[i] > 0 and bodies.light[i] > 0.0:
            for k in range(len(period)):
                far = max(far, abs(begun[k]), abs(done[k]))
            a = vector(period, bodies.acc, i)
            fast, hard, mean = max(fast, norm(now), norm(was)), max(hard, norm(a)), add(mean, a)
    return far, fast, hard, mean


@kernel
def _with_obstacles(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, at: Any, seconds: float, touch: float, ahead: bool,
    count: int,
) -> int:  # fmt: skip
    """Add who may touch which obstacle: within the step, or at its end; return how many there are."""
    capacity = meetings.who.shape[0]
    for m in range(things.row.shape[0]):
        if things.size[m] < 0.0:
            continue
        drift, place = vector(period, things.drift, m), vector(period, things.place, m)
        place = place if ahead else add(place, scale(drift, seconds))
        way = norm(drift) * seconds if ahead else 0.0
        bounded, middle, radius = things.row[m] >= 0, zero(period), things.size[m]
        if bounded:
            middle, radius = bound_of(things.table, things.row[m], period)
        for i in range(bodies.living.shape[0]):
            if bodies.living[i] > 0 and bodies.light[i] > 0.0:
                y = image(period, sub(vector(period, at, i), place))
                room = bodies.radius[i] + touch + way + (bodies.reach[i] if ahead else NEARLY * bodies.radius[i])
                off, far = sub(y, middle), radius + room
                if bounded and not dot(off, off) <= far * far:
                    continue  # it is not even near the circle or sphere around it
                gap, _ = surface(things.table, things.row[m], y)
                if gap - things.size[m] <= room:
                    if count < capacity:
                        meetings.who[count], meetings.other[count] = i, -1 - m
                    count += 1
    return count


@kernel
def _obstacles(
    period: Vec, things: Things, obstacle_x: Any, obstacle_radius: Any, b: int, begun: float, ended: float
) -> None:
    """Find where the obstacles of world b are, and how they move in this step; its own round ones come first."""
    for m in range(things.row.shape[0]):
        if m < obstacle_radius.shape[1]:
            radius = np.float64(obstacle_radius[b, m])
            things.size[m] = radius if radius > 0.0 else -1.0
            write(things.place, m, loaded(period, obstacle_x, b, m))
        else:
            here = shift_of(things.table, things.row[m], begun, period)
            there = shift_of(things.table, things.row[m], ended, period)
            write(things.place, m, add(vector(period, things.anchor, m), here))
            write(things.drift, m, scale(sub(there, here), 1.0 / (ended - begun)))


@kernel
def collide(
    period: Vec, x0: Any, v0: Any, x: Any, v: Any, alive: Any, tick: Any, obstacle_x: Any, obstacle_radius: Any,
    bodies: Bodies, meetings: Meetings, things: Things, contacts: Contacts, ends: Ends, before: Any, reach: Any,
    grid: Any, order: Any, cell: Any, start: Any, offset: Any, bounds: Any, sync: Any, ranges: Any, rules: Rules,
    in_time: bool, once: bool, rounds: int, spread: float, first: int, end: int, work: Any, at_work: int, report: Any,
) -> int:  # fmt: skip
    """Mend the steps of worlds [first, end) that led from x0, v0 to x, v (D, B, N), in place.

    period: where a periodic box ends, zeros = nowhere; in_time: impacts within the step, one after another; once: one
    pass over contacts, and places are not advanced anew; spread: m, how far two are parted at most. Returns the world
    that there was no room for, with the number of its meetings in report[2]: nothing of it is written; else -1.
    """
    scratch = (grid, order, cell, start, offset, bounds, sync, ranges)
    report[0], report[1], report[3], report[4] = -1, -1, 0, 0
    for b in range(first, end):
        impacts_before, unsolved_before = report[3], report[4]
        far, fast, hard, mean = _board(period, x0, v0, x, v, alive, b, bodies, ends, before, rules.seconds)
        if not (far < np.inf and fast < np.inf):
            continue
        began = (tick[b] - 1) * rules.seconds
        _obstacles(period, things, obstacle_x, obstacle_radius, b, began, tick[b] * rules.seconds)
        told = Rules(
            rules.seconds, rules.restitution, rules.friction, rules.sticky, rules.most, rules.anew,
            rules.touch + EXACT * far, rules.pairs,
        )  # fmt: skip
        count = _meetings(period, bodies, meetings, things, ends, told, reach, in_time, scratch)
        if in_time and count <= meetings.who.shape[0]:
            count = _fly(period, bodies, meetings, things, ends, told, before, count, report)
        report[2] = count
        if count > meetings.who.shape[0]:
            return b
        if in_time and _goes_round(period, fast * rules.seconds):
            report[4] += 1
        mean = scale(mean, -1.0 / norm(mean)) if norm(mean) > 1e-9 * hard * x.shape[2] else axis(mean, 0)
        slow = 1e-3 * hard * rules.seconds + 1e-12 * fast
        touching = gather(
            period, bodies, meetings, things, ends, contacts, rules.seconds, mean, told.touch, slow, in_time, count
        )
        if touching > 0:
            _at_once(
                period, bodies, things, contacts, ends, before, told, in_time, once, rounds, fast, hard, spread,
                touching, report,
            )  # fmt: skip
        work[b, 1] += 1 if rules.pairs else 0
        work[b, at_work] += report[3] - impacts_before
        work[b, at_work + 1] += report[4] - unsolved_before
        bad = _leave(period, x, v, b, ends, bodies)
        if bad >= 0 and report[0] < 0:
            report[0], report[1] = b, bad
    return -1


@kernel
def _meetings(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, reach: Any,
    in_time: bool, scratch: Any,
) -> int:  # fmt: skip
    """Find who may meet what within the step, or nearly touches at its end; return how many, room for them or not."""
    grid, order, cell, start, offset, bounds, sync, ranges = scratch
    n, count = bodies.living.shape[0], 0
    where = bodies.start if in_time else ends.pos
    for i in range(n):
        reach[i] = bodies.reach[i] if in_time else rules.touch + NEARLY * bodies.radius[i]
    if rules.pairs:
        count = nearby(
            period, where, bodies.living, bodies.radius, reach, n, grid, order, cell, start, offset, bounds, sync,
            ranges, meetings.who, meetings.other,
        )  # fmt: skip
    count = _with_obstacles(period, bodies, meetings, things, where, rules.seconds, rules.touch, in_time, count)
    if count <= meetings.who.shape[0]:
        for c in range(count):
            link(bodies, meetings, c)
    return count


@kernel
def _fly(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, before: Any, count: int,
    report: Any,
) -> int:  # fmt: skip
    """Let everybody fly through the step; return how many meetings there are, room for them or not."""
    some, cut, count = play(period, bodies, meetings, things, rules, count, before)
    if count <= meetings.who.shape[0]:
        report[3] += some
        report[4] += cut
        for i in range(bodies.living.shape[0]):
            if bodies.moved[i] > 0:
                _land(period, bodies, ends, i, rules.seconds)
    return count


@kernel
def _land(period: Vec, bodies: Bodies, ends: Ends, i: int, seconds: float) -> None:
    """Write where and how fast the way of body i ends."""
    left = seconds - bodies.since[i]
    v, a = vector(period, bodies.vel, i), vector(period, bodies.acc, i)
    write(ends.pos, i, along(vector(period, bodies.at, i), v, a, left))
    write(ends.vel, i, add(add(v, scale(a, left)), vector(period, bodies.excess, i)))


@kernel
def _at_once(
    period: Vec, bodies: Bodies, things: Things, contacts: Contacts, ends: Ends, before: Any, rules: Rules,
    in_time: bool, once: bool, rounds: int, fast: float, hard: float, spread: float, count: int, report: Any,
) -> None:  # fmt: skip
    """Change velocities until nobody goes into anybody, and places until nobody overlaps; report if somebody does."""
    passes, seconds, n = 1 if once else rounds, rules.seconds, bodies.living.shape[0]
    least = 1e-12 * fast
    gain = 1e-6 * hard * seconds + least
    if not in_time:
        for i in range(n):  # what the step has added comes after the impacts; what is slower than it does not bounce
            write(bodies.vel, i, vector(period, ends.vel, i))
            write(bodies.acc, i, sub(vector(period, ends.vel, i), vector(period, before, i)))
        report[3] += impacts(
            period, bodies, things, contacts, before, rules.restitution, rules.friction, rules.sticky, passes,
            hard * seconds + least, count,
        )  # fmt: skip
        for i in range(n):
            write(ends.vel, i, add(vector(period, before, i), vector(period, bodies.acc, i)))
    left = press(period, bodies, things, contacts, ends.vel, rules.friction, rules.sticky, passes, gain, count)
    if not in_time and not once:
        for i in range(n):  # whom contacts have changed goes from where he was as fast as he is now, under every method
            now = vector(period, ends.vel, i)
            more = sub(now, vector(period, bodies.vel, i))
            if dot(more, more) > 0.0:
                write(ends.pos, i, add(vector(period, bodies.start, i), scale(now, seconds)))
    deep, widest = part(period, bodies, things, ends, seconds, passes, rules.touch, spread, contacts, count), 0.0
    for i in range(n):
        widest = max(widest, bodies.radius[i])
    if not once and (left > UNSOLVED * hard * seconds + 1e3 * gain or deep > DEEP * widest + 1e3 * rules.touch):
        report[4] += 1


@kernel
def _leave(period: Vec, x: Any, v: Any, b: int, ends: Ends, bodies: Bodies) -> int:
    """Write everybody back into the batch; return the first who is nowhere, or -1."""
    bad = -1
    for i in range(x.shape[2]):
        if bodies.living[i] == 0:
            continue
        at, now = vector(period, ends.pos, i), vector(period, ends.vel, i)
        if not dot(at, at) + dot(now, now) < np.inf and bad < 0:
            bad = i
        for k in range(len(period)):
            place = at[k]
            if period[k] > 0.0 and not 0.0 <= place < period[k]:
                place = place - period[k] * np.floor(place / period[k])
                place = 0.0 if place >= period[k] or place < 0.0 else place
            x[k, b, i] = place
            v[k, b, i] = now[k]
    return bad
