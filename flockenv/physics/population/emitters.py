"""Emitters: the places, times and velocities at which agents are created.

The time of a birth is independent of dt: agent k of an emitter with a rate is born at start + (k + 1) / rate. Its
position, velocity and lifetime are functions of the world's key and its identity. So births are the same for any dt,
order of agents and number of threads.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from flockenv.core.record import Record
from flockenv.geometry.space import Box, Torus
from flockenv.model.scene_view import SceneView
from flockenv.physics.population.members import Member, check_dimensions, demand_group
from flockenv.physics.population.regions import AnyPlace, Clearing, Surface, Vector, three_numbers

__all__ = ["MOST_RATE", "Burst", "Emitter"]

MOST_RATE = 1e9
"""1/s, largest rate of one emitter: the number of births stays exact for weeks."""

Range = tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]]


class Burst(Record):
    """A number of births at one time."""

    sentence: ClassVar[str] = "{count} births at {time}"

    time: float = Field(ge=0, description="s, time since the start")
    count: int = Field(ge=1, le=2**24, description="number of births")


class Emitter(Member):
    """Agents are created in free slots of a group, at a rate (floor(rate T) in T seconds), in bursts, or both.

    An agent born within a step moves with its velocity for the rest of it; forces act from the next step on. If no
    slot is free, a birth is skipped and counted as refused. All slots but the first `alive` of the group start free.
    """

    kind: Literal["emitter"] = "emitter"
    group: int = Field(default=0, ge=0, description="index of the group whose slots it fills")
    place: AnyPlace = Field(description="place of births")
    rate: float = Field(default=0.0, ge=0, le=MOST_RATE, description="1/s")
    start: float = Field(default=0.0, ge=0, description="s, time at which the rate begins")
    end: float | None = Field(default=None, gt=0, description="s, time at which the rate ends (default: never)")
    bursts: tuple[Burst, ...] = Field(default=(), description="several births at given times")
    together: bool = Field(default=False, description="True if all agents of a burst are born at one point")
    speed: Range = Field(default=(0.0, 0.0), description="m/s, least and greatest")
    direction: Vector | None = Field(
        default=None, description="direction of the velocity (default: any, or the outward normal of a surface)"
    )
    spread: float | None = Field(
        default=None, ge=0, le=180, description="degrees, largest angle with the direction (default: 0 if there is one)"
    )
    lifetime: Range | None = Field(default=None, description="s, least and greatest lifetime (default: no limit)")

    @model_validator(mode="after")
    def _check_ranges(self) -> Emitter:
        """Raise ValueError if a range is reversed, or the emitter has no births."""
        for name in ("speed", "lifetime"):
            value = getattr(self, name)
            if value is not None and value[0] > value[1]:
                raise ValueError(f"{name} = {value}: the lower number must come first")
        if self.lifetime is not None and not self.lifetime[0] > 0:
            raise ValueError(f"lifetime = {self.lifetime}: must be more than 0 s")
        if self.rate == 0 and not self.bursts:
            raise ValueError("rate = 0: give a rate or bursts, or no agent is ever born")
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end = {self.end:g}: must be after start = {self.start:g} s")
        if self.direction is not None and not math.hypot(*self.direction) > 0:
            raise ValueError(f"direction = {self.direction}: must be a direction, not all 0")
        if self.spread is not None and self.direction is None and not isinstance(self.place, Surface):
            raise ValueError(f"spread = {self.spread:g}: needs a direction, or a place on a surface")
        return self

    def feeds(self, group: int) -> bool:
        """Return True if the member creates agents of this group."""
        return group == self.group

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if group or place are invalid in the scene, or a speed exceeds the group's limit."""
        demand_group(scene, self.group)
        group = scene.groups[self.group]
        if group.network is not None:
            raise ValueError(f"group = {self.group}: is a network, whose particles are not born one by one")
        check_dimensions(scene, direction=self.direction)
        try:
            self.place.check(scene)
        except ValueError as error:
            raise ValueError(f"place.{error}") from None
        limit = group.fastest
        if limit is not None and self.speed[1] > limit:
            raise ValueError(f"speed = {self.speed}: must not exceed groups[{self.group}].max_speed = {limit:g} m/s")
        self._check_space(scene, group)

    def _check_space(self, scene: SceneView, group: Any) -> None:
        """Raise ValueError if births lie beyond the walls of a box, or a radius wraps around a torus."""
        if isinstance(scene.space, Box):
            ends = self.place.extremes
            if len(ends) and ((ends < 0).any() or (ends > scene.space.size).any()):
                raise ValueError(
                    f"place: reaches from {ends.min(axis=0).tolist()} to {ends.max(axis=0).tolist()} m, beyond the "
                    f"walls of a box of {list(scene.space.size)} m"
                )
        if isinstance(scene.space, Torus) and isinstance(self.place, Clearing):
            most = min(scene.space.size) / 2
            if self.place.radius > most:
                raise ValueError(f"place.radius = {self.place.radius:g}: at most {most:g} m is allowed on this torus")

    def rows(self, first: int, end: int, dimension: int) -> list[list[float]]:
        """Return a row of numbers for the rate and for each burst, as births.py reads them; slots are [first, end).

        dimension: 2 or 3.
        """
        spread = 0.0 if self.direction is not None or isinstance(self.place, Surface) else 180.0
        spread = math.radians(spread if self.spread is None else self.spread)
        aim = three_numbers(self.direction or (1.0,) + (0.0,) * (dimension - 1))
        length = math.hypot(*aim)
        lifetime = (math.inf, math.inf) if self.lifetime is None else self.lifetime
        along_normal = float(self.direction is None and isinstance(self.place, Surface))
        shared = [*self.speed, spread, along_normal, *(x / length for x in aim), *lifetime]
        until = math.inf if self.end is None else self.end
        found = []
        if self.rate > 0:
            found.append([first, end, self.start, until, self.rate, 0.0, *shared, 0.0, self.place.code])
        for burst in self.bursts:
            together = float(self.together)
            found.append([first, end, burst.time, burst.time, 0.0, burst.count, *shared, together, self.place.code])
        return [[float(x) for x in row] + self.place.row() for row in found]
