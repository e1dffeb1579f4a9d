"""Reynolds' behaviours: properties of all steering laws, and what each of them makes agents do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flockenv import steering
from flockenv.steering import arbitration
from flockenv.steering.vectorize import loop_of, rows
from tests.catalogue import STEERING, Array, Law, mirror, rotation


def laws(*chosen: Law) -> Any:
    return pytest.mark.parametrize("row", chosen, ids=lambda row: row.name)


DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])
VECTORS = ("vector", "heading", "own", "noise", "walls")
TURNED = ("vector", "heading", "noise")


def arguments(row: Law, dimension: int, count: int, seed: int = 1) -> list[Array]:
    """Return random arguments of a law, `count` rows."""
    rng = np.random.default_rng(seed)

    def unit() -> Array:
        directions = rng.normal(size=(count, dimension))
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    make = {
        "vector": lambda: 3 * rng.normal(size=(count, dimension)),
        "heading": unit,
        "own": unit,
        "noise": lambda: rng.uniform(-1, 1, (count, dimension)),
        "walls": lambda: rng.uniform(-1, 4, (count, dimension)),
        "positive": lambda: rng.uniform(0.5, 2, count),
        "length": lambda: rng.uniform(2, 4, count),
    }
    return [make[kind]() for kind in row.takes]


def turned(row: Law, given_: list[Array], matrix: Array) -> list[Array]:
    return [a @ matrix.T if kind in TURNED else a for kind, a in zip(row.takes, given_, strict=True)]


# --- properties of all laws -------------------------------------------------------------------------------------------


@DIMENSIONS
@laws(*(row for row in STEERING if row.turns != "none"))
def test_steering_turns_with_its_arguments(row: Law, dimension: int) -> None:
    given_ = arguments(row, dimension, 200)
    answer = rows(row.law)(*given_)
    for seed in range(3):
        matrix = rotation(dimension, seed, upright=row.turns == "upright")
        expected = answer @ matrix.T if row.gives == "vector" else answer
        np.testing.assert_allclose(rows(row.law)(*turned(row, given_, matrix)), expected, rtol=1e-10, atol=1e-10)


@DIMENSIONS
@laws(*(row for row in STEERING if row.mirrors))
def test_mirrored_arguments_give_mirrored_steering(row: Law, dimension: int) -> None:
    given_ = arguments(row, dimension, 200)
    answer = rows(row.law)(*given_)
    expected = answer @ mirror(dimension) if row.gives == "vector" else answer
    np.testing.assert_allclose(rows(row.law)(*turned(row, given_, mirror(dimension))), expected, rtol=1e-12, atol=1e-12)


def extremes(row: Law, dimension: int) -> list[Array]:
    """Return all combinations of vanishing, tiny, common and huge vectors that the law accepts."""
    rng = np.random.default_rng(3)
    sizes = {"vector": (0.0, 1e-12, 1.0, 1e6), "walls": (-1e6, 0.0, 1e6), "noise": (0.0, 1.0)}
    headings = (0.0, 1.0) if row.law is not steering.separate else (1.0,)  # 0: an agent at rest has no heading
    choices = [sizes.get(kind, headings if kind == "heading" else (1.0,)) for kind in row.takes]
    grid = np.stack([g.ravel() for g in np.meshgrid(*choices, indexing="ij")], axis=1)
    grid = np.repeat(grid, 8, axis=0)
    arrays = []
    for k, kind in enumerate(row.takes):
        directions = rng.normal(size=(len(grid), dimension))
        directions[::4] = np.eye(dimension)[0]  # aligned with each other and with an axis
        directions[1::4] = np.eye(dimension)[-1]  # vertical in 3-D
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        arrays.append(grid[:, k, None] * directions if kind in VECTORS else grid[:, k])
    return arrays


@DIMENSIONS
@laws(*STEERING)
def test_steering_is_bounded_for_vanishing_and_huge_arguments(row: Law, dimension: int) -> None:
    answer = rows(row.law)(*extremes(row, dimension))
    assert not np.isnan(answer).any()
    endless = (steering.threat, steering.unaligned_threat, steering.queue_gap, steering.collision_distance)
    if row.law not in endless:  # infinite if nothing is ahead
        assert np.isfinite(answer).all()
    if row.law is not steering.interception_time:  # up to 1e22 s, by rounding, for a quarry as fast that flees
        assert np.abs(answer[np.isfinite(answer)]).max() <= 1e13  # no law divides twice by a distance of 1e-12 m


@pytest.mark.slow
@DIMENSIONS
def test_laws_stay_in_single_precision_and_accurate(dimension: int) -> None:
    given_ = [[a.astype(np.float32) for a in arguments(row, dimension, 200)] for row in STEERING]
    exact = [rows(row.law)(*g) for row, g in zip(STEERING, given_, strict=True)]
    answers = [np.full_like(e, np.nan) for e in exact]
    for row, arrays, answer in zip(STEERING, given_, answers, strict=True):
        loop_of(row.law, tuple(a.shape[1:] for a in arrays), dimension if row.gives == "vector" else 0)(
            tuple(arrays), answer
        )
    for row, answer, expected in zip(STEERING, answers, exact, strict=True):
        assert (answer.astype(np.float32) == answer).all(), f"a constant promotes {row.name} to float64"
        here = np.isfinite(expected)
        assert (here == np.isfinite(answer)).all()
        np.testing.assert_allclose(answer[here], expected[here], rtol=2e-5, atol=2e-5, err_msg=row.name)


# --- seek, flee, arrive -----------------------------------------------------------------------------------------------


def steer(behaviour: Any, x: Array, v: Array, *, dt: float, seconds: float, top: float = 2.0, strength: float = 8.0):
    """Move agents of 1 kg as in Reynolds 1999: force up to strength [N], speed up to top [m/s], velocity first."""
    x, v = x.copy(), v.copy()
    for step in range(round(seconds / dt)):
        force = 5.0 * behaviour(step * dt, x, v)
        size = np.linalg.norm(force, axis=1, keepdims=True)
        v = v + dt * force * np.minimum(1, strength / np.maximum(size, 1e-200))
        speed = np.linalg.norm(v, axis=1, keepdims=True)
        v = v * np.minimum(1, top / np.maximum(speed, 1e-300))
        x = x + dt * v
        yield step * dt + dt, x, v


def crowd(dimension: int, count: int = 40) -> tuple[Array, Array]:
    rng = np.random.default_rng(5)
    x = rng.normal(size=(count, dimension))
    return x * (4 + 4 * rng.random((count, 1))) / np.linalg.norm(x, axis=1, keepdims=True), rng.normal(size=x.shape)


@DIMENSIONS
def test_seek_approaches_the_point_and_flee_moves_away(dimension: int) -> None:
    x, v = crowd(dimension)
    start = np.linalg.norm(x, axis=1)
    *_, (_, near, _) = steer(lambda t, x, v: rows(steering.seek)(-x, v, 2.0), x, v, dt=0.05, seconds=1.5)
    *_, (_, far, _) = steer(lambda t, x, v: rows(steering.flee)(-x, v, 2.0), x, v, dt=0.05, seconds=1.5)
    assert (np.linalg.norm(near, axis=1) < start - 1).all()
    assert (np.linalg.norm(far, axis=1) > start + 1).all()


def test_seek_steers_to_full_speed_towards_the_point() -> None:
    np.testing.assert_allclose(rows(steering.seek)([3.0, 4.0], [0.5, 0.25], 2.0), [1.2 - 0.5, 1.6 - 0.25])


def test_flee_is_away_from_the_point_and_straight_on_at_the_point_itself() -> None:
    np.testing.assert_allclose(rows(steering.flee)([3.0, 4.0], [0.5, 0.25], 2.0), [-1.2 - 0.5, -1.6 - 0.25])
    np.testing.assert_allclose(rows(steering.flee)([0.0, 0.0], [0.0, 0.5], 2.0), [0.0, 1.5])


@DIMENSIONS
@pytest.mark.parametrize("dt", [0.1, 0.05, 0.01])
def test_arrive_stops_at_the_point_without_chatter(dt: float, dimension: int) -> None:
    """Below 0.01 m/s and 0.02 m after 20 s, at every step size up to 0.1 s."""
    x, v = crowd(dimension)
    *_, (_, x, v) = steer(lambda t, x, v: rows(steering.arrive)(-x, v, 2.0, 1.5), x, v, dt=dt, seconds=20)
    assert np.linalg.norm(v, axis=1).max() < 0.01
    assert np.linalg.norm(x, axis=1).max() < 0.02


def test_arrive_is_seek_outside_the_radius_and_a_ramp_inside() -> None:
    arrive = rows(steering.arrive)
    np.testing.assert_allclose(arrive([5.0, 0.0], [1.0, 0.0], 2.0, 4.0), [1.0, 0.0])
    np.testing.assert_allclose(arrive([1.0, 0.0], [1.0, 0.0], 2.0, 4.0), [-0.5, 0.0])
    np.testing.assert_allclose(arrive([0.0, 0.0], [1.0, 0.0], 2.0, 4.0), [-1.0, 0.0])


# --- pursue, evade ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("offset", "quarry", "speed", "seconds"),
    [
        ((10, 0), (0, 0), 2, 5),
        ((10, 0), (0, 1), 2, 10 / math.sqrt(3)),  # crossing
        ((10, 0), (-1, 0), 2, 10 / 3),  # head-on
        ((10, 0), (1, 0), 2, 10),  # fleeing, slower
        ((10, 0), (-1, 0), 1, 5),  # as fast: the quadratic term vanishes
        ((10, 0), (-3, 0), 2, 2),  # faster, approaching
        ((10, 0), (-3, 1), 2, 2.0),  # faster, two meetings: the first, (9 + 1 - 4) t^2 - 60 t + 100 = 0 ...
        ((10, 0), (3, 0), 2, 5),  # faster and fleeing: never; |p| / V instead
        ((10, 0), (0, 3), 2, 5),  # faster and across: never
        ((10, 0), (0, 2), 2, 5),  # as fast and across: never, at the edge of the formula
        ((0, 0), (1, 0), 2, 0),  # at the same place
    ],
)
def test_interception_time_is_the_closed_form(offset: Any, quarry: Any, speed: float, seconds: float) -> None:
    if quarry == (-3, 1):
        seconds = (60 - math.sqrt(3600 - 4 * 6 * 100)) / 12
    assert rows(steering.interception_time)(offset, quarry, speed) == pytest.approx(seconds, rel=1e-12)


def test_interception_time_is_accurate_despite_cancellation() -> None:
    """Far away and almost as fast: the textbook form of the small root loses all digits."""
    time = float(rows(steering.interception_time)([1e4, 0.0], [-1.0, 0.0], 1.0 + 1e-9))
    assert time == pytest.approx(1e4 / (2 + 1e-9), rel=1e-12)


@DIMENSIONS
def test_pursue_with_the_exact_predictor_intercepts_on_a_straight_path(dimension: int) -> None:
    x, _ = crowd(dimension)
    w = np.random.default_rng(8).normal(size=x.shape)
    w *= 1.5 / np.linalg.norm(w, axis=1, keepdims=True)  # the quarry is slower
    meeting = rows(steering.interception_time)(-x, w, 2.0)
    aim = rows(steering.pursue)(-x, np.zeros_like(x), w, 2.0, meeting)
    np.testing.assert_allclose(x + aim * meeting[:, None], w * meeting[:, None], atol=1e-9)

    def chase(t: float, x: Array, v: Array) -> Array:
        p = w * t - x
        return rows(steering.pursue)(p, v, w, 2.0, rows(steering.interception_time)(p, w, 2.0))

    reached = np.full(len(x), np.inf)
    for t, now, _ in steer(chase, x, 2 * aim / 2, dt=0.02, seconds=20, strength=1e9):
        near = np.linalg.norm(w * t - now, axis=1) < 0.1
        reached[near] = np.minimum(reached[near], t)
    early = meeting - reached  # 0.1 m are closed at 0.5 to 3.5 m/s
    assert early.min() > 0
    assert early.max() < 0.1 / 0.5 + 0.02


@DIMENSIONS
def test_pursue_with_the_distance_predictor_seeks_the_predicted_point(dimension: int) -> None:
    x, v = crowd(dimension)
    time = rows(steering.distance_time)(x, 2.0, 0.5)
    np.testing.assert_allclose(time, 0.25 * np.linalg.norm(x, axis=1))
    ahead = rows(steering.pursue)(x, v, np.ones_like(x), 2.0, time)
    np.testing.assert_allclose(ahead, rows(steering.seek)(x + time[:, None], v, 2.0))


@DIMENSIONS
def test_evade_delays_capture_compared_to_standing_still(dimension: int) -> None:
    """Time until a faster pursuer, which heads straight for the agent, is within 0.5 m."""
    start, _ = crowd(dimension)
    hunter = np.zeros_like(start)
    held = []
    for alert in (True, False):
        x, v, h = start.copy(), np.zeros_like(start), hunter.copy()
        caught = np.full(len(x), np.inf)
        for step in range(400):
            hv = 3.0 * (x - h) / np.linalg.norm(x - h, axis=1, keepdims=True)
            if alert:
                time = np.linalg.norm(h - x, axis=1) / 3.0
                v = v + 0.05 * 5 * rows(steering.evade)(h - x, v, hv, 2.0, 0.3 * time)
            x, h = x + 0.05 * v, h + 0.05 * hv
            near = np.linalg.norm(x - h, axis=1) < 0.5
            caught[near] = np.minimum(caught[near], step * 0.05)
        held.append(caught)
    assert (held[0] > 1.5 * held[1]).all()


# --- wander -----------------------------------------------------------------------------------------------------------


def headings_after(seconds: float, dt: float, count: int = 20_000) -> Array:
    """Return the angles, rad, by which wandering agents have turned from their initial directions."""
    rng = np.random.default_rng(round(1000 * dt))
    target, v = np.tile([1.0, 0.0], (count, 1)), np.tile([1.0, 0.0], (count, 1))
    turned_by = np.zeros(count)
    for _ in range(round(seconds / dt)):
        target = rows(steering.wander_turn)(target, rng.uniform(-1, 1, (count, 2)), 1.0, dt)
        new = v + dt * 2.0 * rows(steering.wander)(target, v, 1.0, 1.5)
        turned_by += np.arctan2(v[:, 0] * new[:, 1] - v[:, 1] * new[:, 0], (v * new).sum(axis=1))
        v = new
    return turned_by


def test_wander_does_not_depend_on_the_step_size() -> None:
    variances = [headings_after(3.0, dt).var() for dt in (0.1, 0.05, 0.025)]
    assert max(variances) < 1.1 * min(variances)
    assert min(variances) > 0.02  # it does turn


def test_wander_targets_stay_on_the_sphere_and_wander_ahead_is_straight() -> None:
    rng = np.random.default_rng(2)
    for dimension in (2, 3):
        target = np.tile(np.eye(dimension)[0], (500, 1))
        for _ in range(50):
            target = rows(steering.wander_turn)(target, rng.uniform(-1, 1, target.shape), 3.0, 0.1)
            np.testing.assert_allclose(np.linalg.norm(target, axis=1), 1, rtol=1e-12)
        v = rng.normal(size=(500, dimension))
        ahead = np.tile(np.eye(dimension)[0], (500, 1))
        desired = rows(steering.wander)(ahead, v, 2.0, 1.5) + v
        np.testing.assert_allclose(desired, 2 * v / np.linalg.norm(v, axis=1, keepdims=True), atol=1e-12)
        assert abs(target.mean(axis=0)).max() < 0.15  # by now the targets are spread over the sphere


def test_a_wander_target_that_would_move_to_the_centre_stays() -> None:
    np.testing.assert_array_equal(rows(steering.wander_turn)([1.0, 0.0], [-1.0, 0.0], 1.0, 1.0), [1.0, 0.0])


def test_the_frame_of_wander_is_forward_left_up() -> None:
    wander = rows(steering.wander)
    v = np.array([3.0, 0.0])
    np.testing.assert_allclose(wander([0.0, 1.0], v, 1.0, 0.0) + v, [0, 1], atol=1e-12)
    v = np.array([3.0, 0.0, 0.0])
    np.testing.assert_allclose(wander([0.0, 1.0, 0.0], v, 1.0, 0.0) + v, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(wander([0.0, 0.0, 1.0], v, 1.0, 0.0) + v, [0, 0, 1], atol=1e-12)


# --- separate, align, cohere ------------------------------------------------------------------------------------------


@DIMENSIONS
def test_separation_is_one_over_the_distance_and_mutual(dimension: int) -> None:
    x, tie = crowd(dimension)
    tie /= np.linalg.norm(tie, axis=1, keepdims=True)
    square = (x**2).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(rows(steering.separate)(x, tie), -x / square)
    np.testing.assert_allclose(rows(steering.separate)(-x, -tie), x / square)
    np.testing.assert_array_equal(rows(steering.separate)(0 * x, tie), tie)


def test_align_takes_on_the_mean_velocity_and_cohere_seeks_the_centre() -> None:
    np.testing.assert_allclose(rows(steering.align)([1.0, 2.0], [0.5, 4.0]), [-0.5, 2.0])
    np.testing.assert_allclose(rows(steering.cohere)([3.0, 4.0], [0.5, 0.25], 2.0), [0.7, 1.35])
    np.testing.assert_array_equal(rows(steering.cohere)([0.0, 0.0], [0.5, 0.25], 2.0), [0.0, 0.0])


# --- avoid ------------------------------------------------------------------------------------------------------------


@DIMENSIONS
def test_obstacles_beside_the_path_are_no_threat(dimension: int) -> None:
    """Obstacles beside the path: a force field would push here."""
    ahead, side = np.eye(dimension)[0], np.eye(dimension)[1]
    far = rows(steering.threat)(ahead, [3 * ahead + 1.001 * side, 3 * ahead + side, -3 * ahead], 1.0, 10.0)
    np.testing.assert_array_equal(far, np.inf)


@DIMENSIONS
def test_a_threat_is_the_distance_to_the_first_touch_on_the_straight_path(dimension: int) -> None:
    ahead, side = np.eye(dimension)[0], np.eye(dimension)[1]
    offsets = [5 * ahead, 5 * ahead + 0.6 * side, 5 * ahead, 0.3 * ahead, -0.3 * ahead, 5 * ahead]
    reach = [10, 10, 3.9, 10, 10, 4.0]  # the last obstacle is touched exactly at the end of the reach
    expected = [4, 5 - 0.8, np.inf, 0, 0, 4]
    np.testing.assert_allclose(rows(steering.threat)(ahead, offsets, 1.0, reach), expected)


@DIMENSIONS
def test_avoid_steers_sideways_away_from_the_centre(dimension: int) -> None:
    """S = -V unit(lateral offset): no part along the heading, at any distance."""
    x, heading = crowd(dimension)
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    lateral = x - (x * heading).sum(axis=1, keepdims=True) * heading
    expected = -3 * lateral / np.linalg.norm(lateral, axis=1, keepdims=True)
    np.testing.assert_allclose(rows(steering.avoid)(heading, x, 0.5, 3.0), expected, atol=1e-12)


def test_avoid_steers_right_of_an_obstacle_dead_ahead() -> None:
    avoid = rows(steering.avoid)
    np.testing.assert_allclose(avoid([1.0, 0.0], [5.0, 0.0], 1.0, 3.0), [0, -3])
    np.testing.assert_allclose(avoid([0.0, 1.0], [0.0, 5.0], 1.0, 3.0), [3, 0])
    np.testing.assert_allclose(avoid([1.0, 0.0, 0.0], [5.0, 0.0, 0.0], 1.0, 3.0), [0, -3, 0])
    np.testing.assert_allclose(avoid([0.6, 0.8], [5 * 0.6, 5 * 0.8], 1.0, 3.0), [3 * 0.8, -3 * 0.6], atol=1e-12)
    up = avoid([0.0, 0.0, 1.0], [0.0, 0.0, 5.0], 1.0, 3.0)
    assert np.linalg.norm(up) == pytest.approx(3)
    assert up[2] == 0


@DIMENSIONS
def test_avoid_steers_straight_out_of_an_obstacle(dimension: int) -> None:
    x, heading = crowd(dimension)
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    out = -3 * x / np.linalg.norm(x, axis=1, keepdims=True)
    np.testing.assert_allclose(rows(steering.avoid)(heading, x, 100.0, 3.0), out, atol=1e-12)
    np.testing.assert_allclose(rows(steering.avoid)(heading, 0 * x, 1.0, 3.0), 3 * heading, atol=1e-12)


# --- contain ----------------------------------------------------------------------------------------------------------


@DIMENSIONS
def test_contain_is_zero_inside_and_steers_inwards_outside(dimension: int) -> None:
    rng = np.random.default_rng(4)
    x, v = rng.uniform(-3, 13, (500, dimension)), rng.normal(size=(500, dimension))
    change = rows(steering.contain)(x, 10 - x, v, 2.0, 1.5)
    soon = x + 1.5 * v
    inside = ((soon >= 0) & (soon <= 10)).all(axis=1)
    assert 50 < inside.sum() < 450
    np.testing.assert_array_equal(change[inside], 0)
    goal = np.clip(soon, 0, 10) - x
    expected = 2 * goal / np.linalg.norm(goal, axis=1, keepdims=True) - v
    np.testing.assert_allclose(change[~inside], expected[~inside], atol=1e-9)
    outside = ((x < 0) | (x > 10)).any(axis=1) & ~inside
    nearest = np.clip(x, 0, 10) - x
    assert (((change + v) * nearest).sum(axis=1)[outside] > 0).all()


# --- arbitration ------------------------------------------------------------------------------------------------------

REYNOLDS = [(8.0, 0.0), (-8.0, 0.0), (0.0, 5.0)]


def test_allocate_takes_forces_in_order_until_the_budget_is_used_up() -> None:
    """Lengths are added as scalars; Buckland's running sum would be (6, 4)."""
    np.testing.assert_allclose(rows(arbitration.allocate)(REYNOLDS, 10.0), [6, 0])
    np.testing.assert_allclose(rows(arbitration.allocate)(REYNOLDS, 21.0), [0, 5])
    np.testing.assert_allclose(rows(arbitration.allocate)(REYNOLDS, 0.0), [0, 0])
    np.testing.assert_allclose(rows(arbitration.allocate)(np.zeros((3, 2)), 10.0), [0, 0])


def test_blend_can_cancel() -> None:
    np.testing.assert_allclose(rows(arbitration.blend)(REYNOLDS, [1.0, 1.0, 0.0], 10.0), [0, 0])
    np.testing.assert_allclose(rows(arbitration.blend)(REYNOLDS, [1.0, 0.5, 0.6], 10.0), [4, 3])
    np.testing.assert_allclose(rows(arbitration.blend)(REYNOLDS, [1.0, 0.5, 0.6], 2.5), [2, 1.5])


def test_prioritise_takes_the_first_force_above_the_threshold() -> None:
    prioritise = rows(arbitration.prioritise)
    np.testing.assert_allclose(prioritise(REYNOLDS, 0.1, 10.0), [8, 0])
    np.testing.assert_allclose(prioritise([(0.05, 0.0), (0.0, 3.0), (9.0, 9.0)], 0.1, 2.0), [0, 2])
    np.testing.assert_allclose(prioritise([(0.05, 0.0), (0.0, 0.1), (0.0, 0.0)], 0.1, 2.0), [0, 0])


NUMBERS = st.one_of(st.just(0.0), st.floats(-1e6, 1e6), st.floats(-1e-9, 1e-9))


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=3, max_size=3), st.floats(0, 1e6))
def test_allocate_never_exceeds_the_budget_and_is_the_sum_if_that_fits(forces: Any, budget: float) -> None:
    granted = rows(arbitration.allocate)(forces, budget)
    lengths = np.linalg.norm(forces, axis=1)
    assert np.isfinite(granted).all()
    assert np.linalg.norm(granted) <= budget * (1 + 1e-12) + 1e-300
    if lengths.sum() <= budget * (1 - 1e-12):
        np.testing.assert_allclose(granted, np.sum(forces, axis=0), rtol=1e-12, atol=1e-9 * max(1.0, lengths.max()))


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=3, max_size=3), st.floats(0, 1e6))
def test_no_arbiter_exceeds_the_budget(forces: Any, budget: float) -> None:
    for answer in (
        rows(arbitration.blend)(forces, [1.0, 2.0, 0.5], budget),
        rows(arbitration.prioritise)(forces, 0.0, budget),
    ):
        assert np.linalg.norm(answer) <= budget * (1 + 1e-12) + 1e-300


# --- the wrapper over rows --------------------------------------------------------------------------------------------


def test_rows_broadcast_and_keep_the_leading_shape() -> None:
    offset = np.random.default_rng(0).normal(size=(4, 1, 5, 2))
    answer = rows(steering.seek)(offset, np.zeros((3, 5, 2)), 2.0)
    assert answer.shape == (4, 3, 5, 2)
    np.testing.assert_array_equal(answer[2, 1, 3], rows(steering.seek)(offset[2, 0, 3], np.zeros(2), 2.0))
    assert rows(steering.distance_time)(offset, 2.0, 1.0).shape == (4, 1, 5)
    assert rows(steering.seek)(np.zeros((0, 2)), np.zeros((0, 2)), 2.0).shape == (0, 2)


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        (([1.0, 2.0], [0.0, 0.0]), "seek takes 3 arguments (offset, velocity, max_speed)"),
        (([1.0, 2.0, 3.0, 4.0], [0.0, 0.0], 1.0), "offset has shape (4,)"),
        ((1.0, [0.0, 0.0], 1.0), "offset has shape ()"),
    ],
)
def test_rows_name_the_argument_that_does_not_fit(given_: Any, message: str) -> None:
    with pytest.raises((TypeError, ValueError)) as caught:
        rows(steering.seek)(*given_)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_rows_refuse_mixed_dimensions() -> None:
    for offset, velocity in (([1.0, 2.0, 3.0], [0.0, 0.0]), ([1.0, 2.0], [0.0, 0.0, 5.0])):
        with pytest.raises(ValueError, match=r"seek: .*\b2\b.*\b3\b"):
            rows(steering.seek)(offset, velocity, 1.0)
