"""The price of harm: an argument of some tasks that multiplies the reward terms of harm, and that policies observe.

One policy then learns every price: `ppo.draw: {price: [0.3, 1, 3, 10, 30]}` (multi-objective learning with a
conditioned policy, Abels et al. 2019, ICML). Without the argument, rewards and rows are those of a price of 1 and of a
policy that observes no price.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydantic import Field

from flockenv.jit.decorators import kernel
from flockenv.tasks.layout import Slot

__all__ = ["price_field", "price_numbers", "price_slots", "write_price"]

_DECADES = 2.0
"""Prices are from 10^-2 to 10^2."""


def price_field(terms: str) -> Any:
    """Return the field `price` of a task whose terms of harm these are."""
    return Field(
        default=None,
        ge=10**-_DECADES,
        le=10**_DECADES,
        exclude_if=lambda price: price is None,  # so results and cards without a price stay as they are
        description=f"factor on {terms}, which is then observed as its logarithm; None: 1, and not observed",
    )


def price_numbers(price: float | None) -> dict[str, float]:
    """Return the parameters of a task's kernels: the price, and what a row holds of it if it is observed."""
    value = 1.0 if price is None else price
    return {"price": value, "price_seen": float(price is not None), "log_price": math.log10(value) / _DECADES}


def price_slots(price: float | None) -> tuple[Slot, ...]:
    """Return the slot of the price, the last of a row, if it is observed."""
    return () if price is None else (Slot("log_price", (), _DECADES, "1", "decimal logarithm of the price of harm"),)


@kernel
def write_price(p: Any, row: Any) -> None:
    """Write the logarithm of the price to the last number of a row, if it is observed."""
    if p.price_seen > 0.0:
        row[np.uint64(row.shape[0] - 1)] = p.log_price
