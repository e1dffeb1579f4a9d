"""Crowds: cases of RiMEA and NIST that pass, verdicts, the page, and the scenes in configs/."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flockenv.cli.main import main
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.studies.validation import (
    CASES,
    VALIDATED,
    Case,
    Finding,
    Results,
    Value,
    run,
    select_cases,
    select_presets,
)
from flockenv.studies.validation.alone import corridor, crossing_time
from flockenv.studies.validation.corridors import DENSITIES, EACH_WAY
from flockenv.studies.validation.doors import DATA, _excess_over
from flockenv.studies.validation.page import page
from flockenv.studies.validation.plots import write_pictures
from flockenv.studies.validation.quiet import ignore_contact_warnings
from flockenv.studies.validation.rooms import bottleneck, corner, room
from flockenv.studies.validation.scenes import SCENES
from flockenv.studies.validation.walk import Walk, run_walk

ROOT = Path(__file__).parent.parent
NERVOUS = "helbing_farkas_vicsek_2000"
CONFIGS = sorted(p for p in (ROOT / "configs" / "scenes").glob("crowd_*.yaml"))
slow = pytest.mark.slow


def found(name: str, preset: str = NERVOUS) -> Finding:
    return run(select_cases(CASES, (name,)), (preset,)).findings[0]


# --- motion -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("rimea 1", marks=slow), "nist 2.1", "juelich 2", "rimea 7"])
def test_single_pedestrian_passes_the_guidelines(name: str) -> None:
    finding = found(name)
    assert finding.verdict == "pass", finding.note


def test_crossing_time_at_a_desired_speed_below_that_of_rimea_1() -> None:
    with ignore_contact_warnings():
        run_ = run_walk(corridor(NERVOUS, 1.1, length=40), 60)
    assert crossing_time(run_.time, run_.pos[:, 0, 0, 0], 40.0) == pytest.approx(40 / 1.1 + 0.5, abs=0.02)


@pytest.mark.slow
def test_twenty_people_turn_a_corner_and_do_not_cross_walls() -> None:
    finding = found("rimea 6")
    assert finding.verdict == "pass", finding.note
    assert finding.note == "0 times through a wall"


@slow
@pytest.mark.parametrize("name", ["lanes", "nist 5.1"])
def test_cases_that_the_preset_of_2000_passes(name: str) -> None:
    finding = found(name)
    assert finding.verdict == "pass", finding.note


@slow
@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_crowds_in_configs_move(path: Path) -> None:
    with ignore_contact_warnings():
        scene = load_scene(path)
        start = scene.start(0)
        end = scene.run(start, round(2.0 / scene.dt))
    here = start.alive[0] & end.alive[0]
    moved = np.linalg.norm(end.pos[0] - start.pos[0], axis=1)[here]
    assert np.isfinite(end.pos).all()
    assert np.median(moved) > 0.3


DENSE = sorted(p for p in (ROOT / "configs" / "crowds").glob("rimea_*") if p.stem.split("_")[1] in ("4", "16"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.stem, marks=() if path == DENSE[0] else slow) for path in DENSE]
)
def test_dense_crowds_start_without_deep_overlap_and_stay_in_the_corridor(path: Path) -> None:
    """With uniformly random positions, overlaps of up to 0.65 m caused speeds of 3,000 m/s, or divergence."""
    with ignore_contact_warnings():
        scene = load_scene(path)
    here, radius = scene.start(0).alive[0], scene.body.radius
    limit = 2 / scene.dt * 80 / (2 * 2.4e5)  # m of overlap d; friction of two bodies, kappa d 2 / m, is unstable beyond
    for seed in range(10):
        with ignore_contact_warnings():
            state = scene.start(seed)
            apart = state.pos[0][:, None] - state.pos[0]
            apart -= scene.space.extent(2) * np.round(apart / scene.space.extent(2))
            gap = np.linalg.norm(apart, axis=2) - radius[:, None] - radius + 9 * np.eye(len(radius))
            assert gap[np.ix_(here, here)].min() > -min(limit, 0.16)
            state = scene.run(state, round(0.8 / scene.dt))
        assert np.linalg.norm(state.vel[0, here], axis=1).max() < 5
        assert np.abs(state.pos[0, here, 1] - 16).max() < (2 if "rimea_4" in path.stem else 0.4)


# --- configs agree with the cases -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "built"),
    [
        ("crowd_bottleneck", lambda: bottleneck(NERVOUS, 1.0)),
        ("crowd_corner", lambda: corner(NERVOUS, 20, 2.0, 10.0, 8.0)),
        ("crowd_room", lambda: room(NERVOUS, 200, (15.0, 15.0), 1.0, 1.5)),
    ],
)
def test_scenes_in_configs_equal_those_of_the_cases(name: str, built: Any) -> None:
    with ignore_contact_warnings():
        loaded, expected = load_scene(ROOT / "configs" / "scenes" / f"{name}.yaml"), built()
    assert _walls(loaded) == _walls(expected)
    assert loaded.groups[0].size == expected.groups[0].size
    assert [e for e in loaded.effects if e.kind != "way"] == [e for e in expected.effects if e.kind != "way"]
    assert loaded.effects[0] == expected.effects[0]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_scene_files_equal_the_scenes_of_the_cases(case: Case) -> None:
    """To update the files: flockenv validate --preset helbing_2000 --scenes configs/crowds --force."""
    for variant, built in SCENES[case.name].items():
        file = ROOT / "configs" / "crowds" / f"{'_'.join([*case.name.split(), *variant.split()])}.yaml"
        with ignore_contact_warnings():
            assert load_scene(file) == built(NERVOUS)


def test_there_is_one_scene_file_per_variant() -> None:
    assert len(list((ROOT / "configs" / "crowds").iterdir())) == sum(len(SCENES[case.name]) for case in CASES)


def test_scenes_are_written_with_the_preset_by_name_and_never_overwrite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["validate", "juelich", "--preset", "moussaid_2009", "--scenes", "mine"]) == 0
    assert "mine contains 3 scenes" in capsys.readouterr().out
    text = Path("mine/juelich_2_turned.yaml").read_text()
    assert "- {preset: moussaid_2009}" in text and "sidestep" not in text
    Path("mine/juelich_6.yaml").write_text("precious")
    Path("mine/juelich_2_turned.yaml").unlink()
    assert main(["validate", "juelich", "--preset", "moussaid_2009", "--scenes", "mine"]) == 2
    assert "juelich_2_straight.yaml exists already" in capsys.readouterr().err
    assert not Path("mine/juelich_2_turned.yaml").exists() and Path("mine/juelich_6.yaml").read_text() == "precious"
    both = ["--preset", "moussaid_2009", "--preset", "helbing_1995"]
    assert main(["validate", "rimea 6", *both, "--scenes", "several"]) == 0
    assert sorted(path.parent.name for path in Path("several").rglob("*.yaml")) == [
        "helbing_molnar_1995", "moussaid_2009",
    ]  # fmt: skip


@pytest.mark.parametrize("case", [c for c in CASES if not c.only], ids=lambda case: case.name)
@pytest.mark.parametrize(
    "preset", [VALIDATED[0], *(pytest.param(name, marks=pytest.mark.slow) for name in VALIDATED[1:])]
)
def test_every_case_can_be_built_with_every_preset(preset: str, case: Case) -> None:
    with ignore_contact_warnings():
        for built in SCENES[case.name].values():
            assert sum(built(preset).living) > 0


def _walls(scene: Scene) -> set[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Return every straight side as a sorted pair of its ends."""
    sides = [(a, b) for shape in scene.shapes for a, b in zip(shape.vertices, shape.vertices[1:], strict=False)]  # type: ignore[attr-defined]
    return {tuple(sorted((tuple(map(float, a)), tuple(map(float, b))))) for a, b in sides}  # type: ignore[misc]


# --- verdicts, names, the page ----------------------------------------------------------------------------------------


def test_unknown_names_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert [case.name for case in select_cases(CASES, ("juelich",))] == ["juelich 2", "juelich 6"]
    assert select_presets(["helbing_2000"]) == (NERVOUS,)
    assert select_presets([]) == VALIDATED
    assert main(["validate", "rimea 21"]) == 2
    assert "case 'rimea 21': unknown" in capsys.readouterr().err
    assert main(["validate", "rimea 1", "--preset", "helbing_2001"]) == 2
    assert "--preset = 'helbing_2001': unknown, did you mean" in capsys.readouterr().err


@pytest.mark.slow
def test_validate_writes_a_page_and_continues_with_earlier_findings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[str] = []

    def trial(name: str) -> Value:
        calls.append(name)
        return Value(0.5, False, "half of it")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flockenv.studies.validation.CASES", (Case("lanes", "made up", "> 1", trial),))
    for _ in range(2):
        assert main(["validate", "--preset", "helbing_2000", "--out", "crowds.md"]) == 0
    assert calls == [NERVOUS]
    assert "0.5 FAILS" in capsys.readouterr().out
    assert "half of it" in Path("crowds.md").read_text()
    assert main(["validate", "--preset", "moussaid_2009", "--json"]) == 0
    assert Results.model_validate_json(capsys.readouterr().out).findings[0].verdict == "fails"
    others = Results.model_validate_json(Path("crowds.json").read_text()).model_copy(update={"sources": "others"})
    Path("crowds.json").write_text(others.model_dump_json())
    assert main(["validate", "--preset", "helbing_2000", "--out", "crowds.md"]) == 2
    assert "crowds.json contains findings (1) of another version of the code; --force" in capsys.readouterr().err
    assert Results.model_validate_json(Path("crowds.json").read_text()) == others
    Path("mine.json").write_text("{}")
    assert main(["validate", "--out", "mine.json"]) == 2
    assert "contains no findings of crowds" in capsys.readouterr().err


def test_crossing_and_leaving_times() -> None:
    time = np.array([0.0, 1.0, 2.0])
    assert crossing_time(time, np.array([0.0, 1.0, 3.0]), 2.0) == 1.5
    assert math.isnan(crossing_time(time, np.array([0.0, 1.0, 3.0]), 4.0))
    alive = np.array([[[True, True, False]], [[True, True, False]], [[False, True, False]]])
    none = np.zeros((3, 1, 3, 2))
    gone = Walk(time, none, none, alive, np.zeros(3), None).leaving_times()  # type: ignore[arg-type]
    np.testing.assert_array_equal(gone, [2.0, np.nan, np.nan])


def test_deviation_of_a_flow_is_its_relative_distance_to_the_band() -> None:
    assert _excess_over(1.8, DATA[1.0]) == 0
    assert _excess_over(0.9 * 1.71, DATA[1.0]) == pytest.approx(-0.1)
    assert _excess_over(1.2 * 2.02, DATA[1.0]) == pytest.approx(0.2)


def artificial() -> Results:
    cloud = {"density": (0.5, 1.0), "speed": (1.2, None), "densities": DENSITIES, "speeds": (1.0,) * len(DENSITIES)}
    spots = tuple(float(k % 32) for k in range(5 * 2 * EACH_WAY))
    series: dict[str, Any] = {
        "rimea 4": cloud, "rimea 12": {"width": (0.8, 1.0, 1.2), "flow": (1.4, 1.8, 2.2)},
        "lanes": {"x": spots, "y": spots},
        "faster is slower": {"speed": (1.0, 2.0), "time": (90.0, 120.0), "low": (80.0, 100.0), "high": (95.0, 130.0)},
    }  # fmt: skip
    return Results(
        findings=tuple(
            Finding(case=name, title="t", under=NERVOUS, bound="b", value=1.0, verdict="pass", note="a | b", seconds=1,
                    series=numbers)
            for name, numbers in series.items()
        )
    )  # fmt: skip


def test_page_has_every_finding_and_picture(tmp_path: Path) -> None:
    results = artificial()
    drawn = write_pictures(tmp_path, results)
    assert [path.name for path in drawn] == [
        "fundamental_diagram.png", "bottleneck.png", "lanes.png", "faster_is_slower.png",
    ]  # fmt: skip
    for path in drawn:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("L"))
        assert min(pixels.shape) > 100
        assert (pixels < 128).mean() > 0.002  # axes, curves and texts
    text = page(results, "crowds", [path.stem for path in drawn])
    assert "| lanes | t | b | 1 ok |" in text
    assert "a \\| b" in text
    assert "![bottleneck](crowds/bottleneck.png)" in text


def test_page_in_docs_matches_its_data() -> None:
    """To update the page: flockenv validate --out docs/crowds.md."""
    results = Results.model_validate_json((ROOT / "docs" / "crowds.json").read_text())
    drawn = [
        name for name in ("fundamental_diagram", "bottleneck", "lanes", "faster_is_slower")
        if (ROOT / "docs" / "crowds" / f"{name}.png").exists()
    ]  # fmt: skip
    assert (ROOT / "docs" / "crowds.md").read_text() == page(results, "crowds", drawn)
    assert {case.name for case in CASES} >= set(results.cases)
