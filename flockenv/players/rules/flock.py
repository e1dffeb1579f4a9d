"""Flock: avoid obstacles, separate, align, cohere, and keep course."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import Order, in_order, parameter, per_row
from flockenv.players.rules.vectors import length
from flockenv.steering import arbitration
from flockenv.steering.vectorize import rows
from flockenv.tasks import Flock

__all__ = ["FlockRules", "flock"]

align = rows(steering.align)
allocate = rows(arbitration.allocate)
avoid = rows(steering.avoid)
separate = rows(steering.separate)
threat = rows(steering.threat)


@dataclass(frozen=True)
class FlockRules:
    """Textbook: the order of Reynolds 1987: collision avoidance, then velocity matching, then flock centring."""

    horizon: float = parameter(2.0, 0.5, 4.0)  # s, look-ahead for obstacles
    margin: float = parameter(0.3, 0.0, 1.0)  # m, clearance from obstacles
    evade: float = parameter(5.0, 0.5, 8.0)  # kg/s, strength of an evasion
    radius: float = parameter(1.5, 1.0, 3.0)  # m, neighbours nearer than this push
    apart: float = parameter(2.0, 0.0, 8.0)  # N m, separation
    match: float = parameter(1.5, 0.0, 5.0)  # kg/s, alignment
    centre: float = parameter(0.3, 0.0, 2.0)  # N/m, cohesion
    course: float = parameter(2.0, 0.2, 6.0)  # kg/s, towards the cruising velocity
    blend: float = parameter(0.0, 0.0, 1.0)  # 0: allocate in order; 1: sum up


BEHAVIOURS = ("avoid", "separate", "align", "cohere", "course")
"""In order of priority."""


def flock(see: Any, task: Flock, p: FlockRules, order: Order = None) -> NDArray[np.float64]:
    """Avoid, separate, align, cohere, follow the heading; vectors are (along the heading, to its left)."""
    speed = length(see.velocity)
    forward = see.velocity / np.maximum(speed, 1e-9)[:, None]
    clearance = see.obstacle_radius + 0.3 + per_row(p.margin)
    distance = threat(forward[:, None], see.obstacles, clearance, (speed * p.horizon)[:, None])
    distance = np.where(see.obstacle_radius > 0, distance, np.inf)
    first, row = np.argmin(distance, axis=1), np.arange(len(speed))
    around = avoid(forward, see.obstacles[row, first], clearance[row, first], task.max_speed)
    evasion = per_row(p.evade) * around * np.isfinite(distance[row, first])[:, None]

    here = see.neighbour_present
    count = np.maximum(here.sum(axis=1), 1.0)[:, None]
    near = here * (length(see.neighbours) < per_row(p.radius))
    push = per_row(p.apart) * np.sum(separate(see.neighbours, np.array([1.0, 0.0])) * near[..., None], axis=1)
    mean_velocity = see.velocity + np.sum(see.neighbour_velocity * here[..., None], axis=1) / count
    match = per_row(p.match) * align(see.velocity, mean_velocity)
    centre = per_row(p.centre) * np.sum(see.neighbours * here[..., None], axis=1) / count
    course = per_row(p.course) * (np.array([task.cruise, 0.0]) - see.velocity)
    forces = np.stack([evasion, push, match, centre, course], axis=1)
    ordered = allocate(in_order(forces, order), task.max_force)
    summed = evasion + push + match + centre + course
    blend = per_row(p.blend)
    force: NDArray[np.float64] = (1.0 - blend) * ordered + blend * summed
    return force
