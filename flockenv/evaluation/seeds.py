"""Intervals over seeds and worlds: of players that were trained or tuned several times.

A player made once has one row of returns, a player made with S seeds has S rows, all in the same W worlds. Both levels
are drawn anew in each resample: seeds of each player by themselves, worlds for all players together. So an interval
contains the luck of training as well as that of worlds. A single seed shows no luck of training: its interval is of the
worlds alone. Source: Owen 2007, The pigeonhole bootstrap, Ann. Appl. Stat. 1, 386.

A bootstrap of few seeds is too narrow, as S drawn seeds vary by (S - 1) / S of the variance, and as their spread is
itself uncertain. So each seed's distance from the mean of all seeds is stretched by sqrt(S / (S - 1)), and by the ratio
of Student's quantile with S - 1 degrees of freedom to the normal one.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri, stdtrit  # scipy.stats takes a second to import

from flockenv.evaluation.episodes import RESAMPLES, Interval, proportion

__all__ = ["better_interval", "lead_interval", "mean_interval", "success_interval"]

Floats = NDArray[np.float64]


def mean_interval(returns: ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> Interval:
    """Return the mean of returns (S, W), of S seeds in W worlds, with its 95 % two-level bootstrap interval.

    resamples: number of bootstrap samples; seed: of their random numbers.

    Raises:
        ValueError: not two axes, fewer than two worlds, or a value that is not finite.
    """
    rows = _checked(returns)
    worlds = _world_weights(rows.shape[1], resamples, seed)
    return _interval(float(rows.mean()), _resampled_means(rows, worlds, np.random.default_rng([seed, 1])))


def success_interval(marks: ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> Interval:
    """Return the success rate of marks (S, W), True for a success, with its 95 % interval.

    resamples: number of bootstrap samples; seed: of their random numbers.

    Of one seed it is Wilson's (see `proportion`), of several the two-level bootstrap, cut off at 0 and 1.
    """
    rows = np.asarray(marks, np.float64)
    return proportion(rows[0]) if len(rows) == 1 else _share(mean_interval(rows, resamples, seed))


def lead_interval(first: ArrayLike, second: ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> Interval:
    """Return the mean return of `first` minus that of `second` in the same worlds, with its interval.

    resamples: number of bootstrap samples; seed: of their random numbers.

    first, second: returns (S1, W) and (S2, W). With one seed each, it is the bootstrap of the paired differences.

    Raises:
        ValueError: as `mean_interval`, or the numbers of worlds differ.
    """
    a, b = _checked_pair(first, second)
    worlds, generator = _world_weights(a.shape[1], resamples, seed), np.random.default_rng([seed, 1])
    drawn = _resampled_means(a, worlds, generator) - _resampled_means(b, worlds, generator)
    return _interval(float(a.mean() - b.mean()), drawn)


def better_interval(first: ArrayLike, second: ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> Interval:
    """Return the probability that `first` has the higher return in a world, ties counted half, with its interval.

    first, second: returns (S1, W) and (S2, W), of which every seed of one is compared with every seed of the other.
    With one seed each, the interval is Wilson's; else it is a two-level bootstrap, cut off at 0 and 1.

    Raises:
        ValueError: as `lead_interval`.
    """
    a, b = _checked_pair(first, second)
    won = np.sign(a[:, None] - b) / 2 + 0.5  # (S1, S2, W)
    if won.shape[:2] == (1, 1):
        return proportion(won[0, 0])
    value, generator = float(won.mean()), np.random.default_rng([seed, 1])
    for axis in (0, 1):
        won = won + (_stretch(won.shape[axis]) - 1) * (won.mean(axis=(1 - axis, 2), keepdims=True) - value)
    worlds = _world_weights(won.shape[2], resamples, seed)
    rates = (worlds @ won.reshape(-1, won.shape[2]).T).reshape(len(worlds), *won.shape[:2])
    one, two = (_seed_weights(count, len(worlds), generator) for count in won.shape[:2])
    return _share(_interval(value, np.einsum("rab,ra,rb->r", rates, one, two)))


def _checked(returns: ArrayLike) -> Floats:
    rows = np.asarray(returns, np.float64)
    if rows.ndim != 2 or rows.shape[0] < 1 or rows.shape[1] < 2 or not np.isfinite(rows).all():
        raise ValueError(f"an interval needs finite returns (seeds, worlds) in two worlds at least, not {rows.shape}")
    return rows


def _checked_pair(first: ArrayLike, second: ArrayLike) -> tuple[Floats, Floats]:
    a, b = _checked(first), _checked(second)
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"returns in {a.shape[1]} and in {b.shape[1]} worlds cannot be paired")
    return a, b


@functools.lru_cache(maxsize=1)  # all players of a task have the same worlds
def _world_weights(worlds: int, resamples: int, seed: int) -> Floats:
    """Return the weight of each world in each resample, (R, W)."""
    weights = np.random.default_rng(seed).multinomial(worlds, np.full(worlds, 1 / worlds), resamples) / worlds
    weights.flags.writeable = False
    return weights


def _seed_weights(seeds: int, resamples: int, generator: np.random.Generator) -> Floats:
    """Return the weight of each seed in each resample, (R, S)."""
    if seeds == 1:
        return np.ones((resamples, 1))
    return generator.multinomial(seeds, np.full(seeds, 1 / seeds), resamples) / seeds


def _resampled_means(rows: Floats, worlds: Floats, generator: np.random.Generator) -> Floats:
    """Return the mean of each resample, (R,)."""
    of_seed = rows.mean(axis=1, keepdims=True)
    rows = rows + (_stretch(len(rows)) - 1) * (of_seed - of_seed.mean())
    return np.asarray(((worlds @ rows.T) * _seed_weights(len(rows), len(worlds), generator)).sum(axis=1))


def _stretch(seeds: int) -> float:
    """Return the factor by which distances between seeds are stretched; that of a single seed, which has none, is 1."""
    if seeds == 1:
        return 1.0
    return float(stdtrit(seeds - 1, 0.975) / ndtri(0.975) * np.sqrt(seeds / (seeds - 1)))


def _interval(value: float, drawn: Floats) -> Interval:
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Interval(value, float(low), float(high))


def _share(interval: Interval) -> Interval:
    """Return the interval of a probability, cut off at 0 and 1."""
    return Interval(interval.value, max(0.0, interval.low), min(1.0, interval.high))
