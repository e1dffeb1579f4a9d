"""The base class of implicit methods with one stage, which Newton's method solves in Python."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from flockenv.model.state import Floats
from flockenv.physics.integrators.integrator import Integrator
from flockenv.physics.integrators.newton import Coupling, Evaluate, NotSolvedError, Stage, solve_stage

__all__ = ["Implicit"]

MOST_HALVED = 3
"""Number of times that a step may be halved before its world counts as diverged."""


class Implicit(Integrator):
    """Base class of methods with one implicit stage, at a fraction `share` of the step."""

    share: ClassVar[float]
    """Time of the stage, in steps: 1 = the end (Euler), 1/2 = the middle."""
    stages: ClassVar[int] = 2
    evaluations: ClassVar[int] = 0  # depends on Newton's method, which counts them
    solves: ClassVar[bool] = True
    stable_at_any_step: ClassVar[bool] = True

    def solve(
        self, evaluate: Evaluate, x: Floats, v: Floats, time: float, dt: float, dimension: int,
        coupling: Coupling | None,
    ) -> Stage:  # fmt: skip
        """Return positions and velocities one step later, (D N,); raise newton.NotSolvedError without a solution.

        evaluate: (x, v, time) -> accelerations, m/s^2, and velocities by which a medium carries agents, m/s, or None;
        x: (D N,) m; v: (D N,) m/s; time: s; dt: s; dimension: D, 2 or 3; coupling: which agents depend on each other
        (default: all on all).

        A step whose equations Newton's method does not solve is halved, repeatedly if needed: if forces jump, a
        solution may exist for one step length and not for another.
        """
        total, left = Stage(x, v, 0, 0, 0), [(time, dt, 0)]
        while left:
            begins, length, halved = left.pop()
            try:
                found = self._stage(evaluate, total.x, total.v, begins, length, dimension, coupling)
            except NotSolvedError:
                if halved == MOST_HALVED:
                    raise
                left += [(begins + length / 2, length / 2, halved + 1), (begins, length / 2, halved + 1)]
                total = total._replace(rejected=total.rejected + 1)
                continue
            total = Stage(
                found.x, found.v, total.newton + found.newton, total.linear + found.linear, total.substeps + 1,
                total.rejected,
            )  # fmt: skip
        return total

    def _stage(
        self, evaluate: Evaluate, x: Floats, v: Floats, time: float, dt: float, dimension: int,
        coupling: Coupling | None,
    ) -> Stage:  # fmt: skip
        """Return positions and velocities one step of this length later, by one stage."""
        h = self.share * dt
        found = solve_stage(evaluate, x, v, time + h, h, dimension, coupling)
        if self.share == 1.0:
            return found
        far = 1.0 / self.share
        return found._replace(x=x + far * (found.x - x), v=v + far * (found.v - v))

    def _step(
        self, law: Any, context: Any, x: Floats, v: Floats, flow: Any, time: float, dt: float, stages: Floats
    ) -> None:
        """Advance one world under laws that are Python functions, with unknown sparsity of the derivatives."""

        def evaluate(pos: Floats, vel: Floats, when: float) -> tuple[Floats, Floats | None]:
            acc, advection = np.empty_like(pos), np.empty_like(pos)
            for row in range(len(pos)):
                law(context, pos[row], vel[row], when, acc[row])
                advection[row] = flow if len(flow) else 0.0
            return acc, advection if len(flow) else None

        found = self.solve(evaluate, x.copy(), v.copy(), time, dt, 1, None)
        x[...], v[...] = found.x, found.v
