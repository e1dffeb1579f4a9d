"""Laws of shapes given as distances on a grid (a signed distance field), interpolated between its points.

A field is a grid (see flockenv/maths/grid.py) relative to the anchor, whose points have 1 + D numbers: the distance to
the surface (m, negative inside) and its outward direction.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.shapes.row_header import body_of
from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.grid import sample, sample_vector
from flockenv.maths.vectors import add, axis, dot, norm, scale, select, sub, unit

__all__ = ["STEPS", "hit_distance_field", "nearest_distance_field", "on_grid"]

STEPS = 96
"""Most steps of ray marching before a ray counts as missed; each step covers most of the distance to the surface."""


@law
def _inside(grid: Any, x: float, d: int, k: int) -> float:
    """Return x clamped to the grid along axis k."""
    high = grid[k] + grid[d] * (grid[d + 1 + k] - like(x, 1.0))
    x = x if x > grid[k] else grid[k]
    return x if x < high else high


@law
def on_grid(grid: Any, x: Vec) -> Vec:
    """Return the point of the grid that is nearest to x."""
    if len(x) == 2:
        return (_inside(grid, x[0], 2, 0), _inside(grid, x[1], 2, 1))
    else:
        return (_inside(grid, x[0], 3, 0), _inside(grid, x[1], 3, 1), _inside(grid, x[2], 3, 2))


@law
def nearest_distance_field(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface, m (negative inside), and the outward unit normal at its nearest point.

    Outside the grid it is the distance to the grid plus the distance at the point reached, an upper bound.
    """
    grid = table[body_of(at, x) :]
    y = on_grid(grid, x)
    beyond = sub(x, y)
    out = unit(add(sample_vector(grid, y, 1), beyond))
    some = dot(out, out) > like(x[0], 0.0)
    return sample(grid, y, 0) + norm(beyond), select(some, out, axis(x, 0))


@law
def hit_distance_field(table: Any, at: int, x: Vec, direction: Vec, clearance: float) -> float:
    """Return the distance along a unit `direction` at which a body of radius `clearance` touches it, m; inf if never.

    It is 0 if the body already overlaps. Computed by ray marching, with steps of 0.9 of the distance to the surface;
    accurate to a hundredth of the grid's spacing.
    """
    grid = table[body_of(at, x) :]
    d = len(x)
    near, longest = grid[d] * like(clearance, 0.01), grid[d] * (grid[d + 1] + grid[d + 2] + grid[2 * d])
    o, most = like(clearance, 0.0), like(clearance, 0.9)
    way, room = o, o
    limit = norm(x) + longest + longest + clearance
    for _ in range(STEPS):
        spot = add(x, scale(direction, way))
        y = on_grid(grid, spot)
        beyond = norm(sub(spot, y))
        here = sample(grid, y, 0)
        # outside the grid the surface is at least as far as the grid; clearance: the radius of the body
        here -= beyond
        room = (beyond if beyond > here else here) - clearance
        if (room < near) | (way > limit):
            break
        way += room * most
    out = way if room < near else like(clearance, np.inf)
    return o if (room < near) & (way <= o) else out
