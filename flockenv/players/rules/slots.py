"""The slots of an observation that list agents, nearest first: some are empty if an agent was not detected."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["nearest"]


def nearest(present: NDArray[np.float64], *quantities: NDArray[np.float64]) -> tuple[NDArray[Any], ...]:
    """Return True for rows in which an agent is present, (R,), and the quantities of the nearest one, (R, ...) each.

    present: (R, K), 0 for an empty slot; quantities: (R, K, ...). They are 0 in rows without an agent.
    """
    here = present > 0
    if here[:, 0].all():  # views are faster
        return (here[:, 0], *(each[:, 0] for each in quantities))
    row, first = np.arange(len(here)), np.argmax(here, axis=1)
    return (here[row, first], *(each[row, first] for each in quantities))
