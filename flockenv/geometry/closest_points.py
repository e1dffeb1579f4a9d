"""Closest points of a point and a triangle, and of two segments, as signed weights of the four corners.

The offset between the closest points is the weighted sum of the corners' positions; the weights add up to 0.
Source: Ericson 2004, Real-Time Collision Detection, sections 5.1.5 and 5.1.9.
"""

from __future__ import annotations

from flockenv.jit.decorators import Numbers, Vec, law, routine
from flockenv.maths.vectors import dot, sub

__all__ = ["closest_point_face", "closest_segments", "weighted"]

PARALLEL = 1e-12
"""Squared sine of the angle of two segments, below which their closest points include an end."""


@law
def weighted(w: Numbers, a: Vec, b: Vec, c: Vec, d: Vec) -> Vec:
    """Return the weighted sum of four vectors."""
    return (
        w[0] * a[0] + w[1] * b[0] + w[2] * c[0] + w[3] * d[0],
        w[0] * a[1] + w[1] * b[1] + w[2] * c[1] + w[3] * d[1],
        w[0] * a[2] + w[1] * b[2] + w[2] * c[2] + w[3] * d[2],
    )


@law
def _part(up: float, down: float) -> float:
    """Return up / down, between 0 and 1; 0 if down is not positive."""
    return min(max(up / down, 0.0), 1.0) if down > 0.0 else 0.0


@routine
def closest_point_face(p: Vec, a: Vec, b: Vec, c: Vec) -> Numbers:
    """Return the weights of p, a, b, c in the offset from the triangle's closest point to p: 1, and three <= 0."""
    ab, ac, ap = sub(b, a), sub(c, a), sub(p, a)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return (1.0, -1.0, 0.0, 0.0)
    bp = sub(p, b)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return (1.0, 0.0, -1.0, 0.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s = _part(d1, d1 - d3)
        return (1.0, s - 1.0, -s, 0.0)
    cp = sub(p, c)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return (1.0, 0.0, 0.0, -1.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s = _part(d2, d2 - d6)
        return (1.0, s - 1.0, 0.0, -s)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        s = _part(d4 - d3, (d4 - d3) + (d5 - d6))
        return (1.0, 0.0, s - 1.0, -s)
    total = va + vb + vc
    s, t = _part(vb, total), _part(vc, total)
    return (1.0, s + t - 1.0, -s, -t)


@law
def _better(w: Numbers, best: Numbers, least: float, a: Vec, b: Vec, c: Vec, d: Vec) -> tuple[Numbers, float]:
    """Return the weights, and the squared distance, of the closer of two pairs of points."""
    off = weighted(w, a, b, c, d)
    square = dot(off, off)
    return (w, square) if square < least else (best, least)


@routine
def closest_segments(a: Vec, b: Vec, c: Vec, d: Vec) -> Numbers:
    """Return the weights of a, b, c, d in the offset from the closest point of segment c d to that of segment a b.

    They are inside of both segments, or one is an end; all five cases are compared, so parallel segments are no
    exception.
    """
    u, v, r = sub(b, a), sub(d, c), sub(a, c)
    uu, vv, uv, ur, vr = dot(u, u), dot(v, v), dot(u, v), dot(u, r), dot(v, r)
    t = _part(vr, vv)
    best = (1.0, 0.0, t - 1.0, -t)
    off = weighted(best, a, b, c, d)
    least = dot(off, off)
    t = _part(vr + uv, vv)
    best, least = _better((0.0, 1.0, t - 1.0, -t), best, least, a, b, c, d)  # type: ignore[assignment]
    s = _part(-ur, uu)
    best, least = _better((1.0 - s, s, -1.0, 0.0), best, least, a, b, c, d)  # type: ignore[assignment]
    s = _part(uv - ur, uu)
    best, least = _better((1.0 - s, s, 0.0, -1.0), best, least, a, b, c, d)  # type: ignore[assignment]
    below = uu * vv - uv * uv
    if below > PARALLEL * uu * vv:
        s, t = (uv * vr - ur * vv) / below, (uu * vr - uv * ur) / below
        if 0.0 < s < 1.0 and 0.0 < t < 1.0:
            best, least = _better((1.0 - s, s, t - 1.0, -t), best, least, a, b, c, d)  # type: ignore[assignment]
    return best
