"""What README, docs/players.md and docs/results.md say about results holds in the files of results."""

from __future__ import annotations

import functools
import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents import best_response, cost_of_accuracy, front, transfer_report
from agents.benchmark import STUDY, plan_of, table
from agents.search import Coordinates
from agents.seed_curves import curves_of
from agents.study import Study, contenders_of, settings_of
from agents.study_report import markdown
from agents.study_results import SettingResults, TaskResults, group_of, read_file, read_task
from agents.sweep import _entries, plan_digest
from flockenv.evaluation import Interval, lead_interval
from flockenv.players import PUBLISHED
from flockenv.players.rules import PLAYERS, load_tuned
from flockenv.players.rules.parameter import beyond, ranges_of
from flockenv.scene.yaml_io import load
from flockenv.tasks import TASKS

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
README = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
PLAYERS_PAGE = " ".join((DOCS / "players.md").read_text(encoding="utf-8").split())
PAGES = {"study": "robustness", "crowd_laws": "crowd_laws", "study_planner": "planner", "study_hybrids": "hybrids"}
FEW, MANY = (3, 4, 8), (24, 32)
"""Numbers of agents of Crossing, far from the 12 at home."""


@functools.cache
def results(task: str, folder: str = "study") -> TaskResults:
    content = read_file(DOCS / folder / f"{task}.json")
    assert content is not None
    return read_task(content)


def at(task: str, axis: str, value: object = "", folder: str = "study") -> SettingResults:
    (found,) = (s for s in results(task, folder).settings if (s.axis, s.value) == (axis, str(value)))
    return found


def success(setting: SettingResults, player: str) -> np.ndarray:
    """Return the success rate of each seed."""
    return np.asarray(setting.scores[player].success.mean(axis=1))


def lead(setting: SettingResults, player: str, other: str, seed: int | None = None) -> Interval:
    returns = setting.scores[player].returns
    return lead_interval(returns if seed is None else returns[seed : seed + 1], setting.scores[other].returns)


def is_level(interval: Interval) -> bool:
    return interval.low <= 0 <= interval.high


@functools.cache
def winners(page: str = "study") -> dict[tuple[str, str, str], str]:
    """Return the kind that is ahead by task, axis and value, from the tables of a page."""
    found = {}
    for part in (DOCS / f"{page}.md").read_text(encoding="utf-8").split("\n## ")[2:]:
        for row in re.findall(r"^\| (\w+) ?([^|]*?) \|.*\| ([a-z]+)[ :][^|]*\|$", part, re.MULTILINE):
            found[part.split("\n")[0], row[0], row[1]] = row[2]
    return {key: kind for key, kind in found.items() if key[1] != "setting"}  # without the headers


def ahead(*axes: str) -> Counter[str]:
    return Counter(kind for (_, axis, _), kind in winners().items() if axis in axes)


# --- at home ----------------------------------------------------------------------------------------------------------


def differences_to_best() -> Iterator[tuple[str, Interval]]:
    """Yield PPO minus the hand-written player with the highest mean, by task."""
    tasks = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))["tasks"]
    for name, task in tasks.items():
        means = {each: player["mean"] for each, player in task["players"].items() if each not in ("random", "ppo")}
        pair = task["pairs"][f"ppo - {max(means, key=lambda each: means[each])}"]
        yield name, Interval(pair["difference"], pair["ci_low"], pair["ci_high"])


def test_ppo_is_ahead_of_the_best_rules_in_two_tasks_and_behind_in_three() -> None:
    found = dict(differences_to_best())
    assert {name for name, each in found.items() if each.low > 0} == {"bottleneck", "path_follow"}
    assert {name for name, each in found.items() if each.high < 0} == {"corridor", "flock", "obstacles"}
    assert found.keys() == TASKS.keys()
    tasks = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))["tasks"]
    ppo, rules = (tasks["bottleneck"]["players"][name]["success_rate"] for name in ("ppo", "rules"))
    assert f"fewer worlds ({100 * ppo:.0f} % against {100 * rules:.0f} %)" in README
    text = README.split("and level in ")[1].split(".")[0]
    level = re.sub(r"\(ORCA\)|,| and", " ", text).split()
    assert sorted(level) == sorted(name for name, each in found.items() if is_level(each))


def test_trainings_of_herd_that_fail_or_end_behind_are_as_many_as_is_said() -> None:
    players = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))["tasks"]["herd"]["players"]
    ppo, rules, random = (np.array(players[name]["returns"]) for name in ("ppo", "rules", "random"))
    behind = [lead_interval(one[None], rules).high < 0 for one in ppo]
    failed = ppo.mean(axis=1) < random.mean() + 1
    assert (len(ppo), failed.sum(), sum(behind)) == (10, 1, 3)


def test_rules_of_corridor_have_25_and_bottleneck_s_mixture_beats_queueing_safely() -> None:
    assert at("corridor", "home").scores["rules"].mean.low > 25
    home = at("bottleneck", "home")
    assert success(home, "mixture").min() > 0.95 and lead(home, "mixture", "queueing").low > 0
    assert all(lead(home, "mixture", "queueing", seed).low > 0 for seed in range(5))


def test_decisions_of_ppo_take_less_than_a_microsecond_and_those_of_rules_longer() -> None:
    for task in json.loads((DOCS / "results.json").read_text(encoding="utf-8"))["tasks"].values():
        ppo, rules = (task["players"][name]["microseconds_per_decision"] for name in ("ppo", "rules"))
        assert ppo < 1 and rules > ppo


# --- elsewhere --------------------------------------------------------------------------------------------------------


def test_policies_are_ahead_under_most_noise_and_rules_under_none() -> None:
    found = ahead("noise")
    assert found["policy"] > found.total() / 2 and found["rules"] == 0


def test_rules_are_ahead_or_level_if_agents_see_less() -> None:
    found = ahead("range", "seen")
    assert found["policy"] + found["hybrid"] <= 0.1 * found.total() and found["rules"] > 0


def test_if_the_task_changes_rules_are_ahead_in_a_third_what_is_learned_in_an_eighth_and_nearly_half_are_level() -> (
    None
):
    found = ahead(*{axis for _, axis, _ in winners() if group_of(axis) == "task"})
    assert found["rules"] / found.total() == pytest.approx(1 / 3, abs=0.02)
    assert (found["policy"] + found["hybrid"]) / found.total() == pytest.approx(1 / 8, abs=0.02)
    assert 0.45 < found["level"] / found.total() < 0.5


def test_ppo_of_crossing_does_not_carry_over_and_that_of_flock_does() -> None:
    assert success(at("crossing", "home"), "ppo").min() == 1
    for count in (*FEW, *MANY):
        assert success(at("crossing", "agents", count), "ppo").max() == 0
    assert winners()["flock", "same_density", "agents 1024, size 261"] == "policy"


def test_hybrids_at_home_are_level_with_the_better_of_rules_and_ppo() -> None:
    folder, name = "study_hybrids", "residual_home"
    found = winners(folder)
    assert len(found) == 7 and set(found.values()) == {"level"}
    better = {task for task, *_ in found if lead(at(task, "home", folder=folder), name, "ppo").low > 0}
    assert better == {"corridor", "flock"}
    cards = [json.loads(path.read_text()) for path in sorted((ROOT / "agents/policies" / name).glob("*-seed-?.json"))]
    unlearned = [card["task"] for card in cards if card["tuning_mean"] == card["curve"][0]["mean"]]
    assert len(cards) == 35 and unlearned == ["corridor"] * 5 + ["school"]
    herd = at("herd", "home", folder=folder)
    assert success(herd, name).min() == 1.0 and success(herd, "ppo").min() == 0.0


def test_no_planner_is_ahead() -> None:
    assert len(winners("study_planner")) == len(TASKS)
    assert "planner" not in winners("study_planner").values()


# --- what was trained in several settings, and hybrids ----------------------------------------------------------------


def larger_circles() -> list[SettingResults]:
    return [each for each in results("crossing").settings if each.axis == "larger_circle"]


def test_the_residual_of_crossing_succeeds_everywhere_and_passes_orca_from_16_agents_on() -> None:
    agents_48, agents_192 = larger_circles()
    assert agents_192.value.startswith("agents 192")
    many = [at("crossing", "agents", count) for count in (16, *MANY)] + [agents_48]
    for setting in many + [at("crossing", "agents", count) for count in FEW] + [at("crossing", "home")]:
        assert success(setting, "residual").min() == 1
    assert 0.92 <= success(agents_192, "residual").mean() < 0.93
    assert [round(each, 2) for each in sorted(success(agents_192, "residual"))] == [0.67, 0.95, 1, 1, 1]
    for setting in [*many, agents_192]:
        assert lead(setting, "residual", "orca").low > 0
        assert all(lead(setting, "residual", "orca", seed).low > 0 for seed in range(5))
    assert is_level(lead(at("crossing", "home"), "residual", "ppo"))


def test_the_residual_of_crowd_nav_is_level_with_orca_in_all_settings_but_one_where_ppo_often_fails() -> None:
    settings = results("crowd_nav", "crowd_laws").settings
    assert len(settings) == 1 + 5 * 5
    leads = [lead(setting, "residual", "orca") for setting in settings]
    assert (
        sum(map(is_level, leads)) == len(settings) - 1
        and min(each.value for each in leads if not is_level(each)) > -0.05
    )
    for setting in settings:
        assert success(setting, "residual").mean() > 0.97
    assert sum(success(setting, "ppo").mean() < 0.5 for setting in settings) > len(settings) / 2


def test_under_noise_ppo_and_policies_trained_with_it_succeed_in_crossing_where_orca_and_its_residual_fail() -> None:
    setting = at("crossing", "noise", 0.05)
    assert max(success(setting, name).max() for name in ("orca", "residual", "rules")) < 0.2
    assert min(success(setting, name).mean() for name in ("ppo", "drawn_noise")) > 0.9
    assert max(success(at("crossing", "noise", 0.1), name).mean() for name in setting.scores) < 0.5


def test_the_residual_of_obstacles_keeps_what_noise_takes_from_the_rules() -> None:
    setting = at("obstacles", "noise", 0.05)
    assert success(setting, "rules").mean() < 0.4
    assert success(setting, "residual").mean() >= 0.95 * success(setting, "ppo").mean()
    for noise in (0.02, 0.05, 0.1):
        assert is_level(lead(at("obstacles", "noise", noise), "residual", "ppo"))


def test_training_in_several_settings_mends_those_and_no_others() -> None:
    for count in (*FEW, 16, *MANY):
        assert success(at("crossing", "agents", count), "drawn").min() == 1
    assert [round(float(success(setting, "drawn").mean()), 1) for setting in larger_circles()] == [0.3, 0]
    for task in ("crowd_nav", "obstacles"):
        assert is_level(lead(at(task, "home"), "drawn", "ppo"))
    behind = lead(at("crossing", "home"), "drawn", "ppo")
    assert behind.value > -0.1 and behind.high < 0


def test_residual_and_gate_pass_the_rules_of_crossing_and_weights_and_priorities_do_not() -> None:
    found = json.loads((DOCS / "hybrids.json").read_text(encoding="utf-8"))["crossing"]
    ends = {name: each["curve"][-1]["mean"] for name, each in found["settings"].items()}
    assert min(ends["residual"], ends["gate"]) > ends["as configured"] > found["rules"]
    best = {name: max(point["mean"] for point in each["curve"]) for name, each in found["settings"].items()}
    assert max(best["weights"], best["priorities"]) < found["rules"] + 0.02


# --- searches and learners --------------------------------------------------------------------------------------------


def test_bounds_at_which_searches_ended_are_named() -> None:
    found = set()
    for name in PUBLISHED:
        for task in PLAYERS[name]:
            parameters = PLAYERS[name][task][1]
            coordinates = Coordinates(ranges_of(parameters))
            for run in load_tuned(task, name).found["searches"].values():
                found |= {(task, name, *pair) for pair in coordinates.at_bounds(run["parameters"]).items()}
    text = PLAYERS_PAGE.split("have ended at a bound:")[1].split("## Seeds")[0]
    for task, name, parameter, end in found:
        assert f"`{name}`, `{parameter}` = {end:g}" in text, (task, name, parameter)
    assert len(found) == text.count("` = ")
    artificial = {each[:3] for each in found if not beyond(PLAYERS[each[1]][each[0]][1], each[2], each[3])}
    assert artificial == {("herd", "rules", "width")} and "herd" not in {
        task for task in TASKS if load_tuned(task, "rules").found["at_bounds"]
    }
    scores = load_tuned("herd", "rules").found["scores"].values()
    assert max(scores) - min(scores) < 0.05


def test_searches_of_queueing_end_at_two_optima_and_the_lower_one_ships() -> None:
    found = load_tuned("bottleneck", "queueing").found
    assert sum(abs(score - 2.4) < 0.11 for score in found["scores"].values()) == 5
    assert sum(abs(score - 3.0) < 0.11 for score in found["scores"].values()) == 5
    assert found["tuning_mean"] < 2.6


def test_other_learners_are_above_random_and_not_above_ppo() -> None:
    ppo = [curve["mean"] for curve in curves_of("pursuit")["ppo"]]
    cards = [json.loads(path.read_text(encoding="utf-8")) for path in (DOCS / "learners").glob("*/pursuit-*.json")]
    assert Counter(card["algorithm"].split()[0] for card in cards).values() and len(cards) == 8
    for card in cards:
        assert 7 < card["tuning_mean"] < min(max(curve) for curve in ppo)
    crossing = [curve["mean"] for curve in curves_of("crossing")["ppo"]]
    others = [json.loads(path.read_text(encoding="utf-8")) for path in (DOCS / "learners").glob("*/crossing-*.json")]
    rules = load_tuned("crossing", "rules").found["tuning_mean"]
    assert len(others) == 4
    for card in others:
        assert rules - 0.05 < card["tuning_mean"] < np.median([max(curve) for curve in crossing])


def test_players_harm_less_than_one_world_of_a_hundred_in_crowd_nav() -> None:
    players = json.loads((DOCS / "fronts" / "crowd_nav.json").read_text(encoding="utf-8"))["players"]
    assert max(players[name]["worlds_with_harm"][0] for name in ("ppo", "orca")) < 0.01


# --- pages ------------------------------------------------------------------------------------------------------------


def test_readme_has_the_sentence_of_the_picture_of_accuracy() -> None:
    """If this fails, run `python -m agents.transfer`, `python -m agents.cost_of_accuracy`, and copy its sentence."""
    found = json.loads((DOCS / "cost_of_accuracy.json").read_text(encoding="utf-8"))
    played = json.loads((DOCS / "transfer.json").read_text(encoding="utf-8"))
    assert found["sentence"] == cost_of_accuracy.sentence(found["scenes"], played)
    assert found["sentence"] in README


def test_the_leaderboard_is_that_of_its_entries_and_trivial_players_fail() -> None:
    entries = [json.loads(path.read_text(encoding="utf-8")) for path in (DOCS / "leaderboard").glob("*.json")]
    page = (DOCS / "leaderboard.md").read_text(encoding="utf-8")
    assert page == table(entries)
    assert {entry["study"] for entry in entries} == {plan_digest(plan_of(STUDY))}  # a new entry joins them
    for path in (ROOT / "agents" / "trivial").glob("[a-z]*.py"):
        assert f"`{path.stem}` (does not solve the tasks)" in page


def test_the_map_has_eleven_tasks_with_eight_variations_and_more() -> None:
    assert {task for task, _, _ in winners()} == TASKS.keys() and len(TASKS) == 11
    assert min(Counter(task for task, axis, _ in winners() if axis != "home").values()) >= 8


def test_players_of_the_transfer_are_those_that_ship_in_the_comparison() -> None:
    """The same worlds, so the same returns; if this fails, one of both was played with other players."""
    compared = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))["tasks"]
    for task, about in json.loads((DOCS / "transfer.json").read_text(encoding="utf-8"))["tasks"].items():
        trained = about["settings"][about["trained"]]["players"]
        for name in ("random", "rules", "ppo"):
            ships = np.mean(compared[task]["players"][name]["returns"][0])
            assert trained[name]["mean"] == pytest.approx(ships, abs=1e-4), (task, name)


def test_pages_of_transfer_fronts_and_partners_are_those_of_their_files() -> None:
    def content(name: str) -> Any:
        return json.loads((DOCS / f"{name}.json").read_text(encoding="utf-8"))

    study = load(ROOT / "configs" / "studies" / "price.yaml", Study)
    fronts = [content(f"fronts/{task}") for task in study.tasks]
    pages = {
        name: (DOCS / f"{name}.md").read_text(encoding="utf-8") for name in ("transfer", "fronts", "best_response")
    }
    assert pages["transfer"] == transfer_report.markdown(content("transfer"))
    command = "python -m agents.front configs/studies/price.yaml --out docs/fronts"
    assert pages["fronts"] == front.markdown(study, command, fronts, "fronts")
    command = pages["best_response"].split("`")[1]
    tasks = re.findall(r"training/(\w+)\.yaml", command)
    payoffs = [content(f"best_response/{task}") for task in tasks]
    assert pages["best_response"] == best_response.markdown(payoffs, command, "best_response")
    together = [task for task, kind in TASKS.items() if kind().learners > 1]
    assert sorted(tasks) == sorted(together), "all tasks with several learners have a matrix"


@pytest.mark.parametrize("folder", [pytest.param("study", marks=pytest.mark.slow), *list(PAGES)[1:]])
def test_stored_results_are_those_of_today_s_settings_and_players(folder: str) -> None:
    """If this fails, run `python -m agents.sweep configs/studies/NAME.yaml --out docs/FOLDER --reuse`."""
    study = load(ROOT / "configs" / "studies" / f"{PAGES[folder]}.yaml", Study)
    for task in study.tasks:
        content: Any = read_file(DOCS / folder / f"{task}.json")
        players = {(each["axis"], each["value"]): each["players"] for each in content["settings"]}
        for setting in settings_of(study, task):
            stored = players.pop((setting.axis, setting.value))
            for entry in _entries(study, setting, contenders_of(study, task)):
                found = stored.pop(entry.contender.name)
                assert entry.content or found["digest"] == entry.digest, (task, setting.name, entry.contender.name)
            assert not stored
        assert not players


@pytest.mark.slow
@pytest.mark.parametrize("folder", PAGES)
def test_pages_of_studies_are_those_of_their_results(folder: str) -> None:
    plan = f"configs/studies/{PAGES[folder]}.yaml"
    study = load(ROOT / plan, Study)
    page = markdown(
        study, f"python -m agents.sweep {plan} --out docs/{folder}", [results(t, folder) for t in study.tasks], folder
    )
    assert (DOCS / f"{folder}.md").read_text(encoding="utf-8") == page
