"""Reordering a large world for the duration of a call of several steps: near in space becomes near in memory.

Agents are numbered as the scene lists them, and consecutive agents lie anywhere in space: sorting them by cell takes an
access to distant memory per agent and step. So at the beginning of a call all data of an agent moves to the place of
its tile of cells, by number within a tile (`flockenv.geometry.spatial_sort`). Each step then sorts what is nearly
sorted, and at the end all agents move back. `ident` holds which agent lies where in between. Sums do not change: within
a cell agents are still visited in the order of their numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.blocks import arrays_of, place_of
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.engine.lane_access import gather, pick_items, places_each, scatter_each
from flockenv.engine.scratch import array_names
from flockenv.geometry.cell_list import FEWEST_ARRANGED, STEPS_ARRANGED, WORTH_ARRANGING
from flockenv.geometry.spatial_sort import count_tiles, find_home_tiles
from flockenv.jit.intrinsics import prefetch_for_write, wait_for_team
from flockenv.jit.section import section
from flockenv.jit.transpose import put_lines

__all__ = ["PackedFields", "arrange_plan", "move_back_of", "move_in_of"]

AHEAD = 64
"""How many agents ahead packed data is prefetched."""

_COMMON = {**dict.fromkeys(("mass", "radius", "max_speed", "max_force"), 0), "requested_force": 1}
"""Fields that all agents may share, and the index of the mask by which they are read, see `blocks.common_places`."""


class PackedFields(NamedTuple):
    """The numbers that are packed of each agent, from several arrays; see `lane_access.places_each`."""

    arrays: tuple[int, ...]  # in which array each lies
    which: tuple[int, ...]  # index of the start: of numbers, of vectors, and both again for what all agents may share
    further: tuple[int, ...]
    own: tuple[tuple[int, ...], ...]  # which numbers are the agent's own: always, or if mask 0, or 1, is not 0


class ArrangePlan(NamedTuple):
    """Constants of the code that reorders agents."""

    dimension: int
    width: int
    periodic: bool
    wraps: bool  # True if agents may lie outside a periodic box
    tracks_home_tiles: bool
    inner: bool
    fields: PackedFields
    size: int  # numbers of a packed agent, in whole cache lines


def arrange_plan(parts: KernelPlan) -> ArrangePlan:
    """Return the `ArrangePlan` of a scene."""
    names = array_names(parts)
    packed = [field.partition(" ") for field in parts.reordered_fields]  # an array, and for vectors the axis
    common = [_COMMON.get(name) for name, _, _ in packed]
    starts = [
        (2 if mask is not None else 0) + (1 if axis else 0) for mask, (_, _, axis) in zip(common, packed, strict=True)
    ]
    fields = PackedFields(
        tuple(names.index(name) for name, _, _ in packed),
        tuple(starts),
        tuple(int(axis) * parts.width if axis else 0 for _, _, axis in packed),
        tuple(tuple(k for k, mask in enumerate(common) if mask == kind) for kind in (None, 0, 1)),
    )
    wraps = parts.space.periodic and not parts.confines
    return ArrangePlan(
        parts.dimension, parts.width, parts.space.periodic, wraps, parts.tracks_home_tiles, bool(parts.inner), fields,
        parts.reordered_size,
    )  # fmt: skip


@section
def move_in_of(plan: ArrangePlan) -> Callable[..., bool]:
    """Make `move_in(scratch, numbers, count, share)`: move agents to their tiles, if that pays; return True if so.

    count: steps until they move back. share: (n, present, first, end, rank, team).
    """
    width, periodic, wraps, tracks_home_tiles = plan.width, plan.periodic, plan.wraps, plan.tracks_home_tiles
    reorder = _reorder(plan, True)

    def move_in(scratch: Any, numbers: Any, count: Any, share: Any) -> Any:
        n, present, first, end, rank, team = share
        arranged = False
        least = FEWEST_ARRANGED if team > 1 and count >= STEPS_ARRANGED else WORTH_ARRANGING
        if count > 1 and n >= least and present == n:
            shape = count_tiles(
                scratch.pos, scratch.living, first, end, width, rank, team, scratch.sync, scratch.bounds, numbers.size,
                numbers.reach, periodic, wraps, n, scratch.cell, scratch.start, scratch.offset,
            )  # fmt: skip
            arranged = shape[0] > 0
            if arranged:
                reorder(scratch, share)
                if tracks_home_tiles:
                    find_home_tiles(first, end, width, n, shape, scratch.start, scratch.home_tiles)
        return arranged

    return move_in


def move_back_of(plan: ArrangePlan) -> Callable[..., None]:
    """Return `move_back(scratch, share)`: move agents back to the places of their numbers."""
    return _reorder(plan, False)


@section
def _reorder(plan: ArrangePlan, to_tiles: bool) -> Callable[..., None]:
    """Make `reorder(scratch, share)`: pack this thread's agents, wait for all threads, and unpack the new ones.

    Packed agents go to distant places, in no order: to their tile, or to the place of their number. `cell` holds where;
    -1 is nowhere.
    """
    dimension, width, (arrays, which, further, _) = plan.dimension, plan.width, plan.fields
    size, count, wide = np.uint64(dimension * width), plan.size, np.uint64(plan.size)
    place_in, arrays_in, unpack = place_of(dimension, width), arrays_of(plan.inner), _unpack(plan)

    def reorder(scratch: Any, share: Any) -> None:
        n, _, first, end, rank, team = share
        buffer, cell, offset, spread = scratch.reorder_buffer, scratch.cell, scratch.offset, scratch.spread
        sources = pick_items(arrays_in(scratch, scratch.pos, scratch.vel), scratch, arrays)
        for block in range(np.uint64(first), np.uint64(end)):
            base, row = block * size, block * np.uint64(width)
            for i in range(row, min(row + np.uint64(width), np.uint64(n))):
                if to_tiles:
                    c = np.uint64(cell[i])
                    cell[i] = offset[rank, c]
                    offset[rank, c] += 1
                else:
                    cell[i] = np.int32(scratch.ident[i])
            starts = row, base, row & spread[0], base & spread[1]
            put_lines(buffer, sources, places_each(starts, which, further), width, cell, row, count, np.uint64(n))
        wait_for_team(scratch.sync, team)
        for i in range(np.uint64(first * width), np.uint64(min(end * width, n))):
            prefetch_for_write(buffer, (i + np.uint64(AHEAD)) * wide)
            unpack(scratch, sources, i, place_in(i))

    return reorder


@section
def _unpack(plan: ArrangePlan) -> Callable[..., None]:
    """Make `unpack(scratch, sources, i, place)`: unpack all data of agent i but what all agents share."""
    own = _unpack_fields(plan.fields, plan.fields.own[0])
    bodies, requests = _unpack_fields(plan.fields, plan.fields.own[1]), _unpack_fields(plan.fields, plan.fields.own[2])
    wide = np.uint64(plan.size)

    def unpack(scratch: Any, sources: Any, i: Any, place: Any) -> None:
        buffer, spread = scratch.reorder_buffer, scratch.spread
        own(buffer, i * wide, sources, i, place)
        if spread[0] > np.uint64(0):
            bodies(buffer, i * wide, sources, i, place)
        if spread[1] > np.uint64(0):
            requests(buffer, i * wide, sources, i, place)

    return unpack


@section
def _unpack_fields(fields: PackedFields, mine: tuple[int, ...]) -> Callable[..., None]:
    """Make `unpack_fields(packed, at, sources, i, place)`: write numbers of agent i that lie packed at `at`."""
    which, further = tuple(fields.which[k] % 2 for k in mine), tuple(fields.further[k] for k in mine)

    def unpack_fields(packed: Any, at: Any, sources: Any, i: Any, place: Any) -> None:
        scatter_each(pick_items(sources, (), mine), (i, place), which, further, gather(packed, at, mine))

    return unpack_fields
