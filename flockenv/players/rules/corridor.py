"""Corridor: slow down before others, and pass them on one side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.clearance import keep_clear
from flockenv.players.rules.parameter import parameter, per_row
from flockenv.steering.vectorize import rows
from flockenv.tasks import Corridor

__all__ = ["CorridorOrcaRules", "CorridorRules", "corridor", "orca_corridor"]

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
    force: NDArray[np.float64] = (_desired_velocity(see) - see.velocity) / per_row(p.tau) + push + walls
    return force


def _desired_velocity(see: Any) -> NDArray[np.float64]:
    """Return the desired velocities, m/s."""
    return np.stack([see.desired_speed, 0.0 * see.desired_speed], axis=-1)


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


def orca_corridor(see: Any, task: Corridor, p: CorridorOrcaRules) -> NDArray[np.float64]:
    """Avoid others by ORCA (van den Berg et al. 2011) along the corridor; walls are not among the neighbours."""
    return keep_clear(see, task, p, _desired_velocity(see), _PERSON, _PERSON, 0.5) + _wall_force(see, 3.0, 0.1)
