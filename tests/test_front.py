"""Fronts: conduct of players, the points of a front, and the command that makes file, picture and page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import front
from agents.conduct import SLOW, ConductWorld
from flockenv.evaluation import rollout, worlds_for
from flockenv.players.policy import save_policy
from flockenv.players.rules import player
from flockenv.studies.play_jobs import Player, Worlds, episodes_of_bytes, play_job
from flockenv.tasks import Bottleneck, Pursuit
from tests.test_tasks import place

TASK = Bottleneck(people=4, together=True, horizon=25)


def test_conduct_is_measured_while_learners_are_in_the_world() -> None:
    """Two people stand before the door, a third pushes one of them against the wall, and a fourth leaves at once."""
    world = ConductWorld(TASK, 1, 25)
    world.reset(0)
    place(world, np.array([(5.76, 1.0), (5.2, 1.0), (1.0, 5.0), (6.2, 3.0)]), 0.0)
    world.state.vel[0, 3] = (1.5, 0.0)
    actions = np.array([[[1, 0], [1, 0], [0, 0], [0.6, 0]]], float)
    frozen, effort, decisions, harmed = 0, 0.0, 0, np.zeros(4, bool)
    for _ in range(20):
        step = world.step(actions)
        inside = step.alive[0]
        frozen += (inside & (np.linalg.norm(world.state.vel[0], axis=1) < SLOW * 1.5)).sum()
        effort += np.array([1, 1, 0, 0.36])[inside].sum()
        decisions += inside.sum()
        harmed |= step.terms[0, :, TASK.terms.index("hurt")] < 0
    assert inside.tolist() == [True, True, True, False] and 0 < harmed.sum() < 4
    measured = world.measure()
    assert measured["harmed"][0] == harmed.sum()
    assert measured["frozen"][0] == pytest.approx(frozen / decisions) and 0.3 < frozen / decisions < 1
    assert measured["effort"][0] == pytest.approx(effort / decisions)
    assert measured["time"][0] == pytest.approx(decisions * 0.1 / 4)
    assert measured["most_pressure"][0] > 1600


def test_conduct_changes_nothing_else_and_begins_anew_with_an_episode() -> None:
    first = worlds_for("evaluation", 0, 3)
    plain = rollout(TASK, player(TASK), 3, first)
    watched = rollout(TASK, player(TASK), 3, first, make_world=ConductWorld)
    np.testing.assert_array_equal(plain.returns, watched.returns)
    for name in plain.metrics:
        np.testing.assert_array_equal(plain.metrics[name], watched.metrics[name])
    assert watched.metrics.keys() - plain.metrics.keys() == {"harmed", "frozen", "effort", "time"}
    world = ConductWorld(TASK, 2, 25)
    for _ in range(2):
        world.reset(7)
        world.step(np.ones((2, 4, 2)))
        assert world.measure()["time"].tolist() == pytest.approx([0.1, 0.1])
    with pytest.raises(ValueError, match="mask: "):
        world.reset(mask=[True, False])
    with pytest.raises(ValueError, match="'pursuit': has no reward term of harm"):
        ConductWorld(Pursuit())


def test_a_job_plays_in_the_given_worlds() -> None:
    rules = Player.of("rules")
    plain = play_job("front", TASK, rules, 2, 0)
    watched = play_job("front", TASK, rules, 2, 0, within=Worlds(ConductWorld, "conduct"))
    assert plain.key != watched.key
    episodes = episodes_of_bytes(watched.function(*watched.arguments))
    assert "frozen" in episodes.metrics and "frozen" not in episodes_of_bytes(plain.function(*plain.arguments)).metrics


# --- the command ------------------------------------------------------------------------------------------------------


def priced_policy(path: Path, seed: int, price: float = 1.0) -> None:
    """Write a policy that observes the price: it pushes to the door, harder at a low price."""
    task = Bottleneck(together=True, price=price)
    weight = np.zeros((2, task.layout.size), np.float32)
    weight[0, task.layout.places["log_price"]] = -0.5
    bias = np.array([0.8 + 0.01 * seed, 0.0], np.float32)
    tensors = {"action.weight": weight, "action.bias": bias, "log_std": np.zeros(2, np.float32)}
    from flockenv.players.policy import describe

    save_policy(path, tensors, {"activation": "relu", **describe(task)})


def study(folder: Path, **more: Any) -> Path:
    """Write a study of two prices in two worlds."""
    plan = {
        "title": "Front", "worlds": 2, "seed": 3,
        "players": {name: name for name in ("random", "queueing", "rules")}
        | {"priced": f"{folder}/{{task}}-*.safetensors"},
        "tasks": {"bottleneck": {"price": [0.5, 20]}}, **more,
    }  # fmt: skip
    path = folder / "price.yaml"
    path.write_text(json.dumps(plan), encoding="utf-8")
    return path


def test_a_front_has_a_point_per_player_and_price(tmp_path: Path) -> None:
    for seed in (0, 1):
        priced_policy(tmp_path / f"bottleneck-{seed}.safetensors", seed)
    arguments = [str(study(tmp_path)), "--out", str(tmp_path / "fronts"), "--processes", "1"]
    result = CliRunner().invoke(front.app, arguments)
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "fronts" / "bottleneck.json").read_text(encoding="utf-8"))
    points = content["players"]
    assert list(points) == ["random", "queueing", "rules", "priced 0.5", "priced 20"]
    assert [points[name]["seeds"] for name in points] == [1, 1, 1, 2, 2]
    assert content["best_rules"] in ("queueing", "rules") and "against_rules" not in points[content["best_rules"]]
    dear = points["priced 20"]
    task, first = Bottleneck(together=True, price=20.0), worlds_for("evaluation", 3, 2)
    members = [Player.of(str(tmp_path / f"bottleneck-{seed}.safetensors")).policy(task, 3) for seed in (0, 1)]
    played = [rollout(task, member, 2, first, make_world=ConductWorld) for member in members]
    harm = np.array([each.terms["pressed"] + each.terms["hurt"] for each in played])
    returns = np.array([each.returns for each in played]) - harm
    assert (harm < 0).any()
    assert dear["return_without_harm"][0] == pytest.approx(returns.mean(), rel=1e-5)
    assert dear["return"][0] == pytest.approx((returns + harm / 20).mean(), rel=1e-5)
    assert dear["by_seed"]["return"] == pytest.approx((returns + harm / 20).mean(axis=1))
    harmed = np.array([each.metrics["harmed"] for each in played])
    assert dear["harmed"][0] == pytest.approx(harmed.mean()) and dear["worlds_with_harm"][0] == (harmed > 0).mean()
    assert points["priced 0.5"]["effort"][0] > dear["effort"][0]  # it observes the price
    page = (tmp_path / "fronts.md").read_text(encoding="utf-8")
    assert f"`priced 20` (2 seeds) | {dear['return'][0]:.3g} [" in page
    assert f"The hand-written player with the highest return is `{content['best_rules']}`. Ahead of it" in page
    assert (tmp_path / "fronts" / "bottleneck.png").read_bytes().startswith(b"\x89PNG")
    again = CliRunner().invoke(front.app, arguments)
    assert again.exit_code == 0 and "done" not in again.stderr  # all records are stored
    assert (tmp_path / "fronts.md").read_text(encoding="utf-8") == page


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"tasks": {"pursuit": {}}}, "tasks.pursuit: has no price of harm; these have one: bottleneck, crowd_nav"),
        ({"tasks": {"bottleneck": {"people": [4]}}}, "tasks.bottleneck: people=4: a front varies the price alone"),
        ({"tasks": {"bottleneck": {"price": [0]}}}, "price = 0"),
        ({"tasks": {"bottleneck": {"pric": [1]}}}, "did you mean `price`?"),
    ],
)
def test_a_bad_study_is_refused_in_one_line(tmp_path: Path, changes: dict[str, Any], text: str) -> None:
    arguments = [str(study(tmp_path, **changes)), "--out", str(tmp_path / "fronts")]
    result = CliRunner().invoke(front.app, arguments)
    assert result.exit_code == 2
    assert text in result.stderr and len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "fronts.md").exists()


def test_the_page_names_players_that_are_safe_and_ahead() -> None:
    def point(success: float, low: float) -> dict[str, Any]:
        return {"success": [success, 0, 1], "against_rules": [low + 1, low, low + 2]}

    points = {"rules": {"success": [0.99, 0, 1]}, "a": point(0.96, 0.1), "b": point(0.9, 0.1), "c": point(0.99, -0.1)}
    text = front._sentence({"players": points, "best_rules": "rules"})
    assert text.endswith("above 0: `a`, `b`. With a success rate above 95%: `rules`, `a`, `c`. Both: `a`.")
