"""Many obstacles and hard collisions: a grid that skips obstacles out of reach changes no bits of the results."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.geometry.shapes import Block, Circle, HalfSpace, Shape
from flockenv.geometry.space import Box, Plane, Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Collisions, collisions
from flockenv.physics.effects import Gravity
from flockenv.scene import Group, Scene

SIDE = 12.0


def obstacles(dimension: int, seed: int, moving: bool, endless: bool) -> tuple[Shape, ...]:
    """Return round obstacles, blocks that stand or move, a large one, and a half-space if `endless`."""
    rng = np.random.default_rng(seed)
    made: list[Shape] = []
    for k in range(60):
        place = tuple(rng.uniform(0, SIDE, dimension).tolist())
        motion: dict[str, Any] = {"velocity": (0.5,) + (0.0,) * (dimension - 1)} if moving and k % 10 == 1 else {}
        if k % 2:
            made.append(Block(centre=place, size=tuple(rng.uniform(0.2, 1, dimension).tolist()), **motion))
        else:
            made.append(Circle(centre=place, radius=float(rng.uniform(0.1, 0.5))))
    low, up = (0.0,) * dimension, (0.0,) * (dimension - 1) + (1.0,)
    ground = (HalfSpace(point=low, direction=up),) if endless else ()
    return (*made, Circle(centre=(SIDE, *low[1:]), radius=4.0), *ground)


def scene_of(dimension: int, space: Any, response: Any, seed: int, moving: bool) -> Scene:
    down = (*(0.0,) * (dimension - 1), -9.81)
    spawn = Spawn(low=(1,) * dimension, high=(SIDE - 1,) * dimension, speed=(1, 4))
    return Scene(
        dimension=dimension, space=space, groups=(Group(count=60, radius=0.1, spawn=spawn),),
        effects=(Gravity(acceleration=down),),
        constraints=(Collisions(response=response, restitution=0.6),), dt=0.01,
        obstacles=obstacles(dimension, seed, moving, not space.periodic),
    )  # fmt: skip


def digest_of(scene: Scene, seed: int) -> tuple[Any, Any]:
    end = scene.run(scene.start(seed, worlds=2), 40)
    return end.x.copy(), end.v.copy()


@pytest.mark.filterwarnings("ignore::flockenv.core.warnings.UnsolvedContactsWarning")
@pytest.mark.parametrize(
    ("dimension", "space", "response"),
    [
        (2, Plane(), "earliest"),
        pytest.param(2, Torus(size=(SIDE, SIDE)), "impulses", marks=pytest.mark.slow),
        pytest.param(2, Box(size=(SIDE, SIDE)), "back_up", marks=pytest.mark.slow),
        pytest.param(2, Plane(), "project", marks=pytest.mark.slow),
        pytest.param(3, Plane(), "impulses", marks=pytest.mark.slow),
        pytest.param(3, Torus(size=(SIDE,) * 3), "project", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("moving", [False, True])
def test_a_grid_changes_no_bits_of_collisions(
    dimension: int, space: Any, response: str, moving: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in range(4):
        gridded = scene_of(dimension, space, response, seed, moving)
        found = digest_of(gridded, seed)
        with monkeypatch.context() as patch:
            patch.setattr(collisions, "FEWEST_ROWS", 10_000)
            expected = digest_of(scene_of(dimension, space, response, seed, moving), seed)
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_array_equal(found[1], expected[1])
        assert (found[1] != gridded.start(seed, worlds=2).v).any()


def test_circles_that_lie_elsewhere_in_a_world_are_hit_there() -> None:
    """The grid holds only where all worlds have the circles of the scene."""
    scene = scene_of(2, Plane(), "earliest", 1, False)
    state = scene.start(1, worlds=2)
    settled = scene.run(state.copy(), 20)
    state.obstacle_x[:, 1] += 0.7
    moved = scene.run(state, 20)
    np.testing.assert_array_equal(moved.x[:, 0], settled.x[:, 0])
    assert (moved.x[:, 1] != settled.x[:, 1]).any()
    alone = scene.start(2)
    alone.obstacle_x[...] = state.obstacle_x[:, 1:]
    np.testing.assert_array_equal(scene.run(alone, 20).x[:, 0], moved.x[:, 1])
    np.testing.assert_array_equal(scene.run(scene.start(1), 20).x[:, 0], settled.x[:, 0])
