"""The search for parameters of hand-written players: its result, its files and its refusals."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import search as searching
from agents import tune
from agents.experiment import Experiment
from agents.search import Coordinates, Found, Search, median_of, search
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.evaluation import rollout
from flockenv.jobs import Store, Work
from flockenv.jobs.local_engine import LocalEngine
from flockenv.players import PUBLISHED
from flockenv.players.rules import PLAYERS, TUNABLE, Tuned, as_dict, load_tuned, player, read_tuned
from flockenv.players.rules.parameter import ranges_of
from flockenv.players.rules.pursuit import PursuitRules
from flockenv.tasks import TASKS

ROOT = Path(__file__).resolve().parent.parent

SMALL = Experiment(
    task="pursuit",
    arguments={"horizon": 5},
    ppo={"steps": 100, "evaluate_every": 80, "evaluate_worlds": 2},
    search={"worlds": 2, "final_worlds": 3},
)
"""A search of a few generations of real episodes."""

QUADRATIC = SMALL.model_copy(update={"ppo": SMALL.ppo.model_copy(update={"steps": 600, "evaluate_every": 60})})
"""A search for tests that replace the episodes by a formula, at one agent-step a world."""

SHORT = QUADRATIC.model_copy(update={"ppo": QUADRATIC.ppo.model_copy(update={"steps": 120})})
"""The same, of fewer generations."""

RANGES = ranges_of(PursuitRules)
AIM = {"factor": 0.6, "horizon": 3.0, "margin": 1.5, "gain": 4.0, "slow_radius": 0.1}


def work(folder: Path, processes: int = 1) -> Work:
    return Work(Store(folder), LocalEngine(processes))


def distance(values: dict[str, float]) -> float:
    """Return the squared distance from AIM, in shares of the ranges."""
    to = Coordinates(RANGES)
    return float(np.sum((to.point(values) - to.point(AIM)) ** 2))


def score_by(monkeypatch: pytest.MonkeyPatch, formula: Callable[[dict[str, float]], float]) -> list[int]:
    """Replace episodes by a formula of the parameters, plus luck of each world; return the list of first worlds."""
    played: list[int] = []

    def rollout(task: Any, policy: Any, worlds: int, seed: int, make_world: Any) -> Any:
        played.append(seed)
        luck = np.random.default_rng(seed).normal(size=worlds)
        success = np.zeros(worlds, np.bool_)
        return SimpleNamespace(
            returns=formula(as_dict(policy.rules)) + luck, success=success, lengths=np.ones(worlds, np.int64)
        )

    monkeypatch.setattr(searching, "rollout", rollout)
    monkeypatch.setattr("os.fsync", lambda file: None)  # hundreds of records
    return played


def untimed(found: Found) -> Found:
    """Return the outcome of a search without its times."""
    return replace(found, seconds=0.0, curve=[{**point, "seconds": 0.0} for point in found.curve])


def found_with(seed: int, mean: float) -> Found:
    return Found("pursuit", "rules", seed, AIM, mean, 0.5, 1.0, 0.25, 3, 9, 6, 1.0, 2, 8, 2, {}, [])


# --- coordinates


def test_a_range_of_more_than_two_decades_is_searched_by_its_logarithm() -> None:
    to = Coordinates({"wide": (0.01, 10.0), "narrow": (0.1, 10.0), "from_zero": (0.0, 100.0)})
    middle = to.values(np.full(3, 0.5))
    assert middle == {"wide": pytest.approx(0.31623), "narrow": pytest.approx(5.05), "from_zero": 50.0}
    np.testing.assert_allclose(to.point(middle), 0.5, atol=1e-5)
    assert to.values(np.array([0.0, 0.0, 0.0])) == {"wide": 0.01, "narrow": 0.1, "from_zero": 0.0}
    np.testing.assert_array_equal(to.point({"wide": 20.0, "narrow": 0.0, "from_zero": 5.0}), [1.0, 0.0, 0.05])


def test_bounds_are_reported_within_a_hundredth_of_the_range() -> None:
    to = Coordinates({"low": (0.0, 10.0), "high": (0.0, 10.0), "inside": (0.0, 10.0), "textbook": (0.0, 10.0)})
    assert to.at_bounds({"low": 0.1, "high": 9.9, "inside": 0.2, "textbook": 30.0}) == {"low": 0.0, "high": 10.0}


def test_every_parameter_of_every_hand_written_player_has_a_range_around_its_published_value() -> None:
    unlimited = {("pursuit", "horizon")}  # in the textbook: wide above the range
    for of in TUNABLE.values():
        for task, (_, kind) in of.items():
            for name, (low, high) in ranges_of(kind).items():
                inside = low <= getattr(kind(), name) <= high
                assert inside != ((task, name) in unlimited), (task, name)


# --- the search


def test_the_search_finds_the_optimum_of_a_quadratic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    score_by(monkeypatch, lambda values: -distance(values))
    (found,) = search(QUADRATIC, "rules", [3], work(tmp_path))
    assert distance(as_dict(PursuitRules())) > 0.1
    assert distance(found.parameters) < 1e-3
    assert found.tuning_mean > found.textbook_mean and found.at_bounds == {}
    assert [point["best"] for point in found.curve] == sorted(point["best"] for point in found.curve)
    assert found.curve[0]["steps"] == 0 and found.curve[-1]["steps"] == found.agent_steps >= 600
    assert found.agent_steps == found.generations * found.candidates * found.worlds


def test_candidates_of_a_generation_play_the_same_worlds_which_no_other_generation_plays() -> None:
    one, two = Search(QUADRATIC, "rules", 0), Search(QUADRATIC, "rules", 1)
    worlds: list[set[int]] = []
    for each in (one, two):
        for _ in range(3):
            jobs = each.ask()[1 if each._point_is_due() else 0 :]
            (first,) = {job.arguments[4] for job in jobs}
            worlds.append(set(range(first, first + jobs[0].arguments[3])))
            each.generation += 1
    last = [job.arguments for job in one.ask_last()[:2]]  # of the curve, and of the final choice
    worlds += [set(range(first, first + count)) for *_, count, first, _ in last]
    assert sum(len(each) for each in worlds) == len(set().union(*worlds))


def test_no_result_is_worse_than_the_textbook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    textbook = as_dict(PursuitRules())
    score_by(monkeypatch, lambda values: 0.0 if values == textbook else -1.0 - distance(values))
    (found,) = search(QUADRATIC, "rules", [0], work(tmp_path))
    assert found.parameters == textbook and found.tuning_mean == found.textbook_mean


def test_a_best_value_on_a_bound_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    to = Coordinates({name: RANGES[name] for name in ("gain", "slow_radius")})
    score_by(monkeypatch, lambda values: float(np.diff(-to.point(values))[0]))
    (found,) = search(QUADRATIC, "rules", [0], work(tmp_path))
    assert {"gain": 12.0, "slow_radius": 0.01}.items() <= found.at_bounds.items()


def test_a_bound_is_printed_with_what_lies_beyond_it_if_it_is_natural(capsys: pytest.CaptureFixture[str]) -> None:
    found = replace(found_with(0, 1.0), task="crossing", player="orca", at_bounds={"margin": 0.0, "gain": 20.0})
    tune._show([found], Path("crossing.json"))
    assert (
        "on a bound of its range: margin = 0 (natural: below it, bodies touch), "
        "gain = 20 (a wider range may have a better value)"
    ) in capsys.readouterr().err


def test_a_search_has_the_agent_steps_of_ppo_unless_the_config_says_otherwise() -> None:
    assert Search(SMALL, "rules", 0).budget == 100
    own = SMALL.model_copy(update={"search": SMALL.search.model_copy(update={"steps": 77})})
    assert Search(own, "rules", 0).budget == 77


def test_candidates_play_in_the_disturbed_worlds_of_the_training() -> None:
    disturbance = Disturbance(noise=0.5)
    noisy = SMALL.model_copy(update={"ppo": SMALL.ppo.model_copy(update={"disturbance": disturbance})})
    job, calm = Search(noisy, "rules", 0).ask()[0], Search(SMALL, "rules", 0).ask()[0]
    played, undisturbed = (searching._play_of(each.function(*each.arguments)) for each in (job, calm))
    task, worlds = SMALL.build(), functools.partial(make_world, disturbance=disturbance)
    expected = rollout(task, player(task, "textbook"), 2, searching.common_worlds(), make_world=worlds)
    assert played.mean == expected.returns.mean() != undisturbed.mean
    assert job.key != calm.key


@pytest.mark.slow  # its processes load the kernels
def test_a_search_has_the_same_result_on_any_number_of_processes(tmp_path: Path) -> None:
    here, there = (search(SMALL, "rules", [0], work(tmp_path / str(n), n)) for n in (1, 2))
    assert [untimed(each) for each in here] == [untimed(each) for each in there]


def test_an_interrupted_search_continues_from_its_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played = score_by(monkeypatch, lambda values: -distance(values))
    (whole,) = search(SHORT, "rules", [0], work(tmp_path / "whole"))
    total = len(played)
    played.clear()

    def interrupted(values: dict[str, float]) -> float:
        if len(played) > total // 2:
            raise KeyboardInterrupt
        return -distance(values)

    played = score_by(monkeypatch, interrupted)
    with pytest.raises(KeyboardInterrupt):
        search(SHORT, "rules", [0], work(tmp_path / "part"))
    before = len(played) - 1  # the last one has no record
    assert 0 < before < total
    played = score_by(monkeypatch, lambda values: -distance(values))
    (resumed,) = search(SHORT, "rules", [0], work(tmp_path / "part"))
    assert len(played) == total - before
    assert untimed(resumed) == untimed(whole)


def test_progress_is_in_thousands_of_agent_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    score_by(monkeypatch, lambda values: -distance(values))
    monkeypatch.setattr(searching, "THOUSAND", 1)
    reports: list[tuple[int, int]] = []
    search(SHORT, "rules", [0], replace(work(tmp_path), progress=lambda done, most, name: reports.append((done, most))))
    assert [done for done, _ in reports] == sorted({done for done, _ in reports}) and reports[-1][0] >= 120
    assert {most for _, most in reports} == {120}


def test_the_search_needs_no_torch() -> None:
    code = "import sys, agents.tune; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "False\n"


# --- several seeds


def test_the_median_search_ships() -> None:
    means = {0: 5.0, 1: 1.0, 2: 3.0, 3: 9.0}
    found = [found_with(seed, mean) for seed, mean in means.items()]
    assert median_of(found[:1]).seed == 0
    assert median_of(found[:3]).seed == 2
    assert median_of(found).seed == 2, "the lower one of two in the middle"


def test_tuned_parameters_are_used_and_name_all_searches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    score_by(monkeypatch, lambda values: -distance(values))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tune, "TUNED", tmp_path / "tuned")
    monkeypatch.setattr("flockenv.players.rules.TUNED", tmp_path / "tuned")
    Path("pursuit.yaml").write_text(SHORT.model_dump_json(), encoding="utf-8")
    assert load_tuned("pursuit") == Tuned(), "no search yet"
    result = CliRunner().invoke(tune.app, ["pursuit.yaml", "--seeds", "0-2", "--processes", "1"])
    assert result.exit_code == 0, result.output
    tuned = load_tuned("pursuit")
    assert as_dict(player(TASKS["pursuit"]()).rules) == tuned.parameters
    records = [json.loads(Path(f"results/tune/pursuit-rules-seed-{seed}.json").read_text()) for seed in range(3)]
    assert [record["seed"] for record in records] == [0, 1, 2] and all(record["curve"] for record in records)
    scores = {str(record["seed"]): record["tuning_mean"] for record in records}
    assert tuned.found["scores"] == scores and len(set(scores.values())) == 3
    ships = next(record for record in records if record["seed"] == tuned.found["seed"])
    assert sorted(scores.values())[1] == ships["tuning_mean"] == tuned.found["tuning_mean"]
    assert ships["parameters"] == tuned.parameters
    assert (tuned.found["lowest"], tuned.found["highest"]) == (min(scores.values()), max(scores.values()))
    assert {seed: each["parameters"] for seed, each in tuned.found["searches"].items()} == {
        str(record["seed"]): record["parameters"] for record in records
    }
    assert len(tuned.found["searches"]["1"]["curve"]["mean"]) == len(records[1]["curve"])
    assert tuned.found["seeds"] == 3 and f"seed {ships['seed']}, the median of 3" in result.stderr


def test_a_player_s_parameters_do_not_replace_those_of_another(tmp_path: Path) -> None:
    path = tmp_path / "crossing.json"
    tune.write(path, "crossing", "rules", {"gain": 1.0}, {"seed": 0})
    tune.write(path, "crossing", "orca", {"gain": 2.0}, {"seed": 1})
    tune.write(path, "crossing", "rules", {"gain": 3.0}, {"seed": 2})
    players = read_tuned(path)
    assert list(players) == ["orca", "rules"], "in the order of the tables"
    assert [each["parameters"]["gain"] for each in players.values()] == [2.0, 3.0]


def test_tuned_players_differ_from_published_ones_where_a_search_was_made() -> None:
    for name, published in PUBLISHED.items():
        for task in PLAYERS[name]:
            tuned = load_tuned(task, name)
            now, before = (as_dict(player(TASKS[task](), each).rules) for each in (name, published))
            assert now == (tuned.parameters or as_dict(PLAYERS[name][task][1]())), (task, name)
            assert before == as_dict(PLAYERS[published][task][1]())
            if tuned.parameters:
                assert tuned.found["tuning_mean"] >= tuned.found["textbook_mean"]
                assert tuned.found["tuning_mean"] > tuned.found["textbook_mean"] or now == before


@pytest.mark.parametrize("settings", [{}, {"disturbance": {"noise": 0.1}}])
def test_tuned_parameters_name_the_disturbance_of_their_search(
    settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tune, "search", lambda *_: [found_with(0, 2.0)])
    Path("pursuit.yaml").write_text(json.dumps({"task": "pursuit", "ppo": settings}), encoding="utf-8")
    assert CliRunner().invoke(tune.app, ["pursuit.yaml", "--out", "x.json"]).exit_code == 0
    expected = {"noise": 0.1, "delay": 0, "dropped": 0.0} if settings else None
    assert read_tuned(Path("x.json"))["rules"]["found"].get("disturbance") == expected
    record = json.loads(Path("results/tune/pursuit-rules-seed-0.json").read_text())
    assert record.get("disturbance") == expected


# --- refusals


def test_a_disturbance_without_slots_is_refused_before_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text("{task: path_follow, ppo: {disturbance: {dropped: 0.2}}}", encoding="utf-8")
    result = CliRunner().invoke(tune.app, ["config.yaml"])
    fault = "dropped = 0.2: must be 0 for path_follow, which has no slots to empty"
    assert (result.exit_code, result.output) == (2, f"error: {fault}\n")
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"], "nothing is written"


@pytest.mark.parametrize(
    ("config", "given", "fault"),
    [
        ("crossing", "orka", "--player 'orka': unknown, did you mean `orca`?; for crossing allowed: orca, rules"),
        ("pursuit", "orca", "--player 'orca': unknown; for pursuit allowed: rules"),
        ("crossing", "textbook", "--player 'textbook': unknown; for crossing allowed: orca, rules"),
    ],
)
def test_an_unknown_player_is_refused_in_one_line(
    config: str, given: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text(f"{{task: {config}}}", encoding="utf-8")
    result = CliRunner().invoke(tune.app, ["config.yaml", "--player", given])
    assert result.exit_code == 2 and result.output == f"error: {fault}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"], "nothing is written"


@pytest.mark.parametrize(
    ("out", "fault"),
    [("/proc/none/x.json", "must lie below"), ("file/x.json", "is not a folder"), ("x.yaml", "must end in .json"),
     ("../x.json", "must not go up"), ("other.json", "not a file of tuned parameters")],
)  # fmt: skip
def test_a_search_is_refused_if_its_result_cannot_be_written(
    out: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("mine")
    Path("other.json").write_text('{"players": {"rules": 3}}')
    Path("pursuit.yaml").write_text("{task: pursuit}", encoding="utf-8")
    monkeypatch.setattr(tune, "search", lambda *_: pytest.fail("searched before --out was checked"))
    result = CliRunner().invoke(tune.app, ["pursuit.yaml", "--out", out])
    assert result.exit_code == 2 and result.output.count("\n") == 1 and fault in result.output


def test_a_search_prints_its_result_if_it_cannot_be_written_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    def searched(*_: Any) -> Any:
        monkeypatch.setattr("os.fsync", full)
        return [found_with(0, 2.0)]

    monkeypatch.chdir(tmp_path)
    Path("pursuit.yaml").write_text("{task: pursuit}", encoding="utf-8")
    monkeypatch.setattr(tune, "search", searched)
    result = CliRunner().invoke(tune.app, ["pursuit.yaml", "--out", "deep/x.json"])
    assert result.exit_code == 2 and result.stderr.splitlines()[-1].startswith("error: cannot write ")
    assert '"gain": 4.0' in result.stderr and not Path("deep").exists()
