"""Folds over the obstacles, all of them in one pass: circles of the state, which may differ from world to world, then
the other shapes: what is not round, moves, or is hollow. These are met where they are at the time of the stage.

A law meets circles as they are, and of any other shape one point (`effects.base.Obstacle`): the nearest of its surface,
or, where the law casts a ray, the one that it touches first. Nothing is written if no law asks for obstacles.

Where there are many shapes of a form, each agent meets those that may lie within reach by a grid (shapes/cells.py), in
the order in which they are listed; that is where the others, which a law leaves alone, would have been met too: so
results are the same bits.
"""

from __future__ import annotations

from collections.abc import Callable

from flockenv.shapes import FORMS
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import Slots, indented, indented_lines, tuple_of

__all__ = ["CIRCLE", "obstacle_imports", "obstacles"]

CIRCLE = "circle"

PIECED = ("chain", "hollow_chain", "hollow_block")
"""Forms that a law may meet piece by piece: side after side."""

LOOSE = 1 + 1e-6
"""Factor of a reach, so that single precision loses nothing that a law would have met."""

SHORT = 1 - 1e-6
"""Share of the way to a surface on which nothing may stand, if it is to be seen: not the surface itself."""


def obstacle_imports(parts: Parts) -> list[str]:
    """Write what folds over obstacles, and who is hidden by them, are made of."""
    if not parts.meets_obstacles:
        return []
    asked = ["outside_box"] * bool(parts.bounded) + ["shift_of", "velocity_of"] * parts.moving
    lines = [
        "from flockenv.effects.base import Obstacle",
        "from flockenv.shapes.round import normal as outward, touched_normal",
        "from flockenv.shapes.touch import touched_offset, touched_spot",
        "from flockenv.steering.around import threat",
        *([f"from flockenv.shapes.head import {', '.join(asked)}"] if asked else []),
    ]
    forms = [(form, module) for form, module in FORMS.items() if form in parts.shaped[1]]
    lines += [f"from {module} import hit_{form}, nearest_{form}" for form, module in forms]
    if parts.cells:
        lines.append("from flockenv.shapes.edges import near_way")
    cut = [(form, module) for form, module in forms if form in PIECED and any(e.obstacle_pieces for e in parts.effects)]
    return lines + [f"from {module} import piece_{form}, pieces_{form}" for form, module in cut]


def obstacles(parts: Parts, me: list[str], found_out: Callable[[int], str]) -> list[str]:
    """Write the folds over the obstacles; nothing if no law asks for obstacles.

    found_out(k): where what the pair law of effect k has found out about others is.
    """
    slot = Slots(parts)
    asking = [(k, slot.all(f"o{k}_")) for k, e in enumerate(parts.effects) if e.obstacle_start is not None]
    if not asking:
        return []
    starts = []
    for k, slots in asking:
        told = f", {found_out(k)}" if parts.effects[k].pair_law else ""
        starts.append(f"found = obstacle_start_{k}(p{k}, me{told})")
        starts += [f"{s} = found[{j}]" for j, s in enumerate(slots)]
    if parts.bounded or parts.looked_up:
        starts.append(f"seen = obstacle_reach_{asking[0][0]}(p{asking[0][0]}, me)")
        starts += [f"seen = max(seen, obstacle_reach_{k}(p{k}, me))" for k, _ in asking[1:]]
        starts.append(f"{slot('reach0')} = seen")
    count = " + ".join(["obstacle_radius.shape[1]", *(f"{form}_count" for form in parts.shaped[1])])
    d, w = parts.dimension, parts.width
    lines = [
        "if block == 0:",
        f"    work[b, 3] += n * ({count})",
        f"for l in range(np.uint64({w})):",
        indented(me + starts, 4),
        "for m in range(obstacle_radius.shape[1]):",
        "    rho = obstacle_radius[b, m]",
        "    if rho > 0:",
        f"        place = {tuple_of('obstacle_x[#, b, m]', d)}",
        f"        for l in range(np.uint64({w})):",
        indented([*me, "to = offset_to(size, x, place)", *_meet(parts, asking, CIRCLE)], 12),
    ]
    for form in parts.shaped[1]:
        met = [f"gap, out = nearest_{form}(params, at_, y)", *_meet(parts, asking, form)]
        if form in parts.bounded:
            within = "if dot(beside, beside) < seen * seen:"
            bound = [f"beside, seen = outside_box(params, at_, y), {slot('reach0')}"]
            met = [*bound, within, *indented_lines(met, 4)]
        if form in parts.looked_up and parts.only_rays:
            met = _near_a_ray(parts, [k for k, _ in asking], met)
        met = ["y = offset_to(size, place, x)", *met]
        if form in parts.looked_up:
            lines += _looked_up(parts, form, me, met, [k for k, _ in asking])
        else:
            lines += _in_turn(parts, form, me, met)
    return lines + _asides(parts, asking, me)


def _in_turn(parts: Parts, form: str, me: list[str], met: list[str]) -> list[str]:
    """Write how all agents of a block, side by side, meet every shape of a form."""
    return [
        f"at_ = {form}_at",
        f"for m in range({form}_count):",
        *indented_lines(_placed(parts), 4),
        f"    for l in range(np.uint64({parts.width})):",
        *indented_lines([*me, *met], 8),
        "    at_ += np.int64(params[at_])",
    ]


def _looked_up(parts: Parts, form: str, me: list[str], met: list[str], asking: list[int]) -> list[str]:
    """Write how each agent of a block meets the shapes of a form that may lie within reach, in order."""
    first = Slots(parts).first("found0")
    return [
        f"for l in range(np.uint64({parts.width})):",
        *indented_lines([*me, *_within_reach(parts, asking)], 4),
        f"    many = near_{form}(params, size, {form}_cells, middle, around, lanes, np.int64({first}))",
        f"    at_ = {form}_at",
        f"    for m in range(many if many >= 0 else {form}_count):",
        f"        at_ = {form}_at + np.int64(lanes[{first} + np.uint64(m)]) if many >= 0 else at_",
        *indented_lines([*_placed(parts), *met], 8),
        "        at_ += np.int64(params[at_])",
    ]


def _near_a_ray(parts: Parts, asking: list[int], met: list[str]) -> list[str]:
    """Write that a shape is met only if a ray, as far as laws reach, comes into the circle or sphere around it."""
    lines = ["touched = False"]
    for k in asking:
        for j in range(parts.effects[k].rays(parts.dimension)):
            lines.append(f"ray, margin = obstacle_ray_{k}(p{k}, me, {j})")
            lines.append("touched |= near_way(params, at_, y, ray, me.radius + margin, seen)")
    return [*lines, "if touched:", *indented_lines(met, 4)]


def _within_reach(parts: Parts, asking: list[int]) -> list[str]:
    """Write the box in which something may matter to agent i: around all rays, if laws cast them, or around it."""
    d = parts.dimension
    lines = [f"seen = {Slots(parts)('reach0')} * like(x[0], {LOOSE!r})"]
    if not parts.only_rays:
        return [*lines, f"middle, around = x, {tuple_of('seen', d)}"]
    lines.append("low, high, wide = zero(x), zero(x), like(seen, 0.0)")
    for k in asking:
        for j in range(parts.effects[k].rays(d)):
            lines += [
                f"ray, margin = obstacle_ray_{k}(p{k}, me, {j})",
                f"low = {tuple_of('min(low[#], seen * ray[#])', d)}",
                f"high = {tuple_of('max(high[#], seen * ray[#])', d)}",
                "wide = max(wide, me.radius + margin)",
            ]
    return [
        *lines,
        f"wide, half = wide * like(wide, {LOOSE!r}), like(wide, 0.5)",
        "middle = add(x, scale(add(low, high), half))",
        f"around = {tuple_of('(high[#] - low[#]) * half + wide', d)}",
    ]


def _placed(parts: Parts) -> list[str]:
    """Write where the shape at `at_` is, and how fast it moves."""
    return [f"place = {tuple_of('params[at_ + 2 + #]', parts.dimension)}", *_moved(parts)]


def _asides(parts: Parts, asking: list[tuple[int, list[str]]], me: list[str]) -> list[str]:
    """Write the side on which each agent goes around what is in its way, for the laws that ask: see around.py."""
    lines: list[str] = []
    for k, slots in asking:
        if not parts.effects[k].obstacle_edges:
            continue
        world = "obstacle_x, obstacle_radius, params, size, b, time"
        which, row = Slots(parts).all(f"ahead{k}_")
        lines += [
            f"for l in range(np.uint64({parts.width})):",
            f"    impact = {slots[0]}",
            "    if impact > 0 and impact < like(impact, np.inf):",
            *indented_lines(me, 8),
            f"        ray, margin = obstacle_ray_{k}(p{k}, me, 0)",
            f"        known = impact, np.int64({which}), np.int64({row})",
            f"        edgeward = aside_of(({world}), x, ray, me.radius + margin, known)",
            *(f"        {s} = edgeward[{j}]" for j, s in enumerate(slots[-parts.dimension :])),
        ]
    return lines


def _moved(parts: Parts) -> list[str]:
    """Write where a shape is at this instant, and how fast it moves."""
    if not parts.moving:
        return []
    velocity = "glide = velocity_of(params, at_, time, place)"
    return [velocity, "place = add(place, shift_of(params, at_, time, place))"]


def _meet(parts: Parts, asking: list[tuple[int, list[str]]], form: str) -> list[str]:
    """Write how every law that asks meets one obstacle."""
    lines = []
    for k, slots in asking:
        effect = parts.effects[k]
        for j in range(effect.rays(parts.dimension) if effect.obstacle_ray else 1):
            vel = "glide" if parts.moving and form != CIRCLE else "zero(x)"
            from_ = k if effect.obstacle_from else None
            if effect.obstacle_pieces and form in PIECED:
                lines += _by_pieces(parts, k, slots, form, vel)
                continue
            lines += _touched(form, k, j, vel) if effect.obstacle_ray else _near(form, from_, vel)
            lines.append(f"found = obstacle_law_{k}(p{k}, me, it, ({', '.join(slots)},))")
            if effect.obstacle_edges:
                lines += _remembered(parts, k, form, slots[0])
            lines += _kept(slots, _seen("it.gap", "it.normal") if effect.occluded_obstacles else "")
    return lines


def _remembered(parts: Parts, k: int, form: str, ahead: str) -> list[str]:
    """Write down which obstacle is ahead, where the law keeps another one than before.

    By its form, and its place among those, or of a form with a grid by how far its row lies behind the first.
    """
    which, row = Slots(parts).all(f"ahead{k}_")
    number = -1 if form == CIRCLE else list(FORMS).index(form)
    place = f"at_ - {form}_at" if form in parts.looked_up else "m"
    return [
        f"another = found[0] != {ahead}",
        f"{which} = like(found[0], {number}) if another else {which}",
        f"{row} = like(found[0], {place}) if another else {row}",
    ]


def _kept(slots: list[str], when: str) -> list[str]:
    """Write how a fold goes on, always or under a condition."""
    if not when:
        return [f"{s} = found[{i}]" for i, s in enumerate(slots)]
    return [f"acts = {when}", *(f"{s} = found[{i}] if acts else {s}" for i, s in enumerate(slots))]


def _seen(gap: str, normal: str) -> str:
    """Write whether nothing stands in the way to the place of a surface that is nearest to x."""
    way = f"scale({normal}, -{gap} * like({gap}, {SHORT!r}))"
    return f"({gap} <= like({gap}, 0.0)) or not blocked(obstacle_x, obstacle_radius, params, size, b, time, x, {way})"


def _by_pieces(parts: Parts, k: int, slots: list[str], form: str, vel: str) -> list[str]:
    """Write how a law meets a shape side after side: the nearest place of each that acts by itself."""
    body = f"{vel}, like(far, 0.0), zero(x), far, side, like(far, np.inf), zero(x)"
    seen = f" and ({_seen('far', 'side')})" if parts.effects[k].occluded_obstacles else ""
    met = [
        "to = touched_offset(zero(x), like(far, 0.0), side, far, far)",
        f"it = Obstacle(params[at_ + 1], to, dot(to, to), {body})",
        f"found = obstacle_law_{k}(p{k}, me, it, ({', '.join(slots)},))",
        *_kept(slots, ""),
    ]
    reach = parts.effects[k].obstacle_reach
    if reach:  # where nothing is near enough its sides are not either
        return [f"if gap < obstacle_reach_{k}(p{k}, me):", *indented_lines(_each_piece(form, seen, met), 4)]
    return _each_piece(form, seen, met)


def _each_piece(form: str, seen: str, met: list[str]) -> list[str]:
    """Write the loop over the sides of a shape."""
    return [
        f"for piece in range(pieces_{form}(params, at_, y, gap)):",
        f"    far, side, acts = piece_{form}(params, at_, piece, y, gap, out)",
        f"    if acts{seen}:",
        *indented_lines(met, 8),
    ]


def _near(form: str, k: int | None, vel: str) -> list[str]:
    """Write an obstacle as a law sees it that casts no rays, from where it is or, for effect k, from elsewhere."""
    if form == CIRCLE:
        way, from_ = ("to", []) if k is None else ("way", [f"way = sub(to, obstacle_from_{k}(p{k}, me))"])
        body = f"{way}, dot({way}, {way}), zero(x), rho, zero(x), norm({way}) - rho, outward({way})"
        return [*from_, f"it = Obstacle(like(rho, m), {body}, like(rho, np.inf), zero(x))"]
    far, side, from_ = "gap", "out", []
    if k is not None:
        far, side = "far", "side"
        from_ = [f"far, side = nearest_{form}(params, at_, add(y, obstacle_from_{k}(p{k}, me)))"]
    body = f"{vel}, like({far}, 0.0), zero(x), {far}, {side}, like({far}, np.inf), zero(x)"
    return [
        *from_,
        f"to = touched_offset(zero(x), like({far}, 0.0), {side}, {far}, {far})",
        f"it = Obstacle(params[at_ + 1], to, dot(to, to), {body})",
    ]


def _touched(form: str, k: int, j: int, vel: str) -> list[str]:
    """Write an obstacle as a law sees it that casts ray j."""
    ray = f"ray, margin = obstacle_ray_{k}(p{k}, me, {j})"
    if form == CIRCLE:
        body = "to, dot(to, to), zero(x), rho, zero(x)"
        return [
            ray,
            "hit = threat(ray, to, me.radius + rho + margin, like(rho, np.inf))",
            f"it = Obstacle(like(rho, m), {body}, norm(to) - rho, touched_normal(to, ray, hit), hit, ray)",
        ]
    return [
        ray,
        "room = me.radius + margin",
        f"hit = like(gap, 0.0) if gap < room else hit_{form}(params, at_, y, ray, room)",
        _touched_side(form),
        "to = touched_offset(ray, hit, side, room, gap)",
        f"it = Obstacle(params[at_ + 1], to, dot(to, to), {vel}, like(gap, 0.0), zero(x), gap, side, hit, ray)",
    ]


def _touched_side(form: str) -> str:
    """Write the normal where a ray touches; where none does it is that of the nearest place, which is known.

    Lanes of blocks and half-spaces lie side by side: there a choice costs less than a branch.
    """
    found = f"nearest_{form}(params, at_, touched_spot(y, ray, hit, room))[1]"
    if form in ("block", "half_space"):
        return f"side = {found}"
    return f"side = {found} if (hit > like(gap, 0.0)) & (hit < like(gap, np.inf)) else out"
