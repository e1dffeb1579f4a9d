"""The hand-written players: a file per task, built from the simulator's own steering laws.

Each receives the learner's observation and nothing else, and its force has the same limits. Two kinds of names:

* `rules`, and of some tasks `orca`, `heuristics`, `queueing`: other functions; all with the parameters that a search
  found, in ../tuned/TASK.json (`python -m agents.tune`);
* `textbook`, `orca_published`, `heuristics_published`, `queueing_published`: the same functions with published
  parameters, the defaults in the files; in corridor, evade, obstacles and path_follow, `textbook` is another function
  than `rules`.

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

from flockenv.core.errors import nearest, printable, printable_path
from flockenv.players import PUBLISHED
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
from flockenv.players.rules.parameter import Order
from flockenv.players.rules.vectors import length
from flockenv.tasks import Task

__all__ = ["PLAYERS", "RULES", "TUNED", "RulesPlayer", "Tuned", "as_dict", "load_tuned", "player", "read_tuned"]

TUNED = Path(__file__).resolve().parent.parent / "tuned"
"""Folder of parameters found by the search, a file per task."""

RULES: dict[str, tuple[Callable[..., Any], type]] = {
    "pursuit": (pursuit.pursuit, pursuit.PursuitRules),
    "obstacles": (obstacles.dynamic_window, obstacles.WindowRules),
    "evade": (evade.escape, evade.EscapeRules),
    "flock": (flock.flock, flock.FlockRules),
    "crossing": (crossing.crossing, crossing.CrossingRules),
    "herd": (herd.herd, herd.HerdRules),
    "path_follow": (path_follow.race, path_follow.RacingRules),
    "school": (school.school, school.SchoolRules),
    "crowd_nav": (crowd_nav.crowd_nav, crowd_nav.CrowdNavRules),
    "bottleneck": (bottleneck.bottleneck, bottleneck.BottleneckRules),
    "corridor": (corridor.sampled_velocity, corridor.SampledRules),
}
"""Function of `rules` for each task, and the class of its parameters."""

TEXTBOOK: dict[str, tuple[Callable[..., Any], type]] = {
    **RULES,
    "obstacles": (obstacles.obstacles, obstacles.ObstaclesRules),
    "evade": (evade.evade, evade.EvadeRules),
    "path_follow": (path_follow.path_follow, path_follow.PathFollowRules),
    "corridor": (corridor.corridor, corridor.CorridorRules),
}
"""The same of `textbook`: other functions, as published, where `rules` are better ones than those."""

TUNABLE: dict[str, dict[str, tuple[Callable[..., Any], type]]] = {
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

PLAYERS: dict[str, dict[str, tuple[Callable[..., Any], type]]] = {
    **{PUBLISHED[name]: of for name, of in TUNABLE.items()},
    **TUNABLE,
    "textbook": TEXTBOOK,
}
"""The same, also by the names of those with published parameters."""

REMEMBERING = (school.school,)
"""Functions with a state per row that is kept between decisions."""

ORDERED: dict[Callable[..., Any], tuple[str, ...]] = {
    obstacles.obstacles: obstacles.BEHAVIOURS,
    evade.evade: evade.BEHAVIOURS,
    flock.flock: flock.BEHAVIOURS,
    crossing.crossing: crossing.BEHAVIOURS,
    herd.herd: herd.BEHAVIOURS,
    school.school: school.BEHAVIOURS,
}
"""Functions that allocate the force limit to behaviours in an order, which may differ by row; those behaviours."""


@dataclass(frozen=True)
class RulesPlayer:
    """A hand-written player: SB3's `predict` around a function of a file in this folder."""

    task: Task  # that it plays
    rules: Any  # a dataclass of its parameters
    name: str = "rules"  # of the player, see NAMES

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], Any]:
        """Return actions (R, A) float32 for observation rows (R, O), or (A,) for one row (O,).

        state: what the last call returned, None at the start; episode_start: (R,), True for rows whose episode begins;
        deterministic: not used.
        """
        seen = np.asarray(observation)
        action, state = self.act(np.atleast_2d(seen), state, episode_start)
        return (action[0] if seen.ndim == 1 else action), state

    def act(
        self, observation: NDArray[Any], state: Any = None, begins: Any = None, order: Order = None
    ) -> tuple[NDArray[np.float32], Any]:
        """Return actions (R, A) for observations (R, O), and the state.

        observation: (R, O) float; state: what the last call returned.

        begins: (R,), True for rows whose episode begins; order: (R, K), indices of the behaviours by priority, for
        players that have `behaviours`.
        """
        steer, see = self.function, self.task.layout.unpack(observation)
        ordered = {} if order is None else {"order": order}
        if steer in REMEMBERING:
            begins = False if begins is None else np.atleast_1d(begins)
            force, state = steer(see, self.task, self.rules, state, begins, **ordered)
        else:
            force = steer(see, self.task, self.rules, **ordered)
        strongest = self.task.action_layout.slots[0].scale
        share = force / strongest
        size = np.maximum(length(share)[..., None], 1.0)
        return (share / size).astype(np.float32), state

    @property
    def function(self) -> Callable[..., Any]:
        """The function of a file in this folder."""
        return PLAYERS[self.name][self.task.name][0]

    @property
    def each_row_alone(self) -> bool:
        """True if an action depends on its own row alone; `rollout` leaves out the rows of worlds that have ended."""
        return self.function not in REMEMBERING

    @property
    def behaviours(self) -> tuple[str, ...]:
        """The behaviours whose order of priority may differ by row; () if they have no order."""
        return ORDERED.get(self.function, ())

    def with_rules(self, values: Mapping[str, Any]) -> RulesPlayer:
        """Return the same player with other parameters: one number each, or one per row of observations, (R,).

        values: by the name of the parameter.
        """
        return replace(self, rules=replace(self.rules, **values))


@dataclass(frozen=True)
class Tuned:
    """The parameters that a search found for a player, and how: see `agents.tune.found_of`."""

    parameters: dict[str, float] = field(default_factory=dict)
    found: dict[str, Any] = field(default_factory=dict)

    @property
    def by_seed(self) -> dict[int, dict[str, float]]:
        """The parameters that each search seed found, those that ship first; {} if their seed is not known."""
        if "seed" not in self.found:
            return {}
        searches = {int(seed): each["parameters"] for seed, each in self.found.get("searches", {}).items()}
        return {int(self.found["seed"]): self.parameters, **dict(sorted(searches.items()))}


def load_tuned(task: str, name: str = "rules") -> Tuned:
    """Return the parameters that a search found for a player of a task; an empty record if there was no search yet.

    task: its name; name: of the player, with a seed or without.
    """
    return Tuned(**read_tuned(TUNED / f"{task}.json").get(name, {}))


def read_tuned(path: Path) -> dict[str, dict[str, Any]]:
    """Return the content of a file of tuned parameters, by player: parameters and found; {} if there is no such file.

    path: of the JSON file.

    Raises:
        ValueError: the file holds something else; one line.
    """
    if not path.is_file():
        return {}
    try:
        players: dict[str, dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["players"]
        if all(each.keys() == {"parameters", "found"} for each in players.values()):
            return players
    except (ValueError, LookupError, TypeError, AttributeError):
        pass
    raise ValueError(f"{printable_path(path)}: not a file of tuned parameters, which `python -m agents.tune` writes")


def player(task: Task, name: str = "rules", search_seed: int | None = None) -> RulesPlayer:
    """Return a hand-written player of a task by name; raise ValueError if the task has none of that name.

    search_seed: one of `Tuned.by_seed`, for the parameters that its search found (default: those that ship).
    """
    if name not in PLAYERS:
        hint = nearest(name, PLAYERS)
        raise ValueError(f"hand-written player {printable(name)}: unknown{hint}; allowed: {', '.join(PLAYERS)}")
    known = PLAYERS[name]
    if task.name not in known:
        raise ValueError(
            f"there is no hand-written player {name!r} for {task.name!r}; there is one for: {', '.join(known)}"
        )
    tuned = load_tuned(task.name, name) if name in PUBLISHED else Tuned()
    parameters = tuned.parameters if search_seed is None else tuned.by_seed[search_seed]
    return RulesPlayer(task, replace(known[task.name][1](), **parameters), name)


def as_dict(rules: Any) -> dict[str, float]:
    """Return parameters by name.

    rules: a dataclass of parameters.
    """
    return {name: float(value) for name, value in asdict(rules).items()}
