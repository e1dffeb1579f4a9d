"""Studies away from home: settings, results, which kind is ahead, and the command."""

from __future__ import annotations

import functools
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import t as student
from typer.testing import CliRunner

from agents.invasion import Among
from agents.study import HOME, Partners, Study, contenders_of, settings_of
from agents.study_report import markdown, winner_text
from agents.study_results import (
    ALONE,
    LEVEL,
    Score,
    SettingResults,
    TaskResults,
    kind_of,
    marks_of,
    read_file,
    read_task,
    stored_marks,
)
from agents.sweep import app, plan_digest, stored_return, sweep
from flockenv.evaluation import bootstrap, lead_interval, mean_interval, rollout, worlds_for
from flockenv.evaluation.report import json_text, rounded
from flockenv.jobs import Store, Work
from flockenv.jobs.local_engine import LocalEngine
from flockenv.physics.integrators import RK4
from flockenv.players import load_player
from flockenv.players.rules import TUNED
from flockenv.scene.yaml_io import load
from flockenv.studies.play_jobs import Player
from flockenv.tasks import TASKS, Crossing, Pursuit

STUDIES = sorted((Path(__file__).resolve().parent.parent / "configs" / "studies").glob("*.yaml"))
PLAYERS = {"random": "random", "textbook": "textbook", "rules": "rules", "ppo": "ppo"}
SMALL = {"players": PLAYERS, "worlds": 3, "everywhere": {"noise": (0.1,)}, "tasks": {"pursuit": {"size": (10,)}}}
RNG = np.random.default_rng(0)


def small(**changes: Any) -> Study:
    return Study(title="small", **{**SMALL, **changes})


def score(kind: str, mean: float, tuning: float = 0.0, seeds: int = 1) -> Score:
    returns = mean + 0.1 * np.random.default_rng(1).normal(size=(seeds, 40))
    return Score(kind, returns, returns > 0, tuning)


# --- intervals --------------------------------------------------------------------------------------------------------


def test_interval_of_one_seed_is_the_bootstrap_over_worlds() -> None:
    returns = RNG.normal(size=200)
    two, one = mean_interval(returns[None]), bootstrap(returns, "mean")
    assert two.value == pytest.approx(one.value)
    assert two.low == pytest.approx(one.low, abs=0.01)
    assert two.high == pytest.approx(one.high, abs=0.01)


def test_interval_contains_the_luck_of_training() -> None:
    seeds = RNG.normal(size=10)
    returns = seeds[:, None] + 0.01 * RNG.normal(size=(10, 300))
    interval = mean_interval(returns)
    half = student.ppf(0.975, 9) * seeds.std(ddof=1) / np.sqrt(10)
    assert (interval.high - interval.low) / 2 == pytest.approx(half, rel=0.1)


@pytest.mark.parametrize("seeds", [2, 3, 5, 10])
def test_intervals_of_few_seeds_cover_the_mean(seeds: int) -> None:
    """Of 300 intervals of 95 %, drawn from a normal distribution over seeds, 88 % at least contain its mean."""
    generator = np.random.default_rng(seeds)
    found = [mean_interval(np.repeat(generator.normal(size=(seeds, 1)), 2, axis=1), 400) for _ in range(300)]
    assert np.mean([each.low <= 0 <= each.high for each in found]) > 0.88


def test_lead_is_paired_by_worlds() -> None:
    worlds = 100 * RNG.normal(size=50)
    lead = lead_interval(worlds[None] + 1.0, worlds[None])
    assert (lead.low, lead.value, lead.high) == pytest.approx((1.0, 1.0, 1.0))


def test_lead_of_seeds_that_differ_more_than_the_lead_is_level() -> None:
    worlds = RNG.normal(size=(1, 200))
    first = worlds + np.array([[1.5], [-1.0], [0.2]])
    lead = lead_interval(first, worlds)
    assert lead.low < 0 < lead.value
    assert lead_interval(first[:1], worlds).low > 0


@pytest.mark.parametrize(
    ("first", "second", "text"),
    [
        (np.zeros(5), np.zeros((1, 5)), r"not \(5,\)"),
        (np.zeros((1, 1)), np.zeros((1, 1)), "two worlds"),
        (np.full((1, 5), np.nan), np.zeros((1, 5)), "finite"),
        (np.zeros((1, 5)), np.zeros((1, 6)), "in 5 and in 6 worlds"),
    ],
)
def test_bad_returns_are_refused(first: Any, second: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        lead_interval(first, second)


# --- which kind is ahead ----------------------------------------------------------------------------------------------


def test_level_unless_the_interval_of_every_lead_is_above_zero() -> None:
    ahead = SettingResults("a", "1", {"rules": score("rules", 1.0), "ppo": score("policy", 2.0)}, {})
    assert ahead.winner == "policy"
    assert ahead.lead is not None and ahead.lead.value == pytest.approx(1.0)
    third = {**ahead.scores, "residual": score("hybrid", 2.0)}
    assert SettingResults("a", "1", third, {}).winner == LEVEL


def test_two_kinds_may_be_level_and_ahead_of_a_third() -> None:
    scores = {"rules": score("rules", 1.0), "ppo": score("policy", 5.0), "residual": score("hybrid", 5.0)}
    setting = SettingResults("agents", "8", scores, {})
    assert setting.winner == LEVEL and setting.behind == ["rules"]
    assert winner_text(setting).endswith("; ahead of rules)")
    home = SettingResults(HOME, "", {"rules": score("rules", 1.0), "ppo": score("policy", 1.0)}, {})
    assert home.winner == LEVEL and home.behind == [] and "ahead" not in winner_text(home)
    page = markdown(small(), "command", [TaskResults("crossing", 40, 0, {}, (home, setting))], "out")
    assert "Settings in which rules are behind the best kind: home: 0 of 1; task: 1 of 1." in page


def test_the_player_of_a_kind_is_chosen_on_tuning_worlds() -> None:
    scores = {"rules": score("rules", 1.0, 5.0), "orca": score("rules", 3.0, 4.0), "ppo": score("policy", 2.0)}
    setting = SettingResults("a", "1", scores, {})
    assert setting.leaders == {"rules": "rules", "policy": "ppo"}
    assert setting.winner == "policy"


def test_kinds_of_players() -> None:
    kinds = [kind_of(load_player(name, Pursuit())) for name in ("random", "textbook", "rules", "ppo")]
    assert kinds == ["random", "rules", "rules", "policy"]


# --- settings ---------------------------------------------------------------------------------------------------------


def test_each_setting_changes_one_thing() -> None:
    study = small(tasks={"pursuit": {"size": (10, 20.0), "both": ({"size": 30, "pursuer_speed": 4},)}})
    settings = settings_of(study, "pursuit", {"evader_speed": 2.0})
    assert [each.name for each in settings] == ["home", "size=10", "both=size 30, pursuer_speed 4", "noise=0.1"]
    tasks: list[Any] = [each.task for each in settings]
    assert [task.size for task in tasks] == [20, 10, 30, 20]  # 20.0 is home
    assert {task.evader_speed for task in tasks} == {2.0}
    assert settings[-1].disturbance.noise == 0.1


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"tasks": {"pursit": {}}}, "tasks.pursit: unknown, did you mean `pursuit`?"),
        ({"everywhere": {"nois": (0.1,)}}, "everywhere.nois: unknown, did you mean `noise`?"),
        ({"players": {**PLAYERS, "a b": "ppo"}}, "a name is up to 40"),
        ({"worlds": 1}, "worlds = 1"),
        ({"everywhere": {"noise": (2.0,)}}, "Disturbance: noise = 2"),
    ],
)
def test_bad_studies_are_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match="Study") as caught:
        small(**changes)
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"sise": (10,)}, "tasks.pursuit.sise: unknown, did you mean `size`?"),
        ({"size": (-1,)}, "tasks.pursuit.size: Pursuit: size = -1"),
        ({"noise": (2.0,)}, "tasks.pursuit.noise: Disturbance: noise = 2"),
    ],
)
def test_bad_settings_are_refused(values: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match="tasks") as caught:
        settings_of(small(tasks={"pursuit": values}), "pursuit")
    assert text in str(caught.value)


def test_values_for_all_tasks_are_left_out_where_they_do_not_apply() -> None:
    study = small(everywhere={"dropped": (0.2,), "dt": (0.1,)}, tasks={"path_follow": {}, "bottleneck": {}})
    assert [each.name for each in settings_of(study, "path_follow")] == ["home", "dt=0.1"]  # alone
    assert [each.name for each in settings_of(study, "bottleneck")] == ["home", "dropped=0.2"]  # unstable at 0.1 s
    with pytest.raises(ValueError, match=r"dropped = 0\.2: must be 0 for path_follow"):
        settings_of(small(tasks={"path_follow": {"dropped": (0.2,)}}), "path_follow")


def test_a_mapping_of_lists_is_all_combinations_with_home() -> None:
    study = small(
        tasks={"pursuit": {"both": {"size": (10, 20), "evader_speed": (2.4, 2)}, "size": (20,)}}, everywhere={}
    )
    home, *settings = settings_of(study, "pursuit")
    rows = [(each.axis, each.value) for each in settings]
    speeds = ("evader_speed 2.4", "evader_speed 2")
    assert rows == [(f"both {size}", text) for size in (10, 20) for text in speeds]  # of the axis `size`, 20 is home
    tasks: list[Any] = [each.task for each in settings]
    assert [(task.size, task.evader_speed) for task in tasks] == [(10, 2.4), (10, 2), (20, 2.4), (20, 2)]
    assert tasks[2] == home.task


CROWD = {"agents": 4, "horizon": 30}


def among(values: Any, **changes: Any) -> Study:
    players = {"random": "random", "textbook": "textbook", "rules": "rules"}
    return small(players=players, everywhere={}, tasks={"crossing": {"partners": values}}, **changes)


def test_partners_are_named_players_the_same_player_or_left_out() -> None:
    mixed = {"partners": "rules", "share": 0.5}
    settings = settings_of(among(("same", "rules", "ppo", mixed)), "crossing", CROWD)
    assert [each.name for each in settings[1:]] == [
        "partners=same", "partners=rules", "partners=ppo", "partners=partners rules, share 0.5",
    ]  # fmt: skip
    found = [each.partners for each in settings]
    assert found[0] is None and found[1] == Partners(None, 1) and found[4] == Partners(Player("rules", "rules"), 2)
    assert found[3] is not None and found[3].player is not None and found[3].player.spec == "ppo"
    study = small(tasks={"pursuit": {}, "crossing": {}}, everywhere={"partners": ("ppo", "orca", "queueing")})
    assert [each.name for each in settings_of(study, "crossing")] == ["home", "partners=ppo", "partners=orca"]
    assert [each.name for each in settings_of(study, "pursuit")] == ["home"]  # one learner


@pytest.mark.parametrize(
    ("task", "values", "text"),
    [
        ("crowd_nav", {"partners": ("rules",)}, "one learner each; the law of its scripted people is `crowd`"),
        ("pursuit", {"partners": ("rules",)}, "must be left out for pursuit, whose worlds have one learner each"),
        ("crossing", {"partners": ("ruls",)}, "partners = 'ruls': unknown, did you mean `rules`?; allowed: same,"),
        ("crossing", {"partners": ("queueing",)}, "partners = 'queueing': unknown"),
        ("crossing", {"mixed": ({"share": 0.5},)}, "tasks.crossing.mixed: share = 0.5: needs partners"),
        ("crossing", {"mixed": ({"partners": "same", "share": 1},)}, "share = 1: must be a number > 0 and < 1"),
        ("crossing", {"partner": ("rules",)}, "tasks.crossing.partner: unknown, did you mean `partners`?"),
    ],
)  # fmt: skip
def test_bad_partners_are_refused_in_one_line(task: str, values: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match="tasks") as caught:
        settings_of(small(tasks={task: values}, everywhere={}), task)
    assert text in str(caught.value) and "\n" not in str(caught.value)


def test_one_agent_is_evaluated_among_partners(tmp_path: Path) -> None:
    noisy = {"partners": "rules", "noise": 0.2}
    study = among(("same", "rules", {"partners": "rules", "share": 0.5}, noisy), worlds=4)
    content = sweep(study, ["crossing"], Work(Store(tmp_path), LocalEngine(1)), {"crossing": CROWD})["crossing"]
    results = read_task(json.loads(json_text(content)))
    assert [each.name for each in results.groups["partners"]] == [each.name for each in results.settings[1:]]
    returns = {each.value: {name: score.returns[0] for name, score in each.scores.items()} for each in results.settings}
    home, same, rules, half, with_noise = returns.values()
    np.testing.assert_array_equal(same["rules"], rules["rules"])
    for one, other in ((same, rules), (home, same), (rules, half), (rules, with_noise)):
        assert (one["textbook"] != other["textbook"]).all()
    task = Crossing(**CROWD)
    made = functools.partial(Among, others=load_player("rules", task, 0))
    alone = rollout(task, load_player("textbook", task), 4, worlds_for("evaluation", 0, 4), make_world=made)
    assert rules["textbook"] == pytest.approx(alone.returns, abs=0.0051)
    page = markdown(study, "command", [results], "folder")
    assert "| task | home | partners |" in page and "**Partners**: one agent of each world" in page


def test_a_player_of_all_agents_is_no_partner_and_is_not_evaluated_among_any(tmp_path: Path) -> None:
    (tmp_path / "sees.py").write_text(
        "import numpy as np\n\nclass Sees:\n    def watch(self, world):\n        pass\n\n"
        "    def predict(self, observation, *rest):\n        return np.zeros((len(observation), 2)), None\n\n"
        "def player(task):\n    return Sees()\n"
    )
    players = {"rules": "rules", "sees": str(tmp_path / "sees.py")}
    for values, refused in ((("rules",), False), (("sees",), True)):
        study = small(players=players, everywhere={}, worlds=2, tasks={"crossing": {"partners": values}})
        work = Work(Store(tmp_path / "jobs"), LocalEngine(1))
        if refused:
            with pytest.raises(ValueError, match="crossing, partners=sees: sees acts for all agents"):
                sweep(study, ["crossing"], work, {"crossing": CROWD})
            continue
        results = read_task(sweep(study, ["crossing"], work, {"crossing": CROWD})["crossing"])
        assert set(results.settings[0].scores) == set(players)
        assert results.settings[1].refused == {"sees": "acts for all agents of a world at once"}


def test_files_of_players() -> None:
    study = small(players={**PLAYERS, "mine": "nothing/here.py"})
    with pytest.raises(ValueError, match=r"players\.mine: 'nothing/here\.py': no such file"):
        contenders_of(study, "pursuit")
    study = small(players={**PLAYERS, "queueing": "queueing", "seeds": "nothing/{task}-seed-*.safetensors"})
    assert [each.name for each in contenders_of(study, "pursuit")] == list(PLAYERS)  # the others play other tasks


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_shipped_studies_can_be_played(path: Path) -> None:
    study = load(path, Study)
    assert set(study.tasks) == set(TASKS) or path.stem in (
        "price",
        "crowd_laws",
        "hybrids",
    )  # of tasks that have prices; of one task
    for task in study.tasks:
        settings = settings_of(study, task)
        assert settings[0].axis == HOME
        assert len({each.name for each in settings}) == len(settings)
        assert {"random", "rules", "ppo"} <= {each.name for each in contenders_of(study, task)}


# --- playing ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return sweep(small(), ["pursuit"], Work(Store(tmp_path_factory.mktemp("jobs")), LocalEngine(1)))["pursuit"]


@pytest.mark.slow
def test_a_player_that_cannot_read_a_setting_is_left_out_of_it(tmp_path: Path) -> None:
    study = small(tasks={"evade": {"pursuers": (1,)}}, everywhere={})
    results = read_task(sweep(study, ["evade"], Work(Store(tmp_path), LocalEngine(1)))["evade"])
    assert [each.name for each in results.settings] == ["home", "pursuers=1"]
    assert "ppo" in results.settings[0].scores and "ppo" not in results.settings[1].scores
    assert results.settings[1].refused["ppo"].startswith("made for observation 'pursuers'"), "no path of this machine"
    assert results.settings[1].winner == ALONE and results.settings[1].first == "rules"


def test_returns_are_those_of_the_held_out_worlds(played: dict[str, Any]) -> None:
    results = read_task(json.loads(json_text(played)))
    assert [each.axis for each in results.settings] == ["home", "size", "noise"]
    assert results.home == {"size": 20}
    home = results.settings[0].scores["ppo"]
    task = Pursuit()
    episodes = rollout(task, load_player("ppo", task), 3, worlds_for("evaluation", 0, 3))
    assert home.returns[0] == pytest.approx(episodes.returns, abs=0.0051)
    assert (home.success[0] == episodes.success).all()
    assert (results.settings[2].scores["ppo"].returns != home.returns).any()  # noise


def test_all_seeds_of_a_name_are_one_player_of_a_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = json.loads((TUNED / "pursuit.json").read_text())
    tuned = content["players"]["rules"]
    others = {str(seed): {"parameters": {**tuned["parameters"], "gain": 2.0 + seed}} for seed in (1, 3)}
    tuned["found"] |= {"seed": 2, "searches": others}
    (tmp_path / "pursuit.json").write_text(json.dumps(content))
    monkeypatch.setattr("flockenv.players.rules.TUNED", tmp_path)
    study = small(players={"random": "random", "rules": "rules@*"}, everywhere={}, tasks={"pursuit": {}})
    results = read_task(sweep(study, ["pursuit"], Work(Store(tmp_path / "jobs"), LocalEngine(1)))["pursuit"])
    rules = results.settings[0].scores["rules"]
    assert rules.returns.shape == (3, 3)
    alone = rollout(Pursuit(), load_player("rules@3", Pursuit()), 3, worlds_for("evaluation", 0, 3))
    assert rules.returns[2] == pytest.approx(alone.returns, abs=0.0051)
    assert rules.mean == mean_interval(rules.returns)
    assert "rules (3 seeds)" in markdown(study, "command", [results], "folder")


def test_only_results_of_one_study_are_on_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tasks: dict[str, Any] = {"pursuit": {}, "obstacles": {}}
    players = {"random": "random", "rules": "rules"}
    for worlds, task, expected in ((2, "pursuit", 1), (2, "obstacles", 2), (3, "obstacles", 1)):
        study = small(worlds=worlds, tasks=tasks, players=players, everywhere={})
        Path("study.yaml").write_text(json.dumps(study.model_dump(mode="json")))
        run = CliRunner().invoke(app, ["study.yaml", "--tasks", task, "--out", "out", "--processes", "1"])
        assert run.exit_code == 0, run.output
        assert Path("out.md").read_text().count("![Map of") == expected


def test_an_integrator_is_named_by_its_kind_and_is_of_the_solver() -> None:
    study = small(everywhere={"integrator": ("semi_implicit_euler", "rk4")}, tasks={"pursuit": {}})
    settings = settings_of(study, "pursuit")
    assert [each.name for each in settings] == ["home", "integrator=rk4"]
    assert settings[1].task.integrator == RK4()
    with pytest.raises(ValueError, match=r"^tasks\.pursuit\.integrator: Pursuit: integrator.*'rk5'"):
        settings_of(small(tasks={"pursuit": {"integrator": ("rk5",)}}), "pursuit")


def test_stored_returns_are_those_of_files_that_had_more_decimals() -> None:
    """Of 1.2349999, a file with four digits had 1.235."""
    values = np.random.default_rng(0).normal(0, 10, 1000)
    assert [stored_return(value) for value in (1.2349999, -16.3512, 103.44)] == [1.24, -16.35, 103.4]
    assert [stored_return(rounded(value, 4)) for value in values] == [stored_return(value) for value in values]
    assert stored_return(1.23456789, 6) == 1.2346


def test_what_a_study_leaves_out_is_on_its_page_and_is_no_other_plan() -> None:
    study = small(left_out="16 N, as the circle is too small.")
    assert "\n**Left out**: 16 N, as the circle is too small.\n" in markdown(study, "command", [], "out")
    assert "**Left out**" not in markdown(small(), "command", [], "out")
    assert plan_digest(study) == plan_digest(small())


def test_a_damaged_player_is_refused_before_anything_is_played(tmp_path: Path) -> None:
    (tmp_path / "mine.safetensors").write_bytes(b"nothing")
    study = small(players={**PLAYERS, "mine": str(tmp_path / "mine.safetensors")})
    with pytest.raises(ValueError, match="mine"):
        sweep(study, ["pursuit"], Work(Store(tmp_path / "jobs"), LocalEngine(1)))
    assert not (tmp_path / "jobs").exists()


def test_the_command_writes_and_checks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    plan = {**small().model_dump(mode="json"), "players": {"random": "random", "rules": "rules", "ppo": "ppo"}}
    Path("study.yaml").write_text(json.dumps(plan))
    run = CliRunner().invoke(app, ["study.yaml", "--out", "out", "--processes", "1"])
    assert run.exit_code == 0, run.output
    assert {path.name for path in Path("out").iterdir()} == {"jobs", "pursuit.json", "pursuit.png", "summary.png"}
    page = Path("out.md").read_text()
    assert "| size 10 |" in page and "| noise 0.1 |" in page
    again = CliRunner().invoke(app, ["study.yaml", "--out", "out", "--check", "2", "--processes", "1"])
    assert again.exit_code == 0, again.output
    assert again.output.count("3 of 3 worlds equal") == 2
    content = read_file(Path("out/pursuit.json"))
    assert content is not None
    for setting in content["settings"]:
        for player in setting["players"].values():
            player["returns"][0][0] += 1
    Path("out/pursuit.json").write_text(json_text(content))
    wrong = CliRunner().invoke(app, ["study.yaml", "--out", "out", "--check", "1", "--processes", "1"])
    assert wrong.exit_code == 1
    assert "2 of 3 worlds equal" in wrong.output


def test_stored_results_are_kept_by_reuse_unless_their_player_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    one = {**small().model_dump(mode="json"), "players": {"random": "random", "rules": "rules"}, "everywhere": {}}
    Path("one.yaml").write_text(json.dumps(one))
    Path("two.yaml").write_text(json.dumps({**one, "tasks": {"pursuit": {"size": [10, 12]}}}))
    assert CliRunner().invoke(app, ["one.yaml", "--out", "out", "--processes", "1"]).exit_code == 0
    first = read_file(Path("out/pursuit.json"))
    assert first is not None
    marked, stale = (first["settings"][0]["players"][name] for name in ("random", "rules"))
    marked["returns"][0][0], stale["returns"][0][0], stale["digest"] = 1234.0, 1234.0, "that of other rules"
    Path("out/pursuit.json").write_text(json_text(first))
    shutil.rmtree("out/jobs")
    run = CliRunner().invoke(app, ["two.yaml", "--out", "out", "--reuse", "--processes", "1"])
    assert run.exit_code == 0, run.output
    assert len(list(Path("out/jobs").rglob("*.safetensors"))) == 3, "the stale one, and both players in the new setting"
    second = read_file(Path("out/pursuit.json"))
    assert second is not None and [each["value"] for each in second["settings"]] == ["", "10", "12"]
    home = second["settings"][0]["players"]
    assert home["random"]["returns"][0][0] == 1234.0 and home["rules"]["returns"][0][0] != 1234.0
    assert second["settings"][1] == first["settings"][1]


def test_reuse_plays_tuning_worlds_that_are_missing(tmp_path: Path) -> None:
    work = Work(Store(tmp_path / "jobs"), LocalEngine(1))
    study = small(players={"random": "random", "rules": "rules", "textbook": "textbook"}, everywhere={}, worlds=2)
    without = sweep(study, ["pursuit"], work, choose=False)
    found = sweep(study, ["pursuit"], work, stored=without)
    for setting in found["pursuit"]["settings"]:
        assert [each["tuning_mean"] is None for each in setting["players"].values()] == [True, False, False]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--tasks", "corsing"], "--tasks 'corsing': unknown"),
        (["--set", "crossing"], "--set 'crossing': must be TASK.ARGUMENT=VALUE"),
        (["--set", "crossing.agents=2"], "--set 'crossing': unknown"),
        (["--set", "pursuit.agents=2"], "tasks.pursuit.agents: unknown"),
        (["--check", "1"], "--check: there are no results in --out"),
        (["--reuse", "--fresh"], "--reuse: not together with --check or --fresh"),
    ],
)
def test_bad_options_are_one_line(
    arguments: list[str], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("study.yaml").write_text(json.dumps(small().model_dump(mode="json")))
    run = CliRunner().invoke(app, ["study.yaml", *arguments])
    assert run.exit_code == 2
    assert text in run.output and len(run.output.strip().splitlines()) == 1
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("worlds", [1, 7, 8, 9, 64])
def test_successes_are_stored_as_bits(worlds: int) -> None:
    marks = np.random.default_rng(worlds).random(worlds) < 0.5
    stored = stored_marks(marks)
    assert len(stored) == 2 * math.ceil(worlds / 8) and (marks_of(stored, worlds) == marks).all()
    assert stored_marks(np.array([True, False, False, True])) == "90"
    with pytest.raises(ValueError, match=f"success = .*{worlds + 8} worlds"):
        marks_of(stored, worlds + 8)


def test_damaged_results_are_named(tmp_path: Path) -> None:
    path = tmp_path / "pursuit.json"
    for text, reason in (("{", "damaged"), ("{}", "not the results of a task")):
        path.write_text(text)
        with pytest.raises(ValueError, match=reason):
            read_file(path)


def test_settings_of_another_task_do_not_change_the_plan_of_this_one() -> None:
    study, other = (small(tasks={"pursuit": {"size": (10,)}, "evade": {"cover": (k,)}}) for k in (0, 5))
    assert plan_digest(study, {}, "pursuit") == plan_digest(other, {}, "pursuit")
    assert plan_digest(study, {}, "evade") != plan_digest(other, {}, "evade")
    assert plan_digest(study) != plan_digest(other)
    fixed = {"evade": {"cover": 5}}
    assert plan_digest(study, fixed, "pursuit") == plan_digest(study, {}, "pursuit")
    assert plan_digest(study, fixed, "evade") != plan_digest(study, {}, "evade")
    assert plan_digest(small(worlds=4, tasks=study.tasks), {}, "pursuit") != plan_digest(study, {}, "pursuit")
