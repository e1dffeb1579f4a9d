"""PathFollow: follow a racing line at the speed that its bends allow, or keep near the middle line (Reynolds 1999)."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import parameter, per_row
from flockenv.players.rules.vectors import length
from flockenv.steering.vectorize import rows
from flockenv.tasks import PathFollow

__all__ = ["PathFollowRules", "RacingRules", "allowed_speeds", "path_follow", "race", "racing_line"]

follow_path = rows(steering.follow_path)
seek = rows(steering.seek)


@dataclass(frozen=True)
class PathFollowRules:
    """Textbook: half a second ahead, the whole track is the tube, full speed in every bend."""

    time: float = parameter(0.5, 0.05, 0.8)  # s, look-ahead for the predicted position
    lead: float = parameter(0.5, 0.1, 0.8)  # s, look-ahead at the present speed to the point that is sought
    tube: float = parameter(1.0, 0.0, 1.0)  # share of the track's width within which there is no correction
    keep: float = parameter(0.5, 0.3, 0.99)  # share of the desired speed, below which it speeds up
    speed: float = parameter(1.0, 0.5, 1.0, above="it exceeds the limit")  # desired speed as a share of the top speed
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
    allowed = per_row(p.grip) * task.max_force / bend + 2.0 * per_row(p.early) * task.max_force * far
    top = np.minimum(p.speed * task.max_speed, np.sqrt(allowed.min(axis=1)))
    speed = length(see.velocity)
    gap = length(fine - per_row(p.time, 2) * see.velocity[:, None])
    then = np.argmin(gap, axis=1)
    gained = then * step - p.keep * top * p.time
    ahead = p.lead * np.maximum(speed, 0.25 * top)
    target = fine[row, np.minimum(np.round(ahead / step), task.ahead * _FINE - 1).astype(int)]
    outside = gap[row, then] - p.tube * task.half_width
    following = per_row(p.gain) * follow_path(outside, gained, target, see.velocity, top)
    slower = -per_row(p.brake) * (np.maximum(speed - top, 0.0) / np.maximum(speed, 1e-9))[:, None] * see.velocity
    force: NDArray[np.float64] = slower + following
    return force


_FINE = 5
"""Interpolated places per piece between two observed points of the track, among which the nearest is taken."""


@dataclass(frozen=True)
class RacingRules:
    """Defaults: the whole force limit is used, and the line keeps a tenth of the half width from the track's edges."""

    width: float = parameter(0.9, 0.6, 1.0)  # share of the track's half width that the line may use
    course: float = parameter(0.0, 0.0, 1.0, below="bends are sought")  # weight of the first bend, at the agent
    grip: float = parameter(1.0, 0.7, 1.4)  # share of max_force that a bend may need
    brake: float = parameter(1.0, 0.4, 1.4)  # share of max_force that is assumed for braking
    late: float = parameter(0.5, 0.0, 1.0)  # braking leaves the force for the bend at a piece's start (0) or end (1)
    lead: float = parameter(0.1, 0.03, 0.4)  # s, look-ahead at the present speed to the point that is sought
    gain: float = parameter(10.0, 4.0, 20.0)  # kg/s: reaches the desired velocity within a decision


def race(see: Any, task: PathFollow, p: RacingRules) -> NDArray[np.float64]:
    """Seek the racing line just ahead at the speed that its bends allow; vectors are (along the track, left)."""
    line = racing_line(see, task, p)
    speeds = allowed_speeds(line, task, p)
    speed = length(see.velocity)
    place = np.minimum(p.lead * np.maximum(speed, 0.25 * task.max_speed) / task.spacing, max(task.ahead - 1.001, 0.999))
    target, desired = _between(line[:, 1:], place), _between(speeds[..., None], place)[:, 0]
    force: NDArray[np.float64] = per_row(p.gain) * seek(target, see.velocity, desired)
    return force


def racing_line(see: Any, task: PathFollow, p: RacingRules) -> NDArray[np.float64]:
    """Return the line of least curvature through the agent and past the points ahead, (R, 2 + ahead, 2) m.

    Its first point lies one spacing behind the agent, against its course; the second is the agent. Each other one is
    the point of the middle line moved sideways, within the width. The sum of squares of the second differences is least
    (Heilmeier et al. 2019, Vehicle System Dynamics 58, 1497).
    """
    here = np.stack([0.0 * see.left, 0.0 * see.left], axis=-1)[:, None]
    nearest = np.stack([0.0 * see.left, -see.left], axis=-1)[:, None]
    spine = np.concatenate([nearest, see.points], axis=1)
    tangent = np.concatenate([(spine[:, 2:] - spine[:, :-2]) / 2.0, spine[:, -1:] - spine[:, -2:-1]], axis=1)
    tangent /= np.maximum(length(tangent)[..., None], 1e-9)
    sideways = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    speed = length(see.velocity)[:, None]
    course = np.where(speed > 0.5, see.velocity / np.maximum(speed, 1e-9), [1.0, 0.0])[:, None]
    middle = np.concatenate([-task.spacing * course, here, see.points], axis=1)
    bending = _bending(task.ahead, p.course)
    matrix = bending[..., 2:] * (sideways @ sideways.transpose(0, 2, 1))
    pull = np.sum(sideways * (bending @ middle), axis=-1)
    limit = task.half_width * per_row(p.width)
    middle[:, 2:] += _least_within(matrix, pull, limit)[..., None] * sideways
    return middle


def _bending(points: int, course: Any) -> NDArray[np.float64]:
    """Return the matrix whose product with the line is half the derivative of the sum of squares by its points.

    (..., points, points + 2). `course` is the weight of the first second difference, that at the agent.
    """
    return _bending_by_number(points, course) if isinstance(course, float) else _bending_by(points, course)


def _bending_by(points: int, course: Any) -> NDArray[np.float64]:
    second = np.diff(np.eye(points + 2), n=2, axis=0)
    weights = np.concatenate([np.asarray(course)[..., None], np.ones((*np.shape(course), points - 1))], axis=-1)
    product: NDArray[np.float64] = second[:, 2:].T @ (weights[..., None] * second)
    return product


_bending_by_number = functools.lru_cache(maxsize=64)(_bending_by)  # the same in all decisions of an episode


def _least_within(matrix: NDArray[np.float64], pull: NDArray[np.float64], limit: Any) -> NDArray[np.float64]:
    """Return the offsets x (R, K) within +-limit for which x M x / 2 + pull x is least.

    Alternating direction method of multipliers (Boyd et al. 2011, Found. Trends Mach. Learn. 3, 1), stopped early.
    """
    one = np.eye(pull.shape[1])
    inverse = np.linalg.inv(matrix + (_PENALTY + _LEVEL) * one)
    within, excess = np.zeros(pull.shape), np.zeros(pull.shape)
    for _ in range(_ITERATIONS):
        offset = (inverse @ (_PENALTY * (within - excess) - pull)[..., None])[..., 0]
        within = np.minimum(np.maximum(offset + excess, -limit), limit)  # np.clip takes longer
        excess += offset - within
    return within


def allowed_speeds(line: NDArray[np.float64], task: PathFollow, p: RacingRules) -> NDArray[np.float64]:
    """Return the greatest speeds at the agent and at the points ahead of it but the last, (R, ahead) m/s.

    Backwards from the end: braking and cornering forces together stay within a circle (Kapania, Subosits and Gerdes
    2016, J. Dyn. Sys., Meas., Control 138, 091005).
    """
    before, after = line[:, 1:-1] - line[:, :-2], line[:, 2:] - line[:, 1:-1]
    piece = length(after)
    sine = np.abs(before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0])
    sides = length(before) * piece * length(before + after)
    needed = 2.0 * sine / np.maximum(sides, 1e-9) / (per_row(p.grip) * task.max_force)  # s^2/m^2
    square = np.minimum(task.max_speed**2, 1.0 / np.maximum(needed, 1e-9))
    bends = (1.0 - per_row(p.late)) * needed[:, :-1] + per_row(p.late) * needed[:, 1:]
    for k in range(task.ahead - 2, -1, -1):
        left = np.sqrt(1.0 - np.minimum(square[:, k + 1] * bends[:, k], 1.0) ** 2)
        slowed = square[:, k + 1] + 2.0 * p.brake * task.max_force * left * piece[:, k]
        square[:, k] = np.minimum(square[:, k], slowed)
    speeds: NDArray[np.float64] = np.sqrt(square)
    return speeds


def _between(values: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the linear interpolation of values (R, K, D) at places (R,) of their index, and beyond it the last one."""
    place = np.clip(place, 0.0, values.shape[1] - 1.0)
    row, k = np.arange(len(place)), place.astype(int)
    after = np.minimum(k + 1, values.shape[1] - 1)
    share = (place - k)[:, None]
    between: NDArray[np.float64] = values[row, k] * (1.0 - share) + values[row, after] * share
    return between


_LEVEL = 1e-6
"""Weight of the squares of the offsets: selects one of the straight lines through the agent on a straight track."""

_ITERATIONS, _PENALTY = 20, 0.5
"""Of the method of multipliers; more iterations move the line by a few centimetres, and gain nothing."""
