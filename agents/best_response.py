"""Best response: one agent deviates from all others. `python -m agents.best_response configs/training/school.yaml`.

In the comparison all agents of a world play one policy. Here one agent of each world plays one policy, and all others
another. If a policy scores best among agents without it, and all score worse when all have it, selfish learners leave
the better policy: a prisoner's dilemma (evolutionary stability: Maynard Smith and Price 1973, Nature 246, 15).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from agents.compare import split
from agents.experiment import load_experiment, one_line_errors
from agents.play import blame, players_in_order, usual_players
from flockenv.cli.terminal import run_program, show_progress
from flockenv.envs.world import Step, World
from flockenv.evaluation import Episodes, Interval, bootstrap, compare, rollout, worlds_for
from flockenv.model.snapshot import Snapshot
from flockenv.players.policy import Policy
from flockenv.tasks import Task

__all__ = ["Among", "Payoffs", "app", "invade"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)

WORLDS = 256


class Among:
    """Worlds in which the caller acts for one agent of each, (B, 1, O); all other agents play `others`.

    In world k that agent is learner k % L, so every learner counts equally if L divides B, otherwise nearly. Its world
    ends when it is out.
    """

    def __init__(self, task: Task, worlds: int, time_limit: int, others: Policy) -> None:
        self._world, self._others = World(task, worlds, time_limit), others
        seats = np.arange(worlds) % task.learners
        self._mine = np.arange(task.learners) == seats[:, None]  # (B, L)
        self._state: Any = None
        self._begins = True

    def reset(self, seeds: int) -> NDArray[np.float32]:
        """Begin episodes; return the observations of the one agent per world."""
        self._seen, self._begins = self._world.reset(seeds), True
        return self._seen[self._mine][:, None]

    def step(self, actions: NDArray[Any]) -> Step:
        """Step all agents, the one agent by `actions` (B, 1, A); return its observation and reward."""
        rows = self._seen[~self._mine]
        theirs, self._state = self._others.predict(rows, self._state, np.full(len(rows), self._begins), True)
        if np.shape(theirs) != (len(rows), actions.shape[-1]):
            raise ValueError(f"others' actions have shape {np.shape(theirs)}, must be {(len(rows), actions.shape[-1])}")
        joint = np.empty((*self._mine.shape, actions.shape[-1]))
        joint[self._mine], joint[~self._mine] = actions[:, 0], theirs
        step, self._begins = self._world.step(joint), False
        self._seen = step.observation
        names = ("observation", "reward", "terms", "terminated", "alive")
        return step._replace(**{name: getattr(step, name)[self._mine][:, None] for name in names})

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


def invade(
    task: Task,
    players: Mapping[str, Callable[[Task], Policy]],
    worlds: int = WORLDS,
    seed: int = 0,
    advance: Callable[[], None] = lambda: None,
) -> Payoffs:
    """Play every policy with one agent of each world, among others of every policy, in the same evaluation worlds.

    Args:
        task: with at least two learners in a world.
        players: name -> factory of that policy; each rollout has a new one, since a policy may have memory.
        worlds: number of worlds.
        seed: of the first, as in the comparison.
        advance: called after each rollout.

    Raises:
        ValueError: one line: a world has one learner, or a player fails.
    """
    if task.learners < 2:
        raise ValueError(f"task {task.name!r}: each world has a single learner; this command needs at least two")
    first, of = worlds_for("evaluation", seed, worlds), {}
    for others, theirs in players.items():
        for one, mine in players.items():

            def make(task: Task, worlds: int, limit: int, theirs: Callable[[Task], Policy] = theirs) -> Among:
                return Among(task, worlds, limit, theirs(task))

            with blame(f"{one} among {others}", task):
                of[one, others] = rollout(task, mine(task), worlds, first, make_world=make)
            advance()
    return Payoffs(task.name, tuple(players), of)


def table_of(payoffs: Payoffs) -> Table:
    """Return the payoffs: a row per policy of the one agent, a column per policy of all others."""
    table = Table("", *payoffs.players)
    for one in payoffs.players:
        table.add_row(one, *(str(payoffs.mean(one, others)) for others in payoffs.players))
    return table


@app.command()
def main(
    configs: Annotated[list[Path], typer.Argument(help="experiments, such as configs/training/school.yaml")],
    players: Annotated[
        list[str] | None,
        typer.Option(help="players, by comma or repeated [rules, ppo, and others written for the task]"),
    ] = None,
    worlds: Annotated[int, typer.Option(min=2, help="number of evaluation worlds")] = WORLDS,
    seed: Annotated[int, typer.Option(min=0, max=999, help="block of evaluation worlds")] = 0,
    trust_pickle: Annotated[
        bool, typer.Option("--trust-pickle", help="also load Stable-Baselines3 zips, which executes the code in them")
    ] = False,
) -> None:
    """Measure whether one agent gains by a policy other than that of all others in its world."""
    with one_line_errors():
        tasks = [load_experiment(config).build() for config in configs]
        fields = [_policy_makers(task, split(players), seed, trust_pickle) for task in tasks]
        out = Console(highlight=False)
        if not out.is_terminal:
            out = Console(highlight=False, width=200)  # a pipe has no width
        for task, field in zip(tasks, fields, strict=True):
            with show_progress(Progress(console=console, transient=True)) as progress:
                bar = progress.add_task(task.name, total=len(field) ** 2)
                found = invade(task, field, worlds, seed, lambda: progress.advance(bar))  # noqa: B023  # called at once
            out.print(f"{task.name}: mean return of one agent that plays the row, among others that play the column")
            out.print(table_of(found))
            for pair in combinations(found.players, 2):
                out.print(found.verdict(*pair), markup=False)


def _policy_makers(
    task: Task, names: Sequence[str], seed: int, trust_pickle: bool
) -> dict[str, Callable[[Task], Policy]]:
    """Return the factory of each player of a task, by name; bad ones raise before any episode."""
    specs = names or [name for name in usual_players([task]) if name not in ("random", "textbook")]
    makers = {
        player.name: functools.partial(player.policy, seed=seed, trust_pickle=trust_pickle)
        for player in players_in_order(specs)
    }
    for name, make in makers.items():
        for phrase in getattr(make(task), "differences", ()):
            console.print(f"{task.name}: {name}: {phrase}", markup=False)
    return makers


if __name__ == "__main__":
    run_program("best_response", app)
