"""Players of several seeds: shipping the median, names with a seed, and what is refused."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file
from typer.testing import CliRunner

from agents.experiment import CONFIGS, load_experiment
from agents.search import Found
from agents.ship import BLOCK, Files, app, ship, trainings
from agents.study import Study, contenders_of
from flockenv import players
from flockenv.players import NAMES, WEIGHTS, known_name, load_player, other_tasks, seeds_of_player
from flockenv.players.policy import save_policy
from flockenv.players.rules import as_dict, load_tuned, player
from flockenv.studies.play_jobs import Player, members_of
from flockenv.tasks import TASKS, Flock, Pursuit

ROOT = CONFIGS.parent.parent
CONFIG = CONFIGS / "pursuit.yaml"
SHIPPED = json.loads((WEIGHTS / "pursuit.json").read_text(encoding="utf-8"))
TEXTBOOK = as_dict(player(Pursuit(), "textbook").rules)
ROWS = np.linspace(-1, 1, 4 * Pursuit().layout.size).astype(np.float32).reshape(4, -1)


def trained(folder: Path, seed: int, mean: float, ppo: Any = (), changes: Any = ()) -> Path:
    """Write a policy as agents.ppo --seeds does: the one that ships, with other weights for each seed."""
    tensors = load_file(WEIGHTS / "pursuit.safetensors")
    tensors["action.bias"] = tensors["action.bias"] + np.float32(0.01 * (seed + 1))
    about = {key: value for key, value in SHIPPED.items() if key not in ("sha256", "seeds")}
    recipe = {**SHIPPED["recipe"], "ppo": {**SHIPPED["recipe"]["ppo"], "seed": seed, **dict(ppo)}}
    card = {**about, "seed": seed, "recipe": recipe, "tuning_mean": mean, **dict(changes)}
    folder.mkdir(exist_ok=True)
    path = folder / f"pursuit-seed-{seed}.safetensors"
    save_policy(path, tensors, {key: value for key, value in card.items() if value is not None})
    return path


def searched(folder: Path, seed: int, mean: float, **changes: Any) -> Path:
    """Write the outcome of a search as agents.tune does."""
    curve = [{"steps": 10 * k, "seconds": 0.5 * k, "mean": k / 3, "success": 0.5, "best": k / 3} for k in range(3)]
    values = {**TEXTBOOK, next(iter(TEXTBOOK)): 5.0 + seed}
    found = Found(
        task="pursuit", player="rules", seed=seed, parameters=values, tuning_mean=mean, tuning_success=0.75,
        textbook_mean=1.0, textbook_success=0.5, tuning_worlds=512, agent_steps=30, evaluation_steps=9, seconds=1.5,
        generations=3, candidates=4, worlds=96, at_bounds={}, curve=curve,
    )  # fmt: skip
    settings = load_experiment(CONFIG).search.model_dump(mode="json")
    folder.mkdir(exist_ok=True)
    path = folder / f"pursuit-rules-seed-{seed}.json"
    path.write_text(json.dumps({**asdict(found), "settings": settings, **changes}), encoding="utf-8")
    return path


@pytest.fixture
def target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty checkout whose players are used in place of those that ship."""
    (tmp_path / "root" / "docs").mkdir(parents=True)
    (tmp_path / "root" / "docs" / "players.md").write_text("<!-- python -m agents.ship -->\n<!-- end -->\n")
    monkeypatch.setattr(players, "WEIGHTS", tmp_path / "root" / "flockenv" / "players" / "weights")
    monkeypatch.setattr("flockenv.players.rules.TUNED", tmp_path / "root" / "flockenv" / "players" / "tuned")
    return tmp_path / "root"


def files(root: Path) -> list[str]:
    """Return the files of the players of a checkout."""
    folder = root / "flockenv" / "players"
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


# --- policies ---------------------------------------------------------------------------------------------------------


def test_the_median_policy_ships_and_the_others_are_kept(tmp_path: Path, target: Path) -> None:
    for seed, mean in ((1, 8.0), (2, 9.0), (4, 8.5), (7, 7.0)):
        trained(tmp_path / "ppo", seed, mean)
    (line,) = ship([tmp_path / "ppo"], target)
    assert line == "pursuit, ppo: seed 1, the median of 4: 8.000, all from 7.000 to 9.000"
    kept = [f"weights/seeds/pursuit-seed-{seed}" for seed in (2, 4, 7)]
    assert files(target) == sorted(
        [
            "weights/pursuit.md",
            *(f"{name}.{end}" for name in ["weights/pursuit", *kept] for end in ("json", "safetensors")),
        ]
    )
    page = (players.WEIGHTS / "pursuit.md").read_text()
    assert "| mean return | 8 (the median of 4 training seeds, 7 to 9) |" in page
    card = json.loads((players.WEIGHTS / "pursuit.json").read_text())
    assert card["seed"] == 1 and card["tuning_mean"] == 8.0
    assert card["seeds"] == {"scores": {"1": 8.0, "2": 9.0, "4": 8.5, "7": 7.0}, "lowest": 7.0, "highest": 9.0}
    assert card["recipe"]["command"] == "python -m agents.ppo configs/training/pursuit.yaml --seed 1"
    assert seeds_of_player("ppo", "pursuit") == (1, 2, 4, 7)
    row = (target / "docs" / "players.md").read_text().splitlines()[3]
    assert row.startswith("| pursuit | -inf |") and row.endswith("| 4 of 4 |"), "without rules every policy passes them"


def test_a_name_with_a_seed_is_the_policy_of_that_seed(tmp_path: Path, target: Path) -> None:
    sources = {seed: trained(tmp_path / "ppo", seed, float(seed)) for seed in (1, 2, 3)}
    ship([tmp_path / "ppo"], target)
    actions = {
        name: load_player(name, Pursuit()).predict(ROWS, deterministic=True)[0]
        for name in ("ppo", *(f"ppo@{seed}" for seed in sources))
    }
    for seed, path in sources.items():
        expected = load_player(path, Pursuit()).predict(ROWS, deterministic=True)[0]
        np.testing.assert_array_equal(actions[f"ppo@{seed}"], expected)
    np.testing.assert_array_equal(actions["ppo"], actions["ppo@2"])
    assert (actions["ppo@1"] != actions["ppo@2"]).any()


def test_what_ships_takes_part_if_its_recipe_is_the_same(tmp_path: Path, target: Path) -> None:
    trained(tmp_path / "a", 0, 5.0)
    ship([tmp_path / "a"], target)
    trained(tmp_path / "b", 1, 6.0)
    trained(tmp_path / "b", 2, 7.0)
    ship([tmp_path / "b"], target)
    assert seeds_of_player("ppo", "pursuit") == (1, 0, 2)
    trained(tmp_path / "c", 2, 5.5)  # in place of the former one
    ship([tmp_path / "c"], target)
    assert seeds_of_player("ppo", "pursuit") == (2, 0, 1)
    assert not (players.WEIGHTS / "seeds" / "pursuit-seed-2.json").exists(), "it ships and is not kept twice"


def test_what_ships_is_left_out_if_its_recipe_is_another(tmp_path: Path, target: Path) -> None:
    for seed in (0, 1):
        trained(tmp_path / "old", seed, 9.0)
    ship([tmp_path / "old"], target)
    for path in target.rglob("*.json"):
        card = json.loads(path.read_text())
        card["recipe"]["ppo"]["epochs"] = 77
        path.write_text(json.dumps(card))
    trained(tmp_path / "new", 5, 1.0)
    (line,) = ship([tmp_path / "new"], target)
    assert line.endswith("seed 5, the median of 1: 1.000, all from 1.000 to 1.000; of another recipe, left out: 0, 1")
    assert seeds_of_player("ppo", "pursuit") == (5,)
    assert files(target) == ["weights/pursuit.json", "weights/pursuit.md", "weights/pursuit.safetensors"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ppo": {"gamma": 0.5}}, "ppo.gamma = 0.5: another recipe than configs/training/pursuit.yaml, with 0.99"),
        ({"arguments": {**SHIPPED["arguments"], "size": 21.0}}, "arguments.size = 21.0: another recipe than"),
        ({"algorithm": "SAC"}, "algorithm = 'SAC': another recipe than configs/training/pursuit.yaml, with 'PPO"),
        ({"tuning_mean": None}, "its card has no tuning_mean"),
        ({"seed": 9}, "its card is of 'pursuit', seed 9"),
        ({"task": "flock"}, "its card is of 'flock', seed 3"),
    ],
)
def test_a_policy_of_another_recipe_is_refused_in_one_line(
    changes: dict[str, Any], message: str, tmp_path: Path, target: Path
) -> None:
    trained(tmp_path / "ppo", 1, 8.0)
    trained(tmp_path / "ppo", 3, 8.0, changes.get("ppo", ()), {k: v for k, v in changes.items() if k != "ppo"})
    run = CliRunner().invoke(app, [str(tmp_path / "ppo"), "--root", str(target)])
    assert run.exit_code == 2
    assert run.output.startswith("error: ") and message in run.output and run.output.count("\n") == 1
    assert "pursuit-seed-3" in run.output
    assert files(target) == []


def test_two_runs_of_one_seed_are_refused_in_one_line(tmp_path: Path, target: Path) -> None:
    trained(tmp_path / "a", 1, 8.0)
    trained(tmp_path / "b", 1, 9.0)
    run = CliRunner().invoke(app, [str(tmp_path / "a"), str(tmp_path / "b"), "--root", str(target)])
    assert run.exit_code == 2 and ": another folder has a run of that seed too" in run.output
    assert run.output.count("\n") == 1 and files(target) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [("none", "no such folder"), ("empty", "neither TASK-seed-N.safetensors nor"), ("odd", "'mine' is no task")],
)
def test_folders_without_runs_are_refused_in_one_line(name: str, message: str, tmp_path: Path, target: Path) -> None:
    (tmp_path / "empty").mkdir()
    trained(tmp_path / "odd", 1, 8.0).rename(tmp_path / "odd" / "mine-seed-1.safetensors")
    run = CliRunner().invoke(app, [str(tmp_path / name), "--root", str(target)])
    assert run.exit_code == 2 and message in run.output and run.output.count("\n") == 1
    assert files(target) == []


# --- hand-written players ---------------------------------------------------------------------------------------------


def test_searches_ship_with_the_parameters_and_curve_of_every_seed(tmp_path: Path, target: Path) -> None:
    for seed, mean in ((1, 8.0), (2, 9.0), (4, 8.5)):
        searched(tmp_path / "tune", seed, mean)
    run = CliRunner().invoke(app, [str(tmp_path / "tune"), "--root", str(target)])
    assert run.exit_code == 0, run.output
    assert "pursuit, rules: seed 4, the median of 3: 8.500, all from 8.000 to 9.000\n" in run.output
    assert seeds_of_player("rules", "pursuit") == (4, 1, 2)
    first = next(iter(TEXTBOOK))
    for name, value in (("rules", 9.0), ("rules@4", 9.0), ("rules@1", 6.0), ("rules@2", 7.0)):
        found: Any = load_player(name, Pursuit())
        assert as_dict(found.rules) == {**TEXTBOOK, first: value}
    searches = load_tuned("pursuit").found["searches"]
    assert searches["2"]["curve"]["mean"] == [0, 0.33333, 0.66667] and searches["2"]["success"] == 0.75


def test_searches_that_ship_take_part_unless_they_are_others(tmp_path: Path, target: Path) -> None:
    for seed, mean in ((1, 8.0), (2, 9.0), (4, 8.5)):
        searched(tmp_path / "tune", seed, mean)
    CliRunner().invoke(app, [str(tmp_path / "tune"), "--root", str(target)])
    before = load_tuned("pursuit").found
    searched(tmp_path / "more", 4, 9.5)
    searched(tmp_path / "more", 5, 9.25)
    run = CliRunner().invoke(app, [str(tmp_path / "more"), "--root", str(target)])
    assert "pursuit, rules: seed 2, the median of 4: 9.000, all from 8.000 to 9.500\n" in run.output
    found = load_tuned("pursuit").found
    assert found["scores"] == {"1": 8.0, "2": 9.0, "4": 9.5, "5": 9.25}
    assert {seed: found["searches"][seed] for seed in "12"} == {seed: before["searches"][seed] for seed in "12"}
    searched(tmp_path / "other", 6, 9.75, textbook_mean=1.5)
    run = CliRunner().invoke(app, [str(tmp_path / "other"), "--root", str(target)])
    assert "seed 6, the median of 1: 9.750, all from 9.750 to 9.750; of another search, left out: 1, 2, 4, 5" in (
        run.output
    )


def test_searches_of_other_settings_are_refused_in_one_line(tmp_path: Path, target: Path) -> None:
    searched(tmp_path / "tune", 1, 8.0)
    other = {**load_experiment(CONFIG).search.model_dump(mode="json"), "sigma": 0.5}
    searched(tmp_path / "tune", 2, 8.0, settings=other)
    run = CliRunner().invoke(app, [str(tmp_path / "tune"), "--root", str(target)])
    assert run.exit_code == 2 and "search.sigma = 0.5: another search than" in run.output
    assert run.output.count("\n") == 1 and files(target) == []
    searched(tmp_path / "tune", 2, 8.0, parameters={"gain": 3.0})
    assert "parameters" in CliRunner().invoke(app, [str(tmp_path / "tune"), "--root", str(target)]).output
    (tmp_path / "tune" / "pursuit-rules-seed-2.json").write_text("{}")
    assert "no outcome of a search" in CliRunner().invoke(app, [str(tmp_path / "tune"), "--root", str(target)]).output


# --- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ppo@7", "player 'ppo@7': no such seed; of task 'pursuit' there are ppo@1, ppo@2"),
        ("ppo@*", "player 'ppo@*': stands for all seeds, but one is needed here; of task 'pursuit' there are ppo@1"),
        ("rules@1", "player 'rules@1': no such seed; of task 'pursuit' there are none"),
        ("random@1", "player 'random@1': 'random' has no seeds; allowed with one: orca, heuristics, queueing, rules"),
        ("ppo@x", "player 'ppo@x': a seed is a number, as in ppo@3; allowed: random,"),
        ("ppo@", "player 'ppo@': a seed is a number, as in ppo@3; allowed: random,"),
        ("rule@1", "player 'rule@1': unknown, did you mean `rules`?"),
        ("orca@0", "there is no hand-written player 'orca' for 'pursuit'; there is one for: crossing"),
    ],
)
def test_unknown_seeds_are_refused_in_one_line(name: str, message: str, tmp_path: Path, target: Path) -> None:
    for seed in (1, 2):
        trained(tmp_path / "ppo", seed, 8.0)
    ship([tmp_path / "ppo"], target)
    with pytest.raises(ValueError, match="player") as caught:
        load_player(name, Pursuit())
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_names_of_seeds_are_known_names() -> None:
    assert [known_name(name) for name in ("ppo", "ppo@3", "ppo@*", "rules@12")] == ["ppo", "ppo", "ppo", "rules"]
    assert [known_name(name) for name in ("ppo@", "ppo@-1", "ppo@3.py", "mine@3", "ppo@²", "mine.py")] == 6 * [None]
    assert other_tasks("orca@1", "flock") == other_tasks("orca", "flock") != ()


def test_all_seeds_are_the_members_of_one_player(tmp_path: Path, target: Path) -> None:
    for seed in (1, 2, 3):
        trained(tmp_path / "ppo", seed, float(seed))
    ship([tmp_path / "ppo"], target)
    assert members_of(Player.of("ppo@*"), "pursuit") == tuple(Player(f"ppo@{seed}", "ppo") for seed in (2, 1, 3))
    assert members_of(Player.of("ppo@*"), "flock") == (Player("ppo", "ppo"),), "it has no seeds there"
    assert members_of(Player.of("ppo@3"), "pursuit") == (Player("ppo@3", "ppo@3"),)
    study = Study(title="small", players={"ppo": "ppo@*", "orca": "orca@*"}, tasks={"pursuit": {}})
    (contender,) = contenders_of(study, "pursuit")
    assert contender.name == "ppo" and len(contender.members) == 3
    (few,) = contenders_of(study.model_copy(update={"seeds": 2}), "pursuit")
    assert few.members == contender.members[:2], "the one that ships, and the next"


def test_every_seed_that_is_there_can_be_loaded() -> None:
    """Of the players that ship; with one seed, all seeds are that one."""
    for task in (Pursuit(), Flock()):
        for name in NAMES:
            for member in members_of(Player(f"{name}@*", name), task.name) if not other_tasks(name, task.name) else ():
                member.policy(task, 0)
            assert seeds_of_player(name, task.name) == () or name in players.SEEDED


def test_the_table_of_the_page_is_that_of_the_players_that_ship() -> None:
    """If this fails, run `python -m agents.ship`."""
    page = (ROOT / "docs" / "players.md").read_text(encoding="utf-8")
    assert BLOCK.findall(page) == [trainings(Files(ROOT))]
    assert trainings(Files(ROOT)).count("\n") == 2 + len(TASKS)
