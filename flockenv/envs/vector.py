"""Gymnasium's vector environments: many worlds in one array program, without subprocesses or a loop over worlds.

They behave as gymnasium's SyncVectorEnv over the single environments does, number for number and info for info (a test
compares the two), in each of the three ways to begin anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from flockenv.envs.face import (
    SEEDS,
    Rows,
    Screen,
    action_space,
    begun,
    checked_options,
    checked_seed,
    observation_space,
    render_fps,
)
from flockenv.envs.single import one_learner
from flockenv.refusals import nearest
from flockenv.tasks import Flock, Obstacles, Pursuit, Task
from flockenv.world import Step, World

__all__ = ["FlockVectorEnv", "ObstaclesVectorEnv", "PursuitVectorEnv", "WorldsEnv"]

Mask = NDArray[np.bool_]
Info = dict[str, Any]
NONE = -1
"""Stands for "no seed" in a column of seeds."""


class WorldsEnv(VectorEnv[Rows, Rows, Rows]):
    """B independent worlds with one learner each; row k with seed s is the single environment with seed s + k.

    Args:
        num_envs: B.
        max_episode_steps: decisions after which a world is truncated; None = never (make_vec passes the id's own).
        autoreset_mode: when a world that ended begins anew: in the same step (default; `info["final_obs"]` and
            `info["final_info"]` hold the end), in the next step, or never (`reset(options={"reset_mask": mask})`).
        render_mode: "rgb_array" or None.
        parameters: those of the task.
    """

    task_type: ClassVar[type[Task]]
    fixed: ClassVar[dict[str, Any]] = {}

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        self.task = one_learner(self.task_type, {**self.fixed, **parameters})
        self.autoreset_mode = _autoreset(autoreset_mode)
        self._screen = Screen(render_mode, render_fps(self.task), modes=("rgb_array",))
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": render_fps(self.task),
            "autoreset_mode": self.autoreset_mode,
        }
        self.world = World(self.task, num_envs, time_limit=max_episode_steps)
        self.num_envs = num_envs = self.world.worlds
        self.single_observation_space = observation_space(self.task)
        self.single_action_space = action_space(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._seeds = np.full(num_envs, NONE, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)
        self._running = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], Info]:
        """Begin an episode in every world, or in those of options["reset_mask"], (B,) bool; return (B, O) float32.

        seed: s for s, s + 1, ...; or one per world, None meaning the next episode of the seed that the world has.
        """
        seeds = self._seed_column(seed)
        mask = self._reset_mask(checked_options(options, ("reset_mask",)))
        super().reset(seed=int(seeds[0]) if seeds[0] != NONE else None)
        if (self._seeds == NONE).any():
            drawn = self.np_random.integers(SEEDS - self.num_envs) + np.arange(self.num_envs)
            seeds = np.where(seeds == NONE, drawn, seeds)
        info: Info = {}
        observation = self._begin(mask, seeds)
        self._running = True
        _put(info, {"seed": self._seeds}, mask)
        return observation, info

    def _seed_column(self, seed: int | Sequence[int | None] | None) -> NDArray[np.int64]:
        if seed is None or isinstance(seed, list | tuple):
            given = [None] * self.num_envs if seed is None else [checked_seed(s) for s in seed]
        else:
            first = checked_seed(seed) or 0
            given = [checked_seed(first + k) for k in range(self.num_envs)]
        if len(given) != self.num_envs:
            raise ValueError(f"seed: {len(given)} seeds for {self.num_envs} worlds")
        return np.array([NONE if s is None else s for s in given], np.int64)

    def _reset_mask(self, options: Mapping[str, Any]) -> Mask:
        if "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_)
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            what = f"{mask.dtype} of shape {mask.shape}" if isinstance(mask, np.ndarray) else type(mask).__name__
            raise ValueError(f"options['reset_mask']: {what}, must be a bool array of shape ({self.num_envs},)")
        if not mask.any():
            raise ValueError("options['reset_mask']: names no world")
        if not self._running and not mask.all():
            raise ValueError("options['reset_mask']: the first reset must begin every world")
        return mask

    def _begin(self, mask: Mask, seeds: NDArray[np.int64] | None = None) -> NDArray[np.float32]:
        """Begin the masked worlds, with a new seed where there is one, else with the next episode of their seed."""
        self._ended = self._ended & ~mask
        if seeds is None:
            return self.world.reset(mask=mask)[:, 0]
        fresh = mask & (seeds != NONE)
        self._seeds[fresh] = seeds[fresh]
        if (mask & ~fresh).any():
            observation = self.world.reset(mask=mask & ~fresh)
        if fresh.any():
            observation = self.world.reset(seeds=self._seeds.tolist(), mask=fresh)
        return observation[:, 0]

    def step(self, actions: Rows) -> tuple[NDArray[np.float32], Rows, Mask, Mask, Info]:
        """Act for one control_dt in every world; actions are (B, A), clipped to [-1, 1].

        Raises ValueError that names the world on NaN or another shape; ResetNeeded for a world that ended, if worlds
        do not begin anew by themselves.
        """
        begun(self._running, "step")
        resting = self._resting()
        result = self.world.step(self._rows(actions, resting))
        acting = ~resting
        terminated, truncated = result.terminated[:, 0] & acting, result.truncated & acting
        self._ended = terminated | truncated
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        ended, anew = self._ended, self._ended if same_step else resting
        info: Info = {}
        columns = self._columns(result)
        observation = result.observation[:, 0]
        if anew.any():
            if same_step:
                _put_final(info, observation, columns, ended)
            observation = self._begin(anew)
        _put(info, columns, ~anew)
        _put(info, {"seed": self._seeds}, anew)
        return observation, np.where(acting, result.reward[:, 0], 0.0), terminated, truncated, info

    def _resting(self) -> Mask:
        """Return the worlds for which this step is their reset; refuse to step one that ended and stays so."""
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            return self._ended
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(
                f"step: world {int(self._ended.argmax())} has ended; call reset(options={{'reset_mask': ended}}) first"
            )
        return np.zeros(self.num_envs, np.bool_)

    def _rows(self, actions: Rows, resting: Mask) -> Rows:
        rows = np.asarray(actions)
        if rows.shape != self.action_space.shape:
            raise ValueError(f"actions: shape {rows.shape}, must be {self.action_space.shape}, a row per world")
        if resting.any():
            rows = np.where(resting[:, None], 0.0, rows)
        return rows[:, None]

    def _columns(self, result: Step) -> Info:
        terms = {name: result.terms[:, 0, k] for k, name in enumerate(self.task.terms)}
        return {"terms": terms, "is_success": result.success, **self.world.measure()}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return one picture per world, each (H, W, 3) uint8."""
        if self.render_mode is None:
            logger.warn("render() shows nothing without a render mode: make_vec(..., render_mode='rgb_array')")
            return None
        begun(self._running, "render")
        frames = (self._screen.show(self.world.snapshot(k)) for k in range(self.num_envs))
        return tuple(frame for frame in frames if frame is not None)

    def close_extras(self, **kwargs: Any) -> None:
        """Forget the episodes; a step then needs a reset."""
        self._running = False


def _autoreset(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        allowed = [m.value for m in AutoresetMode]
        raise ValueError(
            f"autoreset_mode: {mode!r} is unknown{nearest(str(mode), allowed)}; allowed: {', '.join(allowed)}"
        ) from None


def _put(info: Info, columns: Mapping[str, Any], mask: Mask) -> None:
    """Enter columns over worlds as gymnasium's vector envs do: zeros and a False in `_name` where there is no value."""
    for name, column in columns.items():
        here = mask
        if isinstance(column, Mapping):
            value: Any = {}
            _put(value, column, mask)
        else:
            if column.dtype.kind == "f":
                here = mask & ~np.isnan(column)  # a metric that has no value yet
            value = np.where(here, column, np.zeros((), column.dtype))
        if here.any():
            info[name], info[f"_{name}"] = value, here.copy()


def _put_final(info: Info, observation: NDArray[np.float32], columns: Info, ended: Mask) -> None:
    """Enter how the worlds that ended ended: their last observations as objects, their infos as columns."""
    last = np.full(len(ended), None, object)
    for k in np.flatnonzero(ended):
        last[k] = observation[k].copy()
    final: Info = {}
    _put(final, columns, ended)
    info["final_obs"], info["_final_obs"] = last, ended.copy()
    info["final_info"], info["_final_info"] = final, ended.copy()


class PursuitVectorEnv(WorldsEnv):
    """Pursuers, one per world; the page is that of flockenv.envs.single.PursuitEnv."""

    task_type = Pursuit


class ObstaclesVectorEnv(WorldsEnv):
    """Walkers, one per world; the page is that of flockenv.envs.single.ObstaclesEnv."""

    task_type = Obstacles


class FlockVectorEnv(WorldsEnv):
    """Learners in scripted flocks, one per world; the page is that of flockenv.envs.single.FlockEnv."""

    task_type = Flock
    fixed: ClassVar[dict[str, Any]] = {"learners": 1}
