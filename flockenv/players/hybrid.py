"""Hybrids: a learned policy on top of hand-written rules. The observation and the limits are those of all players.

The numbers u that a network puts out become the action of the task in one of these ways (KINDS):

* `residual`: the rules' force plus `bound` times u (Johannink et al. 2019, ICRA, 6023; Silver et al. 2018,
  arXiv 1812.06298); u = 0 plays the rules;
* `gate`: u has one number more, and hands over between both: if it is negative, the rules act, else u itself.

The parameters of the rules are part of the policy's card, so that tuning the rules anew does not change the policy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.core.errors import nearest
from flockenv.players.policy import MlpPolicy, Observation, State
from flockenv.players.rules import RulesPlayer, as_dict, player
from flockenv.tasks import Task

__all__ = ["FORCE", "KINDS", "Hybrid", "HybridPolicy"]

FORCE = "force"
"""The kind of a policy that is no hybrid: what its network puts out is the action."""

KINDS = ("residual", "gate")

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Hybrid:
    """How the numbers of a network become actions of a task."""

    kind: str
    rules: RulesPlayer
    bound: float = 0.5

    @classmethod
    def of(cls, task: Task, kind: str, base: str = "rules", bound: float = 0.5) -> Hybrid:
        """Return the hybrid of a task with its hand-written player `base`; raise ValueError if it has none."""
        return cls(kind, player(task, base), bound)

    @classmethod
    def from_card(cls, about: Any, task: Task) -> Hybrid:
        """Return the hybrid that a card describes; raise ValueError, in one line, if it cannot be used."""
        if not isinstance(about, Mapping) or not about.keys() >= {"kind", "base", "bound", "rules"}:
            raise ValueError("the card's hybrid must hold kind, base, bound and rules")
        if about["kind"] not in KINDS:
            kind = about["kind"]
            raise ValueError(f"hybrid.kind = {kind!r}: unknown{nearest(str(kind), KINDS)}; allowed: {', '.join(KINDS)}")
        base = player(task, str(about["base"]))
        values, known = about["rules"], as_dict(base.rules)
        if not isinstance(values, Mapping) or values.keys() != known.keys() or not _are_numbers([*values.values()]):
            raise ValueError(f"hybrid.rules must hold a number for each of {', '.join(known)}")
        if not _are_numbers([about["bound"]]) or not 0 < about["bound"] <= 2:
            raise ValueError(f"hybrid.bound = {about['bound']!r}: must be above 0 and at most 2")
        return cls(about["kind"], base.with_rules(values), float(about["bound"]))

    @property
    def card(self) -> dict[str, Any]:
        """What a card says of it; `from_card` reads it."""
        return {"kind": self.kind, "base": self.rules.name, "bound": self.bound, "rules": as_dict(self.rules.rules)}

    @property
    def outputs(self) -> int:
        """How many numbers the network puts out."""
        return self.rules.task.action_layout.size + (self.kind == "gate")

    def act(self, rows: Floats, outputs: Floats, state: Any = None, begins: Any = None) -> tuple[Floats, Any]:
        """Return actions (R, A) for observations (R, O) and the network's outputs (R, K) in [-1, 1], and the state.

        state: of the rules, from the call before; begins: (R,), True for rows whose episode begins.
        """
        force, state = self.rules.predict(rows, state, begins)
        if self.kind == "residual":
            return np.clip(force + np.float32(self.bound) * outputs, -1.0, 1.0), state
        return np.where(outputs[:, -1:] < 0, force, outputs[:, :-1]), state


class HybridPolicy(MlpPolicy):
    """A trained network whose outputs act through a hybrid; `MlpPolicy.load` returns it for such a card."""

    hybrid: Hybrid

    @classmethod
    def of(
        cls, tensors: Mapping[str, NDArray[Any]], card: Mapping[str, Any], task: Task | None, seed: int | None = 0
    ) -> HybridPolicy:
        """Return the policy of a task; raise ValueError, in one line, if card, weights and task do not fit."""
        if task is None:
            raise ValueError("a hybrid of a network and rules needs the task that it plays")
        policy = cls(tensors, card, seed)
        policy.hybrid = Hybrid.from_card(card["hybrid"], task)
        if policy.action_size != policy.hybrid.outputs:
            raise ValueError(f"the network puts out {policy.action_size} numbers, must be {policy.hybrid.outputs}")
        return policy

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[Floats, Any]:
        """Return actions (R, A) for observations (R, O), or (A,) for one row (O,), and the state of the rules."""
        outputs, _ = super().predict(observation, None, episode_start, deterministic)
        rows = np.atleast_2d(np.asarray(observation, np.float32))
        begins = None if episode_start is None else np.atleast_1d(episode_start)
        action, state = self.hybrid.act(rows, np.atleast_2d(outputs), state, begins)
        return (action[0] if outputs.ndim == 1 else action), state


def _are_numbers(values: list[Any]) -> bool:
    return all(type(value) in (int, float) and np.isfinite(value) for value in values)
