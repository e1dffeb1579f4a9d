"""Draw a snapshot as pixels, with Pillow; no display is needed.

Pictures are drawn `scale` times larger and averaged down, which smooths edges. Parts that do not move (background,
grid, obstacles, caption) are drawn once per world and cached.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from flockenv.model.snapshot import Floats, Mark, Snapshot
from flockenv.render.backdrop import draw_backdrop, draw_disc, draw_time, restore_margins
from flockenv.render.faces import draw_faces
from flockenv.render.metaballs import draw_metaballs
from flockenv.render.palette import (
    ARROW,
    BODY_DISC,
    BOND,
    DART,
    DART_REACH,
    JUMP,
    PAPER,
    POINT,
    ROLE_COLOURS,
    WAY,
    mix,
    rgb,
)
from flockenv.render.view import View, view_of

__all__ = ["Pixels", "draw"]

Pixels = NDArray[np.uint8]

_PAPER, _INK, _GOAL = (PAPER[part][0] for part in ("paper", "ink", "goal"))
_SIZES: Final = (64, 4096)
_SCALES: Final = (1, 4)
#: Largest radius, px, of billboards whose coverage is cached, and rows of larger ones that are computed at a time.
_LARGEST_KEPT: Final = 64
_ROWS: Final = 64
#: Roles whose dead agents are drawn as crosses; those of other roles are empty slots, which are not drawn.
_CROSSED: Final = ("pursuer", "evader", "learner")


def draw(
    snapshot: Snapshot, size: int = 600, scale: int = 2, trails: Sequence[Snapshot] | None = None,
    all_trails: bool = True,
) -> Pixels:  # fmt: skip
    """Return the picture of a snapshot, (height, width, 3) uint8, with width = size and height <= size px, both even.

    An agent is a dart that points along its velocity (a dot if it is at rest), over a disc of its radius, in the colour
    of its role. Agents with bonds are dots, and bonds are thin lines behind them; sheets and bodies are shaded faces
    instead, whose back has another colour. 3-D scenes are seen from above, others by `turned`: near agents are larger,
    and drawn last. An agent with an appearance is drawn as a point, disc, polygon, metaball or billboard, whose colour
    may show its age, speed, strain or an inner state; a face has the colour of its first corner.

    trails: earlier snapshots of the same world, oldest first. The path of each agent without bonds is drawn behind it;
    of an agent with an appearance, its last `trail` seconds. all_trails: False: only of agents with an appearance.
    scale: supersampling, 1 (fast, jagged) to 4. Raises ValueError or TypeError for a size or scale out of range.
    """
    _check_integer("size", size, _SIZES)
    _check_integer("scale", scale, _SCALES)
    view = view_of(snapshot, size, scale)
    circles = np.column_stack([snapshot.obstacle_centre[:, :2], snapshot.obstacle_radius])
    outlines = tuple(polygon.tobytes() for polygon in snapshot.outlines)
    hidden = np.asarray(snapshot.covered)
    roles = _roles_in_their_colours(snapshot, hidden)
    box = b"" if snapshot.box is None else snapshot.box.tobytes()
    backdrop = draw_backdrop(view, snapshot.title, roles, circles.tobytes(), outlines, box)
    canvas = backdrop.copy()
    pen = ImageDraw.Draw(canvas, "RGBA")
    tracks = [mark for mark in snapshot.marks if mark.kind == "way"]
    for mark in tracks:
        _draw_mark(pen, view, mark)
    if trails:
        path = [*trails, snapshot]
        if all_trails:
            _draw_trails(pen, view, path)
        if any(look.trail > 0 for look in snapshot.looks):
            _draw_look_trails(pen, view, path)
    for mark in snapshot.marks:
        if mark.kind != "way":
            _draw_mark(pen, view, mark)
    _draw_bonds(pen, view, snapshot, hidden)
    draw_faces(canvas, view, snapshot, _relative_heights(snapshot))
    _draw_liquids(canvas, view, snapshot)
    _draw_agents(canvas, pen, view, snapshot, hidden)
    restore_margins(canvas, backdrop, view, view.spill)
    draw_time(pen, view, snapshot.time)
    return np.array(canvas.reduce(scale) if scale > 1 else canvas)


def _check_integer(name: str, value: int, limits: tuple[int, int]) -> None:
    low, high = limits
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name}: must be an int from {low} to {high}, got {value!r}")
    if not low <= value <= high:
        raise ValueError(f"{name}: must be from {low} to {high}, got {value}")


def _roles_in_their_colours(snapshot: Snapshot, hidden: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return the roles that some agent is drawn in the colour of; appearances with colours need no legend.

    hidden (N,): agents that are not drawn, but the surface of their network.
    """
    assert snapshot.look is not None
    coloured = [bool(look.colours) for look in snapshot.looks] + [False]  # the last for index -1: no appearance
    each = zip(snapshot.roles, snapshot.look.tolist(), hidden.tolist(), strict=True)
    return tuple(dict.fromkeys(role for role, k, unseen in each if not (coloured[k] or unseen)))


# ---- agents and marks


def _draw_mark(pen: ImageDraw.ImageDraw, view: View, mark: Mark) -> None:
    x, y = view.to_pixels(mark.at).tolist()
    if mark.kind == "heading":
        _draw_arrow(pen, view, x, y, _directions(mark.vector[None])[0])
        return
    if mark.kind == "way":
        for a, b in view.visible_positions(x, y, mark.radius * view.metre):
            draw_disc(pen, a, b, mark.radius * view.metre, mix(_GOAL, _PAPER, WAY))
        return
    reach = max(mark.radius * view.metre, view.width / 75)
    thick = max(1, round(view.width / 240))
    for a, b in view.visible_positions(x, y, reach):
        box = (a - reach, b - reach, a + reach, b + reach)
        pen.ellipse(box, fill=(*rgb(_GOAL), 36))
        pen.ellipse(box, outline=_GOAL, width=thick)
        draw_disc(pen, a, b, view.width / 200, _GOAL)


def _draw_arrow(pen: ImageDraw.ImageDraw, view: View, x: float, y: float, aim: Floats) -> None:
    length = 0.16 * min(view.right - view.left, view.bottom - view.top) * math.hypot(*aim)
    if length < 1e-3 * view.width:
        return
    along = aim / math.hypot(*aim)
    shape = np.array(ARROW)
    corners = shape[:, :1] * along + shape[:, 1:] * np.array([-along[1], along[0]])
    pixels = np.array([x, y]) + length * corners * np.array([1.0, -1.0])
    pen.polygon(pixels.ravel().tolist(), fill=(*rgb(_GOAL), 120))


def _directions(vel: Floats) -> Floats:
    """Return x and y of the unit vector along each velocity, (N, 2); zero for an agent at rest."""
    largest = np.abs(vel).max(axis=1, keepdims=True, initial=0.0)
    unit = vel / np.where(largest > 0.0, largest, 1.0)  # by the largest component first: no square overflows
    norm = np.linalg.norm(unit, axis=1, keepdims=True)
    return np.asarray(unit[:, :2] / np.where(norm > 0.0, norm, 1.0))


def _relative_heights(snapshot: Snapshot) -> Floats:
    """Return the height of each agent, (N,), from 0 (bottom) to 1 (top, nearest to the viewer); 1 in 2-D."""
    if snapshot.dimension == 2:
        return np.ones(snapshot.agents)
    low, high = snapshot.low[2], snapshot.high[2]
    return np.asarray((np.clip(snapshot.pos[:, 2], low, high) - low) / (high - low))


def _dart_corners(spots: Floats, aim: Floats, reach: Floats) -> Floats:
    """Return the corners of every dart, (N, 4, 2) px; one that points up or down is a third as long."""
    length = np.hypot(aim[:, 0], aim[:, 1])
    along = aim / np.where(length > 0.0, length, 1.0)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    shape = np.array(DART)
    forward = shape[:, 0] * np.maximum(length, 0.35)[:, None]
    corners = forward[..., None] * along[:, None] + shape[:, 1, None] * across[:, None]
    return np.asarray(spots[:, None] + reach[:, None, None] * corners * np.array([1.0, -1.0]))


def _draw_bonds(pen: ImageDraw.ImageDraw, view: View, snapshot: Snapshot, hidden: NDArray[np.bool_]) -> None:
    """Draw a line for each bond between living agents, lowest first; twice if it crosses an edge of a torus.

    hidden (N,): agents whose bonds are not drawn, but the surface of their network.
    """
    drawn = snapshot.alive & snapshot.visible
    bonds = snapshot.whole_bonds
    bonds = bonds[drawn[bonds].all(axis=1) & ~hidden[bonds].all(axis=1)]
    if not len(bonds):
        return
    offset = snapshot.pos[bonds[:, 1]] - snapshot.pos[bonds[:, 0]]
    if snapshot.periodic:
        extent = snapshot.high - snapshot.low
        offset -= extent * np.rint(offset / extent)
    ends = [snapshot.pos[bonds[:, 0]], snapshot.pos[bonds[:, 1]]]
    lines = np.concatenate([view.to_pixels(ends[0]), view.to_pixels(ends[0] + offset)], axis=1)
    copies = np.concatenate([view.to_pixels(ends[1] - offset), view.to_pixels(ends[1])], axis=1)
    twice = np.abs(copies - lines).max(axis=1) > 1.0
    depth, thick = _relative_heights(snapshot)[bonds].mean(axis=1), max(1, round(view.width * BOND))
    for k in np.argsort(depth, kind="stable").tolist():
        share = 0.6 * (0.45 + 0.55 * float(depth[k]))
        fill = mix(ROLE_COLOURS[snapshot.roles[bonds[k, 0]]][0], _PAPER, share)
        for line in (lines[k], copies[k]) if twice[k] else (lines[k],):
            pen.line(line.tolist(), fill=fill, width=thick)


def _draw_liquids(canvas: Image.Image, view: View, snapshot: Snapshot) -> None:
    """Draw the agents that are metaballs, one surface for each appearance."""
    which = np.asarray(snapshot.look)
    for k, look in enumerate(snapshot.looks):
        if look.form != "metaball":
            continue
        chosen = np.flatnonzero((which == k) & snapshot.alive & snapshot.visible)
        magnification, sizes, colours = _magnification(snapshot), [], []
        for i, shade in zip(chosen.tolist(), snapshot.shade[chosen].tolist(), strict=True):
            sizes.append(look.size_at(shade, float(snapshot.radius[i])) * view.metre * magnification[i])
            colour = look.colour(shade, ROLE_COLOURS[snapshot.roles[i]][0])
            colours.append((*colour, 255 * look.opacity_at(shade)))
        if colours:
            draw_metaballs(
                canvas, view, view.to_pixels(snapshot.pos[chosen]), np.array(sizes), np.array(colours, float)
            )


def _magnification(snapshot: Snapshot) -> Floats:
    """Return the factor on the size of each agent, (N,): in 3-D upper agents are nearer, and larger."""
    depth = _relative_heights(snapshot)
    return 0.7 + 0.5 * depth if snapshot.dimension == 3 else depth


def _draw_agents(
    canvas: Image.Image, pen: ImageDraw.ImageDraw, view: View, snapshot: Snapshot, hidden: NDArray[np.bool_]
) -> None:
    """Draw agents, the farthest first, as their appearance or role defines; pen: of the canvas."""
    visible = np.flatnonzero(snapshot.visible & ~(hidden & snapshot.alive))
    depth, magnification = _relative_heights(snapshot), _magnification(snapshot)
    body = snapshot.radius * view.metre * magnification
    reach = np.maximum(body, DART_REACH * view.width * magnification)
    has_bonds, least_radius = snapshot.has_bonds, view.width * BOND
    spots = view.to_pixels(snapshot.pos)
    aim = _directions(np.where(snapshot.visible[:, None], snapshot.aim, 0.0))
    darts = _dart_corners(spots, aim, 0.94 * reach)
    shades, lacks_look = snapshot.shade, _lacks_look(snapshot)
    # Lowest first, and crosses last, so that a captured agent is not hidden by its captor.
    for i in visible[np.argsort(np.where(snapshot.alive, depth, 2.0)[visible], kind="stable")].tolist():
        role, (x, y) = snapshot.roles[i], spots[i].tolist()
        for a, b in view.visible_positions(x, y, 1.1 * float(reach[i])):
            if not snapshot.alive[i]:
                _draw_cross(pen, a, b, float(reach[i]), role)
                continue
            if not lacks_look[i]:
                share, factor = float(shades[i]), float(magnification[i])
                _draw_look(canvas, pen, view, snapshot, i, (a, b), aim[i], share, factor)
                continue
            if has_bonds[i]:
                shade = mix(ROLE_COLOURS[role][0], _PAPER, 0.45 + 0.55 * float(depth[i]))
                draw_disc(pen, a, b, max(float(body[i]), least_radius), shade)
                continue
            corners = (darts[i] + (a - x, b - y)).ravel().tolist() if aim[i].any() else []
            _draw_plain_agent(pen, a, b, corners, float(body[i]), float(reach[i]), role, float(depth[i]))


def _draw_plain_agent(
    pen: ImageDraw.ImageDraw, x: float, y: float, dart: list[float], body: float, reach: float, role: str, depth: float
) -> None:
    colour = ROLE_COLOURS[role][0]
    solid = mix(colour, _PAPER, 0.45 + 0.55 * depth)
    box = (x - body, y - body, x + body, y + body)
    if body >= BODY_DISC * reach:
        pen.ellipse(box, fill=(*solid, 64))
        pen.ellipse(box, outline=(*solid, 150), width=max(1, round(reach / 12)))
    if dart:
        pen.polygon(dart, fill=solid)
    else:
        draw_disc(pen, x, y, 0.5 * reach, solid)
    if body < BODY_DISC * reach:
        draw_disc(pen, x, y, body, mix(colour, _INK, 0.55))


def _draw_cross(pen: ImageDraw.ImageDraw, x: float, y: float, reach: float, role: str) -> None:
    if role not in _CROSSED:
        return
    arm, thick = 0.75 * reach, max(1, round(0.28 * reach))
    for side in (-1.0, 1.0):
        line = (x - arm, y - side * arm, x + arm, y + side * arm)
        pen.line(line, fill=mix(ROLE_COLOURS[role][0], _PAPER, 0.85), width=thick)


def _draw_trails(pen: ImageDraw.ImageDraw, view: View, path: Sequence[Snapshot]) -> None:
    now = path[-1]
    for earlier in path:
        if earlier.pos.shape != now.pos.shape:
            raise ValueError(f"trails: must have positions of shape {now.pos.shape}, got {earlier.pos.shape}")
    spots = view.to_pixels(np.stack([earlier.pos for earlier in path]))
    drawn = np.stack([earlier.alive & earlier.visible & ~now.has_bonds & _lacks_look(now) for earlier in path])
    linked = drawn[1:] & drawn[:-1] & _is_continuous(view, spots, path)
    lines = np.concatenate([spots[:-1], spots[1:]], axis=2)
    for k in range(len(linked)):
        age = (k + 1) / len(linked)  # 1 is now
        colours = {role: mix(ROLE_COLOURS[role][0], _PAPER, 0.1 + 0.45 * age) for role in set(now.roles)}
        thick = max(1, round(view.width / 240 * (0.35 + 0.65 * age)))
        for i in np.flatnonzero(linked[k]).tolist():
            pen.line(lines[k, i].tolist(), fill=colours[now.roles[i]], width=thick)


def _lacks_look(snapshot: Snapshot) -> NDArray[np.bool_]:
    """Return the agents without an appearance, which are drawn by their role, (N,) bool."""
    return np.asarray(np.asarray(snapshot.look) < 0)


def _is_continuous(view: View, spots: Floats, path: Sequence[Snapshot]) -> NDArray[np.bool_]:
    """Return True for slots with the same agent in two successive snapshots, and no jump between, (T - 1, N) bool."""
    box = path[-1].box
    if box is None:
        small = np.abs(np.diff(spots, axis=0)) < JUMP * np.array([view.right - view.left, view.bottom - view.top])
    else:  # of a world that was turned: a jump along any of its three axes, also towards the viewer
        axes = box[1:] - box[0]
        with np.errstate(over="ignore", invalid="ignore"):  # of bodies that diverged, which are not drawn
            step = np.diff(np.stack([each.pos for each in path]), axis=0) @ axes.T
        small = np.abs(step) < JUMP * (axes**2).sum(axis=1)
    same = np.stack([before.is_same(after) for before, after in itertools.pairwise(path)])
    return np.asarray(small.all(axis=2) & same)


def _draw_look_trails(pen: ImageDraw.ImageDraw, view: View, path: Sequence[Snapshot]) -> None:
    """Draw the paths of agents whose appearance has a trail, in the colours of those instants, fainter with age."""
    now = path[-1]
    spots = view.to_pixels(np.stack([earlier.pos for earlier in path]))
    drawn = np.stack([earlier.alive & earlier.visible & ~_lacks_look(earlier) for earlier in path])
    linked = drawn[1:] & drawn[:-1] & _is_continuous(view, spots, path)
    lines = np.concatenate([spots[:-1], spots[1:]], axis=2)
    length = np.array([look.trail for look in now.looks])
    thick = max(1, round(view.width / 400))
    for k, earlier in enumerate(path[:-1]):
        behind = now.time - path[k + 1].time
        shade = earlier.shade
        for i in np.flatnonzero(linked[k] & ~_lacks_look(now)).tolist():
            which = int(np.asarray(now.look)[i])
            look, remaining = now.looks[which], 1.0 - behind / length[which] if length[which] > 0 else 0.0
            if remaining > 1e-9:
                colour = look.colour(float(shade[i]), ROLE_COLOURS[now.roles[i]][0])
                fill = (*colour, round(255 * 0.6 * remaining * look.opacity_at(float(shade[i]))))
                pen.line(lines[k, i].tolist(), fill=fill, width=thick)


def _draw_look(
    canvas: Image.Image, pen: ImageDraw.ImageDraw, view: View, snapshot: Snapshot, i: int,
    position: tuple[float, float], aim: Floats, shade: float, magnification: float,
) -> None:  # fmt: skip
    """Draw an agent as its appearance defines it; metaballs are drawn already."""
    look = snapshot.looks[int(np.asarray(snapshot.look)[i])]
    if look.form == "metaball":
        return
    x, y = position
    reach = look.size_at(shade, float(snapshot.radius[i])) * view.metre * magnification
    fill = (*look.colour(shade, ROLE_COLOURS[snapshot.roles[i]][0]), round(255 * look.opacity_at(shade)))
    if look.form == "polygon":
        length = math.hypot(*aim)
        c, s = (aim / length).tolist() if length > 0 else (1.0, 0.0)
        corners = [p for a, b in look.vertices for p in (x + reach * (a * c - b * s), y - reach * (a * s + b * c))]
        pen.polygon(corners, fill=fill)
    elif look.form == "billboard":
        _draw_billboard(canvas, round(x), round(y), max(1, round(reach)), fill)
    else:
        draw_disc(pen, x, y, max(reach, view.width * POINT) if look.form == "point" else reach, fill)


def _draw_billboard(canvas: Image.Image, x: int, y: int, radius: int, fill: tuple[int, int, int, int]) -> None:
    """Draw a soft disc around a pixel; of a large one only the part in the picture, some rows at a time."""
    if radius <= _LARGEST_KEPT:
        canvas.paste(fill[:3], (x - radius, y - radius), _soft_disc(radius, fill[3]))
        return
    left, right = max(x - radius, 0), min(x + radius + 1, canvas.width)
    first, last = max(y - radius, 0), min(y + radius + 1, canvas.height)
    if left >= right:
        return
    for top in range(first, last, _ROWS):
        rows = np.arange(top, min(top + _ROWS, last))
        mask = _coverage((np.arange(left, right) - x) / radius, (rows - y) / radius, fill[3])
        canvas.paste(fill[:3], (left, top), mask)


@lru_cache(maxsize=1024)
def _soft_disc(radius: int, opacity: int) -> Image.Image:
    """Return the coverage of a billboard; radius in px."""
    place = np.arange(-radius, radius + 1) / radius
    return _coverage(place, place, opacity)


def _coverage(x: Floats, y: Floats, opacity: int) -> Image.Image:
    """Return the coverage of a billboard, 0 to 255: opacity (1 - d^2)^2 at a distance d; x, y and d in radii."""
    inside = np.maximum(1.0 - x**2 - y[:, None] ** 2, 0.0)
    return Image.fromarray(np.rint(opacity * inside**2).astype(np.uint8))
