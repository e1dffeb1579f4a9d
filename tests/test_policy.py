"""Policies: the actor of SB3 in numpy, the checks of policy files, and the task that a policy's card names."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from agents.experiment import PpoSettings
from agents.invasion import Among, jobs_of
from agents.warm_start import starting_policy
from flockenv.core.warnings import OtherTaskWarning
from flockenv.evaluation import rollout
from flockenv.players import load_player
from flockenv.players.independent import stack_networks
from flockenv.players.policy import MlpPolicy, OtherSlotsError, Policy, RandomPolicy, describe, save_policy
from flockenv.studies.play_jobs import Player
from flockenv.tasks import TASKS, Corridor, Crossing, Flock, Pursuit, Task

TASK: Any = SimpleNamespace(
    name="toy", layout=SimpleNamespace(size=5, digest="abc"), action_layout=SimpleNamespace(size=2)
)
CARD = {"activation": "tanh", "layout": "abc", "task": "toy", "steps": 1000, "wall_time_s": 1.5}


def tensors(sizes: tuple[int, ...] = (5, 7, 6, 2), seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    names = [f"policy.{k}" for k in range(len(sizes) - 2)] + ["action"]
    made = {"log_std": rng.normal(-1, 0.1, sizes[-1])}
    for name, inputs, outputs in zip(names, sizes, sizes[1:], strict=False):
        made[f"{name}.weight"], made[f"{name}.bias"] = rng.normal(size=(outputs, inputs)), rng.normal(size=outputs)
    return {name: tensor.astype(np.float32) for name, tensor in made.items()}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "toy.safetensors"
    save_policy(path, tensors(), CARD)
    return path


def rewrite(path: Path, **changes: Any) -> None:
    card = json.loads(path.with_suffix(".json").read_text())
    card = {key: value for key, value in {**card, **changes}.items() if value is not None}
    path.with_suffix(".json").write_text(json.dumps(card))


def replace_weights(path: Path, data: bytes) -> None:
    """Replace the weights, and update their digest in the card."""
    path.write_bytes(data)
    rewrite(path, sha256=hashlib.sha256(data).hexdigest())


# --- the random player


def test_random_player_is_uniform_reproducible_and_records_its_seed() -> None:
    a, b = RandomPolicy(3, seed=7), RandomPolicy(3, seed=7)
    rows = np.zeros((20_000, 9), np.float32)
    first, state = a.predict(rows, deterministic=True)
    assert first.dtype == np.float32
    assert first.shape == (20_000, 3)
    assert state is None
    np.testing.assert_array_equal(first, b.predict(rows)[0])
    assert not np.array_equal(first, a.predict(rows)[0])
    assert np.abs(first).max() <= 1
    np.testing.assert_allclose(np.quantile(first, [0.1, 0.5, 0.9]), [-0.8, 0.0, 0.8], atol=0.02)
    unseeded = RandomPolicy(3)
    again = RandomPolicy(3, unseeded.seed)
    np.testing.assert_array_equal(unseeded.predict(rows)[0], again.predict(rows)[0])
    assert RandomPolicy(3, 0).predict(rows[0])[0].shape == (3,)
    with pytest.raises(ValueError, match="action_size: 0"):
        RandomPolicy(0)


# --- networks of single learners


def independent(path: Path, task: Task, count: int) -> list[dict[str, np.ndarray]]:
    """Write a policy of several networks for a task; return the tensors of each."""
    networks = [tensors((task.layout.size, 7, 6, task.action_layout.size), seed) for seed in range(count)]
    save_policy(path, stack_networks(networks), {"activation": "tanh", **describe(task)})
    return networks


def test_each_learner_acts_by_its_own_network(tmp_path: Path) -> None:
    task = Crossing(agents=3)
    networks = independent(tmp_path / "p.safetensors", task, 3)
    policy = MlpPolicy.load(tmp_path / "p.safetensors", task)
    assert policy.card["networks"] == policy.learners == 3 and policy.differences == ()
    rows = np.random.default_rng(0).uniform(-1, 1, (12, task.layout.size)).astype(np.float32)
    actions, state = policy.predict(rows, deterministic=True)
    for k, network in enumerate(networks):
        alone = MlpPolicy(network, CARD).predict(rows[k::3], deterministic=True)[0]
        np.testing.assert_array_equal(actions[k::3], alone)
    assert state is None and np.abs(actions[0::3] - actions[1::3]).max() > 0.1
    sampled = policy.predict(rows)[0]
    assert len(np.unique(sampled - actions)) > 12, "the networks' samples are not the same numbers"


def test_networks_of_single_learners_play_rows_of_whole_worlds_only(tmp_path: Path) -> None:
    task = Crossing(agents=3, horizon=10)
    independent(tmp_path / "p.safetensors", task, 3)
    policy = load_player(tmp_path / "p.safetensors", task)
    for rows in (np.zeros((4, task.layout.size)), np.zeros(task.layout.size)):
        with pytest.raises(ValueError, match=r"must have a row for each of 3 learners, whose networks differ"):
            policy.predict(rows)
    assert rollout(task, policy, 2, 0).worlds == 2
    with pytest.raises(ValueError, match="has a network for each of 3 learners, which play together only"):
        rollout(task, policy, 3, 0, make_world=lambda task, worlds, limit: Among(task, worlds, limit, policy))
    with pytest.raises(OtherSlotsError, match="has a network for each of 3 learners, task 'crossing' has 4"):
        load_player(tmp_path / "p.safetensors", Crossing(agents=4))
    player = Player.of(str(tmp_path / "p.safetensors"))
    with pytest.raises(ValueError, match="player 'p': has a network for each learner, which play together only"):
        jobs_of(task, [player], 2)
    with pytest.raises(ValueError, match="its actor is squashed, recurrent or of several networks"):
        starting_policy(PpoSettings(start=player.spec, hidden=(7, 6), activation="tanh"), task)


@pytest.mark.parametrize("name", ["policy.0.weight", "log_std"])
def test_tensors_of_different_numbers_of_networks_are_refused(name: str) -> None:
    several = stack_networks([tensors(), tensors(seed=1)])
    with pytest.raises(ValueError, match=f"tensor '{name}' is of 1 networks, 'action.bias' of 2"):
        MlpPolicy.of_tensors({**several, name: several[name][:1]}, CARD)


# --- the actor in numpy


def test_actor_equals_a_network_computed_by_hand() -> None:
    t = {
        "policy.0.weight": np.array([[1, -2], [0.5, 0]], np.float32),
        "policy.0.bias": np.array([0.1, -1], np.float32),
        "action.weight": np.array([[2, 3]], np.float32),
        "action.bias": np.array([0.25], np.float32),
        "log_std": np.array([-2], np.float32),
    }
    x = np.array([0.3, 0.1], np.float32)
    hidden = np.array([0.3 - 0.2 + 0.1, 0.15 - 1])
    tanh = 2 * np.tanh(hidden[0]) + 3 * np.tanh(hidden[1]) + 0.25
    relu = 2 * 0.2 + 0.25
    assert MlpPolicy(t, {"activation": "tanh"}).predict(x, deterministic=True)[0] == pytest.approx(max(tanh, -1))
    assert MlpPolicy(t, {"activation": "relu"}).predict(x, deterministic=True)[0] == pytest.approx(relu, rel=1e-6)


def test_actor_takes_one_or_many_rows_clips_and_does_not_change_its_input() -> None:
    policy = MlpPolicy(tensors(), CARD)
    rows = np.random.default_rng(1).normal(size=(50, 5)).astype(np.float32)
    before = rows.copy()
    rows.flags.writeable = False
    actions, state = policy.predict(rows, ("kept",), None, True)  # type: ignore[arg-type]
    assert actions.shape == (50, 2)
    assert actions.dtype == np.float32
    assert state == ("kept",)
    np.testing.assert_array_equal(rows, before)
    np.testing.assert_allclose(policy.predict(rows[3], deterministic=True)[0], actions[3], atol=1e-6)
    assert actions.max() == 1  # some outputs are clipped
    assert actions.min() == -1
    with pytest.raises(ValueError, match=r"observation: shape \(50, 4\), must be \(5,\) or \(rows, 5\)"):
        policy.predict(rows[:, :4])
    with pytest.raises(ValueError, match="observation: shape"):
        policy.predict(rows[None])
    assert policy.predict(rows[:0])[0].shape == (0, 2)


def test_actor_samples_the_gaussian_of_its_log_std_from_its_own_generator() -> None:
    t = tensors((5, 2))
    t = {
        **t,
        "action.weight": 0 * t["action.weight"],
        "action.bias": np.float32([0.1, -0.2]),
        "log_std": np.float32([-3, -2]),
    }
    rows = np.zeros((40_000, 5), np.float32)
    np.random.seed(0)  # noqa: NPY002 - the global generator must not matter
    actions = MlpPolicy(t, CARD, seed=3).predict(rows)[0]
    np.testing.assert_array_equal(actions, MlpPolicy(t, CARD, seed=3).predict(rows)[0])
    assert not np.array_equal(actions, MlpPolicy(t, CARD, seed=4).predict(rows)[0])
    np.testing.assert_allclose(actions.mean(axis=0), [0.1, -0.2], atol=4 * np.exp(-2) / 200)
    np.testing.assert_allclose(actions.std(axis=0), np.exp([-3, -2]), rtol=0.02)
    assert np.abs(MlpPolicy({**t, "log_std": np.float32([3, 3])}, CARD).predict(rows)[0]).max() == 1


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_actor_equals_stable_baselines3(activation: str) -> None:
    torch = pytest.importorskip("torch")
    policies = pytest.importorskip("stable_baselines3.common.policies")
    from gymnasium.spaces import Box

    kind = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[activation]
    torch.manual_seed(0)
    theirs = policies.ActorCriticPolicy(
        Box(-1, 1, (11,), np.float32),
        Box(-1, 1, (2,), np.float32),
        lambda _: 1e-3,
        net_arch={"pi": [64, 48], "vf": [8]},
        activation_fn=kind,
        ortho_init=False,
    )
    given = theirs.state_dict()
    names = {
        "policy.0": "mlp_extractor.policy_net.0",
        "policy.1": "mlp_extractor.policy_net.2",
        "action": "action_net",
    }
    t = {f"{a}.{part}": given[f"{b}.{part}"].numpy() for a, b in names.items() for part in ("weight", "bias")}
    ours = MlpPolicy({**t, "log_std": given["log_std"].numpy()}, {"activation": activation})
    rows = np.random.default_rng(0).uniform(-1, 1, (501, 11)).astype(np.float32)  # full blocks and a partial one
    expected, _ = theirs.predict(rows, deterministic=True)
    np.testing.assert_allclose(ours.predict(rows, deterministic=True)[0], expected, atol=1e-6)
    np.testing.assert_allclose(ours.predict(rows[0], deterministic=True)[0], expected[0], atol=1e-6)


def test_importing_and_using_a_policy_needs_no_torch() -> None:
    code = (
        "import sys, numpy as np; from flockenv.players.policy import MlpPolicy, RandomPolicy;"
        "RandomPolicy(2).predict(np.zeros((3, 4)));"
        "bad = {'torch', 'matplotlib', 'stable_baselines3'} & set(sys.modules); assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent.parent)


# --- files


@pytest.mark.filterwarnings("ignore:.*does not list the arguments")
def test_a_saved_policy_is_loaded_unchanged(saved: Path) -> None:
    policy = MlpPolicy.load(saved, TASK)
    rows = np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)
    expected = MlpPolicy(tensors(), CARD).predict(rows, deterministic=True)[0]
    np.testing.assert_array_equal(policy.predict(rows, deterministic=True)[0], expected)
    assert isinstance(policy, Policy)
    assert policy.card["steps"] == 1000
    assert policy.card["sha256"] == hashlib.sha256(saved.read_bytes()).hexdigest()
    assert (policy.card["observation_size"], policy.card["action_size"]) == (5, 2)
    assert sorted(path.name for path in saved.parent.iterdir()) == ["toy.json", "toy.safetensors"]
    assert repr(policy) == "MlpPolicy(5 -> 7 -> 6 -> 2, tanh, seed=0)"
    save_policy(saved, tensors(), policy.card)  # a card that was read can be written again


@pytest.mark.filterwarnings("ignore:.*does not list the arguments")
def test_a_network_without_hidden_layers_is_allowed(tmp_path: Path) -> None:
    save_policy(tmp_path / "linear.safetensors", tensors((5, 2)), CARD)
    assert MlpPolicy.load(tmp_path / "linear.safetensors", TASK).predict(np.ones(5))[0].shape == (2,)


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.99])
def test_truncated_weights_are_refused_in_one_line(saved: Path, kept: float) -> None:
    data = saved.read_bytes()
    saved.write_bytes(data[: int(kept * len(data))])
    refused(saved, "not those of the card")
    replace_weights(saved, data[: int(kept * len(data))])
    refused(saved, "not a safetensors file")


def test_one_flipped_bit_is_refused(saved: Path) -> None:
    data = bytearray(saved.read_bytes())
    data[len(data) // 2] ^= 1
    saved.write_bytes(data)
    refused(saved, "not those of the card")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("action.bias", None, "tensor 'action.bias' is missing"),
        ("log_std", None, "tensor 'log_std' is missing"),
        ("policy.0.weight", None, "tensor 'policy."),
        ("value.bias", np.zeros(2, np.float32), "tensor 'value.bias' is not one of an MLP actor"),
        ("policy.9.weight", np.zeros((2, 2), np.float32), "tensor 'policy."),
        ("policy.1.bias", np.zeros(5, np.float32), r"tensor 'policy.1.bias' has shape \(5,\), .* \(6,\)"),
        ("policy.1.weight", np.zeros((6, 6), np.float32), r"tensor 'policy.1.weight' has shape \(6, 6\), .* \(6, 7\)"),
        ("policy.1.weight", np.zeros(6, np.float32), r"tensor 'policy.1.weight' has shape \(6,\)"),
        ("policy.0.weight", np.zeros((7, 0), np.float32), r"tensor 'policy.0.weight' has shape \(7, 0\)"),
        ("policy.0.weight", np.float32(1), "tensor 'policy.0.weight' has shape"),
        ("log_std", np.zeros(3, np.float32), r"tensor 'log_std' has shape \(3,\)"),
        ("log_std", np.zeros(2), "tensor 'log_std' is float64, must be float32"),
        ("action.bias", np.float32([np.nan, 0]), "tensor 'action.bias' holds NaN or infinity"),
        ("action.bias", np.float32([np.inf, 0]), "tensor 'action.bias' holds NaN or infinity"),
    ],
)
def test_foreign_tensors_are_refused_at_load_and_at_save(saved: Path, name: str, change: Any, message: str) -> None:
    wrong = {key: value for key, value in {**tensors(), name: change}.items() if value is not None}
    target = saved.parent / "new" / "wrong.safetensors"
    with pytest.raises(ValueError, match=message):
        save_policy(target, wrong, CARD)
    assert not target.parent.exists()
    replace_weights(saved, save({key: np.ascontiguousarray(value) for key, value in wrong.items()}))
    refused(saved, message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"activation": "tahn"}, "activation: 'tahn', did you mean `tanh`\\?; allowed: 'tanh', 'relu'"),
        ({"activation": "__import__('os')"}, "allowed: 'tanh', 'relu'"),
        ({"activation": ["tanh"]}, "allowed: 'tanh', 'relu'"),
        ({"activation": None}, "lacks 'activation'"),
        ({"sha256": None}, "lacks 'sha256'"),
        ({"version": 2}, "has version 2; this flockenv reads 1"),
        ({"observation_size": 6}, "the card says observation_size = 6, the weights are for 5"),
        ({"action_size": 3}, "the card says action_size = 3, the weights are for 2"),
        ({"layout": "abd"}, "made for observation layout 'abd', task 'toy' has 'abc'"),
        ({"layout": None}, "made for observation layout None, task 'toy' has 'abc'"),
    ],
)
def test_cards_that_do_not_fit_are_refused(saved: Path, change: dict[str, Any], message: str) -> None:
    rewrite(saved, **change)
    refused(saved, message)


def test_another_tasks_sizes_are_refused(saved: Path) -> None:
    wider = SimpleNamespace(**{**vars(TASK), "layout": SimpleNamespace(size=9, digest="abc")})
    with pytest.raises(ValueError, match="made for observation_size = 5, task 'toy' has 9"):
        MlpPolicy.load(saved, wider)
    stronger = SimpleNamespace(**{**vars(TASK), "action_layout": SimpleNamespace(size=3)})
    with pytest.raises(ValueError, match="made for action_size = 2, task 'toy' has 3"):
        MlpPolicy.load(saved, stronger)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "is not JSON"),
        (b"{", "is not JSON"),
        (b"\xff\xfe{}", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b"[]", "holds a list, must be an object"),
        (b'{"version": 1, "version": 1}', "names 'version' twice"),
        (b'{"version": NaN}', "holds NaN"),
        (b" " * (9 << 20), "at most 8388608 are read"),
    ],
)
def test_broken_cards_are_refused(saved: Path, text: bytes, message: str) -> None:
    saved.with_suffix(".json").write_bytes(text)
    refused(saved, message)


def test_missing_files_are_refused(saved: Path) -> None:
    saved.with_suffix(".json").rename(saved.parent / "elsewhere.json")
    refused(saved, "'toy.json' cannot be read: No such file")
    (saved.parent / "elsewhere.json").rename(saved.with_suffix(".json"))
    saved.unlink()
    refused(saved, "'toy.safetensors' cannot be read: No such file")


def refused(path: Path, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        MlpPolicy.load(path, TASK)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("policy '")
    assert len(str(caught.value)) < 600


def test_cards_that_contradict_their_weights_are_not_saved(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="card: observation_size = 6, the weights say 5"):
        save_policy(tmp_path / "x.safetensors", tensors(), {**CARD, "observation_size": 6})
    with pytest.raises(ValueError, match=r"must end in \.safetensors"):
        save_policy(tmp_path / "x.npz", tensors(), CARD)
    with pytest.raises(ValueError, match="not JSON compliant"):
        save_policy(tmp_path / "x.safetensors", tensors(), {**CARD, "score": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_a_failed_save_leaves_the_old_policy(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {path.name: path.read_bytes() for path in saved.parent.iterdir()}

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_policy(saved, tensors(seed=1), CARD)
    assert {path.name: path.read_bytes() for path in saved.parent.iterdir()} == before


# --- the task of a card, and the task that is played


def kept(folder: Path, task: Task, **changes: Any) -> Path:
    """Save a policy that returns zeros, with a card that describes `task`; return its path."""
    inputs, outputs = task.layout.size, task.action_layout.size
    zeros = {"action.weight": np.zeros((outputs, inputs), np.float32), "action.bias": np.zeros(outputs, np.float32)}
    path = folder / "own.safetensors"
    card = {"activation": "tanh", **describe(task), **changes}
    save_policy(path, {**zeros, "log_std": np.zeros(outputs, np.float32)}, card)
    return path


@pytest.mark.parametrize("kind", TASKS.values(), ids=TASKS)
def test_a_policy_loads_for_the_task_of_its_card_without_differences(tmp_path: Path, kind: type[Task]) -> None:
    assert MlpPolicy.load(kept(tmp_path, kind()), kind()).differences == ()


@pytest.mark.parametrize(
    ("trained", "played", "expected"),
    [
        (Crossing(), Crossing(agents=24), ("agents = 24, trained with 12", "learners = 24, trained with 12")),
        (Corridor(people=12), Corridor(people=12, dt=0.025), ("dt = 0.025, trained with 0.05",)),
        (
            Crossing(),
            Crossing(max_speed=1.5),
            ("max_speed = 1.5, trained with 2.0", "observation velocity has scale 1.5 m/s, trained with 2"),
        ),
        (
            Crossing(),
            Crossing(max_force=9.0),
            ("max_force = 9.0, trained with 5.0", "action force has scale 9 N, "),
        ),
    ],
)
def test_other_arguments_and_scales_are_allowed_with_a_warning(
    tmp_path: Path, trained: Task, played: Task, expected: tuple[str, ...]
) -> None:
    path = kept(tmp_path, trained)
    with pytest.warns(OtherTaskWarning) as caught:
        policy = MlpPolicy.load(path, played)
    assert len(caught) == 1 and "\n" not in str(caught[0].message)
    assert str(caught[0].message).startswith(f"policy {str(path)!r}: ")
    for phrase in expected:
        assert any(found.startswith(phrase) for found in policy.differences), policy.differences
        assert phrase in str(caught[0].message)
    action, _ = policy.predict(np.zeros((3, played.layout.size), np.float32))
    assert action.shape == (3, played.action_layout.size)


@pytest.mark.parametrize(
    ("trained", "played", "expected"),
    [
        (
            Crossing(),
            Crossing(neighbours=4),
            r"made for observation 'neighbours' of shape \(6, 2\) in 'm', task",
        ),
        (
            Crossing(),
            Corridor(),
            "made for observation 'goal' .* task 'corridor' has 'desired_speed' of",
        ),
        (Flock(rays=6), Flock(), r"of shape \(6,\) in '.*', task 'flock' has '.*' of shape \(16,\)"),
    ],
)
def test_other_slots_are_refused_with_the_first_that_differs(
    tmp_path: Path, trained: Task, played: Task, expected: str
) -> None:
    with pytest.raises(ValueError, match=expected) as caught:
        MlpPolicy.load(kept(tmp_path, trained), played)
    assert "\n" not in str(caught.value)


def test_an_argument_missing_from_a_card_has_its_default(tmp_path: Path) -> None:
    path = kept(tmp_path, Corridor())
    card = json.loads(path.with_suffix(".json").read_text())
    del card["arguments"]["settling"]
    path.with_suffix(".json").write_text(json.dumps(card))
    assert MlpPolicy.load(path, Corridor()).differences == ()
    with pytest.warns(OtherTaskWarning):
        policy = MlpPolicy.load(path, Corridor(settling=7.0))
    assert policy.differences == (f"settling = 7.0, trained with {Corridor().settling}",)


def test_many_differences_warn_in_one_line_and_are_all_stored(tmp_path: Path) -> None:
    changed = Pursuit(evader_force=4.0, capture_distance=0.7, horizon=200, size=25.0, dt=0.025, control_dt=0.05)
    with pytest.warns(OtherTaskWarning, match="; and .* more$"):
        policy = MlpPolicy.load(kept(tmp_path, Pursuit()), changed)
    assert len(policy.differences) > 6


def test_a_card_without_slots_fits_only_its_own_digest(tmp_path: Path) -> None:
    path = kept(tmp_path, Pursuit())
    rewrite(path, observation=None, action=None)
    with pytest.warns(OtherTaskWarning, match="the card does not list the arguments of its task"):
        MlpPolicy.load(path, Pursuit())
    with pytest.raises(ValueError, match="and the card does not list its slots"):
        MlpPolicy.load(path, Pursuit(size=30.0))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"observation": 3}, "the card's 'observation' is 3, must be a list of slots"),
        ({"observation": [3]}, r"the card's 'observation' is \[3\], must be a list of slots"),
        ({"action": "all"}, "the card's 'action' is 'all', must be a list of slots"),
        ({"action": None}, "the card's 'action' is None, must be a list of slots"),
        ({"observation": [{"name": "x"}]}, "the card's 'observation' has a slot whose 'shape' is None"),
        ({"observation": []}, "made for observation nothing, task 'pursuit' has"),
    ],
)
def test_a_card_with_broken_slots_is_refused(tmp_path: Path, change: dict[str, Any], expected: str) -> None:
    path = kept(tmp_path, Pursuit())
    rewrite(path, **change)
    with pytest.raises(ValueError, match=expected):
        MlpPolicy.load(path, Pursuit())
