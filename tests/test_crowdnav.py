"""CrowdNav: visibility, rewards, ends of episodes, and whether players reach the goal."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.evaluation import rollout, worlds_for
from flockenv.players import WEIGHTS
from flockenv.players.policy import MlpPolicy
from flockenv.players.rules import player
from flockenv.tasks import CrowdNav
from tests.test_tasks import act, paid, place, random_actions, world_of


def meeting(offset: Any, velocity: Any = (0.0, 0.0), **more: Any) -> World:
    """Return a world: the robot 3 m before its goal, a pedestrian at its own goal, and one far away.

    Vectors are (along, left).
    """
    world = world_of(CrowdNav(people=2, **more))
    goal, course = world._memory[:2, 0, 0].copy(), world._memory[2:4, 0, 0].copy()
    axes = np.array([course, [-course[1], course[0]]])
    robot = goal - 3.0 * course
    pos = np.stack([robot, robot + np.array(offset) @ axes, robot + 60.0 * course])
    place(world, pos, np.stack([np.array(velocity) @ axes, [0.0, 0.0], [0.0, 0.0]]))
    world.state.inner[:, 0] = pos.T
    return world


def test_agents_start_on_a_circle_opposite_their_goals() -> None:
    world = world_of(CrowdNav(), worlds=20)
    pos, goal = world.state.pos, world._memory[:2].transpose(1, 2, 0)
    np.testing.assert_allclose(goal[:, 0], -pos[:, 0])
    np.testing.assert_allclose(world.state.inner.transpose(1, 2, 0)[:, 1:], -pos[:, 1:])
    np.testing.assert_allclose(np.linalg.norm(pos, axis=2), 6, rtol=0.02)
    gaps = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=3) + 1e9 * np.eye(11)
    assert gaps.min() > 0.8
    assert not world.state.vel.any()


def test_progress_is_rewarded_and_time_costs() -> None:
    world = meeting((0, 30), (1, 0))
    terms = paid(world, act(world))
    expected = {"progress": 0.5 * 0.1, "success": 0, "collision": 0, "discomfort": 0, "time": -0.02}
    assert terms == pytest.approx(expected, abs=1e-9)


def test_discomfort_cost_is_proportional_to_its_depth_and_duration() -> None:
    """Bodies of 0.3 m and 0.25 m, 0.65 m apart: the gap is 0.1 m too small for 0.1 s."""
    world = meeting((0, 0.65))
    step = act(world)
    assert paid(world, step)["discomfort"] == pytest.approx(-10 * 0.1 * 0.1)
    assert not step.terminated.any()
    measured = world.measure()
    assert measured["discomfort"] == 1
    assert measured["least_gap"] == pytest.approx(0.1)
    act(world, (-1, 0))
    world = meeting((0, 0.76))
    assert paid(world, act(world))["discomfort"] == 0
    assert world.measure()["discomfort"] == 0


def test_collision_within_a_decision_ends_the_episode() -> None:
    world = meeting((0.067, 0.549), (1.34, 0))  # 0.553 m apart before and after, 0.549 m between
    step = act(world)
    terms = paid(world, step)
    assert terms["collision"] == -5
    assert terms["discomfort"] == 0
    assert step.terminated.all()
    assert not step.success.any()
    assert world.measure()["collided"] == 1
    assert world.measure()["timed_out"] == 0
    assert world.measure()["least_gap"] == pytest.approx(-0.001, abs=1e-6)
    world = meeting((0.067, 0.551), (1.34, 0))
    assert not act(world).terminated.any()


def test_goal_ends_the_episode_with_success_unless_there_is_a_collision() -> None:
    for beside, success in ((5.0, True), (0.45, False)):
        world = meeting((0, 5.0), (1, 0))
        goal, course = world._memory[:2, 0, 0].copy(), world._memory[2:4, 0, 0].copy()
        world.state.pos[0, 0] = goal - 0.35 * course
        world.state.pos[0, 1] = goal + beside * np.array([-course[1], course[0]])
        world.state.inner[:, 0, 1] = world.state.pos[0, 1]
        step = act(world)
        assert step.terminated.all()
        assert step.success.all() == success
        assert paid(world, step)["success"] == (20 if success else 0)
        assert paid(world, step)["collision"] == (0 if success else -5)
        assert world.measure()["time_to_goal"] == pytest.approx(0.1) if success else world.measure()["collided"] == 1


def test_episode_without_arrival_or_collision_has_timed_out() -> None:
    world = meeting((0, 30), (0, 1))
    for _ in range(5):
        act(world)
    assert world.measure()["timed_out"] == 1
    assert world.measure()["path_length"] == pytest.approx(0.5)
    assert np.isnan(world.measure()["time_to_goal"])


def crowds(**fields: Any) -> list[np.ndarray]:
    """Return positions of the crowd after 8 s, with a robot at rest and with one that walks through it."""
    found = []
    for action in ((0.0, 0.0), (0.4, 0.1)):
        world = World(CrowdNav(**fields), 4)
        world.reset(5)
        for _ in range(80):
            world.step(np.broadcast_to(np.array(action), (4, 1, 2)))
        found.append(world.state.pos[:, 1:].copy())
    return found


@pytest.mark.slow
def test_crowd_reacts_to_a_visible_robot_only() -> None:
    still, through = crowds()
    np.testing.assert_array_equal(still, through)
    still, through = crowds(visible=True)
    assert np.abs(still - through).max() > 0.05


def test_rewards_do_not_change_the_motion() -> None:
    free = {name: 0.0 for name in CrowdNav.model_fields if name.endswith(("_reward", "_cost"))}
    assert len(free) == 5
    worlds = world_of(CrowdNav()), world_of(CrowdNav(**free))
    for actions in random_actions(worlds[0], 60):
        for world in worlds:
            step = world.step(actions)
        assert not step.reward.any()
    np.testing.assert_array_equal(worlds[0].state.pos, worlds[1].state.pos)


def test_observation_is_in_the_frame_of_the_robot_s_course() -> None:
    world = world_of(CrowdNav())
    for _ in range(35):
        step = act(world, (0.3, 0.1))
    seen, s, task = world.task.layout.unpack(step.observation[0]), world.state, CrowdNav()
    along = world._memory[2:4, 0, 0]
    axes = np.array([along, [-along[1], along[0]]]).T
    offset = s.pos[0, 1:] - s.pos[0, 0]
    distance = np.linalg.norm(offset, axis=1)
    order = np.argsort(distance)[: task.neighbours]
    order = order[distance[order] < task.sight]
    n = len(order)
    assert n > 2
    np.testing.assert_allclose(seen.velocity[0], s.vel[0, 0] @ axes, atol=1e-5)
    np.testing.assert_allclose(seen.goal[0], (world._memory[:2, 0, 0] - s.pos[0, 0]) @ axes, atol=1e-5)
    np.testing.assert_allclose(seen.neighbours[0, :n], offset[order] @ axes, atol=1e-5)
    relative = (s.vel[0, 1:][order] - s.vel[0, 0]) @ axes
    np.testing.assert_allclose(seen.neighbour_velocity[0, :n], relative, atol=1e-5)
    close = np.clip(1 - (distance[order] - 0.55) / task.near, 0, 1) / distance[order]
    np.testing.assert_allclose(seen.crowding[0, :n], (offset[order] @ axes) * close[:, None], atol=1e-5)
    np.testing.assert_array_equal(seen.neighbour_present[0], [1] * n + [0] * (task.neighbours - n))


def test_crowd_crosses_without_deep_overlap() -> None:
    world = World(CrowdNav(), 32)
    world.reset(1)
    least, rest = np.full(32, 9.0), np.zeros((32, 1, 2))
    for _ in range(250):
        world.step(rest)
        pos = world.state.pos[:, 1:]
        gaps = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=3) + 9 * np.eye(10)
        least = np.minimum(least, gaps.min(axis=(1, 2)))
    left = np.linalg.norm(world.state.inner.transpose(1, 2, 0)[:, 1:] - world.state.pos[:, 1:], axis=2)
    assert (left < 0.5).mean() > 0.85
    assert np.median(least) > 0.35  # bodies are 0.5 m wide: shoulders brush


def test_orca_and_the_shipped_policy_reach_the_goal_and_social_force_does_not() -> None:
    """The crowd does not see the robot, so the social force model, which relies on mutual avoidance, collides."""
    task, first = CrowdNav(), worlds_for("tuning", 7, 48)
    players = {
        "force": player(task, name="textbook"),
        "heuristics": player(task, name="heuristics"),
        "orca": player(task, name="orca"),
        "ppo": MlpPolicy.load(WEIGHTS / "crowd_nav.safetensors", task),
    }
    success = {name: rollout(task, player, 48, first).success.mean() for name, player in players.items()}
    assert success["force"] < 0.3
    assert success["orca"] > 0.5
    assert success["ppo"] > 0.9


@pytest.mark.parametrize(
    ("fields", "message"),
    [({"people": 0}, "people = 0"), ({"people": 60}, "circle = 6"), ({"crowd": "helbing"}, "crowd = 'helbing'")],
)
def test_invalid_fields_are_refused_in_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        CrowdNav(**fields)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
