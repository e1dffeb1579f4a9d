"""Behaviours with a target place, direction or speed: seek, flee, arrive, dock, face, target_speed (Reynolds 1999)."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from flockenv import steering
from flockenv.behaviours.behaviour import Behaviour, Moving, top_speed
from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import dot, scale, select, sub, zero
from flockenv.physics.effects.effect import Me, Vector

__all__ = ["Arrive", "Dock", "Face", "Flee", "Seek", "TargetSpeed"]


@law
def seek_force(p: Any, me: Me) -> Vec:
    """Return F = w (V unit(T - x) - v)."""
    return scale(steering.seek(sub(p.target, me.pos), me.vel, top_speed(p, me)), p.weight)


@law
def flee_force(p: Any, me: Me) -> Vec:
    """Return F = w (V unit(x - T) - v), 0 beyond the radius."""
    offset = sub(p.target, me.pos)
    away = scale(steering.flee(offset, me.vel, top_speed(p, me)), p.weight)
    return select(dot(offset, offset) < p.radius * p.radius, away, zero(offset))


@law
def arrive_force(p: Any, me: Me) -> Vec:
    """Return F = w (V min(1, d / d_slow) unit(T - x) - v)."""
    return scale(steering.arrive(sub(p.target, me.pos), me.vel, top_speed(p, me), p.slow_radius), p.weight)


@law
def dock_force(p: Any, me: Me) -> Vec:
    """Return F = w S: through the gate, then along the axis."""
    offset = sub(p.target, me.pos)
    change = steering.dock(offset, me.vel, p.direction, top_speed(p, me), p.gate, p.width, p.slow_radius)
    return scale(change, p.weight)


@law
def face_force(p: Any, me: Me) -> Vec:
    """Return F = w S, perpendicular to the velocity."""
    return scale(steering.face(me.vel, p.heading), p.weight)


@law
def target_speed_force(p: Any, me: Me) -> Vec:
    """Return F = w S, along the velocity."""
    return scale(steering.target_speed(me.vel, p.speed), p.weight)


def _demand_direction(name: str, value: tuple[float, ...]) -> None:
    """Raise ValueError if a direction is zero, or so long or short that its square is out of range in float32."""
    if not 1e-15 <= math.hypot(*value) <= 1e15:
        raise ValueError(f"{name} = {value}: must be a direction, not all 0, of length 1e-15 to 1e+15")


class _ToTarget(Moving):
    """Base of behaviours with a target place; on a torus its nearest image counts."""

    target: Vector = Field(description="m, the place")
    places: ClassVar[tuple[str, ...]] = ("target",)


class Seek(_ToTarget):
    """Head for a place at full speed: S = V unit(T - x) - v (Reynolds 1999's figure; its pseudo-code flees).

    Limits: it does not brake. The desired velocity keeps the length V up to the target and reverses there, so agents
    swing about it (`arrive` stops). It sees no obstacles and no other agents.
    """

    kind: Literal["seek"] = "seek"
    own_law: ClassVar[Law | None] = seek_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 6, max_speed: 2, max_force: 4, spawn: {low: [-6, -5], high: [-4, 5], speed: [1, 2]}}
effects:
  - {kind: seek, weight: 5, target: [4, 0]}
"""


class Flee(_ToTarget):
    """Head away from a place at full speed, if it is within a panic radius: S = V unit(x - T) - v (Reynolds 1999).

    Limits: without a `radius` it acts at any distance, so agents never come to rest; with one the force ends there, and
    nothing stops them beyond. Exactly at the place an agent keeps its direction, and at rest there it stays.
    """

    kind: Literal["flee"] = "flee"
    radius: float | None = Field(default=None, gt=0, description="m, beyond it the force is 0 (default: unlimited)")
    own_law: ClassVar[Law | None] = flee_force
    unlimited: ClassVar[tuple[str, ...]] = ("speed", "radius")
    demo: ClassVar[str | None] = """
groups:
  - {count: 8, max_speed: 2, max_force: 4, spawn: {low: [-8, -3], high: [-5, 3], speed: [1, 1.5], heading: [1, 0]}}
effects:
  - {kind: flee, weight: 5, target: [0, 0], radius: 4}
"""


class Arrive(_ToTarget):
    """Seek a place and stand still there: S = V min(1, d / d_slow) unit(T - x) - v (Reynolds 1999).

    It does not overshoot if d_slow >= V^2 m / max_force (else a LookaheadWarning) and weight >= 4 m V / d_slow.

    Limits: the speed is a function of the distance alone. A constant force f, such as wind, moves the place of rest by
    f d_slow / (weight V). Agents with one target end in one place, and obstacles are not seen.
    """

    kind: Literal["arrive"] = "arrive"
    slow_radius: float = Field(gt=0, description="d_slow, m, distance within which it slows down")
    own_law: ClassVar[Law | None] = arrive_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 6, max_speed: 2, max_force: 4, spawn: {low: [-6, -5], high: [-4, 5], speed: [1, 2]}}
effects:
  - {kind: arrive, weight: 10, target: [4, 0], slow_radius: 2}
"""
    demo_time: ClassVar[float] = 10.0


class Dock(_ToTarget):
    """Arrive at a place in a given direction, through a gate in front of it (described in Reynolds 1999).

    It stops at the place, its last heading along that direction: the distance from the axis falls as the square of the
    remaining distance.

    Limits: the path is computed without max_force: an agent whose turning radius m V^2 / max_force is larger than the
    gate may miss the axis. One that starts beyond the place flies round it. Obstacles are not seen.
    """

    kind: Literal["dock"] = "dock"
    direction: Vector = Field(description="direction of docking, of any length")
    gate: float = Field(gt=0, description="m, distance of the gate before the place")
    width: float = Field(gt=0, description="m, distance from the axis within which it goes along it")
    slow_radius: float = Field(gt=0, description="m, distance within which it slows down")
    own_law: ClassVar[Law | None] = dock_force
    steepness: ClassVar[float] = 4.0  # it aims at the axis half-way to the place; up to 3.2 was measured
    demo: ClassVar[str | None] = """
groups:
  - {count: 5, max_speed: 2, max_force: 6, spawn: {low: [-6, -5], high: [-2, 5], speed: [0, 1]}}
effects:
  - {kind: dock, weight: 12, target: [4, 0], direction: [1, 0], gate: 4, width: 0.5, slow_radius: 2}
"""
    demo_time: ClassVar[float] = 14.0

    @model_validator(mode="after")
    def _check_direction(self) -> Self:
        """Raise ValueError if the direction has no length."""
        _demand_direction("direction", self.direction)
        return self


class Face(Behaviour):
    """Turn the velocity toward a heading at unchanged speed: S is perpendicular to the velocity.

    tan(a/2) of the angle a between the two falls as exp(-weight t / m). The construction is ours.

    Limits: S is proportional to the speed, so an agent at rest does not turn. If the heading is straight behind, it
    turns right.
    """

    kind: Literal["face"] = "face"
    heading: Vector = Field(description="direction, of any length")
    own_law: ClassVar[Law | None] = face_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 7, max_speed: 2, spawn: {low: [-6, -5], high: [-4, 5], speed: [1, 2]}}
effects:
  - {kind: face, weight: 1, heading: [1, 0]}
"""

    @model_validator(mode="after")
    def _check_direction(self) -> Self:
        """Raise ValueError if the heading has no length."""
        _demand_direction("heading", self.heading)
        return self


class TargetSpeed(Behaviour):
    """Reach a speed in the current direction of motion: S = (v_t - |v|) unit(v); zero at rest.

    The law is ours.

    Limits: an agent at rest stays at rest, and the direction is left to other forces.
    """

    kind: Literal["target_speed"] = "target_speed"
    speed: float = Field(ge=0, description="v_t, m/s, to be reached")
    own_law: ClassVar[Law | None] = target_speed_force
    demo: ClassVar[str | None] = """
groups:
  - {count: 7, spawn: {low: [-6, -5], high: [-4, 5], speed: [0.2, 2], heading: [1, 0]}}
effects:
  - {kind: target_speed, weight: 1, speed: 1}
"""
