"""Obstacles: seek the goal around obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import Order, in_order, parameter, per_row
from flockenv.steering import arbitration
from flockenv.steering.vectorize import rows
from flockenv.tasks import Obstacles

__all__ = ["ObstaclesRules", "obstacles"]

allocate = rows(arbitration.allocate)
avoid = rows(steering.avoid)
seek = rows(steering.seek)
threat = rows(steering.threat)


@dataclass(frozen=True)
class ObstaclesRules:
    """Textbook: look two seconds ahead; avoidance comes first, seeking gets the rest of the force."""

    horizon: float = parameter(2.0, 0.4, 3.0)  # s, how far ahead a threat counts at the present speed
    margin: float = parameter(0.2, 0.0, 0.6)  # m, clearance beyond the touching distance
    evade: float = parameter(5.0, 0.5, 8.0)  # kg/s, strength of an evasion
    urgency: float = parameter(0.0, 0.0, 1.0)  # 0: always evade with full strength; 1: in proportion to nearness
    brake: float = parameter(0.0, 0.0, 3.0)  # kg/s against the speed, in proportion to nearness
    gain: float = parameter(2.0, 0.5, 6.0)  # kg/s towards the goal
    speed: float = parameter(1.0, 0.6, 1.0)  # desired speed as a share of the top speed
    push: float = parameter(0.0, 0.0, 2.0)  # N m, repulsion from the nearest surfaces, push / gap


BEHAVIOURS = ("avoid", "repulsion", "seek")
"""In order of priority."""


def obstacles(see: Any, task: Obstacles, p: ObstaclesRules, order: Order = None) -> NDArray[np.float64]:
    """Avoid the obstacle that the straight path touches first (Reynolds 1999), then seek; allocation as in 1987."""
    speed = np.linalg.norm(see.velocity, axis=-1)
    goal_way = see.goal / np.maximum(np.linalg.norm(see.goal, axis=-1), 1e-9)[:, None]
    forward = np.where(speed[:, None] > 0.05, see.velocity / np.maximum(speed, 1e-9)[:, None], goal_way)
    reach = np.maximum(speed, 0.5) * p.horizon
    clearance = see.obstacle_radius + 0.3 + per_row(p.margin)
    distance = threat(forward[:, None], see.obstacles, clearance, reach[:, None])
    distance = np.where(see.obstacle_radius > 0, distance, np.inf)
    first = np.argmin(distance, axis=1)
    row = np.arange(len(first))
    nearest = distance[row, first]
    danger = np.isfinite(nearest)
    nearness = 1.0 - np.where(danger, nearest / np.maximum(reach, 1e-9), 1.0)
    strength = p.evade * (1.0 - p.urgency * (1.0 - nearness)) * danger
    avoidance = avoid(forward, see.obstacles[row, first], clearance[row, first], task.max_speed)
    evasion = avoidance * strength[:, None] - per_row(p.brake) * see.velocity * nearness[:, None]
    away = -see.obstacles / np.maximum(np.linalg.norm(see.obstacles, axis=-1), 1e-9)[..., None]
    seen = (see.obstacle_radius > 0) & (see.clearance < 1.0)
    field = per_row(p.push) * np.sum(away * (seen / np.maximum(see.clearance, 0.05))[..., None], axis=1)
    course = per_row(p.gain) * seek(see.goal, see.velocity, p.speed * task.max_speed)
    return allocate(in_order(np.stack([evasion, field, course], axis=1), order), task.max_force)
