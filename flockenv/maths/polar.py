"""The rotation that is nearest to a matrix, for any matrix: also one that is singular or turns space inside out.

Matrices are tuples of their columns, of 2 or 3 vectors. The rotation R of F maximises tr(R' F) and minimises |F - R|
over all rotations, det R = 1: the polar decomposition F = R S, in which S has one negative eigenvalue, the one of least
size, if det F < 0 (Irving, Teran & Fedkiw 2004, Invertible finite elements, 4).
"""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, axis, cross, dot, lateral, opposite, perpendicular, scale, select, sub, unit

__all__ = ["nearest_rotation"]

Matrix = tuple[Vec, ...]

_Pair = tuple[Vec, Vec, Vec, Vec]


@law
def _orthogonal(a: Vec, b: Vec, u: Vec, v: Vec) -> _Pair:
    """Return two columns of F V, rotated until they are orthogonal, and those of V, rotated likewise.

    Source: Hestenes 1958, Inversion of matrices by biorthogonalization; the smaller angle (Rutishauser 1966).
    """
    o, e, two = like(a[0], 0.0), like(a[0], 1.0), like(a[0], 2.0)
    mixed, half = dot(a, b), (dot(b, b) - dot(a, a)) / two
    size = abs(half) + np.sqrt(half * half + mixed * mixed)
    some = size > o
    tangent = (mixed if half >= o else -mixed) / (size if some else e)
    cosine = e / np.sqrt(e + tangent * tangent)
    sine = tangent * cosine
    return (
        sub(scale(a, cosine), scale(b, sine)), add(scale(b, cosine), scale(a, sine)),
        sub(scale(u, cosine), scale(v, sine)), add(scale(v, cosine), scale(u, sine)),
    )  # fmt: skip


@law
def _sweep(a: Vec, b: Vec, c: Vec, u: Vec, v: Vec, w: Vec) -> tuple[Vec, Vec, Vec, Vec, Vec, Vec]:
    """Return three columns of F V and of V after one rotation of each pair."""
    a, b, u, v = _orthogonal(a, b, u, v)
    a, c, u, w = _orthogonal(a, c, u, w)
    b, c, v, w = _orthogonal(b, c, v, w)
    return a, b, c, u, v, w


@law
def _longer_first(a: Vec, b: Vec, u: Vec, v: Vec) -> _Pair:
    """Return the columns with the longer one first; one changes its sign if they are exchanged, so that det V stays."""
    kept = dot(a, a) >= dot(b, b)
    return (
        select(kept, a, b), select(kept, b, opposite(a)), select(kept, u, v), select(kept, v, opposite(u)),
    )  # fmt: skip


@law
def _in_the_plane(a: Vec, b: Vec) -> Matrix:
    """Return the nearest rotation in 2-D, by its angle: tan = (F_yx - F_xy) / (F_xx + F_yy)."""
    along: Vec = (a[0] + b[1], a[1] - b[0])
    some = dot(along, along) > like(a[0], 0.0)
    x = select(some, unit(along), axis(a, 0))
    return x, (-x[1], x[0])


@law
def _in_space(a: Vec, b: Vec, c: Vec) -> Matrix:
    """Return the nearest rotation in 3-D: U V', from F = U diag(s) V' with U and V rotations.

    Five sweeps of one-sided Jacobi rotations make the columns of F V orthogonal to rounding. The two longest give two
    columns of U, and their cross product the third, so that the least s has the sign of det F.
    """
    u, v, w = axis(a, 0), axis(a, 1), axis(a, 2)
    a, b, c, u, v, w = _sweep(a, b, c, u, v, w)
    a, b, c, u, v, w = _sweep(a, b, c, u, v, w)
    a, b, c, u, v, w = _sweep(a, b, c, u, v, w)
    a, b, c, u, v, w = _sweep(a, b, c, u, v, w)
    a, b, c, u, v, w = _sweep(a, b, c, u, v, w)
    a, b, u, v = _longer_first(a, b, u, v)
    a, c, u, w = _longer_first(a, c, u, w)
    b, c, v, w = _longer_first(b, c, v, w)
    o = like(a[0], 0.0)
    x = select(dot(a, a) > o, unit(a), u)
    y, other = lateral(b, x), lateral(v, x)
    other = select(dot(other, other) > like(o, 0.1), unit(other), perpendicular(x))
    y = select(dot(y, y) > o, unit(y), other)
    z = cross(x, y)
    return (
        add(add(scale(x, u[0]), scale(y, v[0])), scale(z, w[0])),
        add(add(scale(x, u[1]), scale(y, v[1])), scale(z, w[1])),
        add(add(scale(x, u[2]), scale(y, v[2])), scale(z, w[2])),
    )


@law
def nearest_rotation(columns: Matrix) -> Matrix:
    """Return the columns of the rotation nearest to a matrix, given by its columns; of 0: the identity.

    Where several rotations are equally near, it is one of them: of a matrix whose two least singular values are equal
    and det < 0, or of one whose rank is 1.
    """
    if len(columns) == 2:
        return _in_the_plane(columns[0], columns[1])
    else:
        return _in_space(columns[0], columns[1], columns[2])
