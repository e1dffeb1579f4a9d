"""draw(): one snapshot as pixels, by Pillow alone; no window, no display, no pygame, no matplotlib.

Drawn `scale` times larger and averaged down, which smooths every edge. What does not move (paper, grid, obstacles,
caption) is drawn once per world and kept.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from flockenv.model.snapshot import Floats, Mark, Snapshot
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
from flockenv.render.view import View, look

__all__ = ["Pixels", "draw"]

Pixels = NDArray[np.uint8]

_PAPER, _INK, _FAINT, _GOAL = (PAPER[part][0] for part in ("paper", "ink", "faint", "goal"))
_SIZES: Final = (64, 4096)
_SCALES: Final = (1, 4)
#: These leave a cross where they ended; other dead rows are unused places in the table of agents.
_NAMED: Final = ("pursuer", "evader", "learner")


def draw(
    snapshot: Snapshot, size: int = 600, scale: int = 2, trails: Sequence[Snapshot] | None = None,
    all_trails: bool = True,
) -> Pixels:  # fmt: skip
    """Return the picture of a snapshot, (height, width, 3) uint8, width = size and height <= size px, both even.

    Agents are darts that point along their velocity, over a disc of their body radius, coloured by role (Okabe-Ito);
    one at rest is a dot. Those with bonds are dots of their radius, behind which bonds are thin lines. 3-D is seen from
    above: what is higher is larger and drawn last.
    An agent with a look is drawn by it: points, discs or polygons, whose colour may show age or speed.
    trails: earlier snapshots of the same world, oldest first; agents without bonds then have their path drawn behind
    them, those with a look for as long as the look's trail. all_trails=False: only those with a look.
    scale: supersampling, 1 (fast, jagged) to 4. Raises ValueError or TypeError on a size or scale out of range.
    """
    _whole("size", size, _SIZES)
    _whole("scale", scale, _SCALES)
    view = look(snapshot, size, scale)
    stones = np.column_stack([snapshot.obstacle_centre[:, :2], snapshot.obstacle_radius])
    walls = tuple(polygon.tobytes() for polygon in snapshot.outlines)
    backdrop = _backdrop(view, snapshot.title, tuple(dict.fromkeys(snapshot.roles)), stones.tobytes(), walls)
    canvas = backdrop.copy()
    pen = ImageDraw.Draw(canvas, "RGBA")
    ways = [mark for mark in snapshot.marks if mark.kind == "way"]
    for mark in ways:
        _mark(pen, view, mark)
    if trails:
        path = [*trails, snapshot]
        if all_trails:
            _trails(pen, view, path)
        if any(dress.trail > 0 for dress in snapshot.looks):
            _dressed_trails(pen, view, path)
    for mark in snapshot.marks:
        if mark.kind != "way":
            _mark(pen, view, mark)
    _bonds(pen, view, snapshot)
    _bodies(pen, view, snapshot)
    _trim(canvas, backdrop, view, view.spill)
    _clock(pen, view, snapshot.time)
    return np.array(canvas.reduce(scale) if scale > 1 else canvas)


def _whole(name: str, value: int, limits: tuple[int, int]) -> None:
    low, high = limits
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name}: must be an int from {low} to {high}, got {value!r}")
    if not low <= value <= high:
        raise ValueError(f"{name}: must be from {low} to {high}, got {value}")


# ---- what does not move


@lru_cache(maxsize=4)
def _backdrop(view: View, title: str, roles: tuple[str, ...], stones: bytes, walls: tuple[bytes, ...]) -> Image.Image:
    canvas = Image.new("RGB", (view.width, view.height), rgb(PAPER["page"][0]))
    pen = ImageDraw.Draw(canvas, "RGBA")
    world = (view.left, view.top, view.right, view.bottom)
    pen.rectangle(world, fill=rgb(_PAPER))
    _grid(pen, view)
    for x, y, radius in np.frombuffer(stones).reshape(-1, 3).tolist():
        _stone(pen, view, x, y, radius)
    for wall in walls:
        _wall(pen, view, np.frombuffer(wall).reshape(-1, 2))
    _trim(canvas, Image.new("RGB", canvas.size, rgb(PAPER["page"][0])), view, spill=0.0)
    _edge(pen, view)
    _caption(pen, view, title, roles)
    return canvas


def _grid(pen: ImageDraw.ImageDraw, view: View) -> None:
    extent = max(view.high[0] - view.low[0], view.high[1] - view.low[1])
    power = 10.0 ** math.floor(math.log10(extent / 5.0))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power * 10.0 >= extent)
    thick = max(1, round(view.width / 600))
    for n in range(math.ceil(view.low[0] / step), math.floor(view.high[0] / step) + 1):
        x = view.left + (n * step - view.low[0]) * view.metre
        pen.line((x, view.top, x, view.bottom), fill=PAPER["grid"][0], width=thick)
    for n in range(math.ceil(view.low[1] / step), math.floor(view.high[1] / step) + 1):
        y = view.bottom - (n * step - view.low[1]) * view.metre
        pen.line((view.left, y, view.right, y), fill=PAPER["grid"][0], width=thick)


def _stone(pen: ImageDraw.ImageDraw, view: View, x: float, y: float, radius: float) -> None:
    reach = radius * view.metre
    px, py = view.place(np.array([x, y])).tolist()
    for a, b in view.sightings(px, py, reach):
        _disc(pen, a, b, reach, PAPER["rim"][0])
        _disc(pen, a, b, reach - view.width / 400, PAPER["stone"][0])


def _wall(pen: ImageDraw.ImageDraw, view: View, polygon: Floats) -> None:
    """Draw an obstacle that is not round; on a torus, across every edge that its box overlaps."""
    spots = view.place(polygon)
    middle = (spots.min(axis=0) + spots.max(axis=0)) / 2
    reach = float((spots.max(axis=0) - middle).max())
    x, y = middle.tolist()
    for a, b in view.sightings(x, y, reach):
        corners = (spots - middle + (a, b)).ravel().tolist()
        pen.polygon(corners, fill=PAPER["stone"][0], outline=PAPER["rim"][0], width=max(1, round(view.width / 400)))


def _edge(pen: ImageDraw.ImageDraw, view: View) -> None:
    """Frame the world: a closed line, or dashes where it goes on across the seam."""
    thick = max(1, round(view.width / 500))
    if not view.periodic:
        pen.rectangle((view.left, view.top, view.right, view.bottom), outline=PAPER["edge"][0], width=thick)
        return
    dash = view.width / 75
    for x in np.arange(view.left, view.right - dash / 2, 2 * dash).tolist():
        for y in (view.top, view.bottom):
            pen.line((x, y, min(x + dash, view.right), y), fill=PAPER["edge"][0], width=thick)
    for y in np.arange(view.top, view.bottom - dash / 2, 2 * dash).tolist():
        for x in (view.left, view.right):
            pen.line((x, y, x, min(y + dash, view.bottom)), fill=PAPER["edge"][0], width=thick)


# ---- caption


@lru_cache(maxsize=8)
def _font(height: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(height)


def _caption(pen: ImageDraw.ImageDraw, view: View, title: str, roles: tuple[str, ...]) -> None:
    """Write the title on the left and, where there is room, the roles' colours before the clock."""
    big, small = _font(round(view.band * 0.46)), _font(round(view.band * 0.36))
    side, middle = _side(view), 0.52 * view.band
    room = view.width - 2.0 * side - 5.0 * small.getlength("0")
    text = "".join(c if c.isprintable() else " " for c in title)[:200]
    while text and big.getlength(text) > room:
        text = text[:-2].rstrip() + "…" if len(text) > 2 else ""
    pen.text((side, middle), text, fill=_INK, font=big, anchor="lm")
    dot, gap = 0.16 * view.band, 0.3 * view.band
    widths = [2 * dot + 0.5 * gap + small.getlength(role) + 1.6 * gap for role in roles]
    x = side + room - sum(widths) - 0.4 * gap
    if x < side + big.getlength(text) + gap:
        return
    for role, width in zip(roles, widths, strict=True):
        _disc(pen, x + dot, middle, dot, ROLE_COLOURS[role][0])
        pen.text((x + 2 * dot + 0.5 * gap, middle), role, fill=_FAINT, font=small, anchor="lm")
        x += width


def _side(view: View) -> float:
    """Return the caption's distance from the left edge, px: that of the world, unless that is narrow."""
    return view.left if view.left < 0.1 * view.width else 0.45 * view.band


def _clock(pen: ImageDraw.ImageDraw, view: View, time: float) -> None:
    text = f"{time:.1f} s" if abs(time) < 1e6 else f"{time:.3g} s"
    pen.text(
        (view.width - _side(view), 0.52 * view.band), text, fill=_FAINT, font=_font(round(view.band * 0.4)), anchor="rm"
    )


# ---- what moves


def _disc(pen: ImageDraw.ImageDraw, x: float, y: float, r: float, fill: str | tuple[int, ...]) -> None:
    if r > 0.0:
        pen.ellipse((x - r, y - r, x + r, y + r), fill=fill)


def _mark(pen: ImageDraw.ImageDraw, view: View, mark: Mark) -> None:
    x, y = view.place(mark.at).tolist()
    if mark.kind == "heading":
        _arrow(pen, view, x, y, _aim(mark.vector[None])[0])
        return
    if mark.kind == "way":
        for a, b in view.sightings(x, y, mark.radius * view.metre):
            _disc(pen, a, b, mark.radius * view.metre, mix(_GOAL, _PAPER, WAY))
        return
    reach = max(mark.radius * view.metre, view.width / 75)
    thick = max(1, round(view.width / 240))
    for a, b in view.sightings(x, y, reach):
        box = (a - reach, b - reach, a + reach, b + reach)
        pen.ellipse(box, fill=(*rgb(_GOAL), 36))
        pen.ellipse(box, outline=_GOAL, width=thick)
        _disc(pen, a, b, view.width / 200, _GOAL)


def _arrow(pen: ImageDraw.ImageDraw, view: View, x: float, y: float, aim: Floats) -> None:
    length = 0.16 * min(view.right - view.left, view.bottom - view.top) * math.hypot(*aim)
    if length < 1e-3 * view.width:
        return
    along = aim / math.hypot(*aim)
    shape = np.array(ARROW)
    corners = shape[:, :1] * along + shape[:, 1:] * np.array([-along[1], along[0]])
    pixels = np.array([x, y]) + length * corners * np.array([1.0, -1.0])
    pen.polygon(pixels.ravel().tolist(), fill=(*rgb(_GOAL), 120))


def _aim(vel: Floats) -> Floats:
    """Return (N, 2), the x and y of each velocity's unit vector; zero at rest, short where it points up or down."""
    largest = np.abs(vel).max(axis=1, keepdims=True, initial=0.0)
    unit = vel / np.where(largest > 0.0, largest, 1.0)  # first by the largest: no square overflows
    norm = np.linalg.norm(unit, axis=1, keepdims=True)
    return np.asarray(unit[:, :2] / np.where(norm > 0.0, norm, 1.0))


def _depth(snapshot: Snapshot) -> Floats:
    """Return (N,), how near each body is to the eye, 0 (bottom) to 1 (top); 1 everywhere in 2-D."""
    if snapshot.dimension == 2:
        return np.ones(snapshot.agents)
    low, high = snapshot.low[2], snapshot.high[2]
    return np.asarray((np.clip(snapshot.pos[:, 2], low, high) - low) / (high - low))


def _darts(spots: Floats, aim: Floats, reach: Floats) -> Floats:
    """Return the corners (N, 4, 2) in px of every dart; a dart seen from its end is drawn at a third of its length."""
    length = np.hypot(aim[:, 0], aim[:, 1])
    along = aim / np.where(length > 0.0, length, 1.0)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    shape = np.array(DART)
    forward = shape[:, 0] * np.maximum(length, 0.35)[:, None]
    corners = forward[..., None] * along[:, None] + shape[:, 1, None] * across[:, None]
    return np.asarray(spots[:, None] + reach[:, None, None] * corners * np.array([1.0, -1.0]))


def _bonds(pen: ImageDraw.ImageDraw, view: View, snapshot: Snapshot) -> None:
    """Draw a line for every bond with both ends there, the lowest first; across a seam from either side."""
    there = snapshot.alive & snapshot.visible
    bonds = snapshot.bonds[there[snapshot.bonds].all(axis=1)]
    if not len(bonds):
        return
    way = snapshot.pos[bonds[:, 1]] - snapshot.pos[bonds[:, 0]]
    if snapshot.periodic:
        extent = snapshot.high - snapshot.low
        way -= extent * np.rint(way / extent)
    ends = [snapshot.pos[bonds[:, 0]], snapshot.pos[bonds[:, 1]]]
    lines = np.concatenate([view.place(ends[0]), view.place(ends[0] + way)], axis=1)
    copies = np.concatenate([view.place(ends[1] - way), view.place(ends[1])], axis=1)
    twice = np.abs(copies - lines).max(axis=1) > 1.0
    depth, thick = _depth(snapshot)[bonds].mean(axis=1), max(1, round(view.width * BOND))
    for k in np.argsort(depth, kind="stable").tolist():
        share = 0.6 * (0.45 + 0.55 * float(depth[k]))
        fill = mix(ROLE_COLOURS[snapshot.roles[bonds[k, 0]]][0], _PAPER, share)
        for line in (lines[k], copies[k]) if twice[k] else (lines[k],):
            pen.line(line.tolist(), fill=fill, width=thick)


def _bodies(pen: ImageDraw.ImageDraw, view: View, snapshot: Snapshot) -> None:
    seen = np.flatnonzero(snapshot.visible)
    depth = _depth(snapshot)
    swell = 0.7 + 0.5 * depth if snapshot.dimension == 3 else depth
    body = snapshot.radius * view.metre * swell
    reach = np.maximum(body, DART_REACH * view.width * swell)
    tied, dot = snapshot.has_bonds, view.width * BOND
    spots = view.place(snapshot.pos)
    aim = _aim(np.where(snapshot.visible[:, None], snapshot.aim, 0.0))
    darts = _darts(spots, aim, 0.94 * reach)
    shades, plain = snapshot.shade, _plain(snapshot)
    # The lowest first, and crosses over everything: a captured agent must not hide under its captor.
    for i in seen[np.argsort(np.where(snapshot.alive, depth, 2.0)[seen], kind="stable")].tolist():
        role, (x, y) = snapshot.roles[i], spots[i].tolist()
        for a, b in view.sightings(x, y, 1.1 * float(reach[i])):
            if not snapshot.alive[i]:
                _cross(pen, a, b, float(reach[i]), role)
                continue
            if not plain[i]:
                _dressed(pen, view, snapshot, i, (a, b), aim[i], float(shades[i]), float(swell[i]))
                continue
            if tied[i]:
                shade = mix(ROLE_COLOURS[role][0], _PAPER, 0.45 + 0.55 * float(depth[i]))
                _disc(pen, a, b, max(float(body[i]), dot), shade)
                continue
            corners = (darts[i] + (a - x, b - y)).ravel().tolist() if aim[i].any() else []
            _agent(pen, a, b, corners, float(body[i]), float(reach[i]), role, float(depth[i]))


def _agent(
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
        _disc(pen, x, y, 0.5 * reach, solid)
    if body < BODY_DISC * reach:
        _disc(pen, x, y, body, mix(colour, _INK, 0.55))


def _cross(pen: ImageDraw.ImageDraw, x: float, y: float, reach: float, role: str) -> None:
    if role not in _NAMED:
        return
    arm, thick = 0.75 * reach, max(1, round(0.28 * reach))
    for side in (-1.0, 1.0):
        line = (x - arm, y - side * arm, x + arm, y + side * arm)
        pen.line(line, fill=mix(ROLE_COLOURS[role][0], _PAPER, 0.85), width=thick)


def _trails(pen: ImageDraw.ImageDraw, view: View, path: Sequence[Snapshot]) -> None:
    now = path[-1]
    for old in path:
        if old.pos.shape != now.pos.shape:
            raise ValueError(f"trails: must have positions of shape {now.pos.shape}, got {old.pos.shape}")
    spots = view.place(np.stack([old.pos for old in path]))
    there = np.stack([old.alive & old.visible & ~now.has_bonds & _plain(now) for old in path])
    linked = there[1:] & there[:-1] & _steady(view, spots, path)
    lines = np.concatenate([spots[:-1], spots[1:]], axis=2)
    for k in range(len(linked)):
        age = (k + 1) / len(linked)  # 1 is now
        colours = {role: mix(ROLE_COLOURS[role][0], _PAPER, 0.1 + 0.45 * age) for role in set(now.roles)}
        thick = max(1, round(view.width / 240 * (0.35 + 0.65 * age)))
        for i in np.flatnonzero(linked[k]).tolist():
            pen.line(lines[k, i].tolist(), fill=colours[now.roles[i]], width=thick)


def _plain(snapshot: Snapshot) -> NDArray[np.bool_]:
    """Return the agents that are drawn by their role, not by a look, (N,) bool."""
    return np.asarray(np.asarray(snapshot.look) < 0)


def _steady(view: View, spots: Floats, path: Sequence[Snapshot]) -> NDArray[np.bool_]:
    """Return the slots that keep their agent from each snapshot to the next, without a leap, (T - 1, N) bool."""
    leap = np.abs(np.diff(spots, axis=0)) < JUMP * np.array([view.right - view.left, view.bottom - view.top])
    same = np.stack([old.is_same(new) for old, new in itertools.pairwise(path)])
    return np.asarray(leap.all(axis=2) & same)


def _dressed_trails(pen: ImageDraw.ImageDraw, view: View, path: Sequence[Snapshot]) -> None:
    """Draw the path behind agents whose look has a trail, in the colours that they had there, fainter with age."""
    now = path[-1]
    spots = view.place(np.stack([old.pos for old in path]))
    there = np.stack([old.alive & old.visible & ~_plain(old) for old in path])
    linked = there[1:] & there[:-1] & _steady(view, spots, path)
    lines = np.concatenate([spots[:-1], spots[1:]], axis=2)
    length = np.array([dress.trail for dress in now.looks])
    thick = max(1, round(view.width / 400))
    for k, old in enumerate(path[:-1]):
        behind = now.time - path[k + 1].time
        shade = old.shade
        for i in np.flatnonzero(linked[k] & ~_plain(now)).tolist():
            which = int(np.asarray(now.look)[i])
            dress, left = now.looks[which], 1.0 - behind / length[which] if length[which] > 0 else 0.0
            if left > 1e-9:
                colour = dress.colour(float(shade[i]), ROLE_COLOURS[now.roles[i]][0])
                fill = (*colour, round(255 * 0.6 * left * dress.opacity_at(float(shade[i]))))
                pen.line(lines[k, i].tolist(), fill=fill, width=thick)


def _dressed(
    pen: ImageDraw.ImageDraw, view: View, snapshot: Snapshot, i: int, spot: tuple[float, float], aim: Floats,
    shade: float, swell: float,
) -> None:  # fmt: skip
    """Draw an agent by its look."""
    dress = snapshot.looks[int(np.asarray(snapshot.look)[i])]
    x, y = spot
    reach = dress.size_at(shade, float(snapshot.radius[i])) * view.metre * swell
    fill = (*dress.colour(shade, ROLE_COLOURS[snapshot.roles[i]][0]), round(255 * dress.opacity_at(shade)))
    if dress.form == "polygon":
        length = math.hypot(*aim)
        c, s = (aim / length).tolist() if length > 0 else (1.0, 0.0)
        corners = [p for a, b in dress.vertices for p in (x + reach * (a * c - b * s), y - reach * (a * s + b * c))]
        pen.polygon(corners, fill=fill)
    else:
        _disc(pen, x, y, max(reach, view.width * POINT) if dress.form == "point" else reach, fill)


def _trim(canvas: Image.Image, backdrop: Image.Image, view: View, spill: float) -> None:
    """Put the backdrop back around the world, so that no body covers the caption or crosses the seam twice."""
    left, right = math.floor(view.left - spill), math.ceil(view.right + spill) + 1
    top, bottom = math.floor(view.top), math.ceil(view.bottom + spill) + 1
    width, height = view.width, view.height
    strips = [(0, 0, width, top), (0, bottom, width, height), (0, 0, left, height), (right, 0, width, height)]
    for box in strips:
        if box[0] < box[2] and box[1] < box[3]:
            canvas.paste(backdrop.crop(box), box)
