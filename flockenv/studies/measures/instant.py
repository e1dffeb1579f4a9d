"""Measures of one world at one instant: order, spacing, speed, contacts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes import distance_to_shapes
from flockenv.model.state import State
from flockenv.scene import Scene
from flockenv.studies.measures.order import FARTHEST, nearest_distances, polarisation
from flockenv.studies.measures.proportions import touching_pairs

__all__ = ["MEASURES", "bodies_of", "measure", "outside_networks"]

Floats = NDArray[np.float64]

MEASURES = {
    "agents": "alive",
    "speed": "m/s, mean",
    "polarisation": "0 to 1: length of the mean heading",
    "nearest_neighbour": "m, mean distance of centres",
    "contacts": "agents that overlap their nearest neighbour or an obstacle; not within a network",
    "volume": "of networks, relative to rest; area in 2-D",
    "smallest_element": "its volume, relative to rest; < 0: inside out",
}
"""Names and units of what `measure` returns."""


def measure(
    scene: Scene, state: State, world: int = 0, progress: Callable[[int], None] = lambda done: None
) -> dict[str, float]:
    """Return the measures of one world by name; NaN if one has no meaning (spacing of a single agent).

    Particles of networks are left out of polarisation, which is NaN if there are no other agents. That they overlap
    others of their network is by design, and no contact.

    scene: that of the state; state: at the instant; world: index of the world;
    progress: called with the number of agents whose nearest neighbour has been found.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # a run that is about to diverge may also be measured
        return _measure(scene, state, world, progress)


def _measure(scene: Scene, state: State, world: int, progress: Callable[[int], None]) -> dict[str, float]:
    alive = state.alive[world]
    pos, vel = (np.asarray(a[world][alive], np.float64) for a in (state.pos, state.vel))
    radius = np.asarray(scene.body.radius, np.float64)[alive]
    speed = np.linalg.norm(vel, axis=1)
    nearest, who = nearest_distances(pos, scene.space, progress)
    body, loose = bodies_of(scene)[alive], outside_networks(scene)
    touching = nearest < radius + radius[who]
    if not loose.all():
        touching = np.isin(np.arange(len(pos)), _pairs_of_bodies(pos, radius, scene, body))
    for centre, size in zip(state.obstacles.centre[world], state.obstacles.radius[world], strict=True):
        touching |= (size > 0) & (np.linalg.norm(scene.space.displacement(pos, centre), axis=1) < radius + size)
    if scene.shapes:
        period = np.array(scene.space.extent(scene.dimension) if scene.space.periodic else (0.0,) * scene.dimension)
        touching |= distance_to_shapes(scene.shapes, np.asarray(pos, float), period, float(state.time[world])) < radius
    return {
        "agents": float(alive.sum()),
        "speed": float(speed.mean()) if len(speed) else np.nan,
        "polarisation": polarisation(vel[loose[alive]]),
        "nearest_neighbour": float(nearest.mean()) if len(pos) > 1 else np.nan,
        "contacts": float(touching.sum()),
        **_volumes(scene, state, world),
    }


def _volumes(scene: Scene, state: State, world: int) -> dict[str, float]:
    """Return the volume of all elements of networks and of the smallest one, relative to rest; NaN without elements."""
    now, rest = scene.view.volumes(state, world)
    if not len(rest):
        return {"volume": np.nan, "smallest_element": np.nan}
    return {"volume": float(now.sum() / rest.sum()), "smallest_element": float((now / rest).min())}


def outside_networks(scene: Scene) -> NDArray[np.bool_]:
    """Return True for the agents that are no particles of a network, (N,)."""
    return np.repeat([group.network is None for group in scene.groups], [group.size for group in scene.groups])


def bodies_of(scene: Scene) -> NDArray[np.int64]:
    """Return the number of the body of each agent, (N,): itself, or the first particle of its network."""
    body = np.arange(scene.agents)
    for first, group in zip(scene.starts, scene.groups, strict=False):
        if group.network is not None:
            body[first : first + group.size] = first
    return body


def _pairs_of_bodies(pos: Floats, radius: Floats, scene: Scene, body: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the pairs of agents of different bodies that overlap, (P, 2); positions that are not finite have none."""
    here = np.flatnonzero((np.abs(pos) < FARTHEST).all(axis=1))
    return here[touching_pairs(pos[here], radius[here], scene.space, body=body[here])[0]]
