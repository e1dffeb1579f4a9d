"""Springs, hinges and finite elements as effects: forces are gradients of the energy, modes have known frequencies."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from flockenv.behaviours import Cohesion, Separation
from flockenv.behaviours.steer import Steer
from flockenv.geometry.space import Torus
from flockenv.jit.thread_pool import use_threads
from flockenv.model.finite_elements import Material, freedoms, frequencies, mass, solve_static, stiffness
from flockenv.model.networks import Cloth, Mesh, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import AngularSprings, Elastic, Gravity, Springs
from flockenv.physics.effects.effect import all_masses
from flockenv.physics.integrators import RK4, ImplicitEuler, ImplicitMidpoint
from flockenv.scene import Group, Scene

DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])


def scene(network: Any, *effects: Any, dimension: int = 2, each: float = 0.2, **fields: Any) -> Scene:
    given: dict[str, Any] = {"dimension": dimension, "dt": 1e-3} | fields
    return Scene(groups=(Group(network=network, mass=each),), effects=effects, **given)


def cloth(dimension: int, **fields: Any) -> Cloth:
    edges = ((1.0, 0.1), (0.0, 0.8)) if dimension == 2 else ((1.0, 0.0, 0.1), (0.0, 0.8, 0.0))
    return Cloth(cells=(4, 3), edges=edges, **fields)


def shaken(world: Scene, far: float, seed: int = 0) -> State:
    state, rng = world.start(0), np.random.default_rng(seed)
    held = np.isinf(world.body.mass)[None, :, None]
    return state.with_motion(
        state.pos + far * rng.normal(size=state.shape) * ~held, rng.normal(size=state.shape) * ~held
    )


def energy(world: Scene, state: State) -> float:
    """Return the total potential energy of all effects that have one, J."""
    found = [effect.potential(world.groups, state, world.space.displacement) for effect in world.effects]
    return float(sum(part[0] for part in found if part is not None))


EFFECTS = {
    "springs": lambda dimension: Springs(stiffness=300, shear=200, bend=50),
    "zero_length": lambda dimension: Springs(stiffness=30, rest=0),
    "angular": lambda dimension: AngularSprings(stiffness=0.7),
    "elastic": lambda dimension: Elastic(young=1e3, thickness=0.1, poisson=0.3),
}


@pytest.mark.parametrize(
    ("name", "dimension"), [(name, d) for name in EFFECTS for d in (2, 3) if (name, d) != ("elastic", 3)]
)
def test_the_force_is_the_gradient_of_the_energy(name: str, dimension: int) -> None:
    world = scene(cloth(dimension, pinned=("corners",)), EFFECTS[name](dimension), dimension=dimension)
    state = shaken(world, 0.05)
    state.vel[...] = 0
    found, masses, step = world.acceleration(state)[0], world.body.mass, 1e-6
    for i in range(world.agents):
        for k in range(dimension):
            ends = []
            for sign in (1, -1):
                pos = state.pos.copy()
                pos[0, i, k] += sign * step
                ends.append(energy(world, state.with_motion(pos, state.vel)))
            force = -(ends[0] - ends[1]) / (2 * step)
            expected = force / masses[i] if math.isfinite(masses[i]) else 0.0
            assert found[i, k] == pytest.approx(expected, rel=1e-5, abs=1e-4)


@pytest.mark.slow
@DIMENSIONS
def test_momentum_and_angular_momentum_are_conserved_by_springs_and_hinges(dimension: int) -> None:
    """With damping as well."""
    effects = Springs(stiffness=300, ratio=0.3), AngularSprings(stiffness=0.5, damping=0.1)
    world = scene(cloth(dimension), *effects, dimension=dimension)
    state = shaken(world, 0.05)
    force = world.acceleration(state)[0] * world.body.mass[:, None]
    pos = state.pos[0]
    torque = (
        np.cross(pos, force).sum(axis=0)
        if dimension == 3
        else (pos[:, 0] * force[:, 1] - pos[:, 1] * force[:, 0]).sum()
    )
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-11)
    np.testing.assert_allclose(torque, 0, atol=1e-11)


@pytest.mark.slow
@DIMENSIONS
def test_damping_never_adds_energy(dimension: int) -> None:
    """With the opposite sign, as printed in the source, damping would add energy."""
    effects = Springs(stiffness=300, damping=0.5), AngularSprings(stiffness=0.5, damping=0.05)
    world = scene(cloth(dimension), *effects, dimension=dimension, integrator=RK4())
    state, found = shaken(world, 0.05), []
    for _ in range(20):
        kinetic = 0.5 * float((world.body.mass * (state.vel[0] ** 2).sum(axis=1)).sum())
        found.append(kinetic + energy(world, state))
        state = world.run(state, 20)
    assert (np.diff(found) < 1e-12).all()
    assert found[-1] < 0.7 * found[0]


def test_one_damped_spring_loses_energy_as_in_the_worked_example() -> None:
    """k = 50, k_d = 1, stretch .3: the energy falls from 2.25 to 0.0056 J within 3 s."""
    rope = Rope(links=1, length=1.0, stretch=1.3)
    world = scene(rope, Springs(stiffness=50, damping=1), each=1.0, integrator=RK4())
    start = world.start(0)
    end = world.run(start, 3000)
    kinetic = 0.5 * float((end.vel**2).sum())
    assert energy(world, start) == pytest.approx(2.25)
    assert kinetic + energy(world, end) == pytest.approx(0.0056, abs=1e-4)


def test_a_ratio_of_one_is_critical_damping_of_two_masses() -> None:
    """c = 2 sqrt(k mu) with the reduced mass mu: the stretch falls as (1 + w t) exp(-w t) and does not overshoot.

    With the mass of one end, c would be sqrt(2) times too large.
    """
    world = scene(Rope(links=1, length=1.0, stretch=1.5), Springs(stiffness=40, ratio=1), integrator=RK4())
    w = math.sqrt(40 * (1 / world.body.mass).sum())
    end = world.run(world.start(0), 150)
    stretch = float(np.ptp(end.pos[0, :, 0])) - 1
    assert stretch == pytest.approx(0.5 * (1 + w * 0.15) * math.exp(-w * 0.15), rel=1e-5)
    for ratio, swings in ((1.0, False), (0.5, True)):
        world = scene(Rope(links=1, length=1.0, stretch=1.5), Springs(stiffness=40, ratio=ratio), integrator=RK4())
        state, least = world.start(0), math.inf
        for _ in range(100):
            state = world.run(state, 10)
            least = min(least, float(np.ptp(state.pos[0, :, 0])))
        assert (least < 0.99) == swings


# --- degenerate -------------------------------------------------------------------------------------------------------


@DIMENSIONS
def test_two_ends_in_the_same_place_part(dimension: int) -> None:
    """Without NaN, by opposite forces."""
    world = scene(Rope(links=1, length=1.0), Springs(stiffness=40, damping=1), dimension=dimension, integrator=RK4())
    state = world.start(0)
    state.pos[...] = 0.3
    found = world.acceleration(state)[0]
    np.testing.assert_array_equal(found[0], -found[1])
    assert np.linalg.norm(found[0]) == pytest.approx(40 / 0.2)
    assert np.ptp(world.run(state, 5000).pos[0, :, 0]) == pytest.approx(1.0, abs=1e-3)


@DIMENSIONS
def test_a_hinge_with_arms_of_no_length_has_no_force(dimension: int) -> None:
    world = scene(Rope(links=2, length=1.0), AngularSprings(stiffness=4, damping=1), dimension=dimension)
    state = world.start(0)
    state.pos[...] = 0.3
    np.testing.assert_array_equal(world.acceleration(state), 0)


@pytest.mark.slow
def test_a_hinge_finds_its_rest_angle_from_both_sides() -> None:
    """In 2-D an angle has a sign: a corner that is bent through to the other side returns to its own."""
    corner = Mesh(vertices=((1, 0), (0, 0), (0, 1)), pairs=((0, 1), (1, 2)), angles=((0, 1, 2),))
    effects = Springs(stiffness=400, ratio=0.5), AngularSprings(stiffness=5, damping=0.5)
    world = scene(corner, *effects, integrator=RK4())
    for first in ((1.0, 0.0), (-0.5, 0.87), (0.3, -0.95)):
        state = world.start(0)
        state.pos[0, 0] = first
        end = world.run(state, 20_000).pos[0]
        a, b = end[0] - end[1], end[2] - end[1]
        assert math.atan2(a[0] * b[1] - a[1] * b[0], a @ b) == pytest.approx(math.pi / 2, abs=1e-4)


@DIMENSIONS
def test_springs_of_dead_particles_have_no_force(dimension: int) -> None:
    world = scene(Rope(links=3, length=3.0, stretch=1.2), Springs(stiffness=40), dimension=dimension)
    state = world.start(0)
    state.alive[0, 1] = False
    found = world.acceleration(state)[0]
    np.testing.assert_array_equal(found[:2], 0)
    assert abs(found[2, 0]) > 1
    np.testing.assert_allclose(found[2], -found[3])


@pytest.mark.slow
def test_pinned_particles_do_not_move() -> None:
    world = scene(cloth(3, pinned=("top",)), Springs(stiffness=300), Gravity(acceleration=(0, 0, -9.81)), dimension=3)
    start = world.start(0)
    end = world.run(start, 500)
    held = np.isinf(world.body.mass)
    assert held.sum() == 5
    np.testing.assert_array_equal(end.pos[:, held], start.pos[:, held])
    assert (end.pos[0, ~held, 2] < start.pos[0, ~held, 2]).all()


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_length_of_a_hanging_chain_is_the_closed_form() -> None:
    """N15: N L + (m g / k) N (N + 1) / 2 = 1.1348875 m for ten links of .1 m."""
    rope = Rope(links=10, length=1.0, direction=(0, -1), pinned=("start",))
    effects = Springs(stiffness=400, damping=2), Gravity(acceleration=(0, -9.81))
    world = scene(rope, *effects, each=0.1, integrator=ImplicitEuler(), dt=0.02)
    end = world.run(world.start(0), 1500)
    assert -end.pos[0, -1, 1] == pytest.approx(1.1348875, abs=1e-7)


@pytest.mark.parametrize("ends", ["fixed", "free", "both"])
def test_eigenfrequencies_of_a_chain_are_the_closed_forms(ends: str) -> None:
    """sin(k pi / 2(N+1)), sin((2k-1) pi / 2(2N+1)), sin(k pi / 2N), times 2 sqrt(k/m).

    The squares are the eigenvalues of the matrix that gives accelerations along the chain, times -1.
    """
    n, k, m = 8, 400.0, 0.1
    pinned = {"fixed": ("ends",), "free": ("start",), "both": ()}[ends]
    links = {"fixed": n + 1, "free": n, "both": n - 1}[ends]
    world = scene(Rope(links=links, length=0.1 * links, pinned=pinned), Springs(stiffness=k), each=m)
    free = np.isfinite(world.body.mass)
    assert free.sum() == n
    start, step = world.start(0), 1e-5
    columns = []
    for i in np.flatnonzero(free):
        pos = start.pos.copy()
        pos[0, i, 0] += step
        columns.append(world.acceleration(start.with_motion(pos, start.vel))[0, free, 0] / step)
    found = np.sqrt(np.clip(np.linalg.eigvalsh(-np.array(columns)), 0, None))
    number = np.arange(1, n + 1)
    expected = {
        "fixed": np.sin(number * np.pi / (2 * (n + 1))),
        "free": np.sin((2 * number - 1) * np.pi / (2 * (2 * n + 1))),
        "both": np.sin((number - 1) * np.pi / (2 * n)),
    }[ends]
    np.testing.assert_allclose(found, 2 * math.sqrt(k / m) * expected, atol=1e-4)


@pytest.mark.slow
def test_finite_elements_come_to_rest_at_the_static_solution() -> None:
    """M a + D v + K u = F: a bar of ten elements and a plate of triangles under their weight."""
    rope = Rope(links=10, length=1.0, direction=(0, -1), pinned=("start",))
    plate = Cloth(cells=(4, 2), edges=((1, 0), (0, 0.5)), pinned=("left",))
    for network, young, each in ((rope, 2e3, 0.1), (plate, 5e3, 0.01)):
        body = Elastic(young=young, area=0.01, thickness=0.1, alpha=2.0, beta=0.01)
        effects = body, Gravity(acceleration=(0, -9.81))
        world = scene(network, *effects, each=each, integrator=ImplicitEuler(), dt=0.05)
        end = world.run(world.start(0), 800)
        masses = all_masses(world.groups, 2)
        weight = np.zeros((world.agents, 2))
        weight[:, 1] = -9.81 * each
        held = freedoms(np.flatnonzero(np.isinf(masses)), 2)
        if network is rope:
            held = np.union1d(held, freedoms(np.arange(world.agents), 2)[::2])  # bars in a row: no sideways stiffness
        u = solve_static(body.matrix(network, 2), weight, held)
        np.testing.assert_allclose(end.pos[0] - network.points(2), u.reshape(-1, 2), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("method", [RK4(), ImplicitMidpoint()], ids=lambda method: method.kind)
def test_a_plate_swings_at_the_frequency_of_its_first_mode(method: Any) -> None:
    """After one period all particles are back, with an explicit and an implicit method."""
    plate = Cloth(cells=(5, 2), edges=((1, 0), (0, 0.3)), pinned=("left",))
    body = Elastic(young=5e3, thickness=0.1)
    k = body.matrix(plate, 2)
    points = plate.rest_points(2)
    held = np.isinf(Group(network=plate, mass=0.01).masses(2))
    free = np.setdiff1d(np.arange(2 * len(points)), freedoms(np.flatnonzero(held), 2))
    squares, modes = scipy.linalg.eigh(k.toarray()[np.ix_(free, free)] / 0.01)
    period = 2 * math.pi / math.sqrt(squares[0])
    steps = 400
    world = scene(plate, body, each=0.01, integrator=method, dt=period / steps)
    start = world.start(0)
    u = np.zeros(2 * len(points))
    u[free] = 1e-3 * modes[:, 0]
    start.pos[...] += u.reshape(-1, 2)
    half, whole = world.run(start, steps // 2), world.run(start, steps)
    np.testing.assert_allclose(half.pos[0] - points, -u.reshape(-1, 2), atol=1e-6)
    np.testing.assert_allclose(whole.pos[0] - points, u.reshape(-1, 2), atol=1e-6)


def test_frequencies_of_lumped_elements_are_those_of_a_scene() -> None:
    """`finite_elements.frequencies` and a scene use the same K and M."""
    plate = Cloth(cells=(3, 2), edges=((1, 0), (0, 0.5)), pinned=("left",))
    body, material = Elastic(young=5e3, thickness=0.1), Material(young=5e3, thickness=0.1, density=200)
    points, triangles = plate.rest_points(2), plate.elements(2)
    held = freedoms(plate.pins(), 2)
    found = frequencies(stiffness(points, triangles, material), mass(points, triangles, material), held)
    total = 200 * 0.1 * 0.5
    group = Group(network=plate.model_copy(update={"lumping": "geometric"}), mass=total / plate.size)
    world = Scene(groups=(group,), effects=(body,), dt=1e-4)
    start, step, columns = world.start(0), 1e-6, []
    free = np.setdiff1d(np.arange(2 * plate.size), held)
    for f in free:
        pos = start.pos.copy()
        pos[0, f // 2, f % 2] += step
        columns.append(world.acceleration(start.with_motion(pos, start.vel))[0].ravel()[free] / step)
    other = np.sqrt(np.sort(np.linalg.eigvals(-np.array(columns)).real))
    np.testing.assert_allclose(other, found, rtol=1e-6)


# --- threads, spaces, groups, refused arguments -----------------------------------------------------------------------


@pytest.mark.slow
@DIMENSIONS
def test_results_do_not_depend_on_the_number_of_threads(dimension: int) -> None:
    """Several calls also give the same bits as one."""
    size = (90, 80)
    edges = ((9.0, 0.0, 0.0), (0.0, 8.0, 0.0)) if dimension == 3 else ((9.0, 0.0), (0.0, 8.0))
    net = Cloth(cells=size, edges=edges, pinned=("corners",), stretch=1.05)
    effects = Springs(stiffness=20, ratio=0.1), AngularSprings(stiffness=0.01)
    world = scene(net, *effects, dimension=dimension, each=0.05)
    start = world.start(0)
    found = []
    for count in (1, 2, 3):
        use_threads(count)
        found.append(world.run(start, 5))
    use_threads(1)
    for other in found[1:]:
        np.testing.assert_array_equal(other.x, found[0].x)
        np.testing.assert_array_equal(other.v, found[0].v)
    np.testing.assert_array_equal(world.run(world.run(start, 2), 3).x, found[0].x)


@pytest.mark.slow
def test_bonds_act_around_the_edge_of_a_torus() -> None:
    rope = Rope(links=4, start=(8.9, 5.0), length=0.4, stretch=1.2)
    plain = scene(rope, Springs(stiffness=50))
    torus = scene(rope, Springs(stiffness=50), space=Torus(size=(9.0, 9.0)))
    a, b = plain.run(plain.start(0), 300), torus.run(torus.start(0), 300)
    np.testing.assert_allclose(torus.space.displacement(a.pos, b.pos), 0, atol=1e-12)
    assert (b.pos[0, :, 0] < 5).any()


def test_springs_do_not_act_on_other_groups() -> None:
    spawn = Spawn(low=(3, 3), high=(4, 4), speed=(1, 1))
    net = Group(network=Rope(links=9, length=1.0, stretch=1.3), mass=0.1)
    world = Scene(groups=(Group(count=7, spawn=spawn), net), effects=(Springs(group=1, stiffness=50),), dt=0.01)
    start = world.start(0)
    end = world.run(start, 10)
    np.testing.assert_array_equal(end.vel[:, :7], start.vel[:, :7])
    assert (np.abs(end.vel[0, 7:, 0]) > 0).any()


class Limp(Springs):
    """Springs without rates: their bonds are first needed for the table of the kernel."""

    kind: str  # type: ignore[assignment]  # without a default it is not registered

    def rates(self, groups: Any, dimension: int) -> None:
        return None


def free(count: int, *effects: Any) -> Scene:
    return Scene(groups=(Group(count=count, spawn=Spawn(low=(0, 0), high=(1, 1))),), effects=effects)


STEERING = Steer(behaviours=(Separation(weight=1, radius=1), Cohesion(weight=1, radius=1)))
REFUSED = [
    (lambda: scene(Rope(links=2, length=1.0), Springs(group=1, stiffness=1)), "group = 1: there are 1 groups"),
    (lambda: free(3, Springs(stiffness=1)), "effects[0].group = 0: has no network"),
    (
        lambda: free(2, STEERING, Limp(kind="limp", stiffness=1)).table,
        "effects[1].group = 0: has no network",  # index in the list of the scene, not of the kernel
    ),
    (lambda: scene(cloth(3), Elastic(young=1), dimension=3), "effects[0]"),
    (lambda: scene(cloth(3), Springs(stiffness=1)), "groups[0].network"),
    (lambda: Springs(stiffness=-1), "stiffness = -1"),
    (lambda: Elastic(young=1, poisson=0.5), "poisson = 0.5"),
    (lambda: Group(count=3, network=Rope(links=2, length=1.0)), "count"),
    (lambda: Group(), "count"),
]


@pytest.mark.parametrize("number", range(len(REFUSED)))
def test_invalid_springs_and_networks_are_refused_in_one_line(number: int) -> None:
    make, text = REFUSED[number]
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the text is checked below
        make()
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_free_body_slows_down_by_alpha() -> None:
    """Rayleigh's alpha is a drag in proportion to each mass: v falls as exp(-alpha t)."""
    world = scene(Rope(links=2, length=1.0), Elastic(young=1e3, alpha=0.5), integrator=RK4())
    state = world.start(0)
    state.vel[..., 0] = 2.0
    end = world.run(state, 1000)
    np.testing.assert_allclose(end.vel[..., 0], 2 * math.exp(-0.5), rtol=1e-9)
