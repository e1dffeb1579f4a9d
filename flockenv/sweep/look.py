"""What tasks add: `look` finds who is near every agent of a world, for observations and rewards.

It asks the same query as the pair laws, and keeps, for each lane, sorted lists of the nearest few.
"""

from __future__ import annotations

from flockenv.sweep.pairs import me_of, meet_range, offset_of
from flockenv.sweep.parts import SMALL_STRIDE, Parts
from flockenv.sweep.query import listed, listed_at, query, walk
from flockenv.sweep.text import SHARED, Slots, indented, indented_lines, lanes_of, tuple_of

__all__ = ["look_source"]


def look_source(parts: Parts) -> str:
    """Return the source of `look`: what is near every agent of a world, by the query that pair laws use."""
    if parts.look is None:
        return ""
    at = len(parts.parameters()) - 2
    return f'''
@kernel
def look(
    x_, alive, obstacle_x, obstacle_radius, b, params,
    near_square, near_who, near_count, obstacle_gap, obstacle_who, obstacle_count, {SHARED},
):
    """Write, for every agent of world b, the nearest agents (K, N) and obstacles (J, N), and how many (N,).

    Where there is none, it is infinitely far, and some number stands there: of agents, one that exists.
    """
    n, rank, team = x_.shape[2], 0, 1
    first, end = 0, (n + {parts.width - 1}) // {parts.width}
    size, reach, within = {tuple_of("params[#]", parts.dimension)}, params[{at}], params[{at + 1}]
    present, arranged, time, drawn = 0, False, params[0], np.uint64(0)  # nobody asks here what time it is, or draws
    for i in range(n):
        present += alive[b, i]
        living[i] = alive[b, i]
    for i in range(n if present < n else 0):  # who is absent is not asked, and everybody's obstacles are told
        near_count[i] = 0
        for k in range(near_square.shape[0]):
            near_square[k, i] = np.inf
    into_blocks(pos, x_, b, n, first, end)
{indented([*_look_at_agents(parts), *_look_at_obstacles(parts)], 4)}
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
    return [*_tags(parts), *query(parts, parts.seen_fields), *walk(parts, parts.seen_fields, block)]


def _tags(parts: Parts) -> list[str]:
    """Write what keys need to know before."""
    if not parts.keyed:
        return []
    return [
        "farthest, room = key_read(np.float32(np.inf)), 1",
        "while room < n:",
        "    room *= 2",
        "tags = np.int32(room - 1)",
    ]


def _keyed(parts: Parts) -> list[str]:
    """Write how a block keeps lists of keys, one longer than asked for, and tells them if that leaves no doubt.

    A candidate takes two instructions for each place of a list then, not five. Where two neighbours of a list differ in
    less than the bits that are left of a square, all is found in the other way, once more. Squares are worked out anew.
    """
    assert parts.look is not None
    slot, many, d, w = Slots(parts), parts.look.agents, parts.dimension, parts.width
    keys = [slot(f"square{k}") for k in range(many + 1)]
    keep = ["far = key_of(square, j, tags) if other & (square < within) else farthest"]
    for place in keys:
        keep += [
            f"near = key_read({place})",
            f"{place} = key_written(far if far < near else near)",
            "far = near if far < near else far",
        ]
    lines = [
        "sure = present == n",
        "if sure:",
        f"    for l in range(np.uint64({w})):",
        *(f"        {place} = np.inf" for place in keys),
        "    for r in range(found):",
        *indented_lines(meet_range(parts, parts.seen_fields, keep, exact=True), 8),
        "    doubt = False",
        f"    for l in range(np.uint64({w})):",
        "        i, count = block + l, np.int32(0)",
        f"        following = key_read({keys[0]})",
    ]
    for k in range(many):
        lines += [
            f"        key, following = following, key_read({keys[k + 1]})",
            f"        near_who[{k}, i] = tag_of(key, tags)",
            "        count += 1 if key < farthest else 0",
            "        doubt |= same_key(key, following, tags) & (following < farthest)",
        ]
    lines += ["        near_count[i] = count", "    sure = not doubt", "if sure:"]
    for k in range(many):
        picked = [slot(f"picked{j}") for j in range(d)]
        at, first = parts.slots["picked0"] * w, parts.seen_fields.index("x0") * SMALL_STRIDE
        lines.append(
            f"    pick(lanes, np.uint64({at}), np.uint64({w}), sorted_, np.uint64({first}), np.uint64({SMALL_STRIDE}), "
            f"np.uint64({d}), np.uint64(n), near_who, np.uint64({k}) * np.uint64(near_who.shape[1]) + block, {w})"
        )
        lines += [
            f"    for l in range(np.uint64({w})):",
            f"        {me_of(parts, parts.seen_fields)}",
            f"        to = {offset_of(parts, '(' + ', '.join(picked) + ')')}",
            f"        square = exact_dot(to, to) if key_read({keys[k]}) < farthest else like(within, np.inf)",
            f"        near_square[{k}, block + l] = square",
        ]
    return lines


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
