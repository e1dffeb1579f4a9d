"""Steer: the behaviours of a group, in order of priority, and the arbitration of their steering forces.

Steer(group=0, arbitration=Allocation(), behaviours=(AvoidObstacles(weight=8), Wander(weight=2)))
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WrapValidator, model_validator

from flockenv.behaviours import BEHAVIOURS
from flockenv.core.record import instance_of
from flockenv.jit.decorators import Law, Vec
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import EFFECTS, Effect, demand_group
from flockenv.steering.arbitration import Allocation, AnyArbitration, Arbitration

__all__ = ["EVERY_EFFECT", "Steer"]

if TYPE_CHECKING:
    AnyBehaviour = Effect
    AnyReconciling = Arbitration
else:
    AnyBehaviour = Annotated[
        Annotated[functools.reduce(operator.or_, BEHAVIOURS.values()), Field(discriminator="kind")],
        WrapValidator(instance_of(Effect)),
    ]
    AnyReconciling = Annotated[AnyArbitration, WrapValidator(instance_of(Arbitration))]


class Steer(Effect):
    """The behaviours of a group in order of priority, and the arbitration that combines them into one force.

    The force is F = arbitration(F_1, ..., F_n) with |F| <= max_force, F_k the steering force of behaviour k (Reynolds
    1987 and 1999).

    Limits: without a `max_force`, `allocation`, `running_sum` and `blend` add up all forces in full. A second `steer`
    of the same group adds its force, and both together are cut to max_force.
    """

    kind: Literal["steer"] = "steer"
    sentence: ClassVar[str] = "Steer by the following behaviours, the first one first"
    behaviours: tuple[AnyBehaviour, ...] = Field(min_length=1, description="in order of priority, the highest first")
    arbitration: AnyReconciling = Field(default_factory=Allocation, description="how their forces are combined")
    group: int | None = Field(default=None, ge=0, description="group that it steers (default: all)")
    steering: ClassVar[bool] = True

    @model_validator(mode="after")
    def _check_behaviours(self) -> Steer:
        """Raise ValueError if an entry is no behaviour, or the arbitration's numbers do not fit their count."""
        for k, behaviour in enumerate(self.behaviours):
            if not behaviour.steering or behaviour.components:
                raise ValueError(
                    f"behaviours[{k}].kind = {behaviour.kind}: is not a behaviour; allowed: {', '.join(BEHAVIOURS)}"
                )
        self.arbitration.parameters(len(self.behaviours))
        return self

    @property
    def components(self) -> tuple[Effect, ...]:
        """Its behaviours."""
        return self.behaviours

    @property
    def steer_law(self) -> Law:
        """The arbitration's law."""
        return self.arbitration.law

    @property
    def required_inner(self) -> tuple[str, ...]:
        """The inner numbers that the arbitration recalls."""
        return self.arbitration.recalls

    @property
    def reach(self) -> float:
        """The largest reach of its behaviours, m."""
        return max(behaviour.reach for behaviour in self.behaviours)

    def parameters(self) -> dict[str, float | Vec]:
        """Return the numbers of the arbitration; behaviours have numbers of their own."""
        return self.arbitration.parameters(len(self.behaviours))

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """Return the agents that it steers: [first, end)."""
        first, end = (0, starts[-1]) if self.group is None else starts[self.group : self.group + 2]
        return {"first": float(first), "end": float(end)}

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return the sum of the rates of its behaviours, as if each acted in full; 0 for agents that it does not steer.

        For an arbitration that selects one behaviour at a time, the largest of them. None if no behaviour has rates.
        """
        found = [each for behaviour in self.behaviours if (each := behaviour.rates(groups, dimension)) is not None]
        if not found:
            return None
        starts = (0, *itertools.accumulate(group.size for group in groups))
        ends = self.members(starts)
        mine = np.arange(starts[-1])
        mine = (mine >= ends["first"]) & (mine < ends["end"])
        joined = np.max if self.arbitration.exclusive else np.sum
        square, damping = (np.where(mine, joined([each[k] for each in found], axis=0), 0.0) for k in range(2))
        return square, damping

    @property
    def always(self) -> bool:  # type: ignore[override]  # it follows from its behaviours
        """True if all of its behaviours act all the time."""
        return all(behaviour.always for behaviour in self.behaviours)

    def without_obstacles(self) -> Effect | None:
        """Return a copy with those of its behaviours that act without obstacles, or None."""
        left = tuple(behaviour for behaviour in self.behaviours if behaviour.without_obstacles() is not None)
        return self.model_copy(update={"behaviours": left}) if left else None

    def idle_copy(self) -> Effect:
        """Return a copy whose behaviours are all idle."""
        return self.model_copy(update={"behaviours": tuple(behaviour.idle_copy() for behaviour in self.behaviours)})

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if the group does not exist, or a behaviour does not suit the scene."""
        demand_group("group", self.group, scene.groups)
        for k, behaviour in enumerate(self.behaviours):
            try:
                behaviour.check(scene)
            except ValueError as error:
                raise ValueError(f"behaviours[{k}].{error}") from None

    def check_start(self, scene: SceneView, state: Any) -> None:
        """Run the checks of the initial state of its behaviours, which may warn."""
        for behaviour in self.behaviours:
            behaviour.check_start(scene, state)

    def calls_for(self) -> tuple[str, ...]:
        """Return the optional data that its behaviours need."""
        return tuple(dict.fromkeys(what for behaviour in self.behaviours for what in behaviour.calls_for()))


EVERY_EFFECT: tuple[type[Effect], ...] = tuple(EFFECTS.values())
"""All that a scene's file may list: effects, behaviours, and Steer."""
