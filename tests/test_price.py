"""The price of harm: which reward terms it multiplies, where it is observed, and that the default changes nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agents.compare import experiment_of
from agents.drawn import check_settings, played_returns, reward_weight
from agents.drawn_env import DrawnVecEnv
from agents.experiment import Experiment, PpoSettings
from agents.team_credit import CaringBuffer
from agents.training_env import learning_env
from flockenv.evaluation import rollout, worlds_for
from flockenv.players import load_player
from flockenv.players.policy import OtherSlotsError
from flockenv.tasks import TASKS, Bottleneck, CrowdNav, Task
from tests.test_tasks import random_actions, world_of

PRICED: tuple[Task, ...] = (Bottleneck(people=12, clear=0.0, room=3.0), CrowdNav(people=15, circle=4.0, jitter=0.05))
"""Crowded, so that random actions do harm."""

by_name = pytest.mark.parametrize(
    "task", [pytest.param(PRICED[0], id="bottleneck"), pytest.param(PRICED[1], id="crowd_nav", marks=pytest.mark.slow)]
)


def played(task: Task, decisions: int = 40) -> tuple[Any, Any, Any]:
    """Return terms, observations and positions of random actions in eight worlds, after every decision."""
    world = world_of(task, worlds=8)
    steps = ((world.step(actions), world.state.pos.copy()) for actions in random_actions(world, decisions))
    found = [(step.terms, step.observation, pos) for step, pos in steps]
    return tuple(np.array(each) for each in zip(*found, strict=True))


@by_name
def test_the_price_multiplies_the_terms_of_harm_alone(task: Task) -> None:
    plain, dear = played(task), played(task.model_copy(update={"price": 8.0}))
    harm = [task.terms.index(name) for name in task.priced]
    assert (plain[0][..., task.terms.index(task.harm)] < 0).any()
    factors = np.ones(len(task.terms))
    factors[harm] = 8.0
    np.testing.assert_array_equal(dear[0], plain[0] * factors)
    np.testing.assert_array_equal(dear[2], plain[2])


@by_name
def test_a_price_of_one_has_the_rewards_of_none(task: Task) -> None:
    plain, one = played(task), played(task.model_copy(update={"price": 1.0}))
    for k in (0, 2):
        np.testing.assert_array_equal(one[k], plain[k])


@by_name
@pytest.mark.parametrize("price", [0.01, 1.0, 30.0])
def test_a_given_price_is_the_last_number_of_a_row(task: Task, price: float) -> None:
    with_price = task.model_copy(update={"price": price})
    rows, plain = played(with_price, 10)[1], played(task, 10)[1]
    assert rows.shape[-1] == plain.shape[-1] + 1
    np.testing.assert_array_equal(rows[..., :-1], plain)
    seen = with_price.layout.unpack(rows).log_price
    present = rows.any(axis=-1) | (price == 1.0)  # rows of people that are out are 0
    np.testing.assert_allclose(seen[present], np.log10(price), atol=1e-6)
    assert present.mean() > 0.5


@by_name
def test_without_a_price_rows_and_results_are_those_from_before(task: Task) -> None:
    assert "log_price" not in task.layout.places
    assert "price" not in task.model_dump() and task.model_copy(update={"price": 1.0}).model_dump()["price"] == 1.0
    home = experiment_of(task.name).build()
    load_player("ppo", home)  # warns if anything differs from its card
    with pytest.raises(OtherSlotsError, match="log_price"):
        load_player("ppo", home.model_copy(update={"price": 1.0}))


@by_name
@pytest.mark.parametrize("price", [0.0, -1.0, 101.0, float("nan")])
def test_a_price_outside_its_range_is_refused_in_one_line(task: Task, price: float) -> None:
    with pytest.raises(ValueError, match="price") as caught:
        task.model_copy(update={"price": price})
    assert "\n" not in str(caught.value)


def test_the_named_terms_of_harm_are_terms() -> None:
    for task in TASKS.values():
        assert set(task.priced) <= set(task.terms)
        assert (task.harm in task.priced) == bool(task.priced) == ("price" in task.model_fields)


# --- learning ---------------------------------------------------------------------------------------------------------

DRAW = {"price": (0.5, 8.0)}
SETTINGS: dict[str, Any] = {
    "worlds": 4, "rollout": 4, "minibatch": 24, "dtype": "float64", "threads": 1, "evaluate_worlds": 4,
}  # fmt: skip


def experiment(**changes: Any) -> Experiment:
    arguments = {"people": 3, "together": True, "price": 1.0, "horizon": 20}
    return Experiment(task="bottleneck", arguments=arguments, ppo=PpoSettings(**{**SETTINGS, **changes}))


def test_rewards_of_a_high_price_are_scaled_down_for_learning() -> None:
    assert [reward_weight(Bottleneck(price=price)) for price in (None, 1.0, 3.0)] == [1.0, 1.0, 0.5]
    each = experiment(draw=DRAW, reward_scale=1.0)
    env = learning_env(each.build(), each.ppo)
    env.seed(0)
    env.reset()
    rewards = env.step(np.ones((12, 2)))[1]
    plain = learning_env(each.build(), experiment(reward_scale=1.0, worlds=2).ppo)
    plain.seed(0)
    plain.reset()
    expected = plain.step(np.ones((6, 2)))[1]  # no one is pressed in the first decision
    np.testing.assert_allclose(rewards, np.concatenate([expected * 2 / 1.5, expected * 2 / 9]))


def test_the_score_of_a_priced_policy_has_the_same_weights() -> None:
    each = experiment(draw=DRAW, hidden=(4,))
    task, size = each.build(), each.build().layout.size
    tensors = {
        "policy.0.weight": np.zeros((4, size), np.float32), "policy.0.bias": np.zeros(4, np.float32),
        "action.weight": np.zeros((2, 4), np.float32), "action.bias": np.array([1, 0], np.float32),
        "log_std": np.zeros(2, np.float32),
    }  # fmt: skip
    returns, _ = played_returns(task, each.ppo, tensors)

    class Ahead:
        def predict(self, observation: Any, *rest: Any) -> Any:
            return np.tile(np.float32([1, 0]), (len(observation), 1)), None

    for part, price in zip(np.split(returns, 2), DRAW["price"], strict=True):
        found = rollout(task.model_copy(update={"price": price}), Ahead(), 2, worlds_for("tuning", 0, 2))
        np.testing.assert_allclose(part, found.returns * 2 / (1 + price))


def test_care_works_with_a_drawn_price_and_not_with_a_drawn_number_of_learners() -> None:
    from agents.ppo import build

    each = experiment(draw=DRAW, care=1.0)
    check_settings(each)
    model = build(each.build(), each.ppo)
    assert isinstance(model.rollout_buffer, CaringBuffer) and isinstance(model.env, DrawnVecEnv)
    model.learn(48)
    assert model.rollout_buffer.acted.shape == (4, 12) and model.rollout_buffer.acted.all()
    with pytest.raises(ValueError, match=r"ppo.draw: the number of learners must not vary with care, not \[2, 3\]"):
        check_settings(experiment(draw={"people": (2, 3)}, care=1.0))
