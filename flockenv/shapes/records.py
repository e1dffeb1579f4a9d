"""Obstacles as records: each answers for itself how far its surface is, which way is out, where a ray hits.

Polygon(vertices=((0, 0), (4, 0), (4, 3))).gap([5.0, 1.0])
"""

from __future__ import annotations

import functools
import math
import operator
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, WrapValidator, model_validator

from flockenv.grid import packed, points_of
from flockenv.records import Record, keep
from flockenv.shapes import outlines
from flockenv.shapes.table import Floats, hits, nearest

__all__ = [
    "SHAPES", "AnyShape", "Block", "Capsule", "Circle", "DistanceField", "HalfSpace", "Polygon", "Shape", "Wall",
    "clear_of",
]  # fmt: skip

Point = Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]
MOST_POINTS = 2**22
"""Points of a grid of distances: 128 MB in the plane."""


class Shape(Record):
    """Something solid that stands still: what every obstacle answers. Points are (..., D) arrays in m."""

    kind: str
    form: ClassVar[str] = "chain"
    """By which laws it is met; see shapes/table.py."""

    @property
    def dimension(self) -> int:
        """In how many dimensions it lies."""
        return len(self.anchor)

    @property
    @abstractmethod
    def anchor(self) -> tuple[float, ...]:
        """The place that the rest is relative to, m."""

    @property
    @abstractmethod
    def extremes(self) -> Floats:
        """Places that everything of it lies between, (n, D) m; none if it has no end."""

    @abstractmethod
    def row(self, dimension: int) -> Sequence[float]:
        """Return the numbers that its laws read, behind the anchor."""

    @abstractmethod
    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the polygons, each (n, 2) m, that show it from above in a region."""

    def gap(self, points: ArrayLike) -> Floats:
        """Return how far its surface is, (...) m; negative inside."""
        return nearest(self, points)[0]

    def normal(self, points: ArrayLike) -> Floats:
        """Return which way is out at the nearest place of its surface, (..., D) unit vectors."""
        return nearest(self, points)[1]

    def nearest(self, points: ArrayLike) -> Floats:
        """Return the nearest place of its surface, (..., D) m."""
        gap, normal = nearest(self, points)
        return np.asarray(points, float) - gap[..., None] * normal

    def inside(self, points: ArrayLike) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Return whether points lie in it, (...)."""
        return np.asarray(self.gap(points) < 0)

    def hit(self, points: ArrayLike, directions: ArrayLike, clearance: ArrayLike = 0.0) -> Floats:
        """Return how far along unit directions a body of radius `clearance` touches it, (...) m; inf if it never does.

        Exactly, whatever the angle: where a ray hits the shape that is inflated by the body's radius.
        """
        return hits(self, points, directions, clearance)

    def silhouette(self, point: ArrayLike, clearance: float = 0.0) -> tuple[Floats, Floats]:
        """Return the left and right ends of its outline as seen from a point of the plane outside, m.

        Of the shape inflated by `clearance`: whoever aims there passes (Reynolds 1987). ValueError where it has none.
        """
        return outlines.silhouette(self, np.asarray(point, float), clearance)


class Circle(Shape):
    """A round obstacle of a scene: a circle in 2-D, a sphere in 3-D."""

    kind: Literal["circle"] = "circle"
    centre: tuple[float, ...] = Field(min_length=2, max_length=3, description="m")
    radius: float = Field(gt=0, description="m")

    @property
    def anchor(self) -> tuple[float, ...]:
        """Its centre."""
        return self.centre

    @property
    def extremes(self) -> Floats:
        """Its corners, as a box."""
        return np.array(self.centre) + self.radius * np.array([[-1.0], [1.0]])

    def row(self, dimension: int) -> Sequence[float]:
        """A chain of one vertex."""
        return [1.0, self.radius, 0.0] + [0.0] * dimension

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """A circle."""
        return [outlines.around(np.array([self.centre[:2]]), self.radius)]


class Wall(Shape):
    """A line through some points, `radius` thick on each side: walls, and in 3-D tubes."""

    kind: Literal["wall"] = "wall"
    vertices: tuple[Point, ...] = Field(min_length=2, max_length=1024, description="m, from end to end")
    radius: float = Field(default=0.0, ge=0, description="m, half its thickness")

    @model_validator(mode="after")
    def _in_one_dimension(self) -> Wall:
        _one_dimension(self.vertices)
        return self

    @property
    def anchor(self) -> tuple[float, ...]:
        """The middle of its box."""
        return _middle(self.vertices)

    @property
    def extremes(self) -> Floats:
        """Its vertices, with their thickness."""
        return _fattened(self.vertices, self.radius)

    def row(self, dimension: int) -> Sequence[float]:
        """An open chain."""
        around = np.array(self.vertices) - self.anchor
        return [float(len(self.vertices)), self.radius, 0.0, *around.ravel().tolist()]

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """A capsule around each part."""
        flat = np.array(self.vertices)[:, :2]
        radius = max(self.radius, 0.002 * float((high - low).max()))
        return [outlines.around(flat[k : k + 2], radius) for k in range(len(flat) - 1)]


class Capsule(Shape):
    """A straight piece of wall with round ends; with radius 0 a segment."""

    kind: Literal["capsule"] = "capsule"
    start: Point = Field(description="m")
    end: Point = Field(description="m")
    radius: float = Field(default=0.0, ge=0, description="m")

    @model_validator(mode="after")
    def _in_one_dimension(self) -> Capsule:
        if len(self.start) != len(self.end):
            raise ValueError(f"end = {self.end}: start has {len(self.start)} numbers")
        return self

    @property
    def _wall(self) -> Wall:
        return Wall(vertices=(self.start, self.end), radius=self.radius)

    @property
    def anchor(self) -> tuple[float, ...]:
        """The middle."""
        return _middle((self.start, self.end))

    @property
    def extremes(self) -> Floats:
        """Its ends, with their thickness."""
        return self._wall.extremes

    def row(self, dimension: int) -> Sequence[float]:
        """A chain of two vertices."""
        return self._wall.row(dimension)

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """A capsule."""
        return self._wall.outline(low, high)


class Polygon(Shape):
    """A solid of the plane, convex or concave; its edges do not cross."""

    kind: Literal["polygon"] = "polygon"
    vertices: tuple[Annotated[tuple[float, ...], Field(min_length=2, max_length=2)], ...] = Field(
        min_length=3, max_length=1024, description="m, in either sense"
    )

    @model_validator(mode="after")
    def _simple(self) -> Polygon:
        """Refuse edges that cross or touch, and what has no area."""
        crossing = outlines.crossing(np.array(self.vertices))
        if crossing is not None:
            raise ValueError(f"vertices: the edges from vertices {crossing[0]} and {crossing[1]} cross or touch")
        if outlines.area(np.array(self.vertices)) == 0:
            raise ValueError("vertices: enclose no area")
        return self

    @property
    def anchor(self) -> tuple[float, ...]:
        """The middle of its box."""
        return _middle(self.vertices)

    @property
    def extremes(self) -> Floats:
        """Its vertices."""
        return np.array(self.vertices)

    def row(self, dimension: int) -> Sequence[float]:
        """A closed chain, counter-clockwise: the right of an edge is outside."""
        around = np.array(self.vertices) - self.anchor
        around = around if outlines.area(around) > 0 else around[::-1]
        return [float(len(around)), 0.0, 1.0, *around.ravel().tolist()]

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """Itself."""
        return [np.array(self.vertices)]


class Block(Shape):
    """A rectangle, or in 3-D a box, along the axes or turned."""

    kind: Literal["block"] = "block"
    form: ClassVar[str] = "block"
    centre: Point = Field(description="m")
    size: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=2, max_length=3)] = Field(
        description="m, its edges"
    )
    turn: float = Field(default=0.0, description="degrees, counter-clockwise; in 3-D about `axis`")
    axis: Annotated[tuple[float, ...], Field(min_length=3, max_length=3)] = Field(
        default=(0.0, 0.0, 1.0), description="what a block in 3-D is turned about"
    )

    @model_validator(mode="after")
    def _in_one_dimension(self) -> Block:
        if len(self.centre) != len(self.size):
            raise ValueError(f"size = {self.size}: centre has {len(self.centre)} numbers")
        if not math.hypot(*self.axis) > 0:
            raise ValueError(f"axis = {self.axis}: a direction, not all 0")
        if len(self.centre) == 2 and self.axis != (0.0, 0.0, 1.0):
            raise ValueError(f"axis = {self.axis}: in the plane a block turns about the third axis alone")
        return self

    @property
    def anchor(self) -> tuple[float, ...]:
        """Its centre."""
        return self.centre

    @property
    def axes(self) -> Floats:
        """Its own axes, (D, D) unit vectors, a row each (Rodrigues' rotation)."""
        x, y, z = np.array(self.axis) / math.hypot(*self.axis)
        angle, across = math.radians(self.turn), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        full = np.eye(3) + math.sin(angle) * across + (1 - math.cos(angle)) * across @ across
        d = len(self.centre)
        return np.ascontiguousarray(full[:d, :d].T)

    @property
    def extremes(self) -> Floats:
        """Its corners, (2^D, D)."""
        d = len(self.centre)
        signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * d, indexing="ij"), axis=-1).reshape(-1, d)
        return np.asarray(np.array(self.centre) + (signs * self.size) @ self.axes)

    def row(self, dimension: int) -> Sequence[float]:
        """Half edges and axes."""
        return [*(0.5 * edge for edge in self.size), *self.axes.ravel().tolist()]

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """Its corners as seen from above."""
        return [outlines.hull(self.extremes[:, :2])]


class HalfSpace(Shape):
    """All that lies behind a line, or in 3-D a plane."""

    kind: Literal["half_space"] = "half_space"
    form: ClassVar[str] = "half_space"
    point: Point = Field(description="m, any place of its surface")
    direction: Point = Field(description="out of it, of any length")

    @model_validator(mode="after")
    def _points_somewhere(self) -> HalfSpace:
        if len(self.point) != len(self.direction):
            raise ValueError(f"direction = {self.direction}: point has {len(self.point)} numbers")
        if not 1e-15 <= math.hypot(*self.direction) <= 1e15:
            raise ValueError(f"direction = {self.direction}: not all 0 (from 1e-15 to 1e15 long)")
        return self

    @property
    def anchor(self) -> tuple[float, ...]:
        """Its point."""
        return self.point

    @property
    def extremes(self) -> Floats:
        """It has no end."""
        return np.zeros((0, len(self.point)))

    def row(self, dimension: int) -> Sequence[float]:
        """The unit normal."""
        return (np.array(self.direction) / math.hypot(*self.direction)).tolist()  # type: ignore[no-any-return]

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """What of the region lies behind it; nothing of a floor."""
        return outlines.behind(np.array(self.point[:2]), np.array(self.direction[:2]), low, high)


class DistanceField(Shape):
    """Distances on a grid: of other shapes, or any that are given as an array (negative inside)."""

    kind: Literal["distance_field"] = "distance_field"
    form: ClassVar[str] = "distance_field"
    low: Point = Field(description="m, the lowest corner of the grid")
    high: Point | None = Field(default=None, description="m, its highest corner; goes with shapes")
    spacing: float = Field(gt=0, description="m, between points of the grid")
    shapes: tuple[Any, ...] = Field(default=(), description="what it is made of; together they are one")
    values: tuple[Any, ...] | None = Field(default=None, description="m, nested lists (nx, ny[, nz]) of distances")

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        """Read shapes as obstacles of a scene are read."""
        if not isinstance(data, Mapping):
            return data
        made = dict(data)
        if made.get("shapes"):
            made["shapes"] = tuple(shape_of(one) for one in made["shapes"])
        if made.get("values") is not None:
            made["values"] = _nested(made["values"])
        return made

    @model_validator(mode="after")
    def _one_or_the_other(self) -> DistanceField:
        if bool(self.shapes) == (self.values is not None):
            raise ValueError("values: give either shapes or values")
        if bool(self.shapes) != (self.high is not None):
            raise ValueError("high: goes with shapes, and shapes with it")
        counts = self.counts
        if len(counts) != len(self.low) or min(counts) < 2:
            raise ValueError(
                f"spacing: a grid of {counts} points, must be at least 2 along each of {len(self.low)} axes"
            )
        if math.prod(counts) > MOST_POINTS:
            raise ValueError(f"spacing = {self.spacing:g}: {math.prod(counts):,} points, at most {MOST_POINTS:,}")
        for k, shape in enumerate(self.shapes):
            if shape.dimension != len(self.low):
                raise ValueError(f"shapes[{k}]: lies in {shape.dimension} dimensions, low in {len(self.low)}")
        if not np.isfinite(self.distances).all():
            raise ValueError("values: must be finite")
        return self

    @property
    def counts(self) -> tuple[int, ...]:
        """How many points it has along each axis."""
        if self.values is not None:
            return np.shape(np.array(self.values, float))
        assert self.high is not None
        edges = zip(self.low, self.high, strict=True)
        return tuple(1 + math.ceil((b - a) / self.spacing - 1e-9) for a, b in edges)

    @functools.cached_property
    def distances(self) -> Floats:
        """The distance at each point, (nx, ny[, nz]) m."""
        if self.values is not None:
            return np.array(self.values, float)
        points = points_of(self.low, self.spacing, self.counts)
        return np.asarray(np.min([shape.gap(points) for shape in self.shapes], axis=0))

    @property
    def anchor(self) -> tuple[float, ...]:
        """Its lowest corner."""
        return self.low

    @property
    def extremes(self) -> Floats:
        """The corners of its grid."""
        return np.array([self.low, np.array(self.low) + self.spacing * (np.array(self.counts) - 1)])

    def row(self, dimension: int) -> Sequence[float]:
        """Its grid: distances and unit gradients."""
        along: Any = np.gradient(self.distances, self.spacing)
        slopes = np.stack(along, axis=-1)
        size = np.linalg.norm(slopes, axis=-1, keepdims=True)
        numbers = np.concatenate([self.distances[..., None], slopes / np.maximum(size, 1e-12)], axis=-1)
        return packed(numbers, (0.0,) * dimension, self.spacing)  # type: ignore[return-value]

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """Strips of the grid that lie in it; in 3-D, of what lies below or above."""
        flat = self.distances if self.distances.ndim == 2 else self.distances.min(axis=2)
        return outlines.strips(flat, self.low[:2], self.spacing)


def _nested(values: Any) -> tuple[Any, ...]:
    return tuple(_nested(v) if np.ndim(v) else float(v) for v in values)


def _one_dimension(vertices: Sequence[tuple[float, ...]]) -> None:
    for k, vertex in enumerate(vertices):
        if len(vertex) != len(vertices[0]):
            raise ValueError(f"vertices[{k}] = {vertex}: the first has {len(vertices[0])} numbers")


def _middle(vertices: Sequence[tuple[float, ...]]) -> tuple[float, ...]:
    array = np.array(vertices)
    return tuple(((array.min(axis=0) + array.max(axis=0)) / 2).tolist())


def _fattened(vertices: Sequence[tuple[float, ...]], radius: float) -> Floats:
    array = np.array(vertices)
    return np.concatenate([array - radius, array + radius])


SHAPES: dict[str, type[Shape]] = {
    str(shape.model_fields["kind"].default): shape
    for shape in (Circle, Capsule, Wall, Polygon, Block, HalfSpace, DistanceField)
}
"""Every shape by its kind."""


def _round_by_default(value: Any, handler: Any) -> Any:
    """Take a block without a kind for a circle."""
    if isinstance(value, Mapping) and "kind" not in value:
        value = {"kind": "circle", **value}
    return keep(Shape)(value, handler)


if TYPE_CHECKING:
    AnyShape = Shape
else:
    AnyShape = Annotated[
        Annotated[functools.reduce(operator.or_, SHAPES.values()), Field(discriminator="kind")],
        WrapValidator(_round_by_default),
    ]


def shape_of(data: Any) -> Shape:
    """Return a shape, given as itself or as a block of a file; ValueError if it is none."""
    if isinstance(data, Shape):
        return data
    kind = data.get("kind", "circle") if isinstance(data, Mapping) else None
    if kind not in SHAPES or kind == "distance_field":
        allowed = ", ".join(name for name in SHAPES if name != "distance_field")
        raise ValueError(f"shapes: kind = {kind!r}; must be one of {allowed}")
    fields = {name: _in_tuples(value) for name, value in data.items()}
    return SHAPES[kind](**fields)


def _in_tuples(value: Any) -> Any:
    return tuple(map(_in_tuples, value)) if isinstance(value, (list, tuple)) else value


def clear_of(shapes: Sequence[Shape], points: Floats, period: Floats) -> Floats:
    """Return the distance of points (N, D) to the nearest of some shapes, (N,) m; inf if there is none.

    period: of each axis, (D,) m; 0 where the world does not repeat.
    """
    best = np.full(len(points), np.inf)
    for shape in shapes:
        offset = points - shape.anchor
        turns = np.divide(offset, period, out=np.zeros_like(offset), where=period > 0)
        best = np.minimum(best, shape.gap(shape.anchor + offset - period * np.floor(turns + 0.5)))
    return best
