"""Parameters of hand-written players: a default, and the range in which the search looks for a better value."""

from __future__ import annotations

from dataclasses import field, fields
from typing import Any

__all__ = ["parameter", "ranges_of"]


def parameter(default: float, low: float, high: float) -> Any:
    """Return a field of a parameter class; `python -m agents.tune` searches [low, high]."""
    return field(default=default, metadata={"range": (low, high)})


def ranges_of(parameters: type) -> dict[str, tuple[float, float]]:
    """Return the range of each parameter; raise ValueError for one that has none."""
    without = [each.name for each in fields(parameters) if "range" not in each.metadata]
    if without:
        raise ValueError(f"{parameters.__name__}.{without[0]} has no range: use parameter(default, low, high)")
    return {each.name: each.metadata["range"] for each in fields(parameters)}
