"""The hand-written players: one page per task, from the laws that the simulator itself steers by.

Each sees exactly the learner's observation and nothing else, and asks for a force within the same limits. It is shown
twice: with textbook parameters (the defaults below), and tuned by a plain search that had the budget noted in
configs/<task>.yaml (`python -m agents.tune`).

    from agents.reynolds import player
    action, _ = player(task).predict(observation)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from agents.reynolds.bottleneck import BottleneckRules, QueueingRules, bottleneck, queueing
from agents.reynolds.corridor import CorridorOrcaRules, CorridorRules, corridor, orca_corridor
from agents.reynolds.crossing import CrossingRules, OrcaRules, crossing, orca_crossing
from agents.reynolds.crowd_nav import (
    CrowdNavRules,
    HeuristicsRules,
    RobotOrcaRules,
    crowd_nav,
    heuristics_crowd_nav,
    orca_crowd_nav,
)
from agents.reynolds.evade import EvadeRules, evade
from agents.reynolds.flock import FlockRules, flock
from agents.reynolds.herd import HerdRules, herd
from agents.reynolds.obstacles import ObstaclesRules, obstacles
from agents.reynolds.path_follow import PathFollowRules, path_follow
from agents.reynolds.pursuit import PursuitRules, pursuit
from agents.reynolds.school import SchoolRules, school
from flockenv.tasks import Task

__all__ = ["PLAYERS", "RULES", "Reynolds", "as_dict", "player", "tuned"]

CONFIGS = Path(__file__).parent.parent.parent / "configs"

RULES: dict[str, tuple[Callable[..., np.ndarray], type]] = {
    "pursuit": (pursuit, PursuitRules),
    "obstacles": (obstacles, ObstaclesRules),
    "evade": (evade, EvadeRules),
    "flock": (flock, FlockRules),
    "crossing": (crossing, CrossingRules),
    "herd": (herd, HerdRules),
    "path_follow": (path_follow, PathFollowRules),
    "school": (school, SchoolRules),
    "crowd_nav": (crowd_nav, CrowdNavRules),
    "bottleneck": (bottleneck, BottleneckRules),
    "corridor": (corridor, CorridorRules),
}
"""What the player "reynolds" does in each task, and its parameters."""

PLAYERS: dict[str, dict[str, tuple[Callable[..., np.ndarray], type]]] = {
    "orca": {
        "crossing": (orca_crossing, OrcaRules),
        "crowd_nav": (orca_crowd_nav, RobotOrcaRules),
        "corridor": (orca_corridor, CorridorOrcaRules),
    },
    "heuristics": {"crowd_nav": (heuristics_crowd_nav, HeuristicsRules)},
    "queueing": {"bottleneck": (queueing, QueueingRules)},
}
"""Other hand-written players by name, for those tasks that have one."""

REMEMBERING = (school,)
"""Those that keep a number per row from one decision to the next."""


@dataclass(frozen=True)
class Reynolds:
    """A hand-written player: SB3's `predict` around one of the functions above."""

    task: Task
    rules: Any
    name: str = "reynolds"

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return actions (R, A) float32 for observation rows (R, O), or (A,) for one row (O,)."""
        seen = np.asarray(observation)
        steer = _rules(self.name)[self.task.name][0]
        see = self.task.layout.unpack(np.atleast_2d(seen))
        if steer in REMEMBERING:
            begins = False if episode_start is None else np.atleast_1d(episode_start)
            force, state = steer(see, self.task, self.rules, state, begins)
        else:
            force = steer(see, self.task, self.rules)
        strongest = self.task.action_layout.slots[0].scale
        wish = force / strongest
        length = np.maximum(np.linalg.norm(wish, axis=-1, keepdims=True), 1.0)
        action = (wish / length).astype(np.float32)
        return (action[0] if seen.ndim == 1 else action), state

    def with_rules(self, values: Mapping[str, float]) -> Reynolds:
        """Return the same player with other parameters."""
        return replace(self, rules=replace(self.rules, **values))


def _rules(name: str) -> dict[str, tuple[Callable[..., np.ndarray], type]]:
    """Return what a player does, by task."""
    return RULES if name == "reynolds" else PLAYERS[name]


def tuned(name: str) -> dict[str, float]:
    """Return the parameters that the search found for a task, from configs/<name>.yaml; {} if there are none yet."""
    path = CONFIGS / f"{name}.yaml"
    if not path.exists():
        return {}
    config = yaml.safe_load(path.read_text(encoding="utf-8"))
    return dict((config.get("reynolds") or {}).get("rules") or {})


def player(task: Task, textbook: bool = False, name: str = "reynolds") -> Reynolds:
    """Return a hand-written player of a task; "reynolds" is tuned unless the textbook's parameters are asked for."""
    known = _rules(name)
    if task.name not in known:
        which = "" if name == "reynolds" else f" {name!r}"
        raise ValueError(
            f"there is no hand-written player{which} for {task.name!r}; there is one for: {', '.join(known)}"
        )
    found = tuned(task.name) if name == "reynolds" and not textbook else {}
    return Reynolds(task, replace(known[task.name][1](), **found), name)


def as_dict(rules: Any) -> dict[str, float]:
    """Return parameters by name."""
    return {name: float(value) for name, value in asdict(rules).items()}
