"""The header of a row in a table of shapes, common to all forms: number, bounds and motion of an obstacle.

In D dimensions, in order: length of the row; number of the obstacle; anchor (D, m); number of its form (index in
`table.FORMS`); centre of its bounding box relative to the anchor (D, m), half the edges of that box (D, m), and radius
of the bounding circle or sphere around the same centre (m), all infinite if the shape is unbounded; velocity (D, m/s);
amplitude of its sway (D, m), 2 pi / period (1/s) and phase (rad). Then follow the numbers of its form: see chain.py,
block.py and field.py.

`at` is where a row begins; `x` is any vector of the scene, which gives the dimension.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, scale

__all__ = ["body_of", "bound_of", "box_of", "form_of", "outside_box", "shift_of", "vector_at", "velocity_of"]


@law
def vector_at(table: Any, at: int, x: Vec) -> Vec:
    """Return the vector of x's dimension that begins at `at`."""
    if len(x) == 2:
        return (table[at], table[at + 1])
    else:
        return (table[at], table[at + 1], table[at + 2])


@law
def form_of(table: Any, at: int, x: Vec) -> int:
    """Return the number of the row's form."""
    return np.int64(table[at + 2 + len(x)])  # type: ignore[return-value]  # an int to numba


@law
def box_of(table: Any, at: int, x: Vec) -> tuple[Vec, Vec]:
    """Return the axis-aligned bounding box: its centre, relative to the anchor, and half its edges, m."""
    return vector_at(table, at + 3 + len(x), x), vector_at(table, at + 3 + 2 * len(x), x)


@law
def bound_of(table: Any, at: int, x: Vec) -> tuple[Vec, float]:
    """Return the bounding circle or sphere: its centre, relative to the anchor, and its radius, m."""
    return vector_at(table, at + 3 + len(x), x), table[at + 3 + 3 * len(x)]


@law
def outside_box(table: Any, at: int, x: Vec) -> Vec:
    """Return the distance of x from the bounding box per axis, m: 0 inside; tighter than the bounding circle."""
    middle, half = box_of(table, at, x)
    if len(x) == 2:
        return (_excess(x[0] - middle[0], half[0]), _excess(x[1] - middle[1], half[1]))
    else:
        out = (_excess(x[0] - middle[0], half[0]), _excess(x[1] - middle[1], half[1]))
        return out + (_excess(x[2] - middle[2], half[2]),)  # noqa: RUF005  # numba does not unpack tuples


@law
def _excess(x: float, half: float) -> float:
    far, o = abs(x) - half, like(x, 0.0)
    return far if far > o else o


@law
def shift_of(table: Any, at: int, time: float, x: Vec) -> Vec:
    """Return the anchor's displacement at a time, s, in m: v t + a sin(2 pi t / period + phase)."""
    d = len(x)
    turn = table[at + 4 + 5 * d] * time + table[at + 5 + 5 * d]
    sway = scale(vector_at(table, at + 4 + 4 * d, x), np.sin(turn))
    return add(scale(vector_at(table, at + 4 + 3 * d, x), time), sway)


@law
def velocity_of(table: Any, at: int, time: float, x: Vec) -> Vec:
    """Return the velocity of the shape at a time (s), m/s."""
    d = len(x)
    rate = table[at + 4 + 5 * d]
    sway = scale(vector_at(table, at + 4 + 4 * d, x), rate * np.cos(rate * time + table[at + 5 + 5 * d]))
    return add(vector_at(table, at + 4 + 3 * d, x), sway)


@law
def body_of(at: int, x: Vec) -> int:
    """Return the index at which the numbers of the row's form begin."""
    return at + 6 + 5 * len(x)
