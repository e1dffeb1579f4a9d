"""Flow, gaps, bursts, clogging and evacuation against arrangements whose answer is known."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flockenv.studies.measures import (
    Crossings,
    bursts,
    crossings,
    cumulative,
    evacuation_time,
    flow,
    goodness,
    last_crossing,
    leaving_times,
    runs,
    survival,
    tail,
    time_gaps,
)
from flockenv.studies.measures.door_bursts import runs_probability

UP = ((0.0, -1.0), (0.0, 1.0))
"""A line that is drawn upward: who walks along x crosses it forward."""


def column(many: int, gap: float, speed: float, instants: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """People in single file, so far apart, the first at x = -0.3 m: times and positions."""
    time = dt * np.arange(instants)
    x = -0.3 - gap * np.arange(many) + speed * time[:, None]
    return time, np.stack([x, np.zeros_like(x)], axis=-1)


# --- flow -------------------------------------------------------------------------------------------------------------


def test_a_column_passes_in_time_with_gaps_of_its_own() -> None:
    """1.2 m/s, .9 m apart: one every .75 s, the first after .25 s; instants every .4 s, so most cross between two."""
    time, pos = column(10, 0.9, 1.2, 26, 0.4)
    found = crossings(time, pos, UP)
    assert found.time == pytest.approx(0.25 + 0.75 * np.arange(10), abs=1e-12)
    assert found.agent.tolist() == list(range(10))
    assert (found.sign == 1).all()
    assert time_gaps(found) == pytest.approx(np.full(9, 0.75), abs=1e-12)
    assert flow(found, 2.0, 10.0) == pytest.approx((10, 0, 1.0, 0.5, 1 / 0.75))
    assert cumulative(found)[1].tolist() == list(range(1, 11))


def test_the_other_way_is_backward_and_the_line_turned_around_changes_signs() -> None:
    time, pos = column(4, 0.9, 1.2, 26, 0.4)
    assert crossings(time, -pos, UP).sign.tolist() == [-1] * 4
    assert crossings(time, pos, UP[::-1]).sign.tolist() == [-1] * 4
    found = crossings(time, np.concatenate([pos, -pos[:, :3]], axis=1), UP)
    assert flow(found, 1.0, 10.0)[:3] == pytest.approx((4, 3, 0.1))
    assert len(time_gaps(found, -1)) == 2


def test_who_passes_beside_the_line_or_stops_on_it_does_not_cross_twice() -> None:
    """Beside its end; onto it and on; onto it and back; from the right onto it and back."""
    x = np.array([[-1, -1, -1, 1], [0, 0, 0, 0], [1, 1, -1, -1]], float)
    y = np.array([[1.5, 0, 0, 0]] * 3, float)
    found = crossings([0, 1, 2], np.stack([x, y], axis=-1), UP)
    assert dict(zip(found.agent.tolist(), found.sign.tolist(), strict=True)) == {1: 1, 3: -1}


def thousandths(count: int) -> float:
    """Of numbers as close as 1e-241 only rounding says on which side of each other they are."""
    return count / 1000


@given(
    ends=st.lists(st.integers(-990, 990).map(thousandths), min_size=1, max_size=6, unique=True),
    heights=st.lists(st.integers(-1000, 999).map(thousandths), min_size=1, max_size=20),
)
def test_of_a_line_in_pieces_each_crossing_is_of_one_piece(ends: list[float], heights: list[float]) -> None:
    pos = np.array([[(-1.0, y) for y in heights], [(2.0, y) for y in heights]])
    marks = [-1.0, *sorted(ends), 1.0]
    many = sum(len(crossings([0, 1], pos, ((0, a), (0, b))).time) for a, b in itertools.pairwise(marks))
    assert many == len(heights)


def test_over_the_seam_of_a_torus_the_short_way_is_the_way() -> None:
    """9.8 -> 0.1 on a torus of 10 m is a step of .3 m over x = 0, or x = 10: a line drawn at either is crossed once."""
    pos = np.array([[[9.8, 1.0]], [[0.1, 1.0]]])
    for x in (0.0, 10.0):
        found = crossings([0, 1], pos, ((x, 0.0), (x, 2.0)), period=(10.0, 5.0))
        assert found.time == pytest.approx([2 / 3])
        assert found.sign.tolist() == [1]
    assert not len(crossings([0, 1], pos, ((5.0, 0.0), (5.0, 2.0)), period=(10.0, 5.0)).time)
    assert len(crossings([0, 1], pos, ((5.0, 0.0), (5.0, 2.0))).time) == 1  # in a plane it walked 9.7 m back


def test_the_dead_and_those_who_come_in_their_place_made_no_way() -> None:
    time, pos = column(3, 0.9, 1.2, 26, 0.4)
    alive, who = np.ones((26, 3), bool), np.zeros((26, 3), int)
    alive[3:, 1] = False  # the second has died at 1.2 s, and passes at 1 s: it counts
    who[4:, 2] = 7  # the third would pass at 1.75 s, between instants 4 and 5: it is somebody else by then
    who[5:, 2] = 8
    found = crossings(time, pos, UP, alive, who)
    assert found.agent.tolist() == [0]
    assert crossings(time, pos, UP, None, who).agent.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"line": ((0, 0), (0, 0))}, "line = "),
        ({"line": ((0, 0), (0, math.nan))}, "line = "),
        ({"time": [0, 0]}, "time: must grow"),
        ({"time": [0, 1, 2]}, "pos: of shape"),
        ({"pos": np.zeros((2, 3, 3))}, "pos: of shape"),
    ],
)
def test_what_is_no_line_or_run_is_refused_in_one_line(change: dict[str, object], said: str) -> None:
    given_: dict[str, object] = {"time": [0, 1], "pos": np.zeros((2, 3, 2)), "line": UP, **change}
    with pytest.raises(ValueError, match=said) as caught:
        crossings(**given_)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="width = 0"):
        flow(Crossings(np.zeros(0), np.zeros(0, int), np.zeros(0, int)), 0.0, 1.0)


# --- bursts -----------------------------------------------------------------------------------------------------------


def test_runs_of_equal_signs() -> None:
    assert runs([1, 1, -1, 1]).tolist() == [2, 1, 1]
    assert runs([]).tolist() == []
    assert runs([-1]).tolist() == [1]


@pytest.mark.parametrize(("first", "second"), [(1, 1), (3, 5), (4, 4), (1, 6)])
def test_the_null_of_bursts_is_that_of_all_orders(first: int, second: int) -> None:
    """Every order, one after another, against the formula: distribution and mean of the number of runs."""
    n = first + second
    counts = np.zeros(n + 1)
    for places in itertools.combinations(range(n), first):
        signs = np.full(n, -1)
        signs[list(places)] = 1
        counts[len(runs(signs))] += 1
    share = counts / counts.sum()
    assert [runs_probability(r, first, second) for r in range(n + 1)] == pytest.approx(share, abs=1e-12)
    one = np.concatenate([np.ones(first, int), -np.ones(second, int)])
    found = bursts(one)
    assert found.null_bursts == pytest.approx((share * np.arange(n + 1)).sum())
    assert (found.bursts, found.length) == (2, n / 2)
    assert found.p == pytest.approx(share[2])


def test_bursts_are_found_and_a_coin_has_none() -> None:
    rng = np.random.default_rng(0)
    coin = [bursts(rng.choice([-1, 1], 200)).p for _ in range(300)]
    assert 0.02 < np.mean(np.array(coin) < 0.05) < 0.08  # as often as 5 % says
    blocks = np.repeat(rng.choice([-1, 1], 40), 5)
    assert bursts(blocks).p < 1e-6
    assert bursts(np.tile([1, -1], 50)).p == pytest.approx(1)


def test_bursts_without_a_null_have_none_and_say_so() -> None:
    assert bursts([1, 1, 1])[:3] == (3, 1, 3.0)
    assert all(math.isnan(x) for x in bursts([1, 1, 1])[3:])
    assert math.isnan(bursts([]).length)
    with pytest.raises(ValueError, match="signs: must be a list of 1 and -1"):
        bursts([1, 0])


# --- clogging ---------------------------------------------------------------------------------------------------------


def power_law(alpha: float, many: int, start: float = 0.7, seed: int = 0) -> np.ndarray:
    return start * (1 - np.random.default_rng(seed).random(many)) ** (-1 / (alpha - 1))


@pytest.mark.parametrize("alpha", [1.6, 2.0, 2.5, 4.0])
def test_the_exponent_of_a_power_law_is_found_with_its_error(alpha: float) -> None:
    """Over 200 samples the mean is right, and the error that is told is the scatter that is seen."""
    fits = [tail(power_law(alpha, 400, seed=k), start=0.7) for k in range(200)]
    found = np.array([fit.alpha for fit in fits])
    # the estimate is too large by (alpha - 1) / n (Clauset, Shalizi, Newman, appendix B)
    assert found.mean() == pytest.approx(alpha + (alpha - 1) / 400, abs=4 * (alpha - 1) / math.sqrt(400 * 200))
    assert found.std() == pytest.approx(fits[0].error, rel=0.2)
    assert fits[0].gaps == 400


def test_the_start_of_the_tail_is_found() -> None:
    """Below 2 s gaps are evenly spread, above it is a power law of 2.5."""
    rng = np.random.default_rng(1)
    gaps = np.concatenate([rng.uniform(0.3, 2.0, 1500), power_law(2.5, 1000, 2.0, 2)])
    fit = tail(gaps)
    assert 1.6 < fit.start < 2.6
    assert abs(fit.alpha - 2.5) < 3 * fit.error
    assert fit.verdict == "flows"
    assert goodness(gaps, fit, samples=30) > 0.1


def test_what_is_no_power_law_is_not_believed_to_be_one() -> None:
    gaps = np.random.default_rng(3).uniform(1.0, 2.0, 600)
    fit = tail(gaps, start=1.0)
    assert goodness(gaps, fit, samples=30) < 0.1


@pytest.mark.parametrize(
    ("alpha", "many", "verdict"),
    [(1.5, 600, "clogs"), (3.0, 600, "flows"), (2.0, 60, "undecided"), (3.0, 9, "no tail")],
)
def test_a_verdict_is_given_where_the_error_allows_it(alpha: float, many: int, verdict: str) -> None:
    assert tail(power_law(alpha, many), start=0.7).verdict == verdict


def test_the_limit_of_clogging_is_where_the_mean_gap_diverges() -> None:
    """alpha of the density: at 2.5 the mean is start (alpha - 1) / (alpha - 2), at 1.5 it grows with the sample."""
    assert power_law(3.5, 200_000).mean() == pytest.approx(0.7 * 2.5 / 1.5, rel=0.02)
    assert power_law(1.5, 200_000).mean() > 20 * power_law(1.5, 200).mean()
    assert tail(power_law(3.5, 20_000), 0.7).flows
    assert not tail(power_law(1.5, 20_000), 0.7).flows


def test_survival_and_gaps_that_are_none() -> None:
    times, share = survival([3, 1, 2, 2])
    assert times.tolist() == [1, 2, 2, 3]
    assert share.tolist() == [1, 0.75, 0.5, 0.25]
    assert tail([]).verdict == "no tail"
    assert tail(np.ones(50)).verdict == "no tail"  # all the same: a power law of any exponent, or none
    assert math.isnan(goodness(np.ones(50), tail(np.ones(50))))
    for bad in ([-1.0], [math.inf], [math.nan]):
        with pytest.raises(ValueError, match="gaps: must be a list of finite times"):
            tail(bad)
    for start in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="must be a finite time above 0"):
            tail(np.arange(1.0, 99.0), start=start)


# --- evacuation -------------------------------------------------------------------------------------------------------


def test_when_everybody_is_out() -> None:
    inside = np.ones((11, 20), bool)
    for k in range(20):
        inside[1 + k // 2 :, k] = False
    inside[3:5, 0] = True  # comes back once
    left = leaving_times(0.5 * np.arange(11), inside)
    assert left[:3] == pytest.approx([2.5, 0.5, 1.0])
    assert evacuation_time(left) == 5.0
    assert evacuation_time(left, 0.95) == 5.0
    assert evacuation_time(left, 0.9) == 4.5
    assert evacuation_time(left, 0.93) == 5.0  # more than 18 of 20 are 19
    inside[:, 19], inside[:, 18] = True, False
    left = leaving_times(0.5 * np.arange(11), inside)
    assert np.isnan(left[[18, 19]]).all()  # never was inside; still is
    assert math.isnan(evacuation_time(left))
    with pytest.raises(ValueError, match="share = 0 of 20"):
        evacuation_time(left, 0)


def test_the_last_crossing_counts_if_it_leads_out() -> None:
    found = Crossings(np.array([1.0, 2, 3, 4, 5]), np.array([0, 1, 0, 0, 2]), np.array([1, 1, -1, 1, -1]))
    assert last_crossing(found, 4) == pytest.approx([4, 2, math.nan, math.nan], nan_ok=True)
