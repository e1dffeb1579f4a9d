"""The entry points of a task, `play` and `tell`: sections over its kernels and over its scene's step.

`play` begins episodes or takes decisions: what looks around is the larger part of it, and is compiled once. `tell`
works out metrics from what `play` has counted. Parameters to which loops count (`Task.counts`) are constants of both.
"""

from __future__ import annotations

import functools
import hashlib
import keyword
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.abreast import apart, columns, in_one_row, into_rows, packed, take
from flockenv.kernels import (
    Law,
    described,
    finite,
    functions_in,
    kernel,
    laws_digest,
    like,
    load,
    python_of,
    replaced,
    texts_outside,
    unaliased,
)
from flockenv.lines import fetch, pour, settle
from flockenv.section import entry_of, record, section
from flockenv.sweep import look_of, plan_look, scene_source, sections_of
from flockenv.tasks.base import Frame, Task
from flockenv.tasks.lasting import lasts
from flockenv.vehicle import face

__all__ = [
    "REFUSED",
    "Decision",
    "Given",
    "Near",
    "Results",
    "Totals",
    "Worlds",
    "name_of",
    "play_of",
    "scene_of",
    "tell_of",
]

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
    """The kernels of a task, and those of its scene; None where there is none."""

    spawn: Law
    drive: Law
    reward: Law
    ended: Law
    measure: Law
    observe: Law
    keep: Law | None
    abreast: Law | None
    step_world: Law
    look: Law | None
    begin_inner: Law | None


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


def scene_of(task: Task) -> Any:
    """Return the module of the kernels of a task's scene; TypeError for a task of which no kernel can be made."""
    _check(task)
    return load(f"task_{task.name}", scene_source(task.parts), sections_of(task.parts))


def play_of(task: Task) -> Callable[..., tuple[int, int]]:
    """Return a task's entry point that begins episodes and takes decisions."""
    scene, parts = scene_of(task), task.parts
    own = {name: _kernel_of(task, name) for name in ("spawn", "drive", "reward", "ended", "measure", "observe")}
    kernels = Kernels(
        **own, keep=_kernel_of(task, "keep") if task.keeps else None,
        abreast=_kernel_of(task, "abreast") if task.abreast else None, step_world=scene.step_world,
        look=look_of(plan_look(parts)) if task.look else None, begin_inner=scene.begin_inner if parts.inner else None,
    )  # fmt: skip
    return _play(Plan(
        kernels, tuple(task.parameters()), _counts(task), task.measures, task.lasting_aim, parts.oriented, task.alike,
        parts.dimension, parts.width, len(task.terms), task.action_layout.size, task.memory, task.abreast,
        apart(task.learners) if task.abreast else 0,
    ))  # fmt: skip


def name_of(task: Task) -> str:
    """Return a name of a task's kernel, which holds a digest of every law in it."""
    play = python_of(play_of(task))
    outside = texts_outside({each.__module__ for each in functions_in(play)})
    digest = hashlib.sha256(f"{described(play)}{laws_digest()}{outside}".encode()).hexdigest()
    return f"task_{task.name}_{digest[:20]}"


def tell_of(task: Task) -> Callable[..., None]:
    """Return a task's entry point that works out metrics."""
    return _tell(_kernel_of(task, "metrics"), tuple(task.parameters()), _counts(task), task.measures)


def _kernel_of(task: Task, name: str) -> Law:
    """Return a kernel of the module in which a task is defined."""
    module = type(task).__module__
    found: Law | None = getattr(sys.modules[module], name, None)
    if found is None:
        raise TypeError(f"{type(task).__name__}: {module} has no kernel `{name}`")
    return found


def _counts(task: Task) -> tuple[tuple[int, float], ...]:
    """Return the places and values of the parameters to which loops of a task's kernels count."""
    return tuple((k, v) for k, (name, v) in enumerate(task.parameters().items()) if name in task.counts)


def _check(task: Task) -> None:
    """Refuse a task of which no kernel can be made; TypeError."""
    kind, names = type(task).__name__, task.parameters()
    unknown = [name for name in task.counts if name not in names]
    if unknown:
        raise TypeError(f"{kind}.counts: {unknown[0]!r} is none of its parameters: {', '.join(names)}")
    if not task.terms:
        raise TypeError(f"{kind}.terms is empty: a reward is the sum of at least one term")
    for name in task.measures:
        if not name.isidentifier() or keyword.iskeyword(name) or name[0] == "_" or task.measures.count(name) > 1:
            raise TypeError(f"{kind}.measures: {name!r} must be a name, as of a field, and there once")


# --- numbers by name --------------------------------------------------------------------------------------------------


@functools.cache
def _numbers(count: int) -> Callable[[Any, Any], Any]:
    """Return a function that makes a tuple of so many numbers of a row, from a place on: halves, for many."""
    half = count // 2
    before = _numbers(half) if count > 4 else None
    after = _numbers(count - half) if count > 4 else None

    def numbers(row: Any, at: Any) -> Any:
        if before is not None:
            return before(row, at) + after(row, at + np.uint64(half))  # type: ignore[misc]  # both or none
        if count == 1:
            return (row[at],)
        if count == 2:
            return row[at], row[at + np.uint64(1)]
        if count == 3:
            return row[at], row[at + np.uint64(1)], row[at + np.uint64(2)]
        return row[at], row[at + np.uint64(1)], row[at + np.uint64(2)], row[at + np.uint64(3)]

    return kernel(numbers)


@functools.cache
def _fixed(counts: tuple[tuple[int, float], ...]) -> Callable[[Any], Any]:
    """Return a function that puts constants into their places of a tuple."""
    k, value = counts[-1]
    before = _fixed(counts[:-1]) if counts[1:] else None

    def fixed(values: Any) -> Any:
        if before is None:
            return replaced(values, k, like(values[0], value))
        return replaced(before(values), k, like(values[0], value))

    return kernel(fixed)


@section
def _parameters(names: tuple[str, ...], counts: tuple[tuple[int, float], ...]) -> Callable[[Any], Any]:
    """Make what reads the parameters of a task out of a row, by name; some are constants."""
    kind, read, fixed, fixes = (
        record(names),
        _numbers(len(names)),
        _fixed(counts) if counts else None,
        bool(counts),
    )

    def parameters(numbers: Any) -> Any:
        if fixes:
            return kind(*fixed(read(numbers, np.uint64(0))))  # type: ignore[misc]
        return kind(*read(numbers, np.uint64(0)))

    return parameters


@section
def _by_name(names: tuple[str, ...]) -> Callable[[Any], Any]:
    """Make what reads measures out of a row, by name."""
    kind, read, some = record(names), _numbers(max(len(names), 1)), bool(names)

    def by_name(row: Any) -> Any:
        if some:
            return kind(*read(row, np.uint64(0)))
        return ()

    return by_name


# --- tell -------------------------------------------------------------------------------------------------------------


@entry_of
def _tell(
    metrics: Law, names: tuple[str, ...], counts: tuple[tuple[int, float], ...], measures: tuple[str, ...]
) -> Callable[..., None]:
    """Make what writes the metrics of so many worlds, (K, B), from the first on; NaN: no value."""
    parameters, by_name = _parameters(names, counts), _by_name(measures)

    def tell(steps: Any, numbers: Any, last: Any, sums: Any, first: int, told: Any) -> None:
        unaliased()
        p = parameters(numbers)
        for k in range(told.shape[1]):
            b = first + k
            told[:, k] = np.nan
            metrics(p, by_name(sums[b]), by_name(last[b]), steps[b], told[:, k])

    return tell


# --- play -------------------------------------------------------------------------------------------------------------


@kernel
def _frame(w: Any, scratch: Any, near: Any, table: Any, b: int) -> Any:
    """Return the frame of world b."""
    none = near.square[:0]
    return Frame(
        w.x[:, b], w.v[:, b], w.alive[b], w.obstacle_x[:, b], w.obstacle_radius[b], w.memory[:, b], w.key[b],
        w.steps[b], scratch.radius, scratch.max_speed, scratch.max_force, near.square, near.who, near.count, near.gap,
        near.obstacle, near.obstacles, none, none, none, table,
    )  # fmt: skip


@kernel
def _before(w: Any, scratch: Any, made: Any, near: Any, table: Any, b: int) -> Any:
    """Return the frame of world b before the decision: nobody is near."""
    none = near.square[:0]
    return Frame(
        made.x0, made.v0, made.alive0, w.obstacle_x[:, b], w.obstacle_radius[b], w.memory[:, b], w.key[b],
        w.steps[b], scratch.radius, scratch.max_speed, scratch.max_force, none, near.who[:0], near.count[:0],
        near.gap[:0], near.obstacle[:0], near.obstacles[:0], none, none, none, table,
    )  # fmt: skip


@section
def _begin(plan: Plan) -> Callable[..., None]:
    """Make what begins an episode in world b."""
    spawn, begin_inner = plan.kernels.spawn, plan.kernels.begin_inner
    oriented, inner = plan.oriented, begin_inner is not None

    def begin(p: Any, w: Any, given: Any, near: Any, scratch: Any, dt: float, b: int) -> None:
        w.tick[b] = 0
        w.steps[b] = 0
        for i in range(w.x.shape[2]):
            w.alive[b, i] = True
        spawn(p, _frame(w, scratch, near, given.table, b))
        if oriented:
            face(w.v, w.carried[0], b, True)
        if inner:
            if oriented:
                begin_inner(  # type: ignore[misc]
                    w.x, w.v, w.carried[0], w.carried[1], w.key, w.tick, given.params, dt, w.alive, b, scratch
                )
            else:
                begin_inner(w.x, w.v, w.carried[0], w.key, w.tick, given.params, dt, w.alive, b, scratch)  # type: ignore[misc]

    return begin


@section
def _advance(step_world: Law, carried: int) -> Callable[..., Any]:
    """Make what advances world b by `count` steps; returns who is not finite, or -1. carried: frames, inner states."""

    def advance(w: Any, given: Any, force: Any, dt: float, count: int, b: int, scratch: Any) -> Any:
        if carried == 0:
            return step_world(
                w.x, w.v, w.alive, w.tick, w.key, w.obstacle_x, w.obstacle_radius, w.work, force, 0, given.params, dt,
                count, b, 0, 1, scratch,
            )  # fmt: skip
        if carried == 1:
            return step_world(
                w.x, w.v, w.carried[0], w.alive, w.tick, w.key, w.obstacle_x, w.obstacle_radius, w.work, force, 0,
                given.params, dt, count, b, 0, 1, scratch,
            )  # fmt: skip
        return step_world(
            w.x, w.v, w.carried[0], w.carried[1], w.alive, w.tick, w.key, w.obstacle_x, w.obstacle_radius, w.work,
            force, 0, given.params, dt, count, b, 0, 1, scratch,
        )  # fmt: skip

    return advance


@section
def _decide(plan: Plan) -> Callable[..., None]:
    """Make what remembers the present of world b, takes its actions, clipped, and asks what forces they are."""
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
        force = packed(made.force) if shows else made.force
        drive(p, now, action, force[:, 0])

    return decide


@section
def _widened(plan: Plan) -> Callable[..., Any]:
    """Make the frame of a task that shows agents side by side.

    It goes on beyond the last agent, up to whole registers: loops over agents have no rest that goes one by one.
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
    """Make what says how world b ended, and counts the measures; who is over dies if he is `mortal`."""
    ended, measure, lasting, by_name = plan.kernels.ended, plan.kernels.measure, plan.lasting, _by_name(plan.measures)

    def judge(
        p: Any, w: Any, before: Any, wide: Any, totals: Any, results: Any, mortal: bool, limit: int, b: int
    ) -> None:
        over, last, sums = results.over, totals.last, totals.sums
        results.success[b] = ended(p, before, wide, last[b], over[b])
        measure(p, before, wide, last[b])
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
    """Make what adds up the terms of world b, and tells them where that is asked for."""

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
    """Make what asks in good time for the world that comes next."""

    def ask_ahead(w: Any, actions: Any, following: int) -> None:
        for k in range(dimension):
            fetch(w.x[k, following], 0, 1)
            fetch(w.v[k, following], 0, 1)
        fetch(actions[following], 0, 1)

    return ask_ahead


@section
def _ask_for_sums(terms: int) -> Callable[..., None]:
    """Make what asks in good time for what is paid in world b."""

    def ask_for_sums(totals: Any, results: Any, everyone: bool, b: int) -> None:
        for k in range(terms):
            fetch(totals.paid[k, b], 0, 1)
        for k in range(terms if everyone else 0):
            fetch(results.terms[k, b], 0, 1)
        fetch(results.payment[b], 0, 1)

    return ask_for_sums


@kernel
def _refuses(given: Any, check: bool) -> bool:
    """Return True if an action is no number."""
    refused = np.int32(0)
    for k in range(np.uint64(given.shape[0] if check else 0)):
        refused += np.int32(0) if finite(given[k]) else np.int32(1)
    return bool(refused > np.int32(0))


@section
def _act(plan: Plan) -> Callable[..., Any]:
    """Make what lets world b take a decision and go on; returns who is not finite, or -1."""
    decide, ask_for_sums, shows = _decide(plan), _ask_for_sums(plan.terms), plan.abreast > 0
    advance = _advance(plan.kernels.step_world, plan.oriented + (plan.kernels.begin_inner is not None))

    def act(
        p: Any, w: Any, given: Any, dt: float, count: int, made: Any, now: Any, scratch: Any, listed: Any, action: Any,
        totals: Any, results: Any, everyone: bool, past: bool, b: int,
    ) -> Any:  # fmt: skip
        decide(p, w, made, now, listed, action, results.over, b)
        if shows and not past:  # here and there, for it is written at the end
            fetch(results.rows[b], 0, 4)
        bad = advance(w, given, made.force, dt, count, b, scratch)
        w.steps[b] += 1
        if shows:
            if not past:
                fetch(results.rows[b], 1, 4)
            ask_for_sums(totals, results, everyone, b)
        return bad

    return act


@section
def _look(plan: Plan) -> Callable[..., bool]:
    """Make what looks around in world b, if the task does; returns whether it has written where the nearest are."""
    look, looks = plan.kernels.look, plan.kernels.look is not None

    def looked(w: Any, given: Any, near: Any, scratch: Any, b: int) -> bool:
        if looks:
            return look(  # type: ignore[misc, no-any-return]
                w.x, w.alive, w.obstacle_x, w.obstacle_radius, b, given.params, near.square, near.who, near.count,
                near.gap, near.obstacle, near.obstacles, near.pos, scratch,
            )  # fmt: skip
        return False

    return looked


@section
def _answer(plan: Plan) -> Callable[..., None]:
    """Make what pays the agents of world b, and says who is over."""
    reward, terms, shows = plan.kernels.reward, plan.terms, plan.abreast > 0
    judge, pay, ask_ahead = _judge(plan), _pay(terms), _ask_ahead(plan.dimension)

    def answer(
        p: Any, w: Any, before: Any, wide: Any, action: Any, actions: Any, earns: Any, totals: Any, results: Any,
        mortal: bool, everyone: bool, past: bool, limit: int, following: int, b: int,
    ) -> None:  # fmt: skip
        if shows and not past:
            fetch(results.rows[b], 2, 4)
        reward(p, before, wide, action, earns)
        if shows and not past:
            fetch(results.rows[b], 3, 4)
        ask_ahead(w, actions, following)
        judge(p, w, before, wide, totals, results, mortal, limit, b)
        pay(earns, totals, results, everyone, b)

    return answer


@section
def _show(plan: Plan) -> Callable[..., None]:
    """Make what writes the observations of world b: on the canvas first, where they go past the caches."""
    abreast, observe, many, far = plan.kernels.abreast, plan.kernels.observe, plan.abreast, plan.apart
    shows = abreast is not None

    def show(p: Any, now: Any, wide: Any, made: Any, rounded: int, rows: Any, past: bool, b: int) -> None:
        seen = made.canvas if past else rows[b]
        if shows:
            beside = made.wide[3]
            abreast(p, wide, columns(beside, rounded, many, far))  # type: ignore[misc]
            into_rows(seen, beside, many, far)
        observe(p, now, seen)
        if past:
            pour(rows, np.uint64(b) * np.uint64(seen.size), seen)

    return show


@section
def _wide(plan: Plan) -> Callable[..., Any]:
    """Make what returns how many learners are worked out in world b, and the frame in which they are."""
    widened, shows, width = _widened(plan), plan.abreast > 0, plan.width

    def wide_of(
        w: Any, scratch: Any, made: Any, near: Any, table: Any, now: Any, placed: bool, learners: int, b: int
    ) -> Any:
        if shows:
            rounded = np.uint64(learners + (width - 1)) // np.uint64(width) * np.uint64(width)
            return rounded, widened(w, scratch, made, near, table, placed, b)
        return learners, now

    return wide_of


@kernel
def _packed(worlds: Any) -> Any:
    """Return the arrays of worlds so that agents are known to lie side by side."""
    return Worlds(
        packed(worlds.x), packed(worlds.v), worlds.alive, worlds.tick, packed(worlds.obstacle_x),
        worlds.obstacle_radius, worlds.work, worlds.key, packed(worlds.memory), worlds.steps, worlds.carried,
    )  # fmt: skip


@entry_of
def _play(plan: Plan) -> Callable[..., tuple[int, int]]:
    """Make what lets worlds [from_world, to_world) take a decision, or begin an episode, and observes them.

    Acting, it returns the (world, agent) that is not finite first, or -1s; the world is REFUSED, and nothing moves, if
    `check` is asked for and an action is no number. Beginning where `mask` says so, it observes the worlds that begin,
    or everyone; acting, it observes everyone, and writes the terms of worlds in which somebody ends, or everyone's.
    Rows that are to go `past` the caches are made on the canvas.
    """
    keep, keeps, parameters = plan.kernels.keep, plan.kernels.keep is not None, _parameters(plan.names, plan.counts)
    begin, act, look, wide_of, answer, show = (f(plan) for f in (_begin, _act, _look, _wide, _answer, _show))
    terms, size, far = plan.terms, plan.action, plan.apart

    def play(
        worlds: Any, given: Any, dt: float, count: int, mortal: bool, past: bool, totals: Any, made: Any, near: Any,
        scratch: Any, acting: bool, mask: Any, everyone: bool, check: bool, from_world: int, to_world: int,
        actions: Any, limit: int, results: Any,
    ) -> tuple[int, int]:  # fmt: skip
        unaliased()
        w, table, learners = _packed(worlds), given.table, results.over.shape[1]
        distance = far if far else actions.shape[1]
        action, listed = columns(made.decided, actions.shape[1], size, distance), in_one_row(actions)
        if _refuses(listed, check):
            return REFUSED, 0
        p = parameters(given.numbers)
        broken, who = -1, -1
        for b in range(from_world, to_world):
            if not acting and not mask[b] and not everyone:
                continue
            if not acting and mask[b]:
                begin(p, w, given, near, scratch, dt, b)
            if acting:
                now = _frame(w, scratch, near, table, b)
                bad = act(
                    p, w, given, dt, count, made, now, scratch, listed, action, totals, results, everyone, past, b
                )
                if bad >= 0 and broken < 0:
                    broken, who = b, bad
            placed = look(w, given, near, scratch, b)
            now, before = _frame(w, scratch, near, table, b), _before(w, scratch, made, near, table, b)
            if keeps and acting:
                keep(p, before, now)  # type: ignore[misc]
            rounded, wide = wide_of(w, scratch, made, near, table, now, placed, learners, b)
            if acting:
                earns, following = columns(made.earned, rounded, terms, distance), min(b + 1, to_world - 1)
                answer(
                    p, w, before, wide, action, actions, earns, totals, results, mortal, everyone, past, limit,
                    following, b,
                )  # fmt: skip
            show(p, now, wide, made, rounded, results.rows, past, b)
        if past:
            settle()
        return broken, who

    return play
