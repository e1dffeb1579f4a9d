"""A bounding volume hierarchy: a binary tree of axis-aligned boxes, built once and refitted when elements move.

Its order is that of positions at the start. Nodes are in level order without pointers: those below node k are 2 k + 1
and 2 k + 2, and leaf j is node L - 1 + j, with L a power of two. Leaves without an element have empty boxes.
Source: van den Bergen 1997, Efficient collision detection of complex deformable models using AABB trees.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.jit.decorators import kernel

__all__ = ["DEEPEST", "BoxTree", "build_tree", "find_overlaps", "fit_parents", "overlapping_pairs", "set_boxes"]

DEEPEST = 64
"""Length of the stack of a traversal: more than the levels of any tree."""

DIMENSION = 3


class BoxTree(NamedTuple):
    """Boxes of n elements in space, and of the nodes above them."""

    order: NDArray[np.int32]  # (L,) the element of each leaf, or -1
    leaf: NDArray[np.int32]  # (n,) the leaf of each element
    box: NDArray[np.float64]  # (2 L - 1, 6) m, lowest corner and highest corner


def build_tree(centres: NDArray[np.float64]) -> BoxTree:
    """Return a tree over elements with these centres, (n, 3) m, halved along the longest side of each node's box."""
    count = len(centres)
    leaves = 1 << max(count - 1, 0).bit_length()
    order = np.full(leaves, -1, np.int32)
    order[:count] = np.arange(count)
    width = leaves
    while width > 1:
        for first in range(0, count, width):
            part = order[first : min(first + width, count)]
            extent = np.ptp(centres[part], axis=0)
            along = centres[part, int(np.argmax(extent))]
            order[first : first + len(part)] = part[np.argsort(along, kind="stable")]
        width //= 2
    leaf = np.zeros(count, np.int32)
    leaf[order[:count]] = np.arange(count)
    box = np.empty((2 * leaves - 1, 2 * DIMENSION))
    box[:, :DIMENSION], box[:, DIMENSION:] = np.inf, -np.inf
    return BoxTree(order, leaf, box)


@kernel
def fit_parents(tree: Any) -> None:
    """Set the box of every inner node to that of the two below it."""
    for up in range(tree.order.shape[0] - 1):
        k = tree.order.shape[0] - 2 - up
        for c in range(3):
            tree.box[k, c] = min(tree.box[2 * k + 1, c], tree.box[2 * k + 2, c])
            tree.box[k, 3 + c] = max(tree.box[2 * k + 1, 3 + c], tree.box[2 * k + 2, 3 + c])


def set_boxes(tree: BoxTree, corners: NDArray[np.float64]) -> None:
    """Set the boxes of the leaves to those of their elements, (n, k, 3) m, and those of all nodes above; uncompiled."""
    first = len(tree.order) - 1
    tree.box[first + tree.leaf] = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    while first > 0:  # level by level
        up, one, two = first // 2, tree.box[first : 2 * first : 2], tree.box[first + 1 : 2 * first + 1 : 2]
        tree.box[up:first, :DIMENSION] = np.minimum(one[:, :DIMENSION], two[:, :DIMENSION])
        tree.box[up:first, DIMENSION:] = np.maximum(one[:, DIMENSION:], two[:, DIMENSION:])
        first = up


@kernel
def find_overlaps(tree: Any, low: Any, high: Any, stack: Any, found: Any) -> int:
    """Write the elements whose boxes overlap a box, in the order of leaves; return their number.

    low, high: (3,) m; stack: (DEEPEST,); found: room for all elements.
    """
    leaves, depth, count = tree.order.shape[0], 1, 0
    stack[0] = 0
    while depth > 0:
        depth -= 1
        k = stack[depth]
        apart = False
        for c in range(3):
            apart = apart or tree.box[k, c] > high[c] or tree.box[k, 3 + c] < low[c]
        if apart:
            continue
        if k >= leaves - 1:
            found[count] = tree.order[k - leaves + 1]
            count += 1
        else:
            stack[depth], stack[depth + 1] = 2 * k + 2, 2 * k + 1
            depth += 2
    return count


def overlapping_pairs(tree: BoxTree, boxes: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pairs (query, element) whose boxes overlap; boxes: (Q, 6) m. Uncompiled, level by level."""
    leaves = len(tree.order)
    query, node = np.arange(len(boxes)), np.zeros(len(boxes), np.int64)
    while True:
        a, b = boxes[query], tree.box[node]
        meet = ((a[:, :DIMENSION] <= b[:, DIMENSION:]) & (a[:, DIMENSION:] >= b[:, :DIMENSION])).all(axis=1)
        query, node = query[meet], node[meet]
        if not len(node) or node[0] >= leaves - 1:  # all nodes are of one level
            return query, tree.order[node - leaves + 1].astype(np.int64)
        query, node = np.repeat(query, 2), np.asarray((2 * node[:, None] + [1, 2]).ravel(), np.int64)
