"""What `play` of a task depends on, and the records in which arrays are handed to it."""

from __future__ import annotations

from typing import Any, NamedTuple

from flockenv.engine import BeginPlan, LookPlan, StepPlan
from flockenv.jit.decorators import Law

__all__ = ["REFUSED", "Decision", "Given", "Kernels", "Near", "Plan", "Results", "Totals", "Worlds"]

REFUSED = -2
"""The world that `play` names if an action is no number."""


class Worlds(NamedTuple):
    """What changes while worlds go on. B worlds, N agents, D axes, M obstacles."""

    x: Any  # (D, B, N) m
    v: Any  # (D, B, N) m/s
    alive: Any  # (B, N)
    tick: Any  # (B,)
    obstacle_x: Any  # (D, B, M) m
    obstacle_radius: Any  # (B, M) m
    work: Any  # (B, W) counters
    key: Any  # (B,)
    memory: Any  # (K, B, N)
    steps: Any  # (B,) decisions since the start
    carried: Any  # a tuple of arrays: frames and inner states, if there are some


class Given(NamedTuple):
    """Numbers that stay."""

    params: Any  # of the scene
    numbers: Any  # of the task: its parameters()
    table: Any  # of the task: its table()


class Totals(NamedTuple):
    """What is counted over an episode."""

    last: Any  # (B, Q) the measures of the last decision
    sums: Any  # (B, Q) and their sums
    paid: Any  # (K, B, L) sums of the reward terms


class Decision(NamedTuple):
    """Scratch of a decision in one world; `own` and what follows it of tasks with numbers `abreast` alone."""

    canvas: Any  # (L, O), or (0, 0) where rows do not go past the caches
    force: Any  # (D, 1, N) N
    x0: Any  # (D, N) m, positions before it
    v0: Any  # (D, N) m/s
    alive0: Any  # (N,)
    decided: Any  # actions in columns
    earned: Any  # terms in columns
    wide: Any  # a tuple: own, near_vel, near_radius, beside; or nothing


class Near(NamedTuple):
    """What `look` writes; see Frame."""

    square: Any
    who: Any
    count: Any
    gap: Any
    obstacle: Any
    obstacles: Any
    pos: Any


class Results(NamedTuple):
    """What a decision brought; see world.Step."""

    rows: Any
    payment: Any
    terms: Any
    over: Any
    late: Any
    success: Any
    present: Any


class Kernels(NamedTuple):
    """The kernels of a task, and the plans of those of its scene; None where there is none."""

    spawn: Law
    drive: Law
    reward: Law
    ended: Law
    measure: Law
    observe: Law
    keep: Law | None
    abreast: Law | None
    step: StepPlan
    look: LookPlan | None
    begin: BeginPlan | None


class Plan(NamedTuple):
    """All that `play` of a task depends on."""

    kernels: Kernels
    names: tuple[str, ...]  # of its parameters
    counts: tuple[tuple[int, float], ...]  # which of them are constants, and their values
    measures: tuple[str, ...]
    lasting: bool
    oriented: bool
    alike: bool
    dimension: int
    width: int
    terms: int
    action: int  # numbers of an action
    memory: int
    abreast: int  # numbers of a row that are written abreast
    apart: int  # how far columns lie apart; 0 without them
