"""What tasks add: `look` finds who is near every agent of a world, for observations and rewards.

It asks the same query as the pair laws, and keeps, for each lane, sorted lists of the nearest few.
"""

from __future__ import annotations

from flockenv.sweep.handed import OPEN_SCRATCH
from flockenv.sweep.pairs import me_of, meet_range, offset_of
from flockenv.sweep.parts import Parts, sorted_at
from flockenv.sweep.query import listed, listed_at, query, walk
from flockenv.sweep.scratch import SMALL_STRIDE
from flockenv.sweep.text import Slots, indented, indented_lines, lanes_of, tuple_of

__all__ = ["AT_ONCE", "KEYS", "look_source", "merged"]

KEYS = "key_of, key_read, key_written, ordered, pick, same_key, tag_of"
"""What is called where lists of the nearest are kept as keys."""

AT_ONCE = 4
"""So many candidates at once are put into lists of keys."""


def look_source(parts: Parts) -> str:
    """Return the source of `look`: what is near every agent of a world, by the query that pair laws use."""
    if parts.look is None:
        return ""
    at = parts.number_plan.look[0]
    return f'''
@kernel
def look(
    x_, alive, obstacle_x, obstacle_radius, b, params,
    near_square, near_who, near_count, obstacle_gap, obstacle_who, obstacle_count, near_pos, scratch,
):
    """Write, for every agent of world b, the nearest agents (K, N) and obstacles (J, N), and how many (N,).

    Where there is none, it is infinitely far, and some number stands there: of agents, one that exists. Returns whether
    it has written where these are, too (D, K, N).
    """
    {OPEN_SCRATCH}
    n, rank, team = x_.shape[2], 0, 1
    first, end = 0, (n + {parts.width - 1}) // {parts.width}
    size, reach, within = {tuple_of("params[#]", parts.dimension)}, params[{at}], params[{at + 1}]
    present, arranged, time, drawn = 0, False, params[0], np.uint64(0)  # nobody asks here what time it is, or draws
    placed = {parts.keyed}
    for i in range(n):
        present += alive[b, i]
        living[i] = alive[b, i]
    for i in range(n if present < n else 0):  # who is absent is not asked, and everybody's obstacles are told
        near_count[i] = 0
        for k in range(near_square.shape[0]):
            near_square[k, i] = np.inf
    into_blocks(pos, x_, b, n, first, end)
{indented([*_look_at_agents(parts), *_look_at_obstacles(parts)], 4)}
    return placed
'''


def _look_at_agents(parts: Parts) -> list[str]:
    """Write the query, and how every block keeps lists of its nearest agents."""
    assert parts.look is not None
    slot, many = Slots(parts), parts.look.agents
    if not many:
        return []
    candidate = "far, place = square if other & (square < within) else like(square, np.inf), like(square, j)"
    keep = [candidate, *_insert(slot, "square", "place", many)]
    lanes = f"np.uint64({parts.width})"
    block = [
        f"for l in range({lanes}):",
        *(f"    {slot(f'square{k}')} = np.inf; {slot(f'place{k}')} = 0" for k in range(many)),
        "for r in range(found):",
        *indented_lines(meet_range(parts, parts.seen_fields, keep, exact=parts.keyed), 4),
        "if nx == 0 and present == n:  # sorted by number: the lists lie as the lanes do",
        *_tell(slot, many, lanes, agent="block + l", who="np.int32(#)"),
        "else:",
        *_tell(slot, many, "np.uint64(upto - at)", agent=listed(parts), who=listed_at(parts, parts.seen_fields)),
    ]
    if parts.keyed:
        block = [*_keyed(parts), "if not sure:", *indented_lines(block, 4)]
    return [*query(parts, parts.seen_fields), *_tags(parts), *walk(parts, parts.seen_fields, block)]


def _tags(parts: Parts) -> list[str]:
    """Write what keys need to know before, and candidates after the last one: infinitely far, NaN around a box."""
    if not parts.keyed:
        return []
    return [
        "nobody, room = np.uint32(0xFFFFFFFF), 1",
        "while room < n:",
        "    room *= 2",
        "tags = np.int32(room - 1)",
        "edge = key_of(within, np.int32(0), tags)",
        f"for j in range(np.uint64(n), np.uint64(n + {AT_ONCE - 1})):",
        f"    {sorted_at(parts.seen_fields.index('x0'), 'j')} = np.inf",
    ]


def _keyed(parts: Parts) -> list[str]:
    """Write how a block keeps lists of keys, one longer than asked for, and tells them if that leaves no doubt.

    Where two neighbours of a list, or one and the edge of sight, differ in less than the bits that are left of a
    square, all is found in the other way, once more. Squares are worked out anew.
    """
    assert parts.look is not None
    slot, many, d, w = Slots(parts), parts.look.agents, parts.dimension, parts.width
    keys = [slot(f"square{k}") for k in range(many + 1)]
    lines = [
        "sure = present == n",
        "if sure:",
        f"    for l in range(np.uint64({w})):",
        *(f"        {place} = key_written(nobody)" for place in keys),
        f"    for j in range(np.uint64(0), np.uint64(n), np.uint64({AT_ONCE})):",
        f"        for l in range(np.uint64({w})):",
        *indented_lines(_met(parts, keys), 12),
        "    doubt = False",
        f"    for l in range(np.uint64({w})):",
        "        i, count = block + l, np.int32(0)",
        f"        following = key_read({keys[0]})",
    ]
    for k in range(many):
        lines += [
            f"        key, following = following, key_read({keys[k + 1]})",
            "        near = key < edge",
            f"        near_who[{k}, i] = tag_of(key, tags) if near else np.int32(0)",
            "        count += np.int32(1) if near else np.int32(0)",
            "        doubt |= (near & same_key(key, following, tags)) | same_key(key, edge, tags)",
        ]
    first = parts.seen_fields.index("x0") * SMALL_STRIDE
    lines += ["        near_count[i] = count", "    sure = not doubt", "placed &= sure", "if sure:"]
    lines.append("    agents, listed = np.uint64(n), np.uint64(near_who.shape[1])")
    lines.append(f"    table, length = np.uint64({first}), np.uint64({SMALL_STRIDE})")
    for k in range(many):
        there = ", ".join(f"near_pos[{j}, {k}, block + l]" for j in range(d))
        lines += [
            f"    line, beside = np.uint64({k}) * listed + block, np.uint64({many}) * listed",
            "    rows = sorted_rows",
            f"    pick(near_pos, line, beside, rows, table, length, np.uint64({d}), agents, near_who, line, {w})",
            f"    for l in range(np.uint64({w})):",
            f"        {me_of(parts, parts.seen_fields)}",
            f"        to = {offset_of(parts, f'({there})')}",
            "        square = exact_dot(to, to)",
            f"        near_square[{k}, block + l] = square if key_read({keys[k]}) < edge else like(within, np.inf)",
        ]
    return lines


def _met(parts: Parts, keys: list[str]) -> list[str]:
    """Write how the candidates from j on come into the list of a lane."""
    row = [sorted_at(parts.seen_fields.index(f"x{k}"), "(j + np.uint64(#))") for k in range(parts.dimension)]
    lines = [me_of(parts, parts.seen_fields), "mine = number[block + l]"]
    for c in range(AT_ONCE):
        there = ", ".join(place.replace("#", str(c)) for place in row)
        lines += [
            f"to, tag = {offset_of(parts, f'({there})')}, number[j + np.uint64({c})]",
            f"come{c} = key_of(exact_dot(to, to), tag, tags)",
            f"come{c} = nobody if tag == mine else come{c}",
        ]
    return lines + merged(keys)


def merged(keys: list[str]) -> list[str]:
    """Write how the keys come0, come1, ... are put into a list in order, which lies at such places, and stays as long.

    One after the other, into a list of seven, that takes 13 instructions a key, and this 8: they are sorted, the lesser
    of the list's last and the first of them, and so on, are the nearest, and a row that rises and then falls is in
    order after as many rounds as its length has bits (Batcher, "Sorting networks and their applications", AFIPS 1968).
    """
    many = len(keys)
    lines = [_in_order(f"come{a}", f"come{b}") for a, b in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2))]
    lines += [f"list{k} = key_read({place})" for k, place in enumerate(keys)]
    lines += [f"list{many - 1 - c} = ordered(list{many - 1 - c}, come{c})[0]" for c in range(min(AT_ONCE, many))]
    length = 1 << (many - 1).bit_length()  # as if as many as are missing of that were nearer than everybody
    half, missing = length // 2, length - many
    while half:
        firsts = [k for k in range(missing, length) if not k & half]
        lines += [_in_order(f"list{k - missing}", f"list{k - missing + half}") for k in firsts]
        half //= 2
    return lines + [f"{place} = key_written(list{k})" for k, place in enumerate(keys)]


def _in_order(one: str, other: str) -> str:
    """Write how two keys change places unless the first is the lesser."""
    return f"{one}, {other} = ordered({one}, {other})"


def _tell(slot: Slots, many: int, lanes: str, agent: str, who: str) -> list[str]:
    """Write how the lists of so many lanes are told; `who` is the agent at sorted place `#`."""
    lists = [(k, slot(f"square{k}"), who.replace("#", slot(f"place{k}"))) for k in range(many)]
    return [
        f"    for l in range({lanes}):",
        f"        i, count = {agent}, np.int32(0)",
        *(f"        near_square[{k}, i] = {square}; near_who[{k}, i] = {name}" for k, square, name in lists),
        *(f"        count += 1 if {square} < np.inf else 0" for _, square, _ in lists),
        "        near_count[i] = count",
    ]


def _look_at_obstacles(parts: Parts) -> list[str]:
    """Write how every block keeps lists of the obstacles whose surfaces are nearest."""
    assert parts.look is not None
    slot, many, d = Slots(parts), parts.look.obstacles, parts.dimension
    if not many:
        return []
    return [
        "for block in range(first, end):",
        f"    base = np.uint64(block * {d * parts.width})",
        f"    for l in range(np.uint64({parts.width})):",
        *(f"        {slot(f'gap{k}')} = np.inf; {slot(f'which{k}')} = 0" for k in range(many)),
        "    for m in range(obstacle_radius.shape[1]):",
        f"        rho, centre = obstacle_radius[b, m], {tuple_of('obstacle_x[#, b, m]', d)}",
        "        limit = reach if rho > 0 else like(reach, -np.inf)  # no branch: lists stay in registers",
        f"        for l in range(np.uint64({parts.width})):",
        f"            to = offset_to(size, {lanes_of(parts, 'pos')}, centre)",
        "            far, place = norm(to) - rho, like(rho, m)",
        "            far = far if far < limit else like(rho, np.inf)",
        *indented_lines(_insert(slot, "gap", "which", many), 12),
        f"    for l in range(np.uint64({parts.width})):",
        f"        i, count = np.uint64(block * {parts.width}) + l, np.int32(0)",
        *(
            f"        obstacle_gap[{k}, i] = {slot(f'gap{k}')}; obstacle_who[{k}, i] = np.int32({slot(f'which{k}')}); "
            f"count += 1 if {slot(f'gap{k}')} < np.inf else 0"
            for k in range(many)
        ),
        "        obstacle_count[i] = count",
    ]


def _insert(slot: Slots, near: str, where: str, many: int) -> list[str]:
    """Write how (far, place) is put into the lanes' lists of the nearest, kept in order."""
    lines = []
    for k in range(many):
        a, b = slot(f"{near}{k}"), slot(f"{where}{k}")
        lines += [
            f"near, there = {a}, {b}",
            "closer = far < near",
            f"{a} = far if closer else near",
            f"{b} = place if closer else there",
            "far, place = near if closer else far, there if closer else place",
        ]
    return lines
