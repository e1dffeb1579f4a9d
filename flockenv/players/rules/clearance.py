"""Law that ORCA players share: the velocity nearest to the desired one that avoids all agents in sight."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.players.rules.parameter import per_row
from flockenv.steering.orca import orca
from flockenv.steering.vectorize import rows

__all__ = ["keep_clear"]

clear = rows(orca)


def keep_clear(
    see: Any, task: Any, p: Any, desired: NDArray[np.float64], radius: float, others: float, share: Any
) -> NDArray[np.float64]:
    """Return the force towards the free velocity nearest to the `desired` one, (rows, 2) m/s.

    van den Berg et al. 2011. radius: of the agent's body, m; others: radius of those in sight, m; share: the agent's
    part of the change. `p` has the time for which the velocity must be free (horizon, s), the clearance (margin, m),
    the angle by which a desired velocity that is not free is turned right (turn, rad), and the gain, kg/s.
    """
    velocities = see.velocity[:, None] + see.neighbour_velocity
    reach = np.where(see.neighbour_present > 0, others + per_row(p.margin), -1.0)[..., None]
    seen = np.concatenate([see.neighbours, velocities, reach, np.broadcast_to(per_row(share, 2), reach.shape)], axis=-1)
    change = clear(
        see.velocity, desired, radius, task.max_speed, p.horizon, task.control_dt, p.turn, seen.reshape(len(seen), -1)
    )
    force: NDArray[np.float64] = per_row(p.gain) * change
    return force
