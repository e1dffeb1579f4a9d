"""A step: worlds are copied into blocks, advanced by the integrator's method, limited, and written back.

`step_world` is called by scenes through `step`, and by tasks through their `play`. Several threads may advance one
world together, each the agents of its own blocks.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.accelerations import (
    ResponsePlan,
    SensePlan,
    accelerate_of,
    respond_of,
    response_plan,
    sense_of,
    sense_plan,
)
from flockenv.engine.agent_records import AgentPlan, agent_of, agent_plan
from flockenv.engine.blocks import place_of, vector_of_lane
from flockenv.engine.bonds import BondPlan, bond_plan, bring_bonds_of, keep_bonds_of
from flockenv.engine.context import Context
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.engine.lane_access import gather
from flockenv.engine.law_calls import OneLaw, laws_of, value_of
from flockenv.engine.load_store import bring_in_of, bring_inside_of, bring_out_of, take_drive_of
from flockenv.engine.method import MethodPlan, advance_of, method_plan
from flockenv.engine.move import MovePlan, move_of, move_plan
from flockenv.engine.parameters import NumberPlan, numbers_of
from flockenv.engine.reorder import ArrangePlan, arrange_plan, move_back_of, move_in_of
from flockenv.jit.decorators import Law, finite, kernel, like
from flockenv.jit.intrinsics import prefetch_for_write, wait_for_team
from flockenv.jit.section import call_in_turn, section
from flockenv.maths.vectors import zero
from flockenv.model.state import COUNTED_BY_KERNELS
from flockenv.physics.integrators.integrator import Method, Provided

__all__ = ["StepPlan", "step_plan", "step_world_of"]

PART = 8
"""Blocks that are advanced together."""

AHEAD = 16
"""How many blocks ahead the forces and states of agents are prefetched in large worlds: from several arrays at once."""


class StepPlan(NamedTuple):
    """Constants of a step of a scene."""

    agent: AgentPlan
    numbers: NumberPlan
    confines: Law | None  # moves agents into a periodic box when a call begins
    arrange: ArrangePlan | None
    counts: tuple[OneLaw, ...]  # laws that count agents
    sense: SensePlan
    response: ResponsePlan
    move: MovePlan
    method: Callable[[Provided], Method] | None  # of several stages
    method_plan: MethodPlan
    senses_first: bool  # True if `sense` runs at the beginning of a step, for inner states
    ahead: tuple[int, ...]  # numbers of a block in `pos`, `vel`, `pair_force` and `ident`, to be prefetched; or empty
    trusts: bool  # True if every agent has a finite position until a step has failed, see KernelPlan.trusts
    spreads: bool  # True if a NaN position reaches every neighbour within one step
    bonds: BondPlan | None  # of bonds that keep numbers


def step_plan(parts: KernelPlan) -> StepPlan:
    """Return the `StepPlan` of a scene."""
    d, w = parts.dimension, parts.width
    method = None if parts.one_stage else parts.integrator.advance()
    return StepPlan(
        agent_plan(parts), parts.number_plan,
        parts.space.confine_law if parts.confines else None,
        arrange_plan(parts) if parts.arranges else None, laws_of(parts, "count_law"), sense_plan(parts),
        response_plan(parts),
        move_plan(parts), method, method_plan(parts), parts.inner != () and parts.integrator.solves,
        (d * w, d * w, parts.pair_force_size, w) if parts.sorts else (), parts.trusts, parts.spreads,
        bond_plan(parts, agent_plan(parts)) if parts.keeps_bonds else None,
    )  # fmt: skip


# --- one step ---------------------------------------------------------------------------------------------------------


@functools.cache
def _count_one(law: OneLaw) -> Callable[..., None]:
    """Return `counts(numbers, me, lives)`: add a living agent to the counter that a law selects."""
    which_of, k = value_of(law), law.k

    def counts(numbers: Any, me: Any, lives: Any) -> None:
        which: Any = np.int64(which_of(numbers, me))
        if lives and which >= 0 and which < len(numbers.effects[k].counted):
            numbers.effects[k].counted[which] += like(me.radius, 1.0)

    return kernel(counts)


@functools.cache
def _clear_counters(k: int) -> Callable[..., None]:
    def clears(numbers: Any) -> None:
        numbers.effects[k].counted[:] = 0

    return kernel(clears)


@section
def _count(agent: AgentPlan, laws: tuple[OneLaw, ...]) -> Callable[..., None]:
    """Make `count_agents(context, pos, vel, time)`: count all agents of a world, by one thread of the team."""
    d, width = agent.dimension, agent.width
    place_in, vector, agent_at = place_of(d, width), vector_of_lane(d, width), agent_of(agent._replace(aims=False))
    clear, counts = call_in_turn(*(_clear_counters(law.k) for law in laws)), call_in_turn(*map(_count_one, laws))

    def count_agents(context: Any, pos: Any, vel: Any, time: Any) -> None:
        scratch, numbers, random_key = context.scratch, context.numbers, context.key[context.b]
        wait_for_team(scratch.sync, context.team)  # inner states were written by other threads
        if context.rank == 0:
            clear(numbers)
            for i in range(np.uint64(context.n)):
                at = place_in(i)
                x, v = vector(pos, at), vector(vel, at)
                me = agent_at(scratch, random_key, time, at, i, i, x, v, zero(x))
                counts(numbers, me, scratch.living[i] > like(x[0], 0.0))
        wait_for_team(scratch.sync, context.team)  # before any agent changes

    return count_agents


@functools.cache
def _prefetch_block(many: int, width: int) -> Callable[[Any, Any], None]:
    """Return `asks(array, block)`: prefetch `many` numbers of a block of an array."""
    places = tuple(range(0, many, width))
    return kernel(lambda array, block: _prefetch_all(array, block * np.uint64(many), places))


@kernel
def _prefetch_all(array: Any, at: Any, places: Any) -> None:
    for place in places:
        prefetch_for_write(array, at + np.uint64(place))


@section
def _prefetch_ahead(numbers: tuple[int, ...], width: int) -> Callable[..., None]:
    """Make `prefetch_ahead(scratch, pos, vel, block)`: prefetch forces and states of a later block."""
    (of_pos, of_vel, of_pair_force, of_ident), pair_force = (
        (_prefetch_block(many, width) for many in numbers),
        numbers[2] > 0,
    )

    def prefetch_ahead(scratch: Any, pos: Any, vel: Any, block: Any) -> None:
        ahead = block + np.uint64(AHEAD)
        of_pos(pos, ahead)
        of_vel(vel, ahead)
        if pair_force:
            of_pair_force(scratch.pair_force, ahead)
        of_ident(scratch.ident, ahead)

    return prefetch_ahead


@section
def _in_two_loops(plan: StepPlan) -> Callable[..., None]:
    """Make `advance` for a method of one stage: once `sense` is done, no agent reads what another writes.

    PART blocks at a time, which stay in the nearest cache; their accelerations are saved in `saved`. In a single loop,
    from forces to new positions, too few agents would be in flight at a time.
    """
    size = np.uint64(plan.agent.dimension * plan.agent.width)
    respond, move = respond_of(plan.response), move_of(plan.move)
    prefetch_ahead = _prefetch_ahead(plan.ahead, plan.agent.width) if plan.ahead else None
    sense = sense_of(plan.sense)

    def advance(context: Any, pos: Any, vel: Any, time: Any, dt: Any, instant: Any) -> None:
        saved, first, end = context.scratch.saved, context.first, context.end
        sense(context, pos, vel, time)
        for begin in range(first, end, PART):
            until, before = min(begin + PART, end), np.uint64(begin - first)  # each thread at a place of its own
            for block in range(np.uint64(begin), np.uint64(until)):
                if prefetch_ahead is not None:
                    prefetch_ahead(context.scratch, pos, vel, block)
                respond(context, pos, vel, time, block, saved, (block - before) * size)
            for block in range(np.uint64(begin), np.uint64(until)):
                move(context, pos, vel, time, dt, instant, block, (block - before) * size)

    return advance


@section
def _by_method(plan: StepPlan) -> Callable[..., None]:
    """Make `advance` for a method of several stages, which calls for accelerations by itself."""
    assert plan.method is not None
    size, move = plan.agent.dimension * plan.agent.width, move_of(plan.move)
    advance_by = advance_of(plan.method, plan.method_plan)(accelerate_of(plan.response, plan.sense))
    flows, bounces, sense = (
        plan.move.flows,
        plan.move.bounce is not None,
        sense_of(plan.sense) if plan.senses_first else None,
    )

    def advance(context: Any, pos: Any, vel: Any, time: Any, dt: Any, instant: Any) -> None:
        scratch, first, end = context.scratch, context.first, context.end
        if sense is not None:
            sense(context, pos, vel, time)
        for i in range(np.uint64(first * size), np.uint64(end * size)):
            scratch.saved[i] = pos[i]
            if bounces:
                scratch.saved[np.uint64(len(pos)) + i] = vel[i]
        if flows:
            advance_by(context, pos, vel, scratch.advection, time, dt, scratch.stages, first * size, end * size)
        else:
            advance_by(context, pos, vel, (), time, dt, scratch.stages, first * size, end * size)
        for block in range(np.uint64(first), np.uint64(end)):
            move(context, pos, vel, time, dt, instant, block, block * np.uint64(size))

    return advance


def _advance(plan: StepPlan) -> Callable[..., None]:
    """Return `advance(context, pos, vel, time, dt, instant)`: a step of this thread's agents."""
    return _in_two_loops(plan) if plan.method is None else _by_method(plan)


@section
def _advance_and_keep(plan: StepPlan) -> Callable[..., None]:
    """Make `advance` for a scene whose bonds keep numbers."""
    assert plan.bonds is not None
    advance_agents, keep_bonds = _advance(plan), keep_bonds_of(plan.bonds)

    def advance(context: Any, pos: Any, vel: Any, time: Any, dt: Any, instant: Any) -> None:
        advance_agents(context, pos, vel, time, dt, instant)
        keep_bonds(context, pos, vel, time)

    return advance


# --- several steps of a world -----------------------------------------------------------------------------------------


@section
def _first_bad(bad: int, width: int) -> Callable[..., Any]:
    """Make `first_bad(lanes, well)`: return the lowest number of an agent that is not finite, or `well`."""
    at = np.uint64(bad)

    def first_bad(lanes: Any, well: Any) -> Any:
        worst = well
        for lane in range(width):  # one after another: no loop over lanes
            worst = min(worst, lanes[at + np.uint64(lane)])
        return worst

    return first_bad


@section
def _first_failure(bad: int, width: int) -> Callable[..., Any]:
    """Make `failing(lanes, well, step, n, failed, none_failed)`: return which agent failed first, and in which step.

    As one number, step * n + agent; `none_failed`, n (count + 1), as long as no agent has.
    """
    at, lowest = np.uint64(bad), _first_bad(bad, width)

    def failing(lanes: Any, well: Any, step: Any, n: Any, failed: Any, none_failed: Any) -> Any:
        fallen = np.int32(0)
        for lane in range(np.uint64(width)):
            fallen += np.int32(1) if lanes[at + lane] < well else np.int32(0)
        if fallen > np.int32(0) and failed == none_failed:
            return np.int64(step * n) + np.int64(lowest(lanes, well))
        return failed

    return failing


@section
def _copy_in(plan: StepPlan) -> Callable[..., Context]:
    """Make `enter(worlds, drive, drive_row, params, count, b, rank, team, scratch)`: copy agents into blocks.

    The agents are those of this thread. It returns the context of world b, reordered for `count` steps if that pays.
    """
    agent, d, width, ordered = plan.agent, plan.agent.dimension, plan.agent.width, plan.arrange is not None
    read, bring_in, take_drive = numbers_of(plan.numbers), bring_in_of(agent), take_drive_of(d, width, ordered)
    bring_inside = bring_inside_of(agent, plan.confines) if plan.confines is not None else None
    move_in = move_in_of(plan.arrange) if plan.arrange is not None else None
    bring_bonds = bring_bonds_of(plan.bonds.kept, True) if plan.bonds is not None else None

    def enter(
        worlds: Any, drive: Any, drive_row: Any, params: Any, count: Any, b: Any, rank: Any, team: Any, scratch: Any
    ) -> Any:
        n, alive = worlds.x.shape[2], worlds.alive
        blocks = (n + (width - 1)) // width
        first, end = blocks * rank // team, blocks * (rank + 1) // team
        present = np.int64(0)  # not a literal: laws would be typed for it too, and compiled twice
        for i in range(n):
            present += alive[b, i]
        for i in range(first * width, min(end * width, n)):
            scratch.living[i] = alive[b, i]
        bring_in(worlds, scratch, b, first, end)
        take_drive(scratch, drive, drive_row, n, first, end)
        if bring_bonds is not None:  # noqa: SIM102  # numba drops the branch by this alone
            if rank == 0:  # forces wait for all threads before they read them
                bring_bonds(worlds, scratch, b)
        numbers, arranged = read(params, scratch.counters), False
        if bring_inside is not None:
            bring_inside(scratch, numbers.size, first, end)
        if move_in is not None:
            arranged = move_in(scratch, numbers, count, (n, present, first, end, rank, team))
        return Context(
            worlds.obstacle_x, worlds.obstacle_radius, worlds.work, params, numbers, worlds.key, b, n, present,
            arranged, first, end, rank, team, scratch,
        )  # fmt: skip

    return enter


@section
def _copy_out(plan: StepPlan) -> Callable[..., None]:
    """Make `leave(worlds, scratch, b, first, end, rank)`: copy this thread's agents back, and numbers of bonds."""
    bring_out = bring_out_of(plan.agent)
    bring_bonds = bring_bonds_of(plan.bonds.kept, False) if plan.bonds is not None else None

    def leave(worlds: Any, scratch: Any, b: Any, first: Any, end: Any, rank: Any) -> None:
        bring_out(worlds, scratch, b, first, end)
        if bring_bonds is not None:  # noqa: SIM102  # numba drops the branch by this alone
            if rank == 0:
                bring_bonds(worlds, scratch, b)

    return leave


@section
def step_world_of(plan: StepPlan) -> Callable[..., int]:
    """Make `step_world(worlds, drive, drive_row, params, dt, count, b, rank, team, scratch)`.

    It advances this thread's part of world b by `count` steps, and returns -1, or an agent that is not finite: the
    lowest at the end of the call, or, if agents make others not finite (`spreads`), the lowest after the first step
    that failed. Then nothing of the world is written. The commanded steering force is drive[:, drive_row], N; 0 if
    drive is empty.
    """
    agent, width, bad = plan.agent, plan.agent.width, np.uint64(plan.move.bad)
    enter, bring_out, counted = _copy_in(plan), _copy_out(plan), tuple(range(COUNTED_BY_KERNELS))
    count_agents = _count(agent, plan.counts) if plan.counts else None
    advance = _advance(plan) if plan.bonds is None else _advance_and_keep(plan)
    first_bad, failing = (
        _first_bad(plan.move.bad, width),
        _first_failure(plan.move.bad, width) if plan.spreads else None,
    )
    move_back = move_back_of(plan.arrange) if plan.arrange is not None else None
    verdict = _verdict(plan.trusts, agent.dimension)

    def step_world(
        worlds: Any, drive: Any, drive_row: Any, params: Any, dt: Any, count: Any, b: Any, rank: Any, team: Any,
        scratch: Any,
    ) -> Any:  # fmt: skip
        context = enter(worlds, drive, drive_row, params, count, b, rank, team, scratch)
        n, first, end, pos, vel, lanes = context.n, context.first, context.end, scratch.pos, scratch.vel, scratch.lanes
        well, begun, before = like(dt, np.inf), worlds.tick[b], gather(worlds.work[b], np.uint64(0), counted)
        none_failed = np.int64(n * (count + 1))
        failed = none_failed
        for lane in range(np.uint64(width)):
            lanes[bad + lane] = well
        for step in range(count):
            time = like(dt, (begun + step) * np.float64(dt))
            if count_agents is not None:
                count_agents(context, pos, vel, time)
            advance(context, pos, vel, time, dt, begun + step)
            if failing is not None:
                failed = failing(lanes, well, step, n, failed, none_failed)
        if move_back is not None:  # noqa: SIM102  # numba drops the branch by this alone
            if context.arranged:
                move_back(scratch, (n, context.present, first, end, rank, team))
        if failing is None:
            worst = first_bad(lanes, well)
            failed = np.int64(worst) if worst < well else none_failed
        found = verdict(worlds, scratch, b, n, (rank, team), before, failed, none_failed)
        if found < 0:
            bring_out(worlds, scratch, b, first, end, rank)
            if rank == 0:
                worlds.tick[b] += count
        return found

    return step_world


@section
def _verdict(trusts: bool, dimension: int) -> Callable[..., int]:
    """Make `verdict(worlds, scratch, b, n, place, before, failed, none_failed)`: an agent that is not finite, or -1.

    It combines the results of all threads of the team; place = (rank, team). On failure the counters of the world are
    reset to `before`. It takes no context, whose type is that of one scene, so it is compiled once for all of them.
    """

    def verdict(
        worlds: Any, scratch: Any, b: Any, n: Any, place: Any, before: Any, failed: Any, none_failed: Any
    ) -> Any:
        rank, team = place
        # the first half may still be read by threads that count
        scratch.tally[team + rank] = failed
        wait_for_team(scratch.sync, team)
        first = none_failed
        for r in range(team):
            first = min(first, scratch.tally[team + r])
        wait_for_team(scratch.sync, team)  # before any thread counts again
        if first >= none_failed:
            return np.int64(-1)
        agent = first % n
        if rank == 0:
            for k in range(COUNTED_BY_KERNELS):
                worlds.work[b, k] = before[k]
        if trusts:  # an agent that was not finite before the call is the cause
            for i in range(n):
                for k in range(dimension):
                    if worlds.alive[b, i] and not finite(worlds.x[k, b, i]):
                        return np.int64(i)
        return np.int64(agent)

    return verdict
