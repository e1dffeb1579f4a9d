"""Scores of a player, and of two players compared world by world, each of one run or of several seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockenv.evaluation.episodes import RESAMPLES, Episodes, Interval
from flockenv.evaluation.seeds import better_interval, lead_interval, mean_interval, success_interval

__all__ = ["Comparison", "Summary", "compare", "summarise"]

Floats = NDArray[np.float64]

Runs = Episodes | Sequence[Episodes]
"""The episodes of one player: of one run, or of each of its training or search seeds."""


@dataclass(frozen=True)
class Summary:
    """Statistics of one player, as shown in a table; intervals are over seeds and worlds, see `seeds`."""

    mean: Interval  # of the returns
    success: Interval  # success rate, 0 to 1
    metrics: Mapping[str, tuple[float, int]]  # mean over the episodes to which it applies, and their number


def summarise(runs: Runs, resamples: int = RESAMPLES, seed: int = 0) -> Summary:
    """Return the statistics of one player's episodes.

    runs: its episodes, by `rollout`; resamples: number of bootstrap samples; seed: of their random numbers.
    """
    rows = _runs(runs)
    metrics = {name: np.concatenate([run.metrics[name] for run in rows]) for name in rows[0].metrics}
    return Summary(
        mean=mean_interval(_returns(rows), resamples, seed),
        success=success_interval(np.array([run.success for run in rows]), resamples, seed),
        metrics={name: _finite_mean(values) for name, values in metrics.items()},
    )


@dataclass(frozen=True)
class Comparison:
    """Comparison of two players in the same worlds; differences > 0 and `better` > 1/2: the first is ahead."""

    difference: Interval  # of the mean returns
    better: Interval  # probability that the first has the higher return in a world, ties counted half
    worlds: int

    @property
    def separated(self) -> bool:
        """True if the interval of the difference excludes zero."""
        return self.difference.low > 0 or self.difference.high < 0


def compare(first: Runs, second: Runs, resamples: int = RESAMPLES, seed: int = 0) -> Comparison:
    """Compare two players world by world.

    first, second: their episodes, by `rollout`; the difference is first less second. resamples: number of bootstrap
    samples; seed: of their random numbers.

    Raises:
        ValueError: the episodes are not of the same worlds: task, settings, seed, number or time limit differ.
    """
    one, two = _runs(first), _runs(second)
    for run in (*one, *two):
        _check_worlds(one[0], run)
    a, b = _returns(one), _returns(two)
    return Comparison(lead_interval(a, b, resamples, seed), better_interval(a, b, resamples, seed), one[0].worlds)


def _check_worlds(first: Episodes, second: Episodes) -> None:
    for name in ("task", "digest", "seed", "worlds", "horizon"):
        a, b = getattr(first, name), getattr(second, name)
        if a != b:
            raise ValueError(f"scores cannot be paired: {name} {a!r} and {b!r}, must be the same worlds")


def _runs(runs: Runs) -> Sequence[Episodes]:
    return [runs] if isinstance(runs, Episodes) else runs


def _returns(runs: Sequence[Episodes]) -> Floats:
    """Return the returns of each run, (seeds, worlds)."""
    return np.array([run.returns for run in runs])


def _finite_mean(values: Floats) -> tuple[float, int]:
    finite = values[np.isfinite(values)]
    return (float(finite.mean()) if len(finite) else math.nan), len(finite)
