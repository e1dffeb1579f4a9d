"""Folds over the obstacles, all of them in one pass: circles of the state, which may differ from world to world, then
the other shapes: what is not round, moves, or is hollow. These are met where they are at the time of the stage.

A law meets circles as they are, and of any other shape one point (`effects.base.Obstacle`): the nearest of its surface,
or, where the law casts a ray, the one that it touches first. Nothing is written if no law asks for obstacles.
"""

from __future__ import annotations

from collections.abc import Callable

from flockenv.shapes import FORMS
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import Slots, indented, indented_lines, tuple_of

__all__ = ["blocked", "obstacle_imports", "obstacles"]

CIRCLE = "circle"

PIECED = ("chain", "hollow_chain", "hollow_block")
"""Forms that a law may meet piece by piece: side after side."""

SHORT = 1 - 1e-6
"""Share of the way to a surface on which nothing may stand, if it is to be seen: not the surface itself."""


def obstacle_imports(parts: Parts) -> list[str]:
    """Write what folds over obstacles, and who is hidden by them, are made of."""
    if not parts.meets_obstacles:
        return []
    asked = ["bound_of"] * bool(parts.bounded) + ["shift_of", "velocity_of"] * parts.moving
    lines = [
        "from flockenv.effects.base import Obstacle",
        "from flockenv.shapes.round import blocks as stands_between, normal as outward, touched_normal",
        "from flockenv.shapes.touch import touched_offset, touched_spot",
        "from flockenv.steering.around import threat",
        *([f"from flockenv.shapes.head import {', '.join(asked)}"] if asked else []),
    ]
    forms = [(form, module) for form, module in FORMS.items() if form in parts.shaped[1]]
    lines += [f"from {module} import hit_{form}, nearest_{form}" for form, module in forms]
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
    if parts.bounded:
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
            within = "if dot(beside, beside) < (wide + seen) * (wide + seen):"
            bound = ["middle, wide = bound_of(params, at_, y)", f"beside, seen = sub(y, middle), {slot('reach0')}"]
            met = [*bound, within, *indented_lines(met, 4)]
        met = [*me, "y = offset_to(size, place, x)", *met]
        lines += [
            f"at_ = {form}_at",
            f"for m in range({form}_count):",
            f"    place = {tuple_of('params[at_ + 2 + #]', d)}",
            *_moved(parts),
            f"    for l in range(np.uint64({w})):",
            indented(met, 8),
            "    at_ += np.int64(params[at_])",
        ]
    return lines


def _moved(parts: Parts) -> list[str]:
    """Write where a shape is at this instant, and how fast it moves."""
    if not parts.moving:
        return []
    velocity = "    glide = velocity_of(params, at_, time, place)"
    return [velocity, "    place = add(place, shift_of(params, at_, time, place))"]


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
            lines += _kept(slots, _seen(parts, "it.gap", "it.normal") if effect.occluded_obstacles else "")
    return lines


def _kept(slots: list[str], when: str) -> list[str]:
    """Write how a fold goes on, always or under a condition."""
    if not when:
        return [f"{s} = found[{i}]" for i, s in enumerate(slots)]
    return [f"acts = {when}", *(f"{s} = found[{i}] if acts else {s}" for i, s in enumerate(slots))]


def _seen(parts: Parts, gap: str, normal: str) -> str:
    """Write whether nothing stands in the way to the place of a surface that is nearest to x."""
    when = "time, " if parts.moving else ""
    way = f"scale({normal}, -{gap} * like({gap}, {SHORT!r}))"
    return f"({gap} <= like({gap}, 0.0)) or not blocked(obstacle_x, obstacle_radius, params, size, b, {when}x, {way})"


def _by_pieces(parts: Parts, k: int, slots: list[str], form: str, vel: str) -> list[str]:
    """Write how a law meets a shape side after side: the nearest place of each that acts by itself."""
    body = f"{vel}, like(far, 0.0), zero(x), far, side, like(far, np.inf), zero(x)"
    seen = f" and ({_seen(parts, 'far', 'side')})" if parts.effects[k].occluded_obstacles else ""
    met = [
        "to = touched_offset(zero(x), like(far, 0.0), side, far, far)",
        f"it = Obstacle(params[at_ + 1], to, dot(to, to), {body})",
        f"found = obstacle_law_{k}(p{k}, me, it, ({', '.join(slots)},))",
        *_kept(slots, ""),
    ]
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


def _place(parts: Parts) -> str:
    """Write where the anchor of the shape at `at_` is."""
    place = tuple_of("params[at_ + 2 + #]", parts.dimension)
    return f"add({place}, shift_of(params, at_, time, x))" if parts.moving else place


def _touched_side(form: str) -> str:
    """Write the normal where a ray touches; where none does it is that of the nearest place, which is known.

    Lanes of blocks and half-spaces lie side by side: there a choice costs less than a branch.
    """
    found = f"nearest_{form}(params, at_, touched_spot(y, ray, hit, room))[1]"
    if form in ("block", "half_space"):
        return f"side = {found}"
    return f"side = {found} if (hit > like(gap, 0.0)) & (hit < like(gap, np.inf)) else out"


def blocked(parts: Parts) -> str:
    """Return the source of `blocked`: does an obstacle hide what is at `to` from x? Empty if nobody asks."""
    if not parts.occludes:
        return ""
    d = parts.dimension
    lines = [
        "found = False",
        "for m in range(obstacle_radius.shape[1]):",
        "    rho = obstacle_radius[b, m]",
        "    if rho > 0:",
        f"        found |= stands_between(offset_to(size, x, {tuple_of('obstacle_x[#, b, m]', d)}), rho, to)",
    ]
    at = d + 1
    for form in parts.shaped[1]:
        lines += [
            f"at_ = np.int64(params[{at}])",
            f"for m in range(np.int64(params[{at + 1}])):",
            f"    y = offset_to(size, {_place(parts)}, x)",
            f"    found |= hit_{form}(params, at_, y, unit(to), like(to[0], 0.0)) < norm(to)",
            "    at_ += np.int64(params[at_])",
        ]
        at += 2
    return f'''
@kernel
def blocked(obstacle_x, obstacle_radius, params, size, b, {"time, " if parts.moving else ""}x, to):
    """Does an obstacle stand in the straight way to whom is at `to` m?"""
{indented(indented_lines(lines, 0), 4)}
    return found
'''
