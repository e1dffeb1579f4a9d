"""Obstacles of every shape: distance, normal, hit of a ray, silhouette and bounds, by independent computations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours.follow_way import FollowWay
from flockenv.behaviours.orca import Orca
from flockenv.behaviours.walls import Contain
from flockenv.geometry.shapes import (
    Block,
    Capsule,
    Circle,
    DistanceField,
    HalfSpace,
    Polygon,
    Shape,
    Sway,
    Wall,
    distance_to_shapes,
)
from flockenv.geometry.space import Torus
from flockenv.model.spawn import Spawn
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import dump_scene, load_scene

rolling = Circle(centre=(1, 1), radius=0.3, velocity=(1, 0))
L = Polygon(vertices=((0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)))
SHAPES: dict[str, Shape] = {
    "circle": Circle(centre=(1, 0.5), radius=1.2),
    "sphere": Circle(centre=(1, 0.5, -0.3), radius=1.2),
    "capsule": Capsule(start=(-1, 0), end=(1.5, 1), radius=0.4),
    "capsule_3": Capsule(start=(-1, 0, 0.5), end=(1.5, 1, -0.5), radius=0.4),
    "segment": Capsule(start=(-1, 0), end=(1.5, 1)),
    "wall": Wall(vertices=((-2, 0), (0, 1), (1, -1), (2, 1)), radius=0.1),
    "convex": Polygon(vertices=((-1, -1), (2, -0.5), (1, 1.5))),
    "clockwise": Polygon(vertices=((1, 1.5), (2, -0.5), (-1, -1))),
    "concave": L,
    "block": Block(centre=(0.5, 0.2), size=(2, 1)),
    "turned_block": Block(centre=(0.5, 0.2), size=(2, 1), turn=33),
    "box": Block(centre=(0.5, 0.2, 0.1), size=(2, 1, 1.5)),
    "turned_box": Block(centre=(0.5, 0.2, 0.1), size=(2, 1, 1.5), turn=50, axis=(1, 2, -0.5)),
    "line": HalfSpace(point=(0.3, 0.1), direction=(1, 2)),
    "plane": HalfSpace(point=(0.3, 0.1, 0), direction=(1, 2, -1)),
    "hollow_circle": Circle(centre=(1, 0.5), radius=2.2, hollow=True),
    "hollow_sphere": Circle(centre=(1, 0.5, -0.3), radius=2.2, hollow=True),
    "hollow_capsule": Capsule(start=(-1, 0), end=(1.5, 1), radius=1.4, hollow=True),
    "hollow_capsule_3": Capsule(start=(-1, 0, 0.5), end=(1.5, 1, -0.5), radius=1.4, hollow=True),
    "hollow_polygon": Polygon(vertices=((0, 0), (6, 0), (6, 2), (2, 2), (2, 6), (0, 6)), hollow=True),
    "hollow_block": Block(centre=(0.5, 0.2), size=(4, 3), turn=33, hollow=True),
    "hollow_box": Block(centre=(0.5, 0.2, 0.1), size=(4, 3, 3.5), turn=50, axis=(1, 2, -0.5), hollow=True),
}
every = pytest.mark.parametrize("name", SHAPES)


def places(shape: Shape, count: int = 300, seed: int = 1) -> Any:
    low, high = (shape.extremes.min(axis=0), shape.extremes.max(axis=0)) if shape.is_hollow else (-4, 4)
    return np.random.default_rng(seed).uniform(low, high, (count, shape.dimension))


def directions(shape: Shape, count: int = 300) -> Any:
    vectors = np.random.default_rng(2).normal(size=(count, shape.dimension))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@every
def test_the_normal_is_the_gradient_of_the_distance(name: str) -> None:
    shape, h = SHAPES[name], 1e-6
    x = places(shape)
    steps = h * np.eye(shape.dimension)
    slope = np.stack([(shape.gap(x + s) - shape.gap(x - s)) / (2 * h) for s in steps], axis=1)
    smooth = np.abs(np.linalg.norm(slope, axis=1) - 1) < 1e-6  # excludes places with two nearest points
    assert smooth.mean() > 0.9
    np.testing.assert_allclose(shape.normal(x)[smooth], slope[smooth], atol=1e-5)


@every
def test_the_nearest_point_lies_on_the_surface_and_no_point_of_it_is_nearer(name: str) -> None:
    shape = SHAPES[name]
    x = places(shape)
    nearest = shape.nearest(x)
    np.testing.assert_allclose(shape.gap(nearest), 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(nearest - x, axis=1), np.abs(shape.gap(x)), rtol=1e-9)
    # all points nearer to a place than its distance are on the same side of the surface
    inner = x + 0.999 * np.abs(shape.gap(x))[:, None] * directions(shape)
    assert (np.sign(shape.gap(inner)) == np.sign(shape.gap(x))).all()


@every
@pytest.mark.parametrize("clearance", [0.0, 0.35])
def test_a_ray_hits_where_the_body_touches_first(name: str, clearance: float) -> None:
    """The oracle steps finely along the ray: before a hit, the distance must exceed the clearance."""
    shape = SHAPES[name]
    x = places(shape, 200)
    direction = np.array(shape.anchor) + places(shape, 200, 3) / 3 - x  # roughly towards the shape
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    found = shape.hit(x, direction, clearance)
    room = lambda t: shape.gap(x + t[:, None] * direction) - clearance  # noqa: E731
    np.testing.assert_array_equal(found == 0, room(np.zeros(200)) < 0)
    hits = np.isfinite(found) & (found > 0)
    assert 10 < hits.sum() < 190
    np.testing.assert_allclose(room(np.where(hits, found, 0))[hits], 0, atol=1e-9)
    for share in np.linspace(0.01, 0.999, 120):
        assert (room(share * np.where(hits, found, 0))[hits] > -1e-9).all(), "an earlier point touches the shape"
    missed = np.isinf(found)
    for t in np.linspace(0, 20, 300):
        assert (room(np.full(200, t))[missed] > -1e-9).all(), "a ray that misses touches the shape"


@pytest.mark.parametrize("name", ["concave", "convex", "clockwise"])
def test_inside_of_a_polygon_agrees_with_the_winding_number(name: str) -> None:
    shape: Any = SHAPES[name]
    x = places(shape, 500)
    corners = np.array(shape.vertices)[None] - x[:, None]
    angles = np.arctan2(corners[..., 1], corners[..., 0])
    turns = np.diff(np.concatenate([angles, angles[:, :1]], axis=1), axis=1)
    winding = ((turns + np.pi) % (2 * np.pi) - np.pi).sum(axis=1) / (2 * np.pi)
    np.testing.assert_array_equal(shape.inside(x), np.abs(winding) > 0.5)


def test_the_orientation_of_a_polygon_does_not_matter() -> None:
    x, direction = places(L), directions(L)
    a, b = SHAPES["convex"], SHAPES["clockwise"]
    np.testing.assert_allclose(a.gap(x), b.gap(x), atol=1e-12)
    np.testing.assert_allclose(a.hit(x, direction, 0.2), b.hit(x, direction, 0.2), atol=1e-12)
    on_edge = np.array([0.5, -0.75])
    np.testing.assert_allclose(a.normal(on_edge), b.normal(on_edge), atol=1e-9)


@pytest.mark.parametrize("clearance", [0.0, 0.3])
@pytest.mark.parametrize("name", ["circle", "capsule", "segment", "wall", "convex", "concave", "block", "turned_block"])
def test_lines_to_the_ends_of_the_silhouette_just_touch_the_shape(name: str, clearance: float) -> None:
    shape = SHAPES[name]
    point = np.array([-5.0, 3.0])
    for end, side in zip(shape.silhouette(point, clearance), (1, -1), strict=True):
        direction = (end - point) / np.linalg.norm(end - point)
        assert shape.hit(point, direction, clearance + 1e-6) < np.inf
        for turn in (1e-4, 0.1, 1.0):
            c, s = np.cos(side * turn), np.sin(side * turn)
            outward = np.array([direction[0] * c - direction[1] * s, direction[0] * s + direction[1] * c])
            assert shape.hit(point, outward, clearance) == np.inf
        assert abs(float(shape.gap(end)) - clearance) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", ["concave", "turned_box"])
def test_a_distance_field_agrees_with_its_shape_to_the_spacing(name: str) -> None:
    shape = SHAPES[name]
    d, spacing = shape.dimension, 0.05 if name == "concave" else 0.1
    field = DistanceField(low=(-3,) * d, high=(5,) * d, spacing=spacing, shapes=(shape,))
    x, direction = np.random.default_rng(1).uniform(-2.5, 4, (300, d)), directions(shape)
    assert np.abs(field.gap(x) - shape.gap(x)).max() < spacing
    far = np.abs(shape.gap(x)) > 3 * spacing
    assert np.median((field.normal(x) * shape.normal(x)).sum(axis=1)[far]) > 0.999
    found, exact = field.hit(x, direction, 0.3), shape.hit(x, direction, 0.3)
    both = np.isfinite(found) & np.isfinite(exact)
    assert (np.isfinite(found) == np.isfinite(exact)).mean() > 0.98  # except for grazing rays
    assert np.quantile(np.abs(found[both] - exact[both]), 0.95) < 1.5 * spacing
    again = DistanceField(low=field.low, spacing=spacing, values=tuple(field.distances.tolist()))
    np.testing.assert_array_equal(again.gap(x), field.gap(x))
    outside = np.full(d, 40.0)
    assert 0.9 * float(shape.gap(outside)) < float(field.gap(outside)) < 1.2 * float(shape.gap(outside))


@pytest.mark.parametrize("dimension", [2, 3])
def test_queries_in_a_hollow_circle_or_sphere_agree_with_closed_forms(dimension: int) -> None:
    """Distance R - |x|, normal -x / |x|, and hit at t = -x.d + sqrt((x.d)^2 - |x|^2 + (R - r)^2)."""
    ball = Circle(centre=(0,) * dimension, radius=2.0, hollow=True)
    x = np.random.default_rng(5).uniform(-0.9, 0.9, (200, dimension))
    direction, far = directions(ball, 200), np.linalg.norm(x, axis=1)
    np.testing.assert_allclose(ball.gap(x), 2 - far, atol=1e-14)
    np.testing.assert_allclose(ball.normal(x), -x / far[:, None], atol=1e-14)
    along = (x * direction).sum(axis=1)
    np.testing.assert_allclose(ball.hit(x, direction, 0.3), np.sqrt(along**2 - far**2 + 1.7**2) - along, rtol=1e-14)
    assert (ball.hit(x, direction, 2.5) == 0).all()
    assert float(ball.gap(np.full(dimension, 5.0))) < 0


@every
def test_a_shape_lies_within_its_bounds_and_they_are_tight(name: str) -> None:
    shape = SHAPES[name]
    x = 3 * places(shape, 400)
    offset = x - shape.bound.centre
    if shape.is_hollow or shape.kind == "half_space":
        assert np.isinf(shape.bound.half).all() and np.isinf(shape.bound.radius)
        return
    beyond = np.linalg.norm(np.maximum(np.abs(offset) - shape.bound.half, 0), axis=1)
    assert (shape.gap(x)[beyond > 0] >= beyond[beyond > 0] - 1e-12).all()
    assert (shape.gap(x) >= np.linalg.norm(offset, axis=1) - shape.bound.radius - 1e-12).all()
    surface = shape.nearest(x) - shape.bound.centre
    assert (np.abs(surface).max(axis=0) > 0.9 * shape.bound.half).all(), "the bounding box is too large"
    assert shape.bound.radius < 1.01 * np.linalg.norm(shape.bound.half), "the bounding circle is too large"


def test_a_distance_field_solid_at_the_edge_of_its_grid_stays_within_its_bounds() -> None:
    field = DistanceField(low=(0, 0), high=(2, 1), spacing=0.25, shapes=(Circle(centre=(0.5, 0.5), radius=1.0),))
    x, bound = places(field, 1000), field.bound
    offset = x - bound.centre
    beyond = np.linalg.norm(np.maximum(np.abs(offset) - bound.half, 0), axis=1)
    assert (field.gap(x)[beyond > 0] >= beyond[beyond > 0] - 1e-12).all()
    assert (field.gap(x) >= np.linalg.norm(offset, axis=1) - bound.radius - 1e-12).all()
    assert field.gap([0.5, 1.4]) < 0, "the solid must extend beyond the grid"


@every
def test_queries_are_finite_everywhere_and_for_a_zero_direction(name: str) -> None:
    shape = SHAPES[name]
    special = [np.array(shape.anchor), *shape.extremes, np.zeros(shape.dimension), np.full(shape.dimension, 1e9)]
    x = np.array(special)
    assert np.isfinite(shape.gap(x)).all()
    np.testing.assert_allclose(np.linalg.norm(shape.normal(x), axis=1), 1, rtol=1e-9)
    for direction in (np.zeros_like(x), np.eye(shape.dimension)[np.zeros(len(x), int)]):
        assert not np.isnan(shape.hit(x, direction, 0.1)).any()


# --- as obstacles of a scene ------------------------------------------------------------------------------------------

GROUP = Group(count=200, radius=0.2, spawn=Spawn(low=(-3, -3), high=(4, 4)))


def test_an_obstacle_with_centre_and_radius_but_no_kind_is_a_circle() -> None:
    scene = load_scene(
        "groups: [{count: 1, spawn: {low: [0, 0], high: [1, 1]}}]\nobstacles: [{centre: [3, 3], radius: 1}]"
    )
    assert scene.obstacles == (Circle(centre=(3, 3), radius=1),)
    assert scene.start(0).obstacle_radius.shape == (1, 1)


def test_every_shape_survives_yaml() -> None:
    flat = tuple(shape for shape in SHAPES.values() if shape.dimension == 2)
    field = DistanceField(low=(0, 0), high=(1, 1), spacing=0.5, shapes=(Circle(centre=(0.5, 0.5), radius=0.2),))
    sway = Sway(amplitude=(0.5, 0), period=3, phase=1)
    moving = tuple(shape.model_copy(update={"velocity": (1, 2), "sway": sway}) for shape in flat)
    for obstacles in (flat, moving, (*flat, field)):
        scene = Scene(groups=(GROUP,), obstacles=obstacles)
        assert load_scene(dump_scene(scene)) == scene


def test_no_agent_starts_in_an_obstacle() -> None:
    obstacles = (L, SHAPES["wall"], Circle(centre=(-2, -2), radius=0.8), Block(centre=(3, 3), size=(1, 1), turn=45))
    scene = Scene(groups=(GROUP,), obstacles=obstacles)
    pos = scene.start(4, worlds=2).pos
    for shape in obstacles:
        assert (shape.gap(pos) >= 0.2 - 1e-9).all()
    # agents that are clear anyway start where they do without the other obstacles
    free = Scene(groups=(GROUP,), obstacles=obstacles[2:3]).start(4, worlds=2).pos
    clear = np.min([shape.gap(free) for shape in obstacles], axis=0) >= 0.2
    assert clear.sum() > 100
    np.testing.assert_array_equal(pos[clear], free[clear])


@pytest.mark.parametrize("hollow", [False, True])
def test_a_ring_that_repeats_its_first_vertex_is_the_same_polygon(hollow: bool) -> None:
    ring = Polygon(vertices=(*L.vertices, L.vertices[0]), hollow=hollow)
    assert ring == Polygon(vertices=L.vertices, hollow=hollow)
    x = places(L)
    np.testing.assert_array_equal(ring.gap(x), Polygon(vertices=L.vertices, hollow=hollow).gap(x))


def test_on_a_torus_distances_are_to_the_nearest_image() -> None:
    x, period = np.array([[0.1, 5.0], [9.9, 5.0]]), np.array([10.0, 10.0])
    block = Block(centre=(0, 5), size=(1, 1))
    np.testing.assert_allclose(distance_to_shapes([block], x, period), [-0.4, -0.4], atol=1e-9)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Polygon(vertices=((0, 0), (1, 1), (1, 0), (0, 1))), "edges after vertices 0 and 2 cross"),
        (lambda: Polygon(vertices=((0, 0), (1, 0), (2, 0))), "cross or touch|enclose no area"),
        (lambda: Polygon(vertices=((0, 0), (1, 0), (1, 0), (0, 1))), r"vertices\[2\] = .*the same as vertices\[1\]"),
        (lambda: Polygon(vertices=((0, 0), (1, 0), (0, 0), (0, 0))), r"vertices\[2\] = .*the same as vertices\[0\]"),
        (lambda: Polygon(vertices=((0, 0), (1, 0), (0, 0))), r"vertices\[2\] = .*the same as vertices\[0\]"),
        (lambda: Polygon(vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0))), "vertices"),
        (lambda: Wall(vertices=((0, 0), (1, 0, 0))), r"vertices\[1\] = .*must have 2 numbers, as vertices\[0\] has"),
        (lambda: Block(centre=(0, 0), size=(1, 1, 1)), "must have 2 numbers, as centre has"),
        (lambda: Block(centre=(0, 0), size=(1, 0)), "size"),
        (lambda: HalfSpace(point=(0, 0), direction=(0, 0)), "not all 0"),
        (lambda: DistanceField(low=(0, 0), spacing=1), "give either shapes or values"),
        (lambda: DistanceField(low=(0, 0), spacing=1e-4, high=(9, 9), shapes=(L,)), "points; at most"),
        (lambda: Scene(groups=(GROUP,), obstacles=(SHAPES["box"],)), "lies in 3 dimensions, but dimension = 2"),
        (lambda: Scene(groups=(GROUP,), obstacles=(Circle(centre=(0, 0, 0), radius=1),)), r"obstacles\[0\].centre"),
        (lambda: Scene(space=Torus(size=(9, 9)), groups=(GROUP,), obstacles=(SHAPES["line"],)), "no inside"),
        (
            lambda: Scene(space=Torus(size=(5, 5)), groups=(GROUP,), obstacles=(Wall(vertices=((0, 0), (4, 0))),)),
            "at most half of the torus",
        ),
        (lambda: SHAPES["line"].silhouette((1, 2)), "has no corners"),
        (lambda: L.silhouette((0.5, 0.5)), "is not outside"),
        (lambda: SHAPES["hollow_circle"].silhouette((1, 1)), "its outline has no ends"),
        (lambda: Capsule(start=(0, 0), end=(1, 0), hollow=True), "radius = 0: a hollow capsule"),
        (lambda: HalfSpace(point=(0, 0), direction=(0, 1), hollow=True), "hollow = True: unknown key"),
        (lambda: Wall(vertices=((0, 0), (4, 0)), hollow=True), "hollow = True: unknown key"),
        (lambda: Circle(centre=(0, 0), radius=1, velocity=(1, 0, 0)), r"velocity = .*must have 2 numbers"),
        (lambda: Block(centre=(0, 0, 0), size=(1, 1, 1), velocity=(1, 0)), r"velocity = .*must have 3 numbers"),
        (lambda: Polygon(vertices=L.vertices, velocity=(1, math.nan)), r"velocity\[1\] = nan"),
        (lambda: Wall(vertices=((0, 0), (1, 0, 0)), velocity=(1, 0)), r"vertices\[1\] = .*must have 2 numbers"),
        (lambda: Sway(amplitude=(1, 0), period=0), "period = 0: must be a number > 0"),
        (
            lambda: Circle(centre=(0, 0), radius=1, sway=Sway(amplitude=(1, 0, 0), period=1)),
            r"sway.amplitude = .*must have 2 numbers",
        ),
        (
            lambda: DistanceField(low=(0, 0), high=(1, 1), spacing=0.5, shapes=(rolling,)),
            r"shapes\[0\]: moves",
        ),
        (lambda: FollowWay(weight=1, target=(9, 9)).check(Scene(groups=(GROUP,), obstacles=(rolling,))), "moves"),
        (lambda: Orca(weight=1, target=(9, 9), speed=1).check(Scene(groups=(GROUP,), obstacles=(rolling,))), "moves"),
        (lambda: Contain(weight=1, within=SHAPES["hollow_circle"]), "within: must stand still and be solid"),
    ],
)  # fmt: skip
def test_a_bad_shape_raises_an_error_of_one_line(make: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_an_unknown_kind_of_obstacle_gets_a_suggestion() -> None:
    with pytest.raises(ValueError, match=r"polygn.*did you mean `polygon`"):
        load_scene(
            "groups: [{count: 1, spawn: {low: [0, 0], high: [1, 1]}}]\nobstacles: [{kind: polygn, vertices: []}]"
        )
