"""Who is near whom: the sweep through sorted cells against an independent search (scipy's k-d tree), term by term."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flockenv.effects import Alignment, Cohesion, Separation
from flockenv.kernels import entry
from flockenv.neighbours import sort_agents
from flockenv.scene import Group, Scene
from flockenv.space import Box, Space, Torus
from flockenv.spawn import Spawn
from flockenv.state import State
from tests.catalogue import Array, everything, scene_of

DT = 2.0**-10
"""s: one short step, whose change of velocity is the acceleration; a power of two divides exactly."""


# --- the oracle -------------------------------------------------------------------------------------------------------


def pairs(x: Array, radius: float, space: Space) -> tuple[Array, Array, Array]:
    """Who (i) meets whom (j) and the offset between them, for all ordered pairs nearer than the radius."""
    box = np.asarray(space.size) if isinstance(space, Torus) else None
    tree = cKDTree(x, boxsize=box)
    found = tree.query_pairs(radius * (1 + 1e-9), output_type="ndarray")
    i, j = np.concatenate([found, found[:, ::-1]]).T
    offset = x[j] - x[i]
    if box is not None:
        offset -= box * np.rint(offset / box)
    near = (offset**2).sum(axis=1) < radius**2
    return i[near], j[near], offset[near]


def total(values: Array, i: Array, count: int) -> Array:
    return np.stack([np.bincount(i, values[:, k], count) for k in range(values.shape[1])], axis=1)


def expected(effect: Any, x: Array, v: Array, space: Space) -> Array:
    """The forces (N, D) of one of the three rules, written from formulas.md 1.2."""
    n = len(x)
    i, j, offset = pairs(x, effect.radius, space)
    if effect.fov < 360:
        speed = np.linalg.norm(v, axis=1)
        ahead = (offset * v[i]).sum(axis=1)
        limit = math.cos(math.radians(effect.fov / 2)) * np.linalg.norm(offset, axis=1) * speed[i]
        seen = (ahead >= limit) | (speed[i] == 0)
        i, j, offset = i[seen], j[seen], offset[seen]
    count = np.maximum(np.bincount(i, minlength=n), 1)[:, None]
    if isinstance(effect, Separation):
        return -effect.weight * total(offset / (offset**2).sum(axis=1, keepdims=True), i, n)
    if isinstance(effect, Cohesion):
        return effect.weight * total(offset, i, n) / count
    some = np.bincount(i, minlength=n)[:, None] > 0
    return effect.weight * np.where(some, total(v[j], i, n) / count - v, 0)


# --- the sweep --------------------------------------------------------------------------------------------------------


def rules(radius: float, fov: float = 270, chosen: int = -1) -> tuple[Separation, Alignment, Cohesion]:
    """The three rules; with one chosen the others weigh nothing."""
    weights = [1.0 if chosen in (-1, k) else 0.0 for k in range(3)]
    return (
        Separation(weight=1.3 * weights[0], radius=radius),
        Alignment(weight=0.7 * weights[1], radius=radius, fov=fov),
        Cohesion(weight=0.9 * weights[2], radius=radius, fov=fov),
    )


def scene_with(effects: Any, space: Space | None, dimension: int, count: int) -> Scene:
    """A scene of one rule in a plane; on a torus, of the kernel that the other tests use too."""
    groups = (Group(count=count, spawn=Spawn(low=(0,) * dimension, high=(1,) * dimension)),)
    if not isinstance(space, Torus):
        return scene_of(*effects, dimension=dimension, space=space, groups=groups, dt=DT)
    given = {e.kind: e for e in effects}
    idle = {"drag": {"rate": 0.0}, "avoid_obstacles": {"weight": 0.0}}
    others = [
        given.get(e.kind) or type(e)(**e.model_dump() | idle.get(e.kind, {"weight": 0, "radius": 1e-3}))
        for e in everything(dimension).effects
    ]
    return scene_of(*others, dimension=dimension, space=space, groups=groups, obstacles=(), dt=DT)


def placed(scene: Scene, x: Array, v: Array) -> State:
    state = scene.start(0)
    return state.with_motion(x[None], v[None])


def forces(scene: Scene, state: State) -> Array:
    return (scene.step(state).vel - state.vel)[0] / DT


def assert_as_expected(effects: Any, x: Array, space: Space | None, v: Array | None = None) -> State:
    """Compare all forces of all agents; return the state after the step, for its counters."""
    count, dimension = x.shape
    v = np.random.default_rng(1).normal(size=x.shape) if v is None else v
    scene = scene_with(effects, space, dimension, count)
    state = placed(scene, x, v)
    found = forces(scene, state)
    exact = sum(expected(effect, x, v, scene.space) for effect in effects)
    scale = max(1.0, np.abs(exact).max())
    np.testing.assert_allclose(found, exact, atol=1e-9 * scale, rtol=1e-9)
    return scene.step(state)


def uniform(count: int, size: Any, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random((count, len(size))) * size


@pytest.mark.parametrize("rule", [0, 1, 2])
@pytest.mark.parametrize("count", [50, 95, 96, 400, 3000])
def test_in_a_plane_every_rule_meets_exactly_its_neighbours(rule: int, count: int) -> None:
    edge = math.sqrt(count / 4)
    after = assert_as_expected((rules(1.0)[rule],), uniform(count, (edge, edge)) - 3.0, None)
    met = after.counted("pairs") / count**2
    assert met == 1 if count < 96 else met < {96: 1.01, 400: 0.5, 3000: 0.06}[count]  # a grid was used at all


@pytest.mark.parametrize("rule", [0, 1, 2])
def test_in_space_too(rule: int) -> None:
    after = assert_as_expected((rules(1.0)[rule],), uniform(3000, (9.0, 9.0, 9.0)) - 3.0, None)
    assert after.counted("pairs") < 0.2 * 3000**2


@pytest.mark.parametrize("count", [50, 400, 3000])
@pytest.mark.parametrize("dimension", [2, 3])
def test_on_a_torus_all_rules_share_one_sweep(count: int, dimension: int) -> None:
    edge = (count / 4) ** (1 / dimension)
    size = np.array([1.0, 1.3, 0.9])[:dimension] * max(edge, 2.5)
    after = assert_as_expected(rules(1.0), uniform(count, size), Torus(size=tuple(size)))
    assert after.counted("neighbour_queries") == 1


def test_rules_of_different_radii_share_the_widest_query() -> None:
    space = Torus(size=(14.0, 11.0))
    mixed = (Separation(weight=1, radius=0.4), Alignment(weight=1, radius=1.7, fov=120), Cohesion(weight=1, radius=1.1))
    assert_as_expected(mixed, uniform(700, space.size), space)


def test_in_a_box_too() -> None:
    space = Box(size=(20.0, 8.0))
    assert_as_expected((rules(1.0)[0],), uniform(800, (19.6, 7.6)) + 0.2, space)


@pytest.mark.parametrize(
    "size",
    [
        (2.0, 2.0),  # twice the reach: everybody within sight of his own image, almost
        (2.0, 30.0),
        (2.0001, 9.0),
        (3.0, 3.0),  # three cells are just too narrow
        (3.0031, 3.0031),  # three cells just fit: a row's neighbours are all rows
        (3.01, 40.0),
        (4.01, 4.01),
        (200.0, 3.1),  # elongated: cells in one row, and more cells than agents
        (3.1, 200.0),
        (1e4, 2.5),
    ],
)
def test_awkward_toruses(size: Any) -> None:
    assert_as_expected(rules(1.0, fov=200), uniform(300, size), Torus(size=size))


@pytest.mark.parametrize("size", [(2.0, 2.0, 2.0), (3.0031, 3.0031, 3.0031), (4.01, 3.01, 30.0), (60.0, 3.1, 3.1)])
def test_awkward_toruses_in_space(size: Any) -> None:
    assert_as_expected(rules(1.0, fov=200), uniform(300, size), Torus(size=size))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("size", [(1e3, 1e-3, 1e-3), (1e-3, 1e4, 1e-3), (1e6, 1e6, 1.0), (50.0, 50.0, 50.0), (1, 1, 1)])
def test_a_query_writes_into_its_own_arrays_only(size: Any, dimension: int) -> None:
    """With guards behind every array: more cells than there is room for would show there."""
    n, guard = 200, 100_000
    x = np.ascontiguousarray(uniform(n, size[:dimension]).T)
    arrays = {"order": n, "cell": 2 * n, "start": n + 2, "shape": 3}
    whole = {name: np.full(length + guard, -7) for name, length in arrays.items()}
    views = [whole[name][:length] for name, length in arrays.items()]
    box = tuple(float(s) for s in size[:dimension])
    for periodic in (False, True):
        assert entry(sort_agents)(x, np.ones(n, bool), 0.4, box, periodic, *views) == n
        assert sorted(views[0]) == list(range(n))
        for name, length in arrays.items():
            assert (whole[name][length:] == -7).all(), f"{name} is too short for {views[3]} cells"


@pytest.mark.parametrize(
    "size",
    [
        (1000.0, 1e-3),  # a queue of people: many times more cells than agents, all in one row
        (1e-3, 1000.0),
        (1000.0, 0.0),
        (1e6, 1.0),
        (30.0, 2.0),
        (1e-9, 1e-9),
    ],
)
def test_elongated_crowds(size: Any) -> None:
    assert_as_expected((rules(1.0)[0],), uniform(300, size), None)


@pytest.mark.parametrize("size", [(1000.0, 1e-3, 1e-3), (1e-3, 300.0, 300.0), (1e-3, 1e-3, 1e5)])
def test_elongated_crowds_in_space(size: Any) -> None:
    assert_as_expected((rules(1.0)[0],), uniform(300, size), None)


def test_a_lone_runaway_does_not_spoil_the_grid() -> None:
    x = uniform(500, (10.0, 10.0))
    x[7] = 1e12, -1e12
    assert_as_expected((rules(1.0)[0],), x, None)


def on_edges(space: Torus, reach: float) -> Array:
    """Agents on every corner of the cells, and one ulp to either side."""
    axes = []
    for length in space.size:
        edges = np.arange(int(length / (reach * 1.001))) * (length / int(length / (reach * 1.001)))
        edges = np.concatenate([edges, np.nextafter(edges, 1e9), np.nextafter(edges, -1e9)])
        axes.append(edges[(edges >= 0) & (edges < length)])
    corners = np.stack([g.ravel() for g in np.meshgrid(*axes)], axis=1)
    return np.concatenate([corners, [np.nextafter(space.size, 0)]])


@pytest.mark.parametrize("size", [(5.005, 6.0), (8.009, 9.0), (3.1, 20.0)])
def test_agents_on_the_edges_of_cells(size: Any) -> None:
    """numerics.md, P34. They are ulps apart: cohesion and alignment, because pushes of 1e15 N would hide the others."""
    space = Torus(size=size)
    x = on_edges(space, 1.0)
    assert len(x) > 96
    _, alignment, cohesion = rules(1.0, fov=360)
    assert_as_expected((alignment, cohesion), x, space)


def test_exactly_at_the_radius_is_outside() -> None:
    scene = scene_with((rules(1.0)[0],), None, 2, 2)
    for distance, push in ((1.0, 0.0), (np.nextafter(1.0, 0.0), -1.3)):
        found = forces(scene, placed(scene, np.array([[0.0, 0.0], [distance, 0.0]]), np.zeros((2, 2))))
        np.testing.assert_allclose(found, [[push, 0], [-push, 0]])


@pytest.mark.parametrize("count", [50, 200])
def test_everybody_in_one_place(count: int) -> None:
    """Two velocities, one place: everybody's neighbours are all the others."""
    x, v = np.full((count, 2), 4.0), np.zeros((count, 2))
    v[: count // 2, 0] = 1.0
    scene = scene_with((rules(1.0, fov=360)[1],), None, 2, count)
    found = forces(scene, placed(scene, x, v))
    mean = (v.sum(axis=0) - v) / (count - 1)
    np.testing.assert_allclose(found, 0.7 * (mean - v), atol=1e-12)


@pytest.mark.parametrize("count", [60, 600])
def test_the_dead_are_no_neighbours(count: int) -> None:
    x, v = uniform(count, (9.0, 9.0)), np.zeros((count, 2))
    living = np.random.default_rng(3).random(count) < 0.6
    scene = scene_with((rules(1.0)[0],), None, 2, count)
    state = placed(scene, x, v)
    state.alive[0] = living
    found = forces(scene, state)
    np.testing.assert_allclose(found[living], expected(rules(1.0)[0], x[living], v[living], scene.space), rtol=1e-9)
    np.testing.assert_array_equal(found[~living], 0)


@pytest.mark.parametrize("living", [0, 1, 2])
def test_almost_nobody_left(living: int) -> None:
    scene = scene_with((rules(1.0)[0],), None, 2, 120)
    state = placed(scene, uniform(120, (0.5, 0.5)), np.zeros((120, 2)))
    state.alive[0, living:] = False
    found = forces(scene, state)
    assert np.isfinite(found).all()
    assert (np.abs(found).max(axis=1) > 0).sum() == (2 if living == 2 else 0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_grid_finds_what_brute_force_finds(dimension: int) -> None:
    """A rule without weight that looks far makes the query too wide for a grid: the same forces, every pair met."""
    size = (8.0, 9.0, 10.0)[:dimension]
    x, v = uniform(1000, size), np.zeros((1000, dimension))
    found, met = [], []
    for far in (1e-3, 4.0):
        separation, alignment = Separation(weight=1, radius=1), Alignment(weight=1, radius=1)
        effects = (separation, alignment, Cohesion(weight=0, radius=far))
        scene = scene_with(effects, Torus(size=size), dimension, 1000)
        state = placed(scene, x, v)
        found.append(forces(scene, state))
        met.append(scene.step(state).counted("pairs"))
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)
    assert met[1] == 1000**2
    assert met[0] < met[1] / (4 if dimension == 2 else 8)


def test_worlds_of_a_batch_are_searched_apart() -> None:
    scene = scene_with((rules(1.0)[0],), None, 2, 200)
    state = scene.start(0, worlds=3)
    state.pos[...] = uniform(600, (20.0, 20.0)).reshape(3, 200, 2)
    after = scene.step(state)
    for b in range(3):
        alone = state.worlds([b])
        np.testing.assert_array_equal(scene.step(alone).vel[0], after.vel[b])
