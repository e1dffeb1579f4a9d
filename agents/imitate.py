"""Teach a network to answer as the hand-written player does: `python -m agents.imitate configs/school.yaml`.

Where a trained policy loses to rules, this tells two reasons apart. The network is PPO's, of the same size, fed with
the same rows; it is shown what the tuned rules answer in training worlds, and then plays the tuning worlds alone. If it
scores as they do, it can represent them and the search for them failed; if not, look at what it is shown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress

from agents.experiment import Experiment, load_experiment, one_line_errors
from agents.ppo import build, on_threads, score, tensors_of
from agents.reynolds import Reynolds, player
from flockenv.evaluation import rollout, worlds_for
from flockenv.tasks import Task
from flockenv.world import World

__all__ = ["Imitation", "app", "imitate"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)

MINIBATCH, RATE = 2048, 2e-3


@dataclass(frozen=True)
class Imitation:
    """Mean returns of rules, and of the network that was taught by them, on the same tuning worlds."""

    rules: float
    network: float
    rows: int  # shown
    missed: float  # mean square of its answers' errors, over the variance of the rules' answers


def shown(task: Task, rules: Reynolds, worlds: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what rules saw in one episode of each of so many training worlds, (rows, size), and what they answered."""
    world, state = World(task, worlds, task.horizon), None
    seen = world.reset(worlds_for("training", 0, worlds))
    playing, first = np.ones((worlds, task.learners), np.bool_), True
    rows, answers = [], []
    while playing.any():
        given = seen.reshape(-1, task.layout.size)
        actions, state = rules.predict(given, state, np.full(len(given), first))
        rows.append(given[playing.ravel()])
        answers.append(np.asarray(actions, np.float32)[playing.ravel()])
        step = world.step(actions.reshape(worlds, task.learners, -1))
        seen, first = step.observation, False
        playing &= ~(step.terminated | step.truncated[:, None])
    return torch.from_numpy(np.concatenate(rows)), torch.from_numpy(np.concatenate(answers))


def imitate(
    experiment: Experiment, worlds: int = 96, updates: int = 6000, advance: Callable[[int], None] = lambda n: None
) -> Imitation:
    """Teach PPO's actor what the tuned rules answer in so many training worlds; let both play the tuning worlds."""
    task, p = experiment.build(), experiment.ppo
    rules = player(task)
    rows, answers = shown(task, rules, worlds)
    with on_threads(p.threads):
        model = build(task, p, None)
        optimiser = torch.optim.Adam(model.policy.parameters(), RATE)
        for k in range(updates):
            for group in optimiser.param_groups:
                group["lr"] = RATE * (1.0 - 0.95 * k / updates)
            some = torch.randint(len(rows), (MINIBATCH,))
            loss = ((model.policy.get_distribution(rows[some]).mode() - answers[some]) ** 2).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            advance(1)
        own = rollout(task, rules, p.evaluate_worlds, worlds_for("tuning", p.seed, p.evaluate_worlds))
        network, _ = score(task, p, tensors_of(model))
    return Imitation(float(own.returns.mean()), network, len(rows), float(loss.detach() / answers.var()))


@app.command()
def main(
    config: Annotated[Path, typer.Argument(help="an experiment, such as configs/school.yaml")],
    worlds: Annotated[int, typer.Option(min=1, help="training worlds in which rules are watched")] = 96,
    updates: Annotated[int, typer.Option(min=1, help="gradient steps, each of 2,048 rows")] = 6000,
) -> None:
    """Say how well a network of PPO's size plays that was taught by the tuned rules."""
    with one_line_errors():
        experiment = load_experiment(config)
        name = experiment.build().name
    with Progress(console=console) as progress:
        bar = progress.add_task(f"{name}: gradient steps", total=updates)
        found = imitate(experiment, worlds, updates, lambda n: progress.advance(bar, n))
    console.print(
        f"{name}: mean return {found.rules:.3f} (rules) -> {found.network:.3f} (taught by {found.rows:,} rows; "
        f"{found.missed:.1%} of the answers' variance missed)"
    )


if __name__ == "__main__":
    app()
