"""Learning that is no longer finite: found where it happens, and named by world, learner, decision and quantity."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO

from flockenv.tasks import Task

__all__ = ["LearningDiverged", "check_answers", "check_model", "check_step"]

Told = tuple[NDArray[Any], NDArray[Any], NDArray[Any], list[dict[str, Any]]]
"""What a VecEnv returns of a step: observations, rewards, dones, infos."""


class LearningDiverged(FloatingPointError):  # noqa: N818  # as SimulationDiverged
    """A reward, an observation, a loss or a weight is NaN or infinite."""


def check_step(task: Task, told: Told, decisions: NDArray[np.int64]) -> Told:
    """Return what a step of all rows told, if all of it is finite.

    decisions: (B,), how many each world's episode had before the step.

    Raises:
        LearningDiverged: it names the first world, learner and quantity that are not, and the decision.
    """
    observation, reward, done, infos = told
    with np.errstate(all="ignore"):  # one sum is NaN or infinite if a number is; it may be too when all are finite
        whole = np.isfinite(observation.sum() + reward.sum())
    if not whole:
        _name_row(task, "reward", reward[:, None], decisions)
        _name_row(task, "observation", observation, decisions)
    if done.any():
        last = [(row, info["terminal_observation"]) for row, info in enumerate(infos) if "terminal_observation" in info]
        for row, seen in last:
            if not np.isfinite(seen).all():
                _name_row(task, "observation at the end", seen[None], decisions, row)
    return told


def _name_row(task: Task, quantity: str, rows: NDArray[Any], decisions: NDArray[np.int64], first: int = 0) -> None:
    """Raise LearningDiverged if a number of rows (R, K) is not finite; `first` is the row that the first of them is."""
    bad = np.argwhere(~np.isfinite(rows))
    if len(bad):
        at, column = (int(k) for k in bad[0])
        world, learner = divmod(first + at, task.learners)
        what = quantity if rows.shape[1] == 1 else f"{quantity}, {_slot(task, column)}"
        raise LearningDiverged(
            f"world {world}, {task.agent_names[learner]}: {what}, is {rows[at, column]} after decision "
            f"{decisions[world] + 1} of its episode"
        )


def _slot(task: Task, column: int) -> str:
    """Return the name of the slot that a number of a row is in; beyond them is what only a critic is shown."""
    at = 0
    for slot in task.layout.slots:
        at += slot.size
        if column < at:
            return slot.name
    return f"number {column - at} of what the critic is shown besides"


def check_model(model: PPO) -> None:
    """Raise LearningDiverged if a weight is not finite, and name the first thing of the last update that was not."""
    weights = dict(model.policy.named_parameters())
    bad = [name for name, tensor in weights.items() if not torch.isfinite(tensor).all()]
    if not bad:
        return
    buffer = model.rollout_buffer
    for name in ("rewards", "values", "log_probs", "advantages", "returns"):
        array = getattr(buffer, name)
        if not np.isfinite(array).all():
            raise LearningDiverged(f"{name} of the last rollout hold {array[~np.isfinite(array)].flat[0]}")
    losses = {k.removeprefix("train/"): v for k, v in model.logger.name_to_value.items() if k.startswith("train/")}
    lost = [f"; {name} was {value}" for name, value in losses.items() if not np.isfinite(value)]
    reach = f"the largest return of the last rollout was {np.abs(buffer.returns).max():.3g}"
    raise LearningDiverged(
        f"weights of the network, {bad[0]}, are not finite after an update{''.join(lost[:1])}; {reach}"
    )


def check_answers(model: PPO) -> None:
    """Raise LearningDiverged if the network, whose weights are finite, answers the last observations with NaN."""
    policy = model.policy
    with torch.no_grad():
        seen = policy.extract_features(torch.as_tensor(model._last_obs), policy.pi_features_extractor)
        mean, deviation = policy.action_net(policy.mlp_extractor.forward_actor(seen)), policy.log_std.exp()
        largest = max(float(tensor.abs().max()) for tensor in policy.parameters())
    for what, tensor in (("mean", mean), ("standard deviation", deviation)):
        if not torch.isfinite(tensor).all() or (tensor is deviation and not (tensor > 0).all()):
            raise LearningDiverged(f"the {what} of actions is out of range: the largest weight is {largest:.3g}")
