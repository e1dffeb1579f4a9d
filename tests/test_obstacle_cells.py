"""Many obstacles: a grid that skips those out of reach changes no bits of the results."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import AvoidObstacles, FollowWall, ForceField, ObstacleRepulsion, Separation, Whiskers
from flockenv.engine import obstacle_sets
from flockenv.geometry.shapes import Block, Capsule, Shape, Sway
from flockenv.geometry.space import Box, Plane, Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.effects.effect import Effect
from flockenv.scene import Group, Scene

SIDE = 40.0

EFFECTS: dict[str, tuple[Effect, ...]] = {
    "rays": (AvoidObstacles(weight=8, margin=0.1), Whiskers(weight=4)),
    "all around": (
        AvoidObstacles(weight=8), ForceField(weight=2, range=2), FollowWall(weight=1, distance=0.5, range=3),
        ObstacleRepulsion(strength=3, decay=0.3),
    ),
    "hidden": (Separation(weight=3, radius=6, occluded=True), ObstacleRepulsion(strength=3, decay=0.3, occluded=True)),
}  # fmt: skip


def crowded(dimension: int, moving: bool) -> tuple[Shape, ...]:
    """Return 60 blocks and 60 capsules all over a square, 80 blocks in a corner, and long walls."""
    rng = np.random.default_rng(3)
    places = [*rng.uniform(0, SIDE, (120, dimension)), *rng.uniform(0, 3, (80, dimension))]
    made: list[Shape] = []
    for k, place in enumerate(places):
        at, end = tuple(place.tolist()), tuple((place + rng.uniform(-1, 1, dimension)).tolist())
        motion: dict[str, Any] = {}
        if moving and k % 10 == 0:
            amplitude = (1.0,) + (0.0,) * (dimension - 1)
            motion = {"velocity": amplitude} if k % 20 else {"sway": Sway(amplitude=amplitude, period=3)}
        if k % 2 and k < 120:
            made.append(Capsule(start=at, end=end, radius=0.1, **motion))
        else:
            size = tuple(rng.uniform(0.2, 1, dimension).tolist())
            made.append(Block(centre=at, size=size, turn=float(rng.uniform(0, 90)), **motion))
    far = (0.0,) * (dimension - 2)
    for reach in (6.0, 12.0, 18.0):  # from a few cells to many
        made.append(Capsule(start=(1.0, 2.0, *far), end=(1.0 + reach, 2.0 + reach / 2, *far), radius=0.1))
        made.append(Block(centre=(SIDE - 1, reach / 2, *far), size=(0.5, reach, *(1.0 for _ in far)), turn=10.0))
    return tuple(made)


def ends(space: Any, effects: tuple[Effect, ...], dimension: int, dtype: str, moving: bool) -> Any:
    """Return positions and velocities of 60 agents in two worlds after 40 steps."""
    spawn = Spawn(low=(0,) * dimension, high=(SIDE,) * dimension, speed=(1, 2))
    group = Group(count=60, radius=0.2, max_speed=2, max_force=10, desired_speed=1, spawn=spawn)
    scene = Scene(
        dimension=dimension, space=space, groups=(group,), effects=effects, dt=0.05, dtype=dtype,
        obstacles=crowded(dimension, moving),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    state = scene.start(0, worlds=2)
    state = state.with_motion(rng.uniform(0, SIDE, state.pos.shape), rng.uniform(-1, 1, state.vel.shape))
    state = scene.run(state, 40)
    return state.pos, state.vel


@pytest.mark.parametrize(
    ("name", "space", "dimension", "dtype", "moving"),
    [
        ("rays", Plane(), 2, "float64", True),
        ("all around", Torus(size=(SIDE, SIDE)), 2, "float32", True),
        ("rays", Torus(size=(SIDE, SIDE)), 2, "float32", False),
        pytest.param("hidden", Box(size=(SIDE, SIDE)), 2, "float64", False, marks=pytest.mark.slow),
        pytest.param("rays", Torus(size=(SIDE,) * 3), 3, "float32", False, marks=pytest.mark.slow),
    ],
)
def test_a_grid_of_obstacles_changes_no_bits(
    name: str, space: Any, dimension: int, dtype: str, moving: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = ends(space, EFFECTS[name], dimension, dtype, moving)
    monkeypatch.setattr(obstacle_sets, "FEWEST_ROWS", 10**9)  # no grid: loop over all obstacles
    expected = ends(space, EFFECTS[name], dimension, dtype, moving)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])
