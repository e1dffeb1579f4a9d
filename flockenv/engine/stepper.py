"""Stepper: advances the worlds of a scene in place, on one thread or several, with scratch of its own per thread."""

from __future__ import annotations

import dataclasses
import functools
import threading
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.engine.context import worlds_of
from flockenv.engine.entry_points import begin_of, field_of, step_of
from flockenv.engine.implicit_step import solve_steps
from flockenv.engine.kernel_plan import KernelPlan
from flockenv.engine.linear_step import LinearSolver
from flockenv.engine.scratch import TABLES, scratch_of, scratch_record
from flockenv.engine.workspace import Workspace
from flockenv.jit.thread_pool import LARGEST, AutoTuners, run_parallel, usable_threads
from flockenv.model.scene_view import SceneView
from flockenv.model.state import Floats, State
from flockenv.physics.constraints import (
    BodyContacts,
    CollisionForces,
    Collisions,
    Constraint,
    FaceCollisions,
    RodForces,
    Settler,
)
from flockenv.physics.constraints.constraint_forces import WatchedSettler
from flockenv.physics.constraints.rigid_bodies import BodySettler
from flockenv.physics.constraints.rods import RodSettler
from flockenv.physics.integrators import SemiImplicitEuler
from flockenv.physics.population import make_settler as population_settler

__all__ = ["FEWEST_TOGETHER", "Stepper"]

FEWEST_TOGETHER, SURELY_TOGETHER = 128, 4096
"""Least agents of a world for threads to be allowed to share it (at least 8 blocks), and always in long calls."""


class Stepper:
    """The kernels of a scene and their arguments; each thread that calls them has its own scratch."""

    def __init__(self, scene: SceneView) -> None:
        """Compile nothing yet: kernels are compiled by their first call."""
        self._scene = weakref.ref(scene)  # the scene holds this object: its scratch is freed with its last reference

    @property
    def scene(self) -> SceneView:
        """The scene; this object does not keep it alive, but nothing works without it."""
        scene = self._scene()
        assert scene is not None
        return scene

    @functools.cached_property
    def _params(self) -> Floats:
        numbers: Floats = self.scene.parts.packed_numbers()
        return numbers

    @functools.cached_property
    def _params_in_place(self) -> tuple[Floats, Floats, Floats]:
        """The numbers with a grid over the circles, and where these must be: centres (D, 1, M) m, radii (1, M) m."""
        scene = self.scene
        centre = np.array([circle.centre for circle in scene.circles], scene.dtype).T[:, None]
        radius = np.array([[circle.radius for circle in scene.circles]], scene.dtype)
        return scene.parts.packed_numbers(in_place=True), centre, radius

    def params(self, state: State) -> Floats:
        """Return every number that the kernel is passed for a state; the grid over its circles only if it holds."""
        if self.scene.parts.number_plan.circles >= 0:
            numbers, *expected = self._params_in_place
            found = state.obstacle_x, state.obstacle_radius
            if all(a.shape[-1] == b.shape[-1] and (a == b).all() for a, b in zip(found, expected, strict=True)):
                return numbers
        return self._params

    @property
    def dt(self) -> Any:
        """The step, s, in the precision of the scene."""
        return np.dtype(self.scene.dtype).type(self.scene.dt)

    def begin(self, state: State, fresh: NDArray[np.bool_]) -> None:
        """Write the initial inner numbers of the agents in `fresh`, (B, N)."""
        if self.scene.parts.inner and fresh.any():
            scratch = self.workspaces(1, 1)[0].of(0, self._scratch_kind)
            self._fill_inner(worlds_of(state), self._params, self.dt, fresh, scratch)

    def advance(self, state: State, drive: Floats, steps: int) -> tuple[int, int, str]:
        """Step in place; return the first (world, agent) that failed, or (-1, -1), and why if numbers are finite."""
        if steps == 0:
            return -1, -1, ""
        if self.scene.integrator.solves:
            return solve_steps(self.scene, state, drive, steps, self._finish_step, self._linear_solver())
        return *self._step(state, drive, steps), ""

    def _linear_solver(self) -> LinearSolver | None:
        """Return the linear equations of the scene, with memory of this thread, if its method is linearly implicit."""
        if not self.scene.integrator.linearises:
            return None
        memory = vars(self._threads)
        if "linear_solver" not in memory:
            memory["linear_solver"] = LinearSolver(self.scene)
        found: LinearSolver = memory["linear_solver"]
        return found

    def _finish_step(self, state: State, world: int, x: Floats, v: Floats) -> tuple[int, int]:
        """Let the kernel finish a step with the solved positions and velocities, (D, N): limits, space, time."""
        width, (d, n) = self.scene.parts.width, x.shape
        stages = self.workspaces(1, 1)[0].arrays["stages"]
        padded = np.zeros((2, d, -(-n // width) * width), self.scene.dtype)
        padded[0, :, :n], padded[1, :, :n] = x, v
        stages[:] = padded.reshape(2, d, -1, width).transpose(0, 2, 1, 3).reshape(stages.shape)
        return self._step(state, np.zeros((self.scene.dimension, 0, 0), self.scene.dtype), 1)

    def _step(self, state: State, drive: Floats, steps: int) -> tuple[int, int]:
        """Step in place with the kernel: all steps in one call, or one by one with constraints and population."""
        ends = self.scene.constraints or self.scene.population
        return self._step_one_by_one(state, drive, steps) if ends else self._step_by_kernel(state, drive, steps)

    def _step_one_by_one(self, state: State, drive: Floats, steps: int) -> tuple[int, int]:
        """Step in place, with constraints and population after each step; a world that fails stays as it was."""
        kept, x0, v0 = self._back_up(state)
        begun, failed = state.tick.copy(), np.zeros(len(state.tick), np.bool_)
        found, births = (-1, -1), bool(self.scene.population and self.scene.parts.inner)
        for step in range(steps):
            if self._looks_back:
                x0[...], v0[...] = state.x, state.v
            moved = self._step_by_kernel(state, drive, 1)
            who = state.identity.copy() if births else None
            mended = self._apply_constraints(x0, v0, state)
            if who is not None:
                self.begin(state, state.identity != who)
            failed |= state.tick != begun + step + 1
            failed[[world for world, _ in mended]] = True
            found = min([f for f in (moved, *mended) if f[0] >= 0], default=found) if found[0] < 0 else found
            if failed.any():
                state.put(failed, kept)
                state.tick[failed] += step + 1  # steps continue from the kept state
        if failed.any():
            state.put(failed, kept)
        return found

    @functools.cached_property
    def _looks_back(self) -> bool:
        """True if constraints or population depend on the start of the step."""
        return bool(self.scene.constraints) or any(member.looks_back for member in self.scene.population)

    def _back_up(self, state: State) -> tuple[State, Floats, Floats]:
        """Return a copy of a state, and buffers for positions and velocities: memory of this thread, reused."""
        memory = vars(self._threads)
        sizes = state.shape, state.obstacle_radius.shape
        if memory.get("remembered_sizes") != sizes:
            memory["remembered"] = state.copy(), np.empty_like(state.x), np.empty_like(state.v)
            memory["remembered_sizes"] = sizes
        kept, x0, v0 = memory["remembered"]
        kept.copy_from(state)
        return kept, x0, v0

    def _apply_constraints(self, x0: Floats, v0: Floats, state: State) -> list[tuple[int, int]]:
        """Apply all constraints to a step that began at x0, v0; return every (world, agent) that is not finite."""
        worlds, agents, _ = state.shape
        threads, work = min(usable_threads(), worlds), worlds * agents

        def settle(settlers: list[Settler], first: int, end: int) -> list[tuple[int, int]]:
            return [bad for each in settlers if (bad := each(x0, v0, state, first, end))[0] >= 0]

        def alone() -> list[tuple[int, int]]:
            return settle(self._settlers(1)[0], 0, worlds)

        def shared() -> list[tuple[int, int]]:
            bounds = [worlds * k // threads for k in range(threads + 1)]
            parts = zip(self._settlers(threads), bounds[:-1], bounds[1:], strict=False)
            return [
                bad for found in run_parallel([functools.partial(settle, *part) for part in parts]) for bad in found
            ]

        return alone() if threads <= 1 else self.tuners.of("mending", work, threads).run(alone, shared, work >= LARGEST)

    def _settlers(self, count: int) -> list[list[Settler]]:
        """Return the constraints and population of `count` threads, each with scratch memory of its own."""
        kept: list[list[Settler]] = vars(self._threads).setdefault("settlers", [])
        while len(kept) < count:
            last = [population_settler(self.scene)] if self.scene.population else []
            kept.append([constraint.settler(self.scene) for constraint in self.scene.constraints] + last)
        return kept

    def body_contacts(self) -> BodyContacts:
        """Return the contacts of rigid bodies in the last step of one world by this thread."""
        return next(each.found() for each in self._settlers(1)[0] if isinstance(each, BodySettler))

    def rod_forces(self, step: Callable[[], object]) -> RodForces:
        """Return the forces of all rods in a step of one world, which `step` makes; constraints one after another."""
        settlers = [each for each in self._settlers(1)[0] if isinstance(each, RodSettler)]
        for each in settlers:
            each.rods.records[0] = True
        try:
            step()
        finally:
            for each in settlers:
                each.rods.records[0] = False
        return RodForces(*(np.concatenate(parts) for parts in zip(*(each.found() for each in settlers), strict=True)))

    def collision_forces(self, step: Callable[[], object]) -> CollisionForces:
        """Return the forces of collisions in a step of one world, which `step` makes."""
        settlers, solver = self._settlers(1)[0], self._linear_solver()
        unwatched, watched = settlers[:], dict[type[Constraint], WatchedSettler]()
        for k, constraint in enumerate(self.scene.constraints):
            for kind in (Collisions, FaceCollisions):
                if isinstance(constraint, kind):
                    settlers[k] = watched[kind] = WatchedSettler(settlers[k])
        if solver is not None:
            solver.records = True
        try:
            step()
        finally:
            settlers[:] = unwatched
            if solver is not None:
                solver.records = False
        return self._forces_of(watched, 0.0 if solver is None else solver.push)

    def _forces_of(self, watched: dict[type[Constraint], WatchedSettler], push: Floats | float) -> CollisionForces:
        """Return forces by the changes of velocity in a step; push: (N, D) kg m/s, impulses before, of `collisions`."""
        mass, dt = self.scene.body.mass, self.scene.dt
        own, impulses = np.where(np.isinf(mass), 0, mass)[:, None], []
        for kind in (Collisions, FaceCollisions):
            change = watched[kind].change[:, 0].T if kind in watched else np.zeros((len(mass), self.scene.dimension))
            impulses.append(own * change)
        bodies, faces = (impulses[0] + push) / dt, impulses[1] / dt
        return CollisionForces(bodies.astype(self.scene.dtype), faces.astype(self.scene.dtype))

    def plain_scratch(self, masses: Floats | None = None) -> Any:
        """Return scratch for `accelerate`; masses: (N,) kg instead of the scene's, for this call alone."""
        if masses is None:
            return self.workspaces(1, 1)[0].of(0, self.plain_scratch_kind)
        body = dataclasses.replace(self.scene.body, mass=masses)
        return Workspace.allocate(self.scene.parts, body, self.scene.table).of(0, self.plain_scratch_kind)

    def _step_by_kernel(self, state: State, drive: Floats, steps: int) -> tuple[int, int]:
        """Step in place by the kernel alone, on all threads in use.

        Threads divide the worlds, or the agents of a large world.
        """
        worlds, agents, _ = state.shape
        move, kind = self.move, self._scratch_kind
        arrays = worlds_of(state), drive, self.params(state), self.dt, steps
        threads, team = self._thread_counts(worlds, agents)

        def alone() -> tuple[int, int]:
            return move(*arrays, 0, worlds, 0, 1, self.workspaces(1, 1)[0].of(0, kind))

        if threads <= 1:
            return alone()

        def shared() -> tuple[int, int]:
            spaces = self.workspaces(threads // team, team)
            spaces[0].arrays["sync"][:] = 0
            parts = [
                (0, worlds) if team > 1 else (worlds * k // threads, worlds * (k + 1) // threads)
                for k in range(threads)
            ]
            found = run_parallel([
                functools.partial(move, *arrays, *parts[k], k % team, team, spaces[k // team].of(k % team, kind))
                for k in range(threads)
            ])  # fmt: skip
            return min([bad for bad in found if bad[0] >= 0], default=(-1, -1))

        work = worlds * agents * steps
        surely = work >= LARGEST and (team == 1 or agents >= SURELY_TOGETHER)
        return self.tuners.of("together" if team > 1 else "apart", work, threads).run(alone, shared, surely)

    def _thread_counts(self, worlds: int, agents: int) -> tuple[int, int]:
        """Return the number of threads that may step these worlds, and the number that share each world.

        With an implicit method the solution is in one thread's scratch memory.
        """
        threads, solves = usable_threads(), self.scene.integrator.adaptive or self.scene.integrator.solves
        together = worlds < threads and agents >= FEWEST_TOGETHER and not solves
        return (threads, threads) if together else (min(threads, worlds), 1)

    @functools.cached_property
    def plain_parts(self) -> KernelPlan:
        """The kernel plan for accelerations alone: independent of the integrator, and agents may be at NaN."""
        plan: KernelPlan = self.scene.parts
        return dataclasses.replace(plan, integrator=SemiImplicitEuler(), stepped=False)

    @functools.cached_property
    def _scratch_kind(self) -> Any:
        return scratch_record(self.scene.parts)

    @functools.cached_property
    def plain_scratch_kind(self) -> Any:
        """The type of the record of scratch memory that `accelerate` is passed."""
        return scratch_record(self.plain_parts)

    @functools.cached_property
    def accelerate(self) -> Callable[..., None]:
        """The kernel that computes accelerations alone."""
        return field_of(self.plain_parts)

    @functools.cached_property
    def _fill_inner(self) -> Callable[..., None]:
        return begin_of(self.scene.parts)

    @functools.cached_property
    def move(self) -> Callable[..., tuple[int, int]]:
        """The kernel that steps worlds."""
        return step_of(self.scene.parts)

    def workspaces(self, count: int, team: int) -> list[Workspace]:
        """Return scratch memory of this thread: two threads may step one scene at the same time."""
        kept: dict[int, list[Workspace]] = vars(self._threads).setdefault("workspaces", {})
        found = kept.setdefault(team, [])
        while len(found) < count:
            found.append(Workspace.allocate(self.scene.parts, self.scene.body, self.scene.table, team))
        return found

    def share_workspaces(self, other: Stepper) -> None:
        """Use the scratch memory that this thread has for another scene, if all that steps only read in it is equal.

        That is the case after a change of numbers other than bodies', and saves the allocation, which takes longer than
        a step of a large world.
        """
        mine, theirs = self.scene, other.scene
        kept: dict[int, list[Workspace]] = vars(other._threads).get("workspaces", {})
        bodies = mine.body.arrays(), theirs.body.arrays()
        if self.move is not other.move or not all(map(np.array_equal, *bodies)):
            return
        for team in kept:
            wanted, found = (scratch_of(scene.parts, len(scene.body.mass), team) for scene in (mine, theirs))
            if wanted != found or any(name in wanted for name in TABLES):
                return
        vars(self._threads)["workspaces"] = kept

    @property
    def tuners(self) -> AutoTuners:
        """Measurements, by the calling thread, of whether work is faster on one thread or on several."""
        found: AutoTuners = vars(self._threads).setdefault("choices", AutoTuners())
        return found

    @functools.cached_property
    def _threads(self) -> threading.local:
        return threading.local()
