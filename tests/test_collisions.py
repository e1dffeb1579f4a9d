"""Collisions: closed forms, conservation, and independence of numbering, batches, threads and position."""

from __future__ import annotations

import copy
import itertools
import math
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.geometry.shapes import Block, Circle, HalfSpace, Polygon, Wall
from flockenv.geometry.space import Box, Plane, Space, Torus
from flockenv.jit.section import entry
from flockenv.jit.thread_pool import use_threads
from flockenv.model.spawn import Spawn
from flockenv.model.state import Floats, State
from flockenv.physics.constraints import Collisions
from flockenv.physics.constraints.broad_phase import list_near_pairs
from flockenv.physics.effects import Gravity
from flockenv.physics.integrators import RK4, Integrator, SemiImplicitEuler, VelocityVerlet
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import dump_scene, load_scene
from flockenv.studies.cost_breakdown import explain

IN_TIME = ("earliest", "back_up")
EXACT = (*IN_TIME, "impulses")
ALL = (*EXACT, "project")
FLOOR = (HalfSpace(point=(0.0, 0.0), direction=(0.0, 1.0)),)
R, G = 0.1, 9.81


def scene(
    masses: Any, response: str = "earliest", *, e: float = 1.0, g: float = 0.0, dt: float = 0.01, radius: float = R,
    obstacles: tuple[Any, ...] = (), space: Space | None = None, method: Integrator | None = None,
    dtype: str = "float64", **more: Any,
) -> Scene:  # fmt: skip
    """Return discs under gravity; scenes of equal method, space and precision share one kernel."""
    spawn = Spawn(low=(0, 0), high=(1, 1))
    return Scene(
        groups=tuple(Group(count=1, mass=float(m), radius=radius, spawn=spawn) for m in masses),
        effects=(Gravity(acceleration=(0.0, -g)),), obstacles=obstacles, space=space or Plane(), dt=dt, dtype=dtype,
        constraints=(Collisions(response=response, restitution=e, **more),), integrator=method or SemiImplicitEuler(),
    )  # fmt: skip


def begun(of: Scene, pos: Any, vel: Any) -> State:
    return of.start(0).with_motion(np.asarray(pos, float)[None], np.asarray(vel, float)[None])


def energy(of: Scene, state: State, g: float = 0.0) -> float:
    mass, pos, vel = of.body.mass, state.pos[0], state.vel[0]
    return float((mass * ((vel**2).sum(axis=1) / 2 + g * pos[:, 1])).sum())


def gas(response: str, e: float, count: int = 40, order: Any = None, offset: float = 0.0, **more: Any) -> Any:
    """Return a scene and a state of discs of different masses on a lattice, with random velocities."""
    rng, edge = np.random.default_rng(3), 4.0
    side = math.ceil(math.sqrt(count))
    lattice = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:count]
    pos, vel, masses = (lattice + 0.5) * edge / side, rng.normal(size=(count, 2)) * 2, rng.uniform(0.5, 3, count)
    order = np.arange(count) if order is None else order
    of = scene(masses[order], response, e=e, **more)
    return of, begun(of, pos[order] + offset, vel[order])


def walls(offset: float = 0.0) -> tuple[Wall, ...]:
    corners = np.array([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0)]) + offset
    return tuple(Wall(vertices=(tuple(a), tuple(b))) for a, b in itertools.pairwise(corners.tolist()))


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("response", IN_TIME)
@pytest.mark.parametrize(
    "method",
    [SemiImplicitEuler(), *(pytest.param(kind(), marks=pytest.mark.slow) for kind in (VelocityVerlet, RK4))],
    ids=lambda m: m.kind,
)
def test_elastic_ball_keeps_its_height_over_a_hundred_bounces(response: str, method: Integrator) -> None:
    of = scene([1], response, g=G, dt=0.02, obstacles=FLOOR, method=method)
    state = begun(of, [(0, 1 + R)], [(1, 0)])
    # the velocity of a method of order 1 is half a step ahead of its position
    ahead = G * of.dt / 2 if method.order == 1 else 0.0

    def height() -> float:
        return float(state.pos[0, 0, 1] - R + (state.vel[0, 0, 1] - ahead) ** 2 / (2 * G))

    first = height()
    for _ in range(round(100 * 2 * math.sqrt(2 / G) / of.dt)):
        state = of.step(state)
        assert R <= state.pos[0, 0, 1] <= 1.01 + R
    assert abs(height() / first - 1) < 1e-9
    assert state.count_of("impacts") >= 99 and state.vel[0, 0, 0] == 1


@pytest.mark.parametrize("response", IN_TIME)
@pytest.mark.parametrize(("e", "seconds"), [(0.5, 1.354571), (0.8, 4.063713)])
@pytest.mark.parametrize("phase", [0.0, 0.3, 0.77])
def test_ball_comes_to_rest_when_the_series_of_bounces_converges(
    response: str, e: float, seconds: float, phase: float
) -> None:
    dt = 0.02
    of = scene([1], response, e=e, g=G, dt=dt, obstacles=FLOOR)
    away = phase * dt  # time since the ball began to fall
    state = begun(of, [(0, 1 + R - G * away**2 / 2)], [(0, -G * away + G * dt / 2)])  # velocity half a step ahead
    state = of.run(state, math.floor((seconds - away) / dt) - 1)
    assert state.vel[0, 0, 1] != 0
    state = of.run(state, 3)
    np.testing.assert_array_equal(state.vel[0, 0], 0)
    assert abs(state.pos[0, 0, 1] - R) < 1e-12
    later = of.run(state, 500)
    np.testing.assert_allclose(later.pos, state.pos, rtol=0, atol=1e-12)
    assert of.run(later, 1).count_of("unsolved") == 0


@pytest.mark.parametrize("response", EXACT)
@pytest.mark.parametrize("gap", [0.0, 0.03])
@pytest.mark.parametrize("sign", [1, -1], ids=["up", "down"])
@pytest.mark.parametrize(
    ("masses", "before", "after"),
    [
        ((1, 1, 1, 1, 1), (1, 0, 0, 0, 0), (0, 0, 0, 0, 1)),
        ((1, 1, 1, 1, 1), (1, 1, 0, 0, 0), (0, 0, 0, 1, 1)),
        ((1, 2, 1), (1, 0, 0), (-1 / 3, 2 / 9, 8 / 9)),
    ],
)
def test_newton_s_cradle(response: str, gap: float, sign: int, masses: Any, before: Any, after: Any) -> None:
    of = scene(masses, response)
    x = sign * np.arange(len(masses)) * (2 * R + gap)
    state = begun(of, np.stack([x, 0 * x], 1), np.stack([sign * np.array(before, float), 0 * x], 1))
    end = of.run(state, 30 + int(2 * gap * len(masses) / of.dt))
    np.testing.assert_allclose(sign * end.vel[0, :, 0], after, rtol=0, atol=1e-12)


@pytest.mark.parametrize("ratio", [1e3, 1e6, 1e12])
@pytest.mark.parametrize("response", EXACT)
def test_collision_of_a_light_and_a_heavy_body_has_the_closed_form(response: str, ratio: float) -> None:
    of = scene([1, ratio], response)
    end = of.run(begun(of, [(0, 0), (1, 0)], [(3, 0), (0, 0)]), 40)
    v = end.vel[0, :, 0]
    np.testing.assert_allclose(v, [3 * (1 - ratio) / (1 + ratio), 6 / (1 + ratio)], rtol=1e-12, atol=1e-13)
    assert abs(v[0] + ratio * v[1] - 3) <= 1e-14 * ratio
    assert abs((v[0] ** 2 + ratio * v[1] ** 2) / 9 - 1) <= 1e-12


@pytest.mark.parametrize("response", EXACT)
def test_equal_balls_separate_at_a_right_angle(response: str) -> None:
    of = scene([1, 1], response)
    end = of.run(begun(of, [(0, 0), (1, 0.08)], [(2, 0), (0, 0)]), 80)
    a, b = end.vel[0]
    assert abs(a @ b) < 1e-12 and min(np.linalg.norm(a), np.linalg.norm(b)) > 0.1


@pytest.mark.parametrize("response", EXACT)
def test_body_on_an_incline_rests_up_to_the_angle_of_friction(response: str) -> None:
    for degrees in (16.6, 16.8, 30.0):
        angle = math.radians(degrees)
        out = np.array([-math.sin(angle), math.cos(angle)])
        plane = (HalfSpace(point=(0.0, 0.0), direction=tuple(out)),)
        of = scene([1], response, e=0.0, g=G, obstacles=plane, friction=0.3)
        steps = 6000 if degrees < 16.7 else 100
        end = of.run(begun(of, [R * out], [(0, 0)]), steps)
        moved, pull = np.linalg.norm(end.pos[0, 0] - R * out), G * (math.sin(angle) - 0.3 * math.cos(angle))
        if degrees < 16.7:
            assert moved < 1e-9
        else:
            assert abs(np.linalg.norm(end.vel[0, 0]) / pull - 1) < 1e-9
            assert abs(moved / (pull / 2) - 1) < (1e-9 if response in IN_TIME else 0.0101)  # half a step, by Euler


@pytest.mark.slow
@pytest.mark.parametrize("response", EXACT)
@pytest.mark.parametrize("method", [VelocityVerlet(), RK4()], ids=lambda m: m.kind)
def test_resting_body_does_not_creep(response: str, method: Integrator) -> None:
    out = np.array([-math.sin(0.2), math.cos(0.2)])
    plane = (HalfSpace(point=(0.0, 0.0), direction=tuple(out)),)
    of = scene([1], response, e=0.3, g=G, dt=0.02, obstacles=plane, friction=0.3, method=method)
    end = of.run(begun(of, [R * out], [(0, 0)]), 500)
    np.testing.assert_allclose(end.pos[0, 0], R * out, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("response", "dt"), [("earliest", 0.01), ("back_up", 0.01), ("impulses", 0.005)])
def test_friction_stops_a_body_at_the_calculated_place_without_reversal(response: str, dt: float) -> None:
    of = scene([1], response, e=0.0, g=G, dt=dt, obstacles=FLOOR, friction=0.4)
    end = of.run(begun(of, [(0, R)], [(3, 0)]), round(2 / dt))
    assert abs(end.pos[0, 0, 0] / 1.14679 - 1) < 0.01
    np.testing.assert_array_equal(end.vel[0, 0], 0)


@pytest.mark.parametrize("response", ["earliest", "impulses"])
@pytest.mark.parametrize("e", [0.0, 0.5])
def test_stack_of_ten_rests(response: str, e: float) -> None:
    of = scene([1] * 10, response, e=e, g=G, dt=1 / 60, obstacles=FLOOR)
    state = begun(of, [(0, R + 2 * R * k) for k in range(10)], np.zeros((10, 2)))
    end = of.run(state, 1200)
    assert np.abs(end.pos - state.pos).max() < 0.01 * R
    assert np.abs(end.vel).max() <= G * of.dt


def test_position_of_a_billiard_ball_equals_the_unfolded_path() -> None:
    of = scene([1], radius=0.0, space=Box(size=(1, 1), restitution=1.0))
    end = of.run(begun(of, [(0.37, 0.2)], [(3.3, 0)]), 1000)
    assert abs(end.pos[0, 0, 0] - 0.63) < 1e-9 and end.count_of("impacts") == 33


# --- no impact is missed ----------------------------------------------------------------------------------------------

AIMED = [(phase / 16, math.radians(-40 + 80 * k / 7)) for phase in range(16) for k in range(8)]


@pytest.mark.parametrize("response", IN_TIME)
@pytest.mark.parametrize(
    ("obstacle", "turn", "home"),
    [
        (Wall(vertices=((0.0, -100.0), (0.0, 100.0))), 0.0, (-2.0, 0.0)),
        (Wall(vertices=((0.0, -100.0), (0.0, 100.0)), velocity=(-30.0, 0.0)), 0.0, (-9.0, 0.0)),
        (Block(centre=(0.05, 0.0), size=(0.1, 200.0)), 0.0, (-2.0, 0.0)),
        (Wall(vertices=((0.0, -50.0), (0.0, 0.0), (-50.0, 0.0))), 45.0, (-0.2, -0.2)),
        pytest.param(Polygon(vertices=((-50.0, 0.0), (0.0, 0.0), (0.0, -50.0), (1.0, -50.0), (1.0, 1.0), (-50.0, 1.0))),
                     45.0, (-0.2, -0.2), marks=pytest.mark.slow),
    ],
    ids=["wall", "moving wall", "block", "corner of walls", "corner of a polygon"],
)  # fmt: skip
def test_fast_body_does_not_tunnel_through_an_obstacle(
    response: str, obstacle: Any, turn: float, home: tuple[float, float]
) -> None:
    of = scene([1] * len(AIMED), response, e=0.5, dt=1 / 60, obstacles=(obstacle,), agents=False)
    directions = np.array([(math.cos(a + math.radians(turn)), math.sin(a + math.radians(turn))) for _, a in AIMED])
    directions = np.clip(directions, 0.05, None) if turn else directions
    back = np.array([2 + 200 / 60 * phase for phase, _ in AIMED])[:, None]
    state = begun(of, np.array(home) - back * directions, 200 * directions)
    end = of.run(state, 5)
    u = np.array(getattr(obstacle, "velocity", None) or (0.0, 0.0))
    here = end.pos[0] - u * end.time[0]
    beyond = here[:, 0] if not turn else here.max(axis=1)
    assert beyond.max() <= -R + 1e-9
    assert end.count_of("impacts") >= 100


@pytest.mark.parametrize("response", IN_TIME)
def test_fast_bodies_do_not_pass_through_each_other(response: str) -> None:
    of = scene([1, 1], response, dt=1 / 60)
    for phase in range(16):
        end = of.run(begun(of, [(-5 - phase * 0.21, 0), (5, 0)], [(200, 0), (-200, 0)]), 6)
        assert end.pos[0, 0, 0] < end.pos[0, 1, 0] - 2 * R
        np.testing.assert_allclose(end.vel[0, :, 0], [-200, 200], rtol=1e-12)


def test_step_over_a_quarter_of_the_torus_keeps_energy_and_raises_a_warning() -> None:
    """Some steps exceed half the edge of 4 m; impacts are on the real path, not on the shorter one across the edge."""
    post = (Circle(centre=(1.0, 2.0), radius=0.2),)
    of = scene([1, 1], dt=1 / 60, space=Torus(size=(4.0, 4.0)), obstacles=post)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for speed in (100.0, 150.0, 200.0, 300.0, 395.0, 450.0):
            state = begun(of, [(0.5, 2.0), (0.3, 2.0)], [(speed, 1.0), (0.0, 0.0)])
            end = of.run(state, 3)
            np.testing.assert_allclose(energy(of, end), energy(of, state), rtol=1e-12)
            assert end.count_of("unsolved") == 3, speed  # each step exceeds a quarter
        slow = of.run(begun(of, [(0.5, 2.0), (0.3, 2.0)], [(50.0, 1.0), (0.0, 0.0)]), 3)
        assert slow.count_of("unsolved") == 0
    assert ["further than a quarter of the torus" in str(w.message) for w in caught] == [True]


def test_chain_of_impacts_within_one_step_includes_distant_bodies() -> None:
    """A fast body hits a row at rest; the impact passes through all of it in one step."""
    of = scene([1] * 6, dt=0.1)
    end = of.run(begun(of, [(0.5 * k, 0) for k in range(6)], [(40, 0)] + [(0, 0)] * 5), 1)
    np.testing.assert_allclose(end.vel[0, :, 0], [0, 0, 0, 0, 0, 40], atol=1e-9)


@pytest.mark.parametrize("period", [0.0, 4.0])
@pytest.mark.parametrize("count", [5, 60, 500])
def test_candidate_pairs_equal_those_of_brute_force(count: int, period: float) -> None:
    rng = np.random.default_rng(count)
    at, radius, living = rng.uniform(0, 4, (count, 2)), rng.uniform(0.01, 0.06, count), rng.random(count) > 0.1
    reach = np.where(rng.random(count) > 0.98, 1.0, 0.01)  # a few move far
    places, one = 50_000, np.zeros(50_000, np.int64)
    other, int32 = np.zeros(places, np.int64), np.int32
    scratch = (
        np.zeros(max(count, 64), np.int64), np.zeros(count, int32), np.zeros(count, int32), np.zeros(count + 1, int32),
        np.zeros((1, count), int32), np.zeros((1, 6)), np.zeros(8, np.int64), np.zeros((27, 3), np.int64),
    )  # fmt: skip
    found = entry(list_near_pairs)(
        (period,) * 2, at, living.astype(np.int64), radius, reach, count, *scratch, one, other
    )
    d = at[:, None] - at[None]
    d -= period * np.floor(d / period + 0.5) if period else 0.0
    room = radius[:, None] + radius[None] + reach[:, None] + reach[None]
    near = (np.linalg.norm(d, axis=-1) <= room) & living[:, None] & living[None]
    expected = {(i, j) for i, j in np.argwhere(near).tolist() if i < j}
    assert found == len(expected)
    assert set(zip(one[:found].tolist(), other[:found].tolist(), strict=True)) == expected


# --- conservation and symmetry ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("response", ALL)
@pytest.mark.parametrize("e", [1.0, 0.6])
def test_gas_conserves_momentum_and_never_gains_energy(response: str, e: float) -> None:
    of, state = gas(response, e, space=Torus(size=(4, 4)))
    mass = of.body.mass[:, None]
    last, first = energy(of, state), energy(of, state)
    for _ in range(30):
        after = of.run(state, 10)
        assert np.abs((mass * (after.vel[0] - state.vel[0])).sum(axis=0)).max() < 1e-12 * of.agents
        assert energy(of, after) <= last * (1 + 1e-12)
        d = of.space.displacement(after.pos[0][:, None], after.pos[0][None])
        apart = np.linalg.norm(d, axis=-1) + 9 * np.eye(of.agents)
        assert apart.min() > 2 * R * (1 - 0.05)
        state, last = after, energy(of, after)
    assert state.count_of("impacts") > 100
    if response in EXACT:
        assert (abs(last / first - 1) < 1e-11) == (e == 1.0)
        assert state.count_of("unsolved") == 0


@pytest.mark.parametrize("response", EXACT)
def test_collisions_do_not_depend_on_the_order_of_bodies(response: str) -> None:
    order = np.random.default_rng(1).permutation(40)
    (one, a), (other, b) = (gas(response, 0.9, order=o, space=Torus(size=(4, 4))) for o in (None, order))
    np.testing.assert_allclose(other.run(b, 100).pos[0], one.run(a, 100).pos[0][order], rtol=0, atol=1e-9)


@pytest.mark.parametrize("response", EXACT)
@pytest.mark.parametrize("offset", [1e4, 1e7])
def test_collisions_far_from_the_origin_equal_those_near_it(response: str, offset: float) -> None:
    (near, a), (far, b) = (gas(response, 0.9, offset=o, obstacles=walls(o)) for o in (0.0, offset))
    steps = 20 if offset > 1e6 else 40  # chaos amplifies a rounding of 1e-9 m in more steps
    np.testing.assert_allclose(far.run(b, steps).pos - offset, near.run(a, steps).pos, rtol=0, atol=1e-6)
    assert near.run(a, steps).count_of("impacts") > 10


@pytest.mark.slow
def test_worlds_and_threads_are_independent() -> None:
    of, state = gas("earliest", 0.8, obstacles=walls())
    batch = of.start(0, worlds=120)
    rng = np.random.default_rng(0)
    batch = batch.with_motion(np.repeat(state.pos, 120, 0), state.vel + rng.normal(size=batch.shape))
    ends = []
    for count in (1, 2, 3):
        use_threads(count)
        try:
            ends.append(of.run(batch, 60))
        finally:
            use_threads(1)
    for end in ends[1:]:
        np.testing.assert_array_equal(end.x, ends[0].x)
        np.testing.assert_array_equal(end.work, ends[0].work)
    alone = of.run(batch.worlds([77]), 60)
    np.testing.assert_array_equal(alone.x[:, 0], ends[0].x[:, 77])
    split = of.run(of.run(batch.worlds([77]), 23), 37)
    np.testing.assert_array_equal(split.x, alone.x)
    np.testing.assert_array_equal(of.run(copy.deepcopy(batch).worlds([77]), 60).v, alone.v)


@pytest.mark.filterwarnings("default::flockenv.core.warnings.UnsolvedContactsWarning")
@pytest.mark.parametrize("response", EXACT)
def test_fifty_bodies_in_one_place_separate_in_no_preferred_direction(response: str) -> None:
    of = scene([1] * 50, response, e=0.5)
    end = of.run(begun(of, np.zeros((50, 2)), np.zeros((50, 2))), 100)
    apart = np.linalg.norm(end.pos[0][:, None] - end.pos[0][None], axis=-1) + 9 * np.eye(50)
    assert apart.min() > 2 * R * (1 - 1e-9)
    assert np.abs(end.vel).max() == 0  # the separation adds no velocity
    assert np.linalg.norm(end.pos[0].mean(axis=0)) < 1e-12
    slow = scene([1] * 50, response, e=0.5, part_speed=1.0)
    after = slow.run(begun(slow, np.zeros((50, 2)), np.zeros((50, 2))), 1)
    assert 0 < np.abs(after.pos).max() <= 49 * 1.0 * slow.dt


def test_dead_bodies_do_not_move_or_collide() -> None:
    of = scene([1, 1, 1])
    state = begun(of, [(0, 0), (0.5, 0), (1.0, 0)], [(5, 0), (0, 0), (0, 0)])
    state.alive[0, 1] = False
    end = of.run(state, 30)
    np.testing.assert_array_equal(end.pos[0, 1], (0.5, 0))
    assert end.vel[0, 2, 0] == pytest.approx(5) and end.count_of("impacts") == 1


def test_sticky_bodies_stay_at_the_point_of_impact() -> None:
    roof = (*FLOOR, Block(centre=(0.0, 1.0), size=(2.0, 0.2)))
    of = scene([1] * 3, e=1.0, g=G, obstacles=roof, sticky=True)
    end = of.run(begun(of, [(-0.5, 3), (0.5, 4), (4, 2)], [(0, -1), (0.5, 0), (1, 0)]), 200)
    np.testing.assert_allclose(end.pos[0, :, 1], [1.1 + R, 1.1 + R, R], atol=1e-9)
    np.testing.assert_array_equal(of.run(end, 100).pos, end.pos)


def test_gas_in_a_hollow_sphere_stays_inside_and_conserves_energy() -> None:
    shell = Circle(centre=(0.0, 0.0), radius=2.0, hollow=True)
    of, state = gas("earliest", 1.0, count=16, obstacles=(shell,))
    state = state.with_motion(0.5 * (state.pos - 2.0), state.vel)
    end = of.run(state, 400)
    assert np.linalg.norm(end.pos[0], axis=1).max() <= 2.0 - R + 1e-9
    assert energy(of, end) == pytest.approx(energy(of, state), rel=1e-11)


@pytest.mark.slow
def test_gas_in_3d_conserves_energy_and_stays_in_the_box() -> None:
    rng = np.random.default_rng(5)
    spawn = Spawn(low=(0, 0, 0), high=(1, 1, 1))
    of = Scene(
        dimension=3, groups=tuple(Group(count=1, mass=m, radius=R, spawn=spawn) for m in rng.uniform(0.5, 2, 40)),
        space=Box(size=(1.5, 1.5, 1.5), restitution=1.0), constraints=(Collisions(restitution=1.0),), dt=0.01,
    )  # fmt: skip
    lattice = np.stack(np.meshgrid(*[np.arange(4)] * 3), -1).reshape(-1, 3)[:40] * 0.33 + 0.2
    state = of.start(0).with_motion(lattice[None], 2 * rng.normal(size=(1, 40, 3)))
    end = of.run(state, 500)
    mass = of.body.mass[:, None]
    assert (mass * end.vel[0] ** 2).sum() == pytest.approx((mass * state.vel[0] ** 2).sum(), rel=1e-11)
    assert end.pos.min() >= R - 1e-9 and end.pos.max() <= 1.5 - R + 1e-9 and end.count_of("impacts") > 500


@pytest.mark.slow
def test_single_precision_follows_double_precision_for_30_steps() -> None:
    (double, a), (single, b) = (gas("earliest", 0.8, obstacles=walls(), dtype=t) for t in ("float64", "float32"))
    end = single.run(b, 30)
    assert end.x.dtype == np.float32
    np.testing.assert_allclose(end.pos, double.run(a, 30).pos, atol=2e-4)


# --- cost and messages ------------------------------------------------------------------------------------------------


def test_collisions_make_one_neighbour_query_per_step() -> None:
    of, state = gas("earliest", 1.0, space=Torus(size=(4, 4)))
    assert of.run(state, 7).count_of("neighbour_queries") == 7
    bare = of.model_copy(update={"constraints": ()})
    end = bare.run(state, 7)
    assert [end.count_of(what) for what in ("neighbour_queries", "impacts", "unsolved", "pairs")] == [0, 0, 0, 0]
    walls_only = of.model_copy(update={"constraints": (Collisions(agents=False),)})
    assert walls_only.run(state, 7).count_of("neighbour_queries") == 0


def test_explain_lists_the_neighbour_query_of_collisions() -> None:
    found = explain(scene([1, 1], obstacles=FLOOR, space=Box(size=(4, 4))))
    assert found.work["neighbour_queries"] == 1
    assert not [line for line in found.left_out if line.startswith(("neighbour query", "pass over obstacles"))]
    assert found.remaining_parts == "semi_implicit_euler, limits, box, collisions"
    alone = explain(scene([1, 1], agents=False, space=Box(size=(4, 4))))
    assert alone.work["neighbour_queries"] == 0
    assert "neighbour query: no effect needs neighbours" in alone.left_out


def test_motion_without_impacts_is_unchanged_by_the_constraint() -> None:
    of, state = gas("earliest", 1.0, count=4, g=G)
    bare = of.model_copy(update={"constraints": ()})
    np.testing.assert_array_equal(of.run(state, 3).x, bare.run(state, 3).x)
    np.testing.assert_array_equal(of.run(state, 3).v, bare.run(state, 3).v)


def test_unsolved_contacts_raise_one_warning() -> None:
    of = scene([1] * 12, g=G, e=0.9, obstacles=FLOOR, most=1, passes=1)
    state = begun(of, [(0, R + 2 * R * k) for k in range(12)], [(0, -3)] * 12)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        end = of.run(state, 20)
    messages = [str(w.message) for w in caught if issubclass(w.category, UnsolvedContactsWarning)]
    assert len(messages) == 1 and "most = 1 and passes = 1" in messages[0]
    assert end.count_of("unsolved") > 0


def test_slow_separation_does_not_count_as_unsolved() -> None:
    """An overlap of 0.15 m is removed at 0.5 m/s in 0.3 s."""
    of = scene([1, 1], part_speed=0.5)
    state = begun(of, [(0, 0), (0.05, 0)], [(0, 0), (0, 0)])
    early, end = of.run(state, 20), of.run(state, 40)
    assert early.pos[0, 1, 0] - early.pos[0, 0, 0] == pytest.approx(0.05 + 0.5 * 0.2, abs=1e-12)
    assert end.pos[0, 1, 0] - end.pos[0, 0, 0] == pytest.approx(2 * R, abs=1e-9)
    assert np.abs(end.vel).max() == 0.0 and end.count_of("unsolved") == 0


def test_scene_with_collisions_is_a_value(tmp_path: Path) -> None:
    of = scene([1, 2], "impulses", e=0.3, friction=0.2, sticky=True, part_speed=2.0, obstacles=FLOOR)
    file = tmp_path / "scene.yaml"
    file.write_text(dump_scene(of))
    assert load_scene(file) == of and pickle.loads(pickle.dumps(of)) == of and hash(of) == hash(copy.copy(of))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"restitution": -0.1}, "restitution = -0.1"),
        ({"restitution": 1.5}, "restitution = 1.5"),
        ({"friction": -1.0}, "friction = -1"),
        ({"most": 0}, "most = 0"),
        ({"passes": 0}, "passes = 0"),
        ({"part_speed": 0.0}, "part_speed = 0"),
        ({"response": "bounce"}, "response = 'bounce'"),
        ({"restituton": 0.1}, "restitution"),
    ],
)
def test_invalid_parameters_are_refused_in_one_line(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match="Collisions: ") as caught:
        Collisions(**given)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_invalid_scenes_with_collisions_are_refused() -> None:
    group = (Group(count=2, radius=0.3, spawn=Spawn(low=(0, 0), high=(1, 1))),)
    with pytest.raises(ValueError, match=r"constraints\[0\]\.kind = collisions: there is another"):
        Scene(groups=group, constraints=(Collisions(), Collisions()))
    with pytest.raises(ValueError, match=r"constraints\[0\]\.kind = collisions: bodies of radius 0.3 m"):
        Scene(groups=group, space=Torus(size=(1, 4)), constraints=(Collisions(),))


def heights(of: Scene, state: State, steps: int) -> Floats:
    return np.array([(state := of.step(state)).pos[0, 0, 1] for _ in range(steps)])


def test_projection_loses_energy() -> None:
    of = scene([1], "project", g=G, dt=0.02, obstacles=FLOOR)
    assert heights(of, begun(of, [(0, 1 + R)], [(0, 0)]), 400)[-50:].max() < 0.9
