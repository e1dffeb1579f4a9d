"""Camera: a 3-D world turned in front of the viewer, for stills and films, as page/lens.js turns it on a page."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flockenv.model.snapshot import Floats, Mark, Snapshot

__all__ = ["check_camera", "rows_of", "turned"]


def check_camera(yaw: float, tilt: float, dimension: int) -> None:
    """Raise ValueError, in one line, unless -360 <= yaw <= 360 and 0 <= tilt <= 180 degrees, 0 in 2-D."""
    if not -360 <= yaw <= 360:
        raise ValueError(f"yaw = {yaw:g}: must be from -360 to 360 degrees")
    if not 0 <= tilt <= 180:
        raise ValueError(f"tilt = {tilt:g}: must be from 0 to 180 degrees; 0 is the view from above, 90 from the side")
    if dimension != 3 and (yaw or tilt):
        raise ValueError(f"yaw = {yaw:g}, tilt = {tilt:g}: for worlds in 3-D only; this one is in 2-D")


def rows_of(yaw: float, tilt: float) -> Floats:
    """Return the rows of the rotation, (3, 3): to the right, upwards, towards the viewer; angles in degrees.

    Yaw turns the viewer about z, tilt lowers the view from above (0) to the side (90), as `turned` in page/lens.js.
    """
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    ct, st = math.cos(math.radians(tilt)), math.sin(math.radians(tilt))
    return np.array([[c, s, 0.0], [-s * ct, c * ct, st], [s * st, -c * st, ct]])


def turned(snapshot: Snapshot, yaw: float, tilt: float) -> Snapshot:
    """Return a snapshot in axes that point to the right, upwards and towards the viewer; the region's middle is 0.

    yaw: degrees about the vertical; tilt: degrees from above.

    Obstacles that are not round lie on the ground of the region. Nothing is drawn twice at the edges of a torus, and
    bonds across them are left out.
    Raises ValueError, in one line, for angles out of range, see `check_camera`, and in 2-D unless both are 0.
    """
    check_camera(yaw, tilt, snapshot.dimension)
    if not (yaw or tilt):
        return snapshot
    rows, middle = rows_of(yaw, tilt), (snapshot.low + snapshot.high) / 2
    reach = np.abs(rows) @ (snapshot.high - snapshot.low) / 2

    def vectors(given: Floats) -> Floats:
        with np.errstate(invalid="ignore"):  # of bodies that diverged, which are not drawn
            return np.asarray(given @ rows.T)

    def points(given: Floats) -> Floats:
        return vectors(given - middle)

    def on_ground(polygon: Floats) -> Floats:
        return points(np.column_stack([polygon, np.full(len(polygon), snapshot.low[2])]))[:, :2]

    corners = np.stack([snapshot.low, *(snapshot.low + np.diag(snapshot.high - snapshot.low))])
    return replace(
        snapshot, pos=points(snapshot.pos), vel=vectors(snapshot.vel), low=-reach, high=reach, box=points(corners),
        heading=None if snapshot.heading is None else vectors(snapshot.heading),
        obstacle_centre=points(snapshot.obstacle_centre), outlines=tuple(map(on_ground, snapshot.outlines)),
        marks=tuple(Mark(m.kind, points(m.at), vectors(m.vector), m.radius) for m in snapshot.marks),
        periodic=False, broken=_left_out(snapshot) if snapshot.periodic else snapshot.broken,
    )  # fmt: skip


def _left_out(snapshot: Snapshot) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return the bonds that are broken or cross an edge of a torus, (E,) bool."""
    ends, half = snapshot.pos[snapshot.bonds], (snapshot.high - snapshot.low) / 2
    across = (np.abs(ends[:, 1] - ends[:, 0]) > half).any(axis=1)
    return np.asarray(across if snapshot.broken is None else across | snapshot.broken)
