"""Sums of pair laws for the agents of a block: how they begin, what a candidate adds, and how they are finished."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.blocks import place_of, vector_of
from flockenv.engine.lane_access import add_where, choose, copy_each, fill, gather, pick_items, scatter
from flockenv.engine.law_calls import arguments_of
from flockenv.engine.nearest import insert_distance
from flockenv.engine.neighbour_records import listed_agent
from flockenv.engine.pair_plan import PairLaw, Pairs
from flockenv.engine.visibility import is_blocked_of
from flockenv.jit.decorators import kernel, like
from flockenv.jit.intrinsics import count_as_float, count_if
from flockenv.jit.section import call_in_turn, section, tuple_from
from flockenv.maths.vectors import add, dot, zero
from flockenv.physics.effects.effect import Other, in_view

__all__ = ["add_candidate", "begin_sums", "finish_sums", "keep_nearest", "write_sums"]


# --- sights ---------------------------------------------------------------------------------------------------------


@section
def _is_in_sight(plan: Pairs, q: int, cut: bool) -> Callable[..., bool]:
    """Make `seen(numbers, besides, me, it, other, gap, lanes, lane)`: return True if a candidate is in a sight.

    cut: for a topological sight, True if the distances of its nearest neighbours are known already.
    """
    view, masks = plan.views[q], plan.masks
    hidden: Any = is_blocked_of(plan.hidden) if plan.hidden is not None else None
    fov, grouped, occluded, counts = view.fov, view.grouped, view.occluded, cut and view.near[1] > 0
    last = np.uint64(view.near[0] + max(view.near[1] - 1, 0) * plan.lanes)

    def seen(numbers: Any, besides: Any, me: Any, it: Any, other: Any, gap: Any, lanes: Any, lane: Any) -> Any:
        mine, square = numbers.views[q], it.square
        if masks:
            found = other & (square < mine.within)
        else:
            found = gap < mine.within
        if fov >= 0:
            found = in_view(numbers.views[fov].cone, me.heading, it.offset, square) & found
        if grouped:
            found = found & (it.who >= mine.first) & (it.who < mine.end)
        if occluded:  # an agent out of sight anyway needs no occlusion test
            obstacle_x, obstacle_radius, params, b = besides.scenery
            found = found and not hidden(
                obstacle_x, obstacle_radius, params, numbers.size, b, me.time, me.pos, it.offset
            )
        if counts:
            found = found & (square <= lanes[last + lane])
        return found

    return seen


# --- what a candidate adds --------------------------------------------------------------------------------------------


@section
def _add_one(plan: Pairs, law: PairLaw, q: int, apart: bool) -> Callable[..., None]:
    """Make `adds(numbers, me, it, seen, o, lanes, lane)`: add one candidate to the running numbers of a law.

    seen: for each sight that is tested, True if the candidate is in it; q: index of the law's sight in `seen`.
    """
    k, folds, vanishes, slots = law.k, law.start is not None, law.vanishes, plan.slots(law.first, law.sums)
    says_of = law.apart if apart and law.apart is not None else law.pair

    def adds(numbers: Any, me: Any, it: Any, seen: Any, o: Any, lanes: Any, lane: Any) -> None:
        if folds:
            was = gather(lanes, lane, slots)
            scatter(lanes, lane, slots, choose(seen[q], says_of(numbers.effects[k], me, it, was), was))
        elif vanishes:
            square = it.square if seen[q] else like(it.square, np.inf)
            far = Other(it.who, it.offset, square, it.vel, it.radius, it.tie, it.mass, it.inner)
            add_where(True, lanes, lane, slots, says_of(numbers.effects[k], me, far), o)
        else:
            add_where(seen[q], lanes, lane, slots, says_of(numbers.effects[k], me, it), o)

    return adds


@section
def add_candidate(plan: Pairs, touch: bool, apart: bool) -> Callable[..., None]:
    """Make `visit(numbers, besides, me, it, other, gap, o, lanes, lane)`: add one candidate to the sums of all laws.

    touch: True for contact laws, False for all others; apart: True if the candidate shares no agent's position.
    """
    laws = [law for law in plan.laws if law.contact == touch]
    laws.sort(key=lambda law: law.vanishes)  # one register less is needed while the first are computed
    sights = sorted({law.sight for law in laws})
    see = tuple_from(*(_is_in_sight(plan, q, True) for q in sights))
    add_all = call_in_turn(*(_add_one(plan, law, sights.index(law.sight), apart) for law in laws))
    counted = [(k, plan.views[q].counted) for k, q in enumerate(sights) if plan.views[q].counted >= 0]
    count, counts = call_in_turn(*(_count_one(*each) for each in counted)), bool(counted) and not touch
    some = bool(laws)

    def visit(
        numbers: Any, besides: Any, me: Any, it: Any, other: Any, gap: Any, o: Any, lanes: Any, lane: Any
    ) -> None:
        if some:
            seen = see(numbers, besides, me, it, other, gap, lanes, lane)
            if counts:
                count(seen, lanes, lane)
            add_all(numbers, me, it, seen, o, lanes, lane)

    return visit


@functools.cache
def _count_one(q: int, place: int) -> Callable[..., None]:
    """Make `count(seen, lanes, lane)`: count the candidates in a sight whose count laws read."""
    at = np.uint64(place)

    def count(seen: Any, lanes: Any, lane: Any) -> None:
        lanes[at + lane] = count_if(lanes[at + lane], seen[q])

    return kernel(count)


@section
def keep_nearest(plan: Pairs) -> Callable[..., None]:
    """Make a pass that keeps, for each topological sight, the squares of its nearest neighbours, in order.

    It has the arguments of the function that `add_candidate` makes.
    """
    keep = call_in_turn(*(_keep_one(plan, q) for q, view in enumerate(plan.views) if view.near[1]))

    def visit(
        numbers: Any, besides: Any, me: Any, it: Any, other: Any, gap: Any, o: Any, lanes: Any, lane: Any
    ) -> None:
        keep(numbers, besides, me, it, other, gap, lanes, lane)

    return visit


@section
def _keep_one(plan: Pairs, q: int) -> Callable[..., None]:
    see, slots = _is_in_sight(plan, q, False), plan.slots(*plan.views[q].near)

    def keep(numbers: Any, besides: Any, me: Any, it: Any, other: Any, gap: Any, lanes: Any, lane: Any) -> None:
        seen = see(numbers, besides, me, it, other, gap, lanes, lane)
        square = it.square if seen else like(it.square, np.inf)
        scatter(lanes, lane, slots, insert_distance(gather(lanes, lane, slots), square))

    return keep


# --- how sums begin and end -------------------------------------------------------------------------------------------


@section
def begin_sums(plan: Pairs) -> Callable[..., None]:
    """Make `begin(numbers, obstacles, block)`: initialise the running numbers of a block."""
    listing, width = plan.listing, plan.lanes
    sums = [slot for law in plan.laws if law.start is None for slot in plan.slots(law.first, law.sums)]
    sums += [int(listing.slot("here0"))] * plan.parting + [view.counted for view in plan.views if view.counted >= 0]
    clear, far = tuple(sums), tuple(slot for view in plan.views for slot in plan.slots(*view.near))
    starts = call_in_turn(*(_start(plan, law) for law in plan.laws if law.start is not None))
    folds = any(law.start is not None for law in plan.laws)
    agent = listed_agent(listing, plan.inner, plan.oriented)

    def begin(numbers: Any, obstacles: Any, block: Any) -> None:
        o = like(numbers.reach, 0.0)
        for lane in range(np.uint64(width)):
            fill(block.lanes, lane, clear, o)
            if folds:
                me = agent(block.mine, block.first + lane, block.time, block.random_key)
                starts(numbers, obstacles, me, block.lanes, lane)
            fill(block.lanes, lane, far, like(o, np.inf))

    return begin


@section
def _start(plan: Pairs, law: PairLaw) -> Callable[..., None]:
    """Make `start(numbers, obstacles, me, lanes, lane)`: write the initial numbers of a fold.

    If the fold is also one over obstacles, they come first: (obstacle_x, obstacle_radius, b).
    """
    begin, joined, offset_to, given = law.start, law.joined, plan.offset_to, arguments_of(law.k, law.images)
    slots, centre = plan.slots(law.first, law.sums), vector_of(plan.listing.dimension)

    def start(numbers: Any, obstacles: Any, me: Any, lanes: Any, lane: Any) -> None:
        p = given(numbers, me)
        found = begin(p, me)
        if joined is not None:
            x, radius, b = obstacles
            for m in range(radius.shape[1]):
                rho = radius[b, m]
                if rho > 0:
                    to = offset_to(numbers.size, me.pos, centre(x, b, m))
                    it = Other(like(rho, m), to, dot(to, to), zero(to), rho, zero(to), like(rho, np.inf), ())
                    found = joined(p, me, it, found)
        scatter(lanes, lane, slots, found)

    return start


@section
def finish_sums(plan: Pairs) -> Callable[..., None]:
    """Make `finish(numbers, block)`: compute the sum of each target from the running numbers of a block."""
    agent, width = listed_agent(plan.listing, plan.inner, plan.oriented), plan.lanes
    ends = call_in_turn(*(_end(plan, t) for t in range(len(plan.targets))))

    def finish(numbers: Any, block: Any) -> None:
        for lane in range(np.uint64(width)):
            me = agent(block.mine, block.first + lane, block.time, block.random_key)
            ends(numbers, me, block.lanes, lane)

    return finish


@section
def _end(plan: Pairs, target: int) -> Callable[..., None]:
    """Make `end(numbers, me, lanes, lane)`: add up the results of all laws with one target."""
    total = _total(plan, tuple(law for law in plan.laws if law.target == target))
    slots = plan.slots(plan.targets[target], plan.listing.dimension)
    return lambda numbers, me, lanes, lane: scatter(lanes, lane, slots, total(numbers, me, lanes, lane))


@section
def _total(plan: Pairs, laws: tuple[PairLaw, ...]) -> Callable[..., Any]:
    before, law = _total(plan, laws[:-1]) if laws[1:] else None, laws[-1]
    slots, finish, given = plan.slots(law.first, law.sums), law.finish, arguments_of(law.k, law.images)
    averages, many = law.averages, np.uint64(max(plan.views[law.sight].counted, 0))

    def total(numbers: Any, me: Any, lanes: Any, lane: Any) -> Any:
        p = given(numbers, me)
        sums = gather(lanes, lane, slots)
        if averages:
            mine = finish(p, me, sums + (count_as_float(lanes[many + lane]),))  # noqa: RUF005
        else:
            mine = finish(p, me, sums)
        return add(zero(me.pos) if before is None else before(numbers, me, lanes, lane), mine)

    return total


@section
def write_sums(plan: Pairs) -> Callable[..., None]:
    """Make `write(pair_force, order, block, by_number)`: write the sums of a block to `pair_force`, by agent."""
    width, sorts, home = plan.lanes, plan.listing.sorts, plan.listing.slot("home0")
    slots = tuple(slot for first in plan.targets for slot in plan.slots(first, plan.listing.dimension))
    rows, first = tuple(k * width for k in range(len(slots))), (0,) * len(slots)
    whole, place_in = np.uint64(len(slots)), place_of(len(slots), width)

    def write(pair_force: Any, order: Any, block: Any, by_number: Any) -> None:
        lanes, begin = block.lanes, np.uint64(0)
        if by_number:
            sources = pick_items((lanes,), (), first)
            copy_each(pair_force, block.at * whole, rows, sources, (begin,), first, slots, width)
        else:
            for lane in range(block.upto - block.at):
                i = np.uint64(lanes[home + lane]) if sorts else np.uint64(order[block.at + lane])
                scatter(pair_force, place_in(i), rows, gather(lanes, lane, slots))

    return write
