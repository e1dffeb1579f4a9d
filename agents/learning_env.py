"""The environment that PPO learns in: worlds of a task, and what makes learning faster without changing the task."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper

from agents.divergence import check_step
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.envs.world import World

__all__ = ["ForLearning"]


class ForLearning(VecEnvWrapper):
    """What learning likes: small rewards, actions that tell, and worlds in different phases of their episodes.

    Rewards times a constant keep the value loss near 1, so that clipping gradients does not starve the policy. And
    where only the time limit ends an episode, worlds that began together would show every update one phase alone;
    staggered, their first episodes end one after another. What one noisy decision in ten per second changes is lost
    among the others; `hold` keeps to each for so many, and pays what they are paid together (Mnih et al. 2015). Where
    an episode ends among them, what the next one is paid until there is another decision is left out.
    """

    def __init__(self, venv: WorldVecEnv, scale: float, stagger: bool, hold: int = 1) -> None:
        super().__init__(venv)
        self.scale, self.stagger, self.hold = scale, stagger, hold
        self.acted = np.ones(venv.num_envs, np.bool_)  # (rows,): rows whose learner acted in the last step

    def reset(self) -> np.ndarray:
        """Begin; staggered, each world with another part of its first episode behind it."""
        observation = self.venv.reset()
        if self.stagger:
            world: World = self.venv.world
            world.steps[:] = np.arange(world.worlds) * world.task.horizon // world.worlds
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Take an action for every row."""
        self.acted = self.venv.present
        self.actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Act for `hold` decisions of the world, and scale what is paid."""
        observation, reward, done, infos = self._decided()
        done |= ~self.acted  # nothing that is learned of a row without a learner reaches into its next episode
        for _ in range(self.hold - 1):
            self.venv.step_async(self.actions)
            observation, more, over, told = self._decided()
            reward += np.where(done, 0.0, more)
            if any(told):  # a world has ended, or a learner has left
                infos = [before or new for before, new in zip(infos, told, strict=True)]
            done = done | over
        return observation, reward * self.scale, done, infos

    def _decided(self) -> Any:
        """Return what one decision of the world brought; LearningDiverged if a number of it is not finite."""
        world: World = self.venv.world
        before = world.steps.copy()
        return check_step(world.task, self.venv.step_wait(), before)
