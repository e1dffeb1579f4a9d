"""Space as two laws: offset(a, b), the vector from a to b, and confine(x, v), which moves bodies back inside.

If bodies bounce, there is a third: bounce(...) returns the end of a step with impacts on walls.

The topology of the world enters a simulation only here: no other file wraps positions.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from flockenv.core.record import Record
from flockenv.jit.decorators import Law, Vec, finite, law, like
from flockenv.maths.approximations import round_half_even
from flockenv.maths.vectors import sub

__all__ = ["AnySpace", "Box", "Plane", "Space", "Torus"]

Floats = NDArray[np.float64]
Size = Annotated[tuple[Annotated[float, Field(gt=0, allow_inf_nan=False)], ...], Field(min_length=2, max_length=3)]

BOUNCES = 100
"""Most impacts per step on the walls across one axis; a body with more stops at the wall."""


@law
def _plane_offset(size: Vec, a: Vec, b: Vec) -> Vec:
    """Return b - a."""
    return sub(b, a)


@law
def _shortest(d: float, length: float) -> float:
    # times the reciprocal, which is the same for all pairs: a division per pair would double the cost of the pair loop
    return d - length * round_half_even(d * (like(d, 1.0) / length))


@law
def _torus_offset(size: Vec, a: Vec, b: Vec) -> Vec:
    """Return the shortest offset from a to b (minimum image), for points any number of boxes apart.

    For two points exactly half a box apart, the offsets a to b and b to a are opposite.
    """
    if len(a) == 2:
        return (_shortest(b[0] - a[0], size[0]), _shortest(b[1] - a[1], size[1]))
    else:
        return (
            _shortest(b[0] - a[0], size[0]),
            _shortest(b[1] - a[1], size[1]),
            _shortest(b[2] - a[2], size[2]),
        )


@law
def _plane_confine(size: Vec, radius: float, x: Vec, v: Vec) -> tuple[Vec, Vec]:
    """Return x and v unchanged."""
    return x, v


@law
def _wrap(x: float, length: float) -> float:
    o = like(x, 0.0)
    inside = x - length * np.floor(x * (like(x, 1.0) / length))
    # (-1e-17) wraps to exactly `length` in floating point, which is set to 0
    inside = o if inside >= length or inside < o else inside
    # the largest number below `length`, times 1 / length, may round to 1: a position inside is returned unchanged
    return x if (x >= o) & (x < length) else inside


@law
def torus_confine(size: Vec, radius: float, x: Vec, v: Vec) -> tuple[Vec, Vec]:
    """Return x wrapped into [0, size), and v unchanged."""
    if len(x) == 2:
        return (_wrap(x[0], size[0]), _wrap(x[1], size[1])), v
    else:
        return (_wrap(x[0], size[0]), _wrap(x[1], size[1]), _wrap(x[2], size[2])), v


@law
def _stop_at_wall(x: float, v: float, radius: float, length: float) -> tuple[float, float]:
    o = like(x, 0.0)
    low = x < radius
    high = x > length - radius
    stopped = o if (low and v < o) or (high and v > o) else v
    return (radius if low else (length - radius if high else x)), stopped


@law
def _box_confine(size: Vec, radius: float, x: Vec, v: Vec) -> tuple[Vec, Vec]:
    """Return position and velocity of a body inside the walls; at a wall the velocity into it is removed."""
    x0, v0 = _stop_at_wall(x[0], v[0], radius, size[0])
    x1, v1 = _stop_at_wall(x[1], v[1], radius, size[1])
    if len(x) == 2:
        return (x0, x1), (v0, v1)
    else:
        x2, v2 = _stop_at_wall(x[2], v[2], radius, size[2])
        return (x0, x1, x2), (v0, v1, v2)


@law
def _impact(gap: float, away: float, push: float) -> tuple[float, float]:
    """Return the time at which a body reaches a wall, s (inf if never), and its speed then.

    Its distance is gap + away t + push t^2 / 2. Each root is computed without cancellation.
    """
    o, never = like(gap, 0.0), like(gap, np.inf)
    square = away * away - like(gap, 2.0) * push * gap
    speed = np.sqrt(max(square, o))
    comes = like(gap, 2.0) * gap / (speed - away)
    returns = (away + speed) / -push
    later = returns if push < o else never
    return (comes if square >= o else never) if away < o else later, speed


@law
def _flight(dt: float, was: float, before: float, x: float, v: float) -> tuple[float, float, float]:
    """Return initial velocity and acceleration of a step's parabola, and the method's v less that of the parabola.

    The parabola goes from `was` to x in a step over which velocity changed from `before` to v. The velocity of a
    first-order method is half a step ahead or behind, but under a constant force its points do lie on a parabola.
    """
    half = like(x, 0.5)
    a = (v - before) / dt
    moved = x - was
    excess = v - moved / dt - half * a * dt
    rounding = like(x, 4.0) * np.spacing(max(abs(x), abs(was)))
    excess = like(x, 0.0) if abs(excess) * dt <= rounding else excess
    return before - excess, a, excess


@law
def _bounce(
    radius: float, length: float, restitution: float, dt: float, was: float, before: float, x: float, v: float
) -> tuple[float, float]:
    """Return position and velocity along one axis after a step with impacts; each keeps `restitution` of the speed.

    If all further bounces (a geometric series) end within the step, the body is at rest at their end; so a body that
    rests at a wall needs one iteration instead of BOUNCES.
    """
    o, half = like(x, 0.0), like(x, 0.5)
    low, high = radius, length - radius
    speed, a, excess = _flight(dt, was, before, x, v)
    # a body resting at a wall starts at rest, although the velocity of a first-order method is off by half a step
    speed = o if (before == o) & ((was == low) | (was == high)) else speed
    at, left, hit = was, dt, False
    for bounce in range(BOUNCES):
        fall, down = _impact(at - low, speed, a)
        rise, up = _impact(high - at, -speed, -a)
        below = fall <= rise
        seconds = fall if below else rise
        if not seconds < left:
            break
        hit = True
        left -= seconds
        at, into = low if below else high, -a if below else a
        away = restitution * (down if below else up)
        ends = like(x, 2.0) * away <= into * (like(x, 1.0) - restitution) * left
        rests = (bounce == BOUNCES - 1) | ((into > o) & ends)
        speed = o if rests else (away if below else -away)
        a, excess = o if rests else a, o if rests else excess
    end = at + (speed + half * a * left) * left if hit else x
    # NaN, if squares overflow: at a wall, at rest
    inside = low if not end >= low else (high if end > high else end)
    then = speed + a * left + excess if hit else v
    return inside, then if finite(then) else o


@law
def _bounce_or_stop(
    size: float, radius: float, restitution: float, dt: float, was: float, before: float, x: float, v: float
) -> tuple[float, float]:
    """Return position and velocity along one axis of `_box_bounce`."""
    if was < radius or was > size - radius:
        return _stop_at_wall(x, v, radius, size)
    else:
        return _bounce(radius, size, restitution, dt, was, before, x, v)


@law
def _box_bounce(
    size: Vec, radius: float, restitution: float, dt: float, was: Vec, before: Vec, x: Vec, v: Vec
) -> tuple[Vec, Vec]:
    """Return position and velocity after a step from `was` to x, over which velocity changed from `before` to v.

    It is exact under a constant force, axis by axis. A body that was outside is moved to the wall.
    """
    x0, v0 = _bounce_or_stop(size[0], radius, restitution, dt, was[0], before[0], x[0], v[0])
    x1, v1 = _bounce_or_stop(size[1], radius, restitution, dt, was[1], before[1], x[1], v[1])
    if len(x) == 2:
        return (x0, x1), (v0, v1)
    else:
        x2, v2 = _bounce_or_stop(size[2], radius, restitution, dt, was[2], before[2], x[2], v[2])
        return (x0, x1, x2), (v0, v1, v2)


class Space(Record):
    """The space in which agents move."""

    kind: str
    offset_law: ClassVar[Law]
    """(size, a, b) -> the offset from a to b, m, with the `size` that `extent` returns."""
    confine_law: ClassVar[Law]
    """(size, radius, x, v) -> position, m, and velocity, m/s, of a body of this radius, m, back inside the space."""
    bounce_law: ClassVar[Law | None] = None
    periodic: ClassVar[bool] = False

    def extent(self, dimension: int) -> tuple[float, ...]:
        """Return the size passed to the laws, m per axis; 1 for a space without size.

        dimension: 2 or 3.
        """
        size: tuple[float, ...] | None = getattr(self, "size", None)
        return size if size is not None else (1.0,) * dimension

    def numbers(self) -> tuple[float, ...]:
        """Return the numbers, besides the size, that are passed to the bounce law."""
        return ()

    def displacement(self, a: ArrayLike, b: ArrayLike) -> Floats:
        """Return the offset from a to b, (..., D) m, of arrays outside kernels."""
        return np.asarray(np.asarray(b, float) - np.asarray(a, float))

    def wrap(self, x: ArrayLike) -> Floats:
        """Return positions (..., D) m moved back into the space, of arrays outside kernels.

        x: (..., D) m.
        """
        return np.asarray(x, np.float64)


class Plane(Space):
    """Unbounded flat space, 2-D or 3-D."""

    kind: Literal["plane"] = "plane"
    sentence: ClassVar[str] = "An unbounded space"
    offset_law: ClassVar[Law] = _plane_offset
    confine_law: ClassVar[Law] = _plane_confine


class Torus(Space):
    """A periodic box [0, size): an agent that leaves on one side enters on the other."""

    kind: Literal["torus"] = "torus"
    sentence: ClassVar[str] = "A torus of {size}, which agents leave on one side and enter on the other"
    size: Size = Field(description="m per axis")
    offset_law: ClassVar[Law] = _torus_offset
    confine_law: ClassVar[Law] = torus_confine
    periodic: ClassVar[bool] = True

    def displacement(self, a: ArrayLike, b: ArrayLike) -> Floats:
        """Return the shortest offset from a to b, (..., D) m."""
        d, size = super().displacement(a, b), np.asarray(self.size)
        return np.asarray(d - size * np.rint(d / size))

    def wrap(self, x: ArrayLike) -> Floats:
        """Return positions in [0, size)."""
        size = np.asarray(self.size)
        inside = super().wrap(x)
        inside = inside - size * np.floor(inside / size)
        return np.where((inside >= size) | (inside < 0), 0.0, inside)


class Box(Space):
    """A box [0, size] with walls at which bodies stop or bounce.

    Restitution e is the normal speed after over that before an impact; the tangential velocity does not change. Impacts
    are located within a step: exactly under a constant force, for every method; otherwise as if the force were constant
    during the step. A ball dropped from height h rises to e^(2n) h after n bounces, and is at rest after
    sqrt(2 h / g) (1 + e) / (1 - e). A body that would bounce more than 100 times in one step stops.
    """

    kind: Literal["box"] = "box"
    sentence: ClassVar[str] = "A box of {size}, at whose walls bodies stop or bounce"
    size: Size = Field(description="m per axis")
    restitution: float = Field(
        default=0.0, ge=0, le=1, description="e: 0 = bodies stop at a wall, 1 = no speed is lost"
    )
    offset_law: ClassVar[Law] = _plane_offset
    confine_law: ClassVar[Law] = _box_confine

    @property
    def bounce_law(self) -> Law | None:  # type: ignore[override]  # not compiled if bodies do not bounce
        """The law of impacts; None if bodies stop at walls."""
        return _box_bounce if self.restitution > 0 else None

    def numbers(self) -> tuple[float, ...]:
        """Return the restitution, if it is not 0."""
        return (self.restitution,) if self.bounce_law else ()

    def wrap(self, x: ArrayLike) -> Floats:
        """Return positions moved to the nearest point inside."""
        return np.asarray(np.clip(super().wrap(x), 0.0, np.asarray(self.size)))


AnySpace = Annotated[Plane | Torus | Box, Field(discriminator="kind")]
"""A space of any kind, as a field of a record: read from a file, its `kind` selects the class."""
