"""Who gets the credit for what becomes of the others of a world: prosocial learners (Peysakhovich and Lerer 2018).

Everybody is paid for himself and has a critic of his own pay; what is shared is the advantage. A critic of what all are
paid would have to find what one's own hunger changes in the sum of eight: it is lost in what it explains worst, and who
learns from it goes hungry (docs/players.md). The sum of what eight critics find is a critic of the sum (value
decomposition, Sunehag et al. 2018), and finds it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.vec_env import VecEnvWrapper

__all__ = ["CaringBuffer"]


class CaringBuffer(RolloutBuffer):
    """SB3's rollouts, in which a learner's advantage is his own and that of the others of his world, times `care`.

    What an action does to others when its own learner is out counts too. Who is out does nothing: his rows have no
    advantage, before SB3 takes away the mean of a minibatch.

    Args:
        worlds: whose rows these are; `worlds.acted`, (rows,) bool, True for a row whose learner acted in the last step.
        learners: rows of a world, which lie side by side.
        care: 0: he is himself alone; 1: all of a world are worth the same to him.
    """

    def __init__(self, *args: Any, worlds: VecEnvWrapper, learners: int, care: float, **kwargs: Any) -> None:
        self.worlds, self.learners, self.care = worlds, learners, care
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        """Forget the rollout."""
        self.acted = np.ones((self.buffer_size, self.n_envs), np.bool_)
        super().reset()

    def add(self, *args: Any) -> None:
        """Take a step of all rows, and which of them acted."""
        self.acted[self.pos] = self.worlds.acted
        super().add(*args)

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        """Find everybody's own advantages and returns (what critics learn), and share the advantages."""
        super().compute_returns_and_advantage(last_values, dones)
        own = np.where(self.acted, self.advantages, np.float32(0))
        everybody = own.reshape(self.buffer_size, -1, self.learners).sum(axis=2)
        others = np.repeat(everybody, self.learners, axis=1) - own
        self.advantages = np.where(self.acted, own + np.float32(self.care) * others, np.float32(0))
