"""Contacts of one world at the end of a step: impulses until no body approaches another, then positions.

Sequential impulses: contacts are solved one after another, up and down along the mean acceleration, each as if it were
the only one, until none changes. First impacts, with the velocities before the step and restitution e (Guendelman,
Bridson and Fedkiw 2003: the velocity that the step's own acceleration adds never bounces, and a resting body stays
still). Then the velocity that the step has added, without a bounce: the summed impulse of each contact never pulls, and
bounds its friction. Remaining overlaps are resolved by moving bodies apart, the lighter one further. This does not
change velocities, so no overlap accelerates a body.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from flockenv.jit.decorators import Vec, kernel, routine
from flockenv.maths.vectors import add, axis, dot, norm, scale, select, sub, unit, zero
from flockenv.physics.constraints.bodies import RESTS, Bodies, Meetings, Things, larger_acceleration, width
from flockenv.physics.constraints.broad_phase import nearest_image, vector_at, write_vector
from flockenv.physics.constraints.impact import bounce, surface_at

__all__ = [
    "NEARLY",
    "Contacts",
    "Ends",
    "deepest_overlap",
    "gap_and_normal",
    "gather_contacts",
    "move_apart",
    "resolve_impacts",
    "stop_approach",
]


NEARLY = 0.1
"""Largest gap, in radii, of two bodies that others may push into each other."""


class Contacts(NamedTuple):
    """Contacts at the end of a step; the length of the arrays is the capacity."""

    who: Any  # a body
    other: Any  # another, or -1 - m
    normal: Any  # (places, D), to the first from the other
    allowed: Any  # m/s, allowed approach speed, at which they just touch at the end of the step
    open: Any  # 1 = their impact is in the next step, and no impulse acts here
    push: Any  # kg m/s, normal impulse so far
    rub: Any  # (places, D) kg m/s, tangential impulse so far
    was: Any  # (places, D + 1) kg m/s, tangential and normal impulse before a pass
    search: Any  # (places, D + 1) kg m/s, search direction of the passes
    rank: Any  # m, height against the mean acceleration
    order: Any  # the contacts, lowest first


class Ends(NamedTuple):
    """Positions and velocities of the bodies of one world at the end of a step; (N, D) m and m/s."""

    pos: Any
    vel: Any
    tie: Any  # unit vectors: two bodies in one place separate along the difference of theirs


@kernel
def gap_and_normal(
    period: Vec, bodies: Bodies, things: Things, pos: Any, ends: Ends, seconds: float, i: int, j: int
) -> tuple[float, Vec]:
    """Return the gap between a body and another, or an obstacle, m, and the normal towards the body.

    pos (N, D) m: positions `seconds` after the beginning of the step.
    """
    x = vector_at(period, pos, i)
    if j >= 0:
        d = nearest_image(period, sub(x, vector_at(period, pos, j)))
        far = norm(d)
        aside = unit(sub(vector_at(period, ends.tie, i), vector_at(period, ends.tie, j)))
        aside = select(dot(aside, aside) > 0.0, aside, axis(d, 0))
        return far - bodies.radius[i] - bodies.radius[j], select(far > 0.0, unit(d), aside)
    m = -1 - j
    place = add(vector_at(period, things.place, m), scale(vector_at(period, things.drift, m), seconds))
    gap, n = surface_at(things.table, things.row[m], nearest_image(period, sub(x, place)))
    return gap - bodies.radius[i] - things.size[m], n


@kernel
def _relative_velocity(period: Vec, things: Things, vel: Any, i: int, j: int) -> Vec:
    """Return the velocity of a body relative to another, or to an obstacle."""
    v = vector_at(period, vel, i)
    return sub(v, vector_at(period, vel, j)) if j >= 0 else sub(v, vector_at(period, things.drift, -1 - j))


@routine
def gather_contacts(
    period: Vec, bodies: Bodies, meetings: Meetings, things: Things, ends: Ends, contacts: Contacts, seconds: float,
    up: Vec, touch: float, slow: float, restitution: float, in_time: bool, passing: bool, count: int,
) -> int:  # fmt: skip
    """List the meetings that touch, or nearly touch, at the end of the step, by height; return their number.

    in_time: True if the impacts of the step are resolved. Pairs that still approach have their impact in the next step,
    except in a heap: bodies that nearly touch rest if their approach speed is at most that which the step's
    acceleration has added. For others the limit is `slow` m/s.
    passing: True if bodies may pass what they touch at the beginning; contacts are then those of the beginning.
    """
    found = 0
    for c in range(count):
        i, j = meetings.who[c], meetings.other[c]
        margin = max(touch, NEARLY * width(bodies, i, j))
        if j >= 0 and not passing and _far_apart(period, bodies, ends, i, j, margin):
            continue
        gap, n = gap_and_normal(period, bodies, things, ends.pos, ends, seconds, i, j)
        begun, first, passed = gap, n, False
        if passing:
            begun, first = gap_and_normal(period, bodies, things, bodies.start, ends, 0.0, i, j)
            passed = begun <= margin and (gap < -margin or dot(n, first) < 0.5)
            n = select(passed, first, n)
        if (gap <= margin and not (passing and gap < -margin)) or passed:  # a body from afar stops on its path
            contacts.who[found], contacts.other[found] = i, j
            w = -dot(_relative_velocity(period, things, ends.vel, i, j), n)
            heap = restitution < 1.0 if j >= 0 else bodies.leans[i] > 0
            later = w > larger_acceleration(period, bodies, i, j) * seconds if heap else gap > touch or w > slow
            resting = gap <= touch and meetings.closed[c] == RESTS
            contacts.open[found] = 1 if in_time and later and not resting else 0
            contacts.allowed[found] = max(gap, 0.0) / seconds if gap > touch else 0.0
            if not in_time:
                going = _displacement(period, bodies, ends, i)
                going = sub(
                    going,
                    _displacement(period, bodies, ends, j)
                    if j >= 0
                    else _obstacle_displacement(period, things, j, seconds),
                )
                contacts.allowed[found] = max(begun if passed else gap - dot(going, n), 0.0) / seconds
            write_vector(contacts.normal, found, n)
            middle = sub(vector_at(period, ends.pos, i), scale(n, bodies.radius[i]))
            contacts.rank[found] = dot(middle, up)
            contacts.order[found] = found
            found += 1
    sort_by_rank(contacts.rank, contacts.order, found)
    return found


@kernel
def _far_apart(period: Vec, bodies: Bodies, ends: Ends, i: int, j: int, margin: float) -> bool:
    """Return True if two bodies are further apart than a margin, m, at the end of a step."""
    d = nearest_image(period, sub(vector_at(period, ends.pos, i), vector_at(period, ends.pos, j)))
    room = 1.000001 * (bodies.radius[i] + bodies.radius[j] + margin)
    return bool(dot(d, d) > room * room)


@kernel
def _displacement(period: Vec, bodies: Bodies, ends: Ends, i: int) -> Vec:
    """Return the displacement of a body in the step, m."""
    return nearest_image(period, sub(vector_at(period, ends.pos, i), vector_at(period, bodies.start, i)))


@kernel
def _obstacle_displacement(period: Vec, things: Things, j: int, seconds: float) -> Vec:
    """Return the displacement of obstacle -1 - j in the step, m."""
    return scale(vector_at(period, things.drift, -1 - j), seconds)


@kernel
def sort_by_rank(rank: Any, order: Any, count: int) -> None:
    """Sort the first `count` entries of `order` by rank: heapsort."""
    end = count
    start = count // 2
    while end > 1:
        if start > 0:
            start -= 1
        else:
            end -= 1
            order[end], order[0] = order[0], order[end]
        root = start
        while 2 * root + 1 < end:
            child = 2 * root + 1
            if child + 1 < end and rank[order[child + 1]] > rank[order[child]]:
                child += 1
            if rank[order[root]] >= rank[order[child]]:
                break
            order[root], order[child] = order[child], order[root]
            root = child


@kernel
def _apply_impulse(period: Vec, bodies: Bodies, vel: Any, i: int, j: int, impulse: Vec) -> None:
    """Apply an impulse to a body, and the opposite to the other."""
    write_vector(vel, i, add(vector_at(period, vel, i), scale(impulse, bodies.light[i])))
    if j >= 0:
        write_vector(vel, j, sub(vector_at(period, vel, j), scale(impulse, bodies.light[j])))


@kernel
def _inverse_reduced_mass(bodies: Bodies, i: int, j: int) -> float:
    """Return the inverse reduced mass of a pair, 1/kg: the change of relative velocity per impulse."""
    return float(bodies.light[i] + (bodies.light[j] if j >= 0 else 0.0))


@kernel
def resolve_impacts(
    period: Vec, bodies: Bodies, things: Things, contacts: Contacts, vel: Any, restitution: float, friction: float,
    sticky: bool, rounds: int, slow: float, count: int,
) -> tuple[int, int]:  # fmt: skip
    """Let bodies that approach, at velocities (N, D), bounce until none do; return impacts, and those left.

    slow: m/s, approach speed that is ignored. Impacts that are left after `rounds` > 1 passes are deferred to the next
    step: their contacts are marked open, so that no energy is lost.
    """
    done, left = 0, 0
    for turn in range(rounds):
        now = 0
        for k in range(count):
            c = contacts.order[k if turn % 2 == 0 else count - 1 - k]
            i, j, n = contacts.who[c], contacts.other[c], vector_at(period, contacts.normal, c)
            ease = _inverse_reduced_mass(bodies, i, j)
            v = _relative_velocity(period, things, vel, i, j)
            if ease > 0.0 and contacts.open[c] == 0 and -dot(v, n) > slow + contacts.allowed[c]:
                e = restitution if j >= 0 else things.restitution[-1 - j]
                change = scale(v, -1.0) if sticky else sub(bounce(v, n, e, friction), v)
                _apply_impulse(period, bodies, vel, i, j, scale(change, 1.0 / ease))
                now += 1
        done += now
        if now == 0:
            return done, 0
    if rounds > 1:
        for c in range(count):
            w = -dot(
                _relative_velocity(period, things, vel, contacts.who[c], contacts.other[c]),
                vector_at(period, contacts.normal, c),
            )
            if w > slow + contacts.allowed[c]:
                contacts.open[c] = 1
                left += 1
    return done, left


@kernel
def _stop_approach_once(
    period: Vec, bodies: Bodies, things: Things, contacts: Contacts, vel: Any, friction: float, sticky: bool, up: bool,
    count: int,
) -> tuple[float, float]:  # fmt: skip
    """Pass once over all contacts; return the largest change of velocity, and the sum of the squares of impulses."""
    worst, square = 0.0, 0.0
    for k in range(count):
        c = contacts.order[k if up else count - 1 - k]
        i, j, n = contacts.who[c], contacts.other[c], vector_at(period, contacts.normal, c)
        ease = _inverse_reduced_mass(bodies, i, j)
        if ease == 0.0 or contacts.open[c] > 0:
            continue
        v = _relative_velocity(period, things, vel, i, j)
        if sticky:
            impulse = scale(v, -1.0 / ease)
            write_vector(contacts.rub, c, add(vector_at(period, contacts.rub, c), impulse))
            _apply_impulse(period, bodies, vel, i, j, impulse)
            worst = max(worst, norm(v))
            square += dot(impulse, impulse)
            continue
        total = max(contacts.push[c] - (dot(v, n) + contacts.allowed[c]) / ease, 0.0)
        given = total - contacts.push[c]
        contacts.push[c] = total
        impulse = scale(n, given)
        if friction > 0.0:
            v = add(v, scale(impulse, ease))
            before = vector_at(period, contacts.rub, c)
            rub = sub(before, scale(sub(v, scale(n, dot(v, n))), 1.0 / ease))
            size = norm(rub)
            rub = scale(rub, friction * total / size if size > friction * total else 1.0)
            write_vector(contacts.rub, c, rub)
            impulse = add(impulse, sub(rub, before))
        _apply_impulse(period, bodies, vel, i, j, impulse)
        worst = max(worst, norm(impulse) * ease)
        square += dot(impulse, impulse)
    return worst, square


@kernel
def stop_approach(
    period: Vec, bodies: Bodies, things: Things, contacts: Contacts, vel: Any, friction: float, sticky: bool,
    rounds: int, slow: float, count: int,
) -> float:  # fmt: skip
    """Stop the approach of bodies, velocities (N, D), without a bounce; return the last pass's largest change, m/s.

    The summed normal impulse of each contact never pulls. The summed friction impulse is at most `friction` times as
    large (Coulomb), and opposes sliding. Sticky contacts pull and push in every direction. Passes are accelerated by
    nonsmooth nonlinear conjugate gradients (Silcowitz, Niebe and Erleben 2010): the weight of a heap reaches its foot
    after about as many passes as it has layers, not after their square.
    """
    for c in range(count):
        contacts.push[c] = 0.0
        write_vector(contacts.rub, c, zero(period))
        for k in range(len(period)):
            contacts.search[c, k] = 0.0
        contacts.search[c, len(period)] = 0.0
    worst, before = 0.0, 0.0
    for turn in range(rounds):
        for c in range(count):
            contacts.was[c, len(period)] = contacts.push[c]
            for k in range(len(period)):
                contacts.was[c, k] = contacts.rub[c, k]
        worst, square = _stop_approach_once(
            period, bodies, things, contacts, vel, friction, sticky, turn % 2 == 0, count
        )
        if worst <= slow or turn == rounds - 1:
            break
        share = square / before if turn > 0 and square < before else 0.0
        before = square
        for c in range(count):
            for k in range(len(period) + 1):
                step = share * contacts.search[c, k]
                done = (contacts.push[c] if k == len(period) else contacts.rub[c, k]) - contacts.was[c, k]
                contacts.search[c, k] = step + done
                contacts.was[c, k] = step
            if share > 0.0 and contacts.open[c] == 0:
                more = contacts.was[c, len(period)]
                contacts.push[c] += more
                impulse = scale(vector_at(period, contacts.normal, c), more)
                for k in range(len(period)):
                    contacts.rub[c, k] += contacts.was[c, k]
                impulse = add(impulse, vector_at(period, contacts.was, c))
                _apply_impulse(period, bodies, vel, contacts.who[c], contacts.other[c], impulse)
    return worst


@routine
def move_apart(
    period: Vec, bodies: Bodies, things: Things, ends: Ends, seconds: float, rounds: int, touch: float, most: float,
    contacts: Contacts, count: int,
) -> float:  # fmt: skip
    """Move bodies that overlap at the end apart, each pair by at most `most` m; return the last pass's largest move, m.

    The lighter of two moves further. A light body between a heavy one and a wall would need a number of passes
    proportional to the mass ratio, so the second half of the passes treats all masses as equal.
    """
    for c in range(count):
        contacts.push[c] = 0.0
    worst = 0.0
    for turn in range(rounds):
        worst = 0.0
        for k in range(count):
            c = contacts.order[k if turn % 2 == 0 else count - 1 - k]
            i, j = contacts.who[c], contacts.other[c]
            gap, n = gap_and_normal(period, bodies, things, ends.pos, ends, seconds, i, j)
            if gap < 0.0 and _inverse_reduced_mass(bodies, i, j) > 0.0:
                far = min(-gap, most - contacts.push[c])
                contacts.push[c] += far
                share = _share(bodies, i, j, 2 * turn >= rounds and turn > 0)
                write_vector(ends.pos, i, add(vector_at(period, ends.pos, i), scale(n, far * share)))
                if j >= 0:
                    write_vector(ends.pos, j, sub(vector_at(period, ends.pos, j), scale(n, far * (1.0 - share))))
                worst = max(worst, far)
        if worst <= touch:
            break
    return worst


@routine
def deepest_overlap(
    period: Vec, bodies: Bodies, things: Things, ends: Ends, seconds: float, who: Any, other: Any, count: int
) -> float:
    """Return the deepest overlap of these pairs at the end of a step, as a fraction of the smaller radius.

    `who`, `other`: (places,) as in Meetings and Contacts.
    """
    deep = 0.0
    for c in range(count):
        i, j = who[c], other[c]
        gap, _ = gap_and_normal(period, bodies, things, ends.pos, ends, seconds, i, j)
        if gap < 0.0 and _inverse_reduced_mass(bodies, i, j) > 0.0:
            deep = max(deep, -gap / max(width(bodies, i, j), 1e-300))
    return deep


@kernel
def _share(bodies: Bodies, i: int, j: int, alike: bool) -> float:
    """Return the part of a separation that body i moves, from 0 to 1; alike: True if masses are ignored."""
    one, two = bodies.light[i], bodies.light[j] if j >= 0 else 0.0
    if alike and one > 0.0 and two > 0.0:
        return 0.5
    return float(one / (one + two))
