"""Where a scene truly goes: a closed form, scipy's DOP853 on its laws, or what ever finer steps of its own tend to.

DOP853 (Hairer, Norsett, Wanner: Solving Ordinary Differential Equations I, II.10) has order 8, and gets over jumps of a
force in steps of nearly nothing. It is run at two tolerances: by how much the two differ is how wrong it is taken to
be. What it cannot see is what a scene does after each step: a speed limit, a wall. Where these act, and where it gives
up, the reference is the scene's own step with RK4, much finer than anything that is measured, and a run half as fine
says how good it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flockenv.accuracy.problem import Floats, Path, Problem, largest
from flockenv.integrators import RK4

__all__ = ["FINER", "PERTURBATION", "Reference", "Sensitivity", "find_reference", "find_sensitivity"]

TIGHT, LOOSE = 1e-13, 1e-12
"""rtol = atol of the two runs of DOP853."""

AGREED = 1e-8
"""As a share of how far agents go: DOP853's two runs must not differ by more."""

MOST_EVALUATIONS = 50_000
"""Of DOP853, before it is said not to converge."""

FINER = 64
"""The finest steps of a reference of our own, in parts of the finest that are measured."""

PERTURBATION = 1e-12
"""m and m/s, or parts of the largest coordinate: how much a start is changed, to see what becomes of it."""

MOST_GROWTH = 1e8
"""How often larger it may become before the horizon is refused: 1e-12 m are 0.1 mm then."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Where everybody is at the instants of a problem."""

    kind: str  # "closed form", "DOP853" or "own steps"
    pos: Floats  # (K, N, D) m
    vel: Floats  # (K, N, D) m/s
    error: float  # m, how wrong it may be at any instant
    note: str = ""  # why it is no better one


@dataclass(frozen=True)
class Sensitivity:
    """What becomes of a change of the start."""

    growth: float  # how often larger the change is where it is largest
    error: float  # m, what it has become then


class _NotSmoothError(Exception):
    """DOP853 cannot follow this scene; the text says why."""


def find_reference(problem: Problem, finer: int = FINER) -> Reference:
    """Return the best reference there is; raises ValueError if a scene diverges even in the finest steps."""
    if problem.exact is not None:
        pos, vel = zip(*(problem.exact(t) for t in problem.times), strict=True)
        return Reference("closed form", np.array(pos, float), np.array(vel, float), 0.0)
    try:
        return _by_scipy(problem)
    except _NotSmoothError as reason:
        return _by_own_steps(problem, finer, str(reason))


# --- DOP853 -----------------------------------------------------------------------------------------------------------


def _by_scipy(problem: Problem) -> Reference:
    tight, loose = _integrated(problem, TIGHT), _integrated(problem, LOOSE)
    apart = largest(problem.apart(tight.pos, loose.pos))
    gone = largest(problem.apart(tight.pos, problem.start.pos[0]))
    if not apart <= AGREED * max(gone, AGREED):
        raise _NotSmoothError(
            f"DOP853 does not converge: at rtol {TIGHT:g} and {LOOSE:g} its paths are {apart:.1e} m apart"
        )
    return Reference(
        "DOP853", tight.pos, tight.vel, apart, f"rtol = atol = {TIGHT:g}, {tight.evaluations:,} evaluations"
    )


def _integrated(problem: Problem, tolerance: float) -> Path:
    """Integrate x' = v + flow, v' = a from instant to instant."""
    from scipy.integrate import solve_ivp

    laws = _Laws(problem)
    y = np.concatenate([problem.start.pos[0].ravel(), problem.start.vel[0].ravel()]).astype(np.float64)
    now, rows = 0.0, []
    for until in problem.times:
        done = solve_ivp(laws, (now, until), y, method="DOP853", rtol=tolerance, atol=tolerance)
        if not done.success:
            raise _NotSmoothError(
                f"DOP853 does not converge: {done.message.lower().rstrip('.')} at t = {done.t[-1]:g} s"
            )
        laws.refuse_limits(done.t, done.y)
        now, y = until, done.y[:, -1]
        rows.append(y)
    _, n, d = problem.start.shape
    both = np.array(rows).reshape(len(rows), 2, n, d)
    return Path(both[:, 0], both[:, 1], laws.evaluations)


class _Laws:
    """y = (positions, velocities) in one row -> its derivative, by the compiled laws of a scene."""

    def __init__(self, problem: Problem) -> None:
        self._scene, self._state, self.evaluations = problem.scene, problem.start.copy(), 0

    def __call__(self, t: float, y: Floats) -> Floats:
        self.evaluations += 1
        if self.evaluations > MOST_EVALUATIONS:
            raise _NotSmoothError(f"DOP853 does not converge: t = {t:g} s after {MOST_EVALUATIONS:,} evaluations")
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
        """Raise if a limit that a scene keeps after each step would have acted: DOP853 knows nothing of them."""
        body, space = self._scene.body, self._scene.space
        limited = bool(np.isfinite(body.max_speed).any())
        if not limited and space.kind != "box":
            return
        for t, row in zip(times, rows.T, strict=True):
            pos, _ = self._split(row)
            if space.kind == "box":
                extent, radius = np.array(space.extent(pos.shape[1])), body.radius[:, None]
                if ((pos < radius) | (pos > extent - radius)).any():
                    raise _NotSmoothError(f"a wall is met at t = {t:.3g} s, and is kept to after each step")
            if limited:
                derivative = self(t, row)
                speeds = (np.linalg.norm(self._split(part)[k], axis=-1) for part, k in ((row, 1), (derivative, 0)))
                if any((speed > body.max_speed * (1 + 1e-9)).any() for speed in speeds):
                    raise _NotSmoothError(
                        f"the speed limit is reached at t = {t:.3g} s, and is kept to after each step"
                    )


# --- the scene's own steps --------------------------------------------------------------------------------------------


def _by_own_steps(problem: Problem, finer: int, reason: str) -> Reference:
    steps = problem.steps[-1] * finer
    try:
        fine, coarse = problem.path(RK4(), steps), problem.path(RK4(), steps // 2)
    except FloatingPointError as error:
        raise ValueError(f"no reference: {reason}; and in steps of its own: {error}") from None
    apart = largest(problem.apart(fine.pos, coarse.pos))
    note = f"{reason}; RK4 in {steps:,} steps, {apart:.1e} m from half as many"
    return Reference("own steps", fine.pos, fine.vel, apart, note)


# --- chaos ------------------------------------------------------------------------------------------------------------


def find_sensitivity(problem: Problem) -> Sensitivity:
    """Return what becomes of a tiny change of the start until the end.

    Raises ValueError if it grows so much that no two computers could agree where anybody is; the line names a horizon.
    """
    start = problem.start
    shift = PERTURBATION * max(1.0, float(np.abs(start.pos).max()))
    rng = np.random.default_rng(0)
    change = rng.choice([-1.0, 1.0], size=(2, *start.shape)) / math.sqrt(start.shape[2])
    other = start.with_motion(start.pos + shift * change[0], start.vel + shift * change[1])
    steps = problem.steps[-1]
    try:
        paths = [problem.path(RK4(), steps, begin) for begin in (start, other)]
    except FloatingPointError as error:
        raise ValueError(
            f"the finest steps that were asked for, {problem.seconds / steps:g} s, are too long: {error}"
        ) from None
    growth = np.maximum.accumulate(problem.apart(paths[0].pos, paths[1].pos).max(axis=1)) / shift
    if not growth[-1] <= MOST_GROWTH:
        kept = problem.times[growth <= 1e-2 * MOST_GROWTH]
        advice = f"try {kept[-1]:.3g} s" if len(kept) else "try a shorter one"
        raise ValueError(
            f"seconds = {problem.seconds:g}: too long a horizon, a difference of {shift:.0e} m at the start grows "
            f"{growth[-1]:.1e}-fold until the end, whatever the method; {advice}"
        )
    return Sensitivity(float(growth[-1]), float(growth[-1] * shift))
