"""Kernels of a linearly implicit step: the matrix in block compressed sparse rows, and conjugate gradients.

The matrix A = M - h dF/dv - h^2 dF/dx has a block of D x D numbers for each pair of agents that depend on each other,
row after row. A filter S projects the velocity change of each agent onto the directions in which it may move. One
thread solves one world, in float64, and sums in one order: results do not depend on threads or batches.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import Law, kernel
from flockenv.jit.section import entry_of, section
from flockenv.maths.approximations import round_half_even

__all__ = [
    "FIXED", "FREE", "SLIDES", "Local", "System", "assemble_of", "image_of", "size_of", "solve_from_of", "solve_of",
    "strain_change_of",
]  # fmt: skip

FREE, FIXED, SLIDES = 0, 1, 2
"""Kinds of filters of an agent: none; its velocity is prescribed; a projection onto a line or a plane."""


class System(NamedTuple):
    """The linear equations A dv = b of N agents with K blocks, and scratch memory."""

    start: Any  # (N + 1,) int32, first block of each row
    column: Any  # (K,) int32
    diagonal: Any  # (N,) int32, block of each row on the diagonal
    value: Any  # (K D D,)
    right: Any  # (N D,) kg m/s, the right-hand side b
    filter: Any  # (N,) FREE, FIXED or SLIDES
    projection: Any  # (N D D,) of agents that slide
    inverse: Any  # (N D D,) of the blocks on the diagonal
    change: Any  # (N D,) m/s, the solution dv
    residual: Any  # (N D,)
    direction: Any  # (N D,)
    image: Any  # (N D,) A times the direction
    scaled: Any  # (N D,) the residual times the inverse


class Local(NamedTuple):
    """Scratch memory of one stencil of P agents."""

    at: Any  # (P, D) m, from the first agent
    vel: Any  # (P, D) m/s
    by_position: Any  # (P D, P D) N/m, dF/dx
    by_velocity: Any  # (P D, P D) kg/s, dF/dv


@section
def _gather(dimension: int, nodes: int) -> Callable[..., bool]:
    """Make `gather(x, v, alive, agent, s, period, local)`: copy a stencil's motion; return True if all are alive."""
    d = dimension

    def gather(x: Any, v: Any, alive: Any, agent: Any, s: Any, period: Any, local: Any) -> Any:
        living = True
        for p in range(nodes):
            living = living and alive[agent[s, p]]
            for k in range(d):
                off = x[k, agent[s, p]] - x[k, agent[s, 0]]
                if period[k] > 0:
                    off -= period[k] * round_half_even(off / period[k])
                local.at[p, k], local.vel[p, k] = off, v[k, agent[s, p]]
        return living

    return gather


@entry_of
def assemble_of(derivative: Law, dimension: int, nodes: int) -> Callable[..., None]:
    """Make `assemble(...)`: add wx dF/dx + wv dF/dv of the stencils of an effect to A, and w dF/dx v to b.

    Arguments: x, v (D, N); alive (N,); agent (S, P), number (S, C) and block (S, P, P) of the stencils; period (D,) m,
    0 = not periodic; the three weights; system; local.
    """
    gather, d = _gather(dimension, nodes), dimension

    def assemble(
        x: Any, v: Any, alive: Any, agent: Any, number: Any, block: Any, period: Any, by_x: float, by_v: float,
        along: float, system: Any, local: Any,
    ) -> None:  # fmt: skip
        for s in range(agent.shape[0]):
            if gather(x, v, alive, agent, s, period, local):
                derivative(local, number, s)
                for p in range(nodes):
                    for q in range(nodes):
                        base = block[s, p, q] * (d * d)
                        for a in range(d):
                            total = 0.0
                            for c in range(d):
                                slope = local.by_position[p * d + a, q * d + c]
                                damp = local.by_velocity[p * d + a, q * d + c]
                                system.value[base + a * d + c] += by_x * slope + by_v * damp
                                total += slope * local.vel[q, c]
                            system.right[agent[s, p] * d + a] += along * total

    return assemble


@entry_of
def strain_change_of(strain: Law, dimension: int, nodes: int) -> Callable[..., tuple[float, int]]:
    """Make `strain_change(x, y, v, alive, agent, number, period, local)`: the largest change from positions x to y.

    It returns the change and the first agent of the stencil that has it, or 0 and -1. Arguments as for `assemble_of`.
    """
    gather = _gather(dimension, nodes)

    def strain_change(
        x: Any, y: Any, v: Any, alive: Any, agent: Any, number: Any, period: Any, local: Any
    ) -> tuple[float, int]:
        most, where = 0.0, -1
        for s in range(agent.shape[0]):
            if gather(x, v, alive, agent, s, period, local):
                one, two = strain(local, number, s)
                gather(y, v, alive, agent, s, period, local)
                then_one, then_two = strain(local, number, s)
                change = max(abs(then_one - one), abs(then_two - two))
                if change > most:
                    most, where = change, agent[s, 0]
        return most, where

    return strain_change


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
            out[to] = block[at] * x + block[at + 1] * y + block[at + 2] * z
            out[to + 1] = block[at + 3] * x + block[at + 4] * y + block[at + 5] * z
            out[to + 2] = block[at + 6] * x + block[at + 7] * y + block[at + 8] * z

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
def _multiply(dimension: int) -> Callable[..., None]:
    """Make `multiply(system)`: write A times the direction into `image`."""

    def multiply(system: Any) -> None:
        value, column, vector, image = system.value, system.column, system.direction, system.image
        for i in range(system.start.shape[0] - 1):
            first, second, third = 0.0, 0.0, 0.0
            for k in range(np.uint64(system.start[i]), np.uint64(system.start[i + 1])):
                if dimension == 2:
                    to, at = np.uint64(column[k]) * np.uint64(2), k * np.uint64(4)
                    x, y = vector[to], vector[to + np.uint64(1)]
                    first += value[at] * x + value[at + np.uint64(1)] * y
                    second += value[at + np.uint64(2)] * x + value[at + np.uint64(3)] * y
                else:
                    to, at = np.uint64(column[k]) * np.uint64(3), k * np.uint64(9)
                    x, y, z = vector[to], vector[to + np.uint64(1)], vector[to + np.uint64(2)]
                    first += value[at] * x + (value[at + np.uint64(1)] * y + value[at + np.uint64(2)] * z)
                    second += value[at + np.uint64(3)] * x + (
                        value[at + np.uint64(4)] * y + value[at + np.uint64(5)] * z
                    )
                    third += value[at + np.uint64(6)] * x + (
                        value[at + np.uint64(7)] * y + value[at + np.uint64(8)] * z
                    )
            image[i * dimension], image[i * dimension + 1] = first, second
            if dimension == 3:
                image[i * dimension + 2] = third

    return multiply


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
def _begin(dimension: int) -> Callable[..., None]:
    """Make `begin(system)`: invert the diagonal, solve agents that depend on no other, and set the first residual."""
    invert, project, apply_blocks, d = _invert(dimension), _project(dimension), _apply_blocks(dimension), dimension

    def begin(system: Any) -> None:
        for i in range(system.start.shape[0] - 1):
            invert(system.value, system.diagonal[i] * (d * d), system.inverse, i * (d * d))
            for k in range(d):
                system.residual[i * d + k], system.change[i * d + k] = system.right[i * d + k], 0.0
            project(system, system.residual, i)
            apply_blocks(system.inverse, system.residual, system.direction, i)
            project(system, system.direction, i)
            alone = system.start[i + 1] - system.start[i] == 1
            for k in range(d):
                if alone and system.filter[i] != SLIDES:
                    system.change[i * d + k] = system.direction[i * d + k]
                    system.residual[i * d + k] = system.direction[i * d + k] = 0.0

    return begin


@entry_of
def size_of(dimension: int) -> Callable[..., float]:
    """Make `size(system)`: invert the diagonal; return the square of the norm of the residual of dv = 0."""
    invert, project, apply_blocks, d = _invert(dimension), _project(dimension), _apply_blocks(dimension), dimension

    def size(system: Any) -> float:
        for i in range(system.start.shape[0] - 1):
            invert(system.value, system.diagonal[i] * (d * d), system.inverse, i * (d * d))
            for k in range(d):
                system.residual[i * d + k] = system.right[i * d + k]
            project(system, system.residual, i)
            apply_blocks(system.inverse, system.residual, system.direction, i)
        return _dot(system.residual, system.direction)

    return size


@entry_of
def image_of(dimension: int) -> Callable[..., None]:
    """Make `image(system)`: write A dv into `image`."""
    multiply = _multiply(dimension)

    def image(system: Any) -> None:
        for k in range(system.right.shape[0]):
            system.direction[k] = system.change[k]
        multiply(system)

    return image


@section
def _descend(dimension: int) -> Callable[..., tuple[int, float]]:
    """Make `descend(system, first, now, tolerance, most)`: iterate until the norm is `tolerance` times the first.

    first, now: squares of norms, the first and that of the residual.
    """
    multiply, project, apply_blocks = _multiply(dimension), _project(dimension), _apply_blocks(dimension)

    def descend(system: Any, first: float, now: float, tolerance: float, most: int) -> tuple[int, float]:
        count, size = system.start.shape[0] - 1, system.right.shape[0]
        iterations = 0
        while now > tolerance * tolerance * first and iterations < most:
            iterations += 1
            multiply(system)
            for i in range(count):
                project(system, system.image, i)
            by = now / _dot(system.direction, system.image)
            for k in range(np.uint64(size)):
                system.change[k] += by * system.direction[k]
                system.residual[k] -= by * system.image[k]
            for i in range(count):
                apply_blocks(system.inverse, system.residual, system.scaled, i)
                project(system, system.scaled, i)
            before, now = now, _dot(system.residual, system.scaled)
            share = now / before
            for k in range(np.uint64(size)):
                system.direction[k] = system.scaled[k] + share * system.direction[k]
        return iterations, np.sqrt(now / first) if first != 0 else 0.0

    return descend


@entry_of
def solve_from_of(dimension: int) -> Callable[..., tuple[int, float]]:
    """Make `solve_from(system, first, tolerance, most)`: as `solve`, from the change that `system` holds.

    The change must agree with what the filter prescribes; components that the filter removes stay as they are. This is
    the modified method of Baraff and Witkin 1998, with the start of Ascher and Boxerman 2003. `size` must have been
    called, and `first` is its result; if the residual of the start is larger, the criterion is relative to that.
    """
    multiply, project, apply_blocks = _multiply(dimension), _project(dimension), _apply_blocks(dimension)
    descend = _descend(dimension)

    def solve_from(system: Any, first: float, tolerance: float, most: int) -> tuple[int, float]:
        for k in range(system.right.shape[0]):
            system.direction[k] = system.change[k]
        multiply(system)
        for k in range(system.right.shape[0]):
            system.residual[k] = system.right[k] - system.image[k]
        for i in range(system.start.shape[0] - 1):
            project(system, system.residual, i)
            apply_blocks(system.inverse, system.residual, system.direction, i)
            project(system, system.direction, i)
        now = _dot(system.residual, system.direction)
        return descend(system, max(first, now), now, tolerance, most)  # type: ignore[no-any-return]

    return solve_from


@entry_of
def solve_of(dimension: int) -> Callable[..., tuple[int, float]]:
    """Make `solve(system, tolerance, most)`: write dv by filtered, preconditioned conjugate gradients.

    It returns the number of iterations and the norm of the residual relative to the first one, in the norm r . P r of
    the preconditioner P, the inverse blocks on the diagonal. The filter and the criterion are those of Baraff and
    Witkin 1998, section 5.3. An iteration that finds a direction without curvature ends it: the relative norm is NaN.
    """
    begin, descend = _begin(dimension), _descend(dimension)

    def solve(system: Any, tolerance: float, most: int) -> tuple[int, float]:
        begin(system)
        first = _dot(system.residual, system.direction)
        return descend(system, first, first, tolerance, most)  # type: ignore[no-any-return]

    return solve
