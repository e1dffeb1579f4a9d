"""The fundamental diagram: how speed and flow fall with density, beside what was measured on people."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "JUELICH", "Bin", "Deviation", "diagram", "from_weidmann", "in_juelich", "required_length", "single_file_density",
    "single_file_speed", "weidmann_flow", "weidmann_speed",
]  # fmt: skip

Floats = NDArray[np.float64]

FREE, GAMMA, JAM = 1.34, 1.913, 5.4
"""Weidmann's free speed, m/s, his gamma, 1/m^2, and the density at which nobody walks, 1/m^2."""

JUELICH = (
    (0.5, 1.0, 0.94, 0.12), (1.0, 1.5, 0.70, 0.12), (1.5, 2.0, 0.56, 0.08), (2.0, 2.5, 0.42, 0.11),
    (2.5, 3.0, 0.35, 0.06), (3.0, 3.5, 0.23, 0.04), (3.5, 4.0, 0.17, 0.05),
)  # fmt: skip
"""From, to, 1/m^2; mean and deviation of speed, m/s: one-way in a corridor 1.8 m wide, ug-180, n = 434."""

AT_REST, PER_SPEED = 0.36, 1.06
"""m, and s: the length that who walks in single file needs (Seyfried 2005)."""


class Bin(NamedTuple):
    """What was measured between two densities."""

    low: float  # 1/m^2
    high: float
    samples: int
    density: float  # 1/m^2, mean; NaN of an empty bin, as all that follows
    speed: float  # m/s, mean
    spread: float  # m/s, standard deviation
    flow: float  # 1/(m s), mean of density times speed


class Deviation(NamedTuple):
    """How far speeds are from a reference."""

    samples: int
    mean: float  # m/s, over - under
    rms: float  # m/s
    worst: float  # m/s, of the means of bins: the largest, by amount


def weidmann_speed(density: ArrayLike) -> Floats:
    """Return v = 1.34 (1 - exp(-1.913 (1/rho - 1/5.4))), m/s, at densities in 1/m^2; 1.34 at 0, 0 from 5.4 on.

    Raises ValueError, of one line, for a negative density. Source: Weidmann 1993, Transporttechnik der Fussgaenger,
    with Kladek's formula. Real corridors lie below it: `JUELICH`.
    """
    rho = np.asarray(density, np.float64)
    if (rho < 0).any():
        raise ValueError(f"density = {float(rho.min()):g} per m^2: must be >= 0")
    with np.errstate(divide="ignore"):
        speed = FREE * (1.0 - np.exp(-GAMMA * (1.0 / rho - 1.0 / JAM)))
    return np.asarray(np.maximum(speed, 0.0))


def weidmann_flow(density: ArrayLike) -> Floats:
    """Return the specific flow rho v of Weidmann's curve, 1/(m s): 1.225 at most, at 1.75 per m^2."""
    return np.asarray(np.asarray(density, np.float64) * weidmann_speed(density))


def required_length(speed: ArrayLike) -> Floats:
    """Return the length of path d = .36 + 1.06 v that somebody needs in single file, m, at speeds in m/s.

    Source: Seyfried, Steffen, Klingsch, Boltes 2005, J. Stat. Mech. P10002 (arXiv physics/0506170), .1 < v < 1 m/s.
    """
    return np.asarray(AT_REST + PER_SPEED * np.asarray(speed, np.float64))


def single_file_speed(density: ArrayLike) -> Floats:
    """Return v = (1/rho - .36) / 1.06, m/s, at densities per m of path; at least 0. See `required_length`."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.maximum((1.0 / np.asarray(density, np.float64) - AT_REST) / PER_SPEED, 0.0))


def single_file_density(place: ArrayLike, length: float) -> Floats:
    """Return 1 / (the way to the next ahead), per m, of everybody on a closed path of some length, m.

    place (N,) m along the path; a lone walker has all of it for himself; inf where two are in one place.
    """
    s = np.asarray(place, np.float64) % length
    order = np.argsort(s, kind="stable")
    gap = np.diff(s[order], append=s[order][:1] + length)
    out = np.empty(len(s))
    with np.errstate(divide="ignore"):
        out[order] = 1.0 / gap
    return out


def diagram(density: ArrayLike, speed: ArrayLike, edges: ArrayLike | None = None) -> list[Bin]:
    """Return what speeds (S,), m/s, were measured at which densities (S,), 1/m^2, in bins between edges.

    By default edges are those of `JUELICH`, with one more below. A sample whose speed is NaN (nobody was there) is
    none.
    Raises ValueError, of one line, if there are not as many of both.
    """
    rho, v = (np.asarray(each, np.float64).ravel() for each in (density, speed))
    if len(rho) != len(v):
        raise ValueError(f"density has {len(rho)} samples, speed {len(v)}: must be as many")
    some = np.isfinite(rho) & np.isfinite(v)
    rho, v = rho[some], v[some]
    ends = np.asarray([0.0, *(b[0] for b in JUELICH), JUELICH[-1][1]] if edges is None else edges, np.float64)
    bins = []
    for low, high in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        here = (rho >= low) & (rho < high)
        x, y = rho[here], v[here]
        means = (x.mean(), y.mean(), y.std(), (x * y).mean()) if len(x) else (np.nan,) * 4
        bins.append(Bin(low, high, len(x), *map(float, means)))
    return bins


def from_weidmann(density: ArrayLike, speed: ArrayLike, low: float = 0.5, high: float = 3.0) -> Deviation:
    """Return how far speeds (S,) are from Weidmann's at densities (S,) between low and high, 1/m^2; NaN of no sample.

    `worst` is over means of bins half a person per m^2 wide, the last as wide as is left. A model is near enough if it
    stays below .25 m/s: real corridors are .15 m/s below the curve (JuPedSim's validation of ug-180). Raises
    ValueError, of one line, for bounds that leave nothing between them.
    """
    if not 0 <= low < high:
        raise ValueError(f"low = {low:g}: must be at least 0 and below high = {high:g}")
    bins = [b for b in diagram(density, speed, [*np.arange(low, high - 1e-9, 0.5), high]) if b.samples]
    rho, v = (np.asarray(each, np.float64).ravel() for each in (density, speed))
    here = (rho >= low) & (rho < high) & np.isfinite(v)
    if not here.any():
        return Deviation(0, np.nan, np.nan, np.nan)
    off = v[here] - weidmann_speed(rho[here])
    worst = max((b.speed - float(weidmann_speed(b.density)) for b in bins), key=abs)
    return Deviation(len(off), float(off.mean()), float(np.sqrt((off**2).mean())), worst)


def in_juelich(density: ArrayLike, speed: ArrayLike) -> float:
    """Return the share of bins of `JUELICH` with samples whose mean lies within one deviation; NaN if none has any."""
    found = diagram(density, speed)[1:]
    inside = [
        abs(b.speed - mean) <= spread for b, (_, _, mean, spread) in zip(found, JUELICH, strict=True) if b.samples
    ]
    return float(np.mean(inside)) if inside else np.nan
