"""Rigid impact zones: vertices whose contacts the passes did not resolve move together, as a rigid body.

Rotation and translation map all of a zone alike, and the straight paths to their ends are affine maps, so nothing in a
zone passes through it. A zone that still touches something grows; one that touches itself, by rounding, stands still
for the rest of the step. One that holds a pinned particle or an obstacle moves as that does. As zones only grow or
stop, this ends.
Sources: Provot 1997, Collision and self-collision handling in cloth model; Bridson, Fedkiw and Anderson 2002.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import Vec, kernel, routine
from flockenv.maths.vectors import add, cross, dot, norm, scale, sub
from flockenv.physics.constraints.broad_phase import vector_at, write_vector

__all__ = ["SUMS", "Zones", "clear_zones", "join", "move_zones", "root_of"]

SUMS = 19
"""Numbers of each zone: mass, centre, momentum, angular momentum, tensor of inertia, rotation."""

LARGEST_TURN = 1.5
"""Largest rotation in a step, rad: below a half turn the paths of a zone do not cross."""

ROUNDING = 1e-13
"""Shift of the tensor of inertia, relative to its trace: zones may lie on a line."""


class Zones(NamedTuple):
    """Zones as a forest over the V vertices: the root of a tree stands for its zone."""

    parent: Any  # (V,)
    size: Any  # (V,) number of vertices, of roots
    still: Any  # (V,) 1 if the zone stands still in this step, or moves as a vertex whose motion is given, of roots
    held: Any  # (V,) 1 + number of a vertex of the zone whose motion is given, or 0, of roots
    before: Any  # (V, 3) m, moves before zones
    speed: Any  # (V, 3) m/s, speeds before zones
    sums: Any  # (V, SUMS) of roots


@kernel
def clear_zones(zones: Any, light: Any, motion: Any) -> None:
    """Make each vertex a zone of its own, and save its motion."""
    for i in range(light.shape[0]):
        zones.parent[i], zones.size[i], zones.still[i] = i, 1, 0
        zones.held[i] = 0 if light[i] > 0.0 else 1 + i
        for k in range(3):
            zones.before[i, k], zones.speed[i, k] = motion.move[i, k], motion.speed[i, k]


@routine
def root_of(zones: Any, i: int) -> int:
    """Return the root of a vertex's zone; halves the path to it."""
    while zones.parent[i] != i:
        zones.parent[i] = zones.parent[zones.parent[i]]
        i = zones.parent[i]
    return i


@routine
def join(zones: Any, who: Any) -> bool:
    """Join the zones of a pair, or let a zone that touches itself stand still; return True if this changed anything."""
    first, joined = root_of(zones, who[0]), False
    for k in range(1, 4):
        other = root_of(zones, who[k])
        if other == first:
            continue
        low, high = min(first, other), max(first, other)
        zones.parent[high], first, joined = low, low, True
        zones.size[low] += zones.size[high]
        zones.still[low] = max(zones.still[low], zones.still[high])
        zones.held[low] = max(zones.held[low], zones.held[high])
    if joined:
        zones.still[first] = 1 if zones.held[first] > 0 else zones.still[first]
        return True
    stops = zones.still[first] == 0
    zones.still[first] = 1
    return stops  # type: ignore[no-any-return]


@kernel
def _add_up(zones: Any, motion: Any, light: Any, field: Any) -> None:
    """Sum mass, centre, momentum, then angular momentum and inertia about the centre, of all moving zones."""
    zones.sums[:] = 0.0
    for i in range(light.shape[0]):
        r = root_of(zones, i)
        if zones.size[r] > 1 and zones.held[r] == 0:
            m = 1.0 / light[i]
            zones.sums[r, 0] += m
            for k in range(3):
                zones.sums[r, 1 + k] += m * motion.start[i, k]
                zones.sums[r, 4 + k] += m * field[i, k]
    for i in range(light.shape[0]):
        r = root_of(zones, i)
        if zones.size[r] > 1 and zones.held[r] == 0:
            m, off = 1.0 / light[i], _offset(zones, r, motion, i)
            turn, square = cross(off, vector_at(off, field, i)), dot(off, off)
            for k in range(3):
                zones.sums[r, 7 + k] += m * turn[k]
                zones.sums[r, 10 + k] += m * (square - off[k] * off[k])
            zones.sums[r, 13] -= m * off[0] * off[1]
            zones.sums[r, 14] -= m * off[0] * off[2]
            zones.sums[r, 15] -= m * off[1] * off[2]


@kernel
def _offset(zones: Any, r: int, motion: Any, i: int) -> Vec:
    """Return the offset of a vertex from the centre of its zone at the start, m."""
    s, m = zones.sums[r], zones.sums[r, 0]
    return (motion.start[i, 0] - s[1] / m, motion.start[i, 1] - s[2] / m, motion.start[i, 2] - s[3] / m)


@kernel
def _rotation(s: Any) -> Vec:
    """Return I^-1 L of the sums of a zone, by Cramer's rule."""
    shift = ROUNDING * (s[10] + s[11] + s[12])
    x = (s[10] + shift, s[13], s[14])
    y = (s[13], s[11] + shift, s[15])
    z = (s[14], s[15], s[12] + shift)
    by = (s[7], s[8], s[9])
    volume = dot(x, cross(y, z))
    if not volume > 0.0:
        return (0.0, 0.0, 0.0)
    return (dot(by, cross(y, z)) / volume, dot(x, cross(by, z)) / volume, dot(x, cross(y, by)) / volume)


@kernel
def _turned(off: Vec, by: Vec) -> Vec:
    """Return the displacement of an offset by a rotation, a vector in rad (Rodrigues), of at most LARGEST_TURN."""
    angle = norm(by)
    if angle <= 0.0:
        return (0.0, 0.0, 0.0)
    axis = scale(by, 1.0 / angle)
    angle = min(angle, LARGEST_TURN)
    side = cross(axis, off)
    return add(scale(side, np.sin(angle)), scale(cross(axis, side), 1.0 - np.cos(angle)))


@routine
def move_zones(zones: Any, motion: Any, light: Any, ends: bool, clock: int) -> None:
    """Set the moves, or with `ends` the speeds, of zones to rigid ones, of the same momentum and angular momentum.

    A zone that stands still does not move, and keeps its speed. If it holds vertices whose motion is given, those keep
    it, and the others move as one of them does.
    """
    field, out = (zones.speed, motion.speed) if ends else (zones.before, motion.move)
    _add_up(zones, motion, light, field)
    for i in range(light.shape[0]):
        if zones.parent[i] == i and zones.size[i] > 1 and zones.held[i] == 0:
            write_vector(zones.sums[:, 16:], i, _rotation(zones.sums[i]))
    for i in range(light.shape[0]):
        r = root_of(zones, i)
        if zones.size[r] == 1:
            continue
        new = (0.0, 0.0, 0.0)
        if zones.held[r] == 0 and (ends or zones.still[r] == 0):
            s = zones.sums[r]
            by, off = (s[16], s[17], s[18]), _offset(zones, r, motion, i)
            new = (s[4] / s[0], s[5] / s[0], s[6] / s[0])
            new = add(new, cross(by, off) if ends else _turned(off, by))  # type: ignore[assignment]
        elif zones.held[r] > 0:
            new = vector_at(new, field, i if light[i] <= 0.0 else zones.held[r] - 1)  # type: ignore[assignment]
        old = vector_at(new, out, i)
        if norm(sub(new, old)) > 0.0:
            write_vector(out, i, new)
            motion.mark[i], motion.touched[i] = clock, 1
