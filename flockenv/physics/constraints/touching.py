"""Contacts with obstacles at the beginning of a step, for a method that solves its equations with them.

A contact is a condition on the change of velocity dv of one body: n . dv = rise, with the normal n at the place to
which its velocity leads. With `rise` a body that reaches the surface ends the step on it. One that touches or overlaps
it already keeps its gap, since an overlap must not accelerate a body (collisions move it out).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.vectors import dot, norm, sub
from flockenv.physics.constraints.bodies import Bodies, Meetings, Rules, Things
from flockenv.physics.constraints.broad_phase import vector_at, write_vector
from flockenv.physics.constraints.candidates import add_obstacle_pairs
from flockenv.physics.constraints.collision_step import place_obstacles
from flockenv.physics.constraints.contacts import NEARLY, Ends, gap_and_normal

__all__ = ["Touching", "find_touching", "touching_of"]

SAME_SIDE = 0.5
"""Least cosine between the normals at both ends of a straight step; a body that turns further has passed an edge."""


class Touching(NamedTuple):
    """The contacts of each of N bodies with obstacles, at most D, in the order of `rise`, the largest first."""

    count: Any  # (N,)
    normal: Any  # (N, D, D), of each contact, out of the obstacle
    rise: Any  # (N, D) m/s, the change of velocity along the normal
    approach: Any  # (N, D) m/s, the speed of approach at the beginning
    restitution: Any  # (N, D)
    slip: Any  # (N, D) m/s, velocity of the first obstacle less that of the body


def touching_of(bodies: int, dimension: int) -> Touching:
    """Return room for the contacts of a number of bodies."""
    n, d = bodies, dimension
    return Touching(
        np.zeros(n, np.int64), np.zeros((n, d, d)), np.zeros((n, d)), np.zeros((n, d)), np.zeros((n, d)),
        np.zeros((n, d)),
    )  # fmt: skip


@kernel
def _load(
    period: Vec, x: Any, v: Any, flow: Any, alive: Any, bodies: Bodies, ends: Ends, reach: Any, rules: Rules
) -> float:
    """Load motion (D, N) and the ends of straight steps; return the largest coordinate of a living body, m."""
    far = 0.0
    for i in range(x.shape[1]):
        bodies.living[i] = 1 if alive[i] else 0
        for k in range(len(period)):
            bodies.start[i, k], bodies.vel[i, k] = x[k, i], v[k, i]
            if flow.shape[1] > 0:
                bodies.vel[i, k] += flow[k, i]
            ends.pos[i, k] = x[k, i] + rules.seconds * bodies.vel[i, k]
            far = max(far, abs(x[k, i]), abs(ends.pos[i, k])) if alive[i] else far
        reach[i] = norm(vector_at(period, bodies.vel, i)) * rules.seconds + NEARLY * bodies.radius[i]
    return far


@kernel
def _add(period: Vec, touching: Touching, i: int, n: Vec, rise: float, approach: float, e: float, slip: Vec) -> None:
    """Insert a contact of body i; the one with the least rise is dropped if there is no room."""
    place = touching.count[i]
    while place > 0 and touching.rise[i, place - 1] < rise:
        place -= 1
    if place == len(period):
        return
    touching.count[i] = min(touching.count[i] + 1, len(period))
    for k in range(touching.count[i] - 1, place, -1):
        write_vector(touching.normal[i], k, vector_at(period, touching.normal[i], k - 1))
        touching.rise[i, k], touching.approach[i, k] = touching.rise[i, k - 1], touching.approach[i, k - 1]
        touching.restitution[i, k] = touching.restitution[i, k - 1]
    write_vector(touching.normal[i], place, n)
    touching.rise[i, place], touching.approach[i, place], touching.restitution[i, place] = rise, approach, e
    if place == 0:
        write_vector(touching.slip, i, slip)


@kernel
def find_touching(
    period: Vec, x: Any, v: Any, flow: Any, alive: Any, obstacle_x: Any, obstacle_radius: Any, bodies: Bodies,
    meetings: Meetings, things: Things, ends: Ends, reach: Any, rules: Rules, exact: float, begun: float,
    touching: Touching,
) -> int:  # fmt: skip
    """Write the contacts of one world, in a step of rules.seconds from `begun`, s; return the number of near pairs.

    x, v, flow: (D, N) m, m/s, of the bodies and of what carries them, or (D, 0); exact: rounding error of a coordinate,
    relative to its size. A body touches an obstacle if its velocity leads it to the surface, or nearer than a tenth of
    its radius. With a restitution above 0, or sticky, only if the two touch already. If there are more pairs than
    capacity, the caller must repeat the call with more room.
    """
    far = _load(period, x, v, flow, alive, bodies, ends, reach, rules)
    for i in range(touching.count.shape[0]):
        touching.count[i] = 0
    if not far < np.inf:
        return 0
    touch, h = rules.touch + exact * far, rules.seconds
    place_obstacles(period, things, obstacle_x, obstacle_radius, 0, begun, begun + h)
    count = add_obstacle_pairs(period, bodies, meetings, things, bodies.start, reach, h, touch, True, 0)
    if count > meetings.who.shape[0]:
        return count
    for c in range(count):
        i, j = meetings.who[c], meetings.other[c]
        e = 0.0 if rules.sticky else things.restitution[-1 - j]
        gap, first = gap_and_normal(period, bodies, things, bodies.start, ends, 0.0, i, j)
        then, n = gap_and_normal(period, bodies, things, ends.pos, ends, h, i, j)
        margin = max(touch, NEARLY * bodies.radius[i])
        here = gap <= touch if rules.sticky else then <= margin and (gap <= margin or e == 0.0)
        if here and dot(first, n) > SAME_SIDE:
            slip = sub(vector_at(period, things.drift, -1 - j), vector_at(period, bodies.vel, i))
            _add(period, touching, i, n, ((gap if gap <= touch else 0.0) - then) / h, dot(slip, n), e, slip)
    return count
