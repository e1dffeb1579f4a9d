"""One score over tasks, and the benchmark of a player."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import benchmark
from agents.benchmark import app, table
from agents.planners import mppi
from agents.scores import aggregate
from agents.study_results import Score, SettingResults, kind_of, read_task
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.world import World
from flockenv.evaluation import rollout, worlds_for
from flockenv.players import load_player, weights_file
from flockenv.players.rules import TUNED
from flockenv.tasks import Obstacles, Pursuit

ROOT = Path(__file__).resolve().parent.parent
TRIVIAL = sorted((ROOT / "agents" / "trivial").glob("[a-z]*.py"))


def setting(player: np.ndarray, rules: float = 10.0, random: float = 0.0, worlds: int = 50) -> SettingResults:
    """Return a setting in which the player has these scores, a row per seed."""
    noise = np.random.default_rng(0).normal(size=worlds)
    rows = {"mine": player, "rules": np.array([[rules]]), "random": np.array([[random]])}
    kinds = {"mine": "policy", "rules": "rules", "random": "random"}
    scores = {n: Score(kinds[n], row + noise, row + noise > 0, 0.0) for n, row in rows.items()}
    return SettingResults("home", "", scores, {})


def test_rules_have_score_1_and_random_0() -> None:
    settings = {"a": setting(np.array([[10.0]])), "b": setting(np.array([[0.0]]))}
    assert aggregate(settings, "rules").score.value == pytest.approx(1.0)
    assert aggregate(settings, "random").score.value == pytest.approx(0.0)
    assert aggregate(settings, "mine").by_task == pytest.approx({"a": 1.0, "b": 0.0})


def test_the_scale_is_that_of_each_task() -> None:
    settings = {"a": setting(np.array([[5.0]])), "b": setting(np.array([[-50.0]]), rules=0.0, random=-100.0)}
    assert aggregate(settings, "mine").by_task == pytest.approx({"a": 0.5, "b": 0.5})


def test_the_score_is_the_interquartile_mean_over_tasks_and_seeds() -> None:
    settings = {"a": setting(np.array([[-900.0], [2.0]])), "b": setting(np.array([[4.0], [900.0]]))}
    assert aggregate(settings, "mine").score.value == pytest.approx(0.3)
    assert aggregate(settings, "mine").profile[:3] == pytest.approx((0.75, 0.75, 0.5))


def test_the_interval_contains_the_luck_of_seeds() -> None:
    seeds = np.random.default_rng(1).normal(5.0, 2.0, size=(10, 1))
    settings = {name: setting(seeds) for name in "abcd"}
    interval = aggregate(settings, "mine").score
    assert 0.04 < interval.high - interval.low < 0.3
    same = aggregate({f"a/{name}": setting(seeds) for name in "abcdefgh"}, "mine").score
    alone = aggregate({"a": setting(seeds)}, "mine").score  # eight settings of the same seeds say no more than one
    assert same.high - same.low == pytest.approx(alone.high - alone.low, rel=0.25)
    one = aggregate({name: setting(seeds[:1]) for name in "abcd"}, "mine").score
    assert one.high - one.low < interval.high - interval.low  # of one seed only the luck of worlds is seen


def test_players_that_differ_in_the_fifth_digit_are_no_ties(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    returns: list[float] = []
    monkeypatch.setattr(benchmark, "read_task", lambda content: returns.extend(_returns(content)) or read_task(content))
    run = CliRunner().invoke(app, ["textbook", "--study", "study.yaml", "--out", "board", "--processes", "1"])
    assert run.exit_code == 0, run.output
    assert max(len(f"{abs(value):.12g}".replace(".", "").lstrip("0")) for value in returns) == 6


def _returns(content: Any) -> list[float]:
    players = [player for setting in content["settings"] for player in setting["players"].values()]
    return [value for player in players for row in player["returns"] for value in row]


def test_improvement_counts_ties_half() -> None:
    settings = {"a": setting(np.array([[10.0]])), "b": setting(np.array([[11.0]]))}
    assert aggregate(settings, "mine").improvement.value == pytest.approx(0.75)


def test_a_setting_without_a_scale_is_refused() -> None:
    with pytest.raises(ValueError, match=r"a: rules \(.*\) are not better than random"):
        aggregate({"a": setting(np.array([[1.0]]), rules=-1.0)}, "mine")


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    players = {"random": "random", "rules": "rules"}
    study = {"title": "small", "worlds": 8, "players": players, "tasks": {"pursuit": {"size": [10]}, "obstacles": {}}}
    Path("study.yaml").write_text(json.dumps(study))
    return tmp_path


@pytest.mark.parametrize("path", TRIVIAL, ids=lambda path: path.stem)
def test_trivial_players_fail(path: Path, small: Path) -> None:
    run = CliRunner().invoke(app, [str(path), "--study", "study.yaml", "--out", "board", "--processes", "1"])
    assert run.exit_code == 0, run.output
    entry = json.loads(Path(f"board/{path.stem}.json").read_text())
    assert entry["kind"] == "rules"
    assert entry["home"]["score"][0] < benchmark.LEAST
    assert entry["settings"] + entry["settings_left_out"] == 3
    assert set(entry["home"]["by_task"]) == {"pursuit", "obstacles"}
    assert "does not solve the tasks" in Path("board.md").read_text()


def test_entries_are_ordered_by_score_and_files_of_a_policy_have_that_of_its_name(small: Path) -> None:
    files = str(weights_file("pursuit", None).parent / "{task}.safetensors")
    for player, name in (("textbook", "textbook"), ("ppo", "ppo"), (files, "mine")):
        arguments = ["--name", name, "--study", "study.yaml", "--out", "board", "--processes", "1"]
        run = CliRunner().invoke(app, [player, *arguments])
        assert run.exit_code == 0, run.output
    page = Path("board.md").read_text()
    assert page.index("`ppo`") < page.index("`textbook`")
    entries = [json.loads(path.read_text()) for path in Path("board").glob("*.json")]
    assert table(entries) == page
    kinds = {entry["player"]: entry["kind"] for entry in entries}
    assert kinds == {"textbook": "rules", "ppo": "policy", "mine": "policy"}
    scores = {entry["player"]: (entry["home"], entry["robust"]) for entry in entries}
    assert scores["mine"] == scores["ppo"]


def test_a_policy_of_one_task_alone_is_refused(small: Path) -> None:
    run = CliRunner().invoke(app, [str(weights_file("pursuit", None)), "--study", "study.yaml", "--out", "board"])
    assert run.exit_code == 2 and len(run.output.strip().splitlines()) == 1
    assert "obstacles" in run.output and not Path("board").exists()


def test_an_entry_of_all_seeds_has_their_number(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found: dict[str, Any] = {}
    for task in ("pursuit", "obstacles"):
        found[task] = json.loads((TUNED / f"{task}.json").read_text())
        rules = found[task]["players"]["rules"]
        rules["found"] |= {"seed": 4, "searches": {"1": {"parameters": rules["parameters"]}}}
    Path("tuned").mkdir()
    for task, content in found.items():
        Path(f"tuned/{task}.json").write_text(json.dumps(content))
    monkeypatch.setattr("flockenv.players.rules.TUNED", Path("tuned"))
    run = CliRunner().invoke(app, ["rules@*", "--study", "study.yaml", "--out", "board", "--processes", "1"])
    assert run.exit_code == 0, run.output
    entry = json.loads(Path("board/rules@all.json").read_text())
    assert (entry["player"], entry["spec"], entry["seeds"]) == ("rules@all", "rules@*", 2)
    assert entry["home"]["score"][0] == 1.0, "the same parameters as those that ship, which are the scale"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nobody"], "players.nobody: 'nobody': no such file"),
        (["orca"], "player 'orca' does not play pursuit"),
        (["ppo@99"], "player 'ppo@99': no such seed; of task 'pursuit' there are "),
        (["ppo", "--name", "a b"], "--name 'a b': a name is"),
        (["ppo", "--name", "rules"], "--name 'rules'"),
    ],
)
def test_bad_options_are_one_line(arguments: list[str], text: str, small: Path) -> None:
    run = CliRunner().invoke(app, [*arguments, "--study", "study.yaml"])
    assert run.exit_code == 2
    assert text in run.output and len(run.output.strip().splitlines()) == 1


def test_a_file_says_its_kind(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    text = "import numpy as np\ndef predict(observation):\n    return np.zeros((len(observation), 2))\n"
    path.write_text(text)
    assert kind_of(load_player(path, Pursuit())) == "rules"
    path.write_text(f"kind = 'planner'\n{text}")
    assert kind_of(load_player(path, Pursuit())) == "planner"
    path.write_text(f"kind = 'plan'\n{text}")
    with pytest.raises(ValueError, match="player's kind = 'plan': unknown, did you mean `planner`"):
        kind_of(load_player(path, Pursuit()))


# --- a player that plans ----------------------------------------------------------------------------------------------


def test_a_planner_sees_the_worlds_that_it_plays_in() -> None:
    task = Pursuit()
    planner = load_player(ROOT / "agents" / "planners" / "mppi.py", task)
    seed = worlds_for("tuning", 1, 4)
    planned, random = (rollout(task, player, 4, seed) for player in (planner, load_player("random", task)))
    assert planned.success.all()
    assert planned.returns.mean() > random.returns.mean() + 15
    again = rollout(task, load_player(ROOT / "agents" / "planners" / "mppi.py", task), 4, seed)
    assert (again.returns == planned.returns).all()


def test_a_planner_plays_disturbed_worlds() -> None:
    task = Pursuit()
    make = functools.partial(make_world, disturbance=Disturbance(noise=0.05, delay=1))
    planner = load_player(ROOT / "agents" / "planners" / "mppi.py", task)
    assert rollout(task, planner, 2, worlds_for("tuning", 1, 2), make_world=make).success.all()


def test_copies_of_worlds_continue_as_the_worlds_do() -> None:
    """With the same random numbers and the plan of the rules, a copy has the rewards that the world then gives."""
    task = Obstacles()
    world = World(task, 3)
    rows = world.reset(7).reshape(3, -1)
    planner: Any = mppi.player(task)
    planner.watch(world)
    planner.random = SimpleNamespace(integers=lambda most: 0)
    plans = np.zeros((3, mppi.SAMPLES, *planner.shape))
    expected = planner._play(plans, rows)[:, -1]
    rewards = np.zeros((3, 1))
    for k in range(mppi.HORIZON):
        rewards += world.step(plans[:, -1, k].reshape(3, 1, -1)).reward
    assert rewards == pytest.approx(expected, abs=1e-12)
