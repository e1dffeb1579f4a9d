"""A plan: an experiment as data, with cases, variants of each, and the numbers that are measured.

See configs/experiments/; `flockenv experiment FILE.yaml` runs one. A `SteerPlan` varies the behaviours of a `steer`.
"""

from __future__ import annotations

import functools
import importlib
from typing import Literal

from pydantic import Field, model_validator

from flockenv.behaviours import FollowWay, Seek
from flockenv.behaviours.steer import AnyBehaviour, AnyReconciling, Steer
from flockenv.core.record import Record
from flockenv.physics.effects import Effect
from flockenv.scene import Scene
from flockenv.studies.experiments.experiment import Experiment

__all__ = ["Case", "GlobalWay", "Plan", "SteerPlan", "Variant"]


class Plan(Record):
    """An experiment as data: fields that all plans have."""

    measure: str = Field(description="which numbers are measured")
    title: str
    worlds: int = Field(ge=1, description="number of worlds in which each case is run")
    seed: int = Field(default=0, ge=0)

    def experiment(self) -> Experiment:
        """Return the experiment; raise ValueError if one of its scenes cannot be built."""
        raise TypeError(f"{type(self).__name__} must say what is run")


class Case(Record):
    """A case: a scene whose first effect is the `steer` that is varied."""

    what: str = Field(description="description of the case, in a sentence")
    seconds: float = Field(gt=0, description="s, longest duration")
    scene: Scene

    @model_validator(mode="after")
    def _check_seek(self) -> Case:
        """Raise ValueError if the first effect is not a steer with a seek, or if there are no obstacles."""
        steer = self.scene.effects[0] if self.scene.effects else None
        if not isinstance(steer, Steer) or not any(isinstance(behaviour, Seek) for behaviour in steer.behaviours):
            raise ValueError("scene.effects[0]: must be a steer, and seek among its behaviours")
        if not self.scene.obstacles:
            raise ValueError("scene.obstacles: must not be empty")
        return self

    @property
    def steer(self) -> Steer:
        """The effect that is varied."""
        steer = self.scene.effects[0]
        assert isinstance(steer, Steer)
        return steer

    @property
    def target(self) -> tuple[float, ...]:
        """Target of the seek behaviour, m."""
        return next(each.target for each in self.steer.behaviours if isinstance(each, Seek))


class GlobalWay(Record):
    """The floor field around all obstacles to the target of `seek`, see `follow_way`."""

    clearance: float = Field(ge=0, description="m, from the path to every obstacle")
    spacing: float = Field(gt=0, description="m, between points of its grid")
    slow_radius: float = Field(gt=0, description="m before the target, over which the agent slows down")

    def replace_seek(self, behaviour: Effect) -> Effect:
        """Return a FollowWay to the same target for a Seek; return other behaviours unchanged."""
        if not isinstance(behaviour, Seek):
            return behaviour
        return FollowWay(speed=behaviour.speed, weight=behaviour.weight, target=behaviour.target, **self.model_dump())


class Variant(Record):
    """Changes to the steer of every case."""

    first: tuple[AnyBehaviour, ...] = Field(default=(), description="behaviours of higher priority than the case's own")
    arbitration: AnyReconciling | None = Field(default=None, description="arbitration (default: the case's own)")
    way: GlobalWay | None = Field(default=None, description="replaces seeking straight ahead (default: straight ahead)")


class SteerPlan(Plan):
    """Scenes with a steer, each under several variants of it."""

    measure: Literal["avoidance", "arbitration"] = Field(description="which numbers are measured")
    cases: dict[str, Case] = Field(min_length=1)
    variants: dict[str, Variant] = Field(min_length=1)

    def scene_of(self, case: str, variant: str) -> Scene:
        """Return the scene of a case under a variant."""
        given, varied = self.cases[case], self.variants[variant]
        behaviours = (varied.way.replace_seek(each) if varied.way else each for each in given.steer.behaviours)
        steer = given.steer.model_copy(
            update={
                "behaviours": (*varied.first, *behaviours),
                "arbitration": varied.arbitration or given.steer.arbitration,
            }
        )
        fields = {name: getattr(given.scene, name) for name in Scene.model_fields}
        return Scene(**fields | {"effects": (steer, *given.scene.effects[1:])})

    def experiment(self) -> Experiment:
        """Return the experiment."""
        measure = importlib.import_module(f"flockenv.studies.experiments.{self.measure}")
        for case in self.cases:
            for variant in self.variants:
                try:
                    self.scene_of(case, variant)
                except ValueError as error:
                    raise ValueError(f"cases.{case} with variants.{variant}: {error}") from None
        more = measure.more_columns(self) if hasattr(measure, "more_columns") else {}
        return Experiment(
            name=self.measure, title=self.title, cases={name: case.what for name, case in self.cases.items()},
            variants=tuple(self.variants), columns={**measure.COLUMNS, **more}, shown=measure.SHOWN,
            trial=functools.partial(measure.trial, self),
        )  # fmt: skip
