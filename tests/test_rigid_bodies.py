"""Rigid bodies: free rotation against a reference, inclines, impacts, dice and stacks, forces of contacts, refusals."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.geometry.shapes import Block, Capsule, Circle, HalfSpace
from flockenv.geometry.space import Box, Torus
from flockenv.model.networks import Blocks, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.constraints import RigidBodies, Rods
from flockenv.physics.effects import Drag, Gravity
from flockenv.physics.population import Decay
from flockenv.scene import Group, Scene
from tests.catalogue import Array

G = 9.81
FLOOR = HalfSpace(point=(0, 0, 0), direction=(0, 0, 1))
CUBE = (1.0, 1.0, 1.0)


def scene_of(
    blocks: Blocks, *, dt: float = 0.01, down: tuple[float, ...] | None = None, obstacles: Any = (FLOOR,),
    drag: float = 0.0, mass: float = 1.0, space: Any = None, **rules: Any,
) -> Scene:  # fmt: skip
    """Return blocks, whose particles have the mean `mass`; all scenes of a dimension share one kernel."""
    d = blocks.dimension
    fall = down if down is not None else (0.0,) * (d - 1) + (-G,)
    return Scene(
        dimension=d, groups=(Group(network=blocks, mass=mass, radius=0.05),), dt=dt, obstacles=obstacles,
        effects=(Gravity(acceleration=fall), Drag(rate=drag)), constraints=(RigidBodies(**rules),),
        **({} if space is None else {"space": space}),
    )  # fmt: skip


def free(blocks: Blocks, **more: Any) -> Scene:
    return scene_of(blocks, down=(0.0,) * blocks.dimension, obstacles=(), **more)


def momenta(scene: Scene, state: State) -> tuple[Array, Array, float]:
    """Return momentum, angular momentum about the origin, and kinetic energy."""
    mass, x, v = np.asarray(scene.body.mass)[:, None], state.pos[0], state.vel[0]
    return (mass * v).sum(axis=0), (mass * np.cross(x, v)).sum(axis=0), float(0.5 * (mass * v**2).sum())


def bodies(scene: Scene, state: State) -> Array:
    """Return the particles of each block, (K, n, D) m."""
    network: Any = scene.groups[0].network
    return np.asarray(state.pos[0]).reshape(-1, network.each, scene.dimension)


# --- what a body is -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sides", [(1.0, 2.0), (1.0, 2.0, 3.0)])
def test_particles_have_mass_centre_and_inertia_of_a_solid_block(sides: tuple[float, ...]) -> None:
    """I = M (a^2 + b^2) / 12 about each axis; the second block is turned."""
    d = len(sides)
    turn = (30.0,) if d == 2 else (20.0, -50.0, 10.0)
    blocks = Blocks(sides=sides, centres=((0.5,) * d, (9.0,) * d), turns=((0.0,) * len(turn), turn))
    points, mass = blocks.points(d).reshape(2, -1, d), blocks.masses(12.0, d).reshape(2, -1)
    np.testing.assert_allclose(mass.sum(axis=1), 6.0)
    np.testing.assert_allclose((mass[..., None] * points).sum(axis=1) / 6, [(0.5,) * d, (9.0,) * d])
    for k, off in enumerate(points - points[:, -1:]):
        tensor = np.einsum("i,ij,ik->jk", mass[k], off, off)
        moments = np.sort(np.linalg.eigvalsh(tensor))
        np.testing.assert_allclose(moments, 6 * np.array(sides) ** 2 / 12)


def _numbers_in(value: Any) -> int:
    """Return how many numbers the arrays of a tuple, nested or not, have."""
    return value.size if isinstance(value, np.ndarray) else sum(map(_numbers_in, value))


@pytest.mark.parametrize("sides", [CUBE, (1.0, 1.0)])
def test_the_memory_that_is_told_is_that_of_bodies_and_contacts(sides: tuple[float, ...]) -> None:
    floor = HalfSpace(point=(0.0,) * len(sides), direction=(*(0.0,) * (len(sides) - 1), 1.0))
    centres = tuple((*(0.0,) * (len(sides) - 1), 0.5 + k) for k in range(10))
    scene = scene_of(Blocks(sides=sides, centres=centres), obstacles=(floor,))
    (rigid,) = scene.constraints
    settler: Any = rigid.settler(scene)
    allocated = _numbers_in(settler.solids) + _numbers_in(settler.contacts)
    assert 0.97 * allocated < rigid.numbers(scene) * scene.agents < 1.03 * allocated


def test_initial_velocities_are_those_of_the_spin_and_the_group() -> None:
    blocks = Blocks(sides=CUBE, centres=((1, 2, 3), (5, 5, 5)), turns=((0, 0, 45),), spins=((0, 0, 2), (1, 0, 0)))
    group = Group(network=blocks, spawn=Spawn(speed=(3, 3), heading=(0, 1, 0)))
    state = Scene(dimension=3, groups=(group,), constraints=(RigidBodies(),)).start(0)
    off = state.pos[0, :9] - np.array((1, 2, 3))
    np.testing.assert_allclose(state.vel[0, :9], np.cross((0, 0, 2), off) + np.array((0, 3, 0)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(off[:8, :2], axis=1), np.sqrt(0.5))
    np.testing.assert_allclose(np.abs(off[:8, :2]).min(axis=1), 0, atol=1e-12)


def test_a_free_body_keeps_momentum_angular_momentum_and_energy() -> None:
    scene = free(Blocks(sides=(1, 2, 3), centres=((1, 0, 0),), spins=((0.1, 4, 0.3),)))
    start = scene.start(0)
    start = start.with_motion(start.pos, start.vel + np.array((0.3, -0.2, 0.1)))
    before, state = momenta(scene, start), start.copy()
    for _ in range(20):
        state = scene.step(state, steps=50)
        for was, now in zip(before, momenta(scene, state), strict=True):
            np.testing.assert_allclose(np.asarray(now, float), np.asarray(was, float), rtol=1e-12, atol=1e-12)
    network: Any = scene.groups[0].network
    shape = state.pos[0] - state.pos[0, -1]
    np.testing.assert_allclose(shape @ shape.T, network.offsets() @ network.offsets().T, atol=1e-12)


def test_a_cuboid_tumbles_about_its_intermediate_axis_like_the_reference() -> None:
    """Euler's equations, integrated to 1e-12; the axis turns over, and the error is of order 2."""
    spin, moments, seconds = np.array((0.05, 4.0, 0.02)), 9 * np.array((13.0, 10.0, 5.0)) / 12, 4.0

    def rates(t: float, y: Array) -> Array:
        axes, omega = y[:9].reshape(3, 3), y[9:]  # rows: axes; omega in those
        turn = np.cross(axes.T @ omega, axes)
        return np.concatenate([turn.ravel(), np.cross(moments * omega, omega) / moments])

    exact = solve_ivp(rates, (0, seconds), np.concatenate([np.eye(3).ravel(), spin]), rtol=1e-11, atol=1e-12)
    axes = exact.y[:9].T.reshape(-1, 3, 3)
    assert axes[:, 1, 1].min() < -0.9  # it has turned over
    errors = []
    for steps in (250, 500):
        scene = free(Blocks(sides=(1, 2, 3), centres=((0, 0, 0),), spins=(tuple(spin),)), dt=seconds / steps)
        corners = scene.run(scene.start(0), steps).pos[0]
        found = np.array([corners[1] - corners[0], (corners[2] - corners[0]) / 2, (corners[4] - corners[0]) / 3])
        errors.append(np.abs(found - axes[-1]).max())
    assert errors[1] < 0.02
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)


def test_forces_on_particles_slow_down_the_rotation() -> None:
    """Drag c v at the corners of a cube: L decays as exp(-24 c t / M), since their sum of r^2 is 4 a^2."""
    scene = free(Blocks(sides=CUBE, centres=((0, 0, 0),), spins=((1, 2, 3),)), drag=0.1, dt=0.001)
    start = scene.start(0)
    decay = np.exp(-24 * 0.1 * 0.5 / 9)
    np.testing.assert_allclose(momenta(scene, scene.run(start, 500))[1], momenta(scene, start)[1] * decay, rtol=1e-3)


# --- contact with obstacles -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [20.0, 26.5, 26.6, 35.0])
@pytest.mark.parametrize("sides", [(1.0, 0.5), (1.0, 1.5, 0.5)])
def test_a_block_slides_on_an_incline_beyond_the_friction_angle(sides: tuple[float, ...], degrees: float) -> None:
    """The acceleration is g (sin a - mu cos a), or 0 up to atan(0.5) = 26.57 degrees; the plane is horizontal."""
    d, angle = len(sides), np.radians(degrees)
    floor = HalfSpace(point=(0,) * d, direction=(0,) * (d - 1) + (1,))
    down = (G * np.sin(angle), *(0.0,) * (d - 2), -G * np.cos(angle))
    scene = scene_of(
        Blocks(sides=sides, centres=((0,) * (d - 1) + (0.25,),)), down=down, obstacles=(floor,), friction=0.5
    )
    state = scene.run(scene.start(0), 100)
    expected = max(0.0, G * (np.sin(angle) - 0.5 * np.cos(angle)))
    np.testing.assert_allclose(state.vel[0, :, 0], expected, atol=1e-6)
    assert state.pos[0, -1, 0] == pytest.approx(0.5 * expected * 1.01, abs=1e-6)
    np.testing.assert_allclose(state.pos[0, -1, 1:], (0.0,) * (d - 2) + (0.25,), atol=1e-6)


@pytest.mark.parametrize("restitution", [0.0, 0.8, 1.0])
def test_a_block_that_falls_flat_bounces_to_the_height_of_its_restitution(restitution: float) -> None:
    scene = scene_of(Blocks(sides=CUBE, centres=((0, 0, 1.5),)), dt=0.001, restitution=restitution)
    state, heights = scene.start(0), []
    for _ in range(900):
        state = scene.step(state, out=state)
        heights.append(float(state.pos[0, -1, 2]) - 0.5)
    assert min(heights) > -1e-6
    assert max(heights[500:]) == pytest.approx(restitution**2, abs=0.01)


@pytest.mark.parametrize(("seed", "restitution"), [(0, 0.0), (1, 0.3), (2, 0.6)])
def test_a_thrown_die_comes_to_rest_on_a_face(seed: int, restitution: float) -> None:
    draw = np.random.default_rng(seed).uniform(-1, 1, (3, 3))
    blocks = Blocks(sides=CUBE, centres=((0, 0, 3),), turns=(tuple(90 * draw[0]),), spins=(tuple(8 * draw[1]),))
    scene = scene_of(blocks, dt=0.005, restitution=restitution)
    start = scene.start(0)
    state, lowest = start.with_motion(start.pos, start.vel + 3 * draw[2]), 0.0
    for _ in range(160):
        state = scene.step(state, out=state, steps=10)
        lowest = min(lowest, float(state.pos[0, :, 2].min()))
    assert lowest > -0.01
    assert momenta(scene, state)[2] < 1e-12
    assert np.sort(state.pos[0, :8, 2])[[0, 3]] == pytest.approx(0, abs=1e-5)
    assert state.pos[0, -1, 2] == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize(
    "obstacle",
    [
        Circle(centre=(0, 0, -1), radius=1.0), Block(centre=(0, 0, -1), size=(3, 0.5, 2), turn=30),
        Block(centre=(0, 0, -(2**0.5)), size=(2, 6, 2), turn=45, axis=(0, 1, 0)),
    ],
    ids=["ball", "block", "ridge"],
)  # fmt: skip
def test_a_block_is_carried_by_obstacles(obstacle: Any) -> None:
    """It balances on a ball, a narrow block and the edge of a turned one, whose forces carry its weight."""
    scene = scene_of(Blocks(sides=CUBE, centres=((0, 0, 0.5),)), obstacles=(obstacle,))
    state = scene.run(scene.start(0), 20)
    found = scene.contacts(state)
    np.testing.assert_allclose(found.force.sum(axis=0), (0, 0, 9 * G), atol=1e-4)
    assert (found.other == -1).all() and np.abs(found.point[:, 2]).max() < 1e-6
    assert np.abs(state.pos[0, -1] - (0, 0, 0.5)).max() < 1e-4


def test_the_walls_of_a_box_hold_blocks() -> None:
    blocks = Blocks(sides=(0.6, 0.4), centres=((1, 1), (1.8, 1.2), (1.2, 1.9)), turns=((20,), (70,), (-30,)))
    scene = scene_of(blocks, space=Box(size=(3, 2.5)), obstacles=(), down=(3.0, -G), dt=0.005)
    state = scene.run(scene.start(0), 1200)
    assert state.pos[0].min() > -1e-3 and state.pos[0, :, 0].max() < 3 + 1e-3
    assert np.abs(state.vel).max() < 1e-6
    np.testing.assert_allclose(scene.contacts(state).force[scene.contacts(state).other < 0].sum(axis=0), (-45, 15 * G))


# --- contact of bodies ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_impacts_keep_momentum_and_angular_momentum_and_add_no_energy(restitution: float) -> None:
    blocks = Blocks(
        sides=(1, 1.2, 0.8), centres=((0, 0, 0), (2.2, 0.3, 0.2)), turns=((20, 30, 10), (0, 0, 0)),
        spins=((1, 2, 3), (-2, 1, 0.5)),
    )  # fmt: skip
    scene = free(blocks, restitution=restitution, friction=0.3)
    start = scene.start(0)
    vel = np.array(start.vel)
    vel[0, :9, 0] += 2
    vel[0, 9:, 0] -= 2
    state = start.with_motion(start.pos, vel)
    before = momenta(scene, state)
    energies = [before[2]]
    for _ in range(100):
        state = scene.step(state, out=state)
        energies.append(momenta(scene, state)[2])
    after = momenta(scene, state)
    np.testing.assert_allclose(after[0], before[0], atol=1e-12)
    np.testing.assert_allclose(after[1], before[1], atol=1e-12)
    assert max(b - a for a, b in pairwise(energies)) < 1e-9
    assert after[2] < 0.9 * before[2]  # they did collide


def test_two_edges_that_cross_stop_each_other() -> None:
    """Two long bars, turned on their edges and crossed; the upper one falls on the lower one and balances there."""
    blocks = Blocks(
        sides=(4, 1, 1), centres=((0, 0, 0.5**0.5), (0, 0, 3 * 0.5**0.5 + 0.05)), turns=((45, 0, 0), (0, 0, 0)),
    )  # fmt: skip
    lower = blocks.model_copy(update={"centres": blocks.centres[:1], "turns": blocks.turns[:1]})
    upper = Blocks(sides=(1, 4, 1), centres=blocks.centres[1:], turns=((0, 45, 0),))
    groups = tuple(Group(network=network, radius=0.05) for network in (lower, upper))
    scene = free(blocks).model_copy(update={"groups": groups})
    start = scene.start(0)
    vel = np.array(start.vel)
    vel[0, 9:, 2] = -1
    state = scene.run(start.with_motion(start.pos, vel), 20)
    np.testing.assert_allclose(state.vel[0, :, 2], -0.5, atol=1e-9)
    assert state.pos[0, -1, 2] - state.pos[0, 8, 2] == pytest.approx(2**0.5, abs=1e-6)


def test_a_stack_of_ten_dice_stands_for_10_s_and_its_contacts_carry_the_weight_above() -> None:
    scene = scene_of(Blocks(sides=CUBE, centres=tuple((0, 0, k + 0.5) for k in range(10))), dt=0.02)
    state = scene.run(scene.start(0), 500)
    assert np.abs(bodies(scene, state)[:, -1] - [(0, 0, k + 0.5) for k in range(10)]).max() < 1e-4
    assert np.abs(state.vel).max() < 1e-5
    assert state.count_of("unsolved") == 0
    found = scene.contacts(state)
    for k in range(10):
        between = (found.body == k - 1) & (found.other == k) if k else found.other == -1
        sign = -1 if k else 1  # the force on the lower one, or on the lowest
        np.testing.assert_allclose(sign * found.force[between].sum(axis=0), (0, 0, 9 * G * (10 - k)), atol=0.01)


@pytest.mark.parametrize(("over", "stands"), [(0.45, True), (0.55, False)])
def test_a_block_stands_on_another_if_its_centre_is_above_it(over: float, stands: bool) -> None:
    scene = scene_of(Blocks(sides=CUBE, centres=((0, 0, 0.5), (over, 0.1, 1.5))))
    state = scene.run(scene.start(0), 200)
    assert (state.pos[0, -1, 2] > 1.49) == stands


def test_an_overlap_opens_without_a_kick() -> None:
    """Two blocks that start 2 % inside each other separate slowly, and have no speed left."""
    scene = free(Blocks(sides=CUBE, centres=((0, 0, 0), (0.98, 0, 0))))
    state = scene.run(scene.start(0), 60)
    assert float(state.pos[0, -1, 0] - state.pos[0, 8, 0]) > 0.999999
    assert np.abs(state.vel).max() < 1e-12


def test_a_step_that_is_not_solved_is_counted_and_warned_of() -> None:
    scene = scene_of(Blocks(sides=CUBE, centres=tuple((0, 0, k + 0.5) for k in range(4))), sweeps=2)
    with pytest.warns(UnsolvedContactsWarning, match=r"rigid_bodies: in a step, after sweeps = 2 the last one still"):
        state = scene.run(scene.start(0), 5)
    assert state.count_of("unsolved") > 0


# --- bits, cost, refusals -------------------------------------------------------------------------------------------


def test_a_row_of_a_batch_has_the_bits_of_that_world_alone() -> None:
    scene = scene_of(Blocks(sides=CUBE, centres=((0, 0, 0.6), (0.2, 0.3, 1.8))), restitution=0.2)
    start = scene.start(0, worlds=3)
    vel = start.vel + np.random.default_rng(0).normal(0, 1, start.vel.shape)
    start = start.with_motion(start.pos, vel)
    batch = scene.step(start, steps=60)
    for row in range(3):
        alone = scene.step(start.worlds([row]), steps=60)
        assert alone.digest == batch.worlds([row]).digest
        assert (alone.work == batch.work[row]).all()
    assert batch.count_of("impacts") > 0


@pytest.mark.filterwarnings("ignore")
def test_a_world_whose_impulses_overflow_is_reported_and_leaves_the_next_one_alone() -> None:
    scene = scene_of(Blocks(sides=CUBE, centres=((0, 0, 0.5),), turns=((3, 4, 0),)))
    start = scene.start(0, worlds=2)
    start.v[2] = ((-1e200,), (-1.0,))
    ends = []
    for first in (0, 1):
        end, settle = start.copy(), scene.constraints[0].settler(scene)
        end.x[...] += 0.01 * end.v
        assert settle(start.x, start.v, end, first, 2) == ((0, 0) if first == 0 else (-1, -1))
        ends.append(end.worlds([1]))
    assert ends[0].digest == ends[1].digest and ends[1].vel[0, -1, 2] > -0.9


def test_a_scene_with_rigid_bodies_has_the_kernel_of_one_without() -> None:
    """Nothing of the constraint is in the kernel of a scene, and a scene without it has no scratch memory of it."""
    scene = free(Blocks(sides=CUBE, centres=((0, 0, 0),)))
    without = scene.model_copy(update={"constraints": ()})
    assert scene.stepper.move is without.stepper.move
    assert without.bytes_per_world() < scene.bytes_per_world()
    with pytest.raises(ValueError, match=r"^constraints: the scene has no rigid_bodies"):
        without.contacts(without.start(0))


def test_an_agent_without_a_block_moves_as_without_the_constraint() -> None:
    single = Group(count=1, spawn=Spawn(low=(5, 5, 5), high=(5, 5, 5)))
    scene = scene_of(Blocks(sides=CUBE, centres=((0, 0, 0.5),)))
    both = scene.model_copy(update={"groups": (*scene.groups, single)})
    end = both.run(both.start(0), 100)
    assert end.pos[0, -1, 2] == pytest.approx(5 - G * 0.5 * 1.01)  # through the floor: it has no contacts


BLOCKS = Blocks(sides=CUBE, centres=((0, 0, 0.5),))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"groups": (Group(network=Rope(links=3, length=1.0, direction=(1, 0, 0))),)}, "no group has a network of"),
        ({"space": Torus(size=(9, 9, 9))}, "do not wrap around a torus; allowed: plane, box"),
        ({"dtype": "float32"}, "dtype = float32 is too coarse"),
        ({"constraints": (RigidBodies(), RigidBodies())}, "at most one"),
        ({"constraints": (RigidBodies(), Rods(group=0))}, "rods after it would deform blocks; it must be the last"),
        ({"population": (Decay(rate=1.0),)}, "population = "),
        ({"obstacles": (Capsule(start=(0, 0, 0), end=(1, 0, 0)),)}, r"obstacles\[0\] = capsule is none that blocks"),
        ({"obstacles": (Circle(centre=(0, 0, 0), radius=3, hollow=True),)}, "circle is none that blocks collide with"),
        ({"obstacles": (Block(centre=(0, 0, 0), size=(1, 1, 1), velocity=(1, 0, 0)),)}, "block is none that blocks"),
        (
            {"space": Box(size=(9, 9, 9)), "groups": (Group(network=BLOCKS), Group(count=1))},
            r"groups\[1\] has none; a plane with half-spaces",
        ),
    ],
)  # fmt: skip
def test_what_does_not_suit_blocks_is_refused(change: dict[str, Any], text: str) -> None:
    given: dict[str, Any] = {"dimension": 3, "groups": (Group(network=BLOCKS),), "constraints": (RigidBodies(),)}
    with pytest.raises(ValueError, match=text):
        Scene(**(given | change))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"sides": (1, 1)}, r"sides = \(1.0, 1.0\): must have 3 numbers"),
        ({"turns": ((1, 2, 3), (1, 2, 3))}, "turns: there are 2; allowed: 0, 1 or 1"),
        ({"spins": ((1,),)}, r"spins\[0\] = \(1.0,\): must have 3 numbers in 3 dimensions"),
        ({"pinned": (0,)}, "one that does not is an obstacle"),
        ({"stretch": 2.0}, "stretch = 2.0: must be left out"),
        ({"lumping": "geometric"}, "lumping = geometric: must be left out"),
    ],
)
def test_a_block_that_makes_no_sense_is_refused(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Blocks(**({"sides": CUBE, "centres": ((0, 0, 0.5),)} | change))
