"""Task: what is seen, what is paid, when it ends; functions of frames, over a scene that knows nothing of them.

A task is one file: a frozen record whose fields are the keyword arguments of `make`, and six kernels over one world:

* `spawn(p, frame)` writes the first positions, velocities, obstacles and memory from the world's key;
* `drive(p, frame, action, force)` turns actions (L, A) into forces asked for (D, N) N, of scripted agents too;
* `reward(p, before, after, action, terms)` writes the named terms (L, K) and nothing else, as a test checks;
* `ended(p, before, after, over) -> success` writes which learners are over (L,), may take agents out of `after.alive`,
  and says whether the aim is reached;
* `measure(p, before, after, numbers)` writes what this step adds to the domain metrics (Q,);
* `observe(p, frame, rows)` writes the observation rows (L, O).

`p` holds the task's `parameters()` by name. Learners are the first L agents of a world.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.records import Record
from flockenv.scene import Scene
from flockenv.snapshot import Mark
from flockenv.state import State
from flockenv.sweep import scene_source
from flockenv.tasks.layout import Layout

__all__ = ["TASKS", "Frame", "Measured", "Task", "task_source"]

Measured = Mapping[str, NDArray[np.float64]]
"""Numbers of `measure` by name, each (B,)."""

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


class Task(Record):
    """What is seen, what is paid, when it ends. See the module for what a subclass must offer."""

    name: ClassVar[str]
    terms: ClassVar[tuple[str, ...]]
    """Names of the reward terms, in order."""
    metric_names: ClassVar[tuple[str, ...]]
    measures: ClassVar[tuple[str, ...]]
    """Names of the numbers that `measure` writes each step."""
    memory: ClassVar[int] = 0
    """Numbers kept per agent between steps."""

    control_dt: float = Field(default=0.1, gt=0, description="s, one decision; a whole multiple of dt")
    dt: float = Field(default=0.05, gt=0, description="s, one physics step")
    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its name."""
        if "name" in vars(cls):
            TASKS[cls.name] = cls

    def model_post_init(self, context: Any) -> None:
        """Refuse clocks that do not fit."""
        ratio = self.control_dt / self.dt
        if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
            raise ValueError(f"control_dt = {self.control_dt:g} s is not a whole multiple of dt = {self.dt:g} s")

    @property
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
    def obstacle_slots(self) -> int:
        """M: obstacles a world may have."""
        return 0

    @property
    def ends_together(self) -> bool:
        """True if all learners of a world end at the same step."""
        return True

    def parameters(self) -> dict[str, float]:
        """The numbers that its kernels are given, by name."""
        numbers = {n: getattr(self, n) for n in type(self).model_fields}
        return {n: float(v) for n, v in numbers.items() if isinstance(v, (int, float))}

    def metrics(self, sums: Measured, last: Measured, steps: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
        """Return domain metrics (B,) of the episodes so far, from the measures' sums over steps and the last ones."""
        raise TypeError(f"{type(self).__name__} must say how its metrics follow from its measures")

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return what a picture should point out."""
        return ()

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the region that a picture shows, m."""
        d = self.scene.dimension
        return (0.0,) * d, self.scene.space.extent(d)


_KERNELS = ("spawn", "drive", "reward", "ended", "measure", "observe")


def task_source(task: Task) -> str:
    """Return the source of a task's kernel: its scene's, and two entry points, `begin` and `advance_worlds`."""
    d = task.scene.dimension
    names = list(task.parameters())
    values = ", ".join(f"numbers[{k}]" for k in range(len(names)))
    frame = (
        "Frame({x}, {v}, {alive}, obstacle_x[:, b], obstacle_radius[b], memory[:, b], key[b], steps[b], "
        "radius, max_speed, max_force)"
    )
    now = frame.format(x="x[:, b]", v="v[:, b]", alive="alive[b]")
    then = frame.format(x="x0", v="v0", alive="alive0")
    return (
        scene_source(task.scene.parts)
        + f'''

from flockenv.tasks.base import Frame
from {type(task).__module__} import {", ".join(_KERNELS)}

P = namedtuple("P", {" ".join(names)!r})


@njit(cache=True, **FAST)
def begin(
    mask, x, v, alive, tick, obstacle_x, obstacle_radius, key, memory, steps,
    radius, max_speed, max_force, numbers, rows,
):
    """Begin an episode in the masked worlds, and observe all of them."""
    p = P({values})
    for b in range(x.shape[1]):
        if mask[b]:
            tick[b] = 0
            steps[b] = 0
            alive[b, :] = True
            spawn(p, {now})
        observe(p, {now}, rows[b])


@njit(cache=True, **FAST)
def first_bad(actions):
    """Return the (world, learner, axis) of the first action that is not finite, or -1s."""
    for b in range(actions.shape[0]):
        for i in range(actions.shape[1]):
            for k in range(actions.shape[2]):
                if not finite(actions[b, i, k]):
                    return b, i, k
    return -1, -1, -1


@njit(cache=True, **FAST)
def advance_worlds(
    actions, x, v, alive, tick, obstacle_x, obstacle_radius, work_, key, memory, steps,
    mass, radius, max_speed, max_force, params, dt, count, numbers, mortal,
    rows, terms, over, success, measured, force, x0, v0, alive0, action,
    lanes, steer, push, origin, sorted_, order, cell, start, shape, ranges, stages,
):
    """One decision in every world: drive, step, reward, judge, measure, observe."""
    p = P({values})
    broken, who = -1, -1
    for b in range(x.shape[1]):
        now = {now}
        for k in range({d}):
            for i in range(x.shape[2]):
                x0[k, i] = x[k, b, i]
                v0[k, i] = v[k, b, i]
        for i in range(x.shape[2]):
            alive0[i] = alive[b, i]
        for i in range(actions.shape[1]):
            for k in range(actions.shape[2]):
                action[i, k] = min(max(np.float64(actions[b, i, k]), -1.0), 1.0)
        drive(p, now, action, force)
        context = (
            force, mass, radius, max_speed, max_force, alive[b], obstacle_x[:, b], obstacle_radius[b], params,
            lanes, steer, push, origin, sorted_, order, cell, start, shape, ranges, work_[b],
        )
        bad = step_world(context, x[:, b], v[:, b], dt, count, stages)
        if bad >= 0 and broken < 0:
            broken, who = b, bad
        tick[b] += count
        before = {then}
        steps[b] += 1
        now = {now}
        reward(p, before, now, action, terms[b])
        success[b] = ended(p, before, now, over[b])
        measure(p, before, now, measured[b])
        if mortal:
            for i in range(over.shape[1]):
                if over[b, i]:
                    alive[b, i] = False
        observe(p, {now}, rows[b])
    return broken, who
'''
    )
