"""The first contact of a body that moves along a ray with a shape of any form."""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, scale, sub

__all__ = ["touched_offset", "touched_spot"]


@law
def touched_spot(y: Vec, ray: Vec, hit: float, room: float) -> Vec:
    """Return the position of the body's centre at contact; its current position if there is none.

    A point-like body stops just before contact: exactly on the surface the normal depends on rounding.
    """
    o = like(hit, 0.0)
    way = hit if hit < like(hit, np.inf) else o
    back = way * like(hit, 1e-3)
    return add(y, scale(ray, way - back if room < back else way))


@law
def touched_offset(ray: Vec, hit: float, normal: Vec, room: float, gap: float) -> Vec:
    """Return the offset to the point of contact: to the stopped body's centre, and from there `room` inward.

    room: the body's radius. For a body that already overlaps, the point is the nearest one of the surface; if its
    centre is inside, a point equally deep on the inner side, so that the direction away from it leads out.
    """
    o = like(hit, 0.0)
    depth = gap if gap > o else (-gap if gap < o else like(hit, 1e-6))
    way = hit if hit < like(hit, np.inf) else o
    inward = room if hit > o else depth
    return sub(scale(ray, way), scale(normal, inward))
