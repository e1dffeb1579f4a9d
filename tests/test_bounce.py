"""Bodies bounce off walls: stress cases N05, N06, P19 and closed forms, for every method."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.engine import step_of
from flockenv.geometry.space import Box
from flockenv.jit.thread_pool import use_threads
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Gravity
from flockenv.physics.integrators import RK4, Integrator, SemiImplicitEuler
from flockenv.scene import Group, Scene
from tests.catalogue import INTEGRATORS, Array, IntegratorRow
from tests.kernels import functions_of

pytestmark = pytest.mark.slow
"""These tests compile many kernels."""

G = 9.81
METHODS = pytest.mark.parametrize("row", INTEGRATORS, ids=lambda row: row.name)
ORDERS = [row for row in INTEGRATORS if row.name in ("semi_implicit_euler", "velocity_verlet", "rk4")]
ONE_OF_EACH_ORDER = pytest.mark.parametrize("row", ORDERS, ids=lambda row: row.name)
STEPS = pytest.mark.parametrize("dt", [0.001, 0.005, 0.02])


def hall(pull: tuple[float, ...] = (0.0, -G), size: float = 3.0, e: float = 1.0, **given: Any) -> Scene:
    """Return a scene of bodies under a constant force in a square or cube with walls; scenes differ in numbers only."""
    d = len(pull)
    group = {"count": 1, "radius": 0.0, "spawn": Spawn(low=(0,) * d, high=(size,) * d)}
    group |= {name: given.pop(name) for name in ("count", "radius", "max_speed") if name in given}
    fields = {"integrator": RK4(), "dt": 0.01} | given
    space = Box(size=(size,) * d, restitution=e)
    return Scene(dimension=d, space=space, groups=(Group(**group),), effects=(Gravity(acceleration=pull),), **fields)


def at(scene: Scene, pos: Any, vel: Any) -> State:
    shape = (1, scene.agents, scene.dimension)
    return scene.start(0).with_motion(np.broadcast_to(pos, shape), np.broadcast_to(vel, shape))


def heights(scene: Scene, state: State, seconds: float) -> tuple[Array, Array]:
    """Return height and velocity of all bodies after each step, (K, N)."""
    ends = []
    for _ in range(round(seconds / scene.dt)):
        state = scene.step(state)
        ends.append((state.pos[0, :, 1], state.vel[0, :, 1]))
    y, v = np.array(ends).transpose(1, 0, 2)
    return y, v


def dropped(dt: float, **given: Any) -> tuple[Scene, Array]:
    """Return a scene of 16 balls and their heights, about 1 m: each hits the floor at another phase of a step."""
    scene = hall(dt=dt, count=16, **given)
    return scene, 1 + np.arange(16) / 16 * dt * np.sqrt(2 * G)


def bounced(y: Array) -> list[float]:
    """Return the largest heights between impacts, in order."""
    return [float(y[k]) for k in range(1, len(y) - 1) if y[k] >= y[k - 1] and y[k] > y[k + 1]]


# --- a ball on the floor ----------------------------------------------------------------------------------------------


@STEPS
@METHODS
def test_a_ball_rises_to_e_squared_of_its_height_and_rests_after_a_known_time(row: IntegratorRow, dt: float) -> None:
    """N05: apexes e^(2n) h, T = sqrt(2 h / g) (1 + e) / (1 - e), 4.064 s for e = 0.8 and 1 m."""
    scene, h = dropped(dt, e=0.8, integrator=row.method)
    y, v = heights(scene, at(scene, np.stack([np.full(16, 1.5), h], 1), 0), 4.6)
    assert y.min() >= 0
    for j in range(16):
        np.testing.assert_allclose(bounced(y[:, j])[:4], h[j] * 0.8 ** (2 * np.arange(1, 5)), rtol=0.005)
    rest = np.flatnonzero(((y != 0) | (v != 0)).any(axis=1))[-1] * dt
    assert rest == pytest.approx(np.sqrt(2 * h[-1] / G) * 9, abs=2 * dt + 0.001)
    np.testing.assert_array_equal(np.abs(y[-10:]) + np.abs(v[-10:]), 0)  # P19: no jitter


@ONE_OF_EACH_ORDER
def test_an_elastic_ball_rises_as_high_after_100_bounces(row: IntegratorRow) -> None:
    """N06: within 1 % of h for all methods, exactly from order 2 on. P22: plain reflection would pump it to 29 m."""
    scene, h = dropped(0.02, integrator=row.method)
    y, v = heights(scene, at(scene, np.stack([np.full(16, 1.5), h], 1), 0), 91)
    assert (y.max(axis=0) <= 1.01 * h).all()
    assert (y[-100:].max(axis=0) >= 0.99 * h).all()
    if row.method.order > 1:
        np.testing.assert_allclose(v[-1] ** 2 / 2 + G * y[-1], G * h, rtol=1e-11)
    assert (y >= 0).all()


def test_balls_bounce_and_come_to_rest_in_single_precision() -> None:
    scene, h = dropped(0.02, dtype="float32", integrator=SemiImplicitEuler())
    y, _ = heights(scene, at(scene, np.stack([np.full(16, 1.5), h], 1), 0), 91)
    assert y.dtype == np.float32
    assert (y >= 0).all()
    np.testing.assert_allclose(y[-100:].max(axis=0), h, rtol=1e-3)
    slow = hall((0.0, -G), e=0.8, dt=0.02, count=16, dtype="float32", integrator=SemiImplicitEuler())
    end = slow.run(at(slow, np.stack([np.full(16, 1.5), h], 1), 0), 220)
    np.testing.assert_array_equal(end.pos[0, :, 1], 0)
    np.testing.assert_array_equal(end.vel, 0)


def height_after(t: float, h: float) -> float:
    """Return the height at time t of an elastic ball dropped from h."""
    fall = np.sqrt(2 * h / G)
    since = (t + fall) % (2 * fall)
    return float(G * fall * since - G * since**2 / 2)


@pytest.mark.parametrize("dt", [0.4, 3.0, 10.0])
@pytest.mark.parametrize("row", [row for row in INTEGRATORS if row.method.order > 1], ids=lambda row: row.name)
def test_a_step_with_up_to_20_bounces_ends_at_the_exact_height(row: IntegratorRow, dt: float) -> None:
    scene = hall(dt=dt, integrator=row.method)
    state = at(scene, (1.5, 0.3), 0)
    for k in range(1, 4):
        state = scene.step(state)
        assert state.pos[0, 0, 1] == pytest.approx(height_after(k * dt, 0.3), abs=1e-8)


def test_a_ball_that_would_bounce_more_than_100_times_in_a_step_rests() -> None:
    scene = hall(dt=1e6)
    end = scene.step(at(scene, (1.5, 0.3), 0))
    np.testing.assert_array_equal(end.pos[0, 0], (1.5, 0))
    np.testing.assert_array_equal(end.vel[0, 0], (0, 0))


def test_a_ball_whose_bounces_end_within_a_step_rests_after_it() -> None:
    """P20: for e = 0.99 thousands of impacts."""
    for e in (0.3, 0.8, 0.99):
        total = np.sqrt(2 * 1e-4 / G) * (1 + e) / (1 - e)
        scene = hall(e=e, dt=1.01 * total)
        end = scene.step(at(scene, (1.5, 1e-4), (0.25, 0)))
        np.testing.assert_array_equal(end.pos[0, 0, 1], 0)
        np.testing.assert_array_equal(end.vel[0, 0], (0.25, 0))


def test_an_impact_is_found_even_if_both_ends_of_the_step_are_inside() -> None:
    """The force would also turn the body around, but later than the wall does."""
    scene = hall((0.0, 50.0), e=0.5, dt=0.1)
    end = scene.step(at(scene, (1.5, 0.01), (0, -2.0)))
    impact = np.sqrt(2.0**2 - 2 * 50 * 0.01)
    when = (2.0 - impact) / 50
    left = 0.1 - when
    assert end.pos[0, 0, 1] == pytest.approx(0.5 * impact * left + 25 * left**2, abs=1e-12)
    assert end.vel[0, 0, 1] == pytest.approx(0.5 * impact + 50 * left, abs=1e-12)


@METHODS
def test_a_resting_ball_stays_on_the_floor_until_a_force_lifts_it(row: IntegratorRow) -> None:
    down, up = (hall((0.0, pull), e=0.9, integrator=row.method) for pull in (-G, 2.0))
    state = down.run(at(down, (1.5, 0.0), (0.5, 0)), 50)
    np.testing.assert_allclose(state.pos[0, 0], (1.75, 0), atol=1e-12)
    np.testing.assert_array_equal(state.vel[0, 0, 1], 0)
    lifted = up.run(state, 50)
    assert lifted.vel[0, 0, 1] == pytest.approx(1.0)
    assert lifted.pos[0, 0, 1] == pytest.approx(0.25, abs=0.0101)  # order 1 is off by half a step


# --- walls all around -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.01, 0.1, 2.5])
@METHODS
def test_a_billiard_ball_ends_where_the_unfolded_path_does(row: IntegratorRow, dt: float) -> None:
    """x0 = 0.37, v = 3.3, L = 1, 10 s: 0.63 after 33 bounces."""
    scene = hall((0.0, 0.0), size=1.0, dt=dt, integrator=row.method)
    end = scene.run(at(scene, (0.37, 0.2), (3.3, -0.7)), round(10 / dt))
    np.testing.assert_allclose(end.pos[0, 0], (0.63, 0.8), atol=1e-11)
    np.testing.assert_allclose(end.vel[0, 0], (-3.3, 0.7), rtol=1e-11)


def test_rounding_in_single_precision_adds_no_speed() -> None:
    """Far from the origin, differences of positions are less accurate than velocities."""
    scene = hall((0.0, 0.0), size=9000.0, dt=1e-3, dtype="float32", integrator=SemiImplicitEuler())
    for speed in np.linspace(100, 130, 20):
        end = scene.run(at(scene, (8999.5, 3.0), (speed, 0)), 10)
        assert end.vel[0, 0, 0] == -np.float32(speed)


def test_a_corner_reverses_the_velocity_and_a_radius_keeps_its_distance() -> None:
    scene = hall((0.0, 0.0, 0.0), e=0.5, dt=1.0, radius=0.25)
    end = scene.step(at(scene, (0.75, 0.75, 0.75), (-1, -1, -1)))
    np.testing.assert_allclose(end.pos[0, 0], 0.5, rtol=1e-12)
    np.testing.assert_allclose(end.vel[0, 0], 0.5, rtol=1e-12)
    end = scene.step(at(scene, (2.25, 1, 1), (1, -0.5, 0)))
    np.testing.assert_allclose(end.pos[0, 0], (2.5, 0.5, 1), rtol=1e-12)
    np.testing.assert_allclose(end.vel[0, 0], (-0.5, -0.5, 0), rtol=1e-12)


def test_bounces_leave_the_motion_along_the_wall_unchanged() -> None:
    scene, _ = dropped(0.02, e=0.7)
    state = at(scene, (0.5, 0.3), (0.37, -2.0))
    free = at(scene, (0.5, 1.5), (0.37, 0.0))
    wall, open_air = scene.run(state, 20), scene.run(free, 20)
    assert wall.vel[0, 0, 1] > -2
    np.testing.assert_array_equal(wall.x[0], open_air.x[0])
    np.testing.assert_array_equal(wall.v[0], open_air.v[0])


@pytest.mark.parametrize("turn", ["quarter", "mirror"])
def test_bounces_are_the_same_at_every_wall(turn: str) -> None:
    matrix = np.array([[0.0, -1], [1, 0]]) if turn == "quarter" else np.diag([-1.0, 1.0])
    rng = np.random.default_rng(0)
    pos, vel, pull = rng.uniform(0, 3, (50, 2)), rng.normal(size=(50, 2)) * 5, np.array([1.5, -7.0])
    turned = (pos - 1.5) @ matrix.T + 1.5
    scenes = [hall(tuple(map(float, p)), count=50, e=0.9, dt=0.1) for p in (pull, matrix @ pull)]
    end = scenes[0].run(at(scenes[0], pos, vel), 40)
    other = scenes[1].run(at(scenes[1], turned, vel @ matrix.T), 40)
    np.testing.assert_allclose(other.pos, (end.pos - 1.5) @ matrix.T + 1.5, atol=1e-9)
    np.testing.assert_allclose(other.vel, end.vel @ matrix.T, atol=1e-8)


def test_bounces_in_a_batch_and_with_two_threads_give_the_same_bits() -> None:
    scene = hall(count=4500, e=0.9)
    batch = scene.run(scene.start(3, worlds=3), 60)
    assert (batch.x[1] > 0).any()
    for k in range(3):
        np.testing.assert_array_equal(scene.run(scene.start(3 + k), 60).x[:, 0], batch.x[:, k])
    before = scene.run(scene.start(3), 60)
    try:
        use_threads(2)
        after = scene.run(scene.start(3), 60)
        apart = scene.start(3)
        for _ in range(60):
            apart = scene.step(apart)
    finally:
        use_threads(1)
    np.testing.assert_array_equal(after.x, before.x)
    np.testing.assert_array_equal(after.v, before.v)
    np.testing.assert_array_equal(apart.v, before.v)


@pytest.mark.parametrize("method", [RK4(), SemiImplicitEuler()], ids=lambda method: method.kind)
def test_bodies_bounce_equally_in_large_and_small_worlds(method: Integrator) -> None:
    many, few = (hall(count=count, e=0.9, integrator=method) for count in (2000, 50))
    rng = np.random.default_rng(2)
    pos, vel = rng.uniform(0, 3, (2000, 2)), rng.normal(size=(2000, 2)) * 5
    end = many.run(at(many, pos, vel), 60)
    for first in range(0, 2000, 50):
        some = slice(first, first + 50)
        alone = few.run(at(few, pos[some], vel[some]), 60)
        np.testing.assert_array_equal(end.pos[0, some], alone.pos[0])
        np.testing.assert_array_equal(end.vel[0, some], alone.vel[0])


@pytest.mark.parametrize(("dtype", "widest"), [("float64", 150), ("float32", 18)])
@pytest.mark.parametrize("dt", [1e-9, 0.01, 1e6])
def test_bodies_stay_inside_and_finite_for_extreme_numbers(dtype: str, widest: int, dt: float) -> None:
    rng = np.random.default_rng(1)
    count = 2000
    scene = hall((3.0, -G), count=count, e=0.9, dt=dt, dtype=dtype, integrator=SemiImplicitEuler())
    pos = rng.choice([0, 3, 1e-300, 3 - 1e-15, 1.5, 5e-324, -1, 4], (count, 2)) * 1.0
    size = 10.0 ** rng.uniform(-2 * widest, widest, (count, 2))
    vel = np.where(rng.random((count, 2)) < 0.2, 0, rng.choice([-1, 1], (count, 2)) * size)
    state = at(scene, pos.astype(dtype), np.clip(vel, -(10.0**widest) / max(dt, 1), 10.0**widest / max(dt, 1)))
    for _ in range(20):
        state = scene.step(state)
        assert np.isfinite(state.vel).all()
        assert (state.pos >= 0).all()
        assert (state.pos <= 3).all()


def test_a_body_at_the_wall_at_the_end_of_a_step_is_not_rounded_out_of_the_box() -> None:
    rng = np.random.default_rng(2)
    scene = hall(count=2000)
    speed = G * scene.dt / 2 / rng.integers(1, 12, 2000) * (1 + rng.integers(-3, 4, 2000) * 2.2e-16)
    state = at(scene, np.tile((1.5, 0.0), (2000, 1)), np.stack([speed * 0, speed], axis=1))
    for _ in range(50):
        state = scene.step(state)
        assert (state.pos >= 0).all()
    np.testing.assert_allclose(np.hypot(state.vel[0, :, 1], np.sqrt(2 * G * state.pos[0, :, 1])), speed, rtol=1e-9)


def test_a_body_outside_is_put_at_the_wall() -> None:
    scene = hall((0.0, 0.0), dt=0.1, radius=0.5)
    end = scene.step(at(scene, (4.0, -1.0), (-2.0, -3.0)))
    np.testing.assert_array_equal(end.pos[0, 0], (2.5, 0.5))
    np.testing.assert_array_equal(end.vel[0, 0], (-2, 0))


def test_the_speed_limit_holds_after_an_impact() -> None:
    scene, h = dropped(0.02, max_speed=2, integrator=SemiImplicitEuler())
    state = at(scene, np.stack([np.full(16, 1.5), h], 1), 0)
    for _ in range(200):
        before, state = state, scene.step(state)
        assert np.linalg.norm(state.vel, axis=2).max() <= 2 * (1 + 1e-12)
        assert np.linalg.norm(state.pos - before.pos, axis=2).max() <= 2 * 0.02 * (1 + 1e-9)


def test_dead_agents_do_not_move() -> None:
    scene = hall(count=2)
    state = at(scene, (1.0, 0.003), (0, -5.0))
    state.alive[0, 1] = False
    end = scene.run(state, 3)
    np.testing.assert_array_equal(end.pos[0, 1], (1, 0.003))
    assert end.pos[0, 0, 1] > 0.003


# --- restitution, which is 0 for a wall that stops bodies -------------------------------------------------------------


def test_walls_of_restitution_0_stop_bodies_without_code_for_bounces() -> None:
    still, some, more = (hall(e=e) for e in (0.0, 0.5, 1.0))
    assert functions_of(some) - functions_of(still) == {some.space.bounce_law.__name__}  # type: ignore[union-attr]
    assert step_of(some.parts) is step_of(more.parts)
    end = still.run(at(still, (1.5, 0.01), (1.0, -3)), 3)
    np.testing.assert_array_equal(end.pos[0, 0, 1], 0)
    np.testing.assert_array_equal(end.vel[0, 0, 1], 0)


@pytest.mark.parametrize("restitution", [-0.1, 1.1, float("nan"), "0.5", True])
def test_an_invalid_restitution_is_refused_in_one_line(restitution: Any) -> None:
    with pytest.raises(ValueError, match="restitution") as caught:
        Box(size=(1, 1), restitution=restitution)
    assert "\n" not in str(caught.value)
