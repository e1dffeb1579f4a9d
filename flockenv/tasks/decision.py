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
from flockenv.tasks.lasting import lasts
from flockenv.tasks.play_plan import Plan
from flockenv.tasks.task import Frame

__all__ = [
    "act_of", "answer_of", "begin_of", "by_name_of", "frame_before", "frame_of", "indices_of", "look_in",
    "parameters_of", "show_of", "wide_of",
]  # fmt: skip


# --- numbers by name --------------------------------------------------------------------------------------------------


@functools.cache
def _fixed(counts: tuple[tuple[int, float], ...]) -> Callable[[Any], Any]:
    """Return a function that replaces elements of a tuple by constants."""
    k, value = counts[-1]
    before = _fixed(counts[:-1]) if counts[1:] else None

    def fixed(values: Any) -> Any:
        if before is None:
            return replace_at(values, k, like(values[0], value))
        return replace_at(before(values), k, like(values[0], value))

    return kernel(fixed)


@section
def parameters_of(names: tuple[str, ...], counts: tuple[tuple[int, float], ...]) -> Callable[[Any], Any]:
    """Return a function that reads a task's parameters from a row, by name; `counts` are constants."""
    kind, places, fixes = record(names), tuple(range(len(names))), bool(counts)
    fixed: Any = _fixed(counts) if counts else None

    def parameters(numbers: Any) -> Any:
        if fixes:
            return kind(*fixed(gather(numbers, np.uint64(0), places)))
        return kind(*gather(numbers, np.uint64(0), places))

    return parameters


@section
def by_name_of(names: tuple[str, ...]) -> Callable[[Any], Any]:
    """Return a function that reads measures from a row, by name."""
    kind, places, some = record(names), tuple(range(len(names))), bool(names)

    def by_name(row: Any) -> Any:
        if some:
            return kind(*gather(row, np.uint64(0), places))
        return ()

    return by_name


def indices_of(names: tuple[str, ...], places: tuple[int, ...] = ()) -> Any:
    """Return the indices of numbers by name, constants for a kernel: their places, by default 0, 1, 2, ..."""
    return record(names)(*(places or range(max(len(names), 1))))


# --- the parts --------------------------------------------------------------------------------------------------------


@kernel
def frame_of(w: Any, scratch: Any, near: Any, table: Any, b: int) -> Any:
    """Return the frame of world b."""
    none = near.square[:0]
    return Frame(
        w.x[:, b], w.v[:, b], w.alive[b], w.obstacle_x[:, b], w.obstacle_radius[b], w.memory[:, b], w.key[b],
        w.steps[b], scratch.radius, scratch.max_speed, scratch.max_force, near.square, near.who, near.count, near.gap,
        near.obstacle, near.obstacles, none, none, none, table,
    )  # fmt: skip


@kernel
def frame_before(w: Any, scratch: Any, made: Any, near: Any, table: Any, b: int) -> Any:
    """Return the frame of world b before the decision, without neighbours."""
    none = near.square[:0]
    return Frame(
        made.x0, made.v0, made.alive0, w.obstacle_x[:, b], w.obstacle_radius[b], w.memory[:, b], w.key[b],
        w.steps[b], scratch.radius, scratch.max_speed, scratch.max_force, none, near.who[:0], near.count[:0],
        near.gap[:0], near.obstacle[:0], near.obstacles[:0], none, none, none, table,
    )  # fmt: skip


@section
def begin_of(plan: Plan) -> Callable[..., None]:
    """Return a function that begins an episode in world b."""
    spawn, inner, oriented = plan.kernels.spawn, plan.kernels.begin, plan.oriented
    begin_inner = begin_inner_of(inner) if inner is not None else None

    def begin(p: Any, w: Any, given: Any, near: Any, scratch: Any, dt: float, b: int) -> None:
        w.tick[b] = 0
        w.steps[b] = 0
        for i in range(w.x.shape[2]):
            w.alive[b, i] = True
        spawn(p, frame_of(w, scratch, near, given.table, b))
        if oriented:
            face(w.v, w.frame_and_inner[0], b, True)
        if begin_inner is not None:
            begin_inner(w, given.params, dt, w.alive, b, scratch)

    return begin


@section
def _decide(plan: Plan) -> Callable[..., None]:
    """Return a function that stores the state of world b, clips its actions, and computes the steering forces."""
    drive, d, size, shows = plan.kernels.drive, plan.dimension, plan.action, plan.abreast > 0

    def decide(p: Any, w: Any, made: Any, now: Any, given: Any, action: Any, over: Any, b: int) -> None:
        n, learners = w.x.shape[2], over.shape[1]
        for k in range(d):
            for i in range(n):
                made.x0[k, i] = w.x[k, b, i]
                made.v0[k, i] = w.v[k, b, i]
        for i in range(n):
            made.alive0[i] = w.alive[b, i]
        for i in range(np.uint64(learners)):
            for k in range(np.uint64(size)):
                at = (np.uint64(b) * np.uint64(learners) + i) * np.uint64(size) + k
                action[i, k] = min(max(given[at], like(given[at], -1.0)), like(given[at], 1.0))
        for i in range(np.uint64(learners)):
            over[b, i] = False
        force = as_contiguous(made.force) if shows else made.force
        drive(p, now, action, force[:, 0])

    return decide


@section
def _widened(plan: Plan) -> Callable[..., Any]:
    """Return a function that makes the frame of a task with a kernel `abreast`.

    Its arrays are padded beyond the last agent to whole registers, so that loops over agents need no scalar remainder.
    """
    d, kept, alike = plan.dimension, plan.memory, plan.alike
    radius, memory = 2 * d, 2 * d + 1

    def widened(w: Any, scratch: Any, made: Any, near: Any, table: Any, placed: bool, b: int) -> Any:
        own, near_vel, near_radius, _ = made.wide
        n = w.x.shape[2]
        for i in range(n):
            for k in range(d):
                own[k, i], own[d + k, i] = w.x[k, b, i], w.v[k, b, i]
            for k in range(kept):
                own[memory + k, i] = w.memory[k, b, i]
            own[radius, i] = scratch.radius[i]
        if not placed:
            take(near.pos, own, near.who, n)
        take(near_vel, own[d:], near.who, n)
        if not alike:
            take(near_radius, own[radius:], near.who, n)
        return Frame(
            own[:d], own[d:radius], w.alive[b], w.obstacle_x[:, b], w.obstacle_radius[b], own[memory:], w.key[b],
            w.steps[b], own[radius], scratch.max_speed, scratch.max_force, near.square, near.who, near.count, near.gap,
            near.obstacle, near.obstacles, near.pos, near_vel, near_radius[0], table,
        )  # fmt: skip

    return widened


@section
def _judge(plan: Plan) -> Callable[..., None]:
    """Return a function that finds ends and success of world b, and sums measures; if `mortal`, ended agents die."""
    ended, measure, lasting, by_name = plan.kernels.ended, plan.kernels.measure, plan.lasting, by_name_of(plan.measures)
    at = indices_of(plan.measures)

    def judge(
        p: Any, w: Any, before: Any, wide: Any, totals: Any, results: Any, mortal: bool, limit: int, b: int
    ) -> None:
        over, last, sums = results.over, totals.last, totals.sums
        results.success[b] = ended(p, at, before, wide, last[b], over[b])
        measure(p, at, before, wide, last[b])
        results.late[b] = w.steps[b] >= limit
        for k in range(sums.shape[1]):
            sums[b, k] += last[b, k]
        if lasting:
            results.success[b] = lasts(p, by_name(sums[b]))
        for i in range(over.shape[1]):
            if mortal and over[b, i]:
                w.alive[b, i] = False
            results.present[b, i] = w.alive[b, i]

    return judge


@section
def _pay(terms: int) -> Callable[..., None]:
    """Return a function that sums the reward terms of world b, and writes them out if an agent ends or `everyone`."""

    def pay(earns: Any, totals: Any, results: Any, everyone: bool, b: int) -> None:
        over = results.over
        told = everyone or results.late[b]
        for i in range(over.shape[1]):
            told |= over[b, i]
        for k in range(results.terms.shape[0] if told else 0):
            for i in range(np.uint64(over.shape[1])):
                results.terms[k, b, i] = earns[i, k]
        for i in range(np.uint64(over.shape[1])):
            whole = np.float64(earns[i, 0])
            for k in range(np.uint64(1), np.uint64(terms)):
                whole += earns[i, k]
            for k in range(np.uint64(terms)):
                totals.paid[k, b, i] += earns[i, k]
            results.payment[b, i] = whole

    return pay


@section
def _ask_ahead(dimension: int) -> Callable[..., None]:
    """Return a function that prefetches the next world."""

    def ask_ahead(w: Any, actions: Any, following: int) -> None:
        for k in range(dimension):
            prefetch(w.x[k, following], 0, 1)
            prefetch(w.v[k, following], 0, 1)
        prefetch(actions[following], 0, 1)

    return ask_ahead


@section
def _ask_for_sums(terms: int) -> Callable[..., None]:
    """Return a function that prefetches the reward sums of world b."""

    def ask_for_sums(totals: Any, results: Any, everyone: bool, b: int) -> None:
        for k in range(terms):
            prefetch(totals.paid[k, b], 0, 1)
        for k in range(terms if everyone else 0):
            prefetch(results.terms[k, b], 0, 1)
        prefetch(results.payment[b], 0, 1)

    return ask_for_sums


@section
def act_of(plan: Plan) -> Callable[..., Any]:
    """Return a function that takes a decision in world b; it returns the first agent that is not finite, or -1."""
    decide, ask_for_sums, shows = _decide(plan), _ask_for_sums(len(plan.terms)), plan.abreast > 0
    step_world = step_world_of(plan.kernels.step)

    def act(
        p: Any, w: Any, given: Any, dt: float, count: int, made: Any, now: Any, scratch: Any, listed: Any, action: Any,
        totals: Any, results: Any, everyone: bool, past: bool, b: int,
    ) -> Any:  # fmt: skip
        decide(p, w, made, now, listed, action, results.over, b)
        if shows and not past:  # spread over the decision, as rows are written at its end
            prefetch(results.rows[b], 0, 4)
        bad = step_world(w, made.force, 0, given.params, dt, count, b, 0, 1, scratch)
        w.steps[b] += 1
        if shows:
            if not past:
                prefetch(results.rows[b], 1, 4)
            ask_for_sums(totals, results, everyone, b)
        return bad

    return act


@section
def look_in(plan: Plan) -> Callable[..., bool]:
    """Return a function that searches neighbours in world b, if the task has a `look`; True if it wrote positions."""
    look = look_of(plan.kernels.look) if plan.kernels.look is not None else None
    looks = look is not None

    def looked(w: Any, given: Any, near: Any, scratch: Any, b: int) -> bool:
        if looks:
            return look(  # type: ignore[misc, no-any-return]
                w.x, w.alive, w.obstacle_x, w.obstacle_radius, b, given.params, near.square, near.who, near.count,
                near.gap, near.obstacle, near.obstacles, near.pos, scratch,
            )  # fmt: skip
        return False

    return looked


@section
def answer_of(plan: Plan) -> Callable[..., None]:
    """Return a function that computes rewards and ends of world b."""
    reward, shows, at = plan.kernels.reward, plan.abreast > 0, indices_of(plan.terms)
    judge, pay, ask_ahead = _judge(plan), _pay(len(plan.terms)), _ask_ahead(plan.dimension)

    def answer(
        p: Any, w: Any, before: Any, wide: Any, action: Any, actions: Any, earns: Any, totals: Any, results: Any,
        mortal: bool, everyone: bool, past: bool, limit: int, following: int, b: int,
    ) -> None:  # fmt: skip
        if shows and not past:
            prefetch(results.rows[b], 2, 4)
        reward(p, at, before, wide, action, earns)
        if shows and not past:
            prefetch(results.rows[b], 3, 4)
        ask_ahead(w, actions, following)
        judge(p, w, before, wide, totals, results, mortal, limit, b)
        pay(earns, totals, results, everyone, b)

    return answer


@section
def show_of(plan: Plan) -> Callable[..., None]:
    """Return a function that writes the observations of world b, via the canvas if streaming stores are used."""
    abreast, observe, many, far = plan.kernels.abreast, plan.kernels.observe, plan.abreast, plan.apart
    shows, at = abreast is not None, indices_of(*zip(*plan.slots, strict=True))

    def show(p: Any, now: Any, wide: Any, made: Any, rounded: int, rows: Any, past: bool, b: int) -> None:
        seen = made.canvas if past else rows[b]
        if shows:
            beside = made.wide[3]
            abreast(p, at, wide, columns(beside, rounded, many, far))  # type: ignore[misc]
            into_rows(seen, beside, many, far)
        observe(p, at, now, seen)
        if past:
            stream_store(rows, np.uint64(b) * np.uint64(seen.size), seen)

    return show


@section
def wide_of(plan: Plan) -> Callable[..., Any]:
    """Return a function that returns the padded number of learners of world b, and their frame."""
    widened, shows, width = _widened(plan), plan.abreast > 0, plan.width

    def widen(
        w: Any, scratch: Any, made: Any, near: Any, table: Any, now: Any, placed: bool, learners: int, b: int
    ) -> Any:
        if shows:
            rounded = np.uint64(learners + (width - 1)) // np.uint64(width) * np.uint64(width)
            return rounded, widened(w, scratch, made, near, table, placed, b)
        return learners, now

    return widen
