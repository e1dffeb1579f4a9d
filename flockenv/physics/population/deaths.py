"""Deaths in all worlds, one call for each sink: by age, region, chance, drain, crowd or threshold.

Each sink first selects among all agents that are then alive, and then removes them, so that the result does not depend
on the order of agents.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flockenv.geometry.shapes.dispatch import hit_shape, nearest_shape
from flockenv.geometry.shapes.row_header import shift_of
from flockenv.jit.decorators import Vec, kernel, law
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import add, norm, sub, unit
from flockenv.physics.constraints.broad_phase import load_vector, nearest_image
from flockenv.physics.population.births import DEATHS
from flockenv.physics.population.occupancy import count_near, sort_living

__all__ = ["remove_at_level", "remove_crowded", "remove_drained", "remove_expired"]

DECAY = 2_000_000
"""RNG channel of the first sink; each further sink has the next one."""


@kernel
def _remove(b: int, i: int, v: Any, alive: Any, work: Any) -> None:
    """Remove an agent: its slot becomes free, but keeps the position of death and the identity."""
    alive[b, i] = False
    for k in range(v.shape[0]):
        v[k, b, i] = 0
    work[b, DEATHS] += 1


@law
def _chance(rate: float, usual: float, born: float, now: float, dt: float) -> float:
    """Return the probability of death since the last draw; `usual`: that of a whole step, 1 - exp(-rate dt).

    For an agent born within the previous step this is the first draw, which covers the time since birth.
    """
    late = born > now - (2.0 - 1e-6) * dt and born < now - dt
    return 1.0 - math.exp(-rate * (now - born)) if late else usual


@kernel
def remove_expired(
    sinks: Any, x: Any, v: Any, alive: Any, identity: Any, born: Any, dies: Any, tick: Any, key: Any, work: Any,
    dt: float, first: int, end: int, channel: int,
) -> None:  # fmt: skip
    """Remove agents of worlds [first, end) whose lifetime is over, then those that sinks of age, region, chance select.

    sinks: a row each: kind (0 age, 1 region, 2 chance), first slot, one past the last slot, parameters.
    """
    for b in range(first, end):
        now = tick[b] * dt
        for i in range(alive.shape[1]):
            if dies[b, i] <= now + 1e-9 * dt and alive[b, i]:
                _remove(b, i, v, alive, work)
        for s in range(sinks.shape[0]):
            row = sinks[s]
            usual = 1.0 - math.exp(-row[3] * dt) if row[0] == 2.0 else 0.0
            for i in range(int(row[1]), int(row[2])):
                if not alive[b, i]:
                    continue
                gone = False
                if row[0] == 0.0:
                    gone = now - born[b, i] >= row[3] - 1e-9 * dt
                elif row[0] == 1.0:
                    for k in range(x.shape[0]):
                        gone = gone or not (row[3 + k] <= x[k, b, i] <= row[6 + k])
                else:
                    chance = _chance(row[3], usual, born[b, i], now, dt)
                    gone = uniform(key[b], tick[b], identity[b, i], DECAY + channel + s) < chance
                if gone:
                    _remove(b, i, v, alive, work)


@kernel
def remove_drained(
    table: Any, margin: float, slots: Any, anchor: Vec, period: Vec, x0: Any, x: Any, v: Any, alive: Any, tick: Any,
    work: Any, dt: float, first: int, end: int,
) -> None:  # fmt: skip
    """Remove agents that are inside a shape, or have crossed it during the step that began at x0.

    table: the shape's row (see shapes/table.py); slots: (first, end); anchor, period: (D,) m, the latter 0 for axes
    that are not periodic. If the shape moves, paths are relative to it.
    """
    for b in range(first, end):
        shift = shift_of(table, 0, tick[b] * dt, anchor)
        place, moved = add(anchor, shift), sub(shift, shift_of(table, 0, (tick[b] - 1) * dt, anchor))
        for i in range(slots[0], slots[1]):
            if not alive[b, i]:
                continue
            here = load_vector(anchor, x, b, i)
            y = nearest_image(period, sub(here, place))
            path = sub(nearest_image(period, sub(here, load_vector(anchor, x0, b, i))), moved)
            gap, _ = nearest_shape(table, 0, y)
            if gap <= margin or hit_shape(table, 0, sub(y, path), unit(path), margin) <= norm(path):
                _remove(b, i, v, alive, work)


@kernel
def remove_crowded(
    row: Any, channel: int, x: Any, v: Any, alive: Any, identity: Any, born: Any, tick: Any, key: Any, work: Any,
    dt: float, period: Any, first: int, end: int, grid: Any, cell: Any, start: Any, order: Any, doomed: Any,
) -> None:  # fmt: skip
    """Remove agents that have more than a given number of elders within a radius.

    row: kind, first slot, one past the last slot, radius [m], number, rate [1/s]. doomed (N,): scratch memory.
    """
    low, high = int(row[1]), int(row[2])
    for b in range(first, end):
        sort_living(x, alive, b, low, high, row[3], period, grid, cell, start, order)
        now = tick[b] * dt
        for i in range(low, high):
            doomed[i] = False
            if not alive[b, i]:
                continue
            if row[5] < math.inf:
                chance = _chance(row[5], 1.0 - math.exp(-row[5] * dt), born[b, i], now, dt)
                if uniform(key[b], tick[b], identity[b, i], DECAY + channel) >= chance:
                    continue
            y, z = np.float64(x[1, b, i]), np.float64(x[2, b, i]) if x.shape[0] == 3 else 0.0
            place = (np.float64(x[0, b, i]), y, z)
            most = int(row[4])
            doomed[i] = count_near(x, b, place, row[3], most, period, grid, start, order, born, identity, i) > most
        for i in range(low, high):
            if doomed[i]:
                _remove(b, i, v, alive, work)


@kernel
def remove_at_level(
    numbers: Any, level: float, slots: Any, v: Any, alive: Any, work: Any, first: int, end: int
) -> None:
    """Remove agents whose value in `numbers` (B, N) is at least `level`; slots (first, end)."""
    for b in range(first, end):
        for i in range(slots[0], slots[1]):
            if alive[b, i] and numbers[b, i] >= level:
                _remove(b, i, v, alive, work)
