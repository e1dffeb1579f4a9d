"""Listing of the living agents, each time forces are computed, so that neighbours lie side by side.

In a small world, or if a grid would have too few cells, they are listed by number and each agent is a candidate; else
they are sorted by cell. What is listed of each agent are its `fields`: in a small world a row for each field (`x0`,
`x1`, `v0`, ...), else a record for each agent. A team of threads makes the list together, each thread for its own
agents; each then walks through its own share of the blocks of listed agents.

A field is a letter and an axis of a vector (x position, v velocity, t tie, h heading that follows from v, d heading of
its own, a aim), or the name of a number (`who`, `radius`, `inner0`, ...).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from flockenv.engine.blocks import arrays_of, place_of
from flockenv.engine.lane_access import copy_each, gather, gather_each, pick_items, places_each, scatter
from flockenv.engine.scratch import SMALL_STRIDE, array_names
from flockenv.geometry.cell_list import DISTANT, candidates, count_cells, order_records, row_of
from flockenv.geometry.spatial_sort import FAR_FROM_HOME, count_from_home_tiles, order_cells, order_shared
from flockenv.jit.decorators import Law
from flockenv.jit.intrinsics import prefetch_for_write, wait_for_team
from flockenv.jit.section import section
from flockenv.jit.transpose import out_of_records, put_records
from flockenv.maths.vectors import unit

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import KernelPlan

__all__ = ["Listing", "list_living", "listing_of", "walk_blocks"]

AHEAD = np.uint64(8)
"""How many blocks ahead the places of records are prefetched."""

_ARRAYS = {"x": "pos", "v": "vel", "t": "tie", "d": "facing", "a": "aiming", "who": "ident"}
"""The array of each field whose name differs from its array's."""


class Listing(NamedTuple):
    """Which fields of each agent are listed, and how."""

    dimension: int
    width: int
    sorts: bool  # by cell, if the space has enough of them
    periodic: bool
    fields: tuple[str, ...]
    inside: bool  # True if all agents are inside a periodic box already
    tiled: bool  # True if agents may lie in the order of tiles, not by number
    tracks_home_tiles: bool  # True if the agents that have left their tiles are tracked
    confine: Law
    slots: tuple[tuple[str, int], ...]  # where running numbers of a block lie in the scratch `lanes`, by name
    arrays: tuple[str, ...]  # the names of `pos`, `vel` and inner states, which are passed separately, then of scratch

    def slot(self, name: str) -> np.uint64:
        """Return where the lanes of a running number begin."""
        return np.uint64(dict(self.slots).get(name, 0))

    @property
    def record(self) -> tuple[str, ...]:
        """The fields of an agent's record, after its place; headings follow from velocities."""
        return tuple(field for field in self.fields if field[0] != "h")

    @property
    def length(self) -> int:
        """How many numbers a record has."""
        return 1 + len(self.record)

    @property
    def has_headings(self) -> bool:
        """True if headings are computed from velocities."""
        return "h0" in self.fields

    @property
    def wraps(self) -> bool:
        """True if positions are wrapped into a periodic box first."""
        return self.periodic and not self.inside

    def sources(self) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
        """Return, for each field of a record, the array in which it lies, the start to count from, and the offset.

        The start is the number of an agent (0), or where its vectors begin (1); see `gather_each`.
        """
        found = []
        for field in self.record:
            letter, axis = (field[0], int(field[1:])) if field[1:].isdigit() else (field, None)
            array = self.arrays.index(_ARRAYS.get(letter, letter))
            found.append((array, 0, 0) if axis is None else (array, 1, axis * self.width))
        arrays, which, further = zip(*found, strict=True)
        return arrays, which, further

    def lanes_of(self, fields: Sequence[str]) -> tuple[int, ...]:
        """Return where fields of the agents of a block lie, lane beside lane; -1: nowhere."""
        return tuple(self._place(field) if field in self.fields else -1 for field in fields)

    def _place(self, field: str) -> int:
        """Return where the lanes of a field begin: in scratch, or in the rows of a small world."""
        k = self.fields.index(field)
        return int(self.slot(f"mine{k}")) if self.sorts else k * SMALL_STRIDE

    def candidate_places(self, fields: Sequence[str]) -> tuple[int, ...]:
        """Return where fields of a candidate lie: in its record, or in the rows of a small world; -1: nowhere.

        Headings are in no record: no law reads that of a candidate.
        """
        if not self.sorts:
            return self.lanes_of(fields)
        return tuple(1 + self.record.index(field) if field in self.record else -1 for field in fields)

    def axes(self, letter: str) -> tuple[str, ...]:
        """Return the fields of a vector."""
        return tuple(f"{letter}{k}" for k in range(self.dimension))


def listing_of(parts: KernelPlan, fields: list[str], inside: bool = False, tiled: bool = False) -> Listing:
    """Return how the agents of a scene are listed, with these fields of each."""
    slots = tuple((name, place * parts.width) for name, place in parts.slots.items())
    return Listing(
        parts.dimension, parts.width, parts.sorts, parts.space.periodic, tuple(fields), inside, tiled,
        tiled and parts.tracks_home_tiles, parts.space.confine_law, slots,
        array_names(parts),
    )  # fmt: skip


# --- listing ----------------------------------------------------------------------------------------------------------


@section
def list_living(plan: Listing) -> Callable[..., Any]:
    """Make `list_living(context, pos, vel)`: list the living of a world; return the shape of its grid of cells.

    That is (nx, ny, nz, fine, fold), or zeros if they are listed by number.
    """
    sorts, periodic, wraps, width, tracks_home_tiles = (
        plan.sorts,
        plan.periodic,
        plan.wraps,
        plan.width,
        plan.tracks_home_tiles,
    )
    by_number = (_list_as_records if sorts else _list_in_rows)(plan)
    by_cell: Any = _sort(plan) if sorts else None

    def list_all(context: Any, pos: Any, vel: Any) -> Any:
        scratch, team, rank = context.scratch, context.team, context.rank
        wait_for_team(scratch.sync, team)  # all threads have written their positions now
        shape = (0, 0, 0, 0, 0)
        if sorts:
            size, reach = context.numbers.size, context.numbers.reach
            if tracks_home_tiles:
                if context.arranged:
                    shape = count_from_home_tiles(
                        pos, scratch.living, context.first, context.end, width, rank, team, scratch.sync,
                        scratch.bounds, size, reach, periodic, wraps, context.n, scratch.home_tiles, scratch.displaced,
                        scratch.tally, scratch.cell, scratch.start, scratch.offset,
                    )  # fmt: skip
                else:
                    shape = count_cells(
                        pos, scratch.living, context.first, context.end, width, rank, team, scratch.sync,
                        scratch.bounds, size, reach, periodic, wraps, context.n, scratch.cell, scratch.start,
                        scratch.offset,
                    )  # fmt: skip
            else:
                shape = count_cells(
                    pos, scratch.living, context.first, context.end, width, rank, team, scratch.sync, scratch.bounds,
                    size, reach, periodic, wraps, context.n, scratch.cell, scratch.start, scratch.offset,
                )  # fmt: skip
            if shape[0] == 0:
                by_number(context, pos, vel)
            else:
                by_cell(context, pos, vel, shape)
        else:
            by_number(context, pos, vel)
        wait_for_team(scratch.sync, team)
        return shape

    return list_all


@section
def _list_in_rows(plan: Listing) -> Callable[..., None]:
    """Make `fill(context, pos, vel)`: list the living of a small world by number, a row for each field."""
    width, headed, arrays_in = plan.width, plan.has_headings, arrays_of("inner0" in plan.arrays)
    (arrays, which, further), to = plan.sources(), plan.lanes_of(plan.record)
    velocity, heading = plan.lanes_of(plan.axes("v")), plan.lanes_of(plan.axes("h"))
    size, place_in = plan.dimension * width, place_of(plan.dimension, width)

    def fill(context: Any, pos: Any, vel: Any) -> None:
        scratch, n = context.scratch, context.n
        rows = scratch.sorted_rows
        if context.rank == 0:
            sources = pick_items(arrays_in(scratch, pos, vel), scratch, arrays)
            if context.present == n:
                for block in range((n + width - 1) // width):
                    base, row = np.uint64(block * size), np.uint64(block * width)
                    copy_each(rows, row, to, sources, (row, base), which, further, width)
                    if headed:
                        for lane in range(np.uint64(width)):
                            scatter(rows, row + lane, heading, unit(gather(rows, row + lane, velocity)))
            else:
                at = np.uint64(0)
                for i in range(np.uint64(n)):
                    if scratch.living[i] > 0:
                        scratch.order[at] = i
                        scatter(rows, at, to, gather_each(sources, (i, place_in(i)), which, further))
                        if headed:
                            scatter(rows, at, heading, unit(gather(rows, at, velocity)))
                        at += np.uint64(1)

    return fill


@section
def _list_as_records(plan: Listing) -> Callable[..., None]:
    """Make `enter(context, pos, vel)`: list the living of a large world by number, a record each."""
    length, place_in, arrays_in = (
        np.uint64(plan.length),
        place_of(plan.dimension, plan.width),
        arrays_of("inner0" in plan.arrays),
    )
    (arrays, which, further), to = plan.sources(), tuple(range(1, plan.length))

    def enter(context: Any, pos: Any, vel: Any) -> None:
        scratch, n = context.scratch, context.n
        if context.rank == 0:
            sources, records = pick_items(arrays_in(scratch, pos, vel), scratch, arrays), scratch.records
            if context.arranged:  # all agents live, and lie by tile, not by number
                for place in range(np.uint64(n)):
                    scratch.cell[np.uint64(scratch.ident[place])] = place
            at = np.uint64(0)
            for number in range(np.uint64(n)):
                i: Any = np.uint64(scratch.cell[number]) if context.arranged else number
                if scratch.living[i] > 0:
                    records[at * length] = i
                    scatter(records, at * length, to, gather_each(sources, (i, place_in(i)), which, further))
                    at += np.uint64(1)

    return enter


@section
def _sort(plan: Listing) -> Callable[..., None]:
    """Make `sort(context, pos, vel, shape)`: put agents into their cells, as whole records.

    So each agent takes one access to distant memory, which is prefetched.
    """
    d, width, wraps, confine = plan.dimension, plan.width, plan.wraps, plan.confine
    length, arrays_in = np.uint64(plan.length), arrays_of("inner0" in plan.arrays)
    arrays, which, further = plan.sources()
    inside = tuple(int(plan.slot("inside0")) + k * width for k in range(d))
    if wraps:  # read wrapped positions from where they are written first: the lanes of this thread
        moved = [field[0] == "x" for field in plan.record]
        arrays = tuple(plan.arrays.index("lanes") if m else k for m, k in zip(moved, arrays, strict=True))
        which = tuple(2 if m else k for m, k in zip(moved, which, strict=True))
        lanes = iter(inside)
        further = tuple(next(lanes) if m else k for m, k in zip(moved, further, strict=True))
    order: Any = _order_in_cells(plan) if plan.tiled else None
    vector, size = tuple(k * width for k in range(d)), np.uint64(d * width)

    def sort(context: Any, pos: Any, vel: Any, shape: Any) -> None:
        scratch, n, rank = context.scratch, context.n, context.rank
        records, cell, offset = scratch.records, scratch.cell, scratch.offset
        sources = pick_items(arrays_in(scratch, pos, vel), scratch, arrays)
        for block in range(np.uint64(context.first), np.uint64(context.end)):
            base, row = block * size, block * np.uint64(width)
            if n >= DISTANT:
                later = np.uint64(min(block + AHEAD, np.uint64(context.end - 1)) * np.uint64(width))
                for lane in range(np.uint64(width)):
                    there = np.uint64(offset[rank, np.uint64(max(cell[later + lane], np.int32(0)))])
                    prefetch_for_write(records, there * length)
            if wraps:  # a stage of a method may have moved agents out of the box
                for lane in range(np.uint64(width)):
                    x = gather(pos, base + lane, vector)
                    within, _ = confine(context.numbers.size, scratch.radius[row + lane], x, x)
                    scatter(scratch.lanes, lane, inside, within)
            places = places_each((row, base, np.uint64(0)), which, further)
            put_records(records, sources, places, width, cell, row, offset[rank], np.uint64(n))
        if order is not None:  # noqa: SIM102  # numba drops the branch by this alone
            if context.arranged:
                wait_for_team(scratch.sync, context.team)
                order(context, shape)

    return sort


@section
def _order_in_cells(plan: Listing) -> Callable[..., None]:
    """Make `order(context, shape)`: sort records by number within each cell, if agents lie by tiles."""
    tracks_home_tiles, length, width = plan.tracks_home_tiles, plan.length, plan.width

    def order(context: Any, shape: Any) -> None:
        scratch, rank, team = context.scratch, context.rank, context.team
        records, ident, start, offset = scratch.records, scratch.ident, scratch.start, scratch.offset
        nx, rows, everything = shape[0], shape[1] * shape[2], True
        if tracks_home_tiles:
            away = np.int64(0)
            for r in range(team):
                away += scratch.tally[team + r]
            everything = away * FAR_FROM_HOME > context.n
        if everything:
            for line in range(rows * rank // team, rows * (rank + 1) // team):  # one row at a time stays in the cache
                mine: Any = np.int64(start[line * nx])
                beyond: Any = np.int64(start[(line + 1) * nx])
                order_records(records, scratch.cell, ident, length, mine, beyond, offset[rank])
        elif tracks_home_tiles:
            first = context.first * width
            till = first + scratch.tally[team + rank]
            order_cells(records, length, ident, start, offset, rank, scratch.displaced, first, till)
            if team > 1:
                cells = nx * rows
                here, there = cells * rank // team, cells * (rank + 1) // team
                order_shared(records, length, ident, start, offset, team, here, there)

    return order


# --- walking ----------------------------------------------------------------------------------------------------------


@section
def _take(plan: Listing) -> Callable[..., None]:
    """Make `take(lanes, records, block)`: copy the records of a block to lanes, which its laws then read."""
    width, headed = plan.width, plan.has_headings
    to = (int(plan.slot("home0")), *plan.lanes_of(plan.record))
    first = (0,) * len(to)
    velocity, heading = plan.lanes_of(plan.axes("v")), plan.lanes_of(plan.axes("h"))

    def take(lanes: Any, records: Any, block: Any) -> None:
        out_of_records(lanes, places_each((np.uint64(0),), first, to), block, width, records)
        if headed:
            for lane in range(np.uint64(width)):
                scatter(lanes, lane, heading, unit(gather(lanes, lane, velocity)))

    return take


@section
def walk_blocks(plan: Listing, visit: Callable[..., int]) -> Callable[..., int]:
    """Make `walk(context, shape, time)`: call `visit` for each of this thread's blocks; return the sum of its results.

    `visit` is passed context, shape, block, at, upto, found, time: the block is [at, upto), and its candidates are the
    first `found` ranges of listed agents in `scratch.ranges`.
    """
    width, sorts, periodic = plan.width, plan.sorts, plan.periodic
    take: Any = _take(plan) if sorts else None

    def walk(context: Any, shape: Any, time: Any) -> Any:
        scratch, present, rank, team = context.scratch, context.present, context.rank, context.team
        ranges, nx = scratch.ranges, shape[0]
        blocks = (present + width - 1) // width
        at, stop = blocks * rank // team * width, min(blocks * (rank + 1) // team * width, present)
        interactions, line, spot = 0, 0, 0
        if sorts:
            start = scratch.start
            if nx > 0:  # whole rows of cells, so that blocks are the same for any number of threads
                rows = shape[1] * shape[2]
                while line < rows and start[line * nx] * team < present * rank:
                    line += 1
                until = line
                while until < rows and start[until * nx] * team < present * (rank + 1):
                    until += 1
                at, stop = np.int64(start[line * nx]), np.int64(start[until * nx])
        while at < stop:
            found = 1
            upto = min(at + width, present)
            if sorts:
                if nx == 0:
                    ranges[0, 0], ranges[0, 1], ranges[0, 2] = 0, present, 1
                else:
                    line = row_of(at, start, line, nx)
                    upto = min(at + width, np.int64(start[(line + 1) * nx]))
                    found, spot = candidates(at, upto, line, max(spot, line * nx), shape, start, periodic, ranges)
                take(scratch.lanes, scratch.records, np.uint64(at))
            else:
                ranges[0, 0], ranges[0, 1], ranges[0, 2] = 0, present, 1
            interactions += visit(context, shape, np.uint64(at), at, upto, found, time)
            at = upto
        return interactions

    return walk
