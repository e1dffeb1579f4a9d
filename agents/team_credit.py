"""Team credit: learners that share their advantages with the other learners of a world (Peysakhovich and Lerer 2018).

Each learner has its own reward and a critic of its own return; the advantages are shared. A critic of the team's return
would have to find the effect of a learner's own hunger in a sum of eight returns, where it is lost in the unexplained
variance, and such learners starve (docs/history/players.md). The sum of eight critics is a critic of the sum (value
decomposition, Sunehag et al. 2018), and finds that effect.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.vec_env import VecEnvWrapper

__all__ = ["CaringBuffer"]


class CaringBuffer(RolloutBuffer):
    """SB3's rollout buffer; a learner's advantage is its own plus `care` times those of the others in its world.

    An action's effect on others counts also after its own learner has left. A learner that has left does nothing: its
    rows have advantage 0, before SB3 subtracts the mean of a minibatch.

    Args:
        worlds: of these rows; `worlds.acted`, (rows,) bool, is True for a row whose learner acted in the last step.
        learners: rows of a world, which lie side by side.
        care: 0: its own advantage alone; 1: all learners of a world count the same.
    """

    def __init__(self, *args: Any, worlds: VecEnvWrapper, learners: int, care: float, **kwargs: Any) -> None:
        self.worlds, self.learners, self.care = worlds, learners, care
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        """Clear the rollout."""
        self.acted = np.ones((self.buffer_size, self.n_envs), np.bool_)
        super().reset()

    def add(self, *args: Any) -> None:
        """Add a step of all rows, and note which of them acted."""
        self.acted[self.pos] = self.worlds.acted
        super().add(*args)

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        """Compute each learner's own advantages and returns (which critics learn), then share the advantages."""
        super().compute_returns_and_advantage(last_values, dones)
        own = np.where(self.acted, self.advantages, np.float32(0))
        team = own.reshape(self.buffer_size, -1, self.learners).sum(axis=2)
        others = np.repeat(team, self.learners, axis=1) - own
        self.advantages = np.where(self.acted, own + np.float32(self.care) * others, np.float32(0))
