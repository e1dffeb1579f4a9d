"""View: where the world lies in a picture, metres to pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from flockenv.model.snapshot import Floats, Snapshot

__all__ = ["View", "look"]

_MARGIN: Final = 0.03
_BAND: Final = 0.068
#: Bodies further out than this many extents are drawn there instead: off the picture, and no number overflows.
_FARTHEST: Final = 5.0


@dataclass(frozen=True)
class View:
    """The world's rectangle in a picture of (width, height) px; y points up in the world and down in the picture.

    left, top, right, bottom: px, the edges of [low, high]. metre: px per m. low, high: (x, y) in m.
    spill: px beyond those edges that bodies may still cover. band: px, height of the caption.
    """

    width: int
    height: int
    left: float
    top: float
    right: float
    bottom: float
    metre: float
    low: tuple[float, float]
    high: tuple[float, float]
    periodic: bool
    spill: float
    band: float

    def place(self, points: Floats) -> Floats:
        """Return the pixels (..., 2) of points (..., D) in m, by their x and y."""
        low, high = np.array(self.low), np.array(self.high)
        reach = _FARTHEST * (high - low)
        near = np.clip(points[..., :2], low - reach, high + reach)
        offset = (near - low) * self.metre
        return np.stack([self.left + offset[..., 0], self.bottom - offset[..., 1]], axis=-1)

    def sightings(self, x: float, y: float, reach: float) -> list[tuple[float, float]]:
        """Return where a body of `reach` px is seen: at (x, y) and, if periodic, across every edge that it overlaps."""
        if not self.periodic:
            return [(x, y)]
        xs = _copies(x, reach, self.left, self.right)
        ys = _copies(y, reach, self.top, self.bottom)
        return [(a, b) for a in xs for b in ys]


def _copies(x: float, reach: float, first: float, last: float) -> list[float]:
    places = [x]
    if x - reach < first:
        places.append(x + last - first)
    if x + reach > last:
        places.append(x - last + first)
    return places


def look(snapshot: Snapshot, size: int, scale: int) -> View:
    """Return the view of a picture `size` px wide and at most as high, drawn `scale` times larger.

    Width and height are even, as video encoders ask. Tall worlds are centred, wide ones make the picture lower.
    """
    (low_x, low_y), (high_x, high_y) = snapshot.low[:2].tolist(), snapshot.high[:2].tolist()
    width, margin, band = size - size % 2, size * _MARGIN, size * _BAND
    metre = min((width - 2 * margin) / (high_x - low_x), (width - band - margin) / (high_y - low_y))
    height = 2 * math.ceil((band + metre * (high_y - low_y) + margin) / 2 - 1e-9)
    left = 0.5 * (width - metre * (high_x - low_x))
    return View(
        width=width * scale,
        height=height * scale,
        left=left * scale,
        top=band * scale,
        right=(left + metre * (high_x - low_x)) * scale,
        bottom=(band + metre * (high_y - low_y)) * scale,
        metre=metre * scale,
        low=(low_x, low_y),
        high=(high_x, high_y),
        periodic=snapshot.periodic,
        spill=0.0 if snapshot.periodic else margin * scale,
        band=band * scale,
    )
