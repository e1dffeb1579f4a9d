"""A critic with more inputs than its actor, used in training only (Lowe et al. 2017; Yu et al. 2022, MAPPO).

The return of a learner depends on quantities that it does not observe, such as the hunger of a hunter or the number of
agents alive. The critic is needed in training only, so it may use them; its estimates then have less noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor

from flockenv.envs.sb3 import WorldVecEnv

__all__ = ["CentralPolicy", "CentralVecEnv"]

Rows = NDArray[np.float32]


class CentralVecEnv(WorldVecEnv):
    """Rows of a learner's observation, followed by the additional inputs of its critic; see WorldVecEnv.

    These are the mean observation of the learners still present, their share, the share of the episode that is over,
    and the task's memory of all agents that are no learners.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        world = self.world
        numbers = 2 * world.observation_size + 2 + world.task.memory * (world.agents - world.learners)
        self.observation_space = Box(-np.inf, np.inf, (numbers,), np.float32)

    def _rows(self, observation: Rows, worlds: Any = slice(None)) -> Rows:
        world, count, n = self.world, len(observation), self.world.learners
        here = world.state.alive[worlds, :n, None]
        left = here.sum(axis=1)
        mean = (observation * here).sum(axis=1) / np.maximum(left, 1)
        gone = world.steps[worlds, None] / (world.time_limit or world.task.horizon)
        shared = np.concatenate([mean, left / n, gone, world.memory[worlds, :, n:].reshape(count, -1)], axis=1)
        rows = np.concatenate([observation, np.repeat(shared[:, None], n, axis=1)], axis=2, dtype=np.float32)
        return rows.reshape(count * n, -1)


class _Extractor(MlpExtractor):
    """SB3's two networks; the actor's gets only the first `seen` numbers of a row."""

    def __init__(self, seen: int, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.seen = seen
        first = self.policy_net[0]
        self.policy_net[0] = torch.nn.Linear(seen, first.out_features, device=first.weight.device)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Return the output of the actor's network for the learners' observations."""
        return super().forward_actor(features[..., : self.seen])


class CentralPolicy(ActorCriticPolicy):
    """SB3's policy for the rows of `CentralVecEnv`: the actor sees a learner's observation, the critic the whole row.

    Args:
        seen: how many numbers of a row the actor gets; actions can be computed from these alone, values need the whole
        row.
    """

    def __init__(self, *args: Any, seen: int, **kwargs: Any) -> None:
        self.seen = seen
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _Extractor(
            self.seen, self.features_dim, net_arch=self.net_arch, activation_fn=self.activation_fn, device=self.device
        )
