"""Forces between all agents: exact for few agents, and for many within the error that the tree's opening allows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flockenv.behaviours import Separation
from flockenv.geometry.barnes_hut import MOST_DIRECT
from flockenv.geometry.cell_list import WORTH_ARRANGING
from flockenv.geometry.space import Torus
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.model.networks import Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Effect, Gravitation, InverseSquare
from flockenv.physics.integrators import RK4
from flockenv.scene import Group, Scene
from flockenv.studies.cost_breakdown import explain
from tests.catalogue import Array, scene_of, users_module

pytestmark = pytest.mark.slow
"""Slow, because the tests compile many kernels."""

DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])
KINDS = pytest.mark.parametrize("kind", ["gravitation", "inverse_square"])
MANY = 4200
"""Enough agents for a tree, and for several threads in one world."""


def acting(kind: str, opening: float = 0.5, **fields: float) -> Effect:
    if kind == "gravitation":
        return Gravitation(**{"constant": 2e-4, "softening": 0.05, "opening": opening} | fields)
    return InverseSquare(**{"strength": -1e-3, "softening": 0.05, "opening": opening} | fields)


def cloud(effect: Effect, dimension: int, count: int = MANY, **fields: Any) -> Scene:
    """Return a scene with agents of two masses in a square or a cube."""
    spawn = Spawn(low=(0,) * dimension, high=(3,) * dimension)
    groups = (Group(count=count - count // 3, mass=0.7, spawn=spawn), Group(count=count // 3, mass=2, spawn=spawn))
    return scene_of(effect, dimension=dimension, **{"groups": groups} | fields)


def forces(scene: Scene, state: State) -> Array:
    """Return the forces in the first world, (N, D) N."""
    change = scene.step(state).vel[0].astype(float) - state.vel[0]
    return np.asarray(change / scene.dt * scene.body.mass[:, None])


def expected(effect: Any, scene: Scene, state: State) -> Array:
    """Return the textbook sum over all living agents, (N, D) N."""
    pos, mass, alive = state.pos[0].astype(float), scene.body.mass.astype(float), state.alive[0]
    found = np.zeros_like(pos)
    for i in np.flatnonzero(alive):
        offset = pos - pos[i]
        cube = ((offset**2).sum(axis=1) + effect.softening**2) ** 1.5
        share = np.divide(alive, cube, where=cube > 0, out=np.zeros_like(cube))
        share = share * (effect.constant * mass[i] * mass if effect.kind == "gravitation" else effect.strength)
        found[i] = share @ offset
    return found


def errors(found: Array, exact: Array) -> Array:
    """Return the error of each agent relative to the root mean square force, since forces cancel in the middle."""
    size = np.linalg.norm(exact, axis=1)
    return np.asarray(np.linalg.norm(found - exact, axis=1) / np.sqrt((size**2).mean()))


# --- accuracy ---------------------------------------------------------------------------------------------------------


@DIMENSIONS
@KINDS
@pytest.mark.parametrize(("count", "opening"), [(203, 0.5), (MOST_DIRECT, 0.5), (MANY, 0.0)])
def test_forces_are_the_sum_over_all_pairs_for_few_agents_or_an_opening_of_0(
    kind: str, dimension: int, count: int, opening: float
) -> None:
    effect = acting(kind, opening)
    scene = cloud(effect, dimension, count)
    state = scene.start(1)
    assert errors(forces(scene, state), expected(effect, scene, state)).max() < 1e-12
    assert scene.step(state).count_of("pairs") == count**2


BOUNDS = {  # opening -> median and 99 % quantile of the error, share of all pairs that are computed
    2: {1.0: (0.04, 0.13, 0.08), 0.5: (0.0085, 0.023, 0.18), 0.2: (8e-4, 2e-3, 0.56)},
    3: {1.0: (0.011, 0.047, 0.21), 0.5: (0.0012, 0.004, 0.57), 0.2: (1.6e-5, 9e-5, 1.0)},
}
"""4/3 of the measured values."""


@DIMENSIONS
@KINDS
def test_errors_of_the_tree_stay_below_bounds_that_shrink_with_the_opening(kind: str, dimension: int) -> None:
    """From each opening to the next smaller one, errors shrink by a factor of at least 4."""
    before = (np.inf, np.inf)
    for opening in (1.0, 0.5, 0.2):
        effect = acting(kind, opening)
        scene = cloud(effect, dimension)
        state = scene.start(2)
        error = errors(forces(scene, state), expected(effect, scene, state))
        found = float(np.median(error)), float(np.quantile(error, 0.99))
        computed = scene.step(state).count_of("pairs") / MANY**2
        median, most, share = BOUNDS[dimension][opening]
        assert found[0] < median and found[1] < most and computed < share
        assert found[0] < 0.25 * before[0] and found[1] < 0.25 * before[1]
        before = found


def test_the_tree_gives_the_same_forces_in_single_precision() -> None:
    effect = acting("gravitation")
    double, single = (cloud(effect, 2, dtype=dtype) for dtype in ("float64", "float32"))
    state = double.start(2)
    np.testing.assert_allclose(errors(forces(single, single.start(2)), forces(double, state)), 0, atol=2e-5)


@DIMENSIONS
def test_the_tree_is_as_accurate_for_agents_at_very_different_distances(dimension: int) -> None:
    """A dense core, and some agents a thousand times its size away; the tree has as many levels as it needs."""
    effect = acting("gravitation")
    scene = cloud(effect, dimension)
    state = scene.start(3)
    state.pos[0, ::7] *= 0.01
    state.pos[0, :40] *= 3000.0
    error = errors(forces(scene, state), expected(effect, scene, state))
    assert np.quantile(error, 0.99) < 0.023
    assert scene.step(state).count_of("pairs") < 0.6 * MANY**2


@DIMENSIONS
def test_momentum_is_conserved_exactly_by_pairs_and_approximately_by_the_tree(dimension: int) -> None:
    for opening, least, most in ((0.0, 0.0, 1e-15), (0.5, 1e-9, 1e-3)):
        scene = cloud(acting("gravitation", opening), dimension)
        found = forces(scene, scene.start(4))
        lost = np.abs(found.sum(axis=0)).max() / np.linalg.norm(found, axis=1).sum()
        assert least <= lost < most


@DIMENSIONS
@KINDS
def test_the_force_is_the_negative_gradient_of_the_potential(kind: str, dimension: int) -> None:
    effect = acting(kind)
    scene = cloud(effect, dimension, 40)
    state = scene.start(9)
    state.alive[0, 3] = False
    found = forces(scene, state)
    for axis in range(dimension):
        energy = []
        for shift in (-1e-5, 1e-5):
            other = state.copy()
            other.pos[0, 7, axis] += shift
            energy.append(effect.potential(scene.groups, other, None))
        slope = (energy[1] - energy[0]) / 2e-5
        np.testing.assert_allclose(found[7, axis], -slope[0], rtol=1e-5)


# --- orbits -----------------------------------------------------------------------------------------------------------


def test_the_orbit_of_two_bodies_closes_after_keplers_period() -> None:
    """Masses 3 and 1, semi-major axis 1, eccentricity 0.6: P = 2 pi sqrt(a^3 / (G (m + M))) = pi with G = 1."""
    spawn = Spawn(low=(0, 0), high=(1, 1))
    steps, groups = 2000, (Group(count=1, mass=3, spawn=spawn), Group(count=1, mass=1, spawn=spawn))
    effect = Gravitation(constant=1, softening=0)
    scene = Scene(groups=groups, effects=(effect,), integrator=RK4(), dt=np.pi / steps)
    start = scene.start(0)
    near, fast = 1 - 0.6, np.sqrt(4 * (1 + 0.6) / (1 - 0.6))  # at periapsis
    start.pos[0] = [[-near / 4, 0], [near * 3 / 4, 0]]
    start.vel[0] = [[0, -fast / 4], [0, fast * 3 / 4]]
    half, end = scene.run(start, steps // 2), scene.run(start, steps)
    np.testing.assert_allclose(half.pos[0, 1] - half.pos[0, 0], [-1.6, 0], atol=1e-6)
    np.testing.assert_allclose(end.pos, start.pos, atol=1e-6)
    np.testing.assert_allclose(end.vel, start.vel, atol=1e-5)


# --- coincident and dead agents ---------------------------------------------------------------------------------------


@DIMENSIONS
@pytest.mark.parametrize("softening", [0.0, 0.05])
def test_coincident_agents_do_not_attract_each_other(dimension: int, softening: float) -> None:
    """A tree over coincident agents does not split forever, and agents elsewhere are attracted by all of them."""
    effect = acting("gravitation", softening=softening)
    scene = cloud(effect, dimension)
    state = scene.start(0)
    state.pos[...] = 1 / 3
    np.testing.assert_array_equal(forces(scene, state), 0)
    state.pos[0, 1000:2500] = -2 / 3
    state.pos[0, 2500] = 5.0
    assert errors(forces(scene, state), expected(effect, scene, state)).max() < 1e-11


@pytest.mark.parametrize("alive", [0, 1, 16, 17, 3000])
def test_no_force_acts_on_or_from_dead_agents(alive: int) -> None:
    """If there is a tree, the bits are those of a world without the dead agents."""
    effect = acting("gravitation")
    scene = cloud(effect, 3)
    state = scene.start(5)
    state.alive[0, alive:] = False
    state.pos[0, alive:] *= 100.0
    found = forces(scene, state)
    np.testing.assert_array_equal(found[alive:], 0)
    exact = expected(effect, scene, state)
    np.testing.assert_allclose(found, exact, atol=0.05 * float(np.abs(exact).max()))
    if alive > MOST_DIRECT:
        fewer = scene.model_copy(
            update={"groups": (scene.groups[0], scene.groups[1].model_copy(update={"count": 200}))}
        )
        other = fewer.start(5)
        other.x[...] = state.x[:, :, :alive]
        np.testing.assert_array_equal(fewer.step(other).v, scene.step(state).v[:, :, :alive])


# --- threads, batches and other laws ----------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def one_thread_afterwards() -> Iterator[None]:
    before = threads()
    yield
    use_threads(before)


@pytest.mark.parametrize("opening", [0.0, 0.5])
def test_results_do_not_depend_on_the_number_of_threads(opening: float) -> None:
    scene = cloud(acting("gravitation", opening), 3)
    start = scene.start(6)
    start.alive[0, ::9] = False
    end = scene.run(start, 3)
    for count in (2, 3):
        use_threads(count)
        found = scene.run(start, 3)
        for name in ("x", "v", "work"):
            np.testing.assert_array_equal(getattr(found, name), getattr(end, name))


def test_results_do_not_depend_on_the_other_worlds_of_a_batch() -> None:
    scene = cloud(acting("gravitation"), 3)
    batch = scene.run(scene.start(7, worlds=3), 2)
    for k in range(3):
        alone = scene.run(scene.start(7 + k), 2)
        np.testing.assert_array_equal(batch.v[:, k], alone.v[:, 0])
        np.testing.assert_array_equal(batch.work[k], alone.work[0])


LEASH = """
from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.physics.effects.effect import Bonds, Effect, Me, Other
from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import scale


@law
def leash(p: Any, me: Me, others: tuple[Other, ...], numbers: Vec) -> Vec:
    return scale(others[0].offset, numbers[0])


class Leash(Effect):
    kind: Literal["leash"] = "leash"
    bond_law: ClassVar[Law | None] = leash

    def numbers(self, dimension: int) -> int:
        return 1

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        first = np.arange(sum(group.size for group in groups) - 1, dtype=np.int32)
        agent, partner = np.concatenate([first, first + 1]), np.concatenate([first + 1, first])
        return Bonds(agent, partner[:, None], np.full((len(agent), 1), 0.01))
"""


def test_laws_of_all_forms_in_one_scene_add_up(tmp_path: Path) -> None:
    """Trees by mass and by number, an exact sum, bonds and a pair law, for any number of threads and calls."""
    far = acting("gravitation"), acting("inverse_square"), acting("gravitation", 0.0)
    scene = cloud(far[0], 2, WORTH_ARRANGING)
    start = scene.start(8)
    alone = sum(forces(scene.with_effects(effect), start) for effect in far)
    pos = start.pos[0]
    alone[:-1] += 0.01 * np.diff(pos, axis=0)
    alone[1:] -= 0.01 * np.diff(pos, axis=0)
    i, j = cKDTree(pos).query_pairs(0.05, output_type="ndarray").T
    push = 1e-4 * (pos[i] - pos[j]) / ((pos[i] - pos[j]) ** 2).sum(axis=1)[:, None]
    np.add.at(alone, i, push)
    np.add.at(alone, j, -push)
    with users_module(tmp_path, LEASH, "leashes") as users:
        scene = scene.with_effects(*far, users.Leash(), Separation(weight=1e-4, radius=0.05))
        np.testing.assert_allclose(forces(scene, start), alone, atol=1e-12 * float(np.abs(alone).max()))
        end = scene.step(start, steps=2)
        use_threads(2)
        again = scene.step(scene.step(start))
        for name in ("x", "v", "work"):
            np.testing.assert_array_equal(getattr(again, name), getattr(end, name))


# --- explanation, refusals, memory ------------------------------------------------------------------------------------


def test_the_explanation_of_a_scene_names_direct_sums_and_trees() -> None:
    explained = {
        (count, opening): explain(cloud(acting("gravitation", opening), 2, count)).rows[0].calls_for
        for count, opening in ((50, 0.5), (MANY, 0.0), (MANY, 0.5))
    }
    assert explained == {
        (50, 0.5): ("all others (direct)",),
        (MANY, 0.0): ("all others (direct)",),
        (MANY, 0.5): ("all others (tree)",),
    }


@KINDS
def test_a_torus_and_an_invalid_opening_are_refused_in_one_line(kind: str) -> None:
    with pytest.raises(ValueError, match=rf"effects\[0\].kind = {kind} reaches all agents, .* only a plane or a box"):
        scene_of(acting(kind), space=Torus(size=(9, 9)))
    for opening in (-0.1, 1.5, float("nan")):
        with pytest.raises(ValueError, match="opening") as caught:
            acting(kind, opening)
        assert "\n" not in str(caught.value)


def test_gravitation_of_pinned_particles_is_refused_since_their_mass_is_infinite() -> None:
    free = Group(count=3, spawn=Spawn(low=(0, 0), high=(1, 1)))
    pinned = Group(network=Rope(links=3, length=3, pinned=(0,)))
    assert scene_of(acting("inverse_square"), groups=(free, pinned)).agents == 7
    with pytest.raises(ValueError, match=r"effects\[0\].constant: groups\[1\] has particles that are pinned"):
        scene_of(acting("gravitation"), groups=(free, pinned))


def test_the_memory_of_a_tree_is_counted_before_it_is_allocated() -> None:
    few, many = (cloud(acting("gravitation", opening), 3, 40_000).bytes_per_world() / 40_000 for opening in (0.0, 0.5))
    assert 50 < many - few < 100
