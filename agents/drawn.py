"""Settings of a training: combinations of drawn values, and how the outputs of the network act.

`ppo.draw: {agents: [4, 8, 16, 32], noise: [0, 0.05]}` trains in all eight combinations; each has an equal share of the
worlds. Domain randomisation: Tobin et al. 2017, arXiv 1703.06907. The rows must have the same slots in every setting.

A price of harm (flockenv/tasks/price.py) would let the settings with high prices drown the others, as their rewards
are larger. So the rewards of a setting are multiplied by 2 / (1 + price) while learning, also where a policy is chosen:
harm and all else then have weights of a constant sum, as in Abels et al. 2019, arXiv 1809.07803.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.experiment import Experiment, PpoSettings
from flockenv.core.errors import key_path, nearest
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.evaluation import rollout, worlds_for
from flockenv.players.hybrid import FORCE, Hybrid, HybridPolicy
from flockenv.players.policy import MlpPolicy
from flockenv.tasks import Task

__all__ = [
    "MOST_SETTINGS", "Drawn", "check_settings", "drawn_settings", "hybrid_of", "played_returns", "reward_weight",
    "squash_of",
]  # fmt: skip

MOST_SETTINGS = 64
"""Combinations of drawn values."""

Drawn = tuple[str, Task, Disturbance]
"""A setting of a training: its text, the task, and the disturbance."""


def drawn_settings(task: Task, disturbance: Disturbance, draw: Mapping[str, Sequence[Any]]) -> list[Drawn]:
    """Return every combination of drawn values; without any, the setting itself.

    Raises:
        ValueError: in one line, an unknown name, a value that the task does not accept, observations with other slots,
            or too many combinations.
    """
    known = [*type(task).model_fields, *Disturbance.model_fields]
    for name, values in draw.items():
        if name not in known:
            raise ValueError(f"{key_path(('ppo', 'draw', name))}: unknown{nearest(name, known)}")
        if not values:
            raise ValueError(f"ppo.draw.{name}: must have at least one value")
    combinations = list(itertools.product(*draw.values()))
    if len(combinations) > MOST_SETTINGS:
        raise ValueError(f"ppo.draw: {len(combinations)} combinations, at most {MOST_SETTINGS} are allowed")
    return [_drawn(task, disturbance, dict(zip(draw, values, strict=True))) for values in combinations]


def _drawn(task: Task, disturbance: Disturbance, values: Mapping[str, Any]) -> Drawn:
    text = ", ".join(f"{name} {value}" for name, value in values.items())
    own = {name: getattr(task, name) for name in type(task).model_fields if name != "scene"}
    given = {name: value for name, value in own.items() if value != _default(task, name)}
    of_task = {name: value for name, value in values.items() if name not in Disturbance.model_fields}
    others = {name: value for name, value in values.items() if name in Disturbance.model_fields}
    try:
        new = type(task)(**{**given, **of_task}) if of_task else task
        disturbed = Disturbance(**{**disturbance.model_dump(), **others})
        disturbed.check(new)
    except ValueError as error:
        raise ValueError(f"ppo.draw ({text}): {error}") from None
    sizes = [(slot.name, slot.shape) for slot in task.layout.slots], [(s.name, s.shape) for s in new.layout.slots]
    if sizes[0] != sizes[1]:
        raise ValueError(f"ppo.draw ({text}): observations have other slots than with the task's own arguments")
    return text, new, disturbed


def _default(task: Task, name: str) -> Any:
    """Return the default of a task's argument, which may follow from others: all agents are learners."""
    return type(task).model_fields[name].get_default(call_default_factory=True, validated_data=dict(task))


def hybrid_of(task: Task, p: PpoSettings) -> Hybrid | None:
    """Return how the outputs of the network act, or None if they are the action."""
    return None if p.action == FORCE else Hybrid.of(task, p.action, p.base, p.bound)


def squash_of(tensors: Mapping[str, NDArray[Any]]) -> dict[str, str]:
    """Return the card's entry about the squashing of an actor's output: none, or tanh for one of SAC or TQC."""
    return {"squash": "tanh"} if "log_std.weight" in tensors else {}


def reward_weight(task: Task) -> float:
    """Return the factor on the rewards of a setting while learning: 1, or less for a high price of harm."""
    price = getattr(task, "price", None)
    return 1.0 if price is None else 2.0 / (1.0 + price)


def check_settings(experiment: Experiment) -> None:
    """Raise ValueError, in one line, for settings that cannot be trained."""
    task, p = experiment.build(), experiment.ppo
    hybrid_of(task, p)
    if p.start is not None:
        from agents.warm_start import starting_policy  # with torch

        starting_policy(p, task)
    settings = drawn_settings(task, p.disturbance, p.draw)
    count, learners = len(settings), {drawn.learners for _, drawn, _ in settings}
    if p.care and len(learners) > 1:
        raise ValueError(f"ppo.draw: the number of learners must not vary with care, not {sorted(learners)}")
    if count > min(p.worlds, p.evaluate_worlds):
        raise ValueError(f"ppo.draw: {count} combinations need as many ppo.worlds and ppo.evaluate_worlds at least")


def played_returns(
    task: Task, p: PpoSettings, tensors: Mapping[str, NDArray[Any]]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return returns, with the weight of each setting, and successes of a policy on the tuning worlds, without noise.

    Each drawn setting has an equal share of the worlds.
    """
    settings, returns, success = drawn_settings(task, p.disturbance, p.draw), [], []
    worlds = p.evaluate_worlds // len(settings)
    for _, drawn, disturbance in settings:
        make = functools.partial(make_world, disturbance=disturbance)
        policy, first = _policy(drawn, p, tensors), worlds_for("tuning", p.seed, worlds)
        episodes = rollout(drawn, policy, worlds, first, make_world=make)
        returns.append(reward_weight(drawn) * episodes.returns)
        success.append(episodes.success)
    return np.concatenate(returns), np.concatenate(success)


def _policy(task: Task, p: PpoSettings, tensors: Mapping[str, NDArray[Any]]) -> MlpPolicy:
    card: dict[str, Any] = {"activation": p.activation, **squash_of(tensors)}
    if (hybrid := hybrid_of(task, p)) is None:
        return MlpPolicy.of_tensors(tensors, card)
    return HybridPolicy.of(tensors, {**card, "hybrid": hybrid.card}, task)
