"""Vectors as tuples of two or three floats, for laws.

numba prunes the branch of the other dimension at compile time, and LLVM keeps the numbers in registers, so a law
written with these functions is as fast as hand-written scalar code.
"""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like, unfused

__all__ = [
    "add",
    "axis",
    "cross",
    "dot",
    "equal_coordinates",
    "exact_dot",
    "exact_sum",
    "lateral",
    "limit",
    "norm",
    "opposite",
    "perpendicular",
    "planar",
    "scale",
    "select",
    "sub",
    "unit",
    "zero",
]


@law
def add(a: Vec, b: Vec) -> Vec:
    """Return a + b."""
    if len(a) == 2:
        return (a[0] + b[0], a[1] + b[1])
    else:
        return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@law
def sub(a: Vec, b: Vec) -> Vec:
    """Return a - b."""
    if len(a) == 2:
        return (a[0] - b[0], a[1] - b[1])
    else:
        return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@law
def scale(a: Vec, s: float) -> Vec:
    """Return s a."""
    if len(a) == 2:
        return (a[0] * s, a[1] * s)
    else:
        return (a[0] * s, a[1] * s, a[2] * s)


@law
def dot(a: Vec, b: Vec) -> float:
    """Return a . b."""
    if len(a) == 2:
        return a[0] * b[0] + a[1] * b[1]
    else:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@law
def zero(a: Vec) -> Vec:
    """Return the zero vector of a's dimension and precision."""
    o = like(a[0], 0.0)
    if len(a) == 2:
        return (o, o)
    else:
        return (o, o, o)


@law
def equal_coordinates(x: Vec, length: float) -> Vec:
    """Return the vector of x's dimension whose coordinates are all `length`."""
    if len(x) == 2:
        return (length, length)
    else:
        return (length, length, length)


@law
def _pair(condition: bool, a: float, b: float, c: float, d: float) -> Vec:
    return (a if condition else c, b if condition else d)


@law
def select(condition: bool, a: Vec, b: Vec) -> Vec:
    """Return a if the condition holds, else b, without a branch; for tuples of 2 to 5."""
    if len(a) == 2:
        return (a[0] if condition else b[0], a[1] if condition else b[1])
    elif len(a) == 3:
        return (a[0] if condition else b[0], a[1] if condition else b[1], a[2] if condition else b[2])
    elif len(a) == 4:  # unrolled: a recursive law becomes a dangling call when numba's disk cache loads it
        return _pair(condition, a[0], a[1], b[0], b[1]) + _pair(condition, a[2], a[3], b[2], b[3])
    else:
        first = (a[0] if condition else b[0], a[1] if condition else b[1], a[2] if condition else b[2])
        return first + _pair(condition, a[3], a[4], b[3], b[4])


@law
def opposite(a: Vec) -> Vec:
    """Return -a."""
    if len(a) == 2:
        return (-a[0], -a[1])
    else:
        return (-a[0], -a[1], -a[2])


@law
def planar(a: Vec, x: float, y: float) -> Vec:
    """Return (x, y) in the dimension of a: with z = 0 in 3-D."""
    if len(a) == 2:
        return (x, y)
    else:
        return (x, y, like(x, 0.0))


@unfused
def exact_dot(a: Vec, b: Vec) -> float:
    """Return a . b with each operation rounded: bit-identical in every loop, so that distances compare equal."""
    if len(a) == 2:
        return a[0] * b[0] + a[1] * b[1]
    else:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@unfused
def exact_sum(a: float, b: float) -> float:
    """Return a + b, never fused with a product in b: bit-identical in every loop."""
    return a + b


@law
def norm(a: Vec) -> float:
    """Return |a|."""
    return np.sqrt(dot(a, a))  # type: ignore[no-any-return]  # np.sqrt keeps float32, math.sqrt does not


@law
def unit(a: Vec) -> Vec:
    """Return a/|a|, and 0 for a = 0 (anything whose square underflows counts as 0)."""
    square = dot(a, a)
    some = square > like(square, 0.0)
    return scale(a, like(square, 1.0) / np.sqrt(square) if some else like(square, 0.0))


@law
def limit(a: Vec, longest: float) -> Vec:
    """Return a, shortened to `longest` if it is longer: trunc(a, M) = a min(1, M/|a|)."""
    square = dot(a, a)
    over = square > longest * longest
    return scale(a, longest / np.sqrt(square) if over else like(square, 1.0))


@law
def cross(a: Vec, b: Vec) -> Vec:
    """Return a x b, in 3-D."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@law
def lateral(a: Vec, forward: Vec) -> Vec:
    """Return the component of a perpendicular to the unit vector `forward`."""
    return sub(a, scale(forward, dot(a, forward)))


@law
def axis(a: Vec, k: int) -> Vec:
    """Return the k-th unit vector in a's dimension and precision."""
    o, e = like(a[0], 0.0), like(a[0], 1.0)
    if len(a) == 2:
        return (e if k == 0 else o, e if k == 1 else o)
    else:
        return (e if k == 0 else o, e if k == 1 else o, e if k == 2 else o)


@law
def perpendicular(forward: Vec) -> Vec:
    """Return a unit vector perpendicular to `forward`: to its right; horizontal in 3-D (the x axis if it is vertical).

    All agents that must choose a side choose this one, so two agents that meet head-on both keep right.
    """
    if len(forward) == 2:
        side: Vec = (forward[1], -forward[0])
        return select(dot(side, side) > like(forward[0], 0.0), unit(side), axis(forward, 0))
    else:
        side = (forward[1], -forward[0], like(forward[0], 0.0))
        upright = dot(side, side) <= like(forward[0], 1e-12)
        return select(upright, axis(forward, 0), unit(side))
