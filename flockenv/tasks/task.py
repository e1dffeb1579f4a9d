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
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.core.record import Record
from flockenv.engine import KernelPlan, Look
from flockenv.model.snapshot import Mark
from flockenv.model.state import State
from flockenv.physics.integrators import INTEGRATORS, SemiImplicitEuler
from flockenv.scene import AnyIntegrator, Scene
from flockenv.tasks.layout import Layout

__all__ = ["TASKS", "Frame", "Task"]

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
    def parts(self) -> KernelPlan:
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
