"""Crossing: avoid the agent that it would touch first, then head for the goal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.clearance import keep_clear
from flockenv.players.rules.parameter import Order, in_order, parameter, per_row
from flockenv.players.rules.vectors import length
from flockenv.steering import arbitration
from flockenv.steering.vectorize import rows
from flockenv.tasks import Crossing

__all__ = ["CrossingRules", "OrcaRules", "crossing", "orca_crossing"]

allocate = rows(arbitration.allocate)
arrive = rows(steering.arrive)
give_way = rows(steering.give_way)
separate = rows(steering.separate)
unaligned_threat = rows(steering.unaligned_threat)


@dataclass(frozen=True)
class CrossingRules:
    """Textbook: look three seconds ahead; avoidance comes first, arrival gets the rest of the force."""

    horizon: float = parameter(3.0, 0.5, 6.0)  # s, look-ahead for collisions
    margin: float = parameter(0.2, 0.0, 0.8)  # m, clearance beyond the touching distance
    evade: float = parameter(5.0, 0.5, 8.0)  # N, strength of an evasion
    urgency: float = parameter(0.0, 0.0, 1.0)  # 0: always evade fully; 1: in proportion to nearness in time
    radius: float = parameter(1.0, 0.6, 2.0)  # m, neighbours nearer than this push
    apart: float = parameter(0.0, 0.0, 4.0)  # N m, separation
    gain: float = parameter(2.0, 0.5, 6.0)  # kg/s towards the goal
    speed: float = parameter(1.0, 0.5, 1.0, above="it exceeds the limit")  # desired speed as a share of the top speed
    slow_radius: float = parameter(0.8, 0.1, 2.0)  # m, slow down within this of the goal


BEHAVIOURS = ("avoid", "separate", "arrive")
"""Of `rules` and `textbook`, in order of priority."""


def crossing(see: Any, task: Crossing, p: CrossingRules, order: Order = None) -> NDArray[np.float64]:
    """Avoid collisions (unaligned, Reynolds 1999), then arrive; vectors are (along the course, to its left)."""
    own = see.velocity[:, None]
    others = own + see.neighbour_velocity
    time = unaligned_threat(see.neighbours, own, others, 2 * _WALKER + per_row(p.margin), per_row(p.horizon))
    time = np.where(see.neighbour_present > 0, time, np.inf)
    row, first = np.arange(len(time)), np.argmin(time, axis=1)
    soonest = time[row, first]
    danger = np.isfinite(soonest)
    nearness = 1.0 - np.where(danger, soonest, p.horizon) / p.horizon
    strength = p.evade * (1.0 - p.urgency * (1.0 - nearness)) * danger
    away = give_way(see.neighbours[row, first], see.velocity, others[row, first], np.where(danger, soonest, 0.0), 1.0)
    near = see.neighbour_present * (length(see.neighbours) < per_row(p.radius))
    push = per_row(p.apart) * np.sum(separate(see.neighbours, np.array([1.0, 0.0])) * near[..., None], axis=1)
    course = per_row(p.gain) * arrive(see.goal, see.velocity, p.speed * task.max_speed, p.slow_radius)
    forces = np.stack([away * strength[:, None], push, course], axis=1)
    return allocate(in_order(forces, order), task.max_force)


@dataclass(frozen=True)
class OrcaRules:
    """ORCA: as published, each agent makes half of the change; without turning right, twelve agents deadlock."""

    horizon: float = parameter(2.0, 0.5, 6.0)  # s, for which the velocity must be free of collisions
    margin: float = parameter(0.1, 0.0, 0.8, below="bodies touch")  # m, clearance for delays by inertia
    turn: float = parameter(0.3, 0.0, 1.5)  # rad, a desired velocity that is not free is turned right by this
    gain: float = parameter(10.0, 1.0, 20.0)  # kg/s: reaches the desired velocity within a decision
    slow_radius: float = parameter(1.0, 0.1, 2.0)  # m, slow down within this of the goal


def orca_crossing(see: Any, task: Crossing, p: OrcaRules) -> NDArray[np.float64]:
    """Head for the goal; optimal reciprocal collision avoidance (van den Berg et al. 2011) avoids others."""
    still = np.zeros_like(see.goal)
    desired = arrive(see.goal, still, task.max_speed, p.slow_radius)
    return keep_clear(see, task, p, desired, _WALKER, _WALKER, 0.5)


_WALKER = 0.3
"""Radius of a walker, m."""
