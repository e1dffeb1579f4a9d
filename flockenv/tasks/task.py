"""Task: observations, rewards and episode ends, as functions of frames, over a scene that does not depend on them.

A task is one file: a frozen record whose fields are the keyword arguments of `make`, and seven to nine kernels over one
world:

* `spawn(p, frame)` writes the initial positions, velocities, obstacles and memory, drawn from the world's key;
* `drive(p, frame, action, force)` turns actions (L, A) into steering forces (D, N) N, also of scripted agents;
* `keep(p, before, after)`, only if the task `keeps`, writes into the memory what the other kernels read of this step;
* `reward(p, at, before, after, action, terms)` writes the named terms (L, K), each contiguous, and nothing else, as a
  test checks;
* `ended(p, at, before, after, numbers, over) -> success` writes which learners are over (L,), may clear `after.alive`
  of agents, and returns whether the aim is reached; it may also write those of the `measures` (Q,) that it needs
  itself. If the task has a `lasting_aim`, it returns whether the aim holds now, and success is what `aim_has_lasted` in
  tasks/lasting.py returns for the sums of the measures;
* `measure(p, at, before, after, numbers)` runs next and writes the other measures: what this step adds to each;
* `metrics(p, at, sums, last, steps, numbers)` writes the domain metrics of an episode so far, in the order of
  `metric_names`, from the sums of the measures over its steps and from their last values, by name (e.g. sums.path), and
  the number of steps. A metric that is not written has no value. All numbers are double precision, also `p`;
* `abreast(p, at, frame, columns)`, only if the task's `abreast` is not 0, writes the first `abreast` numbers of all
  rows, (L, abreast), each number of all agents contiguous, so that loops over agents become vector code. L is rounded
  up to whole registers there and in that task's `reward`. In the frames of `abreast`, `reward`, `ended` and `measure`
  of such a task, `pos`, `vel`, `memory`, `radius` and the near arrays extend beyond the last agent, up to a multiple of
  `simd_rows.PAIR`, with arbitrary values: no result may depend on these. `alive`, the limits, `before` and `action` end
  with the last agent. The frame is a copy: such a task's `ended` may write only `over` and `after.alive`; `keep` writes
  the memory;
* `observe(p, at, frame, rows)` writes the observation rows (L, O), or what `abreast` left of them.

`p` holds the task's `parameters()` by name, and `at` the indices of the numbers that a kernel writes: those of `terms`
(reward), `measures` (ended, measure), `metric_names` (metrics), or of the first number of each slot of the layout
(abreast, observe): `terms[i, at.progress] = ...`, `rows[i, at.velocity + k] = ...`. No order of names is written twice.

Learners are the first L agents of a world. If the task has a `look`, neighbours are searched once for all kernels, by
the same query as for a scene's effects.
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
    """State of one world at one instant, as passed to kernels."""

    pos: Any  # (D, N) m
    vel: Any  # (D, N) m/s
    alive: Any  # (N,)
    centre: Any  # (D, M) m, obstacles
    rho: Any  # (M,) m, obstacle radii; 0: empty slot
    memory: Any  # (K, N) kept between steps by the task: wander targets, goals
    key: Any  # random key of the world
    step: Any  # decisions since the start
    radius: Any  # (N,) m
    max_speed: Any  # (N,) m/s
    max_force: Any  # (N,) N
    # Neighbours and obstacles, as the task's `look` defines them; empty in the frame `before`.
    near_square: Any  # (K, N) m^2, squared distances to the nearest agents, nearest first; inf: none
    near_index: Any  # (K, N) their indices; a valid index also where there is none
    near_count: Any  # (N,) number of agents within sight, at most K
    obstacle_gap: Any  # (J, N) m, distances to the surfaces of the nearest obstacles; inf: none
    obstacle_index: Any  # (J, N)
    obstacle_count: Any  # (N,)
    # Positions, velocities and radii of the nearest agents: only in tasks with `abreast`, for the kernels `abreast`,
    # `reward`, `ended` and `measure`; else empty.
    near_pos: Any  # (D, K, N) m
    near_vel: Any  # (D, K, N) m/s
    near_radius: Any  # (K, N) m
    table: Any  # (T,) the task's table()


class Task(Record):
    """Observations, rewards and episode ends; the module's docstring lists what a subclass must define."""

    name: ClassVar[str]
    terms: ClassVar[tuple[str, ...]]
    """Names of the reward terms, in order."""
    priced: ClassVar[tuple[str, ...]] = ()
    """The reward terms that its `price` multiplies; (): it has no price (tasks/price.py)."""
    harm: ClassVar[str] = ""
    """The one of them that is not 0 in a decision in which a learner is harmed."""
    metric_names: ClassVar[tuple[str, ...]]
    """Names of the numbers that `metrics` writes."""
    measures: ClassVar[tuple[str, ...]]
    """Names of the numbers that `measure` writes each step."""
    counts: ClassVar[tuple[str, ...]] = ()
    """Parameters that are loop bounds of its kernels; compiled in as constants, so each value has its own kernel."""
    memory: ClassVar[int] = 0
    """Numbers stored per agent between steps."""
    keeps: ClassVar[bool] = False
    """True if it has a kernel `keep`."""
    lasting_aim: ClassVar[bool] = False
    """True if success is judged over the episode, by tasks/lasting.py, and not at one instant."""

    control_dt: float = Field(default=0.1, gt=0, description="s, one decision; an integer multiple of dt")
    dt: float = Field(default=0.05, gt=0, description="s, one physics step")
    integrator: AnyIntegrator = Field(default_factory=SemiImplicitEuler, description="method of a physics step")
    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")
    dtype: Literal["float64", "float32"] = Field(default="float64", description="precision of the simulation")

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its name."""
        if "name" in vars(cls):
            TASKS[cls.name] = cls

    def model_post_init(self, context: Any) -> None:
        """Raise ValueError if control_dt is no integer multiple of dt, or the integrator solves equations in Python.

        context: of pydantic; not used.
        """
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

    # --- properties of a task ---------------------------------------------------------------------------------------

    if TYPE_CHECKING:  # a field in one task, a property in another

        @property
        def learners(self) -> int:
            """L: agents 0..L-1 are the learners."""

        @property
        def agents(self) -> int:
            """N: all agents of a world."""

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Names of the learners, (L,)."""
        raise TypeError(f"{type(self).__name__} must name its learners")

    @functools.cached_property
    def scene(self) -> Scene:
        """The scene of the task."""
        raise TypeError(f"{type(self).__name__} must have a scene")

    @functools.cached_property
    def layout(self) -> Layout:
        """The layout of an observation row."""
        raise TypeError(f"{type(self).__name__} must lay out its observation")

    @functools.cached_property
    def action_layout(self) -> Layout:
        """The layout of an action row."""
        raise TypeError(f"{type(self).__name__} must lay out its action")

    @property
    def alike(self) -> bool:
        """True if all agents have the same radius."""
        return bool(np.ptp(self.scene.body.radius) == 0)

    @property
    def abreast(self) -> int:
        """How many of a row's first numbers its kernel `abreast` writes; 0: it has no such kernel."""
        return 0

    @property
    def obstacle_slots(self) -> int:
        """M: largest number of obstacles in a world."""
        return 0

    @property
    def ends_together(self) -> bool:
        """True if all learners of a world end at the same step."""
        return True

    @property
    def look(self) -> Look | None:
        """The neighbour query whose results are in its frames; None if its kernels need none."""
        return None

    def table(self) -> tuple[float, ...]:
        """Return the numbers that its kernels look up, such as directions of rays."""
        return ()

    @functools.cached_property
    def parts(self) -> KernelPlan:
        """The parts of its kernel: those of the scene, and the look."""
        if self.scene.constraints:
            kinds = ", ".join(constraint.kind for constraint in self.scene.constraints)
            raise ValueError(
                f"scene.constraints: {kinds}: a task runs as one kernel, which supports no constraints yet"
            )
        if self.scene.population:
            raise ValueError(
                "scene.population: a task runs as one kernel, which supports no births; agents leave by `ended`"
            )
        return replace(self.scene.parts, look=self.look)

    def parameters(self) -> dict[str, float]:
        """Return the numbers that are passed to its kernels, by name."""
        numbers = {n: getattr(self, n) for n in type(self).model_fields}
        return {n: float(v) for n, v in numbers.items() if isinstance(v, (int, float))}

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return the marks of a picture, such as goals.

        state: of all worlds; memory: (B, M, N), as of World.memory; world: index of the world shown.
        """
        return ()

    def roles(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[str, ...]:
        """Return the role of each agent of a world in pictures, (N,) of snapshot.ROLES; constant over an episode.

        state: of all worlds; memory: (B, M, N), as of World.memory; world: index of the world.
        """
        return self.scene.roles

    def own_success(self, state: State, memory: NDArray[Any], alive: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return whether each learner, (B, L), does by itself what all must do for success; None if all do it together.

        state: after the step.

        memory: (B, M, N), as of World.memory; alive: (B, L), after the step.
        """
        return None

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the region that a picture shows, m.

        state: of all worlds; world: index of the world shown.
        """
        d = self.scene.dimension
        return (0.0,) * d, self.scene.space.extent(d)
