"""Lane formation: whether agents that walk in the same direction keep together, compared with chance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

__all__ = ["Lanes", "band_index", "lane_order", "lanes", "rows_of"]

Floats = NDArray[np.float64]

BAND, ROW = 0.3, 0.2
"""m: the width of a band of Y and of a row of Phi."""

MOST_ROWS = 10_000


class Lanes(NamedTuple):
    """Order over a run, and the order of the same run with permuted directions."""

    order: float  # Phi, mean over the instants
    bands: float  # Y, mean over the instants
    null: float  # Phi, mean over the permutations
    null_high: float  # Phi, which 95 % of the permutations do not exceed
    p: float  # share of permutations with at least the order that was found, the run itself included
    beyond: float  # (Phi - null) / (1 - null): 0 = as by chance, 1 = lanes alone; NaN if chance makes perfect lanes


def rows_of(across: ArrayLike, low: float, high: float, width: float) -> NDArray[np.int64]:
    """Return the row of width `width`, m, counted from low, of each coordinate `across`, m; -1 outside [low, high).

    Raises ValueError if the range is empty, the width is not positive, or there are more than MOST_ROWS rows.
    """
    if not (np.isfinite([low, high, width]).all() and low < high and width > 0):
        raise ValueError(f"rows from {low:g} to {high:g} m, {width:g} m wide: must be finite, low < high and width > 0")
    if (high - low) / width > MOST_ROWS:
        raise ValueError(f"width = {width:g} m: more than {MOST_ROWS:,} rows")
    y = np.asarray(across, np.float64)
    with np.errstate(invalid="ignore"):
        row = np.floor((y - low) / width)
        return np.where((y >= low) & (y < high), row, -1).astype(np.int64)


def lane_order(across: ArrayLike, direction: ArrayLike, low: float, high: float, width: float = ROW) -> float:
    """Return Phi, the mean over occupied rows of ((n+ - n-) / (n+ + n-))^2; NaN without agents.

    low, high: m, edges of the region across; width: of a row, m.

    across (N,) m, perpendicular to the walking direction; direction (N,), > 0 or < 0: that of each agent. 1 = no row
    holds agents of both directions; by chance it is not 0 but about 1/n in rows of n. Source: Feliciani & Nishinari
    2016, Phys. Rev. E 94, 032304, rows .2 m wide; after Rex & Loewen 2007, Phys. Rev. E 75, 051402.
    """
    forward, many = _count_by_row(across, direction, low, high, width)
    return float((((2 * forward - many) / many) ** 2).mean()) if len(many) else np.nan


def band_index(across: ArrayLike, direction: ArrayLike, low: float, high: float, width: float = BAND) -> float:
    """Return Y, the mean over occupied bands of |n+ - n-| / (n+ + n-); NaN without agents.

    across (N,) m, perpendicular to the walking direction; direction (N,), > 0 or < 0; low, high: m, edges of the region
    across; width: of a band, m.

    Like `lane_order`, but without the square and with bands .3 m wide. Source: Yamori 1998, Psychol. Rev. 105, 530.
    """
    forward, many = _count_by_row(across, direction, low, high, width)
    return float((np.abs(2 * forward - many) / many).mean()) if len(many) else np.nan


def _count_by_row(
    across: ArrayLike, direction: ArrayLike, low: float, high: float, width: float
) -> tuple[Floats, Floats]:
    """Return the number of agents that go forward, and of all agents, in each occupied row."""
    row, sign = rows_of(across, low, high, width), np.asarray(direction, np.float64)
    here = (row >= 0) & (sign != 0)
    many = np.bincount(row[here], np.ones(int(here.sum())))
    forward = np.bincount(row[here], sign[here] > 0, len(many))
    return np.asarray(forward[many > 0]), np.asarray(many[many > 0])


def lanes(
    across: ArrayLike,
    direction: ArrayLike,
    low: float,
    high: float,
    present: ArrayLike | None = None,
    width: float = ROW,
    deals: int = 400,
    seed: int = 0,
) -> Lanes:
    """Return the order of lanes over a run, and over `deals` permutations of its directions.

    low, high: m, edges of the region across; width: of a row, m; seed: of the permutations.

    across (T, N) m; direction (N,): that of each agent over the whole run, > 0 or < 0; agents with 0 are not
    counted; present (T, N): True for agents in the measured region (default: all). This is a permutation test:
    positions stay as they are, each agent keeps one direction, and as many go in each direction as before.
    Raises ValueError if shapes do not match, or if all agents go in one direction.
    """
    y, sign = np.asarray(across, np.float64), np.sign(np.asarray(direction, np.float64))
    if y.ndim != 2 or sign.shape != y.shape[1:]:
        raise ValueError(f"across: of shape {y.shape}, direction of {sign.shape}: must be (T, N) and (N,)")
    row = rows_of(y, low, high, width)
    if present is not None:
        row = np.where(np.asarray(present, np.bool_), row, -1)
    row = np.where(sign != 0, row, -1)
    seen = np.flatnonzero((row >= 0).any(axis=0))
    if not ((sign[seen] > 0).any() and (sign[seen] < 0).any()):
        raise ValueError("direction: lanes need agents in both directions, here all go in one")
    row, forward = row[:, seen], (sign[seen] > 0).astype(np.float64)
    rng = np.random.default_rng(seed)
    dealt = np.stack([forward, *(rng.permutation(forward) for _ in range(deals))], axis=1)
    phi = _orders(row, dealt)
    found, null = float(phi[0]), phi[1:]
    mean = float(null.mean())
    bands = [band_index(y[k, seen][here], sign[seen][here], low, high) for k, here in enumerate(row >= 0) if here.any()]
    return Lanes(
        found, float(np.mean(bands)), mean, float(np.quantile(null, 0.95)),
        float((1 + (null >= found - 1e-12).sum()) / (1 + deals)),
        (found - mean) / (1 - mean) if mean < 1 else np.nan,
    )  # fmt: skip


def _orders(row: NDArray[np.int64], dealt: Floats) -> Floats:
    """Return Phi, mean over the instants, of rows (T, N) under each permutation of directions (N, R), (R,)."""
    total, instants = np.zeros(dealt.shape[1]), 0
    for now in row:
        here = np.flatnonzero(now >= 0)
        if not len(here):
            continue
        used, which = np.unique(now[here], return_inverse=True)
        member = csr_array((np.ones(len(here)), (which, here)), shape=(len(used), len(now)))
        many = np.bincount(which)[:, None]
        total += (((2 * (member @ dealt) - many) / many) ** 2).mean(axis=0)
        instants += 1
    return total / instants
