"""The query of tasks, `look`: it finds the agents near each agent of a world, for observations and rewards.

It lists agents as pair laws do, and keeps, for each lane, sorted lists of the nearest few.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.blocks import into_blocks, vector_of, vector_of_lane
from flockenv.engine.lane_access import fill, gather, scatter
from flockenv.engine.nearest import AT_ONCE, insert
from flockenv.engine.neighbour_lists import list_living, walk_blocks
from flockenv.engine.query_keys import by_keys_of
from flockenv.engine.query_plan import Looking, LookPlan, Nearest, Span
from flockenv.jit.decorators import like
from flockenv.jit.section import section
from flockenv.maths.vectors import dot, exact_dot, norm, sub

__all__ = ["look_of"]


@section
def look_of(plan: LookPlan) -> Callable[..., bool]:
    """Make `look(x, alive, obstacle_x, obstacle_radius, b, params, near_square, ..., near_pos, scratch)`.

    It writes, for every agent of world b, the nearest agents (K, N) and obstacles (J, N), and how many (N,). A missing
    one is infinitely far, with an arbitrary number: for agents, one that exists. It returns True if it has also written
    the positions of the agents (D, K, N).
    """
    width, at, agents, obstacles = plan.listing.width, plan.at, plan.agents > 0, plan.obstacles > 0
    axes, into = tuple(range(plan.listing.dimension)), into_blocks(plan.listing.dimension, plan.listing.width)
    among, around = _among_agents(plan) if agents else None, _among_obstacles(plan) if obstacles else None

    def look(
        x: Any, alive: Any, obstacle_x: Any, obstacle_radius: Any, b: int, params: Any, near_square: Any, near_who: Any,
        near_count: Any, obstacle_gap: Any, obstacle_who: Any, obstacle_count: Any, near_pos: Any, scratch: Any,
    ) -> bool:  # fmt: skip
        n = x.shape[2]
        first, end, present = 0, (n + (width - 1)) // width, 0
        span = Span(gather(params, np.uint64(0), axes), params[at], params[at + 1])
        for i in range(n):
            present += alive[b, i]
            scratch.living[i] = alive[b, i]
        for i in range(n if present < n else 0):  # dead agents are not searched for; obstacles are found for all
            near_count[i] = 0
            for k in range(near_square.shape[0]):
                near_square[k, i] = np.inf
        into(scratch.pos, x, b, n, first, end)
        placed = False
        if agents:
            near = Nearest(near_square, near_who, near_count, near_pos)
            placed = among(Looking(span, near, n, present, False, first, end, 0, 1, scratch))  # type: ignore[misc]
        if obstacles:
            around(  # type: ignore[misc]
                obstacle_x, obstacle_radius, b, span, scratch.pos, scratch.lanes, end, obstacle_gap, obstacle_who,
                obstacle_count,
            )  # fmt: skip
        return placed

    return look


# --- agents -----------------------------------------------------------------------------------------------------------


@section
def _among_agents(plan: LookPlan) -> Callable[[Any], bool]:
    """Make `among(looking)`: write the nearest agents of each agent, block by block; return as `look` does."""
    list_all, walk, keyed = list_living(plan.listing), walk_blocks(plan.listing, _block(plan)), plan.keyed
    x_at = np.uint64(max(plan.place[0], 0))

    def among(looking: Any) -> Any:
        scratch = looking.scratch
        shape = list_all(looking, scratch.pos, scratch.vel)
        if keyed:  # candidates after the last one: infinitely far, NaN around a box
            for j in range(np.uint64(looking.n), np.uint64(looking.n + (AT_ONCE - 1))):
                scratch.sorted_rows[x_at + j] = np.inf
        unsure = walk(looking, shape, looking.numbers.reach)
        return keyed and unsure == 0

    return among


@section
def _block(plan: LookPlan) -> Callable[..., int]:
    """Make the function of one block for `walk_blocks`; it returns 1 if keys were not used for the block, else 0."""
    sorts, keyed = plan.listing.sorts, plan.keyed
    by_keys, by_squares, write = by_keys_of(plan) if keyed else None, _by_squares(plan), _write_lists(plan)

    def block(looking: Any, shape: Any, block: Any, at: Any, upto: Any, found: Any, time: Any) -> Any:
        scratch, near, span = looking.scratch, looking.near, looking.numbers
        all_alive, sure = looking.present == looking.n, False
        if keyed:  # noqa: SIM102  # numba drops the branch by this alone
            if all_alive:
                sure = by_keys(scratch.sorted_rows, scratch.number, scratch.lanes, near, span, block, looking.n)  # type: ignore[misc]
        if not sure:
            if sorts:
                by_squares(
                    scratch.lanes, np.uint64(0), scratch.records, scratch.number, scratch.lanes, span, block,
                    scratch.ranges, found,
                )  # fmt: skip
                write(scratch.records, scratch.lanes, near, block, upto, shape[0] == 0 and all_alive)
            else:
                by_squares(
                    scratch.sorted_rows, block, scratch.sorted_rows, scratch.number, scratch.lanes, span, block,
                    scratch.ranges, found,
                )  # fmt: skip
                write(scratch.order, scratch.lanes, near, block, upto, all_alive)
        return 0 if sure else 1

    return block


@section
def _by_squares(plan: LookPlan) -> Callable[..., None]:
    """Make `by_squares(mine, first, theirs, number, lanes, span, block, ranges, found)`: keep lists of squares.

    Images are considered only around the edge of a periodic box.
    """
    listing, width = plan.listing, plan.listing.width
    squares, places = plan.slots("square", plan.agents), plan.slots("place", plan.agents)
    visit, both = _insert_candidates(plan, listing.periodic), listing.periodic and listing.sorts
    plain = _insert_candidates(plan, False) if both else None

    def by_squares(
        mine: Any, first: Any, theirs: Any, number: Any, lanes: Any, span: Any, block: Any, ranges: Any, found: Any
    ) -> None:  # fmt: skip
        for lane in range(np.uint64(width)):
            fill(lanes, lane, squares, like(span.within, np.inf))
            fill(lanes, lane, places, like(span.within, 0.0))
        for r in range(found):
            j, last = np.uint64(ranges[r, 0]), np.uint64(ranges[r, 1])
            if plain is not None:
                if ranges[r, 2] > 0:
                    visit(mine, first, theirs, number, lanes, span, block, j, last)
                else:
                    plain(mine, first, theirs, number, lanes, span, block, j, last)
            else:
                visit(mine, first, theirs, number, lanes, span, block, j, last)

    return by_squares


@section
def _insert_candidates(plan: LookPlan, wrapped: bool) -> Callable[..., None]:
    """Make `visit(mine, first, theirs, number, lanes, span, block, j, last)`: insert candidates [j, last)."""
    listing, width, exact, offset_to = plan.listing, plan.listing.width, plan.exact, plan.offset_to
    length = np.uint64(listing.length if listing.sorts else 1)
    place, there = plan.place, listing.candidate_places(listing.axes("x"))
    slots = plan.slots("square", plan.agents) + plan.slots("place", plan.agents)

    def visit(
        mine: Any, first: Any, theirs: Any, number: Any, lanes: Any, span: Any, block: Any, j: Any, last: Any
    ) -> None:  # fmt: skip
        while j < last:
            candidate, own = gather(theirs, j * length, there), np.int32(j - block)
            for lane in range(np.uint64(width)):
                here = gather(mine, first + lane, place)
                to = offset_to(span.size, here, candidate) if wrapped else sub(candidate, here)
                square = exact_dot(to, to) if exact else dot(to, to)
                seen = (own != number[lane]) & (square < span.within)
                far = square if seen else like(square, np.inf)
                scatter(lanes, lane, slots, insert(gather(lanes, lane, slots), far, like(square, j)))
            j += np.uint64(1)

    return visit


@section
def _write_lists(plan: LookPlan) -> Callable[..., None]:
    """Make `write(listed, lanes, near, block, upto, by_number)`: write the lists of a block to the output arrays.

    listed: records, or the numbers of agents in the order of listing. by_number: True if lane k is agent block + k.
    """
    listing, width, many = plan.listing, plan.listing.width, plan.agents
    squares, places, home = listing.slot("square0"), listing.slot("place0"), listing.slot("home0")
    sorts, length = listing.sorts, np.uint64(listing.length)

    def write(listed: Any, lanes: Any, near: Any, block: Any, upto: Any, by_number: Any) -> None:
        if by_number:
            for lane in range(np.uint64(width)):
                i, count = block + lane, np.int32(0)
                for k in range(many):
                    at = np.uint64(k * width) + lane
                    square = lanes[squares + at]
                    near.square[k, i] = square
                    near.who[k, i] = np.int32(lanes[places + at])
                    count += np.int32(1) if square < np.inf else np.int32(0)
                near.count[i] = count
        else:
            for lane in range(np.uint64(upto) - block):
                i, count = np.uint64(lanes[home + lane]) if sorts else np.uint64(listed[block + lane]), np.int32(0)
                for k in range(many):
                    at = np.uint64(k * width) + lane
                    square, place = lanes[squares + at], np.uint64(lanes[places + at])
                    near.square[k, i] = square
                    near.who[k, i] = np.int32(listed[place * length]) if sorts else listed[place]
                    count += np.int32(1) if square < np.inf else np.int32(0)
                near.count[i] = count

    return write


# --- obstacles --------------------------------------------------------------------------------------------------------


@section
def _among_obstacles(plan: LookPlan) -> Callable[..., None]:
    """Make `around(obstacle_x, obstacle_radius, b, span, pos, lanes, end, gap, who, count)`: write the nearest.

    For each agent the obstacles whose surfaces are nearest: their distances (J, N), m, their numbers (J, N), how many
    (N,).
    """
    d, width, many, offset_to = plan.listing.dimension, plan.listing.width, plan.obstacles, plan.offset_to
    vector, circle, size = vector_of_lane(d, width), vector_of(d), d * width
    gaps, names = plan.slots("gap", many), plan.slots("which", many)
    gap_at, name_at, slots = plan.listing.slot("gap0"), plan.listing.slot("which0"), gaps + names

    def around(
        obstacle_x: Any, obstacle_radius: Any, b: int, span: Any, pos: Any, lanes: Any, end: Any, gap: Any, who: Any,
        count: Any,
    ) -> None:  # fmt: skip
        for block in range(end):
            base = np.uint64(block * size)
            for lane in range(np.uint64(width)):
                fill(lanes, lane, gaps, like(span.reach, np.inf))
                fill(lanes, lane, names, like(span.reach, 0.0))
            for m in range(obstacle_radius.shape[1]):
                rho = obstacle_radius[b, m]
                centre = circle(obstacle_x, b, m)
                limit = span.reach if rho > 0 else like(span.reach, -np.inf)  # no branch: lists stay in registers
                for lane in range(np.uint64(width)):
                    far = norm(offset_to(span.size, vector(pos, base + lane), centre)) - rho
                    far = far if far < limit else like(rho, np.inf)
                    scatter(lanes, lane, slots, insert(gather(lanes, lane, slots), far, like(rho, m)))
            for lane in range(np.uint64(width)):
                i, found = np.uint64(block * width) + lane, np.int32(0)
                for k in range(many):
                    at = np.uint64(k * width) + lane
                    gap[k, i] = lanes[gap_at + at]
                    who[k, i] = np.int32(lanes[name_at + at])
                    found += np.int32(1) if lanes[gap_at + at] < np.inf else np.int32(0)
                count[i] = found

    return around
