"""The environments of RLlib's runners, which are made in their processes: rows of worlds, and teams of agents."""

from __future__ import annotations

from typing import Any, TypedDict

import numpy as np
from gymnasium.vector import VectorWrapper
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv

from flockenv.envs import parallel, vector
from flockenv.jit.thread_pool import use_threads
from flockenv.tasks import TASKS, Task

__all__ = ["EVALUATION_SEEDS", "NETWORKS", "ONE", "RowsEnv", "Settings", "TeamEnv", "own", "role", "shared"]

EVALUATION_SEEDS = 1_000_000
"""RLlib adds it to the seed of runners that evaluate."""


class Settings(TypedDict):
    """RLlib's `env_config` of an environment."""

    task: str
    arguments: dict[str, Any]
    disturbance: dict[str, Any]
    threads: int  # of the worlds
    first: int  # seed of the first world of the first runner
    seed: int  # of the recipe; RLlib adds the numbers of the runner and of the environment
    worlds: int  # of each runner
    stagger: bool
    reward_scale: float


def _arguments(settings: dict[str, Any]) -> tuple[str, dict[str, Any], Task]:
    """Return the name of the task's class, the arguments of its environments, and the task."""
    task = TASKS[settings["task"]](**settings["arguments"])
    use_threads(settings["threads"])
    fields = {name: getattr(task, name) for name in type(task).model_fields if name != "horizon"}
    return type(task).__name__, {**settings["disturbance"], **fields}, task


class RowsEnv(VectorWrapper):
    """The native vector environment for RLlib: rewards are scaled, infos empty, and each runner has its own worlds.

    Args:
        settings: a Settings, with `num_envs`, the number of rows, which RLlib adds.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        name, arguments, task = _arguments(settings)
        make = getattr(vector, f"{name}VectorEnv")
        super().__init__(make(settings["num_envs"], max_episode_steps=task.horizon, infos="ends", **arguments))
        self._settings = settings

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin episodes; RLlib's seed, that of the recipe plus the number of the runner, selects the worlds."""
        world, settings = self.env.unwrapped.world, self._settings
        if seed is not None:
            seed = settings["first"] + (seed - settings["seed"]) % EVALUATION_SEEDS * world.worlds
        observation, _ = self.env.reset(seed=seed, options=options)
        if settings["stagger"]:
            world.steps[:] = np.arange(world.worlds) * world.time_limit // world.worlds
        return observation, {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Take one decision in every world."""
        observation, reward, terminated, truncated, _ = self.env.step(actions)
        return observation, reward * self._settings["reward_scale"], terminated, truncated, {}


class TeamEnv(ParallelPettingZooEnv):
    """PettingZoo's parallel environment for RLlib: rewards are scaled, and each runner has its own worlds."""

    def __init__(self, settings: Any) -> None:
        name, arguments, task = _arguments(settings)
        super().__init__(getattr(parallel, f"{name}ParallelEnv")(max_cycles=task.horizon, **arguments))
        self._settings, self._runner = settings, settings.worker_index

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin an episode; RLlib's seed is that of the recipe plus the numbers of the runner and of the world."""
        if seed is not None:
            number = (seed - self._settings["seed"] - self._runner) % EVALUATION_SEEDS
            seed = self._settings["first"] + self._runner * self._settings["worlds"] + number
        return super().reset(seed=seed, options=options)

    def step(self, action_dict: dict[str, np.ndarray]) -> tuple[dict, dict, dict, dict, dict]:
        """Take one decision of every agent that is there."""
        observation, reward, *rest = super().step(action_dict)
        return observation, {name: value * self._settings["reward_scale"] for name, value in reward.items()}, *rest


ONE = "default_policy"
"""RLlib's name of the policy of all agents, if there is one."""


def shared(agent: str, *_: Any, **__: Any) -> str:
    """Return the policy of an agent: the one of all agents."""
    return ONE


def role(agent: str, *_: Any, **__: Any) -> str:
    """Return the policy of an agent: that of its role, such as pursuer for pursuer_0."""
    return agent.rsplit("_", 1)[0]


def own(agent: str, *_: Any, **__: Any) -> str:
    """Return the policy of an agent: its own, of the agent's name."""
    return agent


NETWORKS = {"shared": shared, "role": role, "agent": own}
"""Which agents of a team share a network, by name: the function that returns an agent's policy."""
