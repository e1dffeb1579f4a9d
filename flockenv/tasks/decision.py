"""The parts of a decision in one world: begin or act, search neighbours, compute rewards and ends, observe."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine import begin_inner_of, look_of, step_world_of
from flockenv.engine.lane_access import gather
from flockenv.jit.decorators import kernel, like, replace_at
from flockenv.jit.memory import prefetch, stream_store
from flockenv.jit.section import record, section
from flockenv.jit.simd_rows import as_contiguous, columns, into_rows, take
from flockenv.maths.heading import face
from flockenv.tasks.lasting import aim_has_lasted
from flockenv.tasks.play_plan import Plan
from flockenv.tasks.task import Frame

__all__ = [
    "act_of", "begin_of", "by_name_of", "evaluate_of", "frame_before", "frame_of", "indices_of", "padded_frame_of",
    "parameters_of", "search_of", "write_rows_of",
]  # fmt: skip


# --- numbers by name --------------------------------------------------------------------------------------------------


@functools.cache
def _fix_constants(counts: tuple[tuple[int, float], ...]) -> Callable[[Any], Any]:
    """Return a function that replaces elements of a tuple by constants."""
    k, value = counts[-1]
    before = _fix_constants(counts[:-1]) if counts[1:] else None

    def fix(values: Any) -> Any:
        if before is None:
            return replace_at(values, k, like(values[0], value))
        return replace_at(before(values), k, like(values[0], value))

    return kernel(fix)


@section
def parameters_of(names: tuple[str, ...], counts: tuple[tuple[int, float], ...]) -> Callable[[Any], Any]:
    """Return a function that reads a task's parameters from a row, by name; `counts` are constants."""
    make, places, fixes = record(names), tuple(range(len(names))), bool(counts)
    fix_constants: Any = _fix_constants(counts) if counts else None

    def parameters(numbers: Any) -> Any:
        if fixes:
            return make(*fix_constants(gather(numbers, np.uint64(0), places)))
        return make(*gather(numbers, np.uint64(0), places))

    return parameters


@section
def by_name_of(names: tuple[str, ...]) -> Callable[[Any], Any]:
    """Return a function that reads measures from a row, by name."""
    make, places, has_names = record(names), tuple(range(len(names))), bool(names)

    def by_name(row: Any) -> Any:
        if has_names:
            return make(*gather(row, np.uint64(0), places))
        return ()

    return by_name


def indices_of(names: tuple[str, ...], places: tuple[int, ...] = ()) -> Any:
    """Return the indices of numbers by name, constants for a kernel: their places, by default 0, 1, 2, ..."""
    return record(names)(*(places or range(max(len(names), 1))))


# --- the parts --------------------------------------------------------------------------------------------------------


@kernel
def frame_of(worlds: Any, scratch: Any, near: Any, table: Any, b: int) -> Any:
    """Return the frame of world b."""
    none = near.square[:0]
    return Frame(
        worlds.x[:, b], worlds.v[:, b], worlds.alive[b], worlds.obstacle_x[:, b], worlds.obstacle_radius[b],
        worlds.memory[:, b], worlds.key[b], worlds.steps[b], scratch.radius, scratch.max_speed, scratch.max_force,
        near.square, near.index, near.count, near.gap, near.obstacle, near.obstacles, none, none, none, table,
    )  # fmt: skip


@kernel
def frame_before(worlds: Any, scratch: Any, decision: Any, near: Any, table: Any, b: int) -> Any:
    """Return the frame of world b before the decision, without neighbours."""
    none = near.square[:0]
    return Frame(
        decision.x0, decision.v0, decision.alive0, worlds.obstacle_x[:, b], worlds.obstacle_radius[b],
        worlds.memory[:, b], worlds.key[b], worlds.steps[b], scratch.radius, scratch.max_speed, scratch.max_force,
        none, near.index[:0], near.count[:0], near.gap[:0], near.obstacle[:0], near.obstacles[:0], none, none, none,
        table,
    )  # fmt: skip


@section
def begin_of(plan: Plan) -> Callable[..., None]:
    """Return a function that begins an episode in world b."""
    spawn, inner, oriented = plan.kernels.spawn, plan.kernels.begin, plan.oriented
    begin_inner = begin_inner_of(inner) if inner is not None else None

    def begin(p: Any, worlds: Any, constants: Any, near: Any, scratch: Any, dt: float, b: int) -> None:
        worlds.tick[b] = 0
        worlds.steps[b] = 0
        for i in range(worlds.x.shape[2]):
            worlds.alive[b, i] = True
        spawn(p, frame_of(worlds, scratch, near, constants.table, b))
        if oriented:
            face(worlds.v, worlds.frame_and_inner[0], b, True)
        if begin_inner is not None:
            begin_inner(worlds, constants.params, dt, worlds.alive, b, scratch)

    return begin


@section
def _decide(plan: Plan) -> Callable[..., None]:
    """Return a function that stores the state of world b, clips its actions, and computes the steering forces."""
    drive, d, size, has_columns = plan.kernels.drive, plan.dimension, plan.action, plan.abreast > 0

    def decide(
        p: Any, worlds: Any, decision: Any, frame: Any, action_list: Any, action: Any, over: Any, b: int
    ) -> None:
        n, learners = worlds.x.shape[2], over.shape[1]
        for k in range(d):
            for i in range(n):
                decision.x0[k, i] = worlds.x[k, b, i]
                decision.v0[k, i] = worlds.v[k, b, i]
        for i in range(n):
            decision.alive0[i] = worlds.alive[b, i]
        for i in range(np.uint64(learners)):
            for k in range(np.uint64(size)):
                at = (np.uint64(b) * np.uint64(learners) + i) * np.uint64(size) + k
                action[i, k] = min(max(action_list[at], like(action_list[at], -1.0)), like(action_list[at], 1.0))
        for i in range(np.uint64(learners)):
            over[b, i] = False
        force = as_contiguous(decision.force) if has_columns else decision.force
        drive(p, frame, action, force[:, 0])

    return decide


@section
def _padded_frame(plan: Plan) -> Callable[..., Any]:
    """Return a function that makes the frame of a task with a kernel `abreast`.

    Its arrays are padded beyond the last agent to whole registers, so that loops over agents need no scalar remainder.
    """
    d, memory_rows, alike = plan.dimension, plan.memory, plan.alike
    radius, memory = 2 * d, 2 * d + 1

    def padded_frame(worlds: Any, scratch: Any, decision: Any, near: Any, table: Any, placed: bool, b: int) -> Any:
        own, near_vel, near_radius, _ = decision.padded
        n = worlds.x.shape[2]
        for i in range(n):
            for k in range(d):
                own[k, i], own[d + k, i] = worlds.x[k, b, i], worlds.v[k, b, i]
            for k in range(memory_rows):
                own[memory + k, i] = worlds.memory[k, b, i]
            own[radius, i] = scratch.radius[i]
        if not placed:
            take(near.pos, own, near.index, n)
        take(near_vel, own[d:], near.index, n)
        if not alike:
            take(near_radius, own[radius:], near.index, n)
        return Frame(
            own[:d], own[d:radius], worlds.alive[b], worlds.obstacle_x[:, b], worlds.obstacle_radius[b], own[memory:],
            worlds.key[b], worlds.steps[b], own[radius], scratch.max_speed, scratch.max_force, near.square, near.index,
            near.count, near.gap, near.obstacle, near.obstacles, near.pos, near_vel, near_radius[0], table,
        )  # fmt: skip

    return padded_frame


@section
def _judge(plan: Plan) -> Callable[..., None]:
    """Return a function that finds ends and success of world b, and sums measures.

    With `removes_ended`, agents that end are removed.
    """
    ended, measure, lasting, by_name = plan.kernels.ended, plan.kernels.measure, plan.lasting, by_name_of(plan.measures)
    at = indices_of(plan.measures)

    def judge(
        p: Any, worlds: Any, before: Any, wide: Any, totals: Any, results: Any, removes_ended: bool, limit: int, b: int
    ) -> None:
        over, last, sums = results.over, totals.last, totals.sums
        results.success[b] = ended(p, at, before, wide, last[b], over[b])
        measure(p, at, before, wide, last[b])
        results.late[b] = worlds.steps[b] >= limit
        for k in range(sums.shape[1]):
            sums[b, k] += last[b, k]
        if lasting:
            results.success[b] = aim_has_lasted(p, by_name(sums[b]))
        for i in range(over.shape[1]):
            if removes_ended and over[b, i]:
                worlds.alive[b, i] = False
            results.present[b, i] = worlds.alive[b, i]

    return judge


@section
def _sum_rewards(terms: int) -> Callable[..., None]:
    """Return a function that sums the reward terms of world b, and writes them out if an agent ends or `all_worlds`."""

    def sum_rewards(earned: Any, totals: Any, results: Any, all_worlds: bool, b: int) -> None:
        over = results.over
        writes_terms = all_worlds or results.late[b]
        for i in range(over.shape[1]):
            writes_terms |= over[b, i]
        for k in range(results.terms.shape[0] if writes_terms else 0):
            for i in range(np.uint64(over.shape[1])):
                results.terms[k, b, i] = earned[i, k]
        for i in range(np.uint64(over.shape[1])):
            total = np.float64(earned[i, 0])
            for k in range(np.uint64(1), np.uint64(terms)):
                total += earned[i, k]
            for k in range(np.uint64(terms)):
                totals.paid[k, b, i] += earned[i, k]
            results.payment[b, i] = total

    return sum_rewards


@section
def _prefetch_world(dimension: int) -> Callable[..., None]:
    """Return a function that prefetches the next world."""

    def prefetch_world(worlds: Any, actions: Any, next_world: int) -> None:
        for k in range(dimension):
            prefetch(worlds.x[k, next_world], 0, 1)
            prefetch(worlds.v[k, next_world], 0, 1)
        prefetch(actions[next_world], 0, 1)

    return prefetch_world


@section
def _prefetch_sums(terms: int) -> Callable[..., None]:
    """Return a function that prefetches the reward sums of world b."""

    def prefetch_sums(totals: Any, results: Any, all_worlds: bool, b: int) -> None:
        for k in range(terms):
            prefetch(totals.paid[k, b], 0, 1)
        for k in range(terms if all_worlds else 0):
            prefetch(results.terms[k, b], 0, 1)
        prefetch(results.payment[b], 0, 1)

    return prefetch_sums


@section
def act_of(plan: Plan) -> Callable[..., Any]:
    """Return a function that takes a decision in world b; it returns the first agent that is not finite, or -1."""
    decide, prefetch_sums, has_columns = _decide(plan), _prefetch_sums(len(plan.terms)), plan.abreast > 0
    step_world = step_world_of(plan.kernels.step)

    def act(
        p: Any, worlds: Any, constants: Any, dt: float, count: int, decision: Any, frame: Any, scratch: Any,
        action_list: Any, action: Any, totals: Any, results: Any, all_worlds: bool, streaming: bool, b: int,
    ) -> Any:  # fmt: skip
        decide(p, worlds, decision, frame, action_list, action, results.over, b)
        if has_columns and not streaming:  # spread over the decision, as rows are written at its end
            prefetch(results.rows[b], 0, 4)
        bad = step_world(worlds, decision.force, 0, constants.params, dt, count, b, 0, 1, scratch)
        worlds.steps[b] += 1
        if has_columns:
            if not streaming:
                prefetch(results.rows[b], 1, 4)
            prefetch_sums(totals, results, all_worlds, b)
        return bad

    return act


@section
def search_of(plan: Plan) -> Callable[..., bool]:
    """Return `search(worlds, constants, near, scratch, b)`: find the neighbours in world b, if the task has a `look`.

    It returns True if it has also written the positions of the neighbours, see `look_of`.
    """
    look = look_of(plan.kernels.look) if plan.kernels.look is not None else None
    has_look = look is not None

    def search(worlds: Any, constants: Any, near: Any, scratch: Any, b: int) -> bool:
        if has_look:
            return look(  # type: ignore[misc, no-any-return]
                worlds.x, worlds.alive, worlds.obstacle_x, worlds.obstacle_radius, b, constants.params, near.square,
                near.index, near.count, near.gap, near.obstacle, near.obstacles, near.pos, scratch,
            )  # fmt: skip
        return False

    return search


@section
def evaluate_of(plan: Plan) -> Callable[..., None]:
    """Return a function that computes rewards and ends of world b."""
    reward, has_columns, at = plan.kernels.reward, plan.abreast > 0, indices_of(plan.terms)
    judge, sum_rewards, prefetch_world = _judge(plan), _sum_rewards(len(plan.terms)), _prefetch_world(plan.dimension)

    def evaluate(
        p: Any, worlds: Any, before: Any, padded: Any, action: Any, actions: Any, earned: Any, totals: Any,
        results: Any, removes_ended: bool, all_worlds: bool, streaming: bool, limit: int, next_world: int, b: int,
    ) -> None:  # fmt: skip
        if has_columns and not streaming:
            prefetch(results.rows[b], 2, 4)
        reward(p, at, before, padded, action, earned)
        if has_columns and not streaming:
            prefetch(results.rows[b], 3, 4)
        prefetch_world(worlds, actions, next_world)
        judge(p, worlds, before, padded, totals, results, removes_ended, limit, b)
        sum_rewards(earned, totals, results, all_worlds, b)

    return evaluate


@section
def write_rows_of(plan: Plan) -> Callable[..., None]:
    """Return a function that writes the observations of world b, via a buffer if streaming stores are used."""
    abreast, observe, count, distance = plan.kernels.abreast, plan.kernels.observe, plan.abreast, plan.apart
    has_columns, at = abreast is not None, indices_of(*zip(*plan.slots, strict=True))

    def write_rows(
        p: Any, frame: Any, padded: Any, decision: Any, padded_count: int, rows: Any, streaming: bool, b: int
    ) -> None:
        target = decision.row_buffer if streaming else rows[b]
        if has_columns:
            row_columns = decision.padded[3]
            abreast(p, at, padded, columns(row_columns, padded_count, count, distance))  # type: ignore[misc]
            into_rows(target, row_columns, count, distance)
        observe(p, at, frame, target)
        if streaming:
            stream_store(rows, np.uint64(b) * np.uint64(target.size), target)

    return write_rows


@section
def padded_frame_of(plan: Plan) -> Callable[..., Any]:
    """Return a function that returns the padded number of learners of world b, and their frame."""
    padded_frame, has_columns, width = _padded_frame(plan), plan.abreast > 0, plan.width

    def pad(
        worlds: Any, scratch: Any, decision: Any, near: Any, table: Any, frame: Any, placed: bool, learners: int, b: int
    ) -> Any:
        if has_columns:
            padded_count = np.uint64(learners + (width - 1)) // np.uint64(width) * np.uint64(width)
            return padded_count, padded_frame(worlds, scratch, decision, near, table, placed, b)
        return learners, frame

    return pad
