"""Group: agents of one kind, with their masses, radii, speeds and initial positions."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from flockenv.core.record import Record
from flockenv.model.appearance import Appearance
from flockenv.model.distribution import Spread, draw, largest, smallest
from flockenv.model.networks import AnyNetwork
from flockenv.model.spawn import Spawn

__all__ = ["Group"]

SIZE, PACE = 0, 1
"""RNG channels of spreads: masses and radii share ranks (a heavy agent is wide); desired speeds are independent."""


def _above_0(spread: Spread) -> Spread:
    """Return the spread; raise ValueError if all of its numbers are 0."""
    if spread.most <= 0 or (spread.mean == 0 and spread.sd == 0):
        raise ValueError("all of them would be 0; must be above 0")
    return spread


PositiveSpread = Annotated[float, Field(gt=0)] | Annotated[Spread, AfterValidator(_above_0)]


class Group(Record):
    """Agents of one kind: `count` separate agents, or the particles of a network, of which `mass` is the mean.

    Mass, radius and desired_speed are a number, or a `Spread` of numbers that vary within the group.
    """

    sentence: ClassVar[str] = "[{count} agents][{network}]"

    count: int | None = Field(default=None, ge=1, description="number of agents")
    network: AnyNetwork | None = Field(
        default=None, description="particles joined by springs or elements, and their positions"
    )
    mass: PositiveSpread = Field(default=1.0, description="kg")
    radius: Annotated[float, Field(ge=0)] | Spread = Field(default=0.1, description="m")
    desired_speed: PositiveSpread | None = Field(default=None, description="m/s, target speed of the driving force")
    max_speed: float | None = Field(default=None, gt=0, description="m/s (default: no limit)")
    haste: float | None = Field(
        default=None, ge=1, description="max_speed of each agent as a multiple of its desired_speed; replaces max_speed"
    )
    max_force: float | None = Field(
        default=None, ge=0, description="N, limit of driving and steering forces (default: none)"
    )
    oriented: bool = Field(default=False, description="keep a heading (in 3-D also an up vector) at standstill")
    max_turn_rate: float | None = Field(
        default=None, gt=0, description="rad/s, limit of the turn rate of its heading (default: none); implies oriented"
    )
    banking: float | None = Field(
        default=None, gt=0,
        description="s, time constant of banking in 3-D, towards the angle given by lateral acceleration and "
        "9.81 m/s^2 (default: no banking); implies oriented",
    )  # fmt: skip
    spawn: Spawn = Field(default_factory=Spawn)
    alive: int | None = Field(
        default=None, ge=0, description="number alive at the start (default: all, or 0 if an emitter feeds the group)"
    )
    role: Literal["agent", "learner", "pursuer", "evader", "flockmate"] = Field(
        default="agent", description="role in pictures"
    )
    appearance: Appearance | None = Field(default=None, description="appearance in pictures (default: as its role)")

    @model_validator(mode="after")
    def _check_source(self) -> Group:
        """Raise ValueError unless either a count or a network is given, with fields that it allows."""
        if (self.count is None) == (self.network is None):
            raise ValueError("count: give either a count or a network")
        if self.network is not None and (
            self.spawn.low is not None
            or self.spawn.spacing is not None
            or (any(self.spawn.speed) and not self.spawn.heading)
        ):
            raise ValueError("spawn: a network defines its own positions; only speed, with a heading, may be given")
        if self.network is not None and (isinstance(self.mass, Spread) or isinstance(self.radius, Spread)):
            raise ValueError("mass: a network has one mass (the mean of its particles) and one radius")
        if self.haste is not None and (self.max_speed is not None or self.desired_speed is None):
            raise ValueError(f"haste = {self.haste:g}: needs a desired_speed, and no max_speed beside it")
        if self.alive is not None and self.network is not None:
            raise ValueError(f"alive = {self.alive}: must be left out, since all particles of a network are alive")
        if self.alive is not None and self.alive > self.size:
            raise ValueError(f"alive = {self.alive}: at most its count, {self.size}, is allowed")
        self._refuse_fast_moves()
        return self

    def _refuse_fast_moves(self) -> None:
        """Raise ValueError if particles of the network are held at a speed above the limit."""
        if self.network is None or not self.network.moves:
            return
        limit = float(self.max_speeds.min())
        for k, move in enumerate(self.network.moves):
            speed = math.hypot(*move.velocity)
            if speed > limit:
                raise ValueError(
                    f"network.moves[{k}].velocity = {move.velocity}: {speed:g} m/s is more than the limit, {limit:g}"
                )

    @property
    def keeps_heading(self) -> bool:
        """True if each agent keeps a heading frame."""
        return self.oriented or self.max_turn_rate is not None or self.banking is not None

    @property
    def size(self) -> int:
        """Number of agents."""
        return self.network.size if self.network is not None else int(self.count or 0)

    @property
    def radii(self) -> NDArray[np.float64]:
        """The radius of each agent, (size,) m."""
        return draw(self.radius, self.size, SIZE)

    @property
    def desired_speeds(self) -> NDArray[np.float64]:
        """The desired speed of each agent, (size,) m/s; 0 if not given."""
        return draw(self.desired_speed or 0.0, self.size, PACE)

    @property
    def max_speeds(self) -> NDArray[np.float64]:
        """The maximum speed of each agent, (size,) m/s; may be infinite."""
        if self.haste is not None:
            return self.haste * self.desired_speeds
        return np.full(self.size, math.inf if self.max_speed is None else self.max_speed)

    @property
    def narrowest(self) -> float:
        """The smallest radius, m."""
        return smallest(self.radius, self.size, SIZE)

    @property
    def widest(self) -> float:
        """The largest radius, m."""
        return largest(self.radius, self.size, SIZE)

    @property
    def heaviest(self) -> float:
        """The largest mass, kg; for a network the mean."""
        return largest(self.mass, self.size, SIZE)

    @property
    def fastest(self) -> float | None:
        """The largest max_speed, m/s; None without a limit."""
        return self.max_speed if self.haste is None else float(self.max_speeds.max())

    def masses(self, dimension: int) -> NDArray[np.float64]:
        """Return the mass of each agent, (size,) kg; infinite for pinned particles of a network.

        dimension: 2 or 3.
        """
        out = self.own_masses(dimension)
        if self.network is not None:
            out[self.network.pins()] = np.inf
        return out

    def own_masses(self, dimension: int) -> NDArray[np.float64]:
        """Return the mass of each agent, (size,) kg, as if no particle of a network was pinned.

        dimension: 2 or 3.
        """
        if self.network is None:
            return draw(self.mass, self.size, SIZE)
        assert not isinstance(self.mass, Spread)
        return self.network.masses(self.mass * self.size, dimension)
