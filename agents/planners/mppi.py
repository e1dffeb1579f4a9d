"""Sampling MPC: tries out action sequences in copies of the world (`--players rules,ppo,agents/planners/mppi.py`).

Before each decision every world is copied SAMPLES times. The copies play the plan so far with noise, and one plays the
tuned rules, for HORIZON decisions; the new plan is the mean of their actions, weighted by exp(return / temperature),
for each learner by its own return. Its first action is done, the rest is the plan of the next decision. Source:
model predictive path integral control, Williams et al. 2017, ICRA, 1714 (information-theoretic MPC).

It is no fair opponent: it sees the whole state, knows the task's laws and rewards exactly, takes milliseconds for a
decision, and its copies have neither noise nor late actions. The only thing that it does not know is chance: the random
numbers of its copies differ from those of the world. So it shows how much more is possible in a task.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.envs.world import World
from flockenv.players.rules import player as rules_of
from flockenv.tasks import Task

kind = "planner"

SAMPLES = 48
HORIZON = 20  # decisions
SPREAD, PERSISTENCE = 0.5, 0.7  # standard deviation of the noise on actions, and its correlation between decisions
TEMPERATURE = 0.15  # in standard deviations of the samples' returns

WORLD_SECOND = ("state.x", "state.v", "state.obstacle_x", "state.frame", "state.inner", "paid", "memory")
"""Arrays of a World whose second axis is the world; of the others it is the first."""

Floats = NDArray[np.float64]


class Mppi:
    """The planner of a task; `watch` gives it the worlds that it plays in."""

    def __init__(self, task: Task) -> None:
        self.task, self.rules = task, rules_of(task)
        self.shape = (HORIZON, task.learners, task.action_layout.size)
        self.random = np.random.default_rng(0)
        self.plan: Floats = np.zeros((0, *self.shape))
        self.copies: World | None = None

    def watch(self, world: World) -> None:
        """See the state of these worlds from now on."""
        self.world, self.copies = world, None

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], None]:
        """Return actions (R, A) for the observations (R, O) of the learners of the first worlds that it watches."""
        rows = np.asarray(observation)
        worlds = -(-len(rows) // self.task.learners)
        if len(self.plan) != worlds or episode_start is None or np.all(episode_start):
            self.plan = np.zeros((worlds, *self.shape))
        missing = worlds * self.task.learners - len(rows)
        self._improve(np.concatenate([rows, rows[:1].repeat(missing, axis=0)]), worlds)
        action = self.plan[:, 0].reshape(-1, self.shape[2])[: len(rows)].astype(np.float32)
        self.plan = np.concatenate([self.plan[:, 1:], self.plan[:, -1:]], axis=1)
        return action, None

    def _improve(self, rows: NDArray[np.float32], worlds: int) -> None:
        """Replace the plan of each world by the weighted mean of sampled plans."""
        plans = np.clip(self.plan[:, None] + self._noise(worlds), -1.0, 1.0)
        returns = self._play(plans, rows)
        spread = returns.std(axis=1, keepdims=True) + 1e-9
        weights = np.exp((returns - returns.max(axis=1, keepdims=True)) / (TEMPERATURE * spread))
        weights /= weights.sum(axis=1, keepdims=True)
        self.plan = np.einsum("bkl,bkhla->bhla", weights, plans)

    def _noise(self, worlds: int) -> Floats:
        """Return noise for every sample, (B, K, H, L, A), correlated in time; none for the first sample."""
        noise = SPREAD * self.random.normal(size=(worlds, SAMPLES, *self.shape))
        fresh = np.sqrt(1 - PERSISTENCE**2)
        for k in range(1, HORIZON):
            noise[:, :, k] = PERSISTENCE * noise[:, :, k - 1] + fresh * noise[:, :, k]
        noise[:, 0] = 0.0
        return noise

    def _play(self, plans: Floats, rows: NDArray[np.float32]) -> Floats:
        """Play all plans in copies of the worlds; return the sum of rewards of each learner, (B, K, L).

        The last plan of each world is that of the tuned rules, whose actions are written into it.
        """
        worlds, learners = len(plans), self.task.learners
        copies, state = self._copy_worlds(worlds), None
        returns, playing = np.zeros((worlds, SAMPLES, learners)), np.ones((worlds, SAMPLES, learners), np.bool_)
        for k in range(HORIZON):
            action, state = self.rules.predict(rows, state, np.full(len(rows), k == 0))
            plans[:, -1, k] = action.reshape(worlds, learners, -1)
            step = copies.step(plans[:, :, k].reshape(-1, learners, self.shape[2]))
            returns += np.where(playing, step.reward.reshape(returns.shape), 0.0)
            playing &= ~step.terminated.reshape(returns.shape)
            rows = step.observation.reshape(worlds, SAMPLES, learners, -1)[:, -1].reshape(worlds * learners, -1)
        return returns

    def _copy_worlds(self, worlds: int) -> World:
        """Return copies of the first worlds, SAMPLES of each, with other random numbers than theirs."""
        if self.copies is None or self.copies.worlds != worlds * SAMPLES:
            self.copies = World(self.task, worlds * SAMPLES)
            self.copies.reset(0)
        arrays = {}
        seen = self.world.arrays()
        for name in self.copies.arrays():  # a disturbed world has arrays besides: copies are not disturbed
            axis = 1 if name in WORLD_SECOND else 0
            arrays[name] = np.repeat(seen[name].take(range(worlds), axis), SAMPLES, axis)
        arrays["state.key"] ^= np.uint64(self.random.integers(2**63))
        self.copies.restore(arrays)
        return self.copies


def player(task: Task) -> Mppi:
    """Return the planner of a task."""
    return Mppi(task)
