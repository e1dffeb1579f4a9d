"""Workspace: scratch of those who step one world, counted and allocated before anything moves."""

from __future__ import annotations

import mmap
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.effects.base import ties
from flockenv.kernels import LINE
from flockenv.neighbours import FEWEST_ARRANGED, MAX_RANGES
from flockenv.state import Body
from flockenv.sweep import SMALL_STRIDE, Parts, Table
from flockenv.tiles import HOME
from flockenv.tree import BUCKETS, LEVELS, tree_sizes

__all__ = ["Workspace"]

HUGE = 2**21
"""Bytes of a large page."""

ALL = 2**64 - 1
"""A mask that leaves every place as it is."""

GAP = 5 * LINE
"""Bytes between two arrays of scratch."""


@dataclass(frozen=True)
class Workspace:
    """Scratch of a team of threads that step one world: what a step writes and nobody reads afterwards."""

    arrays: dict[str, NDArray[Any]]
    own: tuple[dict[str, NDArray[Any]], ...]  # lanes, ranges and spread of each thread
    _given: dict[tuple[int, str], tuple[NDArray[Any], ...]] = field(default_factory=dict)

    @classmethod
    def allocate(cls, parts: Parts, body: Body, table: Table, team: int = 1) -> Workspace:
        """Return scratch for the sweep, the query and the integrator, by the names of sweep.SHARED."""
        d, agents, dtype = parts.dimension, len(body.mass), body.mass.dtype
        width = parts.width
        padded = -(-agents // width) * width
        sorts = parts.sweeps and parts.sorts
        carried = agents if parts.arranges and agents >= FEWEST_ARRANGED else 1
        tiled = padded if parts.homely and carried > 1 else 0
        swept, cells = padded if parts.sweeps else 1, agents if sorts else 1
        real: dict[str, int | tuple[int, ...]] = {
            **dict.fromkeys(("pos", "vel", "want"), padded * d),
            "aside": padded * parts.aside,
            "stages": (parts.integrator.stages, padded * d),
            **dict.fromkeys(("mass", "radius", "max_speed", "max_force", "living", "ident"), padded),
            "tie": padded * d if "t0" in parts.fields else 1,
            "pulled": padded * d if parts.pulls else 1,
            "carrying": padded * d if parts.flows else 1,
            "frame": max(padded * parts.framed + parts.counters, 1),
            "felt": max(swept * d * len(parts.targets), 1),
            "sorted_": 1 if sorts else parts.rows * SMALL_STRIDE,
            "records": (swept + 2 * width if sorts else 1) * parts.numbers,
            "luggage": (carried + 1) * parts.luggage_size,
        }
        real |= {name: size if parts.treed else 1 for name, size in tree_sizes(agents, width, d, team).items()}
        whole = {
            "order": (1 if sorts else swept,),
            "cell": (padded if sorts else 1,),
            "start": (cells + 1,),
            "offset": (team, cells),
            "homes": (tiled // width * HOME + 1,),
            "strangers": (tiled + 1,),
            "tree_place": (2 * padded if parts.treed else 1,),
        }
        wanted: dict[str, Any] = {name: (shape, np.dtype(dtype)) for name, shape in real.items()}
        wanted |= {name: (shape, np.dtype(np.int32)) for name, shape in whole.items()}
        arrays = _zeros(wanted)
        arrays |= {"bounds": np.zeros((team, 6)), "tally": np.zeros(2 * team, np.int64), "sync": np.zeros(8, np.int64)}
        keys, digits = (2 * padded, BUCKETS + LEVELS + 1) if parts.treed else (1, 1)
        arrays |= {"tree_key": np.zeros(keys, np.int64), "tree_digit": np.zeros(digits, np.int64)}
        for name, pad in (("mass", 1), ("radius", 0), ("max_speed", 1), ("max_force", 1)):
            arrays[name][:] = pad
            arrays[name][:agents] = getattr(body, name)
        for k, name in enumerate(parts.frame_numbers):
            first = padded * (parts.frame_rows + d * parts.aims + k)
            arrays["frame"][first : first + agents] = getattr(body, name)
            arrays["frame"][first + agents : first + padded] = 1
        arrays["ident"][:] = np.arange(padded)
        if "t0" in parts.fields:
            blocks = ties(padded, d).reshape(-1, width, d).transpose(0, 2, 1)
            arrays["tie"][:] = blocks.reshape(-1)
        arrays["number"] = np.arange(SMALL_STRIDE, dtype=np.int32)
        arrays |= {"bond_place": table.place, "bond_number": table.number, "bond_start": table.start}
        lanes = {"lanes": (len(parts.slots) * width, np.dtype(dtype))}
        spread = _spread(body, width)
        own = tuple(
            _zeros(lanes) | {"ranges": np.zeros((MAX_RANGES, 3), np.int64), "spread": spread.copy()}
            for _ in range(team)
        )
        return cls(arrays, own)

    def of(self, rank: int, names: str) -> tuple[NDArray[Any], ...]:
        """Return what one of the team is given: the arrays of these names, "pos, vel, ..."."""
        if (rank, names) not in self._given:
            arrays = self.arrays | self.own[rank]
            self._given[rank, names] = tuple(arrays[name] for name in names.split(", "))
        return self._given[rank, names]


def _spread(body: Body, width: int) -> NDArray[np.uint64]:
    """Return what place of a body's numbers, and of what is asked of agents, is masked with: 0 if all have the same.

    What all have in common is read where the first block has it.
    """
    numbers = (body.mass, body.radius, body.max_speed, body.max_force)
    alike = len(body.mass) >= width and all((number == number[0]).all() for number in numbers)
    return np.array([0 if alike else ALL, ALL], np.uint64)


def _zeros(wanted: Mapping[str, tuple[int | tuple[int, ...], np.dtype[Any]]]) -> dict[str, NDArray[Any]]:
    """Return arrays of zeros in one piece of memory, each beginning on a cache line: no vector is loaded from two.

    Between two there is a gap, or places that are used together would compete for the same few lines of the cache.
    """
    sizes = {name: int(np.prod(shape)) * kind.itemsize for name, (shape, kind) in wanted.items()}
    raw = _memory(sum(sizes.values()) + (len(sizes) + 1) * (LINE + GAP))
    at, out = -raw.ctypes.data % LINE, {}
    for name, (shape, kind) in wanted.items():
        out[name] = raw[at : at + sizes[name]].view(kind).reshape(shape)
        at += -(-sizes[name] // LINE) * LINE + GAP
    return out


def _memory(size: int) -> NDArray[np.uint8]:
    """Return zeros; where there are many, and the system has them, on large pages: fewer addresses to look up."""
    if size < HUGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return np.zeros(size, np.uint8)
    memory = mmap.mmap(-1, size + HUGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    memory.madvise(mmap.MADV_HUGEPAGE)
    raw = np.frombuffer(memory, np.uint8)
    return raw[-raw.ctypes.data % HUGE :]
