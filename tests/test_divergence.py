"""Divergence: which world, agent, step and effect the error names, and the other worlds; also rates and clocks."""

from __future__ import annotations

import pickle
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockenv.core.warnings import UnstableStepWarning
from flockenv.jit.thread_pool import use_threads
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.networks import Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Carried, Drag, Gravity, QuadraticDrag, Springs, Tether, Uniform, Vortex, Wind
from flockenv.physics.integrators import ExponentialDrag, ImplicitEuler, Integrator, SemiImplicitEuler
from flockenv.scene import Group, Scene

HERE = Spawn(low=(0, 0), high=(4, 4), speed=(0.2, 1.0))
MOTION = ("x", "v", "tick")  # without `work`, which also counts failed steps

GROUPS = (Group(count=5, mass=0.5, max_force=2.0, spawn=HERE), Group(network=Rope(links=3, length=0.6), mass=0.2))


def mixed(method: Integrator | None = None, rate: float = 0.1, stiffness: float = 50.0, **fields: Any) -> Scene:
    """Return five agents and a rope under six effects; all scenes here share these laws, and differ in numbers."""
    effects = (
        Gravity(acceleration=(0.0, -9.81)), Uniform(strength=(1.0, 0.0), period=2.0), Drag(rate=0.1),
        Springs(group=1, stiffness=stiffness), QuadraticDrag(rate=rate), Tether(centre=(0, 0), stiffness=1.0),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstableStepWarning)
        return Scene(
            groups=GROUPS, effects=effects, integrator=method or SemiImplicitEuler(), **({"dt": 0.01} | fields)
        )


def same(a: State, b: State, names: tuple[str, ...] = ("x", "v", "tick", "work")) -> None:
    for name in names:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def diverged(call: Any) -> SimulationDiverged:
    with pytest.raises(SimulationDiverged) as caught:
        call()
    assert "\n" not in str(caught.value)
    return caught.value


# --- which agent and effect the error names ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "method",
    [SemiImplicitEuler(), pytest.param(ImplicitEuler(), marks=pytest.mark.slow)],
    ids=lambda method: method.kind,
)
def test_error_names_the_effect_that_caused_the_divergence(method: Integrator) -> None:
    """That is the effect whose force on that agent is the largest, or not finite."""
    for agent, far, fast, kind in (
        (2, 1.0, 1e200, "quadratic_drag"), (6, 1e308, 0.0, "springs"), (3, 1e308, 0.0, "tether"),
    ):  # fmt: skip
        scene = mixed(method, rate=1.0)
        start = scene.start(0, worlds=3)
        start.vel[1, agent, 0] += fast
        if far > 1:
            start.pos[1, agent] = far
        kept = start.copy()
        error = diverged(lambda scene=scene, start=start: scene.step(start))
        assert (error.world, error.step, error.time, error.dt) == (1, 1, 0.01, 0.01)
        assert error.effect == kind, str(error)
        assert error.method == method.kind
        assert error.agent in ((agent,) if agent < 5 else (5, 6, 7))  # neighbours in the rope diverge in the same step
        same(start, kept)


def test_error_names_the_first_step_of_a_call_that_diverges() -> None:
    """The step is too long for quadratic drag in one world; the other worlds make all their steps."""
    scene = mixed(rate=3.0)
    start = scene.run(scene.start(0, worlds=3), 7)
    start.vel[2, 4] = 300.0, 0.0
    error = diverged(lambda: scene.step(start, steps=40))
    alone, done = start.worlds([2]), 0
    while done < 40:
        try:
            alone, done = scene.step(alone), done + 1
        except FloatingPointError:
            break
    assert 1 < done < 40
    assert (error.world, error.agent, error.step) == (2, 4, 7 + done + 1)
    assert error.time == pytest.approx((8 + done) * 0.01)
    assert error.effect == "quadratic_drag"
    same(error.state.worlds([2]), start.worlds([2]), MOTION)
    for b in (0, 1):
        same(error.state.worlds([b]), scene.run(start.worlds([b]), 40))


def test_out_holds_the_results_of_a_call_that_diverges() -> None:
    scene = mixed(rate=3.0)
    start = scene.start(0, worlds=3)
    start.vel[0, 1] = 300.0, 0.0
    kept, out = start.copy(), scene.start(9, worlds=3)
    error = diverged(lambda: scene.step(start, out=out, steps=20))
    assert error.state is out
    same(start, kept)
    same(out.worlds([0]), kept.worlds([0]), MOTION)
    same(out.worlds([1, 2]), scene.run(kept.worlds([1, 2]), 20))
    error = diverged(lambda: scene.step(start, out=start, steps=20))
    assert error.state is start
    same(start, out)


def test_error_does_not_depend_on_the_number_of_threads() -> None:
    scene = mixed(rate=3.0)
    start = scene.start(0, worlds=12)
    start.vel[7, 1] = 300.0, 0.0
    start.vel[3, 2] = -300.0, 0.0
    found = []
    for count in (1, 2):
        use_threads(count)
        found.append(diverged(lambda: scene.step(start, steps=50)))
    use_threads(1)
    one, two = found
    assert one.args == two.args
    assert (one.world, one.agent) == (3, 2)
    same(one.state, two.state)


def test_error_can_be_pickled_and_its_message_has_all_attributes() -> None:
    scene = mixed(rate=3.0)
    start = scene.start(0)
    start.vel[0, 1] = 300.0, 0.0
    error = diverged(lambda: scene.step(start, steps=20))
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is SimulationDiverged
    assert str(again) == str(error)
    assert (again.world, again.agent, again.step, again.effect) == (0, 1, error.step, "quadratic_drag")
    for part in ("world 0", "agent 1", f"step {error.step}", "quadratic_drag", "0.01 s", "semi_implicit_euler"):
        assert part in str(error)
    unknown = SimulationDiverged(0, 1, 2, 0.02, None, 0.01, "rk4", "Newton's method has not converged")
    assert str(unknown) == (
        "world 0, agent 1: Newton's method has not converged in step 2, t = 0.02 s; dt = 0.01 s may be too large for "
        "rk4"
    )


def test_unstable_springs_are_named_when_they_diverge() -> None:
    """The warning about an unstable step is silenced, so the run goes on until it diverges."""
    scene = mixed(stiffness=4e3, rate=0.0, dt=0.012)
    start = scene.start(0)
    start.pos[0, 6, 0] += 0.05
    error = diverged(lambda: scene.run(start, 100_000))
    assert error.effect == "springs"
    assert error.agent >= 5


def test_no_effect_is_named_in_a_scene_without_effects() -> None:
    group = Group(count=2, spawn=HERE)
    scene = Scene(groups=(group,), effects=(), dt=0.5)
    start = scene.start(0)
    start.vel[0, 1] = 1e308, 1e308
    error = diverged(lambda: scene.step(start))
    assert (error.agent, error.effect) == (1, None)


# --- accelerations and rates ------------------------------------------------------------------------------------------


def test_accelerations_are_the_sum_of_the_laws_and_the_bounded_drive() -> None:
    """Calculated by hand for the agents outside the rope. Drag is included under every method."""
    drive = np.zeros((2, 9, 2))
    drive[0, 1] = 30.0, 40.0  # 50 N, more than max_force = 2 N
    drive[1, 2] = 0.3, -0.4
    for method in (SemiImplicitEuler(), ExponentialDrag(), ImplicitEuler()):
        scene = mixed(method)
        state = scene.start(0, worlds=2)
        kept = state.copy()
        found, flow = scene.rates(state, drive, times=[0.3, 0.7])
        assert flow is None
        assert found.shape == state.shape
        x, v, mass = state.pos[:, :5], state.vel[:, :5], 0.5
        force = -0.1 * v - 0.1 * np.linalg.norm(v, axis=2, keepdims=True) * v - x
        force = force + np.array(
            [[[1.0, 0.0]], [[1.0, 0.0]]]
        ) * np.cos(np.pi * np.array([0.3, 0.7]))[:, None, None]  # fmt: skip
        bounded = drive[:, :5].copy()
        bounded[0, 1] *= 2.0 / 50
        np.testing.assert_allclose(found[:, :5], (force + bounded) / mass + (0.0, -9.81), rtol=1e-12, atol=1e-12)
        same(state, kept, MOTION)
        assert state.count_of("evaluations") > 0
        np.testing.assert_array_equal(scene.acceleration(state), scene.rates(state, times=state.time)[0])


def test_invalid_arguments_of_rates_are_refused() -> None:
    scene = mixed()
    state = scene.start(0, worlds=2)
    with pytest.raises(ValueError, match="drive has shape"):
        scene.acceleration(state, np.zeros((1, 9, 2)))
    with pytest.raises(ValueError, match=r"steps of 0\.02 s"):
        scene.acceleration(replace(state, dt=0.02))
    with pytest.raises(ValueError, match="times"):
        scene.rates(state, times=[0.0, 1.0, 2.0])
    with pytest.raises(ValueError, match="times"):
        scene.rates(state, times=[0.0, np.nan])


@pytest.mark.slow
def test_rates_include_the_velocity_of_a_medium_that_carries_agents() -> None:
    effects = Vortex(strength=2.0, centre=(1.0, 1.0), maximum=3.0, acts="medium"), Wind(velocity=(1.0, 0.0)), Carried()
    scene = Scene(groups=(Group(count=3, spawn=HERE),), effects=effects, dt=0.01)
    state = scene.start(0, worlds=2)
    acc, flow = scene.rates(state)
    assert flow is not None
    assert flow.shape == state.shape
    np.testing.assert_array_equal(acc, 0)
    d = state.pos - 1.0
    square = (d * d).sum(axis=2, keepdims=True)
    expected = np.stack([-d[..., 1], d[..., 0]], axis=2) / np.sqrt(square) * 2.0 / (2.0 / 3.0 + square)
    np.testing.assert_allclose(np.abs(flow - (1.0, 0.0)), np.abs(expected), rtol=1e-9)


# --- clocks -----------------------------------------------------------------------------------------------------------


def test_with_dt_keeps_the_time_if_it_is_a_multiple_of_the_new_dt() -> None:
    coarse = mixed(dt=0.02)
    state = coarse.run(coarse.start(0, worlds=2), 6)
    for dt, ticks in ((0.02, 6), (0.01, 12), (0.04, 3), (0.03, 4), (0.12, 1)):
        other = state.with_dt(dt)
        assert (other.dt, other.tick.tolist()) == (dt, [ticks, ticks])
        np.testing.assert_allclose(other.time, state.time, rtol=1e-12)
        same(replace(other, tick=state.tick), state)
        assert not np.shares_memory(other.x, state.x)
    fine = mixed(dt=0.01)
    end = fine.run(state.with_dt(0.01), 4)
    assert end.time.tolist() == pytest.approx([0.16, 0.16])
    with pytest.raises(ValueError, match="with_dt"):
        fine.step(state)
    uneven = replace(state, tick=np.array([6, 7]))
    assert uneven.with_dt(0.01).tick.tolist() == [12, 14]
    with pytest.raises(ValueError, match=r"world 1, 0\.14 s, is no multiple"):
        uneven.with_dt(0.04)


@pytest.mark.parametrize("dt", [0.0, -0.02, np.nan, np.inf])
def test_with_dt_refuses_steps_that_are_not_positive_and_finite(dt: float) -> None:
    state = mixed().start(0)
    with pytest.raises(ValueError, match="dt is"):
        state.with_dt(dt)
    with pytest.raises(ValueError, match="dt is"):
        replace(state, tick=np.array([5])).with_dt(dt)
