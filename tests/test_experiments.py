"""Experiments: plans, results, and the command that runs them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.cli.main import main
from flockenv.scene.yaml_io import ConfigError
from flockenv.studies.experiments import Results, SteerPlan, arbitration, load_plan, run
from tests import catalogue

PLANS = Path(__file__).parent.parent / "configs" / "experiments"


@pytest.mark.parametrize("path", sorted(PLANS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_plan_builds_its_scenes_and_has_the_name_of_its_file(path: Path) -> None:
    experiment = load_plan(path).experiment()  # builds every scene
    assert experiment.name == path.stem
    assert experiment.cases
    assert experiment.variants


def steer_plan(name: str) -> SteerPlan:
    plan = load_plan(PLANS / f"{name}.yaml")
    assert isinstance(plan, SteerPlan)
    return plan


def test_every_arbitration_is_a_variant_of_every_case() -> None:
    plan = steer_plan("arbitration")
    assert list(plan.variants) == [a.kind for a in catalogue.ARBITRATIONS]
    for case in plan.cases:
        for variant in plan.variants:
            assert plan.scene_of(case, variant).effects[0].arbitration.kind == variant  # type: ignore[attr-defined]


def test_follow_way_has_the_target_of_the_seek_behaviour_it_replaces() -> None:
    plan = steer_plan("avoidance")
    avoid, way = plan.scene_of("U trap", "to avoid, global way").effects[0].components
    assert (avoid.kind, way.kind, way.target) == ("avoid_obstacles", "follow_way", (12, 0))  # type: ignore[attr-defined]
    assert [each.kind for each in plan.scene_of("U trap", "whiskers").effects[0].components] == ["whiskers", "seek"]


def test_collisions_and_depths_are_counted_per_agent() -> None:
    # One agent enters once; the other starts inside, leaves and enters again.
    depth = np.array([[[-1.0, 0.1]], [[0.2, -0.1]], [[-0.1, 0.3]]])
    assert arbitration._contacts(depth) == {"collisions": 1.5, "deepest": 0.3}
    assert arbitration._contacts(-np.ones((3, 1, 2))) == {"collisions": 0.0, "deepest": 0.0}


@pytest.mark.slow
def test_blending_collides_in_conflicts_and_ordered_arbitrations_do_not() -> None:
    """A blend collides if forces cancel, and in an emergency."""
    plan = steer_plan("arbitration")
    results, trials = run(plan.experiment())
    assert len(trials) == len(plan.cases) * len(plan.variants)
    assert results.at("cancelling", "blend")["collisions"] == 1.0
    emergency = results.at("emergency", "blend")["collisions"]
    assert emergency is not None
    assert emergency > 0.5
    for case in plan.cases:
        for variant in ("priority", "allocation", "running_sum", "context"):
            assert results.at(case, variant)["collisions"] == 0.0
            assert results.at(case, variant)["share avoid_obstacles"] == pytest.approx(1, abs=0.05)
    chatter = {v: results.at("cancelling", v)["switches"] for v in plan.variants}
    assert chatter["priority"] > 1.5 * chatter["allocation"]  # type: ignore[operator]  # numbers, both
    assert results.at("emergency", "allocation")["share seek"] < 0.7  # type: ignore[operator]
    assert Results.model_validate_json(results.model_dump_json()) == results


SMALL = """
measure: avoidance
title: A small one
worlds: 1
cases:
  ahead:
    what: nothing much
    seconds: 0.2
    scene:
      groups: [{count: 1, radius: 0.2, max_speed: 2, max_force: 12, spawn: {low: [0, 0], high: [0, 0]}}]
      effects: [{kind: steer, behaviours: [{kind: seek, weight: 4, target: [12, 0]}]}]
      obstacles: [{centre: [6, 0], radius: 1}]
variants:
  straight: {}
"""


@pytest.mark.slow
def test_the_command_writes_a_table_numbers_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = tmp_path / "small.yaml"
    plan.write_text(SMALL)
    out = tmp_path / "x.png"
    assert main(["experiment", str(plan), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "A small one" in printed
    found: dict[str, Any] = json.loads(out.with_suffix(".json").read_text())
    assert [cell["numbers"]["arrived"] for cell in found["cells"]] == [0.0]
    assert [cell["numbers"]["time"] for cell in found["cells"]] == [None]
    first = out.read_bytes()
    assert first[:4] == b"\x89PNG"
    assert main(["experiment", str(plan), "--out", str(out), "--force"]) == 0
    assert out.read_bytes() == first
    capsys.readouterr()
    assert main(["experiment", str(plan), "--out", str(out)]) == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("kind: seek, weight: 4, target: [12, 0]", "kind: wander, weight: 4", "seek among its behaviours"),
        ("measure: avoidance", "measure: beauty", "measure"),
        ("obstacles: [{centre: [6, 0], radius: 1}]", "obstacles: []", "must not be empty"),
        ("straight: {}", "straight: {furst: []}", "first"),
    ],
)
def test_an_invalid_plan_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_plan(SMALL.replace(old, new))


def test_a_group_without_a_maximum_speed_is_refused() -> None:
    limitless = SMALL.replace("max_speed: 2, ", "").replace("weight: 4,", "weight: 4, speed: 2,")
    with pytest.raises(ValueError, match=r"cases.ahead.scene.groups\[0\].max_speed = None: must be given, in m/s"):
        run(load_plan(limitless).experiment())
