"""The same worlds for everyone, and what may be said about the scores: intervals, paired differences, who beats whom.

The unit of analysis is the world: the agents of one world share its luck, so a world counts once however many agents it
holds, and its return is the sum over steps of the mean reward of its learners. Players are compared world by world.
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
from flockenv.players.policy import Policy

if TYPE_CHECKING:
    from flockenv.model.snapshot import Snapshot
    from flockenv.tasks import Task

__all__ = [
    "EVALUATION", "TRAINING", "TUNING", "WORLDS_PER_SEED",
    "Comparison", "Episodes", "Interval", "Recording", "Summary",
    "bootstrap", "compare", "iqm", "proportion", "rollout", "summarise", "task_digest", "worlds_for",
]  # fmt: skip

TRAINING, TUNING, EVALUATION = 0, 1_000_000_000, 2_000_000_000
"""Where the seeds of worlds for learning, for tuning hand-written parameters and for the final table begin.

Each block holds 1,000 seeds of a million worlds each and ends where the next begins, so that no player has ever met a
world it is scored on. The seeds people type at an environment (0, 1, 42) lie in the first block."""

WORLDS_PER_SEED, SEEDS = 1_000_000, 1_000
Purpose = Literal["training", "tuning", "evaluation"]
_BLOCKS: Mapping[str, int] = {"training": TRAINING, "tuning": TUNING, "evaluation": EVALUATION}

RESAMPLES = 10_000
"""Bootstrap resamples: the ends of an interval then move by about 1 % of its width from one generator to another."""

DRAWN_AT_ONCE = 4_000_000
"""Numbers of worlds that a bootstrap holds at a time: 32 MB."""

LATENCY_CALLS = 101
"""Single rows asked for to find the median time of one decision."""

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called after every step with (steps done, the most there can be)."""


def worlds_for(purpose: Purpose, seed: int = 0, worlds: int = 1) -> int:
    """Return the seed of the first of `worlds` worlds that nothing else than this purpose and seed uses.

    Raises:
        ValueError: unknown purpose, a seed outside [0, 1000) or more worlds than a seed has.
    """
    if purpose not in _BLOCKS:
        raise ValueError(f"purpose: {purpose!r}, must be one of {', '.join(_BLOCKS)}")
    _whole("seed", seed, 0, SEEDS - 1)
    _whole("worlds", worlds, 1, WORLDS_PER_SEED)
    return _BLOCKS[purpose] + seed * WORLDS_PER_SEED


@dataclass(frozen=True)
class Interval:
    """An estimate and the ends of its 95 % confidence interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


@dataclass(frozen=True, eq=False)
class Recording:
    """One world as it was played: an instant at the start and after each control step, and the return so far."""

    world: int
    snapshots: tuple[Snapshot, ...]
    returns: Floats  # (instants,)


@dataclass(frozen=True, eq=False)
class Episodes:
    """What one policy did in B worlds, one episode in each; arrays are (B,)."""

    task: str
    digest: str
    seed: int  # world k is the world of seed + k
    horizon: int  # control steps
    returns: Floats
    success: NDArray[np.bool_]
    lengths: NDArray[np.int64]  # control steps
    terms: Mapping[str, Floats]  # reward term -> its share of the return
    metrics: Mapping[str, Floats]  # NaN where a metric does not apply (the time to a capture that never came)
    microseconds: float  # per decision, all worlds and learners asked at once, median over steps
    latency: float  # us for one row asked alone, median
    recording: Recording | None = None

    @property
    def worlds(self) -> int:
        """B."""
        return len(self.returns)


class Playable(Protocol):
    """What a rollout asks of a world: flockenv.envs.world.World is one."""

    def reset(self, seeds: int) -> NDArray[np.float32]: ...
    def step(self, actions: NDArray[Any]) -> Step: ...
    def measure(self) -> Mapping[str, Floats]: ...
    def snapshot(self, world: int = 0) -> Snapshot: ...


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
    """Play one episode in each of the worlds seed, seed + 1, ..., all stepped together, every learner by the policy.

    The policy is asked for (worlds * learners, O) rows at once, a world's learners next to each other. Worlds that have
    ended are stepped and asked on with the others, so that a policy may keep a state per row, but no longer count.

    Args:
        task: what is played, for at most `task.horizon` control steps.
        policy: sees observations and nothing else.
        worlds: B.
        seed: of the first world; `worlds_for("evaluation", s, B)` keeps clear of those trained and tuned on.
        record: the index of a world to keep snapshots of.
        deterministic: handed to predict().
        progress: see Progress.
        make_world: (task, worlds, time limit) -> the world to play in.

    Raises:
        ValueError: a bad argument, actions of a wrong shape or not finite, or a reward that is not finite.
    """
    _whole("worlds", worlds, 1, WORLDS_PER_SEED)
    _whole("seed", seed, 0, 2**63 - 1 - worlds)
    if record is not None:
        _whole("record", record, 0, worlds - 1)
    world = make_world(task, worlds, task.horizon)
    observation = world.reset(seed)
    latency = _latency(policy, observation[0, :1], deterministic)  # first: what compiles on first use does so here
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
    """Step all worlds by the policy's actions until the last episode has ended; RuntimeError if one never does."""
    for number in range(1, task.horizon + 1):
        step = world.step(pilot.act(observation, task.action_layout.size))
        running = ledger.enter(step, world.measure)
        film.take(running, ledger.returns)
        observation = step.observation
        if progress is not None:
            progress(number, task.horizon)
        if ledger.closed:
            return
    raise RuntimeError(f"task {task.name!r}: world {int(np.argmax(ledger.running))} goes on after its time limit")


class _staying:  # noqa: N801  # a context manager without the cost of a generator: it is inside the clock
    """Refuse a policy that ends the process."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, SystemExit):
            raise ValueError(f"policy: ends the process, exit({error.code!r}), instead of an action") from None


class _Pilot:
    """Asks the policy for everybody's action, carries its state along and times it: predict() and nothing around it."""

    def __init__(self, policy: Policy, deterministic: bool) -> None:
        self._policy, self._deterministic = policy, deterministic
        self._state: Any = None
        self._times: list[float] = []  # us per row, one entry per call

    def act(self, observation: NDArray[np.float32], action_size: int) -> NDArray[Any]:
        """(B, L, O) -> (B, L, A)."""
        rows = observation.reshape(-1, observation.shape[-1])
        starts = np.full(len(rows), not self._times)
        began = perf_counter()
        with _staying():
            action, self._state = self._policy.predict(rows, self._state, starts, self._deterministic)
        self._times.append(1e6 * (perf_counter() - began) / len(rows))
        action = np.asarray(action)
        if action.shape != (len(rows), action_size):
            raise ValueError(f"policy: actions of shape {action.shape}, must be {(len(rows), action_size)}")
        return action.reshape(*observation.shape[:-1], action_size)

    @property
    def microseconds(self) -> float:
        """Median over calls: what else the machine did in between belongs to nobody's decisions."""
        return float(np.median(self._times))


class _Ledger:
    """Keeps the accounts of every world until its own episode ends."""

    def __init__(self, task: Task, worlds: int) -> None:
        self.returns, self.terms = np.zeros(worlds), np.zeros((worlds, len(task.terms)))
        self.lengths, self.success = np.zeros(worlds, np.int64), np.zeros(worlds, np.bool_)
        self.metrics = {name: np.full(worlds, np.nan) for name in task.metric_names}
        self.running = np.ones(worlds, np.bool_)

    @property
    def closed(self) -> bool:
        return not self.running.any()

    def enter(self, step: Step, measure: Callable[[], Mapping[str, Floats]]) -> NDArray[np.bool_]:
        """Add one step and return which worlds it counted for."""
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
                self.metrics[name][ending] = value[ending]
        self.running = running & ~ending
        return running


@dataclass
class _Film:
    """Takes a snapshot of one world after every step that counts for it."""

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
    """Time one decision for one agent, the case of a single robot: median in us."""
    times = []
    for _ in range(LATENCY_CALLS):
        began = perf_counter()
        with _staying():
            policy.predict(row, None, np.ones(1, np.bool_), deterministic)
        times.append(perf_counter() - began)
    return 1e6 * float(np.median(times))


def task_digest(task: Task) -> str:
    """Return a short fingerprint of a task and all its settings: scores of different fingerprints do not compare."""
    return hashlib.sha256(f"{type(task).__name__} {task.model_dump_json()}".encode()).hexdigest()[:16]


def iqm(values: ArrayLike) -> float:
    """Return the interquartile mean: of what is left without the lowest and the highest quarter.

    Source: Agarwal et al. 2021 (arXiv 2108.13264), who recommend it for returns: outliers do not move it, and it uses
    twice the data that a median does.
    """
    return float(_iqm_rows(np.asarray(values, np.float64)[None])[0])


def _iqm_rows(samples: Floats) -> Floats:
    cut = samples.shape[1] // 4
    # sorted whole: that is vector code, five times as fast as scipy's trim_mean, which only sets the quarters apart
    return np.asarray(np.sort(samples, axis=1)[:, cut : samples.shape[1] - cut].mean(axis=1), np.float64)


def _mean_rows(samples: Floats) -> Floats:
    return np.asarray(samples.mean(axis=1), np.float64)


_STATISTICS: Mapping[str, Callable[[Floats], Floats]] = {"iqm": _iqm_rows, "mean": _mean_rows}


def bootstrap(
    values: ArrayLike, statistic: Literal["iqm", "mean"] = "iqm", resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Return a statistic of one number per world with its 95 % percentile bootstrap interval.

    Percentile and not BCa: the latter has no answer where all worlds score alike. tests/test_evaluation.py measures
    how often the interval holds the truth on a skewed distribution.

    Raises:
        ValueError: fewer than two values, one that is not finite, or no resamples.
    """
    x = np.asarray(values, np.float64)
    if x.ndim != 1 or len(x) < 2 or not np.isfinite(x).all():
        raise ValueError(f"an interval needs at least two worlds and finite scores, not {len(np.atleast_1d(x))} worlds")
    if resamples < 1:
        raise ValueError(f"resamples = {resamples}: an interval needs at least one")
    estimate = _STATISTICS[statistic]
    drawn = np.concatenate([estimate(x[worlds]) for worlds in _resampled(len(x), resamples, seed)])
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Interval(float(estimate(x[None])[0]), float(low), float(high))


def _resampled(worlds: int, resamples: int, seed: int) -> Iterator[NDArray[np.int64]]:
    """Yield which worlds are drawn, some resamples at a time, (n, worlds): the same for whoever asks."""
    some = max(1, DRAWN_AT_ONCE // worlds)
    if resamples <= some:
        yield _drawn(worlds, resamples, seed)
        return
    generator = np.random.default_rng(seed)
    for done in range(0, resamples, some):
        yield generator.integers(worlds, size=(min(some, resamples - done), worlds))


@functools.lru_cache(maxsize=1)  # all players of a task are resampled alike
def _drawn(worlds: int, resamples: int, seed: int) -> NDArray[np.int64]:
    drawn = np.random.default_rng(seed).integers(worlds, size=(resamples, worlds))
    drawn.flags.writeable = False
    return drawn


def proportion(scores: ArrayLike) -> Interval:
    """Return the mean of scores in {0, 1/2, 1} with its 95 % Wilson interval.

    Wilson and not bootstrap: resampling 256 successes out of 256 would claim certainty. Halves (ties) have less
    variance than the formula allows for, so with them the interval is a little too wide, never too narrow.
    Source: Wilson 1927, J. Am. Stat. Assoc. 22, 209.
    """
    x, z = np.asarray(scores, np.float64), NormalDist().inv_cdf(0.975)
    n, p = len(x), float(x.mean())
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return Interval(p, max(0.0, min(p, centre - half)), min(1.0, max(p, centre + half)))


@dataclass(frozen=True)
class Summary:
    """What a table says about one player."""

    iqm: Interval  # bootstrap
    mean: Interval  # bootstrap
    success: Interval  # Wilson
    metrics: Mapping[str, tuple[float, int]]  # mean over the worlds where it applies, and their number


def summarise(episodes: Episodes, resamples: int = RESAMPLES, seed: int = 0) -> Summary:
    """Return the statistics of one player's episodes."""
    return Summary(
        iqm=bootstrap(episodes.returns, "iqm", resamples, seed),
        mean=bootstrap(episodes.returns, "mean", resamples, seed),
        success=proportion(episodes.success),
        metrics={name: _applicable(values) for name, values in episodes.metrics.items()},
    )


def _applicable(values: Floats) -> tuple[float, int]:
    finite = values[np.isfinite(values)]
    return (float(finite.mean()) if len(finite) else math.nan), len(finite)


@dataclass(frozen=True)
class Comparison:
    """The first player against the second in the same worlds; positive and above one half: the first is ahead."""

    difference: Interval  # mean of the per-world differences of return, bootstrap
    iqm_difference: Interval  # interquartile mean of the same differences, bootstrap
    better: Interval  # probability that the first scores higher in a world, ties counted half, Wilson
    worlds: int

    @property
    def separated(self) -> bool:
        """Whether the interval of the difference keeps clear of zero."""
        return self.difference.low > 0 or self.difference.high < 0


def compare(first: Episodes, second: Episodes, resamples: int = RESAMPLES, seed: int = 0) -> Comparison:
    """Compare two players world by world.

    `difference` is the mean: it is the difference of the two mean returns, and a disaster in one world out of five
    weighs in it what it costs; the interquartile mean beside it says what happens in an ordinary world.

    Raises:
        ValueError: the episodes are not of the same worlds: another task, settings, seed, number or time limit.
    """
    for name in ("task", "digest", "seed", "worlds", "horizon"):
        a, b = getattr(first, name), getattr(second, name)
        if a != b:
            raise ValueError(f"scores cannot be paired: {name} {a!r} and {b!r}, must be the same worlds")
    gain = first.returns - second.returns
    return Comparison(
        difference=bootstrap(gain, "mean", resamples, seed),
        iqm_difference=bootstrap(gain, "iqm", resamples, seed),
        better=proportion((np.sign(gain) + 1) / 2),
        worlds=first.worlds,
    )


def _whole(name: str, value: object, least: int, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not least <= value <= most:
        raise ValueError(f"{name}: {value!r}, must be a whole number from {least} to {most}")
