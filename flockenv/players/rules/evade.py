"""Evade: avoid obstacles and walls, flee from pursuers, hide behind cover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.geometry import shapes
from flockenv.players.rules.parameter import parameter
from flockenv.steering import arbitration
from flockenv.steering.vectorize import rows
from flockenv.tasks import Evade

__all__ = ["EvadeRules", "evade"]

allocate = rows(arbitration.allocate)
arrive = rows(steering.arrive)
avoid = rows(steering.avoid)
contain = rows(steering.contain)
evade_from = rows(steering.evade)
hiding_place = rows(steering.hiding_place)
ray_hit = rows(shapes.ray_hit)
threat = rows(steering.threat)


@dataclass(frozen=True)
class EvadeRules:
    """Textbook: evade pursuers that are near, else hide from the nearest (Reynolds 1999), in order of priority."""

    horizon: float = parameter(1.0, 0.2, 2.0)  # s, look-ahead for cover on the path
    avoid: float = parameter(5.0, 0.5, 8.0)  # kg/s, strength of steering around it
    wall: float = parameter(0.5, 0.1, 1.5)  # s, how far ahead walls count
    alarm: float = parameter(10.0, 2.0, 15.0)  # m, within which a pursuer is evaded: as far as it sees
    predict: float = parameter(0.5, 0.0, 2.0)  # s, how far ahead a pursuer is predicted at most
    evade: float = parameter(5.0, 0.5, 8.0)  # kg/s, strength of an evasion
    crowd: float = parameter(1.0, 0.0, 2.0)  # weight of pursuers other than the nearest, whose weight is 1
    middle: float = parameter(0.2, 0.0, 1.5)  # N/m towards the middle of the field while evading
    margin: float = parameter(1.0, 0.4, 2.5)  # m, behind cover
    danger: float = parameter(0.0, 0.0, 3.0)  # m added to a hiding place's distance, per m of a pursuer within 10 m
    exposed: float = parameter(0.0, 0.0, 10.0)  # m added to that distance for each pursuer that sees the place
    hide: float = parameter(3.0, 0.0, 8.0)  # kg/s, towards the hiding place


def evade(see: Any, task: Evade, p: EvadeRules) -> NDArray[np.float64]:
    """Avoid, contain, evade, hide: allocation in that order (Reynolds 1987)."""
    top, row = task.evader_speed, np.arange(len(see.velocity))
    speed = np.linalg.norm(see.velocity, axis=-1)
    forward = see.velocity / np.maximum(speed, 1e-9)[:, None]
    there, clearance = see.cover_radius > 0, see.cover_radius + 0.4
    hit = np.where(there, threat(forward[:, None], see.cover, clearance, (speed * p.horizon)[:, None]), np.inf)
    first = np.argmin(hit, axis=1)
    avoidance = p.avoid * avoid(forward, see.cover[row, first], clearance[row, first], top)
    avoidance *= np.isfinite(hit[row, first])[:, None]
    inside = 5.0 * contain(see.to_low - 0.5, see.to_high - 0.5, see.velocity, top, p.wall)

    distance = np.linalg.norm(see.pursuers, axis=-1)
    time = np.minimum(distance / task.pursuer_speed, p.predict)
    flight = evade_from(see.pursuers, see.velocity[:, None], see.pursuer_velocity, top, time)
    rank = np.where(np.arange(distance.shape[1]) == 0, 1.0, p.crowd)
    weight = rank * (distance < p.alarm) / np.maximum(distance, 0.1) ** 2
    away = p.evade * np.sum(flight * weight[..., None], axis=1) / np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    near = (weight.sum(axis=1) > 0)[:, None]
    away += p.middle * (see.to_high - see.to_low) / 2 * near

    places = hiding_place(see.cover, see.cover_radius, p.margin, see.pursuers[:, :1])
    theirs = np.linalg.norm(places[:, :, None] - see.pursuers[:, None], axis=-1).min(axis=-1)
    cost = np.linalg.norm(places, axis=-1) + p.danger * np.maximum(10.0 - theirs, 0.0)
    cost += p.exposed * _count_watchers(places, see)
    nearest = np.argmin(np.where(there, cost, np.inf), axis=1)
    hidden = p.hide * arrive(places[row, nearest], see.velocity, top, 0.5) * there.any(axis=1)[:, None]
    return allocate(np.stack([avoidance, inside, away, hidden], axis=1), task.evader_force)


def _count_watchers(places: NDArray[np.float64], see: Any) -> NDArray[np.float64]:
    """Return how many pursuers have no cover between themselves and each of the places (R, K)."""
    offsets = places[:, :, None] - see.pursuers[:, None]
    length = np.linalg.norm(offsets, axis=-1)
    covers = (see.cover[:, None, :] - see.pursuers[:, :, None])[:, None]
    rays = offsets / np.maximum(length, 1e-9)[..., None]
    hit = ray_hit(covers, rays[..., None, :], see.cover_radius[:, None, None])
    hit = np.where(see.cover_radius[:, None, None] > 0, hit, np.inf)
    count: NDArray[np.float64] = np.sum(hit.min(axis=-1) > length, axis=-1)
    return count
