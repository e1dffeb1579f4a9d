"""The driving force of social-force models, towards the aim at desired speed; and lining up behind others."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv import steering
from flockenv.behaviours.behaviour import Behaviour, steered_groups
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import dot, norm, scale, sub, unit
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Me, Other, Sight, all_masses

__all__ = ["Driving", "LineUp"]


@law
def driving_force(p: Any, me: Me) -> Vec:
    """Return F = m (v0 e - v) / tau, e = me.aim."""
    return scale(sub(scale(me.aim, me.desired_speed), me.vel), me.mass / p.tau)


class Driving(Behaviour):
    """Walk at the desired speed towards the aim, F = m (v0 e - v) / tau (Helbing and Molnar 1995, eq. 2).

    v0 is the group's `desired_speed`, e the direction from goals, courses and journeys of the scene; an agent without
    an aim stops.

    Limits: it knows neither walls nor other agents: an agent that cannot go on pushes with m v0 / tau for as long as it
    is held up.
    """

    kind: Literal["driving"] = "driving"
    weight: float = Field(default=1.0, ge=0, description="a factor, 1 as published")
    tau: float = Field(default=0.5, gt=0, description="s, relaxation time")
    always: ClassVar[bool] = True
    own_law: ClassVar[Law | None] = driving_force
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
        """Return the relaxation time, divided by the weight."""
        return {"tau": self.tau / self.weight if self.weight else np.inf}

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if a steered group has no desired speed."""
        super().check(scene)
        _demand_speeds(self, scene)

    def rates(self, groups: Any, dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return no oscillation, and a damping of weight / tau."""
        n = len(all_masses(groups, dimension))
        return np.zeros(n), np.full(n, self.weight / self.tau)


def _demand_speeds(effect: Behaviour, scene: SceneView) -> None:
    """Raise ValueError if a group that an effect steers has no desired speed."""
    for k in steered_groups(effect, scene):
        if scene.groups[k].desired_speed is None and scene.groups[k].max_force != 0:
            raise ValueError(f"kind = {effect.kind}: groups[{k}].desired_speed = None: must be given, in m/s")


@law
def no_agent_ahead(p: Any, me: Me) -> Vec:
    """Return the initial gap, inf: no agent ahead."""
    return (like(me.radius, np.inf),)


@law
def gap_ahead(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Keep the shortest gap to a slower agent ahead in the direction of the aim.

    Ahead is within 45 degrees: two agents whose directions differ by less than 90 degrees never wait for each other.
    """
    direction, o = unit(me.aim), like(me.radius, 0.0)
    along = dot(other.offset, direction)
    ahead = (along > o) & (like(o, 2.0) * along * along > other.square)
    clearance = me.radius + other.radius + p.margin
    top = me.desired_speed * norm(me.aim)
    gap = steering.queue_gap(direction, other.offset, other.vel, clearance, top)
    return (gap if ahead & (gap < acc[0]) else acc[0],)


@law
def line_up_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = m (e min(v0, gap / T) - v) / tau."""
    top = me.desired_speed * norm(me.aim)
    return scale(steering.queue(unit(me.aim), me.vel, acc[0], top, p.headway), me.mass / p.tau)


class LineUp(Behaviour):
    """Driving without pushing: walk towards the aim, no faster than the gap to the agent ahead allows.

    F = m (e min(v0, gap / T) - v) / tau, instead of `driving`, with the same aims. If T >= 4 tau a gap closes as
    exp(-t / T) without overshoot (see `queue`). Ahead is within 45 degrees of the aim.

    The speed gap / T is that of Tordeux, Chraibi and Seyfried 2016.

    Limits: oncoming agents also block, so two streams that meet stop; such scenes need a behaviour that avoids them.
    Agents beside each other are kept apart by separation or contact only.
    """

    kind: Literal["line_up"] = "line_up"
    weight: float = Field(default=1.0, ge=0, description="a factor")
    tau: float = Field(default=0.2, gt=0, description="s, relaxation time")
    headway: float = Field(default=0.8, gt=0, description="s, T")
    margin: float = Field(default=0.0, ge=0, description="m, gap between bodies that stand in line")
    radius: float = Field(default=3.0, gt=0, description="m, range within which agents ahead block")
    group: int | None = Field(default=None, ge=0, description="group that it waits behind (default: all)")
    pair_start: ClassVar[Law | None] = no_agent_ahead
    pair_law: ClassVar[Law | None] = gap_ahead
    finish_law: ClassVar[Law | None] = line_up_force
    demo_time: ClassVar[float] = 14.0
    demo: ClassVar[str | None] = """
dt: 0.05
groups: [{count: 12, radius: 0.25, mass: 75, desired_speed: 1.2, max_force: 900, spawn: {low: [-8, -3], high: [-3, 3]}}]
obstacles: [{centre: [0, 2.7], radius: 2}, {centre: [0, -2.7], radius: 2}]
effects:
  - {kind: way, targets: [{at: [6, 0]}], clearance: 0.35}
  - kind: steer
    arbitration: {kind: blend}
    behaviours: [{kind: line_up, margin: 0.1}, {kind: separation, weight: 60, radius: 0.8}]
"""

    @property
    def sight(self) -> Sight:
        """Radius and group, in all directions: ahead is relative to the aim."""
        return Sight(self.radius, group=self.group)

    def parameters(self) -> dict[str, float | Vec]:
        """Return the relaxation time, the headway and the margin."""
        tau = self.tau / self.weight if self.weight else np.inf
        return {"tau": tau, "headway": self.headway, "margin": self.margin}

    def rates(self, groups: Any, dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return w^2 = weight / (tau headway), while a gap closes, and a damping of weight / tau."""
        damping = np.full(len(all_masses(groups, dimension)), self.weight / self.tau)
        return damping / self.headway, damping

    def sums(self, dimension: int) -> int:
        """Return 1: the law keeps one number, the gap."""
        return 1

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if a steered group has no desired speed."""
        super().check(scene)
        _demand_speeds(self, scene)
