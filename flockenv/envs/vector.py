"""Gymnasium vector environments: many worlds in one array program, without subprocesses or a Python loop over worlds.

Numbers and infos equal those of gymnasium's SyncVectorEnv over the single environments (a test compares the two), in
each of the three autoreset modes; `infos="ends"` reports only ends and starts of episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal

import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from flockenv.core.errors import nearest
from flockenv.envs.common import (
    SEEDS,
    Rows,
    Screen,
    action_space,
    build,
    check_ends_together,
    check_options,
    check_seed,
    observation_space,
    render_fps,
    require_episode,
    reward_keys,
)
from flockenv.envs.disturbance import make_world
from flockenv.envs.table import EnvInfo, class_of
from flockenv.envs.world import Step
from flockenv.tasks import Task

__all__ = ["WorldsEnv"]

Mask = NDArray[np.bool_]
Info = dict[str, Any]
OWN: Final = ("num_envs", "max_episode_steps", "autoreset_mode", "render_mode", "infos")
"""Arguments of WorldsEnv that are not the task's."""
INFOS = ("steps", "ends")
NONE = -1
"""Marks "no seed" in a column of seeds."""


class WorldsEnv(VectorEnv[Rows, Rows, Rows]):
    """B independent worlds with L learners each as B L rows; row i is learner i % L of world i // L.

    With one learner per world, row k of seed s equals the single environment of seed s + k. With several, which must
    all end together, the rows of one world share its seed, metrics and success, and are reset together.

    Args:
        num_envs: B L, the number of rows; a multiple of L.
        max_episode_steps: decisions after which a world is truncated; None: never (make_vec passes that of the id).
        autoreset_mode: when a world that ended is reset. "NextStep" (default, as in gymnasium): in the next step, which
            ignores the actions of the world's rows, and returns their first observations, reward 0 and no end.
            "SameStep": in the step that ends it; `info["final_obs"]` and `info["final_info"]` hold the end. "Disabled":
            only by `reset(options={"reset_mask": mask})`.
        render_mode: "rgb_array" or None.
        infos: "steps" reports every row after every step, as single environments do; "ends" reports only the
            metrics of episodes that end and the seeds of episodes that begin: faster with many rows.
        parameters: those of the task, and of the disturbance: noise, delay, dropped, range, seen (see Disturbance).
    """

    info: ClassVar[EnvInfo]
    task_type: ClassVar[type[Task]]
    fixed: ClassVar[dict[str, Any]] = {}

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        infos: Literal["steps", "ends"] = "steps",
        **parameters: Any,
    ) -> None:
        if infos not in INFOS:
            raise ValueError(f"infos: {infos!r} is unknown{nearest(str(infos), INFOS)}; allowed: {', '.join(INFOS)}")
        self.infos: Literal["steps", "ends"] = infos
        task, disturbance = build(self.task_type, {**self.fixed, **parameters}, "max_episode_steps", OWN)
        self.task = check_ends_together(task)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self._screen = Screen(render_mode, render_fps(self.task), modes=("rgb_array",))
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": render_fps(self.task),
            "autoreset_mode": self.autoreset_mode,
        }
        worlds = _count_worlds(num_envs, self.task.learners)
        self.world = make_world(self.task, worlds, max_episode_steps, disturbance)
        self.num_envs = num_envs = self.world.worlds * self.task.learners
        self.single_observation_space = observation_space(self.task)
        self.single_action_space = action_space(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reward_keys = reward_keys(self.task)
        self._seeds = np.full(self.world.worlds, NONE, np.int64)
        self._no_worlds = np.zeros(self.world.worlds, np.bool_)
        self._ended = self._no_worlds
        self._running = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], Info]:
        """Begin an episode in every world, or in those of options["reset_mask"], (B L,) bool; return (B L, O) float32.

        seed: s for worlds s, s + 1, ...; or one per row, None for the next episode of its world's seed.
        """
        seeds = self._seed_column(seed)
        mask = self._reset_mask(check_options(options, ("reset_mask",)))
        super().reset(seed=int(seeds[0]) if seeds[0] != NONE else None)
        if ((seeds == NONE) & (self._seeds == NONE)).any():
            drawn = self.np_random.integers(SEEDS - len(seeds)) + np.arange(len(seeds))
            seeds = np.where(seeds == NONE, drawn, seeds)
        observation = self._begin(mask, seeds)
        self._running = True
        return observation.reshape(self.num_envs, -1), self._reset_infos(mask)

    def _repeat_rows(self, column: NDArray[Any]) -> NDArray[Any]:
        """Return the values of worlds, (B, ...), repeated for each of their rows; always a copy."""
        return np.repeat(column, self.task.learners, axis=0)

    def _seed_column(self, seed: int | Sequence[int | None] | None) -> NDArray[np.int64]:
        """Return a seed per world, (B,); ValueError for a wrong number of seeds, or rows of one world that disagree."""
        worlds = self.world.worlds
        if seed is None:
            return np.full(worlds, NONE, np.int64)
        if not isinstance(seed, list | tuple):
            first = check_seed(seed) or 0
            check_seed(first + worlds - 1)
            return np.arange(first, first + worlds)
        seeds = [check_seed(s) for s in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds for {self.num_envs} rows")
        return self._one_per_world("seed", np.array([NONE if s is None else s for s in seeds], np.int64))

    def _reset_mask(self, options: Mapping[str, Any]) -> Mask:
        """Return the worlds to reset, (B,) bool."""
        if "reset_mask" not in options:
            return np.ones(self.world.worlds, np.bool_)
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            what = f"{mask.dtype} of shape {mask.shape}" if isinstance(mask, np.ndarray) else type(mask).__name__
            raise ValueError(f"options['reset_mask']: {what}, must be a bool array of shape ({self.num_envs},)")
        if not mask.any():
            raise ValueError("options['reset_mask']: names no world")
        if not self._running and not mask.all():
            raise ValueError("options['reset_mask']: the first reset must begin every world")
        return self._one_per_world("options['reset_mask']", mask)

    def _one_per_world(self, what: str, column: NDArray[Any]) -> NDArray[Any]:
        """Return the value of each world's first row; ValueError if another row of that world differs."""
        values = column.reshape(self.world.worlds, self.task.learners)
        differ = values != values[:, :1]
        if differ.any():
            world, learner = (int(k) for k in np.argwhere(differ)[0])
            row = world * self.task.learners
            raise ValueError(f"{what}: rows {row} and {row + learner} are one world, number {world}, and must agree")
        return values[:, 0]

    def _begin(
        self, mask: Mask, seeds: NDArray[np.int64] | None = None, into: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Reset the masked worlds, each with its new seed if there is one, else to the next episode of its seed."""
        self._ended = self._ended & ~mask
        if seeds is None:
            return self.world.reset(mask=mask, into=into)
        fresh = mask & (seeds != NONE)
        self._seeds[fresh] = seeds[fresh]
        if (mask & ~fresh).any():
            observation = self.world.reset(mask=mask & ~fresh)
        if fresh.any():
            observation = self.world.reset(seeds=self._seeds.tolist(), mask=fresh)
        return observation

    def step(self, actions: Rows) -> tuple[NDArray[np.float32], Rows, Mask, Mask, Info]:
        """Take one decision in each world; actions are (B L, A), clipped to [-1, 1].

        Raises ValueError on NaN (with the world) or another shape; ResetNeeded for a world that ended, if
        `autoreset_mode` is "Disabled".
        """
        require_episode(self._running, "step")
        resting = self._worlds_to_reset()
        result = self.world.step(self._actions_by_world(actions, resting), terms=self.infos)
        terminated, truncated = result.terminated, result.truncated
        if resting is not None:
            terminated[resting], truncated[resting], result.reward[resting] = False, False, 0.0
        self._ended = terminated[:, 0] | truncated
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        info = self._infos(result, self._ended if same_step else resting, final=same_step)
        observation, reward = result.observation.reshape(self.num_envs, -1), result.reward.reshape(-1)
        truncated_rows = self._repeat_rows(truncated) if truncated.any() else np.zeros(self.num_envs, np.bool_)
        return observation, reward, terminated.reshape(-1), truncated_rows, info

    def _infos(self, result: Step, to_reset: Mask | None, final: bool) -> Info:
        """Return infos of all rows, or of those that ended; reset the worlds `to_reset`, in the result's observations.

        final: these worlds have just ended, so that their last observations and infos are entered first.
        """
        info: Info = {}
        reported, to_reset = self._reported_worlds(), self._no_worlds if to_reset is None else to_reset
        resets = bool(to_reset.any())
        if not resets and not reported.any():
            return info
        columns, lacks = self._columns(result)
        mask = self._repeat_rows(to_reset)
        if resets:
            if final:
                _enter_final(info, result.observation[to_reset], columns, mask, lacks)
            self._begin(to_reset, into=result.observation)
            info |= self._reset_infos(to_reset)
        reported_rows = self._repeat_rows(reported & ~to_reset)
        _clear_rows(columns, np.flatnonzero(~reported_rows))
        _enter_columns(info, columns, reported_rows, lacks)
        return info

    def _reported_worlds(self) -> Mask:
        """Return the worlds that this step's infos report, (B,) bool."""
        return self._ended if self.infos == "ends" else np.ones(self.world.worlds, np.bool_)

    def _reset_infos(self, worlds: Mask) -> Info:
        """Return the infos of reset worlds: their seeds."""
        info: Info = {}
        mask = self._repeat_rows(worlds)
        _enter_columns(info, _keep_rows({"seed": self._repeat_rows(self._seeds)}, np.flatnonzero(mask)), mask)
        return info

    def _worlds_to_reset(self) -> Mask | None:
        """Return the worlds that this step resets, if any; ResetNeeded if one has ended and autoreset is disabled."""
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and self._ended.any():
            return self._ended
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(
                f"step: world {int(self._ended.argmax())} has ended; call reset(options={{'reset_mask': ended}}) first"
            )
        return None

    def _actions_by_world(self, actions: Rows, resting: Mask | None) -> Rows:
        """Return the actions by world and learner, (B, L, A), with zeros for worlds that this step resets."""
        array = np.asarray(actions)
        if array.shape != self.action_space.shape:
            raise ValueError(
                f"actions: shape {array.shape}, must be {self.action_space.shape}, one row per learner of each world"
            )
        blocks = array.reshape(self.world.worlds, self.task.learners, -1)
        return blocks if resting is None else np.where(resting[:, None, None], 0.0, blocks)

    def _columns(self, result: Step) -> tuple[Info, dict[str, Mask]]:
        """Return infos as columns over rows, and by column the rows that have no value yet (0 instead)."""
        columns: Info = {key: result.terms[..., k].reshape(-1) for k, key in enumerate(self._reward_keys)}
        columns["is_success"] = self._repeat_rows(result.success)
        lacks = {}
        for name, column in self.world.measure().items():
            lacking = np.isnan(column)
            if lacking.any():
                column[lacking], lacks[name] = 0.0, self._repeat_rows(lacking)
            columns[name] = self._repeat_rows(column)
        return columns, lacks

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return one picture per world, each (H, W, 3) uint8."""
        if self.render_mode is None:
            logger.warn("render() shows nothing without a render mode: make_vec(..., render_mode='rgb_array')")
            return None
        require_episode(self._running, "render")
        frames = (self._screen.show(self.world.snapshot(k)) for k in range(self.world.worlds))
        return tuple(frame for frame in frames if frame is not None)

    def close_extras(self, **kwargs: Any) -> None:
        """End the episodes; the next step then needs a reset.

        kwargs: of gymnasium; not used.
        """
        self._running = False


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        allowed = [m.value for m in AutoresetMode]
        raise ValueError(
            f"autoreset_mode: {mode!r} is unknown{nearest(str(mode), allowed)}; allowed: {', '.join(allowed)}"
        ) from None


def _count_worlds(rows: Any, learners: int) -> int:
    """Return the number of worlds with this many rows; ValueError unless `learners` divides it."""
    if learners == 1 or not isinstance(rows, int | np.integer):
        return rows  # type: ignore[no-any-return]  # World checks the number of worlds
    worlds, over = divmod(int(rows), learners)
    if over:
        near = sorted({max(k, 1) * learners for k in (worlds, worlds + 1)})
        raise ValueError(
            f"num_envs: {rows} rows are not a multiple of the {learners} learners per world; "
            f"the nearest: {' or '.join(map(str, near))}"
        )
    return worlds


# Infos are columns over rows, as in gymnasium's vector envs, with 0, and False in `_name`, if there is no value.
# Columns of a result are the step's own arrays, so that they need no copy.


def _enter_columns(
    info: Info, columns: Mapping[str, Any], mask: Mask, lacks: Mapping[str, Mask] = MappingProxyType({})
) -> None:
    """Enter columns, with the mask of their rows; a column without rows is left out."""
    for name, column in columns.items():
        here = mask & ~lacks[name] if name in lacks else mask.copy()
        if here.any():
            info[name], info[f"_{name}"] = column, here


def _enter_final(info: Info, seen: NDArray[np.float32], columns: Info, mask: Mask, lacks: Mapping[str, Mask]) -> None:
    """Enter the ends of rows: their last observations as objects, their infos as columns."""
    rows = np.flatnonzero(mask)
    last = np.full(len(mask), None, object)
    last[rows] = np.fromiter(seen.reshape(len(rows), -1), object, len(rows))
    final: Info = {}
    _enter_columns(final, _keep_rows(columns, rows), mask, lacks)
    info["final_obs"], info["_final_obs"] = last, mask.copy()
    info["final_info"], info["_final_info"] = final, mask.copy()


def _keep_rows(columns: Mapping[str, Any], rows: NDArray[np.intp]) -> Info:
    """Return new columns that are zero except in these rows."""
    new = {name: np.zeros_like(column) for name, column in columns.items()}
    for name, column in new.items():
        column[rows] = columns[name][rows]
    return new


def _clear_rows(columns: Mapping[str, Any], rows: NDArray[np.intp]) -> None:
    """Write zeros into these rows."""
    for column in columns.values():
        column[rows] = 0


def __getattr__(name: str) -> type[WorldsEnv]:
    """Build the class of an environment in the table, such as PursuitVectorEnv."""
    return class_of(WorldsEnv, "VectorEnv", name)
