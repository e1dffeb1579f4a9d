"""Wall repulsion: closed forms (Kretz), and refused arguments. Its symmetries are tested in test_effects.py."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.geometry.space import Box, Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Drag, Uniform, WallRepulsion
from flockenv.physics.integrators import RK4
from flockenv.scene import Group, Scene

MASS = 80.0


def approach(speed: float, tau: float, decay: float, strength: float, normal: Any = (-2.0, 0.0)) -> Scene:
    """Return an agent that walks along x to a wall at x = 5 m: m x'' = m (v0 - x') / tau - A exp(-d / B)."""
    effects = (
        Drag(rate=MASS / tau),
        Uniform(strength=(MASS * speed / tau, 0.0)),
        WallRepulsion(point=(5.0, -3.0), normal=normal, strength=strength, decay=decay),
    )
    group = Group(count=1, mass=MASS, spawn=Spawn(low=(0, 0), high=(0, 0)))
    return Scene(groups=(group,), effects=effects, integrator=RK4(), dt=0.002)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "tau", "decay", "oscillates"),
    [(0.8, 0.5, 0.08, True), (1.34, 0.05, 0.5, False), (1.0, 0.05, 0.2, False), (1.0, 0.2, 0.1, True)],
)
def test_an_agent_oscillates_in_front_of_a_wall_as_the_formula_predicts(
    speed: float, tau: float, decay: float, oscillates: bool
) -> None:
    """P11, N13: no sign change of velocity iff v0 tau / B <= 1/4; the gap is B ln(A tau / (m v0))."""
    strength = 2000.0
    scene = approach(speed, tau, decay, strength)
    state = scene.start(0)
    state.vel[0, 0, 0] = speed
    velocities = []
    for _ in range(10_000):
        state = scene.step(state, out=state)
        velocities.append(float(state.vel[0, 0, 0]))
    signs = np.sign(np.array(velocities)[np.abs(velocities) > 1e-9])
    changes = int((signs[1:] != signs[:-1]).sum())
    assert (changes >= 2) == oscillates
    assert oscillates or changes == 0
    gap = decay * np.log(strength * tau / (MASS * speed))
    assert 5 - state.pos[0, 0, 0] == pytest.approx(gap, abs=1e-3)
    assert state.pos[0, 0, 1] == 0


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_the_force_is_the_formula_and_the_gradient_of_its_potential(dtype: str) -> None:
    wall = WallRepulsion(point=(5.0, -3.0), normal=(-3.0, 4.0), strength=70.0, decay=0.8)
    spawn = Spawn(low=(3, -4), high=(6, -2))
    scene = Scene(groups=(Group(count=50, mass=2, spawn=spawn),), effects=(wall,), dtype=dtype)
    state = scene.start(1)
    away = (state.pos[0].astype(float) - (5, -3)) @ (-0.6, 0.8)
    assert away.min() < 0 < away.max()
    force = 2 * scene.acceleration(state)[0]
    rtol = 1e-12 if dtype == "float64" else 1e-5
    np.testing.assert_allclose(force, 70 * np.exp(-away / 0.8)[:, None] * (-0.6, 0.8), rtol=rtol)
    assert force.dtype == dtype
    if dtype == "float64":
        energy = []
        for step in (1e-6, -1e-6):
            moved = state.copy()
            moved.pos[0, 7, 0] += step
            energy.append(wall.potential(scene.groups, moved, scene.space.displacement)[0])
        assert (energy[0] - energy[1]) / 2e-6 == pytest.approx(-force[7, 0], rel=1e-6)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"normal": (0, 0)}, "normal = (0.0, 0.0): must be a direction"),
        ({"normal": (1e-200, 0)}, "normal[0] = 1e-200"),
        ({"normal": (0, 1e200)}, "normal[1] = 1e+200"),
        ({"decay": 0}, "decay = 0"),
        ({"strength": -1}, "strength = -1"),
    ],
)
def test_invalid_walls_are_refused_in_one_line(fields: Any, message: str) -> None:
    good = {"point": (0, 0), "normal": (0, 1), "strength": 1, "decay": 1}
    with pytest.raises(ValueError, match="WallRepulsion") as caught:
        WallRepulsion(**{**good, **fields})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_walls_are_refused_on_a_torus_and_allowed_in_a_box() -> None:
    wall = WallRepulsion(point=(0, 0), normal=(0, 1), strength=1, decay=1)
    scene = Scene(space=Box(size=(9, 9)), groups=(Group(count=1),), effects=(wall,))
    with pytest.raises(ValueError, match=r"effects\[0\].kind = wall_repulsion: on a torus") as caught:
        scene.model_copy(update={"space": Torus(size=(9, 9))})
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"effects\[0\].normal"):
        scene.with_effects(wall.model_copy(update={"normal": (0, 1, 0)}))
