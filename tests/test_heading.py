"""Oriented agents: headings kept at rest, limited turn rates, banking; no cost for agents without headings."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import Alignment, AvoidObstacles, Separation
from flockenv.behaviours.steer import Steer
from flockenv.core.warnings import LookaheadWarning
from flockenv.engine.workspace import Workspace
from flockenv.envs.world import World
from flockenv.geometry.space import Box, Torus
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.maths.heading import GRAVITY
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Drag, Effect
from flockenv.physics.integrators import RK4
from flockenv.scene import Group, Scene
from flockenv.studies.trajectory import record
from flockenv.tasks import Obstacles
from tests.catalogue import Array
from tests.kernels import functions_of

DIMENSIONS = pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
RATE = 0.8  # rad/s


def vehicles(dimension: int = 2, effects: tuple[Effect, ...] = (), count: int = 6, **group: Any) -> Scene:
    """Return a scene with agents around the origin that fly along the x axis at 1 m/s."""
    corner, ahead = (5.0,) * dimension, (1.0,) + (0.0,) * (dimension - 1)
    spawn = Spawn(low=tuple(-x for x in corner), high=corner, speed=(1, 1), heading=ahead)
    change = {name: group.pop(name) for name in ("dt", "dtype", "space", "integrator", "obstacles") if name in group}
    fields: dict[str, Any] = {"dimension": dimension, "effects": effects, "dt": 0.01} | change
    return Scene(groups=(Group(count=count, spawn=spawn, **group),), **fields)


def leftward(state: State, strength: float) -> Array:
    """Return a force to the left of every agent, in the horizontal plane."""
    out = np.zeros(state.shape)
    out[..., 0], out[..., 1] = -strength * state.heading[..., 1], strength * state.heading[..., 0]
    return out


def angle(a: Array, b: Array) -> Array:
    """Return the angles between vectors, rad; exact for small angles."""
    a, b = (np.asarray(x, float) / np.linalg.norm(x, axis=-1, keepdims=True) for x in (a, b))
    return np.asarray(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


# --- headings ---------------------------------------------------------------------------------------------------------


@DIMENSIONS
def test_a_heading_is_kept_at_rest(dimension: int) -> None:
    """A moving agent's heading is unit(v), and stays when the agent stops; other scenes keep no heading."""
    scene = vehicles(dimension, (Drag(rate=0.5),), oriented=True, max_force=3.0)
    state = scene.start(1)
    assert np.allclose(state.heading[..., 0], 1)
    state = scene.step(state, np.full(state.shape, 0.7), steps=60)
    moving = state.heading.copy()
    np.testing.assert_allclose(moving, state.vel / np.linalg.norm(state.vel, axis=-1, keepdims=True), atol=1e-15)
    assert angle(moving, scene.start(1).heading).min() > 0.1
    state.vel[...] = 0
    state = scene.step(state, steps=30)
    assert not state.vel.any()
    np.testing.assert_allclose(state.heading, moving, atol=1e-15)
    plain = vehicles(dimension, (Drag(rate=0.5),))
    assert not plain.start(1).with_motion(state.pos, state.vel).heading.any()


@pytest.mark.slow
@DIMENSIONS
def test_the_field_of_view_of_a_standing_agent_is_around_its_kept_heading(dimension: int) -> None:
    """A neighbour behind the kept heading is not seen."""
    scene = vehicles(dimension, (Separation(weight=1, radius=3, fov=180),), count=2, oriented=True)
    state = scene.start(0)
    state.pos[0, 0], state.pos[0, 1] = 0, 0
    state.pos[0, 1, 0] = 1
    state.vel[...] = 0
    acceleration = scene.acceleration(state)
    np.testing.assert_allclose(acceleration[0, 0, 0], -1)  # the neighbour is 1 m ahead
    np.testing.assert_array_equal(acceleration[0, 1], 0)
    state.heading[0] *= -1
    np.testing.assert_array_equal(scene.acceleration(state)[0, 0], 0)
    np.testing.assert_allclose(scene.acceleration(state)[0, 1, 0], 1)
    plain = vehicles(dimension, (Separation(weight=1, radius=3, fov=180),), count=2)
    other = plain.start(0).with_motion(state.pos, state.vel)
    assert (
        np.abs(plain.acceleration(other)[0, :, 0]) == 1
    ).all()  # without a heading, an agent at rest sees all around


def test_headings_start_as_spawned_and_follow_velocities_that_are_written() -> None:
    spawn = Spawn(low=(0, 0), high=(1, 1), heading=(0, -2))
    state = Scene(groups=(Group(count=3, spawn=spawn, oriented=True),)).start(0)
    np.testing.assert_array_equal(state.vel, 0)
    np.testing.assert_array_equal(state.heading, np.broadcast_to((0, -1), (1, 3, 2)))
    vel = np.zeros(state.shape)
    vel[0, 0] = (-3, 0)
    written = state.with_motion(state.pos, vel)
    np.testing.assert_array_equal(written.heading[0], [(-1, 0), (0, -1), (0, -1)])
    np.testing.assert_array_equal(state.heading[0, 0], (0, -1))
    nowhere = Scene(groups=(Group(count=1, spawn=Spawn(low=(0, 0), high=(1, 1)), oriented=True),)).start(0)
    np.testing.assert_array_equal(nowhere.heading, [[(1, 0)]])


# --- turning ----------------------------------------------------------------------------------------------------------


@DIMENSIONS
@pytest.mark.parametrize("method", [None, pytest.param(RK4(), marks=pytest.mark.slow)])
def test_an_agent_at_its_turn_rate_limit_flies_a_circle(dimension: int, method: Any) -> None:
    """Steps of s dt, each turned by rate dt, lie on a circle of radius s dt/(2 sin(rate dt/2)); s/rate for small dt."""
    fields = {} if method is None else {"integrator": method}
    scene = vehicles(dimension, (Drag(rate=0.0),), max_turn_rate=RATE, max_speed=1.0, **fields)
    state = scene.step(scene.start(2), leftward(scene.start(2), 8.0))
    places = []
    for _ in range(round(2 * math.pi / RATE / scene.dt)):
        places.append(state.pos.copy())
        before = state.heading.copy()
        state = scene.step(state, leftward(state, 8.0))
        np.testing.assert_allclose(angle(state.heading, before), RATE * scene.dt, rtol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(state.vel, axis=-1), 1, rtol=1e-9)
    path = np.stack(places)[:, 0]
    centre = (path.max(axis=0) + path.min(axis=0)) / 2
    radius = np.linalg.norm((path - centre)[..., :2], axis=-1)
    expected = scene.dt / (2 * math.sin(RATE * scene.dt / 2))
    assert expected == pytest.approx(1 / RATE, rel=1e-5)
    np.testing.assert_allclose(radius, expected, rtol=1e-4)


@DIMENSIONS
@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_no_step_turns_by_more_than_the_rate(dimension: int, dtype: str) -> None:
    """This holds for any drive, also at rest and straight backwards; turns below the limit are not changed."""
    scene = vehicles(dimension, (Drag(rate=0.0),), max_turn_rate=RATE, max_speed=1.0, dtype=dtype)
    state, rng = scene.start(3), np.random.default_rng(0)
    most = RATE * scene.dt
    eps = float(np.finfo(dtype).eps)
    for k in range(60):
        drive = rng.normal(size=state.shape) * 10 ** rng.uniform(-3, 3, (1, state.shape[1], 1))
        if k % 10 == 5:
            drive = -120 * state.heading.astype(float)
        before, place = state.heading.copy(), state.pos.copy()
        unlimited = state.vel + drive * scene.dt
        state = scene.step(state, drive)
        turn = angle(state.heading, before)
        assert (turn <= most + 8 * eps).all()
        less = angle(unlimited, before) < 0.9 * most
        np.testing.assert_allclose(turn[less], angle(unlimited, before)[less], atol=16 * eps)
        went = state.pos - place
        moved = np.linalg.norm(went, axis=-1) > 1e-4
        assert (angle(went[moved], before[moved]) <= most + (1e-9 if dtype == "float64" else 2e-2)).all()


def test_an_agent_at_rest_turns_on_the_spot() -> None:
    """Pushed backwards, it does not move until its heading is within 90 degrees of the push: pi/2 / rate seconds."""
    scene = vehicles(2, (Drag(rate=0.0),), max_turn_rate=RATE, max_speed=1.0)
    state = scene.start(0)
    state.vel[...] = 0
    begin, push = state.pos.copy(), np.zeros(state.shape)
    push[..., 0] = -1.0
    half = round(math.pi / 2 / RATE / scene.dt)
    state = scene.step(state, push, steps=half - 1)
    np.testing.assert_array_equal(state.pos, begin)
    np.testing.assert_allclose(angle(state.heading, scene.start(0).heading), (half - 1) * RATE * scene.dt)
    np.testing.assert_array_less(state.heading[..., 1], 0)  # all turn to the right
    state = scene.step(state, push, steps=2 * half)
    np.testing.assert_allclose(state.heading[..., 0], -1, atol=1e-3)
    assert (state.pos[..., 0] < begin[..., 0] - 0.1).all()


def test_a_limit_that_is_never_reached_changes_nothing() -> None:
    """Positions and velocities have the same bits without headings, with them, and with a wide limit."""
    drive = np.random.default_rng(1).normal(size=(1, 6, 2))
    ends = []
    for group in ({}, {"oriented": True}, {"max_turn_rate": 400.0}):
        scene = vehicles(2, (Drag(rate=0.3),), **group)
        ends.append(scene.step(scene.start(4), drive, steps=200))
    for end in ends[1:]:
        np.testing.assert_array_equal(end.x, ends[0].x)
        np.testing.assert_array_equal(end.v, ends[0].v)


@pytest.mark.slow
def test_each_group_has_its_own_turn_rate_and_a_bounce_turns_at_once() -> None:
    """The turn rate does not limit a bounce off a wall."""
    still = Spawn(low=(4, 4), high=(6, 6), speed=(1, 1), heading=(1, 0))
    groups = tuple(Group(count=3, spawn=still, max_turn_rate=rate) for rate in (0.5, 2.0, None))
    scene = Scene(space=Box(size=(10, 10), restitution=1.0), groups=groups, effects=(Drag(rate=0),), dt=0.01)
    state = scene.step(scene.start(0), leftward(scene.start(0), 50.0))
    turn = angle(state.heading, scene.start(0).heading)[0]
    np.testing.assert_allclose(turn, np.repeat([0.005, 0.02, math.atan(0.5)], 3), rtol=1e-9)
    free = scene.run(scene.start(0), 650)
    np.testing.assert_allclose(free.heading[0, :, 0], -1)


# --- up, and banking --------------------------------------------------------------------------------------------------


def basis(state: State) -> tuple[Array, Array, Array]:
    """Return side (to the right), forward and up."""
    side = np.cross(state.heading, state.up)
    return side, state.heading, state.up


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_side_forward_and_up_stay_a_right_handed_basis(dtype: str) -> None:
    """After 10,000 steps in all directions det (side, forward, up) = +1; with up = f x side (1999) it would be -1."""
    scene = vehicles(3, (Drag(rate=0.3),), oriented=True, dtype=dtype, dt=0.02)
    state, rng = scene.start(5), np.random.default_rng(2)
    np.testing.assert_allclose(np.linalg.det(np.stack(basis(state), axis=-1)), 1, rtol=1e-6)
    for _ in range(500):
        up = state.up.copy()
        state = scene.step(state, rng.normal(size=state.shape) * 3, steps=1)
        assert (np.sum(up * state.up, axis=-1) > 0.5).all()  # it does not flip
        state = scene.step(state, rng.normal(size=state.shape) * 3, steps=19)
    for vectors in zip(*basis(state), strict=True):
        frame = np.stack(vectors, axis=-1)
        tolerance = 1e-12 if dtype == "float64" else 1e-5
        np.testing.assert_allclose(np.linalg.det(frame), 1, atol=tolerance)
        np.testing.assert_allclose(
            frame.swapaxes(-1, -2) @ frame, np.broadcast_to(np.eye(3), frame.shape), atol=tolerance
        )


@pytest.mark.slow
def test_up_is_vertical_in_level_flight_and_leans_back_in_a_climb() -> None:
    scene = vehicles(3, (Drag(rate=0.0),), oriented=True)
    state = scene.start(0)
    np.testing.assert_array_equal(state.up, np.broadcast_to((0, 0, 1), state.shape))
    np.testing.assert_array_equal(basis(state)[0], np.broadcast_to((0, -1, 0), state.shape))  # to the right
    state.vel[...] = (0, 0, 1)  # straight up at once: side does not change, up leans back
    state = scene.step(state)
    np.testing.assert_allclose(basis(state)[0], np.broadcast_to((0, -1, 0), state.shape), atol=1e-12)
    np.testing.assert_allclose(state.up, np.broadcast_to((-1, 0, 0), state.shape), atol=1e-12)
    with pytest.raises(ValueError, match="up: only scenes in 3-D"):
        vehicles(2, oriented=True).start(0).up  # noqa: B018  # a property that refuses


@pytest.mark.slow
def test_the_bank_angle_of_a_steady_turn_follows_from_its_acceleration() -> None:
    """In a steady turn tan(bank) = s omega/g, towards the inside; in level flight the agent returns upright."""
    scene = vehicles(3, (Drag(rate=0.0),), max_turn_rate=2.0, max_speed=6.0, banking=0.3)
    state = scene.start(0)
    state.vel[..., 0] = 6.0
    for _ in range(400):
        state = scene.step(state, leftward(state, 20.0))
    bank = np.arccos(state.up[..., 2])
    speed = np.linalg.norm(state.vel, axis=-1)
    np.testing.assert_allclose(np.tan(bank), speed * 2.0 / GRAVITY, rtol=0.02)
    left = np.cross((0, 0, 1), state.heading)
    assert (np.sum(left * state.up, axis=-1) > 0.5).all()
    state = scene.step(state, steps=300)
    np.testing.assert_allclose(state.up[..., 2], 1, atol=1e-6)
    half = scene.model_copy(update={"dt": 0.005})
    other = half.start(0)
    other.vel[..., 0] = 6.0
    for _ in range(60):  # the transient does not depend on dt either
        other = half.step(other, leftward(other, 20.0))
    once = scene.start(0)
    once.vel[..., 0] = 6.0
    for _ in range(30):
        once = scene.step(once, leftward(once, 20.0))
    np.testing.assert_allclose(np.arccos(other.up[..., 2]), np.arccos(once.up[..., 2]), rtol=0.05)


# --- batches, cost, records, refusals ---------------------------------------------------------------------------------


def crowded(count: int, **group: Any) -> Scene:
    """Return a flock with a field of view on a torus; a large one is sorted by cell and rearranged in memory."""
    edge = math.sqrt(count) * 0.7
    effects = (Alignment(weight=2, radius=1.5, fov=200), Separation(weight=1, radius=1, fov=250))
    spawn = Spawn(speed=(0.0, 1.5))
    groups = (Group(count=count, spawn=spawn, max_speed=2, **group),)
    return Scene(space=Torus(size=(edge, edge)), groups=groups, effects=effects, dt=0.05)


@pytest.mark.slow
def test_headings_do_not_depend_on_batches_steps_per_call_or_threads() -> None:
    scene = crowded(9000, max_turn_rate=1.0)
    batch = scene.run(scene.start(7, worlds=3), 12)
    alone = scene.run(scene.start(9), 12)
    single = scene.start(9)
    for _ in range(12):
        single = scene.step(single)
    had = threads()
    try:
        use_threads(2)
        threaded = scene.run(scene.start(9), 12)
    finally:
        use_threads(had)
    for other in (alone, single, threaded):
        np.testing.assert_array_equal(batch.x[:, 2], other.x[:, 0])
        np.testing.assert_array_equal(batch.frame[:, 2], other.frame[:, 0])
    assert angle(batch.heading, scene.start(7, worlds=3).heading).max() <= 12 * 0.05 * 1.0 + 1e-9
    copy = batch.worlds([2]).copy()
    np.testing.assert_array_equal(copy.frame, alone.frame)


@pytest.mark.slow
def test_dead_agents_and_diverged_worlds_keep_their_headings() -> None:
    scene = vehicles(2, (Drag(rate=0.0),), max_turn_rate=1.0)
    state = scene.start(1, worlds=2)
    state.alive[0, 2] = False
    state.vel[1, 0, 0] = math.inf
    before = state.heading.copy()
    with pytest.raises(FloatingPointError) as raised:
        scene.step(state, leftward(state, 50.0))
    end: State = raised.value.state  # type: ignore[attr-defined]  # of SimulationDiverged
    np.testing.assert_array_equal(end.heading[1], before[1])
    np.testing.assert_array_equal(end.heading[0, 2], before[0, 2])
    assert angle(end.heading[0, 0], before[0, 0]) == pytest.approx(0.01)


def test_scenes_without_headings_need_no_memory_or_code_for_them() -> None:
    plain, kept = vehicles(), vehicles(oriented=True)
    assert plain.start(0).frame.shape == (0, 1, 6)
    assert kept.start(0).frame.shape == (2, 1, 6)
    assert vehicles(3, oriented=True).start(0).frame.shape == (6, 1, 6)
    assert functions_of(kept) - functions_of(plain) == {"face"}
    assert functions_of(vehicles(max_turn_rate=1.0)) - functions_of(kept) == {"turn"}
    assert plain.bytes_per_world() < kept.bytes_per_world()
    scratch = Workspace.allocate(plain.parts, plain.body, plain.table)
    assert sum(a.nbytes for a in scratch.arrays.values()) < sum(
        a.nbytes for a in Workspace.allocate(kept.parts, kept.body, kept.table).arrays.values()
    )


def test_snapshots_and_records_contain_the_heading(tmp_path: Path) -> None:
    scene = vehicles(2, (Drag(rate=0.0),), oriented=True)
    state = scene.start(0)
    state.vel[...] = 0
    shot = scene.snapshot(scene.step(state))
    np.testing.assert_array_equal(shot.aim, np.broadcast_to((1, 0), (6, 2)))
    trajectory = record(scene, 0, 20, 5)
    assert trajectory.heading is not None
    np.testing.assert_array_equal(trajectory.heading, np.broadcast_to((1, 0), (5, 6, 2)))
    trajectory.save(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as file:
        np.testing.assert_array_equal(file["heading"], trajectory.heading)
    assert all(s.heading is not None for s in trajectory.snapshots())
    plain = record(vehicles(2, (Drag(rate=0.0),)), 0, 20, 5)
    assert plain.heading is None
    assert plain.scene.snapshot(plain.last).heading is None


@pytest.mark.parametrize(
    ("group", "message"),
    [
        ({"max_turn_rate": 0.0}, "max_turn_rate = 0"),
        ({"max_turn_rate": -1.0}, "max_turn_rate = -1"),
        ({"banking": 0.3}, r"groups\[0\].banking = 0.3: needs dimension = 3"),
    ],
)
def test_invalid_turn_rates_and_banking_in_2d_are_refused(group: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vehicles(2, **group)


def test_states_and_scenes_must_agree_on_headings() -> None:
    with pytest.raises(ValueError, match="the state keeps no headings, but this scene keeps headings"):
        vehicles(oriented=True).step(vehicles().start(0))
    with pytest.raises(ValueError, match="the state keeps headings, but this scene keeps no headings"):
        vehicles().step(vehicles(oriented=True).start(0))


# --- lookahead --------------------------------------------------------------------------------------------------------


def runners(horizon: float, **group: Any) -> Scene:
    """Return agents with V = 2 m/s, m = 1 kg, F = 4 N, r = 0.1 m: the stopping distance is 0.5 m, 0.6 m with r."""
    given: dict[str, Any] = {"max_speed": 2.0, "max_force": 4.0} | group
    return vehicles(2, (AvoidObstacles(weight=4, horizon=horizon),), **given)


def test_a_lookahead_shorter_than_the_stopping_distance_causes_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        runners(0.31)
        runners(0.01, max_force=None)  # without both limits no stopping distance is known
        runners(0.01, max_speed=None)
    with pytest.warns(LookaheadWarning, match=r"effects\[0\].horizon = 0.29: .* 0.58 m .* 0.6 m .* 0.3 s") as caught:
        runners(0.29)
    assert "\n" not in str(caught[0].message)
    steer = Steer(group=0, behaviours=(Separation(weight=1, radius=1), AvoidObstacles(weight=4, horizon=0.29)))
    with pytest.warns(LookaheadWarning, match=r"effects\[0\].behaviours\[1\].horizon = 0.29"):
        vehicles(2, (steer,), max_speed=2.0, max_force=4.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        other = Group(count=1, spawn=Spawn(low=(0, 0), high=(1, 1)), max_speed=2.0, max_force=40.0)
        slow = vehicles(2, (Drag(rate=0.0),), max_speed=2.0, max_force=4.0)
        slow.model_copy(
            update={"groups": (other, *slow.groups), "effects": (steer,)}
        )  # the steer acts on the other group


# --- tasks ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_task_can_have_agents_with_limited_turn_rates() -> None:
    """Episodes start with headings along velocities, turns are limited, and worlds do not depend on their batch."""

    def world(count: int) -> World:
        task = Obstacles()
        groups = tuple(group.model_copy(update={"max_turn_rate": RATE}) for group in task.scene.groups)
        vars(task)["scene"] = task.scene.model_copy(update={"groups": groups})  # before anything is derived from it
        return World(task, worlds=count)

    batch, alone = world(3), world(1)
    batch.reset(5)
    alone.reset(7)
    for episode in range(2):
        for _ in range(20):
            before = batch.state.heading.copy()
            batch.step(np.full((3, 1, 2), (-1.0, 0.3)))
            alone.step(np.full((1, 1, 2), (-1.0, 0.3)))
            assert (angle(batch.state.heading, before) <= RATE * batch.task.control_dt + 1e-9).all()
        np.testing.assert_array_equal(batch.state.frame[:, 2], alone.state.frame[:, 0])
        shot = batch.snapshot(1)
        assert shot.heading is not None
        np.testing.assert_array_equal(shot.heading, batch.state.heading[1])
        if episode == 0:
            batch.reset()
            alone.reset()
            first = batch.state.heading
            np.testing.assert_allclose(np.linalg.norm(first, axis=-1), 1)
            moving = np.linalg.norm(batch.state.vel, axis=-1) > 0
            assert (angle(first[moving], batch.state.vel[moving]) < 1e-7).all()
            np.testing.assert_array_equal(first[~moving], np.broadcast_to((1.0, 0.0), first[~moving].shape))
