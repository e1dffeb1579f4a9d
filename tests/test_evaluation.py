"""Evaluation: rollouts with known scores, statistics against closed forms and scipy, independence of worlds."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel
from scipy import stats

from flockenv.evaluation import (
    EVALUATION,
    TRAINING,
    TUNING,
    WORLDS_PER_SEED,
    Episodes,
    bootstrap,
    compare,
    iqm,
    proportion,
    rollout,
    summarise,
    task_digest,
    worlds_for,
)
from flockenv.evaluation import (
    episodes as module,
)
from flockenv.evaluation.seeds import better_interval
from flockenv.players.policy import RandomPolicy
from flockenv.tasks import TASKS


class Toy(BaseModel):
    """World of seed s ends after 2 + s % 3 steps. Learner l gets (l + 1) * its action, and s in the first step."""

    name: str = "toy"
    horizon: int = 4
    learners: int = 2
    terms: tuple[str, ...] = ("effort", "gift")
    metric_names: tuple[str, ...] = ("finish",)
    note: str = ""

    @property
    def action_layout(self) -> Any:
        return SimpleNamespace(size=1)


@dataclass
class ToyStep:
    observation: Any
    reward: Any
    terms: Any
    success: Any
    ended: Any


class ToyWorld:
    """Steps Toy; a world that has ended returns wrong numbers, so that a rollout that still counts it fails."""

    def __init__(self, task: Toy, worlds: int, time_limit: int) -> None:
        self.task, self.worlds, self.time_limit = task, worlds, time_limit
        self.received: list[np.ndarray] = []

    def reset(self, seeds: int) -> Any:
        self.seeds, self.steps = seeds + np.arange(self.worlds), 0
        return self.observe()

    def observe(self) -> Any:
        column = np.broadcast_to(self.seeds[:, None], (self.worlds, self.task.learners))
        return np.stack([column, np.full_like(column, self.steps)], axis=-1).astype(np.float32)

    def step(self, actions: Any) -> Any:
        self.received.append(actions.copy())
        self.steps += 1
        over = self.steps > 2 + self.seeds % 3
        effort = actions[..., 0] * np.arange(1, self.task.learners + 1)
        gift = np.where(self.steps == 1, self.seeds, 0)[:, None] * np.ones(self.task.learners)
        wrong = np.where(self.seeds % 2 == 0, np.nan, 1e6)[:, None, None]
        terms = np.where(over[:, None, None], wrong, np.stack([effort, gift], axis=-1))
        ended = self.steps >= np.minimum(2 + self.seeds % 3, self.time_limit)
        return ToyStep(self.observe(), terms.sum(axis=-1), terms, (self.seeds % 2 == 0) ^ over, ended)

    def measure(self) -> Any:
        finish = np.where(self.seeds % 2 == 0, 10.0 * self.steps, np.nan)
        return {"finish": np.where(self.steps > 2 + self.seeds % 3, -1.0, finish)}

    def snapshot(self, world: int = 0) -> Any:
        return (world, self.steps)


class Constant:
    """A policy that always returns `value` and keeps the arguments of its calls."""

    def __init__(self, value: float = 0.5) -> None:
        self.value = value
        self.calls: list[tuple[Any, ...]] = []

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: Any = False
    ) -> Any:
        self.calls.append((observation.copy(), state, episode_start.copy(), deterministic))
        return np.full((len(observation), 1), self.value, np.float32), ((state or (0,))[0] + 1,)


def play(worlds: int = 6, seed: int = 10, value: float = 0.5, task: Any = None, **more: Any) -> Episodes:
    return rollout(task or Toy(), Constant(value), worlds, seed, make_world=ToyWorld, **more)  # type: ignore[arg-type]


# --- rollout


def test_returns_lengths_success_terms_and_metrics_have_the_computed_values() -> None:
    episodes = play(worlds=6, seed=10)
    seeds = np.arange(10, 16)
    lengths = 2 + seeds % 3
    effort = 0.5 * 1.5 * lengths  # the mean over learners of 0.5 * (1, 2), per step
    np.testing.assert_array_equal(episodes.lengths, lengths)
    np.testing.assert_allclose(episodes.returns, seeds + effort)
    np.testing.assert_allclose(episodes.terms["effort"], effort)
    np.testing.assert_allclose(episodes.terms["gift"], seeds)
    np.testing.assert_array_equal(episodes.success, seeds % 2 == 0)
    np.testing.assert_array_equal(episodes.metrics["finish"], np.where(seeds % 2 == 0, 10.0 * lengths, np.nan))
    assert (episodes.task, episodes.seed, episodes.horizon, episodes.worlds) == ("toy", 10, 4, 6)


def test_a_world_ends_at_the_horizon_of_the_task() -> None:
    np.testing.assert_array_equal(play(seed=0, task=Toy(horizon=3)).lengths, [2, 3, 3, 2, 3, 3])


def test_a_policy_is_passed_all_rows_its_own_state_and_episode_starts() -> None:
    policy = Constant()
    rollout(Toy(), policy, 6, 10, make_world=ToyWorld, deterministic=False)  # type: ignore[arg-type]
    calls = policy.calls[module.LATENCY_CALLS :]
    assert len(calls) == 4
    for k, (rows, state, starts, deterministic) in enumerate(calls):
        assert rows.shape == (12, 2)
        assert rows.dtype == np.float32
        np.testing.assert_array_equal(rows[:, 0], np.repeat(np.arange(10, 16), 2))  # a world's learners side by side
        np.testing.assert_array_equal(rows[:, 1], k)  # observed after the last step, not before it
        assert state == (None if k == 0 else (k,))
        assert starts.shape == (12,)
        assert (starts == (k == 0)).all()
        assert deterministic is False


def test_rows_of_ended_worlds_are_left_out_if_each_row_stands_alone() -> None:
    class Alone(Constant):
        each_row_alone = True

        def predict(self, observation: Any, *rest: Any) -> Any:
            super().predict(observation, *rest)
            return observation[:, :1] / 20.0, None

    policy, everywhere = Alone(), Alone()
    everywhere.each_row_alone = False
    found, whole = (rollout(Toy(), each, 6, 10, make_world=ToyWorld) for each in (policy, everywhere))  # type: ignore[arg-type]
    np.testing.assert_array_equal(found.returns, whole.returns)
    np.testing.assert_array_equal(found.lengths, whole.lengths)
    for k, (rows, _, starts, _) in enumerate(policy.calls[module.LATENCY_CALLS :]):
        running = [seed for seed in range(10, 16) if k < 2 + seed % 3]
        np.testing.assert_array_equal(rows[:, 0], np.repeat(running, 2))
        assert len(starts) == len(rows)
    assert all(len(call[0]) == 12 for call in everywhere.calls[module.LATENCY_CALLS :])


def test_actions_reach_their_learners_in_order() -> None:
    worlds: list[ToyWorld] = []

    def make(*arguments: Any) -> ToyWorld:
        worlds.append(ToyWorld(*arguments))
        return worlds[0]

    class Echo(Constant):
        def predict(self, observation: Any, *rest: Any) -> Any:
            return np.arange(len(observation), dtype=np.float32)[:, None], None

    rollout(Toy(learners=3), Echo(), 2, 0, make_world=make)  # type: ignore[arg-type]
    np.testing.assert_array_equal(worlds[0].received[0][..., 0], [[0, 1, 2], [3, 4, 5]])


def test_a_world_is_recorded_from_its_start_to_its_own_end() -> None:
    episodes = play(worlds=6, seed=10, record=2)  # seed 12: two steps
    recording = episodes.recording
    assert recording is not None
    assert recording.world == 2
    assert recording.snapshots == ((2, 0), (2, 1), (2, 2))
    np.testing.assert_allclose(recording.returns, [0, 12.75, 13.5])
    assert play().recording is None


def test_progress_is_reported_after_every_step() -> None:
    reported: list[tuple[int, int]] = []
    play(progress=lambda done, most: reported.append((done, most)))
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_only_the_time_inside_predict_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(module, "perf_counter", lambda: now[0])

    class Slow(Constant):
        def predict(self, observation: Any, *rest: Any) -> Any:
            now[0] += 3e-6 if len(observation) == 1 else 24e-6
            now[0] += 1.0 if len(self.calls) in (7, module.LATENCY_CALLS + 1) else 0.0  # an interruption of the process
            return super().predict(observation, *rest)

    class SlowWorld(ToyWorld):
        def step(self, actions: Any) -> Any:
            now[0] += 1.0
            return super().step(actions)

    episodes = rollout(Toy(), Slow(), 6, 10, make_world=SlowWorld)  # type: ignore[arg-type]
    assert episodes.microseconds == pytest.approx(24 / 12)
    assert episodes.latency == pytest.approx(3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"worlds": 0}, "worlds: 0, must be an integer from 1 to 1000000"),
        ({"worlds": 10**9}, "worlds: 1000000000, must"),
        ({"worlds": 2.5}, "worlds: 2.5, must"),
        ({"worlds": True}, "worlds: True, must"),
        ({"seed": -1}, "seed: -1, must"),
        ({"seed": "1"}, "seed: '1', must"),
        ({"record": 6}, "record: 6, must be an integer from 0 to 5"),
        ({"record": -1}, "record: -1, must"),
    ],
)
def test_invalid_arguments_are_refused_before_a_world_is_created(change: dict[str, Any], message: str) -> None:
    def make(*_: Any) -> Any:
        raise AssertionError("a world was created")

    with pytest.raises(ValueError, match=message):
        rollout(Toy(), Constant(), **{"worlds": 6, "seed": 0, **change}, make_world=make)  # type: ignore[arg-type]


def test_actions_of_a_wrong_shape_are_refused() -> None:
    class Wide(Constant):
        def predict(self, observation: Any, *rest: Any) -> Any:
            return np.zeros((len(observation), 2)), None

    with pytest.raises(ValueError, match=r"policy: actions of shape \(4, 2\), must be \(4, 1\)"):
        rollout(Toy(), Wide(), 2, 0, make_world=ToyWorld)  # type: ignore[arg-type]


def test_an_infinite_reward_is_refused_and_its_world_named() -> None:
    class Broken(ToyWorld):
        def step(self, actions: Any) -> Any:
            step = super().step(actions)
            step.reward[3, 1] = np.inf
            return step

    with pytest.raises(ValueError, match="world 3: its reward is inf"):
        rollout(Toy(), Constant(), 6, 10, make_world=Broken)  # type: ignore[arg-type]


def test_a_world_that_continues_after_its_time_limit_raises_an_error() -> None:
    class Endless(ToyWorld):
        def step(self, actions: Any) -> Any:
            step = super().step(actions)
            step.ended[1] = False
            step.reward[:], step.terms[:] = 0, 0
            return step

    with pytest.raises(RuntimeError, match="world 1 continues after its time limit"):
        rollout(Toy(), Constant(), 3, 0, make_world=Endless)  # type: ignore[arg-type]


# --- seeds


def test_blocks_of_seeds_do_not_overlap() -> None:
    spans = []
    for purpose in ("training", "tuning", "evaluation"):
        for seed in (0, 1, 999):
            first = worlds_for(purpose, seed, WORLDS_PER_SEED)  # type: ignore[arg-type]
            spans.append((first, first + WORLDS_PER_SEED))
    assert sorted(spans) == spans
    assert all(end <= start for (_, end), (start, _) in pairwise(spans))
    assert (worlds_for("training"), worlds_for("tuning"), worlds_for("evaluation")) == (TRAINING, TUNING, EVALUATION)
    assert spans[-1][1] < 2**32  # the limit of numpy's legacy seeding, which SB3 uses


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("testing", 0, 1), "purpose: 'testing', must be one of training, tuning, evaluation"),
        (("training", 1000, 1), "seed: 1000, must be an integer from 0 to 999"),
        (("training", -1, 1), "seed: -1"),
        (("training", 0, 1_000_001), "worlds: 1000001"),
    ],
)
def test_seeds_outside_their_block_are_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        worlds_for(*arguments)


# --- statistics


def test_iqm_is_the_mean_of_the_middle_half() -> None:
    assert iqm([1, 2, 3, 4, 5, 6, 7, 1000]) == pytest.approx((3 + 4 + 5 + 6) / 4)
    x = np.random.default_rng(0).normal(size=257)
    assert iqm(x) == pytest.approx(np.sort(x)[64:193].mean())


@pytest.mark.parametrize("name", ["iqm", "mean"])
def test_bootstrap_agrees_with_that_of_scipy(name: Any) -> None:
    x = np.random.default_rng(1).exponential(size=200)
    statistic = {"iqm": lambda v, axis: stats.trim_mean(v, 0.25, axis=axis), "mean": np.mean}[name]
    theirs = stats.bootstrap((x,), statistic, n_resamples=20_000, method="percentile", rng=np.random.default_rng(5))
    ours = bootstrap(x, name, resamples=20_000)
    width = ours.high - ours.low
    assert ours.value == pytest.approx(statistic(x, axis=0))
    assert ours.low == pytest.approx(theirs.confidence_interval.low, abs=0.03 * width)
    assert ours.high == pytest.approx(theirs.confidence_interval.high, abs=0.03 * width)


def test_bootstrap_is_reproducible_and_depends_on_its_seed() -> None:
    x = np.random.default_rng(2).normal(size=50)
    assert bootstrap(x) == bootstrap(x)
    assert bootstrap(x, seed=1) != bootstrap(x)
    with pytest.raises(ValueError, match="resamples = 0"):
        bootstrap(x, resamples=0)


def test_bootstrap_in_chunks_has_the_expected_width() -> None:
    x = np.random.default_rng(3).normal(size=30_000)  # 133 resamples to a chunk
    interval = bootstrap(x, "mean", resamples=400)
    assert (interval.high - interval.low) == pytest.approx(2 * 1.96 / math.sqrt(30_000), rel=0.15)


def test_intervals_contain_the_true_value_at_the_nominal_rate() -> None:
    """Exponential scores, 128 worlds: the IQM of the distribution is 1 + 1.5 ln(4/3) - 0.5 ln 4."""
    truth = {"iqm": 1 + 1.5 * math.log(4 / 3) - 0.5 * math.log(4), "mean": 1.0}
    rng, tries = np.random.default_rng(4), 400
    held = dict.fromkeys(truth, 0)
    for k in range(tries):
        x = rng.exponential(size=128)
        for name, value in truth.items():
            interval = bootstrap(x, name, resamples=400, seed=k)  # type: ignore[arg-type]
            held[name] += interval.low <= value <= interval.high
    # Percentile intervals cover slightly less than 0.95 at 128 worlds; two standard errors of 400 tries are 0.022.
    assert 0.915 <= held["iqm"] / tries <= 0.975
    assert 0.915 <= held["mean"] / tries <= 0.975


def test_equal_scores_have_an_interval_without_width_or_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert bootstrap([2.5] * 10) == module.Interval(2.5, 2.5, 2.5)


@pytest.mark.parametrize("values", [[], [1.0], [1.0, np.nan], [1.0, np.inf], [[1.0, 2.0]]])
def test_scores_without_an_interval_are_refused(values: Any) -> None:
    with pytest.raises(ValueError, match="at least two worlds and finite scores"):
        bootstrap(values)


@pytest.mark.parametrize(("wins", "worlds"), [(0, 10), (3, 10), (10, 10), (128, 256), (256, 256), (1, 1)])
def test_proportion_returns_wilsons_interval(wins: int, worlds: int) -> None:
    ours = proportion(np.arange(worlds) < wins)
    theirs = stats.binomtest(wins, worlds).proportion_ci(method="wilson")
    assert (ours.low, ours.value, ours.high) == pytest.approx((theirs.low, wins / worlds, theirs.high), abs=1e-12)
    assert 0 <= ours.low <= ours.value <= ours.high <= 1


def test_a_summary_averages_metrics_over_worlds_that_have_them() -> None:
    summary = summarise(play(worlds=6, seed=10), resamples=100)
    assert summary.metrics == {"finish": (pytest.approx((30 + 20 + 40) / 3), 3)}  # seeds 10, 12, 14
    assert summary.success == proportion([1, 0, 1, 0, 1, 0])
    never = summarise(play(worlds=2, seed=11), resamples=100).metrics["finish"]
    np.testing.assert_equal(
        summarise(replace(play(), metrics={"a": np.array([np.nan])}), 10).metrics, {"a": (np.nan, 0)}
    )
    assert never == (20.0, 1)


# --- pairs


def test_players_are_compared_world_by_world() -> None:
    weak, strong = play(value=0.2), play(value=0.6)
    pair = compare(strong, weak, resamples=500)
    gains = 0.4 * 1.5 * weak.lengths  # the scores of the worlds themselves (10 to 15) cancel
    assert pair.difference.value == pytest.approx(gains.mean())
    assert pair.difference.low >= gains.min() - 1e-6
    assert pair.difference.high <= gains.max() + 1e-6
    assert pair.better == proportion([1] * 6)
    assert pair.separated
    assert pair.worlds == 6
    back = compare(weak, strong, resamples=500)
    assert back.difference.value == pytest.approx(-pair.difference.value)
    assert back.better.value == 0
    assert back.separated


def test_ties_count_half_and_equal_players_are_not_separated() -> None:
    pair = compare(play(), play(), resamples=100)
    assert pair.better.value == 0.5
    assert pair.difference.value == 0
    assert not pair.separated


def test_rare_low_scores_count_in_the_difference() -> None:
    one = play(worlds=20)
    gain = np.full(20, 1.0)
    gain[:4] = -100
    other = replace(one, returns=one.returns + gain)
    assert compare(other, one, resamples=500).difference.value == pytest.approx((16 - 400) / 20)


def test_every_seed_of_one_player_is_compared_with_every_seed_of_the_other() -> None:
    base = play(worlds=20)
    one, two = ([replace(base, returns=base.returns + gain) for gain in gains] for gains in ([1.0, 3.0], [0.0, 2.0]))
    pair = compare(one, two, resamples=500)
    assert pair.difference.value == pytest.approx(1.0)
    assert pair.better.value == pytest.approx(0.75)  # 1 > 0, 1 < 2, 3 > 0, 3 > 2
    assert 0 <= pair.better.low < 0.75 < pair.better.high <= 1
    assert not pair.separated, "two seeds say little"
    summary = summarise(one, resamples=500)
    assert summary.mean.value == pytest.approx(base.returns.mean() + 2.0)
    assert summary.metrics["finish"][1] == 2 * summarise(base, resamples=100).metrics["finish"][1]


def test_the_share_of_won_worlds_of_many_seeds_has_the_width_of_their_luck() -> None:
    """Each seed is ahead in all worlds or in none, with probability 0.6: the interval is that of 40 trials."""
    rng = np.random.default_rng(1)
    first = np.where(rng.random(40) < 0.6, 1.0, -1.0)[:, None] + np.zeros(50)
    interval = better_interval(first, np.zeros((1, 50)), 4000)
    value = (first[:, 0] > 0).mean()
    assert interval.value == pytest.approx(value)
    half = stats.t.ppf(0.975, 39) * math.sqrt(value * (1 - value) / 39)
    assert (interval.high - interval.low) / 2 == pytest.approx(half, rel=0.1)


def test_probability_of_improvement_is_that_of_correlated_normals() -> None:
    rng, n, rho, ahead = np.random.default_rng(6), 100_000, 0.8, 0.3
    luck = rng.normal(size=(3, n))
    base = play(worlds=n, task=Toy(learners=1))
    first = replace(base, returns=ahead + math.sqrt(rho) * luck[0] + math.sqrt(1 - rho) * luck[1])
    second = replace(base, returns=math.sqrt(rho) * luck[0] + math.sqrt(1 - rho) * luck[2])
    pair = compare(first, second, resamples=50)
    expected = stats.norm.cdf(ahead / math.sqrt(2 * (1 - rho)))
    assert pair.better.value == pytest.approx(expected, abs=4 * 0.5 / math.sqrt(n))
    assert pair.difference.value == pytest.approx(ahead, abs=4 * math.sqrt(2 * (1 - rho) / n))
    assert pair.better.high - pair.better.low == pytest.approx(2 * 1.96 * math.sqrt(0.2 / n), rel=0.1)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"task": Toy(name="game")}, "task 'toy' and 'game'"),
        ({"task": Toy(note="windy")}, "digest '"),
        ({"seed": 11}, "seed 10 and 11"),
        ({"worlds": 5}, "worlds 6 and 5"),
    ],
)
def test_scores_of_other_tasks_seeds_or_worlds_cannot_be_paired(other: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"scores cannot be paired: {message}"):
        compare(play(), play(**other))


def test_scores_of_another_time_limit_cannot_be_paired() -> None:
    with pytest.raises(ValueError, match="horizon 4 and 3"):
        compare(play(), replace(play(), horizon=3))


def test_the_digest_of_a_task_depends_on_its_class_and_settings() -> None:
    class Other(Toy):
        pass

    assert task_digest(Toy()) == task_digest(Toy())  # type: ignore[arg-type]
    digests = {task_digest(task) for task in (Toy(), Toy(note="x"), Toy(horizon=5), Other())}  # type: ignore[arg-type]
    assert len(digests) == 4


# --- the real worlds


class Forward:
    """A policy of full force along the first axis; it has no state, so worlds cannot influence each other."""

    def predict(self, observation: Any, state: Any = None, *_: Any) -> Any:
        return np.broadcast_to(np.float32([1, 0]), (len(observation), 2)), state


@pytest.mark.parametrize("name", TASKS)
def test_scores_of_a_world_do_not_depend_on_its_batch(name: str) -> None:
    task, first = TASKS[name](horizon=40), worlds_for("evaluation", 3, 4)
    together = rollout(task, Forward(), 4, first)  # type: ignore[arg-type]
    for k in range(4):
        alone = rollout(task, Forward(), 1, first + k)  # type: ignore[arg-type]
        assert alone.returns[0] == together.returns[k]
        assert alone.lengths[0] == together.lengths[k]
        for key, values in together.metrics.items():
            np.testing.assert_array_equal(values[k], alone.metrics[key][0])
    np.testing.assert_allclose(sum(together.terms.values()), together.returns, rtol=1e-9, atol=1e-9)
    assert set(together.metrics) == set(task.metric_names)


@pytest.mark.parametrize("name", TASKS)
def test_every_player_starts_in_the_same_world(name: str) -> None:
    task = TASKS[name](horizon=20)
    players: list[Any] = [Forward(), RandomPolicy(task.action_layout.size, 0)]
    films = [rollout(task, player, 3, 77, record=1).recording for player in players]
    assert films[0] is not None
    assert films[1] is not None
    a, b = films[0].snapshots, films[1].snapshots
    np.testing.assert_array_equal(a[0].pos, b[0].pos)
    np.testing.assert_array_equal(a[0].obstacle_centre, b[0].obstacle_centre)
    assert not np.array_equal(a[-1].pos, b[-1].pos)
    assert len(a) == len(films[0].returns) <= 21
    assert np.all(np.diff([shot.time for shot in a]) > 0)
