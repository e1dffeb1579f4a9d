"""Newton's method for the equations of an implicit stage: find w with x = x0 + h w and v = v0 + h a(x, v, t).

With a medium that carries everybody w = v + u(x, t), else w = v. Derivatives are finite differences: along directions
that GMRES asks for (nothing is known of who depends on whom), or column by column into a sparse matrix, many columns at
once where agents share no neighbour (Curtis, Powell & Reid 1974, doi 10.1093/imamat/13.1.117), which SuperLU factors.
Both solvers are scipy's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Coupling", "NotSolvedError", "Stage", "coupled", "solve_stage"]

Rows = NDArray[np.floating[Any]]

Evaluate = Callable[[Rows, Rows, float], tuple[Rows, Rows | None]]
"""(x, v, time) -> acceleration, and flow or none: of K instants at once, each a row of all coordinates, (K, D N)."""

MOST_ITERATIONS = 50
MOST_HALVINGS = 12
GMRES_TOLERANCE = 1e-4
"""Of one linear solve, relative: Newton's method makes good what is left."""


class NotSolvedError(ArithmeticError):
    """Newton's method has not come to an end."""

    def __init__(self, reason: str, left: Rows | None = None) -> None:
        """left: by how much the equations do not hold, (D N,); none = not known."""
        super().__init__(reason)
        self.place = None if left is None else int(np.argmax(np.abs(left)))  # the first that is no number, or the worst


class Stage(NamedTuple):
    """What was found, and what it took."""

    x: Rows  # (D N,)
    v: Rows  # (D N,)
    newton: int
    linear: int  # iterations of GMRES, or factorisations
    substeps: int = 1
    rejected: int = 0  # steps that were halved


@dataclass(frozen=True)
class Coupling:
    """Whose acceleration depends on whom, as a sparse matrix of agents, and which agents share a difference."""

    row: NDArray[np.int64]  # (P,) the agent that is accelerated
    column: NDArray[np.int64]  # (P,) by where this one is
    colour: NDArray[np.int64]  # (N,): no agent depends on two of one colour

    @property
    def colours(self) -> int:
        """How many there are."""
        return int(self.colour.max(initial=-1)) + 1


def coupled(agents: int, first: NDArray[np.integer[Any]], second: NDArray[np.integer[Any]]) -> Coupling:
    """Return who depends on whom: everybody on himself, and `first` on `second`, (R,) each."""
    from scipy import sparse  # here: it takes a third of a second to load, and who solves nothing need not wait for it

    own = np.arange(agents)
    ones = np.ones(agents + len(first))
    depends = sparse.csr_matrix((ones, (np.r_[own, first], np.r_[own, second])), (agents, agents))
    depends.sum_duplicates()
    near = (depends.T @ depends).tocsr()
    colour = np.full(agents, -1)
    for j in range(agents):  # greedy: the first colour that nobody has who meets j in some row
        taken = set(colour[near.indices[near.indptr[j] : near.indptr[j + 1]]].tolist())
        colour[j] = next(c for c in range(agents) if c not in taken)
    pairs = depends.tocoo()
    return Coupling(pairs.row.astype(np.int64), pairs.col.astype(np.int64), colour)


class _Residual:
    """R(w) = v - v0 - h a(x, v, t), a vector of all coordinates, for one w or several rows of them."""

    def __init__(self, evaluate: Evaluate, x0: Rows, v0: Rows, time: float, h: float) -> None:
        self.evaluate, self.x0, self.v0, self.time, self.h = evaluate, x0, v0, time, h

    def motion(self, w: Rows) -> tuple[Rows, Rows]:
        """Return positions and own velocities."""
        x = self.x0 + self.h * w
        flow = self.evaluate(x, w, self.time)[1] if self.flows else None
        return x, w if flow is None else w - flow

    def __call__(self, w: Rows) -> Rows:
        """Return R of each row of w."""
        x, v = self.motion(w)
        return np.asarray(v - self.v0 - self.h * self.evaluate(x, v, self.time)[0])

    def stage(self, w: Rows, newton: int, linear: int) -> Stage:
        """Return what w comes to."""
        x, v = self.motion(w[None])
        return Stage(x[0], v[0], newton, linear)

    def guesses(self) -> Iterator[Rows]:
        """Return where to begin: everybody goes on as he does; or as the force says that he will."""
        self.flows = False
        acc, flow = self.evaluate(self.x0[None], self.v0[None], self.time)
        self.flows = flow is not None
        goes_on = self.v0.copy() if flow is None else np.asarray(self.v0 + flow[0])
        yield goes_on
        yield goes_on + self.h * acc[0]


def solve_stage(
    evaluate: Evaluate, x0: Rows, v0: Rows, time: float, h: float, dimension: int, coupling: Coupling | None
) -> Stage:
    """Return the stage at `time` of an implicit method with step h; NotSolvedError if Newton's method does not end.

    x0, v0: (D N,), one coordinate of all agents after another. Where it begins forces may have no derivative (agents in
    one place); then it begins anew from where an explicit step leads.
    """
    residual = _Residual(evaluate, x0, v0, time, h)
    for w in residual.guesses():
        try:
            return _solved(residual, w, dimension, coupling)
        except _SingularError:
            continue
    raise NotSolvedError("forces have no derivative where Newton's method begins", residual(w[None])[0])


class _SingularError(ArithmeticError):
    """Corrections are nothing although the equations do not hold: derivatives are without bound."""


def _solved(residual: _Residual, w: Rows, dimension: int, coupling: Coupling | None) -> Stage:
    """Return what Newton's method comes to from a first guess.

    It ends when a correction is at rounding, relative to the velocities, or stops to shrink there; a correction that
    does not bring those after it down is halved.
    """
    rounding, linear = float(np.finfo(w.dtype).eps), 0
    r = residual(w[None])[0]
    first = float(np.abs(r).max())
    # what the rounding of positions makes of velocities: far from the origin corrections come to rest there
    noise = rounding * float(np.abs(residual.x0).max()) / residual.h
    before = np.inf
    for iteration in range(1, MOST_ITERATIONS + 1):
        size = float(np.abs(r).max())
        if not np.isfinite(size):
            raise NotSolvedError("the acceleration is not finite", r)
        if size == 0.0:
            return residual.stage(w, iteration - 1, linear)
        solve = _free(residual, w, r) if coupling is None else _matrix(residual, w, r, dimension, coupling)
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
        w, r, more = _searched(residual, w, correction, solve)
        linear += more
    raise NotSolvedError(f"Newton's method has not converged in {MOST_ITERATIONS} iterations", r)


def _searched(
    residual: _Residual, w: Rows, correction: Rows, solve: Callable[[Rows], tuple[Rows, int]]
) -> tuple[Rows, Rows, int]:
    """Return the next w and R: the correction, halved until what is left to correct shrinks.

    Corrections are what is compared, by the same derivatives, and not residuals: those of stiff springs say little of
    how far the solution is (the natural monotonicity test of Deuflhard 2004, section 3.3).
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
    return new, r_new, took  # at the least as good as it gets; whether that was enough the next correction tells


def _step_of(w: Rows) -> float:
    """Return the difference that derivatives are taken over."""
    return float(np.sqrt(np.finfo(w.dtype).eps)) * max(1.0, float(np.abs(w).max()))


def _matrix(
    residual: _Residual, w: Rows, r: Rows, dimension: int, coupling: Coupling
) -> Callable[[Rows], tuple[Rows, int]]:
    """Return a solver of J s = b by a sparse factorisation."""
    from scipy import sparse
    from scipy.sparse import linalg

    agents, step = len(w) // dimension, _step_of(w)
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


def _free(residual: _Residual, w: Rows, r: Rows) -> Callable[[Rows], tuple[Rows, int]]:
    """Return a solver of J s = b by GMRES, with J s as a difference along s."""
    from scipy.sparse import linalg

    taken = 0

    def along(direction: Rows) -> Rows:
        nonlocal taken
        taken += 1
        length = float(np.abs(direction).max())
        if length == 0.0:
            return np.zeros_like(direction)
        step = _step_of(w) / length
        return np.asarray((residual((w + step * direction)[None])[0] - r) / step)

    def solve(b: Rows) -> tuple[Rows, int]:
        before = taken
        operator = linalg.LinearOperator((len(w), len(w)), matvec=along, dtype=float)
        found, _ = linalg.gmres(operator, b.astype(float), rtol=GMRES_TOLERANCE, restart=40, maxiter=5)
        return found.astype(w.dtype), taken - before

    return solve
