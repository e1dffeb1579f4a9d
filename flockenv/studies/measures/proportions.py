"""Faults of pedestrian models: overlapping bodies, walking backward, and the collision rate."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.geometry.space import Space
from flockenv.studies.measures.bodies import near_pairs

__all__ = [
    "Proportion",
    "collision_rate",
    "oscillation_proportion",
    "overlap_area",
    "overlap_proportion",
    "touching_pairs",
]

Floats = NDArray[np.float64]

ROUNDING = 1e-6
"""Share of the contact distance that is tolerated: whether hard bodies in contact overlap is a matter of rounding."""


class Proportion(NamedTuple):
    """Mean size of a fault where it occurs, and how often it occurs."""

    mean: float  # over the cases where it is not 0; 0 if there are none
    share: float  # of the cases, those in which it is not 0; NaN without cases


def overlap_area(distance: ArrayLike, first: ArrayLike, second: ArrayLike) -> Floats:
    """Return the area, m^2, that two discs share; `distance` of their centres and radii `first` and `second` in m."""
    d, a, b = np.broadcast_arrays(*(np.asarray(each, np.float64) for each in (distance, first, second)))
    small, large = np.minimum(a, b), np.maximum(a, b)
    # half angles of the two segments, from sides of the triangle between the centres and where the circles cross
    with np.errstate(divide="ignore", invalid="ignore"):
        one = np.arccos(np.clip((d**2 + a**2 - b**2) / (2 * d * a), -1, 1))
        other = np.arccos(np.clip((d**2 + b**2 - a**2) / (2 * d * b), -1, 1))
        lens = a**2 * (one - np.sin(2 * one) / 2) + b**2 * (other - np.sin(2 * other) / 2)
    return np.asarray(np.where(d >= a + b, 0.0, np.where(d <= large - small, np.pi * small**2, lens)))


def touching_pairs(
    pos: Floats, radius: Floats, space: Space, margin: float = 0.0, body: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], Floats]:
    """Return the pairs of discs (N, D), m, that overlap, (P, 2), the smaller index first, and their distances, (P,) m.

    Radii, (N,) m, are enlarged by a share `margin`, at most 5e-4. body: (N,), pairs of the same one are left out.
    """
    if len(pos) < 2 or not radius.max() > 0:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    pairs = near_pairs(pos, radius, space, np.arange(len(pos)) if body is None else body, 5e-4)
    far = np.linalg.norm(space.displacement(pos[pairs[:, 0]], pos[pairs[:, 1]]), axis=1)
    near = far < (radius[pairs[:, 0]] + radius[pairs[:, 1]]) * (1 + margin)
    return pairs[near], far[near]


def overlap_proportion(
    pos: ArrayLike, radius: ArrayLike, space: Space, alive: ArrayLike | None = None, body: ArrayLike | None = None
) -> Proportion:
    """Return how much bodies overlap: the mean of A_ij / min(A_i, A_j) over all pairs that overlap.

    space: the plane, box or torus in which distances are measured.

    pos (T, N, 2) m; radius (N,) m; alive (T, N); body (N,): agents of the same one are not compared. `mean` is 0 if no
    two agents ever overlap, 1 if one always lies in the other; `share` is the share of agent-instants in a pair that
    overlaps.
    Source: Chraibi, Seyfried, Schadschneider 2010, Phys. Rev. E 82, 046111 (arXiv 1008.4297), there of ellipses.
    """
    total, many, seen, people = 0.0, 0, 0, 0
    for where, size, who in _instants(pos, radius, alive):
        pairs, far = touching_pairs(where, size, space, -ROUNDING, None if body is None else np.asarray(body)[who])
        a, b = size[pairs[:, 0]], size[pairs[:, 1]]
        least = np.pi * np.minimum(a, b) ** 2
        # a point inside a body overlaps it entirely
        total += float(np.where(least > 0, overlap_area(far, a, b) / np.where(least > 0, least, 1), 1.0).sum())
        many += len(pairs)
        seen += len(np.unique(pairs))
        people += len(where)
    return Proportion(total / many if many else 0.0, seen / people if people else np.nan)


def oscillation_proportion(vel: ArrayLike, desired: ArrayLike, alive: ArrayLike | None = None) -> Proportion:
    """Return how strongly agents move backward: the mean of S = -v . v0 / |v0|^2 where that is > 0.

    vel (T, N, D) and desired (N, D) or (T, N, D), m/s: the desired velocity v0; agents with v0 = 0 are left out.
    alive (T, N). `mean` is 0 if no agent ever moves backward, 1 if agents do so at their desired speed; `share` is the
    share of agent-instants with S > 0. Forces that oscillate cause it repeatedly (Kretz, arXiv 1507.02566).
    Source: Chraibi, Seyfried, Schadschneider 2010, Phys. Rev. E 82, 046111, S = (|s| - s) / 2 with s = v . v0 / |v0|^2.
    """
    v = np.asarray(vel, np.float64)
    v0 = np.broadcast_to(np.asarray(desired, np.float64), v.shape)
    square = (v0**2).sum(axis=-1)
    here = square > 0
    if alive is not None:
        here = here & np.asarray(alive, np.bool_)
    s = (v * v0).sum(axis=-1)[here] / square[here]
    back = -s[s < 0]
    return Proportion(float(back.mean()) if len(back) else 0.0, len(back) / len(s) if len(s) else np.nan)


def collision_rate(
    time: ArrayLike, pos: ArrayLike, radius: ArrayLike, space: Space, alive: ArrayLike | None = None,
    body: ArrayLike | None = None,
) -> float:  # fmt: skip
    """Return the rate at which agents begin to touch, 1/s per agent: 2 (pairs that newly touch) / (N T).

    space: the plane, box or torus in which distances are measured.

    time (T,) s; pos (T, N, D) m; radius (N,) m; alive (T, N); body (N,): agents of the same one are not compared. Pairs
    that touch at the first instant are not counted; contacts that begin and end between two instants are missed. NaN
    for fewer than two instants, or no agents.
    """
    when = np.asarray(time, np.float64)
    before: set[int] | None = None
    began, lived, count = 0, 0.0, len(np.asarray(radius))
    for k, (where, size, who) in enumerate(_instants(pos, radius, alive)):
        own = None if body is None else np.asarray(body)[who]
        pairs = who[touching_pairs(where, size, space, ROUNDING, own)[0]]
        now = set((pairs[:, 0] * count + pairs[:, 1]).tolist())
        if before is not None:
            began += len(now - before)
            lived += len(where) * float(when[k] - when[k - 1])
        before = now
    return 2 * began / lived if lived > 0 else np.nan


def _instants(
    pos: ArrayLike, radius: ArrayLike, alive: ArrayLike | None
) -> Iterator[tuple[Floats, Floats, NDArray[np.intp]]]:
    """Yield positions, radii and indices of the agents that are alive and finite, instant by instant."""
    where, size = np.asarray(pos), np.asarray(radius, np.float64)
    if where.ndim != 3 or size.shape != where.shape[1:2]:
        raise ValueError(f"pos: of shape {where.shape}, radius of {size.shape}: must be (T, N, D) and (N,)")
    there = np.ones(where.shape[:2], np.bool_) if alive is None else np.asarray(alive, np.bool_)
    for now, some in zip(where, there, strict=True):
        here = np.flatnonzero(some & np.isfinite(now).all(axis=1))
        yield np.asarray(now[here], np.float64), size[here], here
