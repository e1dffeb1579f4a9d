"""The end of a step of one world: impulses of all contacts, blocked paths, and resolution of overlaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.vectors import add, dot, norm, scale, sub, zero
from flockenv.physics.constraints.bodies import DEEP, Bodies, Meetings, Rules, Things, widen_reach
from flockenv.physics.constraints.broad_phase import displacement_near, nearest_image, vector_at, write_vector
from flockenv.physics.constraints.candidates import list_meetings
from flockenv.physics.constraints.contacts import (
    NEARLY,
    Contacts,
    Ends,
    deepest_overlap,
    gather_contacts,
    move_apart,
    resolve_impacts,
    stop_approach,
)
from flockenv.physics.constraints.continuous import may_pass, set_reach, stop_on_path

__all__ = ["settle_ends"]

UNSOLVED = 0.1
"""Approach speed that counts as unsolved, as a fraction of the velocity that a step adds."""

ROUNDS = 8
"""Largest number of times that contacts are gathered, if separated bodies overlap others."""

CROWDED = 0.5
"""Move of a body in the single pass of `project`, as a fraction of its radius, beyond which more passes follow."""

DEEPEST = 0.25
"""Overlap after the passes that separate bodies, as a fraction of the smaller radius, beyond which bodies stop."""

RAISED = 4
"""Index in `lost` of the energy, J, of bodies that were moved apart against the step's acceleration."""

LEFT, SUNK = 5, 6
"""Indices in `lost` of the largest residuals of a step: the largest change of velocity of the last pass, m/s, and the
deepest overlap, as a part of the smaller radius."""


@kernel
def settle_ends(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, contacts: Contacts, ends: Ends, before: Any,
    reach: Any, rules: Rules, in_time: bool, once: bool, passing: bool, rounds: int, fast: float, hard: float, up: Vec,
    spread: float, round_about: bool, count: int, scratch: Any, lost: Any, report: Any,
) -> int:  # fmt: skip
    """Solve all contacts of the step's end, velocities, then positions; return the number of meetings.

    up: unit vector against the mean acceleration; round_about: True if paths on a torus are so long that the order of
    bodies is undefined.
    """
    least = 1e-12 * fast
    slow, gain = 1e-3 * hard * rules.seconds + least, 1e-6 * hard * rules.seconds + least
    left, deep, unsolved_before = 0.0, 0.0, report[4]
    touching = gather_contacts(
        period, bodies, meetings, things, ends, contacts, rules.seconds, up, rules.touch, slow,
        rules.restitution, in_time, passing, count,
    )  # fmt: skip
    if touching > 0:
        left = _solve_velocities(
            period, bodies, things, contacts, ends, before, rules, in_time, once, rounds, hard, least, gain, touching,
            report,
        )  # fmt: skip
    turned = touching > 0 and not in_time and not once and _has_moved_far(period, bodies, ends, bodies.at, 0.5 * DEEP)
    again = passing or (turned and may_pass(period, bodies, things, ends, rules.seconds, True))
    if again:
        count = stop_on_path(period, bodies, meetings, things, ends, rules, False, count, lost)
    elif turned:
        count = _add_late_meetings(period, bodies, meetings, things, ends, rules, count)
    held = False
    if (touching > 0 or again) and count <= meetings.who.shape[0]:
        for i in range(bodies.living.shape[0]):  # velocities before the step are no longer used
            write_vector(before, i, vector_at(period, ends.pos, i))
        count, deep, stuck = _separate_bodies(
            period, bodies, meetings, things, contacts, ends, reach, rules, once, again or turned, rounds, up, spread,
            touching, count, scratch,
        )  # fmt: skip
        lost[RAISED] += _lifting_energy(period, bodies, ends, before)
        if not in_time and not round_about and count <= meetings.who.shape[0]:
            stopped = lost[2]
            count = _hold_back(
                period, bodies, meetings, things, ends, before, reach, rules, once, stuck, spread, count, scratch, lost
            )  # fmt: skip
            held = lost[2] > stopped
    limit = DEEP * _largest_radius(bodies) + 1e3 * rules.touch
    unsolved = left > UNSOLVED * hard * rules.seconds + 1e3 * gain or deep > limit
    if held or (unsolved and not once):
        report[4] += 1
        lost[LEFT] = max(lost[LEFT], 0.0 if once else left)
    if report[4] > unsolved_before and count <= meetings.who.shape[0]:
        worst = deepest_overlap(period, bodies, things, ends, rules.seconds, meetings.who, meetings.other, count)
        lost[SUNK] = max(lost[SUNK], worst)
    return count


@kernel
def _hold_back(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, before: Any, reach: Any, rules: Rules,
    once: bool, stuck: bool, spread: float, count: int, scratch: Any, lost: Any,
) -> int:  # fmt: skip
    """Stop bodies where the straight paths to their separated places are blocked; return the number of meetings.

    before (N, D) m: positions before separation; stuck: True if the passes did not suffice. They may move a light body
    past a heavy one, or leave it inside if others block it. Bodies begin the step in order, and stopping at the first
    contact keeps that order.
    """
    if not stuck and not (once and _has_moved_far(period, bodies, ends, before, NEARLY)):
        return count
    set_reach(period, bodies, ends, rules.seconds)
    count = list_meetings(period, bodies, meetings, things, ends, rules, reach, True, True, scratch)
    if count > meetings.who.shape[0]:
        return count
    worst = deepest_overlap(period, bodies, things, ends, rules.seconds, meetings.who, meetings.other, count)
    far = spread == np.inf and worst > DEEPEST
    if far or (once and may_pass(period, bodies, things, ends, rules.seconds, True)):
        count = stop_on_path(period, bodies, meetings, things, ends, rules, True, count, lost)
    return count


@kernel
def _lifting_energy(period: Vec, bodies: Bodies, ends: Ends, before: Any) -> float:
    """Return the energy gained, J, by moving bodies from `before` (N, D) m against the step's acceleration.

    It is mass times acceleration times move. Moves along the acceleration are not subtracted, so this is an upper
    bound.
    """
    joules = 0.0
    for i in range(bodies.living.shape[0]):
        if bodies.living[i] > 0 and bodies.light[i] > 0.0:
            move = nearest_image(period, sub(vector_at(period, ends.pos, i), vector_at(period, before, i)))
            joules += max(-dot(vector_at(period, bodies.free, i), move), 0.0) / bodies.light[i]
    return joules


@kernel
def _solve_velocities(
    period: Vec, bodies: Bodies, things: Things, contacts: Contacts, ends: Ends, before: Any, rules: Rules,
    in_time: bool, once: bool, rounds: int, hard: float, least: float, gain: float, count: int, report: Any,
) -> float:  # fmt: skip
    """Change velocities until no body approaches another; return the last pass's largest change, m/s."""
    passes, seconds, n = 1 if once else rounds, rules.seconds, bodies.living.shape[0]
    if not in_time:
        for i in range(n):  # the velocity added by the step follows after the impacts; slower approaches do not bounce
            write_vector(bodies.vel, i, vector_at(period, ends.vel, i))
            write_vector(bodies.acc, i, sub(vector_at(period, ends.vel, i), vector_at(period, before, i)))
        done, left = resolve_impacts(
            period, bodies, things, contacts, before, rules.restitution, rules.friction, rules.sticky, passes,
            hard * seconds + least, count,
        )  # fmt: skip
        report[3] += done
        report[4] += 1 if left > 0 else 0
        for i in range(n):
            write_vector(ends.vel, i, add(vector_at(period, before, i), vector_at(period, bodies.acc, i)))
    worst = stop_approach(period, bodies, things, contacts, ends.vel, rules.friction, rules.sticky, passes, gain, count)
    if not in_time and not once:
        for i in range(n):
            write_vector(bodies.at, i, vector_at(period, ends.pos, i))
        for i in range(n):  # changed bodies go from their start at their final velocity, under every method
            now = vector_at(period, ends.vel, i)
            more = sub(now, vector_at(period, bodies.vel, i))
            if dot(more, more) > 0.0:
                write_vector(ends.pos, i, add(vector_at(period, bodies.start, i), scale(now, seconds)))
    return float(worst)


@kernel
def _separate_bodies(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, contacts: Contacts, ends: Ends, reach: Any,
    rules: Rules, once: bool, anew: bool, rounds: int, up: Vec, spread: float, touching: int, count: int, scratch: Any,
) -> tuple[int, float, bool]:  # fmt: skip
    """Move overlapping bodies apart; return the number of meetings, the last pass's largest move, m, and `stuck`.

    stuck: True if two still overlap by DEEPEST, or bodies were still moved when rounds ran out; always False if
    `spread`, m, limits the separation.
    anew: True if bodies have moved since contacts were gathered. Contacts are gathered again if bodies are moved so far
    that they may overlap others; with a finite `spread`, bodies are moved once.
    """
    deep, elsewhere, settled, done = 0.0, False, False, False
    for turn in range(ROUNDS):
        if turn > 0 and (elsewhere or _is_beyond_reach(period, bodies, ends, reach)):
            elsewhere = True
            count = list_meetings(period, bodies, meetings, things, ends, rules, reach, False, True, scratch)
        if count > meetings.who.shape[0]:
            return count, deep, False
        if turn > 0 or anew:
            touching = gather_contacts(
                period, bodies, meetings, things, ends, contacts, rules.seconds, up, rules.touch, 0.0,
                rules.restitution, False, False, count,
            )  # fmt: skip
        for i in range(bodies.living.shape[0]):
            write_vector(bodies.at, i, vector_at(period, ends.pos, i))
        deep = move_apart(
            period, bodies, things, ends, rules.seconds, 1 if once else rounds, rules.touch, spread, contacts, touching
        )
        crowded = False
        if once:
            left = deepest_overlap(period, bodies, things, ends, rules.seconds, contacts.who, contacts.other, touching)
            crowded = left > DEEPEST or _has_moved_far(period, bodies, ends, bodies.at, CROWDED)
        if crowded:
            deep = move_apart(
                period, bodies, things, ends, rules.seconds, rounds, rules.touch, spread, contacts, touching
            )
        done = (once and not crowded) or spread < np.inf
        settled = not _has_moved_far(period, bodies, ends, bodies.at, NEARLY if once else 0.5 * DEEP)
        if done or settled:
            break
    left = deepest_overlap(period, bodies, things, ends, rules.seconds, contacts.who, contacts.other, touching)
    return count, deep, spread == np.inf and (left > DEEPEST or not (done or settled))


@kernel
def _is_beyond_reach(period: Vec, bodies: Bodies, ends: Ends, reach: Any) -> bool:
    """Return True if a body is further from its start than the reach for which meetings were listed."""
    for i in range(bodies.living.shape[0]):
        moved = nearest_image(period, sub(vector_at(period, ends.pos, i), vector_at(period, bodies.start, i)))
        if bodies.living[i] > 0 and norm(moved) > max(reach[i], bodies.reach[i]):
            return True
    return False


@kernel
def _add_late_meetings(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, rules: Rules, count: int
) -> int:
    """Add meetings of bodies that impacts have driven out of their reach; return the number of meetings."""
    for i in range(bodies.living.shape[0]):
        moved = sub(vector_at(period, ends.pos, i), vector_at(period, bodies.start, i))
        moved = displacement_near(period, moved, scale(vector_at(period, ends.vel, i), rules.seconds))
        far = norm(moved) > bodies.reach[i] + NEARLY * bodies.radius[i]
        if far and bodies.living[i] > 0 and bodies.light[i] > 0.0:
            bodies.since[i] = 0.0
            write_vector(bodies.at, i, vector_at(period, bodies.start, i))
            write_vector(bodies.vel, i, scale(moved, 1.0 / rules.seconds))
            write_vector(bodies.acc, i, zero(period))
            count = widen_reach(period, bodies, meetings, things, rules, i, 0.0, count)
    return count


@kernel
def _largest_radius(bodies: Bodies) -> float:
    """Return the largest radius, m."""
    widest = 0.0
    for i in range(bodies.living.shape[0]):
        widest = max(widest, bodies.radius[i])
    return float(widest)


@kernel
def _has_moved_far(period: Vec, bodies: Bodies, ends: Ends, since: Any, share: float) -> bool:
    """Return True if a body was moved from its position `since` (N, D) m by more than `share` of its radius."""
    for i in range(bodies.living.shape[0]):
        d = nearest_image(period, sub(vector_at(period, ends.pos, i), vector_at(period, since, i)))
        if bodies.living[i] > 0 and norm(d) > share * bodies.radius[i]:
            return True
    return False
