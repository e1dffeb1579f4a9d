"""Bottleneck: pressure, rewards, agents that leave, and whether players get all agents out unhurt."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.evaluation import rollout, worlds_for
from flockenv.players import WEIGHTS
from flockenv.players.policy import MlpPolicy, RandomPolicy
from flockenv.players.rules import player
from flockenv.tasks import Bottleneck
from tests.test_tasks import act, paid, place, random_actions, world_of

ROUND = 2 * np.pi * 0.25  # m
K = 1.2e5  # N/m


def room(places: Any, velocities: Any = 0.0, **more: Any) -> World:
    world = world_of(Bottleneck(people=len(places), **more))
    place(world, np.array(places, float), velocities)
    return world


def test_people_begin_away_from_the_door_without_overlap() -> None:
    world = World(Bottleneck(), 100)
    world.reset(3)
    pos = world.state.pos
    assert pos[..., 0].max() < 4.5 - 0.25 + 1e-9
    assert pos.min() >= 0.25
    assert pos[..., 1].max() <= 5.75
    gaps = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=3) + 9 * np.eye(20)
    assert gaps.min() >= 0.5


def test_progress_is_rewarded_and_time_costs() -> None:
    world = room([(3.0, 3.0), (1.0, 1.0)], [(1.0, 0.0), (0.0, 0.0)])
    step = act(world)
    assert paid(world, step) == pytest.approx({"progress": 0.05, "out": 0, "pressed": 0, "hurt": 0, "time": -0.05})
    assert paid(world, step, 1) == pytest.approx({"progress": 0, "out": 0, "pressed": 0, "hurt": 0, "time": -0.05})


def pressures(world: World) -> np.ndarray:
    """Return the elastic forces of neighbours and of the wall with the door, over the circumference, N/m."""
    pos = world.state.pos[0]
    overlap = np.clip(0.5 - np.linalg.norm(pos[:, None] - pos, axis=2), 0, None) - 0.5 * np.eye(len(pos))
    wall = 6.0 - pos[:, 0]
    beside = np.abs(pos[:, 1] - 3.0)
    gap = np.where(beside < 0.5, np.hypot(wall, 0.5 - beside), np.abs(wall))
    return K * (overlap.sum(axis=1) + np.clip(0.25 - gap, 0, None)) / ROUND


def test_pressure_is_force_over_circumference_and_hurts_above_a_limit() -> None:
    """Three agents in a row push each other into the wall, with 600 N each."""
    world = room([(5.76, 1.0), (5.28, 1.0), (4.80, 1.0), (1.0, 5.0)])
    hurt = 0.0
    for _ in range(10):
        step = act(world, (1.0, 0.0))
        expected = pressures(world)
        for i in range(4):
            terms = paid(world, step, i)
            assert terms["pressed"] == pytest.approx(-2 * 0.1 * min(expected[i] / 1600, 1), rel=1e-9)
            assert terms["hurt"] == (-5 if expected[i] > 1600 else 0)
        hurt += 0.1 * np.mean(expected > 1600)
    assert expected[0] == pytest.approx((3 * 600 + 2 * 600) / ROUND, rel=0.05)  # the wall, and both agents behind
    assert expected[2] == pytest.approx(600 / ROUND, rel=0.05)
    assert world.measure()["hurt_time"] == pytest.approx(hurt)
    assert world.measure()["most_pressure"] >= expected.max()
    assert hurt > 0.1


def test_a_door_post_exerts_pressure() -> None:
    world = room([(6.0, 2.72), (1.0, 5.0)])  # 0.22 m from the post at (6, 2.5)
    world.state.vel[...] = 0
    act(world)
    assert world.measure()["most_pressure"] == pytest.approx(pressures(world)[0])


def leaving(**more: Any) -> World:
    """Return a world of two agents at the door, one behind the other, and one far away."""
    return room([(6.15, 3.0), (5.3, 3.0), (1.0, 1.0)], [(1.5, 0), (1.5, 0), (0, 0)], **more)


def test_an_agent_through_the_door_leaves_and_gets_no_more_reward() -> None:
    world = leaving()
    step = act(world)
    assert paid(world, step)["out"] == 5
    np.testing.assert_array_equal(step.terminated, [[True, False, False]])
    np.testing.assert_array_equal(world.state.alive, [[False, True, True]])
    assert not step.success.any()
    for _ in range(6):
        step = act(world)
        assert not step.terms[0, 0].any()
    np.testing.assert_array_equal(step.terminated, [[True, True, False]])
    measured = world.measure()
    assert measured["share_out"] == pytest.approx(2 / 3)
    assert measured["specific_flow"] == pytest.approx(1 / 0.6)  # 0.6 s between the two, a door of 1 m
    assert np.isnan(measured["evacuation_time"])
    world.state.pos[0, 2] = (6.2, 3.0)
    world.state.vel[0, 2] = (1.5, 0.0)
    step = act(world)
    assert step.terminated.all()
    assert step.success.all()
    assert world.measure()["evacuation_time"] == pytest.approx(0.8)


def test_together_only_delays_termination_until_all_agents_are_out() -> None:
    world, waiting = leaving(), leaving(together=True)
    for _ in range(5):
        one, other = act(world, (0.3, 0.1)), act(waiting, (0.3, 0.1))
        np.testing.assert_array_equal(one.terms, other.terms)
        np.testing.assert_array_equal(world.state.pos[:, 1:], waiting.state.pos[:, 1:])
        assert not other.terminated.any()
        assert not other.observation[0, 0].any()
    waiting.state.pos[0, 1:] = (6.2, 2.9), (6.2, 3.5)
    waiting.state.vel[0, 1:] = (1.5, 0.0)
    step = act(waiting)
    assert step.terminated.all()
    assert step.success.all()


def test_the_observation_matches_the_state() -> None:
    world = world_of(Bottleneck())
    for actions in random_actions(world, 25):
        step = world.step(actions)
    see, s, task = world.task.layout.unpack(step.observation[0]), world.state, Bottleneck()
    np.testing.assert_allclose(see.pressure, np.minimum(pressures(world), 1600), rtol=1e-4, atol=1e-2)
    for i in range(20):
        offset = s.pos[0] - s.pos[0, i]
        distance = np.linalg.norm(offset, axis=1)
        distance[i] = np.inf
        order = np.argsort(distance)[: task.neighbours]
        order = order[distance[order] < task.sight]
        n = len(order)
        np.testing.assert_allclose(see.velocity[i], s.vel[0, i], atol=1e-5)
        np.testing.assert_allclose(see.door[i], [6, 3] - s.pos[0, i], atol=1e-5)
        np.testing.assert_allclose(see.door_near[i], np.clip([6, 3] - s.pos[0, i], -1.5, 1.5), atol=1e-5)
        np.testing.assert_allclose(see.to_sides[i], [s.pos[0, i, 1], 6 - s.pos[0, i, 1]], atol=1e-5)
        np.testing.assert_allclose(see.neighbours[i, :n], offset[order], atol=1e-5)
        np.testing.assert_allclose(see.neighbour_velocity[i, :n], s.vel[0, order] - s.vel[0, i], atol=1e-5)
        close = np.clip(1 - (distance[order] - 0.5) / task.near, 0, 1) / distance[order]
        np.testing.assert_allclose(see.crowding[i, :n], offset[order] * close[:, None], atol=1e-5)
        np.testing.assert_array_equal(see.neighbour_present[i], [1] * n + [0] * (task.neighbours - n))


def test_rewards_do_not_change_the_motion() -> None:
    free = {name: 0.0 for name in Bottleneck.model_fields if name.endswith(("_reward", "_cost"))}
    assert len(free) == 5
    worlds = world_of(Bottleneck()), world_of(Bottleneck(**free))
    for actions in random_actions(worlds[0], 40):
        for world in worlds:
            step = world.step(actions)
        assert not step.reward.any()
    np.testing.assert_array_equal(worlds[0].state.pos, worlds[1].state.pos)


def test_no_agent_passes_through_the_wall() -> None:
    world = world_of(Bottleneck(), worlds=8)
    for k in range(60):
        world.step(np.broadcast_to([1.0, 1.0 if k % 20 < 10 else -1.0], (8, 20, 2)))
        pos, inside = world.state.pos, world.state.alive
        beyond = (pos[..., 0] > 6.05) & inside
        assert (np.abs(pos[..., 1] - 3.0)[beyond] < 0.5).all()


def test_queueing_gets_all_agents_out_and_hurts_less_than_pushing() -> None:
    task, first = Bottleneck(together=True), worlds_for("tuning", 7, 12)
    players = {
        "random": RandomPolicy(2, 0),
        "force": player(task, name="textbook"),
        "queueing": player(task, name="queueing"),
        "ppo": MlpPolicy.load(WEIGHTS / "bottleneck.safetensors", task),
    }
    episodes = {name: rollout(task, player, 12, first) for name, player in players.items()}
    out = {name: played.metrics["share_out"].mean() for name, played in episodes.items()}
    assert out["random"] < 0.4
    assert min(out["force"], out["queueing"], out["ppo"]) > 0.9
    assert episodes["queueing"].success.mean() > 0.8
    assert episodes["force"].metrics["hurt_time"].mean() > episodes["queueing"].metrics["hurt_time"].mean()


def test_scripted_people_get_out() -> None:
    world = World(Bottleneck(people=8, learners=1), 8)
    world.reset(2)
    for _ in range(200):
        world.step(np.broadcast_to([-0.2, 0.0], (8, 1, 2)))
    assert world.state.alive[:, 1:].mean() < 0.1


@pytest.mark.parametrize(
    ("fields", "message"),
    [({"people": 0}, "people = 0"), ({"people": 200}, "people = 200"), ({"width": 6.0}, "width = 6"),
     ({"clear": 5.5}, "clear = 5.5"), ({"people": 4, "learners": 5}, "learners = 5")],
)  # fmt: skip
def test_invalid_fields_are_refused_in_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Bottleneck(**fields)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
