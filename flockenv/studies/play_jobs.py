"""Players as the command line names them, and the job that plays one of them in many worlds."""

from __future__ import annotations

import functools
import hashlib
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flockenv.core.errors import printable
from flockenv.core.warnings import OtherTaskWarning
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.world import bytes_per_world, first_step
from flockenv.evaluation import Episodes, Playable, Purpose, Recording, rollout, worlds_for
from flockenv.jobs import Job, records
from flockenv.model.appearance import Appearance
from flockenv.model.snapshot import Mark, Snapshot
from flockenv.players import ALL_SEEDS, NAMES, SEEDED, known_name, load_player, other_tasks, seeds_of_player
from flockenv.players.files import SUFFIXES, PlayerError
from flockenv.players.policy import Policy
from flockenv.tasks import Task

__all__ = [
    "Player", "Worlds", "blame", "episodes_of_bytes", "members_of", "play_job", "player_digest", "players_in_order",
    "players_of", "usual_players",
]  # fmt: skip

NAME = re.compile(r"\w[\w.@+-]{0,39}")
"""A player's name becomes a key, a table cell, a label, a file and a piece of HTML."""

PLAYING = 350 * 2**20
"""Bytes that a process needs to play, besides its worlds: libraries, and compiling a kernel; 180 to 340 MiB."""

KINDS = (Episodes, Recording, Snapshot, Mark, Appearance)
"""The classes in a record of episodes."""


@dataclass(frozen=True)
class Player:
    """A player: its specification (a known name or a file), and its name in the tables."""

    spec: str
    name: str

    @classmethod
    def of(cls, spec: str) -> Player:
        """Return a player; a file is named by its stem, the players of all seeds without "@*".

        Raises:
            ValueError: a name that is not valid in tables.
        """
        name = Path(spec).stem if Path(spec).suffix.lower() in SUFFIXES else spec.removesuffix(ALL_SEEDS)
        if not NAME.fullmatch(name):
            raise ValueError(f"--players {printable(spec)}: a name is up to 40 letters, digits and _ . @ + -")
        return cls(spec, name)

    def policy(self, task: Task, seed: int, trust_pickle: bool = False) -> Policy:
        """Return the policy, ready to play a task; raise ValueError, in one line with its name, if it cannot."""
        with blame(self.name, task, ValueError), warnings.catch_warnings():
            warnings.simplefilter("ignore", OtherTaskWarning)  # the results list the differences
            return load_player(self.spec, task, seed, trust_pickle)


@dataclass(frozen=True)
class Worlds:
    """The worlds of a job: `make(task, worlds, time limit)`, which is pickled; `about`: all that it depends on."""

    make: Callable[[Task, int, int], Playable]
    about: Any


@contextmanager
def blame(player: str, task: Task, *clear: type[Exception]) -> Iterator[None]:
    """Add player and task to an error that its `predict` raises or its actions cause; `clear` errors stay as they are.

    A PlayerError names the file already; the task is added.
    """
    try:
        yield
    except clear:
        raise
    except PlayerError as error:
        raise PlayerError(f"{error} (task {task.name!r})") from error
    except (Exception, SystemExit) as error:
        raise ValueError(f"player {player!r}, task {task.name!r}: {type(error).__name__}: {error}") from error


def usual_players(tasks: Sequence[Task], ending: str = "") -> list[str]:
    """Return the default players: the named ones that can play one of the tasks; of published ones the textbook.

    ending: of the names of players that have seeds; with ALL_SEEDS, they play with all of them.
    """
    shown = [name for name in NAMES if not name.endswith("_published")]
    usual = [name for name in shown if any(not other_tasks(name, task.name) for task in tasks)]
    return [f"{name}{ending}" if name in SEEDED else name for name in usual]


def players_of(tasks: Sequence[Task], players: Sequence[Player]) -> dict[str, list[Player]]:
    """Return the players of each task by its name: all except hand-written ones of other tasks in this comparison.

    Raises:
        ValueError: a task without a player.
    """
    fields = {task.name: [player for player in players if not _is_left_out(player, task, tasks)] for task in tasks}
    for task, field in fields.items():
        if not field:
            names = ", ".join(player.name for player in players)
            raise ValueError(f"task {task!r}: no player for it; these play other tasks only: {names}")
    return fields


def _is_left_out(player: Player, task: Task, tasks: Sequence[Task]) -> bool:
    """Return True for a hand-written player of other tasks, one of which is in this comparison."""
    of = other_tasks(player.spec, task.name)
    return any(other.name in of for other in tasks)


def players_in_order(specs: Sequence[str]) -> list[Player]:
    """Return the players in the order of the tables: named ones as in NAMES, then files in the given order."""
    field = [Player.of(spec) for spec in dict.fromkeys(specs)]
    names = [player.name for player in field]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise ValueError(f"--players: two players are called {twice!r}; rename a file, or name the player once")
    return sorted(field, key=lambda player: _place(known_name(player.spec)))


def _place(name: str | None) -> int:
    return len(NAMES) if name is None else NAMES.index(name)


def members_of(player: Player, task: str) -> tuple[Player, ...]:
    """Return the players of all seeds for which NAME@* stands in a task, the one that ships first; else the player."""
    if not player.spec.endswith(ALL_SEEDS) or (name := known_name(player.spec)) is None:
        return (player,)
    seeds = seeds_of_player(name, task)
    return tuple(replace(player, spec=f"{name}@{seed}") for seed in seeds) or (replace(player, spec=name),)


def play_job(
    kind: str, task: Task, player: Player, worlds: int, seed: int, record: int | None = None,
    trust_pickle: bool = False, disturbance: Disturbance | None = None, purpose: Purpose = "evaluation",
    within: Worlds | None = None,
) -> Job:  # fmt: skip
    """Return the job that plays the held-out worlds of a seed with a player; its record is read by `episodes_of_bytes`.

    kind: first word of the job's name. record: index of a world whose episode is recorded. disturbance: of the worlds
    (default: none); ValueError if the task has no slots for it.
    """
    disturbance = disturbance or Disturbance()
    disturbance.check(task)
    digest = player_digest(player, task, seed)
    about = {
        "task": type(task).__name__, "settings": task.model_dump(mode="json"), "worlds": worlds, "seed": seed,
        "record": record, "player": digest, "purpose": purpose,
        **({"disturbance": disturbance.model_dump(mode="json")} if disturbance else {}),
        **({"within": within.about} if within else {}),
    }  # fmt: skip
    make = within.make if within else functools.partial(make_world, disturbance=disturbance)
    arguments = task, player, worlds, seed, record, trust_pickle, digest, make, purpose
    memory = PLAYING + worlds * bytes_per_world(task)
    return Job(f"{kind}/{task.name}/{player.name}", _play, arguments, about, memory, (first_step, (task,)))


def _play(
    task: Task, player: Player, worlds: int, seed: int, record: int | None, trust_pickle: bool, digest: str,
    make: Callable[[Task, int, int], Playable], purpose: Purpose,
) -> bytes:  # fmt: skip
    """Play the worlds; return the episodes as bytes. Raise ValueError if the player has another digest than before."""
    policy = player.policy(task, seed, trust_pickle)
    if _digest(player, policy) != digest:
        raise ValueError(f"player {player.spec!r} has changed since the command began, or differs on this machine")
    first = worlds_for(purpose, seed, worlds)
    with blame(player.name, task):
        return records.to_bytes(rollout(task, policy, worlds, first, record=record, make_world=make))


def episodes_of_bytes(data: bytes) -> Episodes:
    """Return the episodes that a job has played; raise ValueError if the bytes are damaged."""
    episodes: Any = records.from_bytes(data, KINDS)
    if not isinstance(episodes, Episodes):
        raise ValueError("damaged: not a record of episodes")
    if episodes.success.shape != episodes.returns.shape or not np.isfinite(episodes.returns).all():
        raise ValueError("damaged: must hold a finite return and a success of each world")
    return episodes


def player_digest(player: Player, task: Task, seed: int) -> str:
    """Return a digest of a player: of its parameters and weights, or of its file and the files that belong to it.

    These are the Python files in the folder of a Python file, and the card of a weights file.
    """
    return _digest(player, player.policy(task, seed) if known_name(player.spec) else None)


def _digest(player: Player, policy: Policy | None) -> str:
    """Return the digest of a player; policy: its policy, which only a known name needs."""
    if known_name(player.spec):
        weights = (getattr(policy, "card", None) or {}).get("sha256", "")
        return hashlib.sha256(f"{policy!r} {weights}".encode()).hexdigest()
    path, digest = Path(player.spec), hashlib.sha256()
    beside = path.parent.glob("*.py") if path.suffix.lower() == ".py" else [path.with_suffix(".json")]
    for file in sorted({path, *beside}):
        if file.is_file():
            digest.update(f"{file.name} {file.stat().st_size} ".encode() + file.read_bytes())
    return digest.hexdigest()
