"""Floor plans, drawn elsewhere, as obstacles of a scene: GeoJSON or WKT, read by shapely (GEOS).

Lines become walls. Areas are either those in which agents are, whose edges are walls and whose holes are solid, or
solid obstacles. Coordinates are in m in the plane, times `scale`; a third one is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import LinearRing, LineString, MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from flockenv.behaviours.avoid import AvoidObstacles
from flockenv.behaviours.flock import Separation
from flockenv.behaviours.wander import Wander
from flockenv.core.errors import printable
from flockenv.geometry import shapes
from flockenv.geometry.shapes import Shape
from flockenv.model.group import Group
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Collisions
from flockenv.scene.scene import Scene
from flockenv.scene.yaml_io import MAX_BYTES

__all__ = ["read_plan", "scene_of", "shapes_of"]

MOST_VERTICES = 1024
"""Of a wall or a polygon of a scene."""


def read_plan(path: Path, scale: float = 1.0) -> BaseGeometry:
    """Return the geometry of a GeoJSON or WKT file, in m: coordinates times `scale`.

    path: of the file, UTF-8, at most MAX_BYTES long.

    Raises ValueError, in one line, if the file cannot be read or is neither.
    """
    name = printable(str(path))[1:-1]
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1).decode("utf-8-sig").strip()
    except OSError as error:
        raise ValueError(f"{name}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{name}: not UTF-8 text") from None
    if len(text) > MAX_BYTES:
        raise ValueError(f"{name}: larger than {MAX_BYTES} bytes, the most that is read")
    try:
        with np.errstate(all="ignore"):  # coordinates that are not finite are refused below
            plan = shapely.from_geojson(text) if text.startswith("{") else shapely.from_wkt(text)
    except shapely.errors.ShapelyError as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{name}: neither GeoJSON nor WKT: {reason}") from None
    return shapely.transform(shapely.force_2d(plan), lambda points: points * scale)


def shapes_of(plan: BaseGeometry, solid: bool = False, thickness: float = 0.0) -> tuple[Shape, ...]:
    """Return the obstacles of a plan.

    Args:
        plan: lines and areas, also in collections.
        solid: areas are solid; otherwise agents are in them, and they must be connected.
        thickness: of lines, m.

    Raises:
        ValueError: the plan is empty, has points or areas whose edges cross, or more vertices than a scene takes.
    """
    parts = list(_parts(plan))
    for part in parts:
        if not isinstance(part, (LineString, Polygon)):
            raise ValueError(f"{part.geom_type}: is neither a line nor an area; leave it out")
        if not part.is_valid:
            raise ValueError(f"{part.geom_type}: {shapely.is_valid_reason(part)}")
    areas = [part for part in parts if isinstance(part, Polygon)]
    walls = [
        shapes.Wall(vertices=_vertices(part), radius=thickness / 2) for part in parts if isinstance(part, LineString)
    ]
    if not parts:
        raise ValueError("the plan is empty: it has neither lines nor areas")
    made = [each for area in areas for each in _solids(area)] if solid else _rooms(areas)
    return (*made, *walls)


def scene_of(obstacles: Sequence[Shape], agents: int = 20) -> Scene:
    """Return a scene in which agents of the size of people wander between obstacles, to be edited."""
    low, high = _bounds(obstacles)
    people = Group(
        count=agents, radius=0.25, max_speed=1.3, max_force=4.0,
        spawn=Spawn(low=low, high=high, spacing=0.6, speed=(0.5, 1.0)),
    )  # fmt: skip
    return Scene(
        groups=(people,),
        effects=(
            Wander(weight=2.0), Separation(weight=1.0, radius=1.5),
            AvoidObstacles(weight=4.0, horizon=1.5, margin=0.2),
        ),
        obstacles=tuple(obstacles),
        constraints=(Collisions(),),
    )  # fmt: skip


def _bounds(obstacles: Sequence[Shape]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the lowest and the highest corner of the box around some shapes, m."""
    points = np.concatenate([shape.extremes for shape in obstacles])
    return tuple(points.min(axis=0).tolist()), tuple(points.max(axis=0).tolist())


def _parts(plan: BaseGeometry) -> Iterator[BaseGeometry]:
    """Yield the lines, areas and other single geometries of a plan, without empty ones."""
    for part in getattr(plan, "geoms", [plan]):
        if hasattr(part, "geoms"):
            yield from _parts(part)
        elif not part.is_empty:
            yield part


def _rooms(areas: Sequence[Polygon]) -> list[Shape]:
    """Return the edge of the areas in which agents are, and the holes."""
    if not areas:
        return []
    whole = areas[0] if len(areas) == 1 else shapely.union_all(areas)
    if not isinstance(whole, Polygon):
        apart = len(whole.geoms) if isinstance(whole, MultiPolygon) else 0
        raise ValueError(f"{apart} areas are apart, but agents cannot be outside of all but one; join them by doors")
    edge = shapes.Polygon(vertices=_corners(whole.exterior), hollow=True)
    return [edge, *(shapes.Polygon(vertices=_corners(hole)) for hole in whole.interiors)]


def _solids(area: Polygon) -> Iterator[Shape]:
    """Yield solid polygons that make up an area; one with holes is cut through each of them."""
    if not area.interiors:
        yield shapes.Polygon(vertices=_corners(area.exterior))
        return
    low_x, low_y, high_x, high_y = area.bounds
    x = Polygon(area.interiors[0]).centroid.x
    for half in (shapely.box(low_x, low_y, x, high_y), shapely.box(x, low_y, high_x, high_y)):
        for part in _parts(area.intersection(half)):
            if isinstance(part, Polygon):
                yield from _solids(part)


def _corners(ring: LinearRing) -> tuple[tuple[float, ...], ...]:
    """Return the corners of a ring, each once; raise ValueError if there are too many."""
    return _vertices(LineString(ring.coords[:-1]))


def _vertices(line: LineString) -> tuple[tuple[float, ...], ...]:
    """Return the points of a line; raise ValueError if there are too many."""
    points = tuple((float(x), float(y)) for x, y in line.coords)
    if len(points) > MOST_VERTICES:
        raise ValueError(f"a line or ring has {len(points):,} vertices; at most {MOST_VERTICES:,} allowed: simplify it")
    return points
