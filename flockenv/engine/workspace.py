"""Workspace: the scratch of a team of threads that step one world, counted and allocated before anything moves."""

from __future__ import annotations

import mmap
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.engine import OWN, TABLES, KernelPlan, Table, scratch_of
from flockenv.jit.cpu import LINE
from flockenv.model.state import Body
from flockenv.physics.effects.effect import separation_directions

__all__ = ["Workspace"]

HUGE = 2**21
"""Bytes of a large page."""

ALL = 2**64 - 1
"""A mask that leaves every place as it is."""

GAP = 5 * LINE
"""Bytes between two arrays of scratch."""


@dataclass(frozen=True)
class Workspace:
    """Scratch of a team of threads that step one world: arrays that a step writes, and nothing reads after it."""

    arrays: dict[str, NDArray[Any]]
    own: tuple[dict[str, NDArray[Any]], ...]  # lanes, ranges and spread of each thread
    _records: dict[tuple[int, Any], Any] = field(default_factory=dict)

    @classmethod
    def allocate(cls, parts: KernelPlan, body: Body, table: Table, team: int = 1) -> Workspace:
        """Return scratch for neighbours, queries and the integrator: the arrays of engine.scratch.scratch_of."""
        agents, wanted = len(body.mass), scratch_of(parts, len(body.mass), team)
        made = _zeros({name: array for name, array in wanted.items() if name not in (*OWN, *TABLES)})
        arrays = made | {name: getattr(table, name.removeprefix("bond_")) for name in TABLES if name in wanted}
        if "bond_kept" in arrays:
            arrays["bond_kept"] = table.kept.copy()
        padded = len(arrays["mass"])
        for name, pad in (("mass", 1), ("radius", 0), ("max_speed", 1), ("max_force", 1)):
            arrays[name][:] = pad
            arrays[name][:agents] = getattr(body, name)
        for name in parts.frame_numbers:
            arrays[name][:agents], arrays[name][agents:] = getattr(body, name), 1
        arrays["ident"][:] = np.arange(padded)
        if "tie" in arrays:
            blocks = (
                separation_directions(padded, parts.dimension)
                .reshape(-1, parts.width, parts.dimension)
                .transpose(0, 2, 1)
            )
            arrays["tie"][:] = blocks.reshape(-1)
        if "number" in arrays:
            arrays["number"][:] = np.arange(len(arrays["number"]))
        own = tuple(_zeros({name: wanted[name] for name in OWN if name in wanted}) for _ in range(team))
        for each in own:
            if "spread" in each:
                each["spread"][:] = _spread(body, parts.width)
        return cls(arrays, own)

    def of(self, rank: int, kind: Any) -> Any:
        """Return the arrays that one thread of the team is passed, as a record of this kind."""
        if (rank, kind) not in self._records:
            arrays: dict[str, Any] = self.arrays | self.own[rank]
            arrays["inner"] = tuple(array for name, array in arrays.items() if name.startswith("inner"))
            self._records[rank, kind] = kind(*(arrays[name] for name in kind._fields))
        return self._records[rank, kind]


def _spread(body: Body, width: int) -> NDArray[np.uint64]:
    """Return the masks of the places of a body's numbers, and of steering forces: 0 if all agents have the same.

    Numbers that all agents share are read from the first block.
    """
    numbers = (body.mass, body.radius, body.max_speed, body.max_force)
    alike = len(body.mass) >= width and all((number == number[0]).all() for number in numbers)
    return np.array([0 if alike else ALL, ALL], np.uint64)


def _zeros(wanted: Mapping[str, tuple[int | tuple[int, ...], np.dtype[Any]]]) -> dict[str, NDArray[Any]]:
    """Return arrays of zeros in one piece of memory, each beginning on a cache line: no vector spans two lines.

    There is a gap between two arrays, because places that are used together would else compete for the same cache
    lines.
    """
    sizes = {name: int(np.prod(shape)) * kind.itemsize for name, (shape, kind) in wanted.items()}
    raw = _memory(sum(sizes.values()) + (len(sizes) + 1) * (LINE + GAP))
    at, out = -raw.ctypes.data % LINE, {}
    for name, (shape, kind) in wanted.items():
        out[name] = raw[at : at + sizes[name]].view(kind).reshape(shape)
        at += -(-sizes[name] // LINE) * LINE + GAP
    return out


def _memory(size: int) -> NDArray[np.uint8]:
    """Return zeros; a large array on large pages, if the system has them: fewer address translations."""
    if size < HUGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return np.zeros(size, np.uint8)
    try:
        memory = mmap.mmap(-1, size + HUGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    except OSError:
        raise MemoryError(f"Unable to allocate {size / 1e6:,.0f} MB of scratch for the steps of a world") from None
    memory.madvise(mmap.MADV_HUGEPAGE)
    raw = np.frombuffer(memory, np.uint8)
    return raw[-raw.ctypes.data % HUGE :]
