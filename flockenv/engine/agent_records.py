"""Agents as the laws of one agent see them: records assembled from the scratch of a world."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from flockenv.engine.blocks import vector_of_lane
from flockenv.jit.decorators import kernel, law, like
from flockenv.jit.section import record, section, tuple_from
from flockenv.maths.vectors import unit, zero
from flockenv.physics.effects.effect import Me

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import KernelPlan

__all__ = ["AgentPlan", "agent_of", "agent_plan", "at_rest", "inner_of"]


class AgentPlan(NamedTuple):
    """Which fields of an agent the laws of a scene need."""

    dimension: int
    width: int
    oriented: bool = False  # True if it keeps a heading of its own
    aims: bool = False  # True if any effect has an aim law: a desired direction
    paced: bool = False  # True if any law reads the desired speed
    inner: tuple[str, ...] = ()  # names of its inner states


def agent_plan(parts: KernelPlan) -> AgentPlan:
    """Return the `AgentPlan` of a scene."""
    paced = "desired_speed" in parts.frame_numbers
    return AgentPlan(parts.dimension, parts.width, parts.oriented, parts.aims, paced, parts.inner)


@section
def agent_of(plan: AgentPlan) -> Callable[..., Me]:
    """Make `agent_at(scratch, random_key, time, place, i, one, x, v, medium)`: agent i as the laws of one agent see it.

    Its vectors lie at `place`, its body at `one`. Its tie is 0: only pairs in the same position need one.
    """
    vector, inner = vector_of_lane(plan.dimension, plan.width), inner_of(plan.inner)
    oriented, aims, paced = plan.oriented, plan.aims, plan.paced

    def agent_at(
        scratch: Any, random_key: Any, time: Any, place: Any, i: Any, one: Any, x: Any, v: Any, medium: Any
    ) -> Any:
        heading = vector(scratch.facing, place) if oriented else unit(v)
        aim = vector(scratch.aiming, place) if aims else zero(x)
        desired_speed = scratch.desired_speed[i] if paced else like(x[0], 0.0)
        return Me(
            scratch.ident[i],
            x,
            v,
            heading,
            scratch.mass[one],
            scratch.radius[one],
            scratch.max_speed[one],
            scratch.max_force[one],
            zero(x),
            time,
            medium,
            random_key,
            aim,
            desired_speed,
            inner(scratch, i),
        )

    return agent_at


@law
def at_rest(me: Me) -> Me:
    """Return an agent as if at rest: its force then lacks linear drag, which the method integrates separately."""
    o = zero(me.pos)
    mass, radius, max_speed, max_force = me.mass, me.radius, me.max_speed, me.max_force
    return Me(
        me.who, me.pos, o, o, mass, radius, max_speed, max_force, me.tie, me.time, me.medium, me.key, me.aim,
        me.desired_speed, me.inner,
    )  # fmt: skip


@section
def inner_of(names: tuple[str, ...]) -> Callable[..., Any]:
    """Make `inner(scratch, i)`: the inner states of agent i, by name."""
    if not names:
        return lambda scratch, i: ()
    kind, values = record(names), tuple_from(*map(_inner_number, range(len(names))))

    def inner(scratch: Any, i: Any) -> Any:
        return kind(*values(scratch, i))

    return inner


@functools.cache
def _inner_number(k: int) -> Callable[..., float]:
    return kernel(lambda scratch, i: scratch.inner[k][i])
