"""The end of a step for the agents of a block: new positions by the method, limits, space, headings, inner states.

A method of one stage is applied here as well, coordinate by coordinate.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.accelerations import pair_force_of
from flockenv.engine.agent_records import AgentPlan, agent_of, agent_plan
from flockenv.engine.blocks import common_places, put_vector_of, vector_of_lane
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.engine.law_calls import OneLaw, arguments_of, value_of
from flockenv.jit.decorators import Law, Vec, finite, kernel, like
from flockenv.jit.section import call_in_turn, section, tuple_from
from flockenv.maths.counter_rng import normal
from flockenv.maths.heading import bank, heading_for, limit_to_heading, turn_towards, up_for
from flockenv.maths.vectors import add, dot, limit, norm, scale, select, sub, zero
from flockenv.physics.integrators.single_stage import OneStage

__all__ = ["InnerPlan", "MovePlan", "begin_agent_of", "inner_plan", "move_of", "move_plan"]


CHANNELS = 8
"""Channels of random numbers of each effect."""


class KeepLaw(NamedTuple):
    """The laws of an effect that keeps inner states."""

    begin: OneLaw
    keep: OneLaw
    pair_force_at: int  # where the sum of its pair law lies, see KernelPlan.pair_force_at; -1: it has none


class InnerPlan(NamedTuple):
    """Constants of the code that changes inner states."""

    agent: AgentPlan
    laws: tuple[KeepLaw, ...]
    numbers: tuple[tuple[tuple[int, int], ...], ...]  # per number: (law, index in its result) of each law that sets it
    pair_force_size: int  # count of numbers of a block in `pair_force`


class MovePlan(NamedTuple):
    """Constants of the code that moves the agents of a block."""

    agent: AgentPlan
    masked: bool  # True if numbers that all agents share may be read from the first block
    confine: Law
    bounce: Law | None
    turns: bool
    leans: bool
    flows: bool
    method: Law | None  # of one stage: returns a coordinate and its velocity one step later
    kicks: tuple[tuple[int, Law], ...]
    inner: InnerPlan | None
    bad: int  # where among the lanes the agent that is not finite is noted


def inner_plan(parts: KernelPlan) -> InnerPlan | None:
    """Return the plan of the inner states of a scene; None if its agents have none."""
    if not parts.inner:
        return None
    laws = [
        KeepLaw(
            OneLaw.of(parts, k, "begin_law"), OneLaw.of(parts, k, "keep_law"),
            parts.pair_force_at(f"n{k}_") if effect.pair_law else -1,
        )
        for k, effect in parts.keeping
    ]  # fmt: skip
    numbers = tuple(
        tuple((j, effect.keeps.index(name)) for j, (_, effect) in enumerate(parts.keeping) if name in effect.keeps)
        for name in parts.inner
    )
    return InnerPlan(agent_plan(parts), tuple(laws), numbers, parts.pair_force_size)


def move_plan(parts: KernelPlan) -> MovePlan:
    """Return the `MovePlan` of a scene."""
    kicks = tuple((k, e.kick_law) for k, e in enumerate(parts.effects) if e.kick_law is not None)
    method = parts.integrator.move() if isinstance(parts.integrator, OneStage) else None
    space = parts.space
    return MovePlan(
        agent_plan(parts), parts.arranges, space.confine_law, space.bounce_law, parts.turns, parts.leans, parts.flows,
        method, kicks, inner_plan(parts), parts.slots["bad"] * parts.width,
    )  # fmt: skip


# --- where the method leads -------------------------------------------------------------------------------------------


@section
def _method_step(plan: MovePlan) -> Callable[..., Any]:
    """Make `method_step(scratch, pos, vel, at, past, dt)`: old position and velocity, then new ones by the method.

    The agent lies at `at`; what the method saved of it at `past` of `saved`. For a method of one stage that is its
    acceleration; for any other its old position, and its old velocity if bodies bounce.
    """
    dimension, vector, bounces = plan.agent.dimension, vector_of_lane(*plan.agent[:2]), plan.bounce is not None
    method, flows = plan.method, plan.flows

    def method_step(scratch: Any, pos: Any, vel: Any, at: Any, past: Any, dt: Any) -> Any:
        x, v = vector(pos, at), vector(vel, at)
        if method is None:
            was, earlier = vector(scratch.saved, at), v
            if bounces:
                earlier = vector(scratch.saved, np.uint64(len(pos)) + at)
            return was, earlier, x, v
        a = vector(scratch.saved, past)
        x0, v0 = method(x[0], v[0], a[0], dt)
        x1, v1 = method(x[1], v[1], a[1], dt)
        there: Any = (x0, x1)
        fast: Any = (v0, v1)
        if dimension == 3:
            x2, v2 = method(x[2], v[2], a[2], dt)
            there, fast = (x0, x1, x2), (v0, v1, v2)
        if flows:
            there = add(there, scale(vector(scratch.advection, at), dt))
        return x, v, there, fast

    return method_step


@functools.cache
def _draw(channel: int) -> Callable[..., float]:
    """Return `draws(random_key, instant, i, dt)`: a normal number of (world, step, agent, channel), of dt's type."""
    return kernel(lambda random_key, instant, i, dt: like(dt, normal(random_key, instant, np.int64(i), channel)))  # type: ignore[arg-type]


@functools.cache
def _apply_kicks(kicks: tuple[tuple[int, Law], ...], dimension: int) -> Callable[..., tuple[Vec, Vec]]:
    """Return `apply_kicks(numbers, me, free, random_key, instant, dt, x, v)`: x and v after velocity kicks."""
    before, (k, law) = _apply_kicks(kicks[:-1], dimension) if kicks[1:] else None, kicks[-1]
    draws = tuple_from(*(_draw(CHANNELS * k + j) for j in range(dimension)))

    def apply_kicks(numbers: Any, me: Any, free: Any, random_key: Any, instant: Any, dt: Any, x: Any, v: Any) -> Any:
        if before is not None:
            x, v = before(numbers, me, free, random_key, instant, dt, x, v)
        value = law(numbers.effects[k], me, dt, draws(random_key, instant, me.who, dt))
        kick = select(free, value, zero(x))
        return add(x, scale(kick, like(dt, 0.5) * dt)), add(v, kick)  # as if it came in the middle of the step

    return kernel(apply_kicks)


# --- headings ---------------------------------------------------------------------------------------------------------


@section
def _limit_turn(plan: MovePlan) -> Callable[..., Any]:
    """Make `turn(scratch, i, at, dt, was, x, v)`: x, v, heading of an agent that turns by at most max_turn_rate dt.

    Both its velocity and its displacement in this step are limited so; the displacement by a medium is left out.
    """
    vector, flows = vector_of_lane(*plan.agent[:2]), plan.flows

    def turn(scratch: Any, i: Any, at: Any, dt: Any, was: Any, x: Any, v: Any) -> Any:
        most = min(scratch.max_turn_rate[i] * dt, like(dt, np.pi))
        before, path = vector(scratch.facing, at), sub(x, was)
        if flows:
            path = sub(x, add(was, scale(vector(scratch.advection, at), dt)))
        there, over = turn_towards(path, before, most)
        x = add(x, sub(limit_to_heading(path, there, over), path))
        ahead, over = turn_towards(v, before, most)
        return x, limit_to_heading(v, ahead, over), ahead

    return turn


@section
def _update_heading(plan: MovePlan) -> Callable[..., None]:
    """Make `face(scratch, i, at, dt, v, ahead)`: write the heading of agent i after the step, and its up vector.

    An agent whose turn rate is limited also turns while it stands still: `ahead` is the heading that it has reached.
    """
    dimension, vector, put = plan.agent.dimension, vector_of_lane(*plan.agent[:2]), put_vector_of(*plan.agent[:2])
    turns, leans = plan.turns, plan.leans

    def face(scratch: Any, i: Any, at: Any, dt: Any, v: Any, ahead: Any) -> None:
        before = vector(scratch.facing, at)
        now = heading_for(v, ahead) if turns else heading_for(v, before)
        put(scratch.facing, at, now)
        if dimension == 3:
            up = vector(scratch.above, at)
            if leans:
                up = bank(now, before, up, norm(v), dt, scratch.banking[i])
            put(scratch.above, at, up_for(now, before, up))

    return face


# --- inner states -----------------------------------------------------------------------------------------------------


@functools.cache
def _new_number(number: int, setters: tuple[tuple[int, int], ...]) -> Callable[[Any, Any], float]:
    """Return `new_number(was, value)`: a number as its only law sets it, or changed by several laws."""
    if setters[1:]:
        return _sum_of_changes(number, setters)
    ((law, place),) = setters
    return kernel(lambda was, value: value[law][place])


@functools.cache
def _sum_of_changes(number: int, setters: tuple[tuple[int, int], ...]) -> Callable[[Any, Any], float]:
    """Return `new_number(was, value)`: the old number, plus the changes to it by several laws."""
    before, (law, place) = _sum_of_changes(number, setters[:-1]) if setters[1:] else None, setters[-1]
    if before is None:
        return kernel(lambda was, value: was[number] + (value[law][place] - was[number]))
    return kernel(lambda was, value: before(was, value) + (value[law][place] - was[number]))


def _new_numbers(plan: InnerPlan) -> Callable[..., tuple[float, ...]]:
    return tuple_from(*(_new_number(number, setters) for number, setters in enumerate(plan.numbers)))


@functools.cache
def _evaluate_keep_law(plan: InnerPlan, keeper: KeepLaw) -> Callable[..., Any]:
    """Return `keeps(numbers, scratch, me, row, lane, dt)`: the new values of the numbers that a law keeps."""
    given, law, agent = arguments_of(keeper.keep.k, keeper.keep.images), keeper.keep.law, plan.agent
    pair_force = (
        pair_force_of(agent.dimension, agent.width, plan.pair_force_size, keeper.pair_force_at)
        if keeper.pair_force_at >= 0
        else None
    )

    def keeps(numbers: Any, scratch: Any, me: Any, row: Any, lane: Any, dt: Any) -> Any:
        if pair_force is not None:
            return law(given(numbers, me), me, pair_force(scratch, row, lane), dt)
        return law(given(numbers, me), me, zero(me.pos), dt)

    return kernel(keeps)


@functools.cache
def _put_number(number: int) -> Callable[..., None]:
    """Return `put(inner, i, was, now, alive)`: write a number of agent i; that of a dead agent stays."""

    def put(inner: Any, i: Any, was: Any, now: Any, alive: Any) -> None:
        inner[number][i] = now[number] if alive else was[number]

    return kernel(put)


@functools.cache
def _all_finite(count: int) -> Callable[[Any], bool]:
    """Return `all_finite(now)`: True if all numbers are finite."""
    total = _total(count)
    return kernel(lambda now: finite(total(now)))


@functools.cache
def _total(count: int) -> Callable[[Any], float]:
    before, last = _total(count - 1) if count > 1 else None, count - 1
    if before is None:
        return kernel(lambda now: now[last])
    return kernel(lambda now: before(now) + now[last])


@section
def _write_inner(plan: InnerPlan) -> Callable[..., bool]:
    """Make `keep(scratch, numbers, me, i, row, lane, dt)`: write agent i's inner states.

    It returns True if they are finite.
    """
    value, new_numbers = tuple_from(*(_evaluate_keep_law(plan, keeper) for keeper in plan.laws)), _new_numbers(plan)
    put, all_finite = call_in_turn(*map(_put_number, range(len(plan.numbers)))), _all_finite(len(plan.numbers))

    def keep(scratch: Any, numbers: Any, me: Any, i: Any, row: Any, lane: Any, dt: Any) -> Any:
        now = new_numbers(me.inner, value(numbers, scratch, me, row, lane, dt))
        put(scratch.inner, i, me.inner, now, scratch.living[i] > like(dt, 0.0))
        return all_finite(now)

    return keep


@section
def begin_agent_of(plan: InnerPlan) -> Callable[..., tuple[float, ...]]:
    """Make `begin(numbers, me)`: return the initial inner states of an agent."""
    value, new_numbers = tuple_from(*(value_of(keeper.begin) for keeper in plan.laws)), _new_numbers(plan)

    def begin(numbers: Any, me: Any) -> Any:
        return new_numbers(me.inner, value(numbers, me))

    return begin


# --- a block ----------------------------------------------------------------------------------------------------------


@section
def move_of(plan: MovePlan) -> Callable[..., None]:
    """Make `move(context, pos, vel, time, dt, instant, block, past)`: move the agents of a block.

    past: where the values saved for the block begin, see `_method_step`; instant: number of steps made by the world.
    No agent moves faster than max_speed, whatever a method does to its velocity within the step. The lowest number of
    an agent that is not finite is noted in each lane.
    """
    agent, d, width = plan.agent, plan.agent.dimension, plan.agent.width
    size, bad, put = np.uint64(d * width), np.uint64(plan.bad), put_vector_of(d, width)
    agent_at, common, method_step = agent_of(agent), common_places(d, width, plan.masked), _method_step(plan)
    apply_kicks = _apply_kicks(plan.kicks, d) if plan.kicks else None
    turn = _limit_turn(plan) if plan.turns else None
    face = _update_heading(plan) if agent.oriented else None
    keep = _write_inner(plan.inner) if plan.inner is not None else None
    confine, bounce = plan.confine, plan.bounce

    def move(context: Any, pos: Any, vel: Any, time: Any, dt: Any, instant: Any, block: Any, past: Any) -> None:
        scratch, numbers, random_key = context.scratch, context.numbers, context.key[context.b]
        lanes, ident, well = scratch.lanes, scratch.ident, like(dt, np.inf)
        base, row = block * size, block * np.uint64(width)
        one, live, _ = common(scratch, context.n, context.present, block)
        for lane in range(np.uint64(width)):
            i, at = row + lane, base + lane
            was, earlier, x, v = method_step(scratch, pos, vel, at, past + lane, dt)
            if apply_kicks is not None:
                me = agent_at(scratch, random_key, time, at, i, i, x, v, zero(x))
                free = (scratch.living[i] > like(dt, 0.0)) & (scratch.mass[i] < like(dt, np.inf))
                x, v = apply_kicks(numbers, me, free, random_key, instant, dt, x, v)
            where = well if finite(dot(x, x) + dot(v, v)) else ident[i]
            lanes[bad + lane] = where if where < lanes[bad + lane] else lanes[bad + lane]
            ahead = x
            if turn is not None:
                x, v, ahead = turn(scratch, i, at, dt, was, x, v)
            fastest, living = scratch.max_speed[one + lane], scratch.living[live + lane]
            x = add(was, scale(limit(sub(x, was), fastest * dt), living))
            if bounce is not None:
                x, v = bounce(
                    numbers.size, scratch.radius[one + lane], numbers.space[0], dt, was, scale(earlier, living), x,
                    scale(limit(v, fastest), living),
                )  # fmt: skip
                v = limit(v, fastest)
            else:
                x, v = confine(numbers.size, scratch.radius[one + lane], x, scale(limit(v, fastest), living))
            if face is not None:
                face(scratch, i, at, dt, v, ahead)
            put(pos, at, x)
            put(vel, at, v)
            if keep is not None:
                me = agent_at(scratch, random_key, time, at, i, i, x, v, zero(x))
                where = well if keep(scratch, numbers, me, i, row, lane, dt) else ident[i]
                lanes[bad + lane] = where if where < lanes[bad + lane] else lanes[bad + lane]

    return move
