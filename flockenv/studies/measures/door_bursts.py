"""Bursts at a door: runs of passages in one direction before one in the other, compared with chance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln

__all__ = ["Bursts", "bursts", "runs", "runs_probability"]

Floats = NDArray[np.float64]


class Bursts(NamedTuple):
    """Runs of equal direction, and the same by chance with as many crossings in each direction."""

    crossings: int
    bursts: int  # number of runs of equal direction
    length: float  # mean, crossings per burst
    null_bursts: float  # expected by chance
    null_length: float  # crossings / null_bursts
    p: float  # probability that chance makes as few bursts or fewer


def runs(signs: ArrayLike) -> NDArray[np.int64]:
    """Return the lengths of runs of equal signs, in their order: 2, 1, 1 for + + - +."""
    given = np.asarray(signs)
    if not len(given):
        return np.zeros(0, np.int64)
    ends = np.flatnonzero(np.append(given[1:] != given[:-1], True))
    return np.diff(ends, prepend=-1).astype(np.int64)


def bursts(signs: ArrayLike) -> Bursts:
    """Return the bursts among crossings in the order of time, (C,), each 1 or -1.

    The null hypothesis is that all orders of the n1 and n2 signs are equally likely. Then 1 + 2 n1 n2 / n bursts are
    expected, and P(bursts <= r) is exact. The test is one-sided, as doors have fewer and longer bursts. The null is NaN
    if all go in one direction, or without crossings. Raises ValueError for signs other than 1 and -1.
    Source of the null: Wald & Wolfowitz 1940, Ann. Math. Statist. 11, 147; of the bursts: Helbing & Molnar 1995.
    """
    given = np.asarray(signs)
    if given.ndim != 1 or not np.isin(given, (-1, 1)).all():
        raise ValueError("signs: must be a list of 1 and -1, one for each crossing")
    n, first = len(given), int((given > 0).sum())
    found = len(runs(given))
    if not 0 < first < n:
        return Bursts(n, found, n / found if found else np.nan, np.nan, np.nan, np.nan)
    expected = 1 + 2 * first * (n - first) / n
    p = min(1.0, sum(runs_probability(r, first, n - first) for r in range(2, found + 1)))
    return Bursts(n, found, n / found, expected, n / expected, p)


def runs_probability(many: int, first: int, second: int) -> float:
    """Return the probability of `many` runs in a random order of `first` items of one kind and `second` of another."""
    k, odd = divmod(many, 2)
    a, b = first - 1, second - 1
    splits = [(k, k - 1), (k - 1, k)] if odd else [(k - 1, k - 1), (k - 1, k - 1)]
    log_total = _log_choose(first + second, first)
    return float(sum(np.exp(_log_choose(a, i) + _log_choose(b, j) - log_total) for i, j in splits))


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)) if 0 <= k <= n else -np.inf
