"""Obstacles given by triangles: exact distances on a grid, its error between grid points, scenes, and bad meshes."""

from __future__ import annotations

import itertools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours.avoid import AvoidObstacles
from flockenv.cli.main import main
from flockenv.geometry.mesh_distance import distances_to_mesh
from flockenv.geometry.shapes import Block, DistanceField, TriangleMesh
from flockenv.model.group import Group
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Collisions
from flockenv.physics.effects import Gravity
from flockenv.scene.mesh_file import obstacle_of, obstacle_scene_of
from flockenv.scene.scene import Scene
from flockenv.scene.yaml_io import dump_scene, load_scene
from tests.catalogue import Array

CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))[:, ::-1]  # bit k of a corner is coordinate k
SQUARES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]  # outwards
BOX = np.array([side for a, b, c, d in SQUARES for side in ((a, b, c), (a, c, d))])
INWARDS = BOX[:, ::-1]
TETRAHEDRON = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])


def mesh_of(points: Any, triangles: Any, **fields: Any) -> TriangleMesh:
    numbers = {"vertices": tuple(map(tuple, np.asarray(points, float).tolist()))}
    return TriangleMesh(**numbers, triangles=tuple(map(tuple, np.asarray(triangles).tolist())), **fields)


def box(size: float = 1.0, **fields: Any) -> TriangleMesh:
    """Return a cube around the origin."""
    return mesh_of((CORNERS - 0.5) * size, BOX, **{"spacing": 0.1, **fields})


def two(*parts: tuple[Any, Any]) -> tuple[Any, Any]:
    """Return the points and triangles of two meshes together."""
    (a, rows), (b, more) = parts
    return np.concatenate([a, b]), np.concatenate([rows, more + len(a)])


def ball(rounds: int, radius: float = 1.0) -> tuple[Any, Any]:
    """Return a ball: an octahedron whose triangles are divided in four, `rounds` times."""
    points = np.concatenate([np.eye(3), -np.eye(3)])
    rows = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)])
    for _ in range(rounds):
        edges = np.sort(np.concatenate([rows[:, [1, 2]], rows[:, [2, 0]], rows[:, [0, 1]]]), axis=1)
        edges, which = np.unique(edges, axis=0, return_inverse=True)
        a, b, c = (which.reshape(3, -1) + len(points)).astype(np.int64)
        points = np.concatenate([points, points[edges].mean(axis=1)])
        i, j, k = rows.T
        rows = np.concatenate([np.stack(each, axis=1) for each in ((i, c, b), (c, j, a), (b, a, k), (a, b, c))])
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True), rows


# --- distances ------------------------------------------------------------------------------------------------------


def box_distance(x: Array, half: float) -> Array:
    """Return the signed distance to a cube around the origin."""
    beyond = np.abs(x) - half
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0))


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_distances_to_a_cube_with_a_cavity_are_exact_at_every_scale(scale: float) -> None:
    """Also beside edges and corners, where the nearest triangles do not agree about the side."""
    points, rows = two((CORNERS - 0.5, BOX), ((CORNERS - 0.5) / 2, INWARDS))
    x = np.concatenate([np.random.default_rng(0).uniform(-1, 1, (4000, 3)), points, 1.01 * points, 0.99 * points])
    exact = np.maximum(box_distance(x, 0.5), -box_distance(x, 0.25))
    np.testing.assert_allclose(distances_to_mesh(points * scale, rows, x * scale), exact * scale, atol=1e-15 * scale)


def test_the_side_of_a_sharp_tetrahedron_is_that_of_its_planes() -> None:
    random = np.random.default_rng(1)
    for _ in range(30):
        points = random.normal(size=(4, 3)) * (1, 0.1, 0.02)
        rows = TETRAHEDRON if np.linalg.det(points[1:] - points[0]) > 0 else TETRAHEDRON[:, ::-1]
        a, b, c = points[rows].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        weights = random.dirichlet(np.ones(4), 300) * 1.6 - 0.15  # of the corners: around it, and inside
        x = weights @ points
        height = ((x[:, None] - a) * normal).sum(axis=2).max(axis=1)
        np.testing.assert_array_equal(distances_to_mesh(points, rows, x) < 0, height < 0)


def test_a_cube_of_triangles_agrees_with_a_block_within_the_declared_error() -> None:
    """Between grid points at most 0.87 spacings, and 0 where the surface is flat."""
    mesh, block = box(), Block(centre=(0, 0, 0), size=(1, 1, 1))
    x = np.random.default_rng(0).uniform(-0.7, 0.7, (20_000, 3))
    off = mesh.gap(x) - block.gap(x)
    assert off.min() > -1e-12 and 0.2 * mesh.spacing < off.max() < 0.87 * mesh.spacing
    flat = np.sort(np.abs(np.abs(x) - 0.5), axis=1)[:, 1] > 0.2  # near one face, or the middle of none
    flat &= (np.abs(x) > 0.45).any(axis=1) & (np.sort(np.abs(x), axis=1)[:, 1] < 0.3)
    assert flat.sum() > 500
    np.testing.assert_allclose(mesh.gap(x)[flat], block.gap(x)[flat], atol=1e-12)
    np.testing.assert_allclose(mesh.normal(x)[flat], block.normal(x)[flat], atol=1e-12)


def test_the_error_of_a_ball_is_of_second_order_in_the_spacing() -> None:
    way = np.random.default_rng(0).normal(size=(5000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    far = np.random.default_rng(1).uniform(0.75, 1.25, 5000)
    points, rows = ball(4)
    x, errors = way * far[:, None], []
    exact = distances_to_mesh(points, rows, x)
    np.testing.assert_allclose(exact, far - 1, atol=0.005)  # a polyhedron is not a ball
    for spacing in (0.3, 0.15):
        mesh = mesh_of(points, rows, spacing=spacing)
        errors.append(np.abs(mesh.gap(x) - exact).max())
    assert (mesh.normal(x) * way).sum(axis=1).min() > 0.999
    assert errors[1] < 0.1 * 0.15
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.3)


@pytest.mark.parametrize("hollow", [False, True])
def test_laws_read_a_mesh_as_a_distance_field_of_its_distances(hollow: bool) -> None:
    mesh = mesh_of(CORNERS * (1, 2, 0.5) + (3, 1, -2), BOX, spacing=0.15, hollow=hollow)
    field = DistanceField(
        low=tuple(mesh.grid_low.tolist()), spacing=0.15, values=tuple(mesh.distances.tolist()), hollow=hollow
    )
    random = np.random.default_rng(2)
    x, way = random.uniform(-1, 5, (500, 3)), random.normal(size=(500, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.gap(x), field.gap(x), atol=1e-12)
    found, expected = mesh.hit(x, way, 0.1), field.hit(x, way, 0.1)
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(expected))
    np.testing.assert_allclose(found[np.isfinite(found)], expected[np.isfinite(found)], atol=1e-9)
    if not hollow:
        assert (mesh.gap(x) >= np.linalg.norm(np.maximum(np.abs(x - mesh.bound.centre) - mesh.bound.half, 0), axis=1)
                - 1e-12)[mesh.gap(x) > 0].all()  # fmt: skip
        assert mesh.bound.radius < 1.3 * np.linalg.norm(np.array((1, 2, 0.5)) / 2)


def test_a_moved_mesh_has_the_same_distances() -> None:
    mesh = box()
    moved = mesh.moved_to((3.0, -2.0, 1.0))
    np.testing.assert_allclose(moved.distances, mesh.distances, atol=1e-15)
    np.testing.assert_allclose(moved.gap([[3.7, -2, 1]]), [0.2], atol=1e-12)


# --- scenes ---------------------------------------------------------------------------------------------------------


def scene_with(shape: TriangleMesh, start: Any, speed: Any, radius: float, **fields: Any) -> tuple[Scene, Any]:
    spawn = Spawn(low=(-1, -1, -1), high=(1, 1, 1))
    scene = Scene(dimension=3, groups=(Group(count=1, radius=radius, spawn=spawn),), obstacles=(shape,), **fields)
    return scene, scene.start(0).with_motion(np.array([[start]], float), np.array([[speed]], float))


@pytest.mark.slow  # a kernel of its own
def test_a_ball_bounces_off_a_sphere_of_triangles_as_off_a_sphere() -> None:
    """An elastic ball hits a sphere 30 degrees off its axis, so its path turns by 120 degrees."""
    mesh = mesh_of(*ball(4), spacing=0.05)
    offset, reach = np.sin(np.pi / 6) * 1.2, 1.2
    scene, state = scene_with(
        mesh, (-2, offset, 0), (1, 0, 0), 0.2, effects=(Gravity(acceleration=(0, 0, 0)),),
        constraints=(Collisions(restitution=1.0),), dt=0.01,
    )  # fmt: skip
    near = np.inf
    for _ in range(200):
        state = scene.step(state, out=state)
        near = min(near, float(np.linalg.norm(state.pos[0, 0])))
    assert near == pytest.approx(reach, abs=0.01)
    np.testing.assert_allclose(np.linalg.norm(state.vel[0, 0]), 1, atol=1e-9)
    np.testing.assert_allclose(state.vel[0, 0], (-np.cos(np.pi / 3), np.sin(np.pi / 3), 0), atol=0.02)


@pytest.mark.slow  # a kernel of its own
def test_an_agent_passes_a_mesh_in_its_path_without_touching_it() -> None:
    effects = (AvoidObstacles(weight=5.0, horizon=3.0),)
    scene, state = scene_with(box(spacing=0.05), (-4, 0.1, 0.2), (1, 0, 0), 0.2, effects=effects)
    near = np.inf
    for _ in range(400):
        state = scene.step(state, out=state)
        near = min(near, float(box_distance(state.pos[0], 0.5)[0]))
    assert 0.2 < near < 1
    assert state.pos[0, 0, 0] > 1


def test_a_scene_with_a_mesh_survives_yaml_and_pickle() -> None:
    scene, _ = scene_with(box(velocity=(0.1, 0, 0)), (3, 0, 0), (0, 0, 0), 0.2)
    assert load_scene(dump_scene(scene)) == scene
    assert pickle.loads(pickle.dumps(scene)) == scene
    with pytest.raises(ValueError, match=r"obstacles\[0\].margin = 0.1: is less than the largest radius"):
        scene_with(box(margin=0.1), (3, 0, 0), (0, 0, 0), 0.2)


# --- bad meshes -----------------------------------------------------------------------------------------------------

FLIPPED = np.concatenate([BOX[:1, ::-1], BOX[1:]])


@pytest.mark.parametrize(("points", "rows", "fields", "message"), [
    (CORNERS, BOX[1:], {}, "the surface has a hole: the edge of"),
    (CORNERS, FLIPPED, {}, "triangles 0 and 9 face opposite directions at the edge of"),
    (CORNERS, INWARDS, {}, r"the part of triangle 0, at \(1, 1, 0\), faces inwards: reverse its triangles"),
    (*two((CORNERS, BOX), (CORNERS * 0.5 + 0.2, BOX)), {}, "the part of triangle 12, .* lies inside another part"),
    (*two((CORNERS, BOX), (CORNERS + 3, INWARDS)), {}, "the part of triangle 12, .* faces inwards"),
    (*two((CORNERS, BOX), (CORNERS + 0.5, BOX)), {}, r"triangles: the edge of vertices \d+ and \d+ passes through \d+"),
    (CORNERS * (1, 1, 0), BOX, {}, r"triangles\[4\] = \(0, 1, 5\): has no area"),
    (CORNERS, np.concatenate([BOX, [(0, 1, 9)]]), {}, r"triangles\[12\]: there is no vertex 9, they are 0 to 7"),
    (CORNERS, np.concatenate([BOX, [(0, 1, 7)]]), {}, "belongs to three triangles or more"),
    (CORNERS, BOX[:0], {}, "triangles: "),
    (CORNERS * (1, 1, 0.01), BOX, {"spacing": 0.3, "margin": 0.8}, "spacing = 0.3: no grid point is inside the mesh"),
    (CORNERS, BOX, {"spacing": 1e-4}, "spacing = 0.0001: .* points; at most"),
    (CORNERS, BOX, {"spacing": 1e-150}, "points; at most"),
    (CORNERS[:, :2], BOX, {}, "vertices"),
])  # fmt: skip
def test_bad_meshes_raise_errors_of_one_line(points: Any, rows: Any, fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        mesh_of(points, rows, **{"spacing": 0.1, **fields})
    assert "\n" not in str(caught.value)


def test_vertices_without_a_triangle_do_not_enlarge_the_grid_or_the_bounds() -> None:
    plain, spare = box(), mesh_of([*(CORNERS - 0.5), (9.0, 0.0, 0.0)], BOX, spacing=0.1)
    assert spare.counts == plain.counts and spare.anchor == plain.anchor
    np.testing.assert_array_equal(spare.extremes, plain.extremes)
    np.testing.assert_array_equal(spare.distances, plain.distances)


# --- files ----------------------------------------------------------------------------------------------------------


def test_the_command_makes_a_scene_of_a_file_or_refuses_it_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    meshio = pytest.importorskip("meshio", reason="needs the extra `mesh`: pip install 'flockenv[mesh]'")
    monkeypatch.chdir(tmp_path)
    for name, rows in {"part.stl": BOX, "open.obj": BOX[1:]}.items():
        meshio.Mesh(CORNERS, [("triangle", rows)]).write(name)
    assert main(["import-mesh", "part.stl", "--obstacle", "--scale", "2", "--spacing", "0.1"]) == 0
    scene = load_scene(capsys.readouterr().out)
    mesh = scene.obstacles[0]
    assert isinstance(mesh, TriangleMesh) and mesh.spacing == 0.1 and len(mesh.triangles) == 12
    np.testing.assert_array_equal(np.ptp(mesh.vertices, axis=0), 2)
    assert (scene.start(0).pos[..., 1] > 2).all()
    for arguments, line in (
        (["open.obj", "--obstacle"], "open.obj: the surface has a hole: the edge of"),
        (["part.stl", "--spacing", "0.1"], "--spacing: is of the grid of an obstacle; add --obstacle"),
        (["part.stl", "--obstacle", "--dimension", "2"], "--obstacle: is a surface of triangles in 3-D"),
    ):
        assert main(["import-mesh", *arguments]) == 2
        printed = capsys.readouterr()
        assert line in printed.err and printed.err.count("\n") == 1 and printed.out == ""


@pytest.mark.parametrize("sides", [(0.05, 1.0, 0.05), (1.0, 0.05, 0.05), (0.05, 0.05, 1.0), (1.0, 1.0, 1.0)])
def test_balls_start_clear_above_an_obstacle_of_any_shape_and_some_fall_on_it(sides: tuple[float, ...]) -> None:
    points = np.concatenate([CORNERS * sides + (7.0, 0.0, -3.0), [(99.0, 0.0, 0.0)]])  # the last has no triangle
    scene = obstacle_scene_of(obstacle_of(points, BOX, spacing=0.02))
    pos, radius = scene.start(0).pos[0], scene.groups[0].widest
    assert len(pos) == 20 and (pos[:, 1] > sides[1] + radius).all()
    beyond = np.maximum(np.abs(pos - points[:8].mean(axis=0))[:, [0, 2]] - np.array(sides)[[0, 2]] / 2, 0.0)
    assert (np.linalg.norm(beyond, axis=1) < radius).sum() >= 2
