"""Contacts in the linear solve: against a dense constrained solution, their forces, release, friction, and rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.engine.linear_contacts import ContactSolver
from flockenv.engine.linear_step import LinearSolver
from flockenv.geometry.shapes import Circle, HalfSpace
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.model.networks import Cloth
from flockenv.model.state import State
from flockenv.physics.constraints import Collisions, Slide
from flockenv.physics.effects import Bending, Drag, Gravity, Membrane, Springs
from flockenv.physics.integrators import LinearlyImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.studies.stress.impacts import G, drop_balls
from tests.catalogue import Array
from tests.test_implicit import LOOSE, hanging, same
from tests.test_linearly_implicit import CLOSELY, dense, forces

RADIUS, LENGTH = 0.02, 1.0
FLOOR = HalfSpace(point=(0.0, 0.0), direction=(0.0, 1.0))
BALL = Circle(centre=(0.5 * LENGTH, -30.0), radius=30.0)
ROW = 5
"""Particles of the lowest row of a sheet; they come first."""


def standing(shape: Any = FLOOR, pinned: tuple[str, ...] = (), **fields: Any) -> Scene:
    """Return a stiff upright sheet whose lowest row stands on a floor or a ball, and five agents beside it."""
    sheet = Cloth(cells=(ROW - 1, 2), origin=(0.0, RADIUS), sides=(LENGTH, 0.5), pinned=pinned)
    rules = {name: fields.pop(name) for name in ("restitution", "friction") if name in fields}
    groups = Group(network=sheet, mass=0.05, radius=RADIUS), LOOSE.model_copy(update={"radius": RADIUS})
    return hanging(
        groups=groups, obstacles=(shape,),
        **{
            "method": CLOSELY, "constraints": (Collisions(agents=False, **({"restitution": 0.0} | rules)),),
            "stiffness": 2e4, "damping": 20.0, "dt": 1 / 60, **fields,
        },
    )  # fmt: skip


def contacts_of(scene: Scene) -> ContactSolver:
    found = scene.stepper._linear_solver().contacts
    assert found is not None
    return found


def impulses(scene: Scene) -> Array:
    """Return the impulses of surfaces on agents in the last step, (N, D) N s: what the equations leave unbalanced."""
    system, own = scene.stepper._linear_solver().system, contacts_of(scene).impulses
    found = (system.image - system.right).reshape(own.rub.shape) + own.rub
    return np.where((own.active == 1).any(axis=1)[:, None], found, 0.0)


def gaps(shape: Any, x: Array, radius: Array) -> tuple[Array, Array]:
    """Return the gaps between bodies and a floor or a ball, m, and the normals."""
    if shape is FLOOR:
        return x[:, 1] - radius, np.tile((0.0, 1.0), (len(x), 1))
    off = x - shape.centre
    far = np.linalg.norm(off, axis=1)
    return far - shape.radius - radius, off / far[:, None]


def constrained(scene: Scene, state: State, shape: Any) -> tuple[Array, Array]:
    """Return dv and the normal impulses of a step as dense equations, solved again without the contacts that pull."""
    h, radius = scene.dt, np.asarray(scene.body.radius, float)
    matrix, along = dense(scene, state, (-h * h, -h, h * h))
    matrix += np.diag(np.repeat(scene.body.mass, 2))
    right = h * forces(scene, state, state.pos, state.vel) + along
    gap, normal = gaps(shape, state.pos[0] + h * state.vel[0], radius)
    kept = np.flatnonzero(gap <= 0.1 * radius)
    while True:
        rows = np.zeros((len(kept), len(right)))
        for row, i in zip(rows, kept, strict=True):
            row[2 * i : 2 * i + 2] = normal[i]
        both = np.block([[matrix, -rows.T], [rows, np.zeros((len(kept), len(kept)))]])
        found = np.linalg.solve(both, np.concatenate([right, -gap[kept] / h]))
        change, push = found[: len(right)], found[len(right) :]
        if (push >= 0).all():
            every = np.zeros(scene.agents)
            every[kept] = push
            return change.reshape(-1, 2), every
        kept = kept[push >= 0]


@pytest.mark.parametrize("shape", [FLOOR, BALL], ids=["floor", "ball"])
def test_a_step_is_the_dense_solution_with_contacts_that_push(shape: Any) -> None:
    """Particles above the contacts also have another velocity than without them, in the same step."""
    scene = standing(shape)
    state = scene.start(0)
    state.pos[0, -1] = 0.3, RADIUS  # one that no spring holds
    low = [*range(ROW), -1]
    state.pos[0, low, 1] -= 0.9 * gaps(shape, state.pos[0, low], np.full(ROW + 1, RADIUS))[0]
    state.vel[0] += np.random.default_rng(5).normal(scale=0.2, size=state.vel[0].shape)
    state.vel[0, -1] = 0.5, -0.1
    expected, push = constrained(scene, state, shape)
    found = LinearSolver(scene).advance(scene, state, None)
    assert found.held is not None
    np.testing.assert_array_equal(found.held, push > 0)
    assert found.held[-1] and 2 <= found.held.sum() < ROW + 1  # and some were released
    np.testing.assert_allclose(found.v.T - state.vel[0], expected, atol=1e-8 * np.abs(expected).max())
    solver = LinearSolver(scene)
    solver.contacts = None
    alone = solver.advance(scene, state, None)
    assert (np.abs(found.v - alone.v)[:, ROW : 2 * ROW].max(axis=0) > 0.01).all()
    end = scene.step(state)
    _, normal = gaps(shape, state.pos[0] + scene.dt * state.vel[0], np.asarray(scene.body.radius, float))
    np.testing.assert_allclose(impulses(scene), push[:, None] * normal, atol=1e-8 * push.max())
    assert end.count_of("unsolved") == 0


def test_without_collisions_or_obstacles_a_solve_has_no_part_for_contacts() -> None:
    assert LinearSolver(standing()).contacts is not None
    assert LinearSolver(standing(constraints=())).contacts is None
    assert LinearSolver(standing().model_copy(update={"obstacles": ()})).contacts is None


def test_a_contact_along_which_a_body_cannot_move_does_not_hold_it() -> None:
    """The lowest row slides on a line parallel to the floor that it touches: the surface has no force, nor friction."""
    rows = {"constraints": (Slide(particles=("bottom",), along=((1.0, 0.0),)),)}
    free = standing(**rows, weight=Gravity(acceleration=(3.0, -9.81)))
    both = (*rows["constraints"], Collisions(agents=False, restitution=0.0, friction=0.9))
    scene = free.model_copy(update={"constraints": both[::-1]})
    start = scene.start(0)
    np.testing.assert_allclose(scene.step(start).vel[0, :ROW], free.step(start).vel[0, :ROW], atol=1e-9)
    assert (scene.step(start).vel[0, :ROW, 0] > 0.04).all()


@pytest.mark.parametrize("linearisations", [1, 3])
def test_a_sheet_at_rest_presses_with_its_weight_and_has_no_impacts(linearisations: int) -> None:
    scene = standing(friction=0.5, method=CLOSELY.model_copy(update={"linearisations": linearisations}))
    state = scene.run(scene.start(0), 150)
    end = scene.run(state, 10)
    own = slice(0, 3 * ROW)
    assert np.abs(end.vel[0, own]).max() < 1e-7
    weight = 3 * ROW * 0.05 * 9.81
    assert impulses(scene)[own].sum(axis=0) / scene.dt == pytest.approx([0.0, weight], abs=1e-6 * weight)
    assert end.count_of("impacts") == state.count_of("impacts")
    np.testing.assert_allclose(end.pos[0, :ROW, 1], RADIUS, atol=1e-12)


def test_a_sheet_that_is_lifted_is_released() -> None:
    """Its upper side rises; in no step does the floor pull."""
    scene = standing(pinned=("top",))
    state, left = scene.start(0), []
    for step in range(30):
        state.vel[0, 2 * ROW : 3 * ROW, 1] = 0.3 * (step > 3)
        state = scene.step(state)
        assert impulses(scene)[:ROW, 1].min() >= 0.0
        left.append(int(contacts_of(scene).held()[:ROW].sum()))
    assert left[3] == ROW and left[-1] == 0
    assert state.pos[0, :ROW, 1].min() > RADIUS + 0.05


@pytest.mark.parametrize(("slope", "friction"), [(0.2, 1.0), (0.8, 0.5)], ids=["sticks", "slides"])
def test_friction_is_coulombs_in_the_solve(slope: float, friction: float) -> None:
    """A sheet on an incline stays in place if tan(angle) is small, else it is accelerated by g (sin - friction cos)."""
    angle = np.arctan(slope)
    scene = standing(friction=friction, weight=Gravity(acceleration=(9.81 * np.sin(angle), -9.81 * np.cos(angle))))
    start, own = scene.start(0), slice(0, 3 * ROW)
    end = scene.run(start, 40)
    last = scene.step(end)
    pushes = impulses(scene)[:ROW].sum(axis=0)
    if slope < friction:
        np.testing.assert_allclose(last.pos[0, :ROW], start.pos[0, :ROW], atol=1e-12)
        assert 0 < -pushes[0] < friction * pushes[1]
    else:
        assert pushes[0] == pytest.approx(-friction * pushes[1], rel=2e-3)
        gained = (last.vel - start.vel)[0, own, 0].mean() / (41 * scene.dt)
        assert gained == pytest.approx(9.81 * (np.sin(angle) - friction * np.cos(angle)), rel=0.03)


@pytest.mark.parametrize(("speed", "rests"), [(3.0, False), (0.02, True)])
def test_bodies_that_bounce_are_left_to_collisions(speed: float, rests: bool) -> None:
    """The limit of a resting body, of restitution 1/2, is g dt / 2 = 0.08 m/s, as in collisions."""
    scene = standing(restitution=0.5)
    state = scene.start(0)
    state.pos[0, -1], state.vel[0, -1] = (3.0, RADIUS), (0.0, -speed)
    end = scene.step(state)
    assert contacts_of(scene).held()[-1] == rests
    if rests:
        assert (end.vel[0, -1, 1], end.pos[0, -1, 1]) == pytest.approx((0.0, RADIUS), abs=1e-12)
    else:
        assert end.vel[0, -1, 1] == pytest.approx(0.5 * speed, rel=0.15)


def test_a_moving_floor_carries_what_sticks_to_it() -> None:
    scene = standing(FLOOR.model_copy(update={"velocity": (0.4, 0.3)}), friction=2.0)
    state = scene.start(0)
    state.vel[0, : 3 * ROW] = 0.4, 0.3
    end = scene.run(state, 20)
    np.testing.assert_allclose(end.vel[0, :ROW], np.tile((0.4, 0.3), (ROW, 1)), atol=1e-9)
    np.testing.assert_allclose(end.pos[0, :ROW, 1], RADIUS + 0.3 * 20 * scene.dt, atol=1e-9)
    assert end.count_of("impacts") == 0  # collisions have nothing left to do


def test_results_with_contacts_do_not_depend_on_batches_or_threads() -> None:
    scene, before = standing(friction=0.3), threads()
    start = scene.start(0, worlds=3)
    start.vel[...] += np.random.default_rng(2).normal(scale=0.3, size=start.vel.shape)
    try:
        use_threads(1)
        whole = scene.step(start, steps=4)
        use_threads(2)
        same(whole, scene.step(start, steps=4))
    finally:
        use_threads(before)
    assert whole.count_of("linear_iterations") > 0
    for b in reversed(range(3)):
        same(whole.worlds([b]), scene.run(start.worlds([b]), 4))


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_cloth_on_a_ball_comes_to_rest_outside_it(restitution: float) -> None:
    """At 1/60 s; at rest collisions find no impacts."""
    sheet = Cloth(cells=(8, 8), origin=(-0.5, -0.5, 0.45), edges=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    scene = Scene(
        dimension=3,
        groups=(Group(network=sheet, mass=0.01, radius=0.03),),
        obstacles=(Circle(centre=(0.0, 0.0, 0.0), radius=0.4),),
        effects=(
            Gravity(acceleration=(0.0, 0.0, -9.81)), Springs(stiffness=2e4, shear=5e3, bend=1.0, ratio=0.02),
            Drag(rate=0.005),
        ),
        constraints=(Collisions(agents=False, restitution=restitution, friction=0.4),),
        integrator=LinearlyImplicitEuler(),
        dt=1 / 60,
    )  # fmt: skip
    state, nearest = scene.start(0), np.inf
    for _ in range(150):
        state = scene.step(state)
        nearest = min(nearest, float(np.linalg.norm(state.pos[0], axis=1).min()))
    assert nearest > 0.43 - 1e-9
    assert np.abs(state.vel).max() < 1e-3
    found = state.count_of("impacts")
    assert scene.run(state, 60).count_of("impacts") == found


@pytest.mark.slow
def test_a_sheet_of_triangles_drapes_on_a_ball_and_gains_no_energy() -> None:
    """At 1/60 s, where solid faces after the solve would stretch it: see docs/collisions.md."""
    sheet = Cloth(cells=(8, 8), origin=(-0.5, -0.5, 0.45), edges=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    cloth = Membrane(stretch=2e3, shear=500.0, damping=0.02), Bending(stiffness=0.01, damping=0.02)
    scene = Scene(
        dimension=3, groups=(Group(network=sheet, mass=0.01, radius=0.03),), dt=1 / 60,
        effects=(Gravity(acceleration=(0.0, 0.0, -9.81)), *cloth), integrator=LinearlyImplicitEuler(),
        obstacles=(Circle(centre=(0.0, 0.0, 0.0), radius=0.4),),
        constraints=(Collisions(agents=False, restitution=0.0, friction=0.4),),
    )  # fmt: skip
    state, energies = scene.start(0), []
    for _ in range(90):
        state = scene.step(state)
        assert np.linalg.norm(state.pos[0], axis=1).min() > 0.43 - 1e-9
        stored = sum(float(each.potential(scene.groups, state, scene.space.displacement)[0]) for each in cloth)
        energies.append(stored + 0.01 * float((0.5 * state.vel**2).sum() + 9.81 * state.pos[0, :, 2].sum()))
    assert max(energies) < 0.01 * 9.81 * 0.45 * scene.agents
    assert state.pos[0, :, 2].min() < 0 and np.abs(state.vel).max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("dt", "early"), [(0.02, 0.025), (0.01, 0.017), (0.005, 0.007)])
def test_the_last_bounces_are_cut_short_by_a_few_steps(dt: float, early: float) -> None:
    """The numbers of N05 in docs/stress.md: e = .8, rest is due after 9 sqrt(2 h / g); 16 balls."""
    _, v, heights = drop_balls(LinearlyImplicitEuler(), "earliest", dt, 0.8, round(5.0 / dt))
    moving = np.abs(v) > 1e-9
    assert not moving[-1].any()
    rest = dt * (len(v) - moving[::-1].argmax(axis=0) + 1)
    late = rest / (9 * np.sqrt(2 * heights / G)) - 1
    assert -early <= late.min() < -0.8 * early
    assert late.max() <= 0.003
