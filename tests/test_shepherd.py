"""Shepherd and group laws: laws of the centre, the mean velocity and the farthest member of a group."""

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
    """Return a scene of three groups, all of which drive group 1, the sheep."""
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
    """Return the accelerations by the vectorized law, m/s^2, if agents 3 to 9 are the sheep."""
    drive: Any = scene.effects[0]
    living = state.alive[0, 3:10]
    sheep, pos, vel = state.pos[0, 3:10][living], state.pos[0], state.vel[0]
    centre = sheep.mean(axis=0)
    farthest = sheep[np.linalg.norm(sheep - centre, axis=1).argmax()]
    n, r = len(sheep), drive.spacing
    goal = np.array(drive.goal)
    place = rows(steering.herding_offset)(centre - pos, farthest - pos, goal - pos, r * n ** (2 / 3), r, r * n**0.5)
    change = rows(steering.arrive)(place, vel, 2.0, drive.slow_radius)
    return np.where(state.alive[0][:, None], drive.weight * change / 1.5, 0)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("dead", [(), (4, 5, 9)])
def test_accelerations_are_those_of_the_vectorized_law(dimension: int, dead: tuple[int, ...]) -> None:
    scene = herd(dimension)
    state = scene.start(0)
    state.alive[0, list(dead)] = False
    np.testing.assert_allclose(scene.acceleration(state)[0], expected(scene, state), atol=1e-12)


def test_forces_do_not_depend_on_the_seam_of_a_torus() -> None:
    """A group of a few metres across the seam is one group."""
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


def test_the_force_is_zero_without_living_members() -> None:
    scene = herd()
    state = scene.start(0)
    state.alive[0, 3:10] = False
    np.testing.assert_array_equal(scene.acceleration(state), 0)


def test_acceleration_ignores_a_member_whose_position_is_nan() -> None:
    scene = herd()
    state = scene.start(0)
    gone = state.copy()
    gone.alive[0, 4] = False
    state.pos[0, 4] = np.nan
    others = np.arange(12) != 4
    np.testing.assert_array_equal(scene.acceleration(state)[0, others], scene.acceleration(gone)[0, others])


def test_a_diverged_member_is_named_although_it_enters_all_forces() -> None:
    scene = herd()
    state = scene.start(0)
    state.vel[0, 6] = np.inf
    with pytest.raises(FloatingPointError, match="agent 6"):
        scene.step(state, steps=3)


@pytest.mark.slow
@pytest.mark.parametrize("sheep", [20, 300])  # with 300, another effect sorts them by cell
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
        threaded = scene.run(start.worlds([1]), 12)
    finally:
        use_threads(1)
    np.testing.assert_array_equal(once.pos, one_by_one.pos)
    np.testing.assert_array_equal(once.pos[1], alone.pos[0])
    np.testing.assert_array_equal(once.pos[1], threaded.pos[0])


@law
def drawn(p: Any, me: Me, flock: Members) -> Vec:
    """Return the mean velocity of a group as a force."""
    return flock.vel


class Drawn(Effect):
    """The mean velocity of a group, as a force."""

    kind: Literal["drawn_for_a_test"] = "drawn_for_a_test"
    group_law: ClassVar[Law | None] = drawn

    def members(self, starts: Any) -> dict[str, float]:
        """Return the range of the second group."""
        return {"first": float(starts[1]), "end": float(starts[2])}


EFFECTS.pop("drawn_for_a_test")


def test_the_mean_velocity_of_a_group_excludes_dead_members() -> None:
    scene = herd().model_copy(update={"effects": (Drawn(),)})
    state = scene.start(0)
    state.alive[0, 5] = False
    mean = state.vel[0, [3, 4, 6, 7, 8, 9]].mean(axis=0)
    np.testing.assert_allclose(scene.acceleration(state)[0, state.alive[0]], np.tile(mean / 1.5, (11, 1)), atol=1e-12)


@pytest.mark.slow
def test_the_demo_s_shepherd_drives_its_group_to_the_goal() -> None:
    """From more than 8 m away to within 4 m in 35 s; without the shepherd the group stays more than 8 m away."""
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
