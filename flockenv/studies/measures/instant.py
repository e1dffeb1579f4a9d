"""Measures of one world at one instant: order, spacing, speed, contacts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flockenv.geometry.shapes import distance_to_shapes
from flockenv.model.state import State
from flockenv.scene import Scene
from flockenv.studies.measures.bodies import bodies_of, nearest_of_others, outside_networks
from flockenv.studies.measures.order import nearest_distances, polarisation

__all__ = ["MEASURES", "measure"]

MEASURES = {
    "agents": "alive",
    "speed": "m/s, mean",
    "polarisation": "0 to 1: length of the mean heading",
    "nearest_neighbour": "m, mean distance of centres",
    "contacts": "agents that overlap their nearest neighbour outside their network, or an obstacle",
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
    nearest, which = nearest_distances(pos, scene.space, progress)
    loose = outside_networks(scene)
    apart, other = (nearest, which) if loose.all() else nearest_of_others(pos, scene.space, bodies_of(scene)[alive])
    touching = apart < radius + radius[other]
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
