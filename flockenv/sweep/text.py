"""Small pieces of text that every part of a source is made of, and the names of what its functions are handed.

Indices are counted without a sign: of a signed one numba asks whether it counts from the end, and the loop over the
lanes would stay scalar.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from flockenv.effects.base import Effect
from flockenv.sweep.parts import Parts

__all__ = [
    "Slots", "alone", "array_of", "asked", "given", "in_blocks", "in_common",
    "indented", "indented_lines", "lane", "lanes_of", "nearest_images", "needed",
    "place_of", "tuple_of",
]  # fmt: skip


def tuple_of(template: str, dimension: int) -> str:
    """Write a tuple: `#` stands for the axis number."""
    return "(" + ", ".join(template.replace("#", str(k)) for k in range(dimension)) + ",)"


def lane(parts: Parts, array: str, k: int, base: str = "base") -> str:
    """Write coordinate k of lane l of the block that begins at `base`."""
    return f"{array}[{base} + np.uint64({k * parts.width}) + l]"


def lanes_of(parts: Parts, array: str, base: str = "base") -> str:
    """Write all coordinates of lane l of the block that begins at `base`, as a tuple."""
    return "(" + ", ".join(lane(parts, array, k, base) for k in range(parts.dimension)) + ")"


def place_of(parts: Parts, rows: int) -> str:
    """Write where the first of `rows` numbers of agent i lies in an array of blocks; the next is a width further."""
    w = parts.width
    return f"(i // np.uint64({w})) * np.uint64({rows * w}) + i % np.uint64({w})"


def in_common(parts: Parts) -> list[str]:
    """Write where block `block` has its bodies (`one`), who lives (`live`), and what its agents are to do (`wish`).

    In a large world what all have in common is read where the first block has it: large worlds wait for memory.
    """
    if not parts.arranges:
        return ["one, live, wish = row, row, base"]
    whole = f"present == n and (block + np.uint64(1)) * np.uint64({parts.width}) <= np.uint64(n)"
    return [
        "one, wish = row & spread[0], base & spread[1]",
        f"live = np.uint64(0) if {whole} else row",
    ]


def in_blocks(parts: Parts, first: str, end: str, lines: list[str]) -> list[str]:
    """Write what is done in the blocks [first, end): of each, vectors lie from `base` on, and numbers from `row` on."""
    w = parts.width
    return [
        f"for block in range(np.uint64({first}), np.uint64({end})):",
        f"    base, row = block * np.uint64({parts.dimension * w}), block * np.uint64({w})",
        *indented_lines(lines, 4),
    ]


def asked(parts: Parts) -> list[str]:
    """Write how what is asked of the agents of world b, if anything, comes into blocks."""
    size = parts.dimension * parts.width
    nothing = [f"want[first * {size} : end * {size}] = 0"]
    if parts.arranges:
        nothing = [f"want[:{size}] = 0", "spread[1] = np.uint64(0)"]
    return [
        "if drive.shape[1] > 0:",
        "    into_blocks(want, drive, asked, n, first, end)",
        *["    spread[1] = ~np.uint64(0)"] * parts.arranges,
        "else:",
        *indented_lines(nothing, 4),
    ]


def alone(parts: Parts, medium: str = "zero(x)", one: str = "i", aim: bool = True) -> str:
    """Write agent i, at x with velocity v, as the laws of one agent see it; `one`: where its body lies.

    aim: may it be asked where it wants to go?
    """
    function = "alone" if aim or not parts.aims else "alone_without_aim"
    return f"{function}(scratch, key[b], time, base + l, i, {one}, x, v, {medium})"


def array_of(name: str) -> str:
    """Write the array of numbers of that name: of what goes on inside agents there are several."""
    return f"scratch.inner[{name.removeprefix('inner')}]" if name.startswith("inner") else name


def given(parts: Parts, k: int) -> str:
    """Write by which name the numbers of effect k are given to its laws."""
    return f"near{k}" if parts.space.periodic and parts.effects[k].places else f"p{k}"


def nearest_images(parts: Parts, effects: list[tuple[int, Effect]]) -> list[str]:
    """Write the numbers of those that know places anew: on a torus, with the images nearest to agent i, at x."""
    return [f"near{k} = images_of_{k}(p{k}, size, x)" for k, _ in effects if given(parts, k) == f"near{k}"]


def needed(lines: Sequence[str], body: Sequence[str]) -> list[str]:
    """Leave away those of some lines `name, other = value` that name nothing which the body, or a later one, reads."""
    kept: list[str] = []
    read = set(re.findall(r"\w+", "\n".join(body)))
    for line in reversed(lines):
        names, _, value = line.partition(" = ")
        if read.intersection(names.split(", ")):
            kept.insert(0, line)
            read.update(re.findall(r"\w+", value))
    return kept


def indented(lines: list[str], indent: int) -> str:
    """Write lines below each other, as one text; what has several lines is indented as a whole."""
    return "\n".join(indented_lines(lines, indent))


def indented_lines(lines: list[str], indent: int) -> list[str]:
    """Write lines below each other, one by one."""
    return [" " * indent + line for block in lines for line in block.splitlines()]


class Slots:
    """Writes places in the scratch of lanes by name."""

    def __init__(self, parts: Parts) -> None:
        self.slots, self.width = parts.slots, parts.width

    def __call__(self, name: str) -> str:
        """Write the place of one number, in lane l."""
        return f"lanes[{self.first(name)} + l]"

    def first(self, name: str) -> str:
        """Write where the lanes of one number begin."""
        return f"np.uint64({self.slots[name] * self.width})"

    def all(self, prefix: str) -> list[str]:
        """Write every place whose name begins so, in order."""
        return [self(name) for name in self.slots if name.startswith(prefix)]
