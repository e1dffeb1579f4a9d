"""How accuracy of the physics affects a policy: settings, kept results, the verdict in words, the command line."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import compare as comparison
from agents import transfer, transfer_chart, transfer_jobs, transfer_report, transfer_verdict
from agents.transfer_jobs import Plan
from agents.transfer_report import Cell, Clock, Setting
from flockenv.envs.disturbance import Disturbance
from flockenv.jobs import Store
from flockenv.physics.integrators import INTEGRATORS, RK4
from flockenv.studies import play_jobs as play
from flockenv.tasks import TASKS, Bottleneck, Pursuit

FILES = ["transfer.json", "transfer.md", "transfer.png"]
TINY = ("pursuit", "--worlds", "3", "--rounds", "2", "--processes", "1")
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


JOBS = Path("results/jobs")


def records(kind: str) -> dict[Path, bytes]:
    """Return the bytes of the stored records of some kinds of jobs."""
    return {path: path.read_bytes() for path in JOBS.glob(f"{kind}/**/*.safetensors")}


class Counted:
    """Replacement of `rollout` that counts calls and raises KeyboardInterrupt in the call `stop_at`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stop_at: int = 0) -> None:
        self.calls, self.stop_at, self.real = 0, stop_at, play.rollout
        monkeypatch.setattr(play, "rollout", self)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        self.calls += 1
        if self.calls == self.stop_at:
            raise KeyboardInterrupt
        return self.real(*arguments, **options)


# --- settings


def test_the_trained_setting_is_the_task_and_others_replace_method_dtype_and_step() -> None:
    task = Pursuit()
    trained = Setting.of_training(task)
    assert trained == Setting("semi_implicit_euler", "float64", 2)
    assert trained.applied_to(task) == task
    other = Setting("rk4", "float32", 8)
    assert other.applied_to(task) == Pursuit(integrator=RK4(), dtype="float32", dt=task.control_dt / 8)
    assert (trained.name, other.name) == ("semi_implicit_euler /2", "rk4 float32 /8")


@pytest.mark.parametrize("control_dt", [0.1, 0.3, 0.7])
def test_a_setting_has_its_number_of_steps_per_decision(control_dt: float) -> None:
    for steps in (1, 2, 3, 7, 1000):
        task = Setting("midpoint", "float64", steps).applied_to(Pursuit(control_dt=control_dt, dt=control_dt))
        assert task.substeps == steps


# --- measured numbers


@pytest.mark.slow
def test_the_trained_setting_scores_as_in_the_comparison_bit_for_bit() -> None:
    run(*TINY, *TRAINED, "--players", "random,rules,ppo")
    task = TASKS["pursuit"]()
    field = play.players_in_order(["random", "rules", "ppo"])
    report, played = comparison.compare([task], field, worlds=3, resamples=100)
    plan = Plan(task, (Setting.of_training(task),), tuple(field), 3, 0, 2)
    for (_, name), cell in transfer_jobs.read_cells(plan, transfer_jobs.jobs_by_kernel([plan]), Store(JOBS)).items():
        (episodes,) = played["pursuit"][name].values()
        assert cell.returns.tolist() == episodes.returns.tolist()
    about = results()["tasks"]["pursuit"]
    assert about["again"] == {"random": 0.0, "rules": 0.0, "ppo": 0.0}
    [setting] = about["settings"].values()
    assert [setting["players"]["ppo"][key] for key in ("difference", "ci_low", "ci_high")] == [0, 0, 0]
    assert results()["world_seeds"]["first"] == report["world_seeds"]["first"]


def test_a_plan_s_disturbance_is_that_of_its_episodes_and_of_the_pilot() -> None:
    task, player, delay = Pursuit(horizon=20), play.Player.of("rules"), Disturbance(delay=4)
    calm = Plan(task, (Setting.of_training(task),), (player,), 3, 0, 1)
    late = dataclasses.replace(calm, disturbance=delay)
    job, plain = (transfer_jobs.cell_job(plan, plan.settings[0], player) for plan in (late, calm))
    compared = play.play_job("compare", task, player, 3, 0, disturbance=delay)
    played = play.episodes_of_bytes(job.function(*job.arguments))
    assert (job.about, played.returns.tolist()) == (
        compared.about, play.episodes_of_bytes(compared.function(*compared.arguments)).returns.tolist()
    )  # fmt: skip
    assert job.key != plain.key and transfer_jobs.round_jobs([late])[0].key != transfer_jobs.round_jobs([calm])[0].key
    actions = [np.array(transfer_jobs._pilot_actions(plan)) for plan in (late, calm)]
    np.testing.assert_array_equal(actions[0][0], actions[1][0])
    assert not np.array_equal(*actions)


@pytest.mark.slow
def test_the_page_names_the_disturbance() -> None:
    run(*TINY, *TRAINED, "--players", "rules", "--delay", "4")
    assert results()["disturbance"]["delay"] == 4
    assert "3 worlds per task, delay 4, seeds " in Path("results/transfer.md").read_text()


@pytest.mark.slow
def test_methods_of_second_order_have_less_error_and_costs_are_reported() -> None:
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
def test_float32_uses_the_same_worlds() -> None:
    run(*TINY, "--players", "rules", "--methods", "semi_implicit_euler:float32", "--substeps", "2")
    other = results()["tasks"]["pursuit"]["settings"]["semi_implicit_euler float32 /2"]
    assert other["dtype"] == "float32"
    assert 0 < abs(other["players"]["rules"]["difference"]) < 0.5


# --- kept results


@pytest.mark.slow
def test_an_interrupted_command_continues_and_plays_nothing_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    request = (*TINY, "--players", "random,rules", "--methods", "semi_implicit_euler", "--substeps", "1,2")
    cells = 2 * 2 + 2  # settings times players, and the trained setting once more
    first = Counted(monkeypatch, stop_at=4)
    result = run(*request, code=130)
    assert transfer.STOPPED in result.stderr
    assert len(records("transfer*")) == 3
    assert not Path("results/transfer.json").exists()
    monkeypatch.setattr(play, "rollout", first.real)
    second = Counted(monkeypatch)
    run(*request)
    assert second.calls == cells - 3
    kept = records("*")
    before = results()
    run(*request)
    assert second.calls == cells - 3
    assert records("*") == kept
    after = results()
    assert after["tasks"] == before["tasks"]  # also the times: no round is run twice


@pytest.mark.slow
def test_more_rounds_are_added_to_the_kept_ones() -> None:
    run(*TINY, *TRAINED, "--players", "random")
    before = records("transfer-clock")
    run(*TINY, *TRAINED, "--players", "random", "--rounds", "3")
    after = records("transfer-clock")
    assert len(before) == 2 and len(after) == 3 and before.items() <= after.items()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["transfer/pursuit/rules-*", "transfer-clock/round-1-*"])
def test_a_damaged_kept_file_is_named_in_one_line(name: str) -> None:
    request = (*TINY, *TRAINED, "--players", "rules")
    run(*request)
    [path] = JOBS.glob(name)
    before = path.read_bytes()
    for content in (b"", before[:-9], before[:50], b"\x00" * 99, before.replace(b"map", b"mop")):
        path.write_bytes(content)
        error = run(*request, code=2).stderr.splitlines()[-1]
        assert re.match(rf"transfer: \S*{path} is damaged: .*; delete it", error), error
    path.unlink()
    run(*request)


@pytest.mark.slow
def test_a_changed_player_is_played_again(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = Counted(monkeypatch)
    request = (*TINY, *TRAINED, "--players", "mine.py")
    Path("mine.py").write_text(STILL)
    run(*request)
    assert counted.calls == 2
    run(*request)
    assert counted.calls == 2
    Path("mine.py").write_text(STILL.replace("0 *", "0.5 +  0 *"))
    run(*request)
    assert counted.calls == 4


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_processes() -> None:
    request = ("--players", "random,rules", "--methods", "semi_implicit_euler,midpoint", "--substeps", "2")
    run(*TINY, *request)
    alone = results()["tasks"]["pursuit"]["settings"]
    run(*TINY, *request, "--processes", "2", "--out", "two")
    both = results("two")["tasks"]["pursuit"]["settings"]
    assert {name: about["players"] for name, about in both.items()} == {
        name: about["players"] for name, about in alone.items()
    }


# --- verdicts, page and picture

LUCK = np.random.default_rng(0).normal(size=60)


def made_up(policy: Any, error_mm: tuple[float, float] = (80.0, 0.5), *rounds: tuple[float, float]) -> Any:
    """Return results of two settings: the policy scores LUCK + 10 in the trained one, and `policy` in RK4."""
    task = Pursuit()
    settings = (Setting.of_training(task), Setting("rk4", "float64", 4))
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
    seconds = [dict(zip(names, times, strict=True)) for times in rounds or 3 * ((1.0, 3.0),)]
    clock = Clock(seconds, dict(zip(names, error_mm, strict=True)))
    again = {name: cells[settings[0], name] for name in ("random", "rules", "ppo")}
    return transfer_report.task_results(task, settings, cells, clock, again, 500, 0)


def test_the_verdict_reports_survival_and_the_cost_of_accuracy() -> None:
    noise = 0.01 * np.random.default_rng(1).normal(size=60)
    verdict = made_up(LUCK + 9.8 + noise - noise.mean())["verdict"]
    assert verdict.startswith("pursuit: ppo survives every setting: it keeps at least 98 % [98, 98] of its lead over ")
    assert "of its lead over random (rk4, dt 0.025 s); rules at least 100 % [100, 100] (rk4, dt 0.025 s). " in verdict
    assert "Solved to 0.5 mm (rk4, dt 0.025 s; trained: 80 mm) it loses 0.2" in verdict
    assert "and is ahead of rules (0.8" in verdict
    assert verdict.endswith("(rk4, dt 0.025 s: 0.5 mm) costs 3.00 times the time; no other has less error.")


def test_times_of_too_few_rounds_are_not_compared() -> None:
    about = made_up(LUCK + 9.8, (80.0, 0.5), (1.0, 3.0), (1.0, 3.0))
    assert "times the time" not in about["verdict"] + transfer_verdict.count_text({"herd": about})
    assert "times the time" in made_up(LUCK + 9.8)["verdict"]


def test_the_verdict_reports_failures_and_uncertainty() -> None:
    lost = made_up(LUCK + 2)
    assert (
        "ppo does not survive rk4, dt 0.025 s (keeps 20 % [20, 20] of its lead over random); rules" in lost["verdict"]
    )
    assert "it loses 8.000 [8.000, 8.000]" in lost["verdict"]
    assert "is behind rules (-7" in lost["verdict"]
    assert "success 0% against 100%" in lost["verdict"]
    noise = np.random.default_rng(1).normal(size=60)
    level = made_up(LUCK + 10 + noise - noise.mean() - 1e-3)["verdict"]
    assert "it is level with itself, -0.0" in level
    better = made_up(LUCK + 10.5, (80.0, 0.5), (1.0, 1.05), (1.02, 1.01), (1.0, 1.2))["verdict"]
    assert "ppo survives every setting: it keeps at least 105 % [105, 105]" in better
    assert "it gains 0.500" in better
    assert "costs 1.05 times the time (rounds overlap); no other" in better


@pytest.mark.parametrize(("kept", "survives"), [(0.9501, True), (0.9499, False), (1.2, True), (-0.5, False)])
def test_a_player_survives_a_setting_if_it_keeps_95_percent_of_its_lead_over_random(
    kept: float, survives: bool
) -> None:
    about = made_up(LUCK + 10 * kept)
    assert about["settings"]["rk4 /4"]["players"]["ppo"]["kept"] == pytest.approx(kept)
    assert transfer_verdict.lost_settings(about, "ppo") == ([] if survives else ["rk4 /4"])
    assert ("ppo survives every setting: " in about["verdict"]) is survives
    assert ("ppo does not survive rk4, dt 0.025 s " in about["verdict"]) is not survives


def test_all_settings_that_are_not_survived_are_named_the_worst_first() -> None:
    about = made_up(LUCK + 9)
    worse = json.loads(json.dumps(about["settings"]["rk4 /4"]))
    worse |= {"method": "heun"}
    worse["players"]["ppo"] |= {"kept": 0.5, "kept_low": 0.4, "kept_high": 0.6}
    about["settings"]["heun /4"] = worse
    about["settings"]["rk4 /8"] = json.loads(json.dumps(about["settings"][about["trained"]])) | {"dt": 0.0125}
    text = transfer_verdict.verdict("pursuit", about)
    named = "heun, dt 0.025 s (keeps 50 % [40, 60] of its lead over random), rk4, dt 0.025 s (keeps 90 % [90, 90])"
    assert f"ppo does not survive {named}; it survives the other 1 settings; rules at least" in text


def test_the_counts_are_those_of_the_tasks_and_name_the_exceptions() -> None:
    tasks = {"herd": made_up(LUCK + 9.9), "evade": made_up(LUCK + 9), "school": made_up(LUCK + 9.96)}
    text = transfer_verdict.count_text(tasks)
    assert text.startswith("**ppo** survives every setting in 2 of 3 tasks. It does not survive: evade under rk4, dt ")
    assert "(90 % [90, 90])" in text
    assert "In settings without more error than the trained one it survives in 2 of 3." in text
    assert "**rules** survives every setting in 3 of 3 tasks. At most a tenth" in text
    assert "herd under" not in text and "random" not in text
    for about in tasks.values():
        about["settings"]["rk4 /4"]["error_mm"] = 90.0
    coarser = transfer_verdict.count_text(tasks)
    assert "In settings without more error than the trained one it survives in 3 of 3." in coarser
    noise = np.random.default_rng(1).normal(size=60)
    close = transfer_verdict.count_text({"herd": made_up(LUCK + 9.6 + 2 * (noise - noise.mean()))})
    assert "in 1 of 1 tasks (in herd an interval reaches below 95%)" in close


def test_a_player_without_a_lead_over_random_has_nothing_to_keep() -> None:
    task, trained, other = Pursuit(), Setting.of_training(Pursuit()), Setting("rk4", "float64", 4)
    cells = {(setting, name): Cell(LUCK, LUCK > 0) for setting in (trained, other) for name in ("random", "ppo")}
    clock = Clock([{trained.name: 1.0, other.name: 1.0}], {trained.name: 1.0, other.name: 0.1})
    again = {name: cells[trained, name] for name in ("random", "ppo")}
    about = transfer_report.task_results(task, (trained, other), cells, clock, again, 100, 0)
    assert "kept" not in about["settings"][other.name]["players"]["ppo"]
    assert "pursuit: ppo has no lead over random that it could keep. " in about["verdict"]


def test_the_cheapest_of_the_settings_without_error_is_named() -> None:
    about = made_up(LUCK + 10, error_mm=(1e-9, 1e-12))
    assert transfer_verdict.most_accurate(about) == about["trained"]
    assert "Solved to rounding (semi_implicit_euler, dt 0.05 s" in about["verdict"]


def test_the_page_has_a_row_per_setting_of_note_and_says_why_it_is_there() -> None:
    about = {"worlds": 60, "world_seeds": {"first": 1, "last": 60}, "versions": {"python": "3"}}
    task = made_up(LUCK + 9.8)
    task["settings"]["rk4 /4"]["unstable"] = True
    page = transfer_report.markdown({"tasks": {"pursuit": task}, **about, "machine": {"system": "here", "cores": 2}})
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + 2
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {9 + 1}
    assert rows[2].startswith("| trained | semi_implicit_euler | 0.05 |")
    assert rows[3].startswith("| worst for rules, worst for ppo, a tenth of the error, least error | rk4 | 0.025 |")
    assert "-0.200 [-0.200, -0.200]" in rows[3]
    assert "(level)" in rows[3]
    assert page.index(transfer_verdict.count_text({"pursuit": task})) < page.index("Policies were trained")
    assert "Longer than the largest step that is stable in every contact: rk4, dt 0.025 s." in page
    assert (
        "Played a second time, the trained settings had the same returns to the last bit. Rounds of timing: 3." in page
    )


def test_the_picture_has_one_colour_scale_for_all_tasks() -> None:
    tasks = {"pursuit": made_up(LUCK + 10.2), "herd": made_up(LUCK + 5), "evade": made_up(LUCK + 9.8)}
    tasks["flock"] = json.loads(json.dumps(tasks["evade"]))
    for about in tasks["flock"]["settings"].values():  # the same share of a lead that is ten times as large
        for player in about["players"].values():
            player |= {key: 10 * player[key] for key in ("mean", "difference", "ci_low", "ci_high")}
    figure = transfer_chart.draw_chart({"tasks": tasks})
    images = {axes.get_title(loc="left"): axes.images[0] for axes in figure.axes if axes.images}
    assert images.keys() == tasks.keys()
    assert {image.get_clim() for image in images.values()} == {(-transfer_chart.SCALE, transfer_chart.SCALE)}
    losses = {name: image.to_rgba(image.get_array())[1, 1] for name, image in images.items()}
    assert losses["evade"].tolist() == losses["flock"].tolist()
    assert losses["herd"][0] > losses["herd"][2] and losses["herd"][1] < losses["evade"][1], "large losses are darker"
    assert losses["pursuit"][2] > losses["pursuit"][0], "gains are blue"
    texts = [text.get_text() for axes in figure.axes[:4] for text in axes.texts if text.get_text() != "–"]
    assert texts == ["0", "+2", "0", "-50", "0", "-2", "0", "-2"]
    assert figure.get_suptitle() == "ppo keeps 95 % of its lead in every setting in 3 of 4 tasks"


# --- the command line


def test_the_default_players_exist_for_the_tasks_that_are_played(monkeypatch: pytest.MonkeyPatch) -> None:
    Counted(monkeypatch, stop_at=1)
    assert transfer.STOPPED in run(*TINY, *TRAINED, code=130).stderr


@pytest.mark.slow
def test_a_hand_written_player_plays_only_its_own_tasks() -> None:
    run("crossing", *TINY, *TRAINED, "--players", "random,orca")
    found = {task: list(about["again"]) for task, about in results()["tasks"].items()}
    assert found == {"crossing": ["random", "orca"], "pursuit": ["random"]}


def test_a_folder_in_place_of_a_file_is_refused_before_anything_is_played(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(play, "rollout", lambda *_, **__: pytest.fail("something was played"))
    Path("results/transfer.md").mkdir(parents=True)
    assert "transfer.md': is a folder" in run(*TINY, code=2).stderr


@pytest.mark.slow
def test_one_run_writes_all_files() -> None:
    result = run(*TINY, *TRAINED, "--players", "random,rules", "--out", "here/out")
    assert sorted(path.name for path in Path("here/out").iterdir() if path.is_file()) == FILES
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
        (("--substeps", "0"), "--substeps '0': must be an integer from 1 to 1000"),
        (("--substeps", "2.5"), "--substeps '2.5': must be"),
        (("--substeps", "1,9999999999"), "--substeps '9999999999': must be"),
        (("--worlds", "1"), "--worlds 1: must be from 2 to 1000000"),
        (("--rounds", "0"), "--rounds 0: must be from 1"),
        (("--seed", "1000"), "seed: 1000, must be"),
        (("--out", "../x"), "--out '../x': must not go up"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    arguments: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(play, "rollout", lambda *_, **__: pytest.fail("something was played"))
    result = run(*arguments, code=2)
    assert result.stdout == ""
    [line] = result.stderr.splitlines()
    assert line.startswith("transfer: ")
    assert message in line
    assert not list(Path.cwd().rglob("*"))


def test_a_method_that_solves_equations_in_python_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RK4, "solves", True)
    line = run("--methods", "rk4", code=2).stderr
    assert "--methods 'rk4': no method of a task" in line
    assert "midpoint" in line


def test_steps_are_half_once_and_four_times_those_of_training() -> None:
    names = [setting.name for setting in transfer._settings(Pursuit(), [("rk4", "float64")], [])]
    assert names == ["semi_implicit_euler /2", "rk4 /1", "rk4 /2", "rk4 /8"]
    names = [setting.name for setting in transfer._settings(Bottleneck(), [("rk4", "float32")], [])]
    assert names == ["semi_implicit_euler /10", "rk4 float32 /5", "rk4 float32 /10", "rk4 float32 /40"]


def test_a_setting_is_unstable_if_its_step_is_longer_than_is_stable_in_a_contact() -> None:
    long, short = (Setting("rk4", "float64", steps).applied_to(Bottleneck()) for steps in (1, 10))
    assert (transfer_report.is_unstable(long), transfer_report.is_unstable(short)) == (True, False)
    assert not transfer_report.is_unstable(Setting("explicit_euler", "float64", 1).applied_to(Pursuit()))


def test_the_default_methods_exist() -> None:
    assert {name.partition(":")[0] for name in transfer.METHODS} <= set(INTEGRATORS)
