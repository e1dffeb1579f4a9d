"""PettingZoo parallel environments: each learner of one world is an agent with a name."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, NoReturn

import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from flockenv.core.errors import nearest
from flockenv.envs.common import (
    RENDER_MODES,
    ByAgent,
    Rows,
    Screen,
    action_space,
    build,
    check_options,
    check_seed,
    observation_space,
    render_fps,
    require_episode,
    reward_keys,
)
from flockenv.envs.disturbance import make_world
from flockenv.envs.table import EnvInfo, class_of
from flockenv.envs.world import Step, World
from flockenv.tasks import Task

__all__ = ["WorldParallelEnv"]

Named = dict[str, Any]


class WorldParallelEnv(ParallelEnv[str, Rows, Rows]):  # type: ignore[misc]  # pettingzoo ships no types
    """One world whose learners are PettingZoo agents; `task` and `world` give access to its arrays.

    An agent that terminates (captured, for example) appears in the dictionaries of that step and then leaves `agents`.
    At the time limit all remaining agents are truncated, also those that terminate in the same step. When no agent is
    left, `step({})` returns five empty dictionaries. Seeds are as in SingleEnv.

    Infos are flat: `reward/NAME` (each term of the reward of this step), `is_success`, and metrics in the step that
    ends the episode.

    `reset(seed=s)` also seeds `np_random`, for wrappers; the world itself draws nothing from it.

    Args:
        max_cycles: steps after which the world is truncated (default: the task's horizon).
        render_mode: "rgb_array", "human" or None.
        parameters: those of the task, and of the disturbance: noise, delay, dropped, range, seen (see Disturbance).
    """

    info: ClassVar[EnvInfo]
    task_type: ClassVar[type[Task]]
    fixed: ClassVar[dict[str, Any]] = {}
    """Parameters whose default differs from the task's."""

    def __init__(self, max_cycles: int | None = None, render_mode: str | None = None, **parameters: Any) -> None:
        self.task, disturbance = build(
            self.task_type, {**self.fixed, **parameters}, limit="max_cycles", own=("max_cycles", "render_mode")
        )
        self.metadata = {
            "name": f"{self.task.name}_v{self.info.version}",
            "render_modes": list(RENDER_MODES),
            "render_fps": render_fps(self.task),
            "is_parallelizable": True,
        }
        self.render_mode = render_mode
        self.possible_agents = list(self.task.agent_names)
        limit = self.task.horizon if max_cycles is None else max_cycles
        self.world = make_world(self.task, time_limit=limit, disturbance=disturbance)
        self._screen = Screen(render_mode, render_fps(self.task))
        self.observation_spaces = {name: observation_space(self.task) for name in self.possible_agents}
        self.action_spaces = {name: action_space(self.task) for name in self.possible_agents}
        self.np_random = seeding.np_random()[0]
        self._by_agent = ByAgent(reward_keys(self.task), self.possible_agents)
        self._live: dict[str, int] = {}
        self._running = False

    @property
    def max_cycles(self) -> int:
        """Steps after which the world is truncated; PettingZoo's tests set it on an existing environment."""
        return self.world.time_limit or self.task.horizon

    @max_cycles.setter
    def max_cycles(self, limit: int) -> None:
        if limit < 1:
            raise ValueError(f"max_cycles: {limit}, must be at least 1")
        self.world.time_limit = limit

    @property
    def agents(self) -> list[str]:
        """The agents that still act; a new list for each caller."""
        return list(self._live)

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations, the same object each time."""
        return self.observation_spaces[self._check_agent(agent)]

    def action_space(self, agent: str) -> Box:
        """Return the space of an agent's actions, the same object each time."""
        return self.action_spaces[self._check_agent(agent)]

    def _check_agent(self, agent: str) -> str:
        if agent not in self.action_spaces:
            raise ValueError(f"agent: {agent!r} is unknown{nearest(str(agent), self.possible_agents)}")
        return agent

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Named, dict[str, Named]]:
        """Begin an episode; return observations, (O,) float32 each, and infos, which are empty, by agent.

        seed: of the world (default: the next episode of the present one); options: None.

        The seed is `world.seeds[0]`. It is not in the infos, because TorchRL takes their keys as all keys of infos.
        """
        seed = check_seed(seed)
        # PettingZoo's own test suite resets every environment with {"options": 1}; all other options are rejected.
        check_options(options, ("options",))
        observation = self.world.reset(seeds=seed)[0]
        if seed is not None:
            self.np_random = seeding.np_random(seed)[0]
        self._running, self._live = True, {name: i for i, name in enumerate(self.possible_agents)}
        self._show()
        seen = dict(zip(self._live, observation, strict=True))
        return seen, {name: {} for name in self._live}

    def step(
        self, actions: Mapping[str, Rows]
    ) -> tuple[Named, dict[str, float], dict[str, bool], dict[str, bool], dict[str, Named]]:
        """Take one decision; needs an action, (A,), clipped to [-1, 1], from each agent in `agents`.

        Actions of agents that have left are ignored, as in PettingZoo's conversion from AEC: TorchRL and AgileRL pass
        them. When no agent is left, an empty dictionary is needed, and five empty ones are returned.

        Raises ValueError, before any state changes, with the agent that is unknown or whose action is missing, has
        another shape or holds NaN; ResetNeeded before the first reset, or for actions when no agent is left.
        """
        if self._running and not self._live and isinstance(actions, dict) and not actions:
            return {}, {}, {}, {}, {}
        require_episode(bool(self._live), "step")
        result = self._step(actions)
        present, truncated, terminated = self._live, result.truncated.item(), result.terminated[0].tolist()
        outcome = self._by_agent.of(
            result.observation[0], result.reward[0].tolist(), terminated, truncated, result.terms[0].T.tolist(),
            result.success.item(),
        )  # fmt: skip
        if len(present) < len(terminated):
            outcome = tuple({name: values[name] for name in present} for values in outcome)
        if truncated or any(terminated):
            if truncated or all(terminated):
                metrics = self.world.metrics()
                for info in outcome[-1].values():
                    info.update(metrics)
            self._live = {} if truncated else {name: i for name, i in present.items() if not terminated[i]}
        self._show()
        return outcome  # type: ignore[return-value]  # five dictionaries

    def _step(self, actions: Mapping[str, Rows]) -> Step:
        """Step the world; ValueError, with the agent at fault, which is searched only if the actions are rejected."""
        if not isinstance(actions, Mapping):
            raise TypeError(f"actions: {type(actions).__name__}, must be a dictionary from agent to action")
        if [*actions] == [*self._live]:  # in the order of `_live`, as most callers pass them
            rows = [*actions.values()]
        elif self._live.keys() <= actions.keys() <= self.action_spaces.keys():
            rows = [actions[name] for name in self._live]
        else:
            self._raise_for_names(actions)
        try:
            return self.world.step(self._action_rows(rows))
        except (TypeError, ValueError):
            for name in self._live:
                self.check_action(name, actions[name])
            raise

    def _action_rows(self, actions: list[Rows]) -> Rows:
        """Return the actions of all living agents as (1, L, A), with zeros for agents that have left."""
        block, count = np.asarray(actions), len(self.possible_agents)
        if len(actions) == count:
            return block[None]
        rows = np.zeros((1, count, *block.shape[1:]))
        rows[0, list(self._live.values())] = block
        return rows

    def _raise_for_names(self, actions: Mapping[str, Rows]) -> NoReturn:
        for name in actions:
            if name not in self.action_spaces:
                raise ValueError(f"actions: agent {name!r} is unknown{nearest(str(name), self._live)}")
        lacking = next(name for name in self._live if name not in actions)
        raise ValueError(f"actions: agent {lacking!r} has no action")

    def check_action(self, agent: str, action: Rows | None) -> Rows:
        """Return an action as an array, (A,); ValueError, with the agent, on NaN, infinity or another shape."""
        size = self.task.action_layout.size
        try:
            row = np.asarray(action, np.float64)
        except (TypeError, ValueError):
            row = None
        if row is None or action is None:  # numpy converts None to NaN
            raise ValueError(f"actions: agent {agent!r} has {action!r}, must be {size} numbers")
        if row.shape != (size,):
            raise ValueError(f"actions: agent {agent!r} has shape {row.shape}, must be ({size},)")
        if not np.isfinite(row).all():
            raise ValueError(f"actions: agent {agent!r} has {row.tolist()}, must be finite (clipped to [-1, 1])")
        return row

    @functools.cached_property
    def state_space(self) -> Box:
        """The space of state(), (S,) float32 in [-1, 1]."""
        other = World(self.task)
        other.reset(seeds=0)
        return Box(-1.0, 1.0, _state_row(other, 1).shape, np.float32)

    def state(self) -> NDArray[np.float32]:
        """Return the state of the world as one row, for centralised critics; (S,) float32 in [-1, 1].

        Positions (N, D) in the region shown, velocities (N, D) over the largest speed, alive (N,), obstacles
        (M, D + 1), goals and headings (K, 2 D), and the share of the time limit that has passed; all clipped.
        """
        require_episode(bool(self.world.seeds), "state")
        return _state_row(self.world, self.max_cycles)

    def _show(self) -> None:
        if self.render_mode == "human":
            self._screen.show(self.world.snapshot())

    def render(self) -> NDArray[np.uint8] | None:
        """Return the current picture, (H, W, 3) uint8, or show it in the window and return None."""
        if self.render_mode is None:
            warnings.warn(
                "render() shows nothing without a render mode: make(..., render_mode='rgb_array')", stacklevel=2
            )
            return None
        require_episode(bool(self.world.seeds), "render")
        return self._screen.show(self.world.snapshot())

    def close(self) -> None:
        """Close the window and end the episode; may be called twice, and reset() begins a new episode."""
        self._running, self._live = False, {}
        self._screen.close()


def _state_row(world: World, limit: int) -> NDArray[np.float32]:
    now = world.snapshot()
    middle, half = (now.low + now.high) / 2, (now.high - now.low) / 2
    speed = world.task.scene.body.max_speed.max()
    marks = [((mark.at - middle) / half, mark.vector / (np.linalg.norm(mark.vector) or 1.0)) for mark in now.marks]
    parts = (
        (now.pos - middle) / half,
        now.vel / (speed if np.isfinite(speed) else 1.0),
        now.alive,
        (now.obstacle_centre - middle) / half,
        now.obstacle_radius / half.max(),
        *(part for mark in marks for part in mark),
        world.steps / limit,
    )
    row = np.concatenate([np.ravel(part) for part in parts])
    return np.asarray(np.clip(row, -1.0, 1.0), np.float32)


def __getattr__(name: str) -> type[WorldParallelEnv]:
    """Build the class of an environment in the table, such as PursuitParallelEnv."""
    return class_of(WorldParallelEnv, "ParallelEnv", name, team=True)
