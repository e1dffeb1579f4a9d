"""Sinks: conditions under which agents die, applied one after another to the agents that are still alive."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from flockenv.geometry.shapes import AnyShape
from flockenv.geometry.space import Torus
from flockenv.model.scene_view import SceneView
from flockenv.physics.population.members import Member, check_dimensions, demand_group
from flockenv.physics.population.regions import Vector, check_corners, three_numbers

__all__ = ["Ageing", "Crowding", "Decay", "Drain", "Leaving", "Sink", "Threshold"]


class Sink(Member):
    """A condition under which agents of one group, or of all groups, die."""

    code: ClassVar[int]
    """Number of this kind in kernels."""

    group: int | None = Field(default=None, ge=0, description="index of the group whose agents die (default: all)")

    def row(self) -> list[float]:
        """Return the numbers of the sink, in the order in which deaths.py reads them."""
        return []

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the group does not exist, or is a network."""
        demand_group(scene, self.group)
        for k, group in enumerate(scene.groups):
            if self.group in (None, k) and group.network is not None:
                raise ValueError(f"group = {self.group}: groups[{k}] is a network, whose particles do not die")


class Ageing(Sink):
    """Agents older than a lifetime die; an emitter may also give each agent a lifetime of its own."""

    kind: Literal["ageing"] = "ageing"
    code: ClassVar[int] = 0
    lifetime: float = Field(gt=0, description="s")

    def row(self) -> list[float]:
        """Return the lifetime."""
        return [self.lifetime]


class Leaving(Sink):
    """Agents that leave a region die."""

    kind: Literal["leaving"] = "leaving"
    code: ClassVar[int] = 1
    low: Vector = Field(description="m, lower corner of the region")
    high: Vector = Field(description="m, upper corner of the region")

    @model_validator(mode="after")
    def _check_order(self) -> Leaving:
        check_corners(self.low, self.high)
        return self

    def row(self) -> list[float]:
        """Return the corners."""
        return three_numbers(self.low) + three_numbers(self.high)

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the dimension is not the scene's."""
        super().check(scene)
        check_dimensions(scene, low=self.low, high=self.high)


class Decay(Sink):
    """Agents die at random, each with a probability of 1 - exp(-rate t) within any time t, independent of dt.

    Half of them are left after ln 2 / rate. Draws depend on world, step and identity.
    """

    kind: Literal["decay"] = "decay"
    code: ClassVar[int] = 2
    rate: float = Field(gt=0, description="1/s")

    def row(self) -> list[float]:
        """Return the rate."""
        return [self.rate]


class Drain(Sink):
    """Agents die that are inside a shape, or have crossed it during the step.

    An agent counts as inside if its centre is at most `margin` from the shape.
    """

    kind: Literal["drain"] = "drain"
    code: ClassVar[int] = 3
    looks_back: ClassVar[bool] = True
    shape: AnyShape = Field(description="a shape, with the fields of an obstacle")
    margin: float = Field(default=0.0, ge=0, description="m")

    def row(self) -> list[float]:
        """Return the margin."""
        return [self.margin]

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the dimension is not the scene's."""
        super().check(scene)
        if self.shape.dimension != scene.dimension:
            raise ValueError(
                f"shape.kind = {self.shape.kind}: lies in {self.shape.dimension} dimensions, "
                f"but dimension = {scene.dimension}"
            )
        if isinstance(scene.space, Torus) and self.shape.kind == "half_space":
            raise ValueError("shape.kind = half_space: on a torus a half-space has no inside")


class Crowding(Sink):
    """The youngest agents of a dense crowd die: those that have more than `most` elders within a radius.

    Elders are agents of the same group (or of all) that were born earlier. With a rate, such agents die at random;
    without one, at once.
    """

    kind: Literal["crowding"] = "crowding"
    code: ClassVar[int] = 4
    radius: float = Field(gt=0, description="m")
    most: int = Field(ge=0, description="number of elders that are allowed within the radius")
    rate: float | None = Field(default=None, gt=0, description="1/s (default: at once)")

    def row(self) -> list[float]:
        """Return radius, number and rate."""
        return [self.radius, float(self.most), float("inf") if self.rate is None else self.rate]

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the radius wraps around the torus."""
        super().check(scene)
        if isinstance(scene.space, Torus) and self.radius > min(scene.space.size) / 2:
            raise ValueError(
                f"radius = {self.radius:g}: at most half of the torus's shortest edge, "
                f"{min(scene.space.size) / 2:g} m, is allowed"
            )


class Threshold(Sink):
    """Agents die whose inner number is at least a level, for example at a hunger of 1."""

    kind: Literal["threshold"] = "threshold"
    code: ClassVar[int] = 5
    of: str = Field(min_length=1, description="name of the inner number, which an effect keeps")
    level: float = Field(default=1.0, description="value at and above which an agent dies")

    def row(self) -> list[float]:
        """Return the level."""
        return [self.level]

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if no effect keeps the number."""
        super().check(scene)
        if self.of not in scene.parts.inner:
            kept = ", ".join(scene.parts.inner) or "nothing"
            raise ValueError(f"of = {self.of!r}: no effect of this scene keeps such an inner number; they keep {kept}")
