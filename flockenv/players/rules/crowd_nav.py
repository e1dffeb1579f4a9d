"""CrowdNav: social force, ORCA, and the two rules of Moussaid et al."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.clearance import keep_clear
from flockenv.players.rules.parameter import parameter, per_row
from flockenv.players.rules.vectors import length
from flockenv.steering.vectorize import rows
from flockenv.tasks import CrowdNav

__all__ = ["CrowdNavRules", "HeuristicsRules", "RobotOrcaRules", "crowd_nav", "heuristics_crowd_nav", "orca_crowd_nav"]

collision_distance = rows(steering.collision_distance)
seek = rows(steering.seek)
sidestep = rows(steering.sidestep)


@dataclass(frozen=True)
class CrowdNavRules:
    """Textbook: Moussaid et al. 2009, the model of the pedestrians themselves."""

    tau: float = parameter(0.54, 0.15, 1.0)  # s, relaxation time
    speed: float = parameter(1.0, 0.5, 1.0, above="it exceeds the limit")  # desired speed as a share of the top speed
    strength: float = parameter(4.5, 0.5, 20.0)  # A, m/s^2
    importance: float = parameter(2.0, 0.0, 4.0)  # lambda, s/m, of velocities against positions
    gamma: float = parameter(0.35, 0.05, 1.5)  # s, range of the force per m/s of closing speed
    angular: float = parameter(2.0, 0.0, 6.0)  # n, 1/m, of turning
    forward: float = parameter(3.0, 0.0, 6.0)  # n', 1/m, of slowing down
    bias: float = parameter(0.005, 0.0, 0.5)  # eps, 1/m, to the right


def crowd_nav(see: Any, task: CrowdNav, p: CrowdNavRules) -> NDArray[np.float64]:
    """Drive to the goal, slow down before others and pass them on one side; vectors are (along the course, left)."""
    own = see.velocity[:, None]
    sidesteps = sidestep(
        see.neighbours, own, own + see.neighbour_velocity, np.array([1.0, 0.0]),
        *map(per_row, (p.importance, p.gamma, p.angular, p.forward, p.bias)),
    )  # fmt: skip
    direction = see.goal / np.maximum(length(see.goal), 1e-9)[:, None]
    push = per_row(p.strength) * np.sum(sidesteps * see.neighbour_present[..., None], axis=1)
    force: NDArray[np.float64] = (per_row(p.speed) * task.max_speed * direction - see.velocity) / per_row(p.tau) + push
    return force


@dataclass(frozen=True)
class RobotOrcaRules:
    """ORCA as published, but for the share: a robot that the pedestrians do not see must make the whole change."""

    horizon: float = parameter(2.0, 0.5, 6.0)  # s, for which the velocity must be free of collisions
    margin: float = parameter(0.1, 0.0, 0.8, below="bodies touch")  # m, clearance for delays by inertia
    turn: float = parameter(0.0, 0.0, 1.5)  # rad, a desired velocity that is not free is turned right by this
    gain: float = parameter(10.0, 1.0, 20.0)  # kg/s: reaches the desired velocity within a decision
    share: float = parameter(1.0, 0.5, 1.0)  # the robot's part of the change; 0.5 if pedestrians see it


def orca_crowd_nav(see: Any, task: CrowdNav, p: RobotOrcaRules) -> NDArray[np.float64]:
    """Head for the goal, and avoid pedestrians by ORCA (van den Berg et al. 2011)."""
    desired = seek(see.goal, np.zeros_like(see.goal), task.max_speed)
    return keep_clear(see, task, p, desired, _ROBOT, _PEDESTRIAN, 0.5 if task.visible else p.share)


@dataclass(frozen=True)
class HeuristicsRules:
    """Parameters of Moussaid et al. 2011 as published, but for the range of sight, which is the observation's."""

    tau: float = parameter(0.5, 0.1, 1.5)  # s, relaxation time, and the least time to a collision ahead
    reach: float = parameter(10.0, 1.0, 20.0)  # d_max, m
    view: float = parameter(75.0, 30.0, 180.0)  # degrees to either side of its heading
    margin: float = parameter(0.0, 0.0, 0.8)  # m, clearance


def heuristics_crowd_nav(see: Any, task: CrowdNav, p: HeuristicsRules) -> NDArray[np.float64]:
    """Take the most direct free direction, no faster than is safe (Moussaid, Helbing and Theraulaz 2011)."""
    aim = see.goal / np.maximum(length(see.goal), 1e-9)[:, None]
    speed, reach = length(see.velocity)[:, None], per_row(p.reach)
    gaze = np.where(speed > 0.05, see.velocity / np.maximum(speed, 1e-9), aim)
    turn = np.radians(np.linspace(-p.view, p.view, 31).T)
    cosine, sine = np.cos(turn), np.sin(turn)
    x, y = gaze[:, :1] * cosine - gaze[:, 1:] * sine, gaze[:, :1] * sine + gaze[:, 1:] * cosine
    # the aim comes first, so that it is selected among equally good directions
    directions = np.concatenate([aim[:, None], np.stack([x, y], axis=-1)], axis=1)
    seen, moving = see.neighbour_present > 0, see.velocity[:, None] + see.neighbour_velocity
    clearance, one = _ROBOT + _PEDESTRIAN + per_row(p.margin, 2), directions[:, None]
    free = collision_distance(one, see.neighbours[:, :, None], moving[:, :, None], clearance, task.max_speed)
    free = np.where(seen[:, :, None], free, np.inf).min(axis=1).clip(max=reach)
    remaining = reach**2 + free**2 - 2.0 * reach * free * np.sum(directions * aim[:, None], axis=-1)
    best = directions[np.arange(len(remaining)), np.argmin(remaining, axis=1)]
    clearance = _ROBOT + _PEDESTRIAN + per_row(p.margin)
    now = collision_distance(best[:, None], see.neighbours, np.zeros(2), clearance, 1.0)
    now = np.where(seen, now, np.inf).min(axis=1)
    safe = np.minimum(task.max_speed, now / p.tau)[:, None]
    force: NDArray[np.float64] = (safe * best - see.velocity) / per_row(p.tau)
    return force


_ROBOT, _PEDESTRIAN = 0.3, 0.25
"""Radii of the robot and of a pedestrian, m."""
