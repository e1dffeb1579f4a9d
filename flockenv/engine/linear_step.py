"""Steps of a scene by a linearly implicit method: its matrix, filled by the derivatives of effects, and its solution.

Source: Baraff and Witkin 1998, Large steps in cloth simulation, equation 16 and section 5.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.engine.conjugate_gradients import FIXED, FREE, SLIDES, Local, System, assemble_of, solve_of
from flockenv.model.scene_view import SceneView
from flockenv.model.state import Floats, State
from flockenv.physics.constraints import Slide

__all__ = ["LinearSolver", "NotSolvedLinearlyError"]

Doubles = NDArray[np.float64]


class NotSolvedLinearlyError(ArithmeticError):
    """Error that a step has no solution, with the agent that shows it."""

    def __init__(self, reason: str, agent: int) -> None:
        """Store the reason and the agent."""
        super().__init__(reason)
        self.agent = agent


class LinearStep(NamedTuple):
    """Positions and velocities one step later, (D, N), and the iterations to compute them."""

    x: Doubles
    v: Doubles
    iterations: int


class _Part(NamedTuple):
    """The stencils of one effect, and the function that adds their derivatives to the matrix."""

    assemble: Callable[..., None]
    agent: NDArray[np.int32]  # (S, P)
    number: Doubles  # (S, C)
    block: NDArray[np.int32]  # (S, P, P)
    local: Local


class LinearSolver:
    """The linear equations of a scene's steps, with memory for one thread."""

    def __init__(self, scene: SceneView) -> None:
        """Lay out the matrix: a block for every pair of agents that some effect with a derivative couples."""
        n, d = scene.agents, scene.dimension
        found = [
            (effect.derivative, effect.stencils(scene.groups, d))
            for effect in scene.effects
            if effect.derivative is not None
        ]
        keys = [np.arange(n, dtype=np.int64) * (n + 1)]  # row n + column, of the diagonal
        pairs = [each.agent[:, :, None].astype(np.int64) * n + each.agent[:, None, :] for _, each in found]
        every = np.unique(np.concatenate([*keys, *(each.ravel() for each in pairs)]))
        self.system = _system(every, n, d)
        self.parts = [
            _Part(
                assemble_of(law, d, each.agent.shape[1]), np.ascontiguousarray(each.agent, np.int32),
                np.ascontiguousarray(each.number, float), np.searchsorted(every, pair).astype(np.int32),
                _local(each.agent.shape[1], d),
            )
            for (law, each), pair in zip(found, pairs, strict=True)
        ]  # fmt: skip
        self.held = np.isinf(scene.body.mass)
        self.mass = np.where(self.held, 1.0, scene.body.mass.astype(float))
        self.period = np.array(scene.space.extent(d) if scene.space.periodic else (0.0,) * d)
        self.kinds = np.where(self.held, FIXED, FREE).astype(np.int8)
        self._read_slides(scene)
        self.solve = solve_of(d)

    def _read_slides(self, scene: SceneView) -> None:
        """Set the filters of particles that slide."""
        projection = self.system.projection.reshape(scene.agents, -1)
        for constraint in scene.constraints:
            if isinstance(constraint, Slide):
                agents = constraint.agents(scene)
                agents = agents[~self.held[agents]]
                self.kinds[agents] = SLIDES
                projection[agents] = constraint.projection().ravel()

    def assemble(self, x: Doubles, v: Doubles, alive: NDArray[np.bool_], weights: tuple[float, float, float]) -> None:
        """Add the derivatives, times weights of dF/dx and dF/dv, to the matrix, and weighted dF/dx v to its right side.

        x, v: (D, N) m, m/s.
        """
        for part in self.parts:
            part.assemble(
                x, v, alive, part.agent, part.number, part.block, self.period, *weights, self.system, part.local
            )

    def step(
        self, scene: SceneView, state: State, acceleration: Floats, flow: Floats | None
    ) -> LinearStep:  # fmt: skip
        """Return the motion of a single world one step later; raise NotSolvedLinearlyError without a solution.

        acceleration, flow: at the beginning, (1, N, D) m/s^2, m/s.
        """
        method, h, system, d = scene.integrator, scene.dt, self.system, scene.dimension
        acc = np.asarray(acceleration[0], float)
        if not np.isfinite(acc).all():
            raise NotSolvedLinearlyError("the acceleration is not finite", int(np.argmin(np.isfinite(acc).all(axis=1))))
        alive = state.alive[0]
        np.multiply(acc, h * self.mass[:, None], out=system.right.reshape(-1, d))
        system.value[:] = 0.0
        blocks = system.value.reshape(-1, d, d)
        blocks[system.diagonal, np.arange(d)[:, None], np.arange(d)[:, None]] = self.mass
        np.copyto(system.filter, self.kinds)
        system.filter[~alive] = FIXED
        x, v = (np.ascontiguousarray(each[:, 0], float) for each in (state.x, state.v))
        self.assemble(x, v, alive, (-h * h, -h, h * h))
        iterations, left = self.solve(system, method.tolerance, method.most)
        if not left <= method.tolerance:
            raise NotSolvedLinearlyError(
                f"the linear equations are not solved to tolerance = {method.tolerance:g} in {iterations:,} iterations",
                int(np.argmax(np.abs(system.residual))) // d,
            )
        v = v + system.change.reshape(-1, d).T  # not in place: a view of the state, where bounces read the old one
        return LinearStep(x + h * (v if flow is None else v + flow[0].T), v, int(iterations))


def _system(every: NDArray[np.int64], agents: int, dimension: int) -> System:
    """Return the equations with a block for each key, row N + column, ascending."""
    row, column = every // agents, every % agents
    start = np.searchsorted(row, np.arange(agents + 1)).astype(np.int32)
    diagonal = np.searchsorted(every, np.arange(agents, dtype=np.int64) * (agents + 1)).astype(np.int32)
    square, size = agents * dimension**2, agents * dimension
    right, change, residual, direction, image, scaled = (np.zeros(size) for _ in range(6))
    return System(
        start, column.astype(np.int32), diagonal, np.zeros(len(every) * dimension**2), right,
        np.zeros(agents, np.int8), np.zeros(square), np.zeros(square), change, residual, direction, image, scaled,
    )  # fmt: skip


def _local(nodes: int, dimension: int) -> Local:
    """Return scratch memory for a stencil."""
    size = nodes * dimension
    return Local(
        np.zeros((nodes, dimension)), np.zeros((nodes, dimension)), np.zeros((size, size)), np.zeros((size, size))
    )
