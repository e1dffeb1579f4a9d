"""What the players by ORCA share: the velocity nearest to what one wants that is free of all who are seen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.orca import orca
from flockenv.rows import rows

__all__ = ["keep_clear"]

clear = rows(orca)


def keep_clear(
    see: Any, task: Any, p: Any, wish: NDArray[np.float64], radius: float, others: float, share: float
) -> NDArray[np.float64]:
    """Return the force towards the velocity (van den Berg et al. 2011) nearest to `wish`, (rows, 2) m/s, that is free.

    radius: of one's body, m; others: of those who are seen; share: of the change that is one's own. `p` says for how
    long it must be free (horizon, s), with which clearance (margin, m), how far a wish that is not free is turned right
    (turn, rad), and how hard one pushes (gain, kg/s).
    """
    velocities = see.velocity[:, None] + see.neighbour_velocity
    wide = np.where(see.neighbour_present > 0, others + p.margin, -1.0)[..., None]
    seen = np.concatenate([see.neighbours, velocities, wide, np.full_like(wide, share)], axis=-1)
    change = clear(
        see.velocity, wish, radius, task.max_speed, p.horizon, task.control_dt, p.turn, seen.reshape(len(seen), -1)
    )
    force: NDArray[np.float64] = p.gain * change
    return force
