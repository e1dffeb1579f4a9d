"""Group: some agents of a kind, how heavy, wide and fast they are, and where they begin."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from flockenv.core.record import Record
from flockenv.model.appearance import Appearance
from flockenv.model.distribution import Spread, drawn, largest
from flockenv.model.networks import AnyNetwork
from flockenv.model.spawn import Spawn

__all__ = ["Group"]

SIZE, PACE = 0, 1
"""Channels of what differs within a group: whoever is heavy is wide, but not faster."""


def _above_0(spread: Spread) -> Spread:
    """Refuse numbers that are all 0."""
    if spread.most <= 0 or (spread.mean == 0 and spread.sd == 0):
        raise ValueError("all of them would be 0; must be above 0")
    return spread


PositiveSpread = Annotated[float, Field(gt=0)] | Annotated[Spread, AfterValidator(_above_0)]


class Group(Record):
    """Some agents of a kind: so many that are on their own, or a network of them; there `mass` is the mean.

    Mass, radius and desired_speed are a number, or a `Spread` of numbers that differ from one to the next.
    """

    count: int | None = Field(default=None, ge=1, description="how many")
    network: AnyNetwork | None = Field(default=None, description="particles that are tied to each other, and where")
    mass: PositiveSpread = Field(default=1.0, description="kg")
    radius: Annotated[float, Field(ge=0)] | Spread = Field(default=0.1, description="m")
    desired_speed: PositiveSpread | None = Field(
        default=None, description="m/s, how fast it would like to go; see driving"
    )
    max_speed: float | None = Field(default=None, gt=0, description="m/s; none = no limit")
    haste: float | None = Field(
        default=None, ge=1, description="max_speed of each as a multiple of its desired_speed, instead of one for all"
    )
    max_force: float | None = Field(default=None, ge=0, description="N, what it may ask for; none = no limit")
    oriented: bool = Field(
        default=False, description="does it keep its heading (in 3-D an up vector too) while it stands still?"
    )
    max_turn_rate: float | None = Field(
        default=None, gt=0, description="rad/s, how fast its heading turns; none = no limit; oriented if given"
    )
    banking: float | None = Field(
        default=None, gt=0,
        description="s, in which it leans into its turns (3-D), as far as lateral acceleration against 9.81 m/s^2 "
        "says; none = it does not; oriented if given",
    )  # fmt: skip
    spawn: Spawn = Field(default_factory=Spawn)
    alive: int | None = Field(
        default=None, ge=0, description="how many live at the start; none = all, or nobody where an emitter feeds them"
    )
    role: Literal["agent", "learner", "pursuer", "evader", "flockmate"] = Field(
        default="agent", description="what it is in pictures"
    )
    appearance: Appearance | None = Field(default=None, description="how it is drawn; none = as its role is")

    @model_validator(mode="after")
    def _one_or_the_other(self) -> Group:
        """Refuse a count beside a network, and neither; and a network that nobody knows how to place."""
        if (self.count is None) == (self.network is None):
            raise ValueError("count: give either a count or a network")
        if self.network is not None and (
            self.spawn.low is not None
            or self.spawn.spacing is not None
            or (any(self.spawn.speed) and not self.spawn.heading)
        ):
            raise ValueError("spawn: a network is where it says; all it may be given is a speed, with a heading")
        if self.network is not None and (isinstance(self.mass, Spread) or isinstance(self.radius, Spread)):
            raise ValueError("mass: of a network it is the mean, and its radius is a number")
        if self.haste is not None and (self.max_speed is not None or self.desired_speed is None):
            raise ValueError(f"haste = {self.haste:g}: goes with a desired_speed, and instead of a max_speed")
        if self.alive is not None and self.network is not None:
            raise ValueError(f"alive = {self.alive}: all particles of a network live")
        if self.alive is not None and self.alive > self.size:
            raise ValueError(f"alive = {self.alive}: at most its count, {self.size}, is allowed")
        return self

    @property
    def keeps_heading(self) -> bool:
        """Has each of them a frame of its own?"""
        return self.oriented or self.max_turn_rate is not None or self.banking is not None

    @property
    def size(self) -> int:
        """How many agents it has."""
        return self.network.size if self.network is not None else int(self.count or 0)

    @property
    def radii(self) -> NDArray[np.float64]:
        """The radius of each agent, (size,) m."""
        return drawn(self.radius, self.size, SIZE)

    @property
    def desired_speeds(self) -> NDArray[np.float64]:
        """How fast each agent would like to go, (size,) m/s; 0 if nobody says."""
        return drawn(self.desired_speed or 0.0, self.size, PACE)

    @property
    def max_speeds(self) -> NDArray[np.float64]:
        """How fast each agent goes at most, (size,) m/s; may be infinite."""
        if self.haste is not None:
            return self.haste * self.desired_speeds
        return np.full(self.size, math.inf if self.max_speed is None else self.max_speed)

    @property
    def widest(self) -> float:
        """The largest radius, m."""
        return largest(self.radius, self.size, SIZE)

    @property
    def heaviest(self) -> float:
        """The largest mass, kg; of a network the mean."""
        return largest(self.mass, self.size, SIZE)

    @property
    def fastest(self) -> float | None:
        """The largest max_speed, m/s; none without a limit."""
        return self.max_speed if self.haste is None else float(self.max_speeds.max())

    def masses(self, dimension: int) -> NDArray[np.float64]:
        """Return the mass of each agent, (size,) kg; infinite where a network pins one."""
        if self.network is None:
            return drawn(self.mass, self.size, SIZE)
        assert not isinstance(self.mass, Spread)
        out = self.network.masses(self.mass * self.size, dimension)
        out[self.network.pins()] = np.inf
        return out
