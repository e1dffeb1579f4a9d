"""Strain-stress curves of springs: forces are those of the table, energies their integral, derivatives exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.model.networks import Mesh, Rope
from flockenv.physics.effects import Springs
from flockenv.physics.integrators import LinearlyImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.scene.stability import suggest_dt
from tests.catalogue import Array
from tests.test_linearly_implicit import dense, differences

STIFFENS = ((-0.5, -0.1), (-0.1, -0.1), (0.0, 0.0), (0.2, 0.1), (0.5, 0.9))
SLACK = ((-1.0, 0.0), (0.0, 0.0), (0.1, 0.1), (0.3, 0.1))  # no force if compressed; ideally plastic beyond 0.1
CURVES = pytest.mark.parametrize("curve", [STIFFENS, SLACK, ((0.0, 0.0), (1.0, 2.0))])
K, L = 300.0, 0.4
STRAINS = np.array([-0.7, -0.5, -0.3, -0.1, -0.05, 0.0, 0.1, 0.2, 0.3, 0.5, 0.8])
ROPE = Rope(links=1, length=L)


def scene(curve: Any, network: Any = ROPE, **fields: Any) -> Scene:
    springs = Springs(stiffness=K, curve=curve, **{name: fields.pop(name) for name in [*fields] if name in STRAIN})
    return Scene(groups=(Group(network=network, mass=0.1),), effects=(springs,), **{"dt": 1e-4} | fields)


STRAIN = {"yield_strain", "break_strain", "ratio", "rest"}


def interpolated(curve: Any, strain: Array) -> Array:
    """Return the force over k L: between points as numpy interpolates, beyond them along the first and last lines."""
    x, y = np.array(curve).T
    first, last = (y[1] - y[0]) / (x[1] - x[0]), (y[-1] - y[-2]) / (x[-1] - x[-2])
    beyond = first * np.minimum(strain - x[0], 0) + last * np.maximum(strain - x[-1], 0)
    return np.asarray(np.interp(strain, x, y) + beyond)


def at_strains(world: Scene, strains: Array, rest: float = L) -> Any:
    """Return a state with a world for each strain of the only spring."""
    state = world.start(0, len(strains))
    pos = np.zeros(state.shape)
    pos[:, 1, 0] = rest * (1 + strains)
    return state.with_motion(pos, np.zeros(state.shape))


@CURVES
def test_forces_are_those_of_the_table(curve: Any) -> None:
    world = scene(curve)
    found = world.acceleration(at_strains(world, STRAINS))
    np.testing.assert_allclose(found[:, 0, 0] * 0.1, K * L * interpolated(curve, STRAINS), rtol=1e-12, atol=1e-11)
    np.testing.assert_array_equal(found[:, 1], -found[:, 0])
    assert (found[STRAINS == 0] == 0).all()


@CURVES
def test_the_energy_is_the_integral_of_the_force(curve: Any) -> None:
    world = scene(curve)
    fine = np.linspace(0, 1, 40_001)
    for strain in STRAINS:
        found = world.effects[0].potential(
            world.groups, at_strains(world, np.array([strain])), world.space.displacement
        )
        force = K * L * interpolated(curve, fine * strain)
        assert found == pytest.approx([np.trapezoid(force, L * strain * fine)], rel=1e-6, abs=1e-9)


def test_a_straight_curve_has_the_bits_of_hooke() -> None:
    state = at_strains(scene(None), STRAINS)
    np.testing.assert_array_equal(
        scene(((-1.0, -1.0), (1.0, 1.0))).acceleration(state), scene(None).acceleration(state)
    )
    assert Springs(stiffness=1).numbers(2) == 3  # nothing of a curve is computed without one


@CURVES
def test_derivatives_are_those_of_the_forces(curve: Any) -> None:
    """Of a triangle whose sides are stretched by other strains; compressed ones would be clamped across."""
    mesh = Mesh(vertices=((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), triangles=((0, 1, 2),))
    world = scene(curve, mesh, integrator=LinearlyImplicitEuler())
    for corners in (((0.0, 0.0), (1.05, 0.0), (0.1, 1.3)), ((0.0, 0.0), (1.7, 0.1), (0.3, 1.1))):
        state = world.start(0).with_motion(np.array([corners]), np.zeros((1, 3, 2)))
        found, _ = dense(world, state, (1.0, 0.0, 1.0))
        expected = differences(world, state, of_velocity=False)
        np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_the_largest_stable_step_is_that_of_the_steepest_slope() -> None:
    hooke, steep = suggest_dt(scene(None)).dt, suggest_dt(scene(((0.0, 0.0), (0.1, 0.1), (0.2, 0.5)))).dt
    assert steep == pytest.approx(hooke / 2)


@pytest.mark.slow
def test_a_spring_with_a_curve_yields_about_its_present_rest_length() -> None:
    world = scene(STIFFENS, yield_strain=0.25, break_strain=2.0)
    strained = world.step(at_strains(world, np.array([0.2, 0.5, 2.5])))
    np.testing.assert_allclose(strained.bonds[:, 0], [L, L * 1.5 / 1.25, np.inf], rtol=1e-3)
    rest = strained.bonds[1, 0]
    again = at_strains(world, STRAINS, rest)
    again.bonds[:] = rest
    found = world.acceleration(again)[:, 0, 0] * 0.1
    np.testing.assert_allclose(found, K * rest * interpolated(STIFFENS, STRAINS), rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        (((0.0, 0.0),), "curve"),
        (((0.0, 0.0), (0.0, 1.0)), "strain 0 of point 1 is not larger than 0"),
        (((0.0, 0.0), (0.1, 0.2), (0.3, 0.1)), "force 0.1 of point 2 is less than 0.2"),
        (((0.0, 0.1), (1.0, 1.0)), "force at strain 0 is 0.1; must be 0"),
        (((0.1, 0.1), (0.2, 0.3)), "force at strain 0 is -0.1; must be 0"),
        (((0.0, 0.0), (1.0, np.inf)), "curve"),
    ],
)
def test_a_curve_that_is_none_is_refused(curve: Any, message: str) -> None:
    with pytest.raises(ValueError, match="curve") as refusal:
        Springs(stiffness=1, curve=curve)
    assert message in str(refusal.value) and "\n" not in str(refusal.value)
