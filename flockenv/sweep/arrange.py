"""A large world is put in order for as long as a call of several steps lasts: who is near in space is near in memory.

Agents are numbered by whoever made the scene, and neighbours by number lie anywhere in space: sorting them by cell is
one distant place in memory per agent and step. So at the beginning of a call all that is known of an agent moves to
where its tile of cells comes, by number within (`flockenv.tiles`). Each step then sorts what is nearly
sorted; and at the end everybody goes home. `ident` says who is where in between. Sums do not notice: within a cell
agents are met in the order of their numbers all the same.
"""

from __future__ import annotations

from flockenv.neighbours import FEWEST_ARRANGED, STEPS_ARRANGED, WORTH_ARRANGING
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import array_of, in_blocks, indented, indented_lines, place_of

__all__ = ["go_home", "move_in"]

AHEAD = 64
"""So many agents on it is asked for what has been packed."""

_COMMON = {**dict.fromkeys(("mass", "radius", "max_speed", "max_force"), 0), "want": 1}
"""What all may have in common, and by which mask it is read then, see `text.in_common`."""


def move_in(parts: Parts) -> list[str]:
    """Write how agents move to where their tiles come, if that is worth it; sets `arranged`."""
    if not parts.arranges:
        return ["arranged = False"]
    to = ["c = np.uint64(cell[i])", "cell[i] = offset[rank, c]", "offset[rank, c] += 1"]
    periodic, wraps = parts.space.periodic, parts.space.periodic and not parts.confines
    counted = f"pos, living, first, end, {parts.width}, rank, team, sync, bounds, size, reach"
    return [
        "arranged = False",
        f"least = {FEWEST_ARRANGED} if team > 1 and count >= {STEPS_ARRANGED} else {WORTH_ARRANGING}",
        "if count > 1 and n >= least and present == n:",
        f"    shape = count_tiles({counted}, {periodic}, {wraps}, n, cell, start, offset)",
        "    arranged = shape[0] > 0",
        "if arranged:",
        indented(_carry(parts, to), 4),
        *([f"    find_homes(first, end, {parts.width}, n, shape, start, homes)"] if parts.homely else []),
    ]


def go_home(parts: Parts) -> list[str]:
    """Write how agents move back to where their numbers say."""
    if not parts.arranges:
        return []
    return ["if arranged:", indented(_carry(parts, ["cell[i] = np.int32(ident[i])"]), 4)]


def _carry(parts: Parts, to: list[str]) -> list[str]:
    """Write how this thread's agents pack, all of them are carried, and its new ones unpack.

    What is packed goes to distant places, in no order; `to` writes where into `cell`, in which nobody is -1.
    """
    d, w, count = parts.dimension, parts.width, parts.luggage_size
    luggage = [field.partition(" ") for field in parts.luggage]  # an array, and of vectors which axis
    sources = "".join(f"{array_of(name)}, " for name, _, _ in luggage)
    places = "".join(_place(name, axis, w) for name, _, axis in luggage)
    packing = [
        f"for i in range(row, min(row + np.uint64({w}), np.uint64(n))):",
        *indented_lines(to, 4),
        f"put_lines(luggage, ({sources}), ({places}), {w}, cell, row, {count}, np.uint64(n))",
    ]
    return [
        *in_blocks(parts, "first", "end", packing),
        "wait_for_team(sync, team)",
        f"for i in range(np.uint64(first * {w}), np.uint64(min(end * {w}, n))):",
        f"    place = {place_of(parts, d)}",
        f"    ask_for(luggage, (i + np.uint64({AHEAD})) * np.uint64({count}))",
        *indented_lines(_unpacked(parts, luggage), 4),
    ]


def _place(name: str, axis: str, width: int) -> str:
    """Write where a number of a block's agents lies in an array, in the first block if all have it in common."""
    mask = f" & spread[{_COMMON[name]}]" if name in _COMMON else ""
    return f"(base{mask}) + np.uint64({int(axis) * width}), " if axis else f"row{mask}, "


def _unpacked(parts: Parts, luggage: list[tuple[str, str, str]]) -> list[str]:
    """Write how agent i unpacks: all but what everybody has in common, which lies where it lay."""
    own: dict[int | None, list[str]] = {None: [], 0: [], 1: []}
    for k, (name, _, axis) in enumerate(luggage):
        to = f"{name}[place + np.uint64({int(axis) * parts.width})]" if axis else f"{array_of(name)}[i]"
        own[_COMMON.get(name)].append(f"{to} = luggage[i * np.uint64({parts.luggage_size}) + np.uint64({k})]")
    kinds = [[f"if spread[{k}] > np.uint64(0):", *indented_lines(own[k], 4)] for k in (0, 1)]
    return [*own[None], *kinds[0], *kinds[1]]
