"""Order of a flock at one instant: polarisation, milling, momentum, cohesion and spacing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from flockenv.geometry.space import Space, Torus

__all__ = [
    "centre", "cohesion_radius", "components", "group_momentum", "milling", "nearest_distances", "polarisation",
]  # fmt: skip

Floats = NDArray[np.float64]

AT_A_TIME = 2**18
"""Points that are queried between two calls of `progress`."""

FARTHEST = 1e150
"""m: the square of a larger distance overflows."""


def polarisation(vel: Floats) -> float:
    """Return |mean of v_i / |v_i|| over velocities (N, D): 1 if all have the same heading; NaN if no agent moves.

    vel: (N, D) m/s.

    Source: Vicsek et al. 1995, Phys. Rev. Lett. 75, 1226.
    """
    speed = np.linalg.norm(vel, axis=1)
    moving = speed > 0
    if not moving.any():
        return np.nan
    return float(np.linalg.norm((vel[moving] / speed[moving, None]).mean(axis=0)))


def milling(pos: Floats, vel: Floats, space: Space) -> float:
    """Return |mean of unit(x_i - centre) x unit(v_i)|, positions and velocities (N, D): 1 if all circle in one sense.

    pos: (N, D) m; vel: (N, D) m/s. space: the plane, box or torus in which distances are measured.

    NaN if no agent moves away from the centre. Source: Couzin et al. 2002, J. theor. Biol. 218, 1, there called group
    angular momentum.
    """
    out = space.displacement(centre(pos, space), pos) if len(pos) else pos
    far, speed = np.linalg.norm(out, axis=1), np.linalg.norm(vel, axis=1)
    moving = (far > 0) & (speed > 0)
    if not moving.any():
        return np.nan
    r, v = out[moving] / far[moving, None], vel[moving] / speed[moving, None]
    turn = np.cross(r, v) if pos.shape[1] == 3 else (r[:, 0] * v[:, 1] - r[:, 1] * v[:, 0])[:, None]
    return float(np.linalg.norm(turn.mean(axis=0)))


def group_momentum(vel: Floats, mass: ArrayLike) -> float:
    """Return |sum of m_i v_i|, kg m/s, of velocities (N, D), m/s, and masses (N,), kg; infinite masses are left out.

    vel: (N, D) m/s; mass: (N,) kg.
    """
    weight = np.asarray(mass, np.float64)
    free = np.isfinite(weight)
    return float(np.linalg.norm((vel[free] * weight[free, None]).sum(axis=0)))


def centre(pos: Floats, space: Space) -> Floats:
    """Return the centre of positions (N, D), m, (D,): the mean, on a torus the circular mean along each axis.

    Source of the latter: Bai & Breen 2008, J. Graph. Tools 13, 53.
    """
    if not isinstance(space, Torus):
        return np.asarray(pos.mean(axis=0), np.float64)
    size = np.asarray(space.size)
    angle = 2 * np.pi * pos / size
    return np.asarray(np.arctan2(np.sin(angle).mean(axis=0), np.cos(angle).mean(axis=0)) / (2 * np.pi) * size % size)


def cohesion_radius(pos: Floats, space: Space) -> float:
    """Return the mean distance of positions (N, D) from their centre, m; NaN without agents.

    pos: (N, D) m. space: the plane, box or torus in which distances are measured.
    """
    if not len(pos):
        return np.nan
    return float(np.linalg.norm(space.displacement(centre(pos, space), pos), axis=1).mean())


def components(pos: Floats, reach: float, space: Space) -> int:
    """Return the number of connected components of positions (N, D), m, if points within `reach`, m, are linked.

    pos: (N, D) m. space: the plane, box or torus in which distances are measured.
    Raises ValueError if the reach is not positive or, on a torus, more than half of its shortest side.
    """
    longest = min(space.size) / 2 if isinstance(space, Torus) else np.inf
    if not 0 < reach <= longest:
        raise ValueError(f"reach = {reach:g} m: must be > 0" + (f" and <= {longest:g}" if longest < np.inf else ""))
    inside = space.wrap(pos)
    tree = cKDTree(inside, boxsize=space.size if isinstance(space, Torus) else None)
    i, j = tree.query_pairs(reach, output_type="ndarray").reshape(-1, 2).T
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(len(pos), len(pos)))
    return int(connected_components(graph, directed=False, return_labels=False)) if len(pos) else 0


def nearest_distances(
    pos: Floats, space: Space, progress: Callable[[int], None] = lambda done: None
) -> tuple[Floats, NDArray[np.intp]]:
    """Return for each of (N, D) points, m, the distance to its nearest neighbour, m, and which point that is.

    pos: (N, D) m. space: the plane, box or torus in which distances are measured.

    A single point, or one beyond FARTHEST along an axis, has itself as nearest neighbour, at distance inf.
    progress: called with the number of points done.
    """
    distance, nearest = np.full(len(pos), np.inf), np.arange(len(pos))
    here = np.flatnonzero((np.abs(pos) < FARTHEST).all(axis=1))
    if len(here) < 2:
        return distance, nearest
    inside = space.wrap(pos[here])
    tree = cKDTree(inside, boxsize=space.size if isinstance(space, Torus) else None)
    # In the order of the tree's leaves, successive points need the same nodes, which are then in the caches.
    for first in range(0, len(here), AT_A_TIME):
        progress(first)
        rows = np.asarray(tree.indices[first : first + AT_A_TIME])
        found, which = tree.query(inside[rows], k=2)
        # Of two points at the same place either may be found first: the neighbour is the one that is not the point.
        column = np.where(which[:, 0] == rows, 1, 0)
        k = np.arange(len(rows))
        distance[here[rows]], nearest[here[rows]] = found[k, column], here[which[k, column]]
    return distance, nearest
