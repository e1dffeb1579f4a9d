"""Corridor: sample velocities, or slow down before others and pass them on one side; or ORCA."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.jit.decorators import Numbers, Vec, unfused
from flockenv.players.rules.clearance import keep_clear
from flockenv.players.rules.parameter import parameter, per_row
from flockenv.steering.arbitration import Forces
from flockenv.steering.vectorize import rows
from flockenv.tasks import Corridor

__all__ = [
    "CorridorOrcaRules", "CorridorRules", "SampledRules", "best_velocity", "corridor", "orca_corridor",
    "sampled_velocity",
]  # fmt: skip

sidestep = rows(steering.sidestep)

_PERSON = 0.25
"""Radius of a person, m."""


@dataclass(frozen=True)
class CorridorRules:
    """Textbook: Moussaid et al. 2009, with its bias to the right, and its walls."""

    tau: float = parameter(0.54, 0.1, 1.5)  # s, relaxation time
    strength: float = parameter(4.5, 0.0, 20.0)  # A, m/s^2
    importance: float = parameter(2.0, 0.0, 4.0)  # lambda, s/m, of velocities against positions
    gamma: float = parameter(0.35, 0.05, 1.5)  # s, range of the force per m/s of closing speed
    angular: float = parameter(2.0, 0.0, 6.0)  # n, 1/m, of turning
    forward: float = parameter(3.0, 0.0, 6.0)  # n', 1/m, of slowing down
    bias: float = parameter(0.005, 0.0, 0.5)  # eps, 1/m, to the right
    walls: float = parameter(3.0, 0.0, 20.0)  # a, m/s^2
    wall_decay: float = parameter(0.1, 0.02, 0.5)  # b, m


def corridor(see: Any, task: Corridor, p: CorridorRules) -> NDArray[np.float64]:
    """Drive at the desired speed, away from others and from walls; vectors are (along the desired direction, left)."""
    own = see.velocity[:, None]
    sidesteps = sidestep(
        see.neighbours, own, own + see.neighbour_velocity, np.array([1.0, 0.0]),
        *map(per_row, (p.importance, p.gamma, p.angular, p.forward, p.bias)),
    )  # fmt: skip
    push = per_row(p.strength) * np.sum(sidesteps * see.neighbour_present[..., None], axis=1)
    walls = _wall_force(see, p.walls, p.wall_decay)
    force: NDArray[np.float64] = (_desired_velocity(see, 0.0) - see.velocity) / per_row(p.tau) + push + walls
    return force


def _desired_velocity(see: Any, lane: Any) -> NDArray[np.float64]:
    """Return the desired velocities, m/s: along the corridor and, if the body is not in the right half, into it.

    lane: m/s to the right for each metre that it is outside. All agents keep right, so the directions part.
    """
    return np.stack([see.desired_speed, 0.0 - lane * np.maximum(_outside(see), 0.0)], axis=-1)


def _outside(see: Any) -> NDArray[np.float64]:
    """Return how far the body is outside the right half of the corridor, m; negative within it."""
    outside: NDArray[np.float64] = 0.5 * (see.walls[:, 1] - see.walls[:, 0]) + _PERSON
    return outside


def _wall_force(see: Any, strength: Any, decay: Any) -> NDArray[np.float64]:
    """Return the push off both walls, a exp(-d / b), d from the body's centre."""
    push = strength * (np.exp(-see.walls[:, 1] / decay) - np.exp(-see.walls[:, 0] / decay))
    return np.stack([0.0 * push, push], axis=-1)


@dataclass(frozen=True)
class CorridorOrcaRules:
    """ORCA: as published, each agent makes half of the change; a desired velocity that is not free is turned right."""

    horizon: float = parameter(2.0, 0.5, 6.0)  # s, for which the velocity must be free of collisions
    margin: float = parameter(0.05, 0.0, 0.5, below="bodies touch")  # m, clearance for delays by inertia
    turn: float = parameter(0.3, 0.0, 1.5)  # rad, a desired velocity that is not free is turned right by this
    gain: float = parameter(10.0, 1.0, 20.0)  # kg/s: reaches the desired velocity within a decision
    lane: float = parameter(0.0, 0.0, 2.0, below="agents keep left")  # 1/s, back to the right half; not in the paper


def orca_corridor(see: Any, task: Corridor, p: CorridorOrcaRules) -> NDArray[np.float64]:
    """Avoid others by ORCA (van den Berg et al. 2011) along the corridor; walls are not among the neighbours."""
    return keep_clear(see, task, p, _desired_velocity(see, p.lane), _PERSON, _PERSON, 0.5) + _wall_force(see, 3.0, 0.1)


@dataclass(frozen=True)
class SampledRules:
    """Defaults, set by hand on a few tuning worlds."""

    risk: float = parameter(0.2, 0.0, 2.0)  # s, cost of a touch, divided by the time until it
    horizon: float = parameter(3.0, 0.5, 6.0)  # s, beyond which a touch costs nothing
    margin: float = parameter(0.12, 0.0, 0.5, below="bodies touch")  # m, clearance
    share: float = parameter(0.7, 0.4, 1.0)  # the agent's part of a change; the other one makes the rest
    aside: float = parameter(0.1, 0.0, 1.0)  # s/m, cost of a speed across the corridor
    lane: float = parameter(1.0, 0.0, 3.0, below="agents keep left")  # 1/m, cost of being outside the right half in 1 s
    gain: float = parameter(8.0, 1.0, 20.0)  # kg/s, force per m/s of the desired change


def sampled_velocity(see: Any, task: Corridor, p: SampledRules) -> NDArray[np.float64]:
    """Take the velocity that costs least, of 52 (van den Berg, Lin and Manocha 2008, reciprocal velocity obstacles).

    The cost is the deviation from the desired speed, with charges for an early touch, for speed across the corridor,
    for walls, and for being outside the right half. As in the paper, others are expected to make a part of the change.
    """
    desired = best_velocity(
        see.neighbours, see.neighbour_velocity, see.neighbour_present, see.velocity, see.walls, see.desired_speed,
        _outside(see), 2 * _PERSON + p.margin, p.risk, p.horizon, p.share, p.aside, p.lane,
    )  # fmt: skip
    force: NDArray[np.float64] = per_row(p.gain) * (desired - see.velocity)
    return force


_ACROSS = (-1.2, -0.9, -0.6, -0.4, -0.2, -0.1, 0.0, 0.1, 0.2, 0.4, 0.6, 0.9, 1.2)
_ALONG = (1.0, 0.8, 0.5, 0.2)
"""The velocities: across the corridor, m/s to the left, and along it, as a share of the desired speed."""

_WALL_TIME, _SOONEST = 0.5, 0.05  # s, within which reaching a wall costs; least time to a touch


@unfused
def _time_to_touch(to: Vec, x: float, y: float, clearance: float) -> float:
    """Return the time until two bodies touch that approach at (x, y) m/s, the other one at `to`; inf for never."""
    near, closing = to[0] * to[0] + to[1] * to[1] - clearance * clearance, to[0] * x + to[1] * y
    room = closing * closing - (x * x + y * y) * near
    if not (closing > 0.0 and room >= 0.0):
        return np.inf
    return max(near, 0.0) / max(closing + math.sqrt(room), 1e-9)


@unfused
def _best_velocity(
    others: Forces, velocities: Forces, present: Numbers, own: Vec, walls: Numbers, speed: float, outside: float,
    clearance: float, risk: float, horizon: float, share: float, aside: float, lane: float,
) -> Vec:  # fmt: skip
    """Return the velocity that costs least of one agent; parameters are those of SampledRules, the rest is seen."""
    least, best = np.inf, (0.0, 0.0)
    for along in _ALONG:
        for across in _ACROSS:
            to_wall = (walls[0] if across > 0.0 else walls[1]) - _PERSON
            cost = 1.0 - along + aside * abs(across)
            wall = max(1.0 - max(to_wall, 0.0) / max(abs(across) * _WALL_TIME, 1e-9), 0.0)
            half = lane * max(outside + across, 0.0)
            if cost + wall + half >= least:
                continue  # a touch only adds to it
            x, y, soonest = own[0] + (speed * along - own[0]) / share, own[1] + (across - own[1]) / share, np.inf
            for k in range(len(others)):
                if present[k] > 0.0:
                    u, v = x - (own[0] + velocities[k][0]), y - (own[1] + velocities[k][1])
                    soonest = min(soonest, _time_to_touch(others[k], u, v, clearance))
            cost += risk * max(1.0 / max(soonest, _SOONEST) - 1.0 / horizon, 0.0)
            cost += wall
            cost += half
            if cost < least:
                least, best = cost, (speed * along, across)
    return best


best_velocity = rows(_best_velocity)
