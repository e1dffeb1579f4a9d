"""How far every place is from a goal around obstacles: |grad u| = 1 on a grid, solved once by fast sweeping.

A global controller: agents follow -grad u, local steering does the rest. Zhao, "A fast sweeping method for Eikonal
equations" (Math. Comp. 2005); first order in the spacing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.grid import packed, points_of
from flockenv.kernels import entry, kernel
from flockenv.shapes import Shape

__all__ = ["distances_around", "way_table"]

Floats = NDArray[np.float64]
ROUNDS = 200
"""Most rounds of sweeps: each goes around one more corner than the one before."""
NEAR = 4.0
"""Spacings from the goal within which distances are straight lines, where these are free."""


@kernel
def _updated(a: float, b: float, c: float, h: float) -> float:
    """Return u where sum of ((u - neighbour) / h)^2 over the axes that count is 1; of each the smaller neighbour."""
    a, b = (a, b) if a < b else (b, a)
    b, c = (b, c) if b < c else (c, b)
    a, b = (a, b) if a < b else (b, a)
    u = a + h
    if u <= b:
        return u
    u = 0.5 * (a + b + math.sqrt(max(2 * h * h - (a - b) ** 2, 0.0)))
    if u <= c:
        return u
    total = a + b + c
    return (total + math.sqrt(max(total * total - 3 * (a * a + b * b + c * c - h * h), 0.0))) / 3


@kernel
def _sweep(u: Any, free: Any, h: float) -> float:
    """Go through the grid (nx, ny, nz) once in each direction; return by how much anything became less."""
    nx, ny, nz = u.shape
    changed = 0.0
    for way in range(8 if nz > 1 else 4):
        for i_ in range(nx):
            i = i_ if way & 1 else nx - 1 - i_
            for j_ in range(ny):
                j = j_ if way & 2 else ny - 1 - j_
                for k_ in range(nz):
                    k = k_ if way & 4 else nz - 1 - k_
                    if not free[i, j, k]:
                        continue
                    a = min(u[i - 1, j, k] if i > 0 else np.inf, u[i + 1, j, k] if i < nx - 1 else np.inf)
                    b = min(u[i, j - 1, k] if j > 0 else np.inf, u[i, j + 1, k] if j < ny - 1 else np.inf)
                    c = min(u[i, j, k - 1] if k > 0 else np.inf, u[i, j, k + 1] if k < nz - 1 else np.inf)
                    if min(a, b, c) < np.inf:
                        new = _updated(a, b, c, h)
                        if new < u[i, j, k]:
                            changed = max(changed, u[i, j, k] - new if u[i, j, k] < np.inf else 1.0)
                            u[i, j, k] = new
    return changed


def distances_around(free: NDArray[np.bool_], spacing: float, begin: Floats) -> Floats:
    """Return how far each point of a grid is from the goal through free ones, m; inf where no way leads.

    free (nx, ny[, nz]); begin: the same shape, distances of the points about the goal that are known, inf elsewhere.
    """
    shape = (*free.shape, 1, 1)[:3]
    u = np.where(free, begin, np.inf).reshape(shape).astype(np.float64)
    kept = np.ascontiguousarray((free & ~np.isfinite(begin)).reshape(shape))
    for _ in range(ROUNDS):
        if entry(_sweep)(u, kept, spacing) <= 1e-9 * spacing:
            break
    return u.reshape(free.shape)


def way_table(
    shapes: Sequence[Shape], goal: Sequence[float], low: Sequence[float], high: Sequence[float], spacing: float,
    clearance: float,
) -> Floats:  # fmt: skip
    """Return a grid (see grid.py) whose points have 1 + D numbers: the way to the goal, m, and its first direction.

    The way of a body's centre that keeps `clearance` from all shapes. Where no way leads, in an obstacle too, the
    direction is away from the nearest surface, and the way as long as the longest. ValueError, in one line, if the goal
    is not free or outside the grid.
    """
    shown = tuple(map(float, goal))
    counts = [1 + math.ceil((b - a) / spacing - 1e-9) for a, b in zip(low, high, strict=True)]
    points = points_of(low, spacing, counts)
    gap = np.min([shape.gap(points) for shape in shapes], axis=0) if shapes else np.full(points.shape[:-1], np.inf)
    out = _directions_out(shapes, points)
    straight = np.linalg.norm(points - np.asarray(goal), axis=-1)
    if any(not a <= x <= b for a, x, b in zip(low, goal, high, strict=True)):
        raise ValueError(f"target = {shown}: is outside the grid, {tuple(low)} to {tuple(high)} m")
    free = gap >= clearance
    sight = np.maximum(NEAR * spacing, 1.0001 * spacing * math.sqrt(len(goal)))
    goal_gap = min((float(shape.gap(goal)) for shape in shapes), default=math.inf)
    if goal_gap < clearance:
        raise ValueError(f"target = {shown}: is {goal_gap:.3g} m from an obstacle, must be at least {clearance:g} m")
    # straight lines count where nothing can be between: nearer than the nearest obstacle
    known = np.where(straight <= min(sight, goal_gap - clearance + spacing * math.sqrt(len(goal))), straight, np.inf)
    u = distances_around(free, spacing, np.where(free, known, np.inf))
    reached = np.isfinite(u)
    if not reached.any():
        raise ValueError(f"target = {shown}: no point of the grid beside it is free; use a smaller spacing")
    way = -_slopes(u, spacing)
    near = (straight <= 2 * spacing)[..., None]
    way = np.where(near, (np.asarray(goal) - points), way)
    size = np.linalg.norm(way, axis=-1, keepdims=True)
    way = np.where(reached[..., None], way / np.where(size > 0, size, 1), out)
    length = np.where(reached, u, u[reached].max())
    return packed(np.concatenate([length[..., None], way], axis=-1), low, spacing)


def _directions_out(shapes: Sequence[Shape], points: Floats) -> Floats:
    """Return the normal of the nearest surface at each point."""
    best, out = np.full(points.shape[:-1], np.inf), np.zeros_like(points)
    for shape in shapes:
        gap = shape.gap(points)
        nearer = gap < best
        best, out = np.where(nearer, gap, best), np.where(nearer[..., None], shape.normal(points), out)
    return out


def _slopes(u: Floats, spacing: float) -> Floats:
    """Return the gradient towards the smaller neighbour along each axis (upwind): no number crosses an obstacle."""
    found = []
    for axis in range(u.ndim):
        ahead, behind = np.full_like(u, np.inf), np.full_like(u, np.inf)
        a: list[Any] = [slice(None)] * u.ndim
        b: list[Any] = [slice(None)] * u.ndim
        a[axis], b[axis] = slice(1, None), slice(None, -1)
        ahead[tuple(b)], behind[tuple(a)] = u[tuple(a)], u[tuple(b)]
        least = np.minimum(ahead, behind)
        down = np.isfinite(u) & (least < u)
        slope = np.where(down, u - np.where(down, least, 0), 0)
        slope = np.where(down, slope, 0.0) / spacing
        found.append(np.where(ahead < behind, -slope, slope))
    return np.stack(found, axis=-1)
