"""The query: how the living agents are sorted, once per instant, and how their blocks are walked through.

In a small scene, and where a grid would have too few cells, they are listed by number and everybody is a candidate;
else they are sorted by cell. What is sorted of each agent are its `fields`: as a record of its own, and in small scenes
as a row each. A team of threads sorts together, each its own agents, and each then walks through its own share of the
sorted blocks.
"""

from __future__ import annotations

from flockenv.neighbours import DISTANT
from flockenv.sweep.parts import Parts, record_of, sorted_at
from flockenv.sweep.scratch import SMALL_STRIDE
from flockenv.sweep.text import Slots, array_of, copied, in_blocks, indented, indented_lines, lanes_of, place_of
from flockenv.tiles import FAR_FROM_HOME

__all__ = ["counted", "listed", "listed_at", "query", "walk"]

AHEAD = 8
"""So many blocks on it is asked for the places of records."""

_ARRAYS = {"x": "pos", "v": "vel", "t": "tie", "d": "facing", "a": "aiming"}


def query(parts: Parts, fields: list[str], inside: bool = False, may_lie: bool = False) -> list[str]:
    """Write how the living are sorted, with these fields of each.

    inside: nobody is outside of a periodic box; may_lie: agents may lie in order, `arranged`, and not by number.
    """
    return [
        f"periodic, shape = {parts.space.periodic}, (0, 0, 0, 0, 0)",
        "wait_for_team(sync, team)  # positions are everybody's",
        *(_counted(parts, inside, may_lie and parts.homely) if parts.sorts else []),
        "nx = shape[0]",
        "if nx == 0:",
        indented(_enter(parts, fields) if parts.sorts else _fill(parts, fields), 4),
        *(["else:", indented(_sort(parts, fields, inside, may_lie), 4)] if parts.sorts else []),
        "wait_for_team(sync, team)",
    ]


def counted(parts: Parts, kernel: str, inside: bool, more: str = "") -> str:
    """Write how many cells there are per axis, once every agent's has been found; see `count_cells`."""
    return (
        f"{kernel}(pos, living, first, end, {parts.width}, rank, team, sync, bounds, size, reach, "
        f"{parts.space.periodic}, {parts.space.periodic and not inside}, n, {more}cell, start, offset)"
    )


def _counted(parts: Parts, inside: bool, homely: bool) -> list[str]:
    """Write how agents are counted in the cells, and strangers listed where agents lie in tiles."""
    plain = f"shape = {counted(parts, 'count_cells', inside)}"
    if not homely:
        return [plain]
    listed = f"shape = {counted(parts, 'count_from_home', inside, 'homes, strangers, tally, ')}"
    return ["if arranged:", f"    {listed}", "else:", f"    {plain}"]


def listed(parts: Parts) -> str:
    """Write which agent is in lane l of a block."""
    return f"np.uint64({Slots(parts)('home0')})" if parts.sorts else "np.uint64(order[block + l])"


def listed_at(parts: Parts, fields: list[str]) -> str:
    """Write which agent is the one at place `#`."""
    if not parts.sorts:
        return "order[np.uint64(#)]"
    record = record_of(fields)
    return f"np.int32(records[np.uint64(#) * np.uint64({len(record)}) + np.uint64({record.index('place')})])"


def _value(parts: Parts, field: str, place: str) -> str:
    """Write what a field of agent i is; `place` is where its first coordinate lies."""
    if field[1:].isdigit():
        array = _ARRAYS[field[0]]
        return f"{array}[{place} + np.uint64({int(field[1:]) * parts.width})]"
    return {"who": "ident[i]", "place": "i"}.get(field, f"{array_of(field)}[i]")


def _headings(parts: Parts, numbers: dict[str, str]) -> list[str]:
    """Write the headings of an agent whose other numbers lie there, if any law asks for them."""
    if "h0" not in numbers:
        return []
    axes = range(parts.dimension)
    return [f"h = unit(({', '.join(numbers[f'v{k}'] for k in axes)}))", *(f"{numbers[f'h{k}']} = h[{k}]" for k in axes)]


def _fill(parts: Parts, fields: list[str]) -> list[str]:
    """Write how the living of a small scene are listed by number, a row for each number: by one of a team."""
    d, w = parts.dimension, parts.width
    one = {f: sorted_at(k, "at") for k, f in enumerate(fields)}
    many = {f: sorted_at(k, "(row + l)") for k, f in enumerate(fields)}
    each = ["order[at] = i", *(f"{to} = {_value(parts, f, 'place')}" for f, to in one.items() if f[0] != "h")]
    return [
        "if rank == 0:",
        "    if present == n:",
        f"        for block in range((n + {w - 1}) // {w}):",
        f"            base, row = np.uint64(block * {d * w}), np.uint64(block * {w})",
        indented(_lines(parts, fields), 12),
        *([f"            for l in range(np.uint64({w})):"] if "h0" in fields else []),
        *indented_lines(_headings(parts, many), 16),
        "    else:",
        *indented_lines(_one_by_one(parts, "number_", [*each, *_headings(parts, one)]), 8),
    ]


def _lines(parts: Parts, fields: list[str]) -> list[str]:
    """Write how a block is copied, a vector at a time."""
    out = []
    for r, f in enumerate(fields):
        to = f"np.uint64({r * SMALL_STRIDE}) + row"
        if f[1:].isdigit() and f[0] != "h":
            place = f"base + np.uint64({int(f[1:]) * parts.width})"
            out.append(copied(parts, "sorted_rows", to, _ARRAYS[f[0]], place))
        elif f[0] != "h":
            out.append(copied(parts, "sorted_rows", to, "ident" if f == "who" else array_of(f), "row"))
    return out


def _enter(parts: Parts, fields: list[str]) -> list[str]:
    """Write how the living of a large scene are entered by number, a record each, for brute force: by one of a team."""
    record = record_of(fields)
    each = [
        f"records[at * np.uint64({len(record)}) + np.uint64({j})] = {_value(parts, f, 'place')}"
        for j, f in enumerate(record)
    ]
    return [
        "if rank == 0:",
        "    if arranged:  # everybody lives, and is not where his number says",
        "        for i in range(np.uint64(n)):",
        "            cell[np.uint64(ident[i])] = i",
        *indented_lines(_one_by_one(parts, "np.uint64(cell[number_]) if arranged else number_", each), 4),
    ]


def _one_by_one(parts: Parts, who: str, lines: list[str]) -> list[str]:
    """Write how the living are listed one after another, by number; which agent has a number is handed over."""
    return [
        "at = np.uint64(0)",
        "for number_ in range(np.uint64(n)):",
        f"    i = {who}",
        "    if living[i] > 0:",
        f"        place = {place_of(parts, parts.dimension)}",
        indented(lines, 8),
        "        at += np.uint64(1)",
    ]


def _sort(parts: Parts, fields: list[str], inside: bool, may_lie: bool) -> list[str]:
    """Write how agents are put into their cells: as whole records, so that each is one distant place in memory."""
    w, record = parts.width, record_of(fields)
    wraps = parts.space.periodic and not inside
    lanes = [_lanes(parts, f, wraps) for f in record[1:]]
    sources, places = (", ".join(each) for each in zip(*lanes, strict=True))
    putting = [
        f"if n >= {DISTANT}:  # a distant place for each: asked for in good time",
        f"    later = np.uint64(min(block + np.uint64({AHEAD}), np.uint64(end - 1)) * np.uint64({w}))",
        f"    for l in range(np.uint64({w})):",
        "        there = np.uint64(offset[rank, np.uint64(max(cell[later + l], np.int32(0)))])",
        f"        ask_for(records, there * np.uint64({len(record)}))",
        *(_confined(parts) if wraps else []),
        f"put_records(records, ({sources},), ({places},), {w}, cell, row, offset[rank], np.uint64(n))",
    ]
    return [
        *in_blocks(parts, "first", "end", putting),
        *(_in_turn(parts, len(record)) if may_lie else []),
    ]


def _in_turn(parts: Parts, length: int) -> list[str]:
    """Write how records that came in the order of places come in the order of numbers."""
    return ["if arranged:", "    wait_for_team(sync, team)", *indented_lines(_ordered(parts, length), 4)]


def _ordered(parts: Parts, length: int) -> list[str]:
    """Write how records are put in the order of numbers within each cell, of a world that lies in order."""
    every = [
        "rows = shape[1] * shape[2]",
        "for line in range(rows * rank // team, rows * (rank + 1) // team):  # a row at a time stays in the cache",
        "    mine, beyond = np.int64(start[line * nx]), np.int64(start[(line + 1) * nx])",
        f"    order_records(records, cell, ident, {length}, mine, beyond, offset[rank])",
    ]
    if not parts.homely:
        return every
    mine = f"first * {parts.width}"
    return [
        "away = np.int64(0)",
        "for r in range(team):",
        "    away += tally[team + r]",
        f"if away * {FAR_FROM_HOME} > n:",
        *indented_lines(every, 4),
        "else:",
        f"    till = {mine} + tally[team + rank]",
        f"    order_cells(records, {length}, ident, start, offset, rank, strangers, {mine}, till)",
        "    if team > 1:",
        "        cells = nx * shape[1] * shape[2]",
        "        mine, beyond = cells * rank // team, cells * (rank + 1) // team",
        f"        order_shared(records, {length}, ident, start, offset, team, mine, beyond)",
    ]


def _lanes(parts: Parts, field: str, wraps: bool) -> tuple[str, str]:
    """Write in which array a field of a block's agents lies side by side, and from which place on."""
    if not field[1:].isdigit():
        return ("ident" if field == "who" else array_of(field)), "row"
    k = int(field[1:])
    if wraps and field[0] == "x":
        return "lanes", f"np.uint64({parts.slots[f'inside{k}'] * parts.width})"
    return _ARRAYS[field[0]], f"base + np.uint64({k * parts.width})"


def _confined(parts: Parts) -> list[str]:
    """Write where the agents of a block are that a stage of a method may have brought out of a periodic box."""
    x, slot = lanes_of(parts, "pos"), Slots(parts)
    return [
        f"for l in range(np.uint64({parts.width})):",
        f"    inside, _ = confine(size, radius[row + l], {x}, {x})",
        *(f"    {slot(f'inside{k}')} = inside[{k}]" for k in range(parts.dimension)),
    ]


def _take(parts: Parts, fields: list[str]) -> list[str]:
    """Write how the records of a block become lanes: its own numbers, which its laws then read."""
    if not parts.sorts:
        return []
    w, slot = parts.width, Slots(parts)
    mine = {f: slot(f"mine{k}") for k, f in enumerate(fields)}
    places = [parts.slots["home0"], *(parts.slots[f"mine{fields.index(f)}"] for f in record_of(fields)[1:])]
    return [
        f"out_of_records(lanes, ({', '.join(f'np.uint64({k * w})' for k in places)},), block, {w}, records)",
        *([f"for l in range(np.uint64({w})):"] if "h0" in fields else []),
        *indented_lines(_headings(parts, mine), 4),
    ]


def walk(parts: Parts, fields: list[str], lines: list[str]) -> list[str]:
    """Write the loop over this thread's blocks of sorted agents: [at, upto) is one, `found` ranges may be near it.

    Of each agent these fields have been sorted.
    """
    w = parts.width
    by_number = [
        f"blocks = (present + {w - 1}) // {w}",
        f"at, stop = blocks * rank // team * {w}, min(blocks * (rank + 1) // team * {w}, present)",
    ]
    everybody = [f"upto = min(at + {w}, present)", "ranges[0, 0], ranges[0, 1], ranges[0, 2] = 0, present, 1"]
    if not parts.sorts:
        block = ["found = 1", *everybody, "block = np.uint64(at)", *lines, "at = upto"]
        return ["met = 0", *by_number, "while at < stop:", *indented_lines(block, 4)]
    return [
        "met, line, spot = 0, 0, 0",
        "if nx == 0:",
        *indented_lines(by_number, 4),
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
        *indented_lines(everybody, 8),
        "    else:",
        "        line = row_of(at, start, line, nx)",
        f"        upto = min(at + {w}, np.int64(start[(line + 1) * nx]))",
        "        found, spot = candidates(at, upto, line, max(spot, line * nx), shape, start, periodic, ranges)",
        "    block = np.uint64(at)",
        *indented_lines([*_take(parts, fields), *lines], 4),
        "    at = upto",
    ]
