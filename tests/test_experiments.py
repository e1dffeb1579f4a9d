"""Experiments: what they find, and the command that shows it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.cli import main
from flockenv.config import load_scene
from flockenv.experiments import EXPERIMENTS, Results, arbitration, run
from flockenv.experiments.arbitration import CASES, EXPERIMENT, VARIANTS
from flockenv.experiments.base import Experiment, Trial
from tests import catalogue


def test_every_arbitration_is_tried_in_every_conflict() -> None:
    assert list(VARIANTS) == [a.kind for a in catalogue.ARBITRATIONS] == list(EXPERIMENT.variants)
    for case in CASES:
        assert arbitration.scene_of(case, "blend").effects[0].arbitration.kind == "blend"  # type: ignore[attr-defined]
    assert EXPERIMENTS["arbitration"] is EXPERIMENT


def test_numbers_about_contacts_and_grants() -> None:
    depth = np.array([[[-1.0, 0.1]], [[0.2, -0.1]], [[-0.1, 0.3]]])  # one inside from the start, out, in again
    assert arbitration._contacts(depth) == {"collisions": 1.5, "deepest": 0.3}
    assert arbitration._contacts(-np.ones((3, 1, 2))) == {"collisions": 0.0, "deepest": 0.0}


@pytest.mark.slow
def test_what_the_experiment_shows() -> None:
    """A blend runs into what it is warned of, where wishes cancel and in an emergency; an ordered budget does not."""
    results, trials = run(EXPERIMENT)
    assert len(trials) == len(CASES) * len(VARIANTS)
    assert results.at("cancelling", "blend")["collisions"] == 1.0
    emergency = results.at("emergency", "blend")["collisions"]
    assert emergency is not None
    assert emergency > 0.5
    for case in CASES:
        for variant in ("priority", "allocation", "running_sum", "context"):
            assert results.at(case, variant)["collisions"] == 0.0
            assert results.at(case, variant)["share avoid_obstacles"] == pytest.approx(1, abs=0.05)
    chatter = {v: results.at("cancelling", v)["switches"] for v in VARIANTS}
    assert chatter["priority"] > 1.5 * chatter["allocation"]  # type: ignore[operator]  # numbers, both
    assert results.at("emergency", "allocation")["share seek"] < 0.7  # type: ignore[operator]
    assert Results.model_validate_json(results.model_dump_json()) == results


def small() -> Experiment:
    """One that costs nothing, with an obstacle to draw."""
    scene = load_scene(CASES["chatter"][2])
    path = np.linspace((-6, 0), (6, 1), 20)[:, None]

    def trial(case: str, variant: str) -> Trial:
        return Trial({"collisions": 1.0 if variant == "a" else float("nan")}, scene, path)

    return Experiment("small", "A small one", {"x": "nothing"}, ("a", "b"), {"collisions": "-"}, ("collisions",), trial)


def test_the_command_writes_table_numbers_and_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(EXPERIMENTS, "small", small())
    out = tmp_path / "x.png"
    assert main(["experiment", "small", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "A small one" in said
    found: dict[str, Any] = json.loads(out.with_suffix(".json").read_text())
    assert [cell["numbers"]["collisions"] for cell in found["cells"]] == [1.0, None]
    first = out.read_bytes()
    assert first[:4] == b"\x89PNG"
    assert main(["experiment", "small", "--out", str(out), "--force"]) == 0
    assert out.read_bytes() == first
    capsys.readouterr()
    assert main(["experiment", "small", "--out", str(out)]) == 2
    assert main(["experiment", "smal"]) == 2
    assert "smal: no such experiment, did you mean `small`?" in capsys.readouterr().err.replace("'", "")
