"""One step of many worlds, mended: who may meet whom, impacts in the order of time or all at once, overlaps parted."""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.constraints.bodies import DEEP, STOPPED, Bodies, Meetings, Rules, Things, link, take_off, widened
from flockenv.constraints.broad import image, led, loaded, nearby, vector, write
from flockenv.constraints.contacts import NEARLY, Contacts, Ends, deepest, gather, impacts, part, press
from flockenv.constraints.events import play, together
from flockenv.constraints.impact import along, surface
from flockenv.constraints.sweep import may_pass, stop_on_the_way
from flockenv.kernels import Vec, kernel
from flockenv.shapes.head import bound_of, shift_of
from flockenv.vec import add, axis, dot, norm, scale, sub, zero

__all__ = ["COUNTED", "collide"]

COUNTED = 5
"""Numbers that a call reports: world, agent, meetings in all, impacts, what was left unsolved."""

UNSOLVED = 0.1
"""Part of the velocity that a step adds with which a body may still go into another."""

ROUNDS = 8
"""How often those that touch are gathered anew, where moving bodies apart has led them into others."""

CROWDED = 0.5
"""Part of its radius by which a body is moved so far by the single pass of `project` that it makes more of them."""

DEEPEST = 0.25
"""Part of a radius by which two may overlap after the single pass of `project`, before it makes more."""

EXACT = 8 * 2.0**-52
"""Rounding of a coordinate, times how large it is."""


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
        moved = led(period, sub(done, begun), scale(add(was, now), 0.5 * seconds))
        take_off(period, bodies, i, seconds, moved, was, now)
        if bodies.living[i] > 0 and bodies.light[i] > 0.0:
            for k in range(len(period)):
                far = max(far, abs(begun[k]), abs(done[k]))
            a = vector(period, bodies.acc, i)
            fast, hard, mean = max(fast, norm(now), norm(was)), max(hard, norm(a)), add(mean, a)
    return far, fast, hard, mean


@kernel
def _with_obstacles(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, at: Any, reach: Any, seconds: float, touch: float,
    ahead: bool, count: int,
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
                room = bodies.radius[i] + touch + way + reach[i]
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
    lost: Any,
) -> int:  # fmt: skip
    """Mend the steps of worlds [first, end) that led from x0, v0 to x, v (D, B, N), in place.

    period: where a periodic box ends, zeros = nowhere; in_time: impacts within the step, one after another; once: one
    pass over contacts, and places are not advanced anew; spread: m, how far two are parted at most. Returns the world
    that there was no room for, with the number of its meetings in report[2]: nothing of it is written; else -1.
    """
    scratch = (grid, order, cell, start, offset, bounds, sync, ranges)
    report[0], report[1], report[3], report[4] = -1, -1, 0, 0
    for k in range(lost.shape[0]):
        lost[k] = 0.0
    for b in range(first, end):
        impacts_before, unsolved_before = report[3], report[4]
        seconds_before, joules_before, stopped_before = lost[0], lost[1], lost[2]
        far, fast, hard, mean = _board(period, x0, v0, x, v, alive, b, bodies, ends, before, rules.seconds)
        if not (far < np.inf and fast < np.inf):
            continue
        began = (tick[b] - 1) * rules.seconds
        _obstacles(period, things, obstacle_x, obstacle_radius, b, began, tick[b] * rules.seconds)
        told = Rules(
            rules.seconds, rules.restitution, rules.friction, rules.sticky, rules.most, rules.again,
            rules.touch + EXACT * far, rules.pairs, not in_time,
        )  # fmt: skip
        passing = not in_time and may_pass(period, bodies, things, ends, rules.seconds, False)
        ahead = in_time or passing or not once
        count = _meetings(period, bodies, meetings, things, ends, told, reach, ahead, not in_time, scratch)
        if in_time and count <= meetings.who.shape[0]:
            count = _fly(period, bodies, meetings, things, ends, told, before, count, report, lost)
        if count <= meetings.who.shape[0]:
            if in_time and _goes_round(period, fast * rules.seconds):
                report[4] += 1
            mean = scale(mean, -1.0 / norm(mean)) if norm(mean) > 1e-9 * hard * x.shape[2] else axis(mean, 0)
            count = _at_the_end(
                period, bodies, meetings, things, contacts, ends, before, reach, told, in_time, once, passing, rounds,
                fast, hard, mean, spread, count, scratch, lost, report,
            )  # fmt: skip
        report[2] = count
        if count > meetings.who.shape[0]:
            report[3], report[4] = impacts_before, unsolved_before
            lost[0], lost[1], lost[2] = seconds_before, joules_before, stopped_before
            return b
        work[b, 1] += 1 if rules.pairs else 0
        work[b, at_work] += report[3] - impacts_before
        work[b, at_work + 1] += report[4] - unsolved_before
        work[b, at_work + 2] += np.int64(lost[2] - stopped_before)
        bad = _leave(period, x, v, b, ends, bodies)
        if bad >= 0 and report[0] < 0:
            report[0], report[1] = b, bad
    return -1


@kernel
def _meetings(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, reach: Any,
    ahead: bool, nearly: bool, scratch: Any,
) -> int:  # fmt: skip
    """Find what may meet within the step (ahead), or touches at its end; return how many, room for them or not.

    nearly: True if two count that are a tenth of their radii apart.
    """
    grid, order, cell, start, offset, bounds, sync, ranges = scratch
    n, count = bodies.living.shape[0], 0
    where = bodies.start if ahead else ends.pos
    if ahead:
        _reach_further(bodies)
    for i in range(n):
        bodies.first[i] = -1
        reach[i] = (bodies.reach[i] if ahead else 0.0) + (rules.touch + NEARLY * bodies.radius[i] if nearly else 0.0)
    if rules.pairs:
        count = nearby(
            period, where, bodies.living, bodies.radius, reach, n, grid, order, cell, start, offset, bounds, sync,
            ranges, meetings.who, meetings.other,
        )  # fmt: skip
    count = _with_obstacles(period, bodies, meetings, things, where, reach, rules.seconds, rules.touch, ahead, count)
    if count <= meetings.who.shape[0]:
        for c in range(count):
            link(bodies, meetings, c)
    return count


@kernel
def _reach_further(bodies: Bodies) -> None:
    """Let all bodies reach further than they go, so that few that are hit come where they were not expected."""
    total, present = 0.0, 0
    for i in range(bodies.living.shape[0]):
        if bodies.living[i] > 0:
            total, present = total + bodies.reach[i], present + 1
    for i in range(bodies.living.shape[0]):
        bodies.reach[i] = max(1.25 * bodies.reach[i], 1.5 * total / max(present, 1))


@kernel
def _fly(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, before: Any, count: int,
    report: Any, lost: Any,
) -> int:  # fmt: skip
    """Move all bodies through the step; return how many meetings there are, room for them or not."""
    together(period, bodies, meetings, things, rules, count, before)
    some, cut, count = play(period, bodies, meetings, things, rules, count, lost)
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
    now = zero(v) if bodies.moved[i] == STOPPED else add(v, scale(a, left))
    write(ends.vel, i, add(now, vector(period, bodies.excess, i)))


@kernel
def _at_the_end(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, contacts: Contacts, ends: Ends, before: Any,
    reach: Any, rules: Rules, in_time: bool, once: bool, passing: bool, rounds: int, fast: float, hard: float, up: Vec,
    spread: float, count: int, scratch: Any, lost: Any, report: Any,
) -> int:  # fmt: skip
    """Solve all contacts of the step's end, velocities, then places; return how many meetings there are.

    up: against the mean acceleration.
    """
    least = 1e-12 * fast
    slow, gain = 1e-3 * hard * rules.seconds + least, 1e-6 * hard * rules.seconds + least
    left, deep = 0.0, 0.0
    touching = gather(
        period, bodies, meetings, things, ends, contacts, rules.seconds, up, rules.touch, slow,
        rules.restitution, in_time, passing, count,
    )  # fmt: skip
    if touching > 0:
        left = _velocities(
            period, bodies, things, contacts, ends, before, rules, in_time, once, rounds, hard, least, gain, touching,
            report,
        )  # fmt: skip
    turned = touching > 0 and not in_time and not once and _moved_far(period, bodies, ends, 0.5 * DEEP)
    again = passing or (turned and may_pass(period, bodies, things, ends, rules.seconds, True))
    if again:
        count = stop_on_the_way(period, bodies, meetings, things, ends, rules, count, lost)
    elif turned:
        count = _wider(period, bodies, meetings, things, ends, rules, count)
    if (touching > 0 or again) and count <= meetings.who.shape[0]:
        count, deep = _places(
            period, bodies, meetings, things, contacts, ends, reach, rules, once, again or turned, rounds, up, spread,
            touching, count, scratch,
        )  # fmt: skip
    limit = DEEP * _widest(bodies) + 1e3 * rules.touch
    unsolved = left > UNSOLVED * hard * rules.seconds + 1e3 * gain or deep > limit
    report[4] += 1 if unsolved and not once else 0
    return count


@kernel
def _velocities(
    period: Vec, bodies: Bodies, things: Things, contacts: Contacts, ends: Ends, before: Any, rules: Rules,
    in_time: bool, once: bool, rounds: int, hard: float, least: float, gain: float, count: int, report: Any,
) -> float:  # fmt: skip
    """Change velocities until no body goes into another; return the last pass's fastest change, m/s."""
    passes, seconds, n = 1 if once else rounds, rules.seconds, bodies.living.shape[0]
    if not in_time:
        for i in range(n):  # what the step has added comes after the impacts; what is slower than it does not bounce
            write(bodies.vel, i, vector(period, ends.vel, i))
            write(bodies.acc, i, sub(vector(period, ends.vel, i), vector(period, before, i)))
        done, left = impacts(
            period, bodies, things, contacts, before, rules.restitution, rules.friction, rules.sticky, passes,
            hard * seconds + least, count,
        )  # fmt: skip
        report[3] += done
        report[4] += 1 if left > 0 else 0
        for i in range(n):
            write(ends.vel, i, add(vector(period, before, i), vector(period, bodies.acc, i)))
    worst = press(period, bodies, things, contacts, ends.vel, rules.friction, rules.sticky, passes, gain, count)
    if not in_time and not once:
        for i in range(n):
            write(bodies.at, i, vector(period, ends.pos, i))
        for i in range(n):  # what contacts have changed goes from its start as fast as it is now, under every method
            now = vector(period, ends.vel, i)
            more = sub(now, vector(period, bodies.vel, i))
            if dot(more, more) > 0.0:
                write(ends.pos, i, add(vector(period, bodies.start, i), scale(now, seconds)))
    return float(worst)


@kernel
def _places(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, contacts: Contacts, ends: Ends, reach: Any,
    rules: Rules, once: bool, anew: bool, rounds: int, up: Vec, spread: float, touching: int, count: int, scratch: Any,
) -> tuple[int, float]:  # fmt: skip
    """Move apart those that overlap; return how many meetings there are, and the last pass's farthest move, m.

    anew: True if bodies have moved since those that touch were gathered. That is done again, too, where bodies are
    moved so far that they may overlap others; two that part slowly on purpose are moved once.
    """
    deep, elsewhere = 0.0, False
    for turn in range(ROUNDS):
        if turn > 0 and (elsewhere or _beyond(period, bodies, ends, reach)):
            elsewhere = True
            count = _meetings(period, bodies, meetings, things, ends, rules, reach, False, True, scratch)
        if count > meetings.who.shape[0]:
            return count, deep
        if turn > 0 or anew:
            touching = gather(
                period, bodies, meetings, things, ends, contacts, rules.seconds, up, rules.touch, 0.0,
                rules.restitution, False, False, count,
            )  # fmt: skip
        for i in range(bodies.living.shape[0]):
            write(bodies.at, i, vector(period, ends.pos, i))
        deep = part(
            period, bodies, things, ends, rules.seconds, 1 if once else rounds, rules.touch, spread, contacts, touching
        )
        crowded = False
        if once:
            left = deepest(period, bodies, things, ends, rules.seconds, contacts, touching)
            crowded = left > DEEPEST * _widest(bodies) or _moved_far(period, bodies, ends, CROWDED)
        if crowded:
            deep = part(period, bodies, things, ends, rules.seconds, rounds, rules.touch, spread, contacts, touching)
        done = (once and not crowded) or spread < np.inf
        if done or not _moved_far(period, bodies, ends, NEARLY if once else 0.5 * DEEP):
            break
    return count, deep


@kernel
def _beyond(period: Vec, bodies: Bodies, ends: Ends, reach: Any) -> bool:
    """True if a body is further from where it began than meetings were listed for."""
    for i in range(bodies.living.shape[0]):
        moved = image(period, sub(vector(period, ends.pos, i), vector(period, bodies.start, i)))
        if bodies.living[i] > 0 and norm(moved) > max(reach[i], bodies.reach[i]):
            return True
    return False


@kernel
def _wider(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, count: int
) -> int:
    """Add meetings of bodies that impacts made so fast that they end in what they were not near; return how many."""
    for i in range(bodies.living.shape[0]):
        moved = sub(vector(period, ends.pos, i), vector(period, bodies.start, i))
        moved = led(period, moved, scale(vector(period, ends.vel, i), rules.seconds))
        far = norm(moved) > bodies.reach[i] + NEARLY * bodies.radius[i]
        if far and bodies.living[i] > 0 and bodies.light[i] > 0.0:
            bodies.since[i] = 0.0
            write(bodies.at, i, vector(period, bodies.start, i))
            write(bodies.vel, i, scale(moved, 1.0 / rules.seconds))
            write(bodies.acc, i, zero(period))
            count = widened(period, bodies, meetings, things, rules, i, 0.0, count)
    return count


@kernel
def _widest(bodies: Bodies) -> float:
    """Return the largest radius, m."""
    widest = 0.0
    for i in range(bodies.living.shape[0]):
        widest = max(widest, bodies.radius[i])
    return float(widest)


@kernel
def _moved_far(period: Vec, bodies: Bodies, ends: Ends, share: float) -> bool:
    """True if a body was moved from bodies.at by more than this part of its radius: it may now overlap another."""
    for i in range(bodies.living.shape[0]):
        d = image(period, sub(vector(period, ends.pos, i), vector(period, bodies.at, i)))
        if bodies.living[i] > 0 and norm(d) > share * bodies.radius[i]:
            return True
    return False


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
