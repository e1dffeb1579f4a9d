"""Laws that act on everybody, however far: each agent meets all others, or groups of them where these are far away.

Few agents, and many where an effect asks for exactness, are met one by one, lane beside lane (`_direct`); many others
by blocks that walk through a tree (`_walk`, see flockenv.tree). Which of the two depends on the number of agents and
the effect's opening alone. What it comes to is left in `pulled`, by agent, where bonds add to it.
"""

from __future__ import annotations

from flockenv.effects.base import Effect
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import Slots, indented, lanes_of, place_of, tuple_of
from flockenv.tree import BUCKETS, LEVELS, LISTED

__all__ = ["far", "tree_imports"]


def far(parts: Parts) -> list[str]:
    """Write how everybody meets all others; nothing at all if no law asks for it.

    It begins with a wait even where pairs have been met: positions are everybody's, and counts have been read then.
    """
    if not parts.far:
        return []
    direct = [pair for pair in parts.far if pair not in parts.treed]
    return [
        "wait_for_team(sync, team)  # positions are everybody's",
        *(_direct(parts, direct) if direct else []),
        *(_line_up(parts) if parts.treed else []),
        *(
            line
            for k, effect in parts.treed
            for line in _walk(parts, k, effect, bool(direct) or k != parts.treed[0][0])
        ),
        *([] if parts.treed else ["wait_for_team(sync, team)  # nobody moves before all have looked"]),
    ]


def tree_imports(parts: Parts) -> list[str]:
    """Write what a tree needs to have imported."""
    return ["from flockenv.tree import gather, line_up, weigh"] if parts.treed else []


def _direct(parts: Parts, effects: list[tuple[int, Effect]]) -> list[str]:
    """Write how this thread's blocks meet everybody alive, all laws at once."""
    d, w, slot = parts.dimension, parts.width, Slots(parts)
    sums = slot.all("far")
    return [
        "if rank == 0:",
        "    work[b, 2] += present * present",
        "for block in range(np.uint64(first), np.uint64(end)):",
        f"    base, row = block * np.uint64({d * w}), block * np.uint64({w})",
        f"    for l in range(np.uint64({w})):",
        indented([f"{s} = 0" for s in sums], 8),
        "    for j in range(np.uint64(n)):",
        "        if living[j] > 0:",
        f"            place = j // np.uint64({w}) * np.uint64({d * w}) + j % np.uint64({w})",
        f"            xj, heavy = {tuple_of(f'pos[place + np.uint64(# * {w})]', d)}, mass[j]",
        f"            for l in range(np.uint64({w})):",
        f"                x, m = {lanes_of(parts, 'pos')}, mass[row + l]",
        indented(_meet(effects, sums, "one"), 16),
        f"    for l in range(np.uint64({w})):",
        indented([f"pulled[base + np.uint64({k * w}) + l] = {s}" for k, s in enumerate(sums)], 8),
    ]


def _meet(effects: list[tuple[int, Effect]], sums: list[str], count: str) -> list[str]:
    """Write what somebody at xj, `heavy`, adds to the sums of a lane: of an agent at x of mass m.

    A node is as heavy as its weight is; `count` is the weight of whoever is met where a law counts heads.

    Nobody is pulled by who is in the very same place, himself above all: there is no direction.
    """
    lines = [
        "to = sub(xj, x)",
        "square, o, one = dot(to, to), like(m, -0.0), like(m, 1.0)",
        "there, z = square > o, zero(x)",
        "me = Me(m, x, z, z, m, m, m, m, z, time, z, key[b], z, m, ())",
    ]
    for k, effect in effects:
        weight = "heavy" if effect.weighs_mass else count
        lines.append(f"says = far_law_{k}(p{k}, me, Far(to, square, {weight}))")
        # a sum of a choice, see pairs
        lines += [f"{s} += says[{j}] if there else o" for j, s in enumerate(sums)]
    return lines


def _line_up(parts: Parts) -> list[str]:
    """Write how one thread sorts the living for a tree."""
    return [
        "if rank == 0:",
        "    tree = (tree_key, tree_place, tree_digit, tree_leaf)",
        f"    line_up(pos, living, mass, n, {parts.width}, sync, bounds, size, *tree)",
    ]


def _walk(parts: Parts, k: int, effect: Effect, adds: bool) -> list[str]:
    """Write how this thread's share of the sorted blocks walks through the tree of one effect."""
    d, w, slot = parts.dimension, parts.width, Slots(parts)
    sums = slot.all("far")
    by_mass = str(effect.weighs_mass)
    gathered = (
        f"gather(tree_leaf, tree_node, tree_digit, present, {w}, size, {by_mass}, p{k}.opening, np.int64(block), "
        "level, node, tree_near, begin)"
    )
    return [
        "if rank == 0:",
        f"    weigh(tree_leaf, present, {w}, size, {by_mass}, tree_digit, tree_node)",
        "wait_for_team(sync, team)  # the tree is everybody's",
        f"met, blocks, begin = 0, (present + {w - 1}) // {w}, rank * {LISTED * (d + 1)}",
        "for block in range(np.uint64(blocks * rank // team), np.uint64(blocks * (rank + 1) // team)):",
        f"    base, held = block * np.uint64({(d + 1) * w}), min({w}, present - np.int64(block) * {w})",
        f"    for l in range(np.uint64({w})):",
        indented([f"{s} = 0" for s in sums], 8),
        f"    level, node = np.int64(tree_digit[{BUCKETS + LEVELS}]), 0",
        f"    while level <= tree_digit[{BUCKETS + LEVELS}]:",
        f"        many, level, node = {gathered}",
        "        met += many * held",
        f"        for j in range(np.uint64(begin), np.uint64(begin + many * {d + 1}), np.uint64({d + 1})):",
        f"            xj, heavy = {tuple_of('tree_near[j + np.uint64(#)]', d)}, tree_near[j + np.uint64({d})]",
        f"            for l in range(np.uint64({w})):",
        f"                x, m = {lanes_of(parts, 'tree_leaf')}, tree_leaf[base + np.uint64({d * w}) + l]",
        indented(_meet([(k, effect)], sums, "heavy"), 16),
        "    for l in range(np.uint64(held)):",
        f"        i = np.uint64(tree_place[block * np.uint64({w}) + l])",
        f"        place = {place_of(parts, d)}",
        indented([f"pulled[place + np.uint64({j * w})] {'+' * adds}= {s}" for j, s in enumerate(sums)], 8),
        "tally[rank] = met",
        "wait_for_team(sync, team)  # what is pulled was written by others",
        "if rank == 0:",
        "    for r in range(team):",
        "        work[b, 2] += tally[r]",
    ]
