"""Shepherd, and the form of its law: a group as one, its centre, its mean velocity and its farthest member."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
import pytest
import yaml

from flockenv import steering
from flockenv.behaviours import Cohesion, Shepherd
from flockenv.geometry.space import Plane, Torus
from flockenv.jit.decorators import Law, Vec, law
from flockenv.jit.thread_pool import use_threads
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects.effect import EFFECTS, Effect, Me, Members
from flockenv.scene import Group, Scene
from flockenv.steering.vectorize import rows
from tests.catalogue import Array

SIDE = 20.0


def herd(dimension: int = 2, sheep: int = 7, dogs: int = 2, space: Any = None, **fields: Any) -> Scene:
    """Sheep that stand, dogs that drive them, and others of whom nothing is told."""
    low, high = (0.0,) * dimension, (SIDE,) * dimension
    groups = tuple(
        Group(count=count, mass=1.5, max_speed=2, spawn=Spawn(low=low, high=high, speed=(0, 1)))
        for count in (3, sheep, dogs)
    )
    goal = (3.0, 4.0, 5.0)[:dimension]
    drive = Shepherd(weight=4, group=1, goal=goal, spacing=1.2, slow_radius=3)
    return Scene(
        dimension=dimension, groups=groups, effects=(drive, *fields.pop("beside", ())), space=space or Plane(), **fields
    )


def expected(scene: Scene, state: State) -> Array:
    """The accelerations by the law over rows, m/s^2, of a state in which agents 3 to 9 are the sheep."""
    drive: Any = scene.effects[0]
    living = state.alive[0, 3:10]
    sheep, pos, vel = state.pos[0, 3:10][living], state.pos[0], state.vel[0]
    centre = sheep.mean(axis=0)
    farthest = sheep[np.linalg.norm(sheep - centre, axis=1).argmax()]
    n, r = len(sheep), drive.spacing
    goal = np.array(drive.goal)
    place = rows(steering.herd_from)(centre - pos, farthest - pos, goal - pos, r * n ** (2 / 3), r, r * n**0.5)
    wish = rows(steering.arrive)(place, vel, 2.0, drive.slow_radius)
    return np.where(state.alive[0][:, None], drive.weight * wish / 1.5, 0)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("dead", [(), (4, 5, 9)])
def test_it_is_the_law_of_the_place_behind(dimension: int, dead: tuple[int, ...]) -> None:
    scene = herd(dimension)
    state = scene.start(0)
    state.alive[0, list(dead)] = False
    np.testing.assert_allclose(scene.acceleration(state)[0], expected(scene, state), atol=1e-12)


def test_on_a_torus_the_edge_makes_no_difference() -> None:
    """A flock of a few metres over the edge is one flock, wherever the edge is."""
    scene = herd(space=Torus(size=(SIDE, SIDE)))
    state = scene.start(0)
    state.pos[0] = np.random.default_rng(0).uniform(7, 12, (12, 2))
    plain = scene.acceleration(state)[0]
    np.testing.assert_allclose(plain, expected(scene, state), atol=1e-12)
    moved: Any = scene.effects[0]
    over = herd(space=Torus(size=(SIDE, SIDE))).model_copy(
        update={"effects": (moved.model_copy(update={"goal": ((3 + 11) % SIDE, (4 + 9.5) % SIDE)}),)}
    )
    state.pos[0] = (state.pos[0] + (11, 9.5)) % SIDE
    np.testing.assert_allclose(over.acceleration(state)[0], plain, atol=1e-12)


def test_without_living_members_it_asks_for_nothing() -> None:
    scene = herd()
    state = scene.start(0)
    state.alive[0, 3:10] = False
    np.testing.assert_array_equal(scene.acceleration(state), 0)


def test_a_member_at_no_place_is_none_where_accelerations_are_asked_for() -> None:
    scene = herd()
    state = scene.start(0)
    gone = state.copy()
    gone.alive[0, 4] = False
    state.pos[0, 4] = np.nan
    others = np.arange(12) != 4
    np.testing.assert_array_equal(scene.acceleration(state)[0, others], scene.acceleration(gone)[0, others])


def test_one_that_leaves_all_bounds_is_named_though_all_hear_of_it_at_once() -> None:
    scene = herd()
    state = scene.start(0)
    state.vel[0, 6] = np.inf
    with pytest.raises(FloatingPointError, match="agent 6"):
        scene.step(state, steps=3)


@pytest.mark.parametrize("sheep", [20, 300])  # few, and many that are sorted by cell for another effect
def test_threads_calls_and_batches_give_the_same_bits(sheep: int) -> None:
    beside = (Cohesion(weight=1, radius=3),)
    scene = herd(sheep=sheep, dogs=5, beside=beside, space=Torus(size=(SIDE, SIDE)), dtype="float32")
    start = scene.start(3, worlds=2)
    once = scene.run(start, 12)
    one_by_one = start
    for _ in range(12):
        one_by_one = scene.step(one_by_one)
    alone = scene.run(start.worlds([1]), 12)
    try:
        use_threads(2)
        team = scene.run(start.worlds([1]), 12)
    finally:
        use_threads(1)
    np.testing.assert_array_equal(once.pos, one_by_one.pos)
    np.testing.assert_array_equal(once.pos[1], alone.pos[0])
    np.testing.assert_array_equal(once.pos[1], team.pos[0])


@law
def drawn(p: Any, me: Me, flock: Members) -> Vec:
    """The mean velocity of a group, as a force."""
    return flock.vel


class Drawn(Effect):
    """The mean velocity of a group, as a force."""

    kind: Literal["drawn_for_a_test"] = "drawn_for_a_test"
    group_law: ClassVar[Law | None] = drawn

    def members(self, starts: Any) -> dict[str, float]:
        """The second group."""
        return {"first": float(starts[1]), "end": float(starts[2])}


EFFECTS.pop("drawn_for_a_test")


def test_the_mean_velocity_is_that_of_the_living() -> None:
    scene = herd().model_copy(update={"effects": (Drawn(),)})
    state = scene.start(0)
    state.alive[0, 5] = False
    mean = state.vel[0, [3, 4, 6, 7, 8, 9]].mean(axis=0)
    np.testing.assert_allclose(scene.acceleration(state)[0, state.alive[0]], np.tile(mean / 1.5, (11, 1)), atol=1e-12)


def test_the_dog_of_the_demo_drives_its_flock_to_the_place() -> None:
    """From more than 8 m away to within 4 m in 35 s; without the dog the flock stays where it is."""
    assert Shepherd.demo is not None
    scene = Scene.model_validate(yaml.safe_load(Shepherd.demo))
    start = scene.start(0)
    goal, count = np.array((8.0, 3.0)), scene.groups[0].size

    def distance(state: State) -> float:
        return float(np.linalg.norm(state.pos[0, :count].mean(axis=0) - goal))

    idle = scene.model_copy(update={"effects": scene.effects[:2]})
    driven, left = (scene.run(start, round(35 / scene.dt)) for scene in (scene, idle))
    assert distance(start) > 8
    assert distance(driven) < 4
    assert distance(left) > 8
