"""Bodies that stop within a step, at the limit of impacts, or if the response has no impacts within a step.

A body that stops keeps its position for the rest of the step, and its velocity for the next one. That time is lost, but
neither energy nor momentum nor the order of bodies. A body that runs into a stopped body also stops. An obstacle that
moves into a stopped body pushes it, and the body pushes others.
"""

from __future__ import annotations

from typing import Any

from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.vectors import add, dot, scale, sub, zero
from flockenv.physics.constraints.bodies import (
    ANEW,
    GIVEN_UP,
    STOPPED,
    Bodies,
    Meetings,
    Rules,
    Things,
    contact_row,
    position,
    relative_motion,
    velocity,
)
from flockenv.physics.constraints.broad_phase import vector_at, write_vector
from flockenv.physics.constraints.impact import bounce, surface_at

__all__ = ["halt"]


@kernel
def halt(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, c: int, t: float, lost: Any
) -> None:
    """Stop the bodies of meeting c at time t; one that an obstacle pushes also pushes the other.

    A meeting is given up after a bounded number of hits, so that the step ends.
    """
    i, j = meetings.who[c], meetings.other[c]
    y, _, _ = relative_motion(period, bodies, things, i, j, t)
    row, _ = contact_row(bodies, things, i, j)
    _, n = surface_at(things.table, row, y)
    _stop(period, bodies, rules, i, t, lost)
    if j >= 0:
        _stop(period, bodies, rules, j, t, lost)
        _pass_push(period, bodies, i, j, n)
    else:
        _push_stopped(period, bodies, things, rules, i, -1 - j, n)
    if meetings.hits[c] > (ANEW + 1) * (rules.most + 1):
        meetings.closed[c] = GIVEN_UP


@kernel
def _stop(period: Vec, bodies: Bodies, rules: Rules, i: int, t: float, lost: Any) -> None:
    """Stop body i at time t: `excess` stores its velocity, and `vel` the velocity of an obstacle that pushes it."""
    write_vector(bodies.at, i, position(period, bodies, i, t))
    if bodies.moved[i] != STOPPED:
        write_vector(bodies.excess, i, add(vector_at(period, bodies.excess, i), velocity(period, bodies, i, t)))
        write_vector(bodies.vel, i, zero(period))
        write_vector(bodies.acc, i, zero(period))
        bodies.moved[i] = STOPPED
        lost[0] += rules.seconds - t
        lost[2] += 1.0
    bodies.since[i] = t


@kernel
def _push_stopped(period: Vec, bodies: Bodies, things: Things, rules: Rules, i: int, m: int, n: Vec) -> None:
    """Let obstacle m, moving along n, push a stopped body; the stored velocity bounces, or sticks."""
    drift, pushed = vector_at(period, things.drift, m), vector_at(period, bodies.vel, i)
    into = dot(sub(drift, pushed), n)
    if into <= 0.0 or bodies.light[i] == 0.0:
        return
    write_vector(bodies.vel, i, add(pushed, scale(n, into)))
    seen = sub(vector_at(period, bodies.excess, i), drift)
    after = zero(drift) if rules.sticky else bounce(seen, n, things.restitution[m], rules.friction)
    write_vector(bodies.excess, i, add(drift, after))


@kernel
def _pass_push(period: Vec, bodies: Bodies, i: int, j: int, n: Vec) -> None:
    """Let one of two stopped bodies, if it is pushed into the other, push that along n, which leads from j to i."""
    one, two = vector_at(period, bodies.vel, i), vector_at(period, bodies.vel, j)
    into = dot(sub(two, one), n)
    if into <= 0.0:
        return
    if (dot(one, n) < 0.0 and bodies.light[j] > 0.0) or bodies.light[i] == 0.0:
        write_vector(bodies.vel, j, sub(two, scale(n, into)))
    else:
        write_vector(bodies.vel, i, add(one, scale(n, into)))
