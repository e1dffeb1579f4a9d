"""PathFollow: seek the track ahead if the predicted place is off it; brake before a bend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import parameter
from flockenv.steering.vectorize import rows
from flockenv.tasks import PathFollow

__all__ = ["PathFollowRules", "path_follow"]

follow_path = rows(steering.follow_path)


@dataclass(frozen=True)
class PathFollowRules:
    """Textbook: half a second ahead, the whole track is the tube, full speed in every bend."""

    time: float = parameter(0.5, 0.05, 0.8)  # s, look-ahead for the predicted position
    lead: float = parameter(0.5, 0.1, 0.8)  # s, look-ahead at the present speed to the point that is sought
    tube: float = parameter(1.0, 0.0, 1.0)  # share of the track's width within which there is no correction
    keep: float = parameter(0.5, 0.3, 0.99)  # share of the desired speed, below which it speeds up
    speed: float = parameter(1.0, 0.5, 1.0)  # desired speed as a share of the top speed
    grip: float = parameter(100.0, 0.3, 2.5)  # share of max_force that a bend may need; if large, it never slows down
    early: float = parameter(1.0, 0.2, 1.5)  # share of max_force that is assumed for braking before a bend
    brake: float = parameter(0.0, 0.0, 12.0)  # kg/s against speed in excess of that which bends allow
    gain: float = parameter(5.0, 1.0, 12.0)  # kg/s, force per m/s of the desired change


def path_follow(see: Any, task: PathFollow, p: PathFollowRules) -> NDArray[np.float64]:
    """Follow the path (Reynolds 1999), at a speed that the bends ahead allow; vectors are (along the track, left)."""
    row, step = np.arange(len(see.left)), task.spacing / _FINE
    spine = np.concatenate([np.stack([0.0 * see.left, -see.left], axis=-1)[:, None], see.points], axis=1)
    share = (np.arange(task.ahead * _FINE) / _FINE) % 1.0
    piece = np.arange(task.ahead * _FINE) // _FINE
    fine = spine[:, piece] * (1.0 - share)[:, None] + spine[:, piece + 1] * share[:, None]
    far = task.spacing * np.arange(task.ahead)[None]  # a bend is assumed to begin one point earlier
    bend = np.maximum(np.abs(see.curvature), 1e-6)
    allowed = p.grip * task.max_force / bend + 2.0 * p.early * task.max_force * far
    top = np.minimum(p.speed * task.max_speed, np.sqrt(allowed.min(axis=1)))
    speed = np.linalg.norm(see.velocity, axis=-1)
    gap = np.linalg.norm(fine - p.time * see.velocity[:, None], axis=-1)
    then = np.argmin(gap, axis=1)
    gained = then * step - p.keep * top * p.time
    ahead = p.lead * np.maximum(speed, 0.25 * top)
    target = fine[row, np.minimum(np.round(ahead / step), task.ahead * _FINE - 1).astype(int)]
    following = p.gain * follow_path(gap[row, then] - p.tube * task.half_width, gained, target, see.velocity, top)
    slower = -p.brake * (np.maximum(speed - top, 0.0) / np.maximum(speed, 1e-9))[:, None] * see.velocity
    force: NDArray[np.float64] = slower + following
    return force


_FINE = 5
"""Interpolated places per piece between two observed points of the track, among which the nearest is taken."""
