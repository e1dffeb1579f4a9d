"""Bonds: each agent gathers the forces of its own bonds, block by block, lane beside lane.

A table has, for each block of agents, as many slots as the agent with the most bonds has. In a slot each lane has the
places of its partners and the numbers of its bond, or its own place and zeros (`pack`). So no thread writes to the
agent of another, and sums are the same for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.engine.agent_records import AgentPlan, agent_of, inner_of
from flockenv.engine.blocks import vector_of_lane
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.engine.lane_access import gather
from flockenv.jit.decorators import Law, like
from flockenv.jit.intrinsics import wait_for_team
from flockenv.jit.section import call_in_turn, section
from flockenv.maths.vectors import dot, exact_sum, zero
from flockenv.physics.effects.effect import Bonds, Other

__all__ = ["BondPlan", "Table", "bond_plan", "bonds_of", "bring_bonds_of", "keep_bonds_of", "pack"]


class Table(NamedTuple):
    """The bonds of all effects of a scene, as the kernel reads them."""

    place: NDArray[np.int32]  # where the first coordinate of a partner lies; of an unused slot: of the agent itself
    number: NDArray[np.floating]
    start: NDArray[
        np.int64
    ]  # per effect: the first slot of each block, and one more; then where its places, and numbers, begin
    kept: NDArray[np.floating]  # (S,) the first values of State.bonds of a world


def pack(parts: KernelPlan, agents: int, groups: Sequence[object]) -> Table:
    """Return the table of a scene of `agents` agents; raise ValueError, naming the effect, if its bonds are invalid."""
    w, d = parts.width, parts.dimension
    blocks = -(-agents // w)
    places, numbers, starts, bases, kept = [], [], [], [], np.zeros(0)
    first_place = first_number = 0
    for k, effect in parts.bond_effects:
        try:
            found = effect.bonds(groups, d)
        except ValueError as error:
            listed = k - sum(
                each < k for each in parts.combined
            )  # the effects listed before the one that combines them
            raise ValueError(f"effects[{listed}].{error}") from None
        if found.kept is not None:
            found, kept = _keep_apart(found, kept, parts.itemsize)
        start, place, number = _pack_bonds(found, agents, blocks, w, d)
        starts.append(start)
        bases += [first_place, first_number]
        first_place, first_number = first_place + place.size, first_number + number.size
        places.append(place.ravel())
        numbers.append(number.ravel())
    empty: list[NDArray[np.float64]] = [np.zeros(1)]
    return Table(
        np.concatenate(places or empty).astype(np.int32),
        np.concatenate(numbers or empty).astype(parts.dtype),
        np.concatenate([*starts, np.array(bases, np.int64)] if starts else [np.zeros(1, np.int64)]),
        kept.astype(parts.dtype),
    )


def _keep_apart(bonds: Bonds, kept: NDArray[np.float64], itemsize: int) -> tuple[Bonds, NDArray[np.float64]]:
    """Return bonds whose last number is the place of what they keep, and its first values, behind those before."""
    assert bonds.kept is not None
    size = int(bonds.kept.max(initial=-1)) + 1
    if itemsize == 4 and size > MOST_KEPT:
        raise ValueError(f"dtype = float32: {size:,} springs that yield or break; at most {MOST_KEPT:,} are allowed")
    longer = np.zeros(max(size, len(kept), 1))  # kernels are passed no empty array: one agent alone has no springs
    longer[: len(kept)] = kept
    longer[bonds.kept] = bonds.number[:, -1]
    return bonds._replace(number=np.concatenate([bonds.number[:, :-1], bonds.kept[:, None]], axis=1)), longer


MOST_KEPT = 2**24
"""Most bonds that keep a number, in single precision: larger places are no longer exact."""


def _pack_bonds(
    bonds: Bonds, agents: int, blocks: int, width: int, dimension: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the starts of blocks, places (slots, P, W) and numbers (slots, C, W)."""
    order = np.argsort(bonds.agent, kind="stable")
    agent, partner, number = bonds.agent[order].astype(np.int64), bonds.partner[order], bonds.number[order]
    count = np.bincount(agent, minlength=blocks * width)
    start = np.concatenate([[0], np.cumsum(count.reshape(blocks, width).max(axis=1, initial=0))])
    slot = start[agent // width] + np.arange(len(agent)) - np.concatenate([[0], np.cumsum(count)])[agent]
    lane_of = agent % width

    def place_of(agents: NDArray[np.int64]) -> NDArray[np.int64]:
        return (agents // width) * (dimension * width) + agents % width

    block = np.repeat(np.arange(blocks), np.diff(start))
    places = np.repeat(place_of(block[:, None] * width + np.arange(width))[:, None, :], partner.shape[1], axis=1)
    numbers = np.zeros((int(start[-1]), number.shape[1], width))
    places[slot, :, lane_of] = place_of(partner.astype(np.int64))
    numbers[slot, :, lane_of] = number
    return start.astype(np.int64), places, numbers


# --- in a kernel ------------------------------------------------------------------------------------------------------


class BondLaw(NamedTuple):
    """A law of bonds."""

    k: int  # index of its effect
    law: Law
    partners: int
    numbers: int
    keep: Law | None = None  # the law of the number that each bond keeps, the last of `numbers`


class BondPlan(NamedTuple):
    """Constants of the code that sums the forces of bonds."""

    agent: AgentPlan
    offset_to: Law
    laws: tuple[BondLaw, ...]  # in the order of the table
    sums: int  # where the sums of a block begin in the scratch of lanes
    waits: bool  # True if no earlier phase has waited until all threads have written their positions
    adds: bool  # True if `far_bond_force` already holds forces of far laws
    kept: int  # which array of `frame_and_inner` holds the numbers that bonds keep; -1: none


def bond_plan(parts: KernelPlan, agent: AgentPlan) -> BondPlan:
    """Return the `BondPlan` of a scene."""
    d = parts.dimension
    laws = tuple(
        BondLaw(k, e.bond_law, e.partner_count(d), e.numbers(d), e.bond_keep_law)
        for k, e in parts.bond_effects
        if e.bond_law is not None
    )
    sums, waits = parts.slots["bond0"] * parts.width, not (parts.pairs or parts.far)
    return BondPlan(agent, parts.space.offset_law, laws, sums, waits, bool(parts.far), parts.place_of_bonds)


@section
def bonds_of(plan: BondPlan) -> Callable[..., None]:
    """Make `bonds(context, pos, vel, time)`: write bond forces on this thread's agents, N, into `far_bond_force`."""
    add = _add_bonds(plan, len(plan.laws) - 1)
    waits, adds = plan.waits, plan.adds
    count, sums = plan.agent.dimension * plan.agent.width, np.uint64(plan.sums)

    def bonds(context: Any, pos: Any, vel: Any, time: Any) -> None:
        scratch, numbers, key, n = context.scratch, context.numbers, context.key[context.b], context.n
        sync, team, lanes, forces = scratch.sync, context.team, scratch.lanes, scratch.far_bond_force
        if waits:
            wait_for_team(sync, team)  # all threads have written their positions now
        for block in range(np.uint64(context.first), np.uint64(context.end)):
            base = block * np.uint64(count)
            for place in range(np.uint64(count)):
                lanes[sums + place] = forces[base + place] if adds else like(forces[0], 0.0)
            add(scratch, numbers.effects, numbers.size, pos, vel, time, key, n, block)
            for place in range(np.uint64(count)):
                forces[base + place] = lanes[sums + place]
        wait_for_team(sync, team)  # no agent moves before all threads have read positions

    return bonds


@section
def _add_bonds(plan: BondPlan, place: int) -> Callable[..., None]:
    """Make `add(scratch, effects, size, pos, vel, time, key, n, block)`: add bond forces to the sums of a block.

    The bonds are those of the effect at `place` in the table, and of all effects before it.
    """
    before = _add_bonds(plan, place - 1) if place else None
    k, law, partners, numbers, keep_law = plan.laws[place]
    dimension, width = plan.agent.dimension, plan.agent.width
    numbers_of = _numbers(numbers, width, keep_law is not None)
    vector, agent_at, partners_of = vector_of_lane(dimension, width), agent_of(plan.agent), _partners(plan, partners)
    are_alive = _are_alive(dimension, width, partners)
    keeps, apart, wide = bool(plan.agent.inner), partners * width, numbers * width
    first_place, total = 2 * place, len(plan.laws)
    sum_x, sum_y, sum_z = (np.uint64(plan.sums + axis * width) for axis in range(3))

    def add(scratch: Any, effects: Any, size: Any, pos: Any, vel: Any, time: Any, key: Any, n: Any, block: Any) -> None:
        if before is not None:
            before(scratch, effects, size, pos, vel, time, key, n, block)
        lanes, start = scratch.lanes, scratch.bond_start
        placed, living, kept = scratch.bond_place, scratch.living, scratch if keeps else ()
        base, row = block * np.uint64(dimension * width), block * np.uint64(width)
        blocks = (n + (width - 1)) // width + 1
        for slot in range(start[place * blocks + np.int64(block)], start[place * blocks + np.int64(block) + 1]):
            places = np.uint64(start[total * blocks + first_place] + slot * apart)
            first = np.uint64(start[total * blocks + first_place + 1] + slot * wide)
            for lane in range(np.uint64(width)):
                i, at = row + lane, base + lane
                x, v = vector(pos, at), vector(vel, at)
                me = agent_at(scratch, key, time, at, i, i, x, v, zero(x))
                others = partners_of(kept, placed, pos, vel, scratch.radius, scratch.mass, size, x, places + lane)
                value = law(effects[k], me, others, numbers_of(scratch, first + lane))
                whole = are_alive(placed, living, places + lane)  # a bond with a dead partner exerts no force
                # exact_sum: each form of the loop would fuse the products differently, and bits would depend on the
                # processor
                lanes[sum_x + lane] = exact_sum(lanes[sum_x + lane], value[0] if whole else like(x[0], -0.0))
                lanes[sum_y + lane] = exact_sum(lanes[sum_y + lane], value[1] if whole else like(x[0], -0.0))
                if dimension == 3:
                    lanes[sum_z + lane] = exact_sum(lanes[sum_z + lane], value[2] if whole else like(x[0], -0.0))

    return add


@section
def _numbers(count: int, width: int, keeps: bool) -> Callable[..., Any]:
    """Make `numbers(scratch, at)`: the numbers of a bond; the last one, if the bond keeps it, as it is at present."""
    places, last = tuple(number * width for number in range(count - keeps)), np.uint64((count - 1) * width)

    def numbers(scratch: Any, at: Any) -> Any:
        if not keeps:
            return gather(scratch.bond_number, at, places)
        where = np.uint64(np.int64(scratch.bond_number[at + last]))
        return gather(scratch.bond_number, at, places) + (scratch.bond_kept[where],)  # noqa: RUF005  # numba adds

    return numbers


@section
def bring_bonds_of(place: int, inwards: bool) -> Callable[..., None]:
    """Make `bring(worlds, scratch, b)`: copy the numbers that bonds of world b keep into scratch, or back."""

    def bring(worlds: Any, scratch: Any, b: Any) -> None:
        kept = worlds.frame_and_inner[place]
        for bond in range(kept.shape[1]):
            if inwards:
                scratch.bond_kept[bond] = kept[b, bond]
            else:
                kept[b, bond] = scratch.bond_kept[bond]

    return bring


@section
def keep_bonds_of(plan: BondPlan) -> Callable[..., None]:
    """Make `keep(context, pos, vel, time)`: write the numbers that bonds keep, at the positions after a step."""
    keep_each = call_in_turn(*(_keep_law(plan, place) for place, law in enumerate(plan.laws) if law.keep is not None))

    def keep(context: Any, pos: Any, vel: Any, time: Any) -> None:
        scratch = context.scratch
        wait_for_team(scratch.sync, context.team)  # all agents have moved
        keep_each(context, pos, vel, time)
        wait_for_team(scratch.sync, context.team)  # before any force reads what another thread writes

    return keep


@section
def _keep_law(plan: BondPlan, place: int) -> Callable[..., None]:
    """Make `keep(context, pos, vel, time)` for the effect at `place` in the table."""
    k, _, partners, numbers, law = plan.laws[place]
    assert law is not None
    dimension, width = plan.agent.dimension, plan.agent.width
    vector, agent_at, partners_of = vector_of_lane(dimension, width), agent_of(plan.agent), _partners(plan, partners)
    are_alive, numbers_of = _are_alive(dimension, width, partners), _numbers(numbers, width, True)
    keeps, apart, wide, last = bool(plan.agent.inner), partners * width, numbers * width, (numbers - 1) * width
    total, first_place = len(plan.laws), 2 * place

    def keep(context: Any, pos: Any, vel: Any, time: Any) -> None:
        scratch, effects, size = context.scratch, context.numbers.effects, context.numbers.size
        key, start, placed = context.key[context.b], scratch.bond_start, scratch.bond_place
        living, kept = scratch.living, scratch if keeps else ()
        blocks = (context.n + (width - 1)) // width + 1
        for block in range(np.uint64(context.first), np.uint64(context.end)):
            base, row = block * np.uint64(dimension * width), block * np.uint64(width)
            for slot in range(start[place * blocks + np.int64(block)], start[place * blocks + np.int64(block) + 1]):
                places = np.uint64(start[total * blocks + first_place] + slot * apart)
                first = np.uint64(start[total * blocks + first_place + 1] + slot * wide)
                for lane in range(np.uint64(width)):
                    i, at = row + lane, base + lane
                    x, v = vector(pos, at), vector(vel, at)
                    me = agent_at(scratch, key, time, at, i, i, x, v, zero(x))
                    others = partners_of(kept, placed, pos, vel, scratch.radius, scratch.mass, size, x, places + lane)
                    now = law(effects[k], me, others, numbers_of(scratch, first + lane))
                    if me.who < others[0].who and are_alive(placed, living, places + lane):
                        where = np.uint64(np.int64(scratch.bond_number[first + lane + np.uint64(last)]))
                        scratch.bond_kept[where] = now

    return keep


@section
def _partners(plan: BondPlan, count: int) -> Callable[..., tuple[Other, ...]]:
    """Make `partners(kept, placed, pos, vel, radius, mass, size, x, place)`: the partners in a bond of an agent at x.

    place: where `placed` holds the place of the first. kept: scratch if agents have inner states, else an empty tuple.
    """
    before, behind = _partners(plan, count - 1) if count > 1 else None, np.uint64((count - 1) * plan.agent.width)
    vector, inner, offset_to = vector_of_lane(*plan.agent[:2]), inner_of(plan.agent.inner), plan.offset_to
    width, size_of_block = np.uint64(plan.agent.width), np.uint64(plan.agent.dimension * plan.agent.width)

    def partners(
        kept: Any, placed: Any, pos: Any, vel: Any, radius: Any, mass: Any, size: Any, x: Any, place: Any
    ) -> Any:
        at = np.uint64(placed[place + behind])
        i: Any = at // size_of_block * width + at % width
        to, o = offset_to(size, x, vector(pos, at)), zero(x)
        other = Other(like(x[0], i), to, dot(to, to), vector(vel, at), radius[i], o, mass[i], inner(kept, i))
        if before is None:
            return (other,)
        return before(kept, placed, pos, vel, radius, mass, size, x, place) + (other,)  # noqa: RUF005  # numba adds

    return partners


@section
def _are_alive(dimension: int, width: int, count: int) -> Callable[..., bool]:
    """Make `are_alive(places, living, place)`: return True if all partners of a bond are alive."""
    before, behind = _are_alive(dimension, width, count - 1) if count > 1 else None, np.uint64((count - 1) * width)
    lanes, size = np.uint64(width), np.uint64(dimension * width)

    def are_alive(places: Any, living: Any, place: Any) -> Any:
        at = np.uint64(places[place + behind])
        alive = living[at // size * lanes + at % lanes] > like(living[0], 0.0)
        if before is None:
            return alive
        return before(places, living, place) & alive

    return are_alive
