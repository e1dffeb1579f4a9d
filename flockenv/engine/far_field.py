"""Laws about all agents, however far: each agent interacts with all others, distant groups counting as one.

Where agents are few, or an effect requires exact sums, each agent interacts with each other one, lane beside lane
(`_direct`); else blocks walk through a tree (`_walk`, see flockenv.geometry.barnes_hut). The choice depends only on the
number of agents and the effect's opening. The sums are left in `far_bond_force`, by agent, and bonds add to them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.blocks import place_of, vector_of_lane
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.geometry.barnes_hut import BUCKETS, LEVELS, LISTED, build_tree, gather, sort_along_curve
from flockenv.jit.decorators import Law, like
from flockenv.jit.intrinsics import wait_for_team
from flockenv.jit.section import section
from flockenv.maths.vectors import dot, sub, zero
from flockenv.physics.effects.effect import Far, Me

__all__ = ["FarPlan", "far_of", "far_plan"]


class FarLaw(NamedTuple):
    """A law about all agents."""

    k: int  # index of its effect
    law: Law
    by_mass: bool  # True if it weighs by mass, kg, not by the number of agents


class FarPlan(NamedTuple):
    """Constants of the code of laws about all agents."""

    dimension: int
    width: int
    sums: int  # where the sums of a block begin in the scratch of lanes
    direct: tuple[FarLaw, ...]  # laws that are evaluated for each agent
    in_tree: tuple[FarLaw, ...]  # laws that are evaluated for nodes of a tree


def far_plan(parts: KernelPlan) -> FarPlan:
    """Return the `FarPlan` of a scene."""
    laws = {k: FarLaw(k, effect.far_law, effect.weighs_mass) for k, effect in parts.far if effect.far_law is not None}
    in_tree = [k for k, _ in parts.tree_effects]
    direct = tuple(law for k, law in laws.items() if k not in in_tree)
    sums = parts.slots["far0"] * parts.width
    return FarPlan(parts.dimension, parts.width, sums, direct, tuple(laws[k] for k in in_tree))


@section
def far_of(plan: FarPlan) -> Callable[..., None]:
    """Make `far(context, pos, time)`: write the forces of all other agents, N, into `far_bond_force`.

    It begins with a barrier even after pair laws: by then all threads have written their positions, and have read the
    counts.
    """
    direct, walk = _direct(plan) if plan.direct else None, _walk(plan, plan.in_tree) if plan.in_tree else None
    width = plan.width

    def far(context: Any, pos: Any, time: Any) -> None:
        scratch, numbers, key = context.scratch, context.numbers, context.key[context.b]
        sync, lanes, living, mass, forces = (
            scratch.sync,
            scratch.lanes,
            scratch.living,
            scratch.mass,
            scratch.far_bond_force,
        )
        n, present, rank, team = context.n, context.present, context.rank, context.team
        wait_for_team(sync, team)
        interactions = 0
        if direct is not None:
            block_range = context.first, context.end
            direct(numbers.effects, pos, living, mass, lanes, forces, block_range, n, time, key)
            interactions += present * present
        if walk is not None:
            tree = scratch.tree_leaf, scratch.tree_node, scratch.tree_digit, scratch.tree_near, scratch.tree_place
            leaves, _, digits, _, places = tree
            if rank == 0:
                keys, bounds = scratch.tree_key, scratch.bounds
                sort_along_curve(pos, living, mass, n, width, sync, bounds, numbers.size, keys, places, digits, leaves)
            share = present, rank, team
            interactions += walk(
                numbers.effects, numbers.size, tree, lanes, forces, sync, scratch.tally, share, time, key
            )
        else:
            wait_for_team(sync, team)  # no agent moves before all threads have read positions
        if rank == 0:
            context.work[context.b, 2] += interactions

    return far


# --- one interaction --------------------------------------------------------------------------------------------------


@section
def _interact(plan: FarPlan, laws: tuple[FarLaw, ...], in_tree: bool) -> Callable[..., None]:
    """Make `interact(effects, lanes, lane, x, m, xj, heavy, time, key)`: add the effect of a mass at xj to a lane.

    The lane is that of an agent at x of mass m. `heavy` is the mass at xj, or in a tree the weight of a node. A mass at
    exactly x adds nothing, because it has no direction: the agent itself above all.
    """
    before = _interact(plan, laws[:-1], in_tree) if laws[1:] else None
    k, law, by_mass = laws[-1]
    weighs, dimension = by_mass or in_tree, plan.dimension
    first, second, third = (np.uint64(plan.sums + axis * plan.width) for axis in range(3))

    def interact(effects: Any, lanes: Any, lane: Any, x: Any, m: Any, xj: Any, heavy: Any, time: Any, key: Any) -> None:
        if before is not None:
            before(effects, lanes, lane, x, m, xj, heavy, time, key)
        to = sub(xj, x)
        square, o, z = dot(to, to), like(m, -0.0), zero(x)
        there = square > o
        me = Me(m, x, z, z, m, m, m, m, z, time, z, key, z, m, ())
        value = law(effects[k], me, Far(to, square, heavy if weighs else like(m, 1.0)))
        lanes[first + lane] += value[0] if there else o  # add a selected value, see lane_access.add_where
        lanes[second + lane] += value[1] if there else o
        if dimension == 3:
            lanes[third + lane] += value[2] if there else o

    return interact


# --- one by one -------------------------------------------------------------------------------------------------------


@section
def _direct(plan: FarPlan) -> Callable[..., None]:
    """Make `direct(effects, pos, living, mass, lanes, forces, blocks, n, time, key)`: sum over all living agents.

    It evaluates all laws at once. blocks: the first, and the end.
    """
    dimension, width, sums = plan.dimension, plan.width, np.uint64(plan.sums)
    interact, vector, place = (
        _interact(plan, plan.direct, False),
        vector_of_lane(dimension, width),
        place_of(dimension, width),
    )
    count = dimension * width

    def direct(
        effects: Any, pos: Any, living: Any, mass: Any, lanes: Any, forces: Any, blocks: Any, n: Any, time: Any,
        key: Any,
    ) -> None:  # fmt: skip
        for block in range(np.uint64(blocks[0]), np.uint64(blocks[1])):
            base, row = block * np.uint64(count), block * np.uint64(width)
            for lane in range(np.uint64(count)):
                lanes[sums + lane] = 0
            for j in range(np.uint64(n)):
                if living[j] > 0:
                    xj, heavy = vector(pos, place(j)), mass[j]
                    for lane in range(np.uint64(width)):
                        interact(effects, lanes, lane, vector(pos, base + lane), mass[row + lane], xj, heavy, time, key)
            for lane in range(np.uint64(count)):
                forces[base + lane] = lanes[sums + lane]

    return direct


# --- by a tree --------------------------------------------------------------------------------------------------------


@section
def _walk(plan: FarPlan, laws: tuple[FarLaw, ...]) -> Callable[..., int]:
    """Make `walk(effects, size, tree, lanes, forces, sync, tally, share, time, key)`: sorted blocks walk through trees.

    There is one tree for each of `laws`, one after another: nodes weigh kilograms or count agents. share: (agents
    alive, rank, team), which gives this thread's blocks. Returns, on rank 0, the number of interactions of all threads.
    """
    before, adds = _walk(plan, laws[:-1]) if laws[1:] else None, bool(plan.direct or laws[1:])
    dimension, width, sums, (k, _, by_mass) = plan.dimension, plan.width, np.uint64(plan.sums), laws[-1]
    interact, put, vector = _interact(plan, laws[-1:], True), _write_sums(plan, adds), vector_of_lane(dimension, width)
    listed, weight = vector_of_lane(dimension, 1), np.uint64(dimension)
    count, step, room = dimension * width, dimension + 1, LISTED * (dimension + 1)

    def walk(
        effects: Any, size: Any, tree: Any, lanes: Any, forces: Any, sync: Any, tally: Any, share: Any, time: Any,
        key: Any,
    ) -> int:  # fmt: skip
        total = 0
        if before is not None:
            total += before(effects, size, tree, lanes, forces, sync, tally, share, time, key)
        (leaves, nodes, digits, near, places), (present, rank, team) = tree, share
        if rank == 0:
            build_tree(leaves, present, width, size, by_mass, digits, nodes)
        wait_for_team(sync, team)  # the tree is shared by all threads
        interactions, blocks, begin = 0, (present + width - 1) // width, rank * room
        for block in range(np.uint64(blocks * rank // team), np.uint64(blocks * (rank + 1) // team)):
            own: Any = np.int64(block)
            base, held = block * np.uint64(step * width), min(width, present - own * width)
            for lane in range(np.uint64(count)):
                lanes[sums + lane] = 0
            level, node = digits[BUCKETS + LEVELS], 0
            while level <= digits[BUCKETS + LEVELS]:
                many, level, node = gather(
                    leaves, nodes, digits, present, width, size, by_mass, effects[k].opening, own, level, node, near,
                    begin,
                )  # fmt: skip
                interactions += many * held
                for j in range(np.uint64(begin), np.uint64(begin + many * step), np.uint64(step)):
                    xj, heavy = listed(near, j), near[j + weight]
                    for lane in range(np.uint64(width)):
                        x, m = vector(leaves, base + lane), leaves[base + np.uint64(count) + lane]
                        interact(effects, lanes, lane, x, m, xj, heavy, time, key)
            put(forces, lanes, places, block * np.uint64(width), held)
        tally[rank] = interactions
        wait_for_team(sync, team)  # `far_bond_force` was written by other threads
        for r in range(team if rank == 0 else 0):
            total += tally[r]
        return total

    return walk


@section
def _write_sums(plan: FarPlan, adds: bool) -> Callable[..., None]:
    """Make `put(forces, lanes, places, first, held)`: write, or add, the sums of a block where its `held` agents lie.

    places: which agents they are, from `first` on.
    """
    place, dimension = place_of(plan.dimension, plan.width), plan.dimension
    sums, width = np.uint64(plan.sums), np.uint64(plan.width)

    def put(forces: Any, lanes: Any, places: Any, first: Any, held: Any) -> None:
        for lane in range(np.uint64(held)):
            at = place(np.uint64(places[first + lane]))
            for axis in range(np.uint64(dimension)):
                to, found = at + axis * width, lanes[sums + axis * width + lane]
                forces[to] = forces[to] + found if adds else found

    return put
