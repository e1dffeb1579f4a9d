"""Linearly implicit Euler: its matrix against differences, its solution against a dense one, filters, and its cost."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

from flockenv.core.warnings import UnstableStepWarning
from flockenv.engine.linear_step import LinearSolver, LinearStep
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.networks import Cloth, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.constraints import Slide
from flockenv.physics.effects import Drag, Gravity, Membrane, Springs, Tether
from flockenv.physics.integrators import ImplicitEuler, LinearlyImplicitEuler, SemiImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.scene.stability import limit, suggest_dt
from tests.catalogue import Array
from tests.test_implicit import SHEET, WEIGHT, hanging, same, shaken

CLOSELY = LinearlyImplicitEuler(tolerance=1e-13)


def sheet_of(method: Any = CLOSELY, **fields: Any) -> Scene:
    return hanging(method=method, **fields)


def dense(scene: Scene, state: State, weights: tuple[float, float, float]) -> tuple[Array, Array]:
    """Return the weighted sum of the derivatives as a dense matrix, agent after agent, and weighted dF/dx v."""
    solver, d = LinearSolver(scene), scene.dimension
    solver.read_kept(state)
    motion = [np.ascontiguousarray(each[:, 0], float) for each in (state.x, state.v)]
    solver.assemble(*motion, state.alive[0], weights)
    system, found = solver.system, np.zeros((scene.agents * d, scene.agents * d))
    for i in range(scene.agents):
        for k in range(system.start[i], system.start[i + 1]):
            j = system.column[k]
            found[i * d : i * d + d, j * d : j * d + d] = system.value[k * d * d : (k + 1) * d * d].reshape(d, d)
    return found, system.right.copy()


def forces(scene: Scene, state: State, pos: Array, vel: Array) -> Array:
    """Return all forces on free agents, N, those held in place excluded."""
    mass = np.where(np.isinf(scene.body.mass), 0.0, scene.body.mass)
    return np.asarray((scene.acceleration(state.with_motion(pos, vel))[0] * mass[:, None]).ravel())


def differences(scene: Scene, state: State, of_velocity: bool, step: float = 1e-6) -> Array:
    """Return dF/dx or dF/dv by central differences, N/m or kg/s."""
    columns = []
    for k in range(state.pos[0].size):
        off = np.zeros(state.pos[0].size)
        off[k] = step
        by = off.reshape(state.shape)
        ends = [
            forces(scene, state, state.pos + s * by * (not of_velocity), state.vel + s * by * of_velocity)
            for s in (1, -1)
        ]
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=1)


def free_rows(scene: Scene) -> Array:
    return np.repeat(np.isfinite(scene.body.mass), scene.dimension)


def stretched(scene: Scene, by: float = 1.3) -> State:
    """Return a state in which all springs are longer than at rest, and ends move."""
    state = shaken(scene, far=0.005)
    return state.with_motion(state.pos * by, np.random.default_rng(4).normal(size=state.shape))


def test_derivatives_are_those_of_the_forces() -> None:
    """To 1e-6 of the largest; dF/dx is compared without damping, of which it has no part."""
    scene = sheet_of(damping=0.0)
    state, rows = stretched(scene), free_rows(scene)
    found, along = dense(scene, state, (1.0, 0.0, 1.0))
    expected = differences(scene, state, of_velocity=False)
    np.testing.assert_allclose(found[rows], expected[rows], atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(along[rows], (found @ state.vel.ravel())[rows], atol=1e-9 * np.abs(along).max())
    damped = sheet_of(damping=3.0, weight=Drag(rate=0.4))
    found, _ = dense(damped, state, (0.0, 1.0, 0.0))
    expected = differences(damped, state, of_velocity=True)
    np.testing.assert_allclose(found[rows], expected[rows], atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("curve", [None, ((-1.0, -1.0), (0.1, 0.1), (1.0, 0.4))], ids=["hooke", "curve"])
def test_derivatives_of_springs_that_yield_and_break_are_those_of_the_present_rest_lengths(curve: Any) -> None:
    """A spring that is broken has none, and a step takes the others implicitly: it is stable where it was refused."""
    springs = Springs(stiffness=400.0, curve=curve, yield_strain=0.1, break_strain=2.0)
    scene = Scene(groups=(Group(network=SHEET, mass=0.05),), effects=(springs,), integrator=CLOSELY, dt=0.02)
    state, rows = stretched(scene, by=1.5), free_rows(scene)
    state.bonds[...] *= np.random.default_rng(5).uniform(1.0, 1.2, state.bonds.shape)
    state.bonds[0, 3] = np.inf
    found, _ = dense(scene, state, (1.0, 0.0, 0.0))
    expected = differences(scene, state, of_velocity=False)
    np.testing.assert_allclose(found[rows], expected[rows], atol=1e-6 * np.abs(expected).max())
    state.bonds[...] = np.inf
    assert not dense(scene, state, (1.0, 1.0, 0.0))[0].any()
    end = scene.model_copy(update={"dt": 0.1}).run(scene.start(0).with_dt(0.1), 50)
    assert np.abs(end.vel).max() < 1.0


def test_the_matrix_of_a_compressed_sheet_is_symmetric_and_positive_definite() -> None:
    """Without the clamp of compressed springs the least eigenvalue would be negative."""
    scene = sheet_of(stiffness=1e5)
    state = stretched(scene, by=0.3)
    exact = differences(scene, state, of_velocity=False)
    rows = free_rows(scene)
    assert np.linalg.eigvalsh((exact + exact.T)[np.ix_(rows, rows)]).max() > 1.0
    found, _ = dense(scene, state, (-1.0, 0.0, 0.0))
    np.testing.assert_allclose(found, found.T, atol=1e-12 * np.abs(found).max())
    assert np.linalg.eigvalsh(found).min() > -1e-9 * np.abs(found).max()


def filtered_change(scene: Scene, state: State, along: dict[int, Array]) -> Array:
    """Return dv of a step by dense equations, (N, D) m/s; along: orthonormal directions, (K, D), of sliding agents."""
    h, d = scene.dt, scene.dimension
    matrix, right = dense(scene, state, (-h * h, -h, h * h))
    matrix += np.diag(np.repeat(np.where(np.isfinite(scene.body.mass), scene.body.mass, 1.0), d))
    right += h * forces(scene, state, state.pos, state.vel)
    own = [
        along.get(i, np.eye(d)) if np.isfinite(scene.body.mass[i]) else np.zeros((0, d)) for i in range(scene.agents)
    ]
    moves = block_diag(*own).T
    return np.asarray(moves @ np.linalg.solve(moves.T @ matrix @ moves, moves.T @ right)).reshape(-1, d)


def test_a_step_is_the_dense_solution_with_filters() -> None:
    """Two particles are held, one of them moving, and a side slides along (1, 1)."""
    slide = Slide(particles=("right",), along=((1.0, 1.0),))
    scene = sheet_of(constraints=(slide,))
    state, h = stretched(scene), scene.dt
    state.vel[0, 15] = 0.7, -0.2  # held: a prescribed velocity
    agents = [i for i in slide.agents(scene) if np.isfinite(scene.body.mass[i])]
    assert len(agents) == 3
    state.vel[0, agents] = state.vel[0, agents].mean(axis=1, keepdims=True)  # along its line, as the constraint does
    change = filtered_change(scene, state, dict.fromkeys(agents, np.full((1, 2), 0.5**0.5)))
    end = scene.step(state)
    np.testing.assert_array_equal(end.vel[0, 15], state.vel[0, 15])
    np.testing.assert_array_equal(end.pos[0, 15], state.pos[0, 15] + h * state.vel[0, 15])
    assert np.abs(change).max() > 0.1
    np.testing.assert_allclose(end.vel[0], state.vel[0] + change, atol=1e-9 * np.abs(change).max())


@pytest.mark.parametrize("linearisations", [1, 2])
@pytest.mark.parametrize("stiffness", [400.0, 1e6])
def test_free_sheets_keep_their_momentum_however_large_the_tolerance(stiffness: float, linearisations: int) -> None:
    """To 1e-12 of the impulses of a step; under drag they lose what it takes. There is a pinned one beside them."""
    free, pinned = SHEET.model_copy(update={"pinned": ()}), Group(network=SHEET, mass=0.05)
    groups = Group(network=free, mass=0.05), pinned, Group(network=free, mass=0.2)
    sheets = slice(0, free.size), slice(2 * free.size, 3 * free.size)
    method = LinearlyImplicitEuler(tolerance=0.1, linearisations=linearisations)
    for rate in (0.0, 0.4):
        scene = sheet_of(method, stiffness=stiffness, weight=Drag(rate=rate), groups=groups)
        state, mass = shaken(scene), np.asarray(scene.body.mass)[:, None]
        system = scene.stepper._linear_solver().system
        for _ in range(20):
            before, state = state, scene.step(state)
            for own in sheets:
                gained = mass[own] * (state.vel - before.vel)[0, own]
                lost = rate * scene.dt * state.vel[0, own]
                np.testing.assert_allclose((gained + lost).sum(axis=0), 0, atol=1e-12 * np.abs(system.right).sum())
        assert np.abs(state.vel).max() > 0.1


@pytest.mark.parametrize("by", [1.0, 1.3], ids=["shaken", "stretched"])
def test_further_linearisations_end_at_implicit_euler(by: float) -> None:
    """They are Newton's iterations: each error is at most a tenth of the last. Drag and a moving end are part of it."""
    laws: dict[str, Any] = {"damping": 0.0, "weight": Drag(rate=0.4)}
    state, errors = stretched(sheet_of(**laws), by), []
    state.vel[0, 15] = 0.7, -0.2  # held
    exact = sheet_of(ImplicitEuler(), **laws).step(state)
    for linearisations in range(1, 7):
        method = CLOSELY.model_copy(update={"linearisations": linearisations})
        errors.append(float(np.abs(sheet_of(method, **laws).step(state).vel - exact.vel).max()))
    assert errors[0] > 0.02 and errors[-1] < 1e-11
    assert all(next_one < 0.1 * error for error, next_one in itertools.pairwise(errors))


def test_results_do_not_depend_on_batches_or_steps_per_call() -> None:
    scene = sheet_of(CLOSELY.model_copy(update={"linearisations": 2}))
    start = shaken(scene, worlds=3)
    whole, again = scene.step(start, steps=3), start
    for _ in range(3):
        again = scene.step(again)
    same(whole, again)
    for b in range(3):
        same(whole.worlds([b]), scene.run(start.worlds([b]), 3))


def test_it_ends_where_implicit_euler_does_at_a_fraction_of_the_evaluations() -> None:
    """P10: the sheet comes to rest in the same place; a step evaluates the forces once, without Newton iterations."""
    ends, counts = [], []
    for method in (LinearlyImplicitEuler(), ImplicitEuler()):
        scene = sheet_of(method, damping=2.0, dt=0.05, groups=(Group(network=SHEET, mass=0.05),))
        end = scene.run(scene.start(0), 150)
        ends.append(end.pos)
        counts.append({name: end.count_of(name) / 150 for name in ("evaluations", "newton_iterations")})
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-5)
    assert counts[0] == {"evaluations": 1.0, "newton_iterations": 0.0}
    assert counts[1]["evaluations"] > 20


@pytest.mark.parametrize("stiffness", [1e4, 1e6, 1e8])
def test_a_step_of_a_frame_takes_less_work_than_explicit_substeps(stiffness: float) -> None:
    """P10: evaluations and iterations at 60 steps per second are under half of 40, 408 and 4,082 explicit steps.

    An iteration costs about one product with the matrix; `python -m benchmarks.cloth_error` measures times.
    """
    sheet = Cloth(cells=(9, 9), sides=(1.0, 1.0), pinned=("top_left", "top_right"))
    given = {"groups": (Group(network=sheet, mass=0.01),), "stiffness": stiffness, "damping": 0.0}
    substeps = 1 / 60 / suggest_dt(sheet_of(SemiImplicitEuler(), dt=1e-6, **given)).dt
    scene = sheet_of(LinearlyImplicitEuler(), dt=1 / 60, **given)
    end = scene.run(scene.start(0), 20)
    assert end.count_of("evaluations") == 20
    assert 20 < end.count_of("evaluations") + end.count_of("linear_iterations") < 20 * min(substeps / 2, 30)


@pytest.mark.parametrize("stiffness", [1e3, 1e8])
def test_a_cloth_gains_no_energy(stiffness: float) -> None:
    """At 60 steps per second, without damping: at most 1.05 times the work of gravity, however stiff the springs."""
    sheet = Cloth(cells=(9, 9), sides=(1.0, 1.0), pinned=("top_left", "top_right"))
    scene = sheet_of(groups=(Group(network=sheet, mass=0.01),), stiffness=stiffness, damping=0.0, dt=1 / 60)
    state = scene.start(0)
    springs, mass = scene.effects[0], np.where(np.isfinite(scene.body.mass), 0.01, 0.0)
    height = (mass * state.pos[0, :, 1]).sum()
    for _ in range(20):
        state = scene.step(state)
        elastic = springs.potential(scene.groups, state, scene.space.displacement)
        assert elastic is not None
        total = float(elastic[0]) + 0.5 * float((mass * (state.vel[0] ** 2).sum(axis=1)).sum())
        assert total <= 1.05 * 9.81 * (height - (mass * state.pos[0, :, 1]).sum()) + 1e-9
    assert 0 < state.count_of("linear_iterations") <= 20 * 1000


def hit(scene: Scene, speed: float, worlds: int = 1) -> State:
    """Return a sheet at rest of which one particle moves."""
    state, vel = scene.start(0, worlds=worlds), np.zeros((worlds, scene.agents, scene.dimension))
    vel[:, 10] = speed
    return state.with_motion(state.pos, vel)


@pytest.mark.parametrize(
    "effect", [Springs(stiffness=40.0), Membrane(stretch=40.0, shear=10.0)], ids=["springs", "membrane"]
)
def test_strain_is_that_of_the_shape(effect: Any) -> None:
    group = Group(network=Cloth(cells=(4, 3), sides=(1.0, 0.8)), mass=0.05)
    scene = Scene(groups=(group,), effects=(effect,), integrator=CLOSELY, dt=0.02)
    state = scene.start(0)
    end = LinearStep(1.3 * np.asarray(state.x[:, 0], float), np.asarray(state.v[:, 0], float), 0)
    change, agent = LinearSolver(scene)._strain_change(state, end)
    assert change == pytest.approx(0.3, rel=1e-6) and 0 <= agent < scene.agents


def test_a_step_with_a_large_change_of_strain_is_two_of_half_the_time() -> None:
    free, start = sheet_of(), hit(sheet_of(), 3.0, worlds=2)
    for strain in np.geomspace(1.0, 1e-3, 40):
        scene = sheet_of(CLOSELY.model_copy(update={"strain": float(strain)}))
        end = scene.step(start)
        if end.count_of("substeps") == 4:
            break
    assert (end.count_of("substeps"), end.count_of("rejected_steps")) == (4, 2)  # of two worlds
    halves = sheet_of(dt=free.dt / 2).step(start.with_dt(free.dt / 2), steps=2)
    np.testing.assert_array_equal(end.pos, halves.pos)
    np.testing.assert_array_equal(end.vel, halves.vel)
    assert (end.pos != free.step(start).pos).any()


def test_limited_strains_bring_a_hit_sheet_closer_to_the_exact_motion() -> None:
    start, errors, solves = hit(sheet_of(), 20.0), [], []
    exact = sheet_of(dt=sheet_of().dt / 512).step(start.with_dt(sheet_of().dt / 512), steps=512 * 4)
    for strain in (0.0, 0.05, 0.01):
        end = sheet_of(CLOSELY.model_copy(update={"strain": strain, "halvings": 12})).step(start, steps=4)
        errors.append(np.abs(end.pos - exact.pos).max())
        solves.append(end.count_of("substeps"))
    assert errors[0] > 1.5 * errors[1] > 6 * errors[2]
    assert solves[0] == 4 < solves[1] < solves[2] < 4 * 512


def test_a_strain_that_changes_too_much_in_the_shortest_step_is_told() -> None:
    scene = sheet_of(CLOSELY.model_copy(update={"strain": 0.001, "halvings": 1}))
    start = hit(scene, 50.0)
    with pytest.raises(
        SimulationDiverged, match=r"a strain changes by \S+ in \S+ s, after 1 halvings of dt; strain = 0\.001"
    ):
        scene.step(start)


def test_a_limit_on_strains_that_limits_nothing_is_refused() -> None:
    limited, group = CLOSELY.model_copy(update={"strain": 0.1}), Group(network=SHEET, mass=0.05)
    for effects in ((WEIGHT,), (Drag(rate=1.0),)):
        with pytest.raises(
            ValueError, match=r"integrator\.strain = 0\.1: limits nothing in this scene; needs a membrane"
        ):
            Scene(groups=(group,), effects=effects, integrator=limited, dt=0.02)


def test_springs_do_not_limit_the_step_and_forces_without_a_derivative_do() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sheet_of(stiffness=1e9, dt=0.1)
    loose = Tether(centre=(0.0, 0.0), stiffness=30.0)
    with pytest.warns(UnstableStepWarning, match="linearly_implicit_euler with tether"):
        sheet_of(stiffness=1e9, dt=0.1, weight=loose)


@pytest.mark.slow
@pytest.mark.parametrize(("linearisations", "most"), [(1, 2.0), (2, 1.0), (3, 1.0)])
def test_other_forces_limit_dt_as_the_scene_says(linearisations: int, most: float) -> None:
    """Up to h omega = 2 for one linearisation, 1 for more: just below a swing stays small, just above it grows."""
    method = LinearlyImplicitEuler(linearisations=linearisations)
    assert limit(method, 0.0) == pytest.approx(most, rel=1e-5)
    swing = Scene(
        groups=(Group(count=1, spawn=Spawn(low=(1, 0), high=(1, 0))),), integrator=method, dt=0.01,
        effects=(Tether(centre=(0.0, 0.0), stiffness=(0.98 * most / 0.01) ** 2),),
    )  # fmt: skip
    assert np.abs(swing.run(swing.start(0), 2000).pos).max() < 10
    with pytest.warns(UnstableStepWarning, match="with tether"):
        fast = swing.with_effects(Tether(centre=(0.0, 0.0), stiffness=(1.02 * most / 0.01) ** 2))
    assert np.abs(fast.run(fast.start(0), 200).pos).max() > 30


def test_equations_that_are_not_solved_are_told() -> None:
    scene = sheet_of(LinearlyImplicitEuler(most=2), stiffness=1e6)
    start = shaken(scene)
    with pytest.raises(SimulationDiverged, match=r"not solved to tolerance = 0.001 in 2 iterations") as caught:
        scene.step(start)
    same(caught.value.state, start)


def test_dead_particles_stay_and_pull_at_no_other() -> None:
    scene = sheet_of(weight=Gravity(acceleration=(0.0, 0.0)))
    start = scene.start(0)
    start.alive[0, 6] = False
    start.pos[0, 6] += 0.3  # its springs would pull
    end = scene.run(start, 3)
    np.testing.assert_array_equal(end.pos[0, 6], start.pos[0, 6])
    other = start.copy()
    other.pos[0, 6] -= 0.5
    np.testing.assert_array_equal(np.delete(scene.run(other, 3).pos, 6, 1), np.delete(end.pos, 6, 1))


# --- the constraint that both kinds of methods keep -------------------------------------------------------------------


@pytest.mark.parametrize("method", [SemiImplicitEuler(), LinearlyImplicitEuler()], ids=lambda method: method.kind)
def test_a_bead_slides_down_a_line_as_on_an_incline(method: Any) -> None:
    """Its acceleration is g sin 30 degrees along the line, and it never leaves the line."""
    rope = Group(network=Rope(links=1, length=1.0), mass=0.1)
    slide = Slide(particles=(0, 1), along=((3**0.5, -1.0),))
    effects = (Springs(stiffness=50.0), Gravity(acceleration=(0.0, -9.81)))
    scene = Scene(groups=(rope,), effects=effects, constraints=(slide,), integrator=method, dt=0.001)
    start = scene.start(0)
    end = scene.run(start, 1000)
    off = (end.pos - start.pos)[0]
    np.testing.assert_allclose(off @ (0.5, 0.75**0.5), 0, atol=1e-12)
    way = off.mean(axis=0) @ (0.75**0.5, -0.5)
    assert way == pytest.approx(0.5 * 9.81 / 2, rel=2e-3)


@pytest.mark.parametrize(
    ("fields", "part"),
    [
        ({"particles": ("rigt",)}, r"constraints\[0\].particles\[0\] = 'rigt': unknown.*right"),
        ({"particles": (20,)}, r"constraints\[0\].particles\[0\] = 20: there is no such particle"),
        ({"group": 1}, r"constraints\[0\].group = 1: has no network"),
        ({"group": 2}, r"constraints\[0\].group = 2: there are 2 groups"),
        ({"along": ((1.0, 0.0, 0.0),)}, r"constraints\[0\].along\[0\] = .* has 3 numbers, but dimension = 2"),
        ({"along": ((1.0, 0.0), (0.0, 1.0))}, r"constraints\[0\].along: 2 directions in 2 dimensions"),
        ({"along": ((0.0, 0.0),)}, r"along\[0\] = .*must have a finite length above 0"),
        ({"along": ((1.0, 0.0), (2.0, 0.0))}, "they are parallel"),
    ],
)
def test_slides_that_do_not_suit_a_scene_are_refused(fields: dict[str, Any], part: str) -> None:
    with pytest.raises(ValueError, match=part) as caught:
        sheet_of(constraints=(Slide(**{"particles": ("right",), "along": ((1.0, 0.0),)} | fields),))
    assert len(str(caught.value).splitlines()) < 5


def test_particles_of_two_slides_are_refused() -> None:
    both = (Slide(particles=("right",), along=((1.0, 0.0),)), Slide(particles=("top",), along=((0.0, 1.0),)))
    with pytest.raises(ValueError, match=r"constraints\[1\].particles: agent 19 slides along constraints\[0\] already"):
        sheet_of(constraints=both)
