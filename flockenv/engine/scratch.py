"""The scratch of one world in progress: every array by name, declared once.

Which arrays there are follows from the scene, and their sizes from its number of agents. Kernels find them by name in
one record; allocation and the count of bytes use the same declaration. Arrays of vectors and of numbers lie in blocks
(see blocks.py). Each thread has its own of those in `OWN`; all others belong to the team that steps a world together.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from flockenv.geometry.barnes_hut import BUCKETS, LEVELS, tree_sizes
from flockenv.geometry.cell_list import FEWEST_ARRANGED, MAX_RANGES
from flockenv.geometry.spatial_sort import HOME
from flockenv.jit.section import record

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import KernelPlan

__all__ = ["OWN", "SMALL_STRIDE", "TABLES", "Array", "array_names", "scratch_bytes", "scratch_of", "scratch_record"]

SMALL_STRIDE = 128
"""Length of a row of listed agents if these are too few to be sorted by cell: their blocks, and one more."""

OWN = ("lanes", "ranges", "spread")
"""Arrays that each thread has for itself: running numbers of a block, ranges of candidates, masks of shared numbers."""

TABLES = ("bond_place", "bond_number", "bond_start", "bond_kept")
"""Tables of bonds, which a scene has made: passed along with scratch. All but the last, a copy, are only read."""

Array = tuple[tuple[int, ...], Any]
"""Shape and dtype."""


def scratch_of(parts: KernelPlan, agents: int, team: int = 1) -> dict[str, Array]:
    """Return the arrays that a team of threads needs to step one world, in order; those of `OWN` for one thread."""
    real, d, width = np.dtype(parts.dtype), parts.dimension, parts.width
    padded = -(-agents // width) * width

    def vectors(*names: str) -> dict[str, Array]:
        return dict.fromkeys(names, ((padded * d,), real))

    def numbers(*names: str) -> dict[str, Array]:
        return dict.fromkeys(names, ((padded,), real))

    found = vectors("pos", "vel", "requested_force")
    found["saved"] = (padded * parts.saved_size,), real
    if not parts.one_stage:
        found["stages"] = (parts.integrator.stages, padded * d), real
    found |= numbers("mass", "radius", "max_speed", "max_force", "living", "ident")
    found |= vectors(*parts.frame_vectors, *["aiming"] * parts.aims, *["advection"] * parts.flows)
    found |= vectors(*["tie"] * ("t0" in parts.fields), *["far_bond_force"] * parts.has_far_bond_force)
    found |= numbers(*parts.frame_numbers, *(f"inner{k}" for k in range(len(parts.inner))))
    found["counters"] = (max(parts.counters, 1),), real
    if parts.sweeps:
        found |= _query_arrays(parts, agents, team)
    if parts.arranges:
        found |= _tile_arrays(parts, agents)
    if parts.tree_effects:
        found |= _tree_arrays(parts, agents, team)
    if parts.bond_effects:
        kinds = np.dtype(np.int32), real, np.dtype(np.int64), real
        tables = dict(zip(TABLES, kinds, strict=True))
        found |= {name: ((0,), kind) for name, kind in tables.items() if name != "bond_kept" or parts.keeps_bonds}
    found |= {"tally": ((2 * team,), np.dtype(np.int64)), "sync": ((8,), np.dtype(np.int64))}
    return found | {"lanes": ((len(parts.slots) * width,), real)}


def _query_arrays(parts: KernelPlan, agents: int, team: int) -> dict[str, Array]:
    """Return the arrays of the neighbour search: rows for small worlds, records sorted by cell for others."""
    real, whole, width = np.dtype(parts.dtype), np.dtype(np.int32), parts.width
    padded = -(-agents // width) * width
    found: dict[str, Array] = {
        "pair_force": ((max(padded * parts.dimension * len(parts.targets), 1),), real),
        "number": ((SMALL_STRIDE,), whole),
        "ranges": ((MAX_RANGES, 3), np.dtype(np.int64)),
    }
    if not parts.sorts:
        return found | {"sorted_rows": ((parts.rows * SMALL_STRIDE,), real), "order": ((padded,), whole)}
    return found | {
        "records": (((padded + 2 * width) * parts.numbers,), real),
        "cell": ((padded,), whole),
        "start": ((agents + 1,), whole),
        "offset": ((team, agents), whole),
        "bounds": ((team, 6), np.dtype(np.float64)),
    }


def _tile_arrays(parts: KernelPlan, agents: int) -> dict[str, Array]:
    """Return the arrays for reordering a large world."""
    whole, width = np.dtype(np.int32), parts.width
    many = agents >= FEWEST_ARRANGED
    padded = -(-agents // width) * width if many else 0
    found: dict[str, Array] = {
        "reorder_buffer": (
            ((agents if many else 1) * parts.reordered_size + parts.reordered_size,),
            np.dtype(parts.dtype),
        ),
        "spread": ((2,), np.dtype(np.uint64)),
    }
    if parts.tracks_home_tiles:
        found |= {"home_tiles": ((padded // width * HOME + 1,), whole), "displaced": ((padded + 1,), whole)}
    return found


def _tree_arrays(parts: KernelPlan, agents: int, team: int) -> dict[str, Array]:
    """Return the arrays of a tree of agents, for laws about all agents."""
    real, long, width = np.dtype(parts.dtype), np.dtype(np.int64), parts.width
    padded = -(-agents // width) * width
    found: dict[str, Array] = {
        name: ((size,), real) for name, size in tree_sizes(agents, width, parts.dimension, team).items()
    }
    return found | {
        "tree_place": ((2 * padded,), np.dtype(np.int32)),
        "tree_key": ((2 * padded,), long),
        "tree_digit": ((BUCKETS + LEVELS + 1,), long),
        "bounds": ((team, 6), np.dtype(np.float64)),
    }


def scratch_record(parts: KernelPlan) -> Any:
    """Return the type of the record of all arrays for the kernels of a scene; its `inner` is a tuple of arrays."""
    names = [name for name in scratch_of(parts, parts.width) if not name.startswith("inner")]
    return record((*names, *["inner"] * bool(parts.inner)))


def array_names(parts: KernelPlan) -> tuple[str, ...]:
    """Return the names of all arrays of a world in progress, in the order of `blocks.arrays_of` and of scratch."""
    return ("pos", "vel", *(f"inner{k}" for k in range(len(parts.inner))), *scratch_record(parts)._fields)


def scratch_bytes(parts: KernelPlan, agents: int) -> int:
    """Return how many bytes the arrays take for one thread."""
    return sum(math.prod(shape) * kind.itemsize for shape, kind in scratch_of(parts, agents).values())
