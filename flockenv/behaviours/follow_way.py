"""The shortest path to a goal around all obstacles: global navigation, to be combined with local steering."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.behaviours.behaviour import Moving, steered_groups, top_speed
from flockenv.geometry.targets import Target
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import norm, scale, sub
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Me, Vector
from flockenv.physics.floor_fields import (
    check_floor_field,
    floor_field_to,
    grid_corners,
    path_ahead,
    path_lengths,
    start_boxes,
    warn_cut_off,
)

__all__ = ["FollowWay"]


@law
def follow_way_force(p: Any, me: Me) -> Vec:
    """Return F = w (V e - v), e the descent direction of the path length; slower over the last `slow_radius`."""
    straight = sub(p.target, me.pos)
    length, direction = path_ahead(p.table, me.pos, straight)
    near = norm(straight)
    length = near if near < length else length
    ramp = length / p.slow_radius
    speed = top_speed(p, me) * (ramp if ramp < like(ramp, 1.0) else like(ramp, 1.0))
    return scale(sub(scale(direction, speed), me.vel), p.weight)


class FollowWay(Moving):
    """Go to a point by the shortest path around all obstacles: S = V e - v, e = -grad u, |grad u| = 1 (eikonal).

    The floor field u is computed once on a grid, when the scene is built, and interpolated between grid points. Paths
    keep `clearance` from every obstacle. Outside the grid the direction is straight to the point.

    The eikonal equation as a model of pedestrians: Hughes 2002.

    Limits: the paths are found once, for obstacles that stand still, and without other agents: a crowd does not spread
    over two doors. Gaps narrower than 2 `clearance` are closed, and wider ones also if no point of the grid lies in
    them.
    """

    kind: Literal["follow_way"] = "follow_way"
    target: Vector = Field(description="m, the goal")
    clearance: float = Field(default=0.3, ge=0, description="m, from its path to every obstacle: at least its radius")
    spacing: float = Field(default=0.2, gt=0, description="m, between points of the grid")
    slow_radius: float = Field(default=1.0, gt=0, description="m before the target, over which it slows down to stop")
    margin: float = Field(default=3.0, gt=0, description="m of grid around obstacles, target and initial positions")
    tabled: ClassVar[bool] = True
    own_law: ClassVar[Law | None] = follow_way_force
    places: ClassVar[tuple[str, ...]] = ("target",)
    demo: ClassVar[str | None] = """
groups:
- {count: 3, radius: 0.15, max_speed: 2, max_force: 12, spawn: {low: [3, 3], high: [4, 5]}}
obstacles:
- {kind: wall, vertices: [[1, 1], [6, 1], [6, 7], [1, 7]], radius: 0.2}
effects:
- kind: steer
  behaviours:
  - {kind: avoid_obstacles, weight: 8, horizon: 0.5}
  - {kind: follow_way, weight: 5, target: [9, 4], clearance: 0.4}
"""

    def parameters(self) -> dict[str, float | Vec]:
        """Return all parameters but the grid, which is in the table."""
        return {
            "speed": self.limit, "weight": self.weight, "target": self.target, "slow_radius": self.slow_radius,
        }  # fmt: skip

    @property
    def _target_and_name(self) -> tuple[tuple[Target], tuple[str]]:
        """The target, and the name of its field."""
        return (Target(at=self.target),), ("target",)

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return the floor field."""
        corners = grid_corners(scene, self._target_and_name[0], self.margin)
        starts = [start for k in steered_groups(self, scene) for start in start_boxes(scene, k)]
        return floor_field_to(scene, *self._target_and_name, corners, self.spacing, self.clearance, starts)

    def check_start(self, scene: SceneView, state: Any) -> None:
        """Warn of agents whose initial position has no path to the target."""
        lost = np.isinf(path_lengths(scene.table_of(self), state.pos))
        for k in set(range(len(scene.groups))) - set(steered_groups(self, scene)):
            lost[:, scene.starts[k] : scene.starts[k + 1]] = False
        warn_cut_off(self._target_and_name[1][0], lost, state)

    def check(self, scene: SceneView) -> None:
        """Raise ValueError for a torus, moving obstacles, too large a grid, or a target in an obstacle."""
        super().check(scene)
        check_floor_field(scene, self.kind, *self._target_and_name, self.margin, self.spacing, self.clearance)
        scene.table_of(self)
