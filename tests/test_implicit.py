"""Implicit methods: against dense references, in scenes, and their errors if there is no solution."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import root

from flockenv.behaviours import Cohesion, Separation
from flockenv.geometry.space import Torus
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.networks import Cloth, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Carried, Drag, Effect, Gravity, Springs, Vortex
from flockenv.physics.integrators import INTEGRATORS, ImplicitEuler, ImplicitMidpoint
from flockenv.physics.integrators.newton import Coupling, NotSolvedError, coupling_between, solve_stage
from flockenv.scene import Group, Scene
from tests.catalogue import Array

SOLVERS = pytest.mark.parametrize("solver", ["sparse", "free"])


# --- one stage, without a scene ---------------------------------------------------------------------------------------


def linear(rng: Any, agents: int, dimension: int, stiff: float) -> tuple[Any, Array, Array, Array, Array, Coupling]:
    """Return a chain of agents, a = -K x - C v + f t, carried by u = U x, and which agents depend on each other."""
    n = agents * dimension
    near = np.abs(np.subtract.outer(np.arange(agents), np.arange(agents))) <= 1
    mask = np.tile(near, (dimension, dimension))
    stiffness, damping, flow = (mask * rng.normal(size=(n, n)) for _ in range(3))
    stiffness = stiff * (stiffness @ stiffness.T + np.eye(n)) * mask
    force = rng.normal(size=n)

    def evaluate(x: Array, v: Array, time: float) -> tuple[Array, Array]:
        return -x @ stiffness.T - v @ damping.T + force * time, x @ flow.T

    own = np.arange(agents - 1)
    return evaluate, stiffness, damping, flow, force, coupling_between(agents, np.r_[own, own + 1], np.r_[own + 1, own])


@SOLVERS
@pytest.mark.parametrize(("dimension", "stiff"), [(2, 1.0), (3, 30.0)])
def test_a_linear_stage_is_the_dense_solution(solver: str, dimension: int, stiff: float) -> None:
    """x = x0 + h (v + U x), v = v0 + h (-K x - C v + f t): two blocks of linear equations."""
    rng = np.random.default_rng(dimension)
    evaluate, stiffness, damping, flow, force, coupling = linear(rng, 6, dimension, stiff)
    n, h, time = 6 * dimension, 0.02, 1.7
    x0, v0 = rng.normal(size=(2, n))
    one = np.eye(n)
    whole = np.block([[one - h * flow, -h * one], [h * stiffness, one + h * damping]])
    expected = np.linalg.solve(whole, np.concatenate([x0, v0 + h * force * time]))
    found = solve_stage(evaluate, x0, v0, time, h, dimension, coupling if solver == "sparse" else None)
    np.testing.assert_allclose(np.concatenate([found.x, found.v]), expected, rtol=1e-9, atol=1e-10)
    assert 1 <= found.newton <= 6
    assert found.linear >= found.newton - 1


def test_no_agent_depends_on_two_agents_of_one_colour() -> None:
    """The number of colours is at most 3 for a chain, 1 for unconnected agents, and 8 for a star of 8."""
    rng = np.random.default_rng(0)
    for agents, first, second, most in (
        (30, np.arange(29), np.arange(1, 30), 3), (1, [], [], 1), (5, [], [], 1), (8, [0] * 7, np.arange(1, 8), 8),
        (40, rng.integers(0, 40, 60), rng.integers(0, 40, 60), 40),
    ):  # fmt: skip
        pairs = np.asarray(first, int), np.asarray(second, int)
        found = coupling_between(agents, *pairs)
        seen = set(zip(found.row.tolist(), found.column.tolist(), strict=True))
        expected_pairs = {(i, i) for i in range(agents)} | set(zip(*(p.tolist() for p in pairs), strict=True))
        assert seen == expected_pairs
        assert found.colours <= most
        for i in range(agents):
            colours = found.colour[[column for row, column in seen if row == i]]
            assert len(set(colours.tolist())) == len(colours)


def test_a_stage_without_a_solution_raises_an_error() -> None:
    x0, v0 = np.zeros(2), np.ones(2)
    for law, message in (
        (lambda x, v, t: (np.full_like(x, np.nan), None), "not finite"),
        (lambda x, v, t: (np.where(v > 0, -10.0, 10.0) * np.ones_like(x), None), "converged|derivative"),
    ):
        for coupling in (None, coupling_between(1, np.zeros(0, int), np.zeros(0, int))):
            with pytest.raises(NotSolvedError, match=message):
                solve_stage(law, x0, v0, 0.0, 1.0, 2, coupling)


def test_a_step_without_a_solution_is_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """This method finds no solution for dt > 0.3, so a step of 1 s is solved in four of 0.25 s."""
    monkeypatch.setitem(
        INTEGRATORS, "implicit_euler", ImplicitEuler
    )  # the class below registers itself; undone after this test
    calls: list[float] = []

    class Picky(ImplicitEuler):
        def _stage(self, evaluate: Any, x: Any, v: Any, time: float, dt: float, *rest: Any) -> Any:
            calls.append(dt)
            if dt > 0.3:
                raise NotSolvedError("too long")
            return super()._stage(evaluate, x, v, time, dt, *rest)

    def law(x: Array, v: Array, t: float) -> tuple[Array, None]:
        return -x, None

    x0, v0 = np.array([1.0]), np.array([0.0])
    found = Picky().solve(law, x0, v0, 0.0, 1.0, 1, None)
    assert calls == [1.0, 0.5, 0.25, 0.25, 0.5, 0.25, 0.25]
    assert (found.substeps, found.rejected) == (4, 3)
    x, v = x0, v0
    for _ in range(4):
        v = (v - 0.25 * x) / (1 + 0.25**2)
        x = x + 0.25 * v
    np.testing.assert_allclose([found.x, found.v], [x, v], rtol=1e-9)
    with pytest.raises(NotSolvedError, match="too long"):
        Picky().solve(law, x0, v0, 0.0, 4.0, 1, None)


# --- in scenes: two sets of laws --------------------------------------------------------------------------------------

SHEET = Cloth(cells=(4, 3), sides=(1.0, 0.8), pinned=("top_left", "top_right"), stretch=1.05)
LOOSE = Group(count=5, mass=0.4, max_speed=4.0, max_force=3.0, spawn=Spawn(low=(2, 2), high=(3, 3), speed=(0.2, 1)))
WEIGHT = Gravity(acceleration=(0.0, -9.81))


def hanging(*, method: Any = None, stiffness: float = 400.0, damping: float = 0.1, **fields: Any) -> Scene:
    """Return a sheet pinned at two corners and five agents beside it; most tests here share its laws."""
    groups = fields.pop("groups", (Group(network=SHEET, mass=0.05), LOOSE))
    effects: tuple[Effect, ...] = (Springs(stiffness=stiffness, damping=damping), fields.pop("weight", WEIGHT))
    given: dict[str, Any] = {"integrator": method or ImplicitEuler(), "dt": 0.02} | fields
    return Scene(groups=groups, effects=effects, **given)


def shaken(scene: Scene, worlds: int = 1, far: float = 0.02) -> State:
    state, rng = scene.start(3, worlds=worlds), np.random.default_rng(1)
    free = np.isfinite(scene.body.mass)[None, :, None]
    return state.with_motion(
        state.pos + far * rng.normal(size=state.shape) * free, state.vel + 0.3 * rng.normal(size=state.shape) * free
    )


def same(a: State, b: State) -> None:
    for name in ("x", "v", "tick", "work"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("method", [ImplicitEuler(), ImplicitMidpoint()], ids=lambda method: method.kind)
def test_a_step_solves_the_equations_of_its_method(method: Any) -> None:
    """The reference is scipy's hybrid method on the scene's acceleration, with a drive."""
    scene = hanging(method=method)
    state = shaken(scene)
    drive = np.random.default_rng(2).normal(size=state.shape)
    h, shape = method.share * scene.dt, state.shape

    def residual(v: Array) -> Array:
        at = state.with_motion(state.pos + h * v.reshape(shape), v.reshape(shape))
        return np.asarray((v.reshape(shape) - state.vel - h * scene.acceleration(at, drive)).ravel())

    middle = root(residual, state.vel.ravel(), tol=1e-13).x.reshape(shape)
    found = scene.step(state, drive=drive)
    np.testing.assert_allclose(found.vel, state.vel + (middle - state.vel) / method.share, atol=1e-9)
    np.testing.assert_allclose(found.pos, state.pos + scene.dt * middle, atol=1e-10)
    assert found.time[0] == scene.dt


def test_all_solvers_find_the_same_solution() -> None:
    """The solvers use sparse factors, differences along directions, or a full matrix."""
    found = []
    for solver in ("sparse", "free", "dense"):
        scene = hanging()
        all_pairs = np.indices((scene.agents, scene.agents)).reshape(2, -1)
        assert scene.coupling is not None
        assert scene.coupling.colours < 15
        if solver != "sparse":
            scene.__dict__["coupling"] = None if solver == "free" else coupling_between(scene.agents, *all_pairs)
        found.append(scene.run(shaken(scene), 5))
    for other in found[1:]:
        np.testing.assert_allclose(other.pos, found[0].pos, atol=1e-9)
        np.testing.assert_allclose(other.vel, found[0].vel, atol=1e-9)
    assert found[1].count_of("linear_iterations") > found[0].count_of("linear_iterations")


def test_results_do_not_depend_on_batches_or_steps_per_call() -> None:
    scene = hanging()
    start = shaken(scene, worlds=3)
    whole = scene.step(start, steps=3)
    again = start
    for _ in range(3):
        again = scene.step(again)
    same(whole, again)
    for b in range(3):
        same(whole.worlds([b]), scene.run(start.worlds([b]), 3))
    kept = start.copy()
    out = scene.start(0, worlds=3)
    assert scene.step(start, out=out, steps=3) is out
    same(out, whole)
    same(start, kept)
    assert scene.step(start, out=start, steps=3) is start
    same(start, whole)
    assert whole.count_of("substeps") == 9
    assert whole.count_of("newton_iterations") >= 9
    assert whole.count_of("evaluations") > whole.count_of("newton_iterations")


def test_dead_and_pinned_agents_stay_and_limits_of_speed_and_force_hold() -> None:
    scene = hanging()
    start = shaken(scene)
    dead, held = [6, 21], np.flatnonzero(np.isinf(scene.body.mass))
    start.alive[0, dead] = False
    drive = np.full(start.shape, 100.0)  # far more than any agent's max_force
    end = scene.step(start, drive=drive, steps=10)
    np.testing.assert_array_equal(end.pos[0, dead], start.pos[0, dead])
    np.testing.assert_array_equal(end.pos[0, held], start.pos[0, held])
    np.testing.assert_array_equal(end.vel[0, held], 0)
    speeds = np.linalg.norm(end.vel[0, 20:], axis=1)
    assert (speeds <= 4.0 * (1 + 1e-12)).all()
    one = scene.step(start, drive=drive)
    push = (one.vel - start.vel)[0, 20] / scene.dt - (0.0, -9.81)
    assert np.linalg.norm(push) == pytest.approx(3.0 / 0.4, rel=1e-6)


def test_coincident_agents_of_a_rope_part() -> None:
    """P39: forces have no derivative at the start of Newton's method."""
    rope = Group(network=Rope(links=3, length=0.3), mass=0.1)
    scene = hanging(groups=(rope,), weight=Gravity(acceleration=(0.0, 0.0)))
    state = scene.start(0)
    state.pos[...] = 1.0
    end = scene.run(state, 20)
    assert np.linalg.norm(np.diff(end.pos[0], axis=0), axis=1).min() > 0.05  # only bonded neighbours must part
    np.testing.assert_allclose(end.vel[0].sum(axis=0), 0, atol=1e-10)


def test_momentum_is_conserved_by_free_springs() -> None:
    sheet = Group(network=Cloth(cells=(4, 3), sides=(1.0, 0.8), stretch=1.1), mass=0.05)
    scene = hanging(groups=(sheet,), stiffness=1e4, weight=Gravity(acceleration=(0.0, 0.0)))
    start = shaken(scene)
    end = scene.run(start, 20)
    np.testing.assert_allclose((end.vel - start.vel)[0].sum(axis=0) * 0.05, 0, atol=1e-10)


def test_implicit_midpoint_conserves_the_energy_of_a_linear_network() -> None:
    """Springs without rest lengths are linear; the relative error stays below 1e-12 over 1,000 steps."""
    sheet = Group(network=Cloth(cells=(2, 2), sides=(1.0, 0.8), pinned=("corners",)), mass=0.05)
    effects = Springs(stiffness=40.0, rest=0.0), Gravity(acceleration=(0.0, 0.0))
    scene = Scene(groups=(sheet,), effects=effects, integrator=ImplicitMidpoint(), dt=0.05)
    state = shaken(scene)

    def energy(state: State) -> float:
        potential = effects[0].potential(scene.groups, state, scene.space.displacement)
        mass = np.where(np.isfinite(scene.body.mass), scene.body.mass, 0.0)
        return float(potential[0] + 0.5 * (mass * (state.vel[0] ** 2).sum(axis=1)).sum())

    before = energy(state)
    worst = 0.0
    for _ in range(10):
        state = scene.run(state, 100)
        worst = max(worst, abs(energy(state) / before - 1))
    assert worst < 1e-12


@pytest.mark.parametrize("stiffness", [1e3, 1e8])
def test_a_cloth_gains_no_energy(stiffness: float) -> None:
    """P40, N14: at 60 steps per second, kinetic and elastic energy stay below 1.05 times the work of gravity."""
    sheet = Cloth(cells=(9, 9), sides=(1.0, 1.0), pinned=("top_left", "top_right"))
    scene = hanging(groups=(Group(network=sheet, mass=0.01),), stiffness=stiffness, damping=0.0, dt=1 / 60)
    state = scene.start(0)
    springs, mass = scene.effects[0], np.where(np.isfinite(scene.body.mass), 0.01, 0.0)
    height = (mass * state.pos[0, :, 1]).sum()
    for _ in range(8):
        state = scene.step(state)
        elastic = springs.potential(scene.groups, state, scene.space.displacement)
        assert elastic is not None
        total = float(elastic[0]) + 0.5 * float((mass * (state.vel[0] ** 2).sum(axis=1)).sum())
        assert total <= 1.05 * 9.81 * (height - (mass * state.pos[0, :, 1]).sum()) + 1e-9


# --- divergence -------------------------------------------------------------------------------------------------------


def test_an_error_names_the_world_without_a_solution_and_the_others_go_on() -> None:
    scene = hanging()
    start = shaken(scene, worlds=3)
    start.pos[1, 7] = 1e200  # the lengths of its springs are not finite
    with pytest.raises(SimulationDiverged, match="world 1, agent") as caught:
        scene.step(start, steps=2)
    error = caught.value
    assert (error.world, error.step, error.method) == (1, 1, "implicit_euler")
    assert error.reason
    assert error.reason in str(error)
    assert "\n" not in str(error)
    same(error.state.worlds([1]), start.worlds([1]))
    for b in (0, 2):
        same(error.state.worlds([b]), scene.run(start.worlds([b]), 2))


# --- other laws -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_single_precision_on_a_torus_follows_double_precision() -> None:
    """Arrays stay float32, agents stay in the box, and the motion agrees to the rounding of float32."""
    groups = (Group(network=Rope(links=4, length=0.4, start=(3.8, 2.0), stretch=1.2), mass=0.1), LOOSE)
    scene = hanging(groups=groups, space=Torus(size=(4.0, 4.0)), dtype="float32")
    end = scene.run(scene.start(0), 5)
    assert end.x.dtype == end.v.dtype == np.float32
    assert ((end.pos >= 0) & (end.pos < 4)).all()
    plain = hanging(groups=groups, dtype="float64")
    start = plain.start(0)
    other = plain.run(start.with_motion(scene.start(0).pos, scene.start(0).vel), 5)
    apart = scene.space.displacement(end.pos.astype(float), other.pos)
    np.testing.assert_allclose(apart, 0, atol=1e-4)


@pytest.mark.slow
def test_a_medium_and_forces_between_neighbours_are_solved() -> None:
    """x' = v + u(x), against scipy on the scene's rates; few agents are solved by a full matrix, many without one."""
    group = Group(count=6, spawn=Spawn(low=(0, 0), high=(2, 2), speed=(0.2, 1.0)))
    effects = (
        Vortex(strength=2.0, centre=(1.0, 1.0), maximum=3.0, acts="medium"), Carried(), Drag(rate=0.7),
        Separation(weight=0.5, radius=1.5), Cohesion(weight=0.3, radius=1.5),
    )  # fmt: skip
    scene = Scene(groups=(group,), effects=effects, integrator=ImplicitMidpoint(), dt=0.05)
    state = scene.start(5)
    h, shape, size = scene.dt / 2, state.shape, state.pos.size

    def residual(both: Array) -> Array:
        x, v = both[:size].reshape(shape), both[size:].reshape(shape)
        acc, flow = scene.rates(state.with_motion(x, v), times=state.time + h)
        assert flow is not None
        return np.concatenate([(x - state.pos - h * (v + flow)).ravel(), (v - state.vel - h * acc).ravel()])

    middle = root(residual, np.concatenate([state.pos.ravel(), state.vel.ravel()]), tol=1e-13).x
    x, v = middle[:size].reshape(shape), middle[size:].reshape(shape)
    found = scene.step(state)
    np.testing.assert_allclose(found.pos, 2 * x - state.pos, atol=1e-9)
    np.testing.assert_allclose(found.vel, 2 * v - state.vel, atol=1e-9)
    assert scene.coupling is not None
    assert scene.coupling.colours == 6
    scene.__dict__["coupling"] = None
    free = scene.step(state)
    np.testing.assert_allclose(free.pos, found.pos, atol=1e-9)
    np.testing.assert_allclose(free.vel, found.vel, atol=1e-9)
    assert scene.model_copy(update={"groups": (group.model_copy(update={"count": 300}),)}).coupling is None
