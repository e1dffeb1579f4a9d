"""`flockenv measure` on agents that no force acts on, so that their paths are known; and its error messages."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import flockenv.studies.measured_run
import flockenv.studies.trajectory
from flockenv.cli.main import main
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.studies.measured_run import UNITS, Scope, Survey, survey
from flockenv.studies.trajectory import Trajectory, record

STREAMS = """\
space: {kind: torus, size: [10, 4]}
groups:
  - {count: 40, radius: 0.1, max_speed: 1.2, spawn: {low: [0, 0], high: [10, 1.9], speed: [1.2, 1.2], heading: [1, 0]}}
  - {count: 40, radius: 0.1, max_speed: 1.2, spawn: {low: [0, 2.1], high: [10, 4], speed: [1.2, 1.2], heading: [-1, 0]}}
dt: 0.05
"""
"""Two streams in opposite directions."""

ROOM = """\
groups: [{count: 30, radius: 0, spawn: {low: [0, 0], high: [4, 4], speed: [1, 1], heading: [1, 0]}}]
dt: 0.05
"""
"""Thirty agents that move to the right, in a plane."""

INTERRUPTED = "flockenv: interrupted; {}, Ctrl-C again ends it\nflockenv: interrupted; results until then are shown\n"

LINE = ["--line", "5,0,5,4"]


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "streams.yaml").write_text(STREAMS)
    (tmp_path / "room.yaml").write_text(ROOM)


def numbers(path: str = "x.json") -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Path(path).read_text())
    return found


def values(found: dict[str, Any]) -> dict[str, float]:
    return {name: math.nan if x["mean"] is None else x["mean"] for name, x in found["measures"].items()}


def test_all_measures_of_two_streams_are_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    """24 m in 20 s on a torus of 10 m: every agent crosses the line two or three times, 2.4 times in the mean."""
    assert (
        main(["measure", "streams.yaml", "--time", "20", "--every", "0.4", "--json", "x.json", "--out", "p", *LINE])
        == 0
    )
    shown = capsys.readouterr().out
    assert "positions every 0.4 s, seed 0" in shown
    assert "Phi, 1 = no row holds agents" in shown
    scene = load_scene(Path("streams.yaml"))
    x = scene.start(0).pos[0, :, 0]
    turns = np.where(
        np.arange(80) < 40,
        np.floor((x + 19) / 10) - np.floor((x - 5) / 10),
        np.ceil((x - 5) / 10) - np.ceil((x - 29) / 10),
    )
    found = values(numbers())
    assert found["forward"] == turns[:40].sum()
    assert found["backward"] == turns[40:].sum()
    assert found["specific flow"] == pytest.approx((turns[:40].sum() - turns[40:].sum()) / 20 / 4)
    assert found["both ways"] == pytest.approx(turns.sum() / 20 / 4)
    assert found["lanes"] == found["band index"] == 1
    assert found["lanes p"] < 0.05
    assert found["density"] == pytest.approx(2)
    assert found["density counted"] == pytest.approx(2)
    assert found["density times speed"] == pytest.approx(2.4)
    assert (found["walking speed"], found["speed"]) == pytest.approx((1.2, 1.2))
    assert found["off Weidmann"] == pytest.approx(1.2 - 0.606, abs=1e-3)
    assert (found["oscillation"], found["oscillating"], found["polarisation"]) == pytest.approx((0, 0, 0), abs=1e-9)
    assert "all out" not in found  # on a torus they come back
    assert set(found) <= set(UNITS)
    assert sorted(path.name for path in Path("p").iterdir()) == [
        "flow_density.png", "gaps.png", "lanes.png", "space_time.png",
    ]  # fmt: skip
    for path in Path("p").iterdir():
        with Image.open(path) as picture:
            assert picture.width > 300
            assert np.asarray(picture.convert("L")).std() > 5


def test_a_room_is_empty_when_the_last_agent_has_crossed_the_line() -> None:
    """The line is at x = 6, drawn upward; all agents move at 1 m/s."""
    assert main(["measure", "room.yaml", "--time", "8", "--json", "x.json", "--line", "6,-1,6,5"]) == 0
    found = numbers()
    value = values(found)
    distance = np.sort(6 - load_scene(Path("room.yaml")).start(0).pos[0, :, 0])
    assert value["out"] == 30
    assert value["all out"] == pytest.approx(distance[-1])
    assert value["95 % out"] == pytest.approx(distance[28])
    assert value["passing"] == pytest.approx(29 / (distance[-1] - distance[0]))
    assert sorted(found["samples"]["gaps_s"]) == pytest.approx(np.sort(np.diff(distance)), abs=1e-9)
    assert "density" not in value  # not for a plane without an --area
    assert "lanes" not in value  # all walk in the same direction
    assert "overlap" not in value  # these agents are points
    assert main(["measure", "room.yaml", "--time", "3", "--json", "x.json", "--force", "--line", "6,-1,6,5"]) == 0
    assert numbers()["measures"]["all out"]["mean"] is None  # not yet
    # with --walkable, Voronoi cells end at its edge: at the start 30 agents share 4 m x 4 m
    assert main([
        "measure", "room.yaml", "--time", "0.05", "--json", "x.json", "--force", "--walkable", "0,0,4,4", "--area",
        "0,0,4,4",
    ]) == 0  # fmt: skip
    assert values(numbers())["density"] == pytest.approx(30 / 16, rel=0.1)


def test_skip_leaves_out_the_crossings_of_the_first_seconds() -> None:
    assert main(["measure", "room.yaml", "--time", "8", "--skip", "4", "--json", "x.json", "--line", "6,-1,6,5"]) == 0
    distance = 6 - load_scene(Path("room.yaml")).start(0).pos[0, :, 0]
    assert values(numbers())["forward"] == (distance >= 4).sum()
    assert values(numbers())["flow"] == pytest.approx((distance >= 4).sum() / 4)
    assert values(numbers())["out"] == 30


@pytest.mark.slow
def test_several_seeds_give_intervals_and_a_comparison_with_chance(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["measure", "streams.yaml", "--time", "1", "--seeds", "5", "--seed", "3", "--json", "x.json"]) == 0
    shown = capsys.readouterr().out
    assert "seeds 3 to 7: means and 95 % intervals" in shown
    assert "Above chance?" in shown
    found = numbers()
    assert found["seeds"] == [3, 4, 5, 6, 7]
    assert found["above_chance"]["lanes"]["holds"] is True
    near = [row["nearest neighbour"] for row in found["by_seed"]]
    assert len(set(near)) == 5
    mean = found["measures"]["nearest neighbour"]
    assert mean["mean"] == pytest.approx(np.mean(near))
    assert mean["low"] < mean["mean"] < mean["high"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_pictures() -> None:
    for name in ("a", "b"):
        assert main(["measure", "streams.yaml", "--time", "1", "--out", name, *LINE]) == 0
    for path in Path("a").iterdir():
        assert path.read_bytes() == (Path("b") / path.name).read_bytes()


def test_after_an_interrupt_the_results_until_then_are_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(run: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(flockenv.studies.measured_run, "_lanes", interrupted)
    command = ["measure", "streams.yaml", "--time", "2", "--seeds", "3", "--json", "x.json", "--out", "p", *LINE]
    assert main(command) == 130
    captured = capsys.readouterr()
    assert captured.err == INTERRUPTED.format("showing what was measured")
    assert "density times speed" in captured.out
    assert "nearest neighbour" not in captured.out
    found = numbers()
    assert (found["stopped"], found["seeds"]) == ("interrupted", [0])
    assert (Path("p") / "lanes.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("seeds", ["1", "3"])
def test_an_interrupted_simulation_is_announced_before_it_is_measured(
    seeds: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Measuring takes up to 20 s, in which the user must know that Ctrl-C was noticed."""
    told = []

    def late(scene: Scene, seed: int, steps: int, every: int, progress: Callable[[int], None]) -> Trajectory:
        def show(done: int) -> None:
            if seed == int(seeds) - 1 and done >= 20:
                raise KeyboardInterrupt

        return record(scene, seed, steps, every, show)

    def measured(*given: Any) -> Survey:
        told.append(capsys.readouterr().err)
        return survey(*given)

    monkeypatch.setattr(flockenv.studies.trajectory, "PATIENCE", 80)  # a step of 80 agents
    monkeypatch.setattr(flockenv.studies.trajectory, "record", late)
    monkeypatch.setattr(flockenv.studies.measured_run, "survey", measured)
    assert main(["measure", "streams.yaml", "--time", "2", "--seeds", seeds]) == 130
    told.append(capsys.readouterr().err)
    assert told[:-2] == [""] * (int(seeds) - 1)
    assert told[-2] + told[-1] == INTERRUPTED.format("measuring the first 1 s")
    assert told[-1].startswith("flockenv: interrupted; results")


def test_an_interrupt_before_the_first_picture_leaves_no_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("flockenv.studies.measures.plots.write_flow_density", interrupted)
    assert main(["measure", "streams.yaml", "--time", "1", "--out", "a/p", *LINE]) == 130
    assert not Path("a").exists()


@pytest.mark.slow
def test_a_run_that_diverges_is_measured_until_then(capsys: pytest.CaptureFixture[str]) -> None:
    """Such a strong drag reverses and enlarges every velocity until it is no longer finite."""
    free = STREAMS.replace("max_speed: 1.2, ", "")
    Path("bad.yaml").write_text(free.replace("dt:", "effects: [{kind: quadratic_drag, rate: 1.0e+60}]\ndt:"))
    assert main(["measure", "bad.yaml", "--time", "2"]) == 1
    captured = capsys.readouterr()
    assert "results until then are shown" in captured.err
    assert "agents " in captured.out


@pytest.mark.slow
def test_a_scene_in_three_dimensions_has_order_but_no_density() -> None:
    Path("space.yaml").write_text(
        "dimension: 3\nspace: {kind: torus, size: [9, 9, 9]}\n"
        "groups: [{count: 9, spawn: {speed: [1, 1], heading: [0, 0, 1]}}]\n"
    )
    assert main(["measure", "space.yaml", "--time", "1", "--json", "x.json"]) == 0
    assert values(numbers())["polarisation"] == pytest.approx(1)
    assert "density" not in values(numbers())


def test_particles_of_a_network_are_no_flock_and_their_overlaps_are_not_counted() -> None:
    """A net whose particles overlap, at rest, beside two agents that move to the right and do not touch."""
    net = "{radius: 0.3, network: {kind: cloth, cells: [2, 2], sides: [0.4, 0.4], origin: [0, 0]}}"
    two = "{count: 2, radius: 0.3, spawn: {low: [5, 5], high: [9, 9], spacing: 2, speed: [1, 1], heading: [1, 0]}}"
    found = survey(record(load_scene(f"groups: [{net}, {two}]\ndt: 0.05\n"), 0, 2, 1), Scope()).values
    assert (found["polarisation"], found["overlapping"], found["collisions"]) == (1, 0, 0)
    alone = survey(record(load_scene(f"groups: [{net}]\ndt: 0.05\n"), 0, 2, 1), Scope()).values
    assert "polarisation" not in alone
    assert (alone["overlap"], alone["overlapping"], alone["collisions"]) == (0, 0, 0)
    assert alone["nearest neighbour"] == pytest.approx(0.2)


def test_the_area_of_an_obstacle_does_not_count_for_the_density() -> None:
    """A polygon fills half of the box, so the density in the rest is doubled."""
    Path("half.yaml").write_text(
        "space: {kind: box, size: [4, 4]}\ngroups: [{count: 8, radius: 0, spawn: {low: [0, 0], high: [1.9, 3.9]}}]\n"
        "obstacles: [{kind: polygon, vertices: [[2, 0], [4, 0], [4, 4], [2, 4]]}]\ndt: 0.05\n"
    )
    run = record(load_scene(Path("half.yaml")), 0, 2, 1)
    assert survey(run, Scope()).values["density"] == pytest.approx(1)  # 8 agents in 8 m^2 of walkable area
    left = np.array([(0, 0), (2, 0), (2, 4), (0, 4)], float)
    assert survey(run, Scope(area=left)).values["density"] == pytest.approx(1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("room.yaml --time 0", "--time = 0 s: must be a whole multiple of dt = 0.05 s, say 0.05 or 0.1"),
        ("room.yaml --time 1 --skip 1", "--skip = 1: must be >= 0 and less than --time = 1"),
        ("room.yaml --line 1,2,3", "--line = '1,2,3': must be X0,Y0,X1,Y1 in metres"),
        ("room.yaml --line 1,2,1,2", "--line = '1,2,1,2': must be the two ends of a line"),
        ("room.yaml --line 1,2,x,2", "--line = '1,2,x,2': must be X0,Y0,X1,Y1 in metres"),
        ("room.yaml --area 0,0,1,0,2,0", "--area = "),
        (
            "room.yaml --area 0,0,4,0,1,1,0,4",
            "--area = [[0.0, 0.0], [4.0, 0.0], [1.0, 1.0], [0.0, 4.0]]: must be convex",
        ),
        ("room.yaml --time 1e9 --every 0.05", "20,000,000,001 instants of 30 agents need about"),
        ("room.yaml --json x.yaml", "--json 'x.yaml': must end in .json"),
        ("room.yaml --out room.yaml", "--out 'room.yaml': "),
        ("room.yaml --out ../p", "--out '../p': must not go up with '..'"),
        ("room.yaml --seeds 0", "Invalid value for '--seeds'"),
        ("rom.yaml", "rom.yaml: no such file, did you mean `room.yaml`?"),
        ("cube.yaml --time 1 --line 0,0,1,0", "dimension = 3: lines and areas can only be given in 2-D"),
    ],
)
def test_an_invalid_argument_gives_one_line_and_writes_no_file(
    arguments: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("cube.yaml").write_text(
        "dimension: 3\ngroups: [{count: 1, spawn: {low: [0, 0, 0], high: [1, 1, 1]}}]\ndt: 0.05\n"
    )
    before = sorted(path.name for path in tmp_path.iterdir())
    assert main(["measure", *arguments.split(" ")]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"flockenv: {message}"), captured.err
    assert len(captured.err.splitlines()) == 1
    assert captured.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize("option", ["--line 0,0,1,0", "--area 0,0,1,1", "--walkable 0,0,1,1"])
def test_lines_and_areas_in_three_dimensions_are_refused_before_the_run(
    option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def started(*arguments: object) -> None:
        raise AssertionError("the scene is run")

    monkeypatch.setattr(flockenv.studies.trajectory, "record", started)
    Path("cube.yaml").write_text("dimension: 3\ngroups: [{count: 1, spawn: {low: [0, 0, 0], high: [1, 1, 1]}}]\n")
    assert main(["measure", "cube.yaml", "--time", "1", *option.split(" ")]) == 2
    assert capsys.readouterr().err == "flockenv: dimension = 3: lines and areas can only be given in 2-D\n"


def test_existing_files_are_not_overwritten_without_force() -> None:
    Path("p").mkdir()
    (Path("p") / "lanes.png").write_text("mine")
    assert main(["measure", "room.yaml", "--time", "1", "--out", "p"]) == 2
    assert (Path("p") / "lanes.png").read_text() == "mine"


def test_the_pictures_and_scenes_of_the_page_on_measures_exist() -> None:
    """Its pictures are small, and each scene in its commands can be loaded."""
    root = Path(__file__).resolve().parent.parent
    page = (root / "docs" / "measures.md").read_text()
    pictures = re.findall(r"!\[[^\]]*\]\((measures/\w+\.png)\)", page)
    assert len(pictures) == 5
    assert all(1000 < (root / "docs" / name).stat().st_size < 100_000 for name in pictures)
    scenes = re.findall(r"flockenv measure (\w+) ", page)
    assert len(scenes) == 2
    for scene in scenes:
        load_scene(scene)


def test_a_run_of_one_instant_has_density_and_lanes_but_no_flow() -> None:
    run = record(load_scene(Path("streams.yaml")), 0, 0, 1)
    found = survey(run, Scope(line=np.array([(5.0, 0.0), (5.0, 4.0)]))).values
    assert found["density"] == pytest.approx(2)
    assert found["lanes"] == 1
    assert "flow" not in found
    assert math.isnan(found["collisions"])


def test_pictures_of_a_run_without_living_agents_are_drawn() -> None:
    Path("empty.yaml").write_text(Path("streams.yaml").read_text().replace("{count:", "{alive: 0, count:"))
    assert main(["measure", "empty.yaml", "--time", "1", "--line", "5,0,5,4", "--out", "empty"]) == 0
