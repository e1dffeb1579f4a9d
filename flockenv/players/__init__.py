"""Players: those that ship with flockenv, by name, and users' own, from files.

    from flockenv.players import load_player
    from flockenv.tasks import Pursuit

    action, state = load_player("rules", Pursuit()).predict(observation)

* `random`: actions uniform in [-1, 1], the lower baseline of every table;
* `textbook`: the hand-written player of a task, with published parameters;
* `orca`, `heuristics`, `queueing`: other hand-written players, of some tasks each, with parameters found by a search;
* `orca_published`, `heuristics_published`, `queueing_published`: the same with published parameters;
* `rules`: the hand-written player of a task, with parameters found by a search;
* `ppo`: trained weights.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from flockenv.core.errors import nearest, printable

if TYPE_CHECKING:
    from flockenv.players.policy import Policy
    from flockenv.tasks import Task

# Neither the laws nor numba are imported here: `flockenv render --help` lists the players in a fifth of a second.

__all__ = ["NAMES", "PUBLISHED", "WEIGHTS", "load_player", "named_player", "other_tasks"]

PUBLISHED = {
    "orca": "orca_published", "heuristics": "heuristics_published", "queueing": "queueing_published",
    "rules": "textbook",
}  # fmt: skip
"""Hand-written players with tuned parameters, and the name of each with published ones."""

NAMES = ("random", *sorted(PUBLISHED.values(), key="textbook".__ne__), *PUBLISHED, "ppo")
"""Roughly from the weakest to the strongest; tables and pictures keep this order."""

FORMER = {"reynolds": "rules"}
"""Names that players had, and their names now."""

WEIGHTS = Path(__file__).resolve().parent / "weights"
"""Folder of trained weights and their cards, two files per task."""


def load_player(spec: str | os.PathLike[str], task: Task, seed: int = 0, trust_pickle: bool = False) -> Policy:
    """Return the policy of a name or a file, ready to play a task.

    Args:
        spec: one of NAMES; or a `.safetensors` file with its card; or a `.py` file, which is executed (see
            `flockenv.players.files`); or, with `trust_pickle`, a Stable-Baselines3 `.zip`.
        task: the task that it will play.
        seed: of the random numbers of `random` and of a sampling `ppo`.
        trust_pickle: also read zips. Loading one executes the code stored in it.

    Raises:
        ValueError: no such player (with the nearest name), none of that name for the task, a file that cannot be used,
            or one that is not trusted; one line.
    """
    from flockenv.players.files import SUFFIXES, load_file

    name = os.fspath(spec)
    if name in NAMES:
        return named_player(name, task, seed)
    if Path(name).suffix.lower() in SUFFIXES:
        return load_file(name, task, seed, trust_pickle)
    hint = f"is called {FORMER[name]!r}" if name in FORMER else f"unknown{nearest(name, NAMES)}"
    allowed = f"{', '.join(NAMES)}, or a {' or '.join(SUFFIXES)} file"
    raise ValueError(f"player {printable(name)}: {hint}; allowed: {allowed}")


def named_player(name: str, task: Task, seed: int = 0) -> Policy:
    """Return one of NAMES, ready to play a task; raise ValueError if that task has none of that name."""
    from flockenv.players.policy import RandomPolicy
    from flockenv.players.rules import player

    if name == "random":
        return RandomPolicy(task.action_layout.size, seed)
    return _load_trained(task, seed) if name == "ppo" else player(task, name)


def _load_trained(task: Task, seed: int) -> Policy:
    from flockenv.players.policy import MlpPolicy

    path = WEIGHTS / f"{task.name}.safetensors"
    if not path.is_file():
        command = f"python -m agents.ppo configs/training/{task.name}.yaml"
        raise ValueError(f"player 'ppo' has no weights for task {task.name!r}; this trains them: {command}")
    return MlpPolicy.load(path, task, seed)


def other_tasks(name: str, task: str) -> tuple[str, ...]:
    """Return the tasks that a player is written for if `task` is not among them; () if it plays `task`."""
    from flockenv.players.rules import PLAYERS

    known = PLAYERS.get(name, {task: None})
    return () if task in known else tuple(known)
