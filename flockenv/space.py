"""Space as two functions: offset(a, b), the way from a to b, and confine(x, v), where a body that left is put.

The shape of the world enters a simulation here and nowhere else; no other file takes a remainder.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from flockenv.kernels import Vec, law, like
from flockenv.records import Record
from flockenv.vec import sub

__all__ = ["AnySpace", "Box", "Plane", "Space", "Torus"]

Floats = NDArray[np.float64]
Size = Annotated[tuple[Annotated[float, Field(gt=0, allow_inf_nan=False)], ...], Field(min_length=2, max_length=3)]


@law
def plane_offset(size: Vec, a: Vec, b: Vec) -> Vec:
    """Return b - a."""
    return sub(b, a)


@law
def _shortest(d: float, length: float) -> float:
    # times the reciprocal, which is the same for all pairs: a division each would double the cost of a sweep
    return d - length * np.floor(d * (like(d, 1.0) / length) + like(d, 0.5))  # type: ignore[no-any-return]


@law
def torus_offset(size: Vec, a: Vec, b: Vec) -> Vec:
    """Return the shortest way from a to b (minimum image), right for any distance."""
    if len(a) == 2:
        return (_shortest(b[0] - a[0], size[0]), _shortest(b[1] - a[1], size[1]))
    else:
        return (
            _shortest(b[0] - a[0], size[0]),
            _shortest(b[1] - a[1], size[1]),
            _shortest(b[2] - a[2], size[2]),
        )


@law
def plane_confine(size: Vec, radius: float, x: Vec, v: Vec) -> tuple[Vec, Vec]:
    """Leave everybody where they are."""
    return x, v


@law
def _into(x: float, length: float) -> float:
    o = like(x, 0.0)
    inside = x - length * np.floor(x * (like(x, 1.0) / length))
    # (-1e-17) wraps to exactly `length` in floating point: that is 0
    inside = o if inside >= length or inside < o else inside
    # the last number below `length`, times 1 / length, may round to 1: who is inside stays where he is
    return x if (x >= o) & (x < length) else inside


@law
def torus_confine(size: Vec, radius: float, x: Vec, v: Vec) -> tuple[Vec, Vec]:
    """Bring x back into [0, size)."""
    if len(x) == 2:
        return (_into(x[0], size[0]), _into(x[1], size[1])), v
    else:
        return (_into(x[0], size[0]), _into(x[1], size[1]), _into(x[2], size[2])), v


@law
def _wall(x: float, v: float, radius: float, length: float) -> tuple[float, float]:
    o = like(x, 0.0)
    low = x < radius
    high = x > length - radius
    stopped = o if (low and v < o) or (high and v > o) else v
    return (radius if low else (length - radius if high else x)), stopped


@law
def box_confine(size: Vec, radius: float, x: Vec, v: Vec) -> tuple[Vec, Vec]:
    """Keep a body of this radius inside the walls; the part of its velocity into a wall is lost there."""
    x0, v0 = _wall(x[0], v[0], radius, size[0])
    x1, v1 = _wall(x[1], v[1], radius, size[1])
    if len(x) == 2:
        return (x0, x1), (v0, v1)
    else:
        x2, v2 = _wall(x[2], v[2], radius, size[2])
        return (x0, x1, x2), (v0, v1, v2)


class Space(Record):
    """Where agents live."""

    kind: str
    offset_law: ClassVar[str]
    confine_law: ClassVar[str]
    periodic: ClassVar[bool] = False

    def extent(self, dimension: int) -> tuple[float, ...]:
        """Return the size that the laws are given, m per axis; 1 where there is none."""
        size: tuple[float, ...] | None = getattr(self, "size", None)
        return size if size is not None else (1.0,) * dimension

    def displacement(self, a: ArrayLike, b: ArrayLike) -> Floats:
        """Return the way from a to b, (..., D) m, over arrays: for code that is not in a kernel."""
        return np.asarray(np.asarray(b, float) - np.asarray(a, float))

    def wrap(self, x: ArrayLike) -> Floats:
        """Return positions (..., D) m brought back into the space: for code that is not in a kernel."""
        return np.asarray(x, np.float64)


class Plane(Space):
    """Unbounded flat space, 2-D or 3-D."""

    kind: Literal["plane"] = "plane"
    offset_law: ClassVar[str] = "plane_offset"
    confine_law: ClassVar[str] = "plane_confine"


class Torus(Space):
    """A periodic box [0, size): who leaves on one side enters on the other."""

    kind: Literal["torus"] = "torus"
    size: Size = Field(description="m per axis")
    offset_law: ClassVar[str] = "torus_offset"
    confine_law: ClassVar[str] = "torus_confine"
    periodic: ClassVar[bool] = True

    def displacement(self, a: ArrayLike, b: ArrayLike) -> Floats:
        """Return the shortest way from a to b, (..., D) m."""
        d, size = super().displacement(a, b), np.asarray(self.size)
        return np.asarray(d - size * np.floor(d / size + 0.5))

    def wrap(self, x: ArrayLike) -> Floats:
        """Return positions in [0, size)."""
        size = np.asarray(self.size)
        inside = super().wrap(x)
        inside = inside - size * np.floor(inside / size)
        return np.where((inside >= size) | (inside < 0), 0.0, inside)


class Box(Space):
    """A box [0, size] with walls: bodies stop at them."""

    kind: Literal["box"] = "box"
    size: Size = Field(description="m per axis")
    offset_law: ClassVar[str] = "plane_offset"
    confine_law: ClassVar[str] = "box_confine"

    def wrap(self, x: ArrayLike) -> Floats:
        """Return positions moved to the nearest point inside."""
        return np.asarray(np.clip(super().wrap(x), 0.0, np.asarray(self.size)))


AnySpace = Annotated[Plane | Torus | Box, Field(discriminator="kind")]
