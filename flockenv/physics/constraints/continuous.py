"""Straight paths, for responses that use the end of a step only, so that no body tunnels through another.

After impacts and contacts have changed velocities, each body moves in a straight line to its position at the end of the
step. If it would enter another body or an obstacle, it stops at contact, and has its impact in the next step.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.jit.decorators import Vec, kernel, routine
from flockenv.maths.vectors import norm, scale, sub, zero
from flockenv.physics.constraints.bodies import (
    DEEP,
    GIVEN_UP,
    STOPPED,
    Bodies,
    Meetings,
    Rules,
    Things,
    add_to_lists,
    contact_row,
    relative_motion,
    widen_reach,
    width,
)
from flockenv.physics.constraints.broad_phase import displacement_near, vector_at, write_vector
from flockenv.physics.constraints.contacts import Ends
from flockenv.physics.constraints.event_driven import process_impacts
from flockenv.physics.constraints.impact import surface_at

__all__ = ["may_meet_around", "may_pass", "set_reach", "stop_on_path"]

SLOW = 0.75
"""Fraction of its radius that a body may move in a step without passing another that it touches."""

LOST = 0.5
"""Overlap, as a fraction of the smaller radius, from which on the order of two bodies is undefined."""


@kernel
def may_meet_around(period: Vec, path: float) -> bool:
    """Return True if bodies with paths `path` m long may touch at other images than the nearest."""
    least = np.inf
    for k in range(len(period)):
        least = min(least, period[k])
    return bool(4.0 * path > least > 0.0)


@routine
def may_pass(period: Vec, bodies: Bodies, things: Things, ends: Ends, seconds: float, turned: bool) -> bool:
    """Return True if some body moves so far in the step, or an obstacle relative to it, that one may pass the other.

    turned: True if impacts have changed the paths of bodies.
    """
    drift = 0.0
    for k in range(things.moving.shape[0]):
        drift = max(drift, norm(vector_at(period, things.drift, things.moving[k])))
    for i in range(bodies.living.shape[0]):
        if bodies.living[i] > 0 and bodies.light[i] > 0.0:
            moved = norm(_path(period, bodies, ends, i, seconds)) if turned else bodies.reach[i]
            if moved + drift * seconds > SLOW * bodies.radius[i]:
                return True
    return False


@kernel
def set_reach(period: Vec, bodies: Bodies, ends: Ends, seconds: float) -> None:
    """Set the reach of each body to the distance from the beginning to the end of its step."""
    for i in range(bodies.living.shape[0]):
        bodies.reach[i] = norm(_path(period, bodies, ends, i, seconds))


@kernel
def _path(period: Vec, bodies: Bodies, ends: Ends, i: int, seconds: float) -> Vec:
    """Return the vector from the beginning to the end of the step of body i, m."""
    apart = sub(vector_at(period, ends.pos, i), vector_at(period, bodies.start, i))
    return displacement_near(period, apart, scale(vector_at(period, ends.vel, i), seconds))


@routine
def stop_on_path(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, strict: bool, count: int,
    lost: Any,
) -> int:  # fmt: skip
    """Stop bodies where their paths are blocked; return the number of meetings, even if it exceeds their capacity.

    rules.stops must be set. strict: True if no two bodies may overlap by more than at the beginning of the step, or
    than DEEP; two that began with an overlap of more than LOST have no order to keep. A body that stops keeps its
    velocity after impacts, less the step's acceleration times the rest of the step.
    """
    n, seconds, known = bodies.living.shape[0], rules.seconds, count
    for i in range(n):
        if strict and bodies.moved[i] == STOPPED:  # its velocity is already that at the stop
            write_vector(bodies.free, i, zero(period))
        straight = scale(_path(period, bodies, ends, i, seconds), 1.0 / seconds)
        write_vector(bodies.at, i, vector_at(period, bodies.start, i))
        write_vector(bodies.vel, i, straight)
        write_vector(bodies.acc, i, zero(period))
        write_vector(bodies.excess, i, sub(vector_at(period, ends.vel, i), straight))
        bodies.since[i], bodies.moved[i], bodies.first[i] = 0.0, 0, -1
    for c in range(known):
        add_to_lists(bodies, meetings, c)
    for i in range(n):
        if bodies.living[i] > 0 and bodies.light[i] > 0.0:
            count = widen_reach(period, bodies, meetings, things, rules, i, 0.0, count)
    if count > meetings.who.shape[0]:
        return count
    for c in range(count):
        i, j = meetings.who[c], meetings.other[c]
        y, _, _ = relative_motion(period, bodies, things, i, j, 0.0)
        row, room = contact_row(bodies, things, i, j)
        begun = surface_at(things.table, row, y)[0] - room
        if strict:
            wide = width(bodies, i, j)
            meetings.deep[c] = max(DEEP * wide, -begun) + 10.0 * rules.touch
            meetings.closed[c] = GIVEN_UP if -begun > LOST * wide else 0
            continue
        # two bodies that begin near each other rest, with a small separation; a body that comes from afar stops at
        # the surface, or separation would lift it out
        near = max(DEEP * width(bodies, i, j) - max(begun, 0.0), 0.0)
        meetings.deep[c] = near + 10.0 * rules.touch + max(-begun, 0.0)
    _, _, count = process_impacts(period, bodies, meetings, things, rules, count, lost)
    if count <= meetings.who.shape[0]:
        for i in range(n):
            if bodies.moved[i] == STOPPED:
                _write_stop(period, bodies, ends, i, seconds)
    return count


@kernel
def _write_stop(period: Vec, bodies: Bodies, ends: Ends, i: int, seconds: float) -> None:
    """Write the position where body i stopped, or to which an obstacle pushed it, and its velocity."""
    left = seconds - bodies.since[i]
    for k in range(len(period)):
        ends.pos[i, k] = bodies.at[i, k] + bodies.vel[i, k] * left
        ends.vel[i, k] = bodies.excess[i, k] - bodies.free[i, k] * left
