"""Several vector environments side by side, as one: the drawn settings of a training."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agents.divergence import LearningDiverged
from flockenv.tasks import Task

if TYPE_CHECKING:
    from flockenv.envs.world import World

__all__ = ["DrawnVecEnv"]


class DrawnVecEnv(VecEnv):
    """Rows of several vector environments, one after another, as the rows of one.

    Args:
        parts: the environment of each setting, by its text.
    """

    def __init__(self, parts: Mapping[str, Any]) -> None:
        self.parts, self.names = list(parts.values()), list(parts)
        first = self.parts[0]
        self.task: Task = first.get_attr("task", 0)[0]
        self._is_hybrid = hasattr(first, "resume")
        rows = [part.num_envs for part in self.parts]
        self._ends = np.cumsum(rows)[:-1]
        self.render_mode = None
        super().__init__(sum(rows), first.observation_space, first.action_space)

    @property
    def worlds(self) -> list[World]:
        """The worlds of all settings."""
        return [part.get_attr("world", 0)[0] for part in self.parts]

    @property
    def acted(self) -> NDArray[np.bool_]:
        """(rows,): True for rows whose learner acted in the last step."""
        return np.concatenate([part.acted for part in self.parts])

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed all settings with the same worlds' seeds."""
        return [row for part in self.parts for row in part.seed(seed)]

    def reset(self) -> NDArray[np.float32]:
        """Begin episodes; return the observations of all rows."""
        return np.concatenate([part.reset() for part in self.parts])

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store an action for every row."""
        for part, rows in zip(self.parts, np.split(actions, self._ends), strict=True):
            part.step_async(rows)

    def step_wait(self) -> Any:
        """Take one decision in all worlds; raise LearningDiverged with the setting if a number is not finite."""
        results = []
        for name, part in zip(self.names, self.parts, strict=True):
            try:
                results.append(part.step_wait())
            except LearningDiverged as error:
                raise LearningDiverged(f"{name}: {error}") from None
        observations, rewards, dones, infos = zip(*results, strict=True)
        return np.concatenate(observations), np.concatenate(rewards), np.concatenate(dones), [*itertools.chain(*infos)]

    def memory(self) -> list[NDArray[Any]]:
        """Return what rules of hybrids remember in all settings, as arrays."""
        return [array for part in self.parts for array in part.memory()] if self._is_hybrid else []

    def resume(self, rows: NDArray[np.float32], begins: NDArray[np.bool_], memory: list[NDArray[Any]]) -> None:
        """Go on from the last observations of a checkpoint, the rows whose episode begins, and `memory`."""
        if self._is_hybrid:
            memories = [[array] for array in memory] or [[] for _ in self.parts]
            shares = zip(self.parts, np.split(rows, self._ends), np.split(begins, self._ends), memories, strict=True)
            for part, *share in shares:
                part.resume(*share)

    def close(self) -> None:
        """Close all environments."""
        for part in self.parts:
            part.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of this object for each of the rows."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of this object."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of this object once, and return its result for each of the rows."""
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each of the rows: they contain no gymnasium environment that could be wrapped."""
        return [False] * len(list(self._get_indices(indices)))
