"""Kernels that several tasks share: writing observation rows, and reading frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flockenv.geometry.shapes import ray_hit
from flockenv.jit.decorators import Vec, kernel, like
from flockenv.maths.approximations import round_half_even
from flockenv.maths.vectors import dot
from flockenv.tasks.layout import Slot, slots_of

__all__ = [
    "clip", "leaves_gap", "local_components", "neighbour_slots", "offset", "position_of", "ray_directions",
    "shorten_free_paths", "velocity_of", "write_crowding", "write_neighbour", "write_vector",
]  # fmt: skip


@kernel
def clip(x: float) -> float:
    """Clip a number to [-1, 1]."""
    return min(max(x, like(x, -1.0)), like(x, 1.0))


@kernel
def offset(a: float, b: float, size: float) -> float:
    """Return b - a, the shortest offset on a periodic axis of this size (0: not periodic)."""
    d = b - a
    o, one = like(d, 0.0), like(d, 1.0)
    around = one / like(d, size) if size > o else o  # equal for all pairs, so that it is hoisted out of the loop
    return d - like(d, size) * round_half_even(d * around)


@kernel
def local_components(vector: Any, heading: Any, factor: float) -> Any:
    """Return a vector's components along the heading and to its left, scaled, then clipped to [-1, 1]."""
    along, left = vector[0] * heading[0] + vector[1] * heading[1], vector[1] * heading[0] - vector[0] * heading[1]
    return clip(along * factor), clip(left * factor)


@kernel
def position_of(frame: Any, i: int) -> Vec:
    """Return the position of agent i, m."""
    return (np.float64(frame.pos[0, i]), np.float64(frame.pos[1, i]))


@kernel
def velocity_of(frame: Any, i: int) -> Vec:
    """Return the velocity of agent i, m/s."""
    return (np.float64(frame.vel[0, i]), np.float64(frame.vel[1, i]))


@kernel
def leaves_gap(p: Any, frame: Any, m: int, x: float, y: float, rho: float) -> bool:
    """Return True if obstacle m, of radius rho at (x, y), leaves a gap of `min_gap` to those before it."""
    for k in range(m):
        dx, dy = frame.centre[0, k] - x, frame.centre[1, k] - y
        distance = math.sqrt(dx * dx + dy * dy)
        if frame.rho[k] > 0.0 and distance < frame.rho[k] + rho + p.min_gap:
            return False
    return True


@kernel
def write_vector(row: Any, at: int, vector: Any) -> None:
    """Write the two numbers of a vector to row[at] and row[at + 1]."""
    row[np.uint64(at)] = vector[0]
    row[np.uint64(at + 1)] = vector[1]


@kernel
def write_neighbour(row: Any, at: Any, s: int, to: Any, relative: Any, ahead: Any, near_by: float, pace: float) -> None:
    """Write presence, offset and relative velocity of the s-th nearest agent, times `near_by`, 1/m, and `pace`, s/m.

    The slots are those of `neighbour_slots`; vectors are rotated so that the unit vector `ahead` is the x axis.
    """
    write_vector(row, at.neighbours + 2 * s, local_components(to, ahead, near_by))
    write_vector(row, at.neighbour_velocity + 2 * s, local_components(relative, ahead, pace))
    row[np.uint64(at.neighbour_present + s)] = 1.0


@kernel
def write_crowding(row: Any, at: Any, s: int, to: Any, ahead: Any, distance: float, gap: float, near: float) -> None:
    """Write the direction of the s-th nearest agent times 1 - gap / near, 0 for a gap of `near` m or more."""
    share = min(max(1.0 - gap / near, 0.0), 1.0) / distance
    write_vector(row, at.crowding + 2 * s, local_components(to, ahead, share))


def neighbour_slots(count: int, sight: float, most_relative: float, others: str, crowding: bool) -> tuple[Slot, ...]:
    """Return the slots of the nearest agents in a row; `most_relative`, m/s, scales relative velocities.

    crowding: add unit vectors towards them, scaled by closeness.
    """
    present = "1 for each neighbour, 0 for an empty slot, whose other numbers are also 0"
    close = "unit vectors towards them, times 1 - gap between the bodies / near; 0 for a gap above near"
    return slots_of(
        "neighbours",
        Slot("neighbours", (count, 2), sight, "m", f"offsets of the nearest {others}, nearest first"),
        Slot("neighbour_velocity", (count, 2), most_relative, "m/s", "their velocities minus the agent's own"),
        *((Slot("crowding", (count, 2), 1.0, "1", close),) if crowding else ()),
        Slot("neighbour_present", (count,), 1.0, "1", present, low=0.0),
    )


def ray_directions(rays: int) -> tuple[float, ...]:
    """Return the cosines, then the sines, of `rays` directions, anticlockwise from the first axis."""
    angles = [2.0 * math.pi * r / rays for r in range(rays)]
    return (*map(math.cos, angles), *map(math.sin, angles))


@kernel
def shorten_free_paths(
    row: Any, at: int, rays: int, table: Any, to: Any, ahead: Any, clearance: float, sight: float
) -> None:
    """Shorten the free paths in row[at : at + rays], in units of `sight` m, by an obstacle at `to` m, if in sight.

    Paths lead in the directions of `ray_directions`, passed as `table`, rotated so that the first is the unit vector
    `ahead`.
    """
    if dot(to, to) >= (sight + clearance) * (sight + clearance):
        return
    here = (to[0] * ahead[0] + to[1] * ahead[1], to[1] * ahead[0] - to[0] * ahead[1])
    share = like(sight, 1.0) / sight
    sines, row_at = np.uint64(rays), np.uint64(at)
    # Unsigned: numba checks whether a signed index counts from the end, and the loop would stay scalar.
    for r in range(np.uint64(rays)):
        hit = np.float32(ray_hit(here, (table[r], table[sines + r]), clearance) * share)
        # The third argument changes no value, as no path is longer than 1. Of min(row[k], hit) alone LLVM would make a
        # masked store, which takes some processors without AVX-512 forty instructions.
        row[row_at + r] = min(row[row_at + r], hit, np.float32(1.0))
