"""World: B independent worlds of one task, stepped together. Every face is a thin view of this."""

from __future__ import annotations

import copy
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv import state as states
from flockenv.kernels import load
from flockenv.noise import MASK, key_of
from flockenv.scene import MEMORY_LIMIT, Workspace
from flockenv.snapshot import Snapshot
from flockenv.state import State
from flockenv.tasks import Task
from flockenv.tasks.base import task_source

__all__ = ["Step", "World"]

Rows = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Step:
    """What one decision brought; every array is fresh, nobody else holds it. B worlds, L learners."""

    observation: Rows  # (B, L, O)
    reward: NDArray[np.float64]  # (B, L)
    terms: NDArray[np.float64]  # (B, L, K), reward = sum over K
    terminated: NDArray[np.bool_]  # (B, L)
    truncated: NDArray[np.bool_]  # (B,) the time limit, nothing else
    success: NDArray[np.bool_]  # (B,)
    alive: NDArray[np.bool_]  # (B, L) after the step

    @property
    def ended(self) -> NDArray[np.bool_]:
        """(B,): the episode is over, one way or the other."""
        return np.asarray(self.truncated | self.terminated.all(axis=1))


class World:
    """B worlds of one task. World k of seed s is the same world as the only one of seed s + k, bit for bit.

    It never resets by itself: a face decides when. Raises ValueError on actions of a wrong shape or that are not
    finite, naming world and agent, before anything has moved; RuntimeError on a step before the first reset.
    """

    def __init__(self, task: Task, worlds: int = 1, time_limit: int | None = None) -> None:
        """worlds: B >= 1. time_limit: decisions until truncation, none = never."""
        if not _whole(worlds) or worlds < 1:
            raise ValueError(f"worlds is {worlds!r}, must be a whole number of at least 1")
        if time_limit is not None and (not _whole(time_limit) or time_limit < 1):
            raise ValueError(f"time_limit is {time_limit}, must be a whole number of decisions, at least 1, or None")
        scene = task.scene
        bytes_ = worlds * (scene.bytes_per_world() + task.learners * 8 * task.layout.size)
        if bytes_ > MEMORY_LIMIT:
            need = f"{bytes_ / 2**30:.3g} GiB, at most {MEMORY_LIMIT / 2**30:g} allowed"
            raise ValueError(f"worlds is {worlds}: needs about {need}")
        self.task, self.worlds, self.time_limit = task, int(worlds), time_limit
        self.learners, self.agents = task.learners, scene.agents
        self.observation_size, self.action_size = task.layout.size, task.action_layout.size
        self.state = states.blank(self.worlds, self.agents, scene.dimension, task.obstacle_slots, scene.dt, scene.dtype)
        self.steps = np.zeros(self.worlds, np.int64)
        self._memory = np.zeros((task.memory, self.worlds, self.agents))
        self._seeds: list[int] | None = None
        self._episodes = np.zeros(self.worlds, np.int64)
        self._success = np.zeros(self.worlds, np.bool_)
        self._sums = np.zeros((self.worlds, len(task.measures)))
        self._last = np.zeros((self.worlds, len(task.measures)))
        self._prepare()

    def _prepare(self) -> None:
        """Make what follows from the task: kernel, parameters, scratch."""
        scene, task = self.task.scene, self.task
        self._kernel = load(f"task_{task.name}", task_source(task))
        self._numbers = np.array(list(task.parameters().values()), np.float64)
        self._params = np.array(scene.parts.parameters(), scene.dtype)
        self._body = scene.body.arrays()
        self._dt = np.dtype(scene.dtype).type(scene.dt)
        d, n = scene.dimension, self.agents
        self._scratch = (
            *(np.zeros((d, n), scene.dtype) for _ in range(3)),
            np.zeros(n, np.bool_),
            np.zeros((self.learners, self.action_size)),
            *Workspace.allocate(scene.parts, n, scene.dtype).arrays,
        )

    def __getstate__(self) -> dict[str, Any]:
        """Pickle what cannot be made anew."""
        made = ("_kernel", "_numbers", "_params", "_body", "_dt", "_scratch")
        return {name: value for name, value in vars(self).items() if name not in made}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Go on where the pickled world was."""
        vars(self).update(kept)
        self._prepare()

    def __deepcopy__(self, memo: dict[int, Any]) -> World:
        """Return a world that goes on by itself from here."""
        new = object.__new__(World)
        new.__setstate__({name: copy.deepcopy(value, memo) for name, value in self.__getstate__().items()})
        return new

    # --- episodes ---------------------------------------------------------------------------------------------------

    def reset(self, seeds: int | Sequence[int] | None = None, mask: ArrayLike | None = None) -> Rows:
        """Begin episodes and return observations (B, L, O).

        seeds: an int s gives world k the seed s + k; a sequence gives each its own; none begins the next episode of the
        same seeds (a first one without seeds draws them from the system). mask (B,): only these worlds begin anew.
        """
        rows = np.ones(self.worlds, np.bool_) if mask is None else np.asarray(mask)
        if rows.shape != (self.worlds,) or rows.dtype != np.bool_:
            raise ValueError(f"mask has shape {rows.shape} and type {rows.dtype}, expected ({self.worlds},) bool")
        if self._seeds is None and not rows.all():
            raise RuntimeError("the first reset must begin every world: no mask yet")
        self._seed(seeds, rows)
        observation = np.empty((self.worlds, self.learners, self.observation_size), np.float32)
        s = self.state
        self._kernel.begin(
            rows, s.x, s.v, s.alive, s.tick, s.obstacle_x, s.obstacle_radius, s.key, self._memory, self.steps,
            *self._body[1:], self._numbers, observation,
        )  # fmt: skip
        for numbers in (self._sums, self._last, self._success):
            numbers[rows] = 0
        return observation

    def _seed(self, seeds: int | Sequence[int] | None, rows: NDArray[np.bool_]) -> None:
        if seeds is None and self._seeds is None:
            seeds = secrets.randbits(31)
        if seeds is None:
            self._episodes[rows] += 1
        else:
            given = self._checked(seeds)
            old = self._seeds or given
            self._seeds = [g if r else o for g, o, r in zip(given, old, rows, strict=True)]
            self._episodes[rows] = 0
        assert self._seeds is not None
        for b in np.flatnonzero(rows):
            self.state.key[b] = key_of(self._seeds[b], int(self._episodes[b]))

    def _checked(self, seeds: int | Sequence[int]) -> list[int]:
        """Return one seed per world, or refuse."""
        if not (_whole(seeds) or (isinstance(seeds, (Sequence, np.ndarray)) and not isinstance(seeds, (str, bytes)))):
            raise ValueError(f"seeds is {seeds!r}, must be a whole number, or a sequence of them, one for each world")
        several = [seeds + k for k in range(self.worlds)] if isinstance(seeds, (int, np.integer)) else list(seeds)
        if len(several) != self.worlds:
            raise ValueError(f"{len(several)} seeds for {self.worlds} worlds")
        for k, seed in enumerate(several):
            if not _whole(seed) or not 0 <= seed <= MASK:
                raise ValueError(f"seed of world {k} is {seed!r}, must be a whole number from 0 to 2^64 - 1")
        return [int(seed) for seed in several]

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of each world; empty before the first reset."""
        return tuple(self._seeds or ())

    def step(self, actions: ArrayLike) -> Step:
        """Let everybody act for control_dt; actions (B, L, A), clipped to [-1, 1]."""
        if self._seeds is None:
            raise RuntimeError("step before the first reset: call reset() first")
        given = self._actions(actions)
        b, n, s, task = self.worlds, self.learners, self.state, self.task
        observation = np.empty((b, n, self.observation_size), np.float32)
        terms = np.empty((b, n, len(task.terms)))
        over = np.zeros((b, n), np.bool_)
        success = np.zeros(b, np.bool_)
        broken, who = self._kernel.advance_worlds(
            given, s.x, s.v, s.alive, s.tick, s.obstacle_x, s.obstacle_radius, s.work, s.key, self._memory, self.steps,
            *self._body, self._params, self._dt, task.substeps, self._numbers, not task.ends_together,
            observation, terms, over, success, self._last, *self._scratch,
        )  # fmt: skip
        if broken >= 0:
            raise FloatingPointError(f"world {broken}, agent {who}: not finite at t = {s.time[broken]:g} s")
        self._sums += self._last
        self._success = success
        late = self.steps >= self.time_limit if self.time_limit is not None else np.zeros(b, np.bool_)
        return Step(observation, terms.sum(axis=2), terms, over, late, success.copy(), s.alive[:, :n].copy())

    def _actions(self, actions: ArrayLike) -> NDArray[Any]:
        given = np.asarray(actions)
        expected = (self.worlds, self.learners, self.action_size)
        if given.shape != expected:
            raise ValueError(f"actions have shape {given.shape}, expected (worlds, learners, numbers) = {expected}")
        try:
            given = np.ascontiguousarray(given, np.float64)  # one type, one compilation; exact for float32
        except (TypeError, ValueError):
            raise TypeError(f"actions are of type {given.dtype}, expected numbers in [-1, 1]") from None
        b, i, k = self._kernel.first_bad(given)
        if b >= 0:
            name = self.task.agent_names[i]
            raise ValueError(f"action {k} of {name} in world {b} is {given[b, i, k]}, must be a number in [-1, 1]")
        return given

    # --- looking at it ----------------------------------------------------------------------------------------------

    def measure(self) -> dict[str, NDArray[np.float64]]:
        """Domain metrics of the episodes so far, each (B,), by name."""
        names = self.task.measures
        sums = {name: self._sums[:, k].copy() for k, name in enumerate(names)}
        last = {name: self._last[:, k].copy() for k, name in enumerate(names)}
        return {k: np.asarray(v, float) for k, v in self.task.metrics(sums, last, self.steps).items()}

    def snapshot(self, world: int = 0) -> Snapshot:
        """Return one world at this instant, for pictures."""
        s: State = self.state
        low, high = self.task.view(s, world)
        return Snapshot(
            time=float(s.time[world]), pos=s.pos[world], vel=s.vel[world], alive=s.alive[world],
            radius=np.asarray(self.task.scene.body.radius, np.float64), roles=self.task.scene.roles,
            obstacle_centre=s.obstacles.centre[world], obstacle_radius=s.obstacle_radius[world],
            marks=self.task.marks(s, self._memory, world),
            low=np.array(low, np.float64), high=np.array(high, np.float64),
            periodic=self.task.scene.space.periodic, title=type(self.task).__name__,
        )  # fmt: skip


def _whole(value: object) -> bool:
    """Is it a whole number (True and False are none)?"""
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.bool_))
