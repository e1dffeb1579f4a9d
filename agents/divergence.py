"""Checks of a training for NaN and infinity; errors name the world, learner, decision and quantity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from flockenv.tasks import Task

if TYPE_CHECKING:
    from stable_baselines3 import PPO
    from stable_baselines3.common.base_class import BaseAlgorithm

__all__ = ["LearningDiverged", "check_answers", "check_model", "check_step", "diverged_weight"]

StepResult = tuple[NDArray[Any], NDArray[Any], NDArray[Any], list[dict[str, Any]]]
"""Result of a VecEnv's step: observations, rewards, dones, infos."""


class LearningDiverged(FloatingPointError):  # noqa: N818  # as SimulationDiverged
    """A reward, an observation, a loss or a weight is NaN or infinite."""


def check_step(task: Task, result: StepResult, decisions: NDArray[np.int64]) -> StepResult:
    """Return the result of a step unchanged, if all its observations and rewards are finite.

    decisions: (B,), number of decisions in the episode of each world before this step.

    Raises:
        LearningDiverged: with the first world, learner and quantity that is not finite, and the decision.
    """
    observation, reward, done, infos = result
    with np.errstate(all="ignore"):  # if a number is not finite, this sum is not; the reverse need not hold
        is_finite = np.isfinite(observation.sum() + reward.sum())
    if not is_finite:
        _check_rows(task, "reward", reward[:, None], decisions)
        _check_rows(task, "observation", observation, decisions)
    if done.any():
        last = [(row, info["terminal_observation"]) for row, info in enumerate(infos) if "terminal_observation" in info]
        for row, final in last:
            if not np.isfinite(final).all():
                _check_rows(task, "observation at the end", final[None], decisions, row)
    return result


def _check_rows(task: Task, quantity: str, rows: NDArray[Any], decisions: NDArray[np.int64], first: int = 0) -> None:
    """Raise LearningDiverged if one of these rows, (R, K), has a number that is not finite.

    first: index of the first of these rows among the rows of all worlds.
    """
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
    """Return the name of the slot at a column of an observation; later columns are inputs of a central critic alone."""
    at = 0
    for slot in task.layout.slots:
        at += slot.size
        if column < at:
            return slot.name
    return f"number {column - at} of what the critic is shown besides"


def diverged_weight(model: BaseAlgorithm) -> str | None:
    """Return the name of the first weight of a model's networks that is not finite; None if all are."""
    weights = model.policy.named_parameters()
    return next((name for name, tensor in weights if not torch.isfinite(tensor).all()), None)


def check_model(model: PPO) -> None:
    """Raise LearningDiverged if a weight of the network is not finite.

    The message names the first array of the last rollout that was not finite; if all were, the weight and the loss.
    """
    bad = diverged_weight(model)
    if bad is None:
        return
    buffer = model.rollout_buffer
    for name in ("rewards", "values", "log_probs", "advantages", "returns"):
        array = getattr(buffer, name)
        if not np.isfinite(array).all():
            raise LearningDiverged(f"{name} of the last rollout hold {array[~np.isfinite(array)].flat[0]}")
    losses = {k.removeprefix("train/"): v for k, v in model.logger.name_to_value.items() if k.startswith("train/")}
    lost = [f"; {name} was {value}" for name, value in losses.items() if not np.isfinite(value)]
    reach = f"the largest return of the last rollout was {np.abs(buffer.returns).max():.3g}"
    raise LearningDiverged(f"weights of the network, {bad}, are not finite after an update{''.join(lost[:1])}; {reach}")


def check_answers(model: PPO) -> None:
    """Raise LearningDiverged if finite weights give the last observations no valid distribution of actions."""
    policy = model.policy
    with torch.no_grad():
        features = policy.extract_features(torch.as_tensor(model._last_obs), policy.pi_features_extractor)
        mean, deviation = policy.action_net(policy.mlp_extractor.forward_actor(features)), policy.log_std.exp()
        largest = max(float(tensor.abs().max()) for tensor in policy.parameters())
    for what, tensor in (("mean", mean), ("standard deviation", deviation)):
        if not torch.isfinite(tensor).all() or (tensor is deviation and not (tensor > 0).all()):
            raise LearningDiverged(f"the {what} of actions is out of range: the largest weight is {largest:.3g}")
