"""Linear finite elements: structures of bars, triangles or tetrahedra under small displacements.

M a = F - C v - K u, with M, C and K sparse, (n D, n D) for n particles in D dimensions. Degrees of freedom are numbered
particle by particle: x0, y0, x1, y1, ..., so particle i has i D to i D + D - 1 (`freedoms`), and matrices act on
u.ravel() of a displacement u (n, D). Shape functions are linear, so strain and stress are constant in each element.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from flockenv.core.record import Record

__all__ = [
    "Blocks",
    "Material",
    "blocks",
    "contents",
    "flat",
    "freedoms",
    "frequencies",
    "gradients",
    "mass",
    "rayleigh",
    "solve_static",
    "stiffness",
]

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Sparse = Any
"""A scipy.sparse matrix; scipy is imported only in functions, and has no types."""

SOFTEST = 1e-14
"""Least eigenvalue of a stiffness whose diagonal is scaled to about 1: below it the solution is rounding error."""

DENSE = 1000
"""Number of freedoms up to which all frequencies are computed, from full matrices."""

STILL = 1e-13
"""Squared frequency, relative to the greatest, below which a motion counts as rigid."""


class Material(Record):
    """The material of a structure."""

    young: float = Field(gt=0, description="Pa, Young's modulus")
    poisson: float = Field(default=0.3, gt=-1, lt=0.5, description="Poisson's ratio; not used for bars")
    density: float = Field(default=1000.0, gt=0, description="kg/m^3")
    area: float = Field(default=1.0, gt=0, description="m^2, cross section of bars")
    thickness: float = Field(default=1.0, gt=0, description="m, thickness of triangles")

    def section(self, corners: int) -> float:
        """Return the factor from an element's content to its volume: m^2 (bar), m (triangle), 1 (tetrahedron)."""
        return {2: self.area, 3: self.thickness}.get(corners, 1.0)

    def lame(self, corners: int) -> tuple[float, float]:
        """Return Lame's moduli, Pa, in uniaxial stress (bar), plane stress (triangle) or a solid (tetrahedron)."""
        E, v = self.young, self.poisson
        if corners == 2:
            return E, 0.0
        return E * v / ((1 + v) * ((1 - v) if corners == 3 else (1 - 2 * v))), E / (2 * (1 + v))


def contents(points: ArrayLike, elements: ArrayLike) -> Floats:
    """Return length, area or volume of each element, (E,) m, m^2 or m^3.

    points: (n, D) m; elements: (E, k), k corners each: bars, triangles (in the plane or in space) or tetrahedra.
    """
    edges = _edges(np.asarray(points, float), np.asarray(elements))
    if edges.shape[1] == 1:
        return np.asarray(np.linalg.norm(edges[:, 0], axis=1))
    if edges.shape[1] == edges.shape[2]:
        return np.asarray(np.abs(np.linalg.det(edges)) / math.factorial(edges.shape[1]))
    return np.asarray(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2)


def flat(points: ArrayLike, elements: ArrayLike) -> NDArray[np.intp]:
    """Return the indices of degenerate elements: corners in one place, on a line or in a plane, up to rounding."""
    points, elements = np.asarray(points, float), np.asarray(elements)
    edges = _edges(points, elements)
    span = np.linalg.norm(edges, axis=2).max(axis=1, initial=0.0)
    return np.flatnonzero(contents(points, elements) <= 1e-12 * span ** edges.shape[1])


def gradients(points: ArrayLike, elements: ArrayLike) -> Floats:
    """Return the gradients of each element's shape functions, one per corner, (E, k, D) 1/m; those of a bar along it.

    Raises ValueError if points and elements are not a structure.
    """
    return _gradients(*_structure(points, elements))


def freedoms(particles: ArrayLike, dimension: int) -> NDArray[np.int64]:
    """Return the degrees of freedom of some particles, (P D,), which as `fixed` hold them in place."""
    held = np.asarray(particles, np.int64).reshape(-1, 1)
    return np.asarray((held * dimension + np.arange(dimension)).ravel())


def stiffness(points: ArrayLike, elements: ArrayLike, material: Material) -> Sparse:
    """Return K, csr (n D, n D) N/m: forces K u hold the structure at small displacements u.

    points: (n, D) m, undeformed; elements: (E, k): bars (k = 2, any D), triangles (k = 3, in the plane, plane stress)
    or tetrahedra (k = 4, in space). An isotropic element of volume V couples its corners a and b by

        K_ab = V (L g_a g_b' + G g_b g_a' + G (g_a . g_b) I)

    with g the gradients of its shape functions and L, G Lame's moduli; for a bar L = E, G = 0. Raises ValueError if
    points and elements are not a structure. Source: Zienkiewicz, Taylor & Zhu, The Finite Element Method, 2.2 and 6.2.
    """
    points, elements = _structure(points, elements)
    k, d = elements.shape[1], points.shape[1]
    L, G = material.lame(k)
    g = _gradients(points, elements)
    volume = contents(points, elements) * material.section(k)
    outer = np.einsum("eai,ebj->eaibj", g, g)
    inner = np.einsum("eai,ebi->eab", g, g)
    parts = L * outer + G * outer.transpose(0, 3, 2, 1, 4) + G * np.einsum("eab,ij->eaibj", inner, np.eye(d))
    return _assemble(volume[:, None, None, None, None] * parts, elements, len(points))


def mass(points: ArrayLike, elements: ArrayLike, material: Material, lumped: bool = True) -> Sparse:
    """Return the mass matrix M, csr (n D, n D) kg, lumped or consistent.

    Lumped, each element's mass m is shared equally by its corners, and M is diagonal. Consistent with linear shape
    functions, the entry of corners a and b of k is m (1 + [a = b]) / (k (k + 1)).
    """
    points, elements = _structure(points, elements)
    k, d = elements.shape[1], points.shape[1]
    kg = contents(points, elements) * material.section(k) * material.density
    share = np.eye(k) / k if lumped else (1 + np.eye(k)) / (k * (k + 1))
    found = _assemble(np.einsum("e,ab,ij->eaibj", kg, share, np.eye(d)), elements, len(points))
    found.eliminate_zeros()
    return found


def rayleigh(M: Sparse, K: Sparse, alpha: float, beta: float) -> Sparse:
    """Return C = alpha M + beta K, kg/s: a mode of frequency w is damped by the ratio alpha / (2 w) + beta w / 2.

    alpha: 1/s, for slow modes and rigid motions; beta: s, for fast modes. Raises ValueError if one is negative.
    Source: Rayleigh, The Theory of Sound, 1877, 102.
    """
    for name, value in (("alpha", alpha), ("beta", beta)):
        if not 0 <= value < math.inf:
            raise ValueError(f"{name} = {value!r}: must be a number >= 0; a negative one would add energy")
    return alpha * M + beta * K


def solve_static(K: Sparse, F: ArrayLike, fixed: ArrayLike) -> Floats:
    """Return the displacements u, (n, D) m, with K u = F, and 0 at the fixed freedoms.

    F: (n, D) N; fixed: degrees of freedom (see `freedoms`). Raises ValueError if the structure, or a part of it, can
    move without resistance; the message names the particle that moves most.
    """
    force = np.asarray(F, float)
    if force.ndim != 2 or force.size != K.shape[0] or not np.isfinite(force).all():
        raise ValueError(f"F of shape {force.shape}: must be finite numbers (n, D), {K.shape[0]} in all")
    free = _free(K.shape[0], fixed)
    u = np.zeros(force.size)
    if len(free):
        soft, scale = _scale(K.tocsr()[free][:, free], free, force.shape[1])
        lu, mode = _factor(soft)
        if lu is None:
            _refuse_motion(free[np.argmax(np.abs(scale * mode))], force.shape[1])
        u[free] = scale * lu.solve(scale * force.ravel()[free])
    return u.reshape(force.shape)


def frequencies(K: Sparse, M: Sparse, fixed: ArrayLike = (), count: int | None = None) -> Floats:
    """Return the natural frequencies w, rad/s, ascending, with K u = w^2 M u; 0 for a rigid motion.

    fixed: degrees of freedom that are held; count: number of lowest frequencies (default: all, for up to DENSE
    freedoms). With more freedoms they are computed by inverse iteration (ARPACK). Raises ValueError if a freedom has no
    mass.
    """
    free = _free(K.shape[0], fixed)
    if count is not None and not 1 <= count <= len(free):
        raise ValueError(f"count = {count!r}: must be an integer from 1 to {len(free)} (those not fixed)")
    if len(free) > DENSE and (count is None or count > DENSE):
        raise ValueError(
            f"count = {count}: {len(free):,} degrees of freedom have too many frequencies; ask for up to {DENSE}"
        )
    K, M = (matrix.tocsr()[free][:, free].tocsc() for matrix in (K, M))
    empty = np.flatnonzero(M.diagonal() <= 0)
    if len(empty):
        raise ValueError(f"M: degree of freedom {free[empty[0]]} has no mass")
    squares = _lowest(K, M, count) if len(free) > DENSE else _all(K, M)[:count]
    greatest = float((K.diagonal() / M.diagonal()).max(initial=0.0))
    return np.sqrt(np.where(squares > STILL * greatest, squares, 0.0))


class Blocks(NamedTuple):
    """The stiffness blocks of each particle: those of particle i are start[i] to start[i + 1], partners ascending.

    F_i = -sum_j K_ij ((x_j - x_i) - (X_j - X_i)), which needs only relative positions of neighbours; x are the present
    positions, X those at rest.
    """

    start: NDArray[np.int64]  # (n + 1,)
    partner: Ints  # (P,) j
    block: Floats  # (P, D, D) N/m, K_ij
    way: Floats  # (P, D) m, X_j - X_i


def blocks(K: Sparse, points: ArrayLike) -> Blocks:
    """Return K as blocks per pair of partners, without its diagonal, which follows as rows sum to 0.

    points: (n, D) m, undeformed. Raises ValueError if rows of K do not sum to 0: a translation then needs a force, as
    with a support.
    """
    points = np.asarray(points, float)
    n, d = points.shape
    if K.shape != (n * d, n * d):
        raise ValueError(f"K of shape {K.shape}: {n} points in {d} dimensions need {(n * d, n * d)}")
    tied = K.tobsr((d, d))
    tied.sort_indices()
    row, column = np.repeat(np.arange(n), np.diff(tied.indptr)), tied.indices
    shift, size = np.zeros((n, d, d)), np.zeros((n, d, d))
    np.add.at(shift, row, tied.data)
    np.add.at(size, row, np.abs(tied.data))
    held = np.flatnonzero(np.abs(shift).max(axis=(1, 2)) > 1e-9 * size.max(axis=(1, 2)))
    if len(held):
        raise ValueError(f"K: the rows of particle {held[0]} do not sum to zero: something holds it to the ground")
    kept = (row != column) & tied.data.any(axis=(1, 2))
    row, column = row[kept], column[kept]
    start = np.searchsorted(row, np.arange(n + 1)).astype(np.int64)
    return Blocks(start, column.astype(np.int32), np.ascontiguousarray(tied.data[kept]), points[column] - points[row])


# --- one element ----------------------------------------------------------------------------------------------------


def _edges(points: Floats, elements: NDArray[Any]) -> Floats:
    """Return the vectors from each element's first corner to its others, (E, k - 1, D) m."""
    corners = points[elements]
    return np.asarray(corners[:, 1:] - corners[:, :1])


def _gradients(points: Floats, elements: NDArray[Any]) -> Floats:
    """Return the gradients of each element's shape functions, (E, k, D) 1/m; those of a bar are along it."""
    edges = _edges(points, elements)
    if elements.shape[1] == 2:
        others = edges / np.square(edges).sum(axis=2, keepdims=True)
    else:
        others = np.linalg.inv(edges).transpose(0, 2, 1)
    return np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)


def _structure(points: ArrayLike, elements: ArrayLike) -> tuple[Floats, NDArray[np.int64]]:
    """Return points and elements as arrays; raise ValueError, in one line, if they are not a valid structure."""
    X, who = np.asarray(points, float), np.asarray(elements)
    if X.ndim != 2 or X.shape[1] not in (1, 2, 3) or not np.isfinite(X).all():
        raise ValueError(f"points of shape {X.shape}: must be finite numbers (n, D), D from 1 to 3")
    if who.ndim != 2 or not np.issubdtype(who.dtype, np.integer):
        raise ValueError(f"elements of shape {who.shape}, {who.dtype}: must be integers (E, k)")
    if who.shape[1] not in (2, X.shape[1] + 1):
        allowed = {1: "2 (bars)", 2: "2 (bars) or 3 (triangles)", 3: "2 (bars) or 4 (tetrahedra)"}[X.shape[1]]
        raise ValueError(f"elements of {who.shape[1]} corners: in {X.shape[1]} dimensions k must be {allowed}")
    outside = np.flatnonzero(((who < 0) | (who >= len(X))).any(axis=1))
    if len(outside):
        first = outside[0]
        raise ValueError(f"elements[{first}] = {_row(who[first])}: particles are numbered 0 to {len(X) - 1}")
    thin = flat(X, who)
    if len(thin):
        what = {2: "length", 3: "area", 4: "volume"}[who.shape[1]]
        raise ValueError(f"elements[{thin[0]}] = {_row(who[thin[0]])}: it has no {what}")
    return X, who.astype(np.int64)


def _row(row: NDArray[Any]) -> tuple[int, ...]:
    return tuple(int(i) for i in row)


def _assemble(parts: Floats, elements: NDArray[np.int64], count: int) -> Sparse:
    """Return the sum over elements of their matrices (E, k, D, k, D) as csr (n D, n D)."""
    from scipy import sparse  # slow to import, and used only by finite elements

    _, k, d, _, _ = parts.shape
    freedom = (elements[:, :, None] * d + np.arange(d)).reshape(-1, k * d)
    row, column = np.repeat(freedom, k * d, axis=1), np.tile(freedom, (1, k * d))
    entries = (parts.ravel(), (row.ravel(), column.ravel()))
    return sparse.coo_array(entries, shape=(count * d, count * d)).tocsr()


# --- the whole structure --------------------------------------------------------------------------------------------


def _free(count: int, fixed: ArrayLike) -> NDArray[np.intp]:
    """Return the degrees of freedom that are not fixed; raise TypeError or ValueError on invalid ones."""
    held = np.asarray(fixed)
    if held.size and not np.issubdtype(held.dtype, np.integer):
        raise TypeError(f"fixed of {held.dtype}: must be degrees of freedom, integers from 0 to {count - 1}")
    outside = held[(held < 0) | (held >= count)]
    if outside.size:
        raise ValueError(f"fixed: {outside[0]} is no degree of freedom; they are 0 to {count - 1}")
    free = np.ones(count, bool)
    free[held.astype(np.intp).ravel()] = False
    return np.flatnonzero(free)


def _scale(K: Sparse, free: NDArray[np.intp], dimension: int) -> tuple[Sparse, Floats]:
    """Return K, csc, with each particle's stiffest axis scaled to 1, and the scale of each freedom.

    Thick and thin parts are then comparable, and an axis that is stiff only by rounding is still detected.
    """
    from scipy import sparse

    own = K.diagonal()
    if (own <= 0).any():
        _refuse_motion(free[np.argmin(own)], dimension)
    particle = free // dimension
    stiffest = np.zeros(particle[-1] + 1)
    np.maximum.at(stiffest, particle, own)
    scale = 1 / np.sqrt(stiffest[particle])
    return (sparse.diags_array(scale) @ K @ sparse.diags_array(scale)).tocsc(), scale


def _factor(K: Sparse) -> tuple[Any, Floats]:
    """Return the factors of a scaled K, or None if it allows a rigid motion, and its softest mode.

    The mode is computed by inverse iteration, which multiplies it by the reciprocal of its eigenvalue.
    """
    from scipy import sparse

    try:
        lu, singular = _lu(K), False
    except RuntimeError:  # a pivot is exactly zero
        lu, singular = _lu(K + SOFTEST * sparse.eye_array(K.shape[0], format="csc")), True
    mode, growth = np.random.default_rng(0).normal(size=K.shape[0]), 0.0
    for _ in range(3):
        mode = lu.solve(mode / np.linalg.norm(mode))
        growth = float(np.linalg.norm(mode))
    rigid = singular or not growth < 1 / SOFTEST
    return (None if rigid else lu), np.nan_to_num(mode)


def _lu(A: Sparse) -> Any:
    """Return the LU factors of a positive semidefinite matrix, csc, without pivoting, which would cause fill-in."""
    from scipy.sparse.linalg import splu

    return splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _refuse_motion(freedom: int, dimension: int) -> None:
    particle, axis = divmod(int(freedom), dimension)
    raise ValueError(
        f"the structure can move without resistance, particle {particle} along {'xyz'[axis]} most: fix more degrees of "
        "freedom"
    )


def _all(K: Sparse, M: Sparse) -> Floats:
    """Return the squares of all frequencies, ascending, from full matrices."""
    from scipy.linalg import eigh

    if not K.shape[0]:
        return np.zeros(0)
    return np.asarray(eigh(K.toarray(), M.toarray(), eigvals_only=True))


def _lowest(K: Sparse, M: Sparse, count: int | None) -> Floats:
    """Return the squares of the lowest frequencies, ascending, with a shift below 0, as K may be singular."""
    from scipy.sparse.linalg import LinearOperator, eigsh

    shift = -1e-9 * float(K.diagonal().sum() / M.diagonal().sum())
    inverse = LinearOperator(K.shape, matvec=_lu((K - shift * M).tocsc()).solve, dtype=float)
    start = np.random.default_rng(0).normal(size=K.shape[0])
    return np.sort(eigsh(K, k=count, M=M, sigma=shift, OPinv=inverse, v0=start, return_eigenvectors=False))
