"""The fundamental diagram: speed and flow over density, compared with measurements of pedestrians."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "JUELICH",
    "Bin",
    "Deviation",
    "diagram",
    "juelich_share",
    "required_length",
    "single_file_density",
    "single_file_speed",
    "weidmann_deviation",
    "weidmann_flow",
    "weidmann_speed",
]  # fmt: skip

Floats = NDArray[np.float64]

FREE, GAMMA, JAM = 1.34, 1.913, 5.4
"""Weidmann's free speed, m/s, gamma, 1/m^2, and jam density, 1/m^2, at which the speed is 0."""

JUELICH = (
    (0.5, 1.0, 0.94, 0.12), (1.0, 1.5, 0.70, 0.12), (1.5, 2.0, 0.56, 0.08), (2.0, 2.5, 0.42, 0.11),
    (2.5, 3.0, 0.35, 0.06), (3.0, 3.5, 0.23, 0.04), (3.5, 4.0, 0.17, 0.05),
)  # fmt: skip
"""Density from, to, 1/m^2; mean and deviation of speed, m/s: one-way corridor, 1.8 m wide, ug-180, n = 434."""

AT_REST, PER_SPEED = 0.36, 1.06
"""m, and s: length that a pedestrian in single file needs at rest, and its growth per m/s (Seyfried 2005)."""


class Bin(NamedTuple):
    """Samples between two densities."""

    low: float  # 1/m^2
    high: float
    samples: int
    density: float  # 1/m^2, mean; NaN in an empty bin, like all fields below
    speed: float  # m/s, mean
    spread: float  # m/s, standard deviation
    flow: float  # 1/(m s), mean of density times speed


class Deviation(NamedTuple):
    """Deviation of speeds from a reference."""

    samples: int
    mean: float  # m/s, signed
    rms: float  # m/s
    worst: float  # m/s, signed: the largest absolute deviation of a bin's mean


def weidmann_speed(density: ArrayLike) -> Floats:
    """Return v = 1.34 (1 - exp(-1.913 (1/rho - 1/5.4))), m/s, at densities in 1/m^2; 1.34 at 0, 0 from 5.4 on.

    Raises ValueError if a density is negative. Source: Weidmann 1993, Transporttechnik der Fussgaenger,
    with Kladek's formula. Real corridors lie below it: `JUELICH`.
    """
    rho = np.asarray(density, np.float64)
    if (rho < 0).any():
        raise ValueError(f"density = {float(rho.min()):g} per m^2: must be >= 0")
    with np.errstate(divide="ignore"):
        speed = FREE * (1.0 - np.exp(-GAMMA * (1.0 / rho - 1.0 / JAM)))
    return np.asarray(np.maximum(speed, 0.0))


def weidmann_flow(density: ArrayLike) -> Floats:
    """Return the specific flow rho v of Weidmann's curve, 1/(m s): 1.225 at most, at 1.75 per m^2.

    density: 1/m^2, of any shape.
    """
    return np.asarray(np.asarray(density, np.float64) * weidmann_speed(density))


def required_length(speed: ArrayLike) -> Floats:
    """Return the length of path d = .36 + 1.06 v, m, that a pedestrian in single file needs at speed v, m/s.

    Source: Seyfried, Steffen, Klingsch, Boltes 2005, J. Stat. Mech. P10002 (arXiv physics/0506170), .1 < v < 1 m/s.
    """
    return np.asarray(AT_REST + PER_SPEED * np.asarray(speed, np.float64))


def single_file_speed(density: ArrayLike) -> Floats:
    """Return v = (1/rho - .36) / 1.06, m/s, at densities per m of path; at least 0. See `required_length`.

    density: 1/m, of any shape.
    """
    with np.errstate(divide="ignore"):
        return np.asarray(np.maximum((1.0 / np.asarray(density, np.float64) - AT_REST) / PER_SPEED, 0.0))


def single_file_density(place: ArrayLike, length: float) -> Floats:
    """Return 1 / (the distance to the next agent ahead), per m, of each agent on a closed path of some length, m.

    place (N,) m along the path; a single agent has distance `length`; inf for two agents at the same place.
    """
    s = np.asarray(place, np.float64) % length
    order = np.argsort(s, kind="stable")
    gap = np.diff(s[order], append=s[order][:1] + length)
    out = np.empty(len(s))
    with np.errstate(divide="ignore"):
        out[order] = 1.0 / gap
    return out


def diagram(density: ArrayLike, speed: ArrayLike, edges: ArrayLike | None = None) -> list[Bin]:
    """Return speeds (S,), m/s, over densities (S,), 1/m^2, in bins between edges.

    density: (S,) 1/m^2; speed: (S,) m/s; edges: of the bins, 1/m^2, ascending.

    Default edges: those of `JUELICH`, and one more bin below. Samples that are not finite (an empty area) are left out.
    Raises ValueError if the lengths differ.
    """
    rho, v = (np.asarray(each, np.float64).ravel() for each in (density, speed))
    if len(rho) != len(v):
        raise ValueError(f"density has {len(rho)} samples, speed {len(v)}: must have the same length")
    finite = np.isfinite(rho) & np.isfinite(v)
    rho, v = rho[finite], v[finite]
    ends = np.asarray([0.0, *(b[0] for b in JUELICH), JUELICH[-1][1]] if edges is None else edges, np.float64)
    bins = []
    for low, high in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        here = (rho >= low) & (rho < high)
        x, y = rho[here], v[here]
        means = (x.mean(), y.mean(), y.std(), (x * y).mean()) if len(x) else (np.nan,) * 4
        bins.append(Bin(low, high, len(x), *map(float, means)))
    return bins


def weidmann_deviation(density: ArrayLike, speed: ArrayLike, low: float = 0.5, high: float = 3.0) -> Deviation:
    """Return the deviation of speeds (S,) from Weidmann's at densities (S,) in [low, high), 1/m^2; NaN without samples.

    density: (S,) 1/m^2; speed: (S,) m/s.

    `worst` is over the means of bins .5 per m^2 wide; the last may be narrower. A model is close enough if it stays
    below .25 m/s: real corridors are .15 m/s below the curve (JuPedSim's validation of ug-180).
    Raises ValueError unless 0 <= low < high.
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


def juelich_share(density: ArrayLike, speed: ArrayLike) -> float:
    """Return the share of sampled bins of `JUELICH` whose mean lies within one deviation; NaN without samples.

    density: (S,) 1/m^2; speed: (S,) m/s.
    """
    found = diagram(density, speed)[1:]
    inside = [
        abs(b.speed - mean) <= spread for b, (_, _, mean, spread) in zip(found, JUELICH, strict=True) if b.samples
    ]
    return float(np.mean(inside)) if inside else np.nan
