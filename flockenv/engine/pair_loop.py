"""The one loop over neighbours that all pair laws share: a block of listed agents and its candidates.

Every pair law is evaluated for every candidate, lane beside lane, and its sums keep the values for those in sight. Only
contact laws are evaluated just for candidates that some agent of the block may touch, because these are few. A
topological sight needs a pass before that one, which finds the distances of its k nearest neighbours.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.lane_access import gather, scatter
from flockenv.engine.neighbour_lists import list_living, walk_blocks
from flockenv.engine.neighbour_records import (
    Besides,
    Block,
    Candidate,
    listed_agent,
    listed_candidate,
    separation_direction_of,
    with_tie,
)
from flockenv.engine.pair_plan import Pairs
from flockenv.engine.pair_sums import add_candidate, begin_sums, finish_sums, keep_nearest, write_sums
from flockenv.jit.decorators import kernel, like
from flockenv.jit.intrinsics import count_as_float, count_if, wait_for_team
from flockenv.jit.section import section
from flockenv.maths.vectors import dot, exact_dot, sub
from flockenv.physics.effects.effect import Other
from flockenv.steering.others import ONE_PLACE

__all__ = ["sum_pair_laws"]

APART, OTHER, TOGETHER = "in another place", "another agent", "another agent in the same place"
NEAREST, CONTACTS = "another agent, to find the nearest", "another agent that may be touched"
"""Which candidates a pass is about: ties are read only of those in the same position, if laws allow it."""


@section
def _visit_lanes(plan: Pairs, which: str, wrapped: bool, each: Callable[..., None]) -> Callable[..., bool]:
    """Make `lanes_meet(numbers, besides, block, j, it)`: call `each` for all lanes of a block and candidate j.

    It returns True if some agent may touch the candidate. wrapped: True if the nearest image around the edge of a
    periodic box is used.
    """
    width, parting, masks, sorts = plan.lanes, plan.parting, plan.masks, plan.listing.sorts
    agent, offset_to = listed_agent(plan.listing, plan.inner, plan.oriented), plan.offset_to
    exact, periodic = any(view.near[1] for view in plan.views), wrapped
    together, apart = which == TOGETHER, which == APART
    contacts = tuple(sorted({law.sight for law in plan.laws if law.contact}))
    touches, tied = bool(contacts) and which in (APART, OTHER), together and plan.seldom
    within: Any = _within_any(contacts) if touches else None
    tie = separation_direction_of(plan.listing.dimension, width)
    here, home = plan.listing.slot("here0"), plan.listing.slot("home0")

    def lanes_meet(numbers: Any, besides: Any, block: Any, j: Any, it: Any) -> Any:
        lanes, size = block.lanes, numbers.size
        own, o, touch = np.int32(j - block.at), like(numbers.reach, -0.0), False
        for lane in range(np.uint64(width)):
            me = agent(block.mine, block.first + lane, block.time, block.random_key)
            if tied:  # lanes beyond the last agent hold stale numbers
                mine = (
                    np.uint64(lanes[home + lane])
                    if sorts
                    else np.uint64(besides.separation_directions[2][block.at + lane])
                )
                me = with_tie(
                    me, tie(besides.separation_directions, mine if block.at + lane < block.upto else np.uint64(0))
                )
            to = offset_to(size, me.pos, it.pos) if periodic else sub(it.pos, me.pos)
            square = exact_dot(to, to) if exact else dot(to, to)
            if apart:
                other = square > like(square, ONE_PLACE)
            elif together:
                other = (own != block.number[lane]) & (square <= like(square, ONE_PLACE))
            else:
                other = own != block.number[lane]
            gap = square if masks else (square if other else like(square, np.inf))
            neighbour = Other(it.who, to, square, it.vel, it.radius, it.tie, it.mass, it.inner)
            each(numbers, besides, me, neighbour, other, gap, o, lanes, lane)
            if apart and parting:
                lanes[here + lane] = count_if(lanes[here + lane], other)
            if touches:
                touch |= within(numbers.views, other, square)
        return touch

    return lanes_meet


@functools.cache
def _within_any(sights: tuple[int, ...]) -> Callable[..., bool]:
    """Make `within(views, other, square)`: return True if an agent may touch a candidate."""
    before, q = _within_any(sights[:-1]) if sights[1:] else None, sights[-1]

    def within(views: Any, other: Any, square: Any) -> Any:
        mine = other & (square < views[q].within)
        return mine if before is None else before(views, other, square) | mine

    return kernel(within)


@section
def _visit_candidates(plan: Pairs, which: str, wrapped: bool, each: Callable[..., None]) -> Callable[..., None]:
    """Make `visit(numbers, besides, block, r)`: apply `each` to a block and the candidates of range r."""
    candidate, sorts, length = (
        listed_candidate(plan.listing, plan.inner),
        plan.listing.sorts,
        np.uint64(plan.listing.length),
    )
    lanes_meet, tied = _visit_lanes(plan, which, wrapped, each), which == TOGETHER and plan.seldom
    tie = separation_direction_of(plan.listing.dimension, plan.lanes)
    contacts = which in (APART, OTHER) and any(law.contact for law in plan.laws)
    by_touch = _visit_lanes(plan, CONTACTS, wrapped, add_candidate(plan, True, False)) if contacts else None

    def visit(numbers: Any, besides: Any, block: Any, r: Any) -> None:
        j, last = np.uint64(block.ranges[r, 0]), np.uint64(block.ranges[r, 1])
        while j < last:
            at = j * length if sorts else j
            it = candidate(block.theirs, at)
            if tied:
                i = np.uint64(np.int32(block.theirs[at])) if sorts else np.uint64(besides.separation_directions[2][j])
                it = Candidate(
                    it.pos, it.vel, tie(besides.separation_directions, i), it.who, it.radius, it.mass, it.inner
                )
            touch = lanes_meet(numbers, besides, block, j, it)
            if by_touch is not None:  # noqa: SIM102  # numba drops the branch by this alone
                if touch:
                    by_touch(numbers, besides, block, j, it)
            j += np.uint64(1)

    return visit


@section
def _visit_ahead(plan: Pairs, each: Callable[..., None]) -> Callable[..., None]:
    """Make `visit(numbers, besides, block, r)` for a small world: the next candidate's distance is computed early.

    The number behind the last candidate is arbitrary: a row has room for it, and its distance is never used.
    """
    listing, width, parting = plan.listing, plan.lanes, plan.parting
    agent, candidate = listed_agent(listing, plan.inner, plan.oriented), listed_candidate(listing, plan.inner)
    d, periodic, offset_to = listing.dimension, listing.periodic, plan.offset_to
    exact = any(view.near[1] for view in plan.views)
    place, next_offset = listing.candidate_places(listing.axes("x")), plan.slots(int(listing.slot("next0")), d)
    square_at, here = listing.slot(f"next{d}"), listing.slot("here0")

    def visit(numbers: Any, besides: Any, block: Any, r: Any) -> None:
        rows, lanes, size = block.theirs, block.lanes, numbers.size
        o = like(numbers.reach, -0.0)
        j, last = np.uint64(block.ranges[r, 0]), np.uint64(block.ranges[r, 1])
        following = gather(rows, j, place)
        for lane in range(np.uint64(width)):
            me = agent(rows, block.first + lane, block.time, block.random_key)
            onward = offset_to(size, me.pos, following) if periodic else sub(following, me.pos)
            scatter(lanes, lane, next_offset, onward)
            lanes[square_at + lane] = exact_dot(onward, onward) if exact else dot(onward, onward)
        while j < last:
            it = candidate(rows, j)
            j += np.uint64(1)
            following = gather(rows, j, place)
            for lane in range(np.uint64(width)):
                me = agent(rows, block.first + lane, block.time, block.random_key)
                onward = offset_to(size, me.pos, following) if periodic else sub(following, me.pos)
                further = exact_dot(onward, onward) if exact else dot(onward, onward)
                to, square = gather(lanes, lane, next_offset), lanes[square_at + lane]
                other = square > like(square, ONE_PLACE)
                neighbour = Other(it.who, to, square, it.vel, it.radius, it.tie, it.mass, it.inner)
                each(numbers, besides, me, neighbour, other, square, o, lanes, lane)
                if parting:
                    lanes[here + lane] = count_if(lanes[here + lane], other)
                scatter(lanes, lane, next_offset, onward)
                lanes[square_at + lane] = further

    return visit


@section
def _visit_ranges(plan: Pairs, which: str, each: Callable[..., None]) -> Callable[..., None]:
    """Make `visit(numbers, besides, block, found)`: apply `each` to a block and the candidates of all its ranges.

    Images are considered only around the edge of a periodic box. The rare pass over agents in the same position is
    compiled once, with images: the nearest image of a near agent is the agent itself.
    """
    listing = plan.listing
    ahead, both = plan.ahead and which == APART, listing.periodic and listing.sorts and which != TOGETHER
    one = _visit_ahead(plan, each) if ahead else _visit_candidates(plan, which, listing.periodic, each)
    plain = _visit_candidates(plan, which, False, each) if both else None

    def visit(numbers: Any, besides: Any, block: Any, found: Any) -> None:
        for r in range(found):
            if plain is not None:
                if block.ranges[r, 2] > 0:
                    one(numbers, besides, block, r)
                else:
                    plain(numbers, besides, block, r)
            else:
                one(numbers, besides, block, r)

    return visit


# --- a block ----------------------------------------------------------------------------------------------------------


@section
def _block(plan: Pairs) -> Callable[..., int]:
    """Make the function of one block for `walk_blocks`: evaluate pair laws, write sums; return the number of pairs."""
    begin, finish, write = begin_sums(plan), finish_sums(plan), write_sums(plan)
    visit = _visit_ranges(plan, APART if plan.parting else OTHER, add_candidate(plan, False, plan.parting))
    nearest = any(view.near[1] for view in plan.views)
    select = _visit_ranges(plan, NEAREST, keep_nearest(plan)) if nearest else None
    together = _visit_ranges(plan, TOGETHER, add_candidate(plan, False, False)) if plan.parting else None
    width, here, hides, sorts = plan.lanes, plan.listing.slot("here0"), plan.hidden is not None, plan.listing.sorts
    tied = plan.parting and plan.seldom

    def block_of(context: Any, shape: Any, first: Any, at: Any, upto: Any, found: Any, time: Any) -> Any:
        scratch, numbers, ranges = context.scratch, context.numbers, context.scratch.ranges
        if sorts:
            arrays = scratch.lanes, np.uint64(0), scratch.records
        else:
            arrays = scratch.sorted_rows, first, scratch.sorted_rows
        mine, begins, theirs = arrays
        block = Block(
            mine, begins, theirs, scratch.lanes, scratch.number, first, np.uint64(upto), ranges, time,
            context.key[context.b],
        )  # fmt: skip
        obstacles = context.obstacle_x, context.obstacle_radius, context.b
        besides = Besides(
            (context.obstacle_x, context.obstacle_radius, context.params, context.b) if hides else (),
            (scratch.tie, scratch.ident, scratch.order if not sorts else scratch.cell) if tied else (),
        )
        begin(numbers, obstacles, block)
        if select is not None:
            select(numbers, besides, block, found)
        interactions, others = 0, -1
        for r in range(found):
            interactions += (ranges[r, 1] - ranges[r, 0]) * (upto - at)
            others += ranges[r, 1] - ranges[r, 0]
        visit(numbers, besides, block, found)
        if together is not None:  # two agents rarely share a position
            crowded, all_of_them = False, like(numbers.reach, others)
            for lane in range(np.uint64(width)):
                crowded |= count_as_float(scratch.lanes[here + lane]) < all_of_them
            if crowded:
                together(numbers, besides, block, found)
        finish(numbers, block)
        by_number = shape[0] == 0 and context.present == context.n
        if sorts:
            write(scratch.pair_force, scratch.cell, block, by_number and not context.arranged)
        else:
            write(scratch.pair_force, scratch.order, block, by_number)
        return interactions

    return block_of


@section
def sum_pair_laws(plan: Pairs) -> Callable[..., None]:
    """Make `visit(context, pos, vel, time)`: write the sums of pair laws for this thread's blocks to `pair_force`.

    One listing per evaluation, one loop over candidates for all pair laws. A team of threads shares both.
    """
    list_all, walk = list_living(plan.listing), walk_blocks(plan.listing, _block(plan))
    folds = sum(law.joined is not None for law in plan.laws)

    def visit(context: Any, pos: Any, vel: Any, time: Any) -> None:
        scratch, work, b = context.scratch, context.work, context.b
        if context.rank == 0:
            work[b, 1] += 1
            work[b, 3] += folds * context.n * context.obstacle_radius.shape[1]
        shape = list_all(context, pos, vel)
        scratch.tally[context.rank] = walk(context, shape, time)
        wait_for_team(scratch.sync, context.team)  # `pair_force` was written by other threads
        if context.rank == 0:
            for r in range(context.team):
                work[b, 2] += scratch.tally[r]

    return visit
