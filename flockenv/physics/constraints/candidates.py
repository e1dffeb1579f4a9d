"""The meetings of a step: pairs of bodies, or of a body and an obstacle, that may touch within it or at its end."""

from __future__ import annotations

from typing import Any

from flockenv.geometry.shapes.cells import count_of, is_near_box, list_of, row_of_entry, span_of
from flockenv.geometry.shapes.row_header import bound_of
from flockenv.geometry.shapes.row_header import vector_at as vector_in
from flockenv.jit.decorators import Vec, kernel, routine
from flockenv.maths.vectors import add, dot, equal_coordinates, norm, scale, sub
from flockenv.physics.constraints.bodies import Bodies, Meetings, Rules, Things, add_to_lists
from flockenv.physics.constraints.broad_phase import list_near_pairs, nearest_image, vector_at
from flockenv.physics.constraints.contacts import NEARLY, Ends, sort_by_rank
from flockenv.physics.constraints.impact import surface_at

__all__ = ["add_obstacle_pairs", "list_meetings"]


@routine
def list_meetings(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, reach: Any,
    ahead: bool, nearly: bool, scratch: Any,
) -> int:  # fmt: skip
    """List the pairs that may touch within the step (ahead), or at its end; return their number.

    The number may exceed the capacity of `meetings`; then some pairs are not written.
    nearly: True if pairs with a gap of up to a tenth of their radii also count.
    """
    grid, order, cell, start, offset, bounds, sync, ranges = scratch
    n, count = bodies.living.shape[0], 0
    where = bodies.start if ahead else ends.pos
    if ahead:
        _enlarge_reach(bodies)
    for i in range(n):
        bodies.first[i] = -1
        reach[i] = (bodies.reach[i] if ahead else 0.0) + (rules.touch + NEARLY * bodies.radius[i] if nearly else 0.0)
    if rules.pairs:
        count = list_near_pairs(
            period, where, bodies.living, bodies.radius, reach, n, grid, order, cell, start, offset, bounds, sync,
            ranges, meetings.who, meetings.other,
        )  # fmt: skip
    count = add_obstacle_pairs(period, bodies, meetings, things, where, reach, rules.seconds, rules.touch, ahead, count)
    if count <= meetings.who.shape[0]:
        for c in range(count):
            add_to_lists(bodies, meetings, c)
    return count


@kernel
def _enlarge_reach(bodies: Bodies) -> None:
    """Enlarge the reach of all bodies, so that few leave it after an impact."""
    total, present = 0.0, 0
    for i in range(bodies.living.shape[0]):
        if bodies.living[i] > 0:
            total, present = total + bodies.reach[i], present + 1
    for i in range(bodies.living.shape[0]):
        bodies.reach[i] = max(1.25 * bodies.reach[i], 1.5 * total / max(present, 1))


@kernel
def add_obstacle_pairs(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, at: Any, reach: Any, seconds: float, touch: float,
    ahead: bool, count: int,
) -> int:  # fmt: skip
    """Add pairs of a body and an obstacle that may touch, within the step or at its end; return the number of pairs.

    They are in the order of obstacles, and of bodies for each obstacle, whether the grid lists them or not.
    """
    if things.listed[0] > 0:
        found = _list_by_grid(period, bodies, meetings, things, at, reach, seconds, touch, ahead)
        if found <= meetings.near.shape[1]:
            return _add_listed(bodies, meetings, found, count)
    capacity = meetings.who.shape[0]
    for m in range(things.row.shape[0]):
        if things.size[m] >= 0.0:
            for i in range(bodies.living.shape[0]):
                if _may_touch(period, bodies, things, at, reach, seconds, touch, ahead, i, m):
                    if count < capacity:
                        meetings.who[count], meetings.other[count] = i, -1 - m
                    count += 1
    return count


@kernel
def _may_touch(
    period: Vec, bodies: Bodies, things: Things, at: Any, reach: Any, seconds: float, touch: float, ahead: bool, i: int,
    m: int,
) -> bool:  # fmt: skip
    """Return True if body i may touch obstacle m, within the step or at its end."""
    if bodies.living[i] == 0 or not bodies.light[i] > 0.0:
        return False
    drift, place = vector_at(period, things.drift, m), vector_at(period, things.place, m)
    place = place if ahead else add(place, scale(drift, seconds))
    travel = norm(drift) * seconds if ahead else 0.0
    y = nearest_image(period, sub(vector_at(period, at, i), place))
    room = bodies.radius[i] + touch + travel + reach[i]
    if things.row[m] >= 0:
        middle, radius = bound_of(things.table, things.row[m], period)
        off, far = sub(y, middle), radius + room
        if not dot(off, off) <= far * far:
            return False  # outside the bounding circle or sphere
    gap, _ = surface_at(things.table, things.row[m], y)
    return bool(gap - things.size[m] <= room)


@kernel
def _list_by_grid(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, at: Any, reach: Any, seconds: float, touch: float,
    ahead: bool,
) -> int:  # fmt: skip
    """Write pairs that may touch to `meetings.near`, m N + i for body i and obstacle m, some of them several times.

    Return their number; if it exceeds the capacity, not all are written.
    """
    n, found, capacity = bodies.living.shape[0], 0, meetings.near.shape[1]
    length = 1 + 2 * len(period)  # see cells.entry_length
    for i in range(n):
        if bodies.living[i] > 0 and bodies.light[i] > 0.0:
            x = vector_at(period, at, i)
            room = equal_coordinates(period, bodies.radius[i] + touch + reach[i])
            span = span_of(things.cells, 0, x, room)
            for k in range(count_of(span)):
                begin, end = list_of(things.cells, 0, x, span, k)
                for entry in range(begin, end, length):
                    to = nearest_image(period, sub(vector_in(things.cells, entry + 1, x), x))
                    m = row_of_entry(things.cells, entry)
                    near = is_near_box(things.cells, entry, to, room)
                    if near and _may_touch(period, bodies, things, at, reach, seconds, touch, ahead, i, m):
                        if found < capacity:
                            meetings.near[0, found], meetings.near[1, found] = m * n + i, found
                        found += 1
    return found


@kernel
def _add_listed(bodies: Bodies, meetings: Meetings, found: int, count: int) -> int:
    """Add the pairs of `meetings.near`, sorted and each once; return the number of pairs."""
    n, before = bodies.living.shape[0], -1
    sort_by_rank(meetings.near[0], meetings.near[1], found)
    for k in range(found):
        pair = meetings.near[0, meetings.near[1, k]]
        if pair != before:
            if count < meetings.who.shape[0]:
                meetings.who[count], meetings.other[count] = pair % n, -1 - pair // n
            count += 1
        before = pair
    return count
