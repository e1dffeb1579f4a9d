"""Steps of a scene by a linearly implicit method: its matrix, filled by the derivatives of effects, and its solution.

Source: Baraff and Witkin 1998, Large steps in cloth simulation, equation 16 and section 5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.engine.conjugate_gradients import image_of, keep_momentum_of, solve_from_of, solve_of
from flockenv.engine.linear_contacts import ContactSolver
from flockenv.engine.linear_equations import FIXED, FREE, SLIDES, Local, System, assemble_of, strain_change_of
from flockenv.model.scene_view import SceneView
from flockenv.model.state import Floats, State
from flockenv.physics.constraints import Collisions, Slide

__all__ = ["LinearSolver", "NotSolvedLinearlyError"]

Doubles = NDArray[np.float64]


class NotSolvedLinearlyError(ArithmeticError):
    """Error that a step has no solution, with the agent that shows it."""

    def __init__(self, reason: str, agent: int) -> None:
        """Store the reason and the agent."""
        super().__init__(reason)
        self.agent = agent


class LinearStep(NamedTuple):
    """Positions and velocities later, (D, N), and the work to compute them."""

    x: Doubles
    v: Doubles
    iterations: int
    solves: int = 1  # steps that were accepted, whole ones or halves
    rejected: int = 0  # those in which a strain changed too much
    held: NDArray[np.bool_] | None = None  # (N,) agents in contact with an obstacle, by the last linearisation
    push: Doubles | float = 0.0  # (N, D) kg m/s, impulses of these contacts, if they are recorded


class _Part(NamedTuple):
    """The stencils of one effect, and functions: of their derivatives for the matrix, and of their change of strain."""

    assemble: Callable[..., None]
    strain_change: Callable[..., tuple[float, int]] | None
    agent: NDArray[np.int32]  # (S, P)
    number: Doubles  # (S, C)
    kept: NDArray[np.int64] | None  # (S,) see Stencils
    block: NDArray[np.int32]  # (S, P, P)
    local: Local


class LinearSolver:
    """The linear equations of a scene's steps, with memory for one thread."""

    def __init__(self, scene: SceneView) -> None:
        """Lay out the matrix: a block for every pair of agents that some effect with a derivative couples."""
        n, d = scene.agents, scene.dimension
        found = [
            (effect.derivative, effect.strain_law, effect.stencils(scene.groups, d))
            for effect in scene.effects
            if effect.derivative is not None
        ]
        keys = [np.arange(n, dtype=np.int64) * (n + 1)]  # row n + column, of the diagonal
        pairs = [each.agent[:, :, None].astype(np.int64) * n + each.agent[:, None, :] for *_, each in found]
        every = np.unique(np.concatenate([*keys, *(each.ravel() for each in pairs)]))
        self.system = _system(every, n, d)
        self.parts = [
            _Part(
                assemble_of(law, d, each.agent.shape[1]),
                None if strain is None else strain_change_of(strain, d, each.agent.shape[1]),
                np.ascontiguousarray(each.agent, np.int32),
                np.array(each.number, float),  # of its own: `kept` numbers are written into it
                each.kept,
                np.searchsorted(every, pair).astype(np.int32),
                _local(each.agent.shape[1], d),
            )
            for (law, strain, each), pair in zip(found, pairs, strict=True)
        ]
        self.held = np.isinf(scene.body.mass)
        self.mass = np.where(self.held, 1.0, scene.body.mass.astype(float))
        self.masses = np.repeat(self.mass, d)  # of each component
        self.own = (self.system.diagonal[:, None] * d**2 + np.arange(d) * (d + 1)).ravel()  # where `value` has them
        self.period = np.array(scene.space.extent(d) if scene.space.periodic else (0.0,) * d)
        self.kinds = np.where(self.held, FIXED, FREE).astype(np.int8)
        self._read_slides(scene)
        self.records = False  # True while impulses of contacts with obstacles are recorded
        self.push: Doubles | float = 0.0  # (N, D) kg m/s, these impulses in the last step
        self.solve, self.solve_from, self.image, self.first = solve_of(d), solve_from_of(d), image_of(d), 0.0
        self.contacts = self._contacts(scene)
        self.keep_momentum, self.part = keep_momentum_of(d), _loose_parts(self.system, self.kinds)
        parts = int(self.part.max(initial=-1)) + 1
        self.scratch = np.zeros(parts * d * d), np.zeros(parts * d * d), np.zeros(parts * d)

    def _read_slides(self, scene: SceneView) -> None:
        """Set the filters of particles that slide."""
        projection = self.system.projection.reshape(scene.agents, -1)
        for constraint in scene.constraints:
            if isinstance(constraint, Slide):
                agents = constraint.agents(scene)
                agents = agents[~self.held[agents]]
                self.kinds[agents] = SLIDES
                projection[agents] = constraint.projection().ravel()

    def _contacts(self, scene: SceneView) -> ContactSolver | None:
        """Return the contacts with obstacles, if the scene has collisions with some."""
        rules = next((each for each in scene.constraints if isinstance(each, Collisions)), None)
        find = None if rules is None else rules.finder(scene)
        if rules is None or find is None:
            return None
        base = self.system.projection.copy().reshape(scene.agents, scene.dimension, scene.dimension)
        base[self.kinds != SLIDES] = np.eye(scene.dimension)
        return ContactSolver(scene, find, rules, self.kinds, base.ravel())

    def read_kept(self, state: State) -> None:
        """Write the present rest lengths of springs that yield or break into the numbers of their stencils."""
        for part in self.parts:
            if part.kept is not None:
                part.number[:, -1] = state.bonds[0, part.kept]

    def assemble(self, x: Doubles, v: Doubles, alive: NDArray[np.bool_], weights: tuple[float, float, float]) -> None:
        """Add the derivatives, times weights of dF/dx and dF/dv, to the matrix, and weighted dF/dx v to its right side.

        x, v: (D, N) m, m/s.
        """
        for part in self.parts:
            part.assemble(
                x, v, alive, part.agent, part.number, part.block, self.period, *weights, self.system, part.local
            )

    def advance(self, scene: SceneView, state: State, drive: Any) -> LinearStep:
        """Return the motion of a single world one step later: of one solve, or of several over shorter times.

        drive: as for `Scene.rates`. Raises NotSolvedLinearlyError if there is no solution, or if a strain changes by
        more than `method.strain` even in the shortest of them.
        """
        found = self._advance(scene, state, drive, float(state.time[0]), scene.dt, 0)
        self.push = found.push
        return found

    def _advance(self, scene: SceneView, state: State, drive: Any, time: float, h: float, halved: int) -> LinearStep:
        """Return the motion after h seconds, from a state at a time; halved: how often the step was halved for it."""
        method = scene.integrator
        found = self.step(scene, state, drive, time, h)
        change, agent = self._strain_change(state, found) if method.strain > 0 else (0.0, -1)
        if change <= method.strain:
            return found
        if halved == method.halvings:
            raise NotSolvedLinearlyError(
                f"a strain changes by {change:.3g} in {h:.3g} s, after {halved} halvings of dt; strain = "
                f"{method.strain:g} allows no more than that",
                agent,
            )
        first = self._advance(scene, state, drive, time, h / 2, halved + 1)
        pos, vel = (np.ascontiguousarray(each[:, None], scene.dtype) for each in (first.x, first.v))
        last = self._advance(scene, replace(state, x=pos, v=vel), drive, time + h / 2, h / 2, halved + 1)
        return last._replace(
            iterations=found.iterations + first.iterations + last.iterations, solves=first.solves + last.solves,
            rejected=1 + first.rejected + last.rejected, held=_either(first.held, last.held),
            push=first.push + last.push,
        )  # fmt: skip

    def _strain_change(self, state: State, found: LinearStep) -> tuple[float, int]:
        """Return the largest change of a strain over a step, and an agent that it concerns."""
        x, v = (np.ascontiguousarray(each[:, 0], float) for each in (state.x, state.v))
        end, alive = np.ascontiguousarray(found.x), state.alive[0]
        every = [
            part.strain_change(x, end, v, alive, part.agent, part.number, self.period, part.local)
            for part in self.parts
            if part.strain_change is not None
        ]
        return max(every, default=(0.0, -1))

    def step(self, scene: SceneView, state: State, drive: Any, time: float, h: float) -> LinearStep:
        """Return the motion of a single world h seconds after `time`; raise NotSolvedLinearlyError without a solution.

        The first linearisation is about the beginning of the step, each further one about the end that the last one has
        found: they are Newton's iterations for the equation of implicit Euler.
        """
        x, v = (np.ascontiguousarray(each[:, 0], float) for each in (state.x, state.v))
        self.read_kept(state)
        flow = self._set_equations(scene, state, drive, time, h, h * h)
        carried = np.zeros((scene.dimension, 0)) if flow is None else np.ascontiguousarray(flow[0].T, float)
        begins = x, v, carried, time, h
        iterations, held = self._solve(scene, state, begins)
        for _ in range(scene.integrator.linearisations - 1):
            pos, vel = (np.ascontiguousarray(each[:, None], scene.dtype) for each in self._end(*begins))
            self._set_equations(scene, replace(state, x=pos, v=vel), drive, time + h, h, 0.0)
            self._count_from_start()
            more, held = self._solve(scene, state, begins, iterations)
            iterations += more
        recorded = self.contacts if self.records and held is not None else None
        push = 0.0 if recorded is None else recorded.pushes(self.system)
        self._keep_momentum(state.alive[0] if held is None else state.alive[0] & ~held)
        return LinearStep(*self._end(*begins), iterations, held=held, push=push)

    def _set_equations(
        self, scene: SceneView, state: State, drive: Any, time: float, h: float, along: float
    ) -> Floats | None:
        """Write A = M - h dF/dv - h^2 dF/dx and b = h F + `along` dF/dx v at a state, and the filters.

        Returns the velocity by which a medium carries agents, if there is one.
        """
        system, alive = self.system, state.alive[0]
        acceleration, flow = scene.rates(state, drive, [time])
        acc = np.asarray(acceleration[0], float)
        if not np.isfinite(acc).all():
            raise NotSolvedLinearlyError("the acceleration is not finite", int(np.argmin(np.isfinite(acc).all(axis=1))))
        np.multiply(acc.ravel(), h * self.masses, out=system.right)
        system.value[:] = 0.0
        system.value[self.own] = self.masses
        np.copyto(system.filter, self.kinds)
        system.filter[~alive] = FIXED
        x, v = (np.ascontiguousarray(each[:, 0], float) for each in (state.x, state.v))
        self.assemble(x, v, alive, (-h * h, -h, along))
        return flow  # type: ignore[no-any-return]

    def _count_from_start(self) -> None:
        """Add (A - M) dv to b, with the change dv so far: its solution is then the whole change, not the next one."""
        system = self.system
        self.image(system)
        system.right[:] += system.image - self.masses * system.change

    def _solve(
        self, scene: SceneView, state: State, begins: tuple[Doubles, Doubles, Doubles, float, float], done: int = 0
    ) -> tuple[int, NDArray[np.bool_] | None]:
        """Solve the equations; return the number of iterations, and which agents are in contact, if the scene has any.

        done: iterations of earlier linearisations of the step; with some, the solve begins with their change.
        """
        method, system, held = scene.integrator, self.system, None
        if self.contacts is not None and self.contacts.look(system, state, *begins):
            iterations, left = self.contacts.solve(system, self.mass, method.tolerance, method.most - done)
            held = self.contacts.held()
        elif done:
            iterations, left = self.solve_from(system, self.first, method.tolerance, method.most - done)
        else:
            iterations, left, self.first = self.solve(system, method.tolerance, method.most)
        if not left <= method.tolerance:
            raise NotSolvedLinearlyError(
                f"the linear equations are not solved to tolerance = {method.tolerance:g} in "
                f"{done + iterations:,} iterations",
                int(np.argmax(np.abs(system.residual))) // scene.dimension,
            )
        return int(iterations), held

    def _keep_momentum(self, free: NDArray[np.bool_]) -> None:
        """Let parts keep their momentum of which all agents are `free`, (N,): they live, and nothing holds them."""
        part = self.part
        if not free.all():
            part = np.where(np.isin(part, part[~free]), -1, part)
        if part.max(initial=-1) >= 0:
            self.keep_momentum(self.system, part, *self.scratch)

    def _end(self, x: Doubles, v: Doubles, flow: Doubles, time: float, h: float) -> tuple[Doubles, Doubles]:
        """Return positions and velocities after the change that was found, (D, N)."""
        v = v + self.system.change.reshape(-1, len(v)).T  # not in place: a view of the state, which bounces read
        return x + h * (v + flow if flow.size else v), v


def _either(first: NDArray[np.bool_] | None, last: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Return the union of two masks; None stands for an empty one."""
    return last if first is None else first if last is None else first | last


def _system(every: NDArray[np.int64], agents: int, dimension: int) -> System:
    """Return the equations with a block for each key, row N + column, ascending."""
    row, column = every // agents, every % agents
    start = np.searchsorted(row, np.arange(agents + 1)).astype(np.int32)
    diagonal = np.searchsorted(every, np.arange(agents, dtype=np.int64) * (agents + 1)).astype(np.int32)
    square, size = agents * dimension**2, agents * dimension
    right, change, residual, weighted, direction, step, image, carried = (np.zeros(size) for _ in range(8))
    return System(
        start, column.astype(np.int32), diagonal, np.zeros(len(every) * dimension**2),
        np.zeros(len(every) * dimension**2), right,
        np.zeros(agents, np.int8), np.zeros(square), np.zeros(square), change, residual, weighted, direction, step,
        image, carried,
    )  # fmt: skip


def _loose_parts(system: System, kinds: NDArray[np.int8]) -> NDArray[np.int64]:
    """Return the number of the part that each agent belongs to, (N,), -1 if it is alone or the part has a filter.

    Parts are joined by the blocks of the matrix.
    """
    from scipy import sparse  # slow to import, and used only by linearly implicit methods

    joined = sparse.csr_matrix((np.ones(len(system.column)), system.column, system.start))
    _, part = sparse.csgraph.connected_components(joined, directed=False)
    held = np.bincount(part, kinds != FREE) > 0
    loose = ~held & (np.bincount(part) > 1)
    return np.where(loose[part], np.cumsum(loose)[part] - 1, -1)


def _local(nodes: int, dimension: int) -> Local:
    """Return scratch memory for a stencil."""
    size = nodes * dimension
    return Local(
        np.zeros((nodes, dimension)), np.zeros((nodes, dimension)), np.zeros((size, size)), np.zeros((size, size))
    )
