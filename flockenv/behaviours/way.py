"""The way to a goal around all obstacles: a global controller that agents follow while local steering does the rest."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.behaviours.base import Moving, top_speed
from flockenv.effects.base import Me, Vector
from flockenv.eikonal import way_table
from flockenv.grid import MOST_POINTS, covers, sample, sample_vector
from flockenv.kernels import Vec, law, like
from flockenv.shapes import Shape
from flockenv.space import Torus
from flockenv.vec import norm, scale, select, sub, unit

__all__ = ["FollowWay"]


@law
def follow_way(p: Any, me: Me) -> Vec:
    """F = w (V e - v), e downhill the length of the way; slower over the last `slow_radius`."""
    straight = sub(p.target, me.pos)
    here = covers(p.table, me.pos)
    length = sample(p.table, me.pos, 0) if here else norm(straight)
    direction = unit(select(here, sample_vector(p.table, me.pos, 1), straight))
    near = norm(straight)
    length = near if near < length else length
    ramp = length / p.slow_radius
    speed = top_speed(p, me) * (ramp if ramp < like(ramp, 1.0) else like(ramp, 1.0))
    return scale(sub(scale(direction, speed), me.vel), p.weight)


class FollowWay(Moving):
    """Go to a point by the shortest way around all obstacles: S = V e - v, e = -grad u, |grad u| = 1 (eikonal).

    The way is found once, on a grid, when the scene is built; between its points it is interpolated. It keeps
    `clearance` from every obstacle. Outside the grid it leads straight to the point.
    """

    kind: Literal["follow_way"] = "follow_way"
    target: Vector = Field(description="m, where to")
    clearance: float = Field(default=0.3, ge=0, description="m, from its way to every obstacle: its radius and more")
    spacing: float = Field(default=0.2, gt=0, description="m, between points of the grid")
    slow_radius: float = Field(default=1.0, gt=0, description="m before the target, over which it slows down to stop")
    margin: float = Field(default=3.0, gt=0, description="m of grid around obstacles, target and where agents begin")
    tabled: ClassVar[bool] = True
    own_law: ClassVar[str | None] = "follow_way"
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
        """What the law reads beside the grid."""
        return {
            "speed": self.limit, "weight": self.weight, "target": self.target, "slow_radius": self.slow_radius,
        }  # fmt: skip

    def region(self, scene: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the corners of the grid: a box's own, or all that there is and a margin around it."""
        size = getattr(scene.space, "size", None)
        if size is not None:
            return np.zeros(scene.dimension), np.array(size, float)
        places = [np.array([self.target])]
        places += [np.asarray(shape.extremes) for shape in scene.obstacles]
        for group in scene.groups:
            corners = (group.spawn.low, group.spawn.high)
            places.append(np.array(corners) if group.network is None else group.network.points(scene.dimension))
        every = np.concatenate(places)
        return every.min(axis=0) - self.margin, every.max(axis=0) + self.margin

    def table(self, scene: Any) -> NDArray[np.float64]:
        """The grid of ways."""
        low, high = self.region(scene)
        shapes: list[Shape] = list(scene.obstacles)
        return way_table(shapes, self.target, low.tolist(), high.tolist(), self.spacing, self.clearance)

    def check(self, scene: Any) -> None:
        """Refuse a torus, obstacles that move, a grid too large, and a target that is in an obstacle."""
        super().check(scene)
        for k, shape in enumerate(scene.obstacles):
            if shape.moves:
                raise ValueError(f"kind = follow_way: its way is found once, and obstacles[{k}] moves")
        if isinstance(scene.space, Torus):
            raise ValueError("kind = follow_way: on a torus ways lead around; only a plane or a box is allowed")
        low, high = self.region(scene)
        points = float(np.prod((high - low) / self.spacing + 1))
        if points > MOST_POINTS:
            raise ValueError(f"spacing = {self.spacing:g}: {points:,.0f} points, at most {MOST_POINTS:,} are allowed")
        scene.table_of(self)
