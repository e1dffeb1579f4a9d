"""View: the place of the world in a picture, and the conversion of metres to pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from flockenv.model.snapshot import Floats, Snapshot

__all__ = ["FARTHEST", "View", "view_of"]

_MARGIN: Final = 0.03
_BAND: Final = 0.068
#: Distance, in extents of the world, to which farther agents are moved: they are outside the picture, and no number
#: overflows.
FARTHEST: Final = 5.0


@dataclass(frozen=True)
class View:
    """Rectangle of the world in a picture of (width, height) px; y points up in the world and down in the picture.

    low, high: corners of the world, (x, y) m. left, top, right, bottom: its edges in the picture, px. metre: px per m.
    spill: px beyond the edges that agents may cover. band: height of the caption, px.
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

    def to_pixels(self, points: Floats) -> Floats:
        """Return the pixel coordinates, (..., 2), of points, (..., D) m; z is ignored."""
        low, high = np.array(self.low), np.array(self.high)
        reach = FARTHEST * (high - low)
        near = np.clip(points[..., :2], low - reach, high + reach)
        offset = (near - low) * self.metre
        return np.stack([self.left + offset[..., 0], self.bottom - offset[..., 1]], axis=-1)

    def visible_positions(self, x: float, y: float, reach: float) -> list[tuple[float, float]]:
        """Return the positions at which a body of `reach` px is drawn: (x, y), and, on a torus, images at the edges."""
        if not self.periodic:
            return [(x, y)]
        xs = _axis_positions(x, reach, self.left, self.right)
        ys = _axis_positions(y, reach, self.top, self.bottom)
        return [(a, b) for a in xs for b in ys]


def _axis_positions(x: float, reach: float, first: float, last: float) -> list[float]:
    positions = [x]
    if x - reach < first:
        positions.append(x + last - first)
    if x + reach > last:
        positions.append(x - last + first)
    return positions


def view_of(snapshot: Snapshot, size: int, scale: int) -> View:
    """Return the view of a picture that is `size` px wide and at most as high, drawn `scale` times larger.

    Width and height are even, as video encoders require. A tall world is centred; a wide one makes the picture lower.
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
