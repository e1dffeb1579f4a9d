"""Hybrids of a learned policy and hand-written rules: how outputs act, cards, and files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.players import load_player
from flockenv.players.hybrid import KINDS, Hybrid, HybridPolicy
from flockenv.players.policy import describe, save_policy
from flockenv.players.rules import as_dict
from flockenv.tasks import TASKS, Crossing, Pursuit, School, Task

RNG = np.random.default_rng(0)


def rows_of(task: Task, worlds: int = 4, decisions: int = 5) -> np.ndarray:
    """Return observations in the middle of episodes, (R, O)."""
    world = World(task, worlds)
    observation = world.reset(3)
    player, state = load_player("rules", task), None
    for k in range(decisions):
        rows = observation.reshape(-1, observation.shape[-1])
        action, state = player.predict(rows, state, np.full(len(rows), k == 0))
        observation = world.step(action.reshape(*observation.shape[:2], -1)).observation
    return observation.reshape(-1, observation.shape[-1])


def tensors_for(task: Task, outputs: int, scale: float = 1.0) -> dict[str, np.ndarray]:
    size = task.layout.size
    return {
        "policy.0.weight": RNG.normal(size=(8, size)).astype(np.float32),
        "policy.0.bias": RNG.normal(size=8).astype(np.float32),
        "action.weight": (scale * RNG.normal(size=(outputs, 8))).astype(np.float32),
        "action.bias": np.zeros(outputs, np.float32),
        "log_std": np.zeros(outputs, np.float32),
    }


def save(path: Path, task: Task, hybrid: Hybrid, scale: float = 1.0, **changes: Any) -> Path:
    card = {**describe(task), "activation": "tanh", "hybrid": {**hybrid.card, **changes}}
    save_policy(path, tensors_for(task, hybrid.outputs, scale), card)
    return path


@pytest.mark.parametrize("name", TASKS)
def test_a_residual_of_zero_and_a_closed_gate_play_the_rules(name: str) -> None:
    task = TASKS[name]()
    rows = rows_of(task)
    rules = load_player("rules", task).predict(rows, None, np.ones(len(rows), np.bool_))[0]
    begins = np.ones(len(rows), np.bool_)
    for kind, value in (("residual", 0.0), ("gate", -1.0)):
        hybrid = Hybrid.of(task, kind)
        outputs = np.full((len(rows), hybrid.outputs), value, np.float32)
        assert (hybrid.act(rows, outputs, None, begins)[0] == rules).all()


def test_a_residual_is_bounded() -> None:
    task = Pursuit()
    rows, hybrid = rows_of(task, 50), Hybrid.of(task, "residual", bound=0.25)
    rules = load_player("rules", task).predict(rows)[0]
    action, _ = hybrid.act(rows, np.sign(RNG.normal(size=(len(rows), 2))).astype(np.float32))
    assert np.abs(action - rules).max() == pytest.approx(0.25, abs=1e-6)
    assert np.abs(action).max() <= 1.0


def test_a_gate_hands_over_by_row() -> None:
    task = Pursuit()
    rows, hybrid = rows_of(task, 50), Hybrid.of(task, "gate")
    outputs = RNG.uniform(-1, 1, (len(rows), 3)).astype(np.float32)
    action, _ = hybrid.act(rows, outputs)
    mine = outputs[:, 2] >= 0
    assert 0 < mine.sum() < len(rows)
    assert (action[mine] == outputs[mine, :2]).all()
    assert (action[~mine] == load_player("rules", task).predict(rows)[0][~mine]).all()


def test_rules_that_remember_keep_their_state() -> None:
    task = School()
    rows = rows_of(task)
    hybrid, alone = Hybrid.of(task, "residual"), load_player("rules", task)
    state = same = None
    for k in range(3):
        begins = np.full(len(rows), k == 0)
        action, state = hybrid.act(rows, np.zeros((len(rows), 2), np.float32), state, begins)
        force, same = alone.predict(rows, same, begins)
        assert (action == force).all() and state is not None and (np.asarray(state) == np.asarray(same)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_plays_as_its_hybrid(kind: str, tmp_path: Path) -> None:
    task = Crossing()
    hybrid = Hybrid.of(task, kind, "orca", 0.3)
    path = save(tmp_path / "mine.safetensors", task, hybrid)
    policy = load_player(path, task)
    assert isinstance(policy, HybridPolicy) and policy.hybrid == hybrid
    rows = rows_of(task)
    outputs = super(HybridPolicy, policy).predict(rows, deterministic=True)[0]
    action, _ = policy.predict(rows, deterministic=True)
    assert (action == hybrid.act(rows, outputs)[0]).all()
    one, _ = policy.predict(rows[0], deterministic=True)
    assert one.shape == (2,) and one == pytest.approx(action[0], abs=1e-6)


def test_the_card_keeps_the_parameters_of_the_rules(tmp_path: Path) -> None:
    task = Pursuit()
    hybrid = Hybrid.of(task, "residual")
    other = Hybrid("residual", hybrid.rules.with_rules({"gain": 3.21}))
    path = save(tmp_path / "mine.safetensors", task, other)
    policy = load_player(path, task)
    assert isinstance(policy, HybridPolicy)
    assert as_dict(policy.hybrid.rules.rules)["gain"] == 3.21


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"kind": "residul"}, "hybrid.kind = 'residul': unknown, did you mean `residual`"),
        ({"bound": 3.0}, "hybrid.bound = 3.0: must be above 0 and at most 2"),
        ({"bound": True}, "hybrid.bound = True"),
        ({"rules": {"gain": 1.0}}, "hybrid.rules must hold a number for each of"),
        ({"base": "queueing"}, "there is no hand-written player 'queueing' for 'pursuit'"),
        ({"kind": "gate"}, "the network puts out 2 numbers, must be 3"),
    ],
)
def test_bad_cards_are_refused(changes: dict[str, Any], text: str, tmp_path: Path) -> None:
    task = Pursuit()
    path = save(tmp_path / "mine.safetensors", task, Hybrid.of(task, "residual"), **changes)
    with pytest.raises(ValueError, match="mine") as caught:
        load_player(path, task)
    assert text in str(caught.value) and "\n" not in str(caught.value)


def test_a_card_without_fields_is_refused(tmp_path: Path) -> None:
    task = Pursuit()
    path = save(tmp_path / "mine.safetensors", task, Hybrid.of(task, "residual"))
    card = json.loads(path.with_suffix(".json").read_text())
    card["hybrid"] = ["residual"]
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(ValueError, match="the card's hybrid must hold kind, base, bound and rules"):
        load_player(path, task)


def test_an_unknown_base_is_refused() -> None:
    with pytest.raises(ValueError, match="hand-written player 'rulez': unknown, did you mean `rules`"):
        Hybrid.of(Pursuit(), "residual", "rulez")
