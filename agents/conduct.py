"""Conduct of players: which learners they harm, how often they stand still, how much force and time they use."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.envs.world import Rows, Step, World
from flockenv.tasks import Task

__all__ = ["METRICS", "SLOW", "ConductWorld"]

SLOW = 0.1
"""A learner stands still below this share of its maximum speed."""

METRICS = ("harmed", "frozen", "effort", "time")
"""What `ConductWorld.measure` adds to the metrics of a task."""


class ConductWorld(World):
    """A World that also measures the conduct of its learners, as long as they are in the world.

    * `harmed`: number of learners that the task's term of harm (`Task.harm`) ever charged;
    * `frozen`: share of their time in which they stand still, slower than SLOW of their maximum speed;
    * `effort`: mean of (force / max_force)^2 over their time, as passed in their actions;
    * `time`: mean time until they leave or the episode ends, s.

    Raises ValueError for a task without a term of harm.
    """

    def __init__(self, task: Task, worlds: int = 1, time_limit: int | None = None) -> None:
        """Make B = `worlds` >= 1 worlds; the arguments are those of World."""
        if not task.harm:
            raise ValueError(f"task {task.name!r}: has no reward term of harm")
        super().__init__(task, worlds, time_limit)
        self._harm = task.terms.index(task.harm)
        self._slow = SLOW * np.asarray(task.scene.body.max_speed[: task.learners])
        self._begin()

    def _begin(self) -> None:
        self._harmed = np.zeros((self.worlds, self.learners), np.bool_)
        self._conduct = {name: np.zeros(self.worlds) for name in ("frozen", "effort", "decisions")}

    def reset(self, seeds: Any = None, mask: ArrayLike | None = None, into: Rows | None = None) -> Rows:
        """Begin episodes in all worlds, as `World.reset` does; ValueError for a mask."""
        if mask is not None:
            raise ValueError("mask: conduct is measured over whole episodes, in worlds that begin together")
        self._begin()
        return super().reset(seeds, into=into)

    def step(self, actions: ArrayLike, terms: Literal["steps", "ends"] = "steps") -> Step:
        """Take one decision in each world, as `World.step` does, and measure it."""
        result = super().step(actions, "steps")
        inside = result.alive
        self._harmed |= result.terms[..., self._harm] < 0
        speed = np.linalg.norm(self.state.vel[:, : self.learners], axis=2)
        force = np.minimum(np.square(np.clip(np.asarray(actions, float), -1.0, 1.0)).sum(axis=2), 1.0)
        self._conduct["frozen"] += (inside & (speed < self._slow)).sum(axis=1)
        self._conduct["effort"] += np.where(inside, force, 0.0).sum(axis=1)
        self._conduct["decisions"] += inside.sum(axis=1)
        return result

    def measure(self) -> dict[str, NDArray[np.float64]]:
        """Return the metrics of the task, and those of conduct, each (B,)."""
        decisions = np.maximum(self._conduct["decisions"], 1.0)
        conduct = {
            "harmed": self._harmed.sum(axis=1).astype(float),
            "frozen": self._conduct["frozen"] / decisions,
            "effort": self._conduct["effort"] / decisions,
            "time": self._conduct["decisions"] * self.task.control_dt / self.learners,
        }
        return {**super().measure(), **conduct}
