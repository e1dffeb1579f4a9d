"""The plan of `play` of a task, and the records of arrays that are passed to it."""

from __future__ import annotations

from typing import Any, NamedTuple

from flockenv.engine import BeginPlan, LookPlan, StepPlan
from flockenv.jit.decorators import Law

__all__ = [
    "REFUSED", "Constants", "Decision", "Kernels", "Near", "Plan", "Results", "Totals", "WorldArrays",
]  # fmt: skip

REFUSED = -2
"""The world that `play` returns if an action is not finite."""


class WorldArrays(NamedTuple):
    """Arrays that change during episodes. B worlds, N agents, D axes, M obstacles."""

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
    frame_and_inner: Any  # a tuple of arrays: frames and inner states, if any


class Constants(NamedTuple):
    """Numbers that the kernel is passed and never changes."""

    params: Any  # of the scene
    numbers: Any  # of the task: its parameters()
    table: Any  # of the task: its table()


class Totals(NamedTuple):
    """Sums over an episode."""

    last: Any  # (B, Q) the measures of the last decision
    sums: Any  # (B, Q) sums of the measures
    paid: Any  # (K, B, L) sums of the reward terms


class Decision(NamedTuple):
    """Scratch arrays of a decision in one world."""

    row_buffer: Any  # (L, O), or (0, 0) without streaming stores
    force: Any  # (D, 1, N) N
    x0: Any  # (D, N) m, positions before the decision
    v0: Any  # (D, N) m/s
    alive0: Any  # (N,)
    actions: Any  # actions in columns
    rewards: Any  # terms in columns
    padded: Any  # (own, near_vel, near_radius, row_columns) for a task with `abreast`, else empty


class Near(NamedTuple):
    """Results of `look`; see Frame."""

    square: Any
    index: Any
    count: Any
    gap: Any
    obstacle: Any
    obstacles: Any
    pos: Any


class Results(NamedTuple):
    """Results of a decision; see world.Step."""

    rows: Any
    payment: Any
    terms: Any
    over: Any
    late: Any
    success: Any
    present: Any


class Kernels(NamedTuple):
    """The kernels of a task, and the kernel plans of its scene; None if there is none."""

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
    """All constants of `play` of a task."""

    kernels: Kernels
    names: tuple[str, ...]  # of the parameters
    counts: tuple[tuple[int, float], ...]  # indices and values of the constant parameters
    measures: tuple[str, ...]
    lasting: bool
    oriented: bool
    alike: bool
    dimension: int
    width: int
    terms: tuple[str, ...]
    slots: tuple[tuple[str, int], ...]  # of a row: names and first indices
    action: int  # numbers of an action
    memory: int
    abreast: int  # numbers of a row that the kernel `abreast` writes
    apart: int  # distance between columns; 0 without `abreast`
