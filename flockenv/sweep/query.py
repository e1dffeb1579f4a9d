"""The query: how the living agents are sorted, once per instant, and how their blocks are walked through.

Below FEWEST_AGENTS, and where a grid would have too few cells, they are listed by number and everybody is a candidate;
else they are sorted by cell. What is sorted of each agent are its `fields`, a row each. A team of threads sorts
together, each its own agents, and each then walks through its own share of the sorted blocks.
"""

from __future__ import annotations

from flockenv.neighbours import FEWEST_AGENTS
from flockenv.sweep.parts import Parts, record_of
from flockenv.sweep.text import indented, indented_lines, lane, tuple_of

__all__ = ["query", "walk"]

_ARRAYS = {"x": "pos", "v": "vel", "t": "tie"}


def query(parts: Parts, fields: list[str]) -> list[str]:
    """Write how the living are sorted, with these fields of each."""
    return [
        f"periodic, shape = {parts.space.periodic}, (0, 0, 0)",
        "wait_for_team(sync, team)  # positions are everybody's",
        f"if n >= {FEWEST_AGENTS}:",
        "    shape = count_cells(",
        f"        pos, living, first, end, {parts.width}, rank, team, sync, bounds, size, reach, periodic, n,",
        "        cell, start, offset,",
        "    )",
        "nx = shape[0]",
        "if nx == 0:",
        indented(_fill(parts, fields), 4),
        "else:",
        indented(_sort(parts, fields), 4),
        "wait_for_team(sync, team)",
    ]


def _value(parts: Parts, field: str, place: str) -> str:
    """Write what a field of agent i is; `place` is where its first coordinate lies."""
    if field[1:].isdigit():
        array = _ARRAYS[field[0]]
        return f"{array}[{place} + {int(field[1:]) * parts.width}]"
    return "like(mass[0], i)" if field == "who" else f"{field}[i]"


def _derived(parts: Parts, fields: list[str], at: str) -> list[str]:
    """Write the rows of sorted agent `at` that follow from others: headings."""
    d, row = parts.dimension, {f: k for k, f in enumerate(fields)}
    lines = []
    if "h0" in row:
        lines.append("h = unit((" + ", ".join(f"sorted_[{row[f'v{k}']}, {at}]" for k in range(d)) + "))")
        lines += [f"sorted_[{row[f'h{k}']}, {at}] = h[{k}]" for k in range(d)]
    return lines


def _fill(parts: Parts, fields: list[str]) -> list[str]:
    """Write how the living are listed by number, for brute force: by one of a team."""
    d, row = parts.dimension, {f: k for k, f in enumerate(fields)}
    direct = [f"sorted_[{r}, at] = {_value(parts, f, 'place')}" for f, r in row.items() if f[0] != "h"]
    lanes = [
        f"sorted_[{r}, i] = " + (lane(parts, _ARRAYS[f[0]], int(f[1:])) if f[1:].isdigit() else _value(parts, f, ""))
        for f, r in row.items()
        if f[0] != "h"
    ]
    return [
        "if rank == 0:",
        "    if present == n:",
        f"        for block in range((n + {parts.width - 1}) // {parts.width}):",
        f"            base, row = np.uint64(block * {d * parts.width}), np.uint64(block * {parts.width})",
        f"            for l in range(np.uint64({parts.width})):",
        "                i = row + l",
        "                order[i] = i",
        indented(lanes + _derived(parts, fields, "i"), 16),
        "    else:",
        "        at = 0",
        "        for i in range(n):",
        "            if living[i] > 0:",
        f"                place = place_of(i, {d}, {parts.width})",
        "                order[at] = i",
        indented(direct + _derived(parts, fields, "at"), 16),
        "                at += 1",
    ]


def _sort(parts: Parts, fields: list[str]) -> list[str]:
    """Write how agents are put into their cells: whole records first, so that each is one distant place in memory."""
    d, record = parts.dimension, record_of(fields)
    row = {f: k for k, f in enumerate(fields)}
    place = []
    if parts.space.periodic:
        inside = tuple_of(f"pos[place + # * {parts.width}]", d)
        place.append(f"inside, _ = confine(size, radius[i], {inside}, {inside})")
    for j, f in enumerate(record):
        wrapped = parts.space.periodic and f[0] == "x" and f[1:].isdigit()
        place.append(f"records[to, {j}] = " + (f"inside[{f[1:]}]" if wrapped else _value(parts, f, "place")))
    spread = [f"sorted_[{row[f]}, at] = records[at, {j}]" for j, f in enumerate(record) if f in row]
    return [
        f"for i in range(first * {parts.width}, min(end * {parts.width}, n)):",
        "    c = cell[i]",
        "    if c >= 0:",
        f"        to, place = np.int64(offset[rank, c]), place_of(i, {d}, {parts.width})",
        "        offset[rank, c] = to + 1",
        indented(place, 8),
        "wait_for_team(sync, team)",
        "for at in range(present * rank // team, present * (rank + 1) // team):",
        f"    i = np.int64(records[at, {record.index('who')}])",
        "    order[at] = i",
        indented(spread + _derived(parts, fields, "at"), 4),
    ]


def walk(parts: Parts, lines: list[str]) -> list[str]:
    """Write the loop over this thread's blocks of sorted agents: [at, upto) is one, `found` ranges may be near it."""
    w = parts.width
    return [
        "met, line, spot = 0, 0, 0",
        "if nx == 0:",
        f"    blocks = (present + {w - 1}) // {w}",
        f"    at, stop = blocks * rank // team * {w}, min(blocks * (rank + 1) // team * {w}, present)",
        "else:  # whole rows of cells, so that blocks are the same for any number of threads",
        "    rows = shape[1] * shape[2]",
        "    while line < rows and start[line * nx] * team < present * rank:",
        "        line += 1",
        "    until = line",
        "    while until < rows and start[until * nx] * team < present * (rank + 1):",
        "        until += 1",
        "    at, stop = np.int64(start[line * nx]), np.int64(start[until * nx])",
        "while at < stop:",
        "    found = 1",
        "    if nx == 0:",
        f"        upto = min(at + {w}, present)",
        "        ranges[0, 0], ranges[0, 1], ranges[0, 2] = 0, present, 1",
        "    else:",
        "        line = row_of(at, start, line, nx)",
        f"        upto = min(at + {w}, np.int64(start[(line + 1) * nx]))",
        "        found, spot = candidates(at, upto, line, max(spot, line * nx), shape, start, periodic, ranges)",
        "    block = np.uint64(at)",
        *indented_lines(lines, 4),
        "    at = upto",
    ]
