"""Methods on hard problems: order with forces of time, stability limits, orbits, drag, adaptive steps.

Properties that all methods share are in test_integrators.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal, localcontext
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.special import ellipj, ellipk

from flockenv.jit.thread_pool import use_threads
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.spawn import Spawn
from flockenv.model.state import State, blank
from flockenv.physics.integrators import (
    RK4,
    AdaptiveRK4,
    DormandPrince,
    ExponentialDrag,
    Heun,
    Integrator,
    Midpoint,
    SemiImplicitEuler,
    VelocityVerlet,
)
from flockenv.physics.integrators.exponential_drag import phi_functions
from flockenv.physics.integrators.step_size import TRIES, Clock, excess_square, initial_clock, next_clock
from flockenv.scene import Group, Scene
from tests.catalogue import INTEGRATORS, Array, IntegratorRow
from tests.motion import METHODS, V0, WAYS, X0, at_start, first_of, motion, order, tethered

ADAPTIVE = pytest.mark.parametrize(
    "kind", [pytest.param(AdaptiveRK4, marks=pytest.mark.slow), DormandPrince], ids=lambda kind: kind.__name__
)
HERE = Spawn(low=(0, 0), high=(1, 1))


# --- orders (N02; the damped oscillator is in test_integrators.py) ----------------------------------------------------


def forced(t: float) -> tuple[float, float]:
    """x'' = -x + cos 2t."""
    x = (X0 + 1 / 3) * math.cos(t) + V0 * math.sin(t) - math.cos(2 * t) / 3
    return x, -(X0 + 1 / 3) * math.sin(t) + V0 * math.cos(t) + 2 / 3 * math.sin(2 * t)


def pendulum(t: float) -> tuple[float, float]:
    """x'' = -sin x from rest at 60 degrees: sin(x / 2) = k cd(t), k = sin 30 degrees."""
    k = math.sin(math.pi / 6)
    sn, cn, dn, _ = ellipj(t, k * k)
    x = 2 * math.asin(k * cn / dn)
    return x, -2 * k * (1 - k * k) * sn / dn**2 / math.cos(x / 2)


PROBLEMS: dict[str, tuple[dict[str, float], Callable[[float], tuple[float, float]], float]] = {
    "forced": ({"stiffness": 1, "push": 1}, forced, 4.4),
    "pendulum": ({"sine": 1, "pos": math.pi / 3, "vel": 0}, pendulum, 3.1),
}


@WAYS
@METHODS
@pytest.mark.parametrize("problem", ["forced", pytest.param("pendulum", marks=pytest.mark.slow)])
def test_the_order_is_the_declared_one_on_harder_problems(
    problem: str, row: IntegratorRow, way: str, tether: Any
) -> None:
    given, exact, seconds = PROBLEMS[problem]
    end = tethered(tether, way, **given)
    measured = order(end, row.fixed, exact(seconds), seconds, first_of(row.method))
    assert measured == pytest.approx(row.method.order, abs=0.2)


def test_the_exact_solutions_solve_their_equations() -> None:
    h = 1e-4
    for given, exact, seconds in PROBLEMS.values():
        law = {"stiffness": 0.0, "push": 0.0, "sine": 0.0} | given
        (before, _), (x, v), (after, _) = (exact(seconds + k * h) for k in (-1, 0, 1))
        force = -law["stiffness"] * x + law["push"] * math.cos(2 * seconds) - law["sine"] * math.sin(x)
        assert (after - before) / (2 * h) == pytest.approx(v, abs=1e-7)
        assert (after - 2 * x + before) / h**2 == pytest.approx(force, abs=1e-6)
        assert exact(0.0) == pytest.approx((law.get("pos", X0), law.get("vel", V0)))
    assert PROBLEMS["pendulum"][2] / (4 * ellipk(0.25)) == pytest.approx(0.46, abs=0.01)  # periods, no integer


def test_heun_and_midpoint_differ_only_if_forces_depend_on_time(tether: Any) -> None:
    """On linear autonomous problems they are the same method."""
    end = tethered(tether, "python", stiffness=1, push=1)
    errors = [math.dist(motion(end(method, 0.01, 200)), forced(2.0)) for method in (Heun(), Midpoint())]
    assert errors[1] > 1.5 * errors[0]
    end = tethered(tether, "python", stiffness=1, damping=0.2)
    ends = [motion(end(method, 0.01, 440)) for method in (Heun(), Midpoint())]
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-12)


@pytest.mark.slow
@METHODS
def test_the_velocity_of_a_medium_is_integrated_to_the_order_of_the_method(row: IntegratorRow) -> None:
    """x' = v + u with u = -x / 2 + 5 cos 2t and v = 0."""

    def end(method: Integrator, dt: float, steps: int) -> State:
        state = at_start(blank(1, 1, 2, 0, dt), vel=0.0)
        for _ in range(steps):
            state = method(lambda x, v, t: 0 * x, state, dt, flow=lambda x, t: -x / 2 + 5 * math.cos(2 * t))
        return state

    seconds, a, b = 2.3, 10 / 17, 40 / 17  # a particular solution is a cos 2t + b sin 2t
    target = (X0 - a) * math.exp(-seconds / 2) + a * math.cos(2 * seconds) + b * math.sin(2 * seconds)
    measured = order(end, row.fixed, (target, 0.0), seconds, first_of(row.method))
    assert measured == pytest.approx(row.method.order, abs=0.2)


# --- stability --------------------------------------------------------------------------------------------------------


def growth(method: Integrator, law: Callable[[Array, Array, float], Array]) -> float:
    """Return the factor by which the fastest growing motion grows in one step of 1 s: the spectral radius of a step.

    One agent begins with x = 1, another with v = 1: their states after the step are the columns of a matrix.
    """
    state = blank(1, 2, 2, 0, 1.0)
    state.x[:, 0, 0], state.v[:, 0, 1] = 1.0, 1.0
    after = method(law, state, 1.0)
    return float(np.abs(np.linalg.eigvals(np.array([after.x[0, 0], after.v[0, 0]]))).max())


@METHODS
def test_drag_is_stable_up_to_the_limit_of_the_table(row: IntegratorRow) -> None:
    """A method without a limit is tested at up to a thousand times 2, the limit of most others."""
    shares = ((0.5, False), (0.99, False), (1.01, True)) if math.isfinite(row.real) else ((1.0, False), (1e3, False))
    for share, grows in shares:
        state = blank(1, 1, 2, 0, 1.0)
        state.v[...] = 1.0
        rate = share * (row.real if math.isfinite(row.real) else 2.0)
        after = row.fixed(lambda x, v, t, rate=rate: -rate * v, state, 1.0)
        assert (abs(after.v) > 1.0).all() == grows


@METHODS
def test_oscillations_are_stable_up_to_the_limit_of_the_table(row: IntegratorRow) -> None:
    """A method whose limit is 0 grows at every step size."""
    shares = ((0.5, False), (0.99, False), (1.01, True)) if row.imaginary else ((0.1, True), (1.0, True))
    if math.isinf(row.imaginary):
        shares = ((1.0, False), (30.0, False))
    for share, grows in shares:
        w = share * (row.imaginary or 1.0) if math.isfinite(row.imaginary) else share
        found = growth(row.fixed, lambda x, v, t, w=w: -w * w * x)
        assert found > 1 + 1e-7 if grows else found <= 1 + (1e-9 if row.method.solves else 1e-12)


@pytest.mark.parametrize("zeta", [0.5, 1.0, 2.0])
def test_damped_semi_implicit_euler_is_stable_up_to_its_limit(zeta: float) -> None:
    """h omega < 2 (sqrt(1 + zeta^2) - zeta): damping lowers the limit."""
    limit = 2 * (math.sqrt(1 + zeta**2) - zeta)
    for share, grows in ((0.99, False), (1.01, True)):
        w = share * limit
        found = growth(SemiImplicitEuler(), lambda x, v, t, w=w: -w * w * x - 2 * zeta * w * v)
        assert (found > 1) == grows


@pytest.mark.parametrize("kind", [AdaptiveRK4, DormandPrince])
def test_no_oscillation_grows_under_adaptive_methods(kind: type[Integrator]) -> None:
    """If the two results of step doubling were extrapolated, it would grow at every step size."""
    for y in (0.05, 0.1, 0.2):
        found = growth(kind(tolerance=1e30), lambda x, v, t, y=y: -y * y * x)
        assert found**10_000 <= 1 + 1e-9


def test_exponential_drag_damps_oscillations_as_predicted() -> None:
    """The matrix of one step for x'' = -omega^2 x has the determinant 1 - y^4 / 12 with y = h omega."""
    for y in (0.1, 0.5, 1.5):
        assert growth(ExponentialDrag(), lambda x, v, t, y=y: -y * y * x) == pytest.approx(math.sqrt(1 - y**4 / 12))


# --- orbits -----------------------------------------------------------------------------------------------------------


def orbit(eccentricity: float, aphelion: bool = False) -> dict[str, Any]:
    """Return the start of an orbit with a = 1, mu = 1 and period 2 pi, at its perihelion or aphelion."""
    e = -eccentricity if aphelion else eccentricity
    return {"sun": 1.0, "pos": (1 - e, 0.0), "vel": (0.0, math.sqrt((1 + e) / (1 - e)))}


def off(state: State, given: dict[str, Any]) -> float:
    return math.dist(state.pos[0, 0], given["pos"])


@WAYS
@pytest.mark.parametrize(
    ("method", "evaluations", "error"),
    [
        (AdaptiveRK4(tolerance=1e-6), 1620, 1.3e-4),
        (AdaptiveRK4(tolerance=1e-9), 4692, 6.6e-7),
        (DormandPrince(tolerance=1e-9), 1441, 1.2e-7),
    ],
    ids=["rk4_1e-6", "rk4_1e-9", "dormand_prince_1e-9"],
)
def test_cost_and_error_of_a_narrow_orbit_are_those_of_the_table(
    method: Integrator, evaluations: int, error: float, way: str, tether: Any
) -> None:
    """Kepler e = 0.9, one period; fixed RK4 takes 40,000 evaluations for 1.1e-6."""
    given = orbit(0.9)
    after = tethered(tether, way, **given)(method, 2 * math.pi, 1)
    steps = after.count_of("substeps") + after.count_of("rejected_steps")
    needed = 6 * steps + 1 if isinstance(method, DormandPrince) else 10 * steps + after.count_of("substeps")
    assert evaluations / 1.5 < needed < evaluations * 1.5
    assert error / 1.5 < off(after, given) < error * 1.5
    if way == "compiled":
        assert after.count_of("evaluations") == needed
    if method == AdaptiveRK4(tolerance=1e-6):
        assert (after.count_of("substeps"), after.count_of("rejected_steps")) == (
            pytest.approx(102, rel=0.05),
            pytest.approx(33, rel=0.15),
        )


@pytest.mark.slow
@ADAPTIVE
def test_a_smaller_tolerance_reduces_the_error_accordingly(kind: type[Integrator], tether: Any) -> None:
    for aphelion in (False, True):
        given = orbit(0.9, aphelion)
        ends = [tethered(tether, "compiled", **given)(kind(tolerance=10.0**-k), 2 * math.pi, 1) for k in (6, 9, 12)]
        errors, costs = [off(s, given) for s in ends], [s.count_of("evaluations") for s in ends]
        assert all(100 < a / b < 6000 for a, b in pairwise(errors))
        assert all(2 < b / a < 5 for a, b in pairwise(costs))  # 1000^(1/5) is 4.0


@pytest.mark.parametrize(
    ("method", "energy", "spin"),
    [
        pytest.param(VelocityVerlet(), 4e-4, 1e-11, marks=pytest.mark.slow),
        pytest.param(RK4(), 3e-7, 1e-7, marks=pytest.mark.slow),
        (SemiImplicitEuler(), 2e-2, 1e-11),
    ],
    ids=lambda value: getattr(value, "kind", None),
)
def test_orbits_conserve_energy_and_angular_momentum(
    method: Integrator, energy: float, spin: float, tether: Any
) -> None:
    """N04: e = 0.6, 1000 steps per period."""
    given = orbit(0.6)
    end, worst = tethered(tether, "compiled", **given), 0.0
    for k in range(1, 5):
        after = end(method, 2 * math.pi / 1000, 25_000 * k - 250 * k)
        (x, y), (u, w) = after.pos[0, 0], after.vel[0, 0]
        worst = max(worst, abs((u * u + w * w) / 2 - 1 / math.hypot(x, y) + 0.5) / 0.5)
        assert x * w - y * u == pytest.approx(math.sqrt(1 - 0.36), rel=spin)
    assert worst < energy


# --- exact drag -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("z", [0.0, -1e-300, -1e-12, -1e-3, -0.5, -1.0, -1.0000001, -2.0, -10.0, -40.0, -800.0])
def test_phi_functions_are_right_to_the_last_digits(z: float) -> None:
    with localcontext() as context:
        context.prec = 60
        exact, factor = [Decimal(z).exp()], Decimal(1)
        for k in range(1, 4):
            if abs(z) < 1e-9:
                exact.append(Decimal(1) / math.factorial(k) + Decimal(z) / math.factorial(k + 1))
            else:
                exact.append((exact[-1] - factor) / Decimal(z))
                factor /= k
        np.testing.assert_allclose(phi_functions(z), [float(value) for value in exact], rtol=2e-15)


def test_phi_functions_return_the_precision_of_their_argument() -> None:
    found = phi_functions(np.float32(-0.3))
    assert {type(value) for value in found} == {np.float32}
    np.testing.assert_allclose(found, phi_functions(-0.3), rtol=5e-7)


@WAYS
@pytest.mark.parametrize("steps", [1, 3, 50])
def test_exponential_drag_is_exact_for_a_projectile(steps: int, way: str, tether: Any) -> None:
    """v = (10, 15), kappa = 0.2: 2.798418 s and 21.43051 m, with any number of steps."""
    seconds = 2.798418
    end = tethered(tether, way, pos=0.0, vel=(10.0, 15.0), drag=0.2)
    assert end(ExponentialDrag(), seconds / steps, steps).pos[0, 0, 0] == pytest.approx(21.43051, abs=5e-6)
    end = tethered(tether, way, pos=0.0, vel=(10.0, 15.0), drag=0.2, weight=-9.81)
    assert end(ExponentialDrag(), seconds / steps, steps).pos[0, 0, 1] == pytest.approx(0.0, abs=1e-5)


@WAYS
@pytest.mark.parametrize("stiff", [1.9, 2.1, 10.0, 1e6])
def test_stiff_drag_is_exact_and_never_reverses_a_velocity(stiff: float, way: str, tether: Any) -> None:
    """N20: dt = 0.5 and h kappa from 1.9 on."""
    drag, weight, dt = stiff / 0.5, -9.81, 0.5
    end = tethered(tether, way, pos=0.0, vel=0.3, drag=drag, weight=weight)
    speeds = [0.3]
    for steps in range(1, 9):
        speeds.append(motion(end(ExponentialDrag(), dt, steps))[1])
        exact = weight / drag + (0.3 - weight / drag) * math.exp(-drag * dt * steps)
        assert speeds[-1] == pytest.approx(exact, rel=1e-12)
    assert all(b <= a for a, b in pairwise(speeds))
    alone = tethered(tether, way, pos=0.0, vel=0.3, drag=drag)
    assert all(motion(alone(ExponentialDrag(), dt, steps))[1] >= 0 for steps in range(1, 9))
    assert motion(alone(ExponentialDrag(), dt, 8))[0] == pytest.approx(-0.3 * math.expm1(-8 * stiff) / drag, rel=1e-12)


@WAYS
def test_exponential_drag_with_other_forces_is_of_order_2(way: str, tether: Any) -> None:
    """On a damped oscillator whose drag the method treats exactly."""
    w, zeta, seconds = 2.0, 0.4, 2.2
    decay, wd = math.exp(-zeta * w * seconds), w * math.sqrt(1 - zeta**2)
    b = (V0 + zeta * w * X0) / wd
    x = decay * (X0 * math.cos(wd * seconds) + b * math.sin(wd * seconds))
    v = -zeta * w * x + decay * wd * (b * math.cos(wd * seconds) - X0 * math.sin(wd * seconds))
    end = tethered(tether, way, stiffness=w * w, drag=2 * zeta * w)
    assert order(end, ExponentialDrag(), (x, v), seconds, 10) == pytest.approx(2, abs=0.2)


@pytest.mark.slow
def test_exponential_drag_uses_the_mass_of_each_agent(tether: Any) -> None:
    """kappa = c / m of each agent, for 20 agents of two masses."""
    from flockenv.physics.effects import Drag

    groups = tuple(Group(count=10, mass=m, spawn=Spawn(low=(0, 0), high=(1, 1), speed=(1, 2))) for m in (0.5, 4.0))
    scene = Scene(groups=groups, effects=(tether(), Drag(rate=3.0)), integrator=ExponentialDrag(), dt=0.7)
    start = scene.start(0)
    after = scene.run(start, 2)
    np.testing.assert_allclose(after.vel, start.vel * np.exp(-3.0 * 1.4 / scene.body.mass)[:, None], rtol=1e-12)


# --- adaptive steps ---------------------------------------------------------------------------------------------------


def judge(
    clock: Clock, error: float, tolerance: float = 1e-6, least: float = 0.0, most: float = 1e5, dt: float = 1.0
) -> Clock:
    return next_clock(clock, error, (tolerance, least, most), dt, 4)


def test_the_next_step_is_that_of_the_standard_controller() -> None:
    clock = Clock(0.2, 0.01, 0.0, 0, 5, 1, False)
    assert judge(clock, 1e-6 / 2).step == pytest.approx(0.01 * 0.9 * 2**0.2)
    assert judge(clock, 1e-6 * 3).step == pytest.approx(0.01 * 0.9 * 3**-0.2)
    assert judge(clock, 0.0).step == pytest.approx(0.05)
    for error in (1e-300, 1e-20):
        assert judge(clock, error).step == pytest.approx(0.05)
    for error in (1.0, math.inf, math.nan):
        assert judge(clock, error).step == pytest.approx(0.002)
        assert judge(clock, error)[3:6] == (1, 5, 2)
    assert judge(clock, 1e-6)[:1] == (pytest.approx(0.21),)
    assert judge(clock, 1e-6)[3:6] == (0, 6, 1)


def test_steps_do_not_grow_again_before_the_end_of_a_rejected_step() -> None:
    clock = judge(initial_clock(1.0), 1.0)
    assert (clock.step, clock.wary) == (pytest.approx(0.2), 1.0)
    again = judge(clock, 2e-6)
    assert (again.step, again.wary) == (pytest.approx(0.04), pytest.approx(0.2))  # a fifth, although 0.78 might suffice
    taken = judge(again, 0.0)
    assert (taken.done, taken.step) == (pytest.approx(0.04), pytest.approx(0.04))
    assert judge(taken._replace(wary=0.05), 0.0).step == pytest.approx(0.2)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("dt", [0.02, 1 / 3, 1e6, 1e-9])
def test_adaptive_steps_end_exactly_at_the_end_of_the_step(seed: int, dt: float) -> None:
    rng = np.random.default_rng(seed)
    clock, total = initial_clock(dt), 0.0
    while clock.done < dt:
        assert 0 < clock.step <= dt - clock.done
        before, clock = clock, judge(clock, 10.0 ** rng.uniform(-9, -5), dt=dt)
        total += before.step * (clock.accepted - before.accepted)
    assert clock.done == dt
    assert not clock.lost
    assert total == pytest.approx(dt, rel=1e-12)


def test_a_world_is_given_up_after_too_many_tries_or_if_its_steps_vanish() -> None:
    clock, tries = initial_clock(1.0), 0
    while not clock.lost:
        clock, tries = judge(clock, math.nan), tries + 1
    assert (tries, clock.rejected, clock.accepted, clock.done) == (TRIES, TRIES, 0, 1.0)
    assert judge(Clock(0.5, 0.01, 0.0, 0, 3, 0, False), 1.0, least=0.003).lost
    assert not judge(Clock(0.5, 0.01, 0.0, 0, 3, 0, False), 1.0, least=0.002).lost
    assert judge(Clock(0.5, 1e-16, 0.0, 0, 3, 0, False), 1.0).lost  # t + h == t
    assert not judge(Clock(0.5, 1e-16, 0.0, 0, 3, 0, False), 0.0).lost
    assert not judge(Clock(0.5, 0.01, 0.0, 0, 3, 1, False), 0.0, most=6).lost
    assert judge(Clock(0.5, 0.01, 0.0, 0, 3, 2, False), 0.0, most=6).lost
    assert not judge(Clock(0.5, 0.5, 0.0, 0, 3, 2, False), 0.0, most=6).lost  # the end is reached


def test_differences_within_rounding_count_as_no_error() -> None:
    """In float32 rounding makes the two results of a step differ by more than a tolerance of 1e-9."""
    tiny = 8 * np.finfo(np.float32).eps
    assert excess_square(np.float32(9e-6), np.float32(10.0), tiny) == 0
    assert excess_square(np.float32(9e-6), np.float32(1.0), tiny) > 0
    assert excess_square(-3.0, 1.0, 0.0) == 9.0
    assert math.isnan(excess_square(math.nan, 1.0, tiny))
    assert math.isinf(excess_square(math.inf, 1.0, tiny))


@ADAPTIVE
def test_stages_are_evaluated_at_times_within_the_step(kind: type[Integrator]) -> None:
    """The force depends on time alone."""
    times: list[float] = []
    state = blank(1, 1, 2, 0, 2.0)
    state.tick[:] = 3
    method = kind(tolerance=1e-10)
    after = method(lambda x, v, t: times.append(t) or np.cos(9 * t) + 0 * x, state, 2.0)
    assert (min(times), max(times)) == (6.0, pytest.approx(8.0, abs=1e-14))
    np.testing.assert_allclose(after.vel, (math.sin(72) - math.sin(54)) / 9, atol=1e-8)
    assert after.count_of("substeps") > 5


@ADAPTIVE
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-9])
@pytest.mark.parametrize("jump", [1.0, 10.0])
def test_steps_across_a_jump_of_the_force_are_few(kind: type[Integrator], tolerance: float, jump: float) -> None:
    """x'' = -J sign x from x = 0.3: less than 20 rejected steps per crossing."""
    dt, seconds = 0.05, 20 / math.sqrt(jump)
    state, method, crossings = at_start(blank(1, 1, 2, 0, dt), 0.3, 0.0), kind(tolerance=tolerance), 0
    for _ in range(int(seconds / dt)):
        before = state
        state = method(lambda x, v, t: -jump * np.sign(x), state, dt)
        crossings += int(state.x[0, 0, 0] * before.x[0, 0, 0] < 0)
        rejected = state.count_of("rejected_steps") - before.count_of("rejected_steps")
        assert rejected < 20 * (1 + (jump > 1))
    assert crossings >= 10
    assert state.count_of("rejected_steps") < 20 * crossings
    energy = state.v[0, 0, 0] ** 2 / 2 + jump * abs(state.x[0, 0, 0])
    assert energy == pytest.approx(0.3 * jump, abs=200 * crossings * tolerance)


@pytest.mark.slow
@ADAPTIVE
@pytest.mark.parametrize("jump", [1.0, 10.0])
def test_the_agent_with_the_largest_error_sets_the_substeps(kind: type[Integrator], jump: float, tether: Any) -> None:
    """Twenty agents of two masses: compiled and in Python alike; without the light ones less than half the steps."""
    groups = tuple(Group(count=10, mass=m, spawn=Spawn(low=(0, 0), high=(1, 1), speed=(1, 2))) for m in (0.01, 4.0))
    method = kind(tolerance=1e-8)
    scene = Scene(groups=groups, effects=(tether(stiffness=jump, damping=0.1),), integrator=method, dt=1.0)
    start, mass = scene.start(3, worlds=2), scene.body.mass[:, None]
    after = scene.run(start, 2)
    again = start
    for _ in range(2):
        again = method(lambda x, v, t: (-jump * x - 0.1 * v) / mass, again, 1.0)
    np.testing.assert_array_equal(after.work[:, 4:6], again.work[:, 4:6])
    np.testing.assert_allclose(after.pos, again.pos, atol=1e-10)
    quick = Scene(groups=groups[1:], effects=scene.effects, integrator=method, dt=1.0)
    assert quick.run(quick.start(3), 2).count_of("substeps") < after.worlds([0]).count_of("substeps") / 2


@ADAPTIVE
def test_an_agent_with_an_infinite_force_is_named(kind: type[Integrator], tether: Any) -> None:
    scene = Scene(groups=(Group(count=20, spawn=HERE),), effects=(tether(stiffness=1e100),), integrator=kind(), dt=0.1)
    start = scene.start(0, worlds=2)
    start.x[...], start.v[...] = 0.0, 0.0
    start.x[0, 1, 17] = 1e250  # its force is infinite
    with pytest.raises(SimulationDiverged) as caught:
        scene.step(start, out=start)
    assert (caught.value.world, caught.value.agent, caught.value.effect) == (1, 17, "users_tether")
    assert start.x[0, 1, 17] == 1e250
    np.testing.assert_array_equal(start.tick, [1, 0])
    np.testing.assert_array_equal(start.work[1], 0)


@ADAPTIVE
def test_a_world_diverges_if_steps_are_too_small_or_too_many(kind: type[Integrator], tether: Any) -> None:
    given = orbit(0.9)
    with pytest.raises(SimulationDiverged, match=kind.model_fields["kind"].default):
        tethered(tether, "compiled", **given)(kind(tolerance=1e-9, least=0.01), 2 * math.pi, 1)
    with pytest.raises(SimulationDiverged, match=r"not within tolerance = 1e-09 by 7 steps of its own"):
        tethered(tether, "compiled", **given)(kind(tolerance=1e-9, most=7), 2 * math.pi, 1)
    for name, value in (("tolerance", 0.0), ("tolerance", -1e-6), ("least", -1.0)):
        with pytest.raises(ValueError, match=rf"^{kind.__name__}: {name} = {value:g}"):
            kind(**{name: value})


@pytest.mark.slow
@ADAPTIVE
def test_a_tolerance_below_rounding_works_in_single_precision(kind: type[Integrator], tether: Any) -> None:
    """Rounding then limits the steps, and no world is given up."""
    scene = Scene(
        groups=(Group(count=20, spawn=Spawn(low=(50, 50), high=(60, 60), speed=(1, 2))),),
        effects=(tether(stiffness=4.0),), integrator=kind(tolerance=1e-9), dt=0.5, dtype="float32",
    )  # fmt: skip
    start = scene.start(0)
    after = scene.run(start, 4)
    np.testing.assert_allclose(after.pos, start.pos * math.cos(4) + start.vel / 2 * math.sin(4), rtol=0, atol=5e-3 * 60)
    assert after.count_of("substeps") < 2000


@ADAPTIVE
def test_two_threads_change_no_bits_of_an_adaptive_method(kind: type[Integrator], tether: Any) -> None:
    scene = Scene(groups=(Group(count=8192, spawn=HERE),), effects=(tether(stiffness=9.0),), integrator=kind(), dt=0.3)
    ends = []
    for count in (2, 1):
        use_threads(count)
        ends.append(scene.run(scene.start(0), 2))
    np.testing.assert_array_equal(ends[0].x, ends[1].x)
    np.testing.assert_array_equal(ends[0].work, ends[1].work)


@pytest.mark.slow
def test_only_adaptive_and_implicit_methods_count_substeps(tether: Any) -> None:
    for row in INTEGRATORS:
        scene = Scene(groups=(Group(count=1, spawn=HERE),), effects=(tether(stiffness=1),), integrator=row.method)
        after = scene.run(scene.start(0), 10)
        assert after.count_of("substeps") == (10 if row.method.adaptive or row.method.solves else 0)
        assert after.count_of("rejected_steps") == 0
