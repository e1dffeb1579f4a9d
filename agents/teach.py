"""Teach a network what the tuned rules of a task answer: behaviour cloning, by squared errors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from stable_baselines3 import PPO

from agents.reynolds import Reynolds
from flockenv.evaluation import worlds_for
from flockenv.tasks import Task
from flockenv.world import World

__all__ = ["shown", "teach"]

MINIBATCH, RATE = 2048, 2e-3
WORLDS = 96


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


def teach(
    model: PPO, task: Task, rules: Reynolds, updates: int, worlds: int = WORLDS,
    advance: Callable[[int], None] = lambda n: None,
) -> tuple[int, float]:  # fmt: skip
    """Teach PPO's actor what rules answer in so many training worlds, by so many gradient steps of 2,048 rows.

    Returns how many rows there were, and what is missed in the end: mean square of its answers' errors, over the
    variance of the rules' answers. advance: called with 1 after every gradient step.
    """
    rows, answers = shown(task, rules, worlds)
    optimiser = torch.optim.Adam(model.policy.parameters(), RATE)
    loss = torch.zeros(())
    for k in range(updates):
        for group in optimiser.param_groups:
            group["lr"] = RATE * (1.0 - 0.95 * k / updates)
        some = torch.randint(len(rows), (MINIBATCH,))
        loss = ((model.policy.get_distribution(rows[some]).mode() - answers[some]) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        advance(1)
    return len(rows), float(loss.detach() / answers.var())
