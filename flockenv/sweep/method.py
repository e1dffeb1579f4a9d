"""The integrator's method, copied as text, and what it asks of the scene: its numbers, drags, errors and counts."""

from __future__ import annotations

import builtins
import inspect

from flockenv.integrators.base import PROVIDED, SUBSTEPS
from flockenv.kernels import python_of
from flockenv.sweep.accelerate import parameters
from flockenv.sweep.handed import OPEN_CONTEXT
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import indented, needed

__all__ = ["method", "method_imports"]


def method_imports(parts: Parts) -> str:
    """Import the integrator's `move`, or what its `advance` calls in its own module."""
    if parts.one_stage:
        return f"from {type(parts.integrator).__module__} import move"
    python = python_of(parts.integrator.advance())
    names = [name for name in python.__code__.co_names if name in python.__globals__]
    names = [name for name in names if name not in PROVIDED and name not in (*dir(builtins), "np")]
    return f"from {python.__module__} import {', '.join(names)}" if names else "# the method needs nothing else"


def method(parts: Parts) -> str:
    """Return the text of the integrator's `advance` with this scene's `accelerate` in the place of its argument.

    (numba can pass a compiled function as an argument, but does not cache a function that does.)
    """
    python = python_of(parts.integrator.advance())
    text = inspect.getsource(python)
    text = text[text.index("def advance(") :].replace("acceleration: Any, ", "", 1)
    for annotation in (": Any", ": float", ": int"):
        text = text.replace(annotation, "")
    writers = {"damping": _damping, "largest": _largest, "counted": _counted}
    asked = [writers[name](parts) for name in sorted(PROVIDED & set(python.__code__.co_names)) if name in writers]
    return (
        "".join(asked)
        + "\n@kernel\n"
        + text.replace("acceleration(", "accelerate(").replace("settings(context)", "context.numbers.method")
    )


def _damping(parts: Parts) -> str:
    """Write the sum of all linear drags."""
    rates = [f"p{k}.{e.linear_drag}" for k, e in enumerate(parts.effects) if e.linear_drag]
    d, w = parts.dimension, parts.width
    return f'''
@kernel
def damping(context, rate, begin, until):
    """The sum of all linear drags of every coordinate, 1/s."""
    {OPEN_CONTEXT}
{indented(needed(parameters(parts, "context.numbers"), rates), 4)}
    c = {" + ".join(rates) or "like(mass[0], 0.0)"}
    for block in range(np.uint64(begin // {d * w}), np.uint64(until // {d * w})):
        base, row = block * np.uint64({d * w}), block * np.uint64({w})
        for l in range(np.uint64({w})):
            share = c / mass[row + l]
{indented([f"rate[base + np.uint64({k * w}) + l] = share" for k in range(d)], 12)}


'''


def _largest(parts: Parts) -> str:
    """Write how the agent is found of whom some squares have the largest sum."""
    d, w = parts.dimension, parts.width
    return f'''
@kernel
def largest(context, squares, begin, until):
    """The largest sum of an agent's coordinates, NaN if one is, and where the first of that agent lies."""
    worst, where = like(squares[0], -1.0), np.uint64(begin)
    for block in range(np.uint64(begin // {d * w}), np.uint64(until // {d * w})):
        base = block * np.uint64({d * w})
        for lane in range({w}):  # one after the other: no loop over lanes
            l = np.uint64(lane)
            found = {" + ".join(f"squares[base + np.uint64({k * w}) + l]" for k in range(d))}
            more = (worst == worst) & ((found > worst) | (found != found))  # the first NaN stays
            worst, where = found if more else worst, base + l if more else where
    return worst, where


'''


def _counted(parts: Parts) -> str:
    """Write how steps are counted."""
    return f'''
@kernel
def counted(context, accepted, rejected):
    """Count steps of the method's own."""
    {OPEN_CONTEXT}
    work[b, {SUBSTEPS}] += accepted
    work[b, {SUBSTEPS + 1}] += rejected


'''
