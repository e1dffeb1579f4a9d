"""Path of a scene by scipy's DOP853 on its compiled laws.

DOP853 (Hairer, Norsett, Wanner: Solving Ordinary Differential Equations I, II.10) has order 8, and crosses jumps of a
force in very short steps. It is run at two tolerances; the difference of the two runs is the estimate of its error. It
does not include what acts between the steps of a scene, and raises NotSmoothError then.
"""

from __future__ import annotations

import numpy as np

from flockenv.studies.accuracy.paths import Floats, Path, largest_value
from flockenv.studies.accuracy.problem import Problem

__all__ = ["NotSmoothError", "integrate_twice"]

TIGHT, LOOSE = 1e-13, 1e-12
"""rtol = atol of the two runs of DOP853."""

AGREED = 1e-8
"""Largest difference of DOP853's two runs, as a share of the largest distance that an agent moves."""

MOST_EVALUATIONS, AT_ONCE = 50_000, 0.1
"""Most evaluations of DOP853; this share is allowed from the start, the rest in proportion to the time reached."""


class NotSmoothError(Exception):
    """DOP853 cannot follow this scene; the message has the reason."""


def integrate_twice(problem: Problem) -> tuple[Path, float, str]:
    """Return the path, its error in m, and a note; raise NotSmoothError if DOP853 cannot follow the scene."""
    if problem.after_steps:
        raise NotSmoothError(f"DOP853 cannot include what acts after each step ({problem.after_steps})")
    (tight, evaluations), (loose, _) = _integrate(problem, TIGHT), _integrate(problem, LOOSE)
    difference = largest_value(problem.distances(tight, loose))
    gone = largest_value(problem.distances(tight, Path(problem.start.pos[0], problem.start.vel[0])))
    if not difference <= AGREED * max(gone, AGREED):
        raise NotSmoothError(
            f"DOP853 does not converge: at rtol {TIGHT:g} and {LOOSE:g} its paths are {difference:.1e} m apart"
        )
    return tight, difference, f"rtol = atol = {TIGHT:g}, {evaluations:,} evaluations"


def _integrate(problem: Problem, tolerance: float) -> tuple[Path, int]:
    """Integrate x' = v + flow, v' = a from instant to instant; return the path, and the number of evaluations."""
    from scipy.integrate import solve_ivp

    laws = _Laws(problem)
    y = np.concatenate([problem.start.pos[0].ravel(), problem.start.vel[0].ravel()]).astype(np.float64)
    now, rows = 0.0, []
    for until in problem.times:
        done = solve_ivp(laws, (now, until), y, method="DOP853", rtol=tolerance, atol=tolerance)
        if not done.success:
            raise NotSmoothError(
                f"DOP853 does not converge: {done.message.lower().rstrip('.')} at t = {done.t[-1]:g} s"
            )
        laws.refuse_limits(done.t, done.y)
        now, y = until, done.y[:, -1]
        rows.append(y)
    _, n, d = problem.start.shape
    both = np.array(rows).reshape(len(rows), 2, n, d)
    return Path(both[:, 0], both[:, 1]), laws.evaluations


class _Laws:
    """Right-hand side y -> dy/dt for y = (positions, velocities) in one row, by the compiled laws of a scene."""

    def __init__(self, problem: Problem) -> None:
        self._scene, self._state, self._seconds = problem.scene, problem.start.copy(), problem.seconds
        self.evaluations = 0

    def __call__(self, t: float, y: Floats) -> Floats:
        self.evaluations += 1
        if self.evaluations > MOST_EVALUATIONS * (AT_ONCE + (1 - AT_ONCE) * t / self._seconds):
            raise NotSmoothError(f"DOP853 does not converge: t = {t:.3g} s after {self.evaluations:,} evaluations")
        pos, vel = self._split(y)
        self._state.pos[0], self._state.vel[0] = self._scene.space.wrap(pos), vel
        acc, flow = self._scene.rates(self._state, times=[t])
        moved = vel if flow is None else vel + flow[0]
        return np.concatenate([moved.ravel(), acc[0].ravel()])

    def _split(self, y: Floats) -> tuple[Floats, Floats]:
        _, n, d = self._state.shape
        both = y.reshape(2, n, d)
        return both[0], both[1]

    def refuse_limits(self, times: Floats, rows: Floats) -> None:
        """Raise NotSmoothError if a wall or speed limit would have acted after a step: DOP853 does not include them."""
        body, space = self._scene.body, self._scene.space
        limited = bool(np.isfinite(body.max_speed).any())
        if not limited and space.kind != "box":
            return
        for t, row in zip(times, rows.T, strict=True):
            pos, _ = self._split(row)
            if space.kind == "box":
                extent, radius = np.array(space.extent(pos.shape[1])), body.radius[:, None]
                if ((pos < radius) | (pos > extent - radius)).any():
                    raise NotSmoothError(f"an agent reaches a wall at t = {t:.3g} s, and walls act after a step")
            if limited:
                derivative = self(t, row)
                speeds = (np.linalg.norm(self._split(part)[k], axis=-1) for part, k in ((row, 1), (derivative, 0)))
                if any((speed > body.max_speed * (1 + 1e-9)).any() for speed in speeds):
                    raise NotSmoothError(f"a speed limit is reached at t = {t:.3g} s, and acts after a step")
