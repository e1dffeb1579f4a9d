"""Bodies: networks of particles, and agents outside of them; searches for neighbours of another body.

Particles of one network overlap by design, and a fine cloth beside a large ball has millions of such pairs, so no
search looks at two of the same network.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flockenv.geometry.space import Space, Torus
from flockenv.scene import Scene
from flockenv.studies.measures.order import FARTHEST

__all__ = ["bodies_of", "near_pairs", "nearest_of_others", "outside_networks"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def outside_networks(scene: Scene) -> NDArray[np.bool_]:
    """Return True for the agents that are no particles of a network, (N,).

    scene: its groups are read.
    """
    return np.repeat([group.network is None for group in scene.groups], [group.size for group in scene.groups])


def bodies_of(scene: Scene) -> Ints:
    """Return the number of the body of each agent, (N,): itself, or the first particle of its network.

    scene: its groups are read.
    """
    body = np.arange(scene.agents)
    for first, group in zip(scene.starts, scene.groups, strict=False):
        if group.network is not None:
            body[first : first + group.size] = first
    return body


class _Part(NamedTuple):
    """The particles of a network, or all agents outside of networks, and a tree of their positions."""

    agent: Ints
    loose: bool  # True for agents outside of networks
    tree: cKDTree


def _parts(pos: Floats, space: Space, body: Ints) -> list[_Part]:
    """Return the parts of points (N, D), m; a network of one particle counts as an agent."""
    _, which, count = np.unique(body, return_inverse=True, return_counts=True)
    alone = count[which] == 1
    sets = [(np.flatnonzero(alone), True), *((np.flatnonzero(which == k), False) for k in np.flatnonzero(count > 1))]
    wrapped, box = space.wrap(pos), space.size if isinstance(space, Torus) else None
    return [_Part(index, loose, cKDTree(wrapped[index], boxsize=box)) for index, loose in sets if len(index)]


def near_pairs(pos: Floats, radius: Floats, space: Space, body: Ints, margin: float) -> Ints:
    """Return pairs of points of different bodies, (P, 2): all up to (1 + margin) (r_i + r_j) apart, and some others.

    pos: (N, D) m; radius: (N,) m; space: in which distances are measured; body: (N,), see `bodies_of`.
    """
    return np.concatenate([np.zeros((0, 2), np.int64), *_pairs(_parts(pos, space, body), radius * (1 + margin))])


def _pairs(parts: list[_Part], radius: Floats) -> Iterator[Ints]:
    """Yield pairs that may be near, (P, 2), within the agents outside of networks, and between two parts each."""
    widest = [float(radius[part.agent].max()) for part in parts]
    for k, part in enumerate(parts):
        if part.loose:
            own = part.tree.query_pairs(2 * widest[k], output_type="ndarray").reshape(-1, 2)
            yield part.agent[own]
        for other, wide in zip(parts[k + 1 :], widest[k + 1 :], strict=True):
            found = part.tree.sparse_distance_matrix(other.tree, widest[k] + wide, output_type="ndarray")
            yield np.sort(np.stack([part.agent[found["i"]], other.agent[found["j"]]], axis=1), axis=1)


def nearest_of_others(pos: Floats, space: Space, body: Ints) -> tuple[Floats, Ints]:
    """Return for each point the distance to the nearest point of another body, (N,) m, and which point that is, (N,).

    pos: (N, D) m; space: in which distances are measured; body: (N,), see `bodies_of`. A point without another body, or
    beyond `order.FARTHEST` along an axis, has itself, at distance inf.
    """
    distance, nearest = np.full(len(pos), np.inf), np.arange(len(pos))
    here = np.flatnonzero((np.abs(pos) < FARTHEST).all(axis=1))
    if not len(here):
        return distance, nearest
    parts, inside = _parts(pos[here], space, body[here]), space.wrap(pos[here])
    for part in parts:
        for other in parts:
            if part is other and not part.loose:
                continue
            far, which = _query(other, inside[part.agent], part.agent if part is other else None)
            rows = here[part.agent]
            nearer = far < distance[rows]
            distance[rows[nearer]], nearest[rows[nearer]] = far[nearer], here[which[nearer]]
    return distance, nearest


def _query(part: _Part, places: Floats, own: Ints | None) -> tuple[Floats, Ints]:
    """Return the nearest point of a part to each place; own: these points of the part are the places themselves."""
    if own is None:
        far, which = part.tree.query(places)
        return far, part.agent[which]
    if len(own) < 2:
        return np.full(len(own), np.inf), own
    far, which = part.tree.query(places, k=2)
    rows = np.arange(len(own))
    column = np.where(which[:, 0] == rows, 1, 0)  # of two points in one place either may be found first
    return far[rows, column], part.agent[which[rows, column]]
