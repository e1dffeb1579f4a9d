"""Task: what is seen, what is paid, when it ends; functions of frames, over a scene that knows nothing of them.

A task is one file: a frozen record whose fields are the keyword arguments of `make`, and seven kernels, or up to nine,
over one world:

* `spawn(p, frame)` writes the first positions, velocities, obstacles and memory from the world's key;
* `drive(p, frame, action, force)` turns actions (L, A) into forces asked for (D, N) N, of scripted agents too;
* `keep(p, before, after)`, of a task that `keeps` alone, writes into the memory what the others read of this step;
* `reward(p, before, after, action, terms)` writes the named terms (L, K), each of which lies in one piece, and nothing
  else, as a test checks;
* `ended(p, before, after, numbers, over) -> success` writes which learners are over (L,), may take agents out of
  `after.alive`, and returns whether the aim is reached; of the `measures` (Q,) it may write those that it needs itself;
  of a task with a `lasting_aim`, it returns whether the aim holds now, and success is what `lasts` in tasks/lasting.py
  returns of the sums of the measures;
* `measure(p, before, after, numbers)` comes next and writes the others: what this step adds to the `measures`;
* `metrics(p, sums, last, steps, numbers)` writes the domain metrics of an episode so far, in the order of
  `metric_names`, from the sums of the measures over its steps and from their last values, by name (sums.path, say), and
  the number of steps; a metric has no value where none is written. All of it is double precision, `p` too;
* `abreast(p, frame, columns)`, of a task with numbers `abreast` alone, writes the first so many numbers of all rows,
  (L, abreast), of which the same number of all agents lies together: loops over agents become vector code. So that
  none is left over, L is rounded up there and in that task's `reward`, and in what it and that task's `reward`, `ended`
  and `measure` see, `pos`, `vel`, `memory`, `radius` and what is near go on beyond the last agent, up to a multiple of
  `abreast.PAIR`, and hold anything there: nobody may look at what follows from it. `alive`, the limits, `before` and
  `action` end with the last agent. The frame is a copy: such a task's `ended` writes `over` and `after.alive` alone;
  what is to be remembered is for `keep`;
* `observe(p, frame, rows)` writes the observation rows (L, O), or what of them `abreast` left.

`p` holds the task's `parameters()` by name. Learners are the first L agents of a world. Who is near whom is found once
for all of them, by the same query as a scene's effects, if the task says what it wants to know: its `look`.
"""

from __future__ import annotations

import functools
import keyword
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.abreast import apart
from flockenv.integrators import INTEGRATORS, SemiImplicitEuler
from flockenv.records import Record
from flockenv.scene import AnyIntegrator, Scene
from flockenv.snapshot import Mark
from flockenv.state import State
from flockenv.sweep import Look, Parts, look_source, scene_source
from flockenv.sweep.handed import OPEN_SCRATCH
from flockenv.sweep.text import indented_lines
from flockenv.tasks.layout import Layout

__all__ = ["NEAR", "REFUSED", "TASKS", "Frame", "Task", "task_source"]

TASKS: dict[str, type[Task]] = {}
"""Every task by name; a class registers itself when it is defined."""


class Frame(NamedTuple):
    """One world at one instant, as kernels see it."""

    pos: Any  # (D, N) m
    vel: Any  # (D, N) m/s
    alive: Any  # (N,)
    centre: Any  # (D, M) m, obstacles
    rho: Any  # (M,) m, their radii; 0 = empty slot
    memory: Any  # (K, N) what a task keeps between steps: wander targets, goals
    key: Any  # random key of the world
    step: Any  # control steps since the start
    radius: Any  # (N,) m
    max_speed: Any  # (N,) m/s
    max_force: Any  # (N,) N
    # What is near, as the task's `look` asks for it; not in the frame of `before`, whose arrays are empty.
    near_square: Any  # (K, N) m^2, distances to the nearest agents squared, nearest first; inf: none
    near_who: Any  # (K, N) which they are; where there is none, somebody
    near_count: Any  # (N,) how many there are within sight
    obstacle_gap: Any  # (J, N) m, distances to the surfaces of the nearest obstacles; inf: none
    obstacle_who: Any  # (J, N)
    obstacle_count: Any  # (N,)
    # Where the nearest agents are, how they move, how large they are: in tasks with numbers `abreast`, for what writes
    # these and for `reward`, `ended` and `measure`; else empty.
    near_pos: Any  # (D, K, N) m
    near_vel: Any  # (D, K, N) m/s
    near_radius: Any  # (K, N) m
    table: Any  # (T,) the task's table()


class Task(Record):
    """What is seen, what is paid, when it ends. See the module for what a subclass must offer."""

    name: ClassVar[str]
    terms: ClassVar[tuple[str, ...]]
    """Names of the reward terms, in order."""
    metric_names: ClassVar[tuple[str, ...]]
    """Names of the numbers that `metrics` writes."""
    measures: ClassVar[tuple[str, ...]]
    """Names of the numbers that `measure` writes each step."""
    counts: ClassVar[tuple[str, ...]] = ()
    """Parameters to which loops of its kernels count, written into them: faster; another value is another kernel."""
    memory: ClassVar[int] = 0
    """Numbers kept per agent between steps."""
    keeps: ClassVar[bool] = False
    """Has it a kernel `keep`?"""
    lasting_aim: ClassVar[bool] = False
    """True if success is judged over the episode, by tasks/lasting.py, and not at one instant."""

    control_dt: float = Field(default=0.1, gt=0, description="s, one decision; a whole multiple of dt")
    dt: float = Field(default=0.05, gt=0, description="s, one physics step")
    integrator: AnyIntegrator = Field(default_factory=SemiImplicitEuler, description="how a physics step is taken")
    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")
    dtype: Literal["float64", "float32"] = Field(default="float64", description="precision of the simulation")

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its name."""
        if "name" in vars(cls):
            TASKS[cls.name] = cls

    def model_post_init(self, context: Any) -> None:
        """Refuse clocks that do not fit, and methods that leave the kernel."""
        if self.integrator.solves:
            allowed = ", ".join(kind for kind, method in INTEGRATORS.items() if not method.solves)
            solves = "solves equations in Python, while a task plays in one kernel"
            raise ValueError(f"integrator.kind = {self.integrator.kind!r}: {solves}; allowed: {allowed}")
        ratio = self.control_dt / self.dt
        if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
            raise ValueError(f"control_dt = {self.control_dt:g} s is not a whole multiple of dt = {self.dt:g} s")

    @functools.cached_property
    def substeps(self) -> int:
        """Physics steps per decision."""
        return round(self.control_dt / self.dt)

    # --- what a task says of itself ---------------------------------------------------------------------------------

    if TYPE_CHECKING:  # a field in one task, a property in another

        @property
        def learners(self) -> int:
            """L: agents 0..L-1 are the learners."""

        @property
        def agents(self) -> int:
            """N."""

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Names of the learners, (L,)."""
        raise TypeError(f"{type(self).__name__} must name its learners")

    @functools.cached_property
    def scene(self) -> Scene:
        """The scene it plays in."""
        raise TypeError(f"{type(self).__name__} must have a scene")

    @functools.cached_property
    def layout(self) -> Layout:
        """What an observation row holds."""
        raise TypeError(f"{type(self).__name__} must lay out its observation")

    @functools.cached_property
    def action_layout(self) -> Layout:
        """What an action row holds."""
        raise TypeError(f"{type(self).__name__} must lay out its action")

    @property
    def alike(self) -> bool:
        """Are all agents as large as each other?"""
        return bool(np.ptp(self.scene.body.radius) == 0)

    @property
    def abreast(self) -> int:
        """How many of a row's first numbers its kernel `abreast` writes; 0 = it has none."""
        return 0

    @property
    def obstacle_slots(self) -> int:
        """M: obstacles a world may have."""
        return 0

    @property
    def ends_together(self) -> bool:
        """True if all learners of a world end at the same step."""
        return True

    @property
    def look(self) -> Look | None:
        """What its frames say of who is near, if its observations and rewards need it."""
        return None

    def table(self) -> tuple[float, ...]:
        """Numbers that its kernels look up: directions of rays, say."""
        return ()

    @functools.cached_property
    def parts(self) -> Parts:
        """What its kernel is made of: the scene's parts, and the look."""
        if self.scene.constraints:
            kinds = ", ".join(constraint.kind for constraint in self.scene.constraints)
            raise ValueError(f"scene.constraints: {kinds}: a task plays in one kernel, which knows of none yet")
        if self.scene.population:
            raise ValueError("scene.population: a task plays in one kernel, which knows of no births; it has `ended`")
        return replace(self.scene.parts, look=self.look)

    def parameters(self) -> dict[str, float]:
        """The numbers that its kernels are given, by name."""
        numbers = {n: getattr(self, n) for n in type(self).model_fields}
        return {n: float(v) for n, v in numbers.items() if isinstance(v, (int, float))}

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return what a picture should point out."""
        return ()

    def roles(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[str, ...]:
        """Return what each agent of a world is called in pictures, (N,) of snapshot.ROLES; the same all episode."""
        return self.scene.roles

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the region that a picture shows, m."""
        d = self.scene.dimension
        return (0.0,) * d, self.scene.space.extent(d)


_KERNELS = ("spawn", "drive", "reward", "ended", "measure", "metrics", "observe")

NEAR = "near_square, near_who, near_count, obstacle_gap, obstacle_who, obstacle_count"
"""What `look` writes, in order."""

REFUSED = -2
"""The world that `play` names if an action is no number."""


def _frame(
    x: str = "x[:, b]", v: str = "v[:, b]", alive: str = "alive[b]", memory: str = "memory[:, b]",
    radius: str = "radius", near: str = NEAR, nearby: str = ", ".join(["near_square[:0]"] * 3),
) -> str:  # fmt: skip
    """Write the frame of world b."""
    return (
        f"Frame({x}, {v}, {alive}, obstacle_x[:, b], obstacle_radius[b], {memory}, key[b], steps[b], {radius}, "
        f"max_speed, max_force, {near}, {nearby}, table)"
    )


def task_source(task: Task) -> str:
    """Return the source of a task's kernel: its scene's, and two entry points, `play` and `tell`."""
    d, names = task.scene.dimension, task.parameters()
    _check(task)
    now, empty = _frame(), ", ".join(f"{name}[:0]" for name in NEAR.split(", "))
    then = _frame(x="x0", v="v0", alive="alive0", near=empty)
    look = f"placed = look(x, alive, obstacle_x, obstacle_radius, b, params, {NEAR}, near_pos, scratch)"
    size, far = task.action_layout.size, apart(task.learners) if task.abreast else "actions.shape[1]"
    fetches = [f"if not past: fetch(rows[b], {k}, 4)" if task.abreast else "pass" for k in range(4)]
    wide_ones = "own, near_vel, near_radius, beside, " if task.abreast else ""
    told = f"for k in range({len(task.terms)} if everyone else 0):"
    sums = [f"for k in range({len(task.terms)}):", "    fetch(paid[k, b], 0, 1)", told, "    fetch(terms[k, b], 0, 1)"]
    fetch_sums = "\n".join(indented_lines([*sums, "fetch(payment[b], 0, 1)"], 12)) if task.abreast else ""
    widen, show = _lanes(task) if task.abreast else ("rounded, wide = over.shape[1], now", "pass")
    optional = [*["keep"] * task.keeps, *["abreast"] * (task.abreast > 0)]
    lasting = f"success[b] = lasts(p, {_measures(task, 'sums')})" if task.lasting_aim else "pass"
    begin_inner = f"begin_inner(x, v, {task.parts.frame_argument}key, tick, params, dt, alive, b, scratch)"
    worlds = (
        f"x, v, {task.parts.frame_argument}alive, tick, obstacle_x, obstacle_radius, work, key, memory, steps, params, "
        "numbers, table"
    )
    play = f'''

from collections import namedtuple

from flockenv.abreast import columns, in_one_row, into_rows, packed, take
from flockenv.lines import fetch, pour, settle
from flockenv.tasks.base import Frame
from flockenv.vehicle import face
{"from flockenv.tasks.lasting import lasts" if task.lasting_aim else ""}
from {type(task).__module__} import {", ".join([*_KERNELS, *optional])}

P = namedtuple("P", {" ".join(names)!r})
Measures = namedtuple("Measures", {" ".join(task.measures)!r})


@njit(**FAST)
def tell(steps, numbers, last, sums, first, told):
    """Write the metrics of so many worlds, (K, B), from the first on; NaN: no value. Numbers are P's, as doubles."""
    unaliased()
    p = P({_values(task, "float64")})
    for k in range(told.shape[1]):
        b = first + k
        told[:, k] = np.nan
        metrics(p, {_measures(task, "sums")}, {_measures(task, "last")}, steps[b], told[:, k])


@njit(**FAST)
def play(
    {worlds}, dt, count, mortal, past, measured, sums, paid,
    canvas, force, x0, v0, alive0, decided, earned, {wide_ones}{NEAR}, near_pos, scratch,
    acting, mask, everyone, check, from_world, to_world, actions, limit,
    rows, payment, terms, over, late, success, present,
):
    """Let worlds [from_world, to_world) take a decision, or begin an episode where `mask` says so; and observe them.

    One entry point for both: what looks around is the larger part of it, and is compiled once. Acting, it returns the
    (world, agent) that is not finite first, or -1s; the world is {REFUSED}, and nothing moves, if `check` is asked for
    and an action is no number. Beginning, it observes the worlds that begin, or everyone; acting, it observes everyone,
    and writes the terms of worlds in which somebody ends, or everyone's. Rows that are to go `past` the caches are made
    on the canvas.
    """
    unaliased()
    {OPEN_SCRATCH}
    x, v, memory, obstacle_x = packed(x), packed(v), packed(memory), packed(obstacle_x)
    {"force = packed(force)" if task.abreast else "pass"}
    action, given, learners = columns(decided, actions.shape[1], {size}, {far}), in_one_row(actions), over.shape[1]
    refused = np.int32(0)
    for k in range(np.uint64(given.shape[0] if check else 0)):
        refused += np.int32(0) if finite(given[k]) else np.int32(1)
    if refused > np.int32(0):
        return {REFUSED}, 0
    p = P({_values(task, task.scene.dtype)})
    n = x.shape[2]
    broken, who = -1, -1
    for b in range(from_world, to_world):
        if not acting and not mask[b] and not everyone:
            continue
        if not acting and mask[b]:
            tick[b] = 0
            steps[b] = 0
            for i in range(n):
                alive[b, i] = True
            spawn(p, {now})
            {"face(v, frame_, b, True)" if task.parts.oriented else "pass"}
            {begin_inner if task.parts.inner else "pass"}
        if acting:
            for k in range({d}):
                for i in range(n):
                    x0[k, i] = x[k, b, i]
                    v0[k, i] = v[k, b, i]
            for i in range(n):
                alive0[i] = alive[b, i]
            for i in range(np.uint64(learners)):
                for k in range(np.uint64({size})):
                    at = (np.uint64(b) * np.uint64(learners) + i) * np.uint64({size}) + k
                    action[i, k] = min(max(given[at], like(given[at], -1.0)), like(given[at], 1.0))
            for i in range(np.uint64(learners)):
                over[b, i] = False
            drive(p, {now}, action, force[:, 0])
            {fetches[0]}  # here and there, for it is written at the end
            bad = step_world(
                x, v, {task.parts.frame_argument}alive, tick, key, obstacle_x, obstacle_radius, work, force, 0,
                params, dt, count, b, 0, 1, scratch,
            )
            if bad >= 0 and broken < 0:
                broken, who = b, bad
            steps[b] += 1
        if acting:
            {fetches[1]}
{fetch_sums}
        {look if task.look else "pass"}
        now = {now}
        before = {then}
        {"if acting: keep(p, before, now)" if task.keeps else "pass"}
        {widen}
        if acting:
            {fetches[2]}
            earns = columns(earned, rounded, {len(task.terms)}, {far})
            reward(p, before, wide, action, earns)
            {fetches[3]}
            following = min(b + 1, to_world - 1)  # asked for in good time: that world is the next
            for k in range({d}):
                fetch(x[k, following], 0, 1)
                fetch(v[k, following], 0, 1)
            fetch(actions[following], 0, 1)
            success[b] = ended(p, before, wide, measured[b], over[b])
            measure(p, before, wide, measured[b])
            late[b] = steps[b] >= limit
            for k in range(sums.shape[1]):
                sums[b, k] += measured[b, k]
            {lasting}
            for i in range(over.shape[1]):
                if mortal and over[b, i]:
                    alive[b, i] = False
                present[b, i] = alive[b, i]
            told = everyone or late[b]
            for i in range(over.shape[1]):
                told |= over[b, i]
            for k in range(terms.shape[0] if told else 0):
                for i in range(np.uint64(over.shape[1])):
                    terms[k, b, i] = earns[i, k]
            for i in range(np.uint64(over.shape[1])):
                whole = np.float64(earns[i, 0])
                for k in range(np.uint64(1), np.uint64({len(task.terms)})):
                    whole += earns[i, k]
                for k in range(np.uint64({len(task.terms)})):
                    paid[k, b, i] += earns[i, k]
                payment[b, i] = whole
        seen = canvas if past else rows[b]
        {show}
        observe(p, now, seen)
        if past:
            pour(rows, np.uint64(b) * np.uint64(seen.size), seen)
    if past:
        settle()
    return broken, who
'''
    return scene_source(task.parts, look_source(task.parts) + play)


def _check(task: Task) -> None:
    """Refuse a task of which no kernel can be written; TypeError."""
    kind, names = type(task).__name__, task.parameters()
    unknown = [name for name in task.counts if name not in names]
    if unknown:
        raise TypeError(f"{kind}.counts: {unknown[0]!r} is none of its parameters: {', '.join(names)}")
    if not task.terms:
        raise TypeError(f"{kind}.terms is empty: a reward is the sum of at least one term")
    for name in task.measures:
        if not name.isidentifier() or keyword.iskeyword(name) or name[0] == "_" or task.measures.count(name) > 1:
            raise TypeError(f"{kind}.measures: {name!r} must be a name, as of a field, and there once")


def _values(task: Task, dtype: str) -> str:
    """Write the parameters of a task; those to which its loops count as what they are."""
    return ", ".join(
        f"np.{dtype}({value!r})" if name in task.counts else f"numbers[{k}]"
        for k, (name, value) in enumerate(task.parameters().items())
    )


def _measures(task: Task, array: str) -> str:
    """Write the measures of world b, by name."""
    return f"Measures({', '.join(f'{array}[b, {k}]' for k in range(len(task.measures)))})"


def _lanes(task: Task) -> tuple[str, str]:
    """Write the frame of a task that shows agents side by side, and what makes rows of what it shows.

    It goes on beyond the last agent, up to whole registers: loops over agents have no rest that goes one by one.
    """
    d, width, far = task.scene.dimension, task.parts.width, apart(task.learners)
    radius, memory = 2 * d, 2 * d + 1
    nearby = "near_pos, near_vel, near_radius[0]"
    wide = _frame(f"own[:{d}]", f"own[{d}:{radius}]", "alive[b]", f"own[{memory}:]", f"own[{radius}]", NEAR, nearby)
    widen = f"""rounded = np.uint64(over.shape[1] + {width - 1}) // np.uint64({width}) * np.uint64({width})
        for i in range(n):
            for k in range({d}):
                own[k, i], own[{d} + k, i] = x[k, b, i], v[k, b, i]
            for k in range({task.memory}):
                own[{memory} + k, i] = memory[k, b, i]
            own[{radius}, i] = radius[i]
        if not placed:
            take(near_pos, own, near_who, n)
        take(near_vel, own[{d}:], near_who, n)
        {"pass" if task.alike else f"take(near_radius, own[{radius}:], near_who, n)"}
        wide = {wide}"""
    show = f"""abreast(p, wide, columns(beside, rounded, {task.abreast}, {far}))
        into_rows(seen, beside, {task.abreast}, {far})"""
    return widen, show
