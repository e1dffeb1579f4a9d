"""Hybrids of a learned policy and hand-written rules: how outputs act, cards, and files."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.players import load_player
from flockenv.players.hybrid import KINDS, Hybrid, HybridPolicy
from flockenv.players.policy import describe, save_policy
from flockenv.players.rules import PLAYERS, as_dict, load_tuned, player
from flockenv.players.rules.parameter import ranges_of
from flockenv.steering.motivation import ESCAPE
from flockenv.tasks import TASKS, Crossing, Pursuit, School, Task

RNG = np.random.default_rng(0)
WIDE = {name: [-1e3, 1e3] for name in ("factor", "horizon", "margin", "gain", "slow_radius")}


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


def share_of_rules(hybrid: Hybrid) -> np.float32:
    """Return the factor on the rules' force if the outputs are 0, or the gate is closed."""
    return np.float32(1.0 - hybrid.bound if hybrid.kind == "mixture" else 1.0)


def hybrids(name: str) -> list[Hybrid]:
    """Return every hybrid of a task, with one hand-written player for each function."""
    bases = {PLAYERS[base][name][0]: base for base in PLAYERS if name in PLAYERS[base]}.values()
    rules = [player(TASKS[name](), base) for base in bases]
    kinds = [(kind, each) for each in rules for kind in KINDS if kind != "priorities" or each.behaviours]
    return [Hybrid.of(TASKS[name](), kind, each.name) for kind, each in kinds]


@pytest.mark.parametrize("name", TASKS)
def test_outputs_of_zero_and_a_closed_gate_play_the_rules(name: str) -> None:
    rows = rows_of(TASKS[name]())
    begins = np.ones(len(rows), np.bool_)
    for hybrid in hybrids(name):
        rules = load_player(hybrid.rules.name, hybrid.rules.task).predict(rows, None, begins)[0]
        outputs = np.full((len(rows), hybrid.outputs), -1.0 if hybrid.kind == "gate" else 0.0, np.float32)
        expected = rules * share_of_rules(hybrid)
        assert (hybrid.act(rows, outputs, None, begins)[0] == expected).all(), hybrid.kind


@pytest.mark.parametrize("name", TASKS)
def test_actions_are_within_the_limits_for_any_outputs(name: str) -> None:
    rows = rows_of(TASKS[name]())
    begins = np.ones(len(rows), np.bool_)
    for hybrid in hybrids(name):
        outputs = RNG.uniform(-1, 1, (len(rows), hybrid.outputs)).astype(np.float32)
        outputs[: len(rows) // 2] = np.sign(outputs[: len(rows) // 2])
        action, _ = hybrid.act(rows, outputs, None, begins)
        assert action.shape == (len(rows), hybrid.rules.task.action_layout.size) and action.dtype == np.float32
        assert np.isfinite(action).all() and np.abs(action).max() <= 1.0, hybrid.kind


@pytest.mark.parametrize("name", TASKS)
def test_weights_of_a_row_are_the_parameters_of_that_row_alone(name: str) -> None:
    rows = rows_of(TASKS[name](), 40, 12)
    for hybrid in hybrids(name):
        if hybrid.kind == "weights":
            outputs = RNG.uniform(-1, 1, (len(rows), hybrid.outputs)).astype(np.float32)
            action, _ = hybrid.act(rows, outputs, None, np.ones(len(rows), np.bool_))
            assert (action != hybrid.act(rows, 0 * outputs, None, np.ones(len(rows), np.bool_))[0]).any()
            values = hybrid.parameters(outputs)
            for k in range(0, len(rows), len(rows) // 40):
                alone = hybrid.rules.with_rules({each: float(of[k]) for each, of in values.items()})
                expected = alone.predict(rows[k : k + 1], None, np.ones(1, np.bool_))[0][0]
                assert action[k] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", TASKS)
def test_a_row_does_not_depend_on_the_others(name: str) -> None:
    rows = rows_of(TASKS[name](), 40, 12)
    for hybrid in hybrids(name):
        outputs = RNG.uniform(-1, 1, (len(rows), hybrid.outputs)).astype(np.float32)
        action, _ = hybrid.act(rows, outputs)
        for k in range(0, len(rows), len(rows) // 20):
            alone, _ = hybrid.act(rows[k : k + 1], outputs[k : k + 1])
            assert alone[0] == pytest.approx(action[k], abs=1e-6), hybrid.kind


def test_weights_reach_both_ends_of_each_range() -> None:
    hybrid = Hybrid.of(Pursuit(), "weights")
    ends = np.repeat(np.array([[-1.0], [0.0], [1.0]], np.float32), hybrid.outputs, axis=1)
    ranges, tuned = ranges_of(type(hybrid.rules.rules)), as_dict(hybrid.rules.rules)
    for name, values in hybrid.parameters(ends).items():
        assert values == pytest.approx([ranges[name][0], tuned[name], ranges[name][1]]) and values[1] == tuned[name]
    middle = Hybrid("weights", hybrid.rules.with_rules({"slow_radius": 0.1}), ranges=hybrid.ranges)
    assert middle.parameters(0.5 * ends)["slow_radius"] == pytest.approx([0.001**0.5, 0.1, 0.2**0.5])  # its logarithm


def test_scores_reach_every_order_of_behaviours_and_zero_keeps_it() -> None:
    hybrid = Hybrid.of(TASKS["flock"](), "priorities")
    every = np.array([*itertools.permutations(range(5))])
    wanted = np.empty((120, 5))
    np.put_along_axis(wanted, every, np.linspace(0.5, -0.5, 5)[None], axis=1)
    outputs = (wanted - np.linspace(0.5, -0.5, 5)).astype(np.float32)
    assert np.abs(outputs).max() <= 1.0
    assert (hybrid.order(outputs) == every).all()
    assert (hybrid.order(np.zeros((1, 5), np.float32)) == range(5)).all()


def test_the_first_behaviour_gets_the_force_limit_first() -> None:
    task = TASKS["obstacles"]()
    rows, hybrid = rows_of(task, 100), Hybrid.of(task, "priorities", "textbook")
    seeks = np.array([[-1.0, -1.0, 1.0]], np.float32).repeat(len(rows), axis=0)
    action, _ = hybrid.act(rows, seeks)
    ordinary, _ = hybrid.act(rows, 0 * seeks)
    without = hybrid.rules.with_rules({"evade": 0.0, "brake": 0.0, "push": 0.0})
    strong = np.linalg.norm(without.predict(rows)[0], axis=1) > 0.999  # seeking alone takes the whole limit
    assert (action[strong] == without.predict(rows)[0][strong]).all() and (ordinary[strong] != action[strong]).any()


def test_a_residual_is_bounded() -> None:
    task = Pursuit()
    rows, hybrid = rows_of(task, 50), Hybrid.of(task, "residual", bound=0.25)
    rules = load_player("rules", task).predict(rows)[0]
    action, _ = hybrid.act(rows, np.sign(RNG.normal(size=(len(rows), 2))).astype(np.float32))
    assert np.abs(action - rules).max() == pytest.approx(0.25, abs=1e-6)
    assert np.abs(action).max() <= 1.0


def test_a_mixture_is_the_weighted_mean_of_both_forces() -> None:
    task = Pursuit()
    rows, hybrid = rows_of(task, 50), Hybrid.of(task, "mixture", bound=0.25)
    outputs = RNG.uniform(-1, 1, (len(rows), 2)).astype(np.float32)
    rules = load_player("rules", task).predict(rows)[0]
    action, _ = hybrid.act(rows, outputs)
    np.testing.assert_allclose(action, 0.75 * rules + 0.25 * outputs, atol=1e-6)
    assert (Hybrid.of(task, "mixture", bound=1.0).act(rows, outputs)[0] == outputs).all()
    with pytest.raises(ValueError, match=r"bound = 1.5: must be above 0 and at most 1$"):
        Hybrid.of(task, "mixture", bound=1.5)


def test_a_gate_hands_over_by_row() -> None:
    task = Pursuit()
    rows, hybrid = rows_of(task, 50), Hybrid.of(task, "gate")
    outputs = RNG.uniform(-1, 1, (len(rows), 3)).astype(np.float32)
    action, _ = hybrid.act(rows, outputs)
    mine = outputs[:, 2] >= 0
    assert 0 < mine.sum() < len(rows)
    assert (action[mine] == outputs[mine, :2]).all()
    assert (action[~mine] == load_player("rules", task).predict(rows)[0][~mine]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_rules_that_remember_keep_their_state(kind: str) -> None:
    task = School()
    rows = rows_of(task)
    hybrid, alone = Hybrid.of(task, kind), player(task)
    rows[:, task.layout.places["fear"]] = max(alone.rules.escape, alone.rules.school) - alone.rules.calm / 2
    outputs = np.full((len(rows), hybrid.outputs), -1.0 if kind == "gate" else 0.0, np.float32)
    before = np.full(len(rows), float(ESCAPE))
    begins = np.arange(len(rows)) % 2 == 0
    action, state = hybrid.act(rows, outputs, before, begins)
    expected, after = alone.predict(rows, before, begins)
    assert (action == expected * share_of_rules(hybrid)).all() and (state == np.asarray(after)).all()
    assert (np.asarray(after) != np.asarray(alone.predict(rows, None)[1])).any()  # that it remembers has an effect


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_plays_as_its_hybrid(kind: str, tmp_path: Path) -> None:
    task = Crossing()
    hybrid = Hybrid.of(task, kind, "rules" if kind == "priorities" else "orca", 0.3)
    path = save(tmp_path / "mine.safetensors", task, hybrid)
    policy = load_player(path, task)
    assert isinstance(policy, HybridPolicy) and policy.hybrid == hybrid
    rows = rows_of(task)
    outputs = super(HybridPolicy, policy).predict(rows, deterministic=True)[0]
    action, _ = policy.predict(rows, deterministic=True)
    assert (action == hybrid.act(rows, outputs)[0]).all()
    one, _ = policy.predict(rows[0], deterministic=True)
    # float32: how BLAS rounds a row alone depends on the processor, and the rules amplify it (1.1e-6 on an EPYC)
    assert one.shape == (2,) and one == pytest.approx(action[0], abs=1e-5)


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
        ({"kind": "weights"}, "hybrid.ranges must hold both ends for each of factor, horizon"),
        ({"kind": "weights", "ranges": {**WIDE, "gain": [9, 1]}}, "hybrid.ranges.gain = [9, 1]: must be two numbers"),
        ({"kind": "weights", "ranges": {**WIDE, "gain": [1]}}, "hybrid.ranges.gain = [1]: must be two numbers"),
        ({"kind": "weights", "ranges": WIDE}, "the network puts out 2 numbers, must be 5"),
        ({"kind": "priorities"}, "tasks whose 'rules' has them: flock, crossing, herd, school"),
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


def test_the_card_keeps_the_ranges_of_weights(tmp_path: Path) -> None:
    task = Pursuit()
    hybrid = Hybrid.of(task, "weights")
    other = Hybrid("weights", hybrid.rules, ranges=tuple((low / 2, 2 * high) for low, high in hybrid.ranges))
    policy = load_player(save(tmp_path / "mine.safetensors", task, other), task)
    assert isinstance(policy, HybridPolicy) and policy.hybrid == other != hybrid


def test_a_card_with_another_order_of_behaviours_is_refused(tmp_path: Path) -> None:
    task = Crossing()
    hybrid = Hybrid.of(task, "priorities")
    path = save(tmp_path / "mine.safetensors", task, hybrid, behaviours=["arrive", "avoid", "separate"])
    with pytest.raises(ValueError, match="must be avoid, separate, arrive, in this order"):
        load_player(path, task)


@pytest.mark.parametrize(
    ("kind", "base", "text"),
    [
        ("residul", "rules", "action = 'residul': unknown, did you mean `residual`?"),
        ("priorities", "rules", "'rules' of 'evade' has no behaviours in an order; tasks whose 'rules' has them: floc"),
    ],
)
def test_kinds_that_rules_do_not_allow_are_refused(kind: str, base: str, text: str) -> None:
    with pytest.raises(ValueError, match="action = ") as caught:
        Hybrid.of(TASKS["evade"](), kind, base)
    assert text in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_plays_without_torch(tmp_path: Path) -> None:
    task = Crossing()
    path = save(tmp_path / "mine.safetensors", task, Hybrid.of(task, "weights"))
    rows = rows_of(task, 1, 1)
    np.save(tmp_path / "rows.npy", rows)
    code = (
        "import sys; sys.modules['torch'] = sys.modules['stable_baselines3'] = None\n"
        "import numpy as np; from flockenv.players import load_player; from flockenv.tasks import Crossing\n"
        f"folder = {str(tmp_path)!r}; policy = load_player(folder + '/mine.safetensors', Crossing())\n"
        "np.save(folder + '/action.npy', policy.predict(np.load(folder + '/rows.npy'), deterministic=True)[0])"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
    expected, _ = load_player(path, task).predict(rows, deterministic=True)
    assert (np.load(tmp_path / "action.npy") == expected).all()


def test_an_unknown_base_is_refused() -> None:
    with pytest.raises(ValueError, match="hand-written player 'rulez': unknown, did you mean `rules`"):
        Hybrid.of(Pursuit(), "residual", "rulez")


def test_a_base_may_be_the_result_of_a_search_seed() -> None:
    each = Hybrid.of(TASKS["bottleneck"](), "mixture", "queueing@5", 0.4)
    found = load_tuned("bottleneck", "queueing").by_seed
    assert as_dict(each.rules.rules) == {**as_dict(player(TASKS["bottleneck"](), "queueing").rules), **found[5]}
    assert (
        each.card["base"] == "queueing" and each.card["rules"]["headway"] == found[5]["headway"] != found[1]["headway"]
    )
    assert Hybrid.from_card(each.card, TASKS["bottleneck"]()) == each
    with pytest.raises(ValueError, match=r"^player 'queueing@77': no such seed; of task 'bottleneck' there are queue"):
        Hybrid.of(TASKS["bottleneck"](), "mixture", "queueing@77")
