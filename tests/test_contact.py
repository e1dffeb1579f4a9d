"""Solid obstacles: closed forms of a spring that only pushes; symmetries: test_effects.py."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockenv.effects import ObstacleContact
from flockenv.integrators import RK4
from flockenv.scene import Group, Scene
from flockenv.shapes import Block
from flockenv.spawn import Spawn

STIFFNESS, MASS, SPEED = 50.0, 2.0, 1.5
OMEGA = math.sqrt(STIFFNESS / MASS)


def scene(damping: float = 0.0, at: float = 3.4, speed: float = SPEED) -> Scene:
    """Somebody of radius 0.3 m flies along x from `at`; he touches an obstacle of radius 1 m at x = 3.7 m."""
    place = Spawn(low=(at, 0), high=(at, 0), speed=(speed, speed), heading=(1, 0))
    return Scene(
        groups=(Group(count=1, mass=MASS, radius=0.3, spawn=place),),
        obstacles=({"centre": (5.0, 0.0), "radius": 1.0},),
        effects=(ObstacleContact(stiffness=STIFFNESS, damping=damping),),
        integrator=RK4(),
        dt=0.001,
    )


def test_a_body_goes_in_as_far_as_its_energy_carries_it_and_comes_out_as_fast() -> None:
    elastic = scene()
    deepest = elastic.run(elastic.start(0), round(1000 * (0.2 + math.pi / 2 / OMEGA)))
    assert deepest.pos[0, 0, 0] == pytest.approx(3.7 + SPEED / OMEGA, abs=1e-5)
    np.testing.assert_allclose(deepest.vel[0, 0], 0.0, atol=0.01)
    out = elastic.run(elastic.start(0), round(1000 * (0.4 + math.pi / OMEGA)))
    assert out.vel[0, 0, 0] == pytest.approx(-SPEED, rel=1e-3)
    assert out.pos[0, 0, 0] == pytest.approx(3.4, abs=2e-3)


@pytest.mark.parametrize("damping", [2.0, 20.0, 100.0])
def test_damped_it_takes_speed_and_never_pulls(damping: float) -> None:
    """A plain spring and damper would pull back who leaves: his speed would fall again on the way out."""
    damped, speeds = scene(damping), []
    state = damped.start(0)
    for _ in range(60):
        state = damped.run(state, 25)
        speeds.append(state.vel[0, 0, 0])
    assert np.diff(speeds).max() <= 1e-12
    assert -SPEED < speeds[-1] <= 1e-3


def test_at_the_very_centre_there_is_a_way_out() -> None:
    inside = scene(at=5.0, speed=0.0)
    state = inside.run(inside.start(0), 100)
    assert np.isfinite(state.pos).all()
    assert abs(state.vel[0, 0, 0]) == pytest.approx(1.3 * OMEGA * math.sin(0.1 * OMEGA), rel=1e-5)


def test_nobody_is_pushed_who_does_not_touch() -> None:
    apart = scene(at=3.7 - 1e-9, speed=0.0)
    state = apart.run(apart.start(0), 100)
    np.testing.assert_array_equal(state.vel, 0.0)


def test_other_shapes_are_as_solid() -> None:
    """A block whose side is where the circle's nearest point was: head-on there is no difference."""
    block = scene().model_copy(update={"obstacles": (Block(centre=(5.0, 0.0), size=(2.0, 6.0)),)})
    steps = round(1000 * (0.2 + math.pi / 2 / OMEGA))
    assert block.run(block.start(0), steps).pos[0, 0, 0] == pytest.approx(3.7 + SPEED / OMEGA, abs=1e-5)
