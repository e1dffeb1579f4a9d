"""Evaluation of players in the same worlds: rollouts, confidence intervals and paired comparisons.

The unit of analysis is the world: the agents of one world share its random draws, so a world counts once for any number
of agents, and its return is the sum over steps of the mean reward of its learners. Players are compared world by world.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from statistics import NormalDist
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.envs.world import Step, World
from flockenv.players.independent import IndependentPolicy
from flockenv.players.policy import Policy

if TYPE_CHECKING:
    from flockenv.model.snapshot import Snapshot
    from flockenv.tasks import Task

__all__ = [
    "EVALUATION", "TRAINING", "TUNING", "WORLDS_PER_SEED",
    "Episodes", "Interval", "Playable", "Recording",
    "bootstrap", "iqm", "proportion", "rollout", "task_digest", "worlds_for",
]  # fmt: skip

TRAINING, TUNING, EVALUATION = 0, 1_000_000_000, 2_000_000_000
"""First world seeds of the blocks for learning, for tuning hand-written parameters and for the final evaluation.

Each block has 1,000 seeds of a million worlds each and ends where the next begins, so that players are evaluated on
held-out worlds. Seeds that are usual for an environment (0, 1, 42) are in the first block."""

WORLDS_PER_SEED, SEEDS = 1_000_000, 1_000
"""Worlds of each seed, and seeds of each block."""

Purpose = Literal["training", "tuning", "evaluation"]
"""What worlds are for; each has its own block of seeds."""

_BLOCKS: Mapping[str, int] = {"training": TRAINING, "tuning": TUNING, "evaluation": EVALUATION}

RESAMPLES = 10_000
"""Bootstrap resamples: with this number the ends of an interval vary by about 1 % of its width between generators."""

DRAWN_AT_ONCE = 4_000_000
"""World indices that a bootstrap draws at a time: 32 MB."""

LATENCY_CALLS = 101
"""Number of calls with a single row, whose median time is the latency of a decision."""

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called after every step with (steps done, largest possible number of steps)."""


def worlds_for(purpose: Purpose, seed: int = 0, worlds: int = 1) -> int:
    """Return the seed of the first of `worlds` worlds that are reserved for this purpose and seed.

    Raises:
        ValueError: unknown purpose, a seed outside [0, 1000), or more than a million worlds.
    """
    if purpose not in _BLOCKS:
        raise ValueError(f"purpose: {purpose!r}, must be one of {', '.join(_BLOCKS)}")
    _check_integer("seed", seed, 0, SEEDS - 1)
    _check_integer("worlds", worlds, 1, WORLDS_PER_SEED)
    return _BLOCKS[purpose] + seed * WORLDS_PER_SEED


@dataclass(frozen=True)
class Interval:
    """An estimate and the ends of its 95 % confidence interval."""

    value: float  # the estimate
    low: float  # lower end
    high: float  # upper end

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


@dataclass(frozen=True, eq=False)
class Recording:
    """Recording of one world: a snapshot at the start and after each control step, and the return until then."""

    world: int
    snapshots: tuple[Snapshot, ...]  # one per instant
    returns: Floats  # (instants,)


@dataclass(frozen=True, eq=False)
class Episodes:
    """Results of one policy in B worlds, one episode in each; arrays are (B,)."""

    task: str  # its name
    digest: str  # of the task's arguments, see `task_digest`
    seed: int  # world k is the world of seed + k
    horizon: int  # control steps
    returns: Floats  # sums of rewards
    success: NDArray[np.bool_]  # True for worlds in which the task was done
    lengths: NDArray[np.int64]  # control steps
    terms: Mapping[str, Floats]  # reward term -> its share of the return
    metrics: Mapping[str, Floats]  # NaN if a metric does not apply (such as the time to a capture that did not happen)
    microseconds: float  # per decision, for at least half of the worlds at once, median over steps
    latency: float  # us for a call with a single row, median
    recording: Recording | None = None  # of one world, if it was asked for

    @property
    def worlds(self) -> int:
        """Number of worlds, B."""
        return len(self.returns)


class Playable(Protocol):
    """Interface of a world in a rollout, which flockenv.envs.world.World implements; it may measure further metrics."""

    def reset(self, seeds: int) -> NDArray[np.float32]:
        """Begin episodes of the worlds seeds, seeds + 1, ...; return observations (B, L, O)."""

    def step(self, actions: NDArray[Any]) -> Step:
        """Take one decision in each world by actions (B, L, A)."""

    def measure(self) -> Mapping[str, Floats]:
        """Return metrics of the episodes so far, each (B,), by name."""

    def snapshot(self, world: int = 0) -> Snapshot:
        """Return one world at this instant."""


def rollout(
    task: Task,
    policy: Policy,
    worlds: int,
    seed: int,
    record: int | None = None,
    *,
    deterministic: bool = True,
    progress: Progress | None = None,
    make_world: Callable[[Task, int, int], Playable] = World,
) -> Episodes:
    """Play one episode in each of the worlds seed, seed + 1, ..., stepped together; the policy controls every learner.

    The policy receives (worlds * learners, O) rows at once, with the learners of a world next to each other. Worlds
    that have ended are still stepped and passed to it, so that a policy may keep a state per row, but no longer count.
    A policy with a true attribute `each_row_alone` does not receive their rows.

    Args:
        task: the task to play, for at most `task.horizon` control steps.
        policy: receives only observations, unless it has a method `watch`, which is called with the world.
        worlds: B.
        seed: of the first world; `worlds_for("evaluation", s, B)` avoids the worlds for training and tuning.
        record: index of a world to record snapshots of; None: no recording.
        deterministic: passed to predict().
        progress: see Progress.
        make_world: (task, worlds, time limit) -> the world to play in.

    Raises:
        ValueError: a bad argument, actions of a wrong shape or not finite, or a reward that is not finite.
    """
    _check_integer("worlds", worlds, 1, WORLDS_PER_SEED)
    _check_integer("seed", seed, 0, 2**63 - 1 - worlds)
    if record is not None:
        _check_integer("record", record, 0, worlds - 1)
    world = make_world(task, worlds, task.horizon)
    observation = world.reset(seed)
    if hasattr(policy, "watch"):
        policy.watch(world)
    latency = _latency(policy, observation[0, :1], deterministic)  # first: this compiles what is compiled on first use
    pilot, ledger = _Pilot(policy, deterministic), _Ledger(task, worlds)
    film = _Film(world, record)
    _play(task, world, observation, pilot, ledger, film, progress)
    return Episodes(
        task=task.name,
        digest=task_digest(task),
        seed=seed,
        horizon=task.horizon,
        returns=ledger.returns,
        success=ledger.success,
        lengths=ledger.lengths,
        terms=dict(zip(task.terms, ledger.terms.T.copy(), strict=True)),
        metrics=ledger.metrics,
        microseconds=pilot.microseconds,
        latency=latency,
        recording=film.recording,
    )


def _play(
    task: Task, world: Playable, observation: NDArray[np.float32], pilot: _Pilot, ledger: _Ledger, film: _Film,
    progress: Progress | None,
) -> None:  # fmt: skip
    """Step all worlds with the policy's actions until the last episode has ended; RuntimeError if one does not end."""
    for number in range(1, task.horizon + 1):
        step = world.step(pilot.act(observation, task.action_layout.size, ledger.running))
        running = ledger.enter(step, world.measure)
        film.take(running, ledger.returns)
        observation = step.observation
        if progress is not None:
            progress(number, task.horizon)
        if ledger.is_complete:
            return
    raise RuntimeError(f"task {task.name!r}: world {int(np.argmax(ledger.running))} continues after its time limit")


class _exit_as_error:  # noqa: N801  # a class, not a generator, which would cost time inside the timed call
    """Context manager that turns a policy's SystemExit into a ValueError."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, SystemExit):
            raise ValueError(f"policy: calls exit({error.code!r}) instead of returning an action") from None


class _Pilot:
    """Calls the policy for all learners, keeps its state between calls, and times predict() alone."""

    def __init__(self, policy: Policy, deterministic: bool) -> None:
        self._policy, self._deterministic = policy, deterministic
        self._each_row_alone = bool(getattr(policy, "each_row_alone", False))
        self._state: Any = None
        self._times: list[float] = []  # us per row, one entry per call

    def act(self, observation: NDArray[np.float32], action_size: int, running: NDArray[np.bool_]) -> NDArray[Any]:
        """Return the actions (B, L, A) for observations (B, L, O); zeros for worlds that are left out."""
        chosen = running if self._each_row_alone else slice(None)
        rows = observation[chosen].reshape(-1, observation.shape[-1])
        starts = np.full(len(rows), not self._times)
        start = perf_counter()
        with _exit_as_error():
            action, self._state = self._policy.predict(rows, self._state, starts, self._deterministic)
        took = perf_counter() - start
        if 2 * rows.size >= observation.size:  # fewer rows take longer, each
            self._times.append(1e6 * took / len(rows))
        action = np.asarray(action)
        if action.shape != (len(rows), action_size):
            raise ValueError(f"policy: actions of shape {action.shape}, must be {(len(rows), action_size)}")
        actions = np.zeros((*observation.shape[:-1], action_size), action.dtype)
        actions[chosen] = action.reshape(-1, *actions.shape[1:])
        return actions

    @property
    def microseconds(self) -> float:
        """Median time over calls, us per row, which is robust to other load on the machine."""
        return float(np.median(self._times))


class _Ledger:
    """Accumulates returns, lengths and metrics of each world until its episode ends."""

    def __init__(self, task: Task, worlds: int) -> None:
        self.returns, self.terms = np.zeros(worlds), np.zeros((worlds, len(task.terms)))
        self.lengths, self.success = np.zeros(worlds, np.int64), np.zeros(worlds, np.bool_)
        self.metrics = {name: np.full(worlds, np.nan) for name in task.metric_names}
        self.running = np.ones(worlds, np.bool_)

    @property
    def is_complete(self) -> bool:
        return not self.running.any()

    def enter(self, step: Step, measure: Callable[[], Mapping[str, Floats]]) -> NDArray[np.bool_]:
        """Add one step; return the mask (B,) of the worlds whose episode had not ended before it."""
        running, reward = self.running, step.reward.mean(axis=1)
        wrong = running & ~np.isfinite(reward)
        if wrong.any():
            raise ValueError(f"world {int(np.argmax(wrong))}: its reward is {reward[np.argmax(wrong)]}, must be finite")
        self.returns[running] += reward[running]
        self.terms[running] += step.terms.mean(axis=1)[running]
        self.lengths[running] += 1
        ending = running & step.ended
        if ending.any():
            self.success[ending] = step.success[ending]
            for name, value in measure().items():
                self.metrics.setdefault(name, np.full(len(ending), np.nan))[ending] = value[ending]
        self.running = running & ~ending
        return running


@dataclass
class _Film:
    """Records a snapshot of one world after each step of its episode."""

    world: Playable
    record: int | None
    snapshots: list[Snapshot] = field(default_factory=list)
    returns: list[float] = field(default_factory=lambda: [0.0])

    def __post_init__(self) -> None:
        if self.record is not None:
            self.snapshots.append(self.world.snapshot(self.record))

    def take(self, running: NDArray[np.bool_], returns: Floats) -> None:
        if self.record is not None and running[self.record]:
            self.snapshots.append(self.world.snapshot(self.record))
            self.returns.append(float(returns[self.record]))

    @property
    def recording(self) -> Recording | None:
        if self.record is None:
            return None
        return Recording(self.record, tuple(self.snapshots), np.array(self.returns))


def _latency(policy: Policy, row: NDArray[np.float32], deterministic: bool) -> float:
    """Return the median time of a decision for one agent, as on a single robot, in us; by its own network if it has."""
    if isinstance(policy, IndependentPolicy):
        policy = policy.networks[0]
    times = []
    for _ in range(LATENCY_CALLS):
        start = perf_counter()
        with _exit_as_error():
            policy.predict(row, None, np.ones(1, np.bool_), deterministic)
        times.append(perf_counter() - start)
    return 1e6 * float(np.median(times))


def task_digest(task: Task) -> str:
    """Return a short digest of a task and all its settings: scores with different digests cannot be compared."""
    return hashlib.sha256(f"{type(task).__name__} {task.model_dump_json()}".encode()).hexdigest()[:16]


def iqm(values: ArrayLike) -> float:
    """Return the interquartile mean: the mean without the lowest and the highest quarter of the values.

    Agarwal et al. 2021 (arXiv 2108.13264) recommend it for returns: it is robust to outliers, and uses more of the data
    than a median.
    """
    return float(_iqm_rows(np.asarray(values, np.float64)[None])[0])


def _iqm_rows(samples: Floats) -> Floats:
    cut = samples.shape[1] // 4
    # a full sort is vector code, five times as fast as scipy's trim_mean, which only partitions
    return np.asarray(np.sort(samples, axis=1)[:, cut : samples.shape[1] - cut].mean(axis=1), np.float64)


def _mean_rows(samples: Floats) -> Floats:
    return np.asarray(samples.mean(axis=1), np.float64)


_STATISTICS: Mapping[str, Callable[[Floats], Floats]] = {"iqm": _iqm_rows, "mean": _mean_rows}


def bootstrap(
    values: ArrayLike, statistic: Literal["iqm", "mean"] = "iqm", resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Return a statistic of one number per world with its 95 % percentile bootstrap interval.

    values: (W,), of W worlds; statistic: iqm, the interquartile mean, or mean; resamples: number of bootstrap samples;
    seed: of their random numbers.

    Percentile and not BCa: the latter is undefined if all worlds have the same score. tests/test_evaluation.py measures
    the coverage of the interval on a skewed distribution.

    Raises:
        ValueError: fewer than two values, a value that is not finite, or no resamples.
    """
    x = np.asarray(values, np.float64)
    if x.ndim != 1 or len(x) < 2 or not np.isfinite(x).all():
        raise ValueError(f"an interval needs at least two worlds and finite scores, not {len(np.atleast_1d(x))} worlds")
    if resamples < 1:
        raise ValueError(f"resamples = {resamples}: an interval needs at least one")
    estimate = _STATISTICS[statistic]
    drawn = np.concatenate([estimate(x[worlds]) for worlds in _resample(len(x), resamples, seed)])
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Interval(float(estimate(x[None])[0]), float(low), float(high))


def _resample(worlds: int, resamples: int, seed: int) -> Iterator[NDArray[np.int64]]:
    """Yield the indices of the worlds drawn, (n, worlds), n resamples at a time; they depend only on the arguments."""
    at_once = max(1, DRAWN_AT_ONCE // worlds)
    if resamples <= at_once:
        yield _draw_worlds(worlds, resamples, seed)
        return
    generator = np.random.default_rng(seed)
    for done in range(0, resamples, at_once):
        yield generator.integers(worlds, size=(min(at_once, resamples - done), worlds))


@functools.lru_cache(maxsize=1)  # all players of a task use the same resamples
def _draw_worlds(worlds: int, resamples: int, seed: int) -> NDArray[np.int64]:
    drawn = np.random.default_rng(seed).integers(worlds, size=(resamples, worlds))
    drawn.flags.writeable = False
    return drawn


def proportion(scores: ArrayLike) -> Interval:
    """Return the mean of scores in {0, 1/2, 1} with its 95 % Wilson interval.

    Wilson and not bootstrap: the bootstrap interval of 256 successes in 256 trials has width 0. Halves (ties) have less
    variance than the formula assumes, so with them the interval is a little too wide, never too narrow.
    Source: Wilson 1927, J. Am. Stat. Assoc. 22, 209.
    """
    x, z = np.asarray(scores, np.float64), NormalDist().inv_cdf(0.975)
    n, p = len(x), float(x.mean())
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return Interval(p, max(0.0, min(p, centre - half)), min(1.0, max(p, centre + half)))


def _check_integer(name: str, value: object, least: int, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not least <= value <= most:
        raise ValueError(f"{name}: {value!r}, must be an integer from {least} to {most}")
