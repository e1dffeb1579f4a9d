"""The meetings of a step: pairs of bodies, or of a body and an obstacle, that may touch within it or at its end."""

from __future__ import annotations

from typing import Any

from flockenv.geometry.shapes.row_header import bound_of
from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.vectors import add, dot, norm, scale, sub, zero
from flockenv.physics.constraints.bodies import Bodies, Meetings, Rules, Things, add_to_lists
from flockenv.physics.constraints.broad_phase import list_near_pairs, nearest_image, vector_at
from flockenv.physics.constraints.contacts import NEARLY, Ends
from flockenv.physics.constraints.impact import surface_at

__all__ = ["list_meetings"]


@kernel
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
    count = _add_obstacle_pairs(
        period, bodies, meetings, things, where, reach, rules.seconds, rules.touch, ahead, count
    )
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
def _add_obstacle_pairs(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, at: Any, reach: Any, seconds: float, touch: float,
    ahead: bool, count: int,
) -> int:  # fmt: skip
    """Add pairs of a body and an obstacle that may touch, within the step or at its end; return the number of pairs."""
    capacity = meetings.who.shape[0]
    for m in range(things.row.shape[0]):
        if things.size[m] < 0.0:
            continue
        drift, place = vector_at(period, things.drift, m), vector_at(period, things.place, m)
        place = place if ahead else add(place, scale(drift, seconds))
        travel = norm(drift) * seconds if ahead else 0.0
        bounded, middle, radius = things.row[m] >= 0, zero(period), things.size[m]
        if bounded:
            middle, radius = bound_of(things.table, things.row[m], period)
        for i in range(bodies.living.shape[0]):
            if bodies.living[i] > 0 and bodies.light[i] > 0.0:
                y = nearest_image(period, sub(vector_at(period, at, i), place))
                room = bodies.radius[i] + touch + travel + reach[i]
                off, far = sub(y, middle), radius + room
                if bounded and not dot(off, off) <= far * far:
                    continue  # outside the bounding circle or sphere
                gap, _ = surface_at(things.table, things.row[m], y)
                if gap - things.size[m] <= room:
                    if count < capacity:
                        meetings.who[count], meetings.other[count] = i, -1 - m
                    count += 1
    return count
