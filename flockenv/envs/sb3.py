"""Stable-Baselines3 VecEnv: each learner of each world is one row, without subprocesses or SuperSuit.

The thread pool of worlds and torch share the cores. On few cores, GOMP_SPINCOUNT=10000 in the environment keeps torch's
threads from spinning on cores that the thread pool needs (docs/performance.md, Training).
"""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import Wrapper
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from flockenv.envs.common import (
    Screen,
    action_space,
    check_ends_together,
    check_options,
    check_seed,
    iterate_by_name,
    observation_space,
    render_fps,
    require_episode,
    reward_keys,
)
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.table import ENVIRONMENTS
from flockenv.envs.world import Step

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

    from flockenv.tasks import Task

__all__ = ["WorldMonitor", "WorldVecEnv", "load_sb3_zip"]

Info = dict[str, Any]


class _Nothing(Info):
    """The empty info of a row whose episode goes on: one object for all rows, so that it is read-only.

    `info.copy()` returns a writable dictionary; pickled or deeply copied it is still this object.
    """

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError("this info is empty and shared by many rows: write into a copy, info = info.copy()")

    __setitem__ = setdefault = update = __ior__ = _refuse

    def __reduce__(self) -> str:
        return "NOTHING"


NOTHING = _Nothing()


class WorldVecEnv(VecEnv):
    """B worlds with L learners each as B * L rows of one shared policy; row i is learner i % L of world i // L.

    A world that ends is reset in the same step. The infos of its rows then hold `terminal_observation`,
    `TimeLimit.truncated` (so that PPO bootstraps at time limits and not at deaths), `is_success`, `reward/NAME` (each
    reward term, summed over the episode), and the metrics of the world; all other infos are one empty, read-only
    dictionary.

    Seeds: `seed(s)` gives world k the seed s + k at the next reset; later episodes of a world continue its seed. The
    next reset also seeds `np_random` with s, for wrappers; worlds draw nothing from it.

    Stable-Baselines3's `EvalCallback` and `evaluate_policy` need a monitor: wrap this in `WorldMonitor`.

    Args:
        task: its learners must end together, unless `leaving`.
        worlds: B.
        time_limit: decisions after which a world is truncated (default: the task's horizon).
        render_mode: "rgb_array" (world 0) or None.
        leaving: allow learners that end one by one. A row is done once, when its learner leaves, and the info of that
            step holds its `terminal_observation` and reward terms; metrics and success of the world are in the infos of
            the rows that end with it. Until the world is reset, `present` is False for the row, its reward is 0 and its
            actions are ignored. The row is not done again at the reset; `present` is True from then on.
        disturbance: of observations and actions (default: none).

    Raises:
        ValueError: the task's learners end one by one, and `leaving` is False.
    """

    metadata: dict[str, Any]

    def __init__(
        self, task: Task, worlds: int = 1, time_limit: int | None = None, render_mode: str | None = None,
        leaving: bool = False, disturbance: Disturbance | None = None,
    ) -> None:  # fmt: skip
        self.task = task if leaving else check_ends_together(task)
        limit, disturbance = task.horizon if time_limit is None else time_limit, disturbance or Disturbance()
        self.world = make_world(task, worlds, limit, disturbance)
        self.render_mode = render_mode
        self._screen = Screen(render_mode, render_fps(task), modes=("rgb_array",))
        self._reward_keys = reward_keys(task)
        self._actions: NDArray[Any] | None = None
        self._running = False
        self._present = np.ones((self.world.worlds, task.learners), np.bool_)
        self.spec = _spec(task, self.world.time_limit, disturbance)
        self.np_random = seeding.np_random()[0]
        super().__init__(worlds * task.learners, observation_space(task), action_space(task))
        self.metadata["render_fps"] = render_fps(task)

    @property
    def present(self) -> NDArray[np.bool_]:
        """(B L,): True for a row whose learner acts in the next step, False for one whose learner has left."""
        return self._present.reshape(-1).copy()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Give world k the seed s + k at the next reset; None draws s. Returns the seed of every row."""
        first = check_seed(seed)
        first = int(np.random.default_rng().integers(2**32)) if first is None else first
        self._seeds = [first + i // self.task.learners for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every world; return (B L, O) float32. `reset_infos` holds the seed of each row."""
        for options in self._options:
            check_options(options)
        seeds = [seed for seed in self._seeds[:: self.task.learners] if seed is not None]
        seeded = len(seeds) == self.world.worlds
        observation = self.world.reset(seeds=seeds if seeded else None)
        if seeded:
            self.np_random = seeding.np_random(seeds[0])[0]
        self._present[:] = True
        self.reset_infos = [{"seed": seed} for seed in self.world.seeds for _ in range(self.task.learners)]
        self._running = True
        self._reset_seeds()
        self._reset_options()
        return self._rows(observation)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions of all rows, (B L, A), clipped to [-1, 1]; ValueError on another shape."""
        require_episode(self._running, "step")
        rows = np.asarray(actions)
        expected = (self.num_envs, self.task.action_layout.size)
        if rows.shape != expected:
            raise ValueError(f"actions: shape {rows.shape}, must be {expected}, a row per learner of every world")
        self._actions = rows.reshape(self.world.worlds, self.task.learners, -1)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], list[Info]]:
        """Take one decision; return observations (B L, O), rewards (B L,), dones (B L,) and an info per row.

        Raises ValueError, with world and agent, on NaN.
        """
        actions, self._actions = self._actions, None
        if actions is None:
            raise ResetNeeded("step_wait: there are no actions; call step_async(actions) first")
        result = self.world.step(actions, terms="ends")
        ended = result.ended
        done = (ended[:, None] | result.terminated) & self._present
        infos: list[Info] = [NOTHING] * self.num_envs
        if done.any():
            self._write_infos(infos, result, done)
            self._present = (self._present & ~done) | ended[:, None]
        if ended.any():
            self.world.reset(mask=ended, into=result.observation)
        return self._rows(result.observation), result.reward.reshape(-1), done.reshape(-1), infos

    def _write_infos(self, infos: list[Info], result: Step, done: NDArray[np.bool_]) -> None:
        """Write the infos of the rows that are done, done (B, L); the only loop over rows."""
        worlds, learners = np.flatnonzero(done.any(axis=1)), self.task.learners
        of_world = self._final_infos(result, np.flatnonzero(result.ended))
        done_rows = done[worlds].reshape(-1)
        rows = np.flatnonzero(done).tolist()
        paid = iterate_by_name(self._reward_keys, self.world.paid[worlds].reshape(len(done_rows), -1)[done_rows])
        seen, over = self._rows(result.observation[worlds], worlds)[done_rows], result.terminated[done].tolist()
        for row, info, last, terminated in zip(rows, paid, seen, over, strict=True):
            infos[row] = info
            info["terminal_observation"] = last
            info["TimeLimit.truncated"] = not terminated  # an episode ends by termination or by the time limit
            info |= of_world.get(row // learners, {})

    def _final_infos(self, result: Step, worlds: NDArray[np.intp]) -> dict[int, Info]:
        """Return the metrics and success of each world that ended, for the infos of its rows, by world."""
        columns = {name: column[worlds].tolist() for name, column in self.world.measure().items()}
        columns["is_success"] = result.success[worlds].tolist()
        ends = (dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True))
        known = ({name: value for name, value in end.items() if value == value} for end in ends)  # NaN: no value
        return dict(zip(worlds.tolist(), known, strict=True))

    def _rows(self, observation: NDArray[np.float32], worlds: Any = slice(None)) -> NDArray[np.float32]:
        """Return a row for each learner of these worlds, (B, L, O); a subclass may extend rows here."""
        return observation.reshape(-1, self.task.layout.size)

    def close(self) -> None:
        """End the episodes and close the window; may be called twice, and reset() begins new episodes."""
        self._running, self._actions = False, None
        self._screen.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return the picture of world 0 only: one per row would repeat each world for each of its learners."""
        require_episode(self._running, "render")
        return [self._screen.show(self.world.snapshot(), "rgb_array")]

    def render(self, mode: str | None = None) -> NDArray[np.uint8] | None:
        """Return the picture of world 0, (H, W, 3) uint8, or show it ("human") in flockenv's window, without OpenCV.

        mode: `human` or `rgb_array` (default: that of the constructor).
        """
        require_episode(self._running, "render")
        return self._screen.show(self.world.snapshot(), mode)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this object (`task`, `world`, ...) for each of the rows.

        attr_name: its name; indices: of the rows (default: all).
        """
        return [getattr(self, attr_name)] * len(self._row_indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of this object; ValueError for a subset of rows, since all rows share one simulator.

        attr_name: its name; value: the new one; indices: of the rows (default: all).
        """
        if len(self._row_indices(indices)) != self.num_envs:
            raise ValueError(f"set_attr({attr_name!r}): the rows share one simulator; leave out indices")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of this object once, and return its result for each of the rows.

        method_name: its name; method_args, method_kwargs: its arguments; indices: of the rows (default: all).
        """
        rows = self._row_indices(indices)
        return [getattr(self, method_name)(*method_args, **method_kwargs)] * len(rows)

    def env_is_wrapped(
        self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each of the rows: they contain no gymnasium environment that could be wrapped.

        wrapper_class: any; indices: of the rows (default: all).
        """
        return [False] * len(self._row_indices(indices))

    def _row_indices(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))


def _spec(task: Task, time_limit: int | None, disturbance: Disturbance) -> EnvSpec | None:
    """Return the spec from which `gymnasium.make_vec` makes the same worlds; None for a task without an id."""
    name = type(task).__name__
    if name not in ENVIRONMENTS:
        return None
    spec = copy.deepcopy(gymnasium.spec(ENVIRONMENTS[name].id))
    spec.max_episode_steps = time_limit
    for name, field in type(task).model_fields.items():
        value = getattr(task, name)
        if name != "horizon" and (name == "learners" or value != field.get_default(call_default_factory=True)):
            spec.kwargs[name] = value  # always learners: the default of an id is 1, that of a task is all
    spec.kwargs.update(disturbance.model_dump(exclude_defaults=True))
    return spec


class WorldMonitor(VecMonitor):
    """VecMonitor over a WorldVecEnv: the length of an episode is the number of steps in which its learner acted.

    VecMonitor alone also counts the steps in which the row of a learner that has left waits for its world to end. Both
    agree if all learners of a world end together.

    Args:
        venv: a WorldVecEnv.
        filename, info_keywords: those of VecMonitor.
    """

    venv: WorldVecEnv

    def step_wait(self) -> VecEnvStepReturn:
        """Take one decision; infos of rows that are done hold `episode`: return `r`, length `l` and time `t` in s."""
        waiting = ~self.venv.present
        outcome = super().step_wait()
        self.episode_lengths[waiting] = 0
        return outcome


def load_sb3_zip(
    path: str | os.PathLike[str], trust_pickle: bool = False, algorithm: type[BaseAlgorithm] = PPO
) -> BaseAlgorithm:
    """Load a model that Stable-Baselines3 saved; this RUNS CODE from the file (cloudpickle, SB3 #2281).

    path: of the zip file; algorithm: the class that saved it (default: PPO).

    Policies of flockenv are safetensors, which run no code: flockenv.players.policy.MlpPolicy.load.

    Raises:
        ValueError: trust_pickle is not True, or there is no such file.
    """
    file = Path(path)
    if trust_pickle is not True:
        raise ValueError(
            f"{file}: a Stable-Baselines3 zip runs code when it is read; if you trust it, pass trust_pickle=True"
        )
    if not file.is_file():
        raise ValueError(f"{file}: no such file")
    return algorithm.load(file, device="cpu")
