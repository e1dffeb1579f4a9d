"""Learning curves as bands over seeds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from agents.seed_curves import LEARNER_COLOUR, Curve, _limits, app, band, curves_of, with_learners
from flockenv import players
from flockenv.players import WEIGHTS
from flockenv.players.rules import TUNED

CURVES: list[Curve] = [
    {"steps": [0, 10, 20], "seconds": [1.0, 3.0, 5.0], "mean": [0.0, 10.0, 10.0]},
    {"steps": [0, 20, 30], "seconds": [2.0, 4.0, 9.0], "mean": [4.0, 8.0, 20.0]},
    {"steps": [0, 20], "seconds": [1.0, 6.0], "mean": [2.0, 2.0]},
]


def test_a_band_goes_from_the_lowest_to_the_highest_seed() -> None:
    places, (low, middle, high) = band(CURVES, "steps", 5)
    assert list(places) == [0, 5, 10, 15, 20], "it ends with the shortest curve"
    assert list(low) == [0, 2, 2, 2, 2]
    assert list(middle) == [2, 5, 6, 7, 8]
    assert list(high) == [4, 5, 10, 10, 10]
    assert band(CURVES, "seconds", 5)[0][[0, -1]] == pytest.approx([2.0, 5.0]), "every seed has points around"


def test_the_band_of_one_seed_is_its_curve() -> None:
    places, (low, middle, high) = band(CURVES[:1], "steps", 3)
    assert list(middle) == CURVES[0]["mean"]
    np.testing.assert_array_equal(low, high)
    assert list(places) == CURVES[0]["steps"]


def _has(colours: Any, wanted: Any) -> bool:
    """Return True if a picture has a colour, as nearly as the palette of its file allows."""
    return bool((np.abs(colours.astype(int) - wanted) <= 16).all(axis=1).any())


def test_the_curves_of_all_seeds_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "weights" / "seeds").mkdir(parents=True)
    (tmp_path / "tuned").mkdir()
    card = json.loads((WEIGHTS / "pursuit.json").read_text())
    seed = card["seed"] + 1
    other = {**card, "seed": seed, "curve": [{**point, "mean": point["mean"] - 1} for point in card["curve"]]}
    card["seeds"] = {"scores": {str(card["seed"]): 8.0, str(seed): 7.0}}
    for name, content in (("pursuit", card), (f"seeds/pursuit-seed-{seed}", other)):
        (tmp_path / "weights" / f"{name}.json").write_text(json.dumps(content))
        (tmp_path / "weights" / f"{name}.safetensors").touch()
    tuned: Any = json.loads((TUNED / "pursuit.json").read_text())
    tuned["players"]["rules"]["found"]["searches"] = {"0": {"parameters": {}, "curve": CURVES[0]}}
    (tmp_path / "tuned" / "pursuit.json").write_text(json.dumps(tuned))
    monkeypatch.setattr(players, "WEIGHTS", tmp_path / "weights")
    monkeypatch.setattr("flockenv.players.rules.TUNED", tmp_path / "tuned")
    monkeypatch.chdir(tmp_path)

    found = curves_of("pursuit")
    assert {name: len(curves) for name, curves in found.items()} == {"ppo": 2, "rules": 1}
    assert [curve["mean"][0] for curve in found["ppo"]] == [card["curve"][0]["mean"], other["curve"][0]["mean"]]
    assert curves_of("flock") == {}
    run = CliRunner().invoke(app, ["--out", "curves.png"])
    assert run.exit_code == 0, run.output
    with Image.open("curves.png") as picture:
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    for colour in ((0xD5, 0x5E, 0x00), (0x00, 0x72, 0xB2)):
        assert _has(colours, colour), "a line for each player"
    assert CliRunner().invoke(app, ["--out", "curves.jpg"]).exit_code == 2


def test_other_learners_are_drawn_beside_ppo_and_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    card = json.loads((WEIGHTS / "pursuit.json").read_text())
    for name, seed, less in (("sac", 0, 0.2), ("sac", 1, 0.2), ("bc", 0, 0.4)):  # no line hides another
        path = tmp_path / "cards" / name / f"pursuit-seed-{seed}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        curve = [{**point, "mean": point["mean"] - less} for point in card["curve"]]
        path.write_text(json.dumps({**card, "seed": seed, "curve": curve}))
    found = with_learners(Path("cards"))
    assert list(found) == ["pursuit"], "no other task"
    assert {name: len(curves) for name, curves in found["pursuit"].items() if name not in ("ppo", "rules")} == {
        "sac": 2, "bc": 1,
    }  # fmt: skip
    assert {"ppo", "rules"} < set(found["pursuit"])
    run = CliRunner().invoke(app, ["--learners", "cards", "--out", "learners.png"])
    assert run.exit_code == 0, run.output
    with Image.open("learners.png") as picture:
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    for colour in LEARNER_COLOUR["sac"], LEARNER_COLOUR["bc"]:
        wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        assert _has(colours, wanted), colour
    none = CliRunner().invoke(app, ["--learners", "nowhere", "--out", "learners.png"])
    assert none.exit_code == 2 and "--learners 'nowhere': no card FOLDER/ALGO/TASK-seed-N.json" in none.output


def test_the_end_of_a_short_curve_is_shown() -> None:
    long: Curve = {"steps": [0, 10], "seconds": [0, 10], "mean": [0.0, 1.0]}
    short: Curve = {"steps": [0, 1], "seconds": [0, 1], "mean": [0.0, 5.0]}
    low, high = _limits({"ppo": [long], "rules": [short]})
    assert low < 0.2 and high > 5.0
