"""What every row of a table of shapes begins with, whatever its form: who it is, what it lies within, how it moves.

Of D dimensions, in order: its length; the number of the obstacle; the anchor (D, m); the number of its form (its place
in `table.FORMS`); the middle of its box from the anchor (D, m), half the edges of that box (D, m), and the radius of a
circle or sphere around the same middle (m), all infinite of what has no end; its velocity (D, m/s); the amplitude of
its sway (D, m), 2 pi / period (1/s) and phase (rad). Behind that comes what its form calls for: see chain.py, block.py
and field.py.

`at` is where a row begins; `x` is any vector of the scene: it tells the dimension.
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
    """Return the number of its form."""
    return np.int64(table[at + 2 + len(x)])  # type: ignore[return-value]  # a whole number, to numba an int


@law
def box_of(table: Any, at: int, x: Vec) -> tuple[Vec, Vec]:
    """Return the box along the axes that it lies within: the middle, from the anchor, and half its edges, m."""
    return vector_at(table, at + 3 + len(x), x), vector_at(table, at + 3 + 2 * len(x), x)


@law
def bound_of(table: Any, at: int, x: Vec) -> tuple[Vec, float]:
    """Return the circle or sphere that it lies within: the centre, from the anchor, and the radius, m."""
    return vector_at(table, at + 3 + len(x), x), table[at + 3 + 3 * len(x)]


@law
def outside_box(table: Any, at: int, x: Vec) -> Vec:
    """Return how far x is from the box that it lies within, per axis, m: 0 inside. Of a long wall that is near."""
    middle, half = box_of(table, at, x)
    if len(x) == 2:
        return (_beyond(x[0] - middle[0], half[0]), _beyond(x[1] - middle[1], half[1]))
    else:
        out = (_beyond(x[0] - middle[0], half[0]), _beyond(x[1] - middle[1], half[1]))
        return out + (_beyond(x[2] - middle[2], half[2]),)  # noqa: RUF005  # numba does not unpack tuples


@law
def _beyond(x: float, half: float) -> float:
    far, o = abs(x) - half, like(x, 0.0)
    return far if far > o else o


@law
def shift_of(table: Any, at: int, time: float, x: Vec) -> Vec:
    """Return how far its anchor is at a time (s) from where the row says, m: v t + a sin(2 pi t / period + phase)."""
    d = len(x)
    turn = table[at + 4 + 5 * d] * time + table[at + 5 + 5 * d]
    sway = scale(vector_at(table, at + 4 + 4 * d, x), np.sin(turn))
    return add(scale(vector_at(table, at + 4 + 3 * d, x), time), sway)


@law
def velocity_of(table: Any, at: int, time: float, x: Vec) -> Vec:
    """Return how fast it moves at a time (s), m/s."""
    d = len(x)
    rate = table[at + 4 + 5 * d]
    sway = scale(vector_at(table, at + 4 + 4 * d, x), rate * np.cos(rate * time + table[at + 5 + 5 * d]))
    return add(vector_at(table, at + 4 + 3 * d, x), sway)


@law
def body_of(at: int, x: Vec) -> int:
    """Return where begins what its form calls for."""
    return at + 6 + 5 * len(x)
