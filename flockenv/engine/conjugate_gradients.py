"""Solution of the linear equations of a step by filtered, preconditioned conjugate gradients.

A filter S projects the velocity change of each agent onto the directions in which it may move. One thread solves one
world, in float64, and sums in one order: results do not depend on threads or batches.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.linear_equations import FIXED, FREE, SLIDES
from flockenv.jit.decorators import kernel
from flockenv.jit.section import entry_of, section

__all__ = ["image_of", "keep_momentum_of", "size_of", "solve_from_of", "solve_of"]

ROUNDING = 1e-20
"""Largest negative square of a norm, relative to the first one, that rounding is taken to have caused."""


@section
def _invert(dimension: int) -> Callable[..., None]:
    """Make `invert(value, at, inverse, to)`: write the inverse of a symmetric positive definite block."""
    if dimension == 2:

        def invert_2(value: Any, at: Any, inverse: Any, to: Any) -> None:
            a, b, c = value[at], value[at + 1], value[at + 3]
            per = 1.0 / (a * c - b * b)
            inverse[to], inverse[to + 3] = c * per, a * per
            inverse[to + 1] = inverse[to + 2] = -b * per

        return invert_2

    def invert_3(value: Any, at: Any, inverse: Any, to: Any) -> None:
        a, b, c = value[at], value[at + 1], value[at + 2]
        e, f, g = value[at + 4], value[at + 5], value[at + 8]
        x, y, z = e * g - f * f, c * f - b * g, b * f - c * e
        per = 1.0 / (a * x + b * y + c * z)
        inverse[to], inverse[to + 4], inverse[to + 8] = x * per, (a * g - c * c) * per, (a * e - b * b) * per
        inverse[to + 1] = inverse[to + 3] = y * per
        inverse[to + 2] = inverse[to + 6] = z * per
        inverse[to + 5] = inverse[to + 7] = (b * c - a * f) * per

    return invert_3


@section
def _apply_blocks(dimension: int) -> Callable[..., None]:
    """Make `apply_blocks(block, vector, out, i)`: out_i = block_i vector_i, of agent i."""

    def apply_blocks(block: Any, vector: Any, out: Any, i: Any) -> None:
        if dimension == 2:
            to, at = i * 2, i * 4
            x, y = vector[to], vector[to + 1]
            out[to], out[to + 1] = block[at] * x + block[at + 1] * y, block[at + 2] * x + block[at + 3] * y
        else:
            to, at = i * 3, i * 9
            x, y, z = vector[to], vector[to + 1], vector[to + 2]
            out[to] = block[at] * x + (block[at + 1] * y + block[at + 2] * z)
            out[to + 1] = block[at + 3] * x + (block[at + 4] * y + block[at + 5] * z)
            out[to + 2] = block[at + 6] * x + (block[at + 7] * y + block[at + 8] * z)

    return apply_blocks


@section
def _project(dimension: int) -> Callable[..., None]:
    """Make `project(system, vector, i)`: apply the filter of agent i to its part of a vector, in place."""
    apply_blocks = _apply_blocks(dimension)

    def project(system: Any, vector: Any, i: Any) -> None:
        if system.filter[i] == FIXED:
            for k in range(dimension):
                vector[i * dimension + k] = 0.0
        elif system.filter[i] == SLIDES:
            apply_blocks(system.projection, vector, vector, i)

    return project


@section
def _add_row(dimension: int) -> Callable[..., tuple[float, float, float]]:
    """Make `add_row(value, column, vector, first, end)`: the sum of blocks [first, end) of a row times their parts."""

    def add_row(value: Any, column: Any, vector: Any, first: Any, end: Any) -> Any:
        a, b, c = 0.0, 0.0, 0.0
        for k in range(np.uint64(first), np.uint64(end)):
            if dimension == 2:
                to, at = np.uint64(column[k]) * np.uint64(2), k * np.uint64(4)
                x, y = vector[to], vector[to + np.uint64(1)]
                a += value[at] * x + value[at + np.uint64(1)] * y
                b += value[at + np.uint64(2)] * x + value[at + np.uint64(3)] * y
            else:
                to, at = np.uint64(column[k]) * np.uint64(3), k * np.uint64(9)
                x, y, z = vector[to], vector[to + np.uint64(1)], vector[to + np.uint64(2)]
                a += value[at] * x + (value[at + np.uint64(1)] * y + value[at + np.uint64(2)] * z)
                b += value[at + np.uint64(3)] * x + (value[at + np.uint64(4)] * y + value[at + np.uint64(5)] * z)
                c += value[at + np.uint64(6)] * x + (value[at + np.uint64(7)] * y + value[at + np.uint64(8)] * z)
        return a, b, c

    return add_row


@section
def _multiply(dimension: int) -> Callable[..., None]:
    """Make `multiply(system, vector, out)`: out = A vector, without the filter."""
    add_row, d = _add_row(dimension), dimension

    def multiply(system: Any, vector: Any, out: Any) -> None:
        for i in range(system.start.shape[0] - 1):
            a, b, c = add_row(system.value, system.column, vector, system.start[i], system.start[i + 1])
            out[i * d], out[i * d + 1] = a, b
            if d == 3:
                out[i * d + 2] = c

    return multiply


@section
def _project_block(dimension: int) -> Callable[..., None]:
    """Make `project_block(system, i, j, at)`: write P_i A_ij P_j with the projections P of two agents."""
    d = dimension

    def part(system: Any, i: Any, a: Any, b: Any) -> float:
        return system.projection[(i * d + a) * d + b] if system.filter[i] == SLIDES else 1.0 if a == b else 0.0

    part = kernel(part)

    def project_block(system: Any, i: Any, j: Any, at: Any) -> None:
        for a in range(d):
            for b in range(d):
                total = 0.0
                for r in range(d):
                    for q in range(d):
                        total += part(system, i, a, r) * system.value[at + r * d + q] * part(system, j, q, b)
                system.filtered[at + a * d + b] = total

    return project_block


@section
def _filter_blocks(dimension: int) -> Callable[..., None]:
    """Make `filter_blocks(system)`: write S A S + 1 - S on and below the diagonal, and the inverse of the diagonal."""
    invert, project_block, d = _invert(dimension), _project_block(dimension), dimension

    def filter_blocks(system: Any) -> None:
        value, filtered, kinds = system.value, system.filtered, system.filter
        for i in range(system.start.shape[0] - 1):
            for k in range(system.start[i], system.diagonal[i] + 1):
                j, at = system.column[k], k * (d * d)
                if kinds[i] == FIXED or kinds[j] == FIXED:
                    for a in range(d * d):
                        filtered[at + a] = 0.0
                elif kinds[i] == SLIDES or kinds[j] == SLIDES:
                    project_block(system, i, j, at)
                else:
                    for a in range(d * d):
                        filtered[at + a] = value[at + a]
            own = system.diagonal[i] * (d * d)
            if kinds[i] != FREE:
                for a in range(d):
                    filtered[own + a * d + a] += 1.0
            if kinds[i] == SLIDES:
                for a in range(d * d):
                    filtered[own + a] -= system.projection[i * d * d + a]
            invert(filtered, own, system.inverse, i * (d * d))

    return filter_blocks


@section
def _apply_inverse(dimension: int) -> Callable[..., None]:
    """Make `apply_inverse(system, vector, carried, out, i)`: out_i = (vector_i - carried_i) / D_i of agent i."""
    apply_blocks = _apply_blocks(dimension)

    def apply_inverse(system: Any, vector: Any, carried: Any, out: Any, i: Any) -> None:
        for k in range(i * dimension, (i + 1) * dimension):
            out[k] = vector[k] - carried[k]
        apply_blocks(system.inverse, out, out, i)

    return apply_inverse


@section
def _forward(dimension: int) -> Callable[..., None]:
    """Make `forward(system, vector, carried)`: solve (D + L) y = vector in place, and write carried = L y.

    D, L: the blocks of the filtered matrix on the diagonal and below it.
    """
    add_row, apply_inverse, d = _add_row(dimension), _apply_inverse(dimension), dimension

    def forward(system: Any, vector: Any, carried: Any) -> None:
        for i in range(system.start.shape[0] - 1):
            a, b, c = add_row(system.filtered, system.column, vector, system.start[i], system.diagonal[i])
            carried[i * d], carried[i * d + 1] = a, b
            if d == 3:
                carried[i * d + 2] = c
            apply_inverse(system, vector, carried, vector, i)

    return forward


@section
def _backward(dimension: int) -> Callable[..., None]:
    """Make `backward(system, vector, out, carried)`: solve (D + L') out = vector, and write carried = L' out.

    It reads the same blocks as `forward`, below the diagonal, which stay in the cache of the processor.
    """
    apply_inverse, d = _apply_inverse(dimension), dimension

    def backward(system: Any, vector: Any, out: Any, carried: Any) -> None:
        value, column, last = system.filtered, system.column, system.start.shape[0] - 2
        for k in range(carried.shape[0]):
            carried[k] = 0.0
        for back in range(last + 1):
            i = last - back
            apply_inverse(system, vector, carried, out, i)
            for k in range(np.uint64(system.start[i]), np.uint64(system.diagonal[i])):
                if d == 2:
                    x, y = out[i * 2], out[i * 2 + 1]
                    to, at = np.uint64(column[k]) * np.uint64(2), k * np.uint64(4)
                    carried[to] += value[at] * x + value[at + np.uint64(2)] * y
                    carried[to + np.uint64(1)] += value[at + np.uint64(1)] * x + value[at + np.uint64(3)] * y
                else:
                    x, y, z = out[i * 3], out[i * 3 + 1], out[i * 3 + 2]
                    to, at = np.uint64(column[k]) * np.uint64(3), k * np.uint64(9)
                    carried[to] += value[at] * x + (value[at + np.uint64(3)] * y + value[at + np.uint64(6)] * z)
                    carried[to + np.uint64(1)] += value[at + np.uint64(1)] * x + (
                        value[at + np.uint64(4)] * y + value[at + np.uint64(7)] * z
                    )
                    carried[to + np.uint64(2)] += value[at + np.uint64(2)] * x + (
                        value[at + np.uint64(5)] * y + value[at + np.uint64(8)] * z
                    )

    return backward


@kernel
def _dot(a: Any, b: Any) -> float:
    """Return a . b, in four running sums."""
    one, two, three, four = 0.0, 0.0, 0.0, 0.0
    whole = a.shape[0] // 4
    for part in range(np.uint64(whole)):
        k = part * np.uint64(4)
        one += a[k] * b[k]
        two += a[k + np.uint64(1)] * b[k + np.uint64(1)]
        three += a[k + np.uint64(2)] * b[k + np.uint64(2)]
        four += a[k + np.uint64(3)] * b[k + np.uint64(3)]
    for k in range(np.uint64(4 * whole), np.uint64(a.shape[0])):  # type: ignore[assignment]
        one += a[k] * b[k]
    return (one + two) + (three + four)


@section
def _set_residual(dimension: int) -> Callable[..., float]:
    """Make `set_residual(system)`: replace `residual` by (D + L)^-1 of its filtered part; return its squared norm.

    `weighted` becomes D times that. Agents that depend on no other are solved here, and have no residual.
    """
    project, apply_blocks, forward, d = _project(dimension), _apply_blocks(dimension), _forward(dimension), dimension

    def set_residual(system: Any) -> float:
        residual, weighted, size = system.residual, system.weighted, np.uint64(system.right.shape[0])
        for i in range(system.start.shape[0] - 1):
            project(system, residual, i)
            if system.start[i + 1] - system.start[i] == 1:
                apply_blocks(system.inverse, residual, system.step, i)
                for k in range(d):
                    system.change[i * d + k] += system.step[i * d + k]
                    residual[i * d + k] = 0.0
        for k in range(size):
            weighted[k] = residual[k]
        forward(system, residual, system.carried)
        for k in range(size):
            weighted[k] -= system.carried[k]
        return _dot(residual, weighted)

    return set_residual


@section
def _descend(dimension: int) -> Callable[..., tuple[int, float]]:
    """Make `descend(system, first, now, tolerance, most)`: iterate until the norm is `tolerance` times the first.

    first, now: squares of norms, the first and that of the residual.
    """
    forward, backward = _forward(dimension), _backward(dimension)

    def descend(system: Any, first: float, now: float, tolerance: float, most: int) -> tuple[int, float]:
        residual, weighted, direction, carried = system.residual, system.weighted, system.direction, system.carried
        change, step, image, size = system.change, system.step, system.image, np.uint64(system.right.shape[0])
        for k in range(size):
            direction[k] = weighted[k]
        iterations = 0
        while now > tolerance * tolerance * first and iterations < most:
            iterations += 1
            backward(system, direction, step, image)
            forward(system, image, carried)
            for k in range(size):
                image[k] += step[k]
            by = now / _dot(direction, image)
            for k in range(size):
                change[k] += by * step[k]
                residual[k] -= by * image[k]
                weighted[k] -= by * (direction[k] - carried[k])
            before, now = now, _dot(residual, weighted)
            if now < 0.0:  # by rounding, or because a block D is not positive definite
                now = 0.0 if now > -ROUNDING * first else np.nan
            share = now / before
            for k in range(size):
                direction[k] = weighted[k] + share * direction[k]
        return iterations, np.sqrt(now / first) if first != 0 else 0.0

    return descend


@section
def _begin(dimension: int) -> Callable[..., float]:
    """Make `begin(system)`: filter the matrix and set dv = 0; return the squared norm of the residual."""
    filter_blocks, set_residual = _filter_blocks(dimension), _set_residual(dimension)

    def begin(system: Any) -> float:
        filter_blocks(system)
        for k in range(np.uint64(system.right.shape[0])):
            system.residual[k], system.change[k] = system.right[k], 0.0
        return set_residual(system)  # type: ignore[no-any-return]

    return begin


@entry_of
def size_of(dimension: int) -> Callable[..., float]:
    """Make `size(system)`: return the square of the norm of the residual of dv = 0, with the filter of the system."""
    begin = _begin(dimension)

    def size(system: Any) -> float:
        return begin(system)  # type: ignore[no-any-return]

    return size


@entry_of
def image_of(dimension: int) -> Callable[..., None]:
    """Make `image(system)`: write A dv into `image`, without the filter."""
    multiply = _multiply(dimension)

    def image(system: Any) -> None:
        multiply(system, system.change, system.image)

    return image


@section
def _sum_parts(dimension: int) -> Callable[..., None]:
    """Make `sum_parts(system, part, matrix, pull)`: add up the blocks and the residual of the agents of each part."""
    d = dimension

    def sum_parts(system: Any, part: Any, matrix: Any, pull: Any) -> None:
        matrix[:], pull[:] = 0.0, 0.0
        for i in range(part.shape[0]):
            if part[i] >= 0:
                for a in range(d):
                    pull[part[i] * d + a] += system.right[i * d + a] - system.image[i * d + a]
                for k in range(system.start[i], system.start[i + 1]):
                    for a in range(d * d):
                        matrix[part[i] * d * d + a] += system.value[k * d * d + a]

    return sum_parts


@entry_of
def keep_momentum_of(dimension: int) -> Callable[..., None]:
    """Make `keep_momentum(system, part, matrix, inverse, pull)`: change dv by a velocity of each part as a whole.

    Afterwards the residuals of a part add up to 0: it gains the momentum that outer forces give it, however large the
    tolerance. part: (N,) number of the part that an agent belongs to, -1 if none; no filter acts on a part.
    matrix, inverse (P D D,), pull (P D,): scratch memory, for the sums of its blocks, their inverse, and the residual.
    """
    multiply, sum_parts, invert, d = _multiply(dimension), _sum_parts(dimension), _invert(dimension), dimension

    def keep_momentum(system: Any, part: Any, matrix: Any, inverse: Any, pull: Any) -> None:
        multiply(system, system.change, system.image)
        sum_parts(system, part, matrix, pull)
        for own in range(0, matrix.shape[0], d * d):
            if matrix[own] != 0.0:  # of a part that is not free in this step
                invert(matrix, own, inverse, own)
        for i in range(part.shape[0]):
            if part[i] >= 0:
                for a in range(d):
                    for b in range(d):
                        system.change[i * d + a] += inverse[(part[i] * d + a) * d + b] * pull[part[i] * d + b]

    return keep_momentum


@entry_of
def solve_from_of(dimension: int) -> Callable[..., tuple[int, float]]:
    """Make `solve_from(system, first, tolerance, most)`: as `solve`, from the change that `system` holds.

    The change must agree with what the filter prescribes; components that the filter removes stay as they are. This is
    the modified method of Baraff and Witkin 1998, with the start of Ascher and Boxerman 2003. first: a result of
    `size` or `solve`; if the residual of the start is larger, the criterion is relative to that.
    """
    filter_blocks, set_residual = _filter_blocks(dimension), _set_residual(dimension)
    multiply, descend = _multiply(dimension), _descend(dimension)

    def solve_from(system: Any, first: float, tolerance: float, most: int) -> tuple[int, float]:
        filter_blocks(system)
        multiply(system, system.change, system.image)
        for k in range(np.uint64(system.right.shape[0])):
            system.residual[k] = system.right[k] - system.image[k]
        now = set_residual(system)
        return descend(system, max(first, now), now, tolerance, most)  # type: ignore[no-any-return]

    return solve_from


@entry_of
def solve_of(dimension: int) -> Callable[..., tuple[int, float, float]]:
    """Make `solve(system, tolerance, most)`: write dv by filtered, preconditioned conjugate gradients.

    It returns the number of iterations, the norm of the residual relative to that of dv = 0, in the norm r . P r of the
    preconditioner P, and the square of the latter. The filter and the criterion are those of Baraff and Witkin 1998,
    section 5.3. P is symmetric Gauss-Seidel: the inverse of (D + L) D^-1 (D + L'), with the blocks D on the diagonal of
    A and L below it. In the form of Eisenstat 1981 the equations are those of (D + L') dv, multiplied by (D + L)^-1: an
    iteration then costs a backward and a forward substitution, as much as a product with A. An iteration that finds a
    direction without curvature ends it: the relative norm is NaN.
    """
    begin, descend = _begin(dimension), _descend(dimension)

    def solve(system: Any, tolerance: float, most: int) -> tuple[int, float, float]:
        first = begin(system)
        iterations, left = descend(system, first, first, tolerance, most)
        return iterations, left, first

    return solve
