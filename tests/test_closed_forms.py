"""Closed forms: drag, gravity, central fields, vortices, Kepler's orbits.

Scenes contain several effects, of which a test uses one and the others are idle, so that they share one kernel.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import (
    Attraction,
    Carried,
    Drag,
    Effect,
    Gravity,
    QuadraticDrag,
    Sink,
    Source,
    Tether,
    Uniform,
    Vortex,
)
from flockenv.physics.integrators import RK4, ExplicitEuler, Integrator, SemiImplicitEuler, VelocityVerlet
from flockenv.scene import Group, Scene
from tests.catalogue import Array

G = 9.81
PHI, MOST = 2.0, 5.0
SOFT = math.sqrt(PHI / MOST)  # sqrt(a), m


def body(effects: tuple[Effect, ...], method: Integrator, dt: float, mass: float = 1.0, **fields: Any) -> Scene:
    """Return a scene of one body under the given effects."""
    dimension = fields.get("dimension", 2)
    group = Group(count=1, mass=mass, spawn=Spawn(low=(0,) * dimension, high=(1,) * dimension))
    return Scene(groups=(group,), effects=effects, integrator=method, dt=dt, **fields)


def begin(scene: Scene, x: tuple[float, ...], v: tuple[float, ...]) -> State:
    start = scene.start(0)
    start.pos[...], start.vel[...] = x, v
    return start


def path(scene: Scene, start: State, rows: int, every: int) -> tuple[Array, Array]:
    """Return positions and velocities of the first body at the start and after every `every` steps, (rows + 1, D)."""
    found, state = [(start.pos[0, 0].copy(), start.vel[0, 0].copy())], start.copy()
    for _ in range(rows):
        scene.step(state, out=state, steps=every)
        found.append((state.pos[0, 0].copy(), state.vel[0, 0].copy()))
    x, v = (np.array(column) for column in zip(*found, strict=True))
    return x, v


# --- gravity and drag -------------------------------------------------------------------------------------------------


def falling(method: Integrator, dt: float, linear: float = 0.0, quadratic: float = 0.0, mass: float = 1.0) -> Scene:
    return body((Gravity(), Drag(rate=linear), QuadraticDrag(rate=quadratic)), method, dt, mass)


METHODS = pytest.mark.parametrize(
    ("method", "precision"),
    [(SemiImplicitEuler(), 0.13), pytest.param(VelocityVerlet(), 1e-4, marks=pytest.mark.slow), (RK4(), 1e-9)],
    ids=lambda value: getattr(value, "kind", ""),
)  # fmt: skip
"""Methods of order 1, 2 and 4, with a bound on the error in 400 steps."""


@METHODS
def test_projectile_in_linear_drag_has_the_closed_form(method: Integrator, precision: float) -> None:
    """With c/m = 0.2 / s and v = (10, 15) m/s it lands after 2.798418 s at 21.43051 m."""
    seconds, rate, mass = 2.798418, 0.2, 2.5
    scene = falling(method, seconds / 400, linear=rate * mass, mass=mass)
    end = scene.run(begin(scene, (0, 0), (10, 15)), 400).pos[0, 0]
    left = 1 - math.exp(-rate * seconds)
    height = (15 + G / rate) * left / rate - G * seconds / rate
    assert height == pytest.approx(0, abs=2e-5)
    np.testing.assert_allclose(end, (10 * left / rate, height), atol=precision)
    assert end[0] == pytest.approx(21.43051, abs=precision + 1e-5)


@METHODS
def test_fall_in_quadratic_drag_has_the_closed_form(method: Integrator, precision: float) -> None:
    """Terminal speed 20 m/s: after 3 s the speed is 17.997264 m/s and the depth 33.831523 m (g = 9.81 m/s^2)."""
    mass, terminal = 2.5, 20.0
    scene = falling(method, 3 / 400, quadratic=mass * G / terminal**2, mass=mass)
    end = scene.run(begin(scene, (0, 0), (0, 0)), 400)
    assert -end.vel[0, 0, 1] == pytest.approx(17.997264, abs=precision + 5e-7)
    assert -end.pos[0, 0, 1] == pytest.approx(33.831523, abs=precision + 5e-7)


def test_quadratic_drag_is_along_the_velocity_not_per_axis() -> None:
    scene = falling(RK4(), 0.01, quadratic=0.5).with_effects(
        Gravity(acceleration=(0, 0)), Drag(rate=0), QuadraticDrag(rate=0.5)
    )
    end = scene.run(begin(scene, (0, 0), (3, 4)), 100)
    # dv/dt = -c v^2 / m along a straight line: v = v0 / (1 + c v0 t / m), x = m / c ln(1 + c v0 t / m)
    np.testing.assert_allclose(end.vel[0, 0], np.array([3, 4]) / (1 + 0.5 * 5), rtol=1e-6)
    np.testing.assert_allclose(end.pos[0, 0], np.array([0.6, 0.8]) * math.log(1 + 0.5 * 5) / 0.5, rtol=1e-6)


def test_semi_implicit_euler_conserves_a_modified_energy_in_a_fall() -> None:
    """v^2 / 2 + g y - h v g / 2 is conserved to rounding; the plain energy drifts."""
    scene = falling(SemiImplicitEuler(), 0.01)
    x, v = path(scene, begin(scene, (0, 0), (1, 2)), 100, 10)
    plain = (v**2).sum(axis=1) / 2 + G * x[:, 1]
    np.testing.assert_allclose(plain - 0.01 * G * v[:, 1] / 2, plain[0] - 0.01 * G, atol=1e-9)
    assert plain[-1] - plain[0] == pytest.approx(-4.8, abs=0.05)


def test_acceleration_of_a_fall_does_not_depend_on_mass_unless_infinite() -> None:
    groups = tuple(Group(count=1, mass=mass, spawn=Spawn(low=(0, 0), high=(1, 1))) for mass in (0.1, 1, 70))
    scene = falling(RK4(), 0.01).model_copy(update={"groups": groups})
    scene.body.mass[1] = np.inf
    start = scene.start(1)
    end = scene.run(start, 100)
    np.testing.assert_allclose((end.pos - start.pos)[0, :, 1], [-G / 2, 0, -G / 2], atol=1e-12)
    np.testing.assert_array_equal(end.vel[0, 1], 0)


# --- central forces ---------------------------------------------------------------------------------------------------


def central(method: Integrator, dt: float, chosen: Effect, mass: float = 1.0) -> Scene:
    """Return a scene of central forces and a vortex at the origin; all but the chosen one are idle."""
    given = {"centre": (0, 0), "maximum": MOST}
    every = (
        Source(strength=0, **given), Sink(strength=0, **given), Vortex(strength=0, **given),
        Attraction(strength=0, centre=(0, 0)),
    )  # fmt: skip
    return body(tuple(chosen if e.kind == chosen.kind else e for e in every), method, dt, mass)


def potential(r: Array) -> Array:
    """Return the potential of a sink in J, Phi / sqrt(a) arctan(r / sqrt(a)); that of a source is its negative."""
    return PHI / SOFT * np.arctan(r / SOFT)


@pytest.mark.parametrize(("field", "sign"), [(Source, -1), (Sink, 1)])
def test_source_and_sink_conserve_energy(field: Any, sign: int) -> None:
    """The energy is m v^2 / 2 -+ Phi / sqrt(a) arctan(r / sqrt(a)); the path is curved."""
    scene = central(RK4(), 0.002, field(strength=PHI, centre=(0, 0), maximum=MOST), mass=1.5)
    x, v = path(scene, begin(scene, (0.2, 0.1), (-0.4, 2.0)), 200, 10)
    r = np.linalg.norm(x, axis=1)
    energy = 0.75 * (v**2).sum(axis=1) + sign * potential(r)
    assert np.ptp(r) > 0.2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


def test_speed_gained_from_a_source_equals_the_formula() -> None:
    """m = 1.5 kg from 0.2 m at rest: 2.309043 m/s at infinity, less at 2000 m, where Phi / r is still to gain."""
    scene = central(RK4(), 0.01, Source(strength=PHI, centre=(0, 0), maximum=MOST), mass=1.5)
    end = scene.run(begin(scene, (0.2, 0), (0, 0)), 100_000)
    left = math.pi / 2 * PHI / SOFT - float(potential(end.pos[0, 0, 0]))
    assert end.vel[0, 0, 0] == pytest.approx(math.sqrt(2.309043**2 - left / 0.75), abs=1e-6)
    assert left < 0.001


@pytest.mark.slow
@pytest.mark.parametrize(("field", "turn"), [(Vortex, 1), (Source, 0), (Sink, 0)])
@pytest.mark.parametrize("r", [0.3, 1.2, 4.0])
def test_work_around_a_circle_is_nonzero_for_a_vortex_only(field: Any, turn: int, r: float) -> None:
    """The integral of F . dx around a circle is 2 pi r W(r): the force of a vortex has no potential."""
    scene = central(RK4(), 0.01, field(strength=PHI, centre=(0, 0), maximum=MOST), mass=1.5)
    scene = scene.model_copy(update={"groups": (scene.groups[0].model_copy(update={"count": 64}),)})
    angle = np.arange(64) * 2 * np.pi / 64
    start = scene.start(0)
    start.pos[0], start.vel[0] = r * np.stack([np.cos(angle), np.sin(angle)], axis=1), 0
    force = 1.5 * scene.acceleration(start)[0]
    along = force @ np.array([[0, 1], [-1, 0]]).T  # rotated by -90 degrees: tangential becomes radial
    work = (along * start.pos[0]).sum() * 2 * np.pi / 64
    assert work == pytest.approx(turn * 2 * np.pi * r * PHI / (PHI / MOST + r**2), abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_forces_are_negative_gradients_of_the_potentials(dimension: int) -> None:
    """F . dx = -dU for small displacements dx. A medium, a vortex and an oscillating force have no potential."""
    centre = (0.3, -0.2, 0.5)[:dimension]
    given: dict[str, Any] = {"strength": PHI, "maximum": MOST, "centre": centre}
    down, aside = (0.3, -G, 1.0)[:dimension], (1.0, 0.5, -2.0)[:dimension]
    effects = (
        Gravity(acceleration=down), Uniform(strength=aside), Source(**given), Sink(**{**given, "strength": 0.7}),
        Attraction(centre=centre, strength=-1.5, softening=0.2),
    )  # fmt: skip
    scene = body(effects, RK4(), 0.01, mass=1.5, dimension=dimension)
    rng, start = np.random.default_rng(0), scene.start(0)

    def potential_at(x: Array) -> float:
        start.pos[0, 0] = x
        found = [effect.potential(scene.groups, start, scene.space.displacement) for effect in effects]
        return float(sum(one[0] for one in found if one is not None))

    for x, small in zip(rng.normal(size=(10, dimension)), 1e-5 * rng.normal(size=(10, dimension)), strict=True):
        change = potential_at(x + small) - potential_at(x - small)
        start.pos[0, 0] = x
        assert 1.5 * scene.acceleration(start)[0, 0] @ (2 * small) == pytest.approx(-change, rel=1e-5, abs=1e-10)
    without = (Vortex(**given), Source(**given, acts="medium"), Sink(**given, period=1.0))
    assert [effect.potential(scene.groups, start, scene.space.displacement) for effect in without] == [None] * 3


KEPLER = {  # stress case N04, 100 turns of 1000 steps: bounds on energy and angular momentum, shift in degrees
    "velocity_verlet": (VelocityVerlet(), 4e-4, 1e-12, -1.466),
    "rk4": (RK4(), 3e-7, 5e-8, 0.0),
    "semi_implicit_euler": (SemiImplicitEuler(), 2e-2, 1e-12, None),
}
ECCENTRICITY = 0.6


def orbit(method: Integrator, turns: int) -> tuple[Array, Array, Array]:
    """Return energy, angular momentum and direction of the perihelion (degrees) along an orbit with mu = a = 1."""
    scene = central(method, 2 * math.pi / 1000, Attraction(strength=1, centre=(0, 0)))
    e = ECCENTRICITY
    x, v = path(scene, begin(scene, (1 - e, 0), (0, math.sqrt((1 + e) / (1 - e)))), turns * 200, 5)
    r, spin = np.linalg.norm(x, axis=1), x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]
    vector = spin[:, None] * np.stack([v[:, 1], -v[:, 0]], axis=1) - x / r[:, None]  # Laplace-Runge-Lenz
    return (v**2).sum(axis=1) / 2 - 1 / r, spin, np.degrees(np.arctan2(vector[:, 1], vector[:, 0]))


@pytest.mark.parametrize(
    "name", [name if name == "velocity_verlet" else pytest.param(name, marks=pytest.mark.slow) for name in KEPLER]
)
def test_kepler_s_orbit_conserves_energy_and_angular_momentum_within_bounds(name: str) -> None:
    method, energy_bound, spin_bound, shift = KEPLER[name]
    energy, spin, perihelion = orbit(method, 100)
    worst = np.abs(energy / energy[0] - 1).max()
    assert energy_bound / 3 < worst < energy_bound
    assert np.abs(spin / spin[0] - 1).max() < spin_bound
    if shift is not None:
        assert perihelion[-1] == pytest.approx(shift, abs=5e-3)
    if name != "rk4":  # symplectic: the error does not grow
        assert np.abs(energy[-2000:] / energy[0] - 1).max() < 1.05 * np.abs(energy[:2001] / energy[0] - 1).max()


def test_explicit_euler_has_an_energy_error_of_64_percent_on_kepler_s_orbit() -> None:
    energy, _, _ = orbit(ExplicitEuler(), 10)
    assert np.abs(energy / energy[0] - 1).max() == pytest.approx(0.64, abs=0.01)


@pytest.mark.parametrize("strength", [3.0, -3.0])
def test_softened_attraction_and_repulsion_conserve_energy(strength: float) -> None:
    """Attraction leads straight through the centre, where softening keeps the force finite."""
    scene = central(RK4(), 0.002, Attraction(strength=strength, centre=(0, 0), softening=0.3), mass=1.5)
    x, v = path(scene, begin(scene, (1, 0), (-0.5, 0)), 200, 10)
    energy = 0.75 * (v**2).sum(axis=1) - strength / np.sqrt((x**2).sum(axis=1) + 0.09)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)
    assert (x[:, 0].min() < -0.5) == (strength > 0)


# --- carried by a vortex ----------------------------------------------------------------------------------------------

R = 1.2
SPEED = PHI / (PHI / MOST + R**2)
TURN = 2 * math.pi * R / SPEED


def tracer(method: Integrator, dt: float, **fields: Any) -> Scene:
    vortex = {"centre": (0.5, -0.3), "maximum": MOST, "acts": "medium"} | fields
    dimension = len(vortex["centre"])
    return body((Vortex(strength=PHI, **vortex), Carried()), method, dt, dimension=dimension)


@pytest.mark.slow
def test_tracer_circles_a_vortex_in_the_calculated_period() -> None:
    """Stress case N16: RK4, ten turns of 200 steps, |dr / r| <= 1e-6; a turn takes 6.936637 s."""
    assert pytest.approx(6.936637, abs=5e-7) == TURN
    scene = tracer(RK4(), TURN / 200)
    x, v = path(scene, begin(scene, (0.5 + R, -0.3), (0, 0)), 2000, 1)
    away = x - (0.5, -0.3)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), R, rtol=1e-6)
    np.testing.assert_allclose(away[50], (0, R), atol=1e-6)  # a quarter, counterclockwise
    np.testing.assert_allclose(away[-1], (R, 0), atol=1e-5)
    np.testing.assert_array_equal(v, 0)


@pytest.mark.slow
def test_explicit_euler_spirals_out_of_a_vortex_by_the_recursion() -> None:
    """r^2 <- r^2 + h^2 W(r)^2 holds to 1e-10; after 1000 steps of 0.05 s r = 1.7057155 m."""
    scene = tracer(ExplicitEuler(), 0.05)
    x, _ = path(scene, begin(scene, (0.5 + R, -0.3), (0, 0)), 1000, 1)
    square = [R**2]
    for _ in range(1000):
        square.append(square[-1] + (0.05 * PHI / (PHI / MOST + square[-1])) ** 2)
    np.testing.assert_allclose(((x - (0.5, -0.3)) ** 2).sum(axis=1), square, rtol=1e-10)
    assert math.sqrt(square[-1]) == pytest.approx(1.7057155, abs=5e-8)


@pytest.mark.slow
def test_vortex_in_3d_rotates_about_its_axis() -> None:
    """The rotation is right-handed, depends on the distance from the axis only, and not on the axis vector's length."""
    axis, centre = np.array([0.6, 0, 0.8]), np.array([0.5, -0.3, 1.0])
    scene = tracer(RK4(), TURN / 200, centre=tuple(centre), axis=(3.0, 0.0, 4.0))
    out, height = np.array([0.8, 0, -0.6]), 0.7
    start = begin(scene, tuple(centre + height * axis + R * out), (0, 0, 0))
    quarter = scene.run(start, 50).pos[0, 0] - centre
    np.testing.assert_allclose(quarter, height * axis + R * np.cross(axis, out), atol=1e-6)
    np.testing.assert_allclose(scene.run(start, 200).pos, start.pos, atol=1e-6)


def test_tether_damps_motion() -> None:
    """F = -k u - c v; with the opposite sign of c v it would add energy."""
    held = Scene(
        groups=(Group(count=1, mass=2, spawn=Spawn(low=(1, 0), high=(1, 0), speed=(3, 3), heading=(0, 1))),),
        effects=(Tether(centre=(0, 0), stiffness=8, damping=0.5),),
    )
    np.testing.assert_allclose(held.acceleration(held.start(0))[0, 0], [-8 / 2, -0.5 * 3 / 2], rtol=1e-12)
