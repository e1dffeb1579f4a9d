"""Scenes far from the origin: the same motion in double precision, an error of one line in single (N17)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.geometry.shapes import Block, Capsule, Circle, HalfSpace, Polygon, Shape, Wall
from flockenv.geometry.space import Box, Torus
from flockenv.model.float_range import FARTHEST, FARTHEST_PER_RADIUS
from flockenv.model.networks import Mesh, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.constraints import Collisions
from flockenv.physics.effects import Attraction, Drag, Gravity, Springs, Tether
from flockenv.physics.population import Drain
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import load_scene

Array = NDArray[np.float64]
HERE = (Group(count=3, spawn=Spawn(low=(0, 0), high=(1, 1))),)
FAR = 3e4

FAR_AWAY = [
    ({"space": Torus(size=(FAR, 5))}, "space.size = (30000.0, 5.0)"),
    ({"space": Box(size=(5, 1.0001e4))}, "space.size = (5.0, 10001.0)"),
    ({"groups": (*HERE, Group(count=3, spawn=Spawn(low=(-FAR, 0), high=(1, 1))))}, "groups[1].spawn.low = (-30000.0"),
    ({"groups": (Group(count=3, spawn=Spawn(low=(0, 0), high=(1, FAR))),)}, "groups[0].spawn.high = (1.0, 30000.0)"),
    ({"groups": (Group(network=Rope(links=3, start=(FAR, 0), length=1)),)}, "groups[0].network: its farthest"),
    ({"groups": (Group(network=Mesh(vertices=((0, 0), (1, -FAR)))),)}, "its farthest coordinate = 30000 m"),
    ({"obstacles": ({"centre": (1, FAR), "radius": 1},)}, "obstacles[0].centre = (1.0, 30000.0)"),
    (
        {"obstacles": (Circle(centre=(0, 0), radius=FAR),)},
        "kind = circle: its farthest coordinate = 30000 m",
    ),
    ({"obstacles": (HalfSpace(point=(1, -FAR), direction=(0, 1)),)}, "kind = half_space: its farthest coordinate = 3"),
    ({"population": (Drain(shape=Circle(centre=(FAR, 0), radius=1)),)}, "population[0].shape.centre = (30000.0, 0.0)"),
    ({"effects": (Drag(rate=1), Tether(centre=(FAR, 1), stiffness=1))}, "effects[1].centre = (30000.0, 1.0)"),
    ({"effects": (Attraction(strength=1, centre=(0, -1e30)),)}, "effects[0].centre = (0.0, -1e+30)"),
]


@pytest.mark.parametrize(("fields", "message"), FAR_AWAY, ids=lambda value: str(value)[:40])
def test_single_precision_is_refused_in_one_line_far_from_the_origin(fields: Any, message: str) -> None:
    given = {"groups": HERE, **fields}
    with pytest.raises(ValueError, match="use dtype = float64") as caught:
        Scene(dtype="float32", **given)
    line = str(caught.value)
    assert message in line
    assert f"{FARTHEST:,.0f} m" in line
    assert "\n" not in line
    Scene(dtype="float64", **given)


def test_single_precision_is_accepted_up_to_the_limit() -> None:
    scene = Scene(groups=HERE, space=Box(size=(FARTHEST, 5)), dtype="float32")
    assert scene.dtype == "float32"


def test_an_agent_at_the_limit_still_walks_the_right_distance() -> None:
    """It walks at 1 m/s for 1 s in steps of 20 ms; at 30 km it would be 2 % off, at 300 km it would not move."""
    scene = Scene(groups=(Group(count=1, spawn=HERE[0].spawn),), dtype="float32")
    end = scene.run(scene.start(0).with_motion([[(FARTHEST - 2, 0)]], [[(1.0, 0)]]), 50)
    assert end.pos[0, 0, 0] - (FARTHEST - 2) == pytest.approx(1, rel=0.03)


# --- shapes in double precision ---------------------------------------------------------------------------------------

R = 0.1
AT_LIMIT = FARTHEST_PER_RADIUS * R


KINDS = [(2, kind) for kind in ("wall", "capsule", "polygon", "circle", "block")]
KINDS += [(3, kind) for kind in ("wall", "capsule", "circle", "block")]


def floor(kind: str, far: float, d: int) -> Shape:
    """Return a shape in d dimensions with a surface 1 m below the origin, whose farthest coordinate is `far`, m."""
    rest = (0.0,) * (d - 2)
    left, right, down = (-far, -1.0, *rest), (far, -1.0, *rest), (0.0, -far / 2 - 0.5, *rest)
    if kind == "wall":
        return Wall(vertices=(left, right))
    if kind == "capsule":
        return Capsule(start=left, end=right)
    if kind == "polygon":
        return Polygon(vertices=((-far, -2.0), (far, -2.0), right, left))
    if kind == "circle":
        return Circle(centre=down, radius=far / 2 - 0.5)
    return Block(centre=down, size=(2 * far, far - 1, 2 * far)[:d])


def resting_place(shape: Shape, dtype: str = "float64") -> Array:
    """Return the place, m, of a disc that falls on a floor 1 m below the origin, and slides for 3 s from x = 0.3 m."""
    d = shape.dimension
    scene = Scene(
        dimension=d, groups=(Group(count=1, radius=R, spawn=Spawn(low=(0,) * d, high=(1,) * d)),), obstacles=(shape,),
        effects=(Gravity(acceleration=(0.0, -9.81, 0.0)[:d]),), constraints=(Collisions(restitution=0.5),), dt=0.01,
        dtype=dtype,
    )  # fmt: skip
    start = scene.start(0).with_motion([[(0.3, 1.0, 0.0)[:d]]], [[(0.5, 0.0, 0.0)[:d]]])
    return np.asarray(scene.run(start, 300).pos[0, 0])


@pytest.mark.parametrize(
    ("d", "kind"), [pytest.param(d, kind, marks=[pytest.mark.slow] if d == 3 else []) for d, kind in KINDS]
)
def test_shapes_are_accurate_in_double_precision_up_to_the_limit(d: int, kind: str) -> None:
    """The circle is so large that its surface drops by 3e-8 m over the distance."""
    found = resting_place(floor(kind, AT_LIMIT, d))
    np.testing.assert_allclose(found, (1.8, -1 + R, 0.0)[:d], atol=1e-4 * R)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(("d", "kind"), KINDS)
def test_shapes_beyond_the_limit_are_refused_in_one_line(d: int, kind: str, dtype: str) -> None:
    limit, allowed = (AT_LIMIT, "1e+08 m") if dtype == "float64" else (FARTHEST, "10,000 m")
    with pytest.raises(ValueError, match=r"obstacles\[0\]") as caught:
        resting_place(floor(kind, 2.1 * limit, d), dtype)
    assert allowed in str(caught.value) and f"{dtype} " in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("shape", [
    Block(centre=(0, -2), size=(1e100, 2)), HalfSpace(point=(1e100, -1), direction=(0, 1)),
])  # fmt: skip
def test_surfaces_that_are_accurate_at_any_size_are_accepted(shape: Shape) -> None:
    np.testing.assert_allclose(resting_place(shape), (1.8, -1 + R), atol=1e-12)


def test_the_limit_of_shapes_is_that_of_the_smallest_agents() -> None:
    def refusal(*radii: float, **more: Any) -> str:
        groups = tuple(Group(count=1, radius=r, spawn=Spawn(low=(0, 0), high=(9, 9))) for r in radii)
        with pytest.raises(ValueError, match="float64") as caught:
            Scene(groups=groups, **more)
        return str(caught.value)

    far = (Wall(vertices=((0, 0), (0, 3e9))),)
    assert "up to 2e+08 m from the origin (1e+09 times the smallest radius, 0.2 m)" in refusal(0.2, 5.0, obstacles=far)
    assert "up to 1e+09 m from the origin (for agents of radius 0)" in refusal(0.0, obstacles=far)
    assert "population[0].shape.kind = wall: its" in refusal(0.2, population=(Drain(shape=far[0]),))
    Scene(groups=(Group(count=1, radius=5.0, spawn=Spawn(low=(0, 0), high=(9, 9))),), obstacles=far)


# --- motion -----------------------------------------------------------------------------------------------------------


def flock(offset: float) -> Scene:
    effects = (Separation(weight=1.3, radius=2), Alignment(weight=0.7, radius=3), Cohesion(weight=0.9, radius=3))
    spawn = Spawn(low=(0, 0), high=(6, 6), speed=(0.5, 1.5))
    return Scene(groups=(Group(count=40, max_speed=2, spawn=spawn),), effects=effects, dt=0.02)


def chain(offset: float) -> Scene:
    rope = Rope(links=12, start=(offset, -offset), length=6, stretch=1.1, pinned=("start",))
    return Scene(groups=(Group(network=rope, mass=0.1),), effects=(Springs(stiffness=60, damping=0.05),), dt=0.005)


def moved(state: State, offset: float) -> State:
    return state.with_motion(np.add(state.pos, (offset, -offset)), state.vel)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [1e4, 1e7])
@pytest.mark.parametrize("scene", [flock, chain])
def test_a_scene_far_from_the_origin_moves_the_same_in_double_precision(scene: Any, offset: float) -> None:
    """N17: after 100 steps the difference is at most 1e-6 of the size of the scene."""
    start = scene(0.0).start(3)
    if scene is chain:
        start.vel[0, 1:, 1] = np.sin(np.arange(1, start.shape[1]))
    there = moved(start, offset)
    near, far = scene(0.0).run(start, 100), scene(offset).run(there, 100)
    size = np.ptp(near.pos[0], axis=0).max()
    assert np.abs(near.pos - start.pos).max() > 0.05 * size
    np.testing.assert_allclose(far.pos - (offset, -offset), near.pos, atol=1e-6 * size)
    np.testing.assert_allclose(far.vel, near.vel, atol=1e-6 * np.abs(near.vel).max())


def test_the_smallest_agent_of_a_spread_decides() -> None:
    text = """
groups: [{count: 5, radius: {low: 1.0e-6, high: 1.0}, spawn: {low: [0, 0], high: [9, 9]}}]
obstacles: [{kind: wall, vertices: [[-9.0e+8, -1], [9.0e+8, -1]]}]
effects: [{kind: gravity}]
dt: 0.01
"""
    with pytest.raises(ValueError, match="up to 1000 m from the origin"):
        load_scene(text)
    load_scene(text.replace("9.0e+8", "900"))
