"""Newton's method for the equations of an implicit stage: find w with x = x0 + h w and v = v0 + h a(x, v, t).

With a medium that carries all agents w = v + u(x, t), else w = v. Derivatives are finite differences: along the
directions of GMRES (if the sparsity is unknown), or column by column into a sparse matrix, many columns at once for
agents that share no neighbour (Curtis, Powell & Reid 1974, doi 10.1093/imamat/13.1.117), which SuperLU factors.
Both solvers are scipy's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Coupling", "NotSolvedError", "Stage", "coupling_between", "solve_stage"]

Rows = NDArray[np.floating[Any]]

Evaluate = Callable[[Rows, Rows, float], tuple[Rows, Rows | None]]
"""(x, v, time) -> acceleration, and flow or None: for K instants at once, each a row of all coordinates, (K, D N)."""

MOST_ITERATIONS = 50
MOST_HALVINGS = 12
GMRES_TOLERANCE = 1e-4
"""Relative tolerance of one linear solve, as Newton's method corrects its error."""


class NotSolvedError(ArithmeticError):
    """Error that Newton's method has not converged."""

    def __init__(self, reason: str, left: Rows | None = None) -> None:
        """Store the reason and the worst coordinate of the residual `left`, (D N,); None if unknown."""
        super().__init__(reason)
        self.place = None if left is None else int(np.argmax(np.abs(left)))  # the first NaN, or the worst


class Stage(NamedTuple):
    """The solution of a stage, and the work to compute it."""

    x: Rows  # (D N,)
    v: Rows  # (D N,)
    newton: int
    linear: int  # iterations of GMRES, or factorisations
    substeps: int = 1
    rejected: int = 0  # steps that were halved


@dataclass(frozen=True)
class Coupling:
    """Pairs of agents of which one's acceleration depends on the other, and a colouring for finite differences."""

    row: NDArray[np.int64]  # (P,) the agent that is accelerated
    column: NDArray[np.int64]  # (P,) the agent on whose position it depends
    colour: NDArray[np.int64]  # (N,): no agent depends on two of one colour

    @property
    def colours(self) -> int:
        """Number of colours."""
        return int(self.colour.max(initial=-1)) + 1


def coupling_between(agents: int, first: NDArray[np.integer[Any]], second: NDArray[np.integer[Any]]) -> Coupling:
    """Return the coupling in which each agent depends on itself, and `first` on `second`, (R,) each."""
    from scipy import sparse  # slow to import (0.3 s), and used only by implicit methods

    own = np.arange(agents)
    ones = np.ones(agents + len(first))
    depends = sparse.csr_matrix((ones, (np.r_[own, first], np.r_[own, second])), (agents, agents))
    depends.sum_duplicates()
    near = (depends.T @ depends).tocsr()
    colour = np.full(agents, -1)
    for j in range(agents):  # greedy: the first colour of no agent that shares a row with j
        taken = set(colour[near.indices[near.indptr[j] : near.indptr[j + 1]]].tolist())
        colour[j] = next(c for c in range(agents) if c not in taken)
    pairs = depends.tocoo()
    return Coupling(pairs.row.astype(np.int64), pairs.col.astype(np.int64), colour)


class _Residual:
    """The residual R(w) = v - v0 - h a(x, v, t), a vector of all coordinates, for one or several rows of w."""

    def __init__(self, evaluate: Evaluate, x0: Rows, v0: Rows, time: float, h: float) -> None:
        self.evaluate, self.x0, self.v0, self.time, self.h = evaluate, x0, v0, time, h

    def motion(self, w: Rows) -> tuple[Rows, Rows]:
        """Return the positions and own velocities at w."""
        x = self.x0 + self.h * w
        flow = self.evaluate(x, w, self.time)[1] if self.flows else None
        return x, w if flow is None else w - flow

    def __call__(self, w: Rows) -> Rows:
        """Return R of each row of w."""
        x, v = self.motion(w)
        return np.asarray(v - self.v0 - self.h * self.evaluate(x, v, self.time)[0])

    def stage(self, w: Rows, newton: int, linear: int) -> Stage:
        """Return the stage at the solution w."""
        x, v = self.motion(w[None])
        return Stage(x[0], v[0], newton, linear)

    def guesses(self) -> Iterator[Rows]:
        """Yield initial guesses of w: the present velocity; then the velocity after an explicit step."""
        self.flows = False
        acc, flow = self.evaluate(self.x0[None], self.v0[None], self.time)
        self.flows = flow is not None
        goes_on = self.v0.copy() if flow is None else np.asarray(self.v0 + flow[0])
        yield goes_on
        yield goes_on + self.h * acc[0]


def solve_stage(
    evaluate: Evaluate, x0: Rows, v0: Rows, time: float, h: float, dimension: int, coupling: Coupling | None
) -> Stage:
    """Return the stage at `time` of an implicit method with step h; raise NotSolvedError if Newton's method fails.

    x0, v0: (D N,), one coordinate of all agents after another. Forces may have no derivative at the first guess (agents
    in one place); then the second guess is an explicit step.
    """
    residual = _Residual(evaluate, x0, v0, time, h)
    for w in residual.guesses():
        try:
            return _solve_newton(residual, w, dimension, coupling)
        except _SingularError:
            continue
    raise NotSolvedError("forces have no derivative where Newton's method begins", residual(w[None])[0])


class _SingularError(ArithmeticError):
    """Error that corrections vanish although the residual does not, as derivatives are unbounded."""


def _solve_newton(residual: _Residual, w: Rows, dimension: int, coupling: Coupling | None) -> Stage:
    """Return the solution of Newton's method from a first guess.

    It ends when a correction is as small as rounding, relative to the velocities, or stops shrinking near that; a
    correction that does not reduce the next one is halved.
    """
    rounding, linear = float(np.finfo(w.dtype).eps), 0
    r = residual(w[None])[0]
    first = float(np.abs(r).max())
    # rounding of positions, as velocities: far from the origin corrections shrink no further
    noise = rounding * float(np.abs(residual.x0).max()) / residual.h
    before = np.inf
    for iteration in range(1, MOST_ITERATIONS + 1):
        size = float(np.abs(r).max())
        if not np.isfinite(size):
            raise NotSolvedError("the acceleration is not finite", r)
        if size == 0.0:
            return residual.stage(w, iteration - 1, linear)
        solve = (
            _matrix_free_solver(residual, w, r)
            if coupling is None
            else _factorised_solver(residual, w, r, dimension, coupling)
        )
        correction, took = solve(-r)
        linear += took + (coupling is not None)
        scale = max(1.0, float(np.abs(w).max()), float(np.abs(residual.v0).max()))
        change = float(np.abs(correction).max())
        small = change <= 100 * rounding * scale
        if small or (change <= max(1e6 * rounding * scale, 100 * noise) and change >= 0.5 * before):
            if size > max(1e-2 * first, 1e-5 * scale):
                raise _SingularError
            return residual.stage(w + correction if small else w, iteration, linear)
        before = change
        w, r, more = _search_along(residual, w, correction, solve)
        linear += more
    raise NotSolvedError(f"Newton's method has not converged in {MOST_ITERATIONS} iterations", r)


def _search_along(
    residual: _Residual, w: Rows, correction: Rows, solve: Callable[[Rows], tuple[Rows, int]]
) -> tuple[Rows, Rows, int]:
    """Return the next w and R, and the number of linear iterations; halve the correction until the next is smaller.

    Corrections with the same derivatives are compared, not residuals, which for stiff springs are no measure of the
    distance from the solution (the natural monotonicity test of Deuflhard 2004, section 3.3).
    """
    share, took, size = 1.0, 0, float(np.linalg.norm(correction))
    for _ in range(MOST_HALVINGS):
        new = w + share * correction
        r_new = residual(new[None])[0]
        if np.isfinite(r_new).all():
            left, more = solve(-r_new)
            took += more
            if float(np.linalg.norm(left)) <= (1 - share / 4) * size:
                break
        share /= 2
    return new, r_new, took  # the best so far; the next correction shows if it suffices


def _difference_step(w: Rows) -> float:
    """Return the step of the finite differences."""
    return float(np.sqrt(np.finfo(w.dtype).eps)) * max(1.0, float(np.abs(w).max()))


def _factorised_solver(
    residual: _Residual, w: Rows, r: Rows, dimension: int, coupling: Coupling
) -> Callable[[Rows], tuple[Rows, int]]:
    """Return a solver of J s = b by a sparse factorisation."""
    from scipy import sparse
    from scipy.sparse import linalg

    agents, step = len(w) // dimension, _difference_step(w)
    moved = np.repeat(w[None], coupling.colours * dimension, axis=0)
    who = np.arange(agents)
    for k in range(dimension):
        moved[coupling.colour * dimension + k, k * agents + who] += step
    slope = (residual(moved) - r) / step
    rows, columns, values = [], [], []
    for k in range(dimension):
        for axis in range(dimension):
            rows.append(axis * agents + coupling.row)
            columns.append(k * agents + coupling.column)
            values.append(slope[coupling.colour[coupling.column] * dimension + k, axis * agents + coupling.row])
    shape = (len(w), len(w))
    jacobian = sparse.csc_matrix(
        (np.concatenate(values).astype(float), (np.concatenate(rows), np.concatenate(columns))), shape
    )
    try:
        factors = linalg.splu(jacobian)
    except RuntimeError:
        raise NotSolvedError("the equations are singular", r) from None
    return lambda b: (factors.solve(b.astype(float)).astype(w.dtype), 0)


def _matrix_free_solver(residual: _Residual, w: Rows, r: Rows) -> Callable[[Rows], tuple[Rows, int]]:
    """Return a solver of J s = b by GMRES, with J s as a difference along s."""
    from scipy.sparse import linalg

    taken = 0

    def along(direction: Rows) -> Rows:
        nonlocal taken
        taken += 1
        length = float(np.abs(direction).max())
        if length == 0.0:
            return np.zeros_like(direction)
        step = _difference_step(w) / length
        return np.asarray((residual((w + step * direction)[None])[0] - r) / step)

    def solve(b: Rows) -> tuple[Rows, int]:
        before = taken
        operator = linalg.LinearOperator((len(w), len(w)), matvec=along, dtype=float)
        found, _ = linalg.gmres(operator, b.astype(float), rtol=GMRES_TOLERANCE, restart=40, maxiter=5)
        return found.astype(w.dtype), taken - before

    return solve
