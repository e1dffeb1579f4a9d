"""The hand-written players: a file per task, built from the simulator's own steering laws.

Each receives the learner's observation and nothing else, and its force has the same limits. Three kinds of names:

* `textbook`: published parameters, the defaults in the files;
* `rules`: the same functions with the parameters that a search found (`python -m agents.tune`), in ../tuned/TASK.json;
* `orca`, `heuristics`, `queueing`: other functions, of some tasks each, with published parameters.

    from flockenv.players.rules import player
    action, _ = player(task).predict(observation)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.players.rules import (
    bottleneck,
    corridor,
    crossing,
    crowd_nav,
    evade,
    flock,
    herd,
    obstacles,
    path_follow,
    pursuit,
    school,
)
from flockenv.tasks import Task

__all__ = ["PLAYERS", "RULES", "TUNED", "RulesPlayer", "Tuned", "as_dict", "load_tuned", "player"]

TUNED = Path(__file__).resolve().parent.parent / "tuned"
"""Folder of parameters found by the search, a file per task."""

RULES: dict[str, tuple[Callable[..., Any], type]] = {
    "pursuit": (pursuit.pursuit, pursuit.PursuitRules),
    "obstacles": (obstacles.obstacles, obstacles.ObstaclesRules),
    "evade": (evade.evade, evade.EvadeRules),
    "flock": (flock.flock, flock.FlockRules),
    "crossing": (crossing.crossing, crossing.CrossingRules),
    "herd": (herd.herd, herd.HerdRules),
    "path_follow": (path_follow.path_follow, path_follow.PathFollowRules),
    "school": (school.school, school.SchoolRules),
    "crowd_nav": (crowd_nav.crowd_nav, crowd_nav.CrowdNavRules),
    "bottleneck": (bottleneck.bottleneck, bottleneck.BottleneckRules),
    "corridor": (corridor.corridor, corridor.CorridorRules),
}
"""Function of `textbook` and `rules` for each task, and the class of its parameters."""

PLAYERS: dict[str, dict[str, tuple[Callable[..., Any], type]]] = {
    "textbook": RULES,
    "orca": {
        "crossing": (crossing.orca_crossing, crossing.OrcaRules),
        "crowd_nav": (crowd_nav.orca_crowd_nav, crowd_nav.RobotOrcaRules),
        "corridor": (corridor.orca_corridor, corridor.CorridorOrcaRules),
    },
    "heuristics": {"crowd_nav": (crowd_nav.heuristics_crowd_nav, crowd_nav.HeuristicsRules)},
    "queueing": {"bottleneck": (bottleneck.queueing, bottleneck.QueueingRules)},
    "rules": RULES,
}
"""Function and parameter class of each hand-written player, by its name and the task's."""

REMEMBERING = (school.school,)
"""Functions with a state per row that is kept between decisions."""


@dataclass(frozen=True)
class RulesPlayer:
    """A hand-written player: SB3's `predict` around a function of a file in this folder."""

    task: Task
    rules: Any
    name: str = "rules"

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], Any]:
        """Return actions (R, A) float32 for observation rows (R, O), or (A,) for one row (O,)."""
        seen = np.asarray(observation)
        steer = PLAYERS[self.name][self.task.name][0]
        see = self.task.layout.unpack(np.atleast_2d(seen))
        if steer in REMEMBERING:
            begins = False if episode_start is None else np.atleast_1d(episode_start)
            force, state = steer(see, self.task, self.rules, state, begins)
        else:
            force = steer(see, self.task, self.rules)
        strongest = self.task.action_layout.slots[0].scale
        share = force / strongest
        length = np.maximum(np.linalg.norm(share, axis=-1, keepdims=True), 1.0)
        action = (share / length).astype(np.float32)
        return (action[0] if seen.ndim == 1 else action), state

    def with_rules(self, values: Mapping[str, float]) -> RulesPlayer:
        """Return the same player with other parameters."""
        return replace(self, rules=replace(self.rules, **values))


@dataclass(frozen=True)
class Tuned:
    """The parameters that a search found for a task, and the cost and score of the search."""

    parameters: dict[str, float] = field(default_factory=dict)
    found: dict[str, float] = field(default_factory=dict)  # agent_steps, tuning_mean, tuning_worlds, textbook_mean


def load_tuned(name: str) -> Tuned:
    """Return the parameters that the search found for a task; an empty record if there was no search yet."""
    path = TUNED / f"{name}.json"
    if not path.is_file():
        return Tuned()
    content = json.loads(path.read_text(encoding="utf-8"))
    return Tuned(content["parameters"], content["found"])


def player(task: Task, name: str = "rules") -> RulesPlayer:
    """Return a hand-written player of a task by name; raise ValueError if the task has none of that name."""
    known = PLAYERS[name]
    if task.name not in known:
        raise ValueError(
            f"there is no hand-written player {name!r} for {task.name!r}; there is one for: {', '.join(known)}"
        )
    parameters = load_tuned(task.name).parameters if name == "rules" else {}
    return RulesPlayer(task, replace(known[task.name][1](), **parameters), name)


def as_dict(rules: Any) -> dict[str, float]:
    """Return parameters by name."""
    return {name: float(value) for name, value in asdict(rules).items()}
