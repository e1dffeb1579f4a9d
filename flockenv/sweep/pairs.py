"""The one sweep that all pair laws share: a block of sorted agents meets its candidates, lane beside lane.

Every pair law is evaluated for every candidate, and its sums keep what it says of those in sight; but contacts only of
candidates whom some agent of the block may touch, for these are few. A topological sight needs a pass before that one,
which finds how far its k nearest are. `look` meets its candidates in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from flockenv.effects.base import Sight
from flockenv.steering.others import ONE_PLACE
from flockenv.sweep.parts import Parts, record_of, sorted_at
from flockenv.sweep.query import listed, listed_at, query, walk
from flockenv.sweep.text import Slots, copied, given, indented, indented_lines, nearest_image, place_of, tuple_of

__all__ = ["me_of", "meet_range", "offset_of", "pairs"]

SELF = "own != number[l]"
"""Who is somebody else, of a candidate and a lane."""

ELSEWHERE = f"square > like(square, {ONE_PLACE!r})"
"""Who is in another place, and so somebody else."""

TOGETHER = f"({SELF}) & (square <= like(square, {ONE_PLACE!r}))"
"""Who else is in the same place."""


def pairs(parts: Parts) -> list[str]:
    """Write the query and the one sweep that all pair laws share; nothing at all if there is none."""
    if not parts.pairs:
        return []
    return [
        "# one query per instant, one sweep for all pair laws",
        "drawn = key[b]",
        "if rank == 0:",
        "    work[b, 1] += 1",
        *["    work[b, 3] += n * obstacle_radius.shape[1]" for _, e in parts.pairs if e.joined],
        *query(parts, parts.sorted_fields, parts.confines, parts.arranges),
        *walk(parts, parts.sorted_fields, [*_clear(parts), *_select_nearest(parts), *_sum_up(parts)]),
        "tally[rank] = met",
        "wait_for_team(sync, team)  # what is felt was written by others",
        "if rank == 0:",
        "    for r in range(team):",
        "        work[b, 2] += tally[r]",
    ]


def _clear(parts: Parts) -> list[str]:
    """Write how a block's running numbers begin."""
    slot = Slots(parts)
    zeros = [f"{s} = 0" for k, e in parts.pairs if not e.pair_start for s in slot.all(f"c{k}_")]
    zeros += [f"{s} = 0" for s in (*slot.all("here"), *slot.all("many"))]
    folds = [(k, slot.all(f"c{k}_")) for k, e in parts.pairs if e.pair_start]
    if folds:
        zeros += [me_of(parts, parts.sorted_fields), *_nearest_images(parts)]
    for k, slots in folds:
        zeros.append(f"found_ = pair_start_{k}({given(parts, k)}, me)")
        zeros += _obstacles(parts, k) if parts.effects[k].joined else []
        zeros += [f"{s} = found_[{j}]" for j, s in enumerate(slots)]
    far = [f"{s} = np.inf" for q in range(len(parts.sights)) for s in slot.all(f"near{q}_")]
    return [f"for l in range(np.uint64({parts.width})):", indented(zeros + far, 4)]


def _nearest_images(parts: Parts) -> list[str]:
    """Write the numbers of those effects with pair laws that know places anew: with the images nearest to me."""
    return [nearest_image(parts, k, "me.pos") for k, _ in parts.pairs if given(parts, k) == f"near{k}"]


def _obstacles(parts: Parts, k: int) -> list[str]:
    """Write how the fold of effect k meets the obstacles, before it meets neighbours."""
    return [
        "for m in range(obstacle_radius.shape[1]):",
        "    rho = obstacle_radius[b, m]",
        "    if rho > 0:",
        f"        to = offset_to(size, me.pos, {tuple_of('obstacle_x[#, b, m]', parts.dimension)})",
        "        it = Other(like(rho, m), to, dot(to, to), zero(to), rho, zero(to), like(rho, np.inf), ())",
        f"        found_ = obstacle_law_{k}({given(parts, k)}, me, it, found_)",
    ]


def _select_nearest(parts: Parts) -> list[str]:
    """Write the pass that finds how far each topological sight reaches: its k smallest squares, kept in order."""
    topological = [(q, s.nearest) for q, s in enumerate(parts.sights) if s.nearest is not None]
    if not topological:
        return []
    slot, keep = Slots(parts), _ahead(parts)
    for q, count in topological:
        keep.append(f"far = square if {_seen(parts, q)} else like(square, np.inf)")
        for j in range(count):
            place = slot(f"near{q}_{j}")
            keep += [f"near = {place}", f"{place} = far if far < near else near", "far = near if far < near else far"]
    return ["for r in range(found):", *indented_lines(meet_range(parts, parts.sorted_fields, keep), 4)]


def _sum_up(parts: Parts) -> list[str]:
    """Write how a block meets its candidates, and what its sums come to."""
    d, slot = parts.dimension, Slots(parts)
    names = [f"g{name}{j}" for name in parts.targets for j in range(d)]
    r, w = len(names), parts.width
    as_they_lie = [
        copied(parts, "felt", f"block * np.uint64({r}) + np.uint64({j * w})", "lanes", slot.first(name))
        for j, name in enumerate(names)
    ]
    meet, where = _meet(parts, False, parts.parting), ELSEWHERE if parts.parting else SELF
    counted = [f"{slot('here0')} = tallied({slot('here0')}, other)"] if parts.parting else []
    return [
        "for r in range(found):",
        "    met += (ranges[r, 1] - ranges[r, 0]) * (upto - at)",
        *indented_lines(meet_range(parts, parts.sorted_fields, [*meet, *counted], _meet(parts, True), where), 4),
        *(_meet_in_one_place(parts) if parts.parting else []),
        f"for l in range(np.uint64({parts.width})):",
        indented(_finish(parts), 4),
        f"if nx == 0 and present == n{' and not arranged' * parts.sorts}:  # they are felt as the lanes lie",
        *indented_lines(as_they_lie, 4),
        "else:",
        "    for l in range(np.uint64(upto - at)):",
        f"        i = {listed(parts)}",
        f"        place = {place_of(parts, r)}",
        indented([f"felt[place + np.uint64({j * w})] = {slot(name)}" for j, name in enumerate(names)], 8),
    ]


def _meet_in_one_place(parts: Parts) -> list[str]:
    """Write how a block meets who is in one place with some of its agents: seldom anybody but each himself."""
    return [
        "others = -1",
        "for r in range(found):",
        "    others += ranges[r, 1] - ranges[r, 0]",
        "crowded, all_of_them = False, like(reach, others)",
        f"for l in range(np.uint64({parts.width})):",
        f"    crowded |= tally_of({Slots(parts)('here0')}) < all_of_them",
        "if crowded:",
        "    for r in range(found):",
        *indented_lines(meet_range(parts, parts.sorted_fields, _meet(parts, False), where=TOGETHER), 8),
    ]


def _meet(parts: Parts, touch: bool, apart: bool = False) -> list[str]:
    """Write what one candidate adds to the sums of the lanes that see it: by contacts, or by all other laws.

    apart: nobody whom it counts for is in one place with it.
    """
    laws = [(k, e) for k, e in parts.pairs if e.contact == touch]
    vanish = [effect.vanishes and parts.trusts for effect in parts.effects]
    laws.sort(key=lambda law: vanish[law[0]])  # registers: others need one less while the first are worked out
    asked = dict.fromkeys(parts.sight_of(effect) for _, effect in laws)
    slot, lines = Slots(parts), _ahead(parts) if laws and not touch else []
    for q, sight in enumerate(parts.sights):
        if sight not in asked:
            continue
        cut = f" & (square <= {slot(f'near{q}_{sight.nearest - 1}')})" if sight.nearest else ""
        lines.append(f"seen{q} = ({_seen(parts, q)}){cut}" if sight.occluded else f"seen{q} = {_seen(parts, q)}{cut}")
    for q in parts.averaged if not touch else []:
        lines.append(f"{slot(f'many{q}_0')} = tallied({slot(f'many{q}_0')}, seen{q})")
    for q in dict.fromkeys(parts.sights.index(parts.sight_of(effect)) for k, effect in laws if vanish[k]):
        lines.append(f"it{q} = Other(aj, to, square if seen{q} else like(square, np.inf), vj, rj, tj, mj, nj)")
    for k, effect in laws:
        q, slots = parts.sights.index(parts.sight_of(effect)), slot.all(f"c{k}_")
        if effect.pair_start:
            lines.append(f"says = pair_law_{k}(p{k}, me, it, ({', '.join(slots)},))")
            lines += [f"{s} = says[{j}] if seen{q} else {s}" for j, s in enumerate(slots)]
            continue
        law = "apart_law" if apart and effect.apart_law else "pair_law"
        lines.append(f"says = {law}_{k}(p{k}, me, {f'it{q}' if vanish[k] else 'it'})")
        # A sum of a choice: of a choice between sums LLVM makes a masked store, and the sum stays in memory. The other
        # choice is -0, which x + -0 leaves as it is for every x: so this becomes one masked addition.
        lines += [f"{s} += says[{j}]{'' if vanish[k] else f' if seen{q} else o'}" for j, s in enumerate(slots)]
    return lines


def _finish(parts: Parts) -> list[str]:
    """Write what a block's sums come to."""
    slot, d = Slots(parts), parts.dimension
    lines = [me_of(parts, parts.sorted_fields), *_nearest_images(parts)]
    lines += [f"{name} = zero(me.pos)" for name in parts.targets]
    for k, _ in parts.pairs:
        to = parts.pair_target(k)
        sums = slot.all(f"c{k}_")
        if parts.effects[k].averages:
            many = f"many{parts.sights.index(parts.sight_of(parts.effects[k]))}_0"
            sums.append(f"tally_of({slot(many)})")
        lines.append(f"{to} = add({to}, finish_law_{k}({given(parts, k)}, me, ({', '.join(sums)},)))")
    return lines + [f"{slot(f'g{name}{j}')} = {name}[{j}]" for name in parts.targets for j in range(d)]


def _seen(parts: Parts, q: int) -> str:
    """Write whether candidate `it` is in sight q: near enough, ahead, and somebody else."""
    sight = parts.sights[q]
    ahead = [f"ahead{_fovs(parts).index(sight.fov)}"] if sight.fov < 360 else ["other"] * parts.masks
    member = [f"(aj >= first{q})", f"(aj < end{q})"] if sight.group is not None else []
    open_ = " & ".join([*ahead, f"({'square' if parts.masks else 'gap'} < within{q})", *member])
    if not sight.occluded:
        return open_
    # whoever is out of sight anyhow is not looked for behind obstacles: here a branch is cheaper than a choice
    return f"({open_}) and not blocked(obstacle_x, obstacle_radius, params, size, b, time, me.pos, to)"


def _fovs(parts: Parts) -> list[float]:
    """Return the fields of view that are not all around, each once."""
    return list(dict.fromkeys(sight.fov for sight in parts.sights if sight.fov < 360))


def _ahead(parts: Parts) -> list[str]:
    """Write whether the candidate is ahead, once for each field of view."""
    first = {sight.fov: q for q, sight in reversed(list(enumerate(parts.sights)))}
    return [
        f"ahead{k} = {'other & ' * parts.masks}in_view(view{first[fov]}, me.heading, to, square)"
        for k, fov in enumerate(_fovs(parts))
    ]


def meet_range(
    parts: Parts, fields: list[str], lines: list[str], touch: list[str] | None = None, where: str = SELF,
    exact: bool = False,
) -> list[str]:  # fmt: skip
    """Write the loop over the candidates of range r; `touch` is for those whom some lane may touch.

    where: who counts at all; of those in one place ties are read. Only around the edge of a periodic box are images
    sought. exact: squares are worked out in other places, too.
    """
    dot = "exact_dot" if exact or any(s.nearest for s in parts.sights) else "dot"
    wrapped, plain = offset_of(parts, "xj"), "sub(xj, me.pos)"

    mine = f"{listed(parts)} if block + l < np.uint64(upto) else np.uint64(0)"  # lanes beyond hold what lay there
    own_tie = _tie(parts, "own_tie", mine) if where == TOGETHER else []
    me = [*own_tie, me_of(parts, fields, "own_tie" if own_tie else "")]
    near = [q for q, sight in enumerate(parts.sights) if touch and sight in _touching(parts)]

    def loop(offset: str) -> list[str]:
        some = [f"touch |= other & (square < within{q})" for q in near]
        way = [f"to = {offset}", f"square = {dot}(to, to)"]
        return [
            "j, last = np.uint64(ranges[r, 0]), np.uint64(ranges[r, 1])",
            "while j < last:",
            *indented_lines(_candidate(parts, fields, where == TOGETHER), 4),
            "    own, o = np.int32(j - block), like(reach, -0.0)",
            *["    touch = False"] * bool(near),
            *indented_lines(_over_lanes(parts, me, way, where, [*lines, *some]), 4),
            *["    if touch:"] * bool(near),
            *indented_lines(_over_lanes(parts, me, way, where, touch) if touch and near else [], 8),
            "    j += np.uint64(1)",
        ]

    if parts.looks_ahead and where == ELSEWHERE:
        return _loop_ahead(parts, fields, dot, lines)
    if not parts.space.periodic:
        return loop(plain)
    if not parts.sorts or where == TOGETHER:  # what comes seldom has one form: the nearest image of who is near is he
        return loop(wrapped)
    return ["if ranges[r, 2] > 0:", *indented_lines(loop(wrapped), 4), "else:", *indented_lines(loop(plain), 4)]


def _over_lanes(parts: Parts, me: list[str], way: list[str], where: str, each: list[str]) -> list[str]:
    """Write what the lanes do with a candidate: `me`, the way to it, whether it counts, and what follows from that."""
    met = [*me, *way, f"other = {where}"]
    if not parts.masks:  # oneself is far away: compared once, and not for every sight
        met.append("gap = square if other else like(square, np.inf)")
    lanes = [*met, "it = Other(aj, to, square, vj, rj, tj, mj, nj)", *each]
    return [f"for l in range(np.uint64({parts.width})):", *indented_lines(lanes, 4)]


def _loop_ahead(parts: Parts, fields: list[str], dot: str, lines: list[str]) -> list[str]:
    """Write the loop over the candidates of range r that works out how far the next one is while it meets one.

    Behind the last one lies some other number: a row has room for more, and nobody looks at how far that is.
    """
    *to, square = Slots(parts).all("next")
    me = [me_of(parts, fields)]
    following = f"xn = ({', '.join(sorted_at(fields.index(f'x{k}'), 'j') for k in range(parts.dimension))})"
    onward = [f"onward = {offset_of(parts, 'xn')}", f"further = {dot}(onward, onward)"]
    kept = [*(f"{name} = onward[{k}]" for k, name in enumerate(to)), f"{square} = further"]
    now = [f"to = ({', '.join(to)})", f"square = {square}"]
    return [
        "j, last = np.uint64(ranges[r, 0]), np.uint64(ranges[r, 1])",
        following,
        f"for l in range(np.uint64({parts.width})):",
        *indented_lines([*me, *onward, *kept], 4),
        "while j < last:",
        *indented_lines(_candidate(parts, fields), 4),
        "    own, o = np.int32(j - block), like(reach, -0.0)",
        "    j += np.uint64(1)",
        f"    {following}",
        *indented_lines(_over_lanes(parts, me, [*onward, *now], ELSEWHERE, [*lines, *kept]), 4),
    ]


def offset_of(parts: Parts, place: str) -> str:
    """Write the way from me to a place, the shortest one around a periodic box."""
    return f"offset_to(size, me.pos, {place})" if parts.space.periodic else f"sub({place}, me.pos)"


def _touching(parts: Parts) -> set[Sight]:
    """Return the sights of contacts."""
    return {parts.sight_of(effect) for _, effect in parts.pairs if effect.contact}


def _tie(parts: Parts, name: str, who: str) -> list[str]:
    """Write the tie of agent `who` where ties are seldom looked at: they lie by number; nothing if they are at hand."""
    if parts.fields == parts.sorted_fields:
        return []
    ties = ", ".join(f"tie[place + np.uint64({k * parts.width})]" for k in range(parts.dimension))
    return [f"i = np.uint64(ident[{who}])", f"place = {place_of(parts, parts.dimension)}", f"{name} = ({ties})"]


def _candidate(parts: Parts, fields: list[str], tied: bool = False) -> list[str]:
    """Write candidate j as the laws see it: from its record, or in a small scene from the rows that blocks read too.

    tied: its tie is read, wherever that lies.
    """
    row, record = {f: k for k, f in enumerate(fields)}, record_of(fields)

    def number(name: str) -> str:
        if not parts.sorts:
            return sorted_at(row[name], "j")
        return f"records[j * np.uint64({len(record)}) + np.uint64({record.index(name)})]"

    def vector(letter: str) -> str:
        if f"{letter}0" not in row:
            return "xj"
        return "(" + ", ".join(number(f"{letter}{k}") for k in range(parts.dimension)) + ")"

    scalar = {name: number(name) if name in row else "reach" for name in ("who", "radius", "mass")}
    return [
        f"xj = {vector('x')}",
        f"vj, tj, aj, rj = {vector('v')}, {vector('t')}, {scalar['who']}, {scalar['radius']}",
        f"mj, nj = {scalar['mass']}, {_inner(parts, row, number)}",
        *(_tie(parts, "tj", listed_at(parts, fields).replace("#", "j")) if tied else []),
    ]


def _inner(parts: Parts, row: Mapping[str, int], number: Callable[[str], str]) -> str:
    """Write what goes on inside somebody, if any law reads it."""
    if "inner0" not in row:
        return "()"
    return f"Inner({', '.join(number(f'inner{k}') for k in range(len(parts.inner)))})"


def me_of(parts: Parts, fields: list[str], tie: str = "") -> str:
    """Write the agent in lane l of a block as the laws see it; what no law reads is left out.

    tie: a name of its tie, if that is not read where the other numbers are.
    """
    row, slot = {f: k for k, f in enumerate(fields)}, Slots(parts)

    def number(name: str) -> str:
        if name not in row:
            return "reach"
        return slot(f"mine{row[name]}") if parts.sorts else sorted_at(row[name], "block + l")

    def vector(letter: str) -> str:
        if f"{letter}0" not in row:
            letter = "x"
        return "(" + ", ".join(number(f"{letter}{k}") for k in range(parts.dimension)) + ")"

    numbers = ", ".join(number(name) for name in ("mass", "radius", "max_speed", "max_force"))
    vectors = f"{vector('x')}, {vector('v')}, {vector('d' if parts.oriented else 'h')}"
    nothing = f"zero({vector('x')})"
    aim = vector("a") if "a0" in row else nothing
    wishes = f"{aim}, {number('desired_speed')}, {_inner(parts, row, number)}"
    return f"me = Me({number('who')}, {vectors}, {numbers}, {tie or vector('t')}, time, {nothing}, drawn, {wishes})"
