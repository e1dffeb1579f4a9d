"""Births that are due, in all worlds in one call, with slot, position, velocity and lifetime.

A row of `streams` is an emitter's rate, or one of its bursts: first slot, one past the last slot; start and end, s;
rate, 1/s; size of the burst; speed from, to, m/s; spread, rad; 1 if along the normal; direction (3); lifetime from, to,
s; 1 if a burst is born in one place; the kind of its place, and the parameters of that.
Birth k of stream e is a new agent, of identity N + k E + e in a scene of N slots and E streams.
"""

from __future__ import annotations

import math
from typing import Any

from flockenv.jit.decorators import Vec, kernel, law
from flockenv.maths.counter_rng import uniform
from flockenv.maths.heading import face_one
from flockenv.maths.vectors import add, cross, dot, scale, select, sub, unit
from flockenv.model.state import WORK
from flockenv.physics.population.occupancy import count_near, sort_living

__all__ = ["births_due", "create_births"]

BIRTHS, DEATHS, REFUSED = (WORK.index(name) for name in ("births", "deaths", "births_refused"))

CHANNEL = 3_000_000
"""First RNG channel of a newborn: speed, lifetime, place and direction, 16 for each try."""

TOGETHER = CHANNEL + 100_000
"""First RNG channel of draws that all agents of a burst share."""

TRIES = 64
"""Most draws of a point on a surface, if it lies within another part of the shape."""

PLACE = 17
"""Index in a row of the first parameter of the place."""


@kernel
def births_due(row: Any, time: float, dt: float) -> int:
    """Return the number of births of a stream until `time`, s, those due then (within rounding) included."""
    if row[4] == 0.0:
        return int(row[5]) if time + 1e-9 * dt >= row[2] else 0
    expected = row[4] * (min(time, row[3]) - row[2])
    return math.floor(expected * (1.0 + 4e-16) + 1e-9) if expected > 0.0 else 0


@law
def _draw(key: Any, who: int, channel: int) -> Vec:
    """Draw three numbers, each uniform in [0, 1)."""
    return uniform(key, 0, who, channel), uniform(key, 0, who, channel + 1), uniform(key, 0, who, channel + 2)


@law
def _three_numbers(row: Any, at: int) -> Vec:
    """Return the three numbers of a row from index `at` on as a vector."""
    return row[at], row[at + 1], row[at + 2]


@law
def _perpendicular(axis: Vec) -> Vec:
    """Return a unit vector perpendicular to a unit vector; in the plane z = 0 if the axis is."""
    return unit(select(abs(axis[2]) < 0.9, (-axis[1], axis[0], 0.0), (0.0, -axis[2], axis[1])))


@law
def _turn_about(axis: Vec, turn: float) -> Vec:
    """Return a unit vector perpendicular to an axis, turned about the axis by `turn`, rad."""
    u = _perpendicular(axis)
    return add(scale(u, math.cos(turn)), scale(cross(axis, u), math.sin(turn)))


@law
def _direction_in_cone(flat: bool, axis: Vec, spread: float, s: float, t: float) -> Vec:
    """Return a uniformly distributed unit vector within `spread` [rad] of an axis; s, t uniform in [0, 1)."""
    angle = spread * (2.0 * s - 1.0)
    along = math.cos(angle) if flat else 1.0 - s * (1.0 - math.cos(spread))
    aside = math.sin(angle) if flat else math.sqrt(max(0.0, 1.0 - along * along))
    return add(scale(axis, along), scale(_turn_about(axis, 0.0 if flat else 2.0 * math.pi * t), aside))


@law
def _point_on_flat(piece: Any, flat: bool, s: float, t: float) -> tuple[Vec, Vec]:
    """Return a point on an edge or a face, and the outward normal."""
    u, v = _three_numbers(piece, 5), _three_numbers(piece, 8)
    right = (u[1], -u[0], 0.0)
    normal = unit(select(flat, right, cross(u, v)))
    return add(_three_numbers(piece, 2), add(scale(u, s), scale(v, t))), scale(normal, piece[11])


@law
def _point_on_round(piece: Any, flat: bool, s: float, t: float) -> tuple[Vec, Vec]:
    """Return a point on the side of a tube, or on its ends, and the outward normal there."""
    a, b = _three_numbers(piece, 2), _three_numbers(piece, 5)
    line = sub(b, a)
    axis = select(dot(line, line) > 0.0, unit(line), (1.0, 0.0, 0.0))
    turn = (0.0 if t < 0.5 else math.pi) if flat else 2.0 * math.pi * t
    side = piece[1] == 1.0
    normal = select(
        side, _turn_about(axis, turn), _direction_in_cone(flat, axis, math.pi, s, t)
    )  # each end is half of a ball
    end = select(dot(axis, normal) > 0.0, b, a)
    return add(select(side, add(a, scale(line, s)), end), scale(normal, piece[8])), normal


@law
def _is_within(piece: Any, spot: Vec) -> bool:
    """Return True if a point lies inside a segment of a thick line, but not on its surface."""
    line, to_spot = sub(_three_numbers(piece, 5), _three_numbers(piece, 2)), sub(spot, _three_numbers(piece, 2))
    square = dot(line, line)
    share = min(max(dot(line, to_spot) / square, 0.0), 1.0) if square > 0.0 else 0.0
    gap = sub(to_spot, scale(line, share))
    return piece[1] == 1.0 and dot(gap, gap) < piece[8] * piece[8] * (1.0 - 1e-9)  # type: ignore[no-any-return]


@kernel
def _point_on_surface(flat: bool, row: Any, pieces: Any, key: Any, who: int, channel: int) -> tuple[Vec, Vec]:
    """Return a random point on a surface, and the outward normal there."""
    first, end = int(row[PLACE]), int(row[PLACE + 1])
    spot: Vec = (0.0, 0.0, 0.0)
    normal: Vec = spot
    for attempt in range(TRIES):
        draws = _draw(key, who, channel + 16 * attempt)
        low, high = first, end - 1
        while low < high:
            middle = (low + high) // 2
            beyond = pieces[middle, 0] > pieces[end - 1, 0] * draws[0]
            low, high = (low, middle) if beyond else (middle + 1, high)
        piece = pieces[low]
        if piece[1] == 0.0:
            spot, normal = _point_on_flat(piece, flat, draws[1], draws[2])
        else:
            spot, normal = _point_on_round(piece, flat, draws[1], draws[2])
        hidden = False
        for other in range(first, end):
            hidden = hidden or _is_within(pieces[other], spot)
        if not hidden:
            break
    return spot, normal


@law
def _point_in_disc(row: Any, flat: bool, draws: Vec) -> Vec:
    """Return a point in a disc, a ball, or a flat disc in 3-D."""
    axis = _three_numbers(row, PLACE + 4)
    across = dot(axis, axis) > 0.0
    out = _direction_in_cone(flat, (1.0, 0.0, 0.0), math.pi, draws[1], draws[2])
    out = select(across, _turn_about(axis, 2.0 * math.pi * draws[1]), out)
    share = math.sqrt(draws[0]) if flat or across else draws[0] ** (1.0 / 3.0)
    return add(_three_numbers(row, PLACE), scale(out, row[PLACE + 3] * share))


@law
def _point_in_box(row: Any, draws: Vec) -> Vec:
    """Return a point between two corners; on the line between them if all three draws are equal."""
    low, high = _three_numbers(row, PLACE), _three_numbers(row, PLACE + 3)
    return (
        low[0] + draws[0] * (high[0] - low[0]),
        low[1] + draws[1] * (high[1] - low[1]),
        low[2] + draws[2] * (high[2] - low[2]),
    )


@kernel
def _point_in_clearing(
    x: Any, b: int, row: Any, key: Any, who: int, channel: int, period: Any, grid: Any, start: Any, order: Any,
    born: Any, identity: Any,
) -> Vec:  # fmt: skip
    """Return the point with the fewest living agents around it, of several drawn in a box; of equals, the first."""
    best: Vec = (0.0, 0.0, 0.0)
    fewest = 2**62
    for attempt in range(int(row[PLACE + 7])):
        spot = _point_in_box(row, _draw(key, who, channel + 16 * attempt))
        near = count_near(x, b, spot, row[PLACE + 6], fewest, period, grid, start, order, born, identity, -1)
        if near < fewest:
            best, fewest = spot, near
    return best


@kernel
def _wrap_or_clamp(walls: bool, period: Any, size: float, radius: float, p: float) -> float:
    """Return a coordinate wrapped along a periodic axis, or clamped between walls."""
    if period > 0.0:
        inside = p - period * math.floor(p / period)
        return 0.0 if inside >= period else inside
    return min(max(p, radius), size - radius) if walls else p


@kernel
def _birth_place(
    d: int, row: Any, pieces: Any, x: Any, b: int, key: Any, who: int, channel: int, period: Any, grid: Any, start: Any,
    order: Any, born: Any, identity: Any,
) -> tuple[Vec, Vec]:  # fmt: skip
    """Return the position of a birth, and the direction of the row or the outward normal of a surface."""
    draws, aim = _draw(key, who, channel), _three_numbers(row, 10)
    if row[16] <= 1.0:
        return _point_in_box(row, (draws[0], draws[0], draws[0])), aim
    if row[16] == 2.0:
        return _point_in_disc(row, d == 2, draws), aim
    if row[16] == 4.0:
        spot, normal = _point_on_surface(d == 2, row, pieces, key, who, channel)
        return spot, select(row[9] == 1.0, normal, aim)
    spot = _point_in_box(row, draws)
    if order is not None:  # noqa: SIM102  # numba prunes only a test that is alone
        if row[16] == 5.0:
            spot = _point_in_clearing(x, b, row, key, who, channel, period, grid, start, order, born, identity)
    return spot, aim


@kernel
def create_births(
    streams: Any, pieces: Any, clearing: float, x: Any, v: Any, frame: Any, alive: Any, identity: Any, born: Any,
    dies: Any, tick: Any, key: Any, work: Any, radius: Any, dt: float, walls: bool, size: Any, period: Any, first: int,
    end: int, grid: Any, cell: Any, start: Any, order: Any,
) -> None:  # fmt: skip
    """Create the agents that are due in the step that ends now, or at the start, in worlds [first, end).

    clearing: m, the largest radius within which neighbours are counted; if no place counts neighbours, grid, cell,
    start and order are None, and no code for them is compiled. walls: True if the space is a box of `size` (3,) m.
    period (3,) m: 0 for axes that are not periodic.
    """
    n, kinds = x.shape[2], streams.shape[0]
    for b in range(first, end):
        sorted_, slot, until = False, 0, -1
        for e in range(kinds):
            row = streams[e]
            before = births_due(row, (tick[b] - 1) * dt, dt) if tick[b] > 0 else 0
            after = births_due(row, tick[b] * dt, dt)
            if order is not None:  # noqa: SIM102  # numba prunes only a test that is alone
                if after > before and not sorted_:
                    sort_living(x, alive, b, 0, n, clearing, period, grid, cell, start, order)
                    sorted_ = True
            # streams of a group are consecutive, and each continues at the slot where the previous one ended
            if until != int(row[1]):
                slot, until = int(row[0]), int(row[1])
            slot = _create_agents(
                before, after, e, kinds, slot, until, row, pieces, x, v, frame, alive, identity, born, dies,
                tick[b] * dt, key[b], work, radius, dt, walls, size, period, b, grid, start, order,
            )  # fmt: skip


@kernel
def _create_agents(
    before: int, after: int, stream: int, kinds: int, slot: int, until: int, row: Any, pieces: Any, x: Any, v: Any,
    frame: Any, alive: Any, identity: Any, born: Any, dies: Any, now: float, key: Any, work: Any, radius: Any,
    dt: float, walls: bool, size: Any, period: Any, b: int, grid: Any, start: Any, order: Any,
) -> int:  # fmt: skip
    """Create births `before` to `after` of a stream in free slots from `slot` on; return the slot reached."""
    d, n = x.shape[0], x.shape[2]
    for k in range(before, after):
        who = n + k * kinds + stream
        when = row[2] + (k + 1) / row[4] if row[4] > 0.0 else row[2]
        when = min(max(when, now - dt), now)
        life = row[13]
        if life < math.inf:
            life += (row[14] - row[13]) * uniform(key, 0, who, CHANNEL + 3)
        if when + life <= now:  # born and dead within the step
            work[b, BIRTHS] += 1
            work[b, DEATHS] += 1
            continue
        while slot < until and alive[b, slot]:
            slot += 1
        if slot >= until:
            work[b, REFUSED] += after - k
            break
        drawn, channel = (n + stream, TOGETHER) if row[15] == 1.0 else (who, CHANNEL + 16)
        spot, aim = _birth_place(
            d, row, pieces, x, b, key, drawn, channel, period, grid, start, order, born, identity
        )  # fmt: skip
        draws = _draw(key, who, CHANNEL)
        vel = scale(_direction_in_cone(d == 2, aim, row[8], draws[1], draws[2]), row[6] + (row[7] - row[6]) * draws[0])
        spot = add(spot, scale(vel, now - when))
        for j in range(d):
            v[j, b, slot] = vel[j]
            x[j, b, slot] = _wrap_or_clamp(walls, period[j], size[j], float(radius[slot]), spot[j])
        alive[b, slot] = True
        identity[b, slot], born[b, slot], dies[b, slot] = who, when, when + life
        if frame.shape[0] > 0:
            face_one(v, frame, b, slot, True)
        work[b, BIRTHS] += 1
    return slot
