"""Comparison of players: command line, files and sentences, on real tasks and on artificial scores."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from typer.testing import CliRunner

from agents import compare as comparison
from agents.compare import experiment_of
from flockenv.cli.main import main
from flockenv.evaluation import EVALUATION, Episodes, lead_interval, report, task_digest
from flockenv.evaluation.plots import Column, draw_chart, write_chart
from flockenv.jobs import Failure
from flockenv.jobs.job import code_digest, execute
from flockenv.players import trained_task
from flockenv.players.policy import save_policy
from flockenv.players.rules import TUNED
from flockenv.studies import comparison as scores
from flockenv.studies import play_jobs as play
from flockenv.tasks import TASKS

ROOT = Path(__file__).resolve().parent.parent
FILES = ["comparison.png", "replay.html", "results.json", "table.md"]
STILL = "def predict(observation):\n    return 0 * observation[:, :2]\n"


@pytest.fixture(autouse=True)
def in_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: str, code: int = 0) -> Any:
    result = CliRunner().invoke(comparison.app, arguments)
    assert result.exit_code == code, (result.output, result.exception)
    return result


def refused(*arguments: str) -> str:
    """Run a command that must fail with one line and exit code 2, and write nothing; return the line."""
    before = sorted(Path.cwd().rglob("*"))
    result = run(*arguments, code=2)
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("compare: ")
    assert lines[0].isprintable()
    assert sorted(Path.cwd().rglob("*")) == before
    return str(lines[0])


def artificial(returns: Any, task: str = "toy", **change: Any) -> Episodes:
    returns = np.asarray(returns, np.float64)
    fields: dict[str, Any] = {
        "task": task,
        "digest": "d",
        "seed": EVALUATION,
        "horizon": 9,
        "returns": returns,
        "success": returns > 0,
        "lengths": np.full(len(returns), 4),
        "terms": {"effort": returns},
        "metrics": {"time_to_goal": np.where(returns > 0, 2.0, np.nan)},
        "microseconds": 1.5,
        "latency": 20.0,
    }
    return Episodes(**{**fields, **change})


def artificial_results(scores: dict[str, Any], costs: dict[str, Any] | None = None) -> report.Results:
    """Return the results of players with returns (worlds,), or (seeds, worlds)."""
    runs = {
        name: {f"{name}@{k}": artificial(row) for k, row in enumerate(np.atleast_2d(rows))}
        for name, rows in scores.items()
    }
    return report.task_results("d", runs, costs or {}, 300, 0)


# --- sentences and tables


def test_results_have_scores_differences_and_intervals() -> None:
    luck = np.random.default_rng(0).normal(size=40)
    results = artificial_results({"random": luck - 5, "rules": luck, "ppo": luck + 1})
    assert list(results["players"]) == ["random", "rules", "ppo"]
    assert list(results["pairs"]) == ["ppo - rules", "ppo - random", "rules - random"]
    assert {"mean", "mean_low", "mean_high", "success_rate", "worlds"} <= results["players"]["ppo"].keys()
    pair = results["pairs"]["ppo - rules"]
    assert {"difference", "ci_low", "ci_high"} <= pair.keys()
    assert (pair["difference"], pair["ci_low"], pair["ci_high"]) == pytest.approx((1, 1, 1))
    assert pair["probability_better"] == 1
    assert pair["better_low"] < 1
    assert pair["separated"] is True
    assert results["players"]["ppo"]["worlds"] == 40
    assert results["players"]["ppo"]["metrics"]["time_to_goal"] == {"mean": 2.0, "worlds": int((luck + 1 > 0).sum())}
    assert results["players"]["random"]["metrics"]["time_to_goal"] == {"mean": None, "worlds": 0}
    assert results["players"]["rules"]["returns"] == [pytest.approx(list(luck), rel=1e-5)]


def test_results_are_strict_json_with_one_line_per_list() -> None:
    results = artificial_results({"a": [1.0, -2.5e-7, 3.0], "b": [0.0, 1e9, -1.0]})
    text = report.json_text(results)
    assert json.loads(text, parse_constant=pytest.fail) == json.loads(json.dumps(results))
    assert " [1.0,-2.5e-07,3.0]\n" in text
    assert "NaN" not in text


def test_innermost_objects_are_on_one_line_whatever_their_strings_hold() -> None:
    inner = {"a": '{ [x] }\n  "y"', "b": {}, "c": "[ 1 ] [  ] [ - ]"}
    results = {"one": {"a": "x\n  y", "b": 1.5, "c": {}}, "two": [inner, {"d": []}], "three": {"deep": {"e": [1, 2]}}}
    text = report.json_text(results)
    assert json.loads(text) == results
    assert ' "one": {"a": "x\\n  y", "b": 1.5, "c": {}},\n' in text and '{"d": []}' in text


def test_verdict_names_the_winner_the_difference_and_the_costs() -> None:
    luck = np.linspace(-1, 1, 101)
    costs = {"ppo": {"wall_time_s": 252, "steps": 1_000_000}, "rules": {"of": "tuning", "steps": 950}}
    ahead = artificial_results({"random": luck - 9, "rules": luck, "ppo": luck + 0.5}, costs)["verdict"]
    assert ahead.startswith(
        "toy: ppo beats rules by 0.500 [0.500, 0.500] per world and scores higher in 100 % [96, 100]"
    )
    assert "success 75% against 50%" in ahead.replace("74%", "75%")
    assert "ppo cost 4.2 min and 1.0 M agent-steps of training, then 1.5 µs per decision; " in ahead
    assert "; rules cost 950 agent-steps of tuning, then 1.5 µs per decision." in ahead


def test_verdict_also_reports_a_loss_of_ppo_or_a_tie() -> None:
    rng = np.random.default_rng(0)
    luck, noise = np.linspace(-1, 1, 101), 0.1 * rng.normal(size=101)
    behind = artificial_results({"rules": luck, "ppo": luck - 0.5 + noise})
    assert behind["pairs"]["ppo - rules"]["difference"] < 0
    found = re.match(r"toy: rules beats ppo by (\S+) \[(\S+), (\S+)\] per world", behind["verdict"])
    assert found
    value, low, high = map(float, found.groups())
    assert 0 < low < value < high
    assert value == pytest.approx(-behind["pairs"]["ppo - rules"]["difference"], abs=0.005)
    assert low == pytest.approx(-behind["pairs"]["ppo - rules"]["ci_high"], abs=0.005)
    level = artificial_results({"rules": luck, "ppo": luck + noise - noise.mean() + 1e-4})["verdict"]
    assert level.startswith("toy: ppo and rules are level: difference 0.000")


def test_a_player_of_several_seeds_has_their_number_and_ends_beside_its_mean() -> None:
    luck = np.random.default_rng(0).normal(size=40)
    results = artificial_results({"rules": luck, "ppo": luck + np.array([[0.5], [0.7], [0.9]])})
    ppo, pair = results["players"]["ppo"], results["pairs"]["ppo - rules"]
    assert ppo["runs"] == ["ppo@0", "ppo@1", "ppo@2"] and results["players"]["rules"]["runs"] == ["rules@0"]
    assert (ppo["lowest"], ppo["mean"], ppo["highest"]) == pytest.approx(luck.mean() + np.array([0.5, 0.7, 0.9]))
    interval = lead_interval(luck + np.array([[0.5], [0.7], [0.9]]), luck[None], 300)
    assert (pair["difference"], pair["ci_low"], pair["ci_high"]) == (interval.value, interval.low, interval.high)
    assert pair["ci_high"] - pair["ci_low"] > 0.3, "the luck of training"
    assert "success" in results["verdict"] and "; seeds: 3 against 1. ppo cost" in results["verdict"]
    assert report.seeds_text(ppo) == f"3: {ppo['lowest']:.3g}, {ppo['highest']:.3g}"


def test_players_are_level_if_the_interval_over_their_seeds_contains_zero() -> None:
    luck = np.random.default_rng(0).normal(size=40)
    results = artificial_results({"rules": luck, "ppo": luck + np.array([[0.5], [-0.3], [0.2]])})
    assert results["pairs"]["ppo - rules"]["separated"] is False
    assert "ppo and rules are level" in results["verdict"]
    assert artificial_results({"rules": luck, "ppo": luck + 0.2})["pairs"]["ppo - rules"]["separated"] is True


def test_all_seeds_of_a_player_play_the_same_worlds_unless_only_what_ships_is_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tuned = Path("tuned")
    tuned.mkdir()
    about = json.loads((TUNED / "pursuit.json").read_text())["players"]["rules"]
    searches = {str(seed): {**about, "parameters": {**about["parameters"], "gain": 2.0 + seed}} for seed in (1, 3)}
    found = {**about["found"], "seed": 2, "searches": searches}
    content = {"players": {"rules": {"parameters": about["parameters"], "found": found}}}
    (tuned / "pursuit.json").write_text(json.dumps(content))
    monkeypatch.setattr("flockenv.players.rules.TUNED", tuned)

    def played(*options: str) -> Any:
        run("--tasks", "pursuit", "--worlds", "3", "--smoke", "--processes", "1", *options)
        return json.loads(Path("results/results.json").read_text())["tasks"]["pursuit"]["players"]

    players = played("--players", "random,rules@*,rules@3")
    assert players["rules"]["runs"] == ["rules@2", "rules@1", "rules@3"] and len(players["rules"]["returns"]) == 3
    assert players["rules@3"]["returns"] == players["rules"]["returns"][2:]
    assert players["rules"]["returns"][0] != players["rules"]["returns"][1]
    shipped = played("--players", "random,rules@*", "--seeds", "shipped")
    assert shipped["rules"]["runs"] == ["rules"] and shipped["rules"]["returns"] == players["rules"]["returns"][:1]


TWO = ("--processes", "2")
WITHOUT_CLOCK = ("worlds", "runs", "mean", "returns", "metrics", "terms", "episode_length", "success_rate")


@pytest.mark.slow
def test_results_of_two_processes_equal_those_of_one() -> None:
    for out, processes in (("one", "1"), ("two", "2")):
        run("--tasks", "pursuit,obstacles", "--worlds", "2", "--smoke", "--processes", processes, "--out", out)
    one, two = (json.loads(Path(out, "results.json").read_text())["tasks"] for out in ("one", "two"))
    assert list(one) == list(two) == ["pursuit", "obstacles"]
    for name, about in one.items():
        assert two[name]["pairs"] == about["pairs"]
        for player, numbers in about["players"].items():
            assert [two[name]["players"][player][key] for key in WITHOUT_CLOCK] == [
                numbers[key] for key in WITHOUT_CLOCK
            ]


def test_shards_store_jobs_and_a_call_without_a_shard_collects_them(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ("--tasks", "obstacles", "--players", "random,textbook", "--worlds", "2", "--smoke")
    for shard in ("0/2", "1/2"):
        result = run(*arguments, "--shard", shard)
        assert result.stderr.splitlines()[-1].startswith(f"shard {shard}: 1 of 2 jobs, stored in results/jobs; ")
        assert not result.stdout and sorted(path.name for path in Path("results").iterdir()) == ["jobs"]
    run(*arguments, "--out", "once")
    monkeypatch.setattr(play, "rollout", None)
    run(*arguments)
    names = [sorted(path.name for path in Path(out, "jobs").rglob("*.safetensors")) for out in ("results", "once")]
    assert names[0] == names[1] and len(names[0]) == 2
    tasks = [json.loads(Path(out, "results.json").read_text())["tasks"]["obstacles"] for out in ("results", "once")]
    assert tasks[0]["pairs"] == tasks[1]["pairs"]
    for player, numbers in tasks[0]["players"].items():
        assert all(tasks[1]["players"][player][key] == numbers[key] for key in WITHOUT_CLOCK)
    assert refused(*arguments, "--shard", "2/2").startswith(
        "compare: --shard '2/2': must be I/N with I from 0 to N - 1"
    )


def test_stored_episodes_are_not_played_again(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ("--tasks", "obstacles", "--players", "random", "--worlds", "2", "--smoke")
    run(*arguments)
    first = json.loads(Path("results/results.json").read_text())["tasks"]
    with monkeypatch.context() as patch:
        patch.setattr(play, "rollout", None)
        run(*arguments)
        assert json.loads(Path("results/results.json").read_text())["tasks"] == first
        assert "TypeError" in run(*arguments, "--fresh", code=2).stderr
    [record] = Path("results/jobs").rglob("*.safetensors")
    record.write_bytes(record.read_bytes()[:-9])
    assert f"{record} is damaged: " in run(*arguments, code=2).stderr


@pytest.mark.slow
def test_failing_player_is_named_and_all_others_are_played() -> None:
    """There are more jobs than processes."""
    Path("odd.py").write_text("def predict(observation):\n    raise RuntimeError('no idea')\n")
    names = "pursuit,obstacles,corridor"
    result = run("--tasks", names, "--players", "odd.py,random", "--worlds", "2", *TWO, code=2)
    line = result.stderr.splitlines()[-1]
    assert (
        "player 'odd.py': RuntimeError in predict, line 2: no idea (task 'pursuit') (job compare/pursuit/odd-" in line
    )
    assert line.endswith("; 1 more, see `flockenv jobs results/jobs`")
    assert [path.name.split("-")[0] for path in Path("results/jobs").rglob("*.safetensors")] == 3 * ["random"]
    assert not Path("results/results.json").exists() and not multiprocessing.active_children()


def test_a_player_that_changes_during_the_run_is_refused() -> None:
    Path("mine.py").write_text(STILL)
    player, task = play.Player.of("mine.py"), TASKS["obstacles"]()
    job = play.play_job("compare", task, player, 2, 0)
    Path("mine.py").write_text(STILL.replace("0 *", "0.5 +  0 *"))
    failure = execute(job.function, job.arguments, code_digest())
    assert isinstance(failure, Failure) and "player 'mine.py' has changed" in str(failure)
    assert play.play_job("compare", task, player, 2, 0).key != job.key


def test_the_key_of_a_player_s_job_depends_on_the_files_that_belong_to_it() -> None:
    task, seen = TASKS["obstacles"](), set()

    def key(spec: str) -> str:
        return play.play_job("compare", task, play.Player.of(spec), 2, 0).key

    Path("mine.py").write_text(STILL)
    seen.add(key("mine.py"))
    for name, text in (("helper.py", "A = 1"), ("helper.py", "A = 2"), ("other.py", "A = 2")):
        Path(name).write_text(text)
        seen.add(key("mine.py"))
    assert len(seen) == 4
    save_policy("own.safetensors", still_tensors(task), {"activation": "tanh", "layout": task.layout.digest})
    before = key("own.safetensors")
    Path("own.json").write_text(Path("own.json").read_text().replace("tanh", "relu"))
    assert key("own.safetensors") != before


def still_tensors(task: Any) -> dict[str, Any]:
    """Return the weights of a policy without hidden layers that never acts."""
    inputs, outputs = task.layout.size, task.action_layout.size
    tensors = {"action.weight": np.zeros((outputs, inputs), np.float32), "action.bias": np.zeros(outputs, np.float32)}
    return {**tensors, "log_std": np.zeros(outputs, np.float32)}


@pytest.mark.slow
def test_process_that_exits_is_reported_and_nothing_hangs() -> None:
    Path("gone.py").write_text("import os\n\ndef predict(observation):\n    print('farewell')\n    os._exit(3)\n")
    line = run("--tasks", "pursuit,obstacles", "--players", "gone.py", "--worlds", "2", *TWO, code=2).stderr
    assert line.count("its process ended 3 times") == 2 and not Path("results/results.json").exists()


def _enable_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background test run ignores SIGINT, as do its children


def _has_members(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_interrupt_ends_every_process() -> None:
    """The signal goes to the whole process group, as from a terminal; workers print nothing."""
    command = [sys.executable, "-m", "agents.compare", "--tasks", "pursuit,obstacles", "--players", "random,rules"]
    process = subprocess.Popen(
        [*command, "--out", str(Path.cwd() / "out")], cwd=ROOT, text=True, stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL, start_new_session=True, preexec_fn=_enable_interrupts,
    )  # fmt: skip
    assert process.stderr is not None
    while "compare/" not in process.stderr.readline():
        assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.splitlines()[-1] == f"compare: {comparison.STOPPED}" and "Traceback" not in errors
    assert [path.name for path in Path("out").iterdir()] == ["jobs"]
    until = time.monotonic() + 10
    while _has_members(process.pid):
        assert time.monotonic() < until, "a process still runs"
        time.sleep(0.05)


def test_verdict_without_ppo_compares_the_two_best_players() -> None:
    luck = np.linspace(-1, 1, 101)
    three = artificial_results({"random": luck, "textbook": luck + 3, "rules": luck + 2})["verdict"]
    assert three.startswith("toy: textbook beats rules by 1.000")
    assert artificial_results({"ppo": luck})["verdict"] == "toy: only one player, no comparison."


def test_numbers_are_rounded_by_their_intervals() -> None:
    def shown(value: float, low: float, high: float) -> str:
        return report.interval_text({"x": value, "ci_low": low, "ci_high": high}, "x", "ci")

    assert shown(12.3456, 11.9876, 12.7654) == "12.35 [11.99, 12.77]"
    assert shown(1234.567, 1200.1, 1300.2) == "1235 [1200, 1300]"
    assert shown(0.0123412, 0.0119, 0.0139) == "0.0123 [0.0119, 0.0139]"
    assert shown(12.54, 7.1, 18.0) == "12.5 [7.1, 18.0]"
    assert shown(2.0, 2.0, 2.0) == "2.000 [2.000, 2.000]"
    assert [report.number_text(x) for x in (None, 0.123456, 12345.6, -0.0)] == ["–", "0.123", "12,346", "0"]
    assert [report.duration_text(x) for x in (4.2, 252)] == ["4 s", "4.2 min"]


def test_tables_fit_80_columns_and_escape_markup() -> None:
    luck = np.linspace(-1, 1, 101)
    episodes = {name: artificial(x, metrics={"[b]_m": x}) for name, x in {"[red]": luck, "a|b": luck + 0.5}.items()}
    results = report.task_results("d", {name: {name: each} for name, each in episodes.items()}, {}, 100, 0)
    console = Console(width=80, file=StringIO(), force_terminal=False)
    console.print(*report.player_tables("toy [bold]", results))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert all(
        word in text for word in ("toy [bold]", "[red]", "[b] m", "a|b", "0.500 [0.500, 0.500]", "100 % [96, 100]")
    )
    assert max(map(len, text.splitlines())) <= 80
    about = {"worlds": 101, "world_seeds": {"first": 1, "last": 2}, "versions": {}}
    page = report.markdown({"tasks": {"toy": results}, **about})
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(rows) == 4 + 3
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {6 + 1, 3 + 1}


# --- the chart


def columns() -> list[Column]:
    luck = np.random.default_rng(0).normal(size=50)
    scores = {"random": luck - 5, "rules": luck, "$mine_": luck + 0.5}
    return [report.chart_column("toy", artificial_results(scores))]


def test_chart_draws_the_intervals() -> None:
    [column] = columns()
    figure = draw_chart([column], "Title", "note")
    scores, success, pairs = figure.axes
    assert [label.get_text() for label in scores.get_yticklabels()] == ["random", "rules", "$mine_"]
    assert [label.get_text() for label in pairs.get_yticklabels()] == ["$mine_ - rules"]
    drawn = {tuple(line.get_xdata()) for axes in (scores, success, pairs) for line in axes.lines}
    for row in column.rows:
        for interval in (row.score, row.success):
            assert (interval.low, interval.high) in drawn
            assert (interval.value,) in drawn
    interval = column.pairs["$mine_ - rules"]
    assert (interval.low, interval.high) in drawn
    low, high = scores.get_xlim()
    assert all(low < row.score.low <= row.score.high < high for row in column.rows)


def test_chart_is_a_reproducible_png(in_temporary_folder: Path) -> None:
    for name in ("a.png", "b.png"):
        write_chart(in_temporary_folder / name, columns(), "Title")
    data = Path("a.png").read_bytes()
    assert data == Path("b.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    with Image.open("a.png") as picture:
        assert picture.mode == "P" and picture.info["Software"] == "flockenv"
        pixels = np.asarray(picture.convert("L"))
    assert min(pixels.shape) > 500
    assert (pixels < 128).mean() > 0.002


def test_empty_chart_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one task"):
        draw_chart([], "nothing")
    with pytest.raises(ValueError, match="at least one player"):
        draw_chart([Column("toy", [])], "nothing")


# --- the command line


def test_one_run_writes_all_four_files(in_temporary_folder: Path) -> None:
    Path("still.py").write_text(STILL)
    result = run("--players", "still.py,random", "--worlds", "6", "--smoke", "--out", "here/results")
    assert sorted(path.name for path in Path("here/results").iterdir() if path.is_file()) == FILES
    results = json.loads(Path("here/results/results.json").read_text(), parse_constant=pytest.fail)
    assert list(results["tasks"]) == list(TASKS)
    for name, about in results["tasks"].items():
        assert list(about["players"]) == ["random", "still"]
        assert list(about["pairs"]) == ["still - random"]
        assert about["players"]["still"]["worlds"] == 6
        assert [len(row) for row in about["players"]["still"]["returns"]] == [6]
        assert about["players"]["still"]["mean_low"] <= about["players"]["still"]["mean"]
        assert about["verdict"] in " ".join(result.stdout.split())
        assert f"## {name}" in Path("here/results/table.md").read_text()
    assert result.stdout.count("µs: per decision, all worlds at once / one row alone") == 1
    assert results["world_seeds"] == {"block": "evaluation", "first": EVALUATION, "last": EVALUATION + 5}
    assert results["players"] == {"random": "random", "still": "still.py"}
    assert results["smoke"] is True
    assert results["versions"]["numpy"] == np.__version__
    assert re.fullmatch(r"[0-9a-f]{40}", results["git"]["commit"] or "0" * 40)
    assert Path("here/results/comparison.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    page = Path("here/results/replay.html").read_text()
    assert all(name in page for name in ("still", "random", *TASKS))


def test_equal_seeds_give_equal_scores_and_different_seeds_do_not() -> None:
    def scores(out: str, seed: str) -> Any:
        run("--tasks", "obstacles", "--players", "random", "--worlds", "4", "--seed", seed, "--out", out)
        return json.loads(Path(out, "results.json").read_text())["tasks"]["obstacles"]["players"]["random"]["returns"]

    first = scores("a", "0")
    assert scores("a", "0") == first  # this also replaces the older result
    assert scores("b", "1") != first


def test_order_of_players_does_not_depend_on_the_arguments() -> None:
    Path("mine.py").write_text(STILL)
    field = play.players_in_order(["mine.py", "ppo", "random", "rules", "textbook", "ppo"])
    assert [player.name for player in field] == ["random", "textbook", "rules", "ppo", "mine"]


def test_user_s_weights_play_under_the_name_of_their_file() -> None:
    task = TASKS["obstacles"]()
    card = {"activation": "tanh", "layout": task.layout.digest, "steps": 5, "wall_time_s": 3.0}
    save_policy("own.safetensors", still_tensors(task), card)
    run("--tasks", "obstacles", "--players", "random", "--players", "own.safetensors", "--worlds", "2", "--smoke")
    players = json.loads(Path("results/results.json").read_text())["tasks"]["obstacles"]["players"]
    assert players["own"]["cost"] == {"wall_time_s": 3.0, "steps": 5}
    assert players["random"]["cost"] == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--tasks", "pursiut"), f"--tasks 'pursiut': unknown, did you mean `pursuit`?; allowed: {', '.join(TASKS)}"),
        (("--players", "rule"), "player 'rule': unknown, did you mean `rules`?"),
        (("--players", "no.py"), "player 'no.py': no such file"),
        (("--players", "<script>.py"), "--players '<script>.py': a name is up to 40"),
        (("--players", "a - b.py"), "a name is up to 40"),
        (("--players", "\x1b[2J"), "a name is up to 40"),
        (("--players", "still.py,sub/still.py"), "two players are called 'still'"),
        (("--players", "model.zip"), "executes the code stored in it"),
        (
            ("--players", "broken.py"),
            "player 'broken.py': ZeroDivisionError while loading it, line 1: ",
        ),
        (("--players", "late.py"), "player 'late.py': KeyError in player, line 2: 'no'"),
        (("--worlds", "1"), "--worlds 1: must be from 2"),
        (("--worlds", "0"), "--worlds 0: must be from 2"),
        (("--worlds", "1000000000"), "--worlds 1000000000: must be from 2 to 1000000"),
        (("--seed", "-1"), "seed: -1, must be an integer from 0 to 999"),
        (("--seed", "1000"), "seed: 1000, must be"),
        (("--out", "../../x"), "--out '../../x': must not go up"),
        (("--out", "/etc/x"), "--out '/etc/x': must lie below"),
        (("--out", "a\0b"), "control characters"),
        (("--out", "x" * 300), "too long"),
        (("--out", ""), "--out ''"),
        (("--out", "CON"), "reserved"),
        (("--out", "still.py"), "--out 'still.py': is a file, must be a folder"),
        (("--out", "still.py/x"), "is not a folder"),
        (("--out", "link"), "--out 'link': must lie below"),
        (("--out", "taken"), "taken/table.md': is a folder"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(
    arguments: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(play, "rollout", lambda *_, **__: pytest.fail("rollout was called"))
    Path("sub").mkdir()
    late = "def player(task):\n    return {}['no']"
    files = {"still.py": STILL, "sub/still.py": STILL, "broken.py": "1 / 0", "late.py": late, "model.zip": "PK"}
    for path, source in files.items():
        Path(path).write_text(source)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    os.symlink("/etc", "link")
    Path("taken/table.md").mkdir(parents=True)
    assert message in refused(*arguments)


def test_error_about_missing_weights_has_the_command_that_trains_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockenv.players.WEIGHTS", Path("nowhere"))
    line = refused("--players", "random,ppo", "--tasks", "flock")
    assert "no weights for task 'flock'" in line
    assert line.endswith("python -m agents.ppo configs/training/flock.yaml")


def test_player_that_raises_system_exit_is_named_and_nothing_is_written() -> None:
    Path("leaves.py").write_text("def predict(observation):\n    raise SystemExit(3)\n")
    line = run("--tasks", "pursuit", "--players", "random,leaves.py", "--worlds", "2", code=2).stderr
    assert "player 'leaves.py': SystemExit in predict, line 2: 3 (task 'pursuit')" in line.splitlines()[-1]
    assert not Path("results/results.json").exists()


def test_failing_player_is_named_and_nothing_is_written() -> None:
    for name, source, message in (
        ("bad", "def predict(o):\n    return o[:, 10**6]", "IndexError in predict, line 2: "),
        ("wide", "def predict(o):\n    return o", "ValueError in predict: actions of shape"),
        (
            "nan",
            "def predict(o):\n    return float('nan') * o[:, :2]",
            "ValueError in predict: an action is ",
        ),
        ("quits", "def predict(o):\n    exit(3)", "SystemExit in predict, line 2: 3"),
    ):
        Path(f"{name}.py").write_text(source)
        result = run("--tasks", "pursuit", "--players", f"{name}.py", "--worlds", "2", code=2)
        assert f"compare: player '{name}.py': {message}" in result.stderr
        assert re.search(rf"\(task 'pursuit'\) \(job compare/pursuit/{name}-\w+\)\n$", result.stderr)
        assert not Path("results/results.json").exists()


def test_debug_raises_the_exception() -> None:
    result = CliRunner().invoke(comparison.app, ["--tasks", "no", "--debug"])
    assert isinstance(result.exception, ValueError)


def test_interrupt_is_reported_and_no_result_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(play, "rollout", interrupted)
    result = run("--players", "random", "--worlds", "2", code=130)
    assert comparison.STOPPED in result.stderr
    assert not Path("results/results.json").exists()


def test_cost_of_a_player_comes_from_its_card_or_from_its_tuning(
    in_temporary_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = TASKS["pursuit"]()
    policies: dict[str, Any] = {
        "rules": SimpleNamespace(),
        "ppo": SimpleNamespace(card={"wall_time_s": 2.5, "steps": 3, "secret": 1}),
        "mine": SimpleNamespace(),
    }
    monkeypatch.setattr("flockenv.players.rules.TUNED", in_temporary_folder)
    ppo = {"wall_time_s": 2.5, "steps": 3}
    assert scores._costs(task, policies) == {"rules": {}, "ppo": ppo, "mine": {}}
    Path("pursuit.json").write_text('{"players": {"rules": {"parameters": {}, "found": {"agent_steps": 1200.0}}}}')
    spent = {"of": "tuning", "steps": 1200}
    assert scores._costs(task, policies) == {"rules": spent, "ppo": ppo, "mine": {}}


def test_task_is_built_from_its_config(in_temporary_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "CONFIGS", in_temporary_folder)
    Path("pursuit.yaml").write_text("task: pursuit\narguments: {horizon: 7}")
    run("--tasks", "pursuit", "--players", "random", "--worlds", "2", "--smoke")
    about = json.loads(Path("results/results.json").read_text())["tasks"]["pursuit"]
    assert about["horizon"] == 7
    assert about["players"]["random"]["episode_length"] <= 7
    Path("pursuit.yaml").write_text("task: pursuit\nargument: {horizon: 7}")
    assert "argument" in refused("--tasks", "pursuit")


NO_TORCH = """
import sys

class Refuse:  # sys.modules["torch"] = None would not do: scipy reads attributes of that
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "stable_baselines3"):
            raise ImportError(f"{name} is blocked")

sys.meta_path.insert(0, Refuse())
from typer.testing import CliRunner
from agents.compare import app
result = CliRunner().invoke(app, sys.argv[1:])
assert result.exit_code == 0, result.output
"""


@pytest.mark.slow
def test_compare_needs_no_torch() -> None:
    arguments = ["--players", "random,textbook,rules", "--worlds", "2", "--smoke", "--out", str(Path.cwd() / "out")]
    subprocess.run([sys.executable, "-c", NO_TORCH, *arguments], check=True, cwd=ROOT)


def test_hand_written_player_plays_only_the_tasks_that_it_supports() -> None:
    crossing, flock = TASKS["crossing"](), TASKS["flock"]()
    assert play.usual_players([crossing]) == ["random", "textbook", "orca", "rules", "ppo"]
    assert play.usual_players([flock]) == ["random", "textbook", "rules", "ppo"]
    assert play.usual_players([flock], "@*") == ["random", "textbook", "rules@*", "ppo@*"]
    orca, chance = play.Player.of("orca"), play.Player.of("random")
    fields = play.players_of([crossing, flock], [chance, orca])
    assert fields == {"crossing": [chance, orca], "flock": [chance]}
    with pytest.raises(ValueError, match="no hand-written player 'orca' for 'flock'; there is one for: crossing"):
        comparison.compare([flock], [orca], 2)
    with pytest.raises(ValueError, match="task 'flock': no player for it; these play other tasks only: orca"):
        comparison.compare([crossing, flock], [orca], 2)


# --- `flockenv compare`


@pytest.mark.parametrize("name", TASKS)
def test_a_task_as_trained_is_the_one_of_its_config(name: str) -> None:
    assert trained_task(name) == experiment_of(name).build()


def test_the_command_of_the_package_has_the_scores_of_the_workbench(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--players", "random,textbook", "--worlds", "2", "--processes", "1")
    run("--tasks", "obstacles", *options, "--out", "workbench")
    before = sorted(Path.cwd().iterdir())
    assert main(["compare", "obstacles", *options]) == 0
    printed = capsys.readouterr().out
    assert sorted(Path.cwd().iterdir()) == before
    assert "obstacles: " in printed and "textbook - random" in printed
    assert main(["compare", "obstacles", *options, "--out", "package"]) == 0
    ours, theirs = (json.loads(Path(folder, "results.json").read_text()) for folder in ("package", "workbench"))
    assert ours["tasks"]["obstacles"]["pairs"] == theirs["tasks"]["obstacles"]["pairs"]
    assert ours.keys() == theirs.keys() - {"git"}, "agents.publish reads both"
    assert sorted(path.name for path in Path("package").iterdir()) == sorted([*FILES, "jobs"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pursiut",), "TASK 'pursiut': unknown, did you mean `pursuit`?; allowed: bottleneck, "),
        (("--players", "rule"), "player 'rule': unknown, did you mean `rules`?"),
        (("--worlds", "1"), "--worlds 1: must be from 2"),
        (("--out", "../x"), "--out '../x': must not go up"),
        (("pursuit", "--seen", "-1"), "seen"),
        (("pursuit", "--set", "size=10"), "--set 'size=10': must be TASK.ARGUMENT=VALUE"),
        (("pursuit", "--set", "flock.agents=10"), "--set 'flock': unknown; allowed: pursuit"),
        (("pursuit", "--set", "pursuit.sise=10"), "--set: Pursuit: sise = 10: unknown key, did you mean `size`?"),
        (("pursuit", "--set", "pursuit.size=-1"), "--set: Pursuit: size = -1: must be a number > 6"),
        (
            ("pursuit", "--set", "pursuit.dt=1"),
            "--set: Pursuit: control_dt = 0.1 s is not a whole multiple of dt = 1 s",
        ),
    ],
)
def test_the_command_of_the_package_refuses_in_one_line(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", *arguments]) == 2
    line = capsys.readouterr().err
    assert message in line and line.count("\n") == 1 and list(Path.cwd().iterdir()) == []


def test_the_command_of_the_package_plays_a_task_with_other_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--players", "random,rules", "--worlds", "2", "--processes", "1", "--out", "small")
    assert main(["compare", "obstacles", *options, "--set", "obstacles.count=3", "--set", "obstacles.horizon=5"]) == 0
    assert "obstacles.count = 3, obstacles.horizon = 5" in Path("small/table.md").read_text()
    found = json.loads(Path("small/results.json").read_text())
    task = trained_task("obstacles").model_copy(update={"count": 3, "horizon": 5.0})
    assert found["tasks"]["obstacles"]["digest"] == task_digest(task)


def test_policy_in_another_task_than_it_was_trained_on_is_reported(
    in_temporary_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison, "CONFIGS", in_temporary_folder)
    Path("crossing.yaml").write_text("task: crossing\narguments: {agents: 16, horizon: 5}")
    printed = run("--tasks", "crossing", "--players", "random,ppo", "--worlds", "2", "--smoke").stdout
    line = (
        "crossing: ppo plays another task than it was trained on: horizon = 5, trained with 200; agents = 16, trained"
    )
    assert line in " ".join(printed.split())
    players = json.loads(Path("results/results.json").read_text())["tasks"]["crossing"]["players"]
    assert players["random"]["differs"] == []
    assert "agents = 16, trained with 12" in players["ppo"]["differs"]
    assert line in Path("results/table.md").read_text()
    Path("crossing.yaml").write_text("task: crossing\narguments: {neighbours: 4}")
    assert "made for observation 'neighbours' of shape (6, 2)" in refused("--tasks", "crossing", "--players", "ppo")
