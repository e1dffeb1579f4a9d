"""A large world is put in order for as long as a call of several steps lasts: who is near in space is near in memory.

Agents are numbered by whoever made the scene, and neighbours by number lie anywhere in space: sorting them by cell is
one distant place in memory per agent and step. So at the beginning of a call all that is known of an agent moves to
where its cell comes; each step then sorts what is nearly sorted; and at the end everybody goes home. `ident` says who
is where in between. Sums do not notice: within a cell agents are met in the order of their numbers all the same.
"""

from __future__ import annotations

from flockenv.neighbours import WORTH_ARRANGING
from flockenv.sweep.parts import Parts
from flockenv.sweep.query import counted
from flockenv.sweep.text import indented, place_of

__all__ = ["go_home", "move_in"]

AHEAD = 16
"""Agents between asking for a place in memory and writing there."""


def move_in(parts: Parts) -> list[str]:
    """Write how agents move to where their cells come, if that is worth it; sets `arranged`."""
    if not parts.arranges:
        return ["arranged = False"]
    cell = ["c = np.uint64(cell[i])", "to = np.uint64(offset[rank, c])", "offset[rank, c] += 1"]
    soon = [
        f"ask_for(offset[rank], np.uint64(cell[min(i + np.uint64({2 * AHEAD}), last)]))",
        f"then = np.uint64(offset[rank, np.uint64(cell[min(i + np.uint64({AHEAD}), last)])])",
    ]
    return [
        "arranged = False",
        f"if count > 1 and n >= {WORTH_ARRANGING} and present == n:",
        f"    shape = {counted(parts, parts.confines)}",
        "    arranged = shape[0] > 0",
        "if arranged:",
        indented(_carry(parts, soon, cell), 4),
    ]


def go_home(parts: Parts) -> list[str]:
    """Write how agents move back to where their numbers say."""
    if not parts.arranges:
        return []
    soon, home = [f"then = np.uint64(ident[min(i + np.uint64({AHEAD}), last)])"], ["to = np.uint64(ident[i])"]
    return ["if arranged:", indented(_carry(parts, soon, home), 4)]


def _carry(parts: Parts, soon: list[str], to: list[str]) -> list[str]:
    """Write how this thread's agents pack, all of them are carried, and its new ones unpack.

    They go to distant places, in no order: `soon` finds which one a later agent goes `then`, about, so that its memory
    can be asked for.
    """
    w, count = parts.width, parts.luggage_size
    packed = [_place(parts, field) for field in parts.luggage]
    each = f"for i in range(np.uint64(first * {w}), np.uint64(min(end * {w}, n))):"
    place = f"    place = {place_of(parts, parts.dimension)}"
    return [
        f"last = np.uint64(min(end * {w}, n) - 1)",
        each,
        indented([*soon, f"ask_for(luggage, then * np.uint64({count}))"], 4),
        place,
        indented([*to, f"to *= np.uint64({count})"], 4),
        indented([f"luggage[to + np.uint64({k})] = {x}" for k, x in enumerate(packed)], 4),
        "wait_for_team(sync, team)",
        each,
        place,
        indented([f"{x} = luggage[i * np.uint64({count}) + np.uint64({k})]" for k, x in enumerate(packed)], 4),
    ]


def _place(parts: Parts, field: str) -> str:
    """Write where a number of agent i lies."""
    name, _, axis = field.partition(" ")
    return f"{name}[place + np.uint64({int(axis) * parts.width})]" if axis else f"{name}[i]"
