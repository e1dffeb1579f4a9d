"""Targets of agents: a point, a door (a segment) or a region (a box), as a record and as numbers for laws."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from flockenv.core.record import Record
from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import dot, norm, scale, select

__all__ = ["Target", "approach_side", "is_reached", "row_size", "side_of_door", "to_any", "to_target", "way_out"]

Floats = NDArray[np.float64]
Place = Annotated[tuple[Annotated[float, Field(strict=True)], ...], Field(min_length=2, max_length=3)]


class Target(Record):
    """A place to reach: a point `at`, a door between two `ends`, or a box `low` to `high`, enlarged by `radius`."""

    sentence: ClassVar[str] = "[the point {at}][the door between {ends}][the box from {low}][ to {high}]"

    at: Place | None = Field(default=None, description="m, a point")
    ends: tuple[Place, Place] | None = Field(default=None, description="m, the two ends of a door")
    low: Place | None = Field(default=None, description="m, lower corner of an axis-aligned box")
    high: Place | None = Field(default=None, description="m, upper corner of the box")
    radius: float = Field(default=0.0, ge=0, description="m, points within this distance belong to the target")

    @model_validator(mode="after")
    def _check_place(self) -> Target:
        """Raise ValueError unless exactly one of point, door and box is given, with valid numbers."""
        box = self.low is not None or self.high is not None
        if (self.at is not None) + (self.ends is not None) + box != 1 or (self.low is None) != (self.high is None):
            raise ValueError("at: give one of at, ends, or low and high")
        if len({len(place) for place in self._places}) != 1:
            raise ValueError(f"{self._word} = {self.points_text}: both must have the same number of coordinates")
        if self.ends is not None and self.ends[0] == self.ends[1]:
            raise ValueError(f"ends = {self.points_text}: is a point; give at")
        if box and any(a > b for a, b in zip(*self._places, strict=True)):
            raise ValueError(f"low = {self.low}: must not be above high = {self.high}")
        return self

    @property
    def _places(self) -> tuple[tuple[float, ...], ...]:
        """The points that define the target."""
        found = (self.at, *(self.ends or ()), self.low, self.high)
        return tuple(place for place in found if place is not None)

    @property
    def _word(self) -> str:
        """Names of the fields that define the target, for messages."""
        return "at" if self.at is not None else "ends" if self.ends is not None else "low, high"

    @property
    def points_text(self) -> str:
        """The points that define the target, as text for messages."""
        return ", ".join(str(place) for place in self._places)

    @property
    def place(self) -> dict[str, Any]:
        """The fields of `Target` itself, by name, without those of subclasses."""
        return {name: getattr(self, name) for name in Target.model_fields}

    @property
    def dimension(self) -> int:
        """Dimension of space, 2 or 3."""
        return len(self._places[0])

    @property
    def length(self) -> float:
        """Length of a door, m; 0 for other kinds of targets."""
        return float(np.linalg.norm(np.subtract(*self.ends))) if self.ends else 0.0

    @property
    def extremes(self) -> Floats:
        """The lower and the upper corner of the bounding box, (2, D) m."""
        places = np.array(self._places)
        return np.array([places.min(axis=0) - self.radius, places.max(axis=0) + self.radius])

    @property
    def row(self) -> list[float]:
        """Numbers for laws: first end (D), vector to the other end (D), half the edges (D), radius."""
        places = np.array(self._places)
        box, d = self.low is not None, self.dimension
        begin = places.mean(axis=0) if box else places[0]
        along = places[-1] - places[0] if self.ends else np.zeros(d)
        half = (places[1] - places[0]) / 2 if box else np.zeros(d)
        return [*begin, *along, *half, self.radius]

    def offset(self, points: ArrayLike) -> Floats:
        """Return the offset from points (..., D) to the nearest point of the target, (..., D) m; 0 inside."""
        x, d, row = np.asarray(points, np.float64), self.dimension, np.array(self.row)
        begin, along, half = row[:d], row[d : 2 * d], row[2 * d : 3 * d]
        to = begin - x
        if self.ends:
            share = np.clip(-(to @ along) / (along @ along), 0, 1)
            to = to + share[..., None] * along
        to = np.sign(to) * np.maximum(np.abs(to) - half, 0)
        if not self.radius:
            return np.asarray(to)
        far = np.linalg.norm(to, axis=-1, keepdims=True)
        return np.asarray(to * np.maximum(far - self.radius, 0) / np.where(far > 0, far, 1))

    def count(self, spacing: float) -> int:
        """Return the number of samples along the core, a point or a door: these come first in `samples`.

        spacing: m, at most, between samples.
        """
        return 1 + int(np.ceil(4 * self.length / spacing - 1e-9))

    def samples(self, spacing: float) -> Floats:
        """Return sample points (S, D) m: each point of the target is within about spacing / 2 of one."""
        d, row = self.dimension, np.array(self.row)
        core = row[:d] + np.linspace(0, 1, self.count(spacing))[:, None] * row[d : 2 * d]
        if self.low is None and not self.radius:
            return np.asarray(core)
        low, high = self.extremes
        axes = [np.linspace(a, b, 1 + int(np.ceil((b - a) / spacing - 1e-9))) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
        inside = np.linalg.norm(self.offset(grid), axis=1) <= 1e-9
        return np.concatenate([core, grid[inside]])


def row_size(dimension: int) -> int:
    """Return the length of a target's row.

    dimension: 2 or 3.
    """
    return 3 * dimension + 1


@law
def _excess(x: float, half: float) -> float:
    """Return x less the nearest number in [-half, half]; 0 inside."""
    return x - half if x > half else (x + half if x < -half else like(x, 0.0))


@law
def _shorten(offset: Vec, radius: float) -> Vec:
    """Return the offset shortened by `radius`; 0 if it is not longer than that."""
    length = norm(offset)
    return scale(offset, (length - radius) / length if length > radius else like(radius, 0.0))


@law
def _share(to_along: float, square: float) -> float:
    """Return the parameter, 0 to 1, of the nearest point along a door."""
    o, e = like(square, 0.0), like(square, 1.0)
    s = -to_along / square if square > o else o
    return o if s < o else (e if s > e else s)


@law
def to_target(table: Any, at: Any, x: Vec) -> Vec:
    """Return the offset from x to the nearest point of the target whose row begins at `at`; 0 inside.

    table: the numbers of the targets, rows of `Target.row`; x: m.
    """
    if len(x) == 2:
        a, b, u, v = table[at] - x[0], table[at + 1] - x[1], table[at + 2], table[at + 3]
        s = _share(a * u + b * v, u * u + v * v)
        to: Vec = (_excess(a + s * u, table[at + 4]), _excess(b + s * v, table[at + 5]))
        return _shorten(to, table[at + 6])
    else:
        a, b, c = table[at] - x[0], table[at + 1] - x[1], table[at + 2] - x[2]
        u, v, w = table[at + 3], table[at + 4], table[at + 5]
        s = _share(a * u + b * v + c * w, u * u + v * v + w * w)
        beyond = (_excess(a + s * u, table[at + 6]), _excess(b + s * v, table[at + 7]))
        to = beyond + (_excess(c + s * w, table[at + 8]),)  # noqa: RUF005  # numba joins tuples, but unpacks none
        return _shorten(to, table[at + 9])


@law
def to_any(table: Any, at: Any, count: Any, x: Vec) -> Vec:
    """Return the offset from x to the nearest of `count` targets whose rows begin at `at`.

    table: the numbers of the targets, rows of `Target.row`; x: m.
    """
    best = to_target(table, at, x)
    size = 3 * len(x) + 1
    for k in range(1, count):
        to = to_target(table, at + k * size, x)
        best = select(dot(to, to) < dot(best, best), to, best)
    return best


@law
def side_of_door(table: Any, at: Any, x: Vec) -> float:
    """Return a number, m^2, whose sign says on which side of the line through a door x lies; 0 for other targets.

    table: the numbers of the targets, rows of `Target.row`; at: where the row begins; x: m.
    """
    side: float = table[at + 2] * (x[1] - table[at + 1]) - table[at + 3] * (x[0] - table[at])
    return side


@law
def approach_side(table: Any, at: Any, side: float, x: Vec) -> float:
    """Return the side (see `side_of_door`) from which an agent at x approaches a door: 2-D.

    table: the numbers of the targets, rows of `Target.row`; at: where the row of the door begins; x: m.

    It is the side on which the agent was when it was last farther away than the door is long, so that it remains the
    same for an agent that passes beside the end of a door. side: the value so far, 0 if there is none.
    """
    to = to_target(table, at, x)
    anew = (side == like(side, 0.0)) | (dot(to, to) > _square(table, at))
    return side_of_door(table, at, x) if anew else side


@law
def is_reached(table: Any, at: Any, side: float, was: Vec, now: Vec) -> bool:
    """Return True if a move from `was` to `now` ends in the target whose row begins at `at`, or behind a door; 2-D.

    table: the numbers of the targets, rows of `Target.row`; side: the `approach_side` so far, 0 if there is none; was,
    now: m.

    A door is reached by crossing it from its `approach_side`, or beside its end to a place behind it, no farther from
    it than it is long; not by crossing it backwards.
    """
    to, square = to_target(table, at, now), _square(table, at)
    o = like(now[0], 0.0)
    before, after = side_of_door(table, at, was), side_of_door(table, at, now)
    part = before / (before - after) if before != after else o
    crossing = was[0] + part * (now[0] - was[0]), was[1] + part * (now[1] - was[1])
    across = (before * after <= o) & (before != after) & _is_beside(table, at, crossing) & (after * side <= o)
    behind = (after * side < o) & _is_beside(table, at, now) & (dot(to, to) <= square)
    there: bool = (dot(to, to) <= o) | ((square > o) & (across | behind))
    return there


@law
def _square(table: Any, at: Any) -> float:
    """Return the square of the length of a door, m^2; 0 for other targets."""
    square: float = table[at + 2] * table[at + 2] + table[at + 3] * table[at + 3]
    return square


@law
def _is_beside(table: Any, at: Any, x: Vec) -> bool:
    """Return True if the perpendicular from x to the line through a door ends on the door."""
    along = (x[0] - table[at]) * table[at + 2] + (x[1] - table[at + 1]) * table[at + 3]
    beside: bool = (along >= like(along, 0.0)) & (along <= _square(table, at))
    return beside


@law
def way_out(table: Any, at: Any, side: float, step: Vec) -> Vec:
    """Return the direction, of any length, in which an agent goes on that has reached a target with its last `step`.

    table: the numbers of the targets, rows of `Target.row`; at: where the row begins; side: the `approach_side` of the
    door, 0 if there is none; step: m.

    It is the direction of the step, or straight out of the door if the step led back to the approach side.
    """
    o, u, v = like(side, 0.0), table[at + 2], table[at + 3]
    back = side * (u * step[1] - v * step[0])
    out = (v, -u) if side > o else (-v, u)
    return select((back >= o) & (side != o), out, step)
