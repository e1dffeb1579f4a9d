"""The integrator's method as a section of a scene: its `advance`, with functions that know the memory layout."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.engine.kernel_plan import KernelPlan
from flockenv.jit.decorators import kernel, like
from flockenv.jit.section import section
from flockenv.physics.integrators.integrator import SUBSTEPS, Method, Provided

__all__ = ["MethodPlan", "advance_of", "method_plan"]


class MethodPlan(NamedTuple):
    """Constants of the functions that are passed to a method."""

    dimension: int
    width: int
    drags: tuple[tuple[int, int], ...]  # linear drags, kg/s: (effect, index among its numbers)


def method_plan(parts: KernelPlan) -> MethodPlan:
    """Return the `MethodPlan` of a scene."""
    drags = tuple((k, parts.names_of(e).index(e.linear_drag)) for k, e in enumerate(parts.effects) if e.linear_drag)
    return MethodPlan(parts.dimension, parts.width, drags)


@functools.cache
def advance_of(method: Callable[[Provided], Method], plan: MethodPlan) -> Callable[[Any], Method]:
    """Make `advance_of(accelerate)`: the compiled `advance` of a method, for a scene with this `accelerate`.

    numba caches no function that takes a compiled one as an argument, so `advance` holds it.
    """
    damping, largest = _damping(plan), _largest(plan.dimension, plan.width)

    def advance_of(accelerate: Any) -> Method:
        made: Method = kernel(method(Provided(accelerate, _settings, damping, largest, _count_substeps)))
        return made

    return advance_of


@kernel
def _settings(context: Any) -> Any:
    """Return the numbers of the method."""
    return context.numbers.method


@kernel
def _count_substeps(context: Any, accepted: Any, rejected: Any) -> None:
    """Count the accepted and rejected substeps of the method."""
    context.work[context.b, SUBSTEPS] += accepted
    context.work[context.b, SUBSTEPS + 1] += rejected


@section
def _damping(plan: MethodPlan) -> Callable[..., None]:
    """Make `damping(context, rate, first, end)`: write the total linear drag by mass of every coordinate, 1/s."""
    total, dimension, width = _drag(plan.drags), plan.dimension, plan.width
    lanes, size = np.uint64(width), dimension * width

    def damping(context: Any, rate: Any, first: Any, end: Any) -> None:
        mass = context.scratch.mass
        drag = total(context.numbers.effects, mass)
        for block in range(np.uint64(first // size), np.uint64(end // size)):
            base, row = block * np.uint64(size), block * lanes
            for lane in range(np.uint64(width)):
                share = drag / mass[row + lane]
                rate[base + lane] = share
                rate[base + lanes + lane] = share
                if dimension == 3:
                    rate[base + np.uint64(2) * lanes + lane] = share

    return damping


@section
def _drag(drags: tuple[tuple[int, int], ...]) -> Callable[[Any, Any], float]:
    """Make `drag(effects, mass)`: the sum of linear drags, kg/s, 0 if there is none."""
    if not drags:
        return lambda effects, mass: like(mass[0], 0.0)
    before = _drag(drags[:-1]) if drags[1:] else None
    k, place = drags[-1]

    def drag(effects: Any, mass: Any) -> Any:
        if before is None:
            return effects[k][place]
        return before(effects, mass) + effects[k][place]

    return drag


@section
def _largest(dimension: int, width: int) -> Callable[..., tuple[float, Any]]:
    """Make `largest(context, squares, first, end)`: the largest sum of an agent's coordinates, and its place.

    The sum is NaN if any is; the place is that of the agent's first coordinate.
    """
    lanes, size = np.uint64(width), dimension * width

    def largest(context: Any, squares: Any, first: Any, end: Any) -> Any:
        worst, where = like(squares[0], -1.0), np.uint64(first)
        for block in range(np.uint64(first // size), np.uint64(end // size)):
            base = block * np.uint64(size)
            for one in range(width):  # one after another: no loop over lanes
                place = base + np.uint64(one)
                found = squares[place] + squares[place + lanes]
                if dimension == 3:
                    found += squares[place + np.uint64(2) * lanes]
                more = (worst == worst) & ((found > worst) | (found != found))  # the first NaN stays
                worst, where = found if more else worst, place if more else where
        return worst, where

    return largest
