"""Linear equations of a step and their assembly: stencils of effects add their derivatives to a sparse matrix.

The matrix A = M - h dF/dv - h^2 dF/dx has a block of D x D numbers for each pair of agents that depend on each other,
row after row (block compressed sparse rows).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import Law
from flockenv.jit.intrinsics import unaliased
from flockenv.jit.section import entry_of, section
from flockenv.maths.approximations import round_half_even

__all__ = ["FIXED", "FREE", "SLIDES", "Local", "System", "assemble_of", "strain_change_of"]

FREE, FIXED, SLIDES = 0, 1, 2
"""Kinds of filters of an agent: none; its velocity is prescribed; a projection onto a line or a plane."""


class System(NamedTuple):
    """The linear equations A dv = b of N agents with K blocks, and scratch memory."""

    start: Any  # (N + 1,) int32, first block of each row
    column: Any  # (K,) int32
    diagonal: Any  # (N,) int32, block of each row on the diagonal
    value: Any  # (K D D,)
    filtered: Any  # (K D D,) S A S + 1 - S with the filter S; on and below the diagonal
    right: Any  # (N D,) kg m/s, the right-hand side b
    filter: Any  # (N,) FREE, FIXED or SLIDES
    projection: Any  # (N D D,) of agents that slide
    inverse: Any  # (N D D,) of the blocks on the diagonal
    change: Any  # (N D,) m/s, the solution dv
    residual: Any  # (N D,) this and the next five: see `_descend`
    weighted: Any  # (N D,) D times the residual
    direction: Any  # (N D,)
    step: Any  # (N D,) the direction of dv
    image: Any  # (N D,) of the direction
    carried: Any  # (N D,) L times a part of the image


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
        living, first = True, np.uint64(agent[s, 0])
        for p in range(nodes):
            i = np.uint64(agent[s, p])
            living = living and alive[i]
            for k in range(d):
                off = x[k, i] - x[k, first]
                if period[k] > 0:
                    off -= period[k] * round_half_even(off / period[k])
                local.at[p, k], local.vel[p, k] = off, v[k, i]
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
        unaliased()
        for s in range(agent.shape[0]):
            if gather(x, v, alive, agent, s, period, local):
                derivative(local, number, s)
                for p in range(nodes):
                    row = np.uint64(agent[s, p]) * np.uint64(d)
                    for a in range(d):
                        total = 0.0
                        for q in range(nodes):
                            for c in range(d):
                                total += local.by_position[p * d + a, q * d + c] * local.vel[q, c]
                        system.right[row + np.uint64(a)] += along * total
                    for q in range(nodes):
                        base = np.uint64(block[s, p, q]) * np.uint64(d * d)
                        for a in range(d):
                            for c in range(d):
                                slope = by_x * local.by_position[p * d + a, q * d + c]
                                damp = by_v * local.by_velocity[p * d + a, q * d + c]
                                system.value[base + np.uint64(a * d + c)] += slope + damp

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
