"""Obstacles as three questions: how far is the surface, which way is out, where does a ray hit.

Circles and spheres for now. Laws for one agent; `offset` leads from the agent to the centre, lengths in m.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flockenv.kernels import Vec, law, like
from flockenv.records import Record
from flockenv.vec import axis, dot, norm, scale, select, unit

__all__ = ["Circle", "gap", "normal", "ray_hit"]


@law
def gap(offset: Vec, radius: float) -> float:
    """Return the distance to the surface of a circle or sphere, m; negative inside."""
    return norm(offset) - radius


@law
def normal(offset: Vec) -> Vec:
    """Return the outward unit normal at the nearest point of the surface; the x axis at the very centre."""
    outside = dot(offset, offset) > like(offset[0], 0.0)
    return select(outside, scale(unit(offset), like(offset[0], -1.0)), axis(offset, 0))


@law
def ray_hit(offset: Vec, direction: Vec, radius: float) -> float:
    """Return the distance along a unit `direction` to the surface, m: 0 from inside, inf if missed.

    Uses c / (b + sqrt(b^2 - c)), which does not cancel for a grazing ray.
    """
    b = dot(offset, direction)
    c = dot(offset, offset) - radius * radius
    o = like(c, 0.0)
    discriminant = b * b - c
    root = np.sqrt(discriminant if discriminant > o else o)
    hits = discriminant >= o and b > o
    return o if c <= o else (c / (b + root) if hits else like(c, np.inf))


class Circle(Record):
    """A round obstacle of a scene: a circle in 2-D, a sphere in 3-D."""

    centre: tuple[float, ...] = Field(min_length=2, max_length=3, description="m")
    radius: float = Field(gt=0, description="m")
