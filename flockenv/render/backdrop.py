"""The parts of a picture that do not move, and its margins: ground, grid, obstacles, border, caption, time."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from flockenv.model.snapshot import Floats
from flockenv.render.palette import PAPER, ROLE_COLOURS, rgb
from flockenv.render.view import View

__all__ = ["draw_backdrop", "draw_disc", "draw_time", "restore_margins"]

_PAPER, _INK, _FAINT = (PAPER[part][0] for part in ("paper", "ink", "faint"))


# ---- background


@lru_cache(maxsize=4)
def draw_backdrop(
    view: View, title: str, roles: tuple[str, ...], circles: bytes, outlines: tuple[bytes, ...], box: bytes
) -> Image.Image:
    """Draw the parts that do not move; circles, outlines and box are bytes, so that the result can be cached."""
    canvas = Image.new("RGB", (view.width, view.height), rgb(PAPER["page"][0]))
    pen = ImageDraw.Draw(canvas, "RGBA")
    world = (view.left, view.top, view.right, view.bottom)
    pen.rectangle(world, fill=rgb(_PAPER))
    if box:
        _draw_box(pen, view, np.frombuffer(box).reshape(4, 3))
    else:
        _draw_grid(pen, view)
    for x, y, radius in np.frombuffer(circles).reshape(-1, 3).tolist():
        _draw_circle(pen, view, x, y, radius)
    for outline in outlines:
        _draw_outline(pen, view, np.frombuffer(outline).reshape(-1, 2))
    restore_margins(canvas, Image.new("RGB", canvas.size, rgb(PAPER["page"][0])), view, spill=0.0)
    if not box:
        _draw_border(pen, view)
    _draw_caption(pen, view, title, roles)
    return canvas


def _draw_box(pen: ImageDraw.ImageDraw, view: View, box: Floats) -> None:
    """Draw the region of a world that was turned: its ground with a grid, and its other edges; box: of a snapshot."""
    corner, (x, y, z) = box[0], box[1:] - box[0]
    wide, deep = float(np.linalg.norm(x)), float(np.linalg.norm(y))
    step, thick = _grid_step(max(wide, deep)), max(1, round(view.width / 600))
    lines = [(corner + x * k * step / wide, y) for k in range(1, math.ceil(wide / step))]
    lines += [(corner + y * k * step / deep, x) for k in range(1, math.ceil(deep / step))]
    lines += [(corner + side, z) for side in (0 * x, x, y, x + y)]
    lines += [(corner + z + side, along) for side, along in ((0 * x, x), (y, x), (0 * x, y), (x, y))]
    for start, along in lines:
        pen.line(view.to_pixels(np.stack([start, start + along])).ravel().tolist(), PAPER["grid"][0], thick)
    ground = view.to_pixels(np.stack([corner, corner + x, corner + x + y, corner + y, corner]))
    pen.line(ground.ravel().tolist(), PAPER["edge"][0], max(1, round(view.width / 500)))


def _grid_step(extent: float) -> float:
    """Return the distance of grid lines, m, in a world of this extent: 5 to 10 of them."""
    power = 10.0 ** math.floor(math.log10(extent / 5.0))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power * 10.0 >= extent)


def _draw_grid(pen: ImageDraw.ImageDraw, view: View) -> None:
    step = _grid_step(max(view.high[0] - view.low[0], view.high[1] - view.low[1]))
    thick = max(1, round(view.width / 600))
    for n in range(math.ceil(view.low[0] / step), math.floor(view.high[0] / step) + 1):
        x = view.left + (n * step - view.low[0]) * view.metre
        pen.line((x, view.top, x, view.bottom), fill=PAPER["grid"][0], width=thick)
    for n in range(math.ceil(view.low[1] / step), math.floor(view.high[1] / step) + 1):
        y = view.bottom - (n * step - view.low[1]) * view.metre
        pen.line((view.left, y, view.right, y), fill=PAPER["grid"][0], width=thick)


def _draw_circle(pen: ImageDraw.ImageDraw, view: View, x: float, y: float, radius: float) -> None:
    reach = radius * view.metre
    px, py = view.to_pixels(np.array([x, y])).tolist()
    for a, b in view.visible_positions(px, py, reach):
        draw_disc(pen, a, b, reach, PAPER["rim"][0])
        draw_disc(pen, a, b, reach - view.width / 400, PAPER["stone"][0])


def _draw_outline(pen: ImageDraw.ImageDraw, view: View, polygon: Floats) -> None:
    """Draw an obstacle that is not round; on a torus, also its copies at the edges that its box overlaps."""
    spots = view.to_pixels(polygon)
    middle = (spots.min(axis=0) + spots.max(axis=0)) / 2
    reach = float((spots.max(axis=0) - middle).max())
    x, y = middle.tolist()
    for a, b in view.visible_positions(x, y, reach):
        corners = (spots - middle + (a, b)).ravel().tolist()
        pen.polygon(corners, fill=PAPER["stone"][0], outline=PAPER["rim"][0], width=max(1, round(view.width / 400)))


def _draw_border(pen: ImageDraw.ImageDraw, view: View) -> None:
    """Draw the border of the world: a line, or dashes for a torus."""
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
def _load_font(height: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(height)


def _draw_caption(pen: ImageDraw.ImageDraw, view: View, title: str, roles: tuple[str, ...]) -> None:
    """Write the title on the left, and a legend of roles before the time if there is room."""
    big, small = _load_font(round(view.band * 0.46)), _load_font(round(view.band * 0.36))
    side, middle = _caption_margin(view), 0.52 * view.band
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
        draw_disc(pen, x + dot, middle, dot, ROLE_COLOURS[role][0])
        pen.text((x + 2 * dot + 0.5 * gap, middle), role, fill=_FAINT, font=small, anchor="lm")
        x += width


def _caption_margin(view: View) -> float:
    """Return the distance of the caption from the left edge, px: that of the world unless the world is narrow."""
    return view.left if view.left < 0.1 * view.width else 0.45 * view.band


def draw_time(pen: ImageDraw.ImageDraw, view: View, time: float) -> None:
    """Write the time, s, at the right of the caption."""
    text = f"{time:.1f} s" if abs(time) < 1e6 else f"{time:.3g} s"
    pen.text(
        (view.width - _caption_margin(view), 0.52 * view.band),
        text,
        fill=_FAINT,
        font=_load_font(round(view.band * 0.4)),
        anchor="rm",
    )


def draw_disc(pen: ImageDraw.ImageDraw, x: float, y: float, r: float, fill: str | tuple[int, ...]) -> None:
    """Draw a disc of radius r about (x, y), px; none if r is not > 0."""
    if r > 0.0:
        pen.ellipse((x - r, y - r, x + r, y + r), fill=fill)


def restore_margins(canvas: Image.Image, backdrop: Image.Image, view: View, spill: float) -> None:
    """Draw the backdrop again around the world, so that no agent covers the caption or extends beyond the border."""
    left, right = math.floor(view.left - spill), math.ceil(view.right + spill) + 1
    top, bottom = math.floor(view.top), math.ceil(view.bottom + spill) + 1
    width, height = view.width, view.height
    strips = [(0, 0, width, top), (0, bottom, width, height), (0, 0, left, height), (right, 0, width, height)]
    for box in strips:
        if box[0] < box[2] and box[1] < box[3]:
            canvas.paste(backdrop.crop(box), box)
