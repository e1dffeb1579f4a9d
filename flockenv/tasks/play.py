"""The compiled entry points of a task, `play` and `compute_metrics`, made of its kernels and its scene's step.

`play` begins episodes or takes decisions; most of it is the neighbour search, which is compiled once. `compute_metrics`
reads the sums that `play` has kept. Parameters that are loop bounds (`Task.counts`) are constants in both.
"""

from __future__ import annotations

import keyword
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine import begin_plan, plan_look, step_plan
from flockenv.jit.decorators import Law, finite, kernel
from flockenv.jit.intrinsics import unaliased
from flockenv.jit.memory import store_fence
from flockenv.jit.section import digest_of, entry_of
from flockenv.jit.simd_rows import as_contiguous, column_distance, columns, flatten
from flockenv.tasks.decision import (
    act_of,
    begin_of,
    by_name_of,
    evaluate_of,
    frame_before,
    frame_of,
    indices_of,
    padded_frame_of,
    parameters_of,
    search_of,
    write_rows_of,
)
from flockenv.tasks.play_plan import REFUSED, Kernels, Plan, WorldArrays
from flockenv.tasks.task import Task

__all__ = ["metrics_of", "name_of", "plan_of", "play_of"]


def play_of(task: Task) -> Callable[..., tuple[int, int]]:
    """Return the entry point of a task that begins episodes and takes decisions."""
    return _play(plan_of(task))


def plan_of(task: Task) -> Plan:
    """Return the plan of `play` of a task; raise TypeError for a task that cannot be compiled."""
    _check(task)
    parts = task.parts
    own = {name: _kernel_of(task, name) for name in ("spawn", "drive", "reward", "ended", "measure", "observe")}
    kernels = Kernels(
        **own, keep=_kernel_of(task, "keep") if task.keeps else None,
        abreast=_kernel_of(task, "abreast") if task.abreast else None, step=step_plan(parts),
        look=plan_look(parts) if task.look else None, begin=begin_plan(parts),
    )  # fmt: skip
    return Plan(
        kernels, tuple(task.parameters()), _counts(task), task.measures, task.lasting_aim, parts.oriented, task.alike,
        parts.dimension, parts.width, task.terms, tuple(task.layout.places.items()), task.action_layout.size,
        task.memory, task.abreast, column_distance(task.learners) if task.abreast else 0,
    )  # fmt: skip


def name_of(task: Task) -> str:
    """Return the name of a task's kernel, with a digest of every law in it."""
    return f"task_{task.name}_{digest_of(plan_of(task))}"


def metrics_of(task: Task) -> Callable[..., None]:
    """Return the entry point of a task that computes metrics."""
    kernel = _kernel_of(task, "metrics")
    return _compute_metrics(kernel, tuple(task.parameters()), _counts(task), task.measures, task.metric_names)


def _kernel_of(task: Task, name: str) -> Law:
    """Return a kernel of the module in which a task is defined."""
    module = type(task).__module__
    kernel: Law | None = getattr(sys.modules[module], name, None)
    if kernel is None:
        raise TypeError(f"{type(task).__name__}: {module} has no kernel `{name}`")
    return kernel


def _counts(task: Task) -> tuple[tuple[int, float], ...]:
    """Return the indices and values of the parameters in `Task.counts`."""
    return tuple((k, v) for k, (name, v) in enumerate(task.parameters().items()) if name in task.counts)


def _check(task: Task) -> None:
    """Raise TypeError for a task that cannot be compiled: unknown counts, no terms, or bad names."""
    kind, names = type(task).__name__, task.parameters()
    unknown = [name for name in task.counts if name not in names]
    if unknown:
        raise TypeError(f"{kind}.counts: {unknown[0]!r} is none of its parameters: {', '.join(names)}")
    if not task.terms:
        raise TypeError(f"{kind}.terms is empty: a reward is the sum of at least one term")
    slots = tuple(slot.name for slot in task.layout.slots)
    for what, named in (
        ("terms", task.terms), ("measures", task.measures), ("metric_names", task.metric_names), ("layout", slots),
    ):  # fmt: skip
        for name in named:
            plain = name.isidentifier() and not keyword.iskeyword(name) and name.strip("_") == name and "__" not in name
            if not plain or named.count(name) > 1:
                raise TypeError(f"{kind}.{what}: {name!r} must be a valid field name, and unique")


# --- metrics ----------------------------------------------------------------------------------------------------------


@entry_of
def _compute_metrics(
    metrics: Law,
    names: tuple[str, ...],
    counts: tuple[tuple[int, float], ...],
    measures: tuple[str, ...],
    metric_names: tuple[str, ...],
) -> Callable[..., None]:
    """Return `compute_metrics`, which writes the metrics, (K, B), of B worlds from `first` on into `out`; NaN: none."""
    parameters, by_name, at = parameters_of(names, counts), by_name_of(measures), indices_of(metric_names)

    def compute_metrics(steps: Any, numbers: Any, last: Any, sums: Any, first: int, out: Any) -> None:
        unaliased()
        p = parameters(numbers)
        for k in range(out.shape[1]):
            b = first + k
            out[:, k] = np.nan
            metrics(p, at, by_name(sums[b]), by_name(last[b]), steps[b], out[:, k])

    return compute_metrics


# --- play -------------------------------------------------------------------------------------------------------------


@kernel
def _has_invalid_action(actions: Any, check: bool) -> bool:
    """Return True if `check` and an action is not finite."""
    count = np.int32(0)
    for k in range(np.uint64(actions.shape[0] if check else 0)):
        count += np.int32(0) if finite(actions[k]) else np.int32(1)
    return bool(count > np.int32(0))


@kernel
def _mark_contiguous(worlds: Any) -> Any:
    """Return the arrays of worlds, marked as contiguous over agents for the compiler."""
    return WorldArrays(
        as_contiguous(worlds.x), as_contiguous(worlds.v), worlds.alive, worlds.tick, as_contiguous(worlds.obstacle_x),
        worlds.obstacle_radius, worlds.work, worlds.key, as_contiguous(worlds.memory), worlds.steps,
        worlds.frame_and_inner,
    )  # fmt: skip


@entry_of
def _play(plan: Plan) -> Callable[..., tuple[int, int]]:
    """Return `play`, which takes a decision or begins an episode in worlds [from_world, to_world), and observes them.

    If `acting`, it returns the first (world, agent) that is not finite, or -1s, observes all worlds, and writes the
    terms of worlds in which an agent ends, or of all (`all_worlds`). With `check`, it returns REFUSED as the world, and
    changes nothing, if an action is not finite. If not `acting`, it begins the worlds in `mask`, and observes these, or
    all (`all_worlds`). With `streaming`, rows are made in a buffer and written with streaming stores.
    """
    keep, keeps, parameters = plan.kernels.keep, plan.kernels.keep is not None, parameters_of(plan.names, plan.counts)
    begin, act, search, evaluate = (part(plan) for part in (begin_of, act_of, search_of, evaluate_of))
    pad, write_rows = padded_frame_of(plan), write_rows_of(plan)
    terms, size, column_distance = len(plan.terms), plan.action, plan.apart

    def play(
        worlds: Any, constants: Any, dt: float, count: int, removes_ended: bool, streaming: bool, totals: Any,
        decision: Any, near: Any, scratch: Any, acting: bool, mask: Any, all_worlds: bool, check: bool,
        from_world: int, to_world: int, actions: Any, limit: int, results: Any,
    ) -> tuple[int, int]:  # fmt: skip
        unaliased()
        arrays, table, learners = _mark_contiguous(worlds), constants.table, results.over.shape[1]
        distance = column_distance if column_distance else actions.shape[1]
        action, action_list = columns(decision.actions, actions.shape[1], size, distance), flatten(actions)
        if _has_invalid_action(action_list, check):
            return REFUSED, 0
        p = parameters(constants.numbers)
        bad_world, bad_agent = -1, -1
        for b in range(from_world, to_world):
            if not acting and not mask[b] and not all_worlds:
                continue
            if not acting and mask[b]:
                begin(p, arrays, constants, near, scratch, dt, b)
            if acting:
                frame = frame_of(arrays, scratch, near, table, b)
                bad = act(
                    p, arrays, constants, dt, count, decision, frame, scratch, action_list, action, totals, results,
                    all_worlds, streaming, b,
                )  # fmt: skip
                if bad >= 0 and bad_world < 0:
                    bad_world, bad_agent = b, bad
            placed = search(arrays, constants, near, scratch, b)
            frame = frame_of(arrays, scratch, near, table, b)
            before = frame_before(arrays, scratch, decision, near, table, b)
            if keeps and acting:
                keep(p, before, frame)  # type: ignore[misc]
            padded_count, padded = pad(arrays, scratch, decision, near, table, frame, placed, learners, b)
            if acting:
                earned, next_world = columns(decision.rewards, padded_count, terms, distance), min(b + 1, to_world - 1)
                evaluate(
                    p, arrays, before, padded, action, actions, earned, totals, results, removes_ended, all_worlds,
                    streaming, limit, next_world, b,
                )  # fmt: skip
            write_rows(p, frame, padded, decision, padded_count, results.rows, streaming, b)
        if streaming:
            store_fence()
        return bad_world, bad_agent

    return play
