"""Bottleneck: push (Helbing, Farkas and Vicsek 2000), or queue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import parameter, per_row
from flockenv.players.rules.vectors import length
from flockenv.steering.vectorize import rows
from flockenv.tasks import Bottleneck

__all__ = ["BottleneckRules", "QueueingRules", "bottleneck", "queueing"]

queue = rows(steering.queue)
queue_gap = rows(steering.queue_gap)
repulsion = rows(steering.repulsion)
separate = rows(steering.separate)


@dataclass(frozen=True)
class BottleneckRules:
    """Textbook: Helbing, Farkas and Vicsek 2000; the contact forces of bodies and walls are the scene's."""

    tau: float = parameter(0.5, 0.1, 1.5)  # s, relaxation time
    speed: float = parameter(1.0, 0.2, 1.0, above="it exceeds the limit")  # desired speed as a share of the top speed
    strength: float = parameter(2000.0, 0.0, 4000.0)  # A, N
    decay: float = parameter(0.08, 0.02, 0.5)  # B, m
    walls: float = parameter(2000.0, 0.0, 4000.0)  # A of walls, N


def bottleneck(see: Any, task: Bottleneck, p: BottleneckRules) -> NDArray[np.float64]:
    """Drive to the door, with exponential repulsion from other agents and from walls."""
    drive = 80.0 * (per_row(p.speed) * task.max_speed * _exit_direction(see, task) - see.velocity) / per_row(p.tau)
    separation = np.array([1.0, 0.0])
    push = repulsion(see.neighbours, separation, 2 * _PERSON, per_row(p.decay))
    push = per_row(p.strength, 2) * push * see.neighbour_present[..., None]
    x, y, half = see.door[:, 0], see.door[:, 1], task.width / 2
    points = [
        np.stack([x, np.minimum(y - half, 0.0)], axis=-1), np.stack([x, np.maximum(y + half, 0.0)], axis=-1),
        np.stack([0.0 * x, -see.to_sides[:, 0]], axis=-1), np.stack([0.0 * x, see.to_sides[:, 1]], axis=-1),
    ]  # fmt: skip
    off = per_row(p.walls, 2) * repulsion(np.stack(points, axis=1), separation, _PERSON, per_row(p.decay))
    force: NDArray[np.float64] = drive + push.sum(axis=1) + off.sum(axis=1)
    return force


def _exit_direction(see: Any, task: Bottleneck) -> NDArray[np.float64]:
    """Return the unit vectors to the nearest place of the door where a body fits; straight ahead if opposite it."""
    half = max(task.width / 2 - 1.2 * _PERSON, 0.0)
    sideways = see.door[:, 1] - np.clip(see.door[:, 1], -half, half)
    offset = np.stack([np.maximum(see.door[:, 0], 0.0) + 0.1, sideways], axis=-1)
    direction: NDArray[np.float64] = offset / length(offset)[:, None]
    return direction


@dataclass(frozen=True)
class QueueingRules:
    """Reynolds' queue, with the headway of Tordeux, Chraibi and Seyfried 2016."""

    headway: float = parameter(1.0, 0.2, 2.0)  # s
    margin: float = parameter(0.05, 0.0, 0.3, below="bodies touch")  # m, clearance
    gain: float = parameter(8.0, 2.0, 20.0)  # 1/s: at least 4 / headway
    apart: float = parameter(40.0, 0.0, 200.0)  # N m, separation
    radius: float = parameter(0.8, 0.5, 2.0)  # m, between centres, within which it acts


def queueing(see: Any, task: Bottleneck, p: QueueingRules) -> NDArray[np.float64]:
    """Go to the door as fast as the gap ahead allows, with a small separation force."""
    direction, present = _exit_direction(see, task), see.neighbour_present > 0
    others = see.velocity[:, None] + see.neighbour_velocity
    gap = queue_gap(direction[:, None], see.neighbours, others, 2 * _PERSON + per_row(p.margin), task.max_speed)
    gap = np.where(present, gap, np.inf).min(axis=1).clip(max=1e3)
    near = present & (length(see.neighbours) < per_row(p.radius))
    push = per_row(p.apart) * np.sum(separate(see.neighbours, np.array([1.0, 0.0])) * near[..., None], axis=1)
    force: NDArray[np.float64] = (
        80.0 * per_row(p.gain) * queue(direction, see.velocity, gap, task.max_speed, p.headway) + push
    )
    return force


_PERSON = 0.25
"""Radius of a person, m."""
