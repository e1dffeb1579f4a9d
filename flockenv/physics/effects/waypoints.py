"""Journeys: targets visited in order, on straight lines or around obstacles, with a wait at each."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.geometry.targets import Target, approach_side, is_reached, row_size, side_of_door, to_target, way_out
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import norm, scale, select, sub, unit, zero
from flockenv.model.distribution import Spread, draw
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.aims import applies_to
from flockenv.physics.effects.effect import Me
from flockenv.physics.effects.floor_field import Around, slow_down
from flockenv.physics.floor_fields import path_to_target

__all__ = ["Journey", "Stage", "place_behind", "stored_position"]

Seconds = Annotated[float, Field(ge=0)] | Spread

PREMOVEMENT = 2
"""RNG channel of premovement times. Group uses channels 0 and 1; the waits at stage k use PREMOVEMENT + 1 + k."""
HEAD = 2
"""Numbers of a stage before those of its target: index of its floor field in the table, or -1; its slow radius."""


@law
def stored_position(me: Me) -> Vec:
    """Return the position stored at the end of the previous step."""
    return me.inner.was_x, me.inner.was_y


@law
def place_behind(me: Me, table: Any, at: Any) -> Vec:
    """Return a point a metre behind an agent that goes on from the target at `at`, which it has just reached."""
    return sub(me.pos, unit(way_out(table, at, me.inner.side, sub(me.pos, stored_position(me)))))


@law
def stage_row(p: Any, stage: float) -> Any:
    """Return the index in the table at which a stage's numbers begin; after the last stage, that of the last."""
    last = p.many - like(stage, 1.0)
    k = np.floor(stage)
    k = k if k < last else last
    o = like(stage, 0.0)
    return np.int64(k if k > o else o) * np.int64(p.size)


@law
def journey_aim(p: Any, me: Me) -> Vec:
    """Return the direction to the stage; 0 before the start of the journey; straight on after the last stage."""
    stage, o = me.inner.stage, like(p.share, 0.0)
    row = stage_row(p, stage)
    straight = to_target(p.table, row + 2, me.pos)
    block = np.int64(p.table[row])
    length, direction = norm(straight), unit(straight)
    if block >= 0:
        length, direction = path_to_target(p.table[block:], me.pos)
    e = slow_down(direction, length, p.table[row + 1])
    e = select((stage >= p.many) & (p.leaves > o), unit(sub(me.pos, stored_position(me))), e)
    return select(applies_to(p, me) & (stage >= o), scale(e, p.share), zero(me.pos))


@law
def initial_stage(p: Any, me: Me) -> Vec:
    """Return the initial stage, -1/2 during a wait before the journey, the end of that wait, position and side."""
    o = like(p.share, 0.0)
    begin = np.int64(p.many) * np.int64(p.size)
    each = np.int64(p.many) + 1
    mine = applies_to(p, me)
    wait = p.table[begin + np.int64(me.who - p.first) * each] if mine else o
    stage = like(o, -0.5) if wait > o else o
    side = side_of_door(p.table, stage_row(p, stage) + 2, me.pos)
    return select(mine, (stage, me.time + wait, me.pos[0], me.pos[1], side), (o, o, o, o, o))


@law
def wait_at(p: Any, me: Me, stage: float) -> float:
    """Return the duration of the agent's wait at a stage, s."""
    each = np.int64(p.many) + 1
    begin = np.int64(p.many) * np.int64(p.size) + np.int64(me.who - p.first) * each
    return p.table[begin + 1 + np.int64(stage)]  # type: ignore[no-any-return]


@law
def update_stage(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return the stage, k, or k + 1/2 during a wait there, the end of that wait, the position and the approach side."""
    stage, ready, was, side = me.inner.stage, me.inner.ready, stored_position(me), me.inner.side
    o, half, now = like(stage, 0.0), like(stage, 0.5), me.time + seconds
    if not applies_to(p, me) or (stage >= p.many and p.leaves > o):
        return (stage, ready, was[0], was[1], side)
    on, row = np.floor(stage) + like(stage, 1.0), stage_row(p, stage) + 2
    if stage != np.floor(stage):  # it waits
        over = now >= ready - like(seconds, 0.01) * seconds
        stage, side = (on, o) if over else (stage, side)
    elif stage < p.many and is_reached(p.table, row, side, was, me.pos):
        wait = wait_at(p, me, stage)
        ready, side = now + wait, o
        stage = stage + half if wait > o else on
    ended = stage >= p.many
    stage = o if ended and p.loops > o else stage
    place = select(ended & (p.leaves > o), place_behind(me, p.table, row), me.pos)
    return (stage, ready, place[0], place[1], approach_side(p.table, stage_row(p, stage) + 2, side, me.pos))


class Stage(Target):
    """A stage of a journey, reached if an agent is in it (a point: within its radius) or has passed it (a door)."""

    wait: Seconds = Field(default=0.0, description="s, duration of the wait there, or its distribution")
    around: bool = Field(default=True, description="True: by the path around obstacles; False: straight")

    @model_validator(mode="after")
    def _check_radius(self) -> Stage:
        """Raise ValueError for a point of radius 0, which is never reached."""
        if self.at is not None and self.radius == 0:
            raise ValueError("radius = 0: must be above 0, in m, for a point: it is reached within this distance")
        return self


class Journey(Around):
    """Agents of a group visit stages in order, and may wait before the first, and at each.

    `inner(state, "stage")` is the index k of the stage that an agent heads for, from 0; k + 1/2 during a wait there;
    -1/2 during a wait before the first; the number of stages after the last. A wait ends with the first step that
    begins after its duration, for any dt. After the last stage, with then = "leave", an agent goes straight on, through
    a sink if there is one. In 2-D only.

    The direction to a stage is e = unit(d), with d to the stage, or down the gradient of the path length. The model is
    ours.

    Limits: the order of stages is fixed, and the paths are found once, without other agents: a crowd does not avoid a
    full stage. Waits are drawn when the scene is built, and are the same in all worlds.
    """

    kind: Literal["journey"] = "journey"
    stages: tuple[Stage, ...] = Field(min_length=1, description="targets, in this order")
    premovement: Seconds = Field(default=0.0, description="s, wait before the first stage, or its distribution")
    then: Literal["stay", "leave", "loop"] = Field(
        default="stay", description="after the last stage: stay there, go straight on, or repeat the journey"
    )
    slow_radius: float = Field(default=0.5, gt=0, description="m, over which agents slow down before a stop")
    needs_all: ClassVar[bool] = True
    aim_law: ClassVar[Law | None] = journey_aim
    begin_law: ClassVar[Law | None] = initial_stage
    keep_law: ClassVar[Law | None] = update_stage
    keeps: ClassVar[tuple[str, ...]] = ("stage", "ready", "was_x", "was_y", "side")

    @property
    def goals(self) -> tuple[tuple[Target, ...], tuple[str, ...]]:
        """The stages that agents reach by paths around obstacles."""
        there = [k for k, stage in enumerate(self.stages) if stage.around]
        return tuple(self.stages[k] for k in there), tuple(f"stages[{k}]" for k in there)

    def parameters(self) -> dict[str, float | Vec]:
        """Return the share, the number of stages, the size of a row, and the code of `then`."""
        ends = {"leaves": float(self.then == "leave"), "loops": float(self.then == "loop")}
        return {"share": self.share, "many": float(len(self.stages)), "size": float(HEAD + row_size(2)), **ends}

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return a row for each stage, the waits drawn for each agent, and one floor field per target."""
        members = self.members(scene.starts)
        count = int(members["end"] - members["first"])
        given = [(self.premovement, PREMOVEMENT), *((s.wait, PREMOVEMENT + 1 + k) for k, s in enumerate(self.stages))]
        waits = np.stack([draw(value, count, channel) for value, channel in given], axis=1)
        places = {Target(**stage.place): name for stage, name in zip(*self.goals, strict=True)}
        blocks = [self.field_block(scene, (place,), (name,)) for place, name in places.items()]
        begin = len(self.stages) * (HEAD + row_size(2)) + waits.size
        at = dict(zip(places, begin + np.cumsum([0, *map(len, blocks)])[:-1], strict=True))
        rows = [
            [float(at[Target(**stage.place)]) if stage.around else -1.0, self.slow_radius_of(k), *stage.row]
            for k, stage in enumerate(self.stages)
        ]
        return np.concatenate([np.ravel(rows), waits.ravel(), *blocks])

    def grids(self, scene: SceneView) -> list[NDArray[np.float64]]:
        """Return the floor field of each stage that agents reach by paths around obstacles."""
        table, size = scene.table_of(self), HEAD + row_size(2)
        blocks = [int(table[k * size]) for k, stage in enumerate(self.stages) if stage.around]
        return [table[at + 2 + row_size(2) :] for at in blocks]

    def slow_radius_of(self, k: int) -> float:
        """Return the distance over which agents slow down before stage k, m."""
        stays = self.then == "stay" and k == len(self.stages) - 1
        return self.slow_radius if stays or self.stages[k].wait != 0 else 0.0

    def check(self, scene: SceneView) -> None:
        """Raise ValueError in 3-D, and on a torus."""
        if scene.dimension != 2 or scene.space.periodic:
            raise ValueError(f"kind = {self.kind}: only a plane or a box of dimension 2 is allowed")
        super().check(scene)
