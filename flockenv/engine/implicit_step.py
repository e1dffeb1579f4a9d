"""Steps of a scene by an implicit method: which agents depend on which, and how the kernel takes over the solution.

The method itself, and Newton's method, know nothing of scenes (flockenv.physics.integrators.implicit and newton). The
linear equations of a linearly implicit method are those of the scene's effects (`linear_step`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from flockenv.engine.linear_step import LinearSolver, NotSolvedLinearlyError
from flockenv.model.scene_view import SceneView
from flockenv.model.state import WORK, Floats, State
from flockenv.physics.integrators.implicit import Implicit
from flockenv.physics.integrators.newton import Coupling, Evaluate, NotSolvedError, coupling_between

__all__ = ["coupling_of", "solve_steps"]

Kernel = Callable[[State, int, Floats, Floats], tuple[int, int]]

Advance = Callable[[State], tuple[int, str]]
"""Advances one world by one step; returns the agent that is not finite or was not solved, or -1, and the reason."""

MOST_NUMBERS = 2**22
"""Coordinates that are evaluated together; the columns of a large matrix are evaluated in portions."""


MOST_DENSE = 512
"""Coordinates up to which a full matrix of derivatives costs less than GMRES's differences along directions."""


def coupling_of(scene: SceneView) -> Coupling | None:
    """Return which agents depend on which; None if neighbours interact and a dense matrix would be too large."""
    if any(e.pair_law or e.far_law for e in scene.parts.effects):
        if scene.agents * scene.dimension > MOST_DENSE:
            return None
        pairs = np.indices((scene.agents, scene.agents)).reshape(2, -1)
        return coupling_between(scene.agents, *pairs)
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for _, effect in scene.parts.bond_effects:
        bonds = effect.bonds(scene.groups, scene.dimension)
        for column in bonds.partner.T:
            first.append(bonds.agent.astype(np.int64))
            second.append(column.astype(np.int64))
    return coupling_between(scene.agents, np.concatenate(first), np.concatenate(second))


def solve_steps(
    scene: SceneView,
    state: State,
    drive: Floats,
    steps: int,
    step: Kernel,
    solver: LinearSolver | None = None,
) -> tuple[int, int, str]:
    """Advance every world of a state in place; return the first (world, agent) that failed, and why.

    A world fails if an agent is not finite or the equations are not solved; it then stays as it was. `step(state,
    world, x, v)` passes positions and velocities (D, N) to the kernel, which applies limits, the space and the time.
    solver: of a linearly implicit method.
    """
    broken = (-1, -1, "")
    for b in range(state.shape[0]):
        alone = state.worlds([b])
        push = drive[:, b : b + 1] if drive.shape[1] else drive
        advance = _newton_step(scene, alone, push, step) if solver is None else _linear_step(scene, push, step, solver)
        bad, reason = -1, ""
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is reported
            for _ in range(steps):
                bad, reason = advance(alone)
                if bad >= 0:
                    break
        if bad < 0:
            _write_back(state, b, alone)
        elif broken[0] < 0:
            broken = (b, bad, reason)
    return broken


def _newton_step(scene: SceneView, alone: State, drive: Floats, step: Kernel) -> Advance:
    """Return the step of a method that Newton's method solves."""
    method, evaluate = scene.integrator, _evaluation(scene, alone, drive)
    assert isinstance(method, Implicit)
    return lambda state: _solve_step(scene, method, state, evaluate, step)


def _linear_step(scene: SceneView, drive: Floats, step: Kernel, solver: LinearSolver) -> Advance:
    """Return the step of a linearly implicit method."""
    push = drive.transpose(1, 2, 0) if drive.shape[1] else None

    def advance(state: State) -> tuple[int, str]:
        try:
            found = solver.advance(scene, state, push)
        except NotSolvedLinearlyError as error:
            return error.agent, str(error)
        state.work[0, WORK.index("linear_iterations")] += found.iterations
        state.work[0, WORK.index("substeps")] += found.solves
        state.work[0, WORK.index("rejected_steps")] += found.rejected
        if found.held is not None:  # their impacts are over: constraints see a straight path along the surface
            state.v[:, 0, found.held] = (found.x - state.x[:, 0])[:, found.held] / scene.dt
        return step(state, 0, found.x, found.v)[1], ""

    return advance


def _solve_step(
    scene: SceneView, method: Implicit, alone: State, evaluate: Evaluate, step: Kernel
) -> tuple[int, str]:  # fmt: skip
    """Advance one world by one step; return the agent that is not finite or was not solved, or -1, and the reason."""
    x, v = alone.x[:, 0].ravel(), alone.v[:, 0].ravel()
    try:
        found = method.solve(evaluate, x, v, float(alone.time[0]), scene.dt, scene.dimension, scene.coupling)
    except NotSolvedError as error:
        return (error.place or 0) % scene.agents, str(error)
    alone.work[0, WORK.index("newton_iterations")] += found.newton
    alone.work[0, WORK.index("linear_iterations")] += found.linear
    alone.work[0, WORK.index("substeps")] += found.substeps
    alone.work[0, WORK.index("rejected_steps")] += found.rejected
    was = alone.x[:, 0], alone.v[:, 0]
    pos, vel = found.x.reshape(was[0].shape), found.v.reshape(was[0].shape)
    held = np.isinf(scene.body.mass)  # held agents stay exactly, not but for the rounding of a factorisation
    vel[:, held] = was[1][:, held]
    if not scene.parts.flows:
        pos[:, held] = was[0][:, held] + scene.dt * vel[:, held]
    return step(alone, 0, pos, vel)[1], ""


def _write_back(state: State, b: int, alone: State) -> None:
    """Write a world back to its place in the batch."""
    state.x[:, b], state.v[:, b] = alone.x[:, 0], alone.v[:, 0]
    state.frame[:, b], state.inner[:, b] = alone.frame[:, 0], alone.inner[:, 0]
    for name in ("tick", "work", "alive", "identity", "born", "dies", "bonds"):
        getattr(state, name)[b] = getattr(alone, name)[0]


def _evaluation(scene: SceneView, alone: State, drive: Floats) -> Evaluate:
    """Return the scene's law as Newton's method calls it: many points of one world become a batch of worlds."""
    d, n = scene.dimension, scene.agents
    portion = max(1, MOST_NUMBERS // (d * n))

    def rates_of(x: Floats, v: Floats, time: float) -> tuple[Floats, Floats | None]:
        many = len(x)

        def axes_first(rows: Floats) -> Floats:
            return np.ascontiguousarray(rows.reshape(many, d, n).transpose(1, 0, 2))

        def copies(array: Any, axis: int = 0) -> Any:
            return np.ascontiguousarray(np.repeat(array, many, axis=axis))

        worlds = replace(
            alone, x=axes_first(x), v=axes_first(v), alive=copies(alone.alive), tick=copies(alone.tick),
            key=copies(alone.key), obstacle_x=copies(alone.obstacle_x, 1),
            obstacle_radius=copies(alone.obstacle_radius), frame=copies(alone.frame, 1),
            inner=copies(alone.inner, 1), bonds=copies(alone.bonds), work=np.zeros((many, len(WORK)), np.int64),
        )  # fmt: skip
        push = copies(drive, 1).transpose(1, 2, 0) if drive.shape[1] else None
        acc, flow = scene.rates(worlds, push, np.full(many, time))
        alone.work[0] += worlds.work.sum(axis=0)
        rows = acc.transpose(0, 2, 1).reshape(many, d * n)
        return rows, None if flow is None else flow.transpose(0, 2, 1).reshape(many, d * n)

    def evaluate(x: Floats, v: Floats, time: float) -> tuple[Floats, Floats | None]:
        parts = [rates_of(x[k : k + portion], v[k : k + portion], time) for k in range(0, len(x), portion)]
        if len(parts) == 1:
            return parts[0]
        flows = [flow for _, flow in parts if flow is not None]
        return np.concatenate([acc for acc, _ in parts]), np.concatenate(flows) if flows else None

    return evaluate
