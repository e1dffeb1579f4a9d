"""Springs that yield and break: rest lengths are part of the state, in every copy of it and to the last bit."""

from __future__ import annotations

import dataclasses
import pickle
from typing import Any

import numpy as np
import pytest

from flockenv.jit.thread_pool import use_threads
from flockenv.model.networks import Cloth, Network, Rope
from flockenv.model.state import State
from flockenv.physics.effects import Springs
from flockenv.physics.integrators import ImplicitEuler
from flockenv.play.scene_changes import adapted
from flockenv.render.replay import Group as ReplayGroup
from flockenv.render.replay import Panel, replay_page
from flockenv.scene import Group, Scene
from tests.kernels import functions_of


def scene(network: Network, each: float = 0.1, dt: float = 1e-3, **fields: Any) -> Scene:
    """Return a network of springs that yield at 10 % and break at 50 %: one set of laws for this file."""
    method = {"integrator": fields.pop("integrator")} if "integrator" in fields else {}
    springs = Springs(**{"stiffness": 300, "yield_strain": 0.1, "break_strain": 0.5} | fields)
    return Scene(groups=(Group(network=network, mass=each),), effects=(springs,), dt=dt, **method)


def sheet(cells: tuple[int, int] = (8, 6)) -> Cloth:
    return Cloth(cells=cells, edges=((1.0, 0.0), (0.0, 0.8)))


def torn(world: Scene, worlds: int = 1) -> State:
    """Return a sheet whose particles fly apart, so that many springs yield and some break."""
    state, rng = world.start(0, worlds), np.random.default_rng(3)
    return state.with_motion(state.pos, 4.0 * rng.normal(size=state.shape))


def energy(world: Scene, state: State) -> float:
    found = world.effects[0].potential(world.groups, state, world.space.displacement)
    assert found is not None
    return float(found[0] + 0.5 * (world.body.mass * (state.vel[0] ** 2).sum(axis=1)).sum())


@pytest.mark.parametrize(("stretch", "expected"), [(1.05, 1.0), (1.3, 1.3 / 1.1), (0.95, 1.0), (0.7, 0.7 / 0.9)])
def test_a_spring_that_yields_has_the_rest_length_of_the_largest_elastic_strain(
    stretch: float, expected: float
) -> None:
    rope = Rope(links=2, length=2.0, stretch=stretch, pinned=("ends",))
    world = scene(rope)
    start = world.start(0)
    np.testing.assert_allclose(start.bonds, 1.0)
    np.testing.assert_allclose(world.run(start, 3).bonds, expected, rtol=1e-12)


def test_a_spring_that_breaks_has_no_force_and_stays_broken() -> None:
    world = scene(Rope(links=1, length=1.0, stretch=1.6))
    start = world.start(0)
    assert abs(world.acceleration(start)[0, 0, 0]) == pytest.approx(300 * 0.6 / 0.1)
    broken = world.step(start)
    assert np.isinf(broken.bonds).all()
    back = broken.with_motion([[(0.0, 0.0), (1.2, 0.0)]], np.zeros((1, 2, 2)))
    np.testing.assert_array_equal(world.acceleration(back), 0)
    assert np.isinf(world.run(back, 10).bonds).all()
    assert energy(world, back) == 0


def test_energy_is_dissipated_until_the_strain_is_elastic_and_then_conserved() -> None:
    world = scene(Rope(links=1, length=1.0, stretch=1.4), dt=1e-4)
    state, found, rest = world.start(0), [], []
    for _ in range(60):
        found.append(energy(world, state))
        rest.append(float(state.bonds[0, 0]))
        state = world.run(state, 100)
    assert found[0] == pytest.approx(300 * 0.4**2 / 2)
    assert rest[1] == pytest.approx(1.4 / 1.1, rel=1e-3)
    assert (np.diff(found) < 1e-3 * found[0]).all()
    assert np.ptp(rest[-40:]) < 1e-3  # what is left is elastic
    assert found[-1] <= 1.02 * 300 * (0.1 * rest[-1]) ** 2 / 2


def test_momentum_is_conserved_while_springs_yield_and_break() -> None:
    world = scene(sheet())
    state = torn(world)
    end = world.run(state, 60)
    assert 5 < np.isinf(end.bonds).sum() < end.bonds.size
    assert (np.isfinite(end.bonds) & (end.bonds != state.bonds)).any()
    np.testing.assert_allclose(end.vel.sum(axis=1), state.vel.sum(axis=1), atol=1e-12)


def test_rest_lengths_belong_to_the_state() -> None:
    """One call or several, a row of a batch, a pickled copy: the same bits; and the digest counts them."""
    world = scene(sheet())
    start = torn(world, 3)
    end = world.run(start, 40)
    half = world.run(start, 25)
    assert half.digest != world.run(start, 40).digest
    again = pickle.loads(pickle.dumps(half))
    for other in (world.run(half, 15), world.run(again, 15), world.run(half.copy(), 15)):
        assert other.digest == end.digest
        np.testing.assert_array_equal(other.bonds, end.bonds)
    alone = world.run(start.worlds([1]), 40)
    np.testing.assert_array_equal(alone.bonds[0], end.bonds[1])
    np.testing.assert_array_equal(alone.x[:, 0], end.x[:, 1])
    other = half.copy()
    other.bonds[0, 0] += 1e-3
    assert other.digest != half.digest


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_threads() -> None:
    world = scene(Cloth(cells=(90, 80), edges=((9.0, 0.0), (0.0, 8.0))))
    start, found = torn(world), []
    for count in (1, 2, 3):
        use_threads(count)
        found.append(world.run(start, 20))
    use_threads(1)
    assert np.isinf(found[0].bonds).any()
    for other in found[1:]:
        np.testing.assert_array_equal(other.x, found[0].x)
        np.testing.assert_array_equal(other.bonds, found[0].bonds)


@pytest.mark.slow
def test_springs_yield_and_break_with_an_implicit_method() -> None:
    world = scene(Rope(links=1, length=1.0, stretch=1.3), integrator=ImplicitEuler(), dt=0.01)
    assert world.step(world.start(0)).bonds[0, 0] > 1.05
    world = scene(Rope(links=1, length=1.0, stretch=1.9), integrator=ImplicitEuler(), dt=1e-4)
    broken = world.step(world.start(0))
    assert np.isinf(broken.bonds).all()
    np.testing.assert_allclose(world.run(broken, 5).vel, broken.vel, atol=1e-12)


def test_a_scene_without_such_springs_has_no_code_and_no_byte_of_them() -> None:
    plain = Scene(groups=(Group(network=sheet(), mass=0.1),), effects=(Springs(stiffness=300),), dt=1e-3)
    assert plain.start(0).bonds.shape == (1, 0)
    laws = {"length_after_yielding", "lasting_spring"}
    assert not laws & functions_of(plain)
    assert laws <= functions_of(scene(sheet()))


def test_two_networks_keep_their_rest_lengths_apart() -> None:
    ropes = tuple(Group(network=Rope(links=2, start=(0, y), length=2.0, stretch=1.3, pinned=("ends",))) for y in (0, 5))
    effects = Springs(group=1, stiffness=300, yield_strain=0.2), Springs(group=0, stiffness=300, yield_strain=0.1)
    world = Scene(groups=ropes, effects=effects, dt=1e-3)
    np.testing.assert_allclose(world.step(world.start(0)).bonds[0], [1.3 / 1.1] * 2 + [1.3 / 1.2] * 2)


def test_broken_edges_are_not_drawn_and_replays_say_when_they_break() -> None:
    world = scene(sheet())
    first = torn(world)
    last = world.run(first, 60)
    shots = [world.view.snapshot(state) for state in (first, last)]
    assert shots[0].broken is not None
    assert not shots[0].broken.any()
    assert 0 < len(shots[1].whole_bonds) < len(shots[1].bonds) == len(shots[0].bonds)
    low, high = shots[1].low - 1, shots[1].high + 1
    panel = Panel("", [dataclasses.replace(shot, low=low, high=high) for shot in shots], None, "")
    assert b'"gone": [' in replay_page([ReplayGroup("", [panel])], "").replace(b'"gone":[', b'"gone": [')


def test_rest_lengths_outlive_an_edit_in_the_playground() -> None:
    """A change of the scene keeps what has yielded and broken, if the networks are the same."""
    old = scene(sheet())
    state = old.run(torn(old), 40)
    stiffer = scene(sheet(), stiffness=200)
    np.testing.assert_array_equal(adapted(old, stiffer, state, 0).bonds, state.bonds)
    plain = old.model_copy(update={"effects": (Springs(stiffness=300),)})
    assert adapted(old, plain, state, 0).bonds.shape == (1, 0)
    np.testing.assert_array_equal(adapted(plain, old, plain.start(0), 0).bonds, old.start(0).bonds)


REFUSED = [
    (lambda: Springs(stiffness=1, yield_strain=0), "yield_strain = 0"),
    (lambda: Springs(stiffness=1, break_strain=-1), "break_strain = -1"),
    (
        lambda: Scene(
            groups=(Group(network=sheet()),), dt=1e-4,
            effects=(Springs(stiffness=1, break_strain=1), Springs(stiffness=2, yield_strain=1)),
        ),
        "group = 0: 2 effects let its springs yield or break",
    ),
    (lambda: scene(sheet()).step(scene(sheet(), yield_strain=None, break_strain=None).start(0)), "rest lengths of 0"),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(REFUSED)))
def test_invalid_strains_and_states_are_refused_in_one_line(number: int) -> None:
    make, text = REFUSED[number]
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the text is checked below
        make()
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
