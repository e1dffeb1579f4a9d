"""A training that begins with the weights of a trained policy instead of random ones (`ppo.start`).

Only the mean action is taken: the noise is `ppo.log_std`, and the critic is new, so `ppo.critic_first` should let it
learn first. The task may observe more than the policy does, behind what it observes; the first layer ignores that.
"""

from __future__ import annotations

import numpy as np
import torch
from stable_baselines3 import PPO

from agents.experiment import PpoSettings
from agents.run import start_path
from flockenv.core.errors import printable
from flockenv.players.policy import MlpPolicy, describe
from flockenv.players.recurrent import RecurrentPolicy
from flockenv.tasks import Task

__all__ = ["starting_policy", "use_weights"]


def starting_policy(p: PpoSettings, task: Task) -> MlpPolicy:
    """Return the policy from which a training begins (`ppo.start`): of a file, or one of the task's own.

    Raises:
        ValueError: in one line, there is no such policy, it has another network, or it observes something else.
    """
    spec, own = p.start or "", (p.hidden, p.activation)
    policy = MlpPolicy.load(start_path(spec, task, p.seed))
    if "squash" in policy.card or policy.learners or isinstance(policy, RecurrentPolicy):
        what = "is squashed, recurrent or of several networks"
        raise ValueError(f"ppo.start = {printable(spec)}: its actor {what}, must be one of PPO's")
    mine = (tuple(len(bias) for _, bias in policy.layers[:-1]), policy.card["activation"])
    if mine != own:
        raise ValueError(f"ppo.start = {printable(spec)}: its network is {mine}, must be {own}")
    seen, here = policy.card.get("observation"), describe(task)["observation"]
    if not isinstance(seen, list) or seen != here[: len(seen)] or policy.card.get("action") != describe(task)["action"]:
        raise ValueError(f"ppo.start = {printable(spec)}: its observations or actions are not those of the task")
    return policy


def use_weights(model: PPO, policy: MlpPolicy) -> None:
    """Set the actor of a model to a policy; numbers that the policy does not observe have no effect yet."""
    net = model.policy
    modules = [module for module in net.mlp_extractor.policy_net if isinstance(module, torch.nn.Linear)]
    with torch.no_grad():
        for module, (weight, bias) in zip([*modules, net.action_net], policy.layers, strict=True):
            module.weight.zero_()
            module.weight[:, : len(weight)] = torch.from_numpy(np.ascontiguousarray(weight.T))
            module.bias[:] = torch.from_numpy(bias.copy())
