"""Herd: collect a sheep that strays, else drive the flock from behind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import Order, in_order, parameter, per_row
from flockenv.players.rules.slots import nearest
from flockenv.players.rules.vectors import length
from flockenv.steering import arbitration
from flockenv.steering.vectorize import rows
from flockenv.tasks import Herd

__all__ = ["HerdRules", "herd"]

allocate = rows(arbitration.allocate)
arrive = rows(steering.arrive)
avoid = rows(steering.avoid)
herd_from = rows(steering.herding_offset)
threat = rows(steering.threat)


@dataclass(frozen=True)
class HerdRules:
    """Textbook: Strombom et al. 2014; lengths in units of the distance r_a that sheep keep from each other."""

    together: float = parameter(1.0, 0.3, 2.0)  # times r_a N^(2/3): a sheep farther from the centre is collected
    collecting: float = parameter(1.0, 0.0, 4.0)  # r_a, behind the sheep that is collected
    driving: float = parameter(1.0, 0.3, 2.5)  # times r_a sqrt(N), behind the centre
    near: float = parameter(3.0, 0.0, 5.0)  # r_a, distance of the nearest sheep below which the dog slows down
    slow: float = parameter(0.0, 0.0, 1.0)  # speed below that distance, as a share of the top speed
    gain: float = parameter(5.0, 1.0, 12.0)  # kg/s, force per m/s of the desired change
    around: float = parameter(0.0, 0.0, 6.0)  # kg/s, off a circle about the flock, on the path to the place behind it
    width: float = parameter(1.0, 0.5, 2.0)  # of that circle, times the distance of the farthest sheep from the centre
    apart: float = parameter(4.0, 0.0, 10.0)  # N, away from other dogs, in proportion to nearness within 10 m


BEHAVIOURS = ("separate", "detour", "arrive")
"""In order of priority."""


def herd(see: Any, task: Herd, p: HerdRules, order: Order = None) -> NDArray[np.float64]:
    """Go behind a sheep that strays, or behind the flock, slower near a sheep; vectors are (along the course, left)."""
    r, n, top = task.apart_distance, task.sheep, task.dog_speed
    together, driving = p.together * r * n ** (2 / 3), p.driving * r * n**0.5
    place = herd_from(see.centre, see.farthest, see.goal, together, p.collecting * r, driving)
    there, sheep = nearest(see.sheep_present, see.sheep)
    close = there & (length(sheep) < p.near * r)
    speed = np.where(close, p.slow, 1.0) * top
    course = per_row(p.gain) * arrive(place, see.velocity, speed, 0.5)
    direction = place / np.maximum(length(place), 1e-9)[:, None]
    clearance = p.width * see.stray + 2.0 * r
    blocked = np.isfinite(threat(direction, see.centre, clearance, length(place)))
    detour = per_row(p.around) * avoid(direction, see.centre, clearance, top) * blocked[:, None]
    distance = length(see.mates)[..., None]
    push = -see.mates / np.maximum(distance, 1e-9) * np.maximum(1.0 - distance / 10.0, 0.0)
    mates = per_row(p.apart) * np.sum(push, axis=1)
    return allocate(in_order(np.stack([mates, detour, course], axis=1), order), task.dog_force)
