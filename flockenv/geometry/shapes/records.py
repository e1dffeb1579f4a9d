"""Obstacles as records, with methods for the distance to the surface, its normal, and ray casts.

Polygon(vertices=((0, 0), (4, 0), (4, 3))).gap([5.0, 1.0])

The methods of a moving obstacle apply to the position given by its fields; `shift` returns its displacement at a time.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, WrapValidator, field_validator, model_validator

from flockenv.core.record import instance_of, lists_to_tuples
from flockenv.geometry.shapes import outlines
from flockenv.geometry.shapes.grid_shape import GridShape
from flockenv.geometry.shapes.shape import Bound, Closed, Point, Shape, Sway
from flockenv.geometry.shapes.table import Floats
from flockenv.geometry.shapes.triangle_mesh import TriangleMesh
from flockenv.maths.grid import points_of

__all__ = [
    "SHAPES", "AnyShape", "Block", "Bound", "Capsule", "Circle", "Closed", "DistanceField", "HalfSpace", "Polygon",
    "Shape", "Sway", "TriangleMesh", "Wall", "distance_to_shapes",
]  # fmt: skip


class Circle(Closed):
    """A round obstacle: a circle in 2-D, a sphere in 3-D."""

    kind: Literal["circle"] = "circle"
    sentence: ClassVar[str] = "A round obstacle at {centre} of radius {radius}"
    points: ClassVar[tuple[str, ...]] = ("centre",)
    centre: tuple[float, ...] = Field(min_length=2, max_length=3, description="m")
    radius: float = Field(gt=0, description="m")

    @property
    def in_state(self) -> bool:
        """True if the circle is kept in the state: it is solid and does not move."""
        return not (self.moves or self.hollow)

    @property
    def _thickness(self) -> float:
        return 2 * self.radius

    @property
    def anchor(self) -> tuple[float, ...]:
        """The centre."""
        return self.centre

    @property
    def corners(self) -> tuple[Floats, float]:
        """The centre, as the only point, and the radius."""
        return np.array([self.centre]), self.radius

    @property
    def extremes(self) -> Floats:
        """Two opposite corners of the bounding box."""
        return np.array(self.centre) + self.radius * np.array([[-1.0], [1.0]])

    def row(self, dimension: int) -> Sequence[float]:
        """Return the numbers of a chain of one vertex."""
        return [1.0, self.radius, 0.0] + [0.0] * dimension

    def polygons(self, low: Floats, high: Floats) -> list[Floats]:
        """Return a polygon that approximates the circle."""
        return [outlines.inflated_hull(np.array([self.centre[:2]]), self.radius)]


class Wall(Shape):
    """A wall along a polyline, `radius` thick on each side; in 3-D a tube.

    Pieces of length 0 (a vertex given twice) have no effect.
    """

    kind: Literal["wall"] = "wall"
    sentence: ClassVar[str] = "A wall along {vertices}"
    points: ClassVar[tuple[str, ...]] = ("vertices",)
    vertices: tuple[Point, ...] = Field(min_length=2, max_length=1024, description="m, from end to end")
    radius: float = Field(default=0.0, ge=0, description="m, half its thickness")

    @model_validator(mode="after")
    def _check_dimension(self) -> Wall:
        _one_dimension(self.vertices)
        return self

    @property
    def dimension(self) -> int:
        """Dimension of space: the number of coordinates of a vertex."""
        return len(self.vertices[0])

    @property
    def _thickness(self) -> float:
        return 2 * self.radius

    @property
    def anchor(self) -> tuple[float, ...]:
        """The centre of the bounding box."""
        return _middle(self.vertices)

    @property
    def corners(self) -> tuple[Floats, float]:
        """The vertices without repetitions, and the radius."""
        return outlines.distinct(np.array(self.vertices)), self.radius

    @property
    def extremes(self) -> Floats:
        """The corners of the boxes around the vertices, each as wide as the wall."""
        return _inflate(self.vertices, self.radius)

    def row(self, dimension: int) -> Sequence[float]:
        """Return the numbers of an open chain."""
        around = self.corners[0] - self.anchor
        return [float(len(around)), self.radius, 0.0, *around.ravel().tolist()]

    def polygons(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the polygon of a capsule for each piece."""
        flat = np.array(self.vertices)[:, :2]
        radius = max(self.radius, 0.002 * float((high - low).max()))
        return [outlines.inflated_hull(flat[k : k + 2], radius) for k in range(len(flat) - 1)]


class Capsule(Closed):
    """A segment inflated by `radius`: a straight piece of wall with round ends."""

    kind: Literal["capsule"] = "capsule"
    points: ClassVar[tuple[str, ...]] = ("start", "end")
    start: Point = Field(description="m")
    end: Point = Field(description="m")
    radius: float = Field(default=0.0, ge=0, description="m")

    @model_validator(mode="after")
    def _check_dimension(self) -> Capsule:
        if len(self.start) != len(self.end):
            raise ValueError(f"end = {self.end}: must have {len(self.start)} numbers, as start has")
        if self.hollow and self.radius == 0:
            raise ValueError("radius = 0: a hollow capsule needs a radius above 0, or it has no inside")
        return self

    @property
    def _wall(self) -> Wall:
        return Wall(vertices=(self.start, self.end), radius=self.radius)

    @property
    def dimension(self) -> int:
        """Dimension of space, 2 or 3."""
        return len(self.start)

    @property
    def corners(self) -> tuple[Floats, float]:
        """Both ends, and the radius."""
        return self._wall.corners

    @property
    def _thickness(self) -> float:
        return 2 * self.radius

    @property
    def anchor(self) -> tuple[float, ...]:
        """The middle between both ends."""
        return _middle((self.start, self.end))

    @property
    def extremes(self) -> Floats:
        """The corners of the boxes around both ends, each as wide as the capsule."""
        return self._wall.extremes

    def row(self, dimension: int) -> Sequence[float]:
        """Return the numbers of a chain of two vertices."""
        return self._wall.row(dimension)

    def polygons(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the polygon of the capsule."""
        return self._wall.polygons(low, high)


class Polygon(Closed):
    """A 2-D polygon, convex or concave; its edges do not cross.

    A ring that repeats its first vertex at the end (GeoJSON, WKT, shapely's `exterior.coords`) is the same polygon.
    """

    kind: Literal["polygon"] = "polygon"
    points: ClassVar[tuple[str, ...]] = ("vertices",)
    vertices: tuple[Annotated[tuple[float, ...], Field(min_length=2, max_length=2)], ...] = Field(
        min_length=3, max_length=1024, description="m, in either orientation"
    )

    @field_validator("vertices")
    @classmethod
    def _open_ring(cls, vertices: tuple[Point, ...]) -> tuple[Point, ...]:
        """Return the vertices without the last one of a closed ring."""
        return vertices[:-1] if len(vertices) > 3 and vertices[0] == vertices[-1] else vertices

    @model_validator(mode="after")
    def _check_simple(self) -> Polygon:
        """Raise ValueError if a vertex is given twice, edges cross or touch, or the area is 0."""
        first: dict[Point, int] = {}
        for k, vertex in enumerate(self.vertices):
            if first.setdefault(vertex, k) != k:
                raise ValueError(f"vertices[{k}] = {vertex}: is the same as vertices[{first[vertex]}]; leave it out")
        crossing = outlines.crossing(np.array(self.vertices))
        if crossing is not None:
            raise ValueError(f"vertices: the edges after vertices {crossing[0]} and {crossing[1]} cross or touch")
        if outlines.area(np.array(self.vertices)) == 0:
            raise ValueError("vertices: enclose no area")
        return self

    @property
    def _thickness(self) -> float:
        return outlines.width(np.array(self.vertices))

    @property
    def anchor(self) -> tuple[float, ...]:
        """The centre of the bounding box."""
        return _middle(self.vertices)

    @property
    def corners(self) -> tuple[Floats, float]:
        """The vertices, and radius 0."""
        return np.array(self.vertices), 0.0

    @property
    def extremes(self) -> Floats:
        """The vertices, (n, 2) m."""
        return np.array(self.vertices)

    def row(self, dimension: int) -> Sequence[float]:
        """Return the numbers of a closed chain, counter-clockwise: the right of an edge is outside."""
        around = np.array(self.vertices) - self.anchor
        around = around if outlines.area(around) > 0 else around[::-1]
        return [float(len(around)), 0.0, 1.0, *around.ravel().tolist()]

    def polygons(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the polygon itself."""
        return [np.array(self.vertices)]


class Block(Closed):
    """A rectangle, or in 3-D a box, of any orientation."""

    kind: Literal["block"] = "block"
    sentence: ClassVar[str] = "A block at {centre} of size {size}"
    points: ClassVar[tuple[str, ...]] = ("centre",)
    laws: ClassVar[str] = "block"
    centre: Point = Field(description="m")
    size: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=2, max_length=3)] = Field(
        description="m, its edges"
    )
    turn: float = Field(default=0.0, description="degrees, counter-clockwise; in 3-D about `axis`")
    axis: Annotated[tuple[float, ...], Field(min_length=3, max_length=3)] = Field(
        default=(0.0, 0.0, 1.0), description="axis of rotation of a block in 3-D"
    )

    @model_validator(mode="after")
    def _check_dimension(self) -> Block:
        if len(self.centre) != len(self.size):
            raise ValueError(f"size = {self.size}: must have {len(self.centre)} numbers, as centre has")
        if not math.hypot(*self.axis) > 0:
            raise ValueError(f"axis = {self.axis}: must be a direction, not all 0")
        if len(self.centre) == 2 and self.axis != (0.0, 0.0, 1.0):
            raise ValueError(f"axis = {self.axis}: a block in 2-D turns about the z axis only; leave axis out")
        return self

    @property
    def _thickness(self) -> float:
        return min(self.size)

    @property
    def anchor(self) -> tuple[float, ...]:
        """The centre."""
        return self.centre

    @property
    def axes(self) -> Floats:
        """The block's axes as unit vectors, the rows of (D, D) (Rodrigues' rotation)."""
        x, y, z = np.array(self.axis) / math.hypot(*self.axis)
        angle, across = math.radians(self.turn), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        full = np.eye(3) + math.sin(angle) * across + (1 - math.cos(angle)) * across @ across
        d = len(self.centre)
        return np.ascontiguousarray(full[:d, :d].T)

    @property
    def corners(self) -> tuple[Floats, float]:
        """The corners, and radius 0."""
        return self.extremes, 0.0

    @property
    def extremes(self) -> Floats:
        """The corners, (2^D, D) m."""
        d = len(self.centre)
        signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * d, indexing="ij"), axis=-1).reshape(-1, d)
        return np.asarray(np.array(self.centre) + (signs * self.size) @ self.axes)

    @property
    def reference_points(self) -> Floats:
        """The centre, as a face rounds with its own distance from it; of a room, whose faces agents reach, corners."""
        return self.extremes if self.hollow else np.array([self.centre])

    def row(self, dimension: int) -> Sequence[float]:
        """Return the half edges and the axes."""
        return [*(0.5 * edge for edge in self.size), *self.axes.ravel().tolist()]

    def polygons(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the convex hull of the corners as seen from above."""
        return [outlines.hull(self.extremes[:, :2])]


class HalfSpace(Shape):
    """The half-space behind a line, or in 3-D a plane."""

    kind: Literal["half_space"] = "half_space"
    points: ClassVar[tuple[str, ...]] = ("point",)
    laws: ClassVar[str] = "half_space"
    point: Point = Field(description="m, any point of its surface")
    direction: Point = Field(description="outward normal, of any length")

    @model_validator(mode="after")
    def _check_direction(self) -> HalfSpace:
        if len(self.point) != len(self.direction):
            raise ValueError(f"direction = {self.direction}: must have {len(self.point)} numbers, as point has")
        if not 1e-15 <= math.hypot(*self.direction) <= 1e15:
            raise ValueError(f"direction = {self.direction}: must be a direction, not all 0, of length 1e-15 to 1e15")
        return self

    @property
    def _thickness(self) -> float:
        return math.inf

    @property
    def anchor(self) -> tuple[float, ...]:
        """The given point of the surface."""
        return self.point

    @property
    def extremes(self) -> Floats:
        """None, as it is unbounded."""
        return np.zeros((0, len(self.point)))

    @property
    def reference_points(self) -> Floats:
        """The point, each coordinate times that of the unit normal: along the surface it may lie anywhere."""
        return np.array([self.point]) * self.row(self.dimension)

    def row(self, dimension: int) -> Sequence[float]:
        """Return the unit normal."""
        return (np.array(self.direction) / math.hypot(*self.direction)).tolist()  # type: ignore[no-any-return]

    def polygons(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the part of the region behind the surface; no polygon for a floor."""
        return outlines.half_plane(np.array(self.point[:2]), np.array(self.direction[:2]), low, high)


class DistanceField(GridShape):
    """Signed distances on a grid, of other shapes or given as an array (negative inside)."""

    kind: Literal["distance_field"] = "distance_field"
    low: Point = Field(description="m, the lowest corner of the grid")
    high: Point | None = Field(default=None, description="m, the highest corner of the grid; only with shapes")
    spacing: float = Field(gt=0, description="m, between grid points")
    shapes: tuple[Any, ...] = Field(default=(), description="shapes, of whose union the distances are computed")
    values: tuple[Any, ...] | None = Field(default=None, description="m, nested lists (nx, ny[, nz]) of distances")

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        """Return the data with `shapes` converted like obstacles of a scene."""
        if not isinstance(data, Mapping):
            return data
        made = dict(data)
        if made.get("shapes"):
            made["shapes"] = tuple(shape_of(one) for one in made["shapes"])
        if made.get("values") is not None:
            made["values"] = _nested(made["values"])
        return made

    @model_validator(mode="after")
    def _check_source(self) -> DistanceField:
        if bool(self.shapes) == (self.values is not None):
            raise ValueError("values: give either shapes or values")
        if bool(self.shapes) != (self.high is not None):
            raise ValueError("shapes and high go together: give both or neither")
        counts = self.counts
        if len(counts) != len(self.low) or min(counts) < 2:
            raise ValueError(
                f"spacing: gives a grid of {counts} points; needs at least 2 along each of {len(self.low)} axes"
            )
        self._check_counts()
        for k, shape in enumerate(self.shapes):
            if shape.dimension != len(self.low):
                raise ValueError(f"shapes[{k}]: lies in {shape.dimension} dimensions, but low in {len(self.low)}")
            if shape.moves:
                raise ValueError(f"shapes[{k}]: moves; a distance field moves as a whole, by its own velocity and sway")
        if not np.isfinite(self.distances).all():
            raise ValueError("values: must be finite")
        return self

    @property
    def grid_low(self) -> Floats:
        """The lowest corner of the grid, (D,) m."""
        return np.array(self.low)

    @property
    def grid_spacing(self) -> float:
        """Distance between grid points, m."""
        return self.spacing

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of grid points along each axis."""
        if self.values is not None:
            return np.shape(np.array(self.values, float))
        assert self.high is not None
        edges = zip(self.low, self.high, strict=True)
        return tuple(1 + math.ceil((b - a) / self.spacing - 1e-9) for a, b in edges)

    @functools.cached_property
    def distances(self) -> Floats:
        """The distance at each grid point, (nx, ny[, nz]) m."""
        if self.values is not None:
            return np.array(self.values, float)
        points = points_of(self.low, self.spacing, self.counts)
        return np.asarray(np.min([shape.gap(points) for shape in self.shapes], axis=0))

    @property
    def anchor(self) -> tuple[float, ...]:
        """The lowest corner of the grid."""
        return self.low


def _nested(values: Any) -> tuple[Any, ...]:
    return tuple(_nested(v) if np.ndim(v) else float(v) for v in values)


def _one_dimension(vertices: Sequence[tuple[float, ...]]) -> None:
    for k, vertex in enumerate(vertices):
        if len(vertex) != len(vertices[0]):
            raise ValueError(f"vertices[{k}] = {vertex}: must have {len(vertices[0])} numbers, as vertices[0] has")


def _middle(vertices: Sequence[tuple[float, ...]]) -> tuple[float, ...]:
    array = np.array(vertices)
    return tuple(((array.min(axis=0) + array.max(axis=0)) / 2).tolist())


def _inflate(vertices: Sequence[tuple[float, ...]], radius: float) -> Floats:
    array = np.array(vertices)
    return np.concatenate([array - radius, array + radius])


SHAPES: dict[str, type[Shape]] = {
    str(shape.model_fields["kind"].default): shape
    for shape in (Circle, Capsule, Wall, Polygon, Block, HalfSpace, DistanceField, TriangleMesh)
}
"""Shape classes by kind."""


def _round_by_default(value: Any, handler: Any) -> Any:
    """Validate a shape; one without a kind is a circle."""
    if isinstance(value, Mapping) and "kind" not in value:
        value = {"kind": "circle", **value}
    return instance_of(Shape)(value, handler)


if TYPE_CHECKING:
    AnyShape = Shape
else:
    AnyShape = Annotated[
        Annotated[functools.reduce(operator.or_, SHAPES.values()), Field(discriminator="kind")],
        WrapValidator(_round_by_default),
    ]
    """A shape of any kind, as a field of a record: read from a file, its `kind` selects the class, default: circle."""


def shape_of(data: Any) -> Shape:
    """Return a shape, given as a record or as a mapping read from a file; raise ValueError if it is neither."""
    if isinstance(data, Shape):
        return data
    kind = data.get("kind", "circle") if isinstance(data, Mapping) else None
    if kind not in SHAPES or kind == "distance_field":
        allowed = ", ".join(name for name in SHAPES if name != "distance_field")
        raise ValueError(f"shapes: kind = {kind!r}; must be one of {allowed}")
    return SHAPES[kind](**lists_to_tuples(data))


def distance_to_shapes(shapes: Sequence[Shape], points: Floats, period: Floats, time: float = 0.0) -> Floats:
    """Return the distance of points (N, D) to the nearest of some shapes, (N,) m; inf if there are none.

    period: of each axis, (D,) m; 0 if the axis is not periodic. time: s, at which moving shapes are taken.
    """
    best = np.full(len(points), np.inf)
    for shape in shapes:
        offset = points - shape.anchor - shape.shift(time)
        turns = np.divide(offset, period, out=np.zeros_like(offset), where=period > 0)
        best = np.minimum(best, shape.gap(shape.anchor + offset - period * np.floor(turns + 0.5)))
    return best
