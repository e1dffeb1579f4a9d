"""The jobs of agents.transfer: a player under a setting, and a round of timing all settings."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.transfer_report import Cell, Clock, Setting
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.world import World
from flockenv.evaluation import worlds_for
from flockenv.jobs import Job, Store, records
from flockenv.physics.integrators import RK4
from flockenv.players.policy import Policy
from flockenv.studies.play_jobs import Player, episodes_of_bytes, play_job, player_digest
from flockenv.tasks import Task

__all__ = ["Plan", "cell_job", "clock_of", "jobs_by_kernel", "read_again", "read_cells", "round_jobs"]

DECISIONS = 30
"""Decisions that are replayed for timing, from the start of the episodes."""
REFERENCE, LEAST_FINER = 64, 8
"""Steps per decision of the reference for positions, RK4, and its least ratio to those of the finest setting."""

Actions = list[NDArray[Any]]


@dataclass(frozen=True)
class Plan:
    """The plan of one task: players, worlds and settings, the trained one first."""

    task: Task
    settings: tuple[Setting, ...]
    players: tuple[Player, ...]
    worlds: int
    seed: int
    rounds: int
    trust_pickle: bool = False
    disturbance: Disturbance | None = None

    @property
    def first(self) -> int:
        """Seed of the first world."""
        return worlds_for("evaluation", self.seed, self.worlds)

    @property
    def trained_setting(self) -> Setting:
        """The setting that players were made for."""
        return self.settings[0]

    @property
    def pilot(self) -> Player:
        """The player whose actions are replayed for timing, and which the verdict is about."""
        return self.players[-1]

    def policy(self, player: Player, task: Task) -> Policy:
        """Return a new instance of a player, without any state."""
        return player.policy(task, self.seed, self.trust_pickle)


# --- playing ----------------------------------------------------------------------------------------------------------


def cell_job(plan: Plan, setting: Setting, player: Player, kind: str = "transfer") -> Job:
    """Return the job that plays all worlds under one setting with one player."""
    task = setting.applied_to(plan.task)
    return play_job(
        kind, task, player, plan.worlds, plan.seed, trust_pickle=plan.trust_pickle, disturbance=plan.disturbance
    )


def jobs_by_kernel(plans: Sequence[Plan]) -> dict[tuple[str, Setting, str, bool], Job]:
    """Return all jobs that play, by task, setting, player, and whether it is the second time.

    Those that share a kernel follow one another; the trained settings are played twice.
    """
    found = {}
    for plan in plans:
        name = plan.task.name
        for setting in sorted(plan.settings, key=lambda setting: setting.solver):
            for player in plan.players:
                found[name, setting, player.name, False] = cell_job(plan, setting, player)
        for player in plan.players:  # the scores must be equal to the last bit
            again = cell_job(plan, plan.trained_setting, player, "transfer-again")
            found[name, plan.trained_setting, player.name, True] = again
    return found


def read_cells(
    plan: Plan, jobs: Mapping[tuple[str, Setting, str, bool], Job], store: Store
) -> dict[tuple[Setting, str], Cell]:
    """Return all cells of a plan."""
    keys = [(setting, player.name) for setting in plan.settings for player in plan.players]
    return {key: _read_cell(store, jobs[(plan.task.name, *key, False)]) for key in keys}


def read_again(plan: Plan, jobs: Mapping[tuple[str, Setting, str, bool], Job], store: Store) -> dict[str, Cell]:
    """Return, by player, the cells of the trained setting, played a second time."""
    names = [player.name for player in plan.players]
    return {name: _read_cell(store, jobs[plan.task.name, plan.trained_setting, name, True]) for name in names}


def _read_cell(store: Store, job: Job) -> Cell:
    episodes = store.read(job, episodes_of_bytes)
    return Cell(episodes.returns, episodes.success)


# --- timing -----------------------------------------------------------------------------------------------------------


def round_jobs(plans: Sequence[Plan]) -> list[Job]:
    """Return the rounds of timing: in each, all settings of all plans replay the same actions.

    A round goes through all settings, so that other work of the machine affects each of them alike. It needs a process
    of its own: the addresses of its arrays, which are fixed until the process ends, change the time of a small world by
    up to two fifths.
    """
    about = [
        [
            [setting.name, type(plan.task).__name__, setting.applied_to(plan.task).model_dump(mode="json")]
            for setting in plan.settings
        ]
        + [player_digest(plan.pilot, plan.task, plan.seed), plan.worlds, plan.seed]
        + ([plan.disturbance.model_dump(mode="json")] if plan.disturbance else [])
        for plan in plans
    ]
    return [
        Job(f"transfer-clock/round-{number}", _time_round, (tuple(plans), number), [about, number, platform.node()])
        for number in range(1, max(plan.rounds for plan in plans) + 1)
    ]


def _time_round(plans: Sequence[Plan], number: int) -> bytes:
    """Return the time of a decision, and in the first round the position errors, by task and setting, as bytes."""
    found = {}
    for plan in plans:
        actions = _pilot_actions(plan)
        order = plan.settings if number % 2 else plan.settings[::-1]
        times = {setting.name: _time_per_decision(plan, setting, actions) for setting in order}
        found[plan.task.name] = [times, _position_errors(plan, actions) if number == 1 else {}]
    return records.to_bytes(found)


def clock_of(plan: Plan, rounds: Sequence[Job], store: Store) -> Clock:
    """Return the times and errors of a plan from the stored rounds."""
    clock = Clock()
    for job in rounds:
        times, errors = store.read(job, _round_of_bytes)[plan.task.name]
        clock.rounds.append(times)
        clock.error_mm |= errors
    return clock


def _round_of_bytes(data: bytes) -> Any:
    """Return the record of a round; raise ValueError if a number in it is not finite."""
    found = records.from_bytes(data, ())
    numbers = [value for pair in found.values() for values in pair for value in values.values()]
    if not np.isfinite(np.array(numbers, float)).all():
        raise ValueError("damaged: must hold finite times and errors")
    return found


def _pilot_actions(plan: Plan) -> Actions:
    """Return the actions of the pilot in the first decisions of every world, under the trained setting."""
    task = plan.task
    world, policy = (
        make_world(task, plan.worlds, None, plan.disturbance or Disturbance()),
        plan.policy(plan.pilot, task),
    )
    observation, actions, state = world.reset(plan.first), [], None
    for number in range(min(DECISIONS, task.horizon)):
        rows = observation.reshape(-1, observation.shape[-1])
        action, state = policy.predict(rows, state, np.full(len(rows), number == 0), True)
        actions.append(np.asarray(action).reshape(*observation.shape[:-1], -1))
        observation = world.step(actions[-1]).observation
    return actions


def _time_per_decision(plan: Plan, setting: Setting, actions: Actions) -> float:
    """Return the median time of one decision's physics, observations and rewards, s for all worlds together."""
    world, times = World(setting.applied_to(plan.task), plan.worlds), []
    world.reset(plan.first)
    for action in actions:
        began = perf_counter()
        world.step(action)
        times.append(perf_counter() - began)
    return float(np.median(times))


def _position_errors(plan: Plan, actions: Actions) -> dict[str, float]:
    """Return, by setting, the median error of the learners' positions after one second, mm."""
    task = plan.task
    count = max(1, min(len(actions), round(1.0 / task.control_dt)))
    finest = max(setting.substeps for setting in plan.settings)
    steps = max(REFERENCE, LEAST_FINER * finest)
    exact = {"integrator": RK4(), "dtype": "float64", "dt": task.control_dt / steps}
    right = _end_positions(task.model_copy(update=exact), plan, actions[:count])
    errors = {}
    for setting in plan.settings:
        off = task.scene.space.displacement(_end_positions(setting.applied_to(task), plan, actions[:count]), right)
        errors[setting.name] = 1e3 * float(np.median(np.linalg.norm(off, axis=-1)))
    return errors


def _end_positions(task: Task, plan: Plan, actions: Actions) -> NDArray[np.float64]:
    """Return the positions of the learners after some actions, (B, L, D) m."""
    world = World(task, plan.worlds)
    world.reset(plan.first)
    for action in actions:
        world.step(action)
    return np.asarray(world.state.pos[:, : task.learners], np.float64)
