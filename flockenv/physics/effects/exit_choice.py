"""Routes: choice of the door with the shortest expected time, for the walk there and the queue in front of it."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.geometry.eikonal import NO_WAY
from flockenv.geometry.targets import Target, approach_side, is_reached, row_size, side_of_door
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import scale, sub, unit, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.aims import applies_to
from flockenv.physics.effects.effect import Me
from flockenv.physics.effects.floor_field import Around
from flockenv.physics.effects.waypoints import place_behind, stored_position
from flockenv.physics.floor_fields import path_to_target

__all__ = ["Door", "Routes"]

HEAD = 2
"""Numbers of a door before those of its target: index of its floor field in the table; its capacity, 1/s."""
BINS = 256
"""Number of bins of path length to a door, up to the longest, in which agents are counted."""


@law
def door_row(p: Any, k: Any) -> Any:
    """Return the index in the table at which the numbers of door k as a target begin."""
    return 1 + np.int64(k) * np.int64(p.size) + 2


@law
def path_to_door(p: Any, me: Me, k: Any) -> tuple[float, Vec]:
    """Return the length of the path to door k, m, and its initial direction."""
    return path_to_target(p.table[np.int64(p.table[1 + k * np.int64(p.size)]) :], me.pos)


@law
def bin_of(p: Any, length: float) -> float:
    """Return the bin of a path length, m."""
    last = p.bins - like(length, 1.0)
    piece = np.floor(length / p.table[0])
    return piece if piece < last else last  # type: ignore[no-any-return]


@law
def door_counter(p: Any, me: Me) -> float:
    """Return the counter of the agent's door and bin of path length, or -1 if it has passed its door."""
    door = me.inner.door
    heading = applies_to(p, me) & (door < p.many)
    return door * p.bins + bin_of(p, me.inner.left) if heading else like(door, -1.0)


@law
def count_ahead(p: Any, me: Me, k: Any, length: float) -> float:
    """Return the number of agents that head for door k and are nearer to it; those in the same bin count half."""
    o, e = like(length, 0.0), like(length, 1.0)
    mine, begin = np.int64(bin_of(p, length)), k * np.int64(p.bins)
    count = o
    for j in range(mine):
        count += p.counted[begin + j]
    was = np.int64(bin_of(p, me.inner.left))
    me_too = np.int64(me.inner.door) == k
    count -= e if me_too and was < mine else o
    beside: float = p.counted[begin + mine] - (e if me_too and was == mine else o)
    return count + like(o, 0.5) * beside


@law
def expected_time(p: Any, me: Me, k: Any, waits: bool) -> float:
    """Return the time to get through door k, s: that of the walk and, if `waits`, of the queue in front of it."""
    length, _ = path_to_door(p, me, k)
    time = length / me.desired_speed
    if waits:
        time += count_ahead(p, me, k, length) / p.table[2 + k * np.int64(p.size)]
    return time


@law
def quickest_door(p: Any, me: Me, waits: bool) -> tuple[Any, float]:
    """Return the door of the shortest expected time, and that time, s; of equals, the first."""
    best, time = 0, expected_time(p, me, 0, waits)
    for k in range(1, np.int64(p.many)):
        other = expected_time(p, me, k, waits)
        if other < time:
            best, time = k, other
    return best, time


@law
def initial_route(p: Any, me: Me) -> Vec:
    """Return the inner state at the start: the nearest door, the time of first decision, within a period, the side."""
    o = like(p.share, 0.0)
    if not applies_to(p, me):
        return (o, o, o, me.inner.was_x, me.inner.was_y, o)
    door, _ = quickest_door(p, me, False)
    left, _ = path_to_door(p, me, door)
    turn = (me.who + like(o, 1.0)) * like(o, 0.6180339887498949)
    ready, side = me.time + p.period * (turn - np.floor(turn)), side_of_door(p.table, door_row(p, door), me.pos)
    return (like(o, door), left, ready, me.pos[0], me.pos[1], side)


@law
def update_route(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return the inner state after a step: door (decided once per period), length, next decision, position, side."""
    door, left, ready, was, side = me.inner.door, me.inner.left, me.inner.ready, stored_position(me), me.inner.side
    if not applies_to(p, me) or door >= p.many:
        return (door, left, ready, was[0], was[1], side)
    o, e, now, mine = like(door, 0.0), like(door, 1.0), me.time + seconds, np.int64(door)
    if is_reached(p.table, door_row(p, mine), side, was, me.pos):
        place = place_behind(me, p.table, door_row(p, mine))
        return (p.many, o, ready, place[0], place[1], side)
    if now >= ready - like(seconds, 0.01) * seconds:
        found, time = quickest_door(p, me, True)
        if time < (e - p.hysteresis) * expected_time(p, me, mine, True):
            mine, side = np.int64(found), o
        ready += p.period
    length, _ = path_to_door(p, me, mine)
    side = approach_side(p.table, door_row(p, mine), side, me.pos)
    return (like(door, float(mine)), length, ready, me.pos[0], me.pos[1], side)


@law
def routes_aim(p: Any, me: Me) -> Vec:
    """Return the direction of the path to the agent's door, or straight on after the door."""
    if not applies_to(p, me):
        return zero(me.pos)
    if me.inner.door >= p.many:
        return scale(unit(sub(me.pos, stored_position(me))), p.share)
    _, direction = path_to_door(p, me, np.int64(me.inner.door))
    return scale(direction, p.share)


class Door(Target):
    """A door with its width, which determines its capacity."""

    width: float | None = Field(default=None, gt=0, description="m (default: from one end to the other)")

    @model_validator(mode="after")
    def _check_width(self) -> Door:
        """Raise ValueError if the door has neither width nor ends."""
        if self.width is None and self.ends is None:
            raise ValueError("width = None: must be given, in m, for a door without ends")
        return self

    @property
    def opening_width(self) -> float:
        """The width of the door, m."""
        return self.length if self.width is None else self.width


class Routes(Around):
    """Agents of a group leave by the door of the shortest expected time, t = L / v0 + n / (J w).

    L is the length of the path to the door, v0 the desired speed, n the number of agents of the group that head for
    that door and are nearer to it, J the `flow` and w the door's width. An agent begins with the nearest door, decides
    again after each `period`, with an offset of its own (golden ratio times its index), and changes only to a door that
    is faster by `hysteresis`. Each agent is assumed to know n for every door: agents are counted once per step, in bins
    of 1/256 of the longest path. `inner(state, "door")` is the index of the door; for an agent that has passed its
    door, and then goes straight on, it is the number of doors. A door is passed from the side on which the agent
    approached it, also just beside an end that stands free; crossing it backwards does not count.

    The choice by expected time is ours.

    Limits: every agent knows the queue at every door, also behind walls, and agents outside the group are not counted.
    J w is an assumed capacity: a blocked door is still expected to let agents pass.
    """

    kind: Literal["routes"] = "routes"
    doors: tuple[Door, ...] = Field(min_length=1, description="doors to choose from, or a single one")
    flow: float = Field(default=1.9, gt=0, description="1/(m s), agents that pass per metre of width")
    period: float = Field(default=2.0, gt=0, description="s, between decisions")
    hysteresis: float = Field(default=0.1, ge=0, lt=1, description="fraction by which another door must be faster")
    aim_law: ClassVar[Law | None] = routes_aim
    begin_law: ClassVar[Law | None] = initial_route
    keep_law: ClassVar[Law | None] = update_route
    count_law: ClassVar[Law | None] = door_counter
    keeps: ClassVar[tuple[str, ...]] = ("door", "left", "ready", "was_x", "was_y", "side")

    @property
    def goals(self) -> tuple[tuple[Target, ...], tuple[str, ...]]:
        """The doors."""
        return self.doors, tuple(f"doors[{k}]" for k in range(len(self.doors)))

    @property
    def counters(self) -> int:
        """Number of counters: one for each bin of path length and each door."""
        return BINS * len(self.doors)

    def parameters(self) -> dict[str, float | Vec]:
        """Return the numbers that the laws read in addition to the table."""
        numbers = {name: float(getattr(self, name)) for name in ("share", "period", "hysteresis")}
        return {**numbers, "many": float(len(self.doors)), "bins": float(BINS), "size": float(HEAD + row_size(2))}

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return the width of a bin, m, a row for each door, and the floor field of each."""
        blocks = [self.field_block(scene, (door,), (name,)) for door, name in zip(*self.goals, strict=True)]
        begin = 1 + len(self.doors) * (HEAD + row_size(2))
        at = begin + np.cumsum([0, *map(len, blocks)])
        rows = [[float(a), self.flow * d.opening_width, *d.row] for a, d in zip(at[:-1], self.doors, strict=True)]
        lengths = np.concatenate([block[2 + row_size(2) + 6 :: 3] for block in blocks])
        longest = float(lengths[lengths < NO_WAY].max())
        return np.concatenate([[max(longest, self.spacing) / (BINS - 1)], np.ravel(rows), *blocks])

    def grids(self, scene: SceneView) -> list[NDArray[np.float64]]:
        """Return the floor field of each door."""
        table, size = scene.table_of(self), HEAD + row_size(2)
        return [table[int(table[1 + k * size]) + 2 + row_size(2) :] for k in range(len(self.doors))]

    def check(self, scene: SceneView) -> None:
        """Raise ValueError in 3-D, on a torus, and for groups without a desired speed."""
        if scene.dimension != 2 or scene.space.periodic:
            raise ValueError(f"kind = {self.kind}: only a plane or a box of dimension 2 is allowed")
        super().check(scene)
        for k, group in enumerate(scene.groups):
            if self.group in (None, k) and group.desired_speed is None:
                raise ValueError(f"kind = {self.kind}: groups[{k}].desired_speed = None: must be given, in m/s")
