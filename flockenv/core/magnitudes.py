"""Bounds on the size of numbers, within which laws neither overflow nor divide by zero.

Laws multiply: an energy is a mass times two speeds, a spring force a stiffness times a length. They also divide: by a
mass, by the square of a distance. So neither a product of three numbers nor the reciprocal of a square may overflow.
Both bounds follow from the largest number M of a precision, as powers of ten: its cube root, 1e102 and 1e12, and the
reciprocal of its square root, 1e-154 and 1e-19 (float64 and float32). 0 is always allowed here; a parameter that must
not be 0 has its own check. Positions and velocities, which grow in a simulation, may be as large as their squares
allow: 1e154 and 1e19.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

__all__ = ["bounds", "check_array", "check_numbers"]


def bounds(precision: str) -> tuple[float, float]:
    """Return the smallest and the largest absolute value of a number other than 0, in "float64" or "float32"."""
    digits = math.log10(float(np.finfo(precision).max))
    return 10.0 ** -math.floor(digits / 2), 10.0 ** math.floor(digits / 3)


BOUNDS = {precision: bounds(precision) for precision in ("float64", "float32")}


def allowed_range(precision: str) -> str:
    """Return the part of a message that states what is allowed."""
    least, most = BOUNDS[precision]
    more = "; use dtype = float64" if precision == "float32" else ""
    return f"{precision} computes with numbers from {least:g} to {most:g} in size, and 0{more}"


def outliers(value: Any, precision: str, path: str = "", into_records: bool = True) -> Iterator[tuple[str, float]]:
    """Yield the path and value of each number that is out of bounds, in tuples, lists and records at any depth.

    into_records: False skips records.
    """
    if isinstance(value, float):
        least, most = BOUNDS[precision]
        if value != 0 and not least <= abs(value) <= most:
            yield path, value
    elif isinstance(value, (tuple, list)):
        for k, each in enumerate(value):
            yield from outliers(each, precision, f"{path}[{k}]", into_records)
    elif into_records and isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from outliers(getattr(value, name), precision, f"{path}.{name}".lstrip("."))


def check_numbers(value: Any, precision: str, path: str = "", into_records: bool = True) -> None:
    """Raise ValueError if a number in `value` is out of bounds; the message begins with its path; see `outliers`."""
    for place, number in outliers(value, precision, path, into_records):
        raise ValueError(f"{place} = {number:g}: {allowed_range(precision)}")


def check_array(name: str, array: NDArray[np.float64], precision: str) -> None:
    """Raise ValueError if positions or velocities contain NaN, infinity, or a number too large to be squared."""
    most = 1 / BOUNDS[precision][0]
    wrong = ~(np.abs(array) <= most)
    if wrong.any():
        at = tuple(int(k) for k in np.argwhere(wrong)[0])
        found = array[at]
        what = f"{found:g}" if np.isfinite(found) else "NaN or infinity"
        raise ValueError(
            f"{name} contains {what} at (world, agent, axis) {at}; {precision} computes with at most {most:g}"
        )
