"""Obstacles: try velocities in thought, or avoid the first obstacle and seek the goal (Reynolds 1999)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import Order, in_order, parameter, per_row
from flockenv.players.rules.vectors import hypotenuse, length
from flockenv.steering import arbitration
from flockenv.steering.vectorize import rows
from flockenv.tasks import Obstacles

__all__ = ["ObstaclesRules", "WindowRules", "dynamic_window", "obstacles"]

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
    speed: float = parameter(1.0, 0.6, 1.0, above="it exceeds the limit")  # desired speed as a share of the top speed
    push: float = parameter(0.0, 0.0, 2.0)  # N m, repulsion from the nearest surfaces, push / gap


BEHAVIOURS = ("avoid", "repulsion", "seek")
"""In order of priority."""


def obstacles(see: Any, task: Obstacles, p: ObstaclesRules, order: Order = None) -> NDArray[np.float64]:
    """Avoid the obstacle that the straight path touches first (Reynolds 1999), then seek; allocation as in 1987."""
    speed = length(see.velocity)
    goal_way = see.goal / np.maximum(length(see.goal), 1e-9)[:, None]
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
    away = -see.obstacles / np.maximum(length(see.obstacles), 1e-9)[..., None]
    seen = (see.obstacle_radius > 0) & (see.clearance < 1.0)
    field = per_row(p.push) * np.sum(away * (seen / np.maximum(see.clearance, 0.05))[..., None], axis=1)
    course = per_row(p.gain) * seek(see.goal, see.velocity, p.speed * task.max_speed)
    return allocate(in_order(np.stack([evasion, field, course], axis=1), order), task.max_force)


@dataclass(frozen=True)
class WindowRules:
    """Defaults, set by hand on a few tuning worlds."""

    horizon: float = parameter(0.5, 0.2, 2.0)  # s, for which each velocity is tried
    margin: float = parameter(0.05, 0.0, 0.4)  # m, a smaller gap counts as a contact
    near: float = parameter(0.6, 0.0, 5.0, below="surfaces attract")  # s, cost of being at a surface throughout
    reach: float = parameter(0.25, 0.02, 2.0)  # m, gap over which that cost falls to 1 / e
    detour: float = parameter(0.3, 0.0, 3.0)  # s per m by which obstacles overlap the straight path to the goal


def dynamic_window(see: Any, task: Obstacles, p: WindowRules) -> NDArray[np.float64]:
    """Accelerate to the velocity that costs least, of 48, each tried for a moment (Fox, Burgard and Thrun 1997).

    The cost is the time to the goal from the end of that path, with a charge for obstacles in between, for closeness on
    the path, and, above all, for a contact, the earlier the worse.
    """
    velocities = _velocities(see.goal, task.max_speed)
    change = velocities - see.velocity.T[..., None]
    seconds = per_row(p.horizon, 2) * _SHARES[:, None]
    path = _path(see.velocity, velocities, change, seconds, task.max_force)
    gap = _gap(path, see)
    contact = gap < per_row(p.margin, 2)
    first = np.where(contact.any(axis=1), _SHARES[np.argmax(contact, axis=1)], np.inf)
    left = see.goal.T[:, :, None, None] - path
    away = hypotenuse(*left)
    end = path[:, :, -1]
    outside = ((end < _BODY - see.to_low.T[..., None]) | (end > see.to_high.T[..., None] - _BODY)).any(axis=0)

    cost = away[:, -1] / task.max_speed + per_row(p.detour) * _overlap(end, left[:, :, -1], away[:, -1], see, p)
    cost += per_row(p.near) * np.exp(-np.maximum(gap, 0.0) / per_row(p.reach, 2)).mean(axis=1)
    arrives = (away < task.goal_radius).any(axis=1)
    cost += _CONTACT * np.maximum(1.5 - first, 0.0) + _OUTSIDE * outside - _ARRIVAL * arrives
    best = change[:, np.arange(len(cost)), np.argmin(cost, axis=1)].T
    force: NDArray[np.float64] = best / task.control_dt  # reached within this decision, if the force limit allows it
    return force


_BODY = 0.3  # m, the agent's radius
_DIRECTIONS, _SPEEDS = 24, (1.0, 0.5)  # of the velocities; shares of the top speed
_SHARES = np.linspace(0.2, 1.0, 5)  # of the horizon, at which gaps are measured
_CONTACT, _OUTSIDE, _ARRIVAL = 20.0, 3.0, 5.0  # s, costs


# Below, the axis of coordinates is the first one, and that of velocities the last: numpy is fastest so.


def _velocities(goal: NDArray[np.float64], top: float) -> NDArray[np.float64]:
    """Return the velocities to try, (2, R, K) m/s: directions around that to the goal, at some speeds each."""
    angle = np.arctan2(goal[:, 1:], goal[:, :1]) + 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    directions = np.stack([np.cos(angle), np.sin(angle)])
    velocities: NDArray[np.float64] = np.concatenate([speed * top * directions for speed in _SPEEDS], axis=-1)
    return velocities


def _path(
    velocity: NDArray[np.float64], to: NDArray[np.float64], change: NDArray[np.float64], seconds: Any, max_force: float
) -> NDArray[np.float64]:
    """Return where a body of 1 kg is that accelerates with the whole force, then keeps a velocity: (2, R, T, K), m.

    velocity: (R, 2), present one; to, change: (2, R, K); seconds: (T, 1) or (R, T, 1).
    """
    size = hypotenuse(*change)
    until = np.minimum(seconds, (size / max_force)[:, None])
    acceleration = (max_force * change / np.maximum(size, 1e-9))[:, :, None]
    path: NDArray[np.float64] = velocity.T[:, :, None, None] * until
    path += 0.5 * acceleration * until**2
    path += to[:, :, None] * (seconds - until)
    return path


def _gap(path: NDArray[np.float64], see: Any) -> NDArray[np.float64]:
    """Return the gap between the body and the nearest obstacle that is seen, (R, T, K), m; inf if there is none."""
    gap = np.full(path.shape[1:], np.inf)
    for centre, radius in zip(see.obstacles.swapaxes(0, 1), see.obstacle_radius.T, strict=True):
        touching = np.where(radius > 0, radius + _BODY, -np.inf)
        distance = hypotenuse(*(path - centre.T[:, :, None, None]))
        distance -= touching[:, None, None]
        np.minimum(gap, distance, out=gap)
    return gap


def _overlap(
    begin: NDArray[np.float64], way: NDArray[np.float64], distance: NDArray[np.float64], see: Any, p: WindowRules
) -> NDArray[np.float64]:
    """Return by how much obstacles overlap the path of a body along a straight way, (R, K), m: the sum over them.

    begin, way: (2, R, K); distance: its length, (R, K).
    """
    x, y = way / np.maximum(distance, 1e-9)
    total = np.zeros(distance.shape)
    for centre, radius in zip(see.obstacles.swapaxes(0, 1), see.obstacle_radius.T, strict=True):
        to_x, to_y = centre.T[..., None] - begin
        along, beside = to_x * x + to_y * y, np.abs(to_y * x - to_x * y)
        depth = np.maximum((radius + _BODY)[:, None] + per_row(p.margin) - beside, 0.0)
        total += np.where((radius > 0)[:, None] & (along > 0.0) & (along < distance), depth, 0.0)
    return total
