"""Pursuit: seek the predicted place of the quarry, clipped to the walls that it cannot pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import parameter, per_row
from flockenv.players.rules.slots import nearest
from flockenv.steering.vectorize import rows
from flockenv.tasks import Pursuit

__all__ = ["PursuitRules", "pursuit"]

arrive = rows(steering.arrive)
interception_time = rows(steering.interception_time)


@dataclass(frozen=True)
class PursuitRules:
    """Textbook: exact interception, full force."""

    factor: float = parameter(1.0, 0.0, 1.5)  # look-ahead as a share of the interception time
    horizon: float = parameter(10.0, 0.2, 6.0)  # s, longest look-ahead
    margin: float = parameter(0.3, 0.0, 2.5)  # m, least distance of the predicted place from walls
    gain: float = parameter(5.0, 1.0, 12.0)  # kg/s, force per m/s of the desired change
    slow_radius: float = parameter(0.01, 0.01, 2.0)  # m, brake within this distance of the predicted place (arrive)


def pursuit(see: Any, task: Pursuit, p: PursuitRules) -> NDArray[np.float64]:
    """Pursue the nearest opponent (Reynolds 1999) with a bounded exact predictor; without one, keep the velocity."""
    there, offset, quarry = nearest(see.opponent_present, see.opponents, see.opponent_velocity)
    top = task.pursuer_speed
    time = np.minimum(p.factor * interception_time(offset, quarry, top), p.horizon)
    ahead = offset + quarry * time[:, None]
    margin = per_row(p.margin)
    ahead = np.clip(ahead, margin - see.to_low, see.to_high - margin)
    force: NDArray[np.float64] = per_row(p.gain) * arrive(ahead, see.velocity, top, p.slow_radius) * there[:, None]
    return force
