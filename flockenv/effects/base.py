"""Effect: what acts on a body. A frozen record that names its laws; a scene composes the laws of its effects.

An effect is of one or more of three forms, each a law for one agent:

* `own_law(p, me) -> force`: by itself (drag, gravity, a field);
* `pair_law(p, me, other) -> sums`, `finish_law(p, me, sums) -> force`: what one neighbour adds to K running sums, and
  the force they make; all pair laws of a scene share one sweep;
* `obstacle_start(p, me)`, `obstacle_law(p, me, other, acc) -> acc`, `obstacle_finish(p, me, acc) -> force`: a fold over
  the obstacles.

`p` holds the effect's `parameters()` by name, `me` and `other` are the records below. Laws live in the effect's module.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from flockenv.kernels import Vec
from flockenv.records import Record

__all__ = ["EFFECTS", "Effect", "Me", "Other"]

EFFECTS: dict[str, type[Effect]] = {}
"""Every effect by its kind; a class registers itself when it is defined."""


class Me(NamedTuple):
    """The agent a law acts on."""

    who: float  # which agent; a number in the precision of the scene
    pos: Vec  # m
    vel: Vec  # m/s
    heading: Vec  # unit(vel); 0 at standstill
    mass: float  # kg
    radius: float  # m
    max_speed: float  # m/s
    max_force: float  # N


class Other(NamedTuple):
    """Whom it meets: a neighbour, or an obstacle (at rest)."""

    who: float
    offset: Vec  # m, other minus me, the shortest way
    square: float  # m^2, |offset|^2
    vel: Vec  # m/s
    radius: float  # m


class Effect(Record):
    """What acts on a body; see the module for the forms of its laws."""

    kind: str
    steering: ClassVar[bool] = False
    """True if it is something the agent wants (bounded by max_force together with its drive), False for physics."""
    own_law: ClassVar[str | None] = None
    pair_law: ClassVar[str | None] = None
    finish_law: ClassVar[str | None] = None
    obstacle_start: ClassVar[str | None] = None
    obstacle_law: ClassVar[str | None] = None
    obstacle_finish: ClassVar[str | None] = None
    conserves_momentum: ClassVar[bool] = False
    """True if what i does to j is the opposite of what j does to i."""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        kind = cls.model_fields["kind"].default
        if isinstance(kind, str):
            EFFECTS[kind] = cls

    @property
    def reach(self) -> float:
        """How far it looks for neighbours, m; 0 if it does not."""
        return 0.0

    def sums(self, dimension: int) -> int:
        """How many running sums its pair law fills."""
        return 0

    def parameters(self) -> dict[str, float]:
        """The numbers its laws are given, by name."""
        return {name: float(getattr(self, name)) for name in type(self).model_fields if name != "kind"}

    def calls_for(self) -> tuple[str, ...]:
        """What must be computed for it, in words: nothing, a neighbour query, a pass over the obstacles."""
        return tuple(
            text
            for text, law in (("neighbour query", self.pair_law), ("obstacles", self.obstacle_law))
            if law is not None
        )
