"""Corridor: sample velocities, or slow down before others and pass them on one side; or ORCA."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.clearance import keep_clear
from flockenv.players.rules.parameter import parameter, per_row
from flockenv.steering.vectorize import rows
from flockenv.tasks import Corridor

__all__ = ["CorridorOrcaRules", "CorridorRules", "SampledRules", "corridor", "orca_corridor", "sampled_velocity"]

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
    parts = [slice(first, first + _TOGETHER) for first in range(0, max(len(see.velocity), 1), _TOGETHER)]
    return np.concatenate([_sampled(_rows_of(see, part), _rows_of(p, part)) for part in parts])


def _sampled(see: SimpleNamespace, p: SimpleNamespace) -> NDArray[np.float64]:
    """Return the forces of `sampled_velocity` in some rows, (R, 2) N."""
    own = see.velocity[:, None]
    along = see.desired_speed[:, None] * _ALONG
    x, y = (own[..., k] + (v - own[..., k]) / per_row(p.share) for k, v in enumerate((along, _ACROSS)))
    soon = np.maximum(_time_to_touch(x, y, see, 2 * _PERSON + per_row(p.margin)), _SOONEST)
    to_wall = np.where(_ACROSS > 0.0, see.walls[:, :1], see.walls[:, 1:]) - _PERSON
    cost = 1.0 - _ALONG + per_row(p.aside) * np.abs(_ACROSS)
    cost = cost + per_row(p.risk) * np.maximum(1.0 / soon - 1.0 / per_row(p.horizon), 0.0)
    cost += np.maximum(1.0 - np.maximum(to_wall, 0.0) / np.maximum(np.abs(_ACROSS) * _WALL_TIME, 1e-9), 0.0)
    cost += per_row(p.lane) * np.maximum(_outside(see)[:, None] + _ACROSS, 0.0)
    best = np.argmin(cost, axis=1)
    desired = np.stack([along[np.arange(len(best)), best], _ACROSS[best]], axis=-1)
    force: NDArray[np.float64] = per_row(p.gain) * (desired - see.velocity)
    return force


_ACROSS, _ALONG = (
    each.ravel()
    for each in np.meshgrid([-1.2, -0.9, -0.6, -0.4, -0.2, -0.1, 0, 0.1, 0.2, 0.4, 0.6, 0.9, 1.2], [1.0, 0.8, 0.5, 0.2])
)
"""The velocities: across the corridor, m/s to the left, and along it, as a share of the desired speed."""

_WALL_TIME, _SOONEST = 0.5, 0.05  # s, within which reaching a wall costs; least time to a touch


_TOGETHER = 512
"""Rows computed together: an array with a number for each of their velocities then fits into a core's cache."""


def _rows_of(values: Any, part: slice) -> SimpleNamespace:
    """Return some rows of what is seen, or of parameters: those of each array; a number is that of all rows."""
    return SimpleNamespace(**{k: v[part] if isinstance(v, np.ndarray) else v for k, v in vars(values).items()})


def _time_to_touch(x: NDArray[np.float64], y: NDArray[np.float64], see: Any, clearance: Any) -> NDArray[np.float64]:
    """Return the time until the agent touches another at velocities (x, y), (R, K) m/s, in a frame at rest; or inf."""
    soonest, present = np.full(x.shape, np.inf), see.neighbour_present > 0
    for k in np.flatnonzero(present.any(axis=0)):
        to, velocity = see.neighbours[:, k], see.velocity + see.neighbour_velocity[:, k]
        u, v = x - velocity[:, :1], y - velocity[:, 1:]
        near, closing = np.sum(to * to, axis=-1)[:, None] - clearance * clearance, to[:, :1] * u + to[:, 1:] * v
        room = closing * closing - (u * u + v * v) * near
        time = np.maximum(near, 0.0) / np.maximum(closing + np.sqrt(np.maximum(room, 0.0)), 1e-9)
        time[~((closing > 0.0) & (room >= 0.0) & present[:, k, None])] = np.inf
        np.minimum(soonest, time, out=soonest)
    return soonest
