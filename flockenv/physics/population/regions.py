"""Places of births: a point, a line, a disc or ball, a box, the surface of a shape, a clearing in a crowd."""

from __future__ import annotations

import functools
import math
import operator
from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WrapValidator, model_validator

from flockenv.core.record import Record, instance_of
from flockenv.geometry.shapes import AnyShape
from flockenv.model.scene_view import SceneView
from flockenv.physics.population.members import check_dimensions
from flockenv.physics.population.surface import pieces

__all__ = ["PLACES", "AnyPlace", "BoxPlace", "Clearing", "Disc", "Place", "Point", "Segment", "Surface"]

Floats = NDArray[np.float64]
Vector = Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]


def three_numbers(vector: Sequence[float]) -> list[float]:
    """Return a vector with three numbers: the third is 0 in 2-D."""
    return [*vector, *[0.0] * (3 - len(vector))]


class Place(Record):
    """Base class of places of births, which are uniform over all points."""

    kind: str
    code: ClassVar[int]
    """Number of this kind in kernels."""

    @abstractmethod
    def row(self) -> list[float]:
        """Return the numbers of the place for births.py."""

    @property
    @abstractmethod
    def extremes(self) -> Floats:
        """Points whose bounding box contains the place, (n, D) m."""

    def pieces(self) -> Floats:
        """Return the pieces of a surface, (n, 14); see surface.py."""
        return np.zeros((0, 14))

    def check(self, scene: SceneView) -> None:
        """Raise ValueError, beginning with the field's name, if the scene does not suit this place."""


class Point(Place):
    """A point, as a place of births."""

    kind: Literal["point"] = "point"
    code: ClassVar[int] = 0
    at: Vector = Field(description="m")

    def row(self) -> list[float]:
        """Return the point twice, as the ends of a segment."""
        return three_numbers(self.at) * 2

    @property
    def extremes(self) -> Floats:
        """The point itself."""
        return np.array([self.at])

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the dimension is not the scene's."""
        check_dimensions(scene, at=self.at)


class Segment(Place):
    """A straight line from start to end."""

    kind: Literal["segment"] = "segment"
    code: ClassVar[int] = 1
    start: Vector = Field(description="m")
    end: Vector = Field(description="m")

    def row(self) -> list[float]:
        """Return both ends."""
        return three_numbers(self.start) + three_numbers(self.end)

    @property
    def extremes(self) -> Floats:
        """Both ends."""
        return np.array([self.start, self.end])

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the dimension is not the scene's."""
        check_dimensions(scene, start=self.start, end=self.end)


class Disc(Place):
    """A disc; in 3-D a ball, or with an axis the flat disc perpendicular to it."""

    kind: Literal["disc"] = "disc"
    code: ClassVar[int] = 2
    centre: Vector = Field(description="m")
    radius: float = Field(gt=0, description="m")
    axis: Vector | None = Field(default=None, description="in 3-D: normal of the flat disc (default: a ball)")

    @model_validator(mode="after")
    def _check_axis(self) -> Disc:
        if self.axis is not None and not math.hypot(*self.axis) > 0:
            raise ValueError(f"axis = {self.axis}: must be a direction, not all 0")
        return self

    def row(self) -> list[float]:
        """Return centre, radius and axis."""
        length = math.hypot(*self.axis) if self.axis is not None else 1.0
        return [*three_numbers(self.centre), self.radius, *(x / length for x in self.axis or (0.0, 0.0, 0.0))]

    @property
    def extremes(self) -> Floats:
        """The corners of its bounding box."""
        return np.array(self.centre) + self.radius * np.array([[-1.0], [1.0]])

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the dimension is not the scene's."""
        check_dimensions(scene, centre=self.centre, axis=self.axis)
        if self.axis is not None and scene.dimension == 2:
            raise ValueError(f"axis = {self.axis}: only a disc in 3-D has an axis")


class _Corners(Place):
    """Base class of places that have the shape of a box."""

    low: Vector = Field(description="m, lower corner")
    high: Vector = Field(description="m, upper corner")

    @model_validator(mode="after")
    def _check_order(self) -> _Corners:
        """Raise ValueError if the corners are not in order."""
        check_corners(self.low, self.high)
        return self

    def row(self) -> list[float]:
        """Return both corners."""
        return three_numbers(self.low) + three_numbers(self.high)

    @property
    def extremes(self) -> Floats:
        """Both corners."""
        return np.array([self.low, self.high])

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the dimension is not the scene's."""
        check_dimensions(scene, low=self.low, high=self.high)


class BoxPlace(_Corners):
    """An axis-aligned box."""

    kind: Literal["box"] = "box"
    code: ClassVar[int] = 3


class Surface(Place):
    """The surface of a shape; agents without a direction start along its outward normal."""

    kind: Literal["surface"] = "surface"
    code: ClassVar[int] = 4
    shape: AnyShape = Field(description="a shape, with the fields of an obstacle")

    def row(self) -> list[float]:
        """Return no numbers, as the pieces describe the surface."""
        return []

    @property
    def extremes(self) -> Floats:
        """The extremes of the shape."""
        return np.asarray(self.shape.extremes)

    def pieces(self) -> Floats:
        """Return the pieces of the surface."""
        return pieces(self.shape)

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the dimension is not the scene's, or the shape moves, is hollow or is unbounded."""
        if self.shape.dimension != scene.dimension:
            raise ValueError(
                f"shape.kind = {self.shape.kind}: lies in {self.shape.dimension} dimensions, "
                f"but dimension = {scene.dimension}"
            )
        if self.shape.moves:
            raise ValueError(f"shape.kind = {self.shape.kind}: moves, but a place of births must be fixed")
        self.pieces()


class Clearing(_Corners):
    """A clearing in a box: the point with the fewest living agents around it, of some drawn at random."""

    kind: Literal["clearing"] = "clearing"
    code: ClassVar[int] = 5
    radius: float = Field(gt=0, description="m, radius within which neighbours count")
    candidates: int = Field(default=8, ge=1, le=64, description="number of points that are drawn for each birth")

    def row(self) -> list[float]:
        """Return the corners, the radius and the number of draws."""
        return [*super().row(), self.radius, float(self.candidates)]


def check_corners(low: Sequence[float], high: Sequence[float]) -> None:
    """Raise ValueError if the lower corner is not below the upper one, or their lengths differ."""
    if len(low) != len(high) or any(a > b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"low = {low}, high = {high}: the lower corner comes first, and both have as many numbers")


PLACES: dict[str, type[Place]] = {
    str(place.model_fields["kind"].default): place for place in (Point, Segment, Disc, BoxPlace, Surface, Clearing)
}
"""Every place by its kind."""

if TYPE_CHECKING:
    AnyPlace = Place
else:
    AnyPlace = Annotated[
        Annotated[functools.reduce(operator.or_, PLACES.values()), Field(discriminator="kind")],
        WrapValidator(instance_of(Place)),
    ]
