"""Imitation of the tuned rules by a network, in the states that it reaches itself: DAgger (Ross et al. 2011)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from stable_baselines3 import PPO

from agents.divergence import LearningDiverged
from flockenv.envs.world import World
from flockenv.evaluation import worlds_for
from flockenv.players.rules import RulesPlayer
from flockenv.tasks import Task

__all__ = ["collect_answers", "teach"]

Answers = Callable[[torch.Tensor], torch.Tensor]

MINIBATCH, RATE = 2048, 2e-3
WORLDS, ROUNDS = 96, 4


def collect_answers(
    task: Task, rules: RulesPlayer, worlds: int, actor: Answers | None = None, first: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the observations of one episode in each of some training worlds, (rows, size), and the rules' actions.

    actor: the acting policy (default: the rules). first: the number of training worlds before these.
    """
    world, state = World(task, worlds, task.horizon), None
    observation = world.reset(worlds_for("training", 0, first + worlds) + first)
    playing, begins = np.ones((worlds, task.learners), np.bool_), True
    rows, answers = [], []
    while playing.any():
        given = observation.reshape(-1, task.layout.size)
        actions, state = rules.predict(given, state, np.full(len(given), begins))
        rows.append(given[playing.ravel()])
        answers.append(np.asarray(actions, np.float32)[playing.ravel()])
        if actor is not None:
            with torch.no_grad():
                actions = actor(torch.from_numpy(given)).numpy()
        step = world.step(actions.reshape(worlds, task.learners, -1))
        observation, begins = step.observation, False
        playing &= ~(step.terminated | step.truncated[:, None])
    return torch.from_numpy(np.concatenate(rows)), torch.from_numpy(np.concatenate(answers))


def teach(
    model: PPO, task: Task, rules: RulesPlayer, updates: int, worlds: int = WORLDS,
    advance: Callable[[int], None] = lambda n: None, rounds: int = ROUNDS, seen: Callable[[int], None] = lambda n: None,
    ended: Callable[[int, int, float], None] = lambda steps, rows, missed: None,
) -> tuple[int, float]:  # fmt: skip
    """Train PPO's actor to imitate the rules (DAgger), by some gradient steps of 2,048 rows in `rounds` rounds.

    The first round uses observations of the rules in training worlds, each later round adds observations of the actor
    in as many more worlds. Returns the number of rows, and the remaining error: the mean square error of the actions
    over the variance of the rules' actions. advance: called with 1 after every gradient step; seen: with
    the number of rows after each round's episodes; ended: after each round, with the gradient steps and rows so far and
    the remaining error.

    Raises:
        FloatingPointError: learning or a world diverged; LearningDiverged names the gradient step and the loss.
    """

    def answer(rows: torch.Tensor) -> torch.Tensor:
        return _finite_answers(model, rows)

    rows, answers = collect_answers(task, rules, worlds)
    seen(len(rows))
    optimiser = torch.optim.Adam(model.policy.parameters(), RATE)
    loss = torch.zeros(())
    begins = {-(-updates * turn // rounds): turn for turn in range(1, rounds)}
    for k in range(updates):
        if k in begins:
            more = collect_answers(task, rules, worlds, answer, first=worlds * begins[k])
            rows, answers = torch.cat([rows, more[0]]), torch.cat([answers, more[1]])
            seen(len(more[0]))
        for group in optimiser.param_groups:
            group["lr"] = RATE * (1.0 - 0.95 * k / updates)
        batch = torch.randint(len(rows), (MINIBATCH,))
        loss = ((answer(rows[batch]) - answers[batch]) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        _check_weights(model, k + 1, updates, float(loss.detach()))
        advance(1)
        if k + 1 in begins or k + 1 == updates:
            ended(k + 1, len(rows), float(loss.detach() / answers.var()))
    return len(rows), float(loss.detach() / answers.var())


def _finite_answers(model: PPO, rows: torch.Tensor) -> torch.Tensor:
    """Return the actor's actions for rows (R, O), (R, A); raise LearningDiverged if a number is not finite."""
    try:
        answers = model.policy.get_distribution(rows).mode()
    except ValueError:  # torch makes no distribution of NaN
        answers = torch.full((1,), torch.nan)
    if not torch.isfinite(answers).all():
        largest = max(float(tensor.detach().abs().max()) for tensor in model.policy.parameters())
        raise LearningDiverged(f"the network's outputs are not finite: its largest weight is {largest:.3g}")
    return answers


def _check_weights(model: PPO, step: int, updates: int, loss: float) -> None:
    """Raise LearningDiverged if a weight is not finite after a gradient step."""
    for name, tensor in model.policy.named_parameters():
        if not torch.isfinite(tensor).all():
            raise LearningDiverged(
                f"weights of the network, {name}, are not finite after gradient step {step} of {updates} of imitation; "
                f"the loss was {loss:.3g}"
            )
