"""Floor fields: shortest paths around the obstacles of a scene, on a grid, for aims, journeys, routes and behaviours.

One grid (eikonal.floor_field_table) serves all agents with the same targets; laws read it by `path_ahead`.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.core.warnings import NoWayWarning
from flockenv.geometry.eikonal import NO_WAY, Start, floor_field_table, free_part
from flockenv.geometry.space import Torus
from flockenv.geometry.targets import Target, to_any
from flockenv.jit.decorators import Vec, law
from flockenv.maths.grid import MOST_POINTS, covers, sample, sample_points, sample_vector
from flockenv.maths.vectors import norm, select, unit
from flockenv.model.scene_view import SceneView

__all__ = [
    "check_floor_field",
    "floor_field_block",
    "floor_field_to",
    "grid_corners",
    "path_ahead",
    "path_lengths",
    "path_to_target",
    "start_boxes",
    "warn_cut_off",
]  # fmt: skip

Floats = NDArray[np.float64]


@law
def path_ahead(table: Any, x: Vec, straight: Vec) -> tuple[float, Vec]:
    """Return the path length from x, m, and the initial direction; outside the grid, those of a straight line."""
    here = covers(table, x)
    length = sample(table, x, 0) if here else norm(straight)
    direction = unit(select(here, sample_vector(table, x, 1), straight))
    return length, direction


@law
def path_to_target(table: Any, x: Vec) -> tuple[float, Vec]:
    """Return the path length to the nearest target of a block, m, and the initial direction; both 0 within it.

    A block (see `floor_field_block`) holds the number of targets, the distance within which the straight line to
    them is free, m, a row for each target, and a grid.
    """
    count, size = np.int64(table[0]), 3 * len(x) + 1
    straight = to_any(table, 2, count, x)
    length, direction = path_ahead(table[2 + count * size :], x, straight)
    near = norm(straight)
    close = near <= table[1]
    return near if close else length, select(close, unit(straight), direction)


def grid_corners(scene: SceneView, targets: Sequence[Target], margin: float) -> tuple[Floats, Floats]:
    """Return the corners of the grid: those of the box, or of all contents of the scene with a margin around."""
    size = getattr(scene.space, "size", None)
    if size is not None:
        return np.zeros(scene.dimension), np.array(size, float)
    places = [target.extremes for target in targets]
    places += [np.asarray(shape.extremes) for shape in scene.obstacles]
    places += [np.asarray(member.place.extremes) for member in scene.population if hasattr(member, "place")]
    for k, group in enumerate(scene.groups):
        if group.network is not None:
            places.append(group.network.points(scene.dimension))
        elif group.spawn.low is not None or scene.living[k]:
            places.append(np.array((group.spawn.low, group.spawn.high)))
    every = np.concatenate(places)
    return every.min(axis=0) - margin, every.max(axis=0) + margin


def start_boxes(scene: SceneView, which: int | None) -> list[Start]:
    """Return the boxes in which agents of a group (None: all groups) start or are born; none for networks."""
    size = getattr(scene.space, "size", None)
    found = []
    for k, group in enumerate(scene.groups):
        low, high = group.spawn.low or (0.0,) * scene.dimension, group.spawn.high or size
        if which in (None, k) and group.network is None and scene.living[k] and high is not None:
            found.append(Start(f"groups[{k}]", np.array(low, float), np.array(high, float)))
    wanted = range(len(scene.groups)) if which is None else (which,)
    for k, member in enumerate(scene.population):
        if any(map(member.feeds, wanted)):
            places = np.asarray(member.place.extremes, float)
            found.append(Start(f"population[{k}]", places.min(axis=0), places.max(axis=0)))
    return found


def path_lengths(grid: Floats, points: ArrayLike) -> Floats:
    """Return path lengths from points (..., D), (...) m; inf without a path; outside the grid those of its edge."""
    found = sample_points(grid, points)[..., 0]
    return np.asarray(np.where(found > NO_WAY * 1e-12, np.inf, found))  # also next to points without a path


def warn_cut_off(name: str, lost: NDArray[np.bool_], state: Any) -> None:
    """Warn of the living agents of a state without a path to the targets of an effect; lost: (B, N)."""
    lost = lost & np.asarray(state.alive, bool)
    if lost.any():
        world, agent = (int(k) for k in np.argwhere(lost)[0])
        place = ", ".join(f"{x:.3g}" for x in state.pos[world, agent])
        warnings.warn(
            f"{name}: no way leads there from where {lost.sum()} of {state.alive.sum()} agents begin (the first: agent "
            f"{agent} of world {world} at ({place}) m); they stand still once they head for a place without a way",
            NoWayWarning, 2,
        )  # fmt: skip


def floor_field_to(
    scene: SceneView, targets: Sequence[Target], names: Sequence[str], corners: tuple[Floats, Floats], spacing: float,
    clearance: float, starts: Sequence[Start] = (),
) -> Floats:  # fmt: skip
    """Return the floor field to the nearest of some targets."""
    low, high = (corner.tolist() for corner in corners)
    return floor_field_table(list(scene.obstacles), targets, low, high, spacing, clearance, names, starts)


def floor_field_block(
    scene: SceneView, targets: Sequence[Target], names: Sequence[str], corners: tuple[Floats, Floats], spacing: float,
    clearance: float, starts: Sequence[Start] = (),
) -> Floats:  # fmt: skip
    """Return the block that `path_to_target` reads: the reachable parts of the targets, and the floor field to them.

    A target nearer than the spacing, and nearer than the obstacles next to it, is reached on a straight line.
    """
    grid = floor_field_to(scene, targets, names, corners, spacing, clearance, starts)
    free = [free_part(scene.obstacles, *given, spacing, clearance) for given in zip(targets, names, strict=True)]
    direct = min([spacing, *(float(gap.min()) for _, _, gap in free)])
    rows = [target.row for target, _, _ in free]
    return np.concatenate([[len(targets), direct], np.ravel(rows), grid])


def check_floor_field(
    scene: SceneView, kind: str, targets: Sequence[Target], names: Sequence[str], margin: float, spacing: float,
    clearance: float,
) -> None:  # fmt: skip
    """Raise ValueError for a torus, moving obstacles, walls that the grid misses, and too large a grid."""
    for name, target in zip(names, targets, strict=True):
        if target.dimension != scene.dimension:
            mismatch = f"lies in {target.dimension} dimensions, but dimension = {scene.dimension}"
            raise ValueError(f"{name} = {target.points_text}: {mismatch}")
    for k, shape in enumerate(scene.obstacles):
        if shape.moves:
            raise ValueError(f"kind = {kind}: paths are found once, at the start, but obstacles[{k}] moves")
        thick = shape.thickness
        if spacing >= 2 * clearance + thick:
            raise ValueError(
                f"spacing = {spacing:g}: paths lead through obstacles[{k}], {thick:g} m thick, unless a clearance of "
                f"more than {(spacing - thick) / 2:g} m or a spacing of less than {2 * clearance + thick:g} m is given"
                if clearance or thick
                else f"clearance = 0: paths lead through obstacles[{k}], which is a line; must be more than half of "
                f"the spacing, {spacing / 2:g} m"
            )
    if isinstance(scene.space, Torus):
        raise ValueError(f"kind = {kind}: finds no paths around a torus; only a plane or a box is allowed")
    low, high = grid_corners(scene, targets, margin)
    points = float(np.prod((high - low) / spacing + 1))
    if points > MOST_POINTS:
        raise ValueError(f"spacing = {spacing:g}: a grid of {points:,.0f} points; at most {MOST_POINTS:,} are allowed")
