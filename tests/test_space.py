"""Spaces: wrapping, minimum images and walls, in array methods and in compiled steps."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from flockenv.behaviours import Separation
from flockenv.geometry.space import Box, Plane, Space, Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Drag
from flockenv.scene import Group, Scene
from flockenv.steering.vectorize import rows
from tests.catalogue import SPACES, everything, scene_of

ROWS = pytest.mark.parametrize("kind", SPACES)
DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])

ANYWHERE = st.floats(-1e6, 1e6) | st.floats(-1e-300, 1e-300) | st.sampled_from([-1e-17, -5e-324, 5e-324, 0.0, -0.0])


def alone(scene: Scene) -> Scene:
    group = Group(count=1, radius=0.5, spawn=Spawn(low=(0,) * scene.dimension, high=(1,) * scene.dimension))
    return scene.model_copy(update={"groups": (group,), "obstacles": ()})


@pytest.fixture(scope="module", params=["float64", "float32"])
def torus(request: pytest.FixtureRequest) -> Scene:
    return alone(everything(2, Drag(rate=0), dtype=request.param))  # the kernel of all effects, but without forces


@given(ANYWHERE, ANYWHERE)
@example(-1e-17, -1e-9)
@example(9.0, 7.0)
@example(np.nextafter(9.0, 0), np.nextafter(7.0, 8))
def test_a_torus_keeps_agents_in_its_half_open_box(torus: Scene, x: float, y: float) -> None:
    """In floating point, (-1e-17) % 10 is 10: an index beyond the last cell."""
    state = torus.start(0)
    state.pos[0, 0], state.vel[...] = (x, y), 0.0
    found = torus.step(state).pos[0, 0]
    size = np.asarray(SPACES["torus"][2].size, found.dtype)  # type: ignore[union-attr]
    assert (found >= 0).all()
    assert (found < size).all()
    place = state.pos[0, 0].astype(float)
    away = (found - place) / size
    np.testing.assert_allclose(away, np.rint(away), atol=1e-3 if found.dtype == np.float32 else 1e-9)


@given(ANYWHERE, ANYWHERE)
@example(-1e-17, -1e-9)
def test_wrap_puts_arrays_into_the_half_open_box(x: float, y: float) -> None:
    space = SPACES["torus"][2]
    found = space.wrap([[x, y]])
    assert (found >= 0).all()
    assert (found < np.asarray(space.size)).all()  # type: ignore[attr-defined]
    np.testing.assert_allclose(space.displacement(found, [x, y]), 0, atol=1e-9)


@pytest.mark.parametrize("times", [0.3, 0.7, 1.6, 2.4, 7.7, -1.7, 1000.2])
def test_the_displacement_on_a_torus_is_the_shortest_for_any_distance(times: float) -> None:
    """Beyond 1.5 boxes it is not enough to add or subtract one box."""
    space = Torus(size=(10.0, 4.0))
    a, b = np.array([9.0, 3.5]), np.array([9.0, 3.5]) + times * np.array([10.0, 4.0])
    images = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2) * [10.0, 4.0]
    expected = ((b - a) % np.array([10.0, 4.0]) + images)[:, None]
    shortest = np.take_along_axis(expected[:, 0], np.abs(expected[:, 0]).argmin(axis=0)[None], axis=0)[0]
    np.testing.assert_allclose(space.displacement(a, b), shortest, atol=1e-9)
    np.testing.assert_allclose(rows(Torus.offset_law)(space.size, a, b), shortest, atol=1e-9)


@DIMENSIONS
def test_displacements_by_half_a_box_are_opposite_for_the_two_agents(dimension: int) -> None:
    """Otherwise two agents that repel each other would be pushed in the same direction."""
    space = SPACES["torus"][dimension]
    half = np.asarray(space.size) / 2  # type: ignore[attr-defined]
    for offset in (space.displacement, functools.partial(rows(Torus.offset_law), space.extent(dimension))):
        for times in (-5, -3, -1, 1, 3, 5):
            there, back = (np.asarray(offset(times * a, times * b)) for a, b in ((0 * half, half), (half, 0 * half)))
            np.testing.assert_array_equal(there, -back)
            np.testing.assert_array_equal(np.abs(there), half)


@DIMENSIONS
@ROWS
def test_the_offset_law_and_the_displacement_method_agree(kind: str, dimension: int) -> None:
    space: Space = SPACES[kind][dimension]
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-30, 30, (500, dimension)), rng.uniform(-30, 30, (500, dimension))
    law = rows(space.offset_law)
    found = law(space.extent(dimension), a, b)
    np.testing.assert_allclose(found, space.displacement(a, b), atol=1e-12)
    np.testing.assert_allclose(found, -law(space.extent(dimension), b, a), atol=1e-12)
    assert space.periodic == (np.linalg.norm(found, axis=1).max() < 10)


def test_displacements_jump_at_half_a_box() -> None:
    space = Torus(size=(10.0, 10.0))
    np.testing.assert_allclose(np.abs(space.displacement([0, 0], [[5, 5], [-5, 15]])), 5)
    np.testing.assert_allclose(space.displacement([0, 0], [[4.999, 5.001]]), [[4.999, -4.999]])


# --- walls ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def box() -> Scene:
    """Return one agent of radius 0.5 m in a box of 9 m by 7 m, with the kernel that test_neighbours.py uses."""
    return alone(scene_of(Separation(weight=0, radius=1), space=Box(size=(9.0, 7.0)), dt=0.1))


@pytest.mark.parametrize(
    ("at", "velocity", "then", "left"),
    [
        ((8.45, 3.0), (2.0, 1.0), (8.5, 3.1), (0.0, 1.0)),  # into the wall: the component along it stays
        ((0.55, 3.0), (-2.0, 1.0), (0.5, 3.1), (0.0, 1.0)),
        ((4.0, 6.45), (1.0, 2.0), (4.1, 6.5), (1.0, 0.0)),
        ((8.45, 6.45), (2.0, 2.0), (8.5, 6.5), (0.0, 0.0)),  # a corner stops both
        ((8.5, 3.0), (-2.0, 1.0), (8.3, 3.1), (-2.0, 1.0)),  # away from the wall: nothing happens
        ((8.5, 3.0), (0.0, 1.0), (8.5, 3.1), (0.0, 1.0)),  # along the wall
        ((12.0, 3.0), (-2.0, 1.0), (8.5, 3.1), (-2.0, 1.0)),  # outside but moving inwards: only the position changes
        ((-1.0, -1.0), (3.0, -3.0), (0.5, 0.5), (3.0, 0.0)),
        ((4.0, 3.0), (1.0, -1.0), (4.1, 2.9), (1.0, -1.0)),
    ],
)
def test_walls_stop_the_outward_component_only(box: Scene, at: Any, velocity: Any, then: Any, left: Any) -> None:
    state = box.start(0).with_motion([[at]], [[velocity]])
    after = box.step(state)
    np.testing.assert_allclose(after.pos[0, 0], then, atol=1e-12)
    np.testing.assert_allclose(after.vel[0, 0], left, atol=1e-12)


def test_agents_do_not_leave_a_box(box: Scene) -> None:
    state = box.start(3, worlds=50)
    rng = np.random.default_rng(0)
    for _ in range(300):
        state = box.step(state, drive=rng.normal(size=(50, 1, 2)) * 40)
        assert (state.pos >= 0.5).all()
        assert (state.pos <= [8.5, 6.5]).all()


def test_a_plane_has_no_walls() -> None:
    space = Plane()
    np.testing.assert_array_equal(space.wrap([[1e9, -1e9]]), [[1e9, -1e9]])
    np.testing.assert_array_equal(space.displacement([1e9, 0], [-1e9, 0]), [-2e9, 0])
    np.testing.assert_array_equal(Box(size=(9, 7)).wrap([[12, -1], [3, 3]]), [[9, 0], [3, 3]])


@pytest.mark.parametrize(
    "size", [(0.0, 1.0), (-1.0, 1.0), (1.0,), (1.0,) * 4, (float("nan"), 1.0), (1.0, float("inf"))]
)
@pytest.mark.parametrize("kind", [Torus, Box])
def test_an_invalid_size_is_refused_in_one_line(kind: Any, size: Any) -> None:
    with pytest.raises(ValueError, match="size") as caught:
        kind(size=size)
    assert "\n" not in str(caught.value)
