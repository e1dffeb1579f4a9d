"""Statistics over many runs of one scene: a mean with its interval, and whether order is above its null."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Above", "Mean", "above_null", "mean_of_runs"]

Floats = NDArray[np.float64]

RESAMPLES = 10_000


class Mean(NamedTuple):
    """A mean over runs, with its 95 % interval."""

    runs: int
    mean: float
    low: float  # NaN for fewer than two runs
    high: float  # upper end of the interval


class Above(NamedTuple):
    """Mean of value - null over runs, with its interval."""

    runs: int
    excess: float  # mean of value - null
    low: float  # its 95 % interval
    high: float  # its upper end

    @property
    def holds(self) -> bool:
        """True if the whole interval is above 0."""
        return self.low > 0


def mean_of_runs(values: ArrayLike, seed: int = 0) -> Mean:
    """Return the mean of one number per run, (R,), with its 95 % bootstrap interval; only finite values count.

    values: (R,); seed: of the bootstrap.
    """
    given = np.asarray(values, np.float64)
    x = given[np.isfinite(given)]
    if len(x) < 2:
        return Mean(len(x), float(x.mean()) if len(x) else np.nan, np.nan, np.nan)
    rng = np.random.default_rng(seed)
    # one by one: there may be many runs
    drawn = [x[rng.integers(len(x), size=len(x))].mean() for _ in range(RESAMPLES)]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Mean(len(x), float(x.mean()), float(low), float(high))


def above_null(values: ArrayLike, nulls: ArrayLike, seed: int = 0) -> Above:
    """Return the excess of an order, one number per run (R,), over its value by chance in the same run, (R,).

    values, nulls: (R,), the order and its value by chance; seed: of the bootstrap.

    For lanes `Lanes.order` against `Lanes.null`, for a door `Bursts.length` against `Bursts.null_length`: values are
    paired, so differences between runs (number of agents, positions) cancel. Runs without a null (NaN) are left out.
    The order is above chance, with 95 % confidence, if the interval lies above 0. Raises ValueError if the shapes
    differ, or fewer than 5 runs have a null, too few for an interval.
    """
    order, null = np.asarray(values, np.float64), np.asarray(nulls, np.float64)
    if order.shape != null.shape or order.ndim != 1:
        raise ValueError(f"values of shape {order.shape}, nulls of {null.shape}: must be one of each for each run")
    excess = mean_of_runs(order - null, seed)
    if excess.runs < 5:
        raise ValueError(
            f"values: {excess.runs} runs with a null, the value by chance; at least 5 are needed for an interval"
        )
    return Above(excess.runs, excess.mean, excess.low, excess.high)
