"""Rods and ropes: closed forms of pendulums and chains, conserved quantities, and refused input."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from flockenv.core.warnings import UnmetWarning
from flockenv.geometry.space import Torus
from flockenv.model.networks import Cloth, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.constraints import Rods
from flockenv.physics.effects import Drag, Gravity
from flockenv.physics.integrators import (
    RK4,
    ExplicitEuler,
    ImplicitMidpoint,
    Integrator,
    SemiImplicitEuler,
    VelocityVerlet,
)
from flockenv.physics.population import Decay, Emitter, Point
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import dump_scene, load_scene
from tests.catalogue import Array

G = 9.81
HERE = Spawn(low=(0, 0), high=(1, 1))


def hanging(
    network: Any, dt: float, *, drag: float = 0.0, gravity: float = G, mass: float = 1.0,
    method: Integrator | None = None, **rods: Any,
) -> Scene:  # fmt: skip
    """Return a network of rods under gravity and drag; tests with the same method share one kernel."""
    return Scene(
        groups=(Group(network=network, mass=mass),), effects=(Gravity(acceleration=(0, -gravity)), Drag(rate=drag)),
        constraints=(Rods(**({"group": 0} | rods)),), integrator=method or VelocityVerlet(), dt=dt,
    )  # fmt: skip


def pendulum(dt: float, *angles: float, method: Integrator | None = None, **rods: Any) -> tuple[Scene, State]:
    """Return pendulums of 1 m at rest at these angles from the lowest point, one world for each angle."""
    scene = hanging(Rope(links=1, length=1.0, direction=(0, -1), pinned=("start",)), dt, method=method, **rods)
    start = scene.start(0, worlds=len(angles))
    pos = np.array(start.pos)
    pos[:, 1] = np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    return scene, start.with_motion(pos, start.vel)


def energy(state: State) -> Array:
    """Return the energy of free particles of 1 kg, (B,) J; pinned ones rest at height 0."""
    return np.asarray((0.5 * (state.vel**2).sum(axis=2) + G * state.pos[..., 1]).sum(axis=1))


def lengths(state: State) -> Array:
    return np.asarray(np.linalg.norm(np.diff(state.pos, axis=1), axis=2))


# --- closed forms ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_pendulum_keeps_its_length_its_energy_and_its_period() -> None:
    """The period is 4 sqrt(l / g) K(sin^2(a / 2)), for small swings 2 pi sqrt(l / g); over more than 100 periods."""
    angles, dt = np.array([0.02, 1.0, 2.5]), 0.01
    scene, state = pendulum(dt, *angles)
    before, worst, off, found = energy(state), 0.0, np.zeros(3), [np.sin(angles)]
    for _ in range(round(205 / dt)):
        state = scene.step(state, out=state)
        found.append(np.array(state.pos[:, 1, 0]))
        worst = max(worst, float(np.abs(lengths(state) - 1).max()))
        off = np.maximum(off, np.abs(energy(state) - before))
    assert worst <= 1e-9
    assert (off <= 2e-3 * G * (1 - np.cos(angles))).all()
    np.testing.assert_allclose(energy(state), before, atol=1e-3 * G)
    x = np.array(found)
    for k, angle in enumerate(angles):
        falls = np.flatnonzero((x[:-1, k] > 0) & (x[1:, k] <= 0))
        times = (falls + x[falls, k] / (x[falls, k] - x[falls + 1, k])) * dt
        period = (times[-1] - times[0]) / (len(times) - 1)
        exact = 4 * math.sqrt(1 / G) * ellipk(math.sin(angle / 2) ** 2)
        assert period == pytest.approx(exact, rel=2e-4)
        assert len(times) >= 60
    assert len(np.flatnonzero((x[:-1, 0] > 0) & (x[1:, 0] <= 0))) > 100


@pytest.mark.slow
def test_a_hanging_chain_is_the_catenary_of_its_links() -> None:
    """tan theta_i = (m g / H)(i - (n + 1) / 2), H so that sum l cos theta_i = span."""
    links, long, span = 8, 2.0, 1.3
    rope = Rope(links=links, start=(0, 0), end=(span, 0), length=long, pinned=("ends",))
    scene = hanging(rope, 0.01, drag=1.5, mass=0.2)
    end = scene.run(scene.start(0), 4000)
    steps = np.diff(end.pos[0], axis=0)
    slopes = steps[:, 1] / steps[:, 0]
    rise = np.arange(1, links + 1) - (links + 1) / 2
    low, high = 0.01, 100.0
    for _ in range(200):  # of m g / H
        middle = (low + high) / 2
        wide = (long / links * np.cos(np.arctan(middle * rise))).sum()
        low, high = (middle, high) if wide > span else (low, middle)
    np.testing.assert_allclose(slopes, low * rise, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), long / links, rtol=1e-9)


def double(t: float, y: Array) -> list[float]:
    """Return the derivatives of a double pendulum of equal masses and rods of 1 m, angles from the lowest point."""
    a, b, u, w = y
    d, k = a - b, 3 - math.cos(2 * (a - b))
    return [
        u, w,
        (-3 * G * math.sin(a) - G * math.sin(a - 2 * b) - 2 * math.sin(d) * (w * w + u * u * math.cos(d))) / k,
        2 * math.sin(d) * (2 * u * u + 2 * G * math.cos(a) + w * w * math.cos(d)) / k,
    ]  # fmt: skip


def test_a_double_pendulum_follows_its_equations_and_keeps_its_energy() -> None:
    begin = (2.0, 1.0)
    angles = solve_ivp(double, (0, 1.5), [*begin, 0, 0], "DOP853", rtol=1e-12, atol=1e-12).y[:2, -1]
    exact = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0)
    errors = []
    for steps in (300, 600, 1200):
        scene = hanging(Rope(links=2, length=2.0, direction=(0, -1), pinned=("start",)), 1.5 / steps)
        start = scene.start(0)
        pos = np.array(start.pos)
        pos[0, 1:] = np.cumsum(np.stack([np.sin(begin), -np.cos(begin)], axis=1), axis=0)
        start = start.with_motion(pos, start.vel)
        errors.append(np.abs(scene.run(start, steps).pos[0, 1:] - exact).max())
    assert errors[-1] < 1e-3
    assert np.diff(np.log2(errors)) == pytest.approx([-2, -2], abs=0.2)
    state, before, off = start, energy(start), 0.0
    for _ in range(200):
        state = scene.run(state, 40)  # 10 s
        off = max(off, float(np.abs(energy(state) - before)[0]))
    assert off < 2e-3 * G


@pytest.mark.slow  # one kernel for each method
@pytest.mark.parametrize(
    "method", [SemiImplicitEuler(), ExplicitEuler(), RK4(), ImplicitMidpoint()], ids=lambda m: m.kind
)
def test_under_every_method_a_pendulum_keeps_length_and_energy(method: Integrator) -> None:
    scene, state = pendulum(0.005, 1.0, method=method)
    before, worst = energy(state), 0.0
    for _ in range(200):
        state = scene.run(state, 20)
        worst = max(worst, float(np.abs(energy(state) - before)[0]))
        assert abs(lengths(state) - 1).max() <= 1e-9
    assert worst <= (0.06 if method.order == 1 else 1e-3) * G
    np.testing.assert_allclose(np.abs(energy(state) - before), 0, atol=0.06 * G)


# --- conserved quantities -------------------------------------------------------------------------------------------


def free(space: Any = None, pairs: Any = None, **rods: Any) -> Scene:
    """Return 12 agents of two masses in a ring of rods, and nothing else."""
    ring = tuple((k, (k + 1) % 12) for k in range(12)) if pairs is None else pairs
    groups = (Group(count=6, mass=0.7, spawn=HERE), Group(count=6, mass=3.0, spawn=HERE))
    held = Rods(**({"pairs": ring, "lengths": (1.0,)} | rods))
    return Scene(space=space or Torus(size=(20.0, 20.0)), groups=groups, constraints=(held,), dt=0.01)


def ring_state(scene: Scene, worlds: int = 1) -> State:
    """Return the ring across a corner of the torus, each world with other velocities."""
    turn = 2 * np.pi * np.arange(12) / 12
    pos = 0.5 / math.sin(math.pi / 12) * np.stack([np.cos(turn), np.sin(turn)], axis=1) % 20
    vel = np.random.default_rng(3).normal(size=(worlds, 12, 2)) * 2
    return scene.start(0, worlds=worlds).with_motion(np.repeat(pos[None], worlds, axis=0), vel)


def gaps(scene: Scene, state: State) -> Array:
    offset = scene.space.displacement(state.pos, np.roll(state.pos, -1, axis=1))
    return np.asarray(np.linalg.norm(offset, axis=2))


def test_a_free_ring_keeps_momentum_lengths_and_energy_across_the_seam_of_a_torus() -> None:
    """The first step makes the velocities consistent with the rods."""
    scene = free()
    state = scene.step(ring_state(scene, worlds=3))
    mass = scene.body.mass[None, :, None]
    carried, kinetic = (state.vel * mass).sum(axis=1), (mass * state.vel**2).sum(axis=(1, 2))
    for _ in range(20):
        state = scene.run(state, 20)
        np.testing.assert_allclose(gaps(scene, state), 1.0, rtol=1e-9)
        assert ((state.pos >= 0) & (state.pos < 20)).all()
    np.testing.assert_allclose((state.vel * mass).sum(axis=1), carried, atol=1e-12 * 400)
    np.testing.assert_allclose((mass * state.vel**2).sum(axis=(1, 2)), kinetic, rtol=1e-2)


def test_results_do_not_depend_on_the_batch_or_on_the_order_of_rods() -> None:
    scene = free()
    start = ring_state(scene, worlds=3)
    batch = scene.run(start, 50)
    for k in range(3):
        alone = scene.run(start.worlds([k]), 50)
        np.testing.assert_array_equal(alone.x[:, 0], batch.x[:, k])
        np.testing.assert_array_equal(alone.v[:, 0], batch.v[:, k])
    shuffled = np.random.default_rng(0).permutation([((k + 1) % 12, k) for k in range(12)]).tolist()
    other = free(pairs=tuple(map(tuple, shuffled)))
    np.testing.assert_array_equal(other.run(start, 50).pos, batch.pos)
    third = free(pairs=tuple(((k + 7) % 12, (k + 8) % 12) for k in range(12)), tolerance=1e-13)
    np.testing.assert_allclose(third.run(start, 50).pos, batch.pos, atol=1e-7)


def test_rods_do_not_move_dead_pinned_or_partnerless_agents() -> None:
    """A dead agent exerts no force. A rod between two pinned agents moves neither, and there is no warning."""
    scene = free(pairs=((0, 1), (1, 2)))
    start = ring_state(scene)
    start.alive[0, 1] = False
    end = scene.run(start, 20)
    np.testing.assert_array_equal(end.vel[0, [0, 2]], start.vel[0, [0, 2]])
    np.testing.assert_array_equal(end.pos[0, 1], start.pos[0, 1])
    both = hanging(Rope(links=1, start=(0, 0), end=(1, 0), length=2.0, pinned=("ends",)), 0.01)
    here = both.start(0)
    np.testing.assert_array_equal(both.run(here, 5).pos, here.pos)


@pytest.mark.slow  # two kernels
def test_single_precision_holds_rod_lengths_to_4e_5() -> None:
    scene = free().model_copy(update={"dtype": "float32"})
    end = scene.run(ring_state(scene), 200)
    np.testing.assert_allclose(gaps(scene, end), 1.0, rtol=4e-5)


# --- forces ---------------------------------------------------------------------------------------------------------


def forces_on_agents(scene: Scene, state: State, world: int = 0) -> Array:
    """Return the sum of the forces of rods on each agent, (N, D) N."""
    found = scene.rod_forces(state, world)
    total = np.zeros(state.pos.shape[1:])
    np.add.at(total, found.first, found.force)
    np.add.at(total, found.second, -found.force)
    return total


@pytest.mark.parametrize("links", [1, 8])
def test_each_link_of_a_hanging_chain_carries_the_weight_below(links: int) -> None:
    chain = Rope(links=links, length=2.0, direction=(0, -1), pinned=("start",))
    scene = hanging(chain, 0.01, mass=0.3, tolerance=1e-13)
    start = scene.start(0)
    found = scene.rod_forces(start)
    np.testing.assert_array_equal(found.first, np.arange(links))
    np.testing.assert_array_equal(found.second, np.arange(1, links + 1))
    weight = 0.3 * G * np.arange(links, 0, -1)
    np.testing.assert_allclose(found.tension, weight, rtol=1e-6)
    np.testing.assert_allclose(found.force, np.outer(weight, (0, -1)), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(scene.rod_forces(scene.run(start, 300)).tension, weight, rtol=1e-6)


def test_the_tension_of_a_swinging_pendulum_is_its_weight_along_the_rod_and_its_centripetal_force() -> None:
    """T = m (g cos a + v^2 / l) = m g (3 cos a - 2 cos a0), m g + m v^2 / l at the lowest point; of order 2."""
    errors = []
    for dt in (0.02, 0.01, 0.005):
        scene, state = pendulum(dt, 1.2)
        worst = 0.0
        for _ in range(round(1.2 / dt)):  # past the lowest point
            after, found = scene.step(state), scene.rod_forces(state).tension[0]
            x, y = (state.pos + after.pos)[0, 1]
            exact = G * (3 * math.cos(math.atan2(x, -y)) - 2 * math.cos(1.2))
            worst, state = max(worst, abs(found - exact)), after
        errors.append(worst)
    assert errors[-1] < 1e-4 * G
    assert -np.diff(np.log2(errors)) == pytest.approx([2, 2], abs=0.1)


def test_a_strut_has_a_negative_tension_and_a_slack_rope_none() -> None:
    """A mass stands upright on a rod; with a rope instead of the rod it falls."""
    upright = Rope(links=1, length=1.0, direction=(0, 1), pinned=("start",))
    strut = hanging(upright, 0.01)
    assert strut.rod_forces(strut.start(0)).tension[0] == pytest.approx(-G, rel=1e-6)
    falling = hanging(upright, 0.01, slack=True)
    np.testing.assert_array_equal(falling.rod_forces(falling.start(0)).force, 0)


@pytest.mark.filterwarnings("ignore")
def test_the_forces_of_rods_change_momentum_even_if_sweeps_do_not_suffice() -> None:
    scene, hurried = free(), free(most=2)
    start = ring_state(scene, worlds=3)
    for each in (scene, hurried):
        end = each.step(start)
        for world in range(3):
            gained = each.body.mass[:, None] * (end.vel - start.vel)[world] / each.dt
            np.testing.assert_allclose(forces_on_agents(each, start, world), gained, atol=1e-9)
    np.testing.assert_array_equal(scene.rod_forces(start, 2).force, scene.rod_forces(start.worlds([2])).force)


def test_forces_are_those_of_all_constraints_with_rods_one_after_another() -> None:
    scene = free(pairs=((5, 4), (0, 1)))
    rope = Rods(pairs=((2, 3),), lengths=(4.0,), slack=True)
    found = scene.model_copy(update={"constraints": (*scene.constraints, rope)}).rod_forces(ring_state(scene))
    assert list(zip(found.first.tolist(), found.second.tolist(), strict=True)) == [(0, 1), (4, 5), (2, 3)]
    assert (found.tension[:2] != 0).all() and found.tension[2] == 0
    without = scene.model_copy(update={"constraints": ()})
    with pytest.raises(ValueError, match=r"^constraints: the scene has no rods"):
        without.rod_forces(ring_state(without))


# --- ropes ----------------------------------------------------------------------------------------------------------


def test_a_slack_rope_exerts_no_force_and_a_taut_one_never_adds_energy() -> None:
    """The mass flies a parabola within the rope's length, is stopped by the rope, and swings with less energy."""
    scene, state = pendulum(0.002, 0.0, slack=True)
    pos, vel = np.array(state.pos), np.array(state.vel)
    pos[0, 1], vel[0, 1] = (0.3, -0.2), (1.5, 2.0)
    state = state.with_motion(pos, vel)
    flown = scene.run(state, 100)
    np.testing.assert_allclose(flown.pos[0, 1], [0.3 + 1.5 * 0.2, -0.2 + 2.0 * 0.2 - G / 2 * 0.04], atol=1e-9)
    before, caught = energy(state)[0], False
    for _ in range(600):
        state = scene.run(state, 5)
        now = energy(state)[0]
        assert lengths(state).max() <= 1 + 1e-9
        assert now <= before + 1e-4 * G  # the error of Verlet's method
        caught |= now < before - 0.01
        before = min(before, now)
    assert caught
    assert abs(state.pos[0, 1]).max() <= 1 + 1e-9


def test_of_two_ropes_only_the_one_that_ends_taut_acts() -> None:
    """Agent 2 exceeds the length of both ropes in one step; the rope to 1 pulls it back, and the rope to 0 is slack."""
    both, one = (
        free(pairs=((0, 2), (1, 2)), lengths=(0.83, 1.15), slack=True),
        free(pairs=((1, 2),), lengths=(1.15,), slack=True),
    )
    pos = np.arange(24.0).reshape(1, 12, 2) / 4
    vel = np.zeros((1, 12, 2))
    pos[0, :3], vel[0, 2] = [(10, 9.2), (9, 9.5), (10, 10)], (30, 0)
    start = both.start(0).with_motion(pos, vel)
    first, second = both.step(start), one.step(start)
    assert np.linalg.norm(first.pos[0, 2] - first.pos[0, 0]) < 0.8
    assert np.linalg.norm(first.pos[0, 2] - first.pos[0, 1]) == pytest.approx(1.15)
    np.testing.assert_allclose(first.pos, second.pos, atol=1e-9)
    np.testing.assert_allclose(first.vel, second.vel, atol=1e-7)


# --- unmet and refused rods -----------------------------------------------------------------------------------------


def test_wrong_initial_lengths_are_corrected_without_adding_velocity() -> None:
    stretched = Rope(links=4, length=1.0, direction=(1, 0), stretch=1.5)
    scene = hanging(stretched, 0.01, gravity=0.0)
    end = scene.step(scene.start(0))
    np.testing.assert_allclose(lengths(end), 0.25, rtol=1e-9)
    np.testing.assert_allclose(end.vel, 0, atol=1e-12)
    np.testing.assert_allclose(end.pos.mean(axis=1), scene.start(0).pos.mean(axis=1), atol=1e-12)
    together = free(pairs=((0, 1),), lengths=(0.4,))
    start = ring_state(together)
    start.pos[0, 1], start.vel[...] = start.pos[0, 0], 0.0
    np.testing.assert_allclose(gaps(together, together.step(start))[0, 0], 0.4, rtol=1e-9)


def test_too_few_sweeps_warn_once() -> None:
    sheet = Cloth(cells=(9, 9), edges=((1, 0), (0, 1)), pinned=("top",))
    cloth = hanging(sheet, 0.02, gravity=0.0, most=3)
    start = cloth.start(0)
    start.vel[0, cloth.body.mass < 1e9] = np.random.default_rng(0).normal(size=(90, 2))
    with pytest.warns(UnmetWarning, match=r"after most = 3 sweeps agents \d+ and \d+ were .* more sweeps") as caught:
        end = cloth.run(start, 50)
    assert len(caught) == 1
    assert (end.vel**2).sum() <= (start.vel**2).sum()
    start.vel[...] *= 0.2
    enough = hanging(sheet, 0.005)
    hung = enough.run(start.with_dt(0.005), 20)  # without a warning
    assert np.abs(np.linalg.norm(hung.pos[0, 1] - hung.pos[0, 0]) - 1 / 9) < 1e-9


@pytest.mark.parametrize(("fields", "message"), [
    ({}, "group: give either"),
    ({"group": 0, "pairs": ((0, 1),), "lengths": (1.0,)}, "group: give either"),
    ({"pairs": ((0, 1), (1, 2))}, "lengths: there are 0; allowed: 1 or 2"),
    ({"pairs": ((0, 1), (1, 2), (2, 3)), "lengths": (1.0, 2.0)}, "lengths: there are 2; allowed: 1 or 3"),
    ({"group": 0, "lengths": (1.0,)}, "lengths: there are 1; allowed: none"),
    ({"pairs": ((1, 1),), "lengths": (1.0,)}, r"pairs\[0\] = \(1, 1\): two different"),
    ({"pairs": ((0, 1), (1, 0)), "lengths": (1.0,)}, r"pairs\[1\] = \(1, 0\): is the same pair as pairs\[0\]"),
    ({"pairs": ((0, 1),), "lengths": (0.0,)}, "lengths"),
    ({"pairs": ((0, 1),), "lengths": (math.inf,)}, "lengths"),
    ({"pairs": ((0, -1),), "lengths": (1.0,)}, "pairs"),
    ({"pairs": ((0, 1.5),), "lengths": (1.0,)}, "pairs"),
    ({"group": 0, "tolerance": 0.0}, "tolerance"),
    ({"group": 0, "most": 0}, "most"),
])  # fmt: skip
def test_bad_rods_raise_errors_of_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        Rods(**fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("rods", "message"), [
    (Rods(pairs=((0, 12),), lengths=(1.0,)), r"constraints\[0\].pairs: there is no agent 12, they are 0 to 11"),
    (Rods(group=2), r"constraints\[0\].group = 2: there are 2 groups"),
    (Rods(group=1), r"constraints\[0\].group = 1: has no network"),
    (Rods(pairs=((0, 1),), lengths=(10.1,)), r"constraints\[0\].lengths: 10.1 m reaches around the torus"),
])  # fmt: skip
def test_rods_that_do_not_fit_the_scene_are_refused(rods: Rods, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        free().model_copy(update={"constraints": (rods,)})


def test_births_into_the_ends_of_a_rod_are_refused() -> None:
    """A newborn agent would be pulled to the place of the dead one in one step. Agents with rods may die, however."""
    rods, born = Rods(pairs=((0, 1),), lengths=(1.0,)), Emitter(place=Point(at=(0.0, 0.0)), rate=1.0)
    update = {"constraints": (rods,), "population": (Decay(rate=1.0), born)}
    with pytest.raises(ValueError, match=r"constraints\[0\].pairs: agent 0 is of a group that population\[1\] fills"):
        free().model_copy(update=update)
    free().model_copy(update=update | {"population": (Decay(rate=1.0), born.model_copy(update={"group": 1}))})


def test_a_scene_with_rods_survives_yaml_and_pickle(tmp_path: Path) -> None:
    scene = free(tolerance=1e-8, slack=True)
    (tmp_path / "ring.yaml").write_text(dump_scene(scene))
    assert load_scene(tmp_path / "ring.yaml") == scene
    assert pickle.loads(pickle.dumps(scene)) == scene
