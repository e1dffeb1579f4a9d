"""Results of a study: returns by setting and player, and which kind is ahead in each setting.

The results of a task are one file, TASK.json, with the returns of every world; all that pages and pictures show is
computed from it. Players are of four kinds: hand-written (`rules`), learned (`policy`), learned on top of rules
(`hybrid`), and those that plan with the simulator (`planner`). A setting is won by a kind if the difference to every
other kind has an interval above zero; otherwise it is level. If a kind has several players, the best one on the tuning
worlds of the same setting stands for it, so that no choice is made on the worlds that are reported.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.study import HOME, PARTNERS, setting_name
from flockenv.core.errors import nearest
from flockenv.envs.disturbance import Disturbance
from flockenv.evaluation import Interval, lead_interval, mean_interval, success_interval
from flockenv.players.policy import MlpPolicy, Policy, RandomPolicy

__all__ = [
    "ALONE", "GROUPS", "KINDS", "LEVEL", "RANDOM", "Score", "SettingResults", "TaskResults", "group_of", "kind_of",
    "marks_of", "read_file", "read_task", "stored_marks",
]  # fmt: skip

KINDS = ("rules", "policy", "hybrid", "planner")
LEVEL, ALONE = "level", "alone"
RANDOM = "random"

SOLVER = ("dt", "integrator", "dtype")
"""Arguments of a task that change how its motion is computed, not the task."""

Floats = NDArray[np.float64]


GROUPS = (HOME, "sensors and actions", "solver", PARTNERS, "task")
"""What is varied: nothing, sensors and delays, how motion is computed, what other agents play, or the task itself."""


def group_of(axis: str) -> str:
    """Return the group of a setting by what is varied in it."""
    if axis in Disturbance.model_fields:
        return "sensors and actions"
    return axis if axis in (HOME, PARTNERS) else "solver" if axis in SOLVER else "task"


def kind_of(policy: Policy) -> str:
    """Return the kind of a player: that of a Python file is its `kind`, by default rules.

    Raises:
        ValueError: in one line, a kind that is not one of KINDS.
    """
    if isinstance(policy, RandomPolicy):
        return RANDOM
    if isinstance(policy, MlpPolicy):
        return "hybrid" if (policy.card or {}).get("hybrid") else "policy"
    kind = str(getattr(policy, "kind", "rules"))
    if kind not in KINDS:
        raise ValueError(f"player's kind = {kind!r}: unknown{nearest(kind, KINDS)}; allowed: {', '.join(KINDS)}")
    return kind


@dataclass(frozen=True, eq=False)
class Score:
    """A player in one setting: returns and successes (seeds, worlds), and its mean return on tuning worlds."""

    kind: str
    returns: Floats
    success: NDArray[np.bool_]
    tuning_mean: float | None  # None: no other player of its kind was in the setting

    @functools.cached_property
    def mean(self) -> Interval:
        """The mean return with its interval over seeds and worlds."""
        return mean_interval(self.returns)

    @functools.cached_property
    def success_rate(self) -> Interval:
        """The share of successful worlds, with its interval over seeds and worlds."""
        return success_interval(self.success)


@dataclass(frozen=True, eq=False)
class SettingResults:
    """One setting of a task with the scores of its players, and reasons why others cannot play it."""

    axis: str
    value: str
    scores: Mapping[str, Score]
    refused: Mapping[str, str]

    @property
    def name(self) -> str:
        """The text of what is varied, as `Setting.name`."""
        return setting_name(self.axis, self.value)

    @functools.cached_property
    def leaders(self) -> dict[str, str]:
        """The player that stands for each kind."""
        found: dict[str, str] = {}
        for kind in KINDS:
            names = [name for name, score in self.scores.items() if score.kind == kind]
            if names:
                found[kind] = names[0] if len(names) == 1 else max(names, key=self._tuning_mean)
        return found

    def _tuning_mean(self, name: str) -> float:
        mean = self.scores[name].tuning_mean
        if mean is None:
            raise ValueError(f"{self.name}, {name}: tuning_mean is missing, as other players of its kind have played")
        return mean

    @functools.cached_property
    def leads(self) -> dict[str, Interval]:
        """The mean return of the best kind minus that of each other kind, by kind, in the same worlds."""
        ordered = sorted(self.leaders, key=lambda kind: -self.scores[self.leaders[kind]].mean.value)
        best = self.scores[self.leaders[ordered[0]]]
        return {kind: lead_interval(best.returns, self.scores[self.leaders[kind]].returns) for kind in ordered[1:]}

    @property
    def first(self) -> str:
        """The kind with the highest mean return."""
        return max(self.leaders, key=lambda kind: self.scores[self.leaders[kind]].mean.value)

    @property
    def winner(self) -> str:
        """The kind that is ahead of every other; "alone" if no other can play, else "level"."""
        if not self.leads:
            return ALONE
        return self.first if len(self.behind) == len(self.leads) else LEVEL

    @property
    def behind(self) -> list[str]:
        """The kinds to which the lead of the best kind has an interval above zero."""
        return [kind for kind, lead in self.leads.items() if lead.low > 0]

    @property
    def lead(self) -> Interval | None:
        """The smallest lead of the best kind; None if there is one kind only."""
        return min(self.leads.values(), key=lambda lead: lead.value, default=None)


@dataclass(frozen=True, eq=False)
class TaskResults:
    """All settings of a task, home first."""

    task: str
    worlds: int
    seed: int
    home: Mapping[str, Any]  # the arguments that are varied, as they are at home
    settings: tuple[SettingResults, ...]

    @functools.cached_property
    def groups(self) -> dict[str, list[SettingResults]]:
        """Settings by what is varied, see GROUPS."""
        groups: dict[str, list[SettingResults]] = {name: [] for name in GROUPS}
        for each in self.settings:
            groups[group_of(each.axis)].append(each)
        return groups

    @property
    def axes(self) -> list[str]:
        """What is varied, in order, without home."""
        return list(dict.fromkeys(each.axis for each in self.settings[1:]))


def read_task(content: Mapping[str, Any]) -> TaskResults:
    """Return the results of a task from the content of its file."""
    settings = [
        SettingResults(
            each["axis"], each["value"],
            {name: _score(player) for name, player in each["players"].items() if "refused" not in player},
            {name: player["refused"] for name, player in each["players"].items() if "refused" in player},
        )
        for each in content["settings"]
    ]  # fmt: skip
    return TaskResults(content["task"], content["worlds"], content["seed"], content["home"], tuple(settings))


def _score(player: Mapping[str, Any]) -> Score:
    returns = np.array(player["returns"], float)
    success = np.array([marks_of(row, len(each)) for row, each in zip(player["success"], returns, strict=True)])
    return Score(player["kind"], returns, success, player["tuning_mean"])


def stored_marks(marks: NDArray[np.bool_]) -> str:
    """Return one bit per world, the first world in the highest bit of the first byte, in hexadecimal digits."""
    return np.packbits(marks).tobytes().hex()


def marks_of(stored: str, worlds: int) -> NDArray[np.bool_]:
    """Return the marks (worlds,) that `stored_marks` has written; ValueError if they are of other worlds."""
    if len(stored) != 2 * (-(-worlds // 8)):
        raise ValueError(f"success = {stored!r}: must be hexadecimal digits, two for each 8 of {worlds} worlds")
    return np.unpackbits(np.frombuffer(bytes.fromhex(stored), np.uint8), count=worlds).astype(np.bool_)


def read_file(path: Path) -> dict[str, Any] | None:
    """Return the content of a task's file, or None if there is none; ValueError, in one line, if it is damaged."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise ValueError(f"{path}: damaged: {error}; delete it, and the same command makes it anew") from None
    if not isinstance(content, dict) or not content.keys() >= {"plan", "task", "worlds", "seed", "home", "settings"}:
        raise ValueError(f"{path}: not the results of a task; delete it, and the same command makes it anew")
    return content
