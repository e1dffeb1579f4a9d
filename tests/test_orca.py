"""ORCA: its half-planes in closed form, its optimisation against brute force, and crowds without contacts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numba import njit

from flockenv.behaviours import Orca
from flockenv.model.spawn import Spawn
from flockenv.scene import Group, Scene
from flockenv.steering.orca import SLOT, half_plane, orca
from flockenv.steering.vectorize import rows
from tests.catalogue import Array, rotation

steer = rows(orca)
FREE: dict[str, float] = {"horizon": 3.0, "step": 0.1, "turn": 0.0}


@njit
def _half_plane(velocity: Any, offset: Any, other: Any, clearance: float, share: float, horizon: float, step: float):
    v, d, w = (velocity[0], velocity[1]), (offset[0], offset[1]), (other[0], other[1])
    return half_plane(v, d, w, clearance, share, horizon, step)


def plane_of(velocity: Any, offset: Any, other: Any, clearance: float, share: float = 0.5, horizon: float = 3.0):
    arrays = [np.asarray(a, float) for a in (velocity, offset, other)]
    return np.array(_half_plane(*arrays, clearance, share, horizon, 0.1))


def slots(*neighbours: tuple[float, ...], places: int = 8) -> Array:
    """Return the numbers of some neighbours, padded with empty places."""
    numbers = np.full((places, SLOT), -1.0)
    numbers[: len(neighbours)] = np.reshape(neighbours, (-1, SLOT))
    return numbers.ravel()


def change(
    velocity: Any, desired: Any, neighbours: Array, radius: float = 0.3, top: float = 2.0, **given: float
) -> Array:
    """Return S for rows of velocities, desired velocities and neighbours."""
    values = FREE | given
    return steer(velocity, desired, radius, top, values["horizon"], values["step"], values["turn"], neighbours)


# --- half-planes in closed form ---------------------------------------------------------------------------------------


def test_two_agents_head_on_each_take_half_of_the_braking() -> None:
    """Closing at 1.2 m/s, 4 m apart, contact at 0.6 m: a horizon of 3 s allows 3.4 m / 3 s."""
    found = plane_of((0.6, 0), (4, 0), (-0.6, 0), 0.6)
    np.testing.assert_allclose(found, [-1, 0, -0.6 + (1.2 - 3.4 / 3) / 2], atol=1e-12)
    alone = plane_of((0.6, 0), (4, 0), (-0.6, 0), 0.6, share=1.0)
    np.testing.assert_allclose(alone, [-1, 0, -0.6 + (1.2 - 3.4 / 3)], atol=1e-12)


def test_two_agents_that_close_in_fast_both_evade_to_the_right() -> None:
    """Closing at 3 m/s, 4 m apart: the nearest edge is a side of the cone, at an angle of asin(R / d)."""
    angle = math.asin(0.6 / 4)
    found = plane_of((1.5, 0), (4, 0), (-1.5, 0), 0.6)
    normal = np.array([-math.sin(angle), -math.cos(angle)])  # to the right and backwards
    np.testing.assert_allclose(found[:2], normal, atol=1e-12)
    assert found[2] == pytest.approx(1.5 * normal[0] + 0.5 * 3 * math.sin(angle))
    other = plane_of((-1.5, 0), (-4, 0), (1.5, 0), 0.6)
    np.testing.assert_allclose(other, found * [-1, -1, 1], atol=1e-12)


def test_the_half_planes_of_a_pair_are_opposite_and_share_the_change() -> None:
    """n_j = -n_i; the two changes add up to the one that is needed (van den Berg et al. 2011, eq. 5)."""
    rng = np.random.default_rng(0)
    for v, d, w in rng.normal(size=(300, 3, 2)) * [[1], [2], [1]]:
        first, second, whole = plane_of(v, d, w, 0.7), plane_of(w, -d, v, 0.7), plane_of(v, d, w, 0.7, share=1.0)
        np.testing.assert_allclose(second[:2], -first[:2], atol=1e-12)
        assert np.hypot(*first[:2]) == pytest.approx(1)
        lack = whole[2] - first[:2] @ v
        assert first[2] - first[:2] @ v == pytest.approx(lack / 2, abs=1e-12)
        assert second[2] - second[:2] @ w == pytest.approx(lack / 2, abs=1e-12)


def test_on_the_edge_of_a_half_plane_the_gap_just_closes_within_the_horizon() -> None:
    """The neighbour keeps its velocity (share 1), so the least gap must be 0."""
    rng = np.random.default_rng(1)
    checked = 0
    for v, d, w in rng.normal(size=(400, 3, 2)) * [[1], [3], [1]]:
        if np.hypot(*d) < 0.75:
            continue
        n = plane_of(v, d, w, 0.7, share=1.0)
        edge = v + (n[2] - n[:2] @ v) * n[:2]  # the nearest velocity on the edge
        relative, t = edge - w, np.linspace(0, 3, 3001)[:, None]
        nearest = np.hypot(*(d - relative * t).T).min()
        assert nearest >= 0.7 - 1e-9
        assert nearest == pytest.approx(0.7, abs=1e-3)
        checked += 1
    assert checked > 300


def test_two_overlapping_agents_part_within_a_step() -> None:
    found = change((0.0, 0.0), (0.0, 0.0), slots((0.4, 0, 0, 0, 0.3, 0.5)), top=9.0)
    np.testing.assert_allclose(found, [-1.0, 0.0], atol=1e-12)  # half of 0.2 m in 0.1 s


# --- the optimisation -------------------------------------------------------------------------------------------------


def programme(rng: Any, count: int, spread: float) -> tuple[Array, Array, Array]:
    """Return a velocity, a desired velocity, and neighbours around the agent."""
    neighbours = np.concatenate(
        [rng.normal(size=(count, 2)) * spread, rng.normal(size=(count, 2)), rng.uniform(0.2, 0.6, (count, 1)),
         np.full((count, 1), 0.5)], axis=1,
    )  # fmt: skip
    return rng.normal(size=2), 1.5 * rng.normal(size=2), neighbours


def planes_of(velocity: Array, neighbours: Array, radius: float = 0.3) -> Array:
    return np.array([plane_of(velocity, n[:2], n[2:4], radius + n[4], n[5]) for n in neighbours])


def disc(top: float, around: Array, width: float, points: int = 401) -> Array:
    """Return velocities up to a limit: a grid around one velocity, and points on the circle of the limit."""
    axis = np.linspace(-width, width, points)
    grid = around + np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    angles = np.linspace(0, 2 * np.pi, 2000)
    return np.concatenate([grid[np.hypot(*grid.T) <= top], top * np.stack([np.cos(angles), np.sin(angles)], axis=1)])


@pytest.mark.parametrize("spread", [4.0, 2.5, 1.2])
def test_orca_finds_the_best_velocity_of_a_grid_over_all_velocities(spread: float) -> None:
    """If a velocity is feasible: the nearest to the desired one. Otherwise: the one with the smallest violation."""
    rng, feasible, crowded = np.random.default_rng(round(10 * spread)), 0, 0
    for _ in range(25):
        velocity, desired, neighbours = programme(rng, 6, spread)
        found = velocity + change(velocity, desired, slots(*neighbours, places=6))
        planes = planes_of(velocity, neighbours)
        assert np.hypot(*found) <= 2 + 1e-6
        tried = np.concatenate([disc(2.0, np.zeros(2), 2.0), disc(2.0, found, 0.02, 41)])
        worst = (planes[:, 2] - tried @ planes[:, :2].T).max(axis=1)
        own = (planes[:, 2] - planes[:, :2] @ found).max()
        if worst.min() <= 0:
            feasible += 1
            assert own <= 1e-5
            assert np.hypot(*(found - desired)) <= np.hypot(*(tried[worst <= 0] - desired).T).min() + 1e-5
        elif worst.min() > 0.02:  # a smaller violation may be due to the coarse grid
            crowded += 1
            assert own <= worst.min() + 1e-5
    assert feasible + crowded > 20
    assert feasible > 4 if spread > 2 else crowded > 4


def test_an_obstacle_has_priority_over_agents() -> None:
    """Three agents press one against a wall: the wall's half-plane holds, theirs do not."""
    wall = (0.0, -1.3, 0.0, 0.0, 1.0, 1.0)
    pressing = [(x, 0.65, -0.3 * x, -2.0, 0.3, 0.5) for x in (-0.4, 0.0, 0.4)]
    for order in ([wall, *pressing], [*pressing, wall]):
        found = change((0.0, 0.0), (0.0, 0.0), slots(*order), horizon=1.0)
        assert abs(found[1]) < 1e-9  # it touches the wall already
    soft = change((0.0, 0.0), (0.0, 0.0), slots((*wall[:5], 0.5), *pressing), horizon=1.0)
    assert soft[1] < -0.1


def test_a_feasible_desired_velocity_is_reached_at_once() -> None:
    neighbours = slots((-5, -5, -1, -1, 0.3, 0.5), (-1, 0, -1, 0, 0.3, 0.5))
    desired = np.array([1.1, -0.3])
    for turn in (0.0, 0.3):
        np.testing.assert_allclose(change((0.2, 0.1), desired, neighbours, turn=turn), desired - [0.2, 0.1], atol=1e-15)
    np.testing.assert_allclose(change((0.2, 0.1), (30.0, 40.0), neighbours), [1.2 - 0.2, 1.6 - 0.1])
    np.testing.assert_array_equal(change((0.0, 0.0), desired, slots()), desired)


def test_orca_is_invariant_under_rotation_and_order_of_the_neighbours() -> None:
    rng = np.random.default_rng(3)
    for k in range(40):
        velocity, desired, neighbours = programme(rng, 6, 2.0)
        turn = rotation(2, k)
        turned = neighbours.copy()
        turned[:, :2], turned[:, 2:4] = neighbours[:, :2] @ turn.T, neighbours[:, 2:4] @ turn.T
        found = change(velocity, desired, slots(*neighbours), turn=0.1)
        np.testing.assert_allclose(
            change(turn @ velocity, turn @ desired, slots(*turned), turn=0.1), turn @ found, atol=2e-4
        )
        np.testing.assert_allclose(change(velocity, desired, slots(*neighbours[::-1]), turn=0.1), found, atol=2e-4)


def test_orca_is_finite_in_degenerate_cases() -> None:
    """At rest, in one place, at equal velocities, exactly head-on, at a vertex of the cone, among equal neighbours."""
    sizes, directions = (0.0, 1e-12, 1.0, 1e6), [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)]
    cases = [
        (distance, 0.0, speed * x, speed * y, 0.3, 0.5) for distance in sizes for speed in sizes for x, y in directions
    ]
    for own in sizes:
        neighbours = np.array([slots(case, case, (0, 0, 0, 0, 0.0, 1.0)) for case in cases])
        found = change(np.array([own, 0.0]), np.array([1.0, 0.0]), neighbours, turn=0.1)
        assert np.isfinite(found).all()
        assert np.abs(found).max() <= own + 2.1


# --- crowds -----------------------------------------------------------------------------------------------------------


def swap(n: int, horizon: float, turn: float, seconds: float = 40.0, dt: float = 0.05) -> tuple[float, float, float]:
    """Let n agents on a circle of 5 m swap sides; return the least gap, the time needed and the distance left."""
    angles = 2 * np.pi * np.arange(n) / n
    x = 5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    goal, v, least, t = -x.copy(), np.zeros_like(x), np.inf, 0.0
    places = min(6, n - 1)
    while t < seconds:
        offset = x[None] - x[:, None]
        square = (offset**2).sum(axis=-1) + np.diag(np.full(n, np.inf))
        nearest = np.argsort(square, axis=1)[:, :places]
        near = np.take_along_axis(offset, nearest[..., None], axis=1)
        body = np.broadcast_to([0.3, 0.5], (n, places, 2))
        left = np.linalg.norm(goal - x, axis=1, keepdims=True)
        desired = (goal - x) / np.maximum(left, 1e-9) * np.minimum(1.3, left / 0.3)
        seen = np.concatenate([near, v[nearest], body], axis=-1).reshape(n, -1)
        v = v + change(v, desired, seen, top=1.5, horizon=horizon, turn=turn)
        x, t = x + dt * v, t + dt
        least = min(least, float(np.sqrt(square.min())) - 0.6)
        if left.max() < 0.05:
            break
    return least, t, float(left.max())


def test_eight_agents_swap_sides_of_a_circle_without_contact() -> None:
    """By symmetry ORCA as published stops for ever; with desired velocities turned by 0.1 rad all arrive in 12 s."""
    gap, seconds, left = swap(8, horizon=3.0, turn=0.1)
    assert gap >= 0
    assert left < 0.05
    assert seconds < 12
    gap, _, left = swap(8, horizon=3.0, turn=0.0, seconds=20)
    assert gap >= 0
    assert left > 1


@pytest.mark.parametrize("n", [2, 3, 12])
def test_agents_swap_sides_of_a_circle_without_contact(n: int) -> None:
    gap, _, left = swap(n, horizon=2.0, turn=0.2)
    assert gap >= 0
    assert left < 0.05


# --- the behaviour ----------------------------------------------------------------------------------------------------


def walkers(count: int = 8, obstacles: Any = (), **given: Any) -> Scene:
    """Return a scene of agents that reach their desired velocity in one step (weight = m / dt)."""
    arguments: dict[str, Any] = {"weight": 10.0, "target": (20.0, 0.0), "speed": 1.2} | given
    groups = (Group(count=count, radius=0.3, spawn=Spawn(low=(0, 0), high=(1, 1))),)
    return Scene(dimension=2, groups=groups, obstacles=obstacles, effects=(Orca(**arguments),), dt=0.1)


def least_gaps(scene: Scene, state: Any, steps: int) -> tuple[float, float, Any]:
    """Run a scene; return the least gap between agents, the least gap to an obstacle, and the last state."""
    agents, stones, own = np.inf, np.inf, scene.body.radius
    for _ in range(steps):
        state = scene.step(state)
        x = state.pos[0]
        apart = np.linalg.norm(x[:, None] - x, axis=-1) - own - own[:, None] + np.diag(np.full(len(x), np.inf))
        agents = min(agents, float(apart.min()))
        for stone in scene.obstacles:
            stones = min(stones, float((np.linalg.norm(x - stone.centre, axis=1) - stone.radius - own).min()))
    return agents, stones, state


@pytest.mark.slow
def test_agents_without_inertia_pass_obstacles_without_contact() -> None:
    stones = ({"centre": (5.0, 0.05), "radius": 1.0}, {"centre": (8.0, -2.0), "radius": 0.7})
    scene = walkers(obstacles=stones)
    start = scene.start(0)
    start.pos[0] = [(x, y) for x in (-1.0, 0.5) for y in (-1.5, -0.5, 0.5, 1.5)]
    start.vel[0] = 0
    agents, round_, end = least_gaps(scene, start, 150)
    assert agents >= -1e-9
    assert round_ >= -1e-9
    assert (end.pos[0, :, 0] > 11).all()
    assert (np.linalg.norm(end.vel[0], axis=1) <= 1.2 * 1.2 + 1e-9).all()


@pytest.mark.slow
def test_a_lone_agent_has_the_desired_velocity_and_arrives() -> None:
    scene = walkers(1, target=(6.0, 2.0), slow_radius=0.5)
    start = scene.start(0)
    start.pos[0], start.vel[0] = 0, 0
    one = scene.step(start)
    np.testing.assert_allclose(one.vel[0, 0], 1.2 * np.array([6, 2]) / math.hypot(6, 2), rtol=1e-12)
    np.testing.assert_allclose(scene.run(start, 150).pos[0, 0], [6, 2], atol=1e-3)


@pytest.mark.slow
def test_agents_in_one_place_part() -> None:
    scene = walkers(2, target=(0.0, 0.0))
    start = scene.start(0)
    start.pos[0], start.vel[0] = 0.0, 0.0
    end = scene.run(start, 20)
    assert np.isfinite(end.pos).all()
    assert np.linalg.norm(end.pos[0, 0] - end.pos[0, 1]) >= 0.6 - 1e-9


def test_the_nearest_obstacles_count_in_any_order_of_the_list() -> None:
    """Nine obstacles in a row ahead, more than there are places for neighbours."""
    stones = [{"centre": (2.0 + k, 0.1), "radius": 0.3} for k in range(9)]
    ends = []
    for listed in (stones, stones[::-1]):
        scene = walkers(1, obstacles=tuple(listed))
        start = scene.start(0)
        start.pos[0], start.vel[0] = (0.0, 0.0), (1.2, 0.0)
        ends.append(scene.step(start).vel[0, 0])
    np.testing.assert_array_equal(*ends)
    assert ends[0][1] != 0


def test_obstacles_that_are_not_round_are_refused() -> None:
    with pytest.raises(ValueError, match=r"only sees solid circles at rest; obstacles\[0\].kind = wall"):
        walkers(obstacles=({"kind": "wall", "vertices": ((0.0, 0.0), (1.0, 0.0))},))


def test_orca_in_three_dimensions_is_refused() -> None:
    with pytest.raises(ValueError, match=r"dimension = 3, must be 2"):
        Scene(
            dimension=3, groups=(Group(count=2, spawn=Spawn(low=(0, 0, 0), high=(1, 1, 1))),),
            effects=(Orca(weight=1, target=(0, 0, 0), speed=1),),
        )  # fmt: skip
