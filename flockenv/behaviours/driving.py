"""The driving force of social-force models: as fast as one would like to, where one wants to go."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.behaviours.base import Behaviour, steered_groups
from flockenv.effects.base import Me, all_masses
from flockenv.kernels import Vec, law
from flockenv.vec import scale, sub

__all__ = ["Driving"]


@law
def driving(p: Any, me: Me) -> Vec:
    """F = m (v0 e - v) / tau, e = me.aim."""
    return scale(sub(scale(me.aim, me.desired_speed), me.vel), me.mass / p.tau)


class Driving(Behaviour):
    """Walk at one's desired speed where one wants to go, F = m (v0 e - v) / tau (Helbing and Molnar 1995, eq. 2).

    v0 is the group's `desired_speed`, e what goals, courses and journeys of the scene say: who has no aim stops.
    """

    kind: Literal["driving"] = "driving"
    weight: float = Field(default=1.0, ge=0, description="a factor, 1 as published")
    tau: float = Field(default=0.5, gt=0, description="s, relaxation time")
    own_law: ClassVar[str | None] = "driving"
    demo: ClassVar[str | None] = """
dt: 0.05
groups:
  - count: 10
    radius: 0.25
    mass: 75
    desired_speed: {mean: 1.34, sd: 0.26}
    spawn: {low: [0, 0], high: [2, 4]}
effects:
  - {kind: goal, target: [9, 2]}
  - kind: steer
    arbitration: {kind: blend}
    behaviours: [{kind: driving}, {kind: separation, weight: 60, radius: 0.8}]
"""

    def parameters(self) -> dict[str, float | Vec]:
        """The time it takes."""
        return {"tau": self.tau / self.weight if self.weight else np.inf}

    def check(self, scene: Any) -> None:
        """Refuse those who do not say how fast they would like to go."""
        super().check(scene)
        for k in steered_groups(self, scene):
            if scene.groups[k].desired_speed is None and scene.groups[k].max_force != 0:
                raise ValueError(f"kind = driving: groups[{k}].desired_speed = None: give m/s")

    def rates(self, groups: Any, dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """No oscillation, and damping of 1 / tau."""
        n = len(all_masses(groups, dimension))
        return np.zeros(n), np.full(n, self.weight / self.tau)
