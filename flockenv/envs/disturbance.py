"""Disturbances between World and policy: sensor noise, late actions, entities that are not detected or out of range.

The state, rewards, metrics and pictures are those of the undisturbed world; only what a policy observes, and when its
actions take effect, differ. Each environment API makes its world here, so that a disturbance has the same numbers
through all of them.

Random numbers are a function of (seed, episode, decision, learner, number of the observation), as in
maths/counter_rng.py, with a key of their own: world k of seed s is disturbed as a single world of seed s + k, for any
number of threads, and a disturbance draws none of the numbers of the simulation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from flockenv.core.record import Record
from flockenv.envs.world import Rows, Step, World
from flockenv.jit.decorators import kernel
from flockenv.jit.memory import zeros
from flockenv.jit.section import entry, without_dispatch
from flockenv.maths.counter_rng import mix, quick_normal, uniform
from flockenv.tasks import Task

__all__ = ["Disturbance", "DisturbedWorld", "make_world"]

_FAMILY = np.uint64(2**63)
"""Mixed into the key of a world; the simulation mixes in numbers of steps, which stay below."""


class Disturbance(Record):
    """Differences between a world and what its policy observes and does; the default is none."""

    noise: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="standard deviation of Gaussian noise on each number of an observation that is not 0, in units of "
        "its scale; the sum is clipped to the bounds",
    )
    delay: int = Field(
        default=0, ge=0, le=20, description="decisions by which actions take effect late; the first ones are 0"
    )
    dropped: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="probability that a learner does not detect an agent or obstacle in a decision: all numbers of its "
        "slot are 0, as of an empty slot",
    )
    range: float | None = Field(
        default=None,
        gt=0,
        exclude_if=lambda value: value is None,  # so that what was stored before this field stays equal
        description="m, distance beyond which other agents are not detected; their slots are 0, as empty ones",
    )
    seen: int | None = Field(
        default=None,
        ge=1,
        exclude_if=lambda value: value is None,
        description="number of agents of a kind that are detected, the nearest; the slots of the others are 0",
    )

    def __bool__(self) -> bool:
        """Return True unless it is none."""
        return self != _NONE

    def check(self, task: Task) -> None:
        """Raise ValueError, in one line, for a value that needs slots which the task has not, or that hides nothing."""
        if self.dropped > 0 and (task.layout.entities < 0).all():
            raise ValueError(f"dropped = {self.dropped:g}: must be 0 for {task.name}, which has no slots to empty")
        columns, scales, places = task.layout.agent_slots
        farthest, most = (float(limit[columns >= 0].max(initial=0)) for limit in (scales, places + 1))
        _check_limit(task, "range", self.range, farthest, f"shows other agents up to {farthest:g} m away")
        _check_limit(task, "seen", self.seen, most, f"has slots for {most:g} agent{'s' * (most > 1)} of a kind")


def _check_limit(task: Task, name: str, value: float | None, end: float, reason: str) -> None:
    """Raise ValueError unless a limit is none, or below `end`, as it hides no agent otherwise; end = 0: no slots."""
    if value is None or value < end:
        return
    none = end == 0 or (name == "seen" and end == 1)
    because = reason if end else "has no slots of other agents to empty"
    raise ValueError(f"{name} = {value:g}: must be {'None' if none else f'< {end:g}'} for {task.name}, which {because}")


_NONE = Disturbance()


def make_world(task: Task, worlds: int = 1, time_limit: int | None = None, disturbance: Disturbance = _NONE) -> World:
    """Return B worlds of a task; with no disturbance it is a plain `World`, without any cost.

    worlds: B >= 1; time_limit: decisions until truncation (default: that of the task).

    Raises ValueError for bad numbers, and for a disturbance that the task has no slots for.
    """
    return DisturbedWorld(task, worlds, time_limit, disturbance) if disturbance else World(task, worlds, time_limit)


@kernel
def _hide(entities: Any, agents: Any, reach: float, seen: int, row: Any) -> None:
    """Set the numbers of agents in a row, (O,), to 0 that are beyond `reach` m, or not among the nearest `seen`."""
    columns, scales, places = agents
    for e in range(columns.shape[0]):
        if columns[e] < 0:
            continue
        x, y = np.float64(row[columns[e]]) * scales[e], np.float64(row[columns[e] + 1]) * scales[e]
        if places[e] >= seen or x * x + y * y > reach * reach:
            for k in range(row.shape[0]):
                if entities[k] == e:
                    row[k] = 0.0


@kernel
def _disturb(
    keys: Any, steps: Any, mask: Any, low: Any, entities: Any, agents: Any, noise: float, dropped: float, reach: float,
    seen: int, rows: Any,
) -> None:  # fmt: skip
    """Disturb the observations of the worlds in the mask in place; rows (B, L, O), the others as in DisturbedWorld."""
    for b in range(rows.shape[0]):
        if not mask[b]:
            continue
        key = mix(keys[b], _FAMILY)
        for i in range(rows.shape[1]):
            if reach < math.inf or seen < rows.shape[2]:
                _hide(entities, agents, reach, seen, rows[b, i])
            for k in range(rows.shape[2]):
                x = np.float64(rows[b, i, k])
                if x == 0.0:
                    continue
                if entities[k] >= 0 and uniform(key, steps[b], i, rows.shape[2] + entities[k]) < dropped:
                    rows[b, i, k] = 0.0
                elif noise > 0.0:
                    rows[b, i, k] = min(max(x + noise * quick_normal(key, steps[b], i, k), np.float64(low[k])), 1.0)


class DisturbedWorld(World):
    """A World whose observations are disturbed and whose actions are late, with the methods of World.

    An episode begins with `delay` zero actions; the actions that are still to come when a world is reset are dropped.
    """

    def __init__(
        self, task: Task, worlds: int = 1, time_limit: int | None = None, disturbance: Disturbance = _NONE
    ) -> None:
        """Make B = `worlds` >= 1 worlds of a task.

        task: has slots that the disturbance can miss; time_limit: decisions until truncation (default: that of the
        task); disturbance: as of `make_world`.
        """
        disturbance.check(task)
        self.disturbance: Final = disturbance
        super().__init__(task, worlds, time_limit)
        shape = (self.worlds, disturbance.delay, self.learners, self.action_size)
        self._pending: Final = zeros(shape, task.scene.dtype)  # the action of decision n is at n modulo the delay

    def _compile_and_allocate(self) -> None:
        super()._compile_and_allocate()
        self._rows, layout = np.arange(self.worlds), self.task.layout
        self._entry = self._disturb = entry(_disturb)
        d = self.disturbance
        self._changes_rows = d != Disturbance(delay=d.delay)
        reach, seen = math.inf if d.range is None else d.range, layout.size if d.seen is None else d.seen
        self._bounds = layout.low, layout.entities, layout.agent_slots, d.noise, d.dropped, reach, seen

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes that `_compile_and_allocate` cannot make again."""
        derived = ("_rows", "_entry", "_disturb", "_bounds", "_changes_rows")
        return {name: value for name, value in super().__getstate__().items() if name not in derived}

    def reset(
        self, seeds: int | Sequence[int] | None = None, mask: ArrayLike | None = None, into: Rows | None = None
    ) -> Rows:
        """Begin episodes and return observations (B, L, O), as `World.reset` does."""
        observation = super().reset(seeds, mask, into)
        begun = self._all_worlds if mask is None else np.array(mask)
        self._pending[begun] = 0
        self._disturb_rows(observation, self._all_worlds if into is None else begun)
        return observation

    def step(self, actions: ArrayLike, terms: Literal["steps", "ends"] = "steps") -> Step:
        """Take one decision in each world, as `World.step` does, by the actions (B, L, A) of `delay` decisions ago."""
        result = self._step_late(actions, terms) if self.disturbance.delay else super().step(actions, terms)
        self._disturb_rows(result.observation, self._all_worlds)
        return result

    def _step_late(self, actions: ArrayLike, terms: Literal["steps", "ends"]) -> Step:
        given = self._check_actions(actions).copy()
        if not np.isfinite(given).all():
            self._raise_for_action(given)
        due = self._rows, self.steps % self.disturbance.delay
        result = super().step(self._pending[due], terms)
        self._pending[due] = given
        return result

    def _disturb_rows(self, rows: Rows, mask: NDArray[np.bool_]) -> None:
        """Disturb the observations of the worlds in the mask, (B,), in place; again, they would be another result."""
        if self._changes_rows:
            self._disturb(self.state.key, self.steps, mask, *self._bounds, rows)
            if self._disturb is self._entry:
                self._disturb = without_dispatch(self._entry)  # argument types do not change after this call

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays that change during episodes, by name, as views; see `World.arrays`."""
        return {**super().arrays(), "pending": self._pending}
