"""Stable-Baselines3's face: every learner of every world is one row of a VecEnv, without subprocesses or SuperSuit.

Worlds on several threads and torch share the cores: on few of them, GOMP_SPINCOUNT=10000 in the environment keeps
torch's threads from spinning where the worlds' would run (docs/performance.md, Training).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from gymnasium import Wrapper
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from flockenv.envs.face import (
    Screen,
    action_space,
    begun,
    checked_options,
    checked_seed,
    named,
    observation_space,
    render_fps,
    together,
)
from flockenv.world import Step, World

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from flockenv.tasks import Task

__all__ = ["WorldVecEnv", "load_sb3_zip"]

Info = dict[str, Any]


class _Nothing(Info):
    """The info of a row of which there is nothing to tell: one for all of them, so it cannot be written.

    `info.copy()` gives a dictionary of one's own; pickled or deeply copied it is still this one.
    """

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError("this info is empty and shared by many rows: write into a copy, info = info.copy()")

    __setitem__ = setdefault = update = __ior__ = _refuse

    def __reduce__(self) -> str:
        return "NOTHING"


NOTHING = _Nothing()


class WorldVecEnv(VecEnv):
    """B worlds with L learners each as B * L rows of one shared policy; row i is learner i % L of world i // L.

    A world that ended begins anew in the same step. The infos of its rows then hold `terminal_observation`,
    `TimeLimit.truncated` (so that PPO bootstraps time limits and not deaths), `is_success`, `terms` (sums over the
    episode), and the metrics of the world; all other infos are one empty dictionary that refuses to be written.

    Seeds: `seed(s)` gives world k the seed s + k at the next reset; a world goes on with the next episodes of its seed.

    Args:
        task: of which all learners of a world end together, unless `leaving`.
        worlds: B.
        time_limit: decisions after which a world is truncated; None = the task's own horizon.
        render_mode: "rgb_array" (world 0) or None.
        leaving: let learners end one by one. A row is done when its learner is; until its world begins anew it is paid
            nothing and is done in every step, so that nothing that is learned of it reaches across.

    Raises:
        ValueError: the task's learners end one by one, for which a row has no meaning after its end, and not `leaving`.
    """

    def __init__(
        self, task: Task, worlds: int = 1, time_limit: int | None = None, render_mode: str | None = None,
        leaving: bool = False,
    ) -> None:  # fmt: skip
        self.task = task if leaving else together(task)
        self.world = World(task, worlds, time_limit=task.horizon if time_limit is None else time_limit)
        self.render_mode = render_mode
        self._screen = Screen(render_mode, render_fps(task), modes=("rgb_array",))
        self._actions: NDArray[Any] | None = None
        self._running = False
        super().__init__(worlds * task.learners, observation_space(task), action_space(task))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Give world k the seed s + k at the next reset; None draws s. Returns the seed of every row."""
        first = checked_seed(seed)
        first = int(np.random.default_rng().integers(2**32)) if first is None else first
        self._seeds = [first + i // self.task.learners for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every world; return (B L, O) float32. `reset_infos` says which seed each row has."""
        for options in self._options:
            checked_options(options)
        seeds = [seed for seed in self._seeds[:: self.task.learners] if seed is not None]
        observation = self.world.reset(seeds=seeds if len(seeds) == self.world.worlds else None)
        self.reset_infos = [{"seed": seed} for seed in self.world.seeds for _ in range(self.task.learners)]
        self._running = True
        self._reset_seeds()
        self._reset_options()
        return self._rows(observation)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of all rows, (B L, A), clipped to [-1, 1]; ValueError on another shape."""
        begun(self._running, "step")
        rows = np.asarray(actions)
        expected = (self.num_envs, self.task.action_layout.size)
        if rows.shape != expected:
            raise ValueError(f"actions: shape {rows.shape}, must be {expected}, a row per learner of every world")
        self._actions = rows.reshape(self.world.worlds, self.task.learners, -1)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], list[Info]]:
        """Act for one control_dt; return observations (B L, O), rewards (B L,), dones (B L,) and an info per row.

        Raises ValueError that names world and agent on NaN.
        """
        actions, self._actions = self._actions, None
        if actions is None:
            raise ResetNeeded("step_wait: there are no actions; call step_async(actions) first")
        result = self.world.step(actions, terms="ends")
        ended = result.truncated | result.terminated.all(axis=1)
        infos: list[Info] = [NOTHING] * self.num_envs
        if ended.any():
            self._tell(infos, result, np.flatnonzero(ended))
            self.world.reset(mask=ended, into=result.observation)
        done = (ended[:, None] | result.terminated).reshape(-1)
        return self._rows(result.observation), result.reward.reshape(-1), done, infos

    def _tell(self, infos: list[Info], result: Step, worlds: NDArray[np.intp]) -> None:
        """Write how the episodes that end in this step ended; the only loop over rows."""
        learners, of_world = self.task.learners, self._ends(result, worlds)
        rows = (worlds[:, None] * learners + np.arange(learners)).ravel().tolist()
        paid = named(self.task.terms, self.world.paid[worlds].reshape(len(rows), -1))
        seen, over = self._rows(result.observation[worlds], worlds), result.terminated.reshape(-1).tolist()
        for k, (row, terms, last) in enumerate(zip(rows, paid, seen, strict=True)):
            infos[row] = info = of_world[k // learners].copy()
            info["terms"], info["terminal_observation"] = terms, last
            info["TimeLimit.truncated"] = bool(result.truncated[row // learners]) and not over[row]

    def _ends(self, result: Step, worlds: NDArray[np.intp]) -> list[Info]:
        """Return what all rows of a world are told of its end, for each of these worlds."""
        columns = {name: column[worlds].tolist() for name, column in self.world.measure().items()}
        columns["is_success"] = result.success[worlds].tolist()
        ends = (dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True))
        return [{name: value for name, value in end.items() if value == value} for end in ends]  # NaN: no value

    def _rows(self, observation: NDArray[np.float32], worlds: Any = slice(None)) -> NDArray[np.float32]:
        """Return a row for each learner of these worlds, (B, L, O); one who shows more than that does it here."""
        return observation.reshape(-1, self.task.layout.size)

    def close(self) -> None:
        """End the episodes and close the window; may be called twice, and reset() begins anew."""
        self._running, self._actions = False, None
        self._screen.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return the picture of world 0: a picture per row would show every world as often as it has learners."""
        begun(self._running, "render")
        return [self._screen.show(self.world.snapshot(), "rgb_array")]

    def render(self, mode: str | None = None) -> NDArray[np.uint8] | None:
        """Return the picture of world 0, (H, W, 3) uint8, or show it ("human") in our window, which needs no OpenCV."""
        begun(self._running, "render")
        return self._screen.show(self.world.snapshot(), mode)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this face (`task`, `world`, ...) for each of the rows."""
        return [getattr(self, attr_name)] * len(self._picked(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of this face; ValueError for some rows only, since all rows share one simulator."""
        if len(self._picked(indices)) != self.num_envs:
            raise ValueError(f"set_attr({attr_name!r}): the rows share one simulator; leave out indices")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of this face once, and return its result for each of the rows."""
        picked = self._picked(indices)
        return [getattr(self, method_name)(*method_args, **method_kwargs)] * len(picked)

    def env_is_wrapped(
        self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each of the rows: there is no gymnasium environment inside that could be wrapped."""
        return [False] * len(self._picked(indices))

    def _picked(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))


def load_sb3_zip(
    path: str | os.PathLike[str], trust_pickle: bool = False, algorithm: type[BaseAlgorithm] = PPO
) -> BaseAlgorithm:
    """Read a model that Stable-Baselines3 saved, which RUNS CODE from the file (cloudpickle, SB3 #2281).

    Our own policies are safetensors and need none of this: flockenv.policy.MlpPolicy.load.

    Raises:
        ValueError: trust_pickle is not True, or there is no such file.
    """
    file = Path(path)
    if trust_pickle is not True:
        raise ValueError(
            f"{file}: a Stable-Baselines3 zip runs code when it is read; if you made it, say trust_pickle=True"
        )
    if not file.is_file():
        raise ValueError(f"{file}: no such file")
    return algorithm.load(file, device="cpu")
