"""Agents as pair laws see them: in a lane of a block, or as a candidate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.blocks import place_of
from flockenv.engine.lane_access import gather
from flockenv.engine.neighbour_lists import Listing
from flockenv.jit.decorators import kernel
from flockenv.jit.section import record, section
from flockenv.maths.vectors import zero
from flockenv.physics.effects.effect import Me

__all__ = ["Besides", "Block", "Candidate", "listed_agent", "listed_candidate", "separation_direction_of", "with_tie"]


class Candidate(NamedTuple):
    """A listed agent, as pair laws see it; fields that no law reads are 0."""

    pos: Any
    vel: Any
    tie: Any
    who: Any
    radius: Any
    mass: Any
    inner: Any


class Besides(NamedTuple):
    """Data that pair laws need in some scenes only: empty tuples in all others."""

    scenery: Any  # obstacle_x, obstacle_radius, params, world: for sights that obstacles block
    separation_directions: Any  # arrays tie, ident, order: for ties that are not listed


@section
def listed_agent(listing: Listing, inner: tuple[str, ...], oriented: bool) -> Callable[..., Me]:
    """Make `agent(array, at, time, random_key)`: return the agent in a lane of a block, as pair laws see it."""
    pos, vel, tie, aim, heading = (
        listing.lanes_of(listing.axes(x)) for x in ("x", "v", "t", "a", "d" if oriented else "h")
    )
    numbers = listing.lanes_of(("who", "mass", "radius", "max_speed", "max_force", "desired_speed"))
    inside, kind, has_inner = _inner_fields(inner), record(inner), bool(inner)
    within = listing.lanes_of(inside)

    def agent(array: Any, at: Any, time: Any, random_key: Any) -> Any:
        x = gather(array, at, pos)
        who, mass, radius, max_speed, max_force, desired_speed = gather(array, at, numbers)
        return Me(
            who, x, gather(array, at, vel), gather(array, at, heading), mass, radius, max_speed, max_force,
            gather(array, at, tie), time, zero(x), random_key, gather(array, at, aim), desired_speed,
            kind(*gather(array, at, within)) if has_inner else (),
        )  # fmt: skip

    return agent


def _inner_fields(inner: tuple[str, ...]) -> tuple[str, ...]:
    """Return the fields of the inner states of an agent."""
    return tuple(f"inner{k}" for k in range(len(inner)))


@section
def listed_candidate(listing: Listing, inner: tuple[str, ...]) -> Callable[..., Candidate]:
    """Make `candidate(array, at)`: return the agent whose record, or place in rows, begins at `at`."""
    pos, vel, tie = (listing.candidate_places(listing.axes(letter)) for letter in "xvt")
    numbers, within = (
        listing.candidate_places(("who", "radius", "mass")),
        listing.candidate_places(_inner_fields(inner)),
    )
    kind, has_inner = record(inner), bool(inner)

    def candidate(array: Any, at: Any) -> Any:
        who, radius, mass = gather(array, at, numbers)
        states = kind(*gather(array, at, within)) if has_inner else ()
        return Candidate(
            gather(array, at, pos), gather(array, at, vel), gather(array, at, tie), who, radius, mass, states
        )

    return candidate


@kernel
def with_tie(me: Me, tie: Any) -> Me:
    """Return an agent with its tie, which was not listed."""
    return Me(
        me.who, me.pos, me.vel, me.heading, me.mass, me.radius, me.max_speed, me.max_force, tie, me.time, me.medium,
        me.key, me.aim, me.desired_speed, me.inner,
    )  # fmt: skip


@section
def separation_direction_of(dimension: int, width: int) -> Callable[..., Any]:
    """Make `tie(arrays, i)`: return the tie, or separation direction, of agent i."""
    vector, place = tuple(k * width for k in range(dimension)), place_of(dimension, width)
    return lambda arrays, i: gather(arrays[0], place(np.uint64(arrays[1][i])), vector)


class Block(NamedTuple):
    """A block of listed agents, which interact with their candidates."""

    mine: Any  # array with the fields of its agents: lanes, or rows
    first: Any  # where the first agent lies there
    theirs: Any  # array with the fields of candidates: records, or rows
    lanes: Any  # running numbers
    number: Any  # (W,) index of each lane
    at: Any  # the first of its agents, and
    upto: Any  # one past the last, as they are listed
    ranges: Any  # (found, 3) its candidates
    time: Any  # s
    random_key: Any  # the key of random numbers
