"""Contact forces: closed forms of springs that only repel, of dampers and of friction. Symmetries: test_effects.py."""

from __future__ import annotations

import dataclasses
import math
import warnings
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from flockenv.core.warnings import CoarseContactWarning
from flockenv.geometry.shapes import Block
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Contact, ObstacleContact
from flockenv.physics.effects.contact import restitution
from flockenv.physics.integrators import (
    RK4,
    AdaptiveRK4,
    AveragedVelocity,
    ExplicitEuler,
    ImplicitEuler,
    Integrator,
    SemiImplicitEuler,
)
from flockenv.scene import Group, Scene
from flockenv.scene.stability import check_contact, contact_limit
from tests.catalogue import Array

STIFFNESS, MASS, SPEED = 50.0, 2.0, 1.5
OMEGA = math.sqrt(STIFFNESS / MASS)
FLOOR = Block(centre=(0.0, -30.0), size=(200.0, 20.0))
"""The top is at y = -20 m. All scenes here contain it, so that they share one kernel."""


def scene(damping: float = 0.0, at: float = 3.4, speed: float = SPEED) -> Scene:
    """Return a body of radius 0.3 m that flies along x from `at`; it touches an obstacle of radius 1 m at x = 3.7 m."""
    place = Spawn(low=(at, 0), high=(at, 0), speed=(speed, speed), heading=(1, 0))
    return Scene(
        groups=(Group(count=1, mass=MASS, radius=0.3, spawn=place),),
        obstacles=({"centre": (5.0, 0.0), "radius": 1.0}, FLOOR),
        effects=(Contact(stiffness=0.0, radius=0.6), ObstacleContact(stiffness=STIFFNESS, damping=damping)),
        integrator=RK4(),
        dt=0.001,
    )


@pytest.mark.slow
def test_elastic_contact_converts_kinetic_energy_to_depth_and_back() -> None:
    elastic = scene()
    deepest = elastic.run(elastic.start(0), round(1000 * (0.2 + math.pi / 2 / OMEGA)))
    assert deepest.pos[0, 0, 0] == pytest.approx(3.7 + SPEED / OMEGA, abs=1e-5)
    np.testing.assert_allclose(deepest.vel[0, 0], 0.0, atol=0.01)
    out = elastic.run(elastic.start(0), round(1000 * (0.4 + math.pi / OMEGA)))
    assert out.vel[0, 0, 0] == pytest.approx(-SPEED, rel=1e-3)
    assert out.pos[0, 0, 0] == pytest.approx(3.4, abs=2e-3)


@pytest.mark.parametrize("damping", [2.0, 20.0, 100.0])
def test_damped_contact_reduces_speed_and_never_attracts(damping: float) -> None:
    """A plain spring and damper would attract a body that leaves: its speed would fall again."""
    damped, speeds = scene(damping), []
    state = damped.start(0)
    for _ in range(60):
        state = damped.run(state, 25)
        speeds.append(state.vel[0, 0, 0])
    assert np.diff(speeds).max() <= 1e-12
    assert -SPEED < speeds[-1] <= 1e-3


def test_body_at_the_centre_of_an_obstacle_is_pushed_out() -> None:
    inside = scene(at=5.0, speed=0.0)
    state = inside.run(inside.start(0), 100)
    assert np.isfinite(state.pos).all()
    assert abs(state.vel[0, 0, 0]) == pytest.approx(1.3 * OMEGA * math.sin(0.1 * OMEGA), rel=1e-5)


def test_no_contact_force_acts_without_contact() -> None:
    apart = scene(at=3.7 - 1e-9, speed=0.0)
    state = apart.run(apart.start(0), 100)
    np.testing.assert_array_equal(state.vel, 0.0)


def test_block_repels_like_a_circle_in_a_head_on_contact() -> None:
    """The side of the block is at the nearest point of the circle."""
    away = {"centre": (5.0, 90.0), "radius": 1.0}
    block = scene().model_copy(update={"obstacles": (away, Block(centre=(5.0, 0.0), size=(2.0, 6.0)))})
    steps = round(1000 * (0.2 + math.pi / 2 / OMEGA))
    assert block.run(block.start(0), steps).pos[0, 0, 0] == pytest.approx(3.7 + SPEED / OMEGA, abs=1e-5)


# --- pairs and a floor: one kernel for all scenes below -------------------------------------------------------------

K, RADIUS = 400.0, 0.3  # N/m, m


def bodies(masses: tuple[float, ...] = (2.0, 0.5), dt: float = 2e-4, **law: Any) -> Scene:
    """Return bodies, one per group, over a floor; one contact law acts between bodies and with the floor."""
    groups = tuple(Group(count=1, mass=m, radius=RADIUS, spawn=Spawn(low=(0, 0), high=(1, 1))) for m in masses)
    given = {"stiffness": K} | law
    effects = (Contact(radius=2 * RADIUS, **given), ObstacleContact(**given))
    around = ({"centre": (5.0, 90.0), "radius": 1.0}, FLOOR)
    return Scene(groups=groups, effects=effects, obstacles=around, integrator=RK4(), dt=dt)


def begun(of: Scene, pos: Any, vel: Any) -> State:
    return of.start(0).with_motion(np.array([pos], float), np.array([vel], float))


def energy(of: Scene, state: State) -> float:
    return float(0.5 * (of.body.mass * (state.vel[0] ** 2).sum(axis=1)).sum())


def forces(of: Scene, state: State) -> Array:
    """Return the forces on all agents, (N, D) in N, from the change of velocity in a very short step."""
    short = of.model_copy(update={"dt": 1e-8})
    after = short.step(dataclasses.replace(state, dt=1e-8))
    return np.asarray((after.vel[0] - state.vel[0]) * 1e8 * of.body.mass[:, None])


def momentum(of: Scene, state: State) -> Array:
    return np.asarray((of.body.mass[:, None] * state.vel[0]).sum(axis=0))


@pytest.mark.parametrize("adhesive", [False, True])
@pytest.mark.parametrize(
    ("ratio", "released", "kept"), [(0.05, 0.8588, 0.8545), (0.2, 0.5717, 0.5266), (0.5, 0.2984, 0.163)]
)
def test_coefficient_of_restitution_of_a_damped_hit_equals_the_formula(
    ratio: float, released: float, kept: float, adhesive: bool
) -> None:
    """To 2 % for different masses; the formula itself to four digits."""
    expected = kept if adhesive else released
    assert restitution(ratio, adhesive) == pytest.approx(expected, abs=6e-5)
    for masses in ((2.0, 0.5), (0.3, 0.3)):
        hit = bodies(masses, ratio=ratio, adhesive=adhesive)
        start = begun(hit, [(0, 0), (0.7, 0)], [(1.5, 0), (-0.5, 0)])
        end = hit.run(start, 3500)
        gone = end.vel[0, 1, 0] - end.vel[0, 0, 0]
        assert gone / 2.0 == pytest.approx(expected, rel=0.02)
        np.testing.assert_allclose(momentum(hit, end), momentum(hit, start), atol=1e-12)
    wall = bodies(ratio=ratio, adhesive=adhesive)
    end = wall.run(begun(wall, [(0, -19.65), (50, 0)], [(0, -1.0), (0, 0)]), 3500)
    assert end.vel[0, 0, 1] == pytest.approx(expected, rel=0.02)


def test_restitution_of_critical_and_overdamped_contacts() -> None:
    assert restitution(1.0) == pytest.approx(math.exp(-2), rel=1e-9)
    assert restitution(1.0 + 1e-9) == pytest.approx(restitution(1.0 - 1e-9), rel=1e-5)
    assert restitution(2.0) == pytest.approx(0.0477687325)  # scipy's solve_ivp
    assert restitution(2.0, adhesive=True) == 0.0
    with pytest.raises(ValueError, match=">= 0"):
        restitution(-0.1)


@pytest.mark.parametrize("law", [
    {"friction": 300.0}, {"friction": 3000.0, "coulomb": 0.4}, {"friction": 300.0, "ratio": 0.2, "most": 1.0},
])  # fmt: skip
def test_friction_reduces_slip_conserves_momentum_and_never_adds_energy(law: dict[str, Any]) -> None:
    """An oblique hit of two bodies, and one on the floor; with the wrong sign friction would accelerate both."""
    pair = bodies(**law)
    start = begun(pair, [(0, 0), (0.62, 0.1)], [(1.0, 0.5), (-1.0, -2.0)])
    end = pair.run(start, 2000)
    np.testing.assert_allclose(momentum(pair, end), momentum(pair, start), atol=1e-12)
    assert energy(pair, end) < 0.999 * energy(pair, start)
    frictionless = pair.with_effects(*(e.model_copy(update={"friction": 0.0}) for e in pair.effects))
    smooth = frictionless.run(start, 2000)
    n = np.array([0.62, 0.1]) / math.hypot(0.62, 0.1)
    slips = [(s.vel[0, 1] - s.vel[0, 0]) @ (-n[1], n[0]) for s in (start, smooth, end)]
    assert abs(slips[2]) < 0.99 * abs(slips[1])
    assert slips[2] * slips[0] > 0  # slowed, not reversed
    state = begun(pair, [(0, -19.69), (50, 0)], [(2.0, -0.5), (0, 0)])
    before, slip = energy(pair, state), 2.0
    for _ in range(200):
        state = pair.run(state, 10)
        depth = max(0.0, RADIUS - (float(state.pos[0, 0, 1]) + 20))
        now = energy(pair, state) + 0.5 * K * depth**2
        assert now <= before * (1 + 1e-9)
        assert 0 <= state.vel[0, 0, 0] <= slip
        slip = float(state.vel[0, 0, 0])
    assert slip < 1.95


def test_friction_is_helbing_s_up_to_coulomb_s_bound() -> None:
    """On the floor with normal force k d: friction is the smaller of kappa d v and mu k d."""
    depth, slow, fast, mu = 0.01, 0.001, 2.0, 0.4
    floor = bodies(friction=3e4, coulomb=mu)
    for speed, friction in ((slow, 3e4 * depth * slow), (fast, mu * K * depth)):
        state = begun(floor, [(0, -20 + RADIUS - depth), (50, 0)], [(speed, 0), (0, 0)])
        force = forces(floor, state)[0]
        np.testing.assert_allclose(force, [-friction, K * depth], rtol=1e-4)


def test_contact_force_of_a_pair_is_helbing_s() -> None:
    """k g n + kappa g dv.t t with dv = v_j - v_i, t = (-n_y, n_x)."""
    pair = bodies(friction=700.0)
    pos, vel = np.array([(0.1, 0.2), (0.45, 0.5)]), np.array([(0.3, -0.8), (-1.1, 0.4)])
    force = forces(pair, begun(pair, pos, vel))
    d = pos[0] - pos[1]
    n = d / np.linalg.norm(d)
    t, g = np.array([-n[1], n[0]]), 2 * RADIUS - np.linalg.norm(d)
    expected = K * g * n + 700.0 * g * ((vel[1] - vel[0]) @ t) * t
    np.testing.assert_allclose(force, [expected, -expected], rtol=1e-4)


@pytest.mark.parametrize("depth", [0.05, 0.2, 0.59, 0.6])
def test_overlapping_bodies_separate_at_most_at_the_given_speed(depth: float) -> None:
    """Stress case P27. While the spring is below its bound: -u/U - ln(1 - u/U) = w^2 d^2 / (2 U^2)."""
    most, masses = 1.2, (2.0, 0.5)
    omega = math.sqrt(K * (1 / masses[0] + 1 / masses[1]))
    pair = bodies(masses, most=most)
    start = begun(pair, [(0, 0), (2 * RADIUS - depth, 0)], [(0, 0), (0, 0)])
    state, fastest = start, 0.0
    for _ in range(100):
        state = pair.run(state, 40)
        fastest = max(fastest, float(np.linalg.norm(state.vel[0, 1] - state.vel[0, 0])))
    assert fastest <= most
    assert np.linalg.norm(state.pos[0, 1] - state.pos[0, 0]) > 2 * RADIUS
    np.testing.assert_allclose(momentum(pair, state), 0, atol=1e-12)
    if depth * omega < most:
        share = brentq(lambda s: -s - math.log(1 - s) - 0.5 * (omega * depth / most) ** 2, 0, 1 - 1e-12)
        assert fastest == pytest.approx(share * most, rel=2e-3)
    else:
        assert fastest > 0.8 * most
    if depth == 0.2:
        wild = pair.with_effects(Contact(radius=0.6, stiffness=K), ObstacleContact(stiffness=K))
        end = wild.run(start, 2000)
        assert np.linalg.norm(end.vel[0, 1] - end.vel[0, 0]) == pytest.approx(omega * depth, rel=1e-2)


# --- the longest step -----------------------------------------------------------------------------------------------


def warned(of: Scene) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_contact(of)
    assert all(w.category is CoarseContactWarning for w in caught)
    return [str(w.message) for w in caught]


@pytest.mark.parametrize(("method", "steps"), [
    (SemiImplicitEuler(), 30), (RK4(), 30), (AdaptiveRK4(), 4), (AveragedVelocity(), 52.5), (ExplicitEuler(), 105.3),
    (ImplicitEuler(), 105.3),
])  # fmt: skip
def test_number_of_steps_that_a_contact_needs(method: Integrator, steps: float) -> None:
    """Explicit Euler: (1 + y^2)^(pi / 2y) = 1.05, with a margin of 0.002."""
    y = contact_limit(method)
    assert math.pi / y == pytest.approx(steps, abs=0.5)
    if method.kind in ("explicit_euler", "implicit_euler"):
        assert (1 + y * y) ** (math.pi / 2 / y) == pytest.approx(1.048, rel=1e-3)


def test_contact_of_too_few_steps_raises_a_warning_with_the_limit() -> None:
    omega = math.sqrt(K * (1 / 2.0 + 1 / 0.5))
    most = math.pi / omega / 30
    silent = bodies(dt=0.99 * most)
    assert warned(silent) == []
    with pytest.warns(CoarseContactWarning, match=rf"effects\[0\].contact lasts .* dt is at most {most:.3g} s"):
        coarse = bodies(dt=1.01 * most)
    assert len(warned(coarse)) == 1  # the lighter body's contact with a wall is slower than the pair's
    assert warned(bodies(dt=1.01 * most, ratio=0.3)) == []  # a damped contact need not conserve energy


@pytest.mark.slow
def test_neighbour_query_reaches_only_as_far_as_the_widest_two_touch() -> None:
    """900 bodies, one in ten twice as wide: a larger radius changes neither the number of pairs nor the forces."""
    spawn = {"low": (0.0, 0.0), "high": (30.0, 30.0), "speed": (0.0, 1.0)}
    groups = [{"count": 810, "radius": 0.3, "spawn": spawn}, {"count": 90, "radius": 0.6, "spawn": spawn}]
    found = []
    for radius in (1.2, 8.0):
        contact = {"kind": "contact", "stiffness": 10.0, "ratio": 0.3, "friction": 3.0, "radius": radius}
        scene = Scene.model_validate({"groups": groups, "effects": [contact]})
        state = scene.start(3)
        found.append((scene.step(state).count_of("pairs"), scene.acceleration(state)))
    assert found[0][0] == found[1][0] < 0.3 * 900**2
    np.testing.assert_array_equal(found[0][1], found[1][1])
    pos, radius = state.pos[0], scene.body.radius
    gap = np.linalg.norm(pos[:, None] - pos, axis=-1) - radius[:, None] - radius + 100.0 * np.eye(900)
    np.testing.assert_array_equal((found[0][1][0] != 0).any(axis=-1), (gap < 0).any(axis=1))


def test_radius_below_the_largest_sum_of_radii_is_refused() -> None:
    with pytest.raises(ValueError, match=r"effects\[0\].radius = 0.5: must be at least 0.6 m") as caught:
        bodies().with_effects(Contact(stiffness=1.0, radius=0.5))
    assert "\n" not in str(caught.value)
