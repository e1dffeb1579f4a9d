"""The log of a training: what Stable-Baselines3 records, and the learning curve, as CSV and for TensorBoard."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from agents import learn, ppo, training_log
from agents.experiment import Experiment
from agents.imitate import imitate
from agents.learner_job import ALGORITHMS, effective
from tests.training import PURSUIT, TINY, interrupt


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "progress.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def curve_of(rows: list[dict[str, str]]) -> list[tuple[float, ...]]:
    names = ("time/agent_steps", "tuning/mean_return", "tuning/success_rate")
    return [tuple(float(row[name]) for name in names) for row in rows if row["tuning/mean_return"]]


def points_of(curve: list[dict[str, float]]) -> list[tuple[float, ...]]:
    return [(point["steps"], point["mean"], point["success"]) for point in curve]


def test_the_log_has_a_row_per_rollout_and_the_learning_curve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(training_log, "find_spec", lambda name: None)
    run = ppo.train(PURSUIT, tmp_path)
    rows = rows_of(tmp_path / "log_1")
    assert curve_of(rows) == points_of(run.curve)
    assert [int(row["time/iterations"]) for row in rows if row["time/iterations"]] == [1, 2, 3, 4]
    assert all(float(row["train/loss"]) for row in rows[1:]), "of the update before the row"
    assert [path.name for path in (tmp_path / "log_1").iterdir()] == ["progress.csv"]
    line = f"log: {tmp_path / 'log_1'} (CSV only: TensorBoard's needs the package tensorboard)"
    assert line in capsys.readouterr().err.splitlines()


def test_a_training_that_continues_logs_what_follows_into_the_next_folder(tmp_path: Path) -> None:
    interrupt(PURSUIT, tmp_path, points=2)
    run = ppo.train(PURSUIT, tmp_path, go_on=True)
    first, second = (curve_of(rows_of(tmp_path / name)) for name in ("log_1", "log_2"))
    assert [*first, *second] == points_of(run.curve) and len(first) == 2
    ppo.train(PURSUIT, tmp_path, go_on=True)
    assert not (tmp_path / "log_3").exists(), "nothing was left to train"


def test_no_log_stays_of_a_training_that_was_interrupted_before_its_first_row(tmp_path: Path) -> None:
    interrupt(PURSUIT, tmp_path, points=0)
    assert not (tmp_path / "log_1").exists()


def test_a_log_that_is_removed_during_a_training_does_not_end_it(tmp_path: Path) -> None:
    model = ppo.build(PURSUIT.build(), PURSUIT.ppo)
    with training_log.write_log(model, tmp_path, Console(quiet=True)):
        shutil.rmtree(tmp_path / "log_1")
    assert not (tmp_path / "log_1").exists()


def test_the_log_can_be_read_by_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = ppo.train(PURSUIT, tmp_path)
    found = EventAccumulator(str(tmp_path / "log_1")).Reload()
    means = [event.value for event in found.Scalars("tuning/mean_return")]
    assert means == pytest.approx([point["mean"] for point in run.curve])
    assert [event.step for event in found.Scalars("tuning/mean_return")] == [point["steps"] for point in run.curve]


@pytest.mark.parametrize(
    "algo", [*ALGORITHMS[:1], *(pytest.param(name, marks=pytest.mark.slow) for name in ALGORITHMS[1:])]
)
def test_the_other_learners_log_their_curve_too(algo: str, tmp_path: Path) -> None:
    few: Any = {
        "worlds": 4,
        "steps": 600,
        "random_actions": 200,
        "minibatch": 32,
        "evaluate_every": 300,
        "buffer": 1000,
    }
    small = {"ppo": {**TINY, "steps": 1024, "hidden": [16, 16]}, "sac": few, "tqc": few, "recurrent_ppo": {"lstm": 8}}
    cloning = {"bc": {"updates": 40, "worlds": 3, "evaluate_updates": 10}}
    experiment = effective(Experiment(task="pursuit", arguments={"horizon": 40}, **small, **cloning), algo)
    run = learn.new_run(experiment, algo)
    learn.train(experiment, algo, run, tmp_path)
    rows = rows_of(tmp_path / "log_1")
    assert curve_of(rows) == points_of(run.curve)
    if algo != "bc":
        assert any(name.startswith("train/") and rows[-1][name] for name in rows[-1])


def test_imitation_logs_a_row_per_round_and_its_scores(tmp_path: Path) -> None:
    found = imitate(PURSUIT, tmp_path, worlds=2, updates=8)
    *rounds, last = rows_of(tmp_path / "log_1")
    assert [int(row["time/gradient_steps"]) for row in rounds] == [2, 4, 6, 8]
    sizes = [int(row["train/rows"]) for row in rounds]
    assert sizes == sorted(set(sizes)) and sizes[-1] == found.rows
    assert float(rounds[-1]["train/missed"]) == pytest.approx(found.missed)
    assert float(last["tuning/mean_return"]) == pytest.approx(found.network)
    assert float(last["tuning/mean_return_of_rules"]) == pytest.approx(found.rules)
