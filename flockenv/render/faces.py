"""Surfaces in pictures: the triangles of sheets and bodies, shaded, and hidden where others are nearer."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flockenv.model.snapshot import Floats, Snapshot
from flockenv.render.palette import PAPER, ROLE_COLOURS, rgb
from flockenv.render.view import FARTHEST, View

__all__ = ["draw_faces"]

LIGHT: Final = np.array([-0.35, 0.46, 0.81])
"""Direction of the light: to the right, upwards, towards the reader; that of page/faces.js."""

EVEN: Final = 0.6
"""Light on all faces in 2-D."""


def draw_faces(canvas: Image.Image, view: View, snapshot: Snapshot, height: Floats) -> None:
    """Draw the faces whose corners live on a picture, with a depth buffer.

    height (N,): from 0 to 1, of each agent; low faces are paler.
    """
    faces = snapshot.whole_faces
    faces = faces[(snapshot.alive & snapshot.visible)[faces].all(axis=1)]
    if not len(faces):
        return
    extent = snapshot.high - snapshot.low
    reach = FARTHEST * extent  # as of points in pixels, so that no normal of a run that diverged overflows
    corners = np.clip(snapshot.pos[faces], snapshot.low - reach, snapshot.high + reach)
    if snapshot.periodic:
        corners = corners - extent * np.rint((corners - corners[:, :1]) / extent)
    spots, colours = view.to_pixels(corners), _colours(snapshot, faces, corners, height[faces].mean(axis=1))
    depth = corners[..., 2] if snapshot.dimension == 3 else np.zeros(faces.shape)
    pixels, nearest = np.array(canvas), np.full((view.height, view.width), -np.inf)
    for k in range(len(faces)):
        middle = spots[k].mean(axis=0)
        x, y = middle.tolist()
        for place in view.visible_positions(x, y, float(np.abs(spots[k] - middle).max())):
            _fill(pixels, nearest, spots[k] - middle + place, depth[k], colours[k])
    canvas.paste(Image.fromarray(pixels))


def _fill(pixels: NDArray[np.uint8], nearest: Floats, corners: Floats, depth: Floats, colour: Floats) -> None:
    """Fill a triangle, (3, 2) px, where no pixel is nearer; `depth` (3,) is that of its corners, larger is nearer."""
    low = np.maximum(np.floor(corners.min(axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(corners.max(axis=0)) + 1, nearest.shape[::-1]).astype(int)
    (ax, ay), (bx, by), (cx, cy) = corners.tolist()
    twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)  # its area, with a sign
    if (low >= high).any() or twice == 0.0:
        return
    x, y = np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1])[:, None] + 0.5
    b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / twice
    c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / twice
    z = depth[0] + b * (depth[1] - depth[0]) + c * (depth[2] - depth[0])
    box = (slice(low[1], high[1]), slice(low[0], high[0]))
    seen = (np.minimum(np.minimum(b, c), 1.0 - b - c) >= -1e-9) & (z > nearest[box])
    nearest[box][seen] = z[seen]
    pixels[box][seen] = colour


def _colours(snapshot: Snapshot, faces: NDArray[np.int32], corners: Floats, height: Floats) -> NDArray[np.uint8]:
    """Return the colour of each face, (F, 3): that of its first corner's appearance or role, by light and height."""
    back, lit = np.zeros(len(faces), np.bool_), np.full(len(faces), EVEN)
    if snapshot.dimension == 3:
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        back = normal[:, 2] < 0.0
        lit = np.clip(np.where(back, -1.0, 1.0) * (normal @ LIGHT), 0.0, 1.0)
    own, shades = [], snapshot.shade[faces].mean(axis=1).tolist()
    for i, shade, behind in zip(faces[:, 0].tolist(), shades, back.tolist(), strict=True):
        role = "learner" if behind else snapshot.roles[i]
        colour = ROLE_COLOURS["evader" if role == "agent" else role][0]  # agents are grey
        k = int(np.asarray(snapshot.look)[i])
        own.append(snapshot.looks[k].colour(shade, colour) if k >= 0 else rgb(colour))
    share = np.where(lit < 0.55, 0.45 + lit, 1.0 - 0.7 * (lit - 0.55))[:, None]
    towards = np.where((lit < 0.55)[:, None], rgb(PAPER["ink"][0]), 255)
    pale = (0.8 + 0.2 * height)[:, None]
    mixed = pale * (share * np.array(own) + (1.0 - share) * towards) + (1.0 - pale) * rgb(PAPER["paper"][0])
    return np.asarray(np.rint(mixed), np.uint8)
