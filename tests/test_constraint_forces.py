"""Forces of pins, of collisions and of solid faces that are read out: closed forms, balances of momentum, and bits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.geometry.shapes import HalfSpace
from flockenv.model.network import Move
from flockenv.model.networks import Cloth, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.constraints import Collisions, FaceCollisions, Rods
from flockenv.physics.effects import Drag, Gravity, Springs
from flockenv.physics.integrators import RK4, Integrator, LinearlyImplicitEuler, SemiImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.scene.stability import suggest_dt
from tests.catalogue import Array

G = 9.81
HERE = Spawn(low=(0, 0), high=(1, 1))
FLOOR = HalfSpace(point=(0.0, 0.0), direction=(0.0, 1.0))


def weights(scene: Scene) -> Array:
    """Return the weight of each agent by its own mass, (N,) N."""
    return G * np.concatenate([group.own_masses(scene.dimension) for group in scene.groups])


# --- pins -----------------------------------------------------------------------------------------------------------


def test_the_pin_of_a_hanging_chain_carries_its_weight_and_the_load() -> None:
    """One pin above the chain, and one as the second agent of a rod, which carries a load of its own."""
    chain = Group(network=Rope(links=5, length=1.0, direction=(0, -1), pinned=("start",)), mass=0.3)
    hook = Group(network=Rope(links=1, length=0.2, direction=(0, -1), pinned=("end",)), mass=0.5)
    pairs, load = tuple((k, k + 1) for k in range(5)), Group(count=1, mass=7.0, spawn=HERE)
    scene = Scene(
        groups=(chain, load, hook), effects=(Gravity(acceleration=(0, -G)),), dt=0.01,
        constraints=(Rods(pairs=(*pairs, (5, 6), (7, 8)), lengths=(0.2,), tolerance=1e-13),),
    )  # fmt: skip
    pos = np.zeros((1, 9, 2))
    pos[0, :, 1] = [0.0, -0.2, -0.4, -0.6, -0.8, -1.0, -1.2, 0.0, 0.2]
    found = scene.pin_forces(scene.start(0).with_motion(pos, np.zeros_like(pos)))
    assert found.agent.tolist() == [0, 8]
    np.testing.assert_allclose(found.force, [[0.0, (6 * 0.3 + 7.0) * G], [0.0, 2 * 0.5 * G]], rtol=1e-6, atol=1e-9)


def sheet(network: Any, method: Integrator | None = None, **fields: Any) -> Scene:
    """Return a sheet of springs in 3-D under gravity and drag."""
    return Scene(
        dimension=3, groups=(Group(network=network, mass=0.02), *fields.pop("groups", ())),
        effects=(Gravity(acceleration=(0, 0, -G)), Springs(stiffness=500.0, shear=100.0, ratio=0.1), Drag(rate=0.5)),
        integrator=method or SemiImplicitEuler(), **({"dt": 0.002} | fields),
    )  # fmt: skip


FRAME = Cloth(cells=(6, 4), sides=(1.2, 0.8), pinned=("border",), lumping="geometric")


def test_the_pins_of_a_sheet_at_rest_carry_its_weight() -> None:
    scene = sheet(FRAME)
    end = scene.run(scene.start(0), 3000)
    assert np.abs(end.vel).max() < 1e-6
    found = scene.pin_forces(end)
    np.testing.assert_array_equal(found.agent, FRAME.pins())
    np.testing.assert_allclose(found.force.sum(axis=0), [0, 0, weights(scene).sum()], rtol=1e-6, atol=1e-6)


def test_pins_and_weight_change_the_momentum_of_a_moving_sheet_in_each_step() -> None:
    scene = sheet(FRAME).model_copy(update={"effects": sheet(FRAME).effects[:2]})
    state, rng = scene.start(0, worlds=2), np.random.default_rng(0)
    free, mass = np.isfinite(scene.body.mass), weights(scene) / G
    state = state.with_motion(state.pos, np.where(free[:, None], rng.normal(size=state.shape), 0.0))
    for _ in range(5):
        after = scene.step(state)
        for world in range(2):
            gained = mass @ (after.vel - state.vel)[world] / scene.dt
            pins = scene.pin_forces(state, world).force.sum(axis=0)
            np.testing.assert_allclose(pins - [0, 0, weights(scene).sum()], gained, rtol=1e-9, atol=1e-9)
        state = after


def test_what_pulls_a_rope_through_a_medium_balances_its_drag() -> None:
    pulled = Move(particles=("end",), velocity=(2.0, 0.0, 0.0))
    scene = sheet(Rope(links=4, length=1.0, moves=(pulled,)))
    scene = scene.model_copy(update={"effects": scene.effects[1:]})
    found = scene.pin_forces(scene.run(scene.start(0), 4000))
    assert found.agent.tolist() == [4]
    np.testing.assert_allclose(found.force, [[5 * 0.5 * 2.0, 0, 0]], rtol=1e-6, atol=1e-9)


def test_pins_are_refused_without_any() -> None:
    scene = sheet(Cloth(cells=(2, 2), sides=(1.0, 1.0)))
    with pytest.raises(ValueError, match=r"^groups: no network has pinned particles or moves"):
        scene.pin_forces(scene.start(0))


# --- collisions -----------------------------------------------------------------------------------------------------


def discs(response: str, *, e: float = 0.5, count: int = 2, method: Integrator | None = None, **more: Any) -> Scene:
    return Scene(
        groups=(Group(count=count, mass=2.0, radius=0.1, spawn=HERE),), effects=(Gravity(acceleration=(0, -G)),),
        obstacles=(FLOOR,), constraints=(Collisions(response=response, restitution=e, **more),), dt=0.01,
        integrator=method or SemiImplicitEuler(),
    )  # fmt: skip


def placed(scene: Scene, pos: Any, vel: Any) -> State:
    return scene.start(0).with_motion(np.array([pos]), np.array([vel]))


@pytest.mark.parametrize("method", [SemiImplicitEuler(), LinearlyImplicitEuler()], ids=lambda method: str(method.kind))
@pytest.mark.parametrize("response", ["earliest", "back_up", "impulses", "project"])
def test_the_floor_carries_the_weight_of_a_disc_at_rest(response: str, method: Integrator) -> None:
    scene = discs(response, method=method)
    state = scene.run(placed(scene, [(0, 0.1), (1, 0.1)], [(0, 0), (0, 0)]), 20)
    found = scene.collision_forces(state)
    np.testing.assert_allclose(found.bodies, [(0, 2 * G)] * 2, rtol=1e-4)
    np.testing.assert_array_equal(found.faces, np.zeros((2, 2)))


def test_friction_on_a_sliding_disc_is_coulombs() -> None:
    scene = discs("impulses", friction=0.3)
    found = scene.collision_forces(placed(scene, [(0, 0.1), (1, 0.1)], [(1, 0), (-1, 0)])).bodies
    np.testing.assert_allclose(found, [(-0.6 * G, 2 * G), (0.6 * G, 2 * G)], rtol=1e-4)


@pytest.mark.parametrize("response", ["earliest", "impulses"])
def test_the_force_of_bounces_sums_to_the_change_of_momentum(response: str) -> None:
    """The two discs hit each other, too."""
    scene = discs(response, e=0.8)
    state = start = placed(scene, [(0, 0.5), (0.05, 1.0)], [(0, 0), (0.5, -4)])
    total, most = np.zeros((2, 2)), 0.0
    for _ in range(100):
        force = scene.collision_forces(state).bodies
        total += scene.dt * force
        most, state = max(most, float(force.max())), scene.step(state)
    gained = 2.0 * (state.vel - start.vel)[0] + [0, 2.0 * G * 100 * scene.dt]
    np.testing.assert_allclose(total, gained, rtol=1e-9, atol=1e-9)
    assert most > 20 * G


def test_two_discs_exert_opposite_forces_on_each_other() -> None:
    scene = discs("earliest", e=1.0)
    state = placed(scene, [(0, 1), (0.25, 1)], [(5, 0), (-4, 0)])
    np.testing.assert_allclose(scene.collision_forces(state).bodies, [(-1800, 0), (1800, 0)], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("strain", [0.0, 0.002])
def test_contacts_in_the_linear_solve_change_the_momentum_of_a_sheet(strain: float) -> None:
    """A stiff sheet falls on the floor, and its steps are halved if strains are limited."""
    method = LinearlyImplicitEuler(tolerance=1e-12, strain=strain, halvings=6)
    upright = Cloth(cells=(4, 2), origin=(0.0, 0.03), sides=(1.0, 0.5))
    scene = Scene(
        groups=(Group(network=upright, mass=0.05, radius=0.02),), dt=1 / 60, obstacles=(FLOOR,), integrator=method,
        effects=(Gravity(acceleration=(0, -G)), Springs(stiffness=2e3, shear=500.0, ratio=0.1)),
        constraints=(Collisions(agents=False, restitution=0.0, friction=0.4),),
    )  # fmt: skip
    state = start = scene.start(0)
    state = start = start.with_motion(start.pos, start.vel + np.array([0.3, -1.0]))
    total = np.zeros(2)
    for _ in range(30):
        total += scene.dt * scene.collision_forces(state).bodies.sum(axis=0)
        state = scene.step(state)
    assert (state.count_of("rejected_steps") > 0) == (strain > 0)
    gained = scene.body.mass @ (state.vel - start.vel)[0] + [0, weights(scene).sum() * 0.5]
    np.testing.assert_allclose(total, gained, rtol=1e-6)


# --- solid faces ----------------------------------------------------------------------------------------------------


def ball_on_sheet() -> Scene:
    ball = Group(count=1, mass=0.3, radius=0.1, spawn=Spawn(low=(0, 0, 1), high=(1, 1, 2)))
    return sheet(FRAME, groups=(ball,), constraints=(FaceCollisions(thickness=0.01, friction=0.5),))


def resting_ball(scene: Scene, steps: int) -> State:
    start = scene.start(0)
    pos = np.array(start.pos)
    pos[0, -1] = (0.63, 0.41, 0.115)
    return scene.run(start.with_motion(pos, start.vel), steps)


@pytest.mark.slow  # 4000 steps
def test_a_sheet_carries_a_ball_and_its_pins_carry_both() -> None:
    scene = ball_on_sheet()
    state, weight = resting_ball(scene, 4000), 0.3 * G
    assert np.abs(state.vel).max() < 1e-6
    found = scene.collision_forces(state)
    np.testing.assert_array_equal(found.bodies, np.zeros_like(found.faces))
    np.testing.assert_allclose(found.faces[-1], (0, 0, weight), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.faces[:-1].sum(axis=0), -found.faces[-1], rtol=1e-9, atol=1e-9)
    pins = scene.pin_forces(state).force.sum(axis=0)
    np.testing.assert_allclose(pins, (0, 0, weights(scene).sum()), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_pins_beside_pins_that_move_have_no_force_between_them(dtype: str) -> None:
    """Of springs with a damping ratio, whose ends do not oscillate: with their own masses it is that of 1 kg or so."""
    moves = (Move(particles=("bottom_left",), velocity=(0.3, 0, 0)),)
    cloth = Cloth(cells=(1, 1), sides=(1, 1), pinned=("top",), moves=moves)
    scene = Scene(
        dimension=3, groups=(Group(network=cloth, mass=0.1),), effects=(Springs(stiffness=50.0, ratio=0.2),), dt=0.001,
        dtype=dtype,
    )  # fmt: skip
    found = scene.pin_forces(scene.start(0))
    assert len(found.agent) == 3 and np.isfinite(found.force).all()
    assert np.abs(found.force).max() < 1.0


def test_stiff_springs_between_pins_need_no_shorter_step() -> None:
    """A scene with 2e8 N/m was refused: the damping ratio of springs without a mass divided by 0."""
    cloth = Cloth(cells=(2, 1), sides=(1, 1), pinned=("left", "right", "top", "bottom"))
    for stiffness in (1e8, 2e8, 1e12):
        effects = (Springs(stiffness=stiffness, ratio=0.1),)
        scene = Scene(dimension=3, groups=(Group(network=cloth),), effects=effects, dt=0.01)  # a warning is an error
        assert suggest_dt(scene).dt == np.inf


# --- reading --------------------------------------------------------------------------------------------------------


def test_reading_forces_changes_no_bit_and_depends_on_one_world() -> None:
    scene, unread = ball_on_sheet(), ball_on_sheet()
    state = resting_ball(scene, 3).worlds([0, 0])
    state = state.with_motion(state.pos, state.vel + np.where(np.arange(2) == 1, -0.5, 0.0)[:, None, None] * [0, 0, 1])
    other = state.worlds([0, 1])
    for _ in range(20):
        kept = state.digest
        scene.pin_forces(state, 1)
        both = scene.collision_forces(state, 1).faces
        assert state.digest == kept
        np.testing.assert_array_equal(both, scene.collision_forces(state.worlds([1])).faces)
        state, other = scene.step(state), unread.step(other)
    assert both.any() and state.digest == other.digest
    np.testing.assert_array_equal(state.work, other.work)


def test_a_step_that_fails_leaves_no_read_out_behind() -> None:
    """Neither of constraints nor of the linear solver."""
    scene = ball_on_sheet().model_copy(update={"integrator": LinearlyImplicitEuler(strain=1e-12)})
    state = scene.start(0)
    before, solver = list(scene.stepper._settlers(1)[0]), scene.stepper._linear_solver()
    assert solver is not None
    hit = state.with_motion(state.pos, state.vel + np.array([1e3, 0.0, 0.0]))  # what is not held
    with pytest.raises(ArithmeticError, match="a strain changes"):
        scene.collision_forces(hit)
    assert scene.stepper._settlers(1)[0] == before and not solver.records


def test_collisions_are_refused_without_any() -> None:
    scene = sheet(FRAME, RK4())
    with pytest.raises(ValueError, match=r"^constraints: the scene has neither collisions nor face_collisions"):
        scene.collision_forces(scene.start(0))
