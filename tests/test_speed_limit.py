"""A smooth speed limit: its formula, stable steps, and the order of methods under it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import SpeedLimit, Uniform
from flockenv.physics.integrators import RK4
from flockenv.scene import Group, Scene
from flockenv.studies.accuracy import Problem, measure
from flockenv.studies.accuracy.results import Curve

V, B, MASS = 1.5, 4.0, 2.0
PUSH = (2.0, 1.5)  # N, 2.5 together


def scene(push: float = 1.0, dt: float = 0.01, hard: float | None = None, strength: float = B) -> Scene:
    """Return an agent under a constant and a slowly oscillating force, with a smooth or a hard speed limit."""
    group = Group(count=1, mass=MASS, max_speed=hard, spawn=Spawn(low=(0, 0), high=(0, 0)))
    effects = (
        SpeedLimit(speed=V, strength=strength),
        Uniform(strength=tuple(push * p for p in PUSH)),
        Uniform(strength=(0.0, 1.0), period=1.7),
    )  # fmt: skip
    return Scene(groups=(group,), effects=effects, integrator=RK4(), dt=dt)


def moving(of: Scene, *vel: float) -> State:
    return of.start(0).with_motion(np.zeros((1, 1, 2)), np.array([[vel]], float))


def curve(hard: float | None) -> Curve:
    limited = scene(hard=hard, strength=0.0 if hard else B)
    begin = (np.zeros((1, 2)), np.array([[0.8, 0.6]]))
    problem = Problem.of(limited, seconds=1.3, steps=(8, 16, 32, 64, 128), motion=begin)
    (found,) = measure(problem, (RK4(),), repetitions=0).curves
    return found


@pytest.mark.slow
def test_rk4_has_order_4_with_the_smooth_limit_and_order_1_with_the_hard_one() -> None:
    """P09, P14: half the step divides errors by 16, and by 2 with the hard limit."""
    smooth, clamped = curve(None), curve(V)
    assert smooth.order is not None
    assert smooth.order >= 3.8
    assert clamped.order is not None
    assert clamped.order == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("times", [1.0, 2.0, 4.0, 8.0])
def test_the_final_speed_under_a_constant_force_is_the_closed_form(times: float) -> None:
    """16 B s^9 / (15 + s^8) = F: the speed is V for F = B, and 1.087, 1.189 and 1.319 V for 2, 4 and 8 B."""
    share = brentq(lambda s: 16 * s**9 / (15 + s**8) - times, 0.1, 3.0)
    assert share == pytest.approx({1.0: 1.0, 2.0: 1.087, 4.0: 1.189, 8.0: 1.319}[times], abs=5e-4)
    driven = scene(push=times * B / np.hypot(*PUSH))
    quiet = driven.with_effects(*driven.effects[:2], Uniform(strength=(0.0, 0.0), period=1.7))
    state, fastest = quiet.start(0), 0.0
    for _ in range(100):
        state = quiet.run(state, 20)
        fastest = max(fastest, float(np.linalg.norm(state.vel)))
    assert np.linalg.norm(state.vel) == pytest.approx(share * V, rel=1e-6)
    assert fastest <= share * V * (1 + 1e-9)


def test_speeds_far_above_the_limit_decay_stably_and_like_the_exact_solution() -> None:
    """The bound, m V / (8 B) for explicit Euler and more for RK4, is what a scene compares dt to."""
    fast = scene(push=0.0, dt=0.9 * MASS * V / (8 * B))
    state = moving(fast, 300.0, -400.0)
    speeds = [500.0]
    for _ in range(100):
        state = fast.step(state)
        speeds.append(float(np.linalg.norm(state.vel)))
    assert np.diff(speeds)[:3].max() < 0
    assert max(speeds[20:]) < 1.1 * V
    exact = solve_ivp(
        lambda t, y: -B / MASS * 16 * (y / V) ** 9 / (15 + (y / V) ** 8), (0, 0.5), [5.0], rtol=1e-11, atol=1e-12
    ).y[0, -1]
    fine = scene(push=0.0, dt=0.005)
    still = fine.with_effects(*fine.effects[:2], Uniform(strength=(0.0, 0.0), period=1.7))
    end = still.run(moving(still, 3.0, 4.0), 100)
    assert np.linalg.norm(end.vel) == pytest.approx(exact, rel=1e-6)
