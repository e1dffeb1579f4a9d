"""Many obstacles: a grid that skips those out of reach changes no bits of the results."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import AvoidObstacles, FollowWall, ForceField, Hide, ObstacleRepulsion, Separation, Whiskers
from flockenv.engine import obstacle_sets
from flockenv.geometry.shapes import Block, Capsule, Circle, Shape, Sway
from flockenv.geometry.shapes.cells import cells_of, count_of, list_of, span_of
from flockenv.geometry.space import Box, Plane, Torus
from flockenv.jit.decorators import kernel
from flockenv.jit.section import entry
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import ObstacleContact
from flockenv.physics.effects.effect import Effect
from flockenv.scene import Group, Scene

SIDE = 40.0

EFFECTS: dict[str, tuple[Effect, ...]] = {
    "rays": (AvoidObstacles(weight=8, margin=0.1), Whiskers(weight=4)),
    "all around": (
        AvoidObstacles(weight=8), ForceField(weight=2, range=2), FollowWall(weight=1, distance=0.5, range=3),
        ObstacleRepulsion(strength=3, decay=0.3), ObstacleContact(stiffness=4, damping=0.1),
    ),
    "hidden": (Separation(weight=3, radius=6, occluded=True), ObstacleRepulsion(strength=3, decay=0.3, occluded=True)),
}  # fmt: skip


def places_of(dimension: int) -> tuple[np.random.Generator, list[Any]]:
    """Return 120 places all over a square, and 80 in a corner."""
    rng = np.random.default_rng(3)
    return rng, [*rng.uniform(0, SIDE, (120, dimension)), *rng.uniform(0, 3, (80, dimension))]


def motion_of(k: int, dimension: int) -> dict[str, Any]:
    """Return the motion of obstacle k, as keywords: every tenth moves."""
    amplitude = (1.0,) + (0.0,) * (dimension - 1)
    return {} if k % 10 else {"velocity": amplitude} if k % 20 else {"sway": Sway(amplitude=amplitude, period=3)}


def blocks_and_capsules(dimension: int, moving: bool) -> tuple[Shape, ...]:
    """Return 60 blocks and 60 capsules all over a square, 80 blocks in a corner, and long walls."""
    rng, places = places_of(dimension)
    made: list[Shape] = []
    for k, place in enumerate(places):
        at, end = tuple(place.tolist()), tuple((place + rng.uniform(-1, 1, dimension)).tolist())
        motion = motion_of(k, dimension) if moving else {}
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


def circles(dimension: int, moving: bool) -> tuple[Shape, ...]:
    """Return 120 circles or spheres all over a square, 80 in a corner, and large ones, some beyond its edges."""
    rng, places = places_of(dimension)
    made: list[Shape] = []
    for k, place in enumerate(places):
        motion = motion_of(k, dimension) if moving else {}
        made.append(Circle(centre=tuple(place.tolist()), radius=float(rng.uniform(0.1, 0.5)), **motion))
    large = (3.0, 8.0, 15.0)  # from a few cells to many
    return (*made, *(Circle(centre=(SIDE + 1,) + (r,) * (dimension - 1), radius=r) for r in large))


def scene_of(space: Any, effects: tuple[Effect, ...], dtype: str, obstacles: tuple[Shape, ...]) -> Scene:
    """Return a scene of 60 agents among obstacles."""
    dimension = obstacles[0].dimension
    spawn = Spawn(low=(0,) * dimension, high=(SIDE,) * dimension, speed=(1, 2))
    group = Group(count=60, radius=0.2, max_speed=2, max_force=10, desired_speed=1, spawn=spawn)
    return Scene(
        dimension=dimension, space=space, groups=(group,), effects=effects, dt=0.05, dtype=dtype, obstacles=obstacles
    )


def begun(scene: Scene) -> Any:
    """Return the state of two worlds whose agents lie anywhere, some in obstacles."""
    rng = np.random.default_rng(0)
    state = scene.start(0, worlds=2)
    return state.with_motion(rng.uniform(0, SIDE, state.pos.shape), rng.uniform(-1, 1, state.vel.shape))


def check_equal(found: Any, expected: Any) -> None:
    """Assert that two states have the same positions and velocities, bit for bit."""
    np.testing.assert_array_equal(found.pos, expected.pos)
    np.testing.assert_array_equal(found.vel, expected.vel)


PLANE, SQUARE, CUBE = Plane(), Torus(size=(SIDE, SIDE)), Torus(size=(SIDE,) * 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "space", "dimension", "dtype", "moving"),
    [
        ("rays", PLANE, 2, "float64", True),
        ("all around", SQUARE, 2, "float32", True),
        ("hidden", Box(size=(SIDE, SIDE)), 2, "float64", False),
    ],
)
def test_a_grid_of_obstacles_changes_no_bits(
    name: str, space: Any, dimension: int, dtype: str, moving: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(space, EFFECTS[name], dtype, blocks_and_capsules(dimension, moving))
    found = scene.run(begun(scene), 40)
    assert set(scene.parts.gridded_forms) == {"chain", "block"}
    without_grids(monkeypatch)
    plain = scene_of(space, EFFECTS[name], dtype, blocks_and_capsules(dimension, moving))
    check_equal(found, plain.run(begun(plain), 40))
    assert plain.parts.cells == {}


@pytest.mark.parametrize(
    ("name", "space", "dimension", "dtype", "moving"),
    [
        ("rays", PLANE, 2, "float64", False),
        pytest.param("all around", SQUARE, 2, "float32", True, marks=pytest.mark.slow),
        pytest.param("rays", CUBE, 3, "float32", True, marks=pytest.mark.slow),
        pytest.param("hidden", CUBE, 3, "float64", False, marks=pytest.mark.slow),
    ],
)
def test_a_grid_of_circles_changes_no_bits(
    name: str, space: Any, dimension: int, dtype: str, moving: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(space, EFFECTS[name], dtype, circles(dimension, moving))
    state = begun(scene)
    assert "circle" in scene.parts.gridded_forms and uses_grid(scene, state)
    found = scene.run(state, 40)
    without_grids(monkeypatch)
    plain = scene_of(space, EFFECTS[name], dtype, circles(dimension, moving))
    check_equal(found, plain.run(begun(plain), 40))
    assert plain.parts.cells == {}


@pytest.mark.slow  # two kernels
def test_hide_with_a_range_finds_circles_by_the_grid_with_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """With avoid_obstacles beside it; without a range neither may skip an obstacle."""
    hide = Hide(weight=8, radius=12, slow_radius=1, range=4)
    scene = scene_of(PLANE, (hide, AvoidObstacles(weight=4)), "float64", circles(2, False))
    state = begun(scene)
    assert uses_grid(scene, state)
    found = scene.run(state, 40)
    everywhere = hide.model_copy(update={"range": None})
    assert not scene_of(PLANE, (everywhere, AvoidObstacles(weight=4)), "float64", circles(2, False)).parts.reaches
    without_grids(monkeypatch)
    plain = scene_of(PLANE, scene.effects, "float64", circles(2, False))
    check_equal(found, plain.run(begun(plain), 40))
    assert not uses_grid(plain, state)


@pytest.mark.parametrize("moved", ["centre", "radius"])
def test_circles_that_lie_elsewhere_in_a_world_act_there(moved: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def ends(scene: Scene) -> Any:
        state = begun(scene)
        if moved == "centre":
            state.obstacles.centre[1] = state.obstacles.centre[1, :, ::-1] + 3.0
        else:
            state.obstacle_radius[1, ::2] = 0.0
        assert not uses_grid(scene, state)
        return scene.run(state, 40), scene.rates(state)[0]

    scene = scene_of(PLANE, EFFECTS["rays"], "float64", circles(2, False))
    found, force = ends(scene)
    without_grids(monkeypatch)
    expected, plain_force = ends(scene_of(PLANE, EFFECTS["rays"], "float64", circles(2, False)))
    check_equal(found, expected)
    np.testing.assert_array_equal(force, plain_force)


def uses_grid(scene: Scene, state: Any) -> bool:
    """Return True if the kernels of a scene find the circles of a state by a grid."""
    at = scene.parts.number_plan.circles
    return at >= 0 and bool(scene.stepper.params(state)[at + 2] > 0)


def without_grids(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let scenes that are made from now on loop over all obstacles."""
    monkeypatch.setattr(obstacle_sets, "fewest_rows", lambda form, dimension: 10**9)


@pytest.mark.parametrize(("form", "dimension", "fewest"), [("circle", 2, 16), ("block", 2, 16), ("block", 3, 2)])
def test_a_few_obstacles_have_no_grid(form: str, dimension: int, fewest: int) -> None:
    def forms(count: int) -> tuple[str, ...]:
        at, edges = (1.0,) * dimension, (1.0,) * dimension
        one: Shape = Circle(centre=at, radius=0.3) if form == "circle" else Block(centre=at, size=edges)
        return scene_of(PLANE, EFFECTS["rays"], "float64", (one,) * count).parts.gridded_forms

    assert (forms(fewest - 1), forms(fewest)) == ((), (form,))


@kernel
def listed(table: Any, places: Any, reach: float) -> int:
    """Return the number of entries that a search within `reach` reads, for all places together, (N, 2) m."""
    found = 0
    for i in range(places.shape[0]):
        x, room = (places[i, 0], places[i, 1]), (reach, reach)
        span = span_of(table, 0, x, room)
        for k in range(count_of(span)):
            begin, end = list_of(table, 0, x, span, k)
            found += (end - begin) // 5
    return found


@pytest.mark.parametrize("form", ["circle", "block"])
def test_a_search_reads_as_many_obstacles_among_ten_thousand_as_among_a_hundred(form: str) -> None:
    """One per square metre, whatever their number: the cost of avoiding or hitting them is that of those nearby."""
    rng, read = np.random.default_rng(1), {}
    for count in (100, 1_000, 10_000):
        side = math.sqrt(count)
        shapes: list[Shape] = [
            Circle(centre=at, radius=0.2) if form == "circle" else Block(centre=at, size=(0.3, 0.3))
            for at in map(tuple, rng.uniform(0, side, (count, 2)).tolist())
        ]
        places = rng.uniform(2, side - 2, (1_000, 2))
        read[count] = entry(listed)(cells_of(shapes, range(count)), places, 1.0) / 1_000
    assert 4 < read[100] < 20  # of them 4 to 7 in reach
    assert read[1_000] < 1.5 * read[100] and read[10_000] < 1.5 * read[100]
