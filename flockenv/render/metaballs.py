"""Metaballs: discs that melt into their neighbours, as the surface of a liquid (Blinn 1982).

Each agent has a field (1 - (d / R)^2)^2 within its reach R = METABALL sizes, and is drawn where the sum of all fields
is at least that of a lone agent at the edge of its disc. Its colour and opacity are means, weighted by the fields.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from PIL import Image

from flockenv.model.snapshot import Floats
from flockenv.render.palette import METABALL
from flockenv.render.view import View

__all__ = ["LEVEL", "draw_metaballs"]

#: The field of a lone agent at the edge of its disc, where the surface is.
LEVEL: Final = (1.0 - 1.0 / METABALL**2) ** 2


def draw_metaballs(canvas: Image.Image, view: View, spots: Floats, size: Floats, colour: Floats) -> None:
    """Draw agents as one surface; spots: (n, 2) px, size: (n,) px, colour: (n, 4), 0 to 255 with the opacity last."""
    sums = np.zeros((canvas.height, canvas.width, 5))  # fields, and colours times fields
    for (x, y), r, paint in zip(spots.tolist(), size.tolist(), colour, strict=True):
        reach = METABALL * r
        for a, b in view.visible_positions(x, y, reach) if reach > 0 else ():
            left, right = max(0, math.floor(a - reach)), min(canvas.width, math.ceil(a + reach) + 1)
            top, bottom = max(0, math.floor(b - reach)), min(canvas.height, math.ceil(b + reach) + 1)
            if left < right and top < bottom:
                across, down = np.arange(left, right) - a, np.arange(top, bottom) - b
                field = np.maximum(1.0 - (across**2 + down[:, None] ** 2) / reach**2, 0.0) ** 2
                sums[top:bottom, left:right] += field[..., None] * np.array([1.0, *paint])
    inside = sums[..., 0] >= LEVEL
    pixels = np.array(canvas)
    found = sums[inside]
    means = found[:, 1:] / found[:, :1]
    opacity = means[:, 3:] / 255.0
    pixels[inside] = np.rint(opacity * means[:, :3] + (1.0 - opacity) * pixels[inside]).astype(np.uint8)
    canvas.paste(Image.fromarray(pixels))
