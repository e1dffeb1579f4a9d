"""The environment of a hybrid: actions are the outputs of its network, which its rules turn into those of the task."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from flockenv.players.hybrid import Hybrid

__all__ = ["HybridVecEnv"]


class HybridVecEnv(VecEnvWrapper):
    """Rows of a vector environment whose actions are u in [-1, 1]^K, as in flockenv.players.hybrid.

    The rules see the same observations as the network, also where these are disturbed. Rules that remember forget when
    an episode ends.
    """

    def __init__(self, venv: VecEnv, hybrid: Hybrid) -> None:
        super().__init__(venv, action_space=Box(-1.0, 1.0, (hybrid.outputs,), np.float32))
        self.hybrid = hybrid
        self._state: Any = None

    def reset(self) -> NDArray[np.float32]:
        """Begin episodes."""
        self._rows = np.asarray(self.venv.reset())
        self._begins = np.ones(len(self._rows), np.bool_)
        _, self._state = self.hybrid.rules.predict(self._rows, None, self._begins)
        return self._rows

    def memory(self) -> list[NDArray[Any]]:
        """Return what the rules remember, as arrays: none, or one."""
        return [] if self._state is None else [np.asarray(self._state)]

    def resume(self, rows: NDArray[np.float32], begins: NDArray[np.bool_], memory: list[NDArray[Any]]) -> None:
        """Go on from the last observations of a checkpoint, the rows whose episode begins, and `memory`."""
        self._rows, self._begins = rows.copy(), begins.copy()
        self._state = memory[0].copy() if memory else None

    def step_async(self, actions: NDArray[Any]) -> None:
        """Turn the outputs (R, K) of the network into actions of the task, and store them."""
        outputs = np.clip(actions, -1.0, 1.0)
        action, self._state = self.hybrid.act(self._rows, outputs, self._state, self._begins)
        self.venv.step_async(action)

    def step_wait(self) -> Any:
        """Take one decision."""
        self._rows, reward, self._begins, infos = self.venv.step_wait()
        return self._rows, reward, self._begins, infos
