"""What accuracy costs: shares and choices, sentences, scores, the picture's data, the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from typer.testing import CliRunner

from agents import cost_chart, cost_of_accuracy
from agents.cost_of_accuracy import Case
from flockenv.physics.integrators import INTEGRATORS
from flockenv.studies.accuracy import Curve, Machine, Point, Report

ROOT = Path(__file__).parent.parent


def curve(method: str, *points: tuple[float | None, float]) -> Curve:
    """Return a curve of (error, m; seconds), each in twice as many steps as the one before."""
    made = [
        Point(steps=10 * 2**k, dt=0.1 / 2**k, tolerance=None, evaluations=10 * 2**k, error=error, rms=error,
              along=error, energy=None, momentum=None, seconds=None if error is None else seconds)
        for k, (error, seconds) in enumerate(points)
    ]  # fmt: skip
    return Curve(method=method, declared=1, points=tuple(made), order=None, used=0)


def report(*curves: Curve, floor: float = 1e-6) -> Report:
    """Return the report of a scene in which the farthest agent moves 2 m."""
    return Report(
        name="boids", title="A flock", agents=7, seconds=2.0, dtype="float64", reference="own steps",
        reference_error=floor / 4, note="", growth=3.0, floor=floor, reach=2.0, energy="kinetic", repetitions=1,
        machine=Machine(cpu="a CPU", cores=2, load=0.5), curves=curves,
    )  # fmt: skip


CASE = Case("boids.yaml", "A flock", "flock", 0.0, 2.0, ((("rk4", "midpoint", "heun"), (10, 20, 40)),), 4)
REPORT = report(
    curve("rk4", (0.2, 0.4), (0.02, 0.8), (0.002, 1.6)), curve("midpoint", (None, 0.0), (0.01, 0.3), (0.001, 0.6)),
    curve("explicit_euler", (1.0, 0.1), (0.5, 0.2), (0.25, 0.4)),
)  # fmt: skip


def transfer(path_follow: float = 20.0) -> Any:
    """Return results of agents.transfer: random -10, rules 10, ppo 12, except in RK4 in path_follow."""

    def setting(method: str, dtype: str, us: float, ppo: float) -> Any:
        means = {"random": -10.0, "rules": 10.0, "ppo": ppo}
        players = {name: {"mean": mean, "kept": (mean + 10) / 22} for name, mean in means.items()}
        players["rules"]["kept"], players["random"] = 1.0, {"mean": -10.0}
        return {"method": method, "dtype": dtype, "dt": 0.05, "us_per_s": us, "players": players}

    def task(ppo: float) -> Any:
        settings = {
            "semi_implicit_euler /2": setting("semi_implicit_euler", "float64", 3.0, 12.0),
            "rk4 /2": setting("rk4", "float64", 5.0, ppo),
            "semi_implicit_euler float32 /2": setting("semi_implicit_euler", "float32", 2.0, 12.0),
        }
        again = {"random": 0.0, "rules": 0.0, "ppo": 0.0}
        return {"trained": "semi_implicit_euler /2", "again": again, "settings": settings}

    tasks = {"flock": task(12.0), "bottleneck": task(12.1), "path_follow": task(path_follow)}
    return {"tasks": tasks, "worlds": 3, "seed": 0, "git": {"commit": None, "changed": None}}


def results(path_follow: float = 12.0) -> Any:
    played = transfer(path_follow)
    scenes = {"boids": cost_of_accuracy.costs_of(CASE, [REPORT])}
    tasks = {task: cost_of_accuracy.scores_of(played, task) for task in cost_of_accuracy.TASKS}
    return {"aim": cost_of_accuracy.AIM, "scenes": scenes, "tasks": tasks}


# --- numbers


def test_errors_are_shares_of_the_longest_path_and_times_are_per_simulated_second() -> None:
    about = cost_of_accuracy.costs_of(CASE, [REPORT])
    assert [point["error"] for point in about["methods"]["rk4"]] == [0.1, 0.01, 0.001]
    assert [point["ms_per_s"] for point in about["methods"]["rk4"]] == pytest.approx([200, 400, 800])
    first = about["methods"]["midpoint"][0]
    assert (first["error"], first["ms_per_s"]) == (None, None)


def test_the_cheapest_method_that_reaches_the_aim_is_chosen_by_time() -> None:
    about = cost_of_accuracy.costs_of(CASE, [REPORT])
    assert about["cheapest"] == "midpoint"
    assert about["to_aim"]["midpoint"]["ms_per_s"] == pytest.approx(150)
    assert about["to_aim"]["midpoint"]["error"] == pytest.approx(0.005), "coarser steps are unstable"
    assert about["to_aim"]["rk4"]["ms_per_s"] == pytest.approx(400)
    assert about["to_aim"]["explicit_euler"] is None
    alone = cost_of_accuracy.costs_of(CASE, [report(REPORT.curve("explicit_euler"))])
    assert alone["cheapest"] is None


def test_methods_of_another_report_take_part() -> None:
    cheaper = report(curve("implicit_midpoint", (0.02, 0.01)))
    about = cost_of_accuracy.costs_of(CASE, [REPORT, cheaper])
    assert about["cheapest"] == "implicit_midpoint"
    assert list(about["methods"]) == ["rk4", "midpoint", "explicit_euler", "implicit_midpoint"]


def test_a_reference_that_is_too_inexact_is_refused() -> None:
    with pytest.raises(ValueError, match=r"boids\.yaml: errors below 1\.5% are not trusted, so 1% cannot be measured"):
        cost_of_accuracy.costs_of(CASE, [report(REPORT.curve("rk4"), floor=0.03)])


def test_scores_are_0_for_random_and_1_for_rules_and_float32_is_left_out() -> None:
    about = cost_of_accuracy.scores_of(transfer(path_follow=-10.0), "path_follow")
    assert [point["score"] for point in about["players"]["rules"]] == [1.0, 1.0]
    assert [point["score"] for point in about["players"]["ppo"]] == [1.1, 0.0]
    assert [point["us_per_s"] for point in about["players"]["ppo"]] == [3.0, 5.0]


def test_missing_tasks_and_players_are_named() -> None:
    played = transfer()
    with pytest.raises(ValueError, match=r"no results of task 'herd'; `python -m agents\.transfer` plays all"):
        cost_of_accuracy.scores_of(played, "herd")
    del played["tasks"]["flock"]["again"]["rules"]
    with pytest.raises(ValueError, match="no results of player 'rules' of task 'flock'"):
        cost_of_accuracy.scores_of(played, "flock")


def test_the_sentence_names_the_cheapest_methods_and_counts_the_tasks() -> None:
    costs = {
        "flock": {"midpoint": 1.05, "rk4": 1.0, "heun": 1.09, "explicit_euler": 1.2},
        "crowd": {"velocity_verlet": 2.0, "rk4": 2.3},
        "cloth": {"rk4": 1.0, "midpoint": None},
    }
    scenes: dict[str, Any] = {
        name: {"short": name, "to_aim": {method: ms and {"ms_per_s": ms} for method, ms in of.items()}}
        for name, of in costs.items()
    }
    assert cost_of_accuracy.sentence(scenes, transfer(path_follow=12.0)) == (
        "An error of 1 % costs least with RK4, midpoint or heun (flock), with velocity Verlet (crowd), with RK4 "
        "(cloth); PPO keeps 95 % of its lead over random with every method and step in 3 of 3 tasks."
    )
    assert "in 2 of 3 tasks" in cost_of_accuracy.sentence(scenes, transfer(path_follow=10.0))
    scenes["crowd"]["to_aim"] = {"rk4": None}
    assert "with no method (crowd)" in cost_of_accuracy.sentence(scenes, transfer())


# --- the picture


def drawn(figure: Any, panel: int) -> dict[tuple[str, int], list[tuple[float, float]]]:
    """Return the points of the solid lines of a panel, by colour and number of points."""
    found = {}
    for line in figure.findobj(lambda each: type(each).__name__ == "Axes")[panel].get_lines():
        if line.get_linestyle() == "-" and line.get_marker() == "o":
            points = list(zip(np.atleast_1d(line.get_xdata()), np.atleast_1d(line.get_ydata()), strict=True))
            found[to_hex(line.get_color()), len(points)] = points
    return found


def test_the_upper_panels_show_the_errors_over_time_and_a_ring_at_the_cheapest() -> None:
    figure = cost_chart.draw_chart(results())
    lines = drawn(figure, 0)
    rk4, midpoint = (cost_chart.METHODS[name][1].lower() for name in ("rk4", "midpoint"))
    assert np.array(lines[rk4, 3]) == pytest.approx(np.array([(200, 0.1), (400, 0.01), (800, 0.001)]))
    assert np.array(lines[midpoint, 2]) == pytest.approx(np.array([(150, 0.005), (300, 0.0005)]))
    axes = figure.findobj(lambda each: type(each).__name__ == "Axes")[0]
    [ring] = [line for line in axes.get_lines() if line.get_markersize() > 15]
    assert (ring.get_xdata()[0], ring.get_ydata()[0]) == pytest.approx((150, 0.005))
    assert to_hex(ring.get_markeredgecolor()) == midpoint
    [wall] = [line for line in axes.get_lines() if line.get_linestyle() == ":"]
    assert list(wall.get_xdata()) == pytest.approx([150, 150]), "coarser steps of the midpoint method are unstable"
    assert {text.get_text() for text in axes.texts} == {"RK4", "midpoint", "explicit Euler", "midpoint: 1.5e+02 ms"}


def test_a_method_has_the_same_colour_in_all_panels_and_the_worst_score_is_named() -> None:
    figure = cost_chart.draw_chart(results(path_follow=8.0))
    panels = figure.findobj(lambda each: type(each).__name__ == "Axes")
    rk4 = cost_chart.METHODS["rk4"][1].lower()
    assert rk4 in {colour for colour, _ in drawn(figure, 0)}
    points = [(line.get_xdata()[0], line.get_ydata()[0]) for line in panels[3].get_lines()
              if len(line.get_xdata()) == 1 and to_hex(line.get_color()) == rk4]  # fmt: skip
    assert sorted(points) == [(5.0, 0.9), (5.0, 1.0)]
    assert [text.get_text() for text in panels[3].texts] == ["RK4, dt 0.05 s"]
    assert [text.get_text() for text in panels[1].texts] == []


def test_each_method_has_a_colour_of_its_own() -> None:
    used = {name for case in cost_of_accuracy.CASES for names, _ in case.runs for name in names}
    assert used <= cost_chart.METHODS.keys() <= INTEGRATORS.keys()
    assert len({colour for _, colour in cost_chart.METHODS.values()}) == len(cost_chart.METHODS)


# --- the shipped scenes


@pytest.mark.parametrize("case", cost_of_accuracy.CASES, ids=lambda case: case.short)
def test_scenes_exist_and_run_for_whole_steps_before_they_are_measured(case: Case) -> None:
    steps = case.after / case.load().dt
    assert steps == pytest.approx(round(steps))
    assert json.loads(json.dumps(case.about))["contents"]["dimension"] in (2, 3)


# --- the command line


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "--transfer 'mine.json': no such file; `python -m agents.transfer` writes it"),
        ("{", "--transfer 'mine.json': not the results of a transfer"),
        ('{"tasks": {}}', "--transfer 'mine.json': not the results of a transfer"),
        (json.dumps({**transfer(), "tasks": {}}), "--transfer: has no results of task 'flock'"),
    ],
)
def test_bad_results_of_a_transfer_are_refused_before_anything_is_measured(
    content: str | None, message: str, elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cost_of_accuracy, "_measure", lambda *_: pytest.fail("something was measured"))
    if content is not None:
        Path("mine.json").write_text(content, encoding="utf-8")
    result = CliRunner().invoke(cost_of_accuracy.app, ["--transfer", "mine.json"])
    assert result.exit_code == 2
    [line] = result.stderr.splitlines()
    assert line.startswith("cost_of_accuracy: ") and message in line


@pytest.mark.slow
def test_a_scene_is_measured_from_a_later_state_and_both_files_are_written(
    elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = ((("midpoint", "rk4"), (4, 8)), (("velocity_verlet",), (2, 4)))
    monkeypatch.setattr(cost_of_accuracy, "CASES", (Case("boids.yaml", "A flock", "flock", 1.0, 0.2, runs, 64),))
    Path("mine.json").write_text(json.dumps(transfer()), encoding="utf-8")
    request = ["--transfer", "mine.json", "--repetitions", "1", "--processes", "1"]
    result = CliRunner().invoke(cost_of_accuracy.app, request)
    assert result.exit_code == 0, (result.output, result.exception)
    found = json.loads(Path("results/cost_of_accuracy.json").read_text(encoding="utf-8"))
    about = found["scenes"]["boids"]
    assert list(about["methods"]) == ["midpoint", "rk4", "velocity_verlet"]
    assert all(point["ms_per_s"] > 0 for points in about["methods"].values() for point in points)
    assert found["sentence"] in " ".join(result.stdout.split())
    assert Path("results/cost_of_accuracy.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    first, later = (
        cost_of_accuracy.dataclasses.replace(cost_of_accuracy.CASES[0], after=after).problems() for after in (0.0, 1.0)
    )
    assert np.abs(first[0].start.pos - later[0].start.pos).max() > 1.0, "birds fly at 2 to 3 m/s"
