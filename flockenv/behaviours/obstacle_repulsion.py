"""Keep off walls: a repulsion that falls exponentially with the distance, summed over all sides around."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.behaviours.repulsion import Push
from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.approximations import exp
from flockenv.maths.vectors import add, scale, select, zero
from flockenv.physics.effects.effect import Me, Obstacle, all_masses

__all__ = ["ObstacleRepulsion"]


@law
def nowhere(p: Any, me: Me) -> Vec:
    """No force yet."""
    return zero(me.pos)


@law
def pushed_off(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """A exp((r_i - d) / B) n, within reach."""
    force = (p.strength + me.mass * p.acceleration) * exp((p.bodies * me.radius - other.gap) / p.decay)
    force = force if force < p.bound else p.bound
    return select(other.gap < p.radius, add(acc, scale(other.normal, force)), acc)


@law
def within(p: Any, me: Me) -> float:
    """The distance up to which it looks."""
    return p.radius  # type: ignore[no-any-return]


@law
def all_sides(p: Any, me: Me, acc: Vec) -> Vec:
    """The sum."""
    return acc


class ObstacleRepulsion(Push):
    """Keep off every wall: F = A exp((r_i - d) / B) n, d from the body's centre; r_i its radius, or 0.

    Helbing and Molnar 1995: -grad U0 exp(-d / R), so A = U0 / R in m/s^2, B = R, `bodies: false`. Helbing, Farkas and
    Vicsek 2000: A in N, with bodies. Summed over sides: of walls, polygons and rooms every straight side acts by the
    foot of the perpendicular on it, and a corner where it is nearest to all sides that meet there, once; so a wall is
    the same however it is cut, and where walls that stand still are joined. If two obstacles lie on each other (a
    wall given twice, rooms with a common side), both act. What is round, thick or a grid acts by its nearest point.
    With `occluded`, nothing acts through a wall. If a body is inside something solid, the force points out through the
    nearest point, and goes on growing.
    """

    kind: Literal["obstacle_repulsion"] = "obstacle_repulsion"
    decay: float = Field(gt=0, description="B, m, over which the force falls to 1/e")
    bodies: bool = Field(default=True, description="is the distance that from the body's surface, not its centre?")
    radius: float = Field(default=3.0, gt=0, description="m from its centre, beyond which walls do nothing")
    occluded: bool = Field(default=False, description="do only sides push that no other obstacle hides?")
    obstacle_pieces: ClassVar[bool] = True
    obstacle_start: ClassVar[Law | None] = nowhere
    obstacle_law: ClassVar[Law | None] = pushed_off
    obstacle_finish: ClassVar[Law | None] = all_sides
    obstacle_reach: ClassVar[Law | None] = within
    demo: ClassVar[str | None] = """
dt: 0.02
groups:
  - {count: 5, mass: 80, radius: 0.25, desired_speed: 1.3, spawn: {low: [0.5, 0.5], high: [3.5, 5.5]}}
obstacles:
  - {kind: wall, vertices: [[6, 2.4], [6, 0], [0, 0], [0, 6], [6, 6], [6, 3.6]]}
effects:
  - {kind: goal, target: [9, 3]}
  - {kind: driving, tau: 0.5}
  - {kind: circular_repulsion, strength: 2000, decay: 0.08, radius: 3}
  - {kind: obstacle_repulsion, strength: 2000, decay: 0.08}
"""

    @property
    def occluded_obstacles(self) -> bool:
        """Whether walls hide walls."""
        return self.occluded

    def parameters(self) -> dict[str, float | Vec]:
        """A, B, whose surface, and how far it looks."""
        about = {"decay": self.decay, "bodies": float(self.bodies), "radius": self.radius}
        return {**super().parameters(), **about}

    def folded(self, dimension: int) -> int:
        """The force so far."""
        return dimension

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """w^2 = A / (m B) where a body touches a wall (of distances alone, its centre does); deeper it is steeper."""
        mass = all_masses(groups, dimension)
        square = (self.strength / mass + np.where(np.isfinite(mass), self.acceleration, 0.0)) / self.decay
        return square, np.zeros(len(mass))
