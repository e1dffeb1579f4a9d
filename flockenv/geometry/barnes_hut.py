"""A tree over the living agents of a world: a distant group of agents acts as one (Barnes & Hut 1986, Nature 324:446).

Agents are sorted along a Hilbert curve, on which neighbours in order are neighbours in space, and cut into blocks of
one agent per SIMD lane: the leaves. Node i of each level above holds the nodes 4 i to 4 i + 3 below it. So nothing is
inserted, split or linked, the number of nodes is known beforehand, and agents in one place need no special case. Each
block traverses the tree as a whole (`gather`) and lists the sources that its lanes then interact with: a node if its
size is small relative to its distance, single agents otherwise.

One thread builds the tree, in a few hundredths of the time of the traversals; the traversals are shared by all threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.cell_list import region
from flockenv.jit.decorators import kernel

__all__ = ["BUCKETS", "LEVELS", "LISTED", "MOST_DIRECT", "build_tree", "gather", "sort_along_curve", "tree_sizes"]

MOST_DIRECT = 2000
"""Number of agents up to which all pairs are summed exactly.

In 3-D a tree is slower up to there; in 2-D it would be 1.6 times faster from 1,000 on (benchmarks.gravitation), but the
exact sum of 2,000 takes only 1.7 ms.
"""

CHILDREN = 4
"""Children per node, also in 3-D: with 8, levels are so far apart that more nodes are opened than necessary."""

LISTED = 256
"""Capacity of a block's list of sources (nodes and agents); its lanes process the list when it is full."""

DIGIT = 11
"""Bits of a key per pass of the radix sort."""

TURNS = 6
"""Passes for 63 bits; even, so that keys end up in the half of the array in which they began."""

BUCKETS = 2**DIGIT

TOGETHER = 512
"""Cells whose keys are computed together, so that the loop vectorizes."""

LEVELS = 32
"""Upper bound of the number of levels of a tree."""


def tree_sizes(agents: int, lanes: int, dimension: int, team: int) -> dict[str, int]:
    """Return the lengths of the arrays: leaves, nodes, and the source lists of a team of threads.

    The record of a node: centre, lower corner, upper corner (D each); weight, edge, shift.
    """
    blocks = -(-agents // lanes)
    nodes = here = blocks
    while here > 1:
        here = -(-here // CHILDREN)
        nodes += here
    return {
        "tree_leaf": blocks * lanes * (dimension + 1),
        "tree_node": nodes * (3 * dimension + 3),
        "tree_near": team * LISTED * (dimension + 1),
    }


@kernel
def place_of(i: int, rows: int, lanes: int) -> int:
    """Return the index of the first number of agent i, in blocks of (rows, lanes)."""
    return i // lanes * (rows * lanes) + i % lanes


@kernel
def _exchange(x: Any, other: Any, k: int) -> Any:
    """Invert the bits of x below bit k if bit k of `other` is set; else exchange those bits of x and `other`."""
    below, here = (np.int64(1) << k) - 1, (other >> k) & 1
    swap = (x ^ other) & below & (here - 1)
    return x ^ (swap | (below & -here)), other ^ swap


@kernel
def _curve_positions(cells: Any, flat: bool, bits: int) -> None:
    """Convert cells to their positions along a Hilbert curve (Skilling 2004, AIP Conf. Proc. 707:381).

    cells: the x of TOGETHER cells, then their y, then their z; the positions overwrite x.
    """
    one, two = np.uint64(TOGETHER), np.uint64(2 * TOGETHER)
    for k in range(bits - 1, 0, -1):
        for i in range(one):
            x, _ = _exchange(cells[i], cells[i], k)
            x, cells[one + i] = _exchange(x, cells[one + i], k)
            if not flat:
                x, cells[two + i] = _exchange(x, cells[two + i], k)
            cells[i] = x
    for i in range(one):
        cells[one + i] ^= cells[i]
        cells[two + i] = np.int64(0) if flat else cells[two + i] ^ cells[one + i]
    for i in range(one):
        last, turned = cells[one + i] if flat else cells[two + i], np.int64(0)
        for k in range(1, bits):
            turned ^= ((np.int64(1) << k) - 1) & -((last >> k) & 1)
        x, y, z, key = cells[i] ^ turned, cells[one + i] ^ turned, cells[two + i] ^ turned, np.int64(0)
        for k in range(bits - 1, -1, -1):
            key = (key << 2) | (((x >> k) & 1) << 1) | ((y >> k) & 1)
            if not flat:
                key = (key << 1) | ((z >> k) & 1)
        cells[i] = key


@kernel
def _cell(x: float, low: float, pace: float, cells: Any) -> Any:
    """Return the index of the cell that contains x, of `cells` along an axis; 0 for NaN."""
    at = (np.float64(x) - low) * pace
    return np.int64(min(at, np.float64(cells - 1)) if at > 0.0 else 0.0)


@kernel
def _write_keys(keys: Any, first: int, end: int, cells: Any, flat: bool, bits: int) -> None:
    """Write the keys of agents [first, end), at most TOGETHER."""
    _curve_positions(cells, flat, bits)
    for i in range(first, end):
        keys[i] = cells[i - first]


@kernel
def _sort(keys: Any, places: Any, digits: Any, count: int, room: int) -> None:
    """Sort the first `count` keys, and `places` in the same order (stable radix sort); arrays of length 2 `room`."""
    for turn in range(TURNS):
        source = turn % 2 * room
        to, shift = room - source, turn * DIGIT
        for k in range(BUCKETS):
            digits[k] = 0
        for i in range(source, source + count):
            digits[(keys[i] >> shift) & (BUCKETS - 1)] += 1
        total = to
        for k in range(BUCKETS):
            here = digits[k]
            digits[k] = total
            total += here
        for i in range(source, source + count):
            digit = (keys[i] >> shift) & (BUCKETS - 1)
            at = digits[digit]
            digits[digit] += 1
            keys[at], places[at] = keys[i], places[i]


@kernel
def sort_along_curve(
    pos: Any, living: Any, mass: Any, n: int, lanes: int, sync: Any, bounds: Any, size: Any, keys: Any, places: Any,
    digits: Any, leaves: Any,
) -> int:  # fmt: skip
    """Sort the living agents along the curve and write their blocks; return the number of living agents.

    pos: blocks of (D, lanes) m; living, mass (agents, padded). Writes places: the agent at each position of the order;
    leaves: blocks of (D + 1, lanes), coordinates m and mass kg. Lanes beyond the last agent repeat it.
    """
    d = len(size)
    low, lengths = region(pos, living, 0, (n + lanes - 1) // lanes, lanes, 0, 1, sync, bounds, size, False)
    bits = 31 if d == 2 else 21
    cells, longest = np.int64(1) << bits, max(lengths[0], max(lengths[1], lengths[d - 1]))
    pace = cells / longest if longest > 1e-290 else 0.0
    room, count = len(keys) // 2, 0
    for i in range(n):
        if living[i] > 0:
            at, k = place_of(i, d, lanes), count % TOGETHER
            digits[k] = _cell(pos[at], low[0], pace, cells)
            digits[TOGETHER + k] = _cell(pos[at + lanes], low[1], pace, cells)
            digits[2 * TOGETHER + k] = _cell(pos[at + (d - 1) * lanes], low[d - 1], pace, cells)
            places[count] = i
            count += 1
            if count % TOGETHER == 0:
                _write_keys(keys, count - TOGETHER, count, digits, d == 2, bits)
    _write_keys(keys, count // TOGETHER * TOGETHER, count, digits, d == 2, bits)
    _sort(keys, places, digits, count, room)
    for i in range((count + lanes - 1) // lanes * lanes):
        who: Any = np.int64(places[min(i, count - 1)])
        source, to = place_of(who, d, lanes), place_of(i, d + 1, lanes)
        for k in range(d):
            leaves[to + k * lanes] = pos[source + k * lanes]
        leaves[to + d * lanes] = mass[who]
    return count


@kernel
def _leaf(leaves: Any, block: int, held: int, lanes: int, by_mass: bool, nodes: Any, at: int, d: int) -> None:
    """Write weight, centre and corners of a block of `held` agents."""
    first, total = block * (d + 1) * lanes, 0.0
    for l in range(held):  # noqa: E741  # a lane
        total += leaves[first + d * lanes + l] if by_mass else 1.0
    for k in range(d):
        low = high = leaves[first + k * lanes]
        moment = 0.0
        for l in range(held):  # noqa: E741
            x = leaves[first + k * lanes + l]
            moment += x * (leaves[first + d * lanes + l] if by_mass else 1.0)
            low, high = min(low, x), max(high, x)
        nodes[at + k], nodes[at + d + k], nodes[at + 2 * d + k] = moment / total, low, high
    nodes[at + 3 * d] = total


@kernel
def _join(nodes: Any, first: int, held: int, at: int, d: int) -> None:
    """Write weight, centre and corners of a node with `held` children, whose records are contiguous."""
    size, total = 3 * d + 3, 0.0
    for c in range(held):
        total += nodes[first + c * size + 3 * d]
    for k in range(d):
        low, high, moment = nodes[first + d + k], nodes[first + 2 * d + k], 0.0
        for c in range(held):
            child = first + c * size
            moment += np.float64(nodes[child + k]) * nodes[child + 3 * d]
            low, high = min(low, nodes[child + d + k]), max(high, nodes[child + 2 * d + k])
        nodes[at + k], nodes[at + d + k], nodes[at + 2 * d + k] = moment / total, low, high
    nodes[at + 3 * d] = total


@kernel
def _measure(nodes: Any, at: int, d: int) -> None:
    """Write the longest edge of a node, and the distance of its centre from the middle of its box.

    The centre is clamped to the box, so that rounding does not move it away from agents that are all in one place.
    """
    edge, square = 0.0, 0.0
    for k in range(d):
        low, high = nodes[at + d + k], nodes[at + 2 * d + k]
        centre = min(max(nodes[at + k], low), high)
        nodes[at + k] = centre
        edge = max(edge, np.float64(high - low))
        off = np.float64(centre) - 0.5 * (np.float64(low) + np.float64(high))
        square += off * off
    nodes[at + 3 * d + 1], nodes[at + 3 * d + 2] = edge, np.sqrt(square)


@kernel
def build_tree(leaves: Any, count: int, lanes: int, size: Any, by_mass: bool, digits: Any, nodes: Any) -> None:
    """Build the tree over the blocks of `count` agents; the weight of a node is their mass or their number.

    Writes nodes, a record each (see `tree_sizes`), level after level; digits[BUCKETS + k]: the first node of level k,
    digits[BUCKETS + LEVELS]: the highest level.
    """
    d = len(size)
    record, held = 3 * d + 3, (count + lanes - 1) // lanes
    digits[BUCKETS], digits[BUCKETS + 1], level = 0, held, 0
    for block in range(held):
        _leaf(leaves, block, min(lanes, count - block * lanes), lanes, by_mass, nodes, block * record, d)
        _measure(nodes, block * record, d)
    while held > 1:
        below, first = digits[BUCKETS + level], digits[BUCKETS + level + 1]
        above = (held + CHILDREN - 1) // CHILDREN
        for i in range(above):
            at, children = (first + i) * record, min(CHILDREN, held - i * CHILDREN)
            _join(nodes, (below + i * CHILDREN) * record, children, at, d)
            _measure(nodes, at, d)
        level, held = level + 1, above
        digits[BUCKETS + level + 1] = first + held
    digits[BUCKETS + LEVELS] = level


@kernel
def _next_node(level: int, node: int, top: int, digits: Any) -> tuple[int, int]:
    """Return the next node (level, node) after this one and its descendants; level top + 1 if there is none."""
    while level < top and (
        node % CHILDREN == CHILDREN - 1 or digits[BUCKETS + level] + node + 1 == digits[BUCKETS + level + 1]
    ):
        level, node = level + 1, node // CHILDREN
    return (level, node + 1) if level < top else (top + 1, node)


@kernel
def _is_far(nodes: Any, own: int, at: int, slack: float, d: int) -> bool:
    """Return True if a block's box is further than edge / angle + shift from a node's centre (Barnes 1994).

    For angles up to 1 this is never true of a node that contains the block itself.
    """
    square = 0.0
    for k in range(d):
        x = nodes[at + k]
        gap = np.float64(max(nodes[own + d + k] - x, x - nodes[own + 2 * d + k]))
        square += gap * gap if gap > 0.0 else 0.0
    bound = nodes[at + 3 * d + 1] * slack + nodes[at + 3 * d + 2]
    return bool(square > bound * bound)


@kernel
def gather(
    leaves: Any, nodes: Any, digits: Any, count: int, lanes: int, size: Any, by_mass: bool, angle: float, block: int,
    level: int, node: int, listed: Any, first: int,
) -> tuple[int, int, int]:  # fmt: skip
    """List the sources of a block, from a node on, until the list has no room for another leaf.

    Returns the number of sources, and the level and node to continue with. Writes, from listed[first] on, D coordinates
    of each source's centre, m, and its weight.
    """
    d = len(size)
    record, top, many, slack = 3 * d + 3, digits[BUCKETS + LEVELS], 0, 1.0 / np.float64(angle)
    while level <= top and many + lanes <= LISTED:
        at, to = (digits[BUCKETS + level] + node) * record, first + many * (d + 1)
        if _is_far(nodes, block * record, at, slack, d):
            for k in range(d):
                listed[to + k] = nodes[at + k]
            listed[to + d] = nodes[at + 3 * d]
            many += 1
            level, node = _next_node(level, node, top, digits)
        elif level > 0:
            level, node = level - 1, node * CHILDREN
        else:
            held, source = min(lanes, count - node * lanes), node * (d + 1) * lanes
            for l in range(held):  # noqa: E741  # a lane
                for k in range(d):
                    listed[to + k] = leaves[source + k * lanes + l]
                listed[to + d] = leaves[source + d * lanes + l] if by_mass else 1.0
                to += d + 1
            many += held
            level, node = _next_node(level, node, top, digits)
    return many, level, node
