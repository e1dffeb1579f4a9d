"""Corridor: rewards and measures calculated by hand, and whether players form lanes."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.evaluation import rollout, worlds_for
from flockenv.players import WEIGHTS
from flockenv.players.policy import MlpPolicy, RandomPolicy
from flockenv.players.rules import player
from flockenv.players.rules.corridor import CorridorOrcaRules, SampledRules, orca_corridor, sampled_velocity
from flockenv.tasks import Corridor
from tests.test_tasks import act, paid, place, random_actions, world_of

HORIZON = 10


def walk(places: Any, velocities: Any = 0.0, **more: Any) -> World:
    """Return a world with people at places (along the corridor, across it); the first half walks to the right."""
    world = world_of(Corridor(people=len(places), horizon=HORIZON, **more))
    place(world, np.add(places, [0.0, 1.0]), velocities)
    return world


def test_people_start_in_the_corridor_half_each_direction_without_overlap() -> None:
    world = World(Corridor(), 100)
    world.reset(3)
    pos, direction, pace = world.state.pos, world._memory[0], world._memory[1]
    assert (direction[:, :12] == 1).all()
    assert (direction[:, 12:] == -1).all()
    assert (pos[..., 1] >= 1.25).all()
    assert (pos[..., 1] <= 3.75).all()
    x = pos[:, :, None, 0] - pos[:, None, :, 0]
    x -= 12 * np.round(x / 12)
    gaps = np.hypot(x, pos[:, :, None, 1] - pos[:, None, :, 1]) + 9 * np.eye(24)
    assert gaps.min() >= 0.5
    assert pace.mean() == pytest.approx(1.34, abs=0.02)
    assert pace.std() == pytest.approx(0.26, abs=0.02)
    assert len(np.unique(pos[:, 0, 0].round(1))) > 40  # positions differ between worlds


def test_reward_along_peaks_at_the_desired_speed_and_contact_costs_both() -> None:
    world = walk([(2, 1), (6, 1), (6.4, 1), (10, 2)], [(0.67, 0), (1.9, 0), (0.67, 0), (-0.67, 0)])
    pace = world._memory[1, 0].copy()
    step = act(world)
    terms = [paid(world, step, i) for i in range(4)]
    for i, speed in enumerate((0.67, 1.9, -0.67, 0.67)):
        assert terms[i]["along"] == pytest.approx(0.1 * (1 - abs(speed / pace[i] - 1)))
    assert [t["touch"] for t in terms] == pytest.approx([0, -0.5, -0.5, 0])
    assert paid(world, act(world, (0.6, 0.8)))["effort"] == pytest.approx(-0.1 * 0.1)


def test_contact_counts_once_also_across_the_periodic_edge() -> None:
    world = walk([(11.9, 1), (0.5, 1)], [(1.5, 0), (0, 0)])  # 0.6 m apart, 0.45 m after a decision
    act(world)
    assert world.measure()["collisions"] == 1
    act(world)
    assert world.measure()["collisions"] == 1


def order_of(rows: Any, directions: Any) -> float:
    """Return pairs with equal minus pairs with opposite direction, over all pairs in one row, by counting."""
    pairs = [(i, j) for i, j in itertools.combinations(range(len(rows)), 2) if rows[i] == rows[j]]
    return sum(directions[i] * directions[j] for i, j in pairs) / len(pairs) if pairs else 0.0


def test_lane_order_equals_the_count_of_pairs_in_a_row() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        places = np.stack([rng.uniform(0, 12, 24), rng.uniform(0.3, 2.7, 24)], axis=1)
        world = walk(places)
        world.steps[:] = HORIZON - 1
        act(world)
        rows = np.floor(places[:, 1] / 0.5)
        assert world.measure()["lane_order"] == pytest.approx(order_of(rows, world._memory[0, 0]), abs=1e-9)
    lanes = np.stack([np.tile(np.arange(12.0), 2), np.repeat([0.75, 2.25], 12)], axis=1)
    world = walk(lanes)
    act(world)
    assert np.isnan(world.measure()["lane_order"])  # it is measured only in the second half of an episode
    world.steps[:] = HORIZON - 1
    act(world)
    assert world.measure()["lane_order"] == 1


def test_lane_order_of_random_positions_is_about_zero() -> None:
    """The mean is -1/23 for 12 + 12 people: of 23 others, 11 walk in the same direction and 12 in the opposite one."""
    world = World(Corridor(), 400)
    world.reset(0)
    world.steps[:] = 299
    world.step(np.zeros((400, 24, 2)))
    order = world.measure()["lane_order"]
    assert order.mean() == pytest.approx(-1 / 23, abs=4 * order.std() / 20)


def test_walls_are_solid() -> None:
    world = world_of(Corridor(), worlds=8)
    for _ in range(60):
        world.step(np.broadcast_to([0.0, 1.0], (8, 24, 2)))
    y = world.state.pos[..., 1] - 1.0
    assert (y[:, :12] > 2.5).all()  # those that walk to the right are at the wall on their left
    assert (y[:, 12:] < 0.5).all()
    assert y.min() > 0.15
    assert y.max() < 2.85


def test_observations_and_rewards_are_equal_in_both_directions() -> None:
    """Rotated by half a turn, each half of the people gets the observations of the other."""
    places = np.array([(2.0, 0.7), (5.0, 1.4), (3.1, 1.0), (6.4, 2.2)])
    turned = ([12.0, 3.0] - places)[[2, 3, 0, 1]]
    worlds = [walk(places), walk(turned)]
    worlds[1]._memory[1] = worlds[0]._memory[1][:, [2, 3, 0, 1]]
    actions = np.random.default_rng(1).uniform(-1, 1, (1, 4, 2))
    for _ in range(8):
        one, other = worlds[0].step(actions), worlds[1].step(actions[:, [2, 3, 0, 1]])
        np.testing.assert_allclose(one.observation[:, [2, 3, 0, 1]], other.observation, atol=2e-6)
        np.testing.assert_allclose(one.terms[:, [2, 3, 0, 1]], other.terms, atol=1e-9)


def test_rewards_do_not_change_the_motion() -> None:
    worlds = world_of(Corridor()), world_of(Corridor(along_reward=0, touch_cost=0, effort_cost=0))
    for actions in random_actions(worlds[0], 40):
        for world in worlds:
            step = world.step(actions)
        assert not step.reward.any()
    np.testing.assert_array_equal(worlds[0].state.pos, worlds[1].state.pos)


def test_players_form_lanes_and_a_random_player_does_not() -> None:
    task, first = Corridor(), worlds_for("tuning", 7, 12)
    players: dict[str, Any] = {
        "random": RandomPolicy(2, 0),
        "force": player(task, name="textbook"),
        "sampled": player(task, name="rules"),
        "orca": player(task, name="orca"),
        "ppo": MlpPolicy.load(WEIGHTS / "corridor.safetensors", task),
    }
    episodes = {name: rollout(task, player, 12, first) for name, player in players.items()}
    order = {name: played.metrics["lane_order"].mean() for name, played in episodes.items()}
    assert abs(order["random"]) < 0.15
    assert order["force"] > 0.25
    assert order["orca"] > 0.9
    assert order["sampled"] > 0.8
    assert order["ppo"] > 0.5
    for name in ("force", "sampled", "orca", "ppo"):
        assert episodes[name].metrics["speed"].mean() > 0.8


def seen(left: float = 2.25, speed: float = 1.0, others: Any = ()) -> Any:
    """Return what an agent at its desired speed sees: m to the wall on its left, others (x, y, velocity), m and m/s."""
    task = Corridor()
    see = task.layout.unpack(np.zeros((1, task.layout.size)))
    see.walls[0], see.desired_speed[0], see.velocity[0] = (left, task.width - left), speed, (speed, 0.0)
    for k, (x, y, velocity) in enumerate(others):
        see.neighbours[0, k], see.neighbour_present[0, k] = (x, y), 1.0
        see.neighbour_velocity[0, k] = velocity - speed, 0.0
    return see


@pytest.mark.parametrize(("left", "outside"), [(0.5, 1.25), (1.5, 0.25), (1.75, 0.0), (2.5, 0.0)])
def test_orca_returns_to_the_right_half_at_a_speed_in_proportion(left: float, outside: float) -> None:
    """A body of 0.25 m is in the right half if its centre is at least that far from the middle."""
    forces = (orca_corridor(seen(left), Corridor(), CorridorOrcaRules(gain=3.0, lane=lane))[0] for lane in (0.0, 0.4))
    straight, back = forces
    np.testing.assert_allclose(back - straight, [0.0, -0.4 * outside * 3.0], atol=1e-12)


def sampled(see: Any, **parameters: Any) -> Any:
    """Return the velocity that is taken, m/s."""
    return see.velocity[0] + sampled_velocity(see, Corridor(), SampledRules(gain=1.0, **parameters))[0]


def test_sampled_velocities_keep_the_desired_speed_in_the_right_half_and_return_to_it() -> None:
    np.testing.assert_allclose(sampled(seen(2.25, 1.3)), [1.3, 0.0])
    assert sampled(seen(0.75, 1.3))[1] < 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_sampled_velocities_overtake_on_the_free_side(side: float) -> None:
    see = seen(1.5, 1.3, [(1.2, -0.2 * side, 0.4)])
    assert side * sampled(see, lane=0.0)[1] > 0.0
    np.testing.assert_allclose(sampled(see, lane=0.0, risk=0.0), [1.3, 0.0])


def test_sampled_velocities_slow_down_where_there_is_no_room() -> None:
    row = [(0.8, y, 0.2) for y in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    assert sampled(seen(1.5, 1.3, row), lane=0.0)[0] < 1.3


@pytest.mark.parametrize("left", [0.3, 2.7])
def test_sampled_velocities_keep_off_walls(left: float) -> None:
    towards = 1.0 if left < 1.5 else -1.0
    assert towards * sampled(seen(left, 1.3, [(0.9, -0.25 * towards, 0.2)]), lane=0.0)[1] <= 0.1


def test_parameters_of_sampled_velocities_may_differ_by_row() -> None:
    one, task = seen(0.9, 1.3, [(1.0, 0.1, 0.2)]), Corridor()
    two = type(one)(**{name: np.repeat(value, 2, axis=0) for name, value in vars(one).items()})
    values: dict[str, Any] = {
        "risk": (0.1, 1.0),
        "margin": (0.0, 0.3),
        "share": (0.5, 1.0),
        "lane": (0.0, 2.0),
        "gain": (3.0, 9.0),
    }
    together = sampled_velocity(two, task, SampledRules(**{name: np.array(values[name]) for name in values}))
    for k in range(2):
        alone = sampled_velocity(one, task, SampledRules(**{name: pair[k] for name, pair in values.items()}))
        np.testing.assert_array_equal(together[k], alone[0])


def test_scripted_pedestrians_reach_80_percent_of_their_desired_speed() -> None:
    world = World(Corridor(learners=1), 8)
    world.reset(2)
    for _ in range(150):
        world.step(np.zeros((8, 1, 2)))
    along = world.state.vel[:, 1:, 0] * world._memory[0, :, 1:] / world._memory[1, :, 1:]
    assert along.mean() > 0.8


@pytest.mark.parametrize(
    ("fields", "message"),
    [({"people": 1}, "people = 1"), ({"people": 150}, "people = 150"), ({"sight": 7.0}, "sight = 7"),
     ({"people": 4, "learners": 5}, "learners = 5")],
)  # fmt: skip
def test_invalid_fields_are_refused_in_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Corridor(**fields)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_snapshot_has_a_role_for_each_direction() -> None:
    world = world_of(Corridor(people=8, learners=6), seed=3)
    moved = world.snapshot()
    east = np.array(world.memory[0, 0] > 0)
    assert 0 < east.sum() < 8
    assert [name.endswith("2") for name in moved.roles] == (~east).tolist()
    assert [name.removesuffix(" 2") for name in moved.roles] == ["learner"] * 6 + ["agent"] * 2


def test_rules_act_on_each_row_alone_however_many_are_computed_together() -> None:
    task = Corridor()
    rules, seen = player(task, name="rules"), np.random.default_rng(3).uniform(-1, 1, (1100, task.layout.size))
    together = rules.predict(seen)[0]
    np.testing.assert_array_equal(
        together, np.concatenate([rules.predict(seen[k : k + 7])[0] for k in range(0, 1100, 7)])
    )
    assert rules.predict(seen[:0])[0].shape == (0, *together.shape[1:])
