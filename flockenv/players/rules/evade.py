"""Evade: take the least threatened course, or flee from near pursuers and hide behind cover (Reynolds 1999)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.geometry import shapes
from flockenv.players.rules.parameter import Order, in_order, parameter, per_row
from flockenv.steering import arbitration
from flockenv.steering.vectorize import rows
from flockenv.tasks import Evade

__all__ = ["EscapeRules", "EvadeRules", "escape", "evade"]

allocate = rows(arbitration.allocate)
arrive = rows(steering.arrive)
avoid = rows(steering.avoid)
contain = rows(steering.contain)
evade_from = rows(steering.evade)
hiding_place = rows(steering.hiding_place)
ray_hit = rows(shapes.ray_hit)
seek = rows(steering.seek)
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


BEHAVIOURS = ("avoid", "contain", "evade", "hide")
"""Of `textbook`, in order of priority."""


def evade(see: Any, task: Evade, p: EvadeRules, order: Order = None) -> NDArray[np.float64]:
    """Avoid, contain, evade, hide: allocation in that order (Reynolds 1987)."""
    top, row = task.evader_speed, np.arange(len(see.velocity))
    speed = np.linalg.norm(see.velocity, axis=-1)
    forward = see.velocity / np.maximum(speed, 1e-9)[:, None]
    there, clearance = see.cover_radius > 0, see.cover_radius + 0.4
    hit = np.where(there, threat(forward[:, None], see.cover, clearance, (speed * p.horizon)[:, None]), np.inf)
    first = np.argmin(hit, axis=1)
    avoidance = per_row(p.avoid) * avoid(forward, see.cover[row, first], clearance[row, first], top)
    avoidance *= np.isfinite(hit[row, first])[:, None]
    inside = 5.0 * contain(see.to_low - 0.5, see.to_high - 0.5, see.velocity, top, p.wall)

    distance = np.linalg.norm(see.pursuers, axis=-1)
    time = np.minimum(distance / task.pursuer_speed, per_row(p.predict))
    flight = evade_from(see.pursuers, see.velocity[:, None], see.pursuer_velocity, top, time)
    rank = np.where(np.arange(distance.shape[1]) == 0, 1.0, per_row(p.crowd))
    weight = rank * (distance < per_row(p.alarm)) / np.maximum(distance, 0.1) ** 2
    away = per_row(p.evade) * np.sum(flight * weight[..., None], axis=1)
    away /= np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    near = (weight.sum(axis=1) > 0)[:, None]
    away += per_row(p.middle) * (see.to_high - see.to_low) / 2 * near

    places = hiding_place(see.cover, see.cover_radius, per_row(p.margin), see.pursuers[:, :1])
    theirs = np.linalg.norm(places[:, :, None] - see.pursuers[:, None], axis=-1).min(axis=-1)
    cost = np.linalg.norm(places, axis=-1) + per_row(p.danger) * np.maximum(10.0 - theirs, 0.0)
    cost += per_row(p.exposed) * _count_watchers(places, see, task.sight)
    nearest = np.argmin(np.where(there, cost, np.inf), axis=1)
    hidden = per_row(p.hide) * arrive(places[row, nearest], see.velocity, top, 0.5) * there.any(axis=1)[:, None]
    forces = np.stack([avoidance, inside, away, hidden], axis=1)
    return allocate(in_order(forces, order), task.evader_force)


@dataclass(frozen=True)
class EscapeRules:
    """Defaults, set by hand: look 2 s ahead, and prefer courses out of sight; effort is saved if there is no danger."""

    reach: float = parameter(2.0, 0.5, 4.0)  # s, look-ahead along each course
    margin: float = parameter(2.0, 0.3, 5.0)  # m, distance kept from a pursuer, over which its danger falls to 1 / e
    unseen: float = parameter(
        0.5, 0.0, 1.0
    )  # danger of a pursuer that does not see the evader, relative to one that does
    exposed: float = parameter(0.2, 0.0, 2.0)  # cost of a course for each pursuer that sees its end
    turn: float = parameter(0.2, 0.0, 2.0)  # cost of a course opposite to the present one
    wall: float = parameter(0.5, 0.2, 3.0)  # m, clearance from walls
    calm: float = parameter(0.05, 0.0, 0.5)  # danger here, below which the force falls in proportion
    gain: float = parameter(5.0, 1.0, 10.0)  # kg/s, force per m/s of the desired change


def escape(see: Any, task: Evade, p: EscapeRules) -> NDArray[np.float64]:
    """Seek along the course that costs least, of those whose free path is seen (after Fray 2015, context steering).

    The cost of a course is its danger, exposure and change of direction. The danger of a place is a sum over pursuers;
    it falls with the distance that is left to a pursuer that runs straight for the place meanwhile.
    """
    angle = 2.0 * np.pi * np.arange(task.rays) / task.rays
    courses = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seconds = per_row(p.reach) * _SHARES
    places = _places_along(courses, seconds, see, task, p)
    danger = _danger(places, seconds[..., None, :], see, task, p).max(axis=2)
    speed = np.linalg.norm(see.velocity, axis=-1, keepdims=True)
    back = 0.5 - 0.5 * (see.velocity / np.maximum(speed, 0.3)) @ courses.T
    exposure = _count_watchers(places[:, :, -1], see, task.sight)
    cost = danger + per_row(p.exposed) * exposure + per_row(p.turn) * back
    best = courses[np.argmin(cost, axis=1)]
    here = _danger(np.zeros((len(best), 1, 1, 2)), np.zeros(1), see, task, p)[:, 0, 0]
    effort = p.gain * np.minimum(here / np.maximum(p.calm, 1e-9), 1.0)
    force: NDArray[np.float64] = effort[:, None] * seek(best, see.velocity, task.evader_speed)
    return force


def _places_along(
    courses: NDArray[np.float64], seconds: NDArray[np.float64], see: Any, task: Evade, p: EscapeRules
) -> NDArray[np.float64]:
    """Return where the evader is on each course at the given times, s; it stops where its free path ends.

    (R, courses, seconds, 2), relative to the evader, m.
    """
    walls = np.where(courses > 0.0, see.to_high[:, None], see.to_low[:, None]) - per_row(p.wall, 2)
    to_walls = (np.maximum(walls, 0.0) / np.maximum(np.abs(courses), 1e-9)).min(axis=-1)
    free = np.minimum(see.free_way, to_walls)
    run = np.minimum(task.evader_speed * seconds[..., None, :], free[..., None])
    places: NDArray[np.float64] = run[..., None] * courses[:, None]
    return places


def _danger(
    places: NDArray[np.float64], seconds: NDArray[np.float64], see: Any, task: Evade, p: EscapeRules
) -> NDArray[np.float64]:
    """Return the danger of places (R, C, T, 2) at the given times, (T,) or (R, 1, T) s."""
    distance = np.linalg.norm(places[:, :, :, None] - see.pursuers[:, None, None], axis=-1)
    left = distance - task.capture_distance - task.pursuer_speed * seconds[..., None]
    weight = np.where(see.seen > 0, 1.0, per_row(p.unseen))[:, None, None]
    scale = per_row(p.margin, 3)
    danger: NDArray[np.float64] = np.sum(weight * np.exp(-np.maximum(left / scale, -50.0)), axis=-1)
    return danger


def _count_watchers(places: NDArray[np.float64], see: Any, sight: float) -> NDArray[np.float64]:
    """Return how many pursuers are within sight of each of the places (R, K), with no cover in between."""
    offsets = places[:, :, None] - see.pursuers[:, None]
    length = np.linalg.norm(offsets, axis=-1)
    covers = (see.cover[:, None, :] - see.pursuers[:, :, None])[:, None]
    rays = offsets / np.maximum(length, 1e-9)[..., None]
    hit = ray_hit(covers, rays[..., None, :], see.cover_radius[:, None, None])
    hit = np.where(see.cover_radius[:, None, None] > 0, hit, np.inf)
    count: NDArray[np.float64] = np.sum((hit.min(axis=-1) > length) & (length < sight), axis=-1)
    return count


_SHARES = np.array([1.0, 2.0, 3.0]) / 3.0
"""Shares of the look-ahead at which the danger of a course is computed; the greatest counts."""
