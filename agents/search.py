"""Search of a hand-written player's parameters by CMA-ES (Hansen 2016, arXiv:1604.00772), from the package `cmaes`.

A search has the agent-steps that PPO has in the same config, in worlds of the same disturbance (`ppo.disturbance`). It
begins at the textbook's parameters. Each generation is a list of jobs, one for each candidate; all of its candidates
play the same tuning worlds, so that differences between them are not the luck of worlds, and the next generation plays
other worlds, so that no candidate fits a few of them.

As in training, the current mean of the distribution plays other tuning worlds at regular intervals, the same ones each
time: that is the search's curve. In the end a few of these means, the last one and the textbook's parameters play a
larger set of worlds, the same for all search seeds, and the best of them is the result.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from agents.experiment import Experiment
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.world import bytes_per_world, first_step
from flockenv.evaluation import rollout, worlds_for
from flockenv.jobs import Job, Work, records, run_jobs
from flockenv.players.rules import PLAYERS, RulesPlayer, as_dict
from flockenv.players.rules.parameter import is_logarithmic, ranges_of
from flockenv.studies.play_jobs import PLAYING
from flockenv.tasks import Task

__all__ = ["Coordinates", "Found", "Play", "Search", "median_of", "play_job", "search"]

Parameters = dict[str, float]

DIGITS = 5
"""Significant digits of a parameter: what is played is what is written."""

AT_BOUND = 0.01
"""Share of a parameter's range: a best value nearer to an end than this is reported."""

THOUSAND = 1000
"""Agent-steps in a unit of the progress bar."""

FINALISTS = 3
"""Points of the curve that play the larger set of worlds, besides the last mean and the textbook's parameters."""


@dataclass(frozen=True)
class Coordinates:
    """Parameters as points of the unit cube: each is normalised by its range, (low, high)."""

    ranges: Mapping[str, tuple[float, float]]

    def point(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the point (P,) of parameters; values outside their range are moved to its end."""
        shares = [self._share(values[name], *ends) for name, ends in self.ranges.items()]
        point: NDArray[np.float64] = np.clip(np.array(shares), 0.0, 1.0)
        return point

    def values(self, point: NDArray[np.float64]) -> Parameters:
        """Return the parameters of a point (P,), rounded to DIGITS."""
        pairs = zip(self.ranges.items(), point, strict=True)
        return {name: self._value(float(share), *ends) for (name, ends), share in pairs}

    def at_bounds(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the ends of ranges at which parameters lie, by name."""
        found = {}
        for name, (low, high) in self.ranges.items():
            share = self._share(values[name], low, high)
            if 0.0 <= share <= AT_BOUND or 1.0 - AT_BOUND <= share <= 1.0:
                found[name] = low if share < 0.5 else high
        return found

    @staticmethod
    def _share(value: float, low: float, high: float) -> float:
        if is_logarithmic(low, high):
            return float(np.log(max(value, low) / low) / np.log(high / low))
        return (value - low) / (high - low)

    @staticmethod
    def _value(share: float, low: float, high: float) -> float:
        value = low * (high / low) ** share if is_logarithmic(low, high) else low + share * (high - low)
        return min(max(float(f"{value:.{DIGITS}g}"), low), high)


@dataclass(frozen=True)
class Play:
    """Result of parameters on tuning worlds: mean return, success rate, agent-steps, and seconds of one process."""

    mean: float
    success: float
    steps: int
    seconds: float


def play_job(task: Task, name: str, values: Parameters, worlds: int, first: int, disturbance: Disturbance) -> Job:
    """Return the job that plays the worlds first, first + 1, ... with parameters; its record is read by `_play_of`."""
    about = [type(task).__name__, task.model_dump(mode="json"), values, worlds, first]
    about += [disturbance.model_dump(mode="json")] if disturbance else []
    title, memory = f"tune/{task.name}/{name}/{worlds}-worlds", PLAYING + worlds * bytes_per_world(task)
    arguments = task, name, values, worlds, first, disturbance
    return Job(title, _play, arguments, about, memory, (first_step, (task,)))


def _play(task: Task, name: str, values: Parameters, worlds: int, first: int, disturbance: Disturbance) -> bytes:
    """Play the worlds; return the result as bytes.

    The mean return is used, as in the paired differences of the comparison: a failure in one world of ten must count.
    """
    began, make = perf_counter(), functools.partial(make_world, disturbance=disturbance)
    policy = RulesPlayer(task, PLAYERS[name][task.name][1](**values), name)
    episodes = rollout(task, policy, worlds, first, make_world=make)
    mean, success = float(np.mean(episodes.returns)), float(np.mean(episodes.success))
    return records.to_bytes(Play(mean, success, int(episodes.lengths.sum()) * task.learners, perf_counter() - began))


def _play_of(data: bytes) -> Play:
    play: Play = records.from_bytes(data, (Play,))
    return play


@dataclass(frozen=True)
class Found:
    """Outcome of a search: the best parameters, their result on the common tuning worlds, and how they were found."""

    task: str
    player: str
    seed: int
    parameters: Parameters
    tuning_mean: float
    tuning_success: float
    textbook_mean: float
    textbook_success: float
    tuning_worlds: int
    agent_steps: int  # of all generations
    evaluation_steps: int  # of the curve and of the final choice, which are not part of the budget
    seconds: float  # of playing on one process, the curve included
    generations: int
    candidates: int  # of each generation
    worlds: int  # of each candidate
    at_bounds: dict[str, float]
    curve: list[dict[str, float]]  # steps, seconds, mean and success of the current mean, best mean so far


@dataclass
class Search:
    """A search of one seed: its distribution, the agent-steps spent so far, and its curve."""

    experiment: Experiment
    player: str
    seed: int
    steps: int = 0
    seconds: float = 0.0
    evaluation_steps: int = 0
    generation: int = 0
    curve: list[dict[str, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin the distribution at the textbook's parameters."""
        s, p = self.experiment.search, self.experiment.ppo
        self.task, self.disturbance = self.experiment.build(), p.disturbance
        kind = PLAYERS[self.player][self.task.name][1]
        self.textbook, self.coordinates = as_dict(kind()), Coordinates(ranges_of(kind))
        self.budget, self.settings = s.steps or p.steps, s
        self.every, self.evaluate_worlds = p.evaluate_every, p.evaluate_worlds
        start = self.coordinates.point(self.textbook)
        bounds = np.tile([0.0, 1.0], (len(start), 1))
        self.cma = _import_cmaes().CMA(start, s.sigma, bounds, seed=self.seed, population_size=s.candidates)
        self.means: list[Parameters] = []
        self._asked: list[NDArray[np.float64]] = []

    @property
    def done(self) -> bool:
        """True if the budget is spent, or the distribution has shrunk to a point."""
        return self.steps >= self.budget or self.cma.should_stop()

    @property
    def mean(self) -> Parameters:
        """The parameters at the mean of the distribution."""
        return self.coordinates.values(self.cma.mean)

    def ask(self) -> list[Job]:
        """Return the jobs of a generation, and before them that of a point of the curve if one is due."""
        self._asked = [self.cma.ask() for _ in range(self.cma.population_size)]
        first, worlds = self._first_world(), self.settings.worlds
        plays = [(self.coordinates.values(point), worlds, first) for point in self._asked]
        if self._point_is_due():
            plays.insert(0, (self.mean if self.curve else self.textbook, self.evaluate_worlds, common_worlds()))
        return [play_job(self.task, self.player, *play, self.disturbance) for play in plays]

    def tell(self, plays: Sequence[Play]) -> None:
        """Receive the results of the jobs of `ask`, and update the distribution."""
        if self._point_is_due():
            self._add_point(plays[0])
            plays = plays[1:]
        self.steps += sum(play.steps for play in plays)
        self.seconds += sum(play.seconds for play in plays)
        self.cma.tell([(point, -play.mean) for point, play in zip(self._asked, plays, strict=True)])
        self.generation += 1

    def ask_last(self) -> list[Job]:
        """Return the job of the last point of the curve, and those of the final choice: the textbook's are the first.

        The candidates of the choice are the best points of the curve, except its first one, which is the textbook.
        """
        best = sorted(range(1, len(self.curve)), key=lambda k: -self.curve[k]["mean"])[:FINALISTS]
        finalists = [self.textbook, self.mean, *(self.means[k] for k in best)]
        self.finalists = [values for k, values in enumerate(finalists) if values not in finalists[:k]]
        plays = [(self.mean, self.evaluate_worlds, common_worlds())]
        fresh = common_worlds() + self.evaluate_worlds  # not those by which the finalists were chosen
        plays += [(values, self.settings.final_worlds, fresh) for values in self.finalists]
        return [play_job(self.task, self.player, *play, self.disturbance) for play in plays]

    def tell_last(self, plays: Sequence[Play]) -> Found:
        """Receive the results of the jobs of `ask_last`; return the best of the finalists, the textbook's included."""
        self._add_point(plays[0])
        finals = plays[1:]
        self.evaluation_steps += sum(play.steps for play in finals)
        best = max(range(len(finals)), key=lambda k: finals[k].mean)
        values, play = self.finalists[best], finals[best]
        return Found(
            self.task.name, self.player, self.seed, values, play.mean, play.success, finals[0].mean, finals[0].success,
            self.settings.final_worlds, self.steps, self.evaluation_steps, round(self.seconds, 1), self.generation,
            self.cma.population_size, self.settings.worlds, self.coordinates.at_bounds(values), self.curve,
        )  # fmt: skip

    def _point_is_due(self) -> bool:
        return self.steps >= len(self.curve) * self.every

    def _add_point(self, play: Play) -> None:
        self.means.append(self.mean if self.curve else self.textbook)
        self.evaluation_steps += play.steps
        self.seconds += play.seconds
        best = max([play.mean, *(point["mean"] for point in self.curve)])
        self.curve.append({
            "steps": self.steps, "seconds": round(self.seconds, 1), "mean": play.mean, "success": play.success,
            "best": best,
        })  # fmt: skip

    def _first_world(self) -> int:
        """Return the first world of this generation: after the common ones, in the block of the search's seed."""
        s = self.settings
        after = self.evaluate_worlds + s.final_worlds + self.generation * s.worlds
        return worlds_for("tuning", self.seed, after + s.worlds) + after


def _import_cmaes() -> Any:
    """Return the module cmaes; raise ValueError, in one line, if it is not installed."""
    try:
        import cmaes
    except ImportError as error:
        raise ValueError(f"the search: {error}; install the extra: pip install 'flockenv[train]'") from None
    return cmaes


def common_worlds() -> int:
    """Return the first of the tuning worlds on which searches of all seeds are judged."""
    return worlds_for("tuning", 0)


def search(experiment: Experiment, player: str, seeds: Sequence[int], work: Work) -> list[Found]:
    """Return the outcome of the search of each seed.

    The generations of all seeds are played side by side. work: stores and runs the jobs; a search that was interrupted
    reads the stored ones. Its progress is that of all agent-steps, in thousands.
    """
    searches = [Search(experiment, player, seed) for seed in seeds]
    total = sum(each.budget for each in searches) // THOUSAND
    quiet = replace(work, progress=lambda done, most, name: None)
    with work.engine.keep():
        while going := [each for each in searches if not each.done]:
            for each, plays in zip(going, _play_all([each.ask() for each in going], quiet), strict=True):
                each.tell(plays)
            best = max(each.curve[-1]["best"] for each in searches)
            work.progress(sum(each.steps for each in searches) // THOUSAND, total, f"{player}: best mean {best:.3f}")
        results = _play_all([each.ask_last() for each in searches], quiet)
    return [each.tell_last(plays) for each, plays in zip(searches, results, strict=True)]


def _play_all(lists: Sequence[Sequence[Job]], work: Work) -> list[list[Play]]:
    """Run several lists of jobs at once; return their results."""
    run_jobs([job for jobs in lists for job in jobs], work)
    return [[work.store.read(job, _play_of) for job in jobs] for jobs in lists]


class Scored(Protocol):
    """A run with a score on tuning worlds."""

    @property
    def tuning_mean(self) -> float: ...


Run = TypeVar("Run", bound=Scored)


def median_of(runs: Sequence[Run]) -> Run:
    """Return the run with the median score on tuning worlds; the lower one of two in the middle."""
    return sorted(runs, key=lambda each: each.tuning_mean)[(len(runs) - 1) // 2]
