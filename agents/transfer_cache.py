"""The cells and times of agents.transfer, stored in files: what is stored is not computed again."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from agents.compare import Player, blame
from agents.transfer_report import Cell, Clock, Setting
from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.envs.world import World
from flockenv.evaluation import rollout, task_digest, worlds_for
from flockenv.physics.integrators import RK4
from flockenv.players import NAMES
from flockenv.players.policy import Policy
from flockenv.tasks import Task
from flockenv.tasks.play import name_of

__all__ = [
    "KEPT",
    "Job",
    "Plan",
    "Round",
    "all_cells",
    "cell_path",
    "jobs",
    "play",
    "play_again",
    "play_missing",
    "rounds_missing",
    "run_clock",
    "run_round",
]  # fmt: skip

DECISIONS = 30
"""Decisions that are replayed for timing, from the start of the episodes."""
REFERENCE = 64
"""RK4 with this number of steps per decision is the reference for positions."""
KEPT = Path("runs/transfer")

Actions = list[NDArray[Any]]
Kept = TypeVar("Kept", Cell, Clock)


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


Job = tuple[Plan, tuple[Setting, ...]]
"""Settings of one plan that share a kernel: one job."""
Round = tuple[tuple[Plan, ...], int]
"""Plans to be timed, and the number of the round, from 1."""


# --- playing ----------------------------------------------------------------------------------------------------------


def play(plan: Plan, setting: Setting, player: Player) -> Cell:
    """Play all worlds under one setting with one player."""
    task = setting.applied_to(plan.task)
    with blame(player.name, task):
        episodes = rollout(task, plan.policy(player, task), plan.worlds, plan.first)
    return Cell(episodes.returns, episodes.success)


def cell_path(plan: Plan, setting: Setting, player: Player, prefix: str = "") -> Path:
    """Return the file of a cell: its name has a digest of all that its scores depend on."""
    task = setting.applied_to(plan.task)
    about = [task_digest(task), _kernel(task), _player_digest(player, plan), plan.worlds, plan.first]
    return _cache_path(plan.task, f"{prefix}{player.name}-{setting.method}-{setting.dtype}-{setting.substeps}", about)


def _cache_path(task: Task, name: str, about: list[Any]) -> Path:
    digest = hashlib.sha256(json.dumps(about).encode()).hexdigest()[:16]
    return KEPT / task.name / f"{name}-{digest}.json"


@functools.lru_cache(maxsize=512)
def _kernel(task: Task) -> str:
    """Return the name of a task's compiled code, which holds a digest of every law in it."""
    return name_of(task)


def _player_digest(player: Player, plan: Plan) -> str:
    """Return a digest of a player: of its file, or of its code, parameters and weights."""
    known = player.spec in NAMES
    return _known_player_digest(player, plan) if known else hashlib.sha256(Path(player.spec).read_bytes()).hexdigest()


@functools.lru_cache(maxsize=512)
def _known_player_digest(player: Player, plan: Plan) -> str:
    policy = plan.policy(player, plan.task)
    weights = (getattr(policy, "card", None) or {}).get("sha256", "")
    code = Path(inspect.getfile(type(policy))).read_text(encoding="utf-8")
    return hashlib.sha256(f"{policy!r} {weights} {code}".encode()).hexdigest()


def _store(path: Path, content: Any) -> None:
    with new_folder(path.parent), replace_file(path) as file:
        file.write(json.dumps(content, allow_nan=False).encode())


def _read(path: Path, of_json: Callable[[Any], Kept]) -> Kept:
    """Return the content of a file; raise ValueError, in one line that names it, if it is invalid."""
    try:
        return of_json(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{path} is damaged: {why}; delete it, and the same command makes it anew") from None


def _cell_of(content: Any, worlds: int) -> Cell:
    cell = Cell.of_json(content)
    if cell.returns.shape != (worlds,) or cell.success.shape != (worlds,) or not np.isfinite(cell.returns).all():
        raise ValueError(f"must hold a finite return and a success of each of {worlds} worlds")
    return cell


def _clock_of(content: Any) -> Clock:
    clock = Clock(**content)
    numbers = [value for times in [*clock.rounds, clock.error_mm] for value in times.values()]
    if not np.isfinite(np.array(numbers, float)).all():
        raise ValueError("must hold finite times and errors")
    return clock


def _cell(plan: Plan, setting: Setting, player: Player, prefix: str = "") -> Cell:
    """Return a cell from its file; if there is none, play it first."""
    path = cell_path(plan, setting, player, prefix)
    if not path.is_file():
        _store(path, play(plan, setting, player).to_json())
    return _read(path, functools.partial(_cell_of, worlds=plan.worlds))


def play_missing(job: Job) -> tuple[str, int]:
    """Play and store the cells of a job that are not stored yet; return its name, and the number of all its cells."""
    plan, settings = job
    for setting, player in product(settings, plan.players):
        _cell(plan, setting, player)
    return f"{plan.task.name}: {settings[0].solver}", len(settings) * len(plan.players)


def jobs(plan: Plan) -> Iterator[Job]:
    """Yield settings that share a kernel together, so that it is compiled once, if any of their cells is missing."""
    for solver in dict.fromkeys(setting.solver for setting in plan.settings):
        settings = tuple(s for s in plan.settings if s.solver == solver)
        if not all(cell_path(plan, *which).is_file() for which in product(settings, plan.players)):
            yield plan, settings


def all_cells(plan: Plan) -> dict[tuple[Setting, str], Cell]:
    """Return all cells of a plan."""
    return {(s, player.name): _cell(plan, s, player) for s, player in product(plan.settings, plan.players)}


def play_again(plan: Plan) -> dict[str, Cell]:
    """Return, by player, the cells of the trained setting, played a second time: they must be equal to the last bit."""
    return {player.name: _cell(plan, plan.trained_setting, player, "again-") for player in plan.players}


# --- timing -----------------------------------------------------------------------------------------------------------


def run_clock(plan: Plan, rounds: int) -> Clock:
    """Replay the same actions under every setting; return the position errors, and the time of a decision per round.

    A round goes through all settings, so that other work of the machine affects each of them alike; rounds that are
    stored are not run again.
    """
    path, clock = _clock_path(plan), _read_clock(plan)
    if len(clock.rounds) >= rounds:
        return clock
    actions = _pilot_actions(plan)
    if not clock.error_mm:
        clock.error_mm.update(_position_errors(plan, actions))
    for number in range(len(clock.rounds), rounds):
        order = plan.settings if number % 2 == 0 else plan.settings[::-1]
        clock.rounds.append({setting.name: _time_per_decision(plan, setting, actions) for setting in order})
        _store(path, {"rounds": clock.rounds, "error_mm": clock.error_mm})
    return clock


def rounds_missing(plans: Sequence[Plan]) -> list[Round]:
    """Return the rounds that are not stored for all plans yet."""
    done = min(len(_read_clock(plan).rounds) for plan in plans)
    return [(tuple(plans), number) for number in range(done + 1, max(plan.rounds for plan in plans) + 1)]


def run_round(job: Round) -> tuple[str, int]:
    """Run one round for every plan; return a description, and the number of plans.

    Each round needs a process of its own: the addresses of its arrays, which are fixed until the process ends, change
    the time of a small world by up to two fifths.
    """
    plans, number = job
    for plan in plans:
        run_clock(plan, number)
    return f"by the clock: round {number}", len(plans)


def _clock_path(plan: Plan) -> Path:
    kernels = [[task_digest(s.applied_to(plan.task)), _kernel(s.applied_to(plan.task))] for s in plan.settings]
    return _cache_path(
        plan.task, "clock", [kernels, _player_digest(plan.pilot, plan), plan.worlds, plan.first, DECISIONS]
    )


def _read_clock(plan: Plan) -> Clock:
    path = _clock_path(plan)
    return _read(path, _clock_of) if path.is_file() else Clock()


def _pilot_actions(plan: Plan) -> Actions:
    """Return the actions of the pilot in the first decisions of every world, under the trained setting."""
    task = plan.task
    world, policy = World(task, plan.worlds), plan.policy(plan.pilot, task)
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
    exact = {"integrator": RK4(), "dtype": "float64", "dt": task.control_dt / REFERENCE}
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
