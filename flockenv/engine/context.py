"""What kernels are handed: the worlds of a state, and one world in progress as a step sees it."""

from __future__ import annotations

from typing import Any, NamedTuple

from flockenv.model.state import State

__all__ = ["Context", "Worlds", "worlds_of"]


class Worlds(NamedTuple):
    """The arrays of a state. B worlds, N agents, D axes, M obstacles; those of a task have more behind these."""

    x: Any  # (D, B, N) m
    v: Any  # (D, B, N) m/s
    carried: Any  # a tuple of arrays: frames and inner states, if there are some
    alive: Any  # (B, N)
    tick: Any  # (B,) steps since the start
    key: Any  # (B,) of random numbers
    obstacle_x: Any  # (D, B, M) m
    obstacle_radius: Any  # (B, M) m
    work: Any  # (B, W) counters


def worlds_of(state: State) -> Worlds:
    """Return the arrays of a state."""
    return Worlds(
        state.x, state.v, state.carried, state.alive, state.tick, state.key, state.obstacle_x, state.obstacle_radius,
        state.work,
    )  # fmt: skip


class Context(NamedTuple):
    """One world in progress, as a step sees it."""

    obstacle_x: Any  # (D, B, M) m
    obstacle_radius: Any  # (B, M) m
    work: Any  # (B, W) counters
    params: Any  # the numbers of the scene in one row, with its tables behind them
    numbers: Any  # the same by name: numbers.Numbers
    key: Any  # (B,) of random numbers
    b: Any  # which world
    n: Any  # how many agents
    present: Any  # how many of them are alive
    arranged: Any  # do they lie by tiles, and not by number?
    first: Any  # this thread's blocks: [first, end)
    end: Any
    rank: Any  # which thread of the team that steps this world
    team: Any  # how many those are
    scratch: Any  # a record of arrays, see scratch.py
