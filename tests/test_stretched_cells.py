"""Agents far away from all others do not change which neighbours are found, nor add many candidates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flockenv.jit.thread_pool import use_threads
from flockenv.model.state import State
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene

SCENE = """
dimension: {dimension}
space: {{kind: plane}}
groups: [{{count: {count}, radius: 0.1, max_speed: 3, spawn: {{low: {zero}, high: {zero}}}}}]
effects: [{{kind: separation, weight: 1, radius: 3}}, {{kind: alignment, weight: 1, radius: 3}}]
dt: 0.05
"""
COUNT = 5000


def flock(dimension: int = 2, count: int = COUNT) -> Scene:
    return load_scene(SCENE.format(dimension=dimension, count=count, zero=[0] * dimension))


def placed(scene: Scene, outline: tuple[float, ...]) -> State:
    """Return a start with agents spread evenly over a box of these edges, m."""
    rng = np.random.default_rng(0)
    shape = scene.start(0).shape
    return scene.start(0).with_motion(rng.uniform(0, outline, shape), rng.normal(size=shape))


def moved(state: State, change: Any) -> State:
    pos = state.pos.copy()
    change(pos[0])
    return state.with_motion(pos, state.vel)


def candidates(scene: Scene, state: State, steps: int = 1) -> float:
    """Return the mean number of candidates that a step tests."""
    return (scene.run(state, steps).count_of("pairs") - state.count_of("pairs")) / steps


def far_along_x(pos: NDArray[Any], by: float) -> None:
    pos[0, 0] += by


FAR: dict[str, Any] = {
    "one at 10 km": lambda x: far_along_x(x, 1e4),
    "one at -100 km": lambda x: far_along_x(x, -1e5),
    "one at 1e12 m": lambda x: far_along_x(x, 1e12),
    "one at 1e25 m": lambda x: far_along_x(x, 1e25),
    "one far along each axis": lambda x: np.copyto(x[:2], [[1e6], [-1e7]]),
    "two clusters 1,000 km apart": lambda x: np.add(x[::2], 1e6, out=x[::2]),
    "ten clusters 8 km apart": lambda x: np.add(x, np.arange(len(x))[:, None] % 10 * 8192.0, out=x),
}


@pytest.mark.slow
@pytest.mark.parametrize("outline", [(200, 200), (2000, 20), (20, 2000)], ids=["square", "long", "high"])
@pytest.mark.parametrize("how", FAR.values(), ids=FAR.keys())
def test_agents_far_away_do_not_add_candidates(how: Any, outline: tuple[float, ...]) -> None:
    scene = flock()
    state = placed(scene, outline)
    assert candidates(scene, moved(state, how)) < 2.5 * candidates(scene, state)


@pytest.mark.slow
def test_agents_far_away_do_not_add_candidates_in_3d() -> None:
    scene = flock(dimension=3)
    state = placed(scene, (50, 50, 50))
    for how in (FAR["one far along each axis"], FAR["two clusters 1,000 km apart"]):
        assert candidates(scene, moved(state, how)) < 2.5 * candidates(scene, state)


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("how", FAR.values(), ids=FAR.keys())
def test_agents_far_away_do_not_change_the_neighbours_that_are_found(how: Any, dimension: int) -> None:
    """Positions are multiples of 2^-10 m, so that moving a cluster by kilometres changes no distance in it."""
    scene = flock(dimension)
    state = placed(scene, (200, 200) if dimension == 2 else (50, 50, 50))
    state = moved(state, lambda x: x.__setitem__(slice(None), np.round(x * 1024) / 1024))
    shifted = moved(state, how)
    near = [_neighbours(s.pos[0]) for s in (state, shifted)]
    same = np.array([a == b for a, b in zip(*near, strict=True)])
    assert same.mean() > 0.001
    plain, far = scene.acceleration(state)[0], scene.acceleration(shifted)[0]
    np.testing.assert_allclose(far[same], plain[same], rtol=1e-9, atol=1e-9)
    lonely = np.array([not each for each in near[1]])
    assert not far[lonely].any()


def _neighbours(pos: NDArray[np.float64]) -> list[frozenset[int]]:
    from scipy.spatial import cKDTree

    return [frozenset(each) - {i} for i, each in enumerate(cKDTree(pos).query_ball_point(pos, 3.0))]


@pytest.mark.parametrize("count", [5000, 20000])
def test_results_do_not_depend_on_threads_calls_or_batches(count: int) -> None:
    scene = flock(count=count)
    side = 200 * (count / 5000) ** 0.5
    state = moved(placed(scene, (side, side)), FAR["one far along each axis"])
    once = scene.run(state, 6)
    one_by_one = state
    for _ in range(6):
        one_by_one = scene.step(one_by_one)
    use_threads(3)
    try:
        shared = scene.run(state, 6)
    finally:
        use_threads(1)
    batch = scene.start(0, worlds=2).with_motion(np.repeat(state.pos, 2, 0), np.repeat(state.vel, 2, 0))
    rows = scene.run(batch, 6)
    for other in (one_by_one, shared, rows):
        assert np.array_equal(once.pos[0], other.pos[0]) and np.array_equal(once.vel[0], other.vel[0])
        assert np.array_equal(once.work[0], other.work[0])
