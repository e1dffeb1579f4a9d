"""Density and speed in an area: by counting, and by Voronoi cells, which scatters far less."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Voronoi
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from flockenv.studies.measures.polygons import Corners, contains, cut, rectangle, valid_polygon

__all__ = ["Ground", "Room", "classical_density", "speed_in_area", "voronoi", "voronoi_density", "voronoi_speed"]

Floats = NDArray[np.float64]

EDGE = 8.0
"""Width of the border of periodic images that is tried first, in mean distances of agents."""


class Room(NamedTuple):
    """Area of the Voronoi cell of each agent."""

    cell: Floats  # (N,) m^2, the area of the Voronoi cell; NaN for agents outside the walkable area
    inside: Floats  # (N,) m^2, the part of it in the measured area; 0 for agents outside the walkable area
    area: float  # m^2, the walkable part of the measured area


def classical_density(pos: ArrayLike, area: ArrayLike, alive: ArrayLike | None = None) -> Floats:
    """Return agents per m^2 in a polygon, at each instant, (T,): the number inside / its area.

    pos (T, N, 2) m; area (n, 2) m, its corners; alive (T, N), default: all. With few agents it takes few values.
    Raises ValueError if the polygon is invalid. Source: Steffen & Seyfried 2010, Physica A 389, 1902, eq. 1.
    """
    corners = valid_polygon("area", area)
    inside = contains(corners, _flat(pos))
    if alive is not None:
        inside = inside & np.asarray(alive, np.bool_)
    return np.asarray(inside.sum(axis=-1) / Polygon(corners).area, np.float64)


def speed_in_area(
    pos: ArrayLike, vel: ArrayLike, area: ArrayLike, alive: ArrayLike | None = None, along: ArrayLike | None = None
) -> Floats:
    """Return the mean speed of agents in a polygon at each instant, (T,) m/s; NaN if it is empty.

    area: (n, 2) m, the corners of the polygon; alive: (T, N), default: all.

    pos, vel (T, N, 2) m, m/s; along: a direction (2,); if given, the component of velocity along it replaces |v|.
    Raises ValueError if the polygon is invalid or the direction has length 0.
    """
    inside = contains(valid_polygon("area", area), _flat(pos))
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
    """Return the Voronoi cell of each agent at one instant: all points nearer to it than to any other agent.

    pos (N, 2) m. Cells are cut to the polygon `walkable` (n, 2) m, which need not be convex, less the polygons `holes`:
    obstacles, which may lie anywhere and overlap. Parts of a cell behind a wall count as well, so a walkable area must
    end at walls. area: the convex polygon that is measured (default: all of the walkable area). period: (Lx, Ly) m of
    a periodic world, 0 along an axis that is not periodic; `walkable` is one period of it. An agent outside `walkable`
    has no cell and takes no area. Agents at the same position share a cell. Raises ValueError if a polygon is invalid,
    or if the area is not convex or nothing of it is walkable. Source: Steffen & Seyfried 2010, Physica A 389, 1902.
    Cells by scipy's Qhull, areas by shapely's GEOS.
    """
    return Ground.of(walkable, area, holes, period).room(pos)


class Ground(NamedTuple):
    """The walkable area and the measured area, checked once for many instants."""

    walk: Floats  # (n, 2) m, corners of the walkable polygon
    free: BaseGeometry  # the walkable polygon less the obstacles
    target: BaseGeometry  # the part of that which is measured
    period: tuple[float, float]  # m, size of a torus; 0: none
    area: float  # m^2, of the measured area

    @classmethod
    def of(
        cls, walkable: ArrayLike, area: ArrayLike | None = None, holes: Sequence[ArrayLike] = (),
        period: tuple[float, float] = (0.0, 0.0),
    ) -> Ground:  # fmt: skip
        """Return the ground of these polygons; see `voronoi` for the arguments and errors.

        walkable: (n, 2) m, the corners of the walkable area; area: those of the measured one (default: all of it);
        holes: those of obstacles; period: m, size of a torus, 0 for none.
        """
        walk = valid_polygon("walkable", walkable)
        polygon = None if area is None else valid_polygon("area", area, is_convex=True)
        solid = [valid_polygon(f"holes[{k}]", hole) for k, hole in enumerate(holes)]
        free = Polygon(walk).difference(_union_of_images(solid, period))
        target = free if polygon is None else free.intersection(_union_of_images([polygon], period))
        if not target.area > 0:
            raise ValueError("area: nothing of it is walkable")
        return cls(walk, free, target, period, float(target.area))

    def room(self, pos: ArrayLike) -> Room:
        """Return the cells of agents at positions (N, 2), m.

        pos: (N, 2) m.
        """
        points = _flat(pos)
        here = np.flatnonzero(contains(self.walk, points)) if len(points) else np.zeros(0, np.int64)
        cell, inside = np.full(len(points), np.nan), np.zeros(len(points))
        if len(here):
            places, which, many = np.unique(points[here], axis=0, return_inverse=True, return_counts=True)
            cells = _cells(places, self.walk, self.period)
            total, part = (_shared_areas(cells, ground, self.period) / many for ground in (self.free, self.target))
            cell[here], inside[here] = total[which.ravel()], part[which.ravel()]
        return Room(cell, inside, self.area)


def _union_of_images(polygons: Sequence[Floats], period: tuple[float, float]) -> BaseGeometry:
    """Return the union of polygons, including their images in a periodic world."""
    steps = np.array(_shifts(period)) * period
    return shapely.union_all([Polygon(polygon + step) for polygon in polygons for step in steps])


def _shared_areas(cells: Sequence[Corners], ground: BaseGeometry, period: tuple[float, float]) -> Floats:
    """Return the area of the intersection of each convex cell, or of its images, with the ground, (N,) m^2."""
    places = np.concatenate([np.array(cell).reshape(-1, 2) for cell in cells])
    which = np.repeat(np.arange(len(cells)), [len(cell) for cell in cells])
    found = np.zeros(len(cells))
    for shift in _shifts(period):
        there = shapely.convex_hull(shapely.multipoints(places + np.multiply(shift, period), indices=which))
        found += shapely.area(shapely.intersection(there, ground))
    return found


def voronoi_density(room: Room) -> float:
    """Return agents per m^2: the mean over the area of 1 / (the area of the cell that contains the point).

    room: the cells at one instant, by `Ground.room`.
    """
    some = room.inside > 0
    return float((room.inside[some] / room.cell[some]).sum() / room.area)


def voronoi_speed(room: Room, speed: ArrayLike) -> float:
    """Return the mean over the area of the speed, m/s, of the agent whose cell contains the point; NaN without cells.

    room: the cells at one instant, by `Ground.room`.

    speed: (N,) m/s, or any other number per agent.
    """
    total = float(room.inside.sum())
    return float(room.inside @ np.asarray(speed, np.float64)) / total if total > 0 else np.nan


def _cells(places: Floats, walk: Floats, period: tuple[float, float]) -> list[Corners]:
    """Return the cells of distinct points, cut to a box around the walkable area, or to a period around each.

    In a periodic world images near the edge suffice if cells are small: any other image is further from a corner of a
    cell than the cell's own point.
    """
    low, high = walk.min(axis=0), walk.max(axis=0)
    images = [places + np.multiply(shift, period) for shift in _shifts(period)]
    margin = EDGE * float(np.sqrt(np.prod(high - low) / len(places)))
    if len(images) > 1:
        near = [each[((each > low - margin) & (each < high + margin)).all(axis=1)] for each in images[1:]]
        cells = _cut_cells(places, np.concatenate([places, *near]), low, high, period)
        far = max(
            max((x - u) ** 2 + (y - v) ** 2 for x, y in cell)
            for cell, (u, v) in zip(cells, places.tolist(), strict=True)
        )
        if 4 * far < margin**2:
            return cells
    return _cut_cells(places, np.concatenate(images), low, high, period)


def _cut_cells(places: Floats, every: Floats, low: Floats, high: Floats, period: tuple[float, float]) -> list[Corners]:
    """Return the cells of `places`, which are the first points in `every`."""
    middle, far = (low + high) / 2, 20 * float(max(np.ptp(every - every.mean(axis=0)), *(high - low), *period))
    # four more points far outside bound every cell, and are too far away to take any of the walkable area
    ring = middle + far * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    pairs = Voronoi(np.concatenate([every, ring])).ridge_points
    pairs = pairs[(pairs < len(every)).all(axis=1)]
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[pairs[:, 0] < len(places)]
    begin = [_box(place, low, high, period) for place in places.tolist()]
    points: list[tuple[float, float]] = list(map(tuple, every.tolist()))
    for i, j in pairs.tolist():
        (x, y), (u, v) = points[i], points[j]
        nx, ny = u - x, v - y
        begin[i] = cut(begin[i], nx, ny, nx * (x + u) / 2 + ny * (y + v) / 2)
    return begin


def _box(place: Sequence[float], low: Floats, high: Floats, period: tuple[float, float]) -> Corners:
    """Return a box that contains the cell of a point."""
    first = [x - length / 2 if length else a for x, length, a in zip(place, period, low.tolist(), strict=True)]
    last = [x + length / 2 if length else b for x, length, b in zip(place, period, high.tolist(), strict=True)]
    return _corners(rectangle(first, last))


def _shifts(period: tuple[float, float]) -> list[tuple[int, int]]:
    """Return the shifts to the neighbouring images of a periodic world, in periods; (0, 0) comes first."""
    steps = [(0, -1, 1) if length else (0,) for length in period]
    return [(i, j) for i, j in product(*steps)]


def _corners(polygon: Floats) -> Corners:
    return [(float(x), float(y)) for x, y in polygon]


def _flat(vectors: ArrayLike) -> Floats:
    given = np.asarray(vectors, np.float64)
    if given.shape[-1:] != (2,):
        raise ValueError(f"pos: of shape {given.shape}, its last axis must be (x, y): areas exist only in 2-D")
    return given


def _unit(name: str, direction: ArrayLike) -> Floats:
    given = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(given))
    if given.shape != (2,) or not (np.isfinite(length) and length > 0):
        raise ValueError(f"{name} = {given.tolist()}: must be a direction (x, y), not of length 0")
    return given / length
