"""Where a body that goes along a ray touches a shape first, whatever shape it is."""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, scale, sub

__all__ = ["touched_offset", "touched_spot"]


@law
def touched_spot(y: Vec, ray: Vec, hit: float, room: float) -> Vec:
    """Return the place of the body's centre where it touches; where it is if it never does.

    A body without size is there just before: on the very surface a normal is a matter of rounding.
    """
    o = like(hit, 0.0)
    way = hit if hit < like(hit, np.inf) else o
    back = way * like(hit, 1e-3)
    return add(y, scale(ray, way - back if room < back else way))


@law
def touched_offset(ray: Vec, hit: float, normal: Vec, room: float, gap: float) -> Vec:
    """Return the way to the point that is touched: where the body stops, and from there its own radius `room` inward.

    Of a body that overlaps already it is the nearest point of the surface; of one whose centre is inside, a point as
    far inward: from there, too, the way out is away from it.
    """
    o = like(hit, 0.0)
    depth = gap if gap > o else (-gap if gap < o else like(hit, 1e-6))
    way = hit if hit < like(hit, np.inf) else o
    inward = room if hit > o else depth
    return sub(scale(ray, way), scale(normal, inward))
