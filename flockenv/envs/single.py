"""Gymnasium environments: one learner in one world; the docstring of each class is its documentation page.

The classes, such as PursuitEnv, come from the rows of table.py.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from flockenv.envs.common import (
    RENDER_MODES,
    SEEDS,
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
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.docstring import page
from flockenv.envs.table import EnvInfo, class_of
from flockenv.envs.world import Step
from flockenv.tasks import Task

__all__ = ["SingleEnv", "single_learner_task"]


def single_learner_task(task_type: type[Task], parameters: dict[str, Any]) -> tuple[Task, Disturbance]:
    """Make the task of an environment with one learner, and its disturbance; ValueError if the task has several.

    task_type: the class of the task; parameters: its arguments and those of `Disturbance`, by name.
    """
    task, disturbance = build(task_type, parameters, limit="max_episode_steps", own=("render_mode",))
    if task.learners != 1:
        raise ValueError(
            f"{task_type.__name__}: {task.learners} learners; a Gymnasium environment has 1: for more use "
            "gymnasium.make_vec(...), pettingzoo.make('parallel', ...) or flockenv.envs.sb3.WorldVecEnv"
        )
    return task, disturbance


class SingleEnv(gymnasium.Env[Rows, Rows]):
    """One world with one learner, as a Gymnasium environment; `task` and `world` give access to its arrays.

    Seeds: `reset(seed=s)` begins episode 0 of seed s; each later `reset()` begins the next episode of that seed, and a
    first `reset()` without a seed draws one. `info["seed"]` of a reset is the seed used.
    """

    info: ClassVar[EnvInfo]
    task_type: ClassVar[type[Task]]
    fixed: ClassVar[dict[str, Any]] = {}
    """Parameters whose default differs from the task's."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "task_type" in vars(cls):
            task = cls.task_type(**cls.fixed)
            cls.metadata = {"render_modes": list(RENDER_MODES), "render_fps": render_fps(task)}
            cls.__doc__ = page(cls.info, task)

    def __init__(self, render_mode: str | None = None, **parameters: Any) -> None:
        """Make the environment.

        render_mode: `human`, `rgb_array` or None, without pictures; parameters: those of the task and of `Disturbance`.
        """
        self.task, disturbance = single_learner_task(self.task_type, {**self.fixed, **parameters})
        self.metadata = {**self.metadata, "render_fps": render_fps(self.task)}
        self._screen = Screen(render_mode, render_fps(self.task))
        self.render_mode = render_mode
        self.observation_space = observation_space(self.task)
        self.action_space = action_space(self.task)
        self.world = make_world(self.task, disturbance=disturbance)
        self._reward_keys = reward_keys(self.task)
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; return (O,) float32 and info with the seed. Raises ValueError for any option.

        seed: of the world (default: the next episode of the present one); options: None.
        """
        seed = check_seed(seed)
        check_options(options)
        super().reset(seed=seed)
        if seed is None and not self.world.seeds:
            seed = int(self.np_random.integers(SEEDS))
        observation = self.world.reset(seeds=seed)[0, 0]
        self._running = True
        self._show()
        return observation, {"seed": self.world.seeds[0]}

    def step(self, action: Rows) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take one decision; the action is (A,), clipped to [-1, 1]. Raises ValueError on NaN or another shape.

        `truncated` is always False here: the wrapper that gymnasium.make adds applies the time limit.
        """
        require_episode(self._running, "step")
        result = self.world.step(self._check_action(action))
        terminated = result.terminated.item()
        self._running = not terminated
        self._show()
        return result.observation[0, 0], result.reward.item(), terminated, False, self._info(result)

    def _check_action(self, action: Rows) -> Rows:
        row = np.asarray(action)
        if row.shape != self.action_space.shape:
            raise ValueError(f"action: shape {row.shape}, must be {self.action_space.shape}")
        return row[None, None]

    def _info(self, result: Step) -> dict[str, Any]:
        rewards = dict(zip(self._reward_keys, result.terms[0, 0].tolist(), strict=True))
        return {**rewards, "is_success": result.success.item(), **self.world.metrics()}

    def _show(self) -> None:
        if self.render_mode == "human":
            self._screen.show(self.world.snapshot())

    def render(self) -> NDArray[np.uint8] | None:
        """Return the current picture, (H, W, 3) uint8, or show it in the window and return None."""
        if self.render_mode is None:
            logger.warn("render() shows nothing without a render mode: gymnasium.make(..., render_mode='rgb_array')")
            return None
        require_episode(bool(self.world.seeds), "render")
        return self._screen.show(self.world.snapshot())

    def close(self) -> None:
        """Close the window and end the episode; may be called twice, and reset() begins a new episode."""
        self._running = False
        self._screen.close()


def __getattr__(name: str) -> type[SingleEnv]:
    """Build the class of an environment in the table, such as PursuitEnv."""
    return class_of(SingleEnv, "Env", name)
