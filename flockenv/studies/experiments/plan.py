"""A plan: an experiment as data. Some cases, what is varied in each, and which numbers are measured.

configs/experiments/ holds some; `flockenv experiment FILE.yaml` runs one. A `SteerPlan` varies what is in a steer.
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
    """An experiment as data: what all of them say."""

    measure: str = Field(description="which numbers are measured")
    title: str
    worlds: int = Field(ge=1, description="how many worlds each case is tried in")
    seed: int = Field(default=0, ge=0)

    def experiment(self) -> Experiment:
        """Return what is to be run; ValueError, of one line, if one of its scenes cannot be built."""
        raise TypeError(f"{type(self).__name__} must say what is run")


class Case(Record):
    """Something that happens: a scene whose first effect is the `steer` that is varied."""

    what: str = Field(description="what happens, in a sentence")
    seconds: float = Field(gt=0, description="s, for how long at most")
    scene: Scene

    @model_validator(mode="after")
    def _seeks(self) -> Case:
        """Refuse a scene in which nothing could be varied, or nobody wants to get anywhere."""
        steer = self.scene.effects[0] if self.scene.effects else None
        if not isinstance(steer, Steer) or not any(isinstance(wish, Seek) for wish in steer.behaviours):
            raise ValueError("scene.effects[0]: must be a steer, and seek among its behaviours")
        if not self.scene.obstacles:
            raise ValueError("scene.obstacles: must not be empty; it is about them")
        return self

    @property
    def steer(self) -> Steer:
        """What is varied."""
        steer = self.scene.effects[0]
        assert isinstance(steer, Steer)
        return steer

    @property
    def target(self) -> tuple[float, ...]:
        """Where everybody wants to get to, m."""
        return next(wish.target for wish in self.steer.behaviours if isinstance(wish, Seek))


class GlobalWay(Record):
    """The way around all obstacles to what would be sought straight ahead, see `follow_way`."""

    clearance: float = Field(ge=0, description="m, from the way to every obstacle")
    spacing: float = Field(gt=0, description="m, between points of its grid")
    slow_radius: float = Field(gt=0, description="m before the target, over which it slows down")

    def instead_of(self, wish: Effect) -> Effect:
        """Return the way to the same target, if a behaviour seeks one."""
        if not isinstance(wish, Seek):
            return wish
        return FollowWay(speed=wish.speed, weight=wish.weight, target=wish.target, **self.model_dump())


class Variant(Record):
    """What is put into the steer of every case."""

    first: tuple[AnyBehaviour, ...] = Field(default=(), description="more pressing behaviours than those of the case")
    arbitration: AnyReconciling | None = Field(default=None, description="none = the case's own")
    way: GlobalWay | None = Field(default=None, description="instead of seeking straight ahead; none = straight ahead")


class SteerPlan(Plan):
    """Scenes in which somebody steers, each under several ways to do so."""

    measure: Literal["avoidance", "arbitration"] = Field(description="which numbers are measured")
    cases: dict[str, Case] = Field(min_length=1)
    variants: dict[str, Variant] = Field(min_length=1)

    def scene_of(self, case: str, variant: str) -> Scene:
        """Return the scene of a case under a variant."""
        given, varied = self.cases[case], self.variants[variant]
        wishes = (varied.way.instead_of(w) if varied.way else w for w in given.steer.behaviours)
        steer = given.steer.model_copy(
            update={
                "behaviours": (*varied.first, *wishes),
                "arbitration": varied.arbitration or given.steer.arbitration,
            }
        )
        fields = {name: getattr(given.scene, name) for name in Scene.model_fields}
        return Scene(**fields | {"effects": (steer, *given.scene.effects[1:])})

    def experiment(self) -> Experiment:
        """Return what is to be run."""
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
