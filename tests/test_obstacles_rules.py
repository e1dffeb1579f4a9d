"""Obstacles' hand-written player that tries velocities, beside the textbook's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.evaluation import rollout
from flockenv.players.rules import RulesPlayer, player
from flockenv.players.rules.obstacles import ObstaclesRules, WindowRules, dynamic_window
from flockenv.tasks import Obstacles

TASK = Obstacles()


def seen(
    velocity: Any = (0.0, 0.0), goal: Any = (10.0, 0.0), obstacles: Any = (), walls: Any = (12.0, 12.0, 12.0, 12.0)
) -> Any:
    """Return an observation: vectors in m, obstacles (x, y, radius), walls below, left, above, right at distances."""
    row = np.zeros((1, TASK.layout.size), np.float32)
    slots = TASK.layout.unpack(row)
    slots.velocity[0], slots.goal[0] = velocity, goal
    slots.to_low[0], slots.to_high[0] = walls[:2], walls[2:]
    for k, (x, y, radius) in enumerate(obstacles):
        slots.obstacles[0, k], slots.obstacle_radius[0, k] = (x, y), radius
    return slots


def force(p: WindowRules = WindowRules(), **scene: Any) -> Any:  # noqa: B008  # frozen
    return dynamic_window(seen(**scene), TASK, p)[0]


@pytest.mark.parametrize("angle", [0.0, 0.8, 2.5, 4.4])
def test_without_obstacles_it_runs_straight_to_the_goal_at_top_speed(angle: float) -> None:
    way = np.array([np.cos(angle), np.sin(angle)])
    wanted = force(goal=8.0 * way, velocity=1.0 * way) * TASK.control_dt
    np.testing.assert_allclose(wanted, (TASK.max_speed - 1.0) * way, atol=1e-6)


def test_an_empty_slot_is_no_obstacle() -> None:
    np.testing.assert_array_equal(force(obstacles=((0.4, 0.1, 0.0),)), force())


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_passes_an_obstacle_on_the_nearer_side(side: float) -> None:
    wanted = force(velocity=(2.5, 0.0), obstacles=((2.2, -0.4 * side, 1.0),), walls=(9.0, 9.0, 9.0, 9.0))
    assert side * wanted[1] > 1.0


def test_it_brakes_if_every_velocity_at_top_speed_touches() -> None:
    """An obstacle right ahead that is too wide to be passed at this speed."""
    wanted = force(velocity=(2.0, 0.0), obstacles=((2.75, 0.0, 2.0), (1.2, 2.2, 1.2), (1.2, -2.2, 1.2)))
    assert wanted[0] < -1.0


def test_it_keeps_off_walls() -> None:
    towards = force(velocity=(0.0, -1.0), goal=(0.1, -0.4), walls=(5.0, 0.6, 5.0, 15.0))
    free = force(velocity=(0.0, -1.0), goal=(0.1, -0.4), walls=(5.0, 5.0, 5.0, 15.0))
    assert towards[1] > free[1] + 1.0


def test_parameters_may_differ_by_row() -> None:
    rows = np.random.default_rng(0).uniform(0, 1, (6, TASK.layout.size)).astype(np.float32)
    slots, other = TASK.layout.unpack(rows), WindowRules(1.5, 0.3, 4.0, 1.0, 2.0)
    first, second = (dynamic_window(slots, TASK, p) for p in (WindowRules(), other))
    mixed = WindowRules(*(
        np.where(np.arange(6) < 3, a, b)
        for a, b in zip(vars(WindowRules()).values(), vars(other).values(), strict=True)
    ))  # fmt: skip
    np.testing.assert_array_equal(dynamic_window(slots, TASK, mixed), np.vstack([first[:3], second[3:]]))


def test_it_succeeds_more_often_than_the_textbook() -> None:
    assert player(TASK, "textbook").rules == ObstaclesRules()
    trying, avoiding = (
        rollout(TASK, RulesPlayer(TASK, rules, name), 64, 7)
        for rules, name in ((WindowRules(), "rules"), (ObstaclesRules(), "textbook"))
    )
    assert trying.success.mean() > avoiding.success.mean() + 0.05
    assert trying.returns.mean() > avoiding.returns.mean() + 1
