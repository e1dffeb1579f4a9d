"""What accuracy buys a policy: the settings, what is kept between runs, the sentences, and the command line."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import compare as comparison
from agents import transfer, transfer_cache, transfer_chart, transfer_report
from agents.transfer_cache import KEPT, Plan
from agents.transfer_report import Cell, Clock, Setting
from flockenv.physics.integrators import INTEGRATORS, RK4
from flockenv.tasks import TASKS, Pursuit

FILES = ["transfer.json", "transfer.md", "transfer.png"]
TINY = ("pursuit", "--worlds", "3", "--rounds", "2", "--workers", "1")
TRAINED = ("--methods", "semi_implicit_euler", "--substeps", "2")
STILL = "def predict(observation):\n    return 0 * observation[:, :2]\n"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: str, code: int = 0) -> Any:
    result = CliRunner().invoke(transfer.app, arguments)
    assert result.exit_code == code, (result.output, result.exception)
    return result


def results(folder: str = "results") -> Any:
    return json.loads(Path(folder, "transfer.json").read_text(), parse_constant=pytest.fail)


class Counted:
    """Stands for rollout, counts the calls, and may be interrupted at one of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stop_at: int = 0) -> None:
        self.calls, self.stop_at, self.real = 0, stop_at, transfer_cache.rollout
        monkeypatch.setattr(transfer_cache, "rollout", self)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        self.calls += 1
        if self.calls == self.stop_at:
            raise KeyboardInterrupt
        return self.real(*arguments, **options)


# --- settings


def test_the_trained_setting_is_the_task_itself_and_others_differ_in_what_they_say() -> None:
    task = Pursuit()
    trained = Setting.trained(task)
    assert trained == Setting("semi_implicit_euler", "float64", 2)
    assert trained.of(task) == task
    other = Setting("rk4", "float32", 8)
    assert other.of(task) == Pursuit(integrator=RK4(), dtype="float32", dt=task.control_dt / 8)
    assert (trained.name, other.name) == ("semi_implicit_euler /2", "rk4 float32 /8")


@pytest.mark.parametrize("control_dt", [0.1, 0.3, 0.7])
def test_every_number_of_steps_fits_into_a_decision(control_dt: float) -> None:
    for steps in (1, 2, 3, 7, 1000):
        task = Setting("midpoint", "float64", steps).of(Pursuit(control_dt=control_dt, dt=control_dt))
        assert task.substeps == steps


# --- what is measured


@pytest.mark.slow
def test_the_trained_setting_scores_what_the_comparison_says_bit_for_bit_and_again_the_same() -> None:
    run(*TINY, *TRAINED, "--players", "random,rules,ppo")
    task = TASKS["pursuit"]()
    field = comparison.field_of(["random", "rules", "ppo"])
    said, _ = comparison.compare([task], field, worlds=3, resamples=100)
    plan = Plan(task, (Setting.trained(task),), tuple(field), 3, 0, 2)
    for (_, name), cell in transfer_cache.played(plan).items():
        assert cell.returns.tolist() == said["tasks"]["pursuit"]["players"][name]["returns"]
    about = results()["tasks"]["pursuit"]
    assert about["again"] == {"random": 0.0, "rules": 0.0, "ppo": 0.0}
    [setting] = about["settings"].values()
    assert [setting["players"]["ppo"][key] for key in ("difference", "ci_low", "ci_high")] == [0, 0, 0]
    assert results()["world_seeds"]["first"] == said["world_seeds"]["first"]


@pytest.mark.slow
def test_methods_of_second_order_err_less_and_the_costs_are_told() -> None:
    run(*TINY, "--players", "rules", "--methods", "semi_implicit_euler,midpoint", "--substeps", "1,4")
    found = results()["tasks"]["pursuit"]["settings"]
    assert next(iter(found)) == "semi_implicit_euler /2"
    assert len(found) == 5
    errors = {name: about["error_mm"] for name, about in found.items()}
    assert errors["semi_implicit_euler /1"] > 3 * errors["semi_implicit_euler /4"] > 10 * errors["midpoint /4"]
    assert found["midpoint /4"]["evaluations_per_s"] == pytest.approx(2 * 4 / 0.1)
    assert all(0 < about["us_low"] <= about["us_per_s"] <= about["us_high"] for about in found.values())
    differences = {name: about["players"]["rules"]["difference"] for name, about in found.items()}
    assert differences.pop("semi_implicit_euler /2") == 0
    assert all(differences.values())


@pytest.mark.slow
def test_float32_plays_the_same_worlds() -> None:
    run(*TINY, "--players", "rules", "--methods", "semi_implicit_euler:float32", "--substeps", "2")
    other = results()["tasks"]["pursuit"]["settings"]["semi_implicit_euler float32 /2"]
    assert other["dtype"] == "float32"
    assert 0 < abs(other["players"]["rules"]["difference"]) < 0.5


# --- what is kept


@pytest.mark.slow
def test_the_same_command_goes_on_after_an_interruption_and_plays_nothing_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = (*TINY, "--players", "random,rules", "--methods", "semi_implicit_euler", "--substeps", "1,2")
    cells = 2 * 2 + 2  # settings times players, and the trained setting again
    first = Counted(monkeypatch, stop_at=4)
    result = run(*asked, code=130)
    assert "interrupted; what was played is in" in result.stderr
    assert len(list(KEPT.rglob("*.json"))) == 3
    assert not Path("results").exists()
    monkeypatch.setattr(transfer_cache, "rollout", first.real)
    second = Counted(monkeypatch)
    run(*asked)
    assert second.calls == cells - 3
    kept = {path: path.read_bytes() for path in KEPT.rglob("*.json")}
    before = results()
    run(*asked)
    assert second.calls == cells - 3
    assert {path: path.read_bytes() for path in KEPT.rglob("*.json")} == kept
    after = results()
    assert after["tasks"] == before["tasks"]  # times too: no round is run twice


@pytest.mark.slow
def test_more_rounds_are_added_to_those_that_are_kept() -> None:
    run(*TINY, *TRAINED, "--players", "random")
    [path] = KEPT.rglob("clock-*.json")
    before = json.loads(path.read_text())["rounds"]
    run(*TINY, *TRAINED, "--players", "random", "--rounds", "3")
    rounds = json.loads(path.read_text())["rounds"]
    assert rounds[:2] == before
    assert len(rounds) == 3


DAMAGED = [
    ("rules-*.json", ""),
    ("rules-*.json", '{"returns": [1.0, 2.0'),
    ("rules-*.json", '{"returns": [1.0, 2.0], "success": [true, true]}'),
    ("rules-*.json", '{"returns": [1.0, 2.0, NaN], "success": [true, true, true]}'),
    ("rules-*.json", '{"success": [true, true, true]}'),
    ("rules-*.json", "[1, 2]"),
    ("clock-*.json", '{"rounds": [{"a": "b"}], "error_mm": {}}'),
    ("clock-*.json", '{"rounds": [], "error": {}}'),
    ("clock-*.json", "\x00"),
]


def test_a_kept_file_that_is_damaged_is_named_in_one_line() -> None:
    asked = (*TINY, *TRAINED, "--players", "rules")
    run(*asked)
    for name, content in DAMAGED:
        [path] = KEPT.rglob(name)
        before = path.read_bytes()
        path.write_text(content, encoding="utf-8")
        said = run(*asked, code=2).stderr
        assert said.startswith(f"transfer: {path} is damaged: ") and said.count("\n") == 1, said
        path.write_bytes(before)
    path.unlink()
    run(*asked)


@pytest.mark.slow
def test_a_player_that_has_changed_plays_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = Counted(monkeypatch)
    asked = (*TINY, *TRAINED, "--players", "mine.py")
    Path("mine.py").write_text(STILL)
    run(*asked)
    assert counted.calls == 2
    run(*asked)
    assert counted.calls == 2
    Path("mine.py").write_text(STILL.replace("0 *", "0.5 +  0 *"))
    run(*asked)
    assert counted.calls == 4


@pytest.mark.slow
def test_two_processes_find_what_one_finds() -> None:
    asked = ("--players", "random,rules", "--methods", "semi_implicit_euler,midpoint", "--substeps", "2")
    run(*TINY, *asked)
    alone = {path.name: path.read_bytes() for path in KEPT.rglob("*.json") if "clock" not in path.name}
    for path in KEPT.rglob("*.json"):
        path.unlink()
    run(*TINY, *asked, "--workers", "2")
    assert {path.name: path.read_bytes() for path in KEPT.rglob("*.json") if "clock" not in path.name} == alone


# --- what is said

LUCK = np.random.default_rng(0).normal(size=60)


def made_up(policy: Any, error_mm: tuple[float, float] = (80.0, 0.5), *rounds: tuple[float, float]) -> Any:
    """Results of two settings: the trained one, in which the policy scores LUCK + 10, and RK4, in which it does so."""
    task = Pursuit()
    settings = (Setting.trained(task), Setting("rk4", "float64", 4))
    scores = {
        (settings[0], "random"): LUCK,
        (settings[1], "random"): LUCK,
        (settings[0], "rules"): LUCK + 9,
        (settings[1], "rules"): LUCK + 9,
        (settings[0], "ppo"): LUCK + 10,
        (settings[1], "ppo"): np.asarray(policy),
    }
    cells = {key: Cell(returns, returns > 5) for key, returns in scores.items()}
    names = [setting.name for setting in settings]
    seconds = [dict(zip(names, times, strict=True)) for times in rounds or ((1.0, 3.0),)]
    clock = Clock(seconds, dict(zip(names, error_mm, strict=True)))
    again = {name: cells[settings[0], name] for name in ("random", "rules", "ppo")}
    return transfer_report.task_results(task, settings, cells, clock, again, 500, 0)


def test_the_sentence_says_what_survives_and_what_accuracy_costs() -> None:
    noise = 0.01 * np.random.default_rng(1).normal(size=60)
    said = made_up(LUCK + 9.8 + noise - noise.mean())["verdict"]
    assert said.startswith("pursuit: ppo survives every setting: in its worst setting (rk4, dt 0.025 s) it loses 0.2")
    assert "keeps 98 % of its lead over random" in said
    assert "solved to 0.5 mm (rk4, dt 0.025 s; trained: 80 mm) it loses 0.2" in said
    assert "and is ahead of rules (0.8" in said
    assert said.endswith("(rk4, dt 0.025 s: 0.5 mm) costs 3.00 times the time; no other has less error.")


def test_the_sentence_does_not_hide_that_a_policy_fails_or_that_nothing_is_known() -> None:
    lost = made_up(LUCK + 2)
    assert "ppo does not survive every setting: " in lost["verdict"]
    assert "it loses 8.000 [8.000, 8.000]" in lost["verdict"]
    assert "is behind rules (-7" in lost["verdict"]
    assert "success 0% against 100%" in lost["verdict"]
    noise = np.random.default_rng(1).normal(size=60)
    level = made_up(LUCK + 10 + noise - noise.mean() - 1e-3)["verdict"]
    assert "it is level with itself, -0.0" in level
    better = made_up(LUCK + 10.5, (80.0, 0.5), (1.0, 1.05), (1.02, 1.01), (1.0, 1.2))["verdict"]
    assert "ppo does nowhere worse than where it was made; " in better
    assert "it gains 0.500" in better
    assert "costs 1.05 times the time (rounds overlap); no other" in better


def test_of_settings_without_error_the_cheapest_is_named() -> None:
    about = made_up(LUCK + 10, error_mm=(1e-9, 1e-12))
    assert transfer_report.finest(about) == about["trained"]
    assert "solved to rounding (semi_implicit_euler, dt 0.05 s" in about["verdict"]


def test_the_page_holds_a_row_per_setting_and_the_trained_one_again() -> None:
    about = {"worlds": 60, "world_seeds": {"first": 1, "last": 60}, "versions": {"python": "3"}}
    page = transfer_report.markdown({
        "tasks": {"pursuit": made_up(LUCK + 9.8)}, **about, "machine": {"system": "here", "cores": 2},
    })  # fmt: skip
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + 3
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {8 + 1}
    assert "(trained)" in rows[2]
    assert "0.000" in rows[3]
    assert "-0.200 [-0.200, -0.200]" in rows[4]
    assert "(level)" in rows[4]


def test_the_picture_is_centred_on_the_trained_setting() -> None:
    figure = transfer_chart.draw_chart({"tasks": {"pursuit": made_up(LUCK + 10.2)}, "players": {"ppo": "ppo"}})
    heat = figure.axes[0]
    [shades] = heat.images
    low, high = shades.get_clim()
    assert low == -high == pytest.approx(-0.2)
    assert [text.get_text() for text in heat.texts] == ["trained", "+0.2"]
    assert [label.get_text() for label in heat.get_xticklabels()] == ["0.05", "0.025"]
    colours = shades.get_cmap()(shades.norm([-0.2, 0.0, 0.2]))
    assert np.ptp(colours[1][:3]) < 0.05, "no difference has no colour"
    assert colours[0][0] > colours[0][2], "losses are red"
    assert colours[2][2] > colours[2][0], "gains are blue"


def test_players_of_one_task_alone_are_in_the_legend_in_a_colour_of_their_own() -> None:
    tasks = {"pursuit": made_up(LUCK + 10.2)}
    for name in ("orca", "queueing"):
        tasks[name] = json.loads(json.dumps(tasks["pursuit"]).replace("rules", name))
    figure = transfer_chart.draw_chart({"tasks": tasks})
    [legend] = figure.legends
    handles = {t.get_text(): h for t, h in zip(legend.get_texts(), legend.legend_handles, strict=True)}
    assert {"rules", "orca", "queueing", "ppo"} < handles.keys()
    assert len({handles[name].get_color() for name in ("rules", "orca", "queueing", "ppo")}) == 4


# --- the command line


def test_the_usual_players_are_those_of_the_tasks_that_are_played(monkeypatch: pytest.MonkeyPatch) -> None:
    Counted(monkeypatch, stop_at=1)
    assert transfer.STOPPED in run(*TINY, *TRAINED, code=130).stderr


@pytest.mark.slow
def test_a_hand_written_player_sits_out_the_tasks_that_it_is_not_written_for() -> None:
    run("crossing", *TINY, *TRAINED, "--players", "random,orca")
    found = {task: list(about["again"]) for task, about in results()["tasks"].items()}
    assert found == {"crossing": ["random", "orca"], "pursuit": ["random"]}


def test_a_folder_in_the_place_of_a_file_is_refused_before_anything_is_played(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer_cache, "rollout", lambda *_, **__: pytest.fail("something was played"))
    Path("results/transfer.md").mkdir(parents=True)
    assert "transfer.md': is a folder" in run(*TINY, code=2).stderr


@pytest.mark.slow
def test_all_files_come_out_of_one_run() -> None:
    result = run(*TINY, *TRAINED, "--players", "random,rules", "--out", "here/out")
    assert sorted(path.name for path in Path("here/out").iterdir()) == FILES
    assert results("here/out")["tasks"]["pursuit"]["verdict"] in " ".join(result.stdout.split())
    assert Path("here/out/transfer.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pursiut",), "TASK 'pursiut': unknown, did you mean `pursuit`?"),
        (("--players", "rule"), "player 'rule': unknown, did you mean `rules`?"),
        (("--players", "no.py"), "player 'no.py': no such file"),
        (("--methods", "rk44"), "--methods 'rk44': no method of a task, did you mean `rk4`?; allowed: "),
        (("--methods", "rk4:float16"), "--methods 'rk4:float16': the precision must be float64 or float32"),
        (("--substeps", "0"), "--substeps '0': must be a whole number from 1 to 1000"),
        (("--substeps", "2.5"), "--substeps '2.5': must be"),
        (("--substeps", "1,9999999999"), "--substeps '9999999999': must be"),
        (("--worlds", "1"), "--worlds 1: must be from 2 to 1000000"),
        (("--rounds", "0"), "--rounds 0: must be from 1"),
        (("--workers", "0"), "--workers 0: must be from 1"),
        (("--seed", "1000"), "seed: 1000, must be"),
        (("--out", "../x"), "--out '../x': must not go up"),
    ],
)
def test_bad_requests_are_refused_in_one_line(
    arguments: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer_cache, "rollout", lambda *_, **__: pytest.fail("something was played"))
    result = run(*arguments, code=2)
    assert result.stdout == ""
    [line] = result.stderr.splitlines()
    assert line.startswith("transfer: ")
    assert message in line
    assert not list(Path.cwd().rglob("*"))


def test_a_method_that_leaves_the_kernel_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RK4, "solves", True)
    line = run("--methods", "rk4", code=2).stderr
    assert "--methods 'rk4': no method of a task" in line
    assert "midpoint" in line


def test_the_usual_methods_exist() -> None:
    assert {name.partition(":")[0] for name in transfer.METHODS} <= set(INTEGRATORS)
