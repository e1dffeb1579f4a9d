"""A large world is put in order for as long as a call of several steps lasts: near in space is near in memory.

Agents are numbered as the scene lists them, and neighbours by number lie anywhere in space: sorting them by cell is one
distant place in memory per agent and step. So at the beginning of a call all that is known of an agent moves to where
its tile of cells comes, by number within (`flockenv.geometry.spatial_sort`). Each step then sorts what is nearly
sorted; and at the end all agents go home. `ident` says which agent is where in between. Sums do not notice: within a
cell agents are met in the order of their numbers all the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.blocks import handed_of, place_of
from flockenv.engine.kernel_plan import Parts
from flockenv.engine.lane_access import gather, picked, places_each, scatter_each
from flockenv.engine.scratch import array_names
from flockenv.geometry.cell_list import FEWEST_ARRANGED, STEPS_ARRANGED, WORTH_ARRANGING
from flockenv.geometry.spatial_sort import count_tiles, find_homes
from flockenv.jit.intrinsics import ask_for, wait_for_team
from flockenv.jit.section import section
from flockenv.jit.transpose import put_lines

__all__ = ["Luggage", "arrange_plan", "go_home_of", "move_in_of"]

AHEAD = 64
"""How many agents ahead it is asked for what has been packed."""

_COMMON = {**dict.fromkeys(("mass", "radius", "max_speed", "max_force"), 0), "want": 1}
"""What all agents may have in common, and by which mask it is read then, see `blocks.common_places`."""


class Luggage(NamedTuple):
    """What is packed of each agent: numbers of arrays, each at a place; see `gather.places_each`."""

    arrays: tuple[int, ...]  # in which array each lies
    which: tuple[int, ...]  # behind which start: of numbers, of vectors, and the same where all have them in common
    further: tuple[int, ...]
    own: tuple[tuple[int, ...], ...]  # which of them each agent has for itself: always, by mask 0, by mask 1


class ArrangePlan(NamedTuple):
    """What putting agents in order depends on."""

    dimension: int
    width: int
    periodic: bool
    wraps: bool  # may agents lie outside a periodic box?
    homely: bool
    inner: bool
    luggage: Luggage
    size: int  # numbers of an agent that is packed, in whole cache lines


def arrange_plan(parts: Parts) -> ArrangePlan:
    """Return the plan of a scene."""
    names = array_names(parts)
    packed = [field.partition(" ") for field in parts.luggage]  # an array, and of vectors which axis
    common = [_COMMON.get(name) for name, _, _ in packed]
    starts = [
        (2 if mask is not None else 0) + (1 if axis else 0) for mask, (_, _, axis) in zip(common, packed, strict=True)
    ]
    luggage = Luggage(
        tuple(names.index(name) for name, _, _ in packed),
        tuple(starts),
        tuple(int(axis) * parts.width if axis else 0 for _, _, axis in packed),
        tuple(tuple(k for k, mask in enumerate(common) if mask == kind) for kind in (None, 0, 1)),
    )
    wraps = parts.space.periodic and not parts.confines
    return ArrangePlan(
        parts.dimension, parts.width, parts.space.periodic, wraps, parts.homely, bool(parts.inner), luggage,
        parts.luggage_size,
    )  # fmt: skip


@section
def move_in_of(plan: ArrangePlan) -> Callable[..., bool]:
    """Make `move_in(scratch, numbers, count, share)`: move agents to where their tiles come, if that is worth it.

    count: steps that are made before they go home. share: (n, present, first, end, rank, team). It returns whether
    they have moved.
    """
    width, periodic, wraps, homely = plan.width, plan.periodic, plan.wraps, plan.homely
    carry = _carry(plan, True)

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
                carry(scratch, share)
                if homely:
                    find_homes(first, end, width, n, shape, scratch.start, scratch.homes)
        return arranged

    return move_in


def go_home_of(plan: ArrangePlan) -> Callable[..., None]:
    """Return `go_home(scratch, share)`: move agents back to where their numbers say."""
    return _carry(plan, False)


@section
def _carry(plan: ArrangePlan, to_tiles: bool) -> Callable[..., None]:
    """Make `carry(scratch, share)`: this thread's agents pack, all of them are carried, and its new ones unpack.

    What is packed goes to distant places, in no order: where its tile comes, or where its number says. `cell` says
    where, in which -1 is nowhere.
    """
    dimension, width, (arrays, which, further, _) = plan.dimension, plan.width, plan.luggage
    size, count, wide = np.uint64(dimension * width), plan.size, np.uint64(plan.size)
    place_in, handed, unpack = place_of(dimension, width), handed_of(plan.inner), _unpack(plan)

    def carry(scratch: Any, share: Any) -> None:
        n, _, first, end, rank, team = share
        luggage, cell, offset, spread = scratch.luggage, scratch.cell, scratch.offset, scratch.spread
        sources = picked(handed(scratch, scratch.pos, scratch.vel), scratch, arrays)
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
            put_lines(luggage, sources, places_each(starts, which, further), width, cell, row, count, np.uint64(n))
        wait_for_team(scratch.sync, team)
        for i in range(np.uint64(first * width), np.uint64(min(end * width, n))):
            ask_for(luggage, (i + np.uint64(AHEAD)) * wide)
            unpack(scratch, sources, i, place_in(i))

    return carry


@section
def _unpack(plan: ArrangePlan) -> Callable[..., None]:
    """Make `unpack(scratch, sources, i, place)`: agent i unpacks all but what all have in common, which lies still."""
    own = _put_back(plan.luggage, plan.luggage.own[0])
    bodies, wants = _put_back(plan.luggage, plan.luggage.own[1]), _put_back(plan.luggage, plan.luggage.own[2])
    wide = np.uint64(plan.size)

    def unpack(scratch: Any, sources: Any, i: Any, place: Any) -> None:
        luggage, spread = scratch.luggage, scratch.spread
        own(luggage, i * wide, sources, i, place)
        if spread[0] > np.uint64(0):
            bodies(luggage, i * wide, sources, i, place)
        if spread[1] > np.uint64(0):
            wants(luggage, i * wide, sources, i, place)

    return unpack


@section
def _put_back(luggage: Luggage, mine: tuple[int, ...]) -> Callable[..., None]:
    """Make `put_back(packed, at, sources, i, place)`: write numbers of agent i that lie packed at `at`."""
    which, further = tuple(luggage.which[k] % 2 for k in mine), tuple(luggage.further[k] for k in mine)

    def put_back(packed: Any, at: Any, sources: Any, i: Any, place: Any) -> None:
        scatter_each(picked(sources, (), mine), (i, place), which, further, gather(packed, at, mine))

    return put_back
