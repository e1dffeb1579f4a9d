"""The base classes of obstacles: motion, bounds, distance to the surface, its normal, and ray casts.

The methods of a moving obstacle apply to the position given by its fields; `shift` returns its displacement at a time.
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from flockenv.core.record import Record
from flockenv.geometry.shapes import outlines, table
from flockenv.geometry.shapes.table import Floats, hits, nearest

__all__ = ["Bound", "Closed", "Point", "Shape", "Sway"]

Point = Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]


class Sway(Record):
    """Oscillation: amplitude sin(2 pi t / period + phase), added to any other motion."""

    amplitude: Point = Field(description="m, greatest displacement, a vector")
    period: float = Field(gt=0, description="s, of one oscillation")
    phase: float = Field(default=0.0, description="rad, at time 0")


class Bound(NamedTuple):
    """Bounds of a shape at the position given by its fields; all except the centre are infinite if it is unbounded."""

    centre: Floats  # (D,) m, of the bounding box
    half: Floats  # (D,) m, half the edges of the axis-aligned box
    radius: float  # m, of the bounding circle or sphere around the centre


class Shape(Record):
    """Base class of obstacles. Points are (..., D) arrays in m."""

    kind: str
    velocity: Point | None = Field(default=None, description="m/s, constant from time 0 on (default: it does not move)")
    sway: Sway | None = Field(default=None, description="oscillation (default: none)")
    points: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that are points, or lists of points, of which all move with the shape."""
    laws: ClassVar[str] = "chain"
    """Name of the laws if the shape is solid; see shapes/table.py."""

    @model_validator(mode="after")
    def _check_motion(self) -> Self:
        """Raise ValueError if velocity or sway do not have the shape's dimension."""
        swaying = self.sway.amplitude if self.sway else None
        for name, value in (("velocity", self.velocity), ("sway.amplitude", swaying)):
            if value is not None and len(value) != self.dimension:
                raise ValueError(f"{name} = {value}: must have {self.dimension} numbers, as the {self.kind} has")
        return self

    def moved_to(self, place: Sequence[float]) -> Self:
        """Return the shape with its anchor at another place, (D,) m; raise ValueError if it cannot be moved."""
        if not self.points:
            raise ValueError(f"kind = {self.kind}: cannot be moved; give its other fields")
        if len(place) != self.dimension:
            raise ValueError(f"centre = {tuple(place)}: must have {self.dimension} numbers, as the {self.kind} has")
        by = np.subtract(place, self.anchor)

        def shifted(value: Any) -> Any:
            if isinstance(value[0], tuple):
                return tuple(map(shifted, value))
            return tuple((np.array(value, float) + by).tolist())

        return self.model_copy(update={name: shifted(getattr(self, name)) for name in self.points})

    @property
    def is_hollow(self) -> bool:
        """True if the shape is free inside and solid outside."""
        return False

    @property
    def thickness(self) -> float:
        """Lower bound of the least thickness, m: 0 for a line or if unknown."""
        return math.inf if self.is_hollow else self._thickness

    @property
    def _thickness(self) -> float:
        return 0.0

    @property
    def form(self) -> str:
        """Name of the form, which selects the laws; see shapes/table.py."""
        return f"hollow_{self.laws}" if self.is_hollow else self.laws

    @property
    def in_state(self) -> bool:
        """True if it is a circle or sphere kept in the state; every other shape is the same in all worlds."""
        return False

    @property
    def moves(self) -> bool:
        """True if the shape has a velocity or a sway."""
        return any(self.velocity or ()) or (self.sway is not None and any(self.sway.amplitude))

    @property
    def motion(self) -> list[float]:
        """Motion, as laws read it: velocity (D), amplitude of the sway (D), 2 pi / period, phase."""
        still = (0.0,) * self.dimension
        sway = (*self.sway.amplitude, math.tau / self.sway.period, self.sway.phase) if self.sway else (*still, 0.0, 0.0)
        return [*(self.velocity or still), *sway]

    def shift(self, time: float) -> Floats:
        """Return the displacement at a time, s, in (D,) m: v t + a sin(2 pi t / T + phase)."""
        d, motion = self.dimension, np.array(self.motion)
        return np.asarray(motion[:d] * time + motion[d:-2] * math.sin(motion[-2] * time + motion[-1]))

    @property
    def dimension(self) -> int:
        """Dimension of space, 2 or 3."""
        return len(self.anchor)

    @functools.cached_property
    def table(self) -> Floats:
        """The table of this shape alone, for laws."""
        return table.pack_shapes([self], self.dimension)[0]

    @functools.cached_property
    def bound(self) -> Bound:
        """Bounds of the solid; infinite if the shape is hollow, as the solid is outside."""
        extremes, (corners, around) = self.extremes, self.corners
        if self.is_hollow or not len(extremes):
            return Bound(np.array(self.anchor), np.full(self.dimension, np.inf), math.inf)
        low, high = extremes.min(axis=0), extremes.max(axis=0)
        middle = (low + high) / 2
        return Bound(middle, (high - low) / 2, around + float(np.linalg.norm(corners - middle, axis=1).max()))

    @property
    def corners(self) -> tuple[Floats, float]:
        """Points (n, D) m and a radius, m: circles there have the same hull; n = 0 for some shapes."""
        return np.zeros((0, self.dimension)), 0.0

    @property
    @abstractmethod
    def anchor(self) -> tuple[float, ...]:
        """The point that laws take positions relative to, m."""

    @property
    @abstractmethod
    def extremes(self) -> Floats:
        """Points (n, D) m whose bounding box contains the shape; None if it is unbounded."""

    @property
    def reference_points(self) -> Floats:
        """Points (n, D) m by whose coordinates distances are computed: these round as the largest coordinate does."""
        return self.extremes

    @abstractmethod
    def row(self, dimension: int) -> Sequence[float] | Floats:
        """Return the numbers of the form, which follow the row header.

        dimension: 2 or 3.
        """

    @abstractmethod
    def polygons(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the polygons, each (n, 2) m, of the solid in a region, as seen from above.

        low, high: (2,) m, corners of the region.
        """

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the polygons, each (n, 2) m, of the shape in a region from above; only its edge if it is hollow.

        low, high: (2,) m, corners of the region.
        """
        whole = self.polygons(low, high)
        return [outlines.band(each, 0.004 * float((high - low).max())) for each in whole] if self.is_hollow else whole

    def gap(self, points: ArrayLike) -> Floats:
        """Return the distances of points to the surface, (...) m; negative in the solid."""
        return nearest(self, points)[0]

    def normal(self, points: ArrayLike) -> Floats:
        """Return the unit normal out of the solid at the nearest point of the surface, (..., D).

        points: (..., D) m.
        """
        return nearest(self, points)[1]

    def nearest(self, points: ArrayLike) -> Floats:
        """Return the nearest point of the surface, (..., D) m.

        points: (..., D) m.
        """
        gap, normal = nearest(self, points)
        return np.asarray(points, float) - gap[..., None] * normal

    def inside(self, points: ArrayLike) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Return True for each point inside the shape, (...) bool.

        points: (..., D) m.
        """
        return np.asarray(self.gap(points) < 0)

    def hit(self, points: ArrayLike, directions: ArrayLike, clearance: ArrayLike = 0.0) -> Floats:
        """Return the distance along unit directions at which a body of radius `clearance` touches, (...) m, or inf.

        points: (..., D) m, where the rays begin; directions: (..., D) unit vectors; clearance: m.

        It is exact at every angle, as the ray is cast at the shape inflated by the body's radius.
        """
        return hits(self, points, directions, clearance)

    def silhouette(self, point: ArrayLike, clearance: float = 0.0) -> tuple[Floats, Floats]:
        """Return the left and right ends of the silhouette as seen from a point outside, m; 2-D only.

        The shape is inflated by `clearance`: a body that aims at an end passes it (Reynolds 1987). Raises ValueError if
        there are no ends.
        """
        return outlines.silhouette(self, np.asarray(point, float), clearance)


class Closed(Shape):
    """A shape with an inside, which may be solid or free."""

    hollow: bool = Field(default=False, description="free inside and solid outside; bodies stay inside")

    @property
    def is_hollow(self) -> bool:
        """True if the shape is free inside and solid outside."""
        return self.hollow
