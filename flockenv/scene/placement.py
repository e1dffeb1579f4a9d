"""Initial states: group after group, by their spawns and networks, clear of obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes import distance_to_shapes
from flockenv.jit.section import entry
from flockenv.model.scene_view import SceneView
from flockenv.model.spawn import Spawn, cells, scatter
from flockenv.model.state import Floats, State
from flockenv.physics.population import Emitter

if TYPE_CHECKING:
    from flockenv.model.group import Group

__all__ = ["cells_of", "place_groups"]

Cells = tuple[Floats | None, ...]

ROUNDS = 256
"""Most draws of an initial position for an agent that would begin in an obstacle other than a circle."""


def cells_of(scene: SceneView) -> Cells:
    """Return the centres of initial cells of groups with a cell per agent, (size, D) m; None for other groups.

    Raise ValueError, naming the group and the field, if there is no room.
    """
    return tuple(
        None if group.spawn.spacing is None else _group_cells(scene, k, group) for k, group in enumerate(scene.groups)
    )


def place_groups(scene: SceneView, state: State, centres: Cells) -> None:
    """Write the initial state: positions, velocities, headings, and which agents live.

    centres: the cell centres of `cells_of`.
    """
    for b in range(len(state.key)):
        for first, group, own_centres in zip(scene.starts, scene.groups, centres, strict=False):
            if group.network is not None:
                _place_network(scene, state, b, first, group)
            else:
                _place_scattered(scene, state, b, first, group, own_centres)
    _clear_empty_slots(scene, state)
    _write_headings(scene, state)


def _period(scene: SceneView) -> NDArray[np.float64]:
    """Return the edges of a torus, (D,) m; zeros for other spaces."""
    return np.array(scene.space.extent(scene.dimension) if scene.space.periodic else (0.0,) * scene.dimension, float)


def _corners(scene: SceneView, spawn: Spawn) -> tuple[Sequence[float], Sequence[float]]:
    """Return the corners of the box in which agents begin, m."""
    return spawn.low or (0.0,) * scene.dimension, spawn.high or scene.space.extent(scene.dimension)


def _group_cells(scene: SceneView, k: int, group: Group) -> Floats:
    """Return the centres of a group's cells, (size, D) m."""
    try:
        box = _corners(scene, group.spawn)
        return cells(group.spawn, *box, group.size, group.widest, scene.obstacles, _period(scene))
    except ValueError as error:
        raise ValueError(f"groups[{k}].spawn.{error}") from None


def _place_scattered(scene: SceneView, state: State, b: int, first: int, group: Group, centres: Floats | None) -> None:
    """Write a group's initial positions in one world: anywhere in its box, or each near the centre of its cell."""
    spawn, d, period = group.spawn, scene.dimension, _period(scene)
    low, high = (np.array(corner, float) for corner in _corners(scene, spawn))
    if centres is not None:
        low, high = np.full(d, -spawn.jitter), np.full(d, spawn.jitter)
    heading = np.array(spawn.heading if spawn.heading is not None else (0.0,) * d, float)
    attempts, slots = np.zeros(scene.agents, np.int64), slice(first, first + group.size)
    circles = 0 if centres is not None else len(scene.circles)  # cells are clear of all circles
    for _ in range(ROUNDS if scene.shapes else 1):
        entry(scatter)(
            state.key[b], state.x[:, b], state.v[:, b], scene.body.radius, slots.start, slots.stop, low, high,
            *spawn.speed, heading, state.obstacle_x[:, b, :circles], state.obstacle_radius[b, :circles],
            period, np.zeros(d), attempts,
        )  # fmt: skip
        if centres is not None:
            state.pos[b, slots] += centres
            return
        inside = distance_to_shapes(scene.shapes, np.array(state.pos[b, slots], np.float64), period) < group.radii
        if not inside.any():
            return
        attempts[slots] += inside


def _place_network(scene: SceneView, state: State, b: int, first: int, group: Group) -> None:
    """Write the initial positions and velocities of a network's particles in one world."""
    assert group.network is not None
    slots = slice(first, first + group.size)
    state.pos[b, slots] = group.network.points(scene.dimension)
    velocities, held = group.network.velocities(scene.dimension), group.network.pins()
    state.vel[b, slots] = velocities
    if group.spawn.heading is not None:
        heading = np.asarray(group.spawn.heading, float)
        state.vel[b, slots] += group.spawn.speed[0] * heading / np.linalg.norm(heading)
        state.vel[b, first + held] = velocities[held]


def _clear_empty_slots(scene: SceneView, state: State) -> None:
    """Clear the slots of agents that do not live at the start, and place them at their emitter, if any."""
    for k, (first, alive) in enumerate(zip(scene.starts, scene.living, strict=False)):
        dead = slice(first + alive, scene.starts[k + 1])
        emitters = [member for member in scene.population if isinstance(member, Emitter) and member.feeds(k)]
        state.alive[:, dead], state.vel[:, dead] = False, 0
        if scene.population:
            state.identity[:, dead] = -1
        if emitters:
            state.pos[:, dead] = emitters[0].place.extremes.mean(axis=0)


def _write_headings(scene: SceneView, state: State) -> None:
    """Write the initial headings: along the velocity, or the heading of the group."""
    for first, group in zip(scene.starts, scene.groups, strict=False):
        if scene.parts.oriented and group.spawn.heading is not None:
            heading = np.asarray(group.spawn.heading, float)
            state.heading[:, first : first + group.size] = heading / np.linalg.norm(heading)
    state.face()
