"""Actors of other learners than PPO, in numpy: squashed ones of SAC and TQC, recurrent ones of RecurrentPPO."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents import learn
from agents.experiment import Experiment, PpoSettings
from agents.learner_job import effective
from agents.warm_start import starting_policy
from flockenv.evaluation import rollout
from flockenv.players.hybrid import Hybrid, HybridPolicy
from flockenv.players.policy import MlpPolicy, describe, save_policy
from flockenv.players.recurrent import RecurrentPolicy
from flockenv.tasks import Pursuit

TASK = Pursuit()
RELU = {"activation": "relu"}
SQUASHED = {**RELU, "squash": "tanh"}
SMALL = {"buffer": 600, "minibatch": 8, "worlds": 2, "random_actions": 0}


def model_of(algo: str, activation: str = "relu") -> Any:
    """Return an untrained model whose weights are larger than at the start of learning."""
    settings = {"worlds": 2, "rollout": 4, "minibatch": 8, "threads": 1, "hidden": (20, 12), "activation": activation}
    given = Experiment(task="pursuit", ppo=settings, sac=SMALL, tqc=SMALL, recurrent_ppo={"lstm": 9})
    model = learn.build(effective(given, algo), algo)
    with torch.no_grad():
        for tensor in (model.policy.actor if algo in ("sac", "tqc") else model.policy).parameters():
            tensor.normal_(std=0.4)
    return model


def rows(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, TASK.layout.size)).astype(np.float32)


# --- squashed ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("algo", "activation"), [("sac", "relu"), ("tqc", "tanh")])
def test_a_squashed_actor_equals_that_of_its_library(algo: str, activation: str) -> None:
    model = model_of(algo, activation)
    ours = MlpPolicy(learn.tensors_of(model), {**SQUASHED, "activation": activation})
    given = rows(501)
    expected, _ = model.predict(given, deterministic=True)
    assert np.abs(expected).max() > 0.9  # where clipping instead would differ
    np.testing.assert_allclose(ours.predict(given, deterministic=True)[0], expected, atol=1e-6)
    np.testing.assert_allclose(ours.predict(given[3], deterministic=True)[0], expected[3], atol=1e-6)
    assert ours.predict(given[:0])[0].shape == (0, TASK.action_layout.size)


def test_a_squashed_actor_samples_with_the_deviation_of_each_row() -> None:
    model = model_of("sac")
    ours = MlpPolicy(learn.tensors_of(model), SQUASHED, seed=3)
    for row in rows(4):
        with torch.no_grad():
            mean, log_std, _ = model.policy.actor.get_action_dist_params(torch.from_numpy(row[None]))
        drawn = np.arctanh(np.clip(ours.predict(np.repeat(row[None], 40_000, axis=0))[0], -0.9999999, 0.9999999))
        quartiles = np.quantile(drawn, [0.25, 0.5, 0.75], axis=0)
        deviation = log_std.exp().numpy()[0]
        np.testing.assert_allclose(quartiles[1], mean.numpy()[0], atol=0.03 * deviation.max() + 1e-3)
        np.testing.assert_allclose(quartiles[2] - quartiles[0], 1.349 * deviation, rtol=0.04)


def test_a_squashed_actor_is_kept_with_its_card(tmp_path: Path) -> None:
    tensors = learn.tensors_of(model_of("sac"))
    path = tmp_path / "p.safetensors"
    save_policy(path, tensors, {**describe(TASK), **SQUASHED})
    given = rows(20)
    again = MlpPolicy.load(path, TASK).predict(given, deterministic=True)[0]
    np.testing.assert_array_equal(again, MlpPolicy(tensors, SQUASHED).predict(given, deterministic=True)[0])


def test_a_squashed_actor_is_no_plain_one() -> None:
    tensors = learn.tensors_of(model_of("sac"))
    with pytest.raises(ValueError, match="tensor 'log_std' is missing"):
        MlpPolicy(tensors, RELU)
    with pytest.raises(ValueError, match=r"squash: 'tan', did you mean .tanh.\?; allowed: 'tanh'"):
        MlpPolicy(tensors, {**RELU, "squash": "tan"})
    plain = {name: tensor for name, tensor in tensors.items() if not name.startswith("log_std")}
    with pytest.raises(ValueError, match=r"tensor 'log_std' is not one of an MLP actor"):
        MlpPolicy({**plain, "log_std": tensors["log_std.bias"]}, SQUASHED)
    with pytest.raises(ValueError, match=r"tensor 'log_std.weight' has shape"):
        MlpPolicy({**tensors, "log_std.weight": tensors["log_std.weight"][:, 1:]}, SQUASHED)


def test_a_squashed_actor_acts_on_top_of_rules() -> None:
    tensors = learn.tensors_of(model_of("sac"))
    hybrid = Hybrid.of(TASK, "residual")
    policy, given = HybridPolicy.of(tensors, {**SQUASHED, "hybrid": hybrid.card}, TASK), rows(9)
    outputs, _ = MlpPolicy(tensors, SQUASHED).predict(given, deterministic=True)
    expected, _ = hybrid.act(given, outputs)
    np.testing.assert_array_equal(policy.predict(given, deterministic=True)[0], expected)


@pytest.mark.parametrize("algo", ["sac", "recurrent_ppo"])
def test_ppo_does_not_start_with_an_actor_that_it_cannot_represent(algo: str, tmp_path: Path) -> None:
    model = model_of(algo)
    card = {**describe(TASK), **(SQUASHED if algo == "sac" else RELU)}
    save_policy(tmp_path / "p.safetensors", learn.tensors_of(model), card)
    with pytest.raises(ValueError, match=r"ppo\.start = .*: its actor is squashed, recurrent or .* one of PPO's"):
        starting_policy(PpoSettings(start=str(tmp_path / "p.safetensors"), hidden=(20, 12)), TASK)


# --- recurrent --------------------------------------------------------------------------------------------------------


def test_a_recurrent_actor_equals_that_of_its_library_over_episodes() -> None:
    model = model_of("recurrent_ppo")
    ours = MlpPolicy.of_tensors(learn.tensors_of(model), RELU)
    generator = np.random.default_rng(0)
    state: Any = None
    mine: Any = None
    begins = np.ones(7, np.bool_)
    for step in range(30):
        given = rows(7, step)
        expected, state = model.predict(given, state, begins, deterministic=True)
        action, mine = ours.predict(given, mine, begins, deterministic=True)
        np.testing.assert_allclose(action, expected, atol=1e-6)
        for part, theirs in zip(mine, state, strict=True):
            np.testing.assert_allclose(part, theirs, atol=1e-6)
        begins = generator.random(7) < 0.2
    assert np.abs(expected).max() > 0.1


def test_a_recurrent_actor_remembers_and_forgets_when_an_episode_begins() -> None:
    policy = MlpPolicy.of_tensors(learn.tensors_of(model_of("recurrent_ppo")), RELU)
    first, second = rows(5), rows(5, 1)
    fresh, _ = policy.predict(second, None, None, deterministic=True)
    _, state = policy.predict(first, deterministic=True)
    begins = np.array([True, False, True, False, False])
    action, _ = policy.predict(second, state, begins, deterministic=True)
    np.testing.assert_array_equal((action == fresh).all(axis=1), begins)
    one, (output, cell) = policy.predict(first[2], deterministic=True)
    assert one.shape == (TASK.action_layout.size,) and output.shape == cell.shape == (1, 1, 9)
    np.testing.assert_allclose(output[0, 0], state[0][0, 2], atol=1e-6)  # type: ignore[index]


def test_a_recurrent_actor_is_kept_and_plays_a_task(tmp_path: Path) -> None:
    tensors = learn.tensors_of(model_of("recurrent_ppo"))
    path = tmp_path / "p.safetensors"
    save_policy(path, tensors, {**describe(TASK), **RELU})
    policy = MlpPolicy.load(path, TASK)
    assert isinstance(policy, RecurrentPolicy) and policy.card["observation_size"] == TASK.layout.size
    assert "lstm 9" in repr(policy)
    whole, alone = (rollout(TASK, policy, worlds, 5) for worlds in (3, 1))
    assert whole.returns[0] == pytest.approx(alone.returns[0], abs=1e-3)
    forgetful = RecurrentPolicy({**tensors, "lstm.weight_hh": 0 * tensors["lstm.weight_hh"]}, RELU)
    assert rollout(TASK, forgetful, 3, 5).returns[0] != whole.returns[0]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"lstm.bias": None}, "tensor 'lstm.bias' is missing"),
        ({"lstm.weight": np.zeros(3, np.float32)}, "tensor 'lstm.weight' is not one of an LSTM"),
        ({"lstm.bias": np.zeros(35, np.float32)}, r"tensor 'lstm.bias' has shape \(35,\), the other layers require"),
        ({"lstm.bias": np.zeros(36)}, "tensor 'lstm.bias' is float64, must be float32"),
        ({"lstm.weight_ih": np.zeros((36, 0), np.float32)}, "tensor 'lstm.weight_ih' has shape"),
        ({"lstm.weight_hh": np.full((36, 9), np.nan, np.float32)}, "tensor 'lstm.weight_hh' holds NaN"),
    ],
)
def test_other_tensors_of_an_lstm_are_refused(change: dict[str, Any], text: str) -> None:
    tensors = {**learn.tensors_of(model_of("recurrent_ppo")), **change}
    with pytest.raises(ValueError, match=text):
        MlpPolicy.of_tensors({name: tensor for name, tensor in tensors.items() if tensor is not None}, RELU)


def test_states_of_other_rows_and_hybrids_with_an_lstm_are_refused() -> None:
    tensors = learn.tensors_of(model_of("recurrent_ppo"))
    policy = MlpPolicy.of_tensors(tensors, RELU)
    _, state = policy.predict(rows(5))
    with pytest.raises(ValueError, match=r"state: shapes .*, must be two of \(1, 4, 9\)"):
        policy.predict(rows(4), state)
    with pytest.raises(ValueError, match="is not one of an MLP actor"):
        HybridPolicy.of(tensors, {**RELU, "hybrid": Hybrid.of(TASK, "residual").card}, TASK)
