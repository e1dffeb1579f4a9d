"""The task Herd: sheep that flee or graze, rewards, the end of an episode, and observations of dogs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import Step, World
from flockenv.tasks import Herd

PEN = np.array([30.0, 30.0])


def scene(dogs: Any, sheep: Any, **fields: Any) -> World:
    """Return a world with all agents at rest at the given positions and the pen in the middle."""
    dogs, sheep = np.atleast_2d(dogs), np.atleast_2d(sheep)
    world = World(Herd(dogs=len(dogs), sheep=len(sheep), **fields))
    world.reset(3)
    world.state.pos[0], world.state.vel[0] = np.concatenate([dogs, sheep]), 0.0
    world._memory[:, 0] = PEN[:, None]
    return world


def act(world: World, action: Any = 0.0) -> Step:
    return world.step(np.broadcast_to(np.asarray(action, float), (1, world.learners, 2)))


def paid(world: World, step: Step, dog: int = 0) -> dict[str, float]:
    return dict(zip(world.task.terms, step.terms[0, dog].tolist(), strict=True))


def flock(middle: Any, count: int = 12, spacing: float = 1.5) -> Any:
    """Return positions of sheep on a square lattice around a point."""
    k = np.arange(count)
    return np.asarray(middle) + spacing * np.stack([k % 4 - 1.5, k // 4 - (count // 4 - 1) / 2], axis=1)


def test_sheep_flee_from_a_dog_within_the_fear_distance_and_graze_otherwise() -> None:
    for distance, scared in ((5.0, True), (12.0, False)):
        world = scene((10.0 - distance, 10.0), flock((10.0, 10.0), spacing=1.2), error=0.0, attraction=0.0)
        for _ in range(10):
            world.state.pos[0, 0], world.state.vel[0, 0] = (10.0 - distance, 10.0), 0.0
            act(world)
        speeds = np.linalg.norm(world.state.vel[0, 1:], axis=1)
        assert (speeds.mean() > 1.5) == scared
        assert (speeds.max() <= 0.5) == (not scared)
        if scared:
            assert world.state.vel[0, 1:, 0].mean() > 1.0  # away from the dog


def test_a_scared_flock_contracts_and_a_grazing_flock_keeps_its_spread() -> None:
    """The mean distance from the centre shrinks as a dog comes (the selfish herd), and stays about the same without."""
    spreads = {}
    for dog in ((4.0, 20.0), (-50.0, 20.0)):
        world = scene(dog, flock((10.0, 20.0), spacing=3.0))
        for _ in range(40):
            act(world)
        spreads[dog] = float(world.measure()["spread"][0])
    first = np.linalg.norm(flock((0.0, 0.0), spacing=3.0), axis=1).mean()
    assert spreads[4.0, 20.0] < 0.75 * first
    assert spreads[-50.0, 20.0] == pytest.approx(first, rel=0.15)


def test_sheep_keep_their_distance_from_each_other() -> None:
    world = scene((0.0, 10.0), flock((6.0, 10.0), spacing=0.8))
    for _ in range(60):
        world.state.pos[0, 0] = world.state.pos[0, 1:].mean(axis=0) - [6.0, 0.0]
        act(world)
    sheep = world.state.pos[0, 1:]
    gaps = np.linalg.norm(sheep[:, None] - sheep, axis=2) + 1e9 * np.eye(12)
    assert np.median(gaps.min(axis=1)) > 0.6


def test_progress_and_gathering_are_rewarded_per_metre_and_time_costs_per_second() -> None:
    world = scene((15.0, 30.0), flock((20.0, 30.0)))
    here = world.state.pos[0, 1:].copy()
    step = act(world)
    there = world.state.pos[0, 1:]
    nearer = np.linalg.norm(PEN - here.mean(axis=0)) - np.linalg.norm(PEN - there.mean(axis=0))
    spread = [np.linalg.norm(sheep - sheep.mean(axis=0), axis=1).mean() for sheep in (here, there)]
    terms = paid(world, step)
    assert terms["progress"] == pytest.approx(0.5 * nearer, rel=1e-9)
    assert terms["gathering"] == pytest.approx(0.5 * (spread[0] - spread[1]), rel=1e-9)
    assert terms["time"] == pytest.approx(-0.02)
    assert terms["success"] == 0
    assert nearer > 0


def test_the_episode_ends_only_with_all_sheep_in_the_pen() -> None:
    inside = flock(PEN, spacing=1.1)
    world = scene((50.0, 50.0), inside)
    step = act(world)
    assert step.terminated.all()
    assert step.success.all()
    assert paid(world, step)["success"] == 10
    assert world.measure()["share_penned"] == 1
    assert world.measure()["time_to_pen"] == pytest.approx(0.1)
    inside[0] = (34.3, 30.0)
    world = scene((50.0, 50.0), inside)
    step = act(world)
    assert not step.terminated.any()
    assert not step.success.any()
    assert world.measure()["share_penned"] == pytest.approx(11 / 12)
    assert np.isnan(world.measure()["time_to_pen"])


def test_all_dogs_get_the_same_reward() -> None:
    world = scene([(15.0, 30.0), (15.0, 32.0), (15.0, 28.0)], flock((20.0, 30.0)))
    for _ in range(20):
        step = act(world, (1.0, 0.3))
        np.testing.assert_array_equal(step.terms[0, 0], step.terms[0, 1])
        np.testing.assert_array_equal(step.terms[0, 0], step.terms[0, 2])


def test_a_dog_observes_offsets_in_the_frame_of_the_flocks_course() -> None:
    dogs = np.array([(12.0, 20.0), (25.0, 12.0)])
    world = scene(dogs, flock((18.0, 24.0)))
    for _ in range(5):
        step = act(world, (0.4, -0.6))
    s, see = world.state, world.task.layout.unpack(step.observation[0])
    sheep = s.pos[0, 2:]
    centre = sheep.mean(axis=0)
    along = (PEN - centre) / np.linalg.norm(PEN - centre)
    axes = np.array([along, [-along[1], along[0]]]).T
    far = np.linalg.norm(sheep - centre, axis=1)
    for i in range(2):
        here = s.pos[0, i]
        np.testing.assert_allclose(see.velocity[i], s.vel[0, i] @ axes, atol=1e-5)
        np.testing.assert_allclose(see.goal[i], (PEN - here) @ axes, atol=1e-5)
        np.testing.assert_allclose(see.centre[i], (centre - here) @ axes, atol=1e-5)
        np.testing.assert_allclose(see.farthest[i], (sheep[far.argmax()] - here) @ axes, atol=1e-5)
        np.testing.assert_allclose(see.mates[i, 0], (s.pos[0, 1 - i] - here) @ axes, atol=1e-5)
        order = np.argsort(np.linalg.norm(sheep - here, axis=1))[:6]
        np.testing.assert_allclose(see.sheep[i], (sheep[order] - here) @ axes, atol=1e-5)
        np.testing.assert_allclose(see.sheep_velocity[i], s.vel[0, 2:][order] @ axes, atol=1e-5)
    np.testing.assert_allclose(see.spread, far.mean(), atol=1e-5)
    np.testing.assert_allclose(see.stray, far.max(), atol=1e-5)


def test_observations_and_rewards_do_not_change_if_the_field_is_rotated() -> None:
    """The field turns by 90 degrees; noise and grazing are off, since they do not turn with it."""
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    dog, sheep = np.array([16.0, 27.0]), flock((21.0, 33.0))
    world = scene(dog, sheep, error=0.0, graze_speed=0.0)
    turned = scene((dog - PEN) @ quarter.T + PEN, (sheep - PEN) @ quarter.T + PEN, error=0.0, graze_speed=0.0)
    for k in range(25):
        action = (np.cos(0.3 * k), np.sin(0.2 * k))
        ours, theirs = act(turned, action), act(world, action)
        np.testing.assert_allclose(ours.observation, theirs.observation, atol=2e-5)
        np.testing.assert_allclose(ours.terms, theirs.terms, atol=1e-8)


def test_the_flock_starts_away_from_the_pen_and_dogs_beyond_the_fear_distance() -> None:
    world = World(Herd(dogs=3), 100)
    world.reset(3)
    s = world.state
    pen, dogs, sheep = world._memory[:2, :, 0].T, s.pos[:, :3], s.pos[:, 3:]
    assert np.linalg.norm(sheep.mean(axis=1) - pen, axis=1).min() > 15.0 - 6.0
    assert np.linalg.norm(dogs[:, :, None] - sheep[:, None], axis=3).min() >= 8.0
    assert not s.vel.any()


@pytest.mark.parametrize(
    ("fields", "message"), [({"away": 25.0}, "away = 25"), ({"dogs": 4}, "dogs = 4"), ({"sheep": 1}, "sheep = 1")]
)
def test_invalid_fields_are_refused_in_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Herd(**fields)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
