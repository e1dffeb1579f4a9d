"""Arching and clogging: the tail of the time gaps between passages, and whether their mean exists."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Tail", "goodness", "survival", "tail"]

Floats = NDArray[np.float64]

LEAST = 10
"""Fewer gaps than this have no meaningful tail."""

MOST_STARTS = 500


class Tail(NamedTuple):
    """A power law p(t) ~ t^-alpha fitted to all gaps >= `start`; NaN if there are too few."""

    alpha: float
    error: float  # standard error of alpha
    start: float  # s
    gaps: int  # in the tail
    distance: float  # Kolmogorov-Smirnov distance of the tail and the fit

    @property
    def flows(self) -> bool:
        """True if alpha > 2, so that the mean gap exists."""
        return self.alpha > 2

    @property
    def verdict(self) -> str:
        """'flows' or 'clogs' if alpha is more than 1.96 errors above or below 2, else 'undecided'; NaN: 'no tail'."""
        if not np.isfinite(self.alpha):
            return "no tail"
        if abs(self.alpha - 2) <= 1.96 * self.error:
            return "undecided"
        return "flows" if self.flows else "clogs"


def survival(gaps: ArrayLike) -> tuple[Floats, Floats]:
    """Return gaps in ascending order, (n,) s, and the share of gaps that are at least as long as each."""
    ordered = np.sort(_check_gaps(gaps))
    return ordered, 1.0 - np.arange(len(ordered)) / max(1, len(ordered))


def tail(gaps: ArrayLike, start: float | None = None) -> Tail:
    """Return the power law p(t) ~ t^-alpha that fits the long gaps (n,), s, best; the survival falls as t^-(alpha - 1).

    alpha = 1 + n / sum ln(t / start), with error (alpha - 1) / sqrt(n), over gaps >= start; the start, unless given,
    minimises the Kolmogorov-Smirnov distance of fit and gaps, with at least 10 gaps left.
    alpha <= 2 is a clogged door: the mean gap, the integral of t p(t), does not exist. This limit is for the exponent
    of the density; for that of the survival it is 1.
    Raises ValueError if gaps are negative or not finite, or if start is not > 0; gaps of 0 are in no tail.
    Source: Clauset, Shalizi, Newman 2009, SIAM Review 51, 661, eqs. 3.1, 3.2, 3.9; the transition: Zuriguel et al.
    2014, Sci. Rep. 4, 7324.
    """
    ordered = np.sort(_check_gaps(gaps))
    ordered = ordered[ordered > 0]
    none = Tail(np.nan, np.nan, np.nan, 0, np.nan)
    if start is not None:
        if not (start > 0 and np.isfinite(start)):
            raise ValueError(f"start = {start:g}: must be a finite time above 0, s: a power law has no mass at 0")
        return _fit_tail(ordered[ordered >= start], start) or none
    starts = np.unique(ordered[: max(0, len(ordered) - LEAST + 1)])
    if len(starts) > MOST_STARTS:
        starts = starts[np.linspace(0, len(starts) - 1, MOST_STARTS).astype(int)]
    fits = [_fit_tail(ordered[np.searchsorted(ordered, x) :], float(x)) for x in starts]
    return min((fit for fit in fits if fit is not None), key=lambda fit: fit.distance, default=none)


def goodness(gaps: ArrayLike, fit: Tail, samples: int = 200, seed: int = 0) -> float:
    """Return the share of samples of the fit that are at least as far from their own fits as the gaps (n,) from `fit`.

    fit: the fit of `tail` to the gaps; seed: of the samples.

    Below .1 a power law is rejected (Clauset, Shalizi, Newman 2009, 4.1): each sample has as many gaps as given; its
    tail is drawn from the fit, the rest from the gaps before `fit.start`. NaN without a tail.
    """
    given = _check_gaps(gaps)
    given = given[given > 0]
    if not np.isfinite(fit.alpha):
        return np.nan
    rng, body = np.random.default_rng(seed), given[given < fit.start]
    further = 0
    for _ in range(samples):
        long = int(rng.binomial(len(given), fit.gaps / len(given))) if len(body) else len(given)
        drawn = fit.start * (1.0 - rng.random(long)) ** (-1.0 / (fit.alpha - 1.0))
        short = rng.choice(body, len(given) - long) if len(body) else np.zeros(0)
        further += tail(np.concatenate([short, drawn])).distance >= fit.distance
    return further / samples


def _fit_tail(long: Floats, start: float) -> Tail | None:
    """Return the fit to gaps in ascending order, all >= start; None if they are too few or all equal to start."""
    logs = float(np.log(long / start).sum()) if len(long) >= LEAST else 0.0
    if not logs > 0:
        return None
    n = len(long)
    alpha = 1.0 + n / logs
    beyond = (long / start) ** (1.0 - alpha)
    steps = 1.0 - np.arange(n + 1) / n
    distance = max(np.abs(steps[:-1] - beyond).max(), np.abs(steps[1:] - beyond).max())
    return Tail(alpha, (alpha - 1.0) / np.sqrt(n), start, n, float(distance))


def _check_gaps(gaps: ArrayLike) -> Floats:
    given = np.asarray(gaps, np.float64)
    if given.ndim != 1 or not (np.isfinite(given).all() and (given >= 0).all()):
        raise ValueError("gaps: must be a list of finite times >= 0, s")
    return given
