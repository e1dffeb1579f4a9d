"""The entry points of a scene: `step` its worlds, `begin` the inner states of its agents, compute its `field`.

Each is a function of the scene's `KernelPlan`; its machine code is cached, see `section.entry_of`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.accelerations import ResponsePlan, SensePlan, accelerate_of, response_plan, sense_plan
from flockenv.engine.agent_records import agent_of
from flockenv.engine.blocks import out_of_blocks, place_of, vector_of_lane
from flockenv.engine.bonds import bring_bonds_of
from flockenv.engine.context import Context
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.engine.load_store import bring_in_of, take_drive_of
from flockenv.engine.move import InnerPlan, begin_agent_of, inner_plan
from flockenv.engine.parameters import NumberPlan, numbers_of
from flockenv.engine.step import StepPlan, step_plan, step_world_of
from flockenv.jit.decorators import kernel, like
from flockenv.jit.intrinsics import unaliased
from flockenv.jit.section import call_in_turn, entry_of, section, set_title
from flockenv.maths.vectors import zero

__all__ = ["BeginPlan", "begin_inner_of", "begin_of", "begin_plan", "field_of", "step_of"]


def step_of(parts: KernelPlan) -> Callable[..., tuple[int, int]]:
    """Return the entry point `step` of a scene: see `_scene_step`."""
    return set_title(_scene_step(step_plan(parts)), f"{_title(parts)}, {parts.integrator.kind}")


def _title(parts: KernelPlan) -> str:
    """Return a description of a kernel, which is shown while it is compiled."""
    effects = ", ".join(type(e).__name__ for e in parts.effects) or "no effects"
    return f"{parts.dimension}-D {parts.space.kind}; {effects}"


@entry_of
def _scene_step(plan: StepPlan) -> Callable[..., tuple[int, int]]:
    """Make `scene_step`: advance worlds [from_world, to_world) by `count` steps.

    It returns the first (world, agent) that is not finite, or (-1, -1). drive is (D, B, N), or (D, 0, N) if there is
    none. A team of several threads calls this with the same worlds, each thread with its rank.
    """
    step_world = step_world_of(plan)

    def scene_step(
        worlds: Any, drive: Any, params: Any, dt: float, count: int, from_world: int, to_world: int, rank: int,
        team: int, scratch: Any,
    ) -> tuple[int, int]:  # fmt: skip
        unaliased()
        broken, agent = -1, -1
        for b in range(from_world, to_world):  # no branch in here: LLVM would copy the step for each of its outcomes
            bad = step_world(worlds, drive, b, params, dt, count, b, rank, team, scratch)
            if bad >= 0 and broken < 0:
                broken, agent = b, bad
        return broken, agent

    return scene_step


class BeginPlan(NamedTuple):
    """Constants of the code that initialises inner states."""

    inner: InnerPlan
    numbers: NumberPlan


def begin_plan(parts: KernelPlan) -> BeginPlan | None:
    """Return the `BeginPlan` of a scene; None if its agents have no inner states."""
    inner = inner_plan(parts)
    return BeginPlan(inner, parts.number_plan) if inner is not None else None


@section
def begin_inner_of(plan: BeginPlan) -> Callable[..., None]:
    """Make `begin_inner(worlds, params, dt, fresh, b, scratch)`: write the initial inner states of `fresh` agents.

    The agents are those of world b, at its current time; fresh (B, N).
    """
    agent, d, width = plan.inner.agent, plan.inner.agent.dimension, plan.inner.agent.width
    agent_at, vector, read = agent_of(agent._replace(aims=False)), vector_of_lane(d, width), numbers_of(plan.numbers)
    begin, bring_in = begin_agent_of(plan.inner), bring_in_of(agent._replace(inner=()))
    place_in, place, many = place_of(d, width), int(agent.oriented), len(agent.inner)
    clear, write = call_in_turn(*map(_clear_number, range(many))), call_in_turn(*map(_begin_number, range(many)))

    def begin_inner(worlds: Any, params: Any, dt: Any, fresh: Any, b: Any, scratch: Any) -> None:
        n = worlds.x.shape[2]
        time = like(dt, worlds.tick[b] * np.float64(dt))
        numbers = read(params, scratch.counters)
        bring_in(worlds, scratch, b, 0, (n + (width - 1)) // width)
        for i in range(np.uint64(n)):
            if fresh[b, i]:
                at = place_in(i)
                x, v = vector(scratch.pos, at), vector(scratch.vel, at)
                clear(scratch.inner, i)
                me = agent_at(scratch, worlds.key[b], time, at, i, i, x, v, zero(x))
                write(worlds.frame_and_inner[place], b, i, begin(numbers, me))

    return begin_inner


@functools.cache
def _clear_number(number: int) -> Callable[..., None]:
    def clear(inner: Any, i: Any) -> None:
        inner[number][i] = 0

    return kernel(clear)


@functools.cache
def _begin_number(number: int) -> Callable[..., None]:
    def begin(array: Any, b: Any, i: Any, numbers: Any) -> None:
        array[number, b, i] = numbers[number]

    return kernel(begin)


def begin_of(parts: KernelPlan) -> Callable[..., None]:
    """Return the entry point `begin` of a scene with inner states: see `_scene_begin`."""
    plan = begin_plan(parts)
    assert plan is not None, "a scene in which agents keep nothing"
    return set_title(_scene_begin(plan), f"{_title(parts)}, inner states")


@entry_of
def _scene_begin(plan: BeginPlan) -> Callable[..., None]:
    """Make `scene_begin`: write the initial inner states of the agents of all worlds that are `fresh`, (B, N)."""
    begin_inner = begin_inner_of(plan)

    def scene_begin(worlds: Any, params: Any, dt: float, fresh: Any, scratch: Any) -> None:
        unaliased()
        for b in range(worlds.x.shape[1]):
            begin_inner(worlds, params, dt, fresh, b, scratch)

    return scene_begin


def field_of(parts: KernelPlan) -> Callable[..., None]:
    """Return the entry point `field` of parts that are not `stepped`: see `_scene_field`."""
    made = _scene_field(response_plan(parts), sense_plan(parts), parts.number_plan, parts.place_of_bonds)
    return set_title(made, f"{_title(parts)}, accelerations")


@entry_of
def _scene_field(plan: ResponsePlan, sensed: SensePlan, number_plan: NumberPlan, bonds: int) -> Callable[..., None]:
    """Make `scene_field`: write accelerations at given times, and the flow that carries agents if there is one.

    Both are of all worlds, (D, B, N); nothing moves.
    """
    agent, d, width = plan.agent, plan.agent.dimension, plan.agent.width
    bring_in, take_drive, out = bring_in_of(agent), take_drive_of(d, width, plan.masked), out_of_blocks(d, width)
    read, accelerate, flows = numbers_of(number_plan), accelerate_of(plan, sensed), bool(plan.flows)
    bring_bonds = bring_bonds_of(bonds, True) if bonds >= 0 else None

    def scene_field(worlds: Any, drive: Any, params: Any, times: Any, acc: Any, flow: Any, scratch: Any) -> None:
        unaliased()
        n, end = worlds.x.shape[2], (worlds.x.shape[2] + (width - 1)) // width
        for b in range(worlds.x.shape[1]):
            present = np.int64(0)
            for i in range(n):
                present += worlds.alive[b, i]
                scratch.living[i] = worlds.alive[b, i]
            bring_in(worlds, scratch, b, 0, end)
            take_drive(scratch, drive, b, n, 0, end)
            if bring_bonds is not None:
                bring_bonds(worlds, scratch, b)
            context = Context(
                worlds.obstacle_x, worlds.obstacle_radius, worlds.work, params, read(params, scratch.counters),
                worlds.key, b, n, present, False, 0, end, 0, 1, scratch,
            )  # fmt: skip
            accelerate(context, scratch.pos, scratch.vel, times[b], scratch.saved)
            out(scratch.saved, acc, b, n, 0, end)
            if flows:
                out(scratch.advection, flow, b, n, 0, end)

    return scene_field
