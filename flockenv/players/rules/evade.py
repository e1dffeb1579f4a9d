"""Evade: take the least threatened course, or flee from near pursuers and hide behind cover (Reynolds 1999)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.geometry import shapes
from flockenv.players.rules.parameter import Order, in_order, parameter, per_row
from flockenv.players.rules.vectors import hypotenuse, length
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
    speed = length(see.velocity)
    forward = see.velocity / np.maximum(speed, 1e-9)[:, None]
    there, clearance = see.cover_radius > 0, see.cover_radius + 0.4
    hit = np.where(there, threat(forward[:, None], see.cover, clearance, (speed * p.horizon)[:, None]), np.inf)
    first = np.argmin(hit, axis=1)
    avoidance = per_row(p.avoid) * avoid(forward, see.cover[row, first], clearance[row, first], top)
    avoidance *= np.isfinite(hit[row, first])[:, None]
    inside = 5.0 * contain(see.to_low - 0.5, see.to_high - 0.5, see.velocity, top, p.wall)

    distance = length(see.pursuers)
    time = np.minimum(distance / task.pursuer_speed, per_row(p.predict))
    flight = evade_from(see.pursuers, see.velocity[:, None], see.pursuer_velocity, top, time)
    rank = np.where(np.arange(distance.shape[1]) == 0, 1.0, per_row(p.crowd))
    weight = rank * (distance < per_row(p.alarm)) / np.maximum(distance, 0.1) ** 2
    away = per_row(p.evade) * np.sum(flight * weight[..., None], axis=1)
    away /= np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    near = (weight.sum(axis=1) > 0)[:, None]
    away += per_row(p.middle) * (see.to_high - see.to_low) / 2 * near

    places = hiding_place(see.cover, see.cover_radius, per_row(p.margin), see.pursuers[:, :1])
    theirs = length(places[:, :, None] - see.pursuers[:, None]).min(axis=-1)
    cost = length(places) + per_row(p.danger) * np.maximum(10.0 - theirs, 0.0)
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
    run = _runs(courses, seconds, see, task, p)
    x, y = run * courses[:, :1], run * courses[:, 1:]
    danger = _danger(x, y, seconds[..., None, :], see, task, p).max(axis=2)
    heading = see.velocity / np.maximum(length(see.velocity), 0.3)[:, None]
    back = 0.5 - 0.5 * (heading[:, :1] * courses[:, 0] + heading[:, 1:] * courses[:, 1])
    exposure = _count_watchers(np.stack([x[..., -1], y[..., -1]], axis=-1), see, task.sight)
    cost = danger + per_row(p.exposed) * exposure + per_row(p.turn) * back
    best = courses[np.argmin(cost, axis=1)]
    still = np.zeros((len(best), 1, 1))
    here = _danger(still, still, np.zeros(1), see, task, p)[:, 0, 0]
    effort = p.gain * np.minimum(here / np.maximum(p.calm, 1e-9), 1.0)
    force: NDArray[np.float64] = effort[:, None] * seek(best, see.velocity, task.evader_speed)
    return force


def _runs(
    courses: NDArray[np.float64], seconds: NDArray[np.float64], see: Any, task: Evade, p: EscapeRules
) -> NDArray[np.float64]:
    """Return how far the evader is along each course at the given times, s: (R, courses, seconds), m.

    It stops where its free path ends.
    """
    walls = np.where(courses > 0.0, see.to_high[:, None], see.to_low[:, None]) - per_row(p.wall, 2)
    to_walls = np.maximum(walls, 0.0) / np.maximum(np.abs(courses), 1e-9)
    free = np.minimum(see.free_way, np.minimum(to_walls[..., 0], to_walls[..., 1]))
    runs: NDArray[np.float64] = np.minimum(task.evader_speed * seconds[..., None, :], free[..., None])
    return runs


def _danger(
    x: NDArray[np.float64], y: NDArray[np.float64], seconds: NDArray[np.float64], see: Any, task: Evade, p: EscapeRules
) -> NDArray[np.float64]:
    """Return the danger of places (x, y), (R, C, T) m each, at the given times, (T,) or (R, 1, T) s."""
    weights = np.where(see.seen > 0, 1.0, per_row(p.unseen))[..., None, None]
    pursuers, scale = see.pursuers[..., None, None], per_row(p.margin, 2)
    danger = np.zeros(x.shape)
    for k in range(pursuers.shape[1]):
        distance = hypotenuse(x - pursuers[:, k, 0], y - pursuers[:, k, 1])
        left = distance - task.capture_distance - task.pursuer_speed * seconds
        danger += weights[:, k] * np.exp(-np.maximum(left / scale, -50.0))
    return danger


def _count_watchers(places: NDArray[np.float64], see: Any, sight: float) -> NDArray[np.intp]:
    """Return how many pursuers are within sight of each of the places (R, K), with no cover in between."""
    offsets = places[:, :, None] - see.pursuers[:, None]
    distance = length(offsets)
    near = distance < sight
    row, _, pursuer = pair = np.nonzero(near)  # a cover is tested only for those within sight
    covers = see.cover[row] - see.pursuers[row, pursuer][:, None]
    rays = offsets[pair] / np.maximum(distance[pair], 1e-9)[:, None]
    hit = ray_hit(covers, rays[:, None], see.cover_radius[row])
    hit = np.where(see.cover_radius[row] > 0, hit, np.inf)
    near[pair] = hit.min(axis=-1) > distance[pair]
    count: NDArray[np.intp] = np.count_nonzero(near, axis=-1)
    return count


_SHARES = np.array([1.0, 2.0, 3.0]) / 3.0
"""Shares of the look-ahead at which the danger of a course is computed; the greatest counts."""
