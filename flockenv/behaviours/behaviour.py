"""Base classes of behaviours: top speed, target group, and the nearest member of that group."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.core.warnings import LookaheadWarning
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Effect, Me, Other, Sight, all_masses, demand_group

__all__ = [
    "AboutNearest",
    "Behaviour",
    "Moving",
    "gains",
    "mean_nearest",
    "nearest_one",
    "steered_groups",
    "top_speed",
]


@law
def top_speed(p: Any, me: Me) -> float:
    """Return the top speed of a behaviour, m/s.

    p: the parameters of the behaviour, whose `speed`, m/s, is a limit; me: the agent.

    1 for agents without any limit: they are not steered (see Moving), but their force must be finite.
    """
    top = p.speed if p.speed < me.max_speed else me.max_speed
    return top if top < like(top, np.inf) else like(top, 1.0)


@law
def nearest_one(p: Any, me: Me, other: Other) -> Vec:
    """Return offset, velocity and the count 1, to be summed over the nearest neighbour, or several equally near.

    p: parameters, not used; me: the agent; other: the neighbour.
    """
    return other.offset + other.vel + (like(other.square, 1.0),)


@law
def mean_nearest(sums: Vec) -> tuple[Vec, Vec, bool]:
    """Return the mean offset and velocity of the nearest neighbour, and True if there is one.

    sums: those of `nearest_one`: offset, m, velocity, m/s, and the number of the nearest.
    """
    o, e = like(sums[0], 0.0), like(sums[0], 1.0)
    count = sums[len(sums) - 1]
    share = e / count if count > o else o
    if len(sums) == 5:
        return (sums[0] * share, sums[1] * share), (sums[2] * share, sums[3] * share), count > o
    else:
        velocity = (sums[3] * share, sums[4] * share, sums[5] * share)
        return (sums[0] * share, sums[1] * share, sums[2] * share), velocity, count > o


def steered_groups(effect: Effect, scene: SceneView) -> list[int]:
    """Return the indices of the groups that a behaviour of a scene steers.

    effect: the behaviour; scene: the scene that has it, itself or inside others.
    """
    found: set[int] = set()
    for each in scene.effects:
        if each == effect or effect in each.components:
            only = getattr(each, "group", None) if each.components else None
            every = set(range(len(scene.groups)))
            found |= every if only is None else every & {only}
    return sorted(found)


def gains(weight: float, groups: Sequence[Any], dimension: int) -> NDArray[np.float64]:
    """Return weight / mass of every agent, (N,); 0 for agents held in place, or with a max_force of 0.

    weight: the behaviour weight, kg/s; groups: of the scene; dimension: 2 or 3.
    """
    free = np.repeat([group.max_force != 0 for group in groups], [group.size for group in groups])
    return np.where(free, weight / all_masses(groups, dimension), 0.0)


class Behaviour(Effect):
    """A steering force F = weight x S: S is desired velocity less velocity, by a law of `flockenv.steering`.

    S contains -v, so weight / m is a damping rate: with a step above 2 m / weight, the Euler methods are unstable.
    That holds for forces below max_force; a large weight under a small max_force is bang-bang control, whose velocity
    chatters by max_force dt / m.
    """

    weight: float = Field(ge=0, description="kg/s, force per change of velocity")
    steering: ClassVar[bool] = True
    always: ClassVar[bool] = False
    copies: ClassVar[bool] = False
    """True if the agent copies another's velocity: two that copy each other converge twice as fast."""
    unlimited: ClassVar[tuple[str, ...]] = ()
    """Names of the fields in which None means no limit."""

    def parameters(self) -> dict[str, float | Vec]:
        """Return the behaviour's numbers; missing limits are infinite."""
        return {**dict.fromkeys(self.unlimited, math.inf), **super().parameters()}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return no oscillation, and a damping of weight / m, or twice that if it copies a velocity.

        Left out is that what an agent heads for may move with its velocity, as for follow_path and orca, whose damping
        can be larger (tests/test_gains.py).
        """
        damping = gains(self.weight * (2.0 if self.copies else 1.0), groups, dimension)
        return np.zeros(len(damping)), damping

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if a group does not exist, naming the field."""
        for name in ("group", "other", "food"):
            demand_group(name, getattr(self, name, None), scene.groups)
        super().check(scene)


class Moving(Behaviour):
    """A behaviour with a desired velocity up to a top speed."""

    speed: float | None = Field(default=None, gt=0, description="m/s, top speed (default: max_speed)")
    unlimited: ClassVar[tuple[str, ...]] = ("speed",)
    steepness: ClassVar[float] = 1.0
    """Largest gradient of the desired velocity, in units of V / slow_radius."""

    @property
    def limit(self) -> float:
        """Its own top speed, m/s; infinite without a limit."""
        return math.inf if self.speed is None else self.speed

    @property
    def ramp(self) -> float | None:
        """The distance over which it slows down to stop, m; None if it does not."""
        return getattr(self, "slow_radius", None)

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return damping weight / m, and w^2 = weight V / (m slow_radius) if it slows down, times `steepness`."""
        found = super().rates(groups, dimension)
        if found is None or not self.ramp:
            return found
        top = np.minimum(self.limit, np.concatenate([group.max_speeds for group in groups]))
        slope = self.steepness * np.where(np.isfinite(top), top, 0.0) / self.ramp
        return found[0] + gains(self.weight, groups, dimension) * slope, found[1]

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if a group has no speed limit; warn if the ramp is too short to stop on."""
        super().check(scene)
        for k in steered_groups(self, scene):
            group = scene.groups[k]
            if group.max_force == 0:
                continue  # the group is not steered
            speeds = [speed for speed in (self.speed, group.fastest) if speed is not None]
            if not speeds:
                raise ValueError(f"speed = None: groups[{k}].max_speed is not given either; give one of them")
            if self.ramp is not None and group.max_force is not None:
                _warn_of_overshoot(self.kind, self.ramp, min(speeds), group)


def _warn_of_overshoot(kind: str, slow_radius: float, speed: float, group: Any) -> None:
    """Warn if a ramp's deceleration at its edge, V^2 / d, is more than the group's max_force allows."""
    least = speed**2 * group.heaviest / group.max_force
    if slow_radius < least * (1 - 1e-9):
        text = (
            f"{kind}: slow_radius = {slow_radius:g} m: overshoots; with max_force = {group.max_force:g} N to stop from"
        )
        warnings.warn(f"{text} {speed:g} m/s takes speed^2 mass / max_force = {least:g} m", LookaheadWarning, 2)


class AboutNearest(Behaviour):
    """A behaviour towards the nearest visible agent of a group; zero if none is visible."""

    group: int | None = Field(default=None, ge=0, description="group whose nearest agent counts (default: all)")
    radius: float = Field(gt=0, description="m, range of sight")
    fov: float = Field(
        title="field of view", default=360.0, gt=0, le=360, description="degrees, full angle of the field of view"
    )
    occluded: bool = Field(default=False, description="True if obstacles hide agents")
    pair_law: ClassVar[Law | None] = nearest_one

    @property
    def sight(self) -> Sight:
        """The sight: the nearest agent of the group."""
        return Sight(self.radius, self.fov, 1, self.group, self.occluded)

    def sums(self, dimension: int) -> int:
        """Return how many numbers are summed: offset, velocity and count."""
        return 2 * dimension + 1
