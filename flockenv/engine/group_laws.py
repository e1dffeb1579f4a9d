"""Laws about a group as one: its centre, mean velocity and farthest member are computed once, for all agents.

Each thread computes them for itself, over agents in the order of their numbers, so that all threads get the same bits.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.blocks import place_of, vector_of_lane
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.engine.lane_access import gather, scatter
from flockenv.jit.decorators import Law, finite, kernel, like
from flockenv.jit.intrinsics import wait_for_team
from flockenv.jit.section import call_in_turn, section
from flockenv.maths.vectors import add, dot, scale, sub, zero
from flockenv.physics.effects.effect import Members

__all__ = ["GroupLaw", "GroupPlan", "find_groups_of", "group_plan", "members_of"]


class GroupLaw(NamedTuple):
    """Where the results for the law of an effect lie in the scratch of lanes."""

    k: int  # index of its effect
    places: tuple[int, ...]  # of the count, the centre, the mean velocity, the farthest member


class GroupPlan(NamedTuple):
    """Constants of the code that finds groups."""

    dimension: int
    width: int
    offset_to: Law
    laws: tuple[GroupLaw, ...]


def group_plan(parts: KernelPlan) -> GroupPlan:
    """Return the `GroupPlan` of a scene."""
    laws = [
        GroupLaw(k, tuple(at * parts.width for name, at in parts.slots.items() if name.startswith(f"group{k}_")))
        for k, _ in parts.group_effects
    ]
    return GroupPlan(parts.dimension, parts.width, parts.space.offset_law, tuple(laws))


@section
def find_groups_of(plan: GroupPlan) -> Callable[..., None]:
    """Make `find_groups(context, pos, vel)`: compute the groups that laws are about, at this time."""
    find = call_in_turn(*(_find(plan, law) for law in plan.laws))

    def find_groups(context: Any, pos: Any, vel: Any) -> None:
        sync, team = context.scratch.sync, context.team
        wait_for_team(sync, team)  # all threads have written their positions now
        find(context, pos, vel)
        wait_for_team(sync, team)  # no agent moves before all threads have read positions

    return find_groups


@section
def _find(plan: GroupPlan, law: GroupLaw) -> Callable[..., None]:
    """Make `find(context, pos, vel)`: compute one group from its living members whose position is finite.

    Offsets are from the first member; on a torus each is that to the nearest image.
    """
    vector, place_in, offset_to = (
        vector_of_lane(plan.dimension, plan.width),
        place_of(plan.dimension, plan.width),
        plan.offset_to,
    )
    k, places = law

    def find(context: Any, pos: Any, vel: Any) -> None:
        scratch, size, p = context.scratch, context.numbers.size, context.numbers.effects[k]
        first, end = np.uint64(p.first), min(np.uint64(p.end), np.uint64(context.n))
        o = zero(vector(pos, np.uint64(0)))
        origin, offsets, speeds, many = o, o, o, like(o[0], 0.0)
        for i in range(first, end):
            x = vector(pos, place_in(i))
            if scratch.living[i] > o[0] and finite(dot(x, x)):
                if many == o[0]:
                    origin = x
                offsets, speeds = add(offsets, offset_to(size, origin, x)), add(speeds, vector(vel, place_in(i)))
                many += like(many, 1.0)
        share = like(many, 1.0) / many if many > o[0] else o[0]
        centre, farthest, most = scale(offsets, share), o, like(many, -1.0)
        for i in range(first, end):
            x = vector(pos, place_in(i))
            if scratch.living[i] > o[0] and finite(dot(x, x)):
                to = offset_to(size, origin, x)
                away = sub(to, centre)
                if dot(away, away) > most:
                    farthest, most = to, dot(away, away)
        found = (many,) + add(origin, centre) + scale(speeds, share) + add(origin, farthest)  # noqa: RUF005  # numba adds
        scatter(scratch.lanes, np.uint64(0), places, found)

    return find


@functools.cache
def members_of(plan: GroupPlan, law: GroupLaw) -> Callable[..., Members]:
    """Return `members(lanes, size, x)`: the group that a law is about, as an agent at x sees it."""
    d, places, offset_to = plan.dimension, law.places, plan.offset_to
    count, centre, velocity, farthest = places[:1], places[1 : 1 + d], places[1 + d : 1 + 2 * d], places[1 + 2 * d :]

    def members(lanes: Any, size: Any, x: Any) -> Any:
        begin = np.uint64(0)
        many = gather(lanes, begin, count)[0]
        some = like(many, 1.0) if many > like(many, 0.0) else like(many, 0.0)
        return Members(
            many,
            scale(offset_to(size, x, gather(lanes, begin, centre)), some),
            gather(lanes, begin, velocity),
            scale(offset_to(size, x, gather(lanes, begin, farthest)), some),
        )

    return kernel(members)
