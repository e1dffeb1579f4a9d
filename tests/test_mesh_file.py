"""Meshes of other programs as networks: formats, cells, places; and what is refused."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import Delaunay

from flockenv.cli.main import main
from flockenv.geometry.mesh_distance import distances_to_mesh
from flockenv.model.finite_elements import contents
from flockenv.physics.effects import Elastic, Membrane, Springs
from flockenv.scene.mesh_file import mesh_of, obstacle_of, read_mesh, scene_of
from flockenv.scene.mesh_repair import repair_surface
from flockenv.scene.yaml_io import load_scene

meshio = pytest.importorskip("meshio", reason="needs the extra `mesh`: pip install 'flockenv[mesh]'")
trimesh = pytest.importorskip("trimesh", reason="needs the extra `mesh`: pip install 'flockenv[mesh]'")

CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))[:, ::-1]  # bit k of a corner is coordinate k
SQUARES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]  # outwards
FIVE = [(0, 3, 5, 6), (1, 0, 3, 5), (2, 0, 3, 6), (4, 0, 5, 6), (7, 3, 5, 6)]
BOX = [side for a, b, c, d in SQUARES for side in ((a, b, c), (a, c, d))]
FORMATS = ["obj", "off", "ply", "stl", "vtk", "vtu", "msh"]

Cells = list[tuple[str, Any]]


@pytest.fixture(autouse=True)
def _in_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def write(points: Any, cells: Cells, name: str = "mesh.vtk") -> Path:
    mesh = meshio.Mesh(np.array(points, float), [(kind, np.array(rows, np.int32)) for kind, rows in cells])
    mesh.write(name, **({"file_format": "gmsh22"} if name.endswith("msh") else {}))
    return Path(name)


@pytest.mark.parametrize("ending", FORMATS)
def test_a_closed_surface_has_its_area_and_volume_in_every_format(ending: str) -> None:
    path = write(CORNERS, [("triangle", BOX)], f"mesh.{ending}")
    mesh = mesh_of(*read_mesh(path), closed=True)
    corners = mesh.points(3)[mesh.elements(3)]
    assert mesh.size == 8
    assert contents(mesh.points(3), mesh.elements(3)).sum() == pytest.approx(6)
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(1)  # outwards, as in the file


@pytest.mark.parametrize("ending", ["vtk", "vtu", "msh"])
def test_tetrahedra_come_before_their_faces_and_lines_unless_others_are_named(ending: str) -> None:
    cells: Cells = [("line", [(0, 1)]), ("triangle", BOX[:2]), ("tetra", FIVE), ("line", [(1, 3)])]
    path = write(np.concatenate([CORNERS, [(9, 9, 9)]]), cells, f"mesh.{ending}")
    solid, surface = mesh_of(*read_mesh(path)), mesh_of(*read_mesh(path, "triangles"))
    assert contents(solid.vertices, solid.tetrahedra).sum() == pytest.approx(1)
    assert solid.size == 8 and len(surface.triangles) == 2 and surface.size == 4  # other points are left out
    assert mesh_of(*read_mesh(path, "bars")).bars == ((0, 1), (1, 2))


def test_quadrilaterals_are_cut_along_the_shorter_diagonal() -> None:
    points, elements = read_mesh(write([(0, 0, 0), (3, 0, 0), (4, 1, 0), (1, 1, 0)], [("quad", [(0, 1, 2, 3)])]))
    assert elements.tolist() == [[1, 2, 3], [1, 3, 0]]
    np.testing.assert_allclose(contents(points, elements), 1.5)


def test_points_are_scaled_then_rotated_about_x_y_z_then_moved() -> None:
    points, elements = read_mesh(write(CORNERS, [("tetra", FIVE)]))
    placed = mesh_of(points, elements, scale=2, rotate=(90, 0, 90), move=(10, 0, 0.5)).points(3)
    x, y, z = 2 * points.T
    np.testing.assert_array_equal(placed, np.stack([10 + z, x, y + 0.5], axis=1))
    sixth = mesh_of(points, elements, rotate=(0, 30, 0)).points(3)
    np.testing.assert_allclose(sixth[:, 0], points[:, 0] * np.sqrt(3) / 2 + points[:, 2] / 2, atol=1e-15)


def test_a_flat_mesh_is_one_in_two_dimensions() -> None:
    grid = np.array([(x, y, 5.0) for x in range(4) for y in range(3)])
    mesh = mesh_of(grid, Delaunay(grid[:, :2]).simplices, dimension=2)
    assert mesh.dimension == 2 and contents(mesh.points(2), mesh.elements(2)).sum() == pytest.approx(6)
    assert any(isinstance(effect, Elastic) for effect in scene_of(mesh).effects)


def test_points_are_merged_within_a_distance_and_elements_that_vanish_are_left_out() -> None:
    apart = np.array(BOX).ravel()  # every triangle has corners of its own
    points = CORNERS[apart] + 1e-5 * np.random.default_rng(0).uniform(-1, 1, (36, 3))
    elements = np.concatenate([np.arange(36).reshape(-1, 3), [(0, 3, 1)]])  # 0 and 3 are the same corner
    mesh = mesh_of(points, elements, merge=1e-4, closed=True)
    assert mesh.size == 8 and len(mesh.triangles) == 12
    first = np.sort(np.unique(apart, return_index=True)[1])
    np.testing.assert_array_equal(mesh.vertices, points[first])


def test_a_point_whose_only_element_vanishes_is_left_out() -> None:
    points = np.array([(9, 9, 9), (0, 0, 0), (1, 0, 0), (0, 1, 0), (1e-9, 0, 0)])
    mesh = mesh_of(points, np.array([(0, 1, 4), (1, 2, 3)]), merge=1e-6)
    assert mesh.vertices == ((0, 0, 0), (1, 0, 0), (0, 1, 0)) and mesh.triangles == ((0, 1, 2),)


@pytest.mark.parametrize(
    ("cells", "force"), [([("tetra", FIVE)], Elastic), ([("triangle", BOX)], Membrane), ([("line", [(0, 1)])], Springs)]
)
def test_the_command_prints_a_scene_that_reads_back(
    cells: Cells, force: type, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(CORNERS, cells)
    assert main(["import-mesh", str(path), "--scale", "0.1", "--move", "0", "1", "0"]) == 0
    scene = load_scene(capsys.readouterr().out)
    assert scene == scene_of(mesh_of(*read_mesh(path), scale=0.1, move=(0, 1, 0)))
    assert any(isinstance(effect, force) for effect in scene.effects)


TENT = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)]  # three triangles may meet in the edge 0 1


@pytest.mark.parametrize(
    ("points", "cells", "options", "message"),
    [
        (CORNERS, [("triangle", BOX[1:])], ["--closed"], "the surface has a hole: the edge of (0, 0, 0) and (1, 1, 0)"),
        (CORNERS, [("triangle", [(0, 2, 1), (1, 3, 2)])], [], "0 and 1 face opposite directions"),
        (TENT, [("triangle", [(0, 1, 2), (1, 0, 3), (0, 1, 4)])], [], "(0, 0, 0) and (1, 0, 0) belongs to three"),
        (CORNERS, [("triangle", [(0, 1, 1)])], [], "the same particle twice"),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [("triangle", [(0, 1, 2)])], [], "[0] = (0, 1, 2): it has no extent"),
        (CORNERS, [("triangle", [(0, 1, 3), (3, 1, 0)])], [], "triangles[1] = (2, 1, 0): the same as triangles[0]"),
        ([*CORNERS, (0, 0, 0)], [("triangle", [(0, 1, 3), (8, 3, 2)])], [], "0 and 4 are in one place, (0, 0, 0) m"),
        (
            [(0, 0, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 1), (0, -1, 1)], [("triangle", [(0, 1, 2), (0, 3, 4)])], [],
            "parts of the mesh touch in vertex 0, (0, 0, 0), without a common edge",
        ),
        (
            [(0, 0, 0), (4, 0, 0), (0, 4, 0), (1, 1, -1), (1, 2, 1), (2, 1, 1)], [("triangle", [(0, 1, 2), (3, 4, 5)])],
            [], "the edge between particles 3 and 4 passes through the face of 0, 1 and 2",
        ),
        (
            [*CORNERS[[0, 1, 2, 4]], (0.2, 0.2, 2)], [("tetra", [(0, 1, 2, 3), (0, 1, 2, 4)])], [],
            "tetrahedra 0 and 1 overlap: both are on the same side of their common face",
        ),
        (
            [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 2, 0)], [("triangle", [(0, 1, 2), (0, 1, 3)])], ["--dimension", "2"],
            "triangles 0 and 1 overlap: both are on the same side of their common edge, of (0, 0) and (1, 0)",
        ),
        (CORNERS, [("tetra", FIVE)], ["--dimension", "2"], "the mesh is not flat, but 1 m thick along z"),
        (CORNERS, [("tetra", FIVE)], ["--merge", "2"], "merge = 2: corners of every element become one"),
        (CORNERS, [("tetra", FIVE)], ["--merge", "inf"], "merge = inf: must be finite"),
        (CORNERS, [("tetra", FIVE)], ["--move", "0", "inf", "0"], "move = (0.0, inf, 0.0): must be finite"),
        (CORNERS, [("tetra", FIVE)], ["--closed"], "closed: only a surface of triangles in 3-D"),
        (CORNERS, [("tetra", FIVE)], ["--elements", "bars"], "the file has no bars; its cells: 5 tetra"),
        (CORNERS, [("vertex", [[0]])], [], "no bars, triangles or tetrahedra; its cells: 1 vertex"),
        (CORNERS, [("hexahedron", [range(8)]), ("tetra", FIVE)], [], "cells of kind hexahedron: allowed: tetra; its"),
        (CORNERS[:6], [("triangle6", [range(6)])], [], "cells of kind triangle6: allowed: triangle and quad"),
        ([(0, 0, 0), (1, 0, 0), (0, np.nan, 0)], [("triangle", [(0, 1, 2)])], [], "vertex 2 = (0.0, nan, 0.0): must"),
        (CORNERS, [("triangle", [(0, 1, 8)])], [], "triangle 0 has a vertex 8; there are 8, from 0 on"),
    ],
)  # fmt: skip
def test_a_bad_mesh_is_refused_in_one_line(
    points: Any, cells: Cells, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(points, cells)
    assert main(["import-mesh", str(path), *options]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("flockenv: mesh.vtk: ") and printed.err.count("\n") == 1 and printed.out == ""
    assert message in printed.err


def test_a_file_that_is_no_mesh_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for name, content in (
        ("text.vtk", b"text"),
        ("a.msh", b"\0"),
        ("e.obj", b"f 1 x 3"),
        ("r.obj", b""),
        ("m.objj", b""),
    ):
        Path(name).write_bytes(content)
    for name, message in (
        ("none.obj", "cannot be read: No such file"),
        ("m.objj", "unknown format, did you mean `.obj`? known are .obj, .ply"),
        ("text.vtk", "not a mesh that meshio reads: Illegal VTK header"),
        ("a.msh", "not a mesh that meshio reads"),
        ("e.obj", "not a mesh that meshio reads: invalid literal for int"),
        ("r.obj", "the file has no bars, triangles or tetrahedra; its cells: none"),
    ):
        assert main(["import-mesh", name]) == 2
        printed = capsys.readouterr()
        assert f"{name}: {message}" in printed.err and printed.err.count("\n") == 1 and printed.out == ""


def test_a_mesh_that_a_scene_cannot_hold_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    points = np.random.default_rng(0).uniform(size=(20_000, 3))
    path = write(points, [("line", np.stack([np.arange(19_999), np.arange(1, 20_000)], axis=1))])
    assert main(["import-mesh", str(path)]) == 2
    printed = capsys.readouterr()
    line = "mesh.vtk: 20,000 vertices and 19,999 elements are too many for a scene file of 1,000,000 bytes: simplify it"
    assert line in printed.err and printed.err.count("\n") == 1 and printed.out == ""


# --- repair ---------------------------------------------------------------------------------------------------------

SOUP = CORNERS[np.array(BOX)].reshape(-1, 3)
"""The corners of each triangle of the cube, each its own point, as in an STL file."""
EACH = np.arange(36).reshape(-1, 3)


@pytest.mark.parametrize(
    ("triangles", "report"),
    [
        (EACH, "28 points merged, 0 triangles left out, 0 turned, 0 added to fill holes; closed"),
        (EACH[:, ::-1], "28 points merged, 0 triangles left out, 12 turned, 0 added to fill holes; closed"),
        (np.concatenate([EACH[:4], EACH[4:6, ::-1], EACH[6:]]), "28 points .* 2 turned, 0 added to fill holes; closed"),
        (EACH[1:], "28 points merged, 0 triangles left out, 0 turned, 1 added to fill holes; closed"),
        (EACH[2:], "28 points merged, 0 triangles left out, 0 turned, 2 added to fill holes; closed"),
        (np.concatenate([EACH, EACH[3:5], [(0, 0, 7)]]), "28 points merged, 3 triangles left out, 0 turned, 0 added"),
    ],
    ids=["soup", "inside_out", "two_turned", "a_triangle_less", "a_square_less", "doubled"],
)
def test_a_repaired_cube_is_a_cube(triangles: Any, report: str) -> None:
    with pytest.raises(ValueError, match=r"in one place|hole|face|twice|no area"):
        obstacle_of(SOUP, triangles, spacing=0.1)
    mended = repair_surface(SOUP, triangles)
    assert re.match(report, mended.report), mended.report
    solid = obstacle_of(mended.points, mended.triangles, spacing=0.1)
    assert len(solid.vertices) == 8 and len(solid.triangles) == 12
    corners = mended.points[mended.triangles]
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(1)  # outwards
    inside = solid.gap(np.array([(0.5, 0.5, 0.5), (0.5, 0.5, 1.25)]))
    assert inside == pytest.approx([-0.5, 0.25], abs=0.01)


def test_what_cannot_be_repaired_is_refused() -> None:
    mended = repair_surface(SOUP, EACH[:6])
    assert mended.report.endswith("still open")
    with pytest.raises(ValueError, match="the surface has a hole"):
        obstacle_of(mended.points, mended.triangles, spacing=0.1)
    with pytest.raises(ValueError, match="no triangle has an area"):
        repair_surface(SOUP, np.array([(0, 0, 1)]))


def test_the_command_repairs_a_file_and_says_how(capsys: pytest.CaptureFixture[str]) -> None:
    write(CORNERS, [("triangle", BOX[1:])], "open.obj")
    assert main(["import-mesh", "open.obj", "--obstacle", "--spacing", "0.1"]) == 2
    assert "the surface has a hole" in capsys.readouterr().err
    assert main(["import-mesh", "open.obj", "--obstacle", "--spacing", "0.1", "--repair"]) == 0
    printed = capsys.readouterr()
    assert printed.err == (
        "import-mesh: 0 points merged, 0 triangles left out, 0 turned, 1 added to fill holes; closed\n"
    )
    assert len(load_scene(printed.out).obstacles[0].triangles) == 12  # type: ignore[attr-defined]
    assert main(["import-mesh", "open.obj", "--closed", "--repair"]) == 0
    capsys.readouterr()
    assert main(["import-mesh", "open.obj", "--repair"]) == 2
    assert "--repair: is of closed surfaces" in capsys.readouterr().err


def test_distances_to_a_mesh_are_those_of_trimesh() -> None:
    rock = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    rng = np.random.default_rng(1)
    points = rock.vertices * rng.uniform(0.7, 1.3, (len(rock.vertices), 1)) * (1.0, 0.6, 1.4)
    places = rng.uniform(-2, 2, (200, 3))
    corners = points[rock.faces]
    nearest = [trimesh.triangles.closest_point(corners, np.tile(at, (len(corners), 1))) for at in places]
    expected = [np.linalg.norm(each - at, axis=1).min() for each, at in zip(nearest, places, strict=True)]
    found = distances_to_mesh(points, np.array(rock.faces, np.int64), places)
    np.testing.assert_allclose(np.abs(found), expected, atol=1e-12)
