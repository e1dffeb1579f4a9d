"""Collisions in one step of many worlds: broad phase, impacts in the order of time or all at once, overlaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.shapes.row_header import shift_of
from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.vectors import add, axis, dot, norm, scale, sub, zero
from flockenv.physics.constraints.bodies import STOPPED, Bodies, Meetings, Rules, Things, set_parabola
from flockenv.physics.constraints.broad_phase import displacement_near, load_vector, vector_at, write_vector
from flockenv.physics.constraints.candidates import list_meetings
from flockenv.physics.constraints.contacts import Contacts, Ends
from flockenv.physics.constraints.continuous import may_meet_around, may_pass
from flockenv.physics.constraints.event_driven import process_impacts, start_touching
from flockenv.physics.constraints.impact import position_along
from flockenv.physics.constraints.step_end import RAISED, settle_ends

__all__ = ["COUNTED", "LOST", "collide", "place_obstacles"]

COUNTED = 5
"""Length of the report of a call: world, agent, number of meetings, of impacts, and of unsolved ones."""

LOST = 7
"""Length of `lost`: the numbers that event_driven.py and step_end.py name."""

EXACT = 8 * 2.0**-52
"""Rounding error of a coordinate, relative to its size."""


@kernel
def _load_bodies(
    period: Vec, x0: Any, v0: Any, x: Any, v: Any, alive: Any, b: int, bodies: Bodies, ends: Ends, before: Any,
    seconds: float,
) -> tuple[float, float, float, Vec]:  # fmt: skip
    """Load the bodies of world b; return the largest coordinate, speed and acceleration, and summed acceleration."""
    far, fast, hard, mean = 0.0, 0.0, 0.0, zero(period)
    for i in range(x.shape[2]):
        bodies.living[i] = 1 if alive[b, i] else 0
        begun, done = load_vector(period, x0, b, i), load_vector(period, x, b, i)
        was, now = load_vector(period, v0, b, i), load_vector(period, v, b, i)
        write_vector(bodies.start, i, begun)
        write_vector(bodies.at, i, begun)
        write_vector(before, i, was)
        write_vector(ends.pos, i, done)
        write_vector(ends.vel, i, now)
        moved = displacement_near(period, sub(done, begun), scale(add(was, now), 0.5 * seconds))
        set_parabola(period, bodies, i, seconds, moved, was, now)
        if bodies.living[i] > 0 and bodies.light[i] > 0.0:
            for k in range(len(period)):
                far = max(far, abs(begun[k]), abs(done[k]))
            a = vector_at(period, bodies.acc, i)
            fast, hard, mean = max(fast, norm(now), norm(was)), max(hard, norm(a)), add(mean, a)
    return far, fast, hard, mean


@kernel
def place_obstacles(
    period: Vec, things: Things, obstacle_x: Any, obstacle_radius: Any, b: int, begun: float, ended: float
) -> None:
    """Compute positions and velocities of the obstacles of world b in this step; its own round ones come first."""
    if things.listed[0] == 0:
        for m in range(obstacle_radius.shape[1]):
            radius = np.float64(obstacle_radius[b, m])
            things.size[m] = radius if radius > 0.0 else -1.0
            write_vector(things.place, m, load_vector(period, obstacle_x, b, m))
    for k in range(things.moving.shape[0]):
        m = things.moving[k]
        here = shift_of(things.table, things.row[m], begun, period)
        there = shift_of(things.table, things.row[m], ended, period)
        write_vector(things.place, m, add(vector_at(period, things.anchor, m), here))
        write_vector(things.drift, m, scale(sub(there, here), 1.0 / (ended - begun)))


@kernel
def collide(
    period: Vec, x0: Any, v0: Any, x: Any, v: Any, alive: Any, tick: Any, obstacle_x: Any, obstacle_radius: Any,
    bodies: Bodies, meetings: Meetings, things: Things, contacts: Contacts, ends: Ends, before: Any, reach: Any,
    grid: Any, order: Any, cell: Any, start: Any, offset: Any, bounds: Any, sync: Any, ranges: Any, rules: Rules,
    in_time: bool, once: bool, rounds: int, spread: float, first: int, end: int, work: Any, at_work: int, report: Any,
    lost: Any,
) -> int:  # fmt: skip
    """Correct the steps of worlds [first, end) from x0, v0 to x, v (D, B, N), in place.

    period: edges of a periodic box, m, zeros if it is not periodic; in_time: impacts within the step, one after
    another; once: one pass over contacts, and positions are not advanced anew; spread: m, largest separation of a pair.
    Returns -1, or the first world with more meetings than capacity: report[2] is their number, and that world is left
    unchanged.
    """
    scratch = (grid, order, cell, start, offset, bounds, sync, ranges)
    report[0], report[1], report[3], report[4] = -1, -1, 0, 0
    for k in range(lost.shape[0]):
        lost[k] = 0.0
    for b in range(first, end):
        impacts_before, unsolved_before = report[3], report[4]
        seconds_before, joules_before, stopped_before, raised_before = lost[0], lost[1], lost[2], lost[RAISED]
        far, fast, hard, mean = _load_bodies(period, x0, v0, x, v, alive, b, bodies, ends, before, rules.seconds)
        if not (far < np.inf and fast < np.inf):
            continue
        began = (tick[b] - 1) * rules.seconds
        place_obstacles(period, things, obstacle_x, obstacle_radius, b, began, tick[b] * rules.seconds)
        revised = Rules(
            rules.seconds, rules.restitution, rules.friction, rules.sticky, rules.most, rules.again,
            rules.touch + EXACT * far, rules.pairs, not in_time,
        )  # fmt: skip
        passing = not in_time and may_pass(period, bodies, things, ends, rules.seconds, False)
        ahead = in_time or passing or not once
        count = list_meetings(period, bodies, meetings, things, ends, revised, reach, ahead, not in_time, scratch)
        if in_time and count <= meetings.who.shape[0]:
            count = _move_bodies(period, bodies, meetings, things, ends, revised, before, count, report, lost)
        if count <= meetings.who.shape[0]:
            round_about = may_meet_around(period, fast * rules.seconds)
            report[4] += 1 if round_about else 0
            mean = scale(mean, -1.0 / norm(mean)) if norm(mean) > 1e-9 * hard * x.shape[2] else axis(mean, 0)
            count = settle_ends(
                period, bodies, meetings, things, contacts, ends, before, reach, revised, in_time, once, passing,
                rounds, fast, hard, mean, spread, round_about, count, scratch, lost, report,
            )  # fmt: skip
        report[2] = count
        if count > meetings.who.shape[0]:
            report[3], report[4] = impacts_before, unsolved_before
            lost[0], lost[1], lost[2], lost[RAISED] = seconds_before, joules_before, stopped_before, raised_before
            return b
        work[b, 1] += 1 if rules.pairs else 0
        work[b, at_work] += report[3] - impacts_before
        work[b, at_work + 1] += report[4] - unsolved_before
        work[b, at_work + 2] += np.int64(lost[2] - stopped_before)
        bad = _write_bodies(period, x, v, b, ends, bodies)
        if bad >= 0 and report[0] < 0:
            report[0], report[1] = b, bad
    return -1


@kernel
def _move_bodies(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, before: Any, count: int,
    report: Any, lost: Any,
) -> int:  # fmt: skip
    """Move all bodies through the step; return the number of meetings, even if it exceeds their capacity."""
    start_touching(period, bodies, meetings, things, rules, count, before)
    impacts, cut, count = process_impacts(period, bodies, meetings, things, rules, count, lost)
    if count <= meetings.who.shape[0]:
        report[3] += impacts
        report[4] += cut
        for i in range(bodies.living.shape[0]):
            if bodies.moved[i] > 0:
                _write_end(period, bodies, ends, i, rules.seconds)
    return count


@kernel
def _write_end(period: Vec, bodies: Bodies, ends: Ends, i: int, seconds: float) -> None:
    """Write the position and velocity at which the path of body i ends."""
    left = seconds - bodies.since[i]
    v, a = vector_at(period, bodies.vel, i), vector_at(period, bodies.acc, i)
    write_vector(ends.pos, i, position_along(vector_at(period, bodies.at, i), v, a, left))
    now = zero(v) if bodies.moved[i] == STOPPED else add(v, scale(a, left))
    write_vector(ends.vel, i, add(now, vector_at(period, bodies.excess, i)))


@kernel
def _write_bodies(period: Vec, x: Any, v: Any, b: int, ends: Ends, bodies: Bodies) -> int:
    """Write all living bodies back into the batch; return the first whose state is not finite, or -1."""
    bad = -1
    for i in range(x.shape[2]):
        if bodies.living[i] == 0:
            continue
        at, now = vector_at(period, ends.pos, i), vector_at(period, ends.vel, i)
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
