"""Training of hybrids, and in several drawn settings at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.drawn import check_settings, drawn_settings, hybrid_of
from agents.drawn_env import DrawnVecEnv
from agents.experiment import Experiment, PpoSettings
from agents.ppo import export, train
from agents.run import expected_bytes, recipe_of
from agents.training import card_of, score
from agents.training_env import learning_env
from agents.training_job import training_job
from flockenv.envs.disturbance import Disturbance
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.evaluation import rollout, worlds_for
from flockenv.players import load_player
from flockenv.players.hybrid import HybridPolicy
from flockenv.tasks import Crossing, Pursuit
from tests.training import TINY, interrupt

SMALL_SCHOOL = {"fish": 3, "patches": 2, "horizon": 20}


def experiment(task: str = "pursuit", arguments: dict[str, Any] | None = None, **ppo: Any) -> Experiment:
    return Experiment(task=task, arguments=arguments or {}, ppo={**TINY, "steps": 1024, "stagger": True, **ppo})


# --- drawn settings ---------------------------------------------------------------------------------------------------


def test_all_combinations_are_drawn() -> None:
    found = drawn_settings(Crossing(), Disturbance(delay=1), {"agents": [4, 8], "noise": [0, 0.1]})
    assert [name for name, _, _ in found] == [
        "agents 4, noise 0", "agents 4, noise 0.1", "agents 8, noise 0", "agents 8, noise 0.1",
    ]  # fmt: skip
    assert [task.learners for _, task, _ in found] == [4, 4, 8, 8]
    assert [(each.noise, each.delay) for _, _, each in found] == [(0, 1), (0.1, 1)] * 2


@pytest.mark.parametrize(
    ("draw", "text"),
    [
        ({"agnts": (4,)}, "ppo.draw.agnts: unknown, did you mean `agents`?"),
        ({"agents": ()}, "ppo.draw.agents: must have at least one value"),
        ({"agents": (0,)}, "ppo.draw (agents 0): Crossing: agents = 0"),
        ({"noise": (2.0,)}, "ppo.draw (noise 2.0): Disturbance: noise = 2"),
        ({"neighbours": (2,)}, "ppo.draw (neighbours 2): observations have other slots"),
        ({"agents": tuple(range(2, 70))}, "ppo.draw: 68 combinations, at most 64"),
        ({"agents": (2, 3, 4, 5, 6)}, "ppo.draw: 5 combinations need as many ppo.worlds"),
    ],
)
def test_bad_draws_are_refused(draw: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match="draw") as caught:
        check_settings(experiment("crossing", draw=draw))
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"draw": {"agents": (4,)}, "central_critic": True}, "draw: not together with central_critic"),
        ({"draw": {"agents": (4,)}, "taught": 1}, "draw: not together with taught"),
        ({"action": "residual", "central_critic": True}, "action = 'residual': not together with central_critic"),
        ({"action": "residul"}, "action = 'residul'"),
        ({"bound": 0.0}, "bound = 0"),
    ],
)
def test_settings_that_exclude_each_other_are_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match="PpoSettings") as caught:
        PpoSettings(**changes)
    assert text in str(caught.value)


def test_a_base_that_the_task_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match="no hand-written player 'queueing' for 'pursuit'"):
        check_settings(experiment(action="residual", base="queueing"))


def test_rows_of_drawn_settings_are_those_of_their_own_worlds() -> None:
    p = PpoSettings(**{**TINY, "worlds": 6, "reward_scale": 1.0, "dtype": "float64", "draw": {"agents": (2, 5)}})
    env = learning_env(Crossing(), p)
    assert isinstance(env, DrawnVecEnv) and env.num_envs == 3 * 2 + 3 * 5
    alone = [WorldVecEnv(Crossing(agents=count), 3) for count in (2, 5)]
    for each in (env, *alone):
        each.seed(5)
    rows: Any = env.reset()
    assert (rows == np.concatenate([each.reset() for each in alone])).all()
    actions = np.random.default_rng(0).uniform(-1, 1, (21, 2))
    for _ in range(3):
        rows, rewards, dones, infos = env.step(actions)
        parts = [each.step(part) for each, part in zip(alone, np.split(actions, [6]), strict=True)]
        assert (rows == np.concatenate([part[0] for part in parts])).all()
        assert rewards == pytest.approx(np.concatenate([part[1] for part in parts]))
        assert (dones == np.concatenate([part[2] for part in parts])).all() and len(infos) == 21


# --- recipes ----------------------------------------------------------------------------------------------------------


def test_recipes_without_the_new_settings_are_as_before() -> None:
    assert not {"draw", "action", "base", "bound", "hybrid"} & recipe_of(experiment())["ppo"].keys()
    recipe = recipe_of(experiment(action="residual", bound=0.3))
    assert recipe["hybrid"]["kind"] == "residual" and recipe["ppo"]["bound"] == 0.3


# --- training ---------------------------------------------------------------------------------------------------------

CASES = {
    "residual": experiment(action="residual"),
    "gate": experiment(action="gate"),
    "drawn-weights": experiment("crossing", draw={"agents": (2, 3)}, action="weights"),
    "priorities": experiment("crossing", action="priorities"),
    "school-weights": experiment("school", SMALL_SCHOOL, action="weights", worlds=4),
    "drawn": experiment("crossing", draw={"agents": (2, 3), "noise": (0.0, 0.1)}, hold=2),
    "drawn-residual": experiment("crossing", draw={"agents": (2, 3)}, action="residual", base="orca"),
    "school-residual": experiment("school", SMALL_SCHOOL, action="residual", draw={"noise": (0.0, 0.1)}, worlds=4),
}


SLOW = ("priorities", "drawn-weights", "school-weights", "drawn-residual", "school-residual")


@pytest.mark.slow
@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow if c in SLOW else ()) for c in CASES])
def test_resumed_training_equals_the_uninterrupted_one(case: str, tmp_path: Path) -> None:
    whole = train(CASES[case], tmp_path / "whole")
    interrupt(CASES[case], tmp_path / "parts")
    resumed = train(CASES[case], tmp_path / "parts", go_on=True)
    assert resumed.tensors.keys() == whole.tensors.keys()
    for name, tensor in whole.tensors.items():
        assert (resumed.tensors[name] == tensor).all(), name
    assert [point["mean"] for point in resumed.curve] == [point["mean"] for point in whole.curve]


@pytest.mark.slow
@pytest.mark.parametrize("case", ["residual", "gate", "drawn-weights", "priorities", "drawn-residual"])
def test_an_exported_hybrid_plays_as_in_training(case: str, tmp_path: Path) -> None:
    each = CASES[case]
    run = train(each, tmp_path)
    run.tensors["action.weight"] = 30.0 * run.tensors["action.weight"]  # after so few steps, its outputs are near 0
    export(run, tmp_path / "mine.safetensors")
    task = each.build()
    policy = load_player(tmp_path / "mine.safetensors", task)
    assert isinstance(policy, HybridPolicy) and policy.hybrid == hybrid_of(task, each.ppo)
    assert card_of(run)["hybrid"] == policy.hybrid.card
    home = PpoSettings(**{**each.ppo.model_dump(), "draw": {}})
    env = learning_env(task, PpoSettings(**{**home.model_dump(), "dtype": "float64", "stagger": False}))
    env.seed(0)
    env.reset()
    for _ in range(5):
        found = env.step(np.ones((env.num_envs, policy.hybrid.outputs), np.float32))[0]
    rows = np.asarray(found)
    outputs = super(HybridPolicy, policy).predict(rows, deterministic=True)[0]
    expected, _ = policy.predict(rows, None, np.ones(len(rows), np.bool_), True)
    given: list[np.ndarray] = []
    monkey: Any = env
    monkey.venv.step_async = given.append
    env.step_async(outputs)
    assert (given[0] == expected).all()
    assert score(task, home, run.tensors)[0] == pytest.approx(score(task, home, run.tensors)[0])


def test_an_untrained_residual_is_near_its_rules(tmp_path: Path) -> None:
    each = experiment("pursuit", action="residual", steps=16, evaluate_worlds=16)
    start = train(each, tmp_path).curve[0]["mean"]
    rules = rollout(Pursuit(), load_player("rules", Pursuit()), 16, worlds_for("tuning", 0, 16)).returns.mean()
    assert start == pytest.approx(rules, abs=0.5)


def test_memory_is_stated_for_all_drawn_settings(tmp_path: Path) -> None:
    home = experiment("flock", worlds=64)
    drawn = experiment("flock", worlds=64, draw={"agents": (24, 384)})
    assert expected_bytes(drawn) > 1.5 * expected_bytes(home)
    assert training_job(drawn, tmp_path).memory > training_job(home, tmp_path).memory


@pytest.mark.parametrize(("name", "draw"), [("flock", {"agents": (8, 24)}), ("crossing", {"agents": (4, 12)})])
def test_drawn_settings_keep_the_other_arguments(name: str, draw: dict[str, Any]) -> None:
    task = experiment(name, {"integrator": {"kind": "velocity_verlet"}, "max_speed": 1.5}).build()
    for learned in (task, task.model_copy(update={"dtype": "float32"})):
        for (_, drawn, _), count in zip(drawn_settings(learned, Disturbance(), draw), draw["agents"], strict=True):
            changed = {key for key in type(task).model_fields if getattr(drawn, key) != getattr(learned, key)}
            assert changed <= {"agents", "learners", "scene"} and drawn.learners == count
