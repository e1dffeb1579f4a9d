"""Floor plans as obstacles, against shapely: areas, points inside and outside, distances; and what is refused."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from flockenv.cli.main import main
from flockenv.geometry.shapes import Polygon, Shape, Wall, distance_to_shapes
from flockenv.scene.floor_plan import read_plan, scene_of, shapes_of
from flockenv.scene.yaml_io import load_scene

HALL = "POLYGON ((0 0, 20 0, 20 8, 12 8, 12 12, 0 12, 0 0), (4 4, 6 4, 6 6, 4 6, 4 4), (14 2, 16 3, 15 5, 14 2))"
ROOMS = "MULTIPOLYGON (((0 0, 5 0, 5 5, 0 5, 0 0)), ((5 2, 6 2, 6 3, 5 3, 5 2)), ((6 0, 9 0, 9 5, 6 5, 6 0)))"
BLOCKS = "MULTIPOLYGON (((0 0, 5 0, 5 5, 0 5, 0 0), (1 1, 4 1, 4 4, 1 4, 1 1)), ((8 0, 9 0, 9 9, 8 9, 8 0)))"


@pytest.fixture(autouse=True)
def _in_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def polygon(shape: Shape) -> shapely.Polygon:
    assert isinstance(shape, Polygon)
    return shapely.Polygon(shape.vertices)


@pytest.mark.parametrize(("text", "solid"), [(HALL, False), (ROOMS, False), (HALL, True), (BLOCKS, True)])
def test_free_space_is_that_of_the_plan(text: str, solid: bool) -> None:
    plan = shapely.union_all(shapely.from_wkt(text))
    obstacles = shapes_of(shapely.from_wkt(text), solid)
    low_x, low_y, high_x, high_y = plan.bounds
    points = np.random.default_rng(0).uniform((low_x - 2, low_y - 2), (high_x + 2, high_y + 2), (3000, 2))
    gaps = distance_to_shapes(obstacles, points, np.zeros(2))
    free = shapely.contains_xy(plan, points) != solid
    np.testing.assert_array_equal(gaps > 0, free)
    expected = shapely.distance(plan.boundary, shapely.points(points[free]))
    np.testing.assert_allclose(gaps[free], expected, atol=1e-12)


def test_areas_are_those_of_shapely() -> None:
    hall = shapely.from_wkt(HALL)
    edge, *holes = shapes_of(hall)
    assert polygon(edge).area - sum(polygon(hole).area for hole in holes) == pytest.approx(hall.area, rel=1e-14)
    solids = [polygon(each) for each in shapes_of(shapely.from_wkt(BLOCKS), solid=True)]
    assert sum(each.area for each in solids) == pytest.approx(16 + 9, rel=1e-14)
    assert all(a.intersection(b).area == 0 for a, b in itertools.combinations(solids, 2))


def test_lines_are_walls_and_geojson_is_read_with_its_features() -> None:
    line = {"type": "LineString", "coordinates": [[0, 0, 1], [4000, 0, 1], [4000, 3000, 1]]}
    both = {"type": "MultiLineString", "coordinates": [[[0, 1000], [1000, 1000]], [[0, 2000], [1000, 2000]]]}
    features = [{"type": "Feature", "properties": {}, "geometry": each} for each in (line, both)]
    Path("plan.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    walls = shapes_of(read_plan(Path("plan.geojson"), scale=0.001), thickness=0.2)
    assert all(isinstance(wall, Wall) and wall.radius == 0.1 for wall in walls)
    assert [shapely.LineString(wall.vertices).wkt for wall in walls if isinstance(wall, Wall)] == [
        "LINESTRING (0 0, 4 0, 4 3)", "LINESTRING (0 1, 1 1)", "LINESTRING (0 2, 1 2)",
    ]  # fmt: skip


def test_the_command_prints_a_scene_that_reads_back(capsys: pytest.CaptureFixture[str]) -> None:
    Path("hall.wkt").write_text(HALL)
    assert main(["import-plan", "hall.wkt", "--agents", "7"]) == 0
    scene = load_scene(capsys.readouterr().out)
    assert scene == scene_of(shapes_of(shapely.from_wkt(HALL)), 7)
    assert scene.agents == 7


@pytest.mark.slow
def test_agents_begin_and_stay_in_the_hall() -> None:
    hall, scene = shapely.from_wkt(HALL), scene_of(shapes_of(shapely.from_wkt(HALL)), 30)
    state = scene.start(seed=0)
    for _ in range(5):
        assert shapely.contains_xy(hall.buffer(-0.2), state.pos[0]).all()
        state = scene.step(state, steps=100)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"type": "Foo"}', "neither GeoJSON nor WKT: ParseException: Unknown geometry type"),
        ('{"type": "Polygon"', "neither GeoJSON nor WKT: ParseException: Error parsing JSON"),
        ("POLYGON ((0 0", "neither GeoJSON nor WKT: ParseException: Expected word"),
        ("", "neither GeoJSON nor WKT"),
        ("GEOMETRYCOLLECTION EMPTY", "the plan is empty: it has neither lines nor areas"),
        ("POINT (1 2)", "Point: is neither a line nor an area; leave it out"),
        ("POLYGON ((0 0, 2 2, 2 0, 0 2, 0 0))", "Polygon: Self-intersection[1 1]"),
        ("POLYGON ((0 0, 1 nan, 1 1, 0 0))", "Polygon: Invalid Coordinate"),
        ("LINESTRING (0 0, 1e400 0)", "LineString: Invalid Coordinate"),
        (BLOCKS, "2 areas are apart"),
        (shapely.Point(0, 0).buffer(3, quad_segs=300).wkt, "has 1,200 vertices; at most 1,024 allowed: simplify it"),
        ("\xe9", "neither GeoJSON nor WKT"),
    ],
)
def test_a_plan_that_cannot_be_used_is_refused_in_one_line(
    text: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("plan.wkt").write_text(text, encoding="utf-8")
    assert main(["import-plan", "plan.wkt"]) == 2
    printed = capsys.readouterr()
    assert "plan.wkt: " in printed.err and message in printed.err and printed.err.count("\n") == 1
    assert printed.out == ""


def test_a_file_that_cannot_be_read_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    Path("bytes.wkt").write_bytes(b"\xff\xfe\x00")
    for name, message in (("none.wkt", "cannot be read: No such file"), ("bytes.wkt", "not UTF-8 text")):
        assert main(["import-plan", name]) == 2
        line = capsys.readouterr().err
        assert f"{name}: {message}" in line and line.count("\n") == 1
