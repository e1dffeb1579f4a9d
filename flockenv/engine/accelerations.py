"""The acceleration of every agent of a world: the forces of all laws, summed and divided by mass.

Pair laws come first, in one pass over the candidates (`sense`), and write their sums to `pair_force`, by agent; laws
about all agents, and bonds, write theirs to `far_bond_force`. Then each block adds the steering and external forces of
its agents, and the folds over the obstacles (`respond`); the steering force is limited to max_force. With a method of
one stage the step continues from there, a few blocks at a time; `accelerate` serves all other methods, and calls for
accelerations alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.agent_records import AgentPlan, agent_of, agent_plan, at_rest
from flockenv.engine.blocks import common_places, put_vector_of, vector_of_lane
from flockenv.engine.bonds import BondPlan, bond_plan, bonds_of
from flockenv.engine.far_field import FarPlan, far_of, far_plan
from flockenv.engine.group_laws import GroupPlan, find_groups_of, group_plan, members_of
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.engine.lane_access import gather, pick_items
from flockenv.engine.law_calls import OneLaw, arguments_of, laws_of, sum_of, value_of
from flockenv.engine.obstacle_loop import obstacles_of
from flockenv.engine.obstacle_plan import Obstacles, obstacle_plan
from flockenv.engine.pair_loop import sum_pair_laws
from flockenv.engine.pair_plan import Pairs, pairs_of
from flockenv.jit.decorators import Law, Vec, kernel, like
from flockenv.jit.section import section, tuple_from
from flockenv.maths.vectors import add, limit, scale, select, zero

__all__ = ["accelerate_of", "pair_force_of", "respond_of", "response_plan", "sense_of", "sense_plan"]


class Added(NamedTuple):
    """A vector that is added to an agent's steering force, to its external force, or to the force of one behaviour."""

    kind: str
    """An "own" law, an own law without its drag ("still"), a "group" law, a "fold" over obstacles, or the scratch array
    "pair_force" or "far_bond_force"."""
    law: OneLaw | None = None  # of a fold: its finish law
    places: tuple[int, ...] = ()  # of a fold: its numbers among the lanes; of "pair_force": where it lies in a block


class Combination(NamedTuple):
    """An effect that combines the steering forces of several behaviours into one."""

    k: int
    law: Law
    behaviours: tuple[int, ...]


class ResponsePlan(NamedTuple):
    """Constants of the code that computes an agent's acceleration after `sense`."""

    agent: AgentPlan
    masked: bool  # True if numbers that all agents share may be read from the first block
    media: tuple[OneLaw, ...]
    flows: tuple[OneLaw, ...]
    added: tuple[Added, ...]
    totals: tuple[tuple[int, ...], ...]  # indices into `added`: of steering, external and behaviour forces
    combinations: tuple[Combination, ...]
    combined_into: tuple[tuple[int, ...], tuple[int, ...]]  # indices into `combinations`: of steering, external forces
    pair_force_size: int  # count of numbers of a block in `pair_force`
    obstacles: Obstacles | None
    groups: GroupPlan | None


def response_plan(parts: KernelPlan) -> ResponsePlan:
    """Return the `ResponsePlan` of a scene."""
    targets, combined = ["s", "f", *(f"w{k}_" for k in parts.combined)], list(parts.combined)
    added: list[tuple[str, Added]] = []
    for k, effect in enumerate(parts.effects):
        if effect.own_law is not None:
            rests = effect.linear_drag is not None and parts.integrator.splits_drag
            added.append((parts.target(k), Added("still" if rests else "own", OneLaw.of(parts, k, "own_law"))))
        if effect.group_law is not None:
            added.append((parts.target(k), Added("group", OneLaw.of(parts, k, "group_law"))))
        if effect.obstacle_start is not None and effect.obstacle_finish is not None:
            slots = tuple(place * parts.width for name, place in parts.slots.items() if name.startswith(f"o{k}_"))
            # A fold is passed no image points: its law already gets the shortest offset to each obstacle.
            added.append((parts.target(k), Added("fold", OneLaw(k, effect.obstacle_finish), slots)))
    added += [
        (name, Added("pair_force", None, (parts.pair_force_at(name),))) for name in parts.targets if name[0] != "n"
    ]
    added += [("f", Added("far_bond_force"))] * parts.has_far_bond_force
    mine = [(k, e) for k, e in enumerate(parts.effects) if e.components]
    combinations = tuple(
        Combination(k, e.steer_law, tuple(j for j, behaviour in enumerate(combined) if parts.combined[behaviour] == k))
        for k, e in mine
    )
    combined_into = [tuple(j for j, (k, _) in enumerate(mine) if parts.target(k) == name) for name in ("s", "f")]
    return ResponsePlan(
        agent_plan(parts), parts.arranges, laws_of(parts, "medium_law"), laws_of(parts, "flow_law"),
        tuple(one for _, one in added),
        tuple(tuple(j for j, (to, _) in enumerate(added) if to == name) for name in targets),
        combinations, (combined_into[0], combined_into[1]), parts.pair_force_size,
        obstacle_plan(parts, agent_plan(parts)) if parts.folds_obstacles else None,
        group_plan(parts) if parts.group_effects else None,
    )  # fmt: skip


# --- what comes from other agents -------------------------------------------------------------------------------------


class SensePlan(NamedTuple):
    """Plans of the laws about other agents; None where the scene has no such law."""

    agent: AgentPlan
    aims: tuple[OneLaw, ...]
    pairs: Pairs | None
    far: FarPlan | None
    bonds: BondPlan | None
    groups: GroupPlan | None


def sense_plan(parts: KernelPlan) -> SensePlan:
    """Return the `SensePlan` of a scene."""
    agent = agent_plan(parts)
    return SensePlan(
        agent, laws_of(parts, "aim_law"),
        pairs_of(parts) if parts.pairs else None,
        far_plan(parts) if parts.far else None,
        bond_plan(parts, agent) if parts.bond_effects else None,
        group_plan(parts) if parts.group_effects else None,
    )  # fmt: skip


@section
def sense_of(plan: SensePlan) -> Callable[..., None]:
    """Make `sense(context, pos, vel, time)`: write the effect of other agents on this thread's agents of one world."""
    aim = _aim(plan.agent, plan.aims) if plan.aims else None
    sum_pairs = sum_pair_laws(plan.pairs) if plan.pairs is not None else None
    far = far_of(plan.far) if plan.far is not None else None
    bonds = bonds_of(plan.bonds) if plan.bonds is not None else None
    find_groups = find_groups_of(plan.groups) if plan.groups is not None else None

    def sense(context: Any, pos: Any, vel: Any, time: Any) -> None:
        if context.rank == 0:
            context.work[context.b, 0] += 1
        if aim is not None:
            aim(context, pos, vel, time)
        if sum_pairs is not None:
            sum_pairs(context, pos, vel, time)
        if far is not None:
            far(context, pos, time)
        if bonds is not None:
            bonds(context, pos, vel, time)
        if find_groups is not None:
            find_groups(context, pos, vel)

    return sense


@section
def _aim(agent: AgentPlan, laws: tuple[OneLaw, ...]) -> Callable[..., None]:
    """Make `aim(context, pos, vel, time)`: write the desired direction of each of this thread's agents."""
    d, width = agent.dimension, agent.width
    size, vector, put = np.uint64(d * width), vector_of_lane(d, width), put_vector_of(d, width)
    agent_at, directions, total = agent_of(agent._replace(aims=False)), tuple_from(*map(value_of, laws)), _sum_all(laws)

    def aim(context: Any, pos: Any, vel: Any, time: Any) -> None:
        scratch, numbers, random_key = context.scratch, context.numbers, context.key[context.b]
        for block in range(np.uint64(context.first), np.uint64(context.end)):
            base, row = block * size, block * np.uint64(width)
            for lane in range(np.uint64(width)):
                i, at = row + lane, base + lane
                x, v = vector(pos, at), vector(vel, at)
                me = agent_at(scratch, random_key, time, at, i, i, x, v, zero(x))
                direction = total(zero(x), directions(numbers, me))
                put(scratch.aiming, at, limit(direction, like(x[0], 1.0)))

    return aim


def _sum_all(laws: tuple[Any, ...]) -> Callable[[Vec, Any], Vec]:
    return sum_of(tuple(range(len(laws))))


# --- how agents respond -----------------------------------------------------------------------------------------------


@functools.cache
def pair_force_of(dimension: int, width: int, each: int, place: int) -> Callable[..., Vec]:
    """Return `pair_force(scratch, row, lane)`: the sum of pair laws for the agent in a lane of the block at `row`."""
    vector, first, rows = vector_of_lane(dimension, width), np.uint64(place), np.uint64(each // width)
    return kernel(lambda scratch, row, lane: vector(scratch.pair_force, row * rows + first + lane))


@functools.cache
def _added_vector(plan: ResponsePlan, added: Added) -> Callable[..., Vec]:
    """Return `adds(numbers, scratch, me, row, at, lane)`: a vector that is added for an agent."""
    kind, one, places = added
    vector = vector_of_lane(plan.agent.dimension, plan.agent.width)
    if kind == "far_bond_force":
        return kernel(lambda numbers, scratch, me, row, at, lane: vector(scratch.far_bond_force, at))
    if kind == "pair_force":
        pair_force = pair_force_of(plan.agent.dimension, plan.agent.width, plan.pair_force_size, *places)
        return kernel(lambda numbers, scratch, me, row, at, lane: pair_force(scratch, row, lane))
    assert one is not None
    if kind == "fold":
        k, law = one.k, one.law
        return kernel(
            lambda numbers, scratch, me, row, at, lane: law(numbers.effects[k], me, gather(scratch.lanes, lane, places))
        )
    if kind == "group":
        given, law = arguments_of(one.k, one.images), one.law
        assert plan.groups is not None
        members = members_of(plan.groups, next(each for each in plan.groups.laws if each.k == one.k))
        return kernel(
            lambda numbers, scratch, me, row, at, lane: law(
                given(numbers, me), me, members(scratch.lanes, numbers.size, me.pos)
            )
        )
    value = value_of(one)
    if kind == "still":
        return kernel(lambda numbers, scratch, me, row, at, lane: value(numbers, at_rest(me)))
    return kernel(lambda numbers, scratch, me, row, at, lane: value(numbers, me))


@section
def _totals(plan: ResponsePlan) -> Callable[..., Any]:
    """Make `totals(numbers, scratch, me, requested, row, at, lane)`: sum the forces of an agent.

    `requested` is the commanded steering force. Returns the steering force, the external force, and the tuple of the
    forces of those behaviours that an effect combines.
    """
    adding = tuple_from(*(_added_vector(plan, one) for one in plan.added)) if plan.added else None
    steering, external, *behaviours = map(sum_of, plan.totals)
    each_behaviour: Any = tuple_from(*behaviours) if behaviours else kernel(lambda start, vectors: ())

    def totals(numbers: Any, scratch: Any, me: Any, requested: Any, row: Any, at: Any, lane: Any) -> Any:
        o = zero(me.pos)
        if adding is None:
            return requested, o, ()
        vectors = adding(numbers, scratch, me, row, at, lane)
        return steering(requested, vectors), external(o, vectors), each_behaviour(o, vectors)

    return totals


@functools.cache
def _combined_force(one: Combination) -> Callable[..., Vec]:
    """Return `steers(numbers, me, forces)`: an effect's combined behaviours; 0 for an agent of another group."""
    k, law, places = one

    def steers(numbers: Any, me: Any, forces: Any) -> Any:
        p = numbers.effects[k]
        member = (me.who >= p.first) & (me.who < p.end)
        return select(member, law(p, me, pick_items(forces, (), places))[0], zero(me.pos))

    return kernel(steers)


@section
def respond_of(plan: ResponsePlan) -> Callable[..., None]:
    """Make `respond(context, pos, vel, time, block, out, to)`: write the accelerations of a block, m/s^2.

    They are written at `to` in the array of vectors `out`. If a medium carries the agents, its velocity goes to
    `advection`.
    """
    agent, d, width = plan.agent, plan.agent.dimension, plan.agent.width
    size, vector, put = np.uint64(d * width), vector_of_lane(d, width), put_vector_of(d, width)
    agent_at, totals, common = agent_of(agent), _totals(plan), common_places(d, width, plan.masked)
    medium: Any = tuple_from(*map(value_of, plan.media)) if plan.media else None
    of_medium, of_flow = _sum_all(plan.media), _sum_all(plan.flows)
    flow: Any = tuple_from(*map(value_of, plan.flows)) if plan.flows else None
    combine: Any = tuple_from(*map(_combined_force, plan.combinations)) if plan.combinations else None
    to_steering, to_external = map(sum_of, plan.combined_into)
    fold_obstacles = obstacles_of(plan.obstacles) if plan.obstacles is not None else None

    def respond(context: Any, pos: Any, vel: Any, time: Any, block: Any, out: Any, to: Any) -> None:
        scratch, numbers, random_key = context.scratch, context.numbers, context.key[context.b]
        base, row = block * size, block * np.uint64(width)
        one, live, request = common(scratch, context.n, context.present, block)
        if fold_obstacles is not None:
            fold_obstacles(context, pos, vel, time, block)
        for lane in range(np.uint64(width)):
            i, at = row + lane, base + lane
            x, v = vector(pos, at), vector(vel, at)
            o = zero(x)
            me = agent_at(scratch, random_key, time, at, i, one + lane, x, v, o)
            if medium is not None:
                moves = of_medium(o, medium(numbers, me))
                me = agent_at(scratch, random_key, time, at, i, one + lane, x, v, moves)
            steering, external, forces = totals(
                numbers, scratch, me, vector(scratch.requested_force, request + lane), row, at, lane
            )
            if combine is not None:
                combined = combine(numbers, me, forces)
                steering, external = to_steering(steering, combined), to_external(external, combined)
            steering = limit(steering, scratch.max_force[one + lane])
            # Select, do not multiply by 0: a law may be infinite for dead agents, for agents of infinite mass (held in
            # place) and in the lanes beyond the last agent.
            here = (scratch.living[live + lane] > o[0]) & (scratch.mass[one + lane] < like(o[0], np.inf))
            share = like(o[0], 1.0) / scratch.mass[one + lane]
            put(out, to + lane, select(here, scale(add(steering, external), share), o))
            if flow is not None:
                put(scratch.advection, at, select(here, of_flow(o, flow(numbers, me)), o))

    return respond


@section
def accelerate_of(plan: ResponsePlan, sensed: SensePlan) -> Callable[..., None]:
    """Make `accelerate(context, pos, vel, time, out)`: write the acceleration of this thread's agents, m/s^2."""
    sense, respond, size = sense_of(sensed), respond_of(plan), np.uint64(plan.agent.dimension * plan.agent.width)

    def accelerate(context: Any, pos: Any, vel: Any, time: Any, out: Any) -> None:
        sense(context, pos, vel, time)
        for block in range(np.uint64(context.first), np.uint64(context.end)):
            respond(context, pos, vel, time, block, out, block * size)

    return accelerate
