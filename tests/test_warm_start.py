"""Trainings that begin with a trained policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.drawn import check_settings
from agents.experiment import CONFIGS, Experiment, PpoSettings, load_experiment
from agents.ppo import build, export, tensors_of, train
from agents.run import Run, recipe_of, start_path
from agents.training import card_of
from agents.warm_start import starting_policy, use_weights
from flockenv.players import WEIGHTS, load_player, seeds_of_player, weights_file
from flockenv.players.policy import MlpPolicy

FEW: dict[str, Any] = {"worlds": 2, "rollout": 4, "minibatch": 8, "threads": 1, "evaluate_worlds": 2, "steps": 8}
PRICED = {"price": 3.0, "horizon": 30}


def experiment(arguments: dict[str, Any] = PRICED, **changes: Any) -> Experiment:
    return Experiment(task="crowd_nav", arguments=arguments, ppo=PpoSettings(**{**FEW, "start": "ppo", **changes}))


def test_learning_begins_with_the_policy_and_ignores_what_it_does_not_observe() -> None:
    each = experiment()
    task, p = each.build(), each.ppo
    model = build(task, p)
    use_weights(model, starting_policy(p, task))
    mine = MlpPolicy(tensors_of(model), {"activation": "relu"})
    shipped = load_player("ppo", task.model_copy(update={"price": None, "horizon": 250}))
    rows = np.random.default_rng(0).uniform(-1, 1, (50, task.layout.size)).astype(np.float32)
    expected = shipped.predict(rows[:, :-1], deterministic=True)[0]
    np.testing.assert_allclose(mine.predict(rows, deterministic=True)[0], expected, atol=1e-6)
    assert (tensors_of(model)["log_std"] == np.float32(p.log_std)).all()


@pytest.mark.slow
def test_a_training_and_its_recipe_name_the_start(tmp_path: Path) -> None:
    each = experiment(critic_first=8)  # the actor does not learn yet
    run = train(each, tmp_path)
    shipped = MlpPolicy.load(WEIGHTS / "crowd_nav.safetensors")
    np.testing.assert_array_equal(run.tensors["policy.0.weight"][:, :-1].T, shipped.layers[0][0])
    assert run.recipe["start"] == shipped.card["sha256"] and run.recipe["ppo"]["start"] == "ppo"
    assert "start" not in recipe_of(experiment(start=None)) | recipe_of(experiment(start=None))["ppo"]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"start": "no.safetensors"}, "no.safetensors"),
        ({"start": "ppo@77"}, "player 'ppo@77': no such seed; of task 'crowd_nav' there are ppo@0, ppo@1"),
        ({"start": "ppo@*", "seed": 78}, "player 'ppo@78': no such seed; of task 'crowd_nav' there are ppo@0, ppo@1"),
        ({"hidden": (32, 64)}, "ppo.start = 'ppo': its network is ((64, 64), 'relu'), must be ((32, 64), 'relu')"),
        ({"arguments": {"neighbours": 5}}, "its observations or actions are not those of the task"),
        ({"start": str(WEIGHTS / "bottleneck.safetensors")}, "its observations or actions are not those of the task"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused_in_one_line(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        check_settings(experiment(**changes))
    assert text in str(caught.value) and "\n" not in str(caught.value)


def test_learning_may_begin_with_a_policy_of_another_seed_or_of_its_own() -> None:
    task, (ships, other, *_) = experiment().build(), seeds_of_player("ppo", "crowd_nav")
    assert start_path("ppo", task, other) == start_path(f"ppo@{ships}", task, other) == weights_file("crowd_nav")
    assert start_path(f"ppo@{other}", task, ships) == weights_file("crowd_nav", other)
    assert start_path("ppo@*", task, other) == weights_file("crowd_nav", other)
    assert start_path("ppo@*", task, ships) == weights_file("crowd_nav")
    assert recipe_of(experiment(start="ppo@*", seed=other))["start"] != recipe_of(experiment(seed=other))["start"]


@pytest.mark.slow
def test_a_mixture_begins_with_the_policy_that_it_mixes(tmp_path: Path) -> None:
    each = experiment(action="mixture", bound=0.6, base="orca", critic_first=8)
    run = train(each, tmp_path)
    export(run, tmp_path / "mine.safetensors")
    task = each.build()
    mixed, rules = load_player(tmp_path / "mine.safetensors", task), load_player("orca", task)
    shipped = load_player("ppo", task.model_copy(update={"price": None, "horizon": 250}))
    rows = np.random.default_rng(0).uniform(-1, 1, (50, task.layout.size)).astype(np.float32)
    parts = [rules.predict(rows)[0], shipped.predict(rows[:, :-1], deterministic=True)[0]]
    expected = 0.4 * parts[0] + 0.6 * parts[1]
    np.testing.assert_allclose(mixed.predict(rows, deterministic=True)[0], expected, atol=1e-5)


@pytest.mark.parametrize("config", ["crowd_nav", "crowd_nav_priced", "crowd_nav_drawn", "crossing_residual"])
def test_a_card_names_the_config_and_the_options_of_its_recipe(config: str) -> None:
    given = load_experiment(CONFIGS / f"{config}.yaml")
    for changes, options in (({}, ""), ({"steps": 4000}, " --steps 4000"), ({"seed": 3}, " --seed 3")):
        run = Run(recipe_of(given.with_ppo(**changes)), {})
        command = f"python -m agents.ppo configs/training/{config}.yaml{options}"
        assert card_of(run)["recipe"]["command"] == command
    run = Run(recipe_of(given.with_ppo(worlds=7)), {})
    assert card_of(run)["recipe"]["command"] == "python -m agents.ppo CONFIG.yaml", "one that is not ours"


@pytest.mark.parametrize("more", [{"action": "residual"}, {"taught": 1}, {"central_critic": True}])
def test_settings_that_exclude_a_start_are_refused(more: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"start: not together with {next(iter(more))}"):
        experiment(**more)
