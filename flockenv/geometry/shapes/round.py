"""Circles and spheres: distance to the surface, outward normal, ray casts.

Laws for one agent; `offset`: from the agent to the centre; lengths in m.
"""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, axis, dot, norm, scale, select, sub, unit

__all__ = ["blocks", "gap", "normal", "ray_hit", "silhouette", "touched_normal"]


@law
def gap(offset: Vec, radius: float) -> float:
    """Return the distance to the surface of a circle or sphere, m; negative inside.

    offset: from the agent to the centre, m; radius: m.
    """
    return norm(offset) - radius


@law
def normal(offset: Vec) -> Vec:
    """Return the outward unit normal at the nearest point of the surface; the x axis if at the centre.

    offset: from the agent to the centre, m.
    """
    outside = dot(offset, offset) > like(offset[0], 0.0)
    return select(outside, scale(unit(offset), like(offset[0], -1.0)), axis(offset, 0))


@law
def ray_hit(offset: Vec, direction: Vec, radius: float) -> float:
    """Return the distance along a unit `direction` to the surface, m: 0 from inside, inf if missed.

    offset: from the agent to the centre, m; radius: m.

    It is computed as c / (b + sqrt(b^2 - c)), without cancellation for grazing rays.
    """
    b = dot(offset, direction)
    c = dot(offset, offset) - radius * radius
    o = like(c, 0.0)
    discriminant = b * b - c
    root = np.sqrt(discriminant if discriminant > o else o)
    hits = discriminant >= o and b > o
    return o if c <= o else (c / (b + root) if hits else like(c, np.inf))


@law
def touched_normal(offset: Vec, direction: Vec, hit: float) -> Vec:
    """Return the outward unit normal where a ray hits after `hit` m; if it misses, at the nearest point.

    offset: from the agent to the centre, m; direction: of the ray, a unit vector.
    """
    o = like(hit, 0.0)
    there = (hit > o) & (hit < like(hit, np.inf))
    return normal(sub(offset, scale(direction, hit if there else o)))


@law
def blocks(offset: Vec, radius: float, to: Vec) -> bool:
    """Return True if a circle or sphere intersects the straight line to `to`, an offset in m.

    offset: from the agent to the centre, m; radius: m.
    """
    o, e = like(radius, 0.0), like(radius, 1.0)
    length = dot(to, to)
    along = dot(offset, to)
    along = along if along > o else o
    share = along / length if along < length else e
    nearest = sub(offset, scale(to, share))
    return dot(nearest, nearest) < radius * radius


@law
def silhouette(offset: Vec, radius: float, toward: Vec) -> Vec:
    """Return the point of the silhouette, as seen from the agent, on the side `toward`; an offset in m.

    offset: from the agent to the centre, m; radius: m.

    The silhouette of a circle or sphere at distance d is where lines from the agent touch it: at sqrt(d^2 - r^2) from
    the agent. `toward` is any vector not parallel to the offset; from inside, the nearest surface point is returned.
    """
    square = dot(offset, offset)
    o = like(square, 0.0)
    room = square - radius * radius
    outside = room > o
    share = room / square if outside else o
    side = sub(toward, scale(offset, dot(toward, offset) / (square if square > o else like(square, 1.0))))
    aside = radius * np.sqrt(share)
    edge = add(scale(offset, share), scale(unit(side), aside))
    return select(outside, edge, add(offset, scale(normal(offset), radius)))
