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

What was trained or searched with several seeds ships as the median run. `ppo@3` is the policy of training seed 3,
`rules@3` has the parameters that search seed 3 found; `seeds_of_player` has the seeds that are there.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from flockenv.core.errors import nearest, printable

if TYPE_CHECKING:
    from flockenv.players.policy import Policy
    from flockenv.tasks import Task

# Neither the laws nor numba are imported here: `flockenv render --help` lists the players in a fifth of a second.

__all__ = [
    "ALL_SEEDS", "NAMES", "PUBLISHED", "SEEDED", "WEIGHTS", "known_name", "load_player", "other_tasks", "policy_file",
    "seeds_of_player", "trained_task", "weights_file",
]  # fmt: skip

PUBLISHED = {
    "orca": "orca_published", "heuristics": "heuristics_published", "queueing": "queueing_published",
    "rules": "textbook",
}  # fmt: skip
"""Hand-written players with tuned parameters, and the name of each with published ones."""

NAMES = ("random", *sorted(PUBLISHED.values(), key="textbook".__ne__), *PUBLISHED, "ppo")
"""Roughly from the weakest to the strongest; tables and pictures keep this order."""

SEEDED = (*PUBLISHED, "ppo")
"""Players with a run per training or search seed: NAME@3 is that of seed 3."""

ALL_SEEDS = "@*"
"""End of a name that stands for the players of all seeds, where several are accepted: ppo@*."""

FORMER = {"reynolds": "rules"}
"""Names that players had, and their names now."""

WEIGHTS = Path(__file__).resolve().parent / "weights"
"""Folder of trained weights and their cards, two files per task; `seeds` in it has those of further training seeds."""


def load_player(spec: str | os.PathLike[str], task: Task, seed: int = 0, trust_pickle: bool = False) -> Policy:
    """Return the policy of a name or a file, ready to play a task.

    Args:
        spec: one of NAMES; one of SEEDED with a training or search seed, such as ppo@3; or a `.safetensors` file with
            its card; or a `.py` file, which is executed (see `flockenv.players.files`); or, with `trust_pickle`, a
            Stable-Baselines3 `.zip`.
        task: the task that it will play.
        seed: of the random numbers of `random` and of a sampling `ppo`.
        trust_pickle: also read zips. Loading one executes the code stored in it.

    Raises:
        ValueError: no such player (with the nearest name), none of that name or seed for the task, a file that cannot
            be used, or one that is not trusted; one line.
    """
    from flockenv.players.files import SUFFIXES, load_file

    spec = os.fspath(spec)
    if known_name(spec) is not None:
        return _named_player(spec, task, seed)
    if Path(spec).suffix.lower() in SUFFIXES:
        return load_file(spec, task, seed, trust_pickle)
    name, at, _ = spec.partition("@")
    hint = f"is called {FORMER[name]!r}" if name in FORMER else f"unknown{nearest(name, NAMES)}"
    if at and name in NAMES:
        hint = f"a seed is a number, as in {name}@3"
    allowed = f"{', '.join(NAMES)}, or a {' or '.join(SUFFIXES)} file"
    raise ValueError(f"player {printable(spec)}: {hint}; allowed: {allowed}")


def known_name(spec: str) -> str | None:
    """Return which of NAMES a player is, with or without a seed: "ppo" of "ppo", "ppo@3" and "ppo@*"; None if none.

    spec: a player as in `load_player`.
    """
    name, at, seed = spec.partition("@")
    with_seed = seed.isascii() and seed.isdigit() and len(seed) < 9
    return name if name in NAMES and (not at or with_seed or at + seed == ALL_SEEDS) else None


def seeds_of_player(name: str, task: str) -> tuple[int, ...]:
    """Return the training or search seeds of a player that are there for a task, the one that ships first.

    name: one of NAMES. The result is () if it has no seeds, or is not known to be of one.

    Raises:
        ValueError: the card or the file of tuned parameters is damaged; one line.
    """
    if name == "ppo":
        return _training_seeds(task)
    if name in PUBLISHED:
        from flockenv.players.rules import load_tuned

        return tuple(load_tuned(task, name).by_seed)
    return ()


def trained_task(name: str) -> Task:
    """Return a task with the arguments with which its policy was trained; without weights, with its defaults.

    name: of the task, such as `pursuit`.

    Raises:
        KeyError: no such task.
        ValueError: the card of the weights is damaged; one line.
    """
    from flockenv.players.policy import read_card
    from flockenv.tasks import TASKS

    card = weights_file(name).with_suffix(".json")
    arguments = read_card(card).get("arguments", {}) if card.is_file() else {}
    return TASKS[name].model_validate_json(json.dumps(arguments))


def weights_file(task: str, seed: int | None = None) -> Path:
    """Return the path of the weights that ship, or of those of a training seed that is not the one that ships.

    task: its name; seed: the training seed (default: what ships).
    """
    return WEIGHTS / (f"{task}.safetensors" if seed is None else f"seeds/{task}-seed-{seed}.safetensors")


def policy_file(spec: str, task: Task) -> Path:
    """Return the path of the weights of `ppo`, or of a training seed, such as ppo@3, whether it ships or not.

    spec: `ppo`, `ppo@3`; task: the task that it plays.

    Raises:
        ValueError: there is no such seed; one line.
    """
    seed = _checked_seed(spec, task) if "@" in spec else None
    ships = seed is None or seed == seeds_of_player("ppo", task.name)[0]
    return weights_file(task.name, None if ships else seed)


def _training_seeds(task: str) -> tuple[int, ...]:
    from flockenv.players.policy import read_card

    card = weights_file(task).with_suffix(".json")
    about = read_card(card) if card.is_file() else {}
    if "seed" not in about:
        return ()
    others = sorted({int(seed) for seed in about.get("seeds", {}).get("scores", {})} - {about["seed"]})
    return (about["seed"], *(seed for seed in others if weights_file(task, seed).is_file()))


def _named_player(spec: str, task: Task, seed: int) -> Policy:
    """Return one of NAMES, with or without a seed; raise ValueError if that task has none of that name or seed."""
    from flockenv.players.policy import RandomPolicy
    from flockenv.players.rules import player

    name, _, text = spec.partition("@")
    if name == "random" and not text:
        return RandomPolicy(task.action_layout.size, seed)
    if name == "ppo":
        return _load_trained(spec, task, seed)
    return player(task, name, _checked_seed(spec, task) if text and not other_tasks(name, task.name) else None)


def _checked_seed(spec: str, task: Task) -> int:
    """Return the seed in a player's name; raise ValueError, in one line, if there is no run of it."""
    name, _, text = spec.partition("@")
    if name not in SEEDED:
        raise ValueError(f"player {spec!r}: {name!r} has no seeds; allowed with one: {', '.join(SEEDED)}")
    seeds = seeds_of_player(name, task.name)
    there = f"of task {task.name!r} there are {', '.join(f'{name}@{each}' for each in sorted(seeds)) or 'none'}"
    if text == "*":
        raise ValueError(f"player {spec!r}: stands for all seeds, but one is needed here; {there}")
    if int(text) not in seeds:
        raise ValueError(f"player {spec!r}: no such seed; {there}")
    return int(text)


def _load_trained(spec: str, task: Task, seed: int) -> Policy:
    from flockenv.players.policy import MlpPolicy

    if not weights_file(task.name).is_file():
        command = f"python -m agents.ppo configs/training/{task.name}.yaml"
        raise ValueError(f"player 'ppo' has no weights for task {task.name!r}; this trains them: {command}")
    return MlpPolicy.load(policy_file(spec, task), task, seed)


def other_tasks(name: str, task: str) -> tuple[str, ...]:
    """Return the tasks that a player is written for if `task` is not among them; () if it plays `task`.

    name: of the player, with or without a seed.
    """
    from flockenv.players.rules import PLAYERS

    known = PLAYERS.get(known_name(name) or name, {task: None})
    return () if task in known else tuple(known)
