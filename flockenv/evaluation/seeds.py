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

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri, stdtrit  # scipy.stats takes a second to import

from flockenv.evaluation.episodes import RESAMPLES, Interval

__all__ = ["lead_interval", "mean_interval"]

Floats = NDArray[np.float64]


def mean_interval(returns: ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> Interval:
    """Return the mean of returns (S, W), of S seeds in W worlds, with its 95 % two-level bootstrap interval.

    Raises:
        ValueError: not two axes, fewer than two worlds, or a value that is not finite.
    """
    rows = _checked(returns)
    worlds, generator = _world_weights(rows.shape[1], resamples, seed)
    return _interval(float(rows.mean()), _resampled_means(rows, worlds, generator))


def lead_interval(first: ArrayLike, second: ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> Interval:
    """Return the mean return of `first` minus that of `second` in the same worlds, with its interval.

    first, second: returns (S1, W) and (S2, W). With one seed each, it is the bootstrap of the paired differences.

    Raises:
        ValueError: as `mean_interval`, or the numbers of worlds differ.
    """
    a, b = _checked(first), _checked(second)
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"returns in {a.shape[1]} and in {b.shape[1]} worlds cannot be paired")
    worlds, generator = _world_weights(a.shape[1], resamples, seed)
    drawn = _resampled_means(a, worlds, generator) - _resampled_means(b, worlds, generator)
    return _interval(float(a.mean() - b.mean()), drawn)


def _checked(returns: ArrayLike) -> Floats:
    rows = np.asarray(returns, np.float64)
    if rows.ndim != 2 or rows.shape[0] < 1 or rows.shape[1] < 2 or not np.isfinite(rows).all():
        raise ValueError(f"an interval needs finite returns (seeds, worlds) in two worlds at least, not {rows.shape}")
    return rows


def _world_weights(worlds: int, resamples: int, seed: int) -> tuple[Floats, np.random.Generator]:
    """Return the weight of each world in each resample, (R, W), and the generator for further draws."""
    generator = np.random.default_rng(seed)
    return generator.multinomial(worlds, np.full(worlds, 1 / worlds), resamples) / worlds, generator


def _resampled_means(rows: Floats, worlds: Floats, generator: np.random.Generator) -> Floats:
    """Return the mean of each resample, (R,)."""
    seeds = len(rows)
    if seeds > 1:
        of_seed = rows.mean(axis=1, keepdims=True)
        rows = rows + (_stretch(seeds) - 1) * (of_seed - of_seed.mean())
    weights = generator.multinomial(seeds, np.full(seeds, 1 / seeds), len(worlds)) / seeds
    return np.asarray(((weights @ rows) * worlds).sum(axis=1))


def _stretch(seeds: int) -> float:
    """Return the factor by which distances between seeds are stretched."""
    return float(stdtrit(seeds - 1, 0.975) / ndtri(0.975) * np.sqrt(seeds / (seeds - 1)))


def _interval(value: float, drawn: Floats) -> Interval:
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Interval(value, float(low), float(high))
