"""Flow, gaps, bursts, clogging and evacuation in cases with known results."""

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
"""A line drawn upward: an agent that moves along +x crosses it forward."""


def column(many: int, gap: float, speed: float, instants: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and positions of agents in single file, `gap` m apart, the first at x = -0.3 m."""
    time = dt * np.arange(instants)
    x = -0.3 - gap * np.arange(many) + speed * time[:, None]
    return time, np.stack([x, np.zeros_like(x)], axis=-1)


# --- flow -------------------------------------------------------------------------------------------------------------


def test_the_crossings_of_agents_in_single_file() -> None:
    """At 1.2 m/s, 0.9 m apart: one each 0.75 s, the first at 0.25 s. Instants each 0.4 s, so times are interpolated."""
    time, pos = column(10, 0.9, 1.2, 26, 0.4)
    found = crossings(time, pos, UP)
    assert found.time == pytest.approx(0.25 + 0.75 * np.arange(10), abs=1e-12)
    assert found.agent.tolist() == list(range(10))
    assert (found.sign == 1).all()
    assert time_gaps(found) == pytest.approx(np.full(9, 0.75), abs=1e-12)
    assert flow(found, 2.0, 10.0) == pytest.approx((10, 0, 1.0, 0.5, 1 / 0.75))
    assert cumulative(found)[1].tolist() == list(range(1, 11))


def test_signs_of_crossings_change_with_the_direction_of_agents_or_of_the_line() -> None:
    time, pos = column(4, 0.9, 1.2, 26, 0.4)
    assert crossings(time, -pos, UP).sign.tolist() == [-1] * 4
    assert crossings(time, pos, UP[::-1]).sign.tolist() == [-1] * 4
    found = crossings(time, np.concatenate([pos, -pos[:, :3]], axis=1), UP)
    assert flow(found, 1.0, 10.0)[:3] == pytest.approx((4, 3, 0.1))
    assert len(time_gaps(found, -1)) == 2


def test_an_agent_that_stops_on_the_line_crosses_it_once_and_one_beside_it_never() -> None:
    """Agent 0 passes beside its end, 1 stops on the line and goes on, 2 goes back, 3 is 2 from the right."""
    x = np.array([[-1, -1, -1, 1], [0, 0, 0, 0], [1, 1, -1, -1]], float)
    y = np.array([[1.5, 0, 0, 0]] * 3, float)
    found = crossings([0, 1, 2], np.stack([x, y], axis=-1), UP)
    assert dict(zip(found.agent.tolist(), found.sign.tolist(), strict=True)) == {1: 1, 3: -1}


def thousandths(count: int) -> float:
    """Return thousandths; for numbers as close as 1e-241 rounding would decide on which side of a mark they are."""
    return count / 1000


@given(
    ends=st.lists(st.integers(-990, 990).map(thousandths), min_size=1, max_size=6, unique=True),
    heights=st.lists(st.integers(-1000, 999).map(thousandths), min_size=1, max_size=20),
)
def test_each_crossing_of_a_line_in_pieces_is_counted_for_one_piece(ends: list[float], heights: list[float]) -> None:
    pos = np.array([[(-1.0, y) for y in heights], [(2.0, y) for y in heights]])
    marks = [-1.0, *sorted(ends), 1.0]
    many = sum(len(crossings([0, 1], pos, ((0, a), (0, b))).time) for a, b in itertools.pairwise(marks))
    assert many == len(heights)


def test_crossings_on_a_torus_use_the_shortest_path_over_the_seam() -> None:
    """9.8 -> 0.1 on a torus of 10 m is a step of 0.3 m over x = 0, which is also x = 10."""
    pos = np.array([[[9.8, 1.0]], [[0.1, 1.0]]])
    for x in (0.0, 10.0):
        found = crossings([0, 1], pos, ((x, 0.0), (x, 2.0)), period=(10.0, 5.0))
        assert found.time == pytest.approx([2 / 3])
        assert found.sign.tolist() == [1]
    assert not len(crossings([0, 1], pos, ((5.0, 0.0), (5.0, 2.0)), period=(10.0, 5.0)).time)
    assert len(crossings([0, 1], pos, ((5.0, 0.0), (5.0, 2.0))).time) == 1  # in a plane it walked 9.7 m back


def test_dead_and_replaced_agents_do_not_cross() -> None:
    time, pos = column(3, 0.9, 1.2, 26, 0.4)
    alive, number = np.ones((26, 3), bool), np.zeros((26, 3), int)
    alive[3:, 1] = False  # agent 1 would pass at 1 s, but is dead at the instant after, 1.2 s
    number[4:, 2] = 7  # agent 2 would pass at 1.75 s, between instants 4 and 5: another agent by then
    number[5:, 2] = 8
    found = crossings(time, pos, UP, alive, number)
    assert found.agent.tolist() == [0]
    assert crossings(time, pos, UP, None, number).agent.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"line": ((0, 0), (0, 0))}, "line = "),
        ({"line": ((0, 0), (0, math.nan))}, "line = "),
        ({"time": [0, 0]}, "time: must grow"),
        ({"time": [0, 1, 2]}, "pos: of shape"),
        ({"pos": np.zeros((2, 3, 3))}, "pos: of shape"),
    ],
)
def test_an_invalid_line_or_run_is_refused_in_one_line(change: dict[str, object], message: str) -> None:
    given_: dict[str, object] = {"time": [0, 1], "pos": np.zeros((2, 3, 2)), "line": UP, **change}
    with pytest.raises(ValueError, match=message) as caught:
        crossings(**given_)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="width = 0"):
        flow(Crossings(np.zeros(0), np.zeros(0, int), np.zeros(0, int)), 0.0, 1.0)


# --- bursts -----------------------------------------------------------------------------------------------------------


def test_runs_are_the_lengths_of_equal_signs() -> None:
    assert runs([1, 1, -1, 1]).tolist() == [2, 1, 1]
    assert runs([]).tolist() == []
    assert runs([-1]).tolist() == [1]


@pytest.mark.parametrize(("first", "second"), [(1, 1), (3, 5), (4, 4), (1, 6)])
def test_the_null_distribution_of_bursts_is_that_of_all_orders(first: int, second: int) -> None:
    """Distribution and mean of the number of runs, from the formula and from all orders."""
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


def test_bursts_are_found_in_blocks_and_not_in_coin_tosses() -> None:
    rng = np.random.default_rng(0)
    coin = [bursts(rng.choice([-1, 1], 200)).p for _ in range(300)]
    assert 0.02 < np.mean(np.array(coin) < 0.05) < 0.08  # about 5 % of the coins
    blocks = np.repeat(rng.choice([-1, 1], 40), 5)
    assert bursts(blocks).p < 1e-6
    assert bursts(np.tile([1, -1], 50)).p == pytest.approx(1)


def test_bursts_without_a_null_distribution_are_nan() -> None:
    assert bursts([1, 1, 1])[:3] == (3, 1, 3.0)
    assert all(math.isnan(x) for x in bursts([1, 1, 1])[3:])
    assert math.isnan(bursts([]).length)
    with pytest.raises(ValueError, match="signs: must be a list of 1 and -1"):
        bursts([1, 0])


# --- clogging ---------------------------------------------------------------------------------------------------------


def power_law(alpha: float, many: int, start: float = 0.7, seed: int = 0) -> np.ndarray:
    return start * (1 - np.random.default_rng(seed).random(many)) ** (-1 / (alpha - 1))


@pytest.mark.parametrize("alpha", [1.6, 2.0, 2.5, 4.0])
def test_the_exponent_of_a_power_law_and_its_error_are_found(alpha: float) -> None:
    """Over 200 samples the mean is right, and the reported error equals the scatter."""
    fits = [tail(power_law(alpha, 400, seed=k), start=0.7) for k in range(200)]
    found = np.array([fit.alpha for fit in fits])
    # the estimate is too large by (alpha - 1) / n (Clauset, Shalizi, Newman, appendix B)
    assert found.mean() == pytest.approx(alpha + (alpha - 1) / 400, abs=4 * (alpha - 1) / math.sqrt(400 * 200))
    assert found.std() == pytest.approx(fits[0].error, rel=0.2)
    assert fits[0].gaps == 400


def test_the_start_of_the_tail_is_found() -> None:
    """Below 2 s gaps are uniform, above they follow a power law of exponent 2.5."""
    rng = np.random.default_rng(1)
    gaps = np.concatenate([rng.uniform(0.3, 2.0, 1500), power_law(2.5, 1000, 2.0, 2)])
    fit = tail(gaps)
    assert 1.6 < fit.start < 2.6
    assert abs(fit.alpha - 2.5) < 3 * fit.error
    assert fit.verdict == "flows"
    assert goodness(gaps, fit, samples=30) > 0.1


def test_uniform_gaps_do_not_pass_the_test_for_a_power_law() -> None:
    gaps = np.random.default_rng(3).uniform(1.0, 2.0, 600)
    fit = tail(gaps, start=1.0)
    assert goodness(gaps, fit, samples=30) < 0.1


@pytest.mark.parametrize(
    ("alpha", "many", "verdict"),
    [(1.5, 600, "clogs"), (3.0, 600, "flows"), (2.0, 60, "undecided"), (3.0, 9, "no tail")],
)
def test_the_verdict_on_clogging_is_undecided_if_the_error_is_large(alpha: float, many: int, verdict: str) -> None:
    assert tail(power_law(alpha, many), start=0.7).verdict == verdict


def test_gaps_clog_if_their_mean_diverges() -> None:
    """For alpha = 3.5 the mean is start (alpha - 1) / (alpha - 2), for 1.5 it grows with the sample."""
    assert power_law(3.5, 200_000).mean() == pytest.approx(0.7 * 2.5 / 1.5, rel=0.02)
    assert power_law(1.5, 200_000).mean() > 20 * power_law(1.5, 200).mean()
    assert tail(power_law(3.5, 20_000), 0.7).flows
    assert not tail(power_law(1.5, 20_000), 0.7).flows


def test_survival_of_gaps_and_invalid_gaps() -> None:
    times, share = survival([3, 1, 2, 2])
    assert times.tolist() == [1, 2, 2, 3]
    assert share.tolist() == [1, 0.75, 0.5, 0.25]
    assert tail([]).verdict == "no tail"
    assert tail(np.ones(50)).verdict == "no tail"  # equal gaps determine no exponent
    assert math.isnan(goodness(np.ones(50), tail(np.ones(50))))
    for bad in ([-1.0], [math.inf], [math.nan]):
        with pytest.raises(ValueError, match="gaps: must be a list of finite times"):
            tail(bad)
    for start in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="must be a finite time above 0"):
            tail(np.arange(1.0, 99.0), start=start)


# --- evacuation -------------------------------------------------------------------------------------------------------


def test_the_evacuation_time_is_when_the_last_agent_or_a_share_has_left() -> None:
    inside = np.ones((11, 20), bool)
    for k in range(20):
        inside[1 + k // 2 :, k] = False
    inside[3:5, 0] = True  # comes back once
    left = leaving_times(0.5 * np.arange(11), inside)
    assert left[:3] == pytest.approx([2.5, 0.5, 1.0])
    assert evacuation_time(left) == 5.0
    assert evacuation_time(left, 0.95) == 5.0
    assert evacuation_time(left, 0.9) == 4.5
    assert evacuation_time(left, 0.93) == 5.0  # 93 % of 20 agents are rounded up to 19
    inside[:, 19], inside[:, 18] = True, False
    left = leaving_times(0.5 * np.arange(11), inside)
    assert np.isnan(left[[18, 19]]).all()  # agent 18 was never inside, agent 19 still is
    assert math.isnan(evacuation_time(left))
    with pytest.raises(ValueError, match="share = 0 of 20"):
        evacuation_time(left, 0)


def test_the_last_crossing_counts_if_it_leads_out() -> None:
    found = Crossings(np.array([1.0, 2, 3, 4, 5]), np.array([0, 1, 0, 0, 2]), np.array([1, 1, -1, 1, -1]))
    assert last_crossing(found, 4) == pytest.approx([4, 2, math.nan, math.nan], nan_ok=True)
