"""Altitude springs: forces are gradients of the energy, and a tetrahedron of springs recovers from any shape."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.model.networks import Cloth, Mesh, Network
from flockenv.physics.effects import AltitudeSprings, Gravity, Springs
from flockenv.scene import Group, Scene
from tests.catalogue import rotation
from tests.test_corotated import block, force, moved, volumes


def scene(network: Network, each: float = 0.1, g: float = 0.0, dt: float = 1e-3, **fields: Any) -> Scene:
    """Return a network of altitude springs, springs along the edges, and gravity: one set of laws for this file."""
    across = AltitudeSprings(**{"stiffness": 40, "across": 30} | fields)
    effects = (across, Springs(stiffness=fields.get("stiffness", 40), damping=0.2), Gravity(acceleration=(0, 0, -g)))
    return Scene(dimension=3, groups=(Group(network=network, mass=each),), effects=effects, dt=dt)


def potential(world: Scene, pos: Any) -> float:
    found = [
        effect.potential(world.groups, moved(world, pos), world.space.displacement) for effect in world.effects[:2]
    ]
    return float(sum(each[0] for each in found if each is not None))


def test_the_force_is_the_gradient_of_the_energy_in_any_shape() -> None:
    """Also of tetrahedra that are inside out."""
    world, rng = scene(block(3)), np.random.default_rng(0)
    pos = world.start(0).pos
    pos = pos + 0.3 * rng.normal(size=pos.shape)
    assert (volumes(world, moved(world, pos)) < 0).any()
    found = force(world, moved(world, pos))
    for i in range(0, world.agents, 2):
        for k in range(3):
            step = np.zeros(pos.shape)
            step[0, i, k] = 1e-6
            slope = (potential(world, pos + step) - potential(world, pos - step)) / 2e-6
            assert found[i, k] == pytest.approx(-slope, rel=1e-5, abs=1e-5)


def test_momentum_and_angular_momentum_are_conserved() -> None:
    """With damping, which takes energy."""
    world, rng = scene(block(3), damping=0.3), np.random.default_rng(1)
    pos = world.start(0).pos
    state = moved(world, pos + 0.2 * rng.normal(size=pos.shape), rng.normal(size=pos.shape))
    found, size = force(world, state), np.abs(force(world, state)).max()
    assert np.abs(found.sum(axis=0)).max() < 1e-13 * world.agents * size
    assert np.abs(np.cross(state.pos[0], found).sum(axis=0)).max() < 1e-13 * world.agents * size
    assert (state.vel[0] * (found - force(world, moved(world, state.pos)))).sum() < 0


def test_a_rotated_shape_is_at_rest_and_its_mirror_image_is_not() -> None:
    world, points = scene(block(3)), block(3).points(3)
    assert np.abs(force(world, moved(world, points @ rotation(3, 3).T + 2.0))).max() < 1e-11
    assert np.abs(force(world, moved(world, points * (1, 1, -1)))).max() > 10
    edges = world.model_copy(update={"effects": (world.effects[0].idle_copy(), *world.effects[1:])})
    assert np.abs(force(edges, moved(edges, points * (1, 1, -1)))).max() < 1e-11


def test_the_frequencies_of_a_shape_at_rest_are_below_the_bound() -> None:
    """From differences of the acceleration, and not far below: within a factor of 2."""
    world, step = scene(block(3, pinned=("bottom",)), damping=0.05), 1e-6
    free = np.flatnonzero(np.repeat(np.isfinite(world.body.mass), 3))
    pos, columns = world.start(0).pos, []
    effects = (world.effects[0], world.effects[1].idle_copy(), world.effects[2])
    alone = world.model_copy(update={"effects": effects})
    for k in free:
        there = pos.copy()
        there.reshape(-1)[k] += step
        columns.append(alone.acceleration(moved(alone, there)).ravel()[free] / step)
    fastest = np.linalg.eigvals(-np.array(columns)).real.max()
    rates = world.effects[0].rates(world.groups, 3)
    assert rates is not None
    assert fastest <= rates[0].max() <= 4 * fastest
    np.testing.assert_allclose(rates[1], rates[0] * 0.05 / 40, rtol=0.3)


@pytest.mark.parametrize("squash", [(1, 1, -1), (1, 1, 0), (-1, -1, -1)])
def test_a_tetrahedron_recovers_from_any_shape(squash: tuple[int, int, int]) -> None:
    corners = ((0, 0, 0), (1, 0, 0), (0.3, 1, 0), (0.2, 0.4, 1))
    world = scene(Mesh(vertices=corners, tetrahedra=((0, 1, 2, 3),)), damping=0.3)
    state = moved(world, np.array(corners, float) * squash)
    assert volumes(world, world.run(state, 5000)) == pytest.approx(1, abs=1e-3)


def test_a_network_without_tetrahedra_is_refused_in_one_line() -> None:
    sheet = Group(network=Cloth(cells=(2, 2), edges=((1, 0, 0), (0, 1, 0))))
    with pytest.raises(ValueError, match=r"group = 0: needs tetrahedra, and its network \(cloth\) has triangles"):
        Scene(dimension=3, groups=(sheet,), effects=(AltitudeSprings(stiffness=1),), dt=1e-4)
