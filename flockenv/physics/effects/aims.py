"""Aims: the desired direction e, which other laws (driving, social forces) read as `me.aim`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import norm, scale, select, sub, unit, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Effect, Me, Vector, demand_group

__all__ = ["Aim", "Antipode", "Course", "Goal", "applies_to", "direction_with_ramp"]


@law
def applies_to(p: Any, me: Me) -> bool:
    """Return True if the effect applies to this agent, one of [p.first, p.end)."""
    inside: bool = (me.who >= p.first) & (me.who < p.end)
    return inside


@law
def direction_with_ramp(offset: Vec, slow_radius: float) -> Vec:
    """Return the unit vector of an offset, shortened within slow_radius, m, to 0 at the target."""
    length, one = norm(offset), like(slow_radius, 1.0)
    share = length / slow_radius
    return scale(unit(offset), share if share < one else one)


class Aim(Effect):
    """Base class of effects that set the desired direction of a group."""

    group: int | None = Field(default=None, ge=0, description="index of the group that it applies to (default: all)")
    share: float = Field(default=1.0, ge=0, le=1, description="fraction of the desired speed")
    strengths: ClassVar[tuple[str, ...]] = ("share",)

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """Return the agents it applies to: [first, end)."""
        first, end = (0, starts[-1]) if self.group is None else starts[self.group : self.group + 2]
        return {"first": float(first), "end": float(end)}

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the group does not exist."""
        demand_group("group", self.group, scene.groups)
        super().check(scene)


@law
def goal_aim(p: Any, me: Me) -> Vec:
    """Return the direction to the target."""
    return select(
        applies_to(p, me), scale(direction_with_ramp(sub(p.target, me.pos), p.slow_radius), p.share), zero(me.pos)
    )


class Goal(Aim):
    """Agents of a group head for a point, and slow down within `slow_radius` of it.

    The direction is e = d / max(|d|, `slow_radius`), with d from the agent to the point: the desired direction of
    Helbing and Molnar 1995, which here falls to 0 at the point (arrival, Reynolds 1999).

    Limits: the aim is a straight line, through obstacles. All agents of the group head for the same point, and
    crowd around it if their bodies do not overlap.
    """

    kind: Literal["goal"] = "goal"
    target: Vector = Field(description="m, the point")
    slow_radius: float = Field(default=0.5, gt=0, description="m before the target, over which it slows down to stop")
    aim_law: ClassVar[Law | None] = goal_aim
    places: ClassVar[tuple[str, ...]] = ("target",)

    def parameters(self) -> dict[str, float | Vec]:
        """Return target, slow_radius and share."""
        return {"target": self.target, "slow_radius": self.slow_radius, "share": self.share}


@law
def course_aim(p: Any, me: Me) -> Vec:
    """Return the given direction."""
    return select(applies_to(p, me), scale(unit(p.direction), p.share), zero(me.pos))


class Course(Aim):
    """Agents of a group always head in one direction: along a corridor, around a torus.

    The direction is e = unit(`direction`), times `share`: the desired direction of Helbing and Molnar 1995 for a target
    far away.

    Limits: it never ends, and knows no obstacles.
    """

    kind: Literal["course"] = "course"
    direction: Vector = Field(description="direction of travel; its length does not matter")
    aim_law: ClassVar[Law | None] = course_aim

    def parameters(self) -> dict[str, float | Vec]:
        """Return direction and share."""
        return {"direction": self.direction, "share": self.share}

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the direction has length 0."""
        if not any(self.direction):
            raise ValueError(f"direction = {self.direction}: leads nowhere; give a vector that is not 0")
        super().check(scene)


@law
def stored_target(p: Any, me: Me) -> Vec:
    """Return the agent's stored target."""
    return me.inner.goal_x, me.inner.goal_y


@law
def antipode(p: Any, me: Me) -> Vec:
    """Return the point opposite to the initial position, across the centre."""
    across = sub(scale(p.centre, like(me.mass, 2.0)), me.pos)
    return select(applies_to(p, me), across, zero(me.pos))


@law
def keep_target(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return the stored target, unchanged."""
    return stored_target(p, me)


@law
def antipode_aim(p: Any, me: Me) -> Vec:
    """Return the direction to the stored target."""
    return select(
        applies_to(p, me),
        scale(direction_with_ramp(sub(stored_target(p, me), me.pos), p.slow_radius), p.share),
        zero(me.pos),
    )


class Antipode(Aim):
    """Agents of a group head across a centre to the point opposite to their initial position: a circle swap.

    The target is g = 2 c - x0, with the centre c and the initial position x0, and e = d / max(|d|, `slow_radius`) with
    d = g - x. A circle swap is the usual test of collision avoidance (van den Berg, Guy, Lin and Manocha 2011).

    Limits: the target is fixed at the start, or at the birth of an agent, and the aim is a straight line through
    obstacles.
    """

    kind: Literal["antipode"] = "antipode"
    centre: Vector = Field(description="m, the point that all cross")
    slow_radius: float = Field(default=0.5, gt=0, description="m before the target, over which it slows down to stop")
    aim_law: ClassVar[Law | None] = antipode_aim
    begin_law: ClassVar[Law | None] = antipode
    keep_law: ClassVar[Law | None] = keep_target
    keeps: ClassVar[tuple[str, ...]] = ("goal_x", "goal_y")
    heads_for: ClassVar[bool] = False

    def parameters(self) -> dict[str, float | Vec]:
        """Return centre, slow_radius and share."""
        return {"centre": self.centre, "slow_radius": self.slow_radius, "share": self.share}

    def check(self, scene: SceneView) -> None:
        """Raise ValueError in 3-D, and on a torus, where the path across is not unique."""
        super().check(scene)
        if scene.space.periodic or scene.dimension != 2:
            raise ValueError(
                f"kind = antipode: only a plane or a box of dimension 2 is allowed, not a {scene.space.kind} of "
                f"dimension {scene.dimension}"
            )
