"""The way around what is in an agent's way: `aside_of`, the side of the nearest silhouette edge (Reynolds 1988).

What is passed is an obstacle as the body sees it. Where another obstacle leaves no room beside an edge, a body's radius
beyond it, the two are one, and the edge of the other is looked for on the same side: so joined walls, and gaps that are
too narrow, have no edge in between. Written only where an effect has `obstacle_edges`.
"""

from __future__ import annotations

from flockenv.shapes import FORMS
from flockenv.sweep.obstacles import each_row, place_of_row
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import indented, indented_lines, tuple_of

__all__ = ["around", "around_imports"]

FOLLOWED = 8
"""Obstacles in a row, edge to edge, that are taken for one; of more there is no edge on that side."""

ALL_AROUND = 6.0
"""rad: what must be turned by more to be passed is all around."""

JUST = 1 - 1e-3
"""Share of its clearance that a body keeps when it is tried whether it passes an edge: beside it touches nothing."""

NEARER = 1 - 1e-5
"""Share of its distance by which an edge must be nearer than another one to be preferred: so rounding picks no side."""

SPINES = {"chain": "spine_chain(params, row, y, ray)", "block": "spine_block(params, row, y, ray)"}


def around_imports(parts: Parts) -> list[str]:
    """Write what `aside_of` is made of."""
    if not parts.goes_around:
        return []
    names = ["sphere_edge", "near_way", *(f"edge_{form}" for form in parts.shaped[1])]
    names += [f"spine_{form}" for form in parts.shaped[1] if form in SPINES and parts.dimension == 3]
    return [
        "from flockenv.kernels import routine",
        f"from flockenv.shapes.edges import {', '.join(names)}",
        "from flockenv.vec import cross, lateral, perpendicular",
    ]


def around(parts: Parts) -> str:
    """Return the source of `aside_of` and what it calls; empty if no effect goes around anything."""
    if not parts.goes_around:
        return ""
    return "".join(write(parts) for write in (_row_ahead, _first_hit, _edge, _normal, _edge_beyond, _aside_of))


_WORLD = "obstacle_x, obstacle_radius, params, size, b, time"


def _first_hit(parts: Parts) -> str:
    """Write what a body touches first along a ray; of what is touched at once, what is listed first."""
    lines = [
        "best, form, row = most, -2, -1",
        "for m in range(obstacle_radius.shape[1]):",
        "    rho = obstacle_radius[b, m]",
        "    if rho > 0:",
        f"        to = offset_to(size, x, {tuple_of('obstacle_x[#, b, m]', parts.dimension)})",
        "        here = threat(ray, to, room + rho, like(room, np.inf))",
        "        if here < best:",
        "            best, form, row = here, -1, m",
    ]
    half = "scale(ray, best * like(best, 0.5))"
    for number, form in enumerate(FORMS):
        if form not in parts.shaped[1]:
            continue
        met = [
            f"y = offset_to(size, {place_of_row(parts)}, x)",
            "if near_way(params, at_, y, ray, room, best):",
            f"    here = hit_{form}(params, at_, y, ray, room)",
            f"    if here < best or (here == best and form == {number} and at_ < row):",
            f"        best, form, row = here, {number}, at_",
        ]
        # of a grid, what lies within the box around the way as far as it is free
        lines += each_row(parts, form, "middle", "reach", met, [f"middle, reach = box_of_way(x, {half}, room)"])
    return f'''

@kernel
def box_of_way(x, half, room):
    """Return the box around a body on its way: the middle, and half the edges."""
    return add(x, half), {_absolute(parts)}


@routine
def first_hit({_WORLD}, x, ray, room, most):
    """Return how far a body of radius `room` comes along a ray, m, and the form and row of what it touches there.

    At most `most`: form -2 if it touches nothing before. Of a circle of the state: form -1, and its number.
    """
{indented(indented_lines(lines, 0), 4)}
    return best, form, row
'''


def _row_ahead(parts: Parts) -> str:
    """Write where the row of an obstacle is that an agent remembers by its form and its place in that."""
    lines: list[str] = []
    for number, form in enumerate(FORMS):
        if form not in parts.shaped[1]:
            continue
        at = f"np.int64(params[{parts.places_of(form)[0]}])"
        lines.append(f"if form == {number}:")
        if form in parts.looked_up:
            lines.append(f"    return {at} + place")
        else:
            lines += [
                f"    row = {at}",
                "    for _ in range(place):",
                "        row += np.int64(params[row])",
                "    return row",
            ]
    return f'''

@kernel
def row_ahead(params, form, place):
    """Return where the row of an obstacle begins, or the number of a circle of the state."""
{indented([*lines, "return place"], 4)}
'''


def _absolute(parts: Parts) -> str:
    """Write the half edges of the box around a way and a body: |half| and its radius along each axis."""
    return "(" + ", ".join(f"abs(half[{k}]) + room" for k in range(parts.dimension)) + ")"


def _edge(parts: Parts) -> str:
    """Write the choice of the law of an edge, by the form of what is in the way."""
    lines = [
        "if form == -1:",
        f"    to = offset_to(size, x, {tuple_of('obstacle_x[#, b, row]', parts.dimension)})",
        "    return sphere_edge(to, ray, side, room + obstacle_radius[b, row])",
        "at_ = row",
        *([f"y = offset_to(size, {place_of_row(parts)}, x)"] if parts.shaped[1] else []),
    ]
    for number, form in enumerate(FORMS):
        if form in parts.shaped[1]:
            lines += [f"if form == {number}:", f"    return edge_{form}(params, row, y, ray, side, room)"]
    return f'''

@routine
def edge({_WORLD}, form, row, x, ray, side, room):
    """Return the edge of an obstacle in the way: by what angle a ray must be turned to pass it, and how far that is."""
{indented(indented_lines(lines, 0), 4)}
    return like(room, np.inf), like(room, np.inf)
'''


def _normal(parts: Parts) -> str:
    """Write which way the surface faces that a body touches, by the form of what it touches."""
    circle = f"offset_to(size, x, {tuple_of('obstacle_x[#, b, row]', parts.dimension)})"
    lines = [
        "if form == -1:",
        f"    return touched_normal({circle}, ray, hit)",
        "at_ = row",
        *([f"y = offset_to(size, {place_of_row(parts)}, x)"] if parts.shaped[1] else []),
    ]
    for number, form in enumerate(FORMS):
        if form in parts.shaped[1]:
            lines += [
                f"if form == {number}:",
                f"    return nearest_{form}(params, row, touched_spot(y, ray, hit, room))[1]",
            ]
    return f'''

@routine
def normal_hit({_WORLD}, form, row, x, ray, hit, room):
    """Return the outward unit normal of an obstacle where a body touches it, `hit` m along a ray."""
{indented(indented_lines(lines, 0), 4)}
    return zero(x)
'''


def _edge_beyond(parts: Parts) -> str:
    """Write how the edge to one side is found where a body passes; in space also what it first finds there instead."""
    facing = f"normal_hit({_WORLD}, form, row, x, way, hit, room)" if parts.dimension == 3 else "off"
    return f'''

@routine
def edge_beyond({_WORLD}, form, row, hit, x, ray, side, room, most):
    """Return how far from the impact the nearest place is where a body passes on a side, m; inf if beyond `most`.

    In space also the normal of the obstacle that is first found in the way on that side; else 0.
    """
    far, off, first = like(room, np.inf), zero(x), True
    spot, way, across, turned_by = scale(ray, hit), ray, side, like(room, 0.0)
    for _ in range({FOLLOWED}):
        turn, reach = edge({_WORLD}, form, row, x, way, across, room)
        turned_by += turn
        if not (turned_by < like(room, {ALL_AROUND})) or reach == far:
            return far, off
        c, s = np.cos(turn), np.sin(turn)
        way, across = add(scale(way, c), scale(across, s)), sub(scale(across, c), scale(way, s))
        beyond = norm(sub(scale(way, reach), spot))
        if not (beyond < most):
            return far, off
        hit, form, row = first_hit({_WORLD}, x, way, room * like(room, {JUST!r}), reach + room)
        if form == -2:
            return beyond, off
        if first:
            off, first = {facing}, False
    return far, off
'''


def _aside_of(parts: Parts) -> str:
    """Write how the sides are compared: in the plane both, in space the normal's and those along and across an axis."""
    sides = "scale(own, -e)," if parts.dimension == 2 else "ax, scale(ax, -e), across, scale(across, -e)"
    lines = [
        "hit, form, place = known",
        "row, e, right = row_ahead(params, form, place), like(room, 1.0), perpendicular(ray)",
        f"out = lateral(normal_hit({_WORLD}, form, row, x, ray, hit, room), ray)",
        "own = select(dot(out, out) > like(room, 1e-10), unit(out), right)",
        f"best, off = edge_beyond({_WORLD}, form, row, hit, x, ray, own, room, like(room, np.inf))",
        "found = own if best < like(room, np.inf) else zero(x)",
        *(_axis(parts) if parts.dimension == 3 else []),
        f"for side in ({sides}):",
        f"    far = edge_beyond({_WORLD}, form, row, hit, x, ray, side, room, best * like(room, {NEARER!r}))[0]",
        "    best, found = (far, side) if far < best else (best, found)",
    ]
    return f'''

@routine
def aside_of({_WORLD}, x, ray, room, known):
    """Return the unit vector across a ray to the side where the edge of what is ahead is nearest to the impact.

    0 if it has no edge where the body passes. known: how far ahead it is, m, its form, and its place in that.
    """
{indented(indented_lines(lines, 0), 4)}
    return found
'''


def _axis(parts: Parts) -> list[str]:
    """Write the axis along and across which edges are searched for in space: `ax` and `across`.

    It is the obstacle's own, or else leads away from what blocked the side of the normal. So no axis of the coordinates
    is preferred, and agents of the mirrored scene take the mirrored path.
    """
    own = [form for form in SPINES if form in parts.shaped[1]]
    lines = ["ax, at_ = zero(x), row", *([f"y = offset_to(size, {place_of_row(parts)}, x)"] if own else [])]
    for form in own:
        lines += [f"if form == {list(FORMS).index(form)}:", f"    ax = lateral({SPINES[form]}, ray)"]
    return [
        *lines,
        "if dot(ax, ax) <= like(room, 1e-10):",
        "    ax = lateral(lateral(off, ray), own)",
        "if dot(ax, ax) <= like(room, 1e-10):",
        "    ax = cross(ray, own)",
        "ax = unit(ax)",
        "across = cross(ray, ax)",
    ]
