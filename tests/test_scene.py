"""Scene: starts, steps, refused input, memory, threads, and an effect from a user's module."""

from __future__ import annotations

import gc
import pickle
import subprocess
import sys
import tracemalloc
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flockenv
from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.engine import TABLES, scratch_of
from flockenv.engine.workspace import Workspace
from flockenv.geometry.cell_list import FEWEST_AGENTS
from flockenv.geometry.shapes import Block, Circle
from flockenv.geometry.space import Box, Plane, Space, Torus
from flockenv.jit.cache_folder import cache_folder
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import EFFECTS, Drag, Gravity, QuadraticDrag
from flockenv.physics.integrators import RK4, AdaptiveRK4, SemiImplicitEuler
from flockenv.scene import Group, Scene
from tests.catalogue import INTEGRATORS, TETHER, VARIANTS, Array, Variant, everything, scene_of, users_module

SPAWN = Spawn(low=(0, 0), high=(10, 10))
ARRAYS = ("x", "v", "alive", "tick", "key", "obstacle_x", "obstacle_radius", "work")


def crowd(count: int = 150, **fields: Any) -> Scene:
    """Return a scene with every effect, and with enough agents and space for a grid."""
    group = Group(count=count, max_speed=3, max_force=8, spawn=Spawn(speed=(0.5, 2)))
    return everything(2, groups=(group,), space=Torus(size=(24, 20)), **fields)


def assert_same(a: State, b: State) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


# --- starts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_start_of_a_world_does_not_depend_on_the_batch(dimension: int) -> None:
    scene = everything(dimension)
    batch = scene.start(40, worlds=6)
    for k in range(6):
        assert_same(scene.start(40 + k), batch.worlds([k]))
    assert_same(scene.start(43, worlds=3), batch.worlds([3, 4, 5]))
    assert len({batch.x[:, k].tobytes() for k in range(6)}) == 6


@pytest.mark.parametrize("dimension", [2, 3])
def test_agents_start_uniformly_with_the_given_speeds_and_headings(dimension: int) -> None:
    low, high = (1.0, 2.0, 3.0)[:dimension], (4.0, 6.0, 8.0)[:dimension]
    spawn = Spawn(low=low, high=high, speed=(0.5, 1.5))
    led = Spawn(low=low, high=high, speed=(2, 2), heading=(3, 4, 0)[:dimension])
    scene = scene_of(dimension=dimension, groups=(Group(count=4000, spawn=spawn), Group(count=50, spawn=led)))
    state = scene.start(1)
    assert (state.pos >= low).all()
    assert (state.pos < high).all()
    assert np.abs(state.pos[0].mean(axis=0) - (np.array(low) + high) / 2).max() < 0.15
    speed = np.linalg.norm(state.vel[0], axis=1)
    assert 0.5 <= speed[:4000].min() < 0.52
    assert 1.48 < speed[:4000].max() <= 1.5
    assert np.abs(state.vel[0, :4000].mean(axis=0)).max() < 0.05  # no preferred direction
    np.testing.assert_allclose(state.vel[0, 4000:], np.tile((1.2, 1.6, 0)[:dimension], (50, 1)))


@pytest.mark.parametrize("space", [Plane(), Torus(size=(10, 10))])
def test_no_agent_starts_in_an_obstacle(space: Space) -> None:
    """Obstacles also reach across the seam of a torus."""
    obstacles = (Circle(centre=(0.5, 3), radius=2), Circle(centre=(7, 7), radius=1.5))
    scene = scene_of(obstacles=obstacles, space=space, groups=(Group(count=500, radius=0.2, spawn=SPAWN),))
    state = scene.start(0, worlds=3)
    for obstacle in obstacles:
        gap = np.linalg.norm(space.displacement(state.pos, obstacle.centre), axis=2) - obstacle.radius
        assert gap.min() >= 0.2


@pytest.mark.parametrize("dimension", [2, 3])
def test_agents_with_a_spacing_do_not_start_in_each_other_or_in_obstacles(dimension: int) -> None:
    """Cells that an obstacle of any shape reaches into stay empty; worlds differ only by the jitter."""
    obstacles = (Circle(centre=(2,) * dimension, radius=0.8), Block(centre=(0,) * dimension, size=(1,) * dimension))
    spawn = Spawn(low=(0,) * dimension, high=(5,) * dimension, spacing=0.6, jitter=0.1)
    groups = (
        Group(count=40, radius=0.2, spawn=spawn),
        Group(count=1, spawn=Spawn(low=(9,) * dimension, high=(9,) * dimension)),
    )
    scene = scene_of(dimension=dimension, obstacles=obstacles, groups=groups)
    pos = scene.start(0, worlds=3).pos[:, :40]
    for place in pos:
        far = np.linalg.norm(place[:, None] - place, axis=2) + np.eye(40)
        assert 0.4 <= far.min() < 0.5
        assert min(shape.gap(place).min() for shape in obstacles) >= 0.2
    cell = np.floor(pos / 0.6)
    np.testing.assert_array_equal(cell[0], cell[1])
    assert 0.05 < np.abs(pos - 0.6 * (cell + 0.5)).max() <= 0.1
    assert not np.array_equal(pos[0], pos[1])


@pytest.mark.parametrize("edges", [0.6, (0.6, 0.5), (0.3, 0.9)])
def test_bodies_wider_than_their_cells_need_wider_and_stay_near_the_cell_centres(edges: Any) -> None:
    each = (edges, edges) if isinstance(edges, float) else edges
    spawn = Spawn(low=(0, 0), high=(6, 3), spacing=edges, jitter=0.01, wider=True)
    scene = scene_of(groups=(Group(count=20, radius=0.35, spawn=spawn),))
    pos = scene.start(0, worlds=2).pos
    cell = np.floor(pos / each)
    assert len(np.unique(cell[0], axis=0)) == 20
    assert 0.005 < np.abs(pos - (cell + 0.5) * each).max() <= 0.01
    assert not np.array_equal(pos[0], pos[1])
    with pytest.raises(ValueError, match=r"groups\[0\].spawn.spacing = .*radius 0.35 m, up to 0 m from the middle"):
        scene_of(groups=(Group(count=20, radius=0.35, spawn=Spawn(low=(0, 0), high=(6, 3), spacing=edges)),))


# --- steps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(crowd(), id="crowd", marks=pytest.mark.slow),
        pytest.param(scene_of(Drag(rate=0.4), integrator=RK4(), dt=0.02), id="rk4"),
    ],
)
def test_a_run_equals_a_run_split_in_two_and_single_steps(scene: Scene) -> None:
    start = scene.start(1, worlds=2)
    together = scene.run(start, 30)
    split = scene.run(pickle.loads(pickle.dumps(scene.run(start, 11))), 19)
    one_by_one = start
    for _ in range(30):
        one_by_one = scene.step(one_by_one)
    assert_same(together, split)
    assert_same(together, one_by_one)
    assert not np.array_equal(together.x, start.x)


FEW = (Separation(weight=1.3, radius=2.5), Alignment(weight=0.7, radius=3, fov=270), Drag(rate=0.4))
"""A pair law, a view cone and a law of one agent; they compile in a third of the time of every effect."""

QUICK = {"torus", "torus_3", "torus_single", "box"}

ALL = [
    *(v if v.name in QUICK else pytest.param(v, marks=pytest.mark.slow) for v in VARIANTS),
    *(
        pytest.param(
            Variant(
                f"torus_{d}_{dtype}_{row.name}",
                () if row.method == SemiImplicitEuler() else FEW,
                "torus",
                d,
                dtype,
                row.method,
            ),
            marks=pytest.mark.slow,
        )
        for d, dtype in ((2, "float64"), (3, "float32"))
        for row in INTEGRATORS
        if d == 2 or row.method in (SemiImplicitEuler(), RK4())
        if not row.method.solves  # see test_implicit.py
    ),
]
"""Every space, dimension, precision and method; most of them are slow tests."""


def tried(counts: Sequence[int]) -> Any:
    """Parametrize over ALL and these numbers of agents; with enough agents for cells, over three methods only."""
    kinds = (SemiImplicitEuler(), RK4(), AdaptiveRK4())
    rows = [(row if isinstance(row, Variant) else row.values[0], getattr(row, "marks", ())) for row in ALL]
    return pytest.mark.parametrize(
        ("variant", "count"),
        [
            pytest.param(variant, count, marks=marks, id=f"{count}-{variant.name}")
            for count in counts
            for variant, marks in rows
            if count < FEWEST_AGENTS or variant.method in kinds
        ],
    )


def roomy(variant: Variant, count: int) -> Scene:
    """Return a scene with room for a grid."""
    return variant.make(count, 24.0 if variant.dimension == 2 else 18.0)


@tried([1, 7, 16, 17, 32, 95, 96, 97, 300])
def test_a_world_of_a_batch_equals_the_world_alone_to_the_last_bit(variant: Variant, count: int) -> None:
    scene = roomy(variant, count)
    start = scene.start(20, worlds=3)
    start.alive[1, count // 2 :] = False
    batch = scene.run(start, 4)
    assert count < 300 or batch.work[0, 2] < 0.7 * batch.work[0, 1] * count**2  # by sorted cells
    for k in range(3):
        assert_same(scene.run(start.worlds([k]), 4), batch.worlds([k]))


@tried([17, 150])
def test_ten_steps_in_one_call_equal_ten_calls(variant: Variant, count: int) -> None:
    scene = roomy(variant, count)
    start = scene.start(5, worlds=2)
    drive = np.random.default_rng(0).normal(size=start.shape)
    one_by_one = start
    for _ in range(10):
        one_by_one = scene.step(one_by_one, drive=drive)
    assert_same(scene.step(start, drive=drive, steps=10), one_by_one)
    assert not np.array_equal(one_by_one.x, start.x)


def test_reused_scratch_does_not_affect_later_results() -> None:
    """A scene that has just stepped many agents steps two living agents like a new scene."""
    scene, fresh = crowd(), crowd()
    for seed in range(3):
        full = scene.start(seed)
        full.pos[...] *= 0.1
        scene.run(full, 3)
        few = scene.start(9, worlds=2)
        few.alive[0, 2:], few.alive[1, :-2] = False, False
        assert_same(scene.run(few, 5), fresh.run(few, 5))


def test_a_drive_may_be_a_view_of_the_state_it_drives() -> None:
    scene = crowd(100)
    start = scene.start(2, worlds=2)
    expected = scene.step(start, drive=start.vel.copy(), steps=3)
    assert scene.step(start, drive=start.vel, out=start, steps=3) is start
    assert_same(start, expected)


def test_a_step_into_a_given_state_equals_a_step_into_a_new_one() -> None:
    scene = crowd()
    start = scene.start(1, worlds=2)
    kept, fresh = start.copy(), scene.run(start, 5)
    assert_same(start, kept)  # the input is unchanged
    other = scene.start(9, worlds=2)
    assert scene.step(start, out=other, steps=5) is other
    assert_same(other, fresh)
    assert scene.step(start, out=start, steps=5) is start
    assert_same(start, fresh)


def test_zero_steps_leave_a_state_unchanged() -> None:
    scene = crowd()
    start = scene.start(1)
    assert_same(scene.run(start, 0), start)


@pytest.mark.parametrize("steps", [-1, 1.5, True, "3", None])
def test_an_invalid_number_of_steps_is_refused(steps: Any) -> None:
    scene = crowd()
    start = scene.start(1)
    kept = start.copy()
    with pytest.raises((TypeError, ValueError), match="steps is"):
        scene.step(start, out=start, steps=steps)
    assert_same(start, kept)


def test_time_does_not_drift_by_rounding() -> None:
    """A million times 0.1 s is 100000 s, not 100000.00000133."""
    scene = scene_of(dt=0.1, groups=(Group(count=1, spawn=SPAWN),))
    assert scene.run(scene.start(0), 1_000_000).time[0] == 1_000_000 * 0.1


def test_a_drive_is_a_force_and_lasts_for_the_whole_step() -> None:
    scene = scene_of(groups=(Group(count=2, mass=4, spawn=SPAWN),), dt=0.5)
    drive = np.array([[[2.0, 0.0], [0.0, -8.0]]])
    end = scene.step(scene.start(0), drive=drive, steps=4)
    np.testing.assert_allclose(end.vel, drive / 4 * 2, rtol=1e-15)


@pytest.mark.parametrize("far", [0.0, 1e4, 1e7])
def test_motion_does_not_depend_on_the_distance_from_the_origin(far: float) -> None:
    """Relative trajectories agree to 1e-6 in float64."""
    scene = scene_of(Separation(weight=1.3, radius=2.5))
    start = scene.start(2)
    away = start.with_motion(start.pos + far, start.vel)
    np.testing.assert_allclose(scene.run(away, 40).pos - far, scene.run(start, 40).pos, atol=1e-6)


@pytest.mark.slow
def test_single_precision_agrees_with_double_precision() -> None:
    single, double = everything(2, dtype="float32"), everything(2)
    start = single.start(3, worlds=2)
    assert start.x.dtype == start.v.dtype == np.float32
    end, exact = single.run(start, 20), double.run(double.start(3, worlds=2), 20)
    assert end.x.dtype == end.v.dtype == np.float32
    np.testing.assert_allclose(single.space.displacement(end.pos, exact.pos), 0, atol=2e-4)
    np.testing.assert_allclose(end.vel, exact.vel, atol=5e-4)


def test_two_threads_may_step_one_scene() -> None:
    scene = crowd(400)
    starts = [scene.start(seed, worlds=2) for seed in range(6)]
    serial = [scene.run(start, 60) for start in starts]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(lambda start: scene.run(start, 60), starts))
    for a, b in zip(serial, together, strict=True):
        assert_same(a, b)


def test_a_toggled_effect_acts_from_the_next_step_on() -> None:
    scene, bare = scene_of(Drag(rate=0.4)), scene_of()
    start = scene.start(1)
    under_way = scene.run(start, 3)
    assert_same(scene.with_effects().run(under_way, 5), bare.run(under_way, 5))
    assert_same(bare.with_effects(Drag(rate=0.4)).run(under_way, 5), scene.run(under_way, 5))


# --- errors during a run ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_drive_that_is_not_finite_is_refused_with_its_world_and_agent(value: float) -> None:
    scene = crowd(20)
    start = scene.start(0, worlds=2)
    kept, drive = start.copy(), np.zeros(start.shape)
    drive[1, 7, 0] = value
    with pytest.raises(ValueError, match="drive of world 1, agent 7") as caught:
        scene.step(start, drive=drive, out=start)
    assert "\n" not in str(caught.value)
    assert_same(start, kept)


@pytest.mark.parametrize("shape", [(1, 20), (1, 19, 2), (2, 20, 2), (1, 20, 3), (20, 2), ()])
def test_a_drive_of_another_shape_is_refused(shape: Any) -> None:
    scene = crowd(20)
    start = scene.start(0)
    kept = start.copy()
    with pytest.raises(ValueError, match="drive has shape") as caught:
        scene.step(start, drive=np.zeros(shape), out=start)
    assert str(shape) in str(caught.value)
    assert_same(start, kept)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("array", ["x", "v"])
def test_a_diverged_run_raises_an_error_with_world_and_agent(array: str, value: float) -> None:
    scene = scene_of(Drag(rate=0.4))
    start = scene.start(0, worlds=3)
    getattr(start, array)[0, 1, 5] = value
    kept = start.copy()
    with pytest.raises(FloatingPointError, match="world 1, agent 5") as caught:
        scene.step(start)
    assert "\n" not in str(caught.value)
    assert_same(start, kept)


def test_a_step_that_is_far_too_large_raises_an_error_with_effect_and_dt() -> None:
    scene = scene_of(QuadraticDrag(rate=1e6), dt=0.01)
    with pytest.raises(FloatingPointError, match=r"accelerated by quadratic_drag; dt = 0\.01 s"):
        scene.run(scene.start(0), 1000)


@pytest.mark.parametrize("other", [crowd(21), crowd(19), everything(3), crowd(20, dtype="float32")])
def test_the_state_of_another_scene_is_refused(other: Scene) -> None:
    """A kernel does not check its arrays: it would read and write beyond their ends."""
    scene = crowd(20)
    state, theirs = scene.start(0), other.start(0)
    for call in (lambda: scene.step(theirs), lambda: scene.step(state, out=theirs)):
        with pytest.raises(ValueError, match="state") as caught:
            call()
        assert "\n" not in str(caught.value)


def test_a_result_for_another_number_of_worlds_is_refused() -> None:
    scene = crowd(20)
    with pytest.raises(ValueError, match="state"):
        scene.step(scene.start(0), out=scene.start(0, worlds=3))


def test_with_motion_refuses_wrong_shapes_and_numbers_that_are_not_finite() -> None:
    state = crowd(20).start(0)
    bad = np.zeros(state.shape)
    bad[0, 3, 1] = np.nan
    for pos, message in (
        (bad, "(0, 3, 1)"),
        (np.zeros((1, 19, 2)), "(1, 19, 2)"),
        (np.zeros((1, 20, 3)), "(1, 20, 3)"),
    ):
        with pytest.raises(ValueError, match="pos") as caught:
            state.with_motion(pos, np.zeros(state.shape))
        assert message in str(caught.value)


# --- errors when a scene is built -------------------------------------------------------------------------------------

GROUPS = (Group(count=3, spawn=SPAWN),)
BAD_SCENES = [
    ({"dt": 0}, ["dt = 0", "> 0"]),
    ({"dt": -0.01}, ["dt = -0.01", "> 0"]),
    ({"dt": float("nan")}, ["dt = nan"]),
    ({"dt": float("inf")}, ["dt = inf"]),
    ({"dt": "1e-3"}, ["dt = '1e-3'"]),
    ({"dt": True}, ["dt = True"]),
    ({"dt": None}, ["dt = None"]),
    ({"dtt": 0.01}, ["dtt", "did you mean `dt`"]),
    ({"dtype": "float16"}, ["float16", "float32"]),
    ({"dimension": 4}, ["dimension = 4", "2, 3"]),
    ({"groups": ()}, ["groups", "at least 1"]),
    ({"effects": ({"kind": "dragg", "rate": 1},)}, ["effects[0].kind = 'dragg'", "did you mean `drag`"]),
    ({"effects": ({"kind": "drag", "rat": 1},)}, ["effects[0].rat", "did you mean `rate`"]),
    ({"effects": ({"rate": 1},)}, ["effects[0].kind", "missing"]),
    ({"effects": (3,)}, ["effects[0]"]),
    ({"integrator": {"kind": "rk44"}}, ["integrator.kind = 'rk44'", "did you mean `rk4`"]),
    ({"space": {"kind": "tours", "size": (5, 5)}}, ["space.kind = 'tours'", "did you mean `torus`"]),
    ({"space": Torus(size=(5, 5, 5))}, ["space.size", "dimension = 2"]),
    ({"dimension": 3, "space": Torus(size=(5, 5))}, ["space.size", "dimension = 3"]),
    ({"obstacles": ({"centre": (1, 1, 1), "radius": 1},)}, ["obstacles[0].centre", "dimension = 2"]),
    ({"obstacles": ({"centre": (1, 1), "radius": 0},)}, ["obstacles[0].radius = 0", "> 0"]),
    ({"obstacles": ({"centre": (1, float("nan")), "radius": 1},)}, ["obstacles[0].centre[1] = nan"]),
    ({"space": Torus(size=(9, 5)), "effects": (Separation(weight=1, radius=2.6),)}, ["radius = 2.6", "2.5 m"]),
    ({"space": Torus(size=(9, 5)), "effects": (Drag(rate=1), Cohesion(weight=1, radius=3))}, ["effects[1].radius = 3"]),
    ({"groups": (Group(count=3),)}, ["groups[0].spawn.low", "missing"]),
    ({"groups": (Group(count=3, spawn=Spawn(low=(0, 0, 0), high=(1, 1, 1))),)}, ["groups[0].spawn.low", "dimension"]),
    ({"groups": (Group(count=3, spawn=SPAWN), {"count": 2, "mas": 1})}, ["groups[1].mas", "did you mean `mass`"]),
    (
        {"groups": (Group(count=3, spawn=Spawn(low=(0, 0), high=(1, 0.4), spacing=0.4)),)},
        ["room for only 2 of 3 agents"],
    ),
    ({"groups": (Group(count=3, spawn=Spawn(low=(0, 0), high=(1, 1), spacing=0.3, jitter=0.1)),)}, ["at least 0.4 m"]),
    ({"groups": (Group(count=3, radius=0, spawn=Spawn(low=(0, 0), high=(9, 9), spacing=1e-4)),)}, ["8,100,000,000"]),
    ({"groups": (Group(count=3, spawn=Spawn(low=(0, 0), high=(9, 9), spacing=(1, 1, 1))),)}, ["one per axis (2)"]),
    ({"space": Box(size=(1, 1)), "groups": (Group(count=3, radius=2),)}, ["groups[0].radius = 2", "does not fit"]),
    ({"groups": (Group(count=10**9, spawn=SPAWN),)}, ["1,000,000,000 agents", "GiB", "are allowed"]),
    ({"groups": (Group(count=10**30, spawn=SPAWN),)}, ["GiB"]),
]


@pytest.mark.parametrize(("fields", "parts"), BAD_SCENES, ids=lambda value: str(value)[:40])
def test_a_bad_scene_raises_an_error_of_one_line_before_allocating(fields: Any, parts: list[str]) -> None:
    tracemalloc.start()
    try:
        with pytest.raises((ValueError, TypeError)) as caught:
            Scene(**{"groups": GROUPS, **fields})
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    line = str(caught.value)
    assert "\n" not in line
    for part in parts:
        assert part in line, line
    assert peak < 20e6


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"count": 0}, "count = 0"),
        ({"count": -1}, "count = -1"),
        ({"count": 2.5}, "count = 2.5"),
        ({"count": "ten"}, "count = 'ten'"),
        ({"count": True}, "count = True"),
        ({"mass": 0}, "mass = 0"),
        ({"mass": -1}, "mass = -1"),
        ({"mass": float("nan")}, "mass = nan"),
        ({"radius": -1}, "radius = -1"),
        ({"max_speed": 0}, "max_speed = 0"),
        ({"max_force": -1}, "max_force = -1"),
        ({"max_force": float("inf")}, "max_force = inf"),
        ({"role": "bird"}, "role = 'bird'"),
        ({"mas": 1}, "did you mean `mass`"),
        ({"spawn": {"speed": (2, 1)}}, "speed = (2.0, 1.0)"),
        ({"spawn": {"low": (1, 1), "high": (0, 2)}}, "low = (1.0, 1.0)"),
        ({"spawn": {"low": (1, 1)}}, "low and high"),
        ({"spawn": {"jitter": 0.1}}, "jitter = 0.1: needs spacing"),
        ({"spawn": {"spacing": 0}}, "spacing = 0"),
        ({"spawn": {"wider": True}}, "wider = true: needs spacing"),
    ],
    ids=str,
)
def test_a_bad_group_raises_an_error_of_one_line(fields: Any, message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Group(**{"count": 3, **fields})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda scene: scene.start(0, worlds=0), "worlds is 0"),
        (lambda scene: scene.start(0, worlds=10**9), "GiB"),
        (lambda scene: scene.start(0, worlds=2.5), "worlds is 2.5"),
        (lambda scene: scene.start(-1), "seed"),
        (lambda scene: scene.start(2**64), "seed"),
        (lambda scene: scene.start(1.5), "seed"),
        (lambda scene: scene.start("abc"), "seed"),
    ],
)
def test_a_bad_start_raises_an_error_of_one_line(call: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError)) as caught:
        call(crowd(20))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# --- memory -----------------------------------------------------------------------------------------------------------


def taken(scene: Scene) -> int:
    """Return the bytes of a state of one world, of the bodies, and of the scratch of one thread."""
    state, scratch = scene.start(0), Workspace.allocate(scene.parts, scene.body, scene.table)
    own = [array for arrays in scratch.own for array in arrays.values()]
    arrays = [*(getattr(state, name) for name in ARRAYS), *scene.body.arrays(), *scratch.arrays.values(), *own]
    return sum(array.nbytes for array in arrays)


@pytest.mark.parametrize("variant", ALL[: len(VARIANTS)], ids=lambda variant: variant.name)
@pytest.mark.parametrize("count", [1, 97, 3000])
def test_allocated_memory_agrees_with_bytes_per_world(variant: Variant, count: int) -> None:
    """Except for a few tables of constant size, and lanes beyond the last agent."""
    scene = variant.make(count, 9.0)
    predicted, fixed = scene.bytes_per_world(), 24 * 1024
    assert predicted <= 1.25 * taken(scene)
    assert taken(scene) <= predicted + fixed


CONSTANT = ("mass", "radius", "max_speed", "max_force", "ident", "tie", "number", "spread", "sync", *TABLES)
"""Scratch that is filled when it is allocated, or by the caller of the threads."""


@pytest.mark.parametrize("variant", ALL[: len(VARIANTS)], ids=lambda variant: variant.name)
@pytest.mark.parametrize("count", [97, 3000])
def test_steps_read_nothing_that_earlier_steps_left_in_scratch(variant: Variant, count: int) -> None:
    """So scratch may be used for another scene that fills CONSTANT alike. Lanes beyond the last agent never live."""
    scene, rng = variant.make(count, 9.0), np.random.default_rng(1)
    start = scene.start(3)
    expected = scene.step(start, steps=3)
    for spaces in vars(scene.stepper._threads)["workspaces"].values():
        for arrays in (each for space in spaces for each in (space.arrays, *space.own)):
            for name in set(arrays) - {*CONSTANT, *scene.parts.frame_numbers, "living"}:
                array = arrays[name]
                array[...] = rng.normal(size=array.shape) if array.dtype.kind == "f" else 1
            arrays.get("living", np.zeros(0))[:count] = 0
    assert scene.step(start, steps=3).digest == expected.digest


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("space", [Plane(), Torus(size=(900, 900))])  # only a torus stores tiles
def test_a_million_agents_fit_into_a_gigabyte(space: Space, dtype: str) -> None:
    rules = (Separation(weight=1, radius=1), Alignment(weight=1, radius=2), Cohesion(weight=1, radius=2))

    def of(count: int) -> Scene:
        group = Group(count=count, spawn=Spawn(low=(0, 0), high=(900, 900)))
        return scene_of(*rules, dtype=dtype, space=space, groups=(group,))

    assert of(1_000_000).bytes_per_world() < 1e9
    few, many = of(8192), of(16384)
    more = many.bytes_per_world() - few.bytes_per_world()
    per_agent = more / 8192  # bytes grow linearly
    assert of(1_000_000).bytes_per_world() == pytest.approx(per_agent * 1_000_000, rel=1e-3)
    assert more == taken(many) - taken(few)


def test_a_scene_of_gravity_alone_allocates_nothing_for_other_laws() -> None:
    """No array of neighbours, bonds, tree, medium or walls grows with the agents; only evaluations are counted."""
    gravity = Gravity(acceleration=(0, -9.81))
    scenes = [scene_of(gravity, groups=(Group(count=n, spawn=Spawn(low=(0, 0), high=(9, 9))),)) for n in (160, 1600)]
    few, many = (Workspace.allocate(s.parts, s.body, s.table).arrays for s in scenes)
    growing = {name for name in few if many[name].size > few[name].size}
    body = {"mass", "radius", "max_speed", "max_force", "living", "ident"}
    assert growing == {"pos", "vel", "saved", "requested_force"} | body
    handed = set(scratch_of(scenes[0].parts, 160))
    assert handed == growing | {"counters", "tally", "sync", "lanes"}  # of agents, threads, and of divergence
    start = scenes[0].start(0)
    end = scenes[0].step(start, steps=3)
    assert end.count_of("evaluations") == 3
    assert end.work.sum() == 3
    tracemalloc.start()
    try:
        scenes[0].step(end, out=end, steps=100)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8_000  # objects of Python, nothing per agent or step


# --- positions --------------------------------------------------------------------------------------------------------


def crowd_of(count: int, **fields: Any) -> Scene:
    spawn = Spawn(low=(0, 0), high=(50, 50))
    return scene_of(Separation(weight=1, radius=1), groups=(Group(count=count, max_speed=3, spawn=spawn),), **fields)


@pytest.mark.slow
def test_resting_agents_near_the_edge_of_a_torus_are_not_wrapped() -> None:
    """59.999996 / 60 rounds to 1 in single precision: an agent there must not be wrapped at each call."""
    scene = crowd_of(200, space=Torus(size=(60, 60)), dtype="float32")
    state = scene.start(0)
    state.v[...] = 0
    state.x[:, 0, 0] = np.nextafter(np.float32(60), np.float32(0)), 55
    np.testing.assert_array_equal(scene.step(state).x[:, 0, 0], state.x[:, 0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_agents_on_a_line_are_not_all_paired(axis: int) -> None:
    scene = crowd_of(2000, space=Plane())
    state = scene.start(0)
    state.x[axis], state.x[1 - axis] = np.linspace(0, 2000, 2000), 1.0
    assert scene.step(state).count_of("pairs") < 100 * 2000


def test_zero_steps_do_not_wrap_positions() -> None:
    scene = crowd_of(200, space=Torus(size=(60, 60)))
    state = scene.start(0)
    state.x[0, 0, 0] = -3.0
    np.testing.assert_array_equal(scene.step(state, steps=0).x, state.x)


def test_a_noncontiguous_state_is_copied_as_input_and_refused_as_output() -> None:
    scene = crowd_of(64, space=Plane())
    state = scene.start(0)
    pieces = State(**{**vars(state), "x": np.asfortranarray(state.x)})
    np.testing.assert_array_equal(scene.step(pieces).x, scene.step(state).x)
    with pytest.raises(ValueError, match=r"out\.x is not contiguous"):
        scene.step(pieces, out=pieces)


@pytest.mark.parametrize(
    ("fault", "drive", "x"),
    [
        (r"out\.x is not contiguous", None, np.asfortranarray),
        (r"drive has shape", np.zeros(3), np.copy),
        (r"drive of world 0, agent 0, axis 0 is nan", np.full((1, 64, 2), np.nan), np.copy),
    ],
)
def test_a_refused_step_writes_nothing(fault: str, drive: Any, x: Callable[[Array], Array]) -> None:
    scene = crowd_of(64, space=Plane())
    other = scene.start(7)
    out = State(**{**vars(other), "x": x(other.x)})
    before = out.copy()
    with pytest.raises(ValueError, match=fault):
        scene.step(scene.start(0), drive, out=out)
    assert_same(out, before)


# --- effects of users -------------------------------------------------------------------------------------------------


def test_an_effect_of_a_user_s_module_works_like_a_built_in_one(tmp_path: Path) -> None:
    with users_module(tmp_path, TETHER) as laws:
        effect = laws.Tether(stiffness=4.0, damping=0.5)
        scene = scene_of(effect, Drag(rate=0.1))
        start = scene.start(0, worlds=2)
        end = scene.step(start)
        force = -4.0 * start.pos - 0.6 * start.vel
        np.testing.assert_allclose((end.vel - start.vel) / scene.dt * scene.body.mass[:, None], force, rtol=1e-9)
        assert eval(repr(effect), vars(laws)) == effect  # noqa: S307
        assert pickle.loads(pickle.dumps(scene)) == scene
        with pytest.raises(ValueError, match="did you mean `stiffness`"):
            laws.Tether(stifness=1)
    assert "users_tether" not in EFFECTS


SECOND = """
import sys
sys.path.insert(0, sys.argv[1])
import users_laws
from tests.catalogue import scene_of
scene = scene_of(users_laws.Tether(stiffness=4.0, damping=0.5))
start = scene.start(0)
print((scene.step(start).vel - start.vel)[0, 0, 0] / start.pos[0, 0, 0])
"""


@pytest.mark.slow
def test_an_edited_law_is_recompiled_in_the_next_process(tmp_path: Path) -> None:
    """numba alone would reuse the machine code of the old law: it checks the file of the caller, not of the law."""
    found = []
    for text in (TETHER, TETHER.replace("-p.stiffness", "-3 * p.stiffness").replace("-p.damping", "-3 * p.damping")):
        (tmp_path / "users_laws.py").write_text(text)
        done = subprocess.run(
            [sys.executable, "-B", "-c", SECOND, str(tmp_path)],
            cwd=Path(__file__).resolve().parent.parent,
            env={"FLOCKENV_CACHE": str(cache_folder()), "PYTHONPATH": str(Path(flockenv.__file__).parent.parent)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        found.append(float(done.stdout))
    assert found[1] == pytest.approx(3 * found[0], rel=1e-12)


def test_a_scene_built_in_python_runs() -> None:
    scene = Scene(
        space=Torus(size=(9, 7)),
        groups=(Group(count=30, max_speed=2, spawn=Spawn(speed=(1, 2))),),
        effects=everything(2).effects,
        dt=0.05,
    )
    assert any(isinstance(effect, Alignment) for effect in scene.effects)
    end = scene.run(scene.start(seed=1), 20)
    assert end.time[0] == 20 * 0.05
    assert (np.linalg.norm(end.vel, axis=2) <= 2 * (1 + 1e-12)).all()
    snapshot = scene.snapshot(end)
    assert snapshot.periodic
    np.testing.assert_array_equal(snapshot.pos, end.pos[0])


def test_a_scene_is_freed_with_its_last_reference() -> None:
    """Otherwise its scratch, 200 bytes per agent, would wait for the garbage collector, which does not count bytes."""
    scene = Scene(space=Torus(size=(9.0, 9.0)), groups=(Group(count=4),), effects=(Drag(rate=1.0),), dt=0.01)
    state = scene.run(scene.start(0), 2)
    scene.snapshot(state)
    scene.acceleration(state)
    there = weakref.ref(scene)
    gc.disable()
    try:
        del scene
        assert there() is None
    finally:
        gc.enable()
