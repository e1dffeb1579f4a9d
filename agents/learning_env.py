"""The environment of PPO: worlds of a task, with changes that make learning faster and leave the task as it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper

from agents.divergence import check_step
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.envs.world import World

__all__ = ["ForLearning"]


class ForLearning(VecEnvWrapper):
    """A vector environment for learning: scaled rewards, held actions, worlds in different phases of their episodes.

    Scaled rewards keep the value loss near 1, so that gradient clipping does not starve the policy. If only the time
    limit ends episodes, worlds that begin together would show each update a single phase; staggered, their first
    episodes end one after another. The effect of one noisy decision in ten per second is small; `hold` repeats each
    action for a number of decisions and sums their rewards (Mnih et al. 2015). If an episode ends among them, rewards
    of the next one before the next decision are left out.
    """

    def __init__(self, venv: WorldVecEnv, scale: float, stagger: bool, hold: int = 1) -> None:
        super().__init__(venv)
        self.scale, self.stagger, self.hold = scale, stagger, hold
        self.acted = np.ones(venv.num_envs, np.bool_)  # (rows,): rows whose learner acted in the last step

    def reset(self) -> np.ndarray:
        """Begin episodes; if staggered, each world starts after another part of its first episode."""
        observation = self.venv.reset()
        if self.stagger:
            world: World = self.venv.world
            world.steps[:] = np.arange(world.worlds) * world.task.horizon // world.worlds
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store an action for every row."""
        self.acted = self.venv.present
        self.actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Apply the actions for `hold` decisions of the world, and scale the rewards."""
        observation, reward, done, infos = self._decide()
        done |= ~self.acted  # returns of a row whose learner has left must not include its next episode
        for _ in range(self.hold - 1):
            self.venv.step_async(self.actions)
            observation, more, over, new_infos = self._decide()
            reward += np.where(done, 0.0, more)
            if any(new_infos):  # a world has ended, or a learner has left
                infos = [before or new for before, new in zip(infos, new_infos, strict=True)]
            done = done | over
        return observation, reward * self.scale, done, infos

    def _decide(self) -> Any:
        """Return the result of one decision of the world; raise LearningDiverged if a number of it is not finite."""
        world: World = self.venv.world
        before = world.steps.copy()
        return check_step(world.task, self.venv.step_wait(), before)
