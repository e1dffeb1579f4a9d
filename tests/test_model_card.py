"""Model cards: the page beside the weights of each task is made of its JSON card, in the form of model hubs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from flockenv.envs.table import ENVIRONMENTS
from flockenv.players import PUBLISHED, WEIGHTS, weights_file
from flockenv.players.model_card import cards_in, folder_card, model_card
from flockenv.players.rules import PLAYERS, load_tuned
from flockenv.tasks import TASKS

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("task", TASKS)
def test_the_page_of_each_task_is_made_of_its_card(task: str) -> None:
    """If this fails, run `python -m flockenv.players.model_card`."""
    card = json.loads(weights_file(task).with_suffix(".json").read_text(encoding="utf-8"))
    page = weights_file(task).with_suffix(".md").read_text(encoding="utf-8")
    assert page == model_card(card)
    assert card["sha256"] in page and card["recipe"]["command"] in page
    assert all(f"| `{name}` | `" in page for name in card["arguments"])
    assert all(f"| `{slot['name']}` | " in page for slot in card["observation"] if 0 not in slot["shape"])


@pytest.mark.parametrize("task", TASKS)
def test_hubs_find_task_library_and_score_at_the_top_of_the_page(task: str) -> None:
    _, front, _ = weights_file(task).with_suffix(".md").read_text(encoding="utf-8").split("---\n", 2)
    about, card = yaml.safe_load(front), json.loads(weights_file(task).with_suffix(".json").read_text(encoding="utf-8"))
    assert (about["license"], about["library_name"], about["pipeline_tag"]) == (
        "mit", "flockenv", "reinforcement-learning",
    )  # fmt: skip
    (model,) = about["model-index"]
    (result,) = model["results"]
    assert result["dataset"]["type"] == ENVIRONMENTS[TASKS[task].__name__].id
    assert result["metrics"][0]["value"] == pytest.approx(card["tuning_mean"], abs=0.005)
    assert result["task"]["type"] == "reinforcement-learning" and model["name"].startswith("ppo-")


@pytest.mark.parametrize("task", TASKS)
def test_the_policy_and_the_rules_that_ship_are_median_runs_and_the_card_says_so(task: str) -> None:
    card = json.loads(weights_file(task).with_suffix(".json").read_text(encoding="utf-8"))
    runs = [(card["seed"], card["tuning_mean"], card["seeds"]["scores"])]
    for name in PUBLISHED:
        if task in PLAYERS[name]:
            found = load_tuned(task, name).found
            runs.append((found["seed"], found["tuning_mean"], found["scores"]))
    for seed, mean, scores in runs:
        ordered = sorted(scores.values())
        assert scores[str(seed)] == ordered[(len(ordered) - 1) // 2] == pytest.approx(mean, rel=1e-4)
    page = weights_file(task).with_suffix(".md").read_text(encoding="utf-8")
    assert f"(the median of {len(card['seeds']['scores'])} training seeds, " in page


def test_weights_are_named_on_a_card_of_their_folder() -> None:
    """If this fails, run `python -m flockenv.players.model_card agents/policies/* agents/priced`."""
    weights = [path for room in ("flockenv", "agents") for path in (ROOT / room).rglob("*.safetensors")]
    assert len(weights) > 100
    for folder in {path.parent for path in weights} - {WEIGHTS}:
        page = (folder / "README.md").read_text(encoding="utf-8")
        assert page == folder_card(cards_in(folder), folder.name)
        assert all(f"\n| {path.name} | " in page for path in weights if path.parent == folder)
    assert all(path.with_suffix(".md").is_file() for path in weights if path.parent == WEIGHTS)


def test_a_card_says_which_algorithm_and_hybrid_it_is() -> None:
    card = json.loads((ROOT / "agents/policies/residual/crossing-seed-0.json").read_text(encoding="utf-8"))
    page = model_card({**card, "algorithm": "SAC (stable-baselines3)"})
    about = yaml.safe_load(page.split("---\n")[1])
    assert "# SAC, residual on orca for flockenv/Crossing" in page and "# PPO" not in page
    assert about["tags"][1:3] == ["sac", "residual"] and about["model-index"][0]["name"].startswith("sac-")


def test_a_page_follows_its_card() -> None:
    card = json.loads(weights_file("pursuit").with_suffix(".json").read_text(encoding="utf-8"))
    before, after = model_card(card), model_card({**card, "tuning_mean": 1.25, "seed": 77})
    assert "| mean return | 8.29 (" in before and "| mean return | 1.25 (" in after and "| seed | 77 |" in after
