"""Surfaces from files that bound no solid as they are, mended by trimesh (extra `mesh`)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Repaired", "repair_surface"]

Floats = NDArray[np.float64]
Ints = NDArray[Any]


class Repaired(NamedTuple):
    """A mended surface, and what was done."""

    points: Floats  # (n, 3), in the unit of the file
    triangles: Ints  # (T, 3), counter-clockwise from outside
    report: str  # one line


def repair_surface(points: Floats, triangles: Ints) -> Repaired:
    """Return a surface without doubled points and faces, whose faces look outwards, and whose small holes are filled.

    points: (n, 3), in any unit; triangles: (T, 3). Points in one place become one. Triangles that are there twice or
    have no area are left out. Triangles that look the other way than their neighbours, and parts that look inwards, are
    turned. Holes of three or four edges are filled. What stays wrong, such as a larger hole, obstacles refuse.
    Raises ValueError, in one line, without trimesh, or if no triangle is left.
    """
    try:
        import networkx  # noqa: F401  # trimesh compares neighbours by it
        import trimesh
    except ImportError:
        raise ValueError("repair needs the packages trimesh and networkx: pip install 'flockenv[mesh]'") from None
    mends: Any = trimesh.repair  # without types
    mesh = trimesh.Trimesh(points, triangles, process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.update_faces(mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    merged, left = len(points) - len(mesh.vertices), len(mesh.faces)
    if not left:
        raise ValueError("repair: no triangle has an area")
    before = np.array(mesh.faces)
    mends.fix_winding(mesh)
    mends.fill_holes(mesh)
    mends.fix_inversion(mesh, multibody=True)
    turned = int((_turns(before) != _turns(np.asarray(mesh.faces)[:left])).sum())
    report = (
        f"{merged:,} points merged, {len(triangles) - left:,} triangles left out, {turned:,} turned, "
        f"{len(mesh.faces) - left:,} added to fill holes; {'closed' if mesh.is_watertight else 'still open'}"
    )
    return Repaired(np.array(mesh.vertices, float), np.array(mesh.faces, np.int64), report)


def _turns(triangles: Ints) -> NDArray[np.bool_]:
    """Return in which of two directions triangles (T, 3) run through the numbers of their corners, (T,)."""
    first = triangles.argmin(axis=1)
    after, last = (np.take_along_axis(triangles, ((first + k) % 3)[:, None], axis=1)[:, 0] for k in (1, 2))
    return np.asarray(after < last)
