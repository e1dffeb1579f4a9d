"""Parameters of hand-written players: a default, and the range in which the search looks for a better value.

Each may be one number, or one per row of observations, (R,): a hybrid sets them anew in each decision.
"""

from __future__ import annotations

from dataclasses import field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Order", "beyond", "in_order", "is_logarithmic", "parameter", "per_row", "ranges_of"]

Order = NDArray[np.intp] | None
"""Indices of behaviours by priority, (R, K), or None for the rules' own order."""

DECADES = 2.0
"""A positive range that spans more than this is divided on a logarithmic scale."""


def parameter(default: float, low: float, high: float, *, below: str = "", above: str = "") -> Any:
    """Return a field of a parameter class; `python -m agents.tune` searches [low, high].

    default: the published or initial value, in the parameter's unit.

    below, above: what a value below `low`, or above `high`, would mean, if that end is natural; "" if it is a choice,
    so that a best value at it calls for a wider range.
    """
    return field(default=default, metadata={"range": (low, high), "beyond": (below, above)})


def ranges_of(parameters: type) -> dict[str, tuple[float, float]]:
    """Return the range of each parameter; raise ValueError for one that has none.

    parameters: the dataclass.
    """
    without = [each.name for each in fields(parameters) if "range" not in each.metadata]
    if without:
        raise ValueError(f"{parameters.__name__}.{without[0]} has no range: use parameter(default, low, high)")
    return {each.name: each.metadata["range"] for each in fields(parameters)}


def beyond(parameters: type, name: str, end: float) -> str:
    """Return what a value beyond an end of a parameter's range would mean; "" if that end is a choice.

    parameters: the dataclass; name: of the parameter; end: the lower or the upper end of its range.
    """
    metadata = next(each.metadata for each in fields(parameters) if each.name == name)
    side = metadata["range"].index(end)
    text: str = metadata["beyond"][side]
    return text and f"{('below', 'above')[side]} it, {text}"


def is_logarithmic(low: float, high: float) -> bool:
    """Return True if a range is positive and spans more than DECADES.

    low, high: the ends, in the parameter's unit.
    """
    return low > 0.0 and high / low > 10.0**DECADES


def per_row(value: Any, axes: int = 1) -> Any:
    """Return a parameter as it multiplies arrays (R, ...): a number as it is, (R,) with further axes of length 1.

    value: a number or an array (R,); axes: number of further axes.
    """
    return value if isinstance(value, float) else np.asarray(value, np.float64)[(..., *(None,) * axes)]


def in_order(forces: NDArray[np.float64], order: Order) -> NDArray[np.float64]:
    """Return forces (R, K, D) in an order of priority; unchanged if it is None."""
    if order is None:
        return forces
    taken: NDArray[np.float64] = np.take_along_axis(forces, order[..., None], axis=1)
    return taken
