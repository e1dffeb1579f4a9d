"""Bodies that stop within a step: when the impact limit is reached, or the response has no impacts within a step.

A body that stops keeps its place for the rest of the step, and its velocity for the next one. The time that it does not
move is lost; energy, momentum and the order of bodies are not. A body that runs into a stopped body also stops. An
obstacle that moves into a stopped body pushes it, and the body pushes others.
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
    met,
    position,
    relative,
    velocity,
)
from flockenv.physics.constraints.broad_phase import vector, write
from flockenv.physics.constraints.impact import bounced, surface

__all__ = ["halt"]


@kernel
def halt(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, rules: Rules, c: int, t: float, lost: Any
) -> None:
    """Stop the bodies of meeting c at time t; a body that is pushed already pushes the other.

    A meeting is given up after a bounded number of hits, so that the step ends.
    """
    i, j = meetings.who[c], meetings.other[c]
    y, _, _ = relative(period, bodies, things, i, j, t)
    row, _ = met(bodies, things, i, j)
    _, n = surface(things.table, row, y)
    _stop(period, bodies, rules, i, t, lost)
    if j >= 0:
        _stop(period, bodies, rules, j, t, lost)
        _push_on(period, bodies, i, j, n)
    else:
        _push(period, bodies, things, rules, i, -1 - j, n)
    if meetings.hits[c] > (ANEW + 1) * (rules.most + 1):
        meetings.closed[c] = GIVEN_UP


@kernel
def _stop(period: Vec, bodies: Bodies, rules: Rules, i: int, t: float, lost: Any) -> None:
    """Stop body i at time t: `excess` stores its velocity, and `vel` that by which an obstacle pushes it."""
    write(bodies.at, i, position(period, bodies, i, t))
    if bodies.moved[i] != STOPPED:
        write(bodies.excess, i, add(vector(period, bodies.excess, i), velocity(period, bodies, i, t)))
        write(bodies.vel, i, zero(period))
        write(bodies.acc, i, zero(period))
        bodies.moved[i] = STOPPED
        lost[0] += rules.seconds - t
        lost[2] += 1.0
    bodies.since[i] = t


@kernel
def _push(period: Vec, bodies: Bodies, things: Things, rules: Rules, i: int, m: int, n: Vec) -> None:
    """Let obstacle m, moving along n, push a stopped body; the stored velocity bounces, or sticks."""
    drift, pushed = vector(period, things.drift, m), vector(period, bodies.vel, i)
    into = dot(sub(drift, pushed), n)
    if into <= 0.0 or bodies.light[i] == 0.0:
        return
    write(bodies.vel, i, add(pushed, scale(n, into)))
    seen = sub(vector(period, bodies.excess, i), drift)
    after = zero(drift) if rules.sticky else bounced(seen, n, things.restitution[m], rules.friction)
    write(bodies.excess, i, add(drift, after))


@kernel
def _push_on(period: Vec, bodies: Bodies, i: int, j: int, n: Vec) -> None:
    """Let one of two stopped bodies that is pushed into the other push it along n; n leads to i from j."""
    one, two = vector(period, bodies.vel, i), vector(period, bodies.vel, j)
    into = dot(sub(two, one), n)
    if into <= 0.0:
        return
    if (dot(one, n) < 0.0 and bodies.light[j] > 0.0) or bodies.light[i] == 0.0:
        write(bodies.vel, j, sub(two, scale(n, into)))
    else:
        write(bodies.vel, i, add(one, scale(n, into)))
