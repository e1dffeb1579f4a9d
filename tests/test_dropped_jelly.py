"""A jelly that was turned inside out by a fall comes to rest in the shape of one that was set down."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockenv.geometry.shapes import HalfSpace
from flockenv.model.networks import Jelly
from flockenv.physics.constraints import Collisions
from flockenv.physics.effects import AltitudeSprings, Effect, Elastic, Gravity, Springs
from flockenv.scene import Group, Scene
from tests.catalogue import Array
from tests.test_corotated import volumes

pytestmark = pytest.mark.slow
EDGES = Springs(stiffness=40, damping=0.1)
ALTITUDES = AltitudeSprings(stiffness=40, damping=0.1)
ELASTIC = Elastic(young=200, alpha=1, beta=0.02, strain="corotated")


def at_rest(*laws: Effect, height: float, tilt: float = 0.0, friction: float = 0.0) -> tuple[Array, float]:
    """Return the volumes of the tetrahedra 6 s after a fall, over those without a load, and the least until then.

    height: m, of the corner that touches first. tilt: rad, about the y axis: the jelly lands on an edge, and turns
    over to its lower face.
    """
    along, up = 0.9 * math.cos(tilt), 0.9 * math.sin(tilt)
    net = Jelly(cells=(3, 3, 3), edges=((along, 0, up), (0, 0.9, 0), (-up, 0, along)), origin=(0, 0, height))
    floor = HalfSpace(point=(0, 0, 0), direction=(0, 0, 1))
    scene = Scene(
        dimension=3, groups=(Group(network=net, mass=0.05),), effects=(*laws, Gravity(acceleration=(0, 0, -9.81))),
        obstacles=(floor,), constraints=(Collisions(agents=False, restitution=0, friction=friction),), dt=2e-3,
    )  # fmt: skip
    state, least = scene.start(0), 1.0
    for _ in range(600):
        state = scene.run(state, 5)
        least = min(least, float(volumes(scene, state).min()))
    assert np.abs(state.vel).max() < 0.3
    return volumes(scene, state), least


def test_a_jelly_of_corotated_elements_recovers_from_a_fall_on_an_edge() -> None:
    """Some elements are inside out at the impact."""
    still, (fallen, least) = at_rest(ELASTIC, height=0.01)[0], at_rest(ELASTIC, height=3.0, tilt=0.6)
    assert least < -0.01
    np.testing.assert_allclose(fallen, still, atol=0.02)
    assert still.mean() > 0.95


def test_a_jelly_of_linear_elements_does_not_come_to_rest_in_that_shape() -> None:
    """They take its rotation for a strain."""
    linear = ELASTIC.model_copy(update={"strain": "linear"})
    still, fallen = at_rest(linear, height=0.01)[0], at_rest(linear, height=3.0, tilt=0.6)[0]
    assert np.abs(fallen - still).max() > 0.2
    assert fallen.mean() > 1.05


def test_a_jelly_of_altitude_springs_comes_to_rest_the_right_side_out() -> None:
    still, fallen = (at_rest(ALTITUDES, EDGES, height=height, friction=0.5)[0] for height in (0.01, 1.0))
    assert fallen.min() > 0.9
    np.testing.assert_allclose(fallen, still, atol=0.02)


def test_a_jelly_of_springs_along_its_edges_stays_inside_out() -> None:
    """Such springs cannot tell a tetrahedron from its mirror image."""
    still, fallen = (at_rest(EDGES, height=height, friction=0.5)[0] for height in (0.01, 1.0))
    assert (still > 0).all()
    assert (fallen < 0).mean() > 0.2
