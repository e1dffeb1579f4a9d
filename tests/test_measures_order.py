"""Lanes and their null distribution, order of flocks, and artefacts of pedestrian models."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flockenv.geometry.space import Box, Plane, Torus
from flockenv.studies.measures import (
    above_null,
    band_index,
    cohesion_radius,
    collision_rate,
    components,
    group_momentum,
    lane_order,
    lanes,
    mean_of_runs,
    milling,
    oscillation_proportion,
    overlap_area,
    overlap_proportion,
    polarisation,
)

# --- lanes ------------------------------------------------------------------------------------------------------------


def walkers(many: int, seed: int, laned: float, instants: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Return positions across a corridor 3 m wide, and directions; a share `laned` stays in its direction's third."""
    rng = np.random.default_rng(seed)
    way = np.where(np.arange(many) % 2, 1, -1)
    y = rng.uniform(0, 3, (instants, many))
    keeps = rng.random(many) < laned
    y[:, keeps] = np.where(way == 1, 2, 0)[keeps] + rng.uniform(0, 1, (instants, int(keeps.sum())))
    return y, way


def test_lane_order_is_1_for_perfect_lanes_and_0_for_even_mixing() -> None:
    y = np.array([0.1, 0.3, 0.5, 0.7])
    assert lane_order(y, [1, 1, -1, -1], 0, 1) == 1
    assert band_index(y, [1, 1, -1, -1], 0, 1, 0.4) == 1
    assert lane_order(y, [1, -1, 1, -1], 0, 1, 0.4) == 0
    assert band_index(y, [1, -1, 1, -1], 0, 1, 0.4) == 0
    # a row of three agents, two in one direction: (1/3)^2 and 1/3
    assert lane_order([0.1, 0.1, 0.1], [1, 1, -1], 0, 1) == pytest.approx(1 / 9)
    assert band_index([0.1, 0.1, 0.1], [1, 1, -1], 0, 1) == pytest.approx(1 / 3)
    assert math.isnan(lane_order([5.0], [1], 0, 1))


def test_lanes_are_above_their_null_and_a_random_crowd_is_not() -> None:
    found = lanes(*walkers(54, 0, 1.0), 0, 3)
    assert found.order == 1
    assert found.beyond == 1
    assert found.p == pytest.approx(1 / 401)
    at = [lanes(*walkers(54, k, 0.0), 0, 3, deals=100) for k in range(60)]
    assert np.mean([each.beyond for each in at]) == pytest.approx(0, abs=0.01)
    p = np.array([each.p for each in at])
    assert (p < 0.05).mean() < 0.15
    assert p.mean() == pytest.approx(0.5, abs=0.15)


def test_the_null_of_lane_order_is_about_one_over_the_number_in_a_row() -> None:
    """In rows of n, E ((n+ - n-) / n)^2 = 1/n, and a little less if there are equally many in both directions."""
    for each in (2, 5, 10):
        many = 20 * each
        y = np.repeat((np.arange(20) + 0.5) * 0.2, each)[None]
        way = np.where(np.arange(many) % 2, 1, -1)
        found = lanes(y, way, 0, 4, deals=2000)
        exact = 1 / each - (each - 1) / each / (many - 1)
        assert found.null == pytest.approx(exact, rel=0.03)


def test_lane_order_grows_with_the_share_of_agents_in_lanes() -> None:
    orders = [lanes(*walkers(80, 3, share), 0, 3, deals=50).beyond for share in (0, 0.3, 0.6, 1)]
    assert orders == sorted(orders)
    assert orders[1] > 0.05


def test_agents_that_are_not_present_do_not_count_for_lanes() -> None:
    y, way = walkers(40, 1, 1.0)
    rng = np.random.default_rng(0)
    spoilt = np.concatenate([y, rng.uniform(0, 3, (30, 20))], axis=1)
    ways = np.concatenate([way, np.where(rng.random(20) < 0.5, 1, -1)])
    present = np.ones((30, 60), bool)
    assert lanes(spoilt, ways, 0, 3, deals=20).order < 0.95
    present[:, 40:] = False
    assert lanes(spoilt, ways, 0, 3, present, deals=20).order == 1
    with pytest.raises(ValueError, match="direction: lanes need agents in both directions"):
        lanes(y, np.ones(40), 0, 3)
    with pytest.raises(ValueError, match="rows from 3 to 0 m"):
        lanes(y, way, 3, 0)
    with pytest.raises(ValueError, match="across: of shape"):
        lanes(y, way[1:], 0, 3)


def test_over_20_seeds_lanes_are_above_chance_and_random_crowds_are_not() -> None:
    def over_seeds(laned: float) -> bool:
        runs = [lanes(*walkers(40, k, laned, 5), 0, 3, deals=40) for k in range(20)]
        return above_null([r.order for r in runs], [r.null for r in runs]).holds

    assert over_seeds(0.4)
    assert not over_seeds(0.0)


@pytest.mark.slow
def test_runs_without_excess_are_rarely_above_the_null() -> None:
    """An exact 95 % interval would give 2.5 %; a bootstrap of 20 runs gives a little more."""
    rng = np.random.default_rng(5)
    holds = [above_null(rng.normal(1, 1, 20), np.ones(20)).holds for _ in range(200)]
    assert 0.005 < np.mean(holds) < 0.07


def test_means_of_runs_leave_out_nan_and_have_intervals() -> None:
    found = mean_of_runs([1, 2, 3, math.nan])
    assert (found.runs, found.mean) == (3, 2)
    assert found.low < 2 < found.high
    assert math.isnan(mean_of_runs([4.0]).low)
    assert mean_of_runs([]).runs == 0
    with pytest.raises(ValueError, match="values: 2 runs with a null"):
        above_null([1, 1], [0, 0])
    with pytest.raises(ValueError, match="must be one of each for each run"):
        above_null([1, 1], [0, 0, 0])


# --- order of flocks --------------------------------------------------------------------------------------------------


def ring(many: int, dimension: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of a rigid ring that rotates about its centre."""
    turn = 2 * np.pi * np.arange(many) / many
    out, round_ = np.stack([np.cos(turn), np.sin(turn)], -1), np.stack([-np.sin(turn), np.cos(turn)], -1)
    more = [np.zeros((many, 1))] * (dimension - 2)
    return np.concatenate([3 * out, *more], 1) + 9.0, np.concatenate([0.7 * round_, *more], 1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_rigid_rotation_has_milling_1_and_polarisation_0(dimension: int) -> None:
    pos, vel = ring(36, dimension)
    assert milling(pos, vel, Plane()) == pytest.approx(1)
    assert milling(pos, -vel, Plane()) == pytest.approx(1)
    assert polarisation(vel) == pytest.approx(0, abs=1e-12)
    assert group_momentum(vel, np.ones(36)) == pytest.approx(0, abs=1e-12)
    assert cohesion_radius(pos, Plane()) == pytest.approx(3)


def test_agents_with_equal_velocities_have_milling_0() -> None:
    pos, _ = ring(36)
    vel = np.tile([0.6, 0.8], (36, 1))
    assert milling(pos, vel, Plane()) == pytest.approx(0, abs=1e-12)
    assert group_momentum(vel, np.full(36, 2.0)) == pytest.approx(72)
    assert group_momentum(vel[:2], [1.0, np.inf]) == pytest.approx(1)
    half = np.where(np.arange(36)[:, None] % 2, *[ring(36)[1] * s for s in (1, -1)])
    assert milling(pos, half, Plane()) == pytest.approx(0, abs=1e-12)
    assert math.isnan(milling(pos, np.zeros((36, 2)), Plane()))
    assert math.isnan(cohesion_radius(np.zeros((0, 2)), Plane()))


def test_milling_of_a_ring_across_the_corner_of_a_torus() -> None:
    pos, vel = ring(36)
    torus = Torus(size=(20.0, 30.0))
    shifted = torus.wrap(pos - 9.0)
    assert milling(shifted, vel, torus) == pytest.approx(1)
    assert cohesion_radius(shifted, torus) == pytest.approx(3)
    assert milling(shifted, vel, Plane()) < 0.9  # in a plane the ring is in four pieces


@given(st.lists(st.tuples(st.floats(0, 9.9), st.floats(0, 9.9)), min_size=1, max_size=15), st.floats(0.1, 4.9))
def test_connected_groups_are_those_that_a_search_finds(points: list[tuple[float, float]], reach: float) -> None:
    pos, torus = np.array(points), Torus(size=(10.0, 10.0))
    near = np.linalg.norm(torus.displacement(pos[:, None], pos[None]), axis=-1) <= reach
    todo, groups = set(range(len(pos))), 0
    while todo:
        edge = {todo.pop()}
        groups += 1
        while edge:
            new = {int(j) for i in edge for j in np.flatnonzero(near[i])} & todo
            todo -= new
            edge = new
    assert components(pos, reach, torus) == groups


def test_connected_groups_need_a_valid_reach() -> None:
    assert components(np.zeros((0, 2)), 1.0, Plane()) == 0
    with pytest.raises(ValueError, match="reach = 0 m: must be > 0"):
        components(np.zeros((2, 2)), 0.0, Plane())
    with pytest.raises(ValueError, match="reach = 6 m: must be > 0 and <= 5"):
        components(np.zeros((2, 2)), 6.0, Torus(size=(10.0, 20.0)))


# --- artefacts of models ----------------------------------------------------------------------------------------------


def test_the_overlap_area_of_two_discs() -> None:
    """Apart, one inside the other, and partly overlapping; also against counting random places."""
    assert overlap_area(2.0, 1, 1) == 0
    assert overlap_area(0.0, 1, 2) == pytest.approx(np.pi)
    assert overlap_area(0.9, 2, 1) == pytest.approx(np.pi)
    assert overlap_area(1.0, 1, 1) == pytest.approx(2 * np.pi / 3 - math.sqrt(3) / 2)
    places = np.random.default_rng(0).uniform(-1, 1, (400_000, 2))
    both = (np.linalg.norm(places, axis=1) < 1) & (np.linalg.norm(places - [1.2, 0], axis=1) < 0.7)
    assert overlap_area(1.2, 1, 0.7) == pytest.approx(4 * both.mean(), rel=0.02)


def test_the_mean_overlap_is_over_overlapping_pairs_only() -> None:
    """At one instant a pair shares 2 pi/3 - sqrt(3)/2 of pi, at one no pair, at one a small disc is in a large one."""
    pos = np.array([[[0, 0], [1, 0], [9, 9]], [[0, 0], [3, 0], [9, 9]], [[0, 0], [3, 0], [0.1, 0]]], float)
    found = overlap_proportion(pos, [1, 1, 0.5], Plane())
    assert found.mean == pytest.approx(((2 / 3 - math.sqrt(3) / 2 / np.pi) + 1) / 2)
    assert found.share == pytest.approx(4 / 9)
    assert overlap_proportion(pos[1:2], [1, 1, 0.5], Plane()) == (0.0, 0.0)
    alive = np.ones((3, 3), bool)
    alive[:, 0] = False
    assert overlap_proportion(pos, [1, 1, 0.5], Plane(), alive).mean == 0
    seam = np.array([[[0.2, 5.0], [9.8, 5.0]]])
    assert overlap_proportion(seam, [0.5, 0.5], Torus(size=(10.0, 10.0))).mean > 0
    assert overlap_proportion(seam, [0.5, 0.5], Box(size=(10.0, 10.0))).mean == 0


def test_oscillation_is_the_share_of_motion_against_the_desired_velocity() -> None:
    """One agent goes ahead, one goes back at half speed at one of four instants, one has no desired velocity."""
    vel = np.zeros((4, 3, 2))
    vel[:, 0], vel[:, 1], vel[:, 2] = (1.3, 0), (0, 1.2), (-5, 0)
    vel[2, 1] = (0.9, -0.6)
    desired = np.array([[1.3, 0], [0, 1.2], [0, 0]])
    assert oscillation_proportion(vel, desired) == pytest.approx((0.5, 1 / 8))
    assert oscillation_proportion(vel[:2], desired) == (0.0, 0.0)
    assert math.isnan(oscillation_proportion(vel, np.zeros((3, 2))).share)


def test_a_collision_is_counted_when_the_contact_begins() -> None:
    """Two agents touch at 1 s and 2 s, part, and touch again at 4 s: each has two collisions in 4 s."""
    gap = np.array([3.0, 0.9, 0.9, 3.0, 0.9])
    pos = np.zeros((5, 3, 2))
    pos[:, 1, 0], pos[:, 2] = gap, (50, 50)
    assert collision_rate(np.arange(5.0), pos, [0.5, 0.5, 0.5], Plane()) == pytest.approx(2 * 2 / (3 * 4))
    assert collision_rate(np.arange(5.0), pos, [0.5, 0.5, 0.5], Plane(), body=[7, 7, 7]) == 0
    assert collision_rate(np.arange(5.0), pos[:, ::-1], [0.5] * 3, Plane()) == pytest.approx(1 / 3)
    assert np.isnan(collision_rate([0.0], pos[:1], [0.5] * 3, Plane()))  # a single instant
    alive = np.ones((5, 3), bool)
    alive[1:3, 1] = False
    assert collision_rate(np.arange(5.0), pos, [0.5] * 3, Plane(), alive) == pytest.approx(2 / (2 + 2 + 3 + 3))
