"""Spread: the distribution of a number within a group, uniform or normal, with the same values in every world."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.core.record import Record

__all__ = ["Spread", "draw", "largest", "smallest"]

MOST = 10_000_000
"""Most agents for which numbers are drawn to find the largest: larger groups are rejected elsewhere."""


class Spread(Record):
    """A uniform distribution from `low` to `high` or, with `mean` and `sd`, a normal one truncated to [low, high]."""

    sentence: ClassVar[str] = "spread[ around {mean}][ with a deviation of {sd}][ from {low}][ to {high}]"

    low: float | None = Field(default=None, description="lower bound (default for a normal one: 0)")
    high: float | None = Field(default=None, description="upper bound (default for a normal one: no limit)")
    mean: float | None = Field(default=None, description="mean of a normal one, before truncation")
    sd: float | None = Field(default=None, ge=0, description="standard deviation of a normal one")
    seed: int = Field(default=0, ge=0, description="seed of the random numbers")

    @model_validator(mode="after")
    def _check_kind(self) -> Spread:
        """Raise ValueError if it is neither uniform nor normal, or its range is not valid."""
        if (self.mean is None) != (self.sd is None):
            raise ValueError("mean and sd go together: give both or neither")
        if self.mean is None and (self.low is None or self.high is None):
            raise ValueError("low: give low and high, or mean and sd")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"low = {self.low:g}: must not be above high = {self.high:g}")
        if self.least < 0:
            raise ValueError(f"low = {self.least:g}: must be at least 0")
        if self.mean is not None and not self.least <= self.mean <= self.most:
            raise ValueError(f"mean = {self.mean:g}: must lie between low and high")
        return self

    @property
    def least(self) -> float:
        """Lower bound of the numbers."""
        return 0.0 if self.low is None else self.low

    @property
    def most(self) -> float:
        """Upper bound of the numbers; may be infinite."""
        return math.inf if self.high is None else self.high

    def at(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the quantiles at `share`, each in [0, 1]."""
        if self.mean is None or self.sd is None:
            return self.least + (self.most - self.least) * share
        if self.sd == 0:
            return np.full(len(share), self.mean)
        from scipy.special import ndtr, ndtri  # slow to import, and used only by normal spreads

        low, high = (ndtr((bound - self.mean) / self.sd) for bound in (self.least, self.most))
        found = self.mean + self.sd * ndtri(low + (high - low) * share)
        return np.asarray(np.clip(found, self.least, self.most))


def draw(value: float | Spread, count: int, channel: int) -> NDArray[np.float64]:
    """Return `count` numbers, whose ranks depend on channel and seed alone (so that heavy agents are wide).

    value: a number, which all of them are, or a spread; channel: an integer >= 0, a different one for each property of
    a group.
    """
    if not isinstance(value, Spread):
        return np.full(count, float(value))
    return value.at(np.random.default_rng([value.seed, channel]).random(count))


def smallest(value: float | Spread, count: int, channel: int) -> float:
    """Return the lower bound of the numbers: that of the spread or, if it is 0, the smallest number drawn.

    value: a number or a spread; count: how many are drawn; channel: as of `draw`.
    """
    if not isinstance(value, Spread):
        return float(value)
    return value.least if value.least > 0 else float(draw(value, min(count, MOST), channel).min())


def largest(value: float | Spread, count: int, channel: int) -> float:
    """Return the upper bound of the numbers: that of the spread or, if infinite, the largest number drawn.

    value: a number or a spread; count: how many are drawn; channel: as of `draw`.
    """
    if not isinstance(value, Spread):
        return float(value)
    return value.most if math.isfinite(value.most) else float(draw(value, min(count, MOST), channel).max())
