"""Aims by floor fields: shortest paths around all obstacles to a target, or to the nearest of several."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from flockenv.geometry.targets import Target, row_size
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import scale, select, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.aims import Aim, applies_to
from flockenv.physics.effects.effect import Me
from flockenv.physics.floor_fields import (
    check_floor_field,
    floor_field_block,
    grid_corners,
    path_lengths,
    path_to_target,
    start_boxes,
    warn_cut_off,
)

__all__ = ["Around", "Way", "slow_down"]


@law
def slow_down(direction: Vec, length: float, slow_radius: float) -> Vec:
    """Return a direction, shortened if less than slow_radius, m, of the path remains."""
    return scale(direction, length / slow_radius if length < slow_radius else like(length, 1.0))


@law
def path_aim(p: Any, me: Me) -> Vec:
    """Return the direction of the shortest path to any of the targets."""
    length, direction = path_to_target(p.table, me.pos)
    return select(applies_to(p, me), scale(slow_down(direction, length, p.slow_radius), p.share), zero(me.pos))


class Around(Aim):
    """Base class of aims by floor fields, which are computed on a grid when the scene is built."""

    clearance: float = Field(default=0.3, ge=0, description="m, of paths from obstacles: at least a body's radius")
    spacing: float = Field(default=0.2, gt=0, description="m, between points of the grid")
    margin: float = Field(default=3.0, gt=0, description="m, of the grid around the scene, if the space is not a box")
    tabled: ClassVar[bool] = True
    needs_all: ClassVar[bool] = False
    """True if an agent must visit all targets, False if one of them is enough."""

    def field_block(self, scene: SceneView, targets: tuple[Target, ...], names: tuple[str, ...]) -> NDArray[np.float64]:
        """Return the block of the floor field to the nearest target; see flockenv.physics.floor_fields."""
        corners = grid_corners(scene, self.goals[0], self.margin)
        starts = start_boxes(scene, self.group)
        return floor_field_block(scene, targets, names, corners, self.spacing, self.clearance, starts)

    @property
    def goals(self) -> tuple[tuple[Target, ...], tuple[str, ...]]:
        """All targets, with their names in errors."""
        raise NotImplementedError

    def check(self, scene: SceneView) -> None:
        """Raise ValueError for a torus, moving obstacles, too large a grid, targets in obstacles or out of reach."""
        super().check(scene)
        if self.keeps:
            _check_alone(self, scene)
        check_floor_field(scene, self.kind, *self.goals, self.margin, self.spacing, self.clearance)
        scene.table_of(self)

    def grids(self, scene: SceneView) -> list[NDArray[np.float64]]:
        """Return the floor fields, one for each target or set of alternatives.

        scene: that has the effect.
        """
        raise TypeError(f"{type(self).__name__} has no floor fields")

    def check_start(self, scene: SceneView, state: Any) -> None:
        """Warn of agents that start where no path leads to any target, or to a stage of a journey."""
        first, end = (int(k) for k in self.members(scene.starts).values())
        lengths = np.array([path_lengths(grid, state.pos[:, first:end]) for grid in self.grids(scene)])
        if not len(lengths):
            return
        lost = np.zeros(state.alive.shape, bool)
        lost[:, first:end] = np.isinf(lengths).any(axis=0) if self.needs_all else np.isinf(lengths).all(axis=0)
        warn_cut_off(" or ".join(self.goals[1]), lost, state)


def _check_alone(effect: Aim, scene: SceneView) -> None:
    """Raise ValueError if another effect keeps the same numbers of the same agents, as changes would be added."""
    first, end = effect.members(scene.starts).values()
    for k, other in enumerate(scene.effects):
        if isinstance(other, Around) and other is not effect and set(effect.keeps) & set(other.keeps):
            theirs = other.members(scene.starts)
            if theirs["first"] < end and first < theirs["end"]:
                raise ValueError(f"group = {effect.group}: effects[{k}], a {other.kind}, also steers some of them")


class Way(Around):
    """Agents of a group head for a target, or the nearest of several, around all obstacles.

    Paths follow the negative gradient of their length u, |grad u| = 1 (eikonal equation). Nearest means by path length,
    not by straight distance. The target of a door is the part at least `clearance` from its jambs. Within a target box
    the desired velocity is 0.

    The eikonal equation as a model of pedestrians: Hughes 2002; its solution: Zhao 2005 and Sethian 1999.

    Limits: the paths are found once, for obstacles that stand still, and without other agents: a crowd does not spread
    over two doors of different distance (`routes` does). Gaps narrower than 2 `clearance` are closed, and an agent
    without a path stands still.
    """

    kind: Literal["way"] = "way"
    targets: tuple[Target, ...] = Field(min_length=1, description="points, doors or boxes")
    slow_radius: float = Field(default=0.0, ge=0, description="m before the target, over which it slows down to stop")
    aim_law: ClassVar[Law | None] = path_aim

    @property
    def goals(self) -> tuple[tuple[Target, ...], tuple[str, ...]]:
        """The targets."""
        return self.targets, tuple(f"targets[{k}]" for k in range(len(self.targets)))

    def parameters(self) -> dict[str, float | Vec]:
        """Return the numbers that the law reads besides the table."""
        return {"slow_radius": self.slow_radius, "share": self.share}

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return the numbers of the targets and of the floor field to the nearest."""
        return self.field_block(scene, *self.goals)

    def lengths(self, scene: SceneView, points: ArrayLike) -> NDArray[np.float64]:
        """Return path lengths from points (..., D), (...) m; inf without a path; outside the grid those of its edge.

        scene: whose shapes block the paths.
        """
        return path_lengths(self.grids(scene)[0], points)

    def grids(self, scene: SceneView) -> list[NDArray[np.float64]]:
        """Return the floor field to the nearest target, the only one."""
        return [scene.table_of(self)[2 + len(self.targets) * row_size(scene.dimension) :]]
