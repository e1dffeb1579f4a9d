"""Integrators: measured orders, exact discrete invariants, and the declarations of each method.

Laws are integrated both by `Integrator.__call__` with an acceleration in Python ("python") and by the compiled step of
a scene ("compiled").
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, ClassVar, Literal

import numpy as np
import pytest

from flockenv.behaviours import Separation
from flockenv.model.spawn import Spawn
from flockenv.model.state import blank
from flockenv.physics.effects import Drag
from flockenv.physics.integrators import (
    RK4,
    ExplicitEuler,
    ExponentialDrag,
    Heun,
    Integrator,
    Midpoint,
    SemiImplicitEuler,
    VelocityVerlet,
)
from flockenv.physics.integrators.integrator import INTEGRATORS as KINDS
from flockenv.physics.integrators.integrator import Alone, Provided
from flockenv.physics.integrators.single_stage import OneStage
from flockenv.scene import Group, Scene
from tests.catalogue import INTEGRATORS, Array, IntegratorRow
from tests.motion import METHODS, V0, WAYS, X0, Advance, at_start, first_of, motion, order, tethered

W, ZETA = 2.0, 0.1
PERIOD = 2 * math.pi / W


def oscillator(tether: Any, way: str, w: float = W, zeta: float = ZETA, **limits: Any) -> Advance:
    """Return x'' = -w^2 x - 2 zeta w x' from (X0, V0), advanced in Python or by a compiled scene."""
    return tethered(tether, way, stiffness=w * w, damping=2 * zeta * w, **limits)


def spring(context: Any, pos: Array, vel: Array, time: float, out: Array) -> None:
    """Write an acceleration over flat rows, with the signature that `advance` calls."""
    out[...] = -pos


def alone(row: IntegratorRow) -> Alone:
    """Return the context of a world whose laws are Python functions."""
    return Alone(settings=row.fixed.settings())


def exact(t: float) -> tuple[float, float]:
    """Return position and velocity of the damped oscillator at time t."""
    decay, wd = math.exp(-ZETA * W * t), W * math.sqrt(1 - ZETA**2)
    a, b = X0, (V0 + ZETA * W * X0) / wd
    x = decay * (a * math.cos(wd * t) + b * math.sin(wd * t))
    v = -ZETA * W * x + decay * wd * (b * math.cos(wd * t) - a * math.sin(wd * t))
    return x, v


# --- order ------------------------------------------------------------------------------------------------------------


@WAYS
@METHODS
def test_the_order_is_the_declared_one(row: IntegratorRow, way: str, tether: Any) -> None:
    """Over 0.7 periods of a damped oscillator; over a whole period semi-implicit Euler would seem of order 2 (P06)."""
    seconds = 0.7 * PERIOD
    measured = order(oscillator(tether, way), row.fixed, exact(seconds), seconds, first_of(row.method))
    assert measured == pytest.approx(row.method.order_with_drag, abs=0.2)


def test_the_orders_are_those_of_the_table() -> None:
    """The orders are written here again, so that a wrong declaration fails."""
    orders = {row.name: (row.method.order, row.method.order_with_drag) for row in INTEGRATORS}
    promised = {"explicit_euler": (1, 1), "semi_implicit_euler": (1, 1), "averaged_velocity": (1, 1), "rk4": (4, 4)}
    promised |= {"midpoint": (2, 2), "heun": (2, 2), "velocity_verlet": (2, 2), "exponential_drag": (2, 2)}
    promised |= {"adaptive_rk4": (4, 4), "dormand_prince": (5, 5)}
    promised |= {"implicit_euler": (1, 1), "implicit_midpoint": (2, 2), "linearly_implicit_euler": (1, 1)}
    assert {name: orders[name] for name in promised} == promised


@pytest.mark.slow
def test_a_speed_limit_reduces_the_order(tether: Any) -> None:
    """RK4 is no longer of order 4 if speeds are clamped after each step."""
    end = oscillator(tether, "compiled", max_speed=0.9)
    seconds = 0.7 * PERIOD
    measured = order(end, RK4(), motion(end(RK4(), seconds / 2**17, 2**17)), seconds, first=40)
    assert 0.7 < measured < 2.5


@pytest.mark.slow
@METHODS
def test_python_and_compiled_steps_agree(row: IntegratorRow, tether: Any) -> None:
    ends = [motion(oscillator(tether, way)(row.method, 0.05, 100)) for way in ("python", "compiled")]
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-12)


@METHODS
def test_exponential_growth_has_the_values_of_the_catalogue(row: IntegratorRow) -> None:
    """x = 100 exp(t / 10) as x'' = x' / 10 in ten steps of 1 s."""
    state = blank(1, 1, 2, 0, 1.0)
    state.x[...], state.v[...] = 100.0, 10.0
    for _ in range(10):
        state = row.fixed(lambda x, v, t: 0.1 * v, state, 1.0)
    np.testing.assert_allclose(state.pos, row.grown, atol=5e-6)


# --- exact discrete invariants ----------------------------------------------------------------------------------------


def energies(end: Advance, method: Integrator, w: float, dt: float, counts: Any) -> Array:
    """Return v^2 + w^2 x^2 after each of the given numbers of steps."""
    return np.array([v * v + w * w * x * x for x, v in (motion(end(method, dt, n)) for n in counts)])


@WAYS
def test_energy_under_explicit_euler_grows_by_the_exact_factor(way: str, tether: Any) -> None:
    """E_n = (1 + h^2 w^2)^n E_0. An Euler method that moves with the new velocity would fail."""
    w, h, counts = 2 * math.pi, 0.01, (1, 10, 1000)
    found = energies(oscillator(tether, way, w, zeta=0), ExplicitEuler(), w, h, counts)
    expected = (V0**2 + w * w * X0**2) * (1 + h * h * w * w) ** np.array(counts)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@WAYS
def test_energy_under_rk4_falls_by_the_exact_factor(way: str, tether: Any) -> None:
    """Per step 1 - y^6/72 + y^8/576 with y = h w."""
    w, h, counts = 2 * math.pi, 0.05, (1, 10, 1000)
    found = energies(oscillator(tether, way, w, zeta=0), RK4(), w, h, counts)
    y = h * w
    expected = (V0**2 + w * w * X0**2) * (1 - y**6 / 72 + y**8 / 576) ** np.array(counts)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize(("way", "steps"), [("python", 3000), ("compiled", 100_000)])
def test_semi_implicit_euler_conserves_its_invariant(way: str, steps: int, tether: Any) -> None:
    """v^2 + w^2 x^2 - h w^2 x v does not change at all."""
    w, h = 2 * math.pi, 0.01
    end = oscillator(tether, way, w, zeta=0)
    start = V0**2 + w * w * X0**2 - h * w * w * X0 * V0
    for n in (1, 7, steps):
        x, v = motion(end(SemiImplicitEuler(), h, n))
        assert v * v + w * w * x * x - h * w * w * x * v == pytest.approx(start, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("way", "steps"), [("python", 3000), ("compiled", 100_000)])
def test_velocity_verlet_conserves_its_invariant(way: str, steps: int, tether: Any) -> None:
    """v^2 + w^2 x^2 (1 - h^2 w^2 / 4) does not change at all."""
    w, h = 2 * math.pi, 0.01
    end, share = oscillator(tether, way, w, zeta=0), 1 - h * h * w * w / 4
    start = V0**2 + w * w * X0**2 * share
    for n in (1, 7, steps):
        x, v = motion(end(VelocityVerlet(), h, n))
        assert v * v + w * w * x * x * share == pytest.approx(start, rel=1e-12)


@WAYS
@pytest.mark.parametrize("method", [Midpoint(), Heun()], ids=lambda method: method.kind)
def test_energy_under_methods_of_order_2_grows_by_the_exact_factor(method: Integrator, way: str, tether: Any) -> None:
    """Per step 1 + y^4/4 with y = h w."""
    w, h, counts = 2 * math.pi, 0.05, (1, 10, 1000)
    found = energies(oscillator(tether, way, w, zeta=0), method, w, h, counts)
    expected = (V0**2 + w * w * X0**2) * (1 + (h * w) ** 4 / 4) ** np.array(counts)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@METHODS
def test_a_constant_force_gives_a_parabola(row: IntegratorRow) -> None:
    """It is exact for all methods but the Euler methods, which lag or lead by h g t / 2."""
    state, g = at_start(blank(1, 1, 2, 0, 0.25)), -9.81
    for _ in range(8):
        state = row.method(lambda x, v, t: g + 0 * x, state, 0.25)
    lag = {"explicit_euler": -1, "semi_implicit_euler": 1, "implicit_euler": 1, "linearly_implicit_euler": 1}.get(
        row.name, 0
    )
    off = lag * 0.25 * g * 2.0 / 2
    np.testing.assert_allclose(state.pos, X0 + 2 * V0 + g * 2 + off, rtol=1e-13)
    np.testing.assert_allclose(state.vel, V0 + g * 2, rtol=1e-13)


@pytest.mark.slow
def test_energy_after_a_hundred_periods_has_the_documented_values(tether: Any) -> None:
    """100 steps per period: 1.29272e17 explicit, 0.9999915 RK4, within 3.3 % semi-implicit."""
    w = 2 * math.pi
    end = oscillator(tether, "compiled", w, zeta=0)
    start = V0**2 + w * w * X0**2
    assert energies(end, ExplicitEuler(), w, 0.01, [10_000])[0] / start == pytest.approx(1.29272e17, rel=1e-5)
    assert energies(end, RK4(), w, 0.01, [10_000])[0] / start == pytest.approx(0.9999915, abs=1e-7)
    for method in (Midpoint(), Heun()):
        assert energies(end, method, w, 0.01, [10_000])[0] / start == pytest.approx(1.039733, abs=1e-6)
    kept = start - 0.01 * w * w * X0 * V0  # its invariant; the energy oscillates around it
    swing = energies(end, SemiImplicitEuler(), w, 0.01, range(9_900, 10_000)) / kept
    assert swing.min() == pytest.approx(1 / (1 + 0.01 * w / 2), abs=1e-4)  # 0.969541
    assert swing.max() == pytest.approx(1 / (1 - 0.01 * w / 2), abs=1e-4)  # 1.032435


# --- declarations and rows of a method --------------------------------------------------------------------------------


@pytest.mark.parametrize("row", [row for row in INTEGRATORS if not row.method.solves], ids=lambda row: row.name)
def test_a_method_evaluates_the_force_as_often_as_declared(row: IntegratorRow, tether: Any) -> None:
    calls = []
    row.method(lambda x, v, t: calls.append(1) or -x, blank(1, 3, 2, 0, 0.1), 0.1)
    assert len(calls) == row.method.evaluations
    spawn = Spawn(low=(0, 0), high=(1, 1))
    scene = Scene(groups=(Group(count=1, spawn=spawn),), effects=(tether(stiffness=1),), integrator=row.method)
    assert scene.run(scene.start(0), 10).count_of("evaluations") == 10 * row.method.evaluations


@METHODS
@pytest.mark.parametrize("dt", [0.0, -0.1, math.nan, math.inf])
def test_a_time_step_that_is_not_positive_and_finite_is_refused(row: IntegratorRow, dt: float) -> None:
    state = blank(1, 1, 2, 0, 0.1)
    with pytest.raises(ValueError, match="dt is") as caught:
        row.method(lambda x, v, t: -x, state, dt)
    assert "\n" not in str(caught.value)
    assert state.tick[0] == 0


@METHODS
def test_a_step_does_not_change_its_state_and_agents_are_independent(row: IntegratorRow) -> None:
    rng = np.random.default_rng(0)
    state = blank(2, 5, 3, 0, 0.1)
    state.x[...], state.v[...] = rng.normal(size=(3, 2, 5)), rng.normal(size=(3, 2, 5))
    before = state.copy()
    stiffness = np.arange(1.0, 6.0)[:, None]
    after = row.fixed(lambda x, v, t: -stiffness * x, state, 0.1)
    np.testing.assert_array_equal(state.x, before.x)
    np.testing.assert_array_equal(state.v, before.v)
    np.testing.assert_array_equal(after.tick, 1)
    for b, i in ((0, 0), (1, 3)):
        one = blank(1, 1, 3, 0, 0.1)
        one.x[:, 0, 0], one.v[:, 0, 0] = before.x[:, b, i], before.v[:, b, i]
        alone = row.fixed(lambda x, v, t, k=i + 1.0: -k * x, one, 0.1)
        np.testing.assert_array_equal(alone.pos[0, 0], after.pos[b, i])


@METHODS
def test_without_a_force_every_method_moves_in_a_straight_line(row: IntegratorRow) -> None:
    state = at_start(blank(1, 1, 2, 0, 0.25))
    for _ in range(8):
        state = row.method(lambda x, v, t: 0 * x, state, 0.25)
    np.testing.assert_allclose(state.pos, X0 + 2 * V0, rtol=4e-15)  # RK4 rounds four times per step
    np.testing.assert_array_equal(state.vel, V0)


IN_ROWS = pytest.mark.parametrize(
    "row", [row for row in INTEGRATORS if not isinstance(row.method, OneStage)], ids=lambda row: row.name
)
"""Methods that work on rows of coordinates and have stage rows of their own."""


@IN_ROWS
def test_a_method_writes_no_more_stage_rows_than_it_declares(row: IntegratorRow) -> None:
    """Guard rows behind the declared ones must stay unchanged; writes there would overwrite other scratch."""
    stages = np.full((row.method.stages + 2, 6), 7.0)
    row.method.advance()(Provided(spring))(alone(row), np.ones(6), np.ones(6), (), 0.0, 0.1, stages, 0, 6)
    assert (stages[row.method.stages :] == 7).all()


@pytest.mark.parametrize("row", INTEGRATORS, ids=lambda row: row.name)
def test_methods_of_one_evaluation_need_no_stage_rows(row: IntegratorRow) -> None:
    group = Group(count=3, spawn=Spawn(low=(0, 0), high=(1, 1)))
    scene = Scene(groups=(group,), effects=(Separation(weight=1, radius=1),), integrator=row.method)
    once = row.method.evaluations == 1
    assert scene.parts.one_stage == once
    assert ("stages" not in scene.stepper.workspaces(1, 1)[0].arrays) == once


@IN_ROWS
def test_each_thread_of_a_shared_world_writes_only_its_own_part(row: IntegratorRow) -> None:
    """Threads that share a world share its rows, so each must write all of [first, end) and nothing beyond."""
    rng = np.random.default_rng(0)
    start = (*rng.normal(size=(2, 12)), np.full((row.method.stages, 12), 7.0))
    together, apart = [array.copy() for array in start], [array.copy() for array in start]
    row.method.advance()(Provided(spring))(alone(row), *together[:2], (), 0.0, 0.1, together[2], 0, 12)
    for first, end in ((0, 5), (5, 5), (5, 12)):
        if first == end and row.method.adaptive:
            continue  # threads never share a world of an adaptive method: no empty parts

        def law(context: Any, pos: Array, vel: Array, time: float, out: Array, mine: slice = slice(first, end)) -> None:
            out[mine] = -pos[mine]

        mine = [array.copy() for array in start]
        row.method.advance()(Provided(law))(alone(row), *mine[:2], (), 0.0, 0.1, mine[2], first, end)
        for before, after, whole in zip(start, mine, apart, strict=True):
            np.testing.assert_array_equal(
                np.delete(after, slice(first, end), -1), np.delete(before, slice(first, end), -1)
            )
            whole[..., first:end] = after[..., first:end]
    for whole, once in zip(apart, together, strict=True):
        np.testing.assert_array_equal(whole, once)


@pytest.mark.slow
def test_linear_drags_of_several_effects_are_summed() -> None:
    """v = v0 exp(-(c + c') dt / m) exactly, in both dimensions."""
    for dimension in (2, 3):
        group = Group(count=20, mass=2.0, spawn=Spawn(low=(0,) * dimension, high=(9,) * dimension, speed=(1, 2)))
        drags = Drag(rate=3.0), Drag(rate=1.5)
        scene = Scene(dimension=dimension, groups=(group,), effects=drags, integrator=ExponentialDrag(), dt=0.7)
        start = scene.start(0)
        np.testing.assert_allclose(scene.step(start).vel, start.vel * math.exp(-4.5 * 0.7 / 2.0), rtol=1e-13)


TYPED = """
def advance(provided):
    acceleration = provided.acceleration

    def advance(context, pos, vel, flow, time, dt, stages, first, end):
        acceleration(context, pos, vel, time, stages[0])
        for i in range(np.uint64(first), np.uint64(end)):
            vel[i] += dt * stages[0, i]
            pos[i] += dt * vel[i]

    return advance
"""


def test_a_method_without_a_source_file_runs_in_a_scene_and_in_python(tether: Any) -> None:
    """Its code object is compiled, not its source, as in a notebook. It is semi-implicit Euler over a row."""
    typed: dict[str, Any] = {"np": np, "__name__": __name__}
    exec(TYPED, typed)  # noqa: S102  # the text above

    class Typed(Integrator):
        kind: Literal["typed"] = "typed"
        order: ClassVar[int] = 1
        order_with_drag: ClassVar[int] = 1
        stages: ClassVar[int] = 1
        evaluations: ClassVar[int] = 1

        @classmethod
        def advance(cls) -> Any:
            return typed["advance"]

    del KINDS["typed"]
    for way in ("python", "compiled"):
        ended = [motion(oscillator(tether, way)(method, 0.05, 20)) for method in (Typed(), SemiImplicitEuler())]
        np.testing.assert_allclose(*ended, rtol=1e-14, atol=0)


@pytest.mark.slow
def test_differences_between_methods_halve_with_the_step(tether: Any) -> None:
    seconds = 0.7 * PERIOD
    end, gaps = oscillator(tether, "compiled"), []
    for n in (100, 200, 400):
        ends = [motion(end(row.method, seconds / n, n)) for row in INTEGRATORS]
        gaps.append(np.ptp(ends, axis=0).max())
    assert all(1.7 < a / b < 2.3 for a, b in pairwise(gaps))
