"""A tree of boxes over the rows of one form, so that a law meets only the shapes that may be near.

A tree is built once, of the shapes of a scene. Its nodes lie depth first, and each has the place of the next node that
is not below it, so that a walk needs no stack:

    node = tree
    while node < end:
        node = node + length if meets(...) else next_of(...)

A node is, in order: how far behind the first node the next one lies that is not below it; how far behind the first row
of its form its own row lies, or -1 if it has nodes below it; the middle of its box (D, m) and half the edges (D, m).
Shapes that move have boxes without an end and lie first. See Ericson 2005, "Real-Time Collision Detection", 6.6.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.kernels import Vec, kernel, law
from flockenv.shapes.head import vector_at

__all__ = ["FEWEST_ROWS", "MOST_FOUND", "keep_in_order", "meets_box", "node_length", "row_of_node", "tree_of"]

Floats = NDArray[np.float64]

FEWEST_ROWS = 16
"""Fewer shapes of a form are met one after the other by agents side by side, which is sooner done."""

MOST_FOUND = 64
"""If more shapes are near an agent than this, it meets all of the form: they need not be put in order."""

LOOSE = 1e-6
"""Boxes are larger by this share of their coordinates: single precision rounds by 6e-8."""


def node_length(dimension: int) -> int:
    """Return how many numbers a node has."""
    return 2 + 2 * dimension


def tree_of(shapes: Sequence[Any], rows: Sequence[int], period: Floats | None = None) -> Floats:
    """Return the nodes of a tree over some shapes of one form, (K (2 + 2 D),), and before them how many numbers follow.

    rows: how far behind the first row the row of each begins, ascending. period: the edges of a torus, m.
    """
    middle = np.array([shape.bound.centre for shape in shapes])
    half = np.array([np.full(len(m), np.inf) if s.moves else s.bound.half for s, m in zip(shapes, middle, strict=True)])
    away = np.abs(middle).max(axis=1, keepdims=True) + (0.0 if period is None else float(period.max()))
    half = half * (1 + LOOSE) + LOOSE * away
    still = np.isfinite(half).all(axis=1)
    nodes: list[list[float]] = []
    for k in np.flatnonzero(~still):
        _grow(nodes, np.array([k]), middle, half, rows)
    if still.any():
        _grow(nodes, np.flatnonzero(still), middle, half, rows)
    table = np.array(nodes)
    table[:, 0] *= table.shape[1]
    return np.concatenate([[float(table.size)], table.ravel()])


def _grow(nodes: list[list[float]], mine: NDArray[np.intp], middle: Floats, half: Floats, rows: Sequence[int]) -> None:
    """List the tree over the shapes `mine`: halves along the axis on which their middles lie farthest apart."""
    here = len(nodes)
    low, high = (middle[mine] - half[mine]).min(axis=0), (middle[mine] + half[mine]).max(axis=0)
    whole = (low + high) / 2 if len(mine) > 1 else middle[mine[0]]
    around = (high - low) / 2 if len(mine) > 1 else half[mine[0]]
    nodes.append([0.0, float(rows[mine[0]] if len(mine) == 1 else -1), *whole.tolist(), *around.tolist()])
    if len(mine) > 1:
        axis = int(np.argmax(np.ptp(middle[mine], axis=0)))
        order = mine[np.argsort(middle[mine, axis], kind="stable")]
        _grow(nodes, order[: len(order) // 2], middle, half, rows)
        _grow(nodes, order[len(order) // 2 :], middle, half, rows)
    nodes[here][0] = float(len(nodes))


@law
def meets_box(table: Any, node: int, to: Vec, reach: Vec) -> bool:
    """Return whether a node's box is within `reach` (m, per axis) of a place; `to` leads from there to its middle."""
    half = vector_at(table, node + 2 + len(to), to)
    near = (abs(to[0]) <= half[0] + reach[0]) & (abs(to[1]) <= half[1] + reach[1])
    if len(to) == 3:
        near &= abs(to[2]) <= half[2] + reach[2]
    return near


@law
def row_of_node(table: Any, node: int) -> int:
    """Return how far behind the first row its row lies, -1 if it has none."""
    return np.int64(table[node + 1])  # type: ignore[return-value]  # a whole number, to numba an int


@kernel
def keep_in_order(found: Any, first: int, count: int, row: int) -> None:
    """Put a row among the `count` that are listed from `first` on, in ascending order."""
    j = first + count
    while j > first and found[j - 1] > row:
        found[j] = found[j - 1]
        j -= 1
    found[j] = row
