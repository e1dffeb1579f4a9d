"""What several tasks share: what they write into observation rows, and what they ask of a frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flockenv.kernels import Vec, kernel, like
from flockenv.shapes import ray_hit

__all__ = ["block_ways", "clip", "compass", "leaves_gap", "offset", "place_of", "put", "turned", "velocity_of"]


@kernel
def clip(x: float) -> float:
    """Bound to [-1, 1]."""
    return min(max(x, like(x, -1.0)), like(x, 1.0))


@kernel
def offset(a: float, b: float, size: float) -> float:
    """Return b - a, the shortest way around a periodic axis of this size (0 = not periodic)."""
    d = b - a
    o, one, half = like(d, 0.0), like(d, 1.0), like(d, 0.5)
    around = one / like(d, size) if size > o else o  # the same for all pairs: the division leaves the loop
    return d - like(d, size) * np.floor(d * around + half)  # type: ignore[no-any-return]  # numpy's floor of a float is one


@kernel
def turned(vector: Any, heading: Any, factor: float) -> Any:
    """Return a vector's parts along the heading and to its left, scaled and clipped."""
    along, left = vector[0] * heading[0] + vector[1] * heading[1], vector[1] * heading[0] - vector[0] * heading[1]
    return clip(along * factor), clip(left * factor)


@kernel
def place_of(frame: Any, i: int) -> Vec:
    """Return where agent i is, m."""
    return (np.float64(frame.pos[0, i]), np.float64(frame.pos[1, i]))


@kernel
def velocity_of(frame: Any, i: int) -> Vec:
    """Return the velocity of agent i, m/s."""
    return (np.float64(frame.vel[0, i]), np.float64(frame.vel[1, i]))


@kernel
def leaves_gap(p: Any, frame: Any, m: int, x: float, y: float, rho: float) -> bool:
    """Does obstacle m, a circle of radius rho here, leave a gap of `min_gap` to those before it?"""
    for k in range(m):
        distance = math.hypot(frame.centre[0, k] - x, frame.centre[1, k] - y)
        if frame.rho[k] > 0.0 and distance < frame.rho[k] + rho + p.min_gap:
            return False
    return True


@kernel
def put(row: Any, at: int, vector: Any) -> None:
    """Write two numbers into a row from place `at` on (counted without a sign, see block_ways)."""
    row[np.uint64(at)] = vector[0]
    row[np.uint64(at + 1)] = vector[1]


def compass(rays: int) -> tuple[float, ...]:
    """Return the cosines, then the sines, of so many directions, anticlockwise from the first axis."""
    angles = [2.0 * math.pi * r / rays for r in range(rays)]
    return (*map(math.cos, angles), *map(math.sin, angles))


@kernel
def block_ways(row: Any, at: int, rays: int, table: Any, to: Any, ahead: Any, clearance: float, sight: float) -> None:
    """Shorten the free ways in row[at : at + rays], in units of `sight` m, by an obstacle at `to` m.

    Ways lead in the directions of `compass`, turned so that the first is `ahead`, a unit vector; `table` is it.
    """
    here = (to[0] * ahead[0] + to[1] * ahead[1], to[1] * ahead[0] - to[0] * ahead[1])
    share = like(sight, 1.0) / sight
    sines, row_at = np.uint64(rays), np.uint64(at)
    # Counted without a sign: of a signed index numba asks whether it counts from the end, and the loop stays scalar.
    for r in range(np.uint64(rays)):
        hit = np.float32(ray_hit(here, (table[r], table[sines + r]), clearance) * share)
        row[row_at + r] = min(row[row_at + r], hit)
