"""Liquids: viscosity and surface tension between neighbours, alone, beside pressure, and against closed forms."""

from __future__ import annotations

import math
import re
import warnings
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import ConvexHull

from flockenv.core.warnings import UnstableStepWarning
from flockenv.geometry.space import Torus
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Drag, Effect, Fluctuation, Pressure, SurfaceTension, Viscosity
from flockenv.physics.integrators import SemiImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.scene.stability import suggest_dt
from tests.catalogue import Array

PRESSURE = Pressure(strength=1.5, density=1.0, radius=1.35)
VISCOSITY = Viscosity(viscosity=0.7, density=1.0, radius=2.4)
TENSION = SurfaceTension(tension=0.9, density=1.0, radius=2.4)
DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])


def scene_of(*effects: Effect, count: int = 40, dimension: int = 2, mass: float = 1.0, **fields: Any) -> Scene:
    """Return agents under some effects; the others are idle, so that few kernels are compiled."""
    spawn = Spawn(low=(0,) * dimension, high=(1,) * dimension, speed=(0.5, 1))
    given = {"integrator": SemiImplicitEuler(), "dt": 0.01} | fields
    kinds = {
        effect.kind: effect for effect in (*(each.idle_copy() for each in (PRESSURE, VISCOSITY, TENSION)), *effects)
    }
    group = Group(count=count, mass=mass, spawn=spawn)
    return Scene(dimension=dimension, groups=(group,), effects=tuple(kinds.values()), **given)


def spread(scene: Scene, factor: float, seed: int = 0) -> State:
    """Return a start in a cube `factor` m wide."""
    state = scene.start(seed)
    state.pos[...] *= factor
    return state


def summed(x: Array, v: Array, dimension: int) -> tuple[Array, Array]:
    """Return the forces of viscosity and of surface tension by their formulas, over all pairs, (N, D) each."""
    offset, change = x[None] - x[:, None], v[None] - v[:, None]
    r = np.linalg.norm(offset, axis=2) + np.eye(len(x)) * 1e9
    n, q = offset / r[..., None], np.minimum(r / 2.4, 1)
    g = 0.7 * 480 / (math.pi * 2.4**4) if dimension == 2 else 0.7 * 1575 / (2 * math.pi * 2.4**5)
    hole = math.pi**-0.5 / 2.4 if dimension == 2 else (0.75 / math.pi) ** (1 / 3) / 2.4
    share = [quad(lambda q, power=power: q**power * (1 - q) ** 2, hole, 1)[0] for power in range(6)]
    z = share[dimension + 1] / share[dimension]
    k = 0.9 / 2.4 ** (dimension + 2) / (1 / 3 if dimension == 2 else math.pi / 8)
    k /= share[dimension + 2] - z * share[dimension + 1]
    slow = g * (1 - q) ** 2 * (n * change).sum(axis=2)
    pull = k * (1 - q) ** 2 * (q - z)
    return (slow[..., None] * n).sum(axis=1), (pull[..., None] * n).sum(axis=1)


@DIMENSIONS
def test_both_forces_follow_their_formulas(dimension: int) -> None:
    scene = scene_of(VISCOSITY, TENSION, dimension=dimension, mass=0.5)
    start = spread(scene, 4)
    expected = sum(summed(start.pos[0], start.vel[0], dimension))
    np.testing.assert_allclose(0.5 * scene.acceleration(start)[0], expected, rtol=1e-9, atol=1e-12)


@DIMENSIONS
def test_a_liquid_conserves_momentum_and_angular_momentum(dimension: int) -> None:
    """All forces are central and mutual, and a semi-implicit step keeps both quantities to rounding."""
    scene = scene_of(PRESSURE, VISCOSITY, TENSION, dimension=dimension)
    start = spread(scene, 4)
    end = scene.run(start, 200)

    def carried(state: State) -> tuple[Array, Array]:
        x, v = (np.pad(each[0], ((0, 0), (0, 3 - dimension))) for each in (state.pos, state.vel))
        return v.sum(axis=0), np.cross(x, v).sum(axis=0)

    assert np.abs(end.vel - start.vel).max() > 0.3
    for before, after in zip(carried(start), carried(end), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-12 * len(start.pos[0]))


def test_viscosity_only_reduces_kinetic_energy_and_leaves_motion_as_a_body() -> None:
    scene = scene_of(VISCOSITY)
    state = spread(scene, 4)
    energy = [float((state.vel**2).sum())]
    for _ in range(50):
        state = scene.step(state)
        energy.append(float((state.vel**2).sum()))
    assert (np.diff(energy) < 0).all()
    assert energy[-1] < 0.7 * energy[0]
    x = state.pos[0]
    state.vel[0] = np.array([0.3, -2]) + 1.7 * np.stack([-x[:, 1], x[:, 0]], axis=1)
    np.testing.assert_allclose(scene.acceleration(state), 0, atol=1e-12)


def lattice(rows: int) -> tuple[Array, tuple[float, float]]:
    """Return a triangular lattice of density 1 and the size of its torus; rows: even."""
    a = math.sqrt(2 / math.sqrt(3))
    i, j = np.mgrid[:12, :rows]
    x = np.stack([(i + 0.5 * (j % 2) + 0.25) * a, (j + 0.5) * a * math.sqrt(3) / 2], axis=2).reshape(-1, 2)
    return x, (12 * a, rows * a * math.sqrt(3) / 2)


@pytest.mark.slow
def test_a_shear_flow_decays_at_the_rate_of_the_given_viscosity() -> None:
    """v = U sin(k y) decays as exp(-eta k^2 t / (rho m)); so slow a flow does not disturb the lattice."""
    x, size = lattice(32)
    scene = scene_of(VISCOSITY, count=len(x), mass=2.0, space=Torus(size=size), dt=0.1)
    state, k = scene.start(0), 2 * math.pi / size[1]
    wave = np.sin(k * x[:, 1])
    state.pos[0], state.vel[0] = x, np.stack([1e-6 * wave, 0 * wave], axis=1)
    seconds = 2.0 / (0.7 * k**2)
    end = scene.run(state, round(seconds / 0.1))
    found = -math.log(float(end.vel[0, :, 0] @ wave / (state.vel[0, :, 0] @ wave))) / (round(seconds / 0.1) * 0.1)
    assert found == pytest.approx(0.7 * k**2 / 2, rel=0.03)


@DIMENSIONS
def test_neighbours_outside_the_hole_of_one_agent_give_the_tension_and_no_pressure(dimension: int) -> None:
    """By the force between two agents: Fowler's half work that separates two half-spaces, and the virial."""
    scene = scene_of(TENSION, count=2, dimension=dimension)
    hole = math.pi**-0.5 if dimension == 2 else (0.75 / math.pi) ** (1 / 3)
    r = hole + (2.4 - hole) * (np.arange(400) + 0.5) / 400
    state = scene.start(0, worlds=400)
    state.pos[...], state.vel[...] = 0, 0
    state.pos[:, 1, 0] = r
    pull = scene.acceleration(state)[:, 0, 0]
    share = r**3 / 3 if dimension == 2 else math.pi * r**4 / 8
    assert float((share * pull).mean() * (2.4 - hole)) == pytest.approx(0.9, rel=1e-3)
    assert abs(float((r**dimension * pull).sum())) < 1e-4 * float(np.abs(r**dimension * pull).sum())
    assert abs(pull[-1]) < 1e-4 < pull.max()


@pytest.mark.parametrize("radius", [2.1, 2.4, 3.0])
def test_surface_tension_hardly_presses_on_a_lattice(radius: float) -> None:
    """Its neighbours are not evenly distributed, so parts of the virial cancel only to some percent."""
    x, _ = lattice(32)
    scene = scene_of(TENSION.model_copy(update={"radius": radius}), count=2)
    r = np.linalg.norm(x - x[len(x) // 2 + 16], axis=1)
    r = r[(r > 0) & (r < radius)]
    assert len(r) >= 12
    state = scene.start(0, worlds=len(r))
    state.pos[...], state.vel[...] = 0, 0
    state.pos[:, 1, 0] = r
    part = r * scene.acceleration(state)[:, 0, 0]
    assert abs(part.sum()) < 0.15 * np.abs(part).sum()


@pytest.mark.slow
def test_an_oblong_drop_becomes_round_and_keeps_its_area() -> None:
    """A bar of 20 x 10 agents: kicks melt it, and tension makes its moments equal."""
    pressure, tension = PRESSURE.model_copy(update={"strength": 0.75}), TENSION.model_copy(update={"tension": 3.0})
    viscosity = VISCOSITY.model_copy(update={"viscosity": 0.2})
    scene = scene_of(pressure, viscosity, tension, Drag(rate=0.05), Fluctuation(strength=0.6), count=200, dt=0.02)
    start = scene.start(0)
    grid = np.stack(np.mgrid[:20, :10], axis=2).reshape(-1, 2)
    start.pos[0], start.vel[0] = grid + start.pos[0] * 0.1, 0

    def shape(state: State) -> Array:
        """Return the ratio of second moments, the area, and 4 pi area / circumference^2."""
        hull, moments = ConvexHull(state.pos[0]), np.linalg.eigvalsh(np.cov(state.pos[0].T))
        return np.array([moments[1] / moments[0], hull.volume, 4 * math.pi * hull.volume / hull.area**2])

    state, late = scene.run(start, 3000), []
    for _ in range(5):
        state = scene.run(state, 500)
        late.append(shape(state))
    (long, before, square), (ratio, after, circular) = shape(start), np.mean(late, axis=0)
    assert long > 4
    assert square < 0.7
    assert ratio < 1.35
    assert circular > 0.95
    assert after == pytest.approx(before, rel=0.1)


def test_the_largest_step_of_a_viscous_lattice_is_near_the_suggested_one() -> None:
    x, size = lattice(12)
    scene = scene_of(VISCOSITY, count=len(x), space=Torus(size=size))
    most = suggest_dt(scene)
    assert most.effect == "viscosity"

    def grows(dt: float) -> bool:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnstableStepWarning)
            bold = scene.model_copy(update={"dt": dt})
            state = bold.start(0)
        state.pos[0] = x
        state.vel[...] *= 1e-9  # it would move the lattice
        return bool(np.abs(bold.run(state, 200).vel).max() > 1e-9)

    assert not grows(0.99 * most.dt)
    assert grows(3 * most.dt)


def test_a_radius_with_few_neighbours_is_refused_in_one_line() -> None:
    line = "Scene: effects[1].radius = 1.2: at this density fewer than 12 neighbours are within it; at least 1.954 m"
    with pytest.raises(ValueError, match="^" + re.escape(line)) as caught:
        scene_of(VISCOSITY.model_copy(update={"radius": 1.2}))
    assert "\n" not in str(caught.value)
