"""Crossing: rewards, measures and observations of hand-made states, and scripted and hand-written walkers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.evaluation import rollout, worlds_for
from flockenv.players.rules import player
from flockenv.tasks import Crossing, Flock
from tests.test_tasks import act, paid, place, random_actions, world_of


def walk(gap: float, first: Any, second: Any, **more: Any) -> tuple[World, dict[str, float], dict[str, float]]:
    """Return a world after one step of two walkers in the middle, `gap` m apart, and their rewards.

    first, second: velocities (along, left).
    """
    world = world_of(Crossing(agents=2, jitter=0.0, **more))
    course = world._memory[2:4, 0].T
    left = np.stack([-course[:, 1], course[:, 0]], axis=1)
    velocities = np.stack([v[0] * course[k] + v[1] * left[k] for k, v in enumerate((first, second))])
    ends = np.array([[0.0], [gap]]) * left[0]
    place(world, ends - 0.1 * velocities, velocities)
    step = act(world)
    return world, paid(world, step, 0), paid(world, step, 1)


def test_walkers_start_on_a_circle_opposite_their_goals() -> None:
    world = world_of(Crossing(), worlds=20)
    pos, goal, course = world.state.pos, *(world._memory[k : k + 2].transpose(1, 2, 0) for k in (0, 2))
    np.testing.assert_allclose(goal, -pos)
    np.testing.assert_allclose(course, -pos / np.linalg.norm(pos, axis=2, keepdims=True))
    np.testing.assert_allclose(np.linalg.norm(pos, axis=2), 6, rtol=0.006)
    gaps = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=3) + 1e9 * np.eye(12)
    assert gaps.min() > 2
    assert np.unique(pos[:, 0], axis=0).shape == (20, 2)


def test_reward_terms_equal_values_calculated_by_hand() -> None:
    """3 m apart: one walks at 2 m/s towards its goal 6 m away, one at 1 m/s away from its goal."""
    _, a, b = walk(3.0, (2, 0), (-1, 0))
    expected = [0.5 * 0.2, 0, 0, -0.05, 0]
    np.testing.assert_allclose([a[name] for name in Crossing.terms], expected, atol=1e-9)
    assert b["progress"] == pytest.approx(0.5 * (math.hypot(5.9, 3) - math.hypot(6, 3)))
    world = world_of(Crossing(agents=1))
    assert paid(world, act(world, [0.6, 0.8]))["effort"] == pytest.approx(-0.1 * 0.1)


def test_contact_costs_in_every_decision_and_counts_once() -> None:
    world, a, b = walk(0.5, (0, 0), (0, 0))
    assert a["touch"] == b["touch"] == pytest.approx(-10 * 0.1)
    assert world.measure()["collisions"] == 0  # in contact before the step
    world, _, _ = walk(0.55, (0, 0), (0, 1))  # the other walker comes from 0.65 m
    assert world.measure()["collisions"] == 1
    act(world)
    assert world.measure()["collisions"] == 1


def test_leaving_the_goal_costs_the_reward_for_arrival() -> None:
    world = world_of(Crossing(agents=2))
    goal, course = world._memory[:2, 0].T.copy(), world._memory[2:4, 0].T.copy()
    place(world, [goal[0] - 0.5 * course[0], [0, 0]], [2 * course[0], [0, 0]])
    terms = paid(world, act(world))
    assert terms["arrival"] == 5
    assert terms["time"] == 0
    place(world, [goal[0] + 0.3 * course[0], [0, 0]], [2 * course[0], [0, 0]])
    terms = paid(world, act(world))
    assert terms["arrival"] == -5
    assert terms["time"] == pytest.approx(-0.05)


def test_episode_ends_for_all_when_all_have_arrived() -> None:
    world = world_of(Crossing(agents=3))
    goal = world._memory[:2, 0].T.copy()
    place(world, [goal[0], goal[1], goal[2] * 0.9])
    step = act(world)
    assert not step.terminated.any()
    assert world.measure()["arrived"] == pytest.approx(2 / 3)
    assert world.measure()["time_to_goal"] == pytest.approx(0.1 / 3)
    place(world, goal)
    step = act(world)
    assert step.terminated.all()
    assert step.success.all()
    assert world.measure()["arrived"] == 1


def test_path_efficiency_is_progress_over_path_length() -> None:
    world, _, _ = walk(0.0, (0.8, 0.6), (0.8, -0.6))  # both end in the middle
    assert world.measure()["path_efficiency"] == pytest.approx((math.hypot(6.08, 0.06) - 6) / 0.1)
    world = world_of(Crossing(agents=1))
    for _ in range(20):
        act(world, [1.0, 0.0])
    assert world.measure()["path_efficiency"] == pytest.approx(1)


def test_observation_is_in_the_frame_of_the_course() -> None:
    world = world_of(Crossing())
    for actions in random_actions(world, 15):
        step = world.step(actions)
    seen, s, task = world.task.layout.unpack(step.observation[0]), world.state, world.task
    for i in range(12):
        along = world._memory[2:4, 0, i]
        axes = np.array([along, [-along[1], along[0]]]).T
        offset = s.pos[0] - s.pos[0, i]
        distance = np.linalg.norm(offset, axis=1)
        distance[i] = np.inf
        order = np.argsort(distance)[: task.neighbours]  # type: ignore[attr-defined]
        order = order[distance[order] < task.sight]  # type: ignore[attr-defined]
        n = len(order)
        np.testing.assert_allclose(seen.velocity[i], s.vel[0, i] @ axes, atol=1e-5)
        np.testing.assert_allclose(seen.goal[i], (world._memory[:2, 0, i] - s.pos[0, i]) @ axes, atol=1e-5)
        np.testing.assert_allclose(seen.neighbours[i, :n], offset[order] @ axes, atol=1e-5)
        relative = (s.vel[0, order] - s.vel[0, i]) @ axes
        np.testing.assert_allclose(seen.neighbour_velocity[i, :n], relative, atol=1e-5)
        np.testing.assert_array_equal(seen.neighbour_present[i], [1] * n + [0] * (task.neighbours - n))  # type: ignore[attr-defined]


def test_scripted_walkers_cross_without_contact() -> None:
    """The learner rests. All others arrive, except agent 4, whose goal is there."""
    world = world_of(Crossing(agents=8, learners=1), worlds=4)
    least = np.inf
    for _ in range(150):
        world.step(np.zeros((4, 1, 2)))
        pos = world.state.pos
        least = min(least, (np.linalg.norm(pos[:, :, None] - pos[:, None], axis=3) + 1e9 * np.eye(8)).min())
    assert least >= 0.6
    left = np.linalg.norm(world._memory[:2].transpose(1, 2, 0) - pos, axis=2)
    assert np.delete(left, [0, 4], axis=1).max() < 0.1


def test_hand_written_players_arrive_and_orca_has_no_collision() -> None:
    task = Crossing()
    orca = rollout(task, player(task, name="orca"), 16, worlds_for("tuning", 0, 16))
    rules = rollout(task, player(task, name="textbook"), 16, worlds_for("tuning", 0, 16))
    for played in (orca, rules):
        assert played.metrics["arrived"].min() == 1
    assert orca.metrics["collisions"].max() == 0
    assert rules.metrics["collisions"].mean() < 0.3
    with pytest.raises(ValueError, match="no hand-written player 'orca' for 'flock'; there is one for: crossing"):
        player(Flock(), name="orca")
