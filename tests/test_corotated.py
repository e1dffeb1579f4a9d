"""Corotated elements: forces are gradients, rotations strain nothing, and an element that is inside out recovers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv.model.finite_elements import solve_static
from flockenv.model.networks import Cloth, Jelly, Mesh, Network, Rope
from flockenv.model.state import State
from flockenv.physics.effects import Elastic, Gravity
from flockenv.scene import Group, Scene
from tests.catalogue import Array, rotation

DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])


def scene(network: Network, each: float = 0.1, g: float = 0.0, dt: float = 1e-3, **fields: Any) -> Scene:
    """Return a network of corotated elements under gravity: one set of laws for most tests of this file."""
    dimension = network.dimension
    assert dimension is not None
    elastic = Elastic(**{"young": 1e3, "strain": "corotated"} | fields)
    down = (*(0.0,) * (dimension - 1), -g)
    group = Group(network=network, mass=each)
    return Scene(dimension=dimension, groups=(group,), effects=(elastic, Gravity(acceleration=down)), dt=dt)


def block(dimension: int, cells: int = 2, **fields: Any) -> Jelly:
    return Jelly(cells=(cells,) * dimension, sides=(1.0,) * dimension, **fields)


def moved(world: Scene, pos: Array, vel: Any = 0.0) -> State:
    state = world.start(0)
    return state.with_motion(np.broadcast_to(pos, state.shape), np.broadcast_to(vel, state.shape))


def volumes(world: Scene, state: State) -> Array:
    """Return the volume of each element over that at rest; negative if it is inside out."""
    network = world.groups[0].network
    assert network is not None
    elements = network.elements(world.dimension)
    now, rest = (points[elements] for points in (state.pos[0], network.rest_points(world.dimension)))
    return np.asarray(np.linalg.det(now[:, 1:] - now[:, :1]) / np.linalg.det(rest[:, 1:] - rest[:, :1]))


def potential(world: Scene, pos: Array) -> float:
    found = world.effects[0].potential(world.groups, moved(world, pos), world.space.displacement)
    assert found is not None
    return float(found[0])


def force(world: Scene, state: State) -> Array:
    return np.asarray(world.acceleration(state)[0] * world.body.mass[:, None])


@DIMENSIONS
def test_the_force_is_the_gradient_of_the_energy_in_any_shape(dimension: int) -> None:
    """Also of elements that are inside out."""
    world, rng = scene(block(dimension)), np.random.default_rng(0)
    state = world.start(0)
    state = moved(world, state.pos + 0.4 * rng.normal(size=state.shape))
    assert (volumes(world, state) < 0).any()
    found = force(world, state)
    for i in range(0, world.agents, 4):
        for k in range(dimension):
            step = np.zeros(state.shape)
            step[0, i, k] = 1e-6
            slope = (potential(world, state.pos + step) - potential(world, state.pos - step)) / 2e-6
            assert found[i, k] == pytest.approx(-slope, rel=1e-6, abs=1e-4)


@DIMENSIONS
def test_momentum_and_angular_momentum_are_conserved(dimension: int) -> None:
    """With damping, at strains of any size."""
    world, rng = scene(block(dimension), beta=0.01, dt=1e-4), np.random.default_rng(1)
    state = world.start(0)
    state = moved(world, state.pos + 0.3 * rng.normal(size=state.shape), rng.normal(size=state.shape))
    found, x = force(world, state), state.pos[0]
    size = np.abs(found).max()
    torque = np.cross(x, found).sum(axis=0) if dimension == 3 else (x[:, 0] * found[:, 1] - x[:, 1] * found[:, 0]).sum()
    assert np.abs(found.sum(axis=0)).max() < 1e-13 * world.agents * size
    assert np.abs(torque).max() < 1e-13 * world.agents * size
    still = force(world, moved(world, state.pos))
    assert (state.vel[0] * (found - still)).sum() < 0  # damping takes energy


@DIMENSIONS
def test_a_rotated_shape_has_no_force_and_a_small_strain_that_of_linear_elements(dimension: int) -> None:
    world = scene(block(dimension), beta=0.01, dt=1e-4)
    body = world.effects[0]
    assert isinstance(body, Elastic)
    points, rng = block(dimension).points(dimension), np.random.default_rng(2)
    u, v = 1e-6 * rng.normal(size=points.shape), 1e-4 * rng.normal(size=points.shape)
    linear = -(body.matrix(block(dimension), dimension) @ (u + 0.01 * v).ravel()).reshape(u.shape)
    for turn in (np.eye(dimension), rotation(dimension, 7)):
        assert np.abs(force(world, moved(world, points @ turn.T + 3.0))).max() < 1e-10
        found = force(world, moved(world, (points + u) @ turn.T, v @ turn.T))
        np.testing.assert_allclose(found, linear @ turn.T, atol=1e-4 * np.abs(linear).max())


def test_any_affine_deformation_of_an_irregular_mesh_leaves_inner_particles_at_rest() -> None:
    """The patch test: strain and stress are then the same in all elements."""
    net, rng = block(3), np.random.default_rng(3)
    points = net.points(3)
    points[13] += (0.1, -0.15, 0.2)  # the one in the middle
    mesh = Mesh(vertices=tuple(map(tuple, points.tolist())), tetrahedra=tuple(map(tuple, net.elements(3).tolist())))
    world = scene(mesh)
    found = force(world, moved(world, points @ (np.eye(3) + 0.4 * rng.normal(size=(3, 3)))))
    assert np.linalg.norm(found[13]) < 1e-11
    assert np.linalg.norm(found[0]) > 1


@pytest.mark.parametrize("shape", ["mirrored", "flat", "line", "point"])
def test_an_element_recovers_from_any_shape(shape: str) -> None:
    """Inside out, or all corners in a plane, on a line or in one place."""
    corners = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    world = scene(Mesh(vertices=corners, tetrahedra=((0, 1, 2, 3),)), young=100, beta=0.01)
    squash = {"mirrored": (1, 1, -1), "flat": (1, 1, 0), "line": (1, 0, 0), "point": (0, 0, 0)}[shape]
    state = moved(world, np.array(corners, float) * squash)
    end = world.run(state, 4000)
    assert volumes(world, end) == pytest.approx(1, abs=0.01)
    assert volumes(world, state) == pytest.approx(squash[2] * squash[1])


def test_a_block_that_starts_inside_out_recovers() -> None:
    """Every element of a mirror image is inside out."""
    world = scene(block(3), beta=0.01)
    state = world.start(0)
    state = moved(world, state.pos * (1, 1, -1) + 0.01 * np.random.default_rng(4).normal(size=state.shape))
    assert (volumes(world, state) < 0).all()
    np.testing.assert_allclose(volumes(world, world.run(state, 4000)), 1, atol=0.01)


def spun(dimension: int, strain: str) -> tuple[Scene, State]:
    """Return a block that turns once a second about its centre, with a centrifugal strain of less than 1 %."""
    world = scene(block(dimension), young=1e4, strain=strain)
    state = world.start(0)
    x = state.pos[0] - state.pos[0].mean(axis=0)
    vel = np.zeros(state.shape)
    vel[0, :, 0], vel[0, :, 1] = -2 * math.pi * x[:, 1], 2 * math.pi * x[:, 0]
    return world, moved(world, state.pos, vel)


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_spinning_block_keeps_its_volume_over_ten_turns(dimension: int) -> None:
    """Each element, 40 times a turn."""
    world, state = spun(dimension, "corotated")
    for _ in range(400):
        state = world.run(state, 25)
        np.testing.assert_allclose(volumes(world, state), 1, atol=0.01)
    x = state.pos[0] - state.pos[0].mean(axis=0)
    assert np.abs(x - (world.start(0).pos[0] - 0.5)).max() < 0.5  # ten turns: it is back


@pytest.mark.slow
def test_a_spinning_block_of_linear_elements_does_not_keep_its_volume() -> None:
    world, state = spun(3, "linear")
    found = []
    for _ in range(20):
        state = world.run(state, 25)
        found.append(volumes(world, state).mean())
    assert max(abs(volume - 1) for volume in found) > 0.1


def test_a_hanging_bar_stretches_as_the_closed_form() -> None:
    """Its weight W stretches it by W L / (2 E A), at any strain if Poisson's ratio is 0."""
    net = Jelly(cells=(2, 8), sides=(0.5, 4.0), pinned=("top",), lumping="geometric", diagonals="parallel")
    world = scene(net, each=0.1, g=9.81, dt=2e-3, young=80, poisson=0, alpha=1.0)
    end = world.run(world.start(0), 20_000).pos[0]
    weight = 9.81 * 0.1 * net.size
    depth = 4.0 - net.points(2)[:, 1]
    expected = weight / (80 * 0.5) * (depth - depth**2 / 8)
    dropped = net.points(2)[:, 1] - end[:, 1]
    assert expected.max() > 1  # half as long again: not small
    rows = [np.isclose(depth, level) for level in np.unique(depth)]
    np.testing.assert_allclose(
        [dropped[row].mean() for row in rows], [expected[row].mean() for row in rows], atol=0.01 * expected.max()
    )


def test_a_cantilever_differs_from_linear_elements_by_the_square_of_its_load() -> None:
    """At the linear solution the forces that remain fall fourfold if the load is halved."""
    net = Jelly(cells=(12, 2), sides=(6.0, 1.0), pinned=("left",))
    world = scene(net)
    body, free, points = world.effects[0], np.isfinite(world.body.mass), net.points(2)
    assert isinstance(body, Elastic)
    held = np.flatnonzero(np.repeat(~free, 2))
    remains = []
    for load in (0.02, 0.01):
        weight = np.zeros(points.shape)
        weight[free, 1] = -load
        u = solve_static(body.matrix(net, 2), weight, held)
        acceleration = world.acceleration(moved(world, points + u))[0, free]
        remains.append(np.abs(acceleration * 0.1 + weight[free]).max())
    assert remains[0] / remains[1] == pytest.approx(4, rel=0.1)
    assert remains[1] < 0.5 * 0.01 * free.sum()


def test_networks_without_suitable_elements_are_refused_in_one_line() -> None:
    refused = (
        (2, Rope(links=3, length=1.0), "needs triangles, and this network (rope) has bars"),
        (3, Cloth(cells=(2, 2), edges=((1, 0, 0), (0, 1, 0))), "needs tetrahedra, and this network (cloth) has triang"),
    )
    for dimension, network, text in refused:
        with pytest.raises(ValueError, match=r"strain = corotated: in \d dimensions it needs") as caught:
            Scene(
                dimension=dimension, groups=(Group(network=network),),
                effects=(Elastic(young=1, strain="corotated"),), dt=1e-4,
            )  # fmt: skip
        assert text in str(caught.value)
        assert "\n" not in str(caught.value)
