"""The end of a step of worlds with rigid bodies: contacts, positions, then velocities.

Contacts are solved twice, from the same velocities of the method. For positions each contact may close its gap within
the step, but not more, and overlaps open slowly; for velocities those that are closed at its end separate with the
restitution of the speed at which they approached at its start. So a body at rest neither bounces by its weight nor is
sped up by being moved out of another (Guendelman, Bridson and Fedkiw 2003, Nonconvex rigid bodies with stacking).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import Vec, kernel, routine
from flockenv.maths.vectors import add, cross, dot, norm, scale, sub
from flockenv.physics.constraints.rigid_contacts import Contacts, add_ball, add_pair, add_plane
from flockenv.physics.constraints.rigid_motion import (
    Solids,
    advance_axes,
    first_not_finite,
    load_bodies,
    put,
    row,
    spin_of,
    store_body,
)
from flockenv.physics.constraints.rigid_solver import apply_impulse, slide_speed, solve_contacts, sum_impulses

__all__ = ["Around", "BodyRules", "settle_bodies"]

NEAR = 0.02
"""Gap below which bodies at rest have a contact, in parts of the smaller distance from a centre to a corner."""

OPENS = 0.2
"""Part of an overlap that is removed in a step."""

CLOSED = 1e-6
"""Gap at the end of a step at which a contact is closed, in parts of that distance."""

SLIGHT = 1e-6
"""Change in a sweep, in parts of the largest change of velocity in the step, below which sweeps end."""

UNSOLVED = 0.1
"""The same, beyond which a step counts as unsolved."""

DEEP = 0.05
"""Overlap at the start of a step, in parts of that distance, from which it counts as unsolved."""


class BodyRules(NamedTuple):
    """Numbers of the constraint."""

    restitution: float
    friction: float
    sweeps: int
    dt: float  # s


class Around(NamedTuple):
    """Obstacles, other than blocks and round ones: planes."""

    point: Any  # (P, 3) m
    normal: Any  # (P, 3)
    bounce: Any  # (P,) restitution


@kernel
def _room(solids: Any, i: int, dt: float) -> float:
    """Return how far a point of a body may move in the step, m."""
    far = 0.0
    for k in range(2):
        speed = solids.free if k == 0 else solids.before
        far = max(far, norm(row(speed[0], i)) + norm(row(speed[1], i)) * solids.reach[i])
    return far * dt


@kernel
def _near(solids: Any, i: int, j: int) -> float:
    """Return the smaller distance from a centre to a corner, m."""
    return float(min(solids.reach[i], solids.reach[j]))


@routine
def _find_contacts(
    solids: Any, contacts: Any, around: Any, circles: Any, radii: Any, b: int, rules: Any, flat: bool
) -> int:
    """List all contacts of a world; return their number, which may exceed the room."""
    count, bodies, dt = 0, solids.first.shape[0], rules.dt
    for i in range(bodies):
        own = _room(solids, i, dt)
        margin = own + NEAR * solids.reach[i]
        for p in range(around.bounce.shape[0]):
            count = add_plane(
                solids, contacts, count, i, row(around.point, p), row(around.normal, p), around.bounce[p], margin, flat
            )
        for m in range(radii.shape[1]):
            if radii[b, m] > 0.0:
                middle = (circles[0, b, m], circles[1, b, m], 0.0 if flat else circles[circles.shape[0] - 1, b, m])
                count = add_ball(solids, contacts, count, i, middle, radii[b, m], rules.restitution, margin)
        for j in range(i + 1, solids.light.shape[0] - 1):
            margin = own + NEAR * _near(solids, i, j) + (_room(solids, j, dt) if j < bodies else 0.0)
            far = sub(row(solids.centre, j), row(solids.centre, i))
            reach = solids.reach[i] + solids.reach[j] + margin
            if dot(far, far) <= reach * reach:
                count = add_pair(solids, contacts, count, i, j, rules.restitution, margin, flat)
    return count


@kernel
def _hardest(solids: Any, contacts: Any, count: int, dt: float) -> float:
    """Return the largest change of a body's velocity by the method, or of opening an overlap, m/s.

    It is at least 1e-6 of the largest speed, and of 1e-3 of the distance from a centre to a corner per step.
    """
    most, fast = 0.0, 0.0
    for i in range(solids.first.shape[0]):
        for k in range(2):
            lever = 1.0 if k == 0 else solids.reach[i]
            most = max(most, lever * norm(sub(row(solids.free[k], i), row(solids.before[k], i))))
            fast = max(fast, lever * norm(row(solids.before[k], i)))
        fast = max(fast, 1e-3 * solids.reach[i] / dt)
    for c in range(count):
        most = max(most, -OPENS * contacts.gap[c] / dt)
    return max(most, 1e-6 * fast)


@kernel
def _restart(solids: Any) -> None:
    """Set velocities to those without contacts; what stands still too: impulses that overflow make it not finite."""
    for i in range(solids.light.shape[0]):
        for k in range(2):
            put(solids.speed[k], i, row(solids.free[k], i))


@routine
def _solve_positions(solids: Any, contacts: Any, count: int, rules: Any, hard: float, report: Any) -> float:
    """Compute the impulses with which bodies move through the step; return the last change of speed, m/s."""
    _restart(solids)
    for c in range(count):
        gap = contacts.gap[c]
        contacts.aim[c] = -(gap if gap > 0.0 else OPENS * gap) / rules.dt
    left = solve_contacts(solids, contacts, count, 0, rules.friction, rules.sweeps, SLIGHT * hard, report)
    sum_impulses(solids, contacts, count, 0, solids.shift)
    for c in range(count):
        i, j = contacts.body[c, 0], contacts.body[c, 1]
        if contacts.impulse[0, c, 0] > 0.0:
            solids.touched[i], solids.touched[j] = 1, 1
        end = contacts.gap[c] + rules.dt * slide_speed(solids, contacts, c, 0, solids.speed)
        closed = min(end, contacts.gap[c]) <= CLOSED * _near(solids, i, j) or contacts.impulse[0, c, 0] > 0.0
        came = slide_speed(solids, contacts, c, 0, solids.before)
        contacts.aim[c] = contacts.bounce[c] * max(-came, 0.0) if closed else -np.inf
    return left


@routine
def _solve_velocities(solids: Any, contacts: Any, count: int, rules: Any, hard: float, report: Any) -> float:
    """Compute the impulses that change velocities; return the last change of speed, m/s."""
    _restart(solids)
    for c in range(count):
        for k in range(3):
            by = contacts.impulse[0, c, k] if contacts.aim[c] > -np.inf else 0.0
            contacts.impulse[1, c, k] = by
            if by != 0.0:
                apply_impulse(solids, contacts, c, k, by)
    left = solve_contacts(solids, contacts, count, 1, rules.friction, rules.sweeps, SLIGHT * hard, report)
    sum_impulses(solids, contacts, count, 1, solids.push)
    return left


@kernel
def _impulse(contacts: Any, c: int, stage: int) -> Vec:
    """Return the impulse on the first body of a contact, kg m/s."""
    total: Vec = (0.0, 0.0, 0.0)
    for k in range(3):
        total = add(total, scale(row(contacts.way[c], k), contacts.impulse[stage, c, k]))
    return total


@routine
def _balance(solids: Any, contacts: Any, count: int, dt: float) -> None:
    """Give the angular momentum that moving two bodies along their contact takes from their orbit to their spins."""
    bodies = solids.first.shape[0]
    for c in range(count):
        i, j = contacts.body[c, 0], contacts.body[c, 1]
        if j < bodies:
            then = sub(row(solids.speed[0], i), row(solids.speed[0], j))
            free = sub(row(solids.free[0], i), row(solids.free[0], j))
            lost = sub(cross(_impulse(contacts, c, 0), then), cross(_impulse(contacts, c, 1), free))
            put(solids.push[1], i, sub(row(solids.push[1], i), scale(lost, 0.5 * dt)))
            put(solids.push[1], j, sub(row(solids.push[1], j), scale(lost, 0.5 * dt)))


@routine
def _move(solids: Any, x: Any, v: Any, b: int, count: int, dt: float) -> None:
    """Write the end of the step of all bodies."""
    for i in range(solids.first.shape[0]):
        moved, turn, speed = row(solids.moved, i), row(solids.turn, i), row(solids.free[0], i)
        twist, light = row(solids.twist, i), solids.light[i]
        if count > 0:
            if solids.touched[i] > 0:
                moved = scale(add(speed, scale(row(solids.shift[0], i), light)), dt)
                turn = add(twist, row(solids.shift[1], i))
            speed = add(speed, scale(row(solids.push[0], i), light))
            twist = add(twist, row(solids.push[1], i))
        advance_axes(solids, i, turn, dt)
        store_body(solids, x, v, b, i, add(row(solids.centre, i), moved), speed, spin_of(solids, i, twist))


@kernel
def _deepest(solids: Any, contacts: Any, count: int) -> float:
    """Return the deepest overlap of a contact, in parts of the smaller distance from a centre to a corner."""
    deep = 0.0
    for c in range(count):
        deep = max(deep, -contacts.gap[c] / _near(solids, contacts.body[c, 0], contacts.body[c, 1]))
    return deep


@kernel
def settle_bodies(
    x0: Any, v0: Any, x: Any, v: Any, circles: Any, radii: Any, solids: Solids, contacts: Contacts, around: Around,
    rules: BodyRules, work: Any, where: Any, first: int, end: int, report: Any, lost: Any,
) -> int:  # fmt: skip
    """Correct the steps of worlds [first, end) in place; return the world for which there was no room, or -1.

    where: (2,) columns of `work` of contacts and unsolved steps. report: (5,) sweeps, world and agent that are not
    finite, or -1s, contacts of the last world, and unsolved steps. lost: (2,) the largest change of speed that was
    left, m/s, and the deepest overlap of those, in parts of the distance from a centre to a corner.
    """
    report[0], report[1], report[2], report[3], report[4], lost[0], lost[1] = 0, -1, -1, 0, 0, 0.0, 0.0
    for b in range(first, end):
        bad, left = load_bodies(solids, x0, v0, x, v, b, rules.dt), 0.0
        if bad >= 0:
            if report[1] < 0:
                report[1], report[2] = b, bad
            continue
        count = _find_contacts(solids, contacts, around, circles, radii, b, rules, x.shape[0] == 2)
        report[3] = count
        if count > contacts.gap.shape[0]:
            return b
        hard = _hardest(solids, contacts, count, rules.dt)
        if count > 0:
            left = _solve_positions(solids, contacts, count, rules, hard, report)
            left = max(left, _solve_velocities(solids, contacts, count, rules, hard, report))
            _balance(solids, contacts, count, rules.dt)
        _move(solids, x, v, b, count, rules.dt)
        bad = first_not_finite(x, v, b)
        if bad >= 0 and report[1] < 0:
            report[1], report[2] = b, bad
        work[b, where[0]] += count
        deep = _deepest(solids, contacts, count)
        if left > UNSOLVED * hard or deep > DEEP:
            work[b, where[1]] += 1
            report[4] += 1
            lost[0], lost[1] = max(lost[0], left if left > UNSOLVED * hard else 0.0), max(lost[1], deep)
    return -1
