"""Density and speed in an area: counted, and by the room that everybody has (Voronoi), which scatters far less."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Voronoi

from flockenv.measures.polygons import Corners, checked, contains, convex, cut, cut_by, rectangle, size

__all__ = ["Ground", "Room", "classical_density", "speed_in_area", "voronoi", "voronoi_density", "voronoi_speed"]

Floats = NDArray[np.float64]


class Room(NamedTuple):
    """How much room everybody has."""

    cell: Floats  # (N,) m^2, the area of his Voronoi cell; NaN for who is not on the walkable area
    inside: Floats  # (N,) m^2, what of it lies in the area that is measured; 0 for those
    area: float  # m^2 of what is measured, as far as it is walkable


def classical_density(pos: ArrayLike, area: ArrayLike, alive: ArrayLike | None = None) -> Floats:
    """Return agents per m^2 in a polygon, at each instant, (T,): so many inside / its area.

    pos (T, N, 2) m; area (n, 2) m, its corners; alive (T, N), all by default. With few agents it takes few values.
    Raises ValueError, of one line, for an area that is none. Source: Steffen & Seyfried 2010, Physica A 389, 1902, eq.
    1.
    """
    corners = checked("area", area)
    inside = contains(corners, _flat(pos))
    if alive is not None:
        inside = inside & np.asarray(alive, np.bool_)
    return np.asarray(inside.sum(axis=-1) / size(_corners(corners)), np.float64)


def speed_in_area(
    pos: ArrayLike, vel: ArrayLike, area: ArrayLike, alive: ArrayLike | None = None, along: ArrayLike | None = None
) -> Floats:
    """Return the mean speed of those in a polygon at each instant, (T,) m/s; NaN where nobody is there.

    pos, vel (T, N, 2) m, m/s; along: a direction (2,), and then it is the component of velocity along it instead of
    |v|. Raises ValueError, of one line, for an area that is none, or a direction of no length.
    """
    inside = contains(checked("area", area), _flat(pos))
    if alive is not None:
        inside = inside & np.asarray(alive, np.bool_)
    speed = np.linalg.norm(_flat(vel), axis=-1) if along is None else _flat(vel) @ _unit("along", along)
    many = inside.sum(axis=-1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(inside, speed, 0.0).sum(axis=-1) / np.where(many > 0, many, np.nan))


def voronoi(
    pos: ArrayLike,
    walkable: ArrayLike,
    area: ArrayLike | None = None,
    holes: Sequence[ArrayLike] = (),
    period: tuple[float, float] = (0.0, 0.0),
) -> Room:
    """Return the Voronoi cell of everybody at one instant: all that is nearer to him than to anybody else.

    pos (N, 2) m. Cells are cut to the polygon `walkable` (n, 2) m, which need not be convex, less the polygons `holes`
    in it, which do not overlap: obstacles. What of a cell lies behind a wall counts too, so a walkable area must end at
    walls. area: a convex polygon that is measured, all of the walkable area by default. period: (Lx, Ly) m, 0 = none:
    the world goes on with itself after so much, and `walkable` is one period of it. Who is outside of `walkable` has no
    cell and takes no room. Those in one place share a cell.
    Raises ValueError, of one line, for polygons that are none, for an area that is not convex, or not walkable.
    Source: Steffen & Seyfried 2010, Physica A 389, 1902. Cells by scipy's Qhull, cut by half-planes.
    """
    return Ground.of(walkable, area, holes, period).room(pos)


class Ground(NamedTuple):
    """Where people walk and where they are measured, checked once for many instants."""

    walk: Floats
    target: Floats | None
    holes: list[Corners]
    period: tuple[float, float]
    area: float  # m^2 of what is measured, as far as it is walkable

    @classmethod
    def of(
        cls, walkable: ArrayLike, area: ArrayLike | None = None, holes: Sequence[ArrayLike] = (),
        period: tuple[float, float] = (0.0, 0.0),
    ) -> Ground:  # fmt: skip
        """Return it; see `voronoi`, for what is what, and for what is refused."""
        walk = checked("walkable", walkable)
        target = None if area is None else checked("area", area, is_convex=True)
        gaps = [_corners(checked(f"holes[{k}]", hole)) for k, hole in enumerate(holes)]
        if target is not None:
            measured = _Cutter(_corners(walk), None, gaps, period).areas(_corners(target))[0]
        else:
            measured = size(_corners(walk)) - sum(
                size(cut_by(gap, _corners(walk)) if convex(walk) else gap) for gap in gaps
            )
        if not measured > 0:
            raise ValueError("area: nothing of it is walkable")
        return cls(walk, target, gaps, period, measured)

    def room(self, pos: ArrayLike) -> Room:
        """Return the cells of people at (N, 2), m."""
        points = _flat(pos)
        here = np.flatnonzero(contains(self.walk, points)) if len(points) else np.zeros(0, np.int64)
        cell, inside = np.full(len(points), np.nan), np.zeros(len(points))
        if len(here):
            places, which, many = np.unique(points[here], axis=0, return_inverse=True, return_counts=True)
            target = None if self.target is None else _corners(self.target)
            cutter = _Cutter(_corners(self.walk), target, self.holes, self.period)
            found = np.array([cutter.areas(each) for each in _cells(places, self.walk, self.period)])
            cell[here], inside[here] = (found / many[:, None])[which.ravel()].T
        return Room(cell, inside, self.area)


def voronoi_density(room: Room) -> float:
    """Return agents per m^2: the mean over the area of 1 / (the area of the cell that a place belongs to)."""
    some = room.inside > 0
    return float((room.inside[some] / room.cell[some]).sum() / room.area)


def voronoi_speed(room: Room, speed: ArrayLike) -> float:
    """Return the mean over the area of the speed, m/s, of whom a place belongs to; NaN where it belongs to nobody.

    speed: (N,) m/s, or any other number of each.
    """
    total = float(room.inside.sum())
    return float(room.inside @ np.asarray(speed, np.float64)) / total if total > 0 else np.nan


def _cells(places: Floats, walk: Floats, period: tuple[float, float]) -> list[Corners]:
    """Return the cells of different places, cut to a box around the walkable area, or to a period around each."""
    low, high = walk.min(axis=0), walk.max(axis=0)
    every = np.concatenate([places + np.multiply(shift, period) for shift in _shifts(period)])
    middle, far = (low + high) / 2, 20 * float(max(np.ptp(every - every.mean(axis=0)), *(high - low), *period))
    # four more far outside: every cell ends, and they are too far away to take anything of the walkable area
    ring = middle + far * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    pairs = Voronoi(np.concatenate([every, ring])).ridge_points
    pairs = pairs[(pairs < len(every)).all(axis=1)]
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[pairs[:, 0] < len(places)]  # the first image is the place itself
    begin = [_box(place, low, high, period) for place in places.tolist()]
    points: list[tuple[float, float]] = list(map(tuple, every.tolist()))
    for i, j in pairs.tolist():
        (x, y), (u, v) = points[i], points[j]
        nx, ny = u - x, v - y
        begin[i] = cut(begin[i], nx, ny, nx * (x + u) / 2 + ny * (y + v) / 2)
    return begin


def _box(place: Sequence[float], low: Floats, high: Floats, period: tuple[float, float]) -> Corners:
    """Return a box that the cell of a place lies in."""
    first = [x - length / 2 if length else a for x, length, a in zip(place, period, low.tolist(), strict=True)]
    last = [x + length / 2 if length else b for x, length, b in zip(place, period, high.tolist(), strict=True)]
    return _corners(rectangle(first, last))


class _Cutter(NamedTuple):
    """What cells are cut to."""

    walk: Corners
    target: Corners | None
    holes: list[Corners]
    period: tuple[float, float]

    def areas(self, cell: Corners) -> tuple[float, float]:
        """Return the area of what of a cell is walkable, and of what of that lies in the target."""
        whole, part = 0.0, 0.0
        for shift in _shifts(self.period):
            dx, dy = shift[0] * self.period[0], shift[1] * self.period[1]
            there = [(x + dx, y + dy) for x, y in cell]
            if _apart(there, self.walk):
                continue
            here = self._walkable(there)
            whole += here
            part += here if self.target is None else self._walkable(cut_by(there, self.target))
        return whole, part

    def _walkable(self, cell: Corners) -> float:
        """Return the walkable area of a convex polygon, m^2."""
        if len(cell) < 3:
            return 0.0
        inside = size(cut_by(self.walk, cell))
        return inside - sum(size(cut_by(hole, cell)) for hole in self.holes if not _apart(hole, cell))


def _apart(a: Corners, b: Corners) -> bool:
    """Is one of two polygons wholly beside, above or below the other? Most are, and need not be cut."""
    return (
        max(a)[0] <= min(b)[0] or max(b)[0] <= min(a)[0]
        or max(y for _, y in a) <= min(y for _, y in b) or max(y for _, y in b) <= min(y for _, y in a)
    )  # fmt: skip


def _shifts(period: tuple[float, float]) -> list[tuple[int, int]]:
    """Return by how many periods a world is repeated around itself; not at all comes first."""
    steps = [(0, -1, 1) if length else (0,) for length in period]
    return [(i, j) for i, j in product(*steps)]


def _corners(polygon: Floats) -> Corners:
    return [(float(x), float(y)) for x, y in polygon]


def _flat(vectors: ArrayLike) -> Floats:
    given = np.asarray(vectors, np.float64)
    if given.shape[-1:] != (2,):
        raise ValueError(f"pos: of shape {given.shape}, its last axis must be (x, y): areas are of the plane")
    return given


def _unit(name: str, direction: ArrayLike) -> Floats:
    given = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(given))
    if given.shape != (2,) or not (np.isfinite(length) and length > 0):
        raise ValueError(f"{name} = {given.tolist()}: must be a direction (x, y), not of length 0")
    return given / length
