"""PettingZoo's turn-based form (AEC) of a parallel environment: agents pass actions one by one, then all act."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import BaseWrapper, OrderEnforcingWrapper

from flockenv.envs import parallel
from flockenv.envs.common import Rows
from flockenv.envs.table import ENVIRONMENTS

__all__ = ["by_turns"]


class _CheckedAEC(BaseWrapper):  # type: ignore[misc]  # pettingzoo ships no types
    """Rejects a bad action on its agent's turn, not later, when the last agent of the round acts.

    It also gives access to what PettingZoo's conversion hides behind a deprecation warning (the dictionaries of spaces)
    or omits (`np_random`).
    """

    @property
    def observation_spaces(self) -> dict[str, Box]:
        """The space of each agent's observations, by agent."""
        return self.unwrapped.observation_spaces  # type: ignore[no-any-return]

    @property
    def action_spaces(self) -> dict[str, Box]:
        """The space of each agent's actions, by agent."""
        return self.unwrapped.action_spaces  # type: ignore[no-any-return]

    @property
    def np_random(self) -> np.random.Generator:
        """The random number generator for wrappers, seeded by `reset(seed=s)`."""
        return self.unwrapped.np_random  # type: ignore[no-any-return]

    def observe(self, agent: str) -> Rows:
        """Return the last observation of an agent, (O,) float32.

        Raises ValueError for an unknown agent, and for one that left before the last step of the world.
        """
        try:
            return self.env.observe(agent)  # type: ignore[no-any-return]
        except KeyError:
            self.env.observation_space(agent)  # ValueError if it is unknown
            raise ValueError(f"observe: agent {agent!r} has left the game") from None

    def step(self, action: Rows | None) -> None:
        """Pass the action of the agent whose turn it is: (A,), or None from an agent that has ended."""
        turns = self.env  # plain attributes: the properties of this wrapper would slow down each turn
        agent = turns.agent_selection
        if not (turns.terminations[agent] or turns.truncations[agent]):
            turns.unwrapped.check_action(agent, action)
        elif action is not None:
            raise ValueError(f"actions: agent {agent!r} has ended, so that its action must be None")
        turns.step(action)

    def __str__(self) -> str:
        return str(self.env)


def by_turns(env: parallel.WorldParallelEnv) -> AECEnv[str, Any, Any]:
    """Return the AEC form, with order enforced (no step before reset, one per turn) and actions checked.

    env: the parallel form of the environment.

    Actions out of [-1, 1] are clipped by the world, as in all other APIs, and not by a wrapper that warns.
    """
    return OrderEnforcingWrapper(_CheckedAEC(parallel_to_aec_wrapper(env)))


def __getattr__(name: str) -> Callable[..., AECEnv[str, Any, Any]]:
    """Return the function that makes the AEC form of an environment in the table, such as PursuitAECEnv."""
    info = ENVIRONMENTS.get(name.removesuffix("AECEnv")) if name.endswith("AECEnv") else None
    if info is None or not info.team:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    env_class: type[parallel.WorldParallelEnv] = getattr(parallel, f"{info.name}ParallelEnv")

    def env(max_cycles: int | None = None, render_mode: str | None = None, **parameters: Any) -> AECEnv[str, Any, Any]:
        """Make the turn-based environment (AEC); the parameters are those of the parallel environment."""
        return by_turns(env_class(max_cycles, render_mode, **parameters))

    return env
