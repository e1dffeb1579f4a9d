"""Neighbours: the sums over sorted cells equal those of an independent search, scipy's k-d tree."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.geometry.cell_list import count_cells, order_records
from flockenv.geometry.space import Box, Space, Torus
from flockenv.geometry.spatial_sort import TILE, count_tiles
from flockenv.jit.section import entry
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.scene import Group, Scene
from tests.catalogue import NEAREST, NEAREST_MANY, VARIANTS, Array, Variant, everything, scene_of

DT = 2.0**-10
"""s: one short step, whose change of velocity is the acceleration; a power of two divides exactly."""


# --- the reference ----------------------------------------------------------------------------------------------------


def pairs(x: Array, radius: float, space: Space) -> tuple[Array, Array, Array]:
    """Return i, j and the offset from i to j, for all ordered pairs nearer than the radius.

    Operations and precision are those of the library, so that exactly equal distances are equal here also.
    """
    box = np.asarray(space.size, x.dtype) if isinstance(space, Torus) else None
    tree = cKDTree(np.asarray(x, float), boxsize=box)
    found = tree.query_pairs(radius * (1 + 1e-6), output_type="ndarray")
    i, j = np.concatenate([found, found[:, ::-1]]).T
    offset = x[j] - x[i]
    if box is not None:
        offset -= box * np.rint(offset / box)
    near = (offset**2).sum(axis=1) < radius**2
    return i[near], j[near], offset[near]


def nearest_few(i: Array, square: Array, count: int) -> Array:
    """Return which pairs (i, .) are among the `count` nearest of their i; ties with the last are included."""
    order = np.lexsort((square, i))
    agents, first, how_many = np.unique(i[order], return_index=True, return_counts=True)
    farthest = np.zeros(i.max() + 1, square.dtype)
    farthest[agents] = square[order][first + np.minimum(how_many, count) - 1]
    return square <= farthest[i]


def in_sight(effect: Any, x: Array, v: Array, space: Space) -> tuple[Array, Array, Array]:
    """Return i, j and offsets of the pairs that an effect sums over: within radius, field of view and nearest few."""
    i, j, offset = pairs(x, effect.radius, space)
    if effect.fov < 360:
        speed = np.linalg.norm(v, axis=1)
        ahead = (offset * v[i]).sum(axis=1)
        limit = math.cos(math.radians(effect.fov / 2)) * np.linalg.norm(offset, axis=1) * speed[i]
        seen = (ahead >= limit) | (speed[i] == 0)
        i, j, offset = i[seen], j[seen], offset[seen]
    if effect.nearest and len(i):
        few = nearest_few(i, (offset**2).sum(axis=1), effect.nearest)
        i, j, offset = i[few], j[few], offset[few]
    return i, j, offset


def total(values: Array, i: Array, count: int) -> Array:
    return np.stack([np.bincount(i, values[:, k], count) for k in range(values.shape[1])], axis=1)


def expected(effect: Any, x: Array, v: Array, space: Space) -> Array:
    """Return the forces (N, D) of one of the three rules, from their formulas."""
    n = len(x)
    if effect.weight == 0:
        return np.zeros_like(x)
    i, j, offset = in_sight(effect, x, v, space)
    count = np.maximum(np.bincount(i, minlength=n), 1)[:, None]
    if isinstance(effect, Separation):
        return -effect.weight * total(offset / (offset**2).sum(axis=1, keepdims=True), i, n)
    if isinstance(effect, Cohesion):
        return effect.weight * total(offset, i, n) / count
    some = np.bincount(i, minlength=n)[:, None] > 0
    return effect.weight * np.where(some, total(v[j], i, n) / count - v, 0)


# --- all neighbours within a radius -----------------------------------------------------------------------------------


def rules(radius: float, fov: float = 270, chosen: int = -1) -> tuple[Separation, Alignment, Cohesion]:
    """Return the three rules, each with its own field of view; if one is chosen, the weights of the others are 0."""
    weights = [1.0 if chosen in (-1, k) else 0.0 for k in range(3)]
    return (
        Separation(weight=1.3 * weights[0], radius=radius),
        Alignment(weight=0.7 * weights[1], radius=radius, fov=fov),
        Cohesion(weight=0.9 * weights[2], radius=radius, fov=fov - 30),
    )


def scene_with(effects: Any, space: Space | None, dimension: int, count: int) -> Scene:
    """Return a scene with only these rules in a plane; on a torus, with the kernel that other tests share."""
    groups = (Group(count=count, spawn=Spawn(low=(0,) * dimension, high=(1,) * dimension)),)
    given = {"groups": groups, "obstacles": (), "dt": DT}
    if isinstance(space, Torus):
        return everything(dimension, *effects, space=space, **given)
    return scene_of(*effects, dimension=dimension, space=space, **given)


def placed(scene: Scene, x: Array, v: Array) -> State:
    state = scene.start(0)
    return state.with_motion(x[None], v[None])


def forces(scene: Scene, state: State) -> Array:
    return (scene.step(state).vel - state.vel)[0] / DT


def assert_as_expected(effects: Any, x: Array, space: Space | None, wrapped: bool = False) -> State:
    """Compare all forces of all agents with the reference; return the state after the step, for its counters.

    wrapped: some agents are outside of the periodic box, so the reference is given their images inside.
    """
    count, dimension = x.shape
    v = np.random.default_rng(1).normal(size=x.shape)
    scene = scene_with(effects, space, dimension, count)
    state = placed(scene, x, v)
    found = forces(scene, state)
    where = scene.space.wrap(x) if wrapped else x
    exact = sum(expected(effect, where, v, scene.space) for effect in effects)
    scale = max(1.0, np.abs(exact).max())
    np.testing.assert_allclose(found, exact, atol=1e-9 * scale, rtol=1e-9)
    return scene.step(state)


def uniform(count: int, size: Any, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random((count, len(size))) * size


@pytest.mark.parametrize("alone", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rule", [0, 1, 2])
@pytest.mark.parametrize("count", [50, 95, 96, 400, 3000])
def test_in_a_plane_every_rule_acts_on_exactly_its_neighbours(rule: int, count: int, alone: bool) -> None:
    """In its own kernel (alone), or beside two rules of weight 0."""
    edge = math.sqrt(count / 4)
    effects = (rules(1.0)[rule],) if alone else rules(1.0, chosen=rule)
    after = assert_as_expected(effects, uniform(count, (edge, edge)) - 3.0, None)
    tested = after.count_of("pairs") / count**2
    assert tested == 1 if count < 96 else tested < {96: 1.01, 400: 0.5, 3000: 0.06}[count]  # a grid was used


@pytest.mark.slow
@pytest.mark.parametrize("rule", [0, 1, 2])
def test_in_three_dimensions_every_rule_acts_on_exactly_its_neighbours(rule: int) -> None:
    after = assert_as_expected((rules(1.0)[rule],), uniform(3000, (9.0, 9.0, 9.0)) - 3.0, None)
    assert after.count_of("pairs") < 0.2 * 3000**2


@pytest.mark.parametrize("count", [50, 400, 3000])
@pytest.mark.parametrize("dimension", [2, 3])
def test_on_a_torus_all_rules_share_one_neighbour_query(count: int, dimension: int) -> None:
    edge = (count / 4) ** (1 / dimension)
    size = np.array([1.0, 1.3, 0.9])[:dimension] * max(edge, 2.5)
    after = assert_as_expected(rules(1.0), uniform(count, size), Torus(size=tuple(size)))
    assert after.count_of("neighbour_queries") == 1


MIXED = (
    Separation(weight=1, radius=0.4),
    Alignment(weight=1, radius=1.7, fov=120),
    Cohesion(weight=1, radius=1.1, fov=300),
)
"""Three rules with different radii and fields of view."""


def test_rules_of_different_radii_share_the_widest_query() -> None:
    space = Torus(size=(14.0, 11.0))
    after = assert_as_expected(MIXED, uniform(700, space.size), space)
    assert after.count_of("neighbour_queries") == 1
    _, widest, _ = MIXED
    narrow = [effect.model_copy(update={"radius": 1e-3}) for effect in MIXED]
    alone = assert_as_expected((narrow[0], widest, narrow[2]), uniform(700, space.size), space)
    assert alone.count_of("pairs") == after.count_of("pairs")  # a smaller radius adds nothing to the query


@pytest.mark.slow
@pytest.mark.parametrize("count", [50, pytest.param(700, marks=pytest.mark.slow)])
def test_effects_of_weight_zero_change_no_bits_and_no_counters(count: int) -> None:
    space = Torus(size=(14.0, 11.0))
    among = scene_with(MIXED, space, 2, count)
    alone = among.with_effects(*MIXED)
    assert len(among.effects) > len(MIXED)
    start = placed(among, uniform(count, space.size), np.random.default_rng(1).normal(size=(count, 2)))
    ends = [scene.run(start, 10) for scene in (among, alone)]
    np.testing.assert_array_equal(ends[0].x, ends[1].x)
    np.testing.assert_array_equal(ends[0].v, ends[1].v)
    np.testing.assert_array_equal(ends[0].work, ends[1].work)
    listed = scene_of(*MIXED, space=space, obstacles=({"centre": (7, 5), "radius": 1},), groups=alone.groups, dt=DT)
    under = listed.run(listed.start(0), 3)
    assert under.count_of("obstacle_tests") == 0  # no effect of this scene needs the obstacle


def test_in_a_box_separation_acts_on_exactly_its_neighbours() -> None:
    space = Box(size=(20.0, 8.0))
    assert_as_expected((rules(1.0)[0],), uniform(800, (19.6, 7.6)) + 0.2, space)


@pytest.mark.parametrize(
    "size",
    [
        (2.0, 2.0),  # twice the reach: an agent almost reaches its own image
        (2.0, 30.0),
        (2.0001, 9.0),
        (3.0, 3.0),  # three cells are just too narrow
        (3.0031, 3.0031),  # three cells just fit: every row is a neighbour of every other
        (3.01, 40.0),
        (4.01, 4.01),
        (200.0, 3.1),  # elongated: cells in one row, and more cells than agents
        (3.1, 200.0),
        (1e4, 2.5),
    ],
)
def test_forces_are_right_on_awkward_toruses(size: Any) -> None:
    assert_as_expected(rules(1.0, fov=200), uniform(300, size), Torus(size=size))


@pytest.mark.slow
@pytest.mark.parametrize("size", [(2.0, 2.0, 2.0), (3.0031, 3.0031, 3.0031), (4.01, 3.01, 30.0), (60.0, 3.1, 3.1)])
def test_forces_are_right_on_awkward_toruses_in_three_dimensions(size: Any) -> None:
    assert_as_expected(rules(1.0, fov=200), uniform(300, size), Torus(size=size))


@pytest.mark.parametrize("absent", [0, 60])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("size", [(1e3, 1e-3, 1e-3), (1e-3, 1e4, 1e-3), (1e6, 1e6, 1.0), (50.0, 50.0, 50.0), (1, 1, 1)])
def test_a_query_writes_only_into_its_own_arrays(size: Any, dimension: int, absent: int) -> None:
    """Guards behind every array reveal a grid with more cells than the arrays have room for."""
    n, lanes, guard = 200, 16, 100_000
    blocks = -(-n // lanes)
    pos, living = np.zeros(blocks * lanes * dimension), np.r_[np.ones(n), np.zeros(blocks * lanes - n)]
    living[np.random.default_rng(0).permutation(n)[:absent]] = 0
    x = uniform(n, size[:dimension])
    for i in range(n):
        at = i // lanes * lanes * dimension + i % lanes
        pos[at : at + dimension * lanes : lanes] = x[i]
    lengths = {"cell": blocks * lanes, "start": n + 1, "offset": n}

    def counted(periodic: bool, kernel: Any = count_cells) -> tuple[Any, Array]:
        whole = {name: np.full(length + guard, -7, np.int32) for name, length in lengths.items()}
        cell, start, offset = (whole[name][:length] for name, length in lengths.items())
        box = tuple(float(edge) for edge in size[:dimension])
        shape = entry(kernel)(
            pos, living, 0, blocks, lanes, 0, 1, np.zeros(8, np.int64), np.zeros((1, 6)), box, 0.4, periodic,
            periodic, n, cell, start, offset[None],
        )  # fmt: skip
        for name, length in lengths.items():
            assert (whole[name][length:] == -7).all(), f"{name} is too short for {shape} cells"
        cells = math.prod(shape[:3])
        if cells:
            if kernel is count_tiles:
                cells = int(cell.max()) + 1
            sizes = np.bincount(cell[cell >= 0], minlength=cells)
            np.testing.assert_array_equal(np.diff(start[: cells + 1]), sizes)
            np.testing.assert_array_equal(offset[:cells], start[:cells])
            np.testing.assert_array_equal(cell == -1, living == 0)
            assert start[0] == 0
        return shape, cell

    for periodic in (False, True):
        shape, cell = counted(periodic)
        cells = math.prod(shape[:3])
        assert cells <= n
        again, tile = counted(periodic, count_tiles)
        assert again == shape
        if cells:
            nx, ny, nz, fine, _ = shape
            edge = max(1, int(np.power(TILE * cells / n / fine, 1 / 2 if nz == 1 else 1 / 3) + 0.5))
            along, up = -(-nx // (edge * fine)), -(-ny // edge)
            x, y, z = cell % nx // (edge * fine), cell // nx % ny // edge, cell // nx // ny // edge
            np.testing.assert_array_equal(tile, np.where(cell < 0, -1, (z * up + y) * along + x))


@pytest.mark.slow
@pytest.mark.parametrize(
    "size",
    [
        (1000.0, 1e-3),  # a queue: many more cells than agents, all in one row
        (1e-3, 1000.0),
        (1000.0, 0.0),
        (1e6, 1.0),
        (30.0, 2.0),
        (1e-9, 1e-9),
    ],
)
def test_forces_are_right_in_elongated_crowds(size: Any) -> None:
    assert_as_expected((rules(1.0)[0],), uniform(300, size), None)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1000.0, 1e-3, 1e-3), (1e-3, 300.0, 300.0), (1e-3, 1e-3, 1e5)])
def test_forces_are_right_in_elongated_crowds_in_three_dimensions(size: Any) -> None:
    assert_as_expected((rules(1.0)[0],), uniform(300, size), None)


@pytest.mark.parametrize("far", [1e3, 1e5, 1e9, 1e100])
@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_one_agent_very_far_away_changes_no_other_force_and_adds_few_candidates(dimension: int, far: float) -> None:
    x = uniform(3000, (26.0, 26.0) if dimension == 2 else (9.0, 9.0, 9.0))
    among = assert_as_expected((rules(1.0)[0],), x, None).count_of("pairs")
    x[7] = (far, -far, far)[:dimension]
    assert assert_as_expected((rules(1.0)[0],), x, None).count_of("pairs") < 1.5 * among


def on_edges(space: Torus, reach: float) -> Array:
    """Return agents on every corner of the cells, and one ulp to either side."""
    axes = []
    for length in space.size:
        edges = np.arange(int(length / (reach * 1.001))) * (length / int(length / (reach * 1.001)))
        after = np.maximum(np.nextafter(edges, 1e9), 1e-16)  # the float after 0 has the square 0
        edges = np.concatenate([edges, after, np.nextafter(edges, -1e9)])
        axes.append(edges[(edges >= 0) & (edges < length)])
    corners = np.stack([g.ravel() for g in np.meshgrid(*axes)], axis=1)
    return np.concatenate([corners, [np.nextafter(space.size, 0)]])


@pytest.mark.parametrize("size", [(5.005, 6.0), (8.009, 9.0), (3.1, 20.0)])
def test_forces_are_right_for_agents_on_the_edges_of_cells(size: Any) -> None:
    """The agents are ulps apart, so separation has weight 0: forces of 1e15 N would hide the others."""
    space = Torus(size=size)
    x = on_edges(space, 1.0)
    assert len(x) > 96
    _, alignment, cohesion = rules(1.0, fov=359)
    assert_as_expected((Separation(weight=0, radius=1e-3), alignment, cohesion), x, space)


@pytest.mark.parametrize("nudge", [-1e-17, 0.0, 5e-324, 1e-17])
@pytest.mark.parametrize("axis", [0, 1])
def test_forces_are_right_for_agents_just_beyond_the_edge_of_the_box(nudge: float, axis: int) -> None:
    """-1e-17 must be wrapped to 0: in the last cell the agent would miss its neighbours across the edge."""
    space = Torus(size=(10.0, 10.0))
    x = uniform(1500, space.size)
    x[:15, axis], x[15:30, axis] = nudge, 10.0 + nudge
    after = assert_as_expected(rules(1.0), x, space, wrapped=True)
    assert after.count_of("pairs") < 0.5 * 1500**2


def test_a_neighbour_exactly_at_the_radius_is_out_of_range() -> None:
    scene = scene_with((rules(1.0)[0],), None, 2, 2)
    for distance, push in ((1.0, 0.0), (np.nextafter(1.0, 0.0), -1.3)):
        found = forces(scene, placed(scene, np.array([[0.0, 0.0], [distance, 0.0]]), np.zeros((2, 2))))
        np.testing.assert_allclose(found, [[push, 0], [-push, 0]])


@pytest.mark.slow
@pytest.mark.parametrize("count", [50, 200])
def test_alignment_if_all_agents_are_in_one_place(count: int) -> None:
    """Every agent has all others as neighbours, and they have two different velocities."""
    x, v = np.full((count, 2), 4.0), np.zeros((count, 2))
    v[: count // 2, 0] = 1.0
    scene = scene_with((rules(1.0)[1],), None, 2, count)  # an agent in the same place is always in view
    found = forces(scene, placed(scene, x, v))
    mean = (v.sum(axis=0) - v) / (count - 1)
    np.testing.assert_allclose(found, 0.7 * (mean - v), atol=1e-12)


@pytest.mark.parametrize("count", [60, 600])
def test_dead_agents_are_no_neighbours(count: int) -> None:
    x, v = uniform(count, (9.0, 9.0)), np.zeros((count, 2))
    living = np.random.default_rng(3).random(count) < 0.6
    scene = scene_with((rules(1.0)[0],), None, 2, count)
    state = placed(scene, x, v)
    state.alive[0] = living
    found = forces(scene, state)
    np.testing.assert_allclose(found[living], expected(rules(1.0)[0], x[living], v[living], scene.space), rtol=1e-9)
    np.testing.assert_array_equal(found[~living], 0)


@pytest.mark.parametrize("living", [0, 1, 2])
def test_forces_are_finite_if_at_most_two_agents_are_alive(living: int) -> None:
    scene = scene_with((rules(1.0)[0],), None, 2, 120)
    state = placed(scene, uniform(120, (0.5, 0.5)), np.zeros((120, 2)))
    state.alive[0, living:] = False
    found = forces(scene, state)
    assert np.isfinite(found).all()
    assert (np.abs(found).max(axis=1) > 0).sum() == (2 if living == 2 else 0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_grid_finds_what_brute_force_finds(dimension: int) -> None:
    """A rule of weight 0 with a large radius makes the query too wide for a grid; the forces must not change."""
    size = (8.0, 9.0, 10.0)[:dimension]
    x, v = uniform(1000, size), np.zeros((1000, dimension))
    found, tested = [], []
    for far in (1e-3, 4.0):
        separation, alignment = Separation(weight=1, radius=1), Alignment(weight=1, radius=1, fov=270)
        effects = (separation, alignment, Cohesion(weight=0, radius=far, fov=240))
        scene = scene_with(effects, Torus(size=size), dimension, 1000)
        state = placed(scene, x, v)
        found.append(forces(scene, state))
        tested.append(scene.step(state).count_of("pairs"))
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)
    assert tested[1] == 1000**2
    assert tested[0] < tested[1] / (4 if dimension == 2 else 8)


def test_agents_of_other_worlds_in_a_batch_are_no_neighbours() -> None:
    scene = scene_with((rules(1.0)[0],), None, 2, 200)
    state = scene.start(0, worlds=3)
    state.pos[...] = uniform(600, (20.0, 20.0)).reshape(3, 200, 2)
    after = scene.step(state)
    for b in range(3):
        alone = state.worlds([b])
        np.testing.assert_array_equal(scene.step(alone).vel[0], after.vel[b])


# --- the nearest few --------------------------------------------------------------------------------------------------

FEW = pytest.mark.parametrize(
    "variant", [*NEAREST, pytest.param(NEAREST_MANY, marks=pytest.mark.slow)], ids=lambda variant: variant.name
)


ONE_LONG_STEP = pytest.mark.filterwarnings("ignore::flockenv.core.warnings.UnstableStepWarning")
"""One step of 1 s shows the acceleration; its result is not used further."""


def one_at_a_time(variant: Variant, count: int, edge: float) -> list[tuple[Any, Scene]]:
    """Return every rule of a variant with a scene in which the others have weight 0; one step of 1 s, no limits.

    One step of any first-order method changes a velocity by dt times the acceleration at the start.
    """
    scenes = []
    for rule in variant.effects:
        effects = [e if e == rule else e.model_copy(update={"weight": 0}) for e in variant.effects]
        spawn = Spawn(low=(0,) * variant.dimension, high=(edge,) * variant.dimension)
        groups = (Group(count=count, spawn=spawn),)
        scenes.append((rule, variant.make(count, edge, groups=groups, dt=1.0).with_effects(*effects)))
    return scenes


def doubtful(rule: Any, x: Array, v: Array, space: Space, hair: float) -> Array:
    """Return which agents (N,) have a neighbour so near the limit of sight that rounding decides whether it is seen."""
    found = []
    for wide in (1 - hair, 1 + hair):
        changed = rule.model_copy(update={"radius": rule.radius * wide, "fov": min(rule.fov * wide, 360.0)})
        found.append(in_sight(changed, x, v, space))
    counts = [np.bincount(i, minlength=len(x)) for i, _, _ in found]
    return np.asarray(counts[0] != counts[1])


def assert_few_as_expected(variant: Variant, x: Array, edge: float, hair: float = 1e-6) -> State:
    """Compare every rule of a variant by itself with the reference; return the state after the last step."""
    v = np.random.default_rng(1).normal(size=x.shape).astype(variant.dtype)
    x = x.astype(variant.dtype)
    for rule, scene in one_at_a_time(variant, len(x), edge):
        state = placed(scene, x, v)
        after = scene.step(state)
        exact = expected(rule, x, v, scene.space)
        sure = ~doubtful(rule, x, v, scene.space, hair)
        assert sure.mean() > 0.98
        error = np.abs((after.vel - state.vel)[0] - exact)[sure].max(initial=0.0)
        terms = np.abs(exact).max() + np.abs(v).max()
        assert error <= 200 * np.finfo(variant.dtype).eps * terms, f"{rule.kind}: {error}"
    assert after.count_of("neighbour_queries") == 1
    return after


@pytest.mark.slow
@ONE_LONG_STEP
@pytest.mark.parametrize(
    ("variant", "count"),
    [
        *itertools.product(NEAREST, [1, 2, 5, 40, 95, 96, 1500]),
        pytest.param(NEAREST_MANY, 1500, marks=pytest.mark.slow),  # fewer would compile one more kernel without cells
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_the_nearest_few_are_those_of_the_reference(variant: Variant, count: int) -> None:
    """From fewer agents than the nearest few to far more, by brute force and by cell list."""
    edge = max(7.0, (count / 1.5) ** 0.5) if variant.dimension == 2 else max(7.0, (count / 0.3) ** (1 / 3))
    x = uniform(count, (edge,) * variant.dimension) * 0.999
    after = assert_few_as_expected(variant, x, edge)
    if count == 1500:
        assert after.count_of("pairs") < 0.8 * count**2


@pytest.mark.slow
@ONE_LONG_STEP
@FEW
@pytest.mark.parametrize("share", [0.4, 1.0])
def test_neighbours_exactly_as_far_as_the_last_are_included(variant: Variant, share: float) -> None:
    """On a grid of points, complete or with holes, all distances are exact and most of them tie."""
    side = 16 if variant.dimension == 2 else 8
    points = np.stack(np.meshgrid(*[np.arange(side)] * variant.dimension, indexing="ij"), axis=-1)
    x = points.reshape(-1, variant.dimension) + 0.25
    x = x[np.random.default_rng(4).random(len(x)) < share]
    tied = 0
    for rule in variant.effects:
        if rule.nearest:
            i, _, _ = in_sight(rule, x, np.zeros_like(x), variant.make(1, float(side)).space)
            tied += int((np.bincount(i) > rule.nearest).sum())
    assert tied > 40
    assert_few_as_expected(variant, x, float(side), hair=0.0)


@ONE_LONG_STEP
@FEW
def test_the_nearest_few_are_found_among_the_living(variant: Variant) -> None:
    living = np.random.default_rng(3).random(500) < 0.6
    edge = 18.0 if variant.dimension == 2 else 9.0
    x = (uniform(500, (edge,) * variant.dimension) * 0.999).astype(variant.dtype)
    v = np.zeros_like(x)
    for rule, scene in one_at_a_time(variant, 500, edge):
        state = placed(scene, x, v)
        state.alive[0] = living
        found = scene.step(state).vel[0]
        exact = expected(rule, x[living], v[living], scene.space)
        assert np.abs(found[living] - exact).max() <= 200 * np.finfo(variant.dtype).eps * np.abs(exact).max()
        np.testing.assert_array_equal(found[~living], 0)


@pytest.mark.parametrize("nearest", [0, 33, -1, 2.5, True, "6"])
def test_an_invalid_number_of_nearest_neighbours_is_refused(nearest: Any) -> None:
    with pytest.raises(ValueError, match="nearest") as caught:
        Cohesion(weight=1, radius=1, nearest=nearest)
    assert "\n" not in str(caught.value)


# --- in single precision ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [60, 1500])
@pytest.mark.parametrize("name", ["torus_single", "plane_3_single"])
@pytest.mark.parametrize("rule", [0, 1, 2])
def test_in_single_precision_every_rule_acts_on_exactly_its_neighbours(name: str, rule: int, count: int) -> None:
    variant = next(v for v in VARIANTS if v.name == name)
    d, eps = variant.dimension, np.finfo(np.float32).eps
    edge = max(7.0, (count / 2) ** (1 / d))
    chosen = rules(1.0, chosen=rule)
    x = (uniform(count, (edge,) * d) * 0.999).astype(np.float32)
    v = np.random.default_rng(1).normal(size=x.shape).astype(np.float32)
    space = variant.make(1, edge).space
    groups = (Group(count=count, spawn=Spawn(low=(0,) * d, high=(1,) * d)),)
    scene = everything(d, *chosen, space=space, groups=groups, obstacles=(), dt=1.0, dtype="float32")
    state = placed(scene, x, v)
    after = scene.step(state)
    assert after.count_of("pairs") == count**2 if count < 96 else after.count_of("pairs") < 0.8 * count**2
    exact = expected(chosen[rule], x.astype(float), v.astype(float), space)
    sure = ~doubtful(chosen[rule], x.astype(float), v.astype(float), space, 1e-6)
    assert sure.mean() > 0.98
    # each term of the sum is right to some bits; a neighbour at 1 mm contributes 1000 N, whose last bits are coarse
    assert np.abs((after.vel - state.vel)[0] - exact)[sure].max() <= 50 * eps * max(
        np.abs(exact).max(), np.abs(v).max()
    )


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 1.0])  # of agents that are out of order
@pytest.mark.parametrize("cells", [1, 30, 200, 1000])
def test_records_are_ordered_by_agent_number_within_each_cell(cells: int, share: float, dtype: str) -> None:
    rng, length, count = np.random.default_rng(cells), 4, 400
    cell, ident = np.sort(rng.integers(0, cells, count)), rng.permutation(count).astype(dtype)
    place = rng.permutation(count)
    place = place[np.lexsort((ident[place], cell))]
    for k in rng.permutation(count)[: int(share * count)]:  # swaps places with another agent of its cell
        other = rng.choice(np.flatnonzero(cell == cell[k]))
        place[[k, other]] = place[[other, k]]
    records = np.column_stack([place, place + 0.5, place + 0.25, -place]).astype(dtype)
    by_place = np.empty(count, np.int32)
    by_place[place] = cell
    first, end = 37, 333
    expected = records.copy()
    turn = np.lexsort((ident[place[first:end]], cell[first:end]))
    expected[first:end] = records[first:end][turn]
    flat, late = records.reshape(-1).copy(), np.full(end - first, -7, np.int32)  # one more than can be out of order
    order = entry(order_records)
    order(flat, by_place, ident, length, first, first, late)  # no agents: nothing changes
    np.testing.assert_array_equal(flat, records.reshape(-1))
    order(flat, by_place, ident, length, first, end, late)
    np.testing.assert_array_equal(flat.reshape(count, length), expected)
    assert late[-1] == -7


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("fov", [60, 180, 270, 350])
def test_the_edge_of_a_field_of_view_belongs_to_it_in_every_direction(fov: float, dtype: str) -> None:
    """In both precisions; neighbours slightly outside are not seen."""
    scene = scene_with((Alignment(weight=1, radius=3, fov=fov),), None, 2, 2).model_copy(update={"dtype": dtype})
    start, seen = scene.start(0), []
    for course in np.linspace(0, 2 * np.pi, 61):
        for off in (0.0, -1e-4, 1e-4):  # rad, outwards
            side = course + math.radians(fov / 2) + off
            x, v = np.zeros((2, 2)), np.array([[np.cos(course), np.sin(course)], [0.0, 0.0]])
            x[1] = 2 * np.cos(side), 2 * np.sin(side)
            moved = scene.step(start.with_motion(x[None], v[None])).vel[0, 0]
            seen.append(bool(np.linalg.norm(moved - v[0].astype(dtype)) > 1e-2 * DT))
    assert seen == [True, True, False] * 61
