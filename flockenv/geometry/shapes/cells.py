"""A grid of cells over the rows of one form, so that a law is evaluated only for shapes that may be near.

It is built once per scene and has about as many cells as there are shapes. A shape is listed in every cell that its box
overlaps, so that the few cells around a position list all shapes near it. Shapes that move, and those that overlap more
than MOST_CELLS cells, are in an additional list, the last one, which every search includes.

The table holds, in order: the lower corner of the grid (D, m), cells per metre (D), the number of cells along each axis
(D), 1 for a torus and 0 otherwise; the beginning of each list, cells in C order, then the last list, and its end; the
lists. An entry holds the offset of the shape's row from the first row of its form, the middle of the shape's box (D, m)
and half its edges (D, m). See Ericson 2005, "Real-Time Collision Detection", 7.1.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes.row_header import vector_at
from flockenv.jit.decorators import Vec, kernel, law, like

__all__ = [
    "CIRCLES",
    "MOST_FOUND",
    "cells_of",
    "count_of",
    "entry_length",
    "fewest_rows",
    "is_near_box",
    "keep_in_order",
    "list_of",
    "row_of_entry",
    "span_of",
]  # fmt: skip

Floats = NDArray[np.float64]

CIRCLES = "circle"
"""Name of the grid over the circles or spheres of the state, which are numbered by index instead of rows."""

FEWEST_ROWS = 16
"""With fewer shapes of a form there is usually no grid: a vectorized loop over all of them is faster.

Where a grid begins to be faster depends on the law: at 5 to 15 shapes for most, at 45 for `avoid_obstacles` around
circles. A cheap law that reaches over many cells, `follow_wall` around circles, needs hundreds, in 3-D thousands.
"""

FEWEST_SOLID_BLOCKS = 2
"""The same for blocks in 3-D: a ray is cast at twelve round edges, which takes 20 to 30 times as long as in 2-D."""

MOST_FOUND = 64
"""An agent with more shapes near it than this interacts with all shapes of the form, which needs no sorting."""

MOST_CELLS = 64
"""A shape that overlaps more cells than this is in the last list."""

LOOSE = 1e-6
"""Boxes are enlarged by this fraction of their coordinates: single precision rounds by 6e-8."""

BESIDE = 1e-3
"""Fraction of a cell by which boxes are enlarged on the grid: single precision also rounds grid coordinates."""


def fewest_rows(form: str, dimension: int) -> int:
    """Return from how many shapes of a form on there is a grid over them."""
    return FEWEST_SOLID_BLOCKS if form == "block" and dimension == 3 else FEWEST_ROWS


def entry_length(dimension: int) -> int:
    """Return the number of values in an entry of a list."""
    return 1 + 2 * dimension


def cells_of(shapes: Sequence[Any], rows: Sequence[int], period: Floats | None = None) -> Floats:
    """Return the table of cells for some shapes of one form.

    rows: offset of each shape's row from the first row, ascending. period: the edges of a torus, m.
    """
    middle = np.array([shape.bound.centre for shape in shapes])
    half = np.array([np.full(len(m), np.inf) if s.moves else s.bound.half for s, m in zip(shapes, middle, strict=True)])
    away = np.abs(middle).max(axis=1, keepdims=True) + (0.0 if period is None else float(period.max()))
    half = half * (1 + LOOSE) + LOOSE * away
    low, rate, many = _grid(middle, half, period)
    lists: list[list[list[float]]] = [[] for _ in range(int(many.prod()) + 1)]
    for row, m, h in zip(rows, middle, half, strict=True):
        for cell in _cells(m, h, low, rate, many, period is not None):
            lists[cell].append([float(row), *m.tolist(), *h.tolist()])
    head = np.concatenate([low, rate, many, [0.0 if period is None else 1.0]])
    begins = np.cumsum([0, *map(len, lists)]) * entry_length(middle.shape[1]) + len(head) + len(lists) + 1
    return np.concatenate([head, begins, np.array(list(itertools.chain(*lists))).ravel()])


def _grid(middle: Floats, half: Floats, period: Floats | None) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return the lower corner of a grid, and cells per metre and the number of cells along each axis."""
    still, d = np.isfinite(half).all(axis=1), middle.shape[1]
    if period is not None:
        low, width = np.zeros(d), period
    elif still.any():
        low = (middle - half)[still].min(axis=0)
        width = (middle + half)[still].max(axis=0) - low
    else:
        low, width = np.zeros(d), np.ones(d)
    width = np.maximum(width, max(float(width.max()), 1e-9) / len(middle))  # bounds the cells of shapes in a line
    edge = (width.prod() / len(middle)) ** (1 / d)
    many = np.maximum(np.floor(width / edge), 1).astype(np.int64)
    return low, many / width, many


def _cells(m: Floats, h: Floats, low: Floats, rate: Floats, many: NDArray[np.int64], closes: bool) -> list[int]:
    """Return the indices of the cells that a box overlaps; the index of the last list if there are too many."""
    last = [int(many.prod())]
    if not np.isfinite(h).all():
        return last
    begin = np.floor((m - h - low) * rate - BESIDE).astype(np.int64)
    end = np.floor((m + h - low) * rate + BESIDE).astype(np.int64) + 1
    if closes:
        begin, end = np.where(end - begin < many, begin, 0), np.where(end - begin < many, end, many)
    else:
        begin, end = np.clip(begin, 0, many), np.clip(end, 0, many)
    if (end - begin).prod() > MOST_CELLS:
        return last
    axes = [np.arange(a, b) % n for a, b, n in zip(begin, end, many, strict=True)]
    return [int(np.ravel_multi_index(cell, tuple(many))) for cell in itertools.product(*axes)]


@law
def _span(table: Any, at: int, d: int, middle: float, reach: float, closes: bool) -> tuple[int, int]:
    """Return the first cell that a box overlaps along an axis, whose numbers begin at `at`, and their number.

    The cells are clipped to the grid.
    """
    low, rate, many = table[at], table[at + d], table[at + 2 * d]
    o, e = like(middle, 0.0), like(middle, 1.0)
    begin, end = np.floor((middle - reach - low) * rate), np.floor((middle + reach - low) * rate) + e
    if closes:
        turns = np.floor(begin / many) * many
        begin, end = (begin - turns, end - turns) if end - begin < many else (o, many)
    else:
        begin, end = begin if begin > o else o, end if end < many else many
    most: Any = np.int64(many)
    first: Any = np.int64(begin)
    past: Any = np.int64(end)
    first = first if first >= 0 else 0  # NaN becomes the least integer
    last = first + most if closes else most
    past = past if past <= last else last
    return first, (past - first if past > first else 0)


@law
def span_of(table: Any, at: int, middle: Vec, reach: Vec) -> tuple[tuple[int, int], ...]:
    """Return the cells that a box overlaps, per axis: (first, count). middle, reach: its centre and half edges, m."""
    d = len(middle)
    closes = table[at + 3 * d] > like(middle[0], 0.0)
    x = _span(table, at, d, middle[0], reach[0], closes)
    y = _span(table, at + 1, d, middle[1], reach[1], closes)
    if len(middle) == 2:
        return (x, y)
    else:
        return (x, y, _span(table, at + 2, d, middle[2], reach[2], closes))


@law
def count_of(span: tuple[tuple[int, int], ...]) -> int:
    """Return the number of lists to search for a box: one per cell, and the last list."""
    if len(span) == 2:
        return span[0][1] * span[1][1] + 1
    else:
        return span[0][1] * span[1][1] * span[2][1] + 1


@law
def list_of(table: Any, at: int, x: Vec, span: tuple[tuple[int, int], ...], k: int) -> tuple[int, int]:
    """Return the begin and end of the k-th list of a span; k = 0 is the last list of the table."""
    d = len(x)
    cell: Any = 0
    left: Any = k - 1
    if len(x) == 2:
        along: Any = (left // span[1][1], left % span[1][1]) if k > 0 else (0, 0)
    else:
        rest = left // span[2][1] if k > 0 else 0
        along = (
            rest // span[1][1] if k > 0 else 0,
            rest % span[1][1] if k > 0 else 0,
            left % span[2][1] if k > 0 else 0,
        )
    last: Any = 1
    for axis in range(d):
        many = np.int64(table[at + 2 * d + axis])
        here = span[axis][0] + along[axis]
        cell = cell * many + (here - many if here >= many else here)
        last *= many
    begins = at + 3 * d + 1 + (cell if k > 0 else last)
    return at + np.int64(table[begins]), at + np.int64(table[begins + 1])  # type: ignore[return-value]


@law
def is_near_box(table: Any, entry: int, to: Vec, reach: Vec) -> bool:
    """Return True if a box is within `reach` (m, per axis) of a point; `to`: offset from the point to its middle."""
    half = vector_at(table, entry + 1 + len(to), to)
    near = (abs(to[0]) <= half[0] + reach[0]) & (abs(to[1]) <= half[1] + reach[1])
    if len(to) == 3:
        near &= abs(to[2]) <= half[2] + reach[2]
    return near


@law
def row_of_entry(table: Any, entry: int) -> int:
    """Return the offset of a listed shape's row from the first row of its form."""
    return np.int64(table[entry])  # type: ignore[return-value]  # an int to numba


@kernel
def keep_in_order(found: Any, first: int, count: int, row: int) -> int:
    """Insert a row into the ascending `count` rows from `first` on, if it is new; return the new count."""
    place = first + count
    while place > first and found[place - 1] > row:
        place -= 1
    if place > first and found[place - 1] == row:
        return count
    for j in range(first + count, place, -1):
        found[j] = found[j - 1]
    found[place] = row
    return count + 1
