"""One agent of each world, or a share, plays one player, and all others another: worlds, jobs, and payoffs.

If a policy scores best among agents without it, and all score worse when all have it, selfish learners leave the
better policy: a prisoner's dilemma (evolutionary stability: Maynard Smith and Price 1973, Nature 246, 15).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.world import Step
from flockenv.evaluation import Episodes, Interval, bootstrap, compare
from flockenv.jobs import Job, Store, Work, run_jobs
from flockenv.jobs.local_engine import LocalEngine
from flockenv.model.snapshot import Snapshot
from flockenv.players.independent import IndependentPolicy
from flockenv.players.policy import Policy
from flockenv.studies.play_jobs import Player, Worlds, episodes_of_bytes, play_job, player_digest
from flockenv.tasks import Task

__all__ = ["Among", "Payoffs", "invade", "jobs_of", "worlds_among"]


class Among:
    """Worlds in which the caller acts for E agents of each, (B, E, O); all other agents play `others`.

    With E = 1, in world k that agent is learner k % L, so every learner counts equally if L divides B, otherwise
    nearly; more are spread evenly over the learners, from that one on. A world ends when all E are out. Success is that
    of the E agents, see `Task.own_success`, or that of the world, if the task defines it for all agents together.
    """

    def __init__(
        self, task: Task, worlds: int, time_limit: int, others: Policy, egos: int = 1,
        disturbance: Disturbance | None = None,
    ) -> None:  # fmt: skip
        self._world, self._others = make_world(task, worlds, time_limit, disturbance or Disturbance()), others
        seats = (np.arange(worlds)[:, None] + np.arange(egos) * task.learners // egos) % task.learners
        self._mine = (np.arange(task.learners) == seats[:, :, None]).any(axis=1)  # (B, L)
        self._state: Any = None
        self._begins = True

    def reset(self, seeds: int) -> NDArray[np.float32]:
        """Begin episodes; return the observations of the E agents per world."""
        self._seen, self._begins = self._world.reset(seeds), True
        return self._of_mine(self._seen)

    def step(self, actions: NDArray[Any]) -> Step:
        """Step all agents, the E agents by `actions` (B, E, A); return their observations and rewards."""
        rows = self._seen[~self._mine]
        theirs, self._state = self._others.predict(rows, self._state, np.full(len(rows), self._begins), True)
        if np.shape(theirs) != (len(rows), actions.shape[-1]):
            raise ValueError(f"others' actions have shape {np.shape(theirs)}, must be {(len(rows), actions.shape[-1])}")
        joint = np.empty((*self._mine.shape, actions.shape[-1]))
        joint[self._mine], joint[~self._mine] = actions.reshape(-1, actions.shape[-1]), theirs
        step, self._begins = self._world.step(joint), False
        self._seen = step.observation
        task, names = self._world.task, ("observation", "reward", "terms", "terminated", "alive")
        mine = {name: self._of_mine(getattr(step, name)) for name in names}
        own = task.own_success(self._world.state, self._world.memory, step.alive)
        success = step.success if own is None else np.asarray(self._of_mine(own).all(axis=1))
        return step._replace(success=success, **mine)

    def _of_mine(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values (B, L, ...) of the E agents, (B, E, ...)."""
        mine: NDArray[Any] = values[self._mine].reshape(len(values), -1, *values.shape[2:])
        return mine

    def measure(self) -> Mapping[str, NDArray[np.float64]]:
        """Return the metrics of whole worlds."""
        return self._world.measure()

    def snapshot(self, world: int = 0) -> Snapshot:
        """Return one world at this instant, for pictures."""
        return self._world.snapshot(world)


@dataclass(frozen=True)
class Payoffs:
    """Episodes of one agent with each policy among others with each policy: `of[one, others]`."""

    task: str
    players: tuple[str, ...]
    of: Mapping[tuple[str, str], Episodes]
    disturbance: Disturbance | None = None

    def mean(self, one: str, others: str) -> Interval:
        """Return the mean return of an agent that plays `one` among `others`."""
        return bootstrap(self.of[one, others].returns, "mean")

    def gain(self, one: str, others: str) -> Interval:
        """Return the gain of one agent by playing `one` among `others`, over playing `others`, in the same worlds."""
        return compare(self.of[one, others], self.of[others, others]).difference

    def verdict(self, a: str, b: str) -> str:
        """Return a line: the gain of one agent that changes its policy, and the gain if all agents change it."""
        a, b = sorted((a, b), key=lambda name: self.mean(name, name).value)
        into, back = self.gain(a, b), self.gain(b, a)
        together = compare(self.of[a, a], self.of[b, b]).difference
        gains = (
            f"{a} among {b}: {_signed_text(into)} for one agent; {b} among {a}: {_signed_text(back)}; "
            f"all {a}: {_signed_text(together)}"
        )
        if into.low > 0 and back.high < 0 and together.high < 0:
            return f"{gains}: a prisoner's dilemma, each agent does better with {a} and all together with {b}"
        if into.high < 0 and back.low > 0:
            return f"{gains}: {b} is the better answer to both"
        if into.high < 0 and back.high < 0:
            return f"{gains}: either is best among its own kind"
        if into.low > 0 and back.low > 0:
            return f"{gains}: either does better among the other kind"
        if into.low > 0 and back.high < 0:
            return f"{gains}: {a} is the better answer to both"
        return f"{gains}: not decided in these worlds"


def _signed_text(interval: Interval) -> str:
    return f"{interval.value:+.2f} [{interval.low:+.2f}, {interval.high:+.2f}]"


def jobs_of(
    task: Task, players: Sequence[Player], worlds: int, seed: int = 0, trust_pickle: bool = False,
    disturbance: Disturbance | None = None,
) -> dict[tuple[str, str], Job]:  # fmt: skip
    """Return the jobs by the names of the one agent's player and of the others', all in the same evaluation worlds.

    disturbance: of the worlds, the same for all agents (default: none).

    Raises:
        ValueError: one line: a world has one learner, or a player cannot be loaded, or has a network for each learner.
    """
    if task.learners < 2:
        raise ValueError(f"task {task.name!r}: each world has a single learner; this command needs at least two")
    for player in players:
        if isinstance(player.policy(task, seed, trust_pickle), IndependentPolicy):
            raise ValueError(f"player {player.name!r}: has a network for each learner, which play together only")
    found = {}
    for others in players:
        within = worlds_among(task, others, seed, trust_pickle, disturbance=disturbance)
        for one in players:
            found[one.name, others.name] = play_job(
                f"best_response/among-{others.name}", task, one, worlds, seed, None, trust_pickle, disturbance,
                within=within,
            )  # fmt: skip
    return found


def worlds_among(
    task: Task, others: Player, seed: int, trust_pickle: bool = False, egos: int = 1,
    disturbance: Disturbance | None = None,
) -> Worlds:  # fmt: skip
    """Return the worlds of a job in which `egos` agents of each play the job's player, and all others `others`.

    Raises:
        ValueError: one line: the others' player cannot be loaded.
    """
    digest = player_digest(others, task, seed)
    make = functools.partial(
        _among, others=others, seed=seed, trust_pickle=trust_pickle, digest=digest, egos=egos, disturbance=disturbance
    )
    return Worlds(make, {"others": digest, **({"egos": egos} if egos > 1 else {})})


def _among(
    task: Task, worlds: int, time_limit: int, others: Player, seed: int, trust_pickle: bool, digest: str, egos: int,
    disturbance: Disturbance | None,
) -> Among:  # fmt: skip
    """Return worlds whose other agents play `others`, if it has this digest; ValueError if not."""
    if player_digest(others, task, seed) != digest:
        raise ValueError(f"player {others.spec!r} has changed since the command began, or differs on this machine")
    return Among(task, worlds, time_limit, others.policy(task, seed, trust_pickle), egos, disturbance)


def invade(
    task: Task, players: Sequence[Player], worlds: int, seed: int = 0, trust_pickle: bool = False,
    work: Work | None = None, disturbance: Disturbance | None = None,
) -> Payoffs:  # fmt: skip
    """Play every player with one agent of each world, among others of every player, in the same evaluation worlds.

    work: where and how to run the jobs (default: one after another in this process, and nothing is stored).
    disturbance: of the worlds (default: none).

    Raises:
        ValueError: one line: a world has one learner, or a player fails.
    """
    if work is None:
        with TemporaryDirectory(prefix="flockenv-jobs-") as folder:
            work = Work(Store(Path(folder)), LocalEngine(1))
            return invade(task, players, worlds, seed, trust_pickle, work, disturbance)
    jobs = jobs_of(task, players, worlds, seed, trust_pickle, disturbance)
    run_jobs(list(jobs.values()), work)
    episodes = {pair: work.store.read(job, episodes_of_bytes) for pair, job in jobs.items()}
    names = tuple(player.name for player in players)
    return Payoffs(task.name, names, episodes, disturbance)
