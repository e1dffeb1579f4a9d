"""Floor fields: path lengths u to a target around obstacles, |grad u| = 1 on a grid, second order in the spacing.

Agents follow -grad u for global navigation; steering behaviours avoid other agents. Fast sweeping (Zhao, "A fast
sweeping method for Eikonal equations", Math. Comp. 2005) computes the first-order solution, and with it the order in
which a front reaches the points; one pass in that order takes one-sided differences of second order (Sethian, "Fast
marching methods", SIAM Review 1999, section 3.1).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes import Shape
from flockenv.geometry.shapes.table import nearest
from flockenv.geometry.targets import Target
from flockenv.jit.decorators import kernel
from flockenv.jit.section import entry
from flockenv.maths.grid import pack_grid, points_of

__all__ = ["NO_WAY", "Start", "distances_around", "floor_field_table", "free_part"]

Floats = NDArray[np.float64]
NEAR = 4.0
"""Distance from the target, in spacings, within which distances are straight lines if these are free."""
NO_WAY = 1e30
"""m, the path length without a path: finite, so that it can be interpolated, also in float32."""


@kernel
def _solve_point(a: float, b: float, c: float, h: float) -> float:
    """Return u such that the sum of ((u - neighbour) / h)^2 is 1; a, b, c: the smaller neighbour along each axis.

    Only neighbours smaller than u contribute.
    """
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
    """Sweep the grid (nx, ny, nz) once in each direction; return the largest decrease of a value."""
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
                        new = _solve_point(a, b, c, h)
                        if new < u[i, j, k]:
                            changed = max(changed, u[i, j, k] - new if u[i, j, k] < np.inf else 1.0)
                            u[i, j, k] = new
    return changed


@kernel
def _upwind(u: Any, done: Any, at: int, stride: int, place: int, count: int) -> tuple[float, float, float]:
    """Return the smaller final neighbour of point `at` along one axis, and its one-sided difference as (t, w).

    The difference squared is w ((x - t) / h)^2: w = 9/4 where two points upwind are final and increase towards `at`,
    else 1; w = 0 and t = inf if no neighbour is final. place: the index along this axis, of `count`.
    """
    near, side, beyond = np.inf, 0, False
    if place > 0 and done[at - stride]:
        near, side, beyond = u[at - stride], -stride, place > 1
    if place < count - 1 and done[at + stride] and u[at + stride] < near:
        near, side, beyond = u[at + stride], stride, place < count - 2
    if beyond and done[at + 2 * side] and u[at + 2 * side] <= near:
        return near, (4 * near - u[at + 2 * side]) / 3, 2.25
    return near, near, 1.0 if near < np.inf else 0.0


@kernel
def _second_order(u: Any, done: Any, order: Any, shape: Any, h: float) -> None:
    """Write the second-order distance of each point, in the given order; u, done: flat grids of this shape."""
    _, ny, nz = shape
    for at in order:
        i, j, k = at // (ny * nz), at // nz % ny, at % nz
        a = _upwind(u, done, at, ny * nz, i, shape[0])
        b = _upwind(u, done, at, nz, j, ny)
        c = _upwind(u, done, at, 1, k, nz)
        a, b = (a, b) if a[0] < b[0] else (b, a)
        b, c = (b, c) if b[0] < c[0] else (c, b)
        a, b = (a, b) if a[0] < b[0] else (b, a)
        w, wt, wtt = 0.0, 0.0, -h * h
        x = np.inf
        for near, t, weight in (a, b, c):
            if near >= x:
                break
            w, wt, wtt = w + weight, wt + weight * t, wtt + weight * t * t
            root = wt * wt - w * wtt
            if root < 0 or wt + math.sqrt(root) < w * near:  # x < this neighbour, which then does not contribute
                break
            x = (wt + math.sqrt(root)) / w
        u[at], done[at] = x, True


def distances_around(free: NDArray[np.bool_], spacing: float, begin: Floats) -> Floats:
    """Return the distance of each point of a grid from the target through free points, m; inf where no path leads.

    free (nx, ny[, nz]); begin: the same shape, known distances of points near the target, inf elsewhere.
    """
    shape = (*free.shape, 1, 1)[:3]
    u = np.where(free, begin, np.inf).reshape(shape).astype(np.float64)
    open_ = np.ascontiguousarray((free & ~np.isfinite(begin)).reshape(shape))
    while entry(_sweep)(u, open_, spacing) > 1e-9 * spacing:
        pass  # each round reaches around one more corner than the one before, and no distance grows
    flat = u.reshape(-1)
    done = np.isfinite(flat) & ~open_.reshape(-1)
    order = np.flatnonzero(np.isfinite(flat) & ~done)
    order = order[np.argsort(flat[order], kind="stable")]
    entry(_second_order)(flat, done, order, np.array(shape), spacing)
    return u.reshape(free.shape)


class Ground(NamedTuple):
    """A grid over a region with obstacles."""

    low: tuple[float, ...]  # m, its lowest corner
    spacing: float  # m
    points: Floats  # (nx, ny[, nz], D) m
    gap: Floats  # (nx, ny[, nz]) m, distance to the nearest obstacle
    out: Floats  # (nx, ny[, nz], D) outward unit normal of its surface


class Start(NamedTuple):
    """A box in which agents start, and from which a path must lead to a target."""

    name: str
    low: Floats  # (D,) m
    high: Floats  # (D,) m


@functools.lru_cache(maxsize=2)
def ground(shapes: tuple[Shape, ...], low: tuple[float, ...], high: tuple[float, ...], spacing: float) -> Ground:
    """Return the grid of a region with the distances of its points from obstacles, which all targets share."""
    counts = [1 + math.ceil((b - a) / spacing - 1e-9) for a, b in zip(low, high, strict=True)]
    points = points_of(low, spacing, counts)
    return Ground(low, spacing, points, *_nearest_surface(shapes, points))


def floor_field_table(
    shapes: Sequence[Shape], targets: Sequence[Target], low: Sequence[float], high: Sequence[float], spacing: float,
    clearance: float, names: Sequence[str] = ("target",), starts: Sequence[Start] = (),
) -> Floats:  # fmt: skip
    """Return a floor field as a grid (see flockenv/maths/grid.py): distance to the nearest target, m, and direction.

    Paths are those of a body's centre at least `clearance` from all shapes. Within `clearance` of an
    obstacle, and inside it, the direction is away from the nearest surface, and the distance is that of the nearest
    clear point plus the distance to that point. Where no path leads the distance is NO_WAY; the direction is then zero
    at points that are clear of all obstacles.

    Raises:
        ValueError: one line that begins with the target's name if a target is not free or is outside the grid, or if
            no path leads to any target from one of `starts`.
    """
    found = ground(tuple(shapes), tuple(map(float, low)), tuple(map(float, high)), spacing)
    begin, towards = np.full(found.gap.shape, np.inf), np.zeros_like(found.points)
    for name, target in zip(names, targets, strict=True):
        _begin_near_target(found, shapes, target, clearance, name, high, begin, towards)
    free = found.gap >= clearance
    near = np.any(towards != 0, axis=-1) | (begin == 0)
    u = distances_around(free, spacing, begin)
    reached = np.isfinite(u)
    for start in starts:
        room = np.all((found.points >= start.low - spacing) & (found.points <= start.high + spacing), axis=-1) & free
        if room.any() and not (room & reached).any():
            places = " or ".join(target.points_text for target in targets)
            raise ValueError(
                f"{names[0]} = {places}: no way leads there from {start.name}, {clearance:g} m clear of all obstacles"
            )
    way = np.where(near[..., None], towards, -_slopes(u, spacing))
    size = np.linalg.norm(way, axis=-1, keepdims=True)
    way = np.where(reached[..., None], way / np.where(size > 0, size, 1), np.where(free[..., None], 0.0, found.out))
    length = _lengths_beside(u, reached, free, spacing, clearance)
    return pack_grid(np.concatenate([length[..., None], way], axis=-1), found.low, spacing)


def _lengths_beside(
    u: Floats, reached: NDArray[np.bool_], free: NDArray[np.bool_], spacing: float, clearance: float
) -> Floats:
    """Return u, m, extended to points within `clearance` of obstacles, where agents may be pushed."""
    from scipy.ndimage import distance_transform_edt  # slow to import, and used only by floor fields

    far, place = distance_transform_edt(~reached, sampling=spacing, return_indices=True)
    beside = reached | (~free & (far <= clearance + 2 * spacing))
    return np.asarray(np.where(beside, u[tuple(place)] + far, NO_WAY))


def free_part(
    shapes: Sequence[Shape], target: Target, name: str, spacing: float, clearance: float
) -> tuple[Target, Floats, Floats]:
    """Return the free part of a target, sample points of it (S, D) m, and their distances to shapes (S,) m.

    A door is cut to the part between its jambs; a box stays whole, but only points at least `clearance` from all shapes
    are returned. Raises ValueError, in one line, if nothing is left.
    """
    samples = target.samples(spacing)
    gap = np.min([shape.gap(samples) for shape in shapes], axis=0) if shapes else np.full(len(samples), np.inf)
    free = gap >= clearance
    if not free.any():
        where = "" if len(samples) == 1 else "at most "
        raise ValueError(
            f"{name} = {target.points_text}: is {where}{gap.max():.3g} m from an obstacle, must be at least "
            f"{clearance:g} m"
        )
    if target.ends is not None and not free.all():
        core = samples[: target.count(spacing)][free[: target.count(spacing)]]
        ends = (tuple(core[0].tolist()), tuple(core[-1].tolist())) if len(core) else target.ends
        change = {"at": ends[0], "ends": None} if ends[0] == ends[1] else {"ends": ends}
        target = target.model_copy(update=change)
    return target, samples[free], gap[free]


def _begin_near_target(
    found: Ground, shapes: Sequence[Shape], whole: Target, clearance: float, name: str, high: Sequence[float],
    begin: Floats, towards: Floats,
) -> None:  # fmt: skip
    """Write the distances of points near a target, and the straight offset to it from those within two spacings.

    A straight line is used only if it is shorter than the distance to the nearest obstacle, so that none is in between.
    """
    spacing, d = found.spacing, whole.dimension
    if (whole.extremes[0] < found.low).any() or (whole.extremes[1] > high).any():
        raise ValueError(f"{name} = {whole.points_text}: is outside the grid, {found.low} to {tuple(high)} m")
    sight = np.maximum(NEAR * spacing, 1.0001 * spacing * math.sqrt(d))
    target, places, gap = free_part(shapes, whole, name, spacing, clearance)
    first = np.maximum(np.floor((target.extremes[0] - sight - found.low) / spacing), 0).astype(int)
    last = np.ceil((target.extremes[1] + sight - found.low) / spacing).astype(int) + 1
    here = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
    points, free = found.points[here], found.gap[here] >= clearance
    from scipy.spatial import cKDTree  # slow to import, and used only by floor fields

    nearby = cKDTree(places).query(points)[1]
    to = target.offset(points)
    straight = np.linalg.norm(to, axis=-1)
    reach = np.minimum(sight, gap[nearby] - clearance + spacing * math.sqrt(d))
    known = free & (np.linalg.norm(places[nearby] - points, axis=-1) <= reach)
    if not known.any():
        raise ValueError(f"{name} = {whole.points_text}: no point of the grid beside it is free; use a smaller spacing")
    nearer = known & (straight < begin[here])
    begin[here] = np.where(nearer, straight, begin[here])
    close = nearer & (straight <= 2 * spacing)
    towards[here] = np.where(nearer[..., None], np.where(close[..., None], to, 0), towards[here])


def _nearest_surface(shapes: Sequence[Shape], points: Floats) -> tuple[Floats, Floats]:
    """Return the distance of each point of a grid to the nearest surface, and its normal there.

    A shape is evaluated only at points whose distance to its bounding box is less than the best distance so far.
    """
    d = points.shape[-1]
    flat, lead = points.reshape(-1, d), points.shape[:-1]
    best, out = np.full(len(flat), np.inf), np.zeros_like(flat)
    axes = [np.moveaxis(points[..., k], k, 0).reshape(lead[k], -1)[:, 0] for k in range(d)]
    for shape in shapes:
        to = [np.maximum(abs(x - c) - h, 0) ** 2 for x, c, h in zip(axes, *shape.bound[:2], strict=True)]
        box = functools.reduce(np.add.outer, to).reshape(-1)
        here = np.flatnonzero(box <= (np.maximum(best, 0) + 1e-9) ** 2)
        gap, normal = nearest(shape, flat[here])
        nearer = gap < best[here]
        best[here[nearer]], out[here[nearer]] = gap[nearer], normal[nearer]
    return best.reshape(lead), out.reshape(points.shape)


def _slopes(u: Floats, spacing: float) -> Floats:
    """Return the gradient, (..., D), by one-sided differences towards the smaller neighbour along each axis.

    The order is 2 where the next value on that side is not larger than the neighbour. No difference crosses an
    obstacle.
    """
    found = []
    for axis in range(u.ndim):
        padded = np.pad(u, [(2, 2) if k == axis else (0, 0) for k in range(u.ndim)], constant_values=np.inf)
        near2, near1, far1, far2 = (np.take(padded, np.arange(k, k + u.shape[axis]), axis) for k in (0, 1, 3, 4))
        ahead = far1 < near1
        first, second = np.where(ahead, far1, near1), np.where(ahead, far2, near2)
        down = np.isfinite(u) & (first < u)
        here, one = np.where(down, u, 0.0), np.where(down, first, 0.0)
        two = np.where(down & (second <= first), second, 2 * one - here)
        slope = (3 * here - 4 * one + two) / (2 * spacing)
        found.append(np.where(ahead, -slope, slope))
    return np.stack(found, axis=-1)
