"""Counter-based random numbers: a function (key, step, agent, channel) -> number, without state.

A world's key is mixed from its seed and the number of its episode. So world k of a batch draws the same numbers as it
would alone, for any number of threads, and a copied world continues like the original. The mixer is the finaliser of
SplitMix64 (Steele, Lea & Flood 2014, doi 10.1145/2660193.2660195).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flockenv.jit.decorators import kernel, python_of

__all__ = ["key_of", "keys_of", "normal", "quick_normal", "smooth", "uniform"]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_START = np.uint64(0x5EED)
_TO_UNIT = 2.0**-53
MASK = (1 << 64) - 1


@kernel
def mix(a: np.uint64, b: np.uint64) -> np.uint64:
    """Return the hash `a` with the number `b` mixed in."""
    z = (a ^ (b * _GOLDEN)) + _GOLDEN
    z = (z ^ (z >> _30)) * _M1
    z = (z ^ (z >> _27)) * _M2
    return z ^ (z >> _31)


@kernel
def uniform(key: np.uint64, step: int, agent: int, channel: int) -> float:
    """Draw from U[0, 1): the same four arguments always give the same number.

    key: of the world, by `key_of`; step: number of the step or draw; agent: its index; channel: an integer >= 0, a
    different one for each use.
    """
    h = mix(mix(mix(key, np.uint64(step)), np.uint64(agent)), np.uint64(channel))
    return float(h >> _11) * _TO_UNIT


@kernel
def normal(key: np.uint64, step: int, agent: int, channel: int) -> float:
    """Draw from N(0, 1) (Box-Muller; uses channels 2c and 2c + 1 of a separate family).

    key: of the world, by `key_of`; step: number of the step or draw; agent: its index; channel: an integer >= 0, a
    different one for each use.
    """
    u = 1.0 - uniform(key, step, agent, 2 * channel + 1_000_003)
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * uniform(key, step, agent, 2 * channel + 1_000_004))


@kernel
def quick_normal(key: np.uint64, step: int, agent: int, channel: int) -> float:
    """Draw from N(0, 1) by inversion of one uniform number: a third of the time of `normal`, to seven digits.

    key: of the world, by `key_of`; step: number of the step or draw; agent: its index; channel: an integer >= 0, a
    different one for each use.

    Source: Wichura 1988, algorithm AS 241 (PPND7), Applied Statistics 37, 477.
    """
    p = uniform(key, step, agent, channel)
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        top = ((59.109374720 * r + 159.29113202) * r + 50.434271938) * r + 3.3871327179
        return q * top / (((67.187563600 * r + 78.757757664) * r + 17.895169469) * r + 1.0)
    r = math.sqrt(-math.log(max(min(p, 1.0 - p), 0.5 * _TO_UNIT)))  # uniform numbers are multiples of _TO_UNIT
    if r <= 5.0:
        r -= 1.6
        top = ((0.17023821103 * r + 1.3067284816) * r + 2.7568153900) * r + 1.4234372777
        size = top / ((0.12021132975 * r + 0.73700164250) * r + 1.0)
    else:
        r -= 5.0
        top = ((0.017337203997 * r + 0.42868294337) * r + 3.0812263860) * r + 6.6579051150
        size = top / ((0.012258202635 * r + 0.24197894225) * r + 1.0)
    return size if q > 0.0 else -size


@kernel
def smooth(key: np.uint64, time: float, agent: int, channel: int) -> float:
    """Draw a number in [-1, 1] that changes smoothly with time, whose unit is the correlation time.

    key: of the world, by `key_of`; time: in units of the correlation time; agent: its index; channel: an integer >= 0,
    a different one for each use.

    Coherent noise, after Perlin (1985): independent draws at integer times, interpolated between them by the weight
    6 s^5 - 15 s^4 + 10 s^3. As it is a function of time, the signal is the same for every dt.
    """
    begin = math.floor(time)
    s = time - begin
    first = 2.0 * uniform(key, begin, agent, channel) - 1.0
    second = 2.0 * uniform(key, begin + 1, agent, channel) - 1.0
    return first + (second - first) * s * s * s * (10.0 + s * (6.0 * s - 15.0))


def key_of(seed: int, episode: int) -> np.uint64:
    """Return the key of a world, by the same mixing as in the kernels, in plain Python.

    seed: of the world, an integer, of which the lowest 64 bits count; episode: its number, from 0.
    """
    return np.uint64(_mix(_mix(int(_START), seed & MASK), episode & MASK))


def keys_of(seeds: NDArray[np.uint64], episodes: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the keys of many worlds at once.

    seeds, episodes: (B,) uint64, as of `key_of`.
    """
    plain = python_of(mix)  # on arrays, whose integers wrap as in a kernel
    return np.asarray(plain(plain(_START, seeds), episodes))


def _mix(a: int, b: int) -> int:
    z = ((a ^ (b * int(_GOLDEN) & MASK)) + int(_GOLDEN)) & MASK
    z = ((z ^ (z >> 30)) * int(_M1)) & MASK
    z = ((z ^ (z >> 27)) * int(_M2)) & MASK
    return z ^ (z >> 31)
