"""Solid bodies never pass each other in any response, and energy is conserved even if impacts reach their limit."""

from __future__ import annotations

import itertools
import math
import warnings
from typing import Any, cast

import numpy as np
import pytest

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.geometry.shapes import Block, Capsule, HalfSpace, Wall
from flockenv.geometry.space import Box, Plane, Space
from flockenv.model.spawn import Spawn
from flockenv.model.state import Floats, State
from flockenv.physics.constraints import Collisions
from flockenv.physics.constraints.step_end import RAISED
from flockenv.physics.effects import Gravity
from flockenv.physics.integrators import VelocityVerlet
from flockenv.scene import Group, Scene

pytestmark = pytest.mark.filterwarnings("ignore::flockenv.core.warnings.UnsolvedContactsWarning")

IN_TIME = ("earliest", "back_up")
EXACT = (*IN_TIME, "impulses")
ALL = (*EXACT, "project")
R, G = 0.1, 9.81


def scene(
    masses: Any, response: str, *, e: float = 1.0, dt: float = 0.001, pull: float = 0.0, dimension: int = 2,
    radius: float = R, obstacles: Any = (), space: Space | None = None, dtype: str = "float64", **rules: Any,
) -> Scene:  # fmt: skip
    """Return balls of these masses under gravity along the second axis."""
    spawn = Spawn(low=(0,) * dimension, high=(1,) * dimension)
    down = (0.0, -pull, 0.0)[:dimension]
    return Scene(
        dimension=dimension, groups=tuple(Group(count=1, mass=float(m), radius=radius, spawn=spawn) for m in masses),
        effects=(Gravity(acceleration=down),), obstacles=tuple(obstacles), space=space or Plane(), dt=dt, dtype=dtype,
        integrator=VelocityVerlet(),
        constraints=(Collisions(response=response, restitution=e, **rules),),
    )  # fmt: skip


def line(of: Scene, x: Any, v: Any) -> State:
    """Return bodies on the first axis at x, m, with velocities v, m/s."""
    pos, vel = np.zeros((2, 1, len(x), of.dimension))
    pos[0, :, 0], vel[0, :, 0] = x, v
    return of.start(0).with_motion(pos, vel)


def gaps(state: State, radius: float = R) -> Floats:
    """Return the gaps between neighbours on the first axis, in the order of their numbers, m."""
    return np.diff(np.asarray(state.pos[0, :, 0], float)) - 2 * radius


def kinetic(of: Scene, state: State) -> float:
    return float((of.body.mass[:, None] * np.asarray(state.vel[0], float) ** 2).sum() / 2)


def billiard(masses: Any, x: Any, v: Any, seconds: float) -> tuple[Floats, int]:
    """Return velocities of two elastic balls in front of a wall at x = 0 after some time, and the number of impacts."""
    (m, n), (x, y), (v, w), done = masses, map(float, x), map(float, v), 0
    while True:
        wall = (x - R) / -v if v < 0 else math.inf
        pair = (y - x - 2 * R) / (v - w) if v > w else math.inf
        t = min(wall, pair)
        if t > seconds:
            return np.array([v, w]), done
        x, y, seconds, done = x + v * t, y + w * t, seconds - t, done + 1
        if wall < pair:
            v = -v
        else:
            v, w = ((m - n) * v + 2 * n * w) / (m + n), ((n - m) * w + 2 * m * v) / (m + n)


# --- a light body between a heavy one and a wall: a thousand impacts in a few steps -----------------------------------

SQUEEZED = [
    pytest.param((1, 1e6), (1.1, 2.3), (0, -1), 12.0, marks=pytest.mark.slow),
    ((1, 1e4), (1.1, 2.3), (0, -1), 12.0),
    ((1e4, 1), (1.1, 2.3), (0, -50), 1.0),
    ((1e4, 1), (1.1, 2.3), (1, -3), 3.0),
    ((3, 7), (0.6, 1.3), (-2, -1), 3.0),
]


@pytest.mark.parametrize("response", ALL)
@pytest.mark.parametrize(("masses", "x", "v", "seconds"), SQUEEZED)
def test_a_body_between_another_and_a_wall_stays_there(
    response: str, masses: Any, x: Any, v: Any, seconds: float
) -> None:
    of = scene(masses, response, obstacles=(HalfSpace(point=(0.0, 0.0), direction=(1.0, 0.0)),))
    state = line(of, x, v)
    first = last = kinetic(of, state)
    for _ in range(round(seconds / of.dt)):
        state = of.step(state)
        now = kinetic(of, state)
        assert min(gaps(state)[0], state.pos[0, 0, 0] - R) > -(0.05 if response in EXACT else 0.6) * R
        assert now <= last * (1 + 1e-10)
        last = now
    if response in EXACT:
        assert last == pytest.approx(first, rel=1e-11)
    if response in IN_TIME:
        velocities, impacts = billiard(masses, x, v, seconds)
        np.testing.assert_allclose(state.vel[0, :, 0], velocities, rtol=1e-9, atol=1e-6)
        assert state.count_of("impacts") == impacts


def test_a_mass_ratio_of_a_million_gives_3141_impacts() -> None:
    """The number has the digits of pi (Galperin 2003)."""
    assert billiard((1, 1e6), (1.1, 2.3), (0, -1), 12.0)[1] == 3141


@pytest.mark.parametrize(
    ("dimension", "dtype"),
    [(2, "float64"), *(pytest.param(d, t, marks=pytest.mark.slow) for d, t in ((3, "float64"), (2, "float32")))],
)
@pytest.mark.parametrize("response", EXACT)
def test_five_bodies_between_walls_keep_their_order_and_energy(response: str, dimension: int, dtype: str) -> None:
    size = (2.0, 1.0, 1.0)[:dimension]
    of = scene(
        [1, 1e4, 0.1, 10, 1], response, dimension=dimension, dtype=dtype, space=Box(size=size, restitution=1.0), dt=0.01
    )
    state = line(of, (0.2, 0.6, 1.0, 1.4, 1.8), (9, -2, 0, 1, -5))
    state = state.with_motion(state.pos + np.array([0.0, 0.5, 0.5][:dimension]), state.vel)
    first, rounding = kinetic(of, state), 1e-11 if dtype == "float64" else 1e-4
    for _ in range(400):
        state = of.step(state)
        assert gaps(state).min() > -0.05 * R
        assert state.pos[0, :, 0].min() > R - 0.05 * R and state.pos[0, :, 0].max() < 2.0 - R + 0.05 * R
        assert kinetic(of, state) == pytest.approx(first, rel=rounding)


@pytest.mark.parametrize("most", [1, 3])
@pytest.mark.parametrize("response", IN_TIME)
def test_bodies_stopped_at_the_limit_of_impacts_keep_momentum_and_energy(response: str, most: int) -> None:
    masses = np.array([1000.0, 1, 1, 1, 1000])
    of = scene(masses, response, dt=0.05, most=most)
    state = line(of, (-0.5, -0.28, 0, 0.28, 0.5), (4, 0, 0, 0, -4))
    first, momentum = kinetic(of, state), masses @ state.vel[0, :, 0]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnsolvedContactsWarning)
        for _ in range(200):
            state = of.step(state)
            assert gaps(state).min() > -1e-9
            assert kinetic(of, state) == pytest.approx(first, rel=1e-11)
            assert masses @ state.vel[0, :, 0] == pytest.approx(momentum, abs=1e-8)
    assert state.count_of("stopped") > 0
    (message,) = [str(w.message) for w in caught]
    assert "bodies stopped" in message and "keep their velocities" in message


def test_energy_lost_at_the_limit_of_impacts_is_reported() -> None:
    """A disc settles on another one on the floor, slower than the speed that gravity adds in a step."""
    floor = (HalfSpace(point=(0.0, 0.0), direction=(0.0, 1.0)),)
    of = scene([1, 1], "earliest", dt=0.005, pull=G, obstacles=floor, most=1)
    state = of.start(0).with_motion([[[0.0, R], [0.0, 3 * R]]], [[[0.0, 0.0], [0.0, -0.02]]])
    with pytest.warns(UnsolvedContactsWarning, match=r"most = 1 and .*; [\d.e-]+ J lost by bodies that came to rest"):
        of.run(state, 5)


# --- fast or thin bodies ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("response", ALL)
@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_body_that_moves_many_times_its_width_in_a_step_passes_nothing(response: str, dimension: int) -> None:
    """It moves 3.3 m per step, towards a row of discs at rest and a thin wall behind them."""
    thin = Capsule(start=(9.0, -5.0), end=(9.0, 5.0), radius=0.01)
    block = Block(centre=(9.05,) + (0.0,) * (dimension - 1), size=(0.1,) + (10.0,) * (dimension - 1))
    for phase in range(8):
        of = scene(
            [1, 2, 3, 4],
            response,
            e=0.5,
            dt=1 / 60,
            dimension=dimension,
            obstacles=(thin if dimension == 2 else block,),
        )
        state = line(of, (-2 - 0.41 * phase, 0, 0.9, 3.7), (200, 0, 0, 0))
        for _ in range(60):
            state = of.step(state)
            assert gaps(state).min() > -(0.06 if response in EXACT else 0.5) * R
            assert state.pos[0, 3, 0] < 9.0
        assert np.isfinite(state.vel).all() and state.count_of("impacts") > 0


@pytest.mark.parametrize("response", ALL)
def test_no_body_is_left_behind_a_fast_thin_wall(response: str) -> None:
    wall = Wall(vertices=((-1.0, -5.0), (-1.0, 5.0)), velocity=(50.0, 0.0))  # 0.83 m per step
    of = scene([1, 1], response, e=0.5, dt=1 / 60, obstacles=(wall,))
    for phase in range(8):
        state = line(of, (0.1 * phase, 0.1 * phase + 0.6), (0, 0))
        for k in range(20):
            state = of.step(state)
            assert state.pos[0, 0, 0] > -1 + 50 * (k + 1) / 60
            assert gaps(state).min() > -0.5 * R
        assert (state.vel[0, :, 0] > 40).all()


@pytest.mark.parametrize("response", ALL)
def test_a_body_sticks_to_a_fast_wall(response: str) -> None:
    """It moves on with the wall, whether the impact is found within the step or at its end."""
    wall = Wall(vertices=((-1.0, -5.0), (-1.0, 5.0)), velocity=(30.0, 0.0))  # 1.5 m per step
    of = scene([1], response, e=0.3, dt=0.05, obstacles=(wall,), sticky=True)
    state = of.run(line(of, (0.0,), (0,)), 10)
    assert state.vel[0, 0, 0] == pytest.approx(30)
    assert state.pos[0, 0, 0] == pytest.approx(-1 + 30 * 0.5 + R, abs=0.1 * R)


@pytest.mark.parametrize("response", ALL)
@pytest.mark.parametrize("mass", [1.0, 1e4])
def test_a_row_of_bodies_pushed_by_a_wall_keeps_its_order(response: str, mass: float) -> None:
    """The bodies touch at the start; the wall moves at 2 m/s."""
    wall = Wall(vertices=((-R, -5.0), (-R, 5.0)), velocity=(2.0, 0.0))
    of = scene([1, mass, 1], response, e=0.0, dt=0.005, obstacles=(wall,))
    state = line(of, (0.0, 0.2, 0.4), (0, 0, 0))
    for k in range(200):
        state = of.step(state)
        assert gaps(state).min() > -(0.05 if response in EXACT else 0.6) * R
        assert state.pos[0, 0, 0] > -R + 0.01 * (k + 1)


@pytest.mark.parametrize("response", EXACT)
def test_a_body_at_rest_on_another_is_not_driven_through_it(response: str) -> None:
    """A ball lies on another one on the floor; a heavy one hits it from above, with large steps."""
    floor = (HalfSpace(point=(0.0, 0.0), direction=(0.0, 1.0)),)
    for dt, speed in itertools.product((0.01, 0.05), (1.0, 40.0)):
        of = scene([1, 1, 1e4], response, e=0.3, dt=dt, pull=G, obstacles=floor)
        pos = np.array([[[0.0, R], [0.0, 3 * R], [0.0, 5 * R + 1.5 * speed * dt]]])
        state = of.start(0).with_motion(pos, [[[0, 0], [0, 0], [0, -speed]]])
        for _ in range(100):
            state = of.step(state)
            heights = state.pos[0, :, 1]
            assert min(heights[0] - R, (np.diff(heights) - 2 * R).min()) > -0.06 * R


@pytest.mark.parametrize("response", IN_TIME)
@pytest.mark.parametrize(("speed", "friction", "e"), [(1, 0, 0.5), (1, 0.3, 0.5), (3, 0, 0), (1, 0, 1)])
def test_a_ball_slides_over_collinear_pieces_of_a_wall(response: str, speed: float, friction: float, e: float) -> None:
    wall = Wall(vertices=((-5.0, 0.0), (0.0, 0.0), (1.0, 0.0), (5.0, 0.0)))
    of = scene([1], response, e=e, dt=0.01, pull=G, friction=friction, obstacles=(wall,))
    state = of.start(0).with_motion([[[-1.03, R]]], [[[speed, 0.0]]])
    end = of.run(state, 200)
    assert end.count_of("unsolved") == 0 and end.count_of("stopped") == 0
    distance = 2.0 * speed if not friction else speed**2 / (2 * friction * G)
    np.testing.assert_allclose(end.pos[0, 0], [-1.03 + distance, R], rtol=0, atol=1e-2 if friction else 1e-9)


# --- piles ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("response", EXACT)
@pytest.mark.parametrize(
    ("count", "e", "friction", "dt"),
    [(3, 0.5, 0.3, 0.005), (3, 0.2, 0.3, 0.005), (3, 0.8, 0.3, 0.005), (3, 0.5, 0.0, 0.005), (3, 0.5, 0.3, 0.001),
     (3, 0.0, 0.3, 0.005), (4, 0.5, 0.3, 0.005), pytest.param(6, 0.5, 0.3, 0.005, marks=pytest.mark.slow),
     pytest.param(11, 0.5, 0.3, 0.005, marks=pytest.mark.slow)],
)  # fmt: skip
def test_bodies_that_lean_on_each_other_come_to_rest(
    response: str, count: int, e: float, friction: float, dt: float
) -> None:
    """Discs between two walls, each on the one below, for 7 s; free fall would reach g t = 69 m/s."""
    size = (0.5, 5.0)
    of = scene(
        [1] * count, response, e=e, dt=dt, pull=G, radius=0.15, friction=friction, space=Box(size=size, restitution=e)
    )
    k = np.arange(count)
    pos = np.stack([np.where(k % 2, 0.35, 0.15), 0.16 + 0.34 * k], axis=1)
    state = of.start(0).with_motion(pos[None], np.zeros((1, count, 2)))
    for step in range(round(7 / dt / 10)):
        state = of.run(state, 10)
        assert overlap(state.pos[0], 0.15, size) < 0.01 * 0.15
        if step * 10 * dt > 5:
            assert np.linalg.norm(state.vel[0], axis=1).max() <= G * dt
    assert (np.diff(state.pos[0, :, 1]) > 0).all(), "they lie in their initial order"


def overlap(pos: Floats, radius: float, size: Any) -> float:
    """Return the largest overlap of two bodies, or of a body and a wall of the box, m."""
    pos = np.asarray(pos, float)
    apart = np.linalg.norm(pos[:, None] - pos[None], axis=-1) + 9 * np.eye(len(pos))
    walls = min(pos.min(), (np.array(size) - pos).min())
    return float(max(2 * radius - apart.min(), radius - walls))


# --- random scenes ----------------------------------------------------------------------------------------------------


def passes(before: Floats, after: Floats, room: float) -> bool:
    """Return True if a pair has swapped sides and on its path came nearer than half of `room`."""
    a, b = (x[:, None] - x[None] for x in (np.asarray(before, float), np.asarray(after, float)))
    path = b - a
    share = np.clip(-(a * path).sum(-1) / np.maximum((path**2).sum(-1), 1e-300), 0, 1)
    nearest = np.linalg.norm(a + share[..., None] * path, axis=-1) + 9 * np.eye(len(before))
    return bool(((nearest < room / 2) & ((a * b).sum(-1) < 0)).any())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("response", ALL)
@pytest.mark.parametrize("dimension", [2, 3])
def test_bodies_in_random_scenes_do_not_overlap_pass_or_gain_energy(response: str, dimension: int, seed: int) -> None:
    """Random masses, restitution, friction, gravity, speeds and steps, in a box."""
    rng = np.random.default_rng(100 * dimension + seed)
    count, e = 24, float(rng.choice([0.0, 0.4, 0.8, 1.0]))
    pull, dt = float(rng.choice([0.0, G])), float(rng.choice([0.002, 0.01]))
    size = (1.6, 1.6, 1.6)[:dimension]
    of = scene(
        10.0 ** rng.uniform(-1, 2, count), response, e=e, dt=dt, pull=pull,
        dimension=dimension,
        friction=float(rng.choice([0.0, 0.5])), space=Box(size=size, restitution=e),
    )  # fmt: skip
    grid = np.stack(np.meshgrid(*[np.arange(5)] * dimension), -1).reshape(-1, dimension)
    pos = 0.2 + 0.3 * grid[rng.choice(len(grid), count, replace=False)]
    vel = rng.normal(size=pos.shape) * rng.choice([1.0, 5.0])
    state = of.start(0).with_motion(pos[None], vel[None])
    mass, last = of.body.mass, np.inf
    for _ in range(200):
        before, before_v, state = state.pos[0].copy(), state.vel[0].copy(), of.step(state)
        assert overlap(state.pos[0], R, size) < (0.06 if response in EXACT else 0.26) * R
        slow = np.abs(np.concatenate([state.vel[0], before_v])).max() * dt < R  # faster ones may move around each other
        assert not slow or not passes(before, state.pos[0], 2 * R)
        now = kinetic(of, state) + float((mass * pull * state.pos[0, :, 1]).sum())
        lift = float(mass.sum()) * pull * (0.01 if response in EXACT else 0.3) * R  # moving bodies apart may raise them
        if response not in IN_TIME:  # impacts at the end of a step are up to one step of free fall late
            lift += float((mass * pull * dt * np.linalg.norm(before_v, axis=1)).sum())
        assert now <= last * (1 + 1e-9) + lift
        last = now


# --- crowds of very uneven masses -------------------------------------------------------------------------------------


def crowd(seed: int, response: str, pull: float = G) -> tuple[Scene, State]:
    """Return 40 discs of masses 1 to 1,000 that cover half of a box."""
    rng, count, e = np.random.default_rng(seed), 40, [0.0, 0.4, 0.8, 1.0][seed % 4]
    size = (1.6, 1.6)
    of = scene(10.0 ** rng.uniform(0, 3, count), response, e=e, dt=0.01, pull=pull, space=Box(size=size, restitution=e))
    grid = np.stack(np.meshgrid(np.arange(7), np.arange(7)), -1).reshape(-1, 2)
    pos = 0.11 + 0.23 * grid[rng.choice(len(grid), count, replace=False)]
    return of, of.start(0).with_motion(pos[None], rng.normal(size=(1, count, 2)))


@pytest.mark.parametrize("response", ["impulses", "project"])
@pytest.mark.parametrize("seed", range(12))
def test_heavy_bodies_do_not_push_light_ones_past_others(response: str, seed: int) -> None:
    """`project` once did so when it moved bodies apart."""
    of, state = crowd(seed, response)
    for _ in range(200):
        before, state = state.pos[0].copy(), of.step(state)
        assert not passes(before, state.pos[0], 2 * R)
        assert overlap(state.pos[0], R, (1.6, 1.6)) < (0.26 if response == "project" else 0.06) * R


@pytest.mark.parametrize("pull", [0.0, G])
@pytest.mark.parametrize("response", ["impulses", "project"])
def test_energy_added_by_moving_bodies_apart_is_counted(response: str, pull: float) -> None:
    """No step gains more than that energy and an error of one step of free fall; both are 0 without gravity."""
    for seed in range(4):
        of, state = crowd(seed, response, pull)
        mass, last = of.body.mass, np.inf
        for _ in range(200):
            fast, state = np.linalg.norm(state.vel[0], axis=1), of.step(state)
            now = kinetic(of, state) + float((mass * pull * state.pos[0, :, 1]).sum())
            (settler,) = cast(Any, of.stepper._settlers(1)[0])
            falling = float((mass * pull * of.dt * fast).sum())
            assert now <= last * (1 + 1e-9) + settler.lost[RAISED] + falling
            last = now


def test_a_warning_names_the_energy_added_by_moving_bodies_apart() -> None:
    of, state = crowd(0, "project")
    with pytest.warns(UnsolvedContactsWarning, match=r"; up to [\d.e+-]+ J gained by bodies that were moved apart"):
        of.run(state, 200)
