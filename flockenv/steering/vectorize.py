"""Application of a law of one agent to arrays of agents.

`rows(seek)(offset, velocity, max_speed)` takes arrays (..., D) for vectors, (...) or a number for numbers, and (..., K,
D) for a tuple of K forces; leading shapes broadcast. Its result has a row for each. Hand-written players thus call the
same laws as the simulator.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.jit.decorators import Law, Vec, kernel, python_of
from flockenv.jit.section import entry_of, read_several

__all__ = ["loop_of", "rows"]

_RANK = {"Vec": 1, "Numbers": 1, "Forces": 2, "float": 0}


@functools.lru_cache(maxsize=256)
def rows(law: Law) -> Callable[..., NDArray[np.float64]]:
    """Return a function that applies a law to arrays, in float64; it is compiled once per law and shape of vector.

    Raises TypeError for a law whose annotations do not distinguish numbers, vectors and tuples of vectors.
    """
    python: Any = python_of(law)
    parameters = inspect.signature(python).parameters
    ranks = tuple(_rank(python, name, p.annotation) for name, p in parameters.items())
    any_length = {name for name, p in parameters.items() if name == "weights" or str(p.annotation) == "Numbers"}
    answer = _rank(python, "return", inspect.signature(python).return_annotation)

    @functools.wraps(python)
    def over_rows(*arguments: Any) -> NDArray[np.float64]:
        if len(arguments) != len(ranks):
            raise TypeError(f"{python.__name__} takes {len(ranks)} arguments ({', '.join(parameters)})")
        arrays = [np.asarray(a, np.float64) for a in arguments]
        for name, array, rank in zip(parameters, arrays, ranks, strict=True):
            if array.ndim < rank or (rank and array.shape[-1] not in (2, 3) and name not in any_length):
                expected = "(..., K, D)" if rank == 2 else "(..., D)"
                raise ValueError(f"{python.__name__}: {name} has shape {array.shape}, expected {expected}")
        tails = tuple(a.shape[a.ndim - r :] for a, r in zip(arrays, ranks, strict=True))
        leads = {a.shape[: a.ndim - r] for a, r in zip(arrays, ranks, strict=True)}
        lead = leads.pop() if len(leads) == 1 else np.broadcast_shapes(*leads)
        flat = [_in_rows(a, lead, t) for a, t in zip(arrays, tails, strict=True)]
        dimensions = {
            t[-1] for t, r, name in zip(tails, ranks, parameters, strict=True) if r and name not in any_length
        }
        if len(dimensions) > 1:
            raise ValueError(
                f"{python.__name__}: vectors of {' and of '.join(map(str, sorted(dimensions)))} numbers; "
                "all must have the same number"
            )
        dimension = max(dimensions, default=0)
        out = np.empty((flat[0].shape[0], dimension) if answer else flat[0].shape[0])
        loop_of(law, tails, dimension if answer else 0)(tuple(flat), out)
        return out.reshape((*lead, dimension) if answer else lead)

    return over_rows


def _in_rows(array: NDArray[np.float64], lead: tuple[int, ...], tail: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an array, broadcast to (*lead, *tail), as contiguous rows, (R, *tail)."""
    whole = array
    if array.shape != lead + tail:  # a copy takes a third of the time of np.broadcast_to and a copy
        whole = np.empty(lead + tail)
        whole[...] = array
    return np.ascontiguousarray(whole).reshape((-1, *tail))


def _rank(python: Any, name: str, annotation: Any) -> int:
    """Return the number of axes of an argument's rows: 0 for numbers, 1 for vectors, 2 for tuples of forces."""
    found = _RANK.get(annotation if isinstance(annotation, str) else getattr(annotation, "__name__", ""))
    if found is None:
        allowed = ", ".join(_RANK)
        raise TypeError(f"{python.__name__}: {name} must be annotated as one of {allowed}, as text, got {annotation!r}")
    return found


@entry_of
def loop_of(law: Law, tails: tuple[tuple[int, ...], ...], dimension: int) -> Callable[..., None]:
    """Return the loop of a law over rows of arrays (R, *tail), into (R, dimension), or (R,) if that is 0.

    law: a law of one agent; tails: the shape of a row of each of its arguments, () for numbers.
    """
    arguments = _arguments(tails)

    def over(arrays: Any, out: Any) -> None:
        for r in range(out.shape[0]):
            found = law(*arguments(arrays, r))
            if dimension == 0:
                out[r] = found
            else:
                out[r, 0], out[r, 1] = found[0], found[1]
                if dimension == 3:
                    out[r, 2] = found[2]

    return over


@functools.cache
def _arguments(tails: tuple[tuple[int, ...], ...]) -> Callable[[Any, int], tuple[Any, ...]]:
    """Return a function that returns a law's arguments from row r of each array of a tuple, up to four at once."""
    first = (len(tails) - 1) // 4 * 4
    mine = tails[first:]
    before, count = _arguments(tails[:first]) if first else None, len(mine)
    a, b, c, d = (_element(mine[min(k, count - 1)]) for k in range(4))
    second, third, fourth = (min(first + k, len(tails) - 1) for k in (1, 2, 3))

    def arguments(arrays: Any, r: int) -> tuple[Any, ...]:
        if count == 1:
            last: tuple[Any, ...] = (a(arrays[first], r),)
        elif count == 2:
            last = (a(arrays[first], r), b(arrays[second], r))
        elif count == 3:
            last = (a(arrays[first], r), b(arrays[second], r), c(arrays[third], r))
        else:
            last = (a(arrays[first], r), b(arrays[second], r), c(arrays[third], r), d(arrays[fourth], r))
        if before is None:
            return last
        return before(arrays, r) + last

    return kernel(arguments)


@kernel
def _item(items: Any, k: int) -> Any:
    """Return item k of a row or of an array: a number or a row."""
    return items[k]


def _vector(dimension: int) -> Callable[[Any, int], Vec]:
    """Return a function that returns row r of an array as a vector."""

    def vector_of(array: Any, r: int) -> Vec:
        if dimension == 2:
            return array[r, 0], array[r, 1]
        return array[r, 0], array[r, 1], array[r, 2]

    return kernel(vector_of)


@functools.cache
def _element(tail: tuple[int, ...]) -> Callable[[Any, int], Any]:
    """Return a function that returns row r of an array as a law takes it: a number, a tuple, or nested tuples."""
    if not tail:
        return _item
    if len(tail) == 1 and tail[0] in (2, 3):
        return _vector(tail[0])
    items = read_several(tail[0], _element(tail[1:]))

    def element(array: Any, r: int) -> Any:
        return items(array[r], 0)

    return kernel(element)
