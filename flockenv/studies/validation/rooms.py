"""Scenes of rooms, doors, corners and bottlenecks.

All have two groups, each with a floor field to its goal, and differ in numbers alone: a preset's kernel is compiled
once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from flockenv.geometry.cell_list import FEWEST_AGENTS
from flockenv.geometry.shapes import Wall
from flockenv.geometry.targets import Target
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Way
from flockenv.physics.population import Leaving
from flockenv.physics.population.members import Member
from flockenv.scene import Group, Scene
from flockenv.studies.validation.walk import empty_group, people, scene_of, wall

__all__ = [
    "bottleneck",
    "corner",
    "counterflow",
    "door_between",
    "goal_region",
    "group_floor_field",
    "is_empty",
    "many_rooms",
    "public_room",
    "room",
    "straight_corridor",
    "wall_with_doors",
]  # fmt: skip

CLEARANCE, SPACING = 0.3, 0.1
"""m: the distance that floor fields keep from walls, about a body's radius; the spacing of their grids."""

Point = tuple[float, float]


def goal_region(*corners: Point) -> Target:
    """Return a goal: a door by its ends, a box by its corners if neither edge is 0."""
    (x, y), (u, v) = corners
    if x == u or y == v:
        return Target(ends=((x, y), (u, v)))
    return Target(low=(min(x, u), min(y, v)), high=(max(x, u), max(y, v)))


def group_floor_field(group: int, *targets: Target, spacing: float = SPACING) -> Way:
    """Return the floor field of a group, to the nearest of some places around all walls."""
    return Way(group=group, targets=targets, clearance=CLEARANCE, spacing=spacing)


def is_empty(state: State) -> bool:
    """Return True if no agent is left in any world."""
    return not bool(state.alive.any())


def _scene(
    name: str, groups: Sequence[Group], targets: Sequence[Sequence[Target]], walls: Sequence[Wall],
    sinks: Sequence[Member], spacing: float = SPACING, **fields: Any,
) -> Scene:  # fmt: skip
    """Return a scene of two groups, each with its floor field; the second may be one without living agents.

    The empty group has enough slots for the scene to count as large: small and large crowds then share a kernel.
    """
    all_groups, goals = list(groups), [*targets, targets[0]][:2]
    low = groups[0].spawn.low
    assert low is not None
    missing = max(1, FEWEST_AGENTS - sum(group.size for group in groups))
    if len(groups) == 1 or missing > 1:
        all_groups.append(empty_group(name, (low[0] + 0.5, low[1] + 0.5), missing))
    aims = [group_floor_field(k, *targets, spacing=spacing) for k, targets in enumerate(goals)]
    return scene_of(name, all_groups, aims, obstacles=tuple(walls), population=tuple(sinks), **fields)


def wall_with_doors(x: float, low: float, high: float, *doors: tuple[float, float]) -> tuple[Wall, ...]:
    """Return a wall at x from low to high with doors, each from and to a y, m."""
    ends = [low, *(y for door in sorted(doors) for y in door), high]
    return tuple(wall((x, a), (x, b)) for a, b in zip(ends[::2], ends[1::2], strict=True) if b > a)


def room(name: str, count: int, size: Point, door: float, speed: Any = None, seed: int = 0, **fields: Any) -> Scene:
    """Return people in a room whose right wall, at x = 0, has a door in its middle; people 2 m outside are removed.

    A door of 0 m is shut: people push against the wall there.
    """
    wide, high = size[0], size[1] / 2
    walls = (
        wall((0.0, high), (-wide, high), (-wide, -high), (0.0, -high)),
        *wall_with_doors(0.0, -high, high, (-door / 2, door / 2)),
    )  # fmt: skip
    goal = goal_region((2.5, -2.0), (3.5, 2.0)) if door else goal_region((-0.35, -0.5), (-0.35, 0.5))
    changes = {} if speed is None else {"desired_speed": speed}
    group = people(name, count, (-wide + 0.1, -high + 0.1), (-0.3, high - 0.1), **changes)
    out = Leaving(low=(-wide - 1, -high - 1), high=(2.0, high + 1))
    return _scene(name, [group], [[goal]], walls, [out], **fields)


def bottleneck(name: str, width: float, count: int = 150, long: float = 5.0) -> Scene:
    """Return two rooms of 10 x 10 m, one full, a passage of `width` between, and an exit as wide (RiMEA 12)."""
    half, end = width / 2, long + 10.0
    walls = (
        wall((0.0, half), (0.0, 5.0), (-10.0, 5.0), (-10.0, -5.0), (0.0, -5.0), (0.0, -half), (long, -half),
             (long, -5.0), (end, -5.0), (end, -half)),
        wall((0.0, half), (long, half), (long, 5.0), (end, 5.0), (end, half)),
    )  # fmt: skip
    group = people(name, count, (-9.9, -4.9), (-0.3, 4.9))
    out = Leaving(low=(-11.0, -6.0), high=(end + 2, 6.0))
    return _scene(name, [group], [[goal_region((end + 2.5, -2.0), (end + 3.5, 2.0))]], walls, [out])


def corner(name: str, count: int, width: float, arm: float, begin: float) -> Scene:
    """Return people in the first metres of a corridor that turns left; people at the end of the second arm are removed.

    Along x from 0, walls at y = 0 and y = width; then up, to y = width + arm.
    """
    end = arm + width
    walls = (wall((0.0, width), (0.0, 0.0), (end, 0.0), (end, end)), wall((0.0, width), (arm, width), (arm, end)))
    group = people(name, count, (0.1, 0.1), (begin, width - 0.1))
    out = Leaving(low=(-1.0, -1.0), high=(end + 1, end))
    return _scene(name, [group], [[goal_region((arm + 0.5, end + 1.0), (end - 0.5, end + 2.0))]], walls, [out])


def straight_corridor(name: str, count: int, width: float, length: float, begin: float) -> Scene:
    """Return people in the first metres of a straight corridor along x; people at its end are removed."""
    walls = (wall((length, 0.0), (0.0, 0.0), (0.0, width), (length, width)),)
    group = people(name, count, (0.1, 0.1), (begin, width - 0.1))
    out = Leaving(low=(-1.0, -1.0), high=(length, width + 1))
    return _scene(name, [group], [[goal_region((length + 1.0, 0.5), (length + 2.0, width - 0.5))]], walls, [out])


def counterflow(name: str, there: int, back: int) -> Scene:
    """Return two rooms of 10 x 10 m, a corridor of 2 x 10 m between, people with goals in the other (NIST 2.8)."""
    walls = (
        wall((-5.0, 1.0), (-5.0, 5.0), (-15.0, 5.0), (-15.0, -5.0), (-5.0, -5.0), (-5.0, -1.0), (5.0, -1.0),
             (5.0, -5.0), (15.0, -5.0), (15.0, 5.0), (5.0, 5.0), (5.0, 1.0), (-5.0, 1.0)),
    )  # fmt: skip
    groups = [
        people(name, there, (-14.9, -4.9), (-5.3, 4.9)), people(name, 100, (5.3, -4.9), (14.9, 4.9), alive=back),
    ]  # fmt: skip
    sinks = [Leaving(group=0, low=(-16.0, -6.0), high=(7.0, 6.0)), Leaving(group=1, low=(-7.0, -6.0), high=(16.0, 6.0))]
    targets = [[goal_region((8.0, -4.0), (14.0, 4.0))], [goal_region((-14.0, -4.0), (-8.0, 4.0))]]
    return _scene(name, groups, targets, walls, sinks)


def door_between(name: str, each: int, door: float) -> Scene:
    """Return two halves of a room of 16 x 8 m, and people in both that go through a door to the other."""
    walls = (
        wall((-8.0, -4.0), (8.0, -4.0), (8.0, 4.0), (-8.0, 4.0), (-8.0, -4.0)),
        *wall_with_doors(0.0, -4.0, 4.0, (-door / 2, door / 2)),
    )  # fmt: skip
    groups = [people(name, each, (-7.9, -3.9), (-0.6, 3.9)), people(name, each, (0.6, -3.9), (7.9, 3.9))]
    sinks = [Leaving(group=0, low=(-9.0, -5.0), high=(3.0, 5.0)), Leaving(group=1, low=(-3.0, -5.0), high=(9.0, 5.0))]
    targets = [[goal_region((4.0, -3.0), (7.0, 3.0))], [goal_region((-7.0, -3.0), (-4.0, 3.0))]]
    return _scene(name, groups, targets, walls, sinks)


def public_room(name: str, count: int, doors: int) -> Scene:
    """Return people in a room of 30 x 20 m, four doors of 1 m in its long walls, or the lower two (RiMEA 9)."""
    at = (-7.5, 7.5)
    cuts = (-15.0, at[0] - 0.5, at[0] + 0.5, at[1] - 0.5, at[1] + 0.5, 15.0)
    low = tuple(wall((a, -10.0), (b, -10.0)) for a, b in zip(cuts[::2], cuts[1::2], strict=True))
    high = tuple(wall((a, 10.0), (b, 10.0)) for a, b in zip(cuts[::2], cuts[1::2], strict=True))
    if doors == 2:
        high = tuple(wall((a, 10.0), (b, 10.0)) for a, b in ((-15.0, -5.0), (-5.0, 5.0), (5.0, 15.0)))
    sides = (wall((-15.0, -10.0), (-15.0, 10.0)), wall((15.0, -10.0), (15.0, 10.0)))
    targets = [goal_region((x - 2, s * 12.5), (x + 2, s * 13.5)) for s in (-1, 1)[: doors // 2] for x in at]
    group = people(name, count, (-14.9, -9.9), (14.9, 9.9))
    out = Leaving(low=(-16.0, -12.0), high=(16.0, 12.0))
    return _scene(name, [group], [targets], [*low, *high, *sides], [out], spacing=0.15)


def many_rooms(name: str) -> Scene:
    """Return 12 rooms of 4 x 4 m along a corridor with an exit at either end, and 23 people, two in a room.

    Those of the last eight rooms, 15, are to leave by the right exit, those of the others, 8, by the left (RiMEA 10).
    """
    walls: list[Wall] = []
    for side in (-1, 1):
        cuts = [0.0, *(x for k in range(6) for x in (4 * k + 1.55, 4 * k + 2.45)), 24.0]
        walls += [wall((a, side), (b, side)) for a, b in zip(cuts[::2], cuts[1::2], strict=True)]
        walls += [wall((4.0 * k, side * 1.0), (4.0 * k, side * 5.0)) for k in range(7)]
        walls += [wall((0.0, side * 5.0), (24.0, side * 5.0))]
    # cells of 2 m: those in the corridor lie in its walls, all others are a place in a room
    begin = [Spawn(low=(x, -4.0), high=(x + wide, 4.0), spacing=2.0) for x, wide in ((8.0, 16.0), (0.0, 8.0))]
    groups = [
        people(name, count, spawn.low or (), spawn.high or (), spawn=spawn)
        for count, spawn in zip((15, 8), begin, strict=True)
    ]
    targets = [[goal_region((26.0, -1.0), (27.0, 1.0))], [goal_region((-3.0, -1.0), (-2.0, 1.0))]]
    return _scene(name, groups, targets, walls, [Leaving(low=(-1.0, -6.0), high=(25.0, 6.0))])
