"""The records that kernels are passed: the worlds of a state, and one world in progress as a step sees it."""

from __future__ import annotations

from typing import Any, NamedTuple

from flockenv.model.state import State

__all__ = ["Context", "Worlds", "worlds_of"]


class Worlds(NamedTuple):
    """The arrays of a state. B worlds, N agents, D axes, M obstacles; worlds of a task have more fields."""

    x: Any  # (D, B, N) m
    v: Any  # (D, B, N) m/s
    frame_and_inner: Any  # a tuple of arrays: frames, inner states and numbers of bonds, if there are any
    alive: Any  # (B, N)
    tick: Any  # (B,) steps since the start
    key: Any  # (B,) key of random numbers
    obstacle_x: Any  # (D, B, M) m
    obstacle_radius: Any  # (B, M) m
    work: Any  # (B, W) counters


def worlds_of(state: State) -> Worlds:
    """Return the arrays of a state."""
    return Worlds(
        state.x, state.v, state.frame_and_inner, state.alive, state.tick, state.key, state.obstacle_x,
        state.obstacle_radius, state.work,
    )  # fmt: skip


class Context(NamedTuple):
    """One world in progress, as a step sees it."""

    obstacle_x: Any  # (D, B, M) m
    obstacle_radius: Any  # (B, M) m
    work: Any  # (B, W) counters
    params: Any  # the numbers of the scene in one row, followed by its tables
    numbers: Any  # the same by name: parameters.Numbers
    key: Any  # (B,) key of random numbers
    b: Any  # index of the world
    n: Any  # number of agents
    present: Any  # number of agents alive
    arranged: Any  # True if agents lie by tile, not by number
    first: Any  # this thread's blocks: [first, end)
    end: Any
    rank: Any  # index of this thread in the team that steps this world
    team: Any  # number of threads in the team
    scratch: Any  # a record of arrays, see scratch.py
