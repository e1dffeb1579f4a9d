"""Repulsion from walls that falls exponentially with the distance, summed over all sides within range."""

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
def zero_force(p: Any, me: Me) -> Vec:
    """Return the initial force, zero."""
    return zero(me.pos)


@law
def add_repulsion(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Add A exp((r_i - d) / B) n, within range."""
    force = (p.strength + me.mass * p.acceleration) * exp((p.bodies * me.radius - other.gap) / p.decay)
    force = force if force < p.bound else p.bound
    return select(other.gap < p.radius, add(acc, scale(other.normal, force)), acc)


@law
def repulsion_reach(p: Any, me: Me) -> float:
    """Return the range of the force, m."""
    return p.radius  # type: ignore[no-any-return]


@law
def total_repulsion(p: Any, me: Me, acc: Vec) -> Vec:
    """Return the sum."""
    return acc


class ObstacleRepulsion(Push):
    """Keep off every wall: F = A exp((r_i - d) / B) n, d from the body's centre; r_i its radius, or 0.

    Helbing and Molnar 1995: -grad U0 exp(-d / R), so A = U0 / R in m/s^2, B = R, `bodies: false`. Helbing, Farkas and
    Vicsek 2000: A in N, with bodies.

    Summed over sides: every straight side of walls, polygons and rooms acts by the foot of the perpendicular on it; a
    corner acts once, if it is the nearest point of all sides that meet there. So the force does not depend on how a
    wall is divided, also where walls that stand still are joined. If two obstacles coincide (a wall given twice, rooms
    with a common side), both act. Round and thick shapes and grids act by their nearest point. With `occluded`, no side
    acts through another obstacle. If a body is inside a solid obstacle, the force points out through the nearest point,
    and grows with depth.

    Limits: without `most` a thin wall is a hill of height A B exp(r_i / B) (r_i = 0 without `bodies`): an agent that
    comes head-on with more than that as kinetic energy, or is driven by more than A exp(r_i / B), passes through it. It
    has no damping.
    """

    kind: Literal["obstacle_repulsion"] = "obstacle_repulsion"
    decay: float = Field(gt=0, description="B, m, over which the force falls to 1/e")
    bodies: bool = Field(default=True, description="True: distance from the body's surface; False: from its centre")
    radius: float = Field(default=3.0, gt=0, description="m from its centre, range within which walls act")
    occluded: bool = Field(default=False, description="True if obstacles hide the sides of others")
    obstacle_pieces: ClassVar[bool] = True
    obstacle_start: ClassVar[Law | None] = zero_force
    obstacle_law: ClassVar[Law | None] = add_repulsion
    obstacle_finish: ClassVar[Law | None] = total_repulsion
    obstacle_reach: ClassVar[Law | None] = repulsion_reach
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
        """True if walls hide walls."""
        return self.occluded

    def parameters(self) -> dict[str, float | Vec]:
        """Return A, B, `bodies` and the range."""
        about = {"decay": self.decay, "bodies": float(self.bodies), "radius": self.radius}
        return {**super().parameters(), **about}

    def fold_size(self, dimension: int) -> int:
        """Return the size of a force."""
        return dimension

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return w^2 = A / (m B) for a body that touches a wall, no damping; it is steeper for deeper overlap."""
        mass = all_masses(groups, dimension)
        square = (self.strength / mass + np.where(np.isfinite(mass), self.acceleration, 0.0)) / self.decay
        return square, np.zeros(len(mass))
