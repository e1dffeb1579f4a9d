"""Fields, media, fluctuations and pressure: closed forms, statistics and refusals."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from flockenv.geometry.space import Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import (
    Attraction,
    Carried,
    Drag,
    Effect,
    Fluctuation,
    Gravity,
    Pressure,
    Sink,
    Source,
    Uniform,
    Vortex,
    Wind,
)
from flockenv.physics.integrators import RK4, SemiImplicitEuler
from flockenv.scene import Group, Scene
from tests.catalogue import Array


def scene_of(*effects: Effect, count: int = 1, dimension: int = 2, mass: float = 1.0, **fields: Any) -> Scene:
    spawn = Spawn(low=(0,) * dimension, high=(1,) * dimension)
    given = {"integrator": RK4(), "dt": 0.01} | fields
    return Scene(
        dimension=dimension, groups=(Group(count=count, mass=mass, spawn=spawn),), effects=effects, **given
    )  # fmt: skip


# --- time dependence --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_uniform_field_can_oscillate_in_time() -> None:
    """m v' = F cos(w t + phase): v and x are its integrals; stages of a method evaluate it at their own times."""
    scene = scene_of(Uniform(strength=(3, -1), period=0.7, phase=0.4), mass=1.5)
    start = scene.start(0)
    end = scene.run(start, 230)
    w, t, a = 2 * math.pi / 0.7, 2.3, np.array([2, -2 / 3])
    speed = (math.sin(w * t + 0.4) - math.sin(0.4)) / w
    shift = (math.cos(0.4) - math.cos(w * t + 0.4)) / w**2 - math.sin(0.4) / w * t
    np.testing.assert_allclose(end.vel[0, 0], a * speed, atol=1e-8)
    np.testing.assert_allclose((end.pos - start.pos)[0, 0], a * shift, atol=1e-8)


def test_gusts_rise_and_fall_within_a_period() -> None:
    """x of a tracer is the integral of U + G (1 - cos w t) / 2."""
    scene = scene_of(Wind(velocity=(2, 0), gust=(1, 3), period=0.8), Carried())
    start = scene.start(0)
    end = scene.run(start, 100)
    grown = (1 - math.sin(2 * math.pi / 0.8) * 0.8 / (2 * math.pi)) / 2
    np.testing.assert_allclose((end.pos - start.pos)[0, 0], (2 + grown, 3 * grown), atol=1e-8)


def test_steady_effects_have_no_parameters_of_time() -> None:
    steady = scene_of(Source(strength=1, centre=(0, 0), maximum=1), Wind(velocity=(1, 0)))
    swinging = scene_of(Source(strength=1, centre=(0, 0), maximum=1, period=2), Wind(velocity=(1, 0)))
    (source, wind), (swung, _) = steady.parts.number_plan.effects, swinging.parts.number_plan.effects
    assert "period" not in source.names
    assert "period" in swung.names
    assert not any("gust" in name for name in wind.names)


# --- media ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_dragged_and_carried_agents_follow_different_closed_forms() -> None:
    """Dragged from rest v = u (1 - exp(-c t / m)), and x lags behind u t by u m / c; carried x = u t, and v stays 0."""
    medium, u = Uniform(strength=(2, 1), acts="medium"), np.array([2, 1])
    ends = []
    for rate, share in ((0.8, 0.0), (0.0, 1.0), (0.0, 0.25)):
        scene = scene_of(medium, Drag(rate=rate), Carried(share=share), mass=0.5)
        start = scene.start(0)
        end = scene.run(start, 300)
        ends.append((end.vel[0, 0], (end.pos - start.pos)[0, 0]))
    left = 1 - math.exp(-0.8 / 0.5 * 3)
    np.testing.assert_allclose(ends[0], (u * left, u * (3 - left * 0.5 / 0.8)), rtol=1e-7)
    np.testing.assert_allclose(ends[1], (u * 0, u * 3), rtol=1e-12)
    np.testing.assert_allclose(ends[2], (u * 0, u * 0.75), rtol=1e-12)


@pytest.mark.slow
def test_media_are_summed() -> None:
    scene = scene_of(Uniform(strength=(2, 1), acts="medium"), Wind(velocity=(-1.5, 3)), Carried())
    start = scene.start(0)
    np.testing.assert_allclose((scene.run(start, 100).pos - start.pos)[0, 0], (0.5, 4), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_nearest_image_of_a_centre_acts_on_a_torus(dimension: int) -> None:
    """The forces are those in a plane with the centre at that image."""
    size, place = (9.0, 7.0, 8.0)[:dimension], (8.5, 6.8, 0.1)[:dimension]
    given = {"strength": 2, "maximum": 3}
    turning = {"axis": (0.6, 0, 0.8)} if dimension == 3 else {}

    def effects(centre: tuple[float, ...]) -> tuple[Effect, ...]:
        return (
            Source(centre=centre, **given), Attraction(centre=centre, strength=3, softening=0.2),
            Vortex(centre=centre, acts="medium", **given, **turning), Sink(centre=centre, acts="medium", **given),
            Drag(rate=0.5), Carried(),
        )  # fmt: skip

    torus = scene_of(*effects(place), dimension=dimension, space=Torus(size=size), count=1)
    plane = scene_of(*effects(place), dimension=dimension)
    rng = np.random.default_rng(1)
    for x in rng.uniform(0, 1, (20, dimension)) * size:
        image = x + torus.space.displacement(x, place)
        start, open_ = torus.start(0), plane.with_effects(*effects(tuple(map(float, image))))
        start.pos[...], start.vel[...] = x, 0.3
        for a, b in zip(torus.rates(start), open_.rates(start), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)


# --- fluctuations -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_variances_under_fluctuations_do_not_depend_on_dt() -> None:
    """For three values of dt, var x after T is (s/m)^2 T^3 / 3 and var v is (s/m)^2 T, within 5 %."""
    seconds, s, m = 2.0, 0.6, 1.5
    for dt in (0.1, 0.05, 0.025):
        scene = scene_of(Fluctuation(strength=s), Drag(rate=0), count=10_000, mass=m, dt=dt)
        start = scene.start(4)
        end = scene.run(start, round(seconds / dt))
        np.testing.assert_allclose((end.pos - start.pos).var(), (s / m) ** 2 * seconds**3 / 3, rtol=0.05)
        np.testing.assert_allclose(end.vel.var(), (s / m) ** 2 * seconds, rtol=0.05)
        assert abs(end.vel.mean()) < 4 * s / m * math.sqrt(seconds / 20_000)


@pytest.mark.slow
def test_fluctuations_and_drag_reach_the_equilibrium_variance() -> None:
    """var v = s^2 / (2 c m) per direction, and in the long run x diffuses: var x = 2 D t + ..., D = s^2 / (2 c^2).

    v is measured just after a kick, before drag acts on it, and is too large by a factor of about 1 + c dt / m; the two
    steps are therefore short.
    """
    s, m, c = 0.6, 0.25, 0.5
    for dt in (0.02, 0.01):
        scene = scene_of(Fluctuation(strength=s), Drag(rate=c), count=10_000, mass=m, dt=dt)
        start = scene.start(4)
        early, late = (scene.run(start, round(seconds / dt)) for seconds in (5, 10))
        after_a_kick = 2 * c / m * dt / (1 - math.exp(-2 * c / m * dt))
        np.testing.assert_allclose(late.vel.var(), s**2 / (2 * c * m), rtol=0.05)
        np.testing.assert_allclose(late.vel.var(), s**2 / (2 * c * m) * after_a_kick, rtol=0.03)
        gained = (late.pos - start.pos).var() - (early.pos - start.pos).var()
        np.testing.assert_allclose(gained, s**2 / c**2 * 5, rtol=0.1)
        assert (late.vel**4).mean() / late.vel.var() ** 2 == pytest.approx(3, rel=0.1)  # normal


@pytest.mark.slow
def test_a_kick_is_a_function_of_seed_world_step_and_agent() -> None:
    scene = scene_of(Fluctuation(strength=1), Drag(rate=0), count=200)
    start = scene.start(4, worlds=3)
    steps = [start]
    for _ in range(3):
        steps.append(scene.step(steps[-1]))
    kicks = np.stack([b.vel - a.vel for a, b in pairwise(steps)])
    assert len(np.unique(kicks)) == kicks.size
    assert np.abs(np.corrcoef(kicks.reshape(9, -1))[~np.eye(9, dtype=bool)]).max() < 0.25  # steps and worlds
    np.testing.assert_array_equal(scene.run(start, 3).vel, steps[-1].vel)
    np.testing.assert_array_equal(scene.run(scene.start(5), 3).vel[0], steps[-1].vel[1])


# --- pressure ---------------------------------------------------------------------------------------------------------

PRESSURE = Pressure(strength=1.5, density=1.0, radius=1.35)
DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])


def pushed(x: Array, dimension: int) -> Array:
    """Return the formula summed over all pairs, (N, D)."""
    a2, offset = PRESSURE.distance(dimension) ** 2, x[:, None] - x[None]
    square = (offset**2).sum(axis=2) + np.eye(len(x)) * 1e9
    force = 1.5 * (a2 - square) / (square + a2 / 64) * np.maximum(1 - square / 1.35**2, 0) ** 2
    return np.asarray((offset * (force / np.sqrt(square))[..., None]).sum(axis=1))


@DIMENSIONS
def test_pressure_follows_its_formula_and_goes_smoothly_to_0_at_its_radius(dimension: int) -> None:
    scene = scene_of(PRESSURE, Drag(rate=0), count=40, dimension=dimension, mass=0.5)
    start = scene.start(0)
    start.pos[0] *= 3
    np.testing.assert_allclose(0.5 * scene.acceleration(start)[0], pushed(start.pos[0], dimension), rtol=1e-9)

    pair, a = scene_of(PRESSURE, Drag(rate=0), count=2, dimension=dimension), PRESSURE.distance(dimension)
    state = pair.start(0)

    def force(r: float) -> float:
        """Return the force on the second of two agents, away from the first."""
        state.pos[0], state.pos[0, 1, 0] = 0, r
        found = pair.acceleration(state)[0]
        np.testing.assert_array_equal(found[0], -found[1])
        return float(found[1, 0])

    assert force(0.5 * a) > 0 > force(1.1 * a)
    assert force(a) == pytest.approx(0, abs=1e-12)
    assert force(1.35) == force(5) == 0
    assert abs(force(1.35 - 1e-5)) < 1e-8  # the slope is also 0
    assert force(1e-9) == pytest.approx(1.5 * 64, rel=1e-6)


@pytest.mark.slow
@DIMENSIONS
@pytest.mark.parametrize("crowding", [1.5, 2.0])
def test_a_crowded_gas_relaxes_to_the_given_density(dimension: int, crowding: float) -> None:
    """The density within half the radius is right to 10 %; the centre of mass does not move."""
    count = 400
    edge = (count / crowding) ** (1 / dimension)
    scene = scene_of(PRESSURE, Drag(rate=1), count=count, dimension=dimension, dt=0.02, integrator=SemiImplicitEuler())
    start = scene.start(1, worlds=3)
    start.pos[...] *= edge
    end = scene.run(start, 5000)
    assert np.abs(end.vel).max() < 0.05
    away = np.linalg.norm(end.pos - end.pos.mean(axis=1, keepdims=True), axis=2)
    within = 0.5 * (count * (1 / math.pi if dimension == 2 else 0.75 / math.pi)) ** (1 / dimension)
    region = math.pi * within**2 if dimension == 2 else 4 / 3 * math.pi * within**3
    assert (away < within).sum() / (3 * region) == pytest.approx(1, abs=0.1)
    np.testing.assert_allclose(end.pos.mean(axis=1), start.pos.mean(axis=1), atol=1e-10)  # it began at rest


@pytest.mark.slow
def test_without_drag_a_gas_under_pressure_conserves_momentum() -> None:
    scene = scene_of(PRESSURE, Drag(rate=0), count=400, dt=0.002, integrator=SemiImplicitEuler())
    start = scene.start(1)
    start.pos[...] *= 14
    end = scene.run(start, 1000)
    assert np.abs(end.vel).max() > 1
    np.testing.assert_allclose(end.vel.sum(axis=1), start.vel.sum(axis=1), atol=1e-10)


# --- refusals ---------------------------------------------------------------------------------------------------------

GROUPS = (Group(count=1, spawn=Spawn(low=(0, 0), high=(1, 1))),)


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda: Scene(groups=GROUPS, effects=(Gravity(acceleration=(0, 0, -9.81)),)),
         "Scene: effects[0].acceleration = (0.0, 0.0, -9.81): has 3 numbers, but dimension = 2"),
        (lambda: Scene(groups=GROUPS, effects=(Drag(rate=1), Attraction(strength=1, centre=(1, 2, 3)))),
         "Scene: effects[1].centre = (1.0, 2.0, 3.0): has 3 numbers, but dimension = 2"),
        (lambda: Scene(groups=GROUPS, effects=(Vortex(strength=1, maximum=1, centre=(1, 2), axis=(0, 0, 1)),)),
         "Scene: effects[0].axis = (0.0, 0.0, 1.0): has 3 numbers, but dimension = 2"),
        (lambda: Scene(groups=GROUPS, effects=(Pressure(strength=1, density=1, radius=2),)),
         "Scene: effects[0].radius = 2: at this density nearest neighbours are a = 1.075 m apart; from 1.1 a = 1.182"),
        (lambda: Vortex(strength=1, maximum=1, centre=(1, 2, 3), axis=(0, 0, 0)),
         "Vortex: axis = (0.0, 0.0, 0.0): must be three numbers, not all 0, or None for the z axis"),
        (lambda: Uniform(strength=(1, 0), phase=0.5), "Uniform: phase = 0.5: needs a period"),
        (lambda: Wind(velocity=(1, 0), gust=(1, 0)), "Wind: gust and period go together: give both or neither"),
        (lambda: Wind(velocity=(1, 0), period=2), "Wind: gust and period go together: give both or neither"),
        (lambda: Source(strength=1, maximum=1, centre=(1, 2), acts="velocity"),
         "Source: acts = 'velocity': unknown; allowed: force, medium"),
        (lambda: Gravity(acceleration=(0, "-9.81")), "Gravity: acceleration[1] = '-9.81': must be a number, not text"),
        (lambda: Gravity(acceleration=(0,)), "Gravity: acceleration: must be a list of 2 to 3, each a number"),
    ],
)  # fmt: skip
def test_invalid_fields_are_refused_in_one_line(make: Any, line: str) -> None:
    with pytest.raises(ValueError, match="^" + re.escape(line)) as caught:
        make()
    assert "\n" not in str(caught.value)
