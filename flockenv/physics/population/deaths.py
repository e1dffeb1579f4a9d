"""Deaths of all worlds in one call for each sink: by age, on leaving a region, by chance, in a drain, in a crowd.

Each sink selects among all agents that live when its turn comes, before any of them dies: the result does not depend
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
from flockenv.physics.constraints.broad_phase import image, loaded
from flockenv.physics.population.births import DEATHS
from flockenv.physics.population.occupancy import count_near, sort_living

__all__ = ["crowding", "drain", "passing", "reaching"]

DECAY = 2_000_000
"""Channel of the draws of the first sink; the next has the next."""


@kernel
def _die(b: int, i: int, v: Any, alive: Any, work: Any) -> None:
    """Let an agent die: its slot is free, and keeps the place of death and the identity."""
    alive[b, i] = False
    for k in range(v.shape[0]):
        v[k, b, i] = 0
    work[b, DEATHS] += 1


@law
def _chance(rate: float, usual: float, born: float, now: float, dt: float) -> float:
    """Return the probability that an agent died since the sinks last acted; `usual`: in a step, 1 - exp(-rate dt).

    An agent that was born within the step before was not yet drawn for: it has been alive for longer than a step.
    """
    late = born > now - (2.0 - 1e-6) * dt and born < now - dt
    return 1.0 - math.exp(-rate * (now - born)) if late else usual


@kernel
def passing(
    sinks: Any, x: Any, v: Any, alive: Any, identity: Any, born: Any, dies: Any, tick: Any, key: Any, work: Any,
    dt: float, first: int, end: int, channel: int,
) -> None:  # fmt: skip
    """Let agents die at the end of their own lifetime, then by sinks of age, region and chance; worlds [first, end).

    sinks: a row each: kind (0 age, 1 region, 2 chance), first slot, the one after the last, numbers.
    """
    for b in range(first, end):
        now = tick[b] * dt
        for i in range(alive.shape[1]):
            if dies[b, i] <= now + 1e-9 * dt and alive[b, i]:
                _die(b, i, v, alive, work)
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
                    _die(b, i, v, alive, work)


@kernel
def drain(
    table: Any, margin: float, slots: Any, anchor: Vec, period: Vec, x0: Any, x: Any, v: Any, alive: Any, tick: Any,
    work: Any, dt: float, first: int, end: int,
) -> None:  # fmt: skip
    """Let agents die that are in a shape, or went through it in the step that began at x0; slots (first, end).

    table: the shape's row (see shapes/table.py); anchor, period: (D,) m, the latter 0 where an axis does not repeat.
    If the shape moves, paths are relative to it.
    """
    for b in range(first, end):
        shift = shift_of(table, 0, tick[b] * dt, anchor)
        place, moved = add(anchor, shift), sub(shift, shift_of(table, 0, (tick[b] - 1) * dt, anchor))
        for i in range(slots[0], slots[1]):
            if not alive[b, i]:
                continue
            here = loaded(anchor, x, b, i)
            y = image(period, sub(here, place))
            way = sub(image(period, sub(here, loaded(anchor, x0, b, i))), moved)
            gap, _ = nearest_shape(table, 0, y)
            if gap <= margin or hit_shape(table, 0, sub(y, way), unit(way), margin) <= norm(way):
                _die(b, i, v, alive, work)


@kernel
def crowding(
    row: Any, channel: int, x: Any, v: Any, alive: Any, identity: Any, born: Any, tick: Any, key: Any, work: Any,
    dt: float, period: Any, first: int, end: int, grid: Any, cell: Any, start: Any, order: Any, doomed: Any,
) -> None:  # fmt: skip
    """Let agents die that have too many elders around them.

    row: kind, first slot, the one after the last, radius [m], how many, rate [1/s]. doomed (N,): scratch.
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
                _die(b, i, v, alive, work)


@kernel
def reaching(numbers: Any, level: float, slots: Any, v: Any, alive: Any, work: Any, first: int, end: int) -> None:
    """Let agents die whose number, of numbers (B, N), has come to a level; slots (first, end)."""
    for b in range(first, end):
        for i in range(slots[0], slots[1]):
            if alive[b, i] and numbers[b, i] >= level:
                _die(b, i, v, alive, work)
