"""Lists of the nearest agents of a block of a small world as keys: squares whose last bits are places.

Four candidates at once are sorted and merged with a list (`nearest.merge`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.blocks import vector_of
from flockenv.engine.lane_access import fill, gather, scatter
from flockenv.engine.nearest import AT_ONCE, merge
from flockenv.engine.query_plan import LookPlan
from flockenv.engine.scratch import SMALL_STRIDE
from flockenv.jit.decorators import like
from flockenv.jit.section import section
from flockenv.jit.simd_rows import float_as_key, key_as_float, key_of, pick, same_key, tag_of
from flockenv.maths.vectors import exact_dot, sub

__all__ = ["by_keys_of"]

NO_NEIGHBOUR = np.uint32(0xFFFFFFFF)
"""A key that sorts after those of all agents."""


@section
def by_keys_of(plan: LookPlan) -> Callable[..., bool]:
    """Make `by_keys(rows, number, lanes, near, span, block, n)`: keep lists of keys, and write them if certain.

    The lists are one longer than needed. If two neighbours of a list, or one and the edge of sight, differ in less than
    the bits that remain of a square, it returns False: then the lists must be computed again from squares.
    """
    width, lists, key = plan.listing.width, plan.slots("square", plan.agents + 1), _key(plan)
    write, place, write_positions = _write_keys(plan), plan.place, _write_positions(plan)

    def by_keys(rows: Any, number: Any, lanes: Any, near: Any, span: Any, block: Any, n: Any) -> Any:
        room, size = 1, span.size
        while room < n:
            room *= 2
        tags = np.int32(room - 1)
        edge = key_of(span.within, np.int32(0), tags)
        for lane in range(np.uint64(width)):
            fill(lanes, lane, lists, key_as_float(NO_NEIGHBOUR))
        for j in range(np.uint64(0), np.uint64(n), np.uint64(AT_ONCE)):
            for lane in range(np.uint64(width)):
                here, mine = gather(rows, block + lane, place), number[block + lane]
                come = (
                    key(rows, number, j, size, here, mine, tags),
                    key(rows, number, j + np.uint64(1), size, here, mine, tags),
                    key(rows, number, j + np.uint64(2), size, here, mine, tags),
                    key(rows, number, j + np.uint64(3), size, here, mine, tags),
                )
                scatter(lanes, lane, lists, merge(gather(lanes, lane, lists), come))
        sure = write(lanes, near, block, tags, edge)
        if sure:
            write_positions(rows, lanes, near, span, block, n, edge)
        return sure

    return by_keys


@section
def _key(plan: LookPlan) -> Callable[..., Any]:
    """Make `key(rows, number, j, size, here, mine, tags)`: the key of candidate j, for agent `mine` at `here`."""
    place, offset_to, periodic = plan.place, plan.offset_to, plan.listing.periodic

    def key(rows: Any, number: Any, j: Any, size: Any, here: Any, mine: Any, tags: Any) -> Any:
        there, tag = gather(rows, j, place), number[j]
        to = offset_to(size, here, there) if periodic else sub(there, here)
        found = key_of(exact_dot(to, to), tag, tags)
        return NO_NEIGHBOUR if tag == mine else found

    return key


@section
def _write_keys(plan: LookPlan) -> Callable[..., bool]:
    """Make `write(lanes, near, block, tags, edge)`: write the lists of a block.

    It returns True if rounding leaves no doubt about them.
    """
    width, many, squares = plan.listing.width, plan.agents, plan.listing.slot("square0")

    def write(lanes: Any, near: Any, block: Any, tags: Any, edge: Any) -> Any:
        doubt = False
        for lane in range(np.uint64(width)):
            i, count, following = block + lane, np.int32(0), float_as_key(lanes[squares + lane])
            for k in range(many):
                key, following = following, float_as_key(lanes[squares + np.uint64((k + 1) * width) + lane])
                seen = key < edge
                near.who[k, i] = tag_of(key, tags) if seen else np.int32(0)
                count += np.int32(1) if seen else np.int32(0)
                doubt |= (seen & same_key(key, following, tags)) | same_key(key, edge, tags)
            near.count[i] = count
        return not doubt

    return write


@section
def _write_positions(plan: LookPlan) -> Callable[..., None]:
    """Make `write_positions(rows, lanes, near, span, block, n, edge)`: positions of the nearest, and exact squares."""
    width, many, d, squares = plan.listing.width, plan.agents, plan.listing.dimension, plan.listing.slot("square0")
    first = np.uint64(plan.place[0])
    place, offset_to, periodic, listed_at = plan.place, plan.offset_to, plan.listing.periodic, vector_of(d)

    def write_positions(rows: Any, lanes: Any, near: Any, span: Any, block: Any, n: Any, edge: Any) -> None:
        listed, length, axes = np.uint64(near.who.shape[1]), np.uint64(SMALL_STRIDE), np.uint64(d)
        for k in range(many):
            line, beside = np.uint64(k) * listed + block, np.uint64(many) * listed
            pick(near.pos, line, beside, rows, first, length, axes, np.uint64(n), near.who, line, width)
            for lane in range(np.uint64(width)):
                i, here = block + lane, gather(rows, block + lane, place)
                there = listed_at(near.pos, k, i)
                to = offset_to(span.size, here, there) if periodic else sub(there, here)
                square, key = exact_dot(to, to), float_as_key(lanes[squares + np.uint64(k * width) + lane])
                near.square[k, i] = square if key < edge else like(span.within, np.inf)

    return write_positions
