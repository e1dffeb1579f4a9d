"""One score over tasks: 0 = random actions, 1 = tuned rules; and the statistics of rliable around it.

Source: Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice, arXiv 2108.13264.
A player is scored once per task and training seed; random actions and tuned rules are those of the same worlds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.study_results import RANDOM, SettingResults
from flockenv.evaluation import Interval, iqm

__all__ = ["THRESHOLDS", "Aggregate", "aggregate"]

RULES = "rules"
RESAMPLES = 2_000
THRESHOLDS = (-1.0, 0.0, 0.25, 0.5, 0.75, 0.9, 1.0, 1.1)
"""Scores at which the performance profile is given."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Aggregate:
    """A player's scores over tasks.

    score: interquartile mean over tasks and training seeds. profile: share of these scores above each of THRESHOLDS.
    improvement: mean over tasks of the probability to have a higher return than tuned rules in the same world, ties
    counted half. by_task: mean score of each task.
    """

    score: Interval
    profile: tuple[float, ...]
    improvement: Interval
    by_task: Mapping[str, float]


def aggregate(settings: Mapping[str, SettingResults], name: str, seed: int = 0) -> Aggregate:
    """Return the scores of a player over settings, by a name of each (a task, or a task in one of its settings).

    Intervals: stratified bootstrap; in each resample seeds and worlds are drawn anew for every task, the same ones for
    all settings of a task ("crossing/agents=4"), which share policies and worlds. The scale itself, the mean returns of
    random and rules, is taken as known.

    Raises:
        ValueError: rules are not better than random in a setting, so that it has no scale.
    """
    tables = {key: _Table.of(key, setting, name) for key, setting in settings.items()}
    generator = np.random.default_rng(seed)
    scores = [table.scores() for table in tables.values()]
    drawn = [_draw(tables, generator) for _ in range(RESAMPLES)]
    every = np.concatenate(scores)
    ends = np.quantile([iqm(values) for values, _ in drawn], (0.025, 0.975))
    better = np.quantile([share for _, share in drawn], (0.025, 0.975))
    return Aggregate(
        Interval(iqm(every), float(ends[0]), float(ends[1])),
        tuple(float((every > threshold).mean()) for threshold in THRESHOLDS),
        Interval(
            float(np.mean([table.improvement() for table in tables.values()])), float(better[0]), float(better[1])
        ),
        {key: float(each.mean()) for key, each in zip(settings, scores, strict=True)},
    )


@dataclass(frozen=True, eq=False)
class _Table:
    """Returns in one setting: of the player (seeds, worlds), of rules (worlds,); mean returns of random and rules."""

    player: Floats
    rules: Floats
    low: float
    high: float

    @staticmethod
    def of(key: str, setting: SettingResults, name: str) -> _Table:
        random, rules = setting.scores[RANDOM].returns.mean(axis=0), setting.scores[RULES].returns.mean(axis=0)
        if not rules.mean() > random.mean():
            raise ValueError(f"{key}: rules ({rules.mean():.4g}) are not better than random ({random.mean():.4g})")
        return _Table(setting.scores[name].returns, rules, float(random.mean()), float(rules.mean()))

    def scores(self) -> Floats:
        """Return the score of each seed, (seeds,)."""
        return np.asarray((self.player.mean(axis=1) - self.low) / (self.high - self.low))

    def improvement(self) -> float:
        """Return the share of worlds in which the return is higher than that of rules, ties counted half."""
        return float((np.sign(self.player - self.rules) / 2 + 0.5).mean())

    def resampled(self, seeds: NDArray[np.int64], worlds: NDArray[np.int64]) -> _Table:
        """Return the table of these seeds and worlds."""
        return _Table(self.player[seeds][:, worlds], self.rules[worlds], self.low, self.high)


def _draw(tables: Mapping[str, _Table], generator: np.random.Generator) -> tuple[Floats, float]:
    """Return all scores, and the probability of improvement, of one resample."""
    drawn: dict[tuple[str, tuple[int, ...]], tuple[NDArray[np.int64], NDArray[np.int64]]] = {}
    found = []
    for key, table in tables.items():
        seeds, worlds = table.player.shape
        of = key.partition("/")[0], table.player.shape
        if of not in drawn:
            drawn[of] = generator.integers(seeds, size=seeds), generator.integers(worlds, size=worlds)
        found.append(table.resampled(*drawn[of]))
    return np.concatenate([table.scores() for table in found]), float(np.mean([each.improvement() for each in found]))
