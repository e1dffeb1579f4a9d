"""Hybrids: a learned policy on top of hand-written rules. The observation and the limits are those of all players.

The numbers u that a network puts out become the action of the task in one of these ways (KINDS):

* `residual`: the rules' force plus `bound` times u (Johannink et al. 2019, ICRA, 6023; Silver et al. 2018,
  arXiv 1812.06298); u = 0 plays the rules;
* `mixture`: 1 - `bound` times the rules' force plus `bound` times u, so that u may be a policy that plays alone;
* `weights`: u sets the rules' parameters of this decision within their ranges, a number for each: -1 is the lower end,
  0 the tuned value, 1 the upper end;
* `priorities`: u sets in which order the rules' behaviours get their share of max_force (Reynolds 1987), a score for
  each; 0 is the rules' own order;
* `gate`: u has one number more, and hands over between both: if it is negative, the rules act, else u itself.

The parameters of the rules, and what else an output depends on, are part of the policy's card, so that tuning the rules
anew does not change the policy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.core.errors import nearest, printable
from flockenv.players import PUBLISHED, load_player
from flockenv.players.policy import MlpPolicy, Observation, State
from flockenv.players.rules import ORDERED, PLAYERS, RulesPlayer, as_dict, player
from flockenv.players.rules.parameter import is_logarithmic, ranges_of
from flockenv.tasks import Task

__all__ = ["FORCE", "KINDS", "Hybrid", "HybridPolicy"]

FORCE = "force"
"""The kind of a policy that is no hybrid: what its network puts out is the action."""

KINDS = ("residual", "mixture", "weights", "priorities", "gate")
"""Kinds of hybrids, see `Hybrid`."""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Hybrid:
    """How the numbers of a network become actions of a task."""

    kind: str  # what the network puts out
    rules: RulesPlayer  # the hand-written player
    bound: float = 0.5  # of the network's part, see the module
    ranges: tuple[tuple[float, float], ...] = ()
    """Of `weights`: the ends between which each parameter of the rules is set."""

    @classmethod
    def of(cls, task: Task, kind: str, base: str = "rules", bound: float = 0.5) -> Hybrid:
        """Return the hybrid of a task with its hand-written player `base`; queueing@5 is that of search seed 5.

        kind: one of KINDS, see the module; bound: of the network's part, see there.

        Raises:
            ValueError: in one line, an unknown kind, base or seed, or a base that does not allow this kind.
        """
        rules = _base(task, base)
        _check_kind("action", kind, rules)
        _check_bound("bound", kind, bound)
        return cls(kind, rules, bound, _ranges(rules) if kind == "weights" else ())

    @classmethod
    def from_card(cls, about: Any, task: Task) -> Hybrid:
        """Return the hybrid that a card describes; raise ValueError, in one line, if it cannot be used.

        about: the entry `hybrid` of the card; task: that it plays.
        """
        if not isinstance(about, Mapping) or not about.keys() >= {"kind", "base", "bound", "rules"}:
            raise ValueError("the card's hybrid must hold kind, base, bound and rules")
        base = player(task, str(about["base"]))
        kind, values, known = str(about["kind"]), about["rules"], as_dict(base.rules)
        _check_kind("hybrid.kind", kind, base)
        if not isinstance(values, Mapping) or values.keys() != known.keys() or not _are_numbers([*values.values()]):
            raise ValueError(f"hybrid.rules must hold a number for each of {', '.join(known)}")
        values = {name: values[name] for name in known}
        _check_bound("hybrid.bound", kind, about["bound"])
        if kind == "priorities" and about.get("behaviours") != [*base.behaviours]:
            raise ValueError(f"hybrid.behaviours must be {', '.join(base.behaviours)}, in this order")
        ranges = _ranges_of_card(about.get("ranges"), values) if kind == "weights" else ()
        return cls(kind, base.with_rules(values), float(about["bound"]), ranges)

    @property
    def card(self) -> dict[str, Any]:
        """What a card says of it; `from_card` reads it."""
        values = as_dict(self.rules.rules)
        card = {"kind": self.kind, "base": self.rules.name, "bound": self.bound, "rules": values}
        if self.kind == "weights":
            card["ranges"] = {name: [*ends] for name, ends in zip(values, self.ranges, strict=True)}
        if self.kind == "priorities":
            card["behaviours"] = [*self.rules.behaviours]
        return card

    @property
    def outputs(self) -> int:
        """How many numbers the network puts out."""
        if self.kind == "weights":
            return len(self.ranges)
        if self.kind == "priorities":
            return len(self.rules.behaviours)
        return self.rules.task.action_layout.size + (self.kind == "gate")

    def act(self, rows: Floats, outputs: Floats, state: Any = None, begins: Any = None) -> tuple[Floats, Any]:
        """Return actions (R, A) for observations (R, O) and the network's outputs (R, K) in [-1, 1], and the state.

        state: of the rules, from the call before; begins: (R,), True for rows whose episode begins.
        """
        if self.kind == "weights":
            return self.rules.with_rules(self.parameters(outputs)).act(rows, state, begins)
        if self.kind == "priorities":
            return self.rules.act(rows, state, begins, self.order(outputs))
        force, state = self.rules.act(rows, state, begins)
        if self.kind == "residual":
            return np.clip(force + np.float32(self.bound) * outputs, -1.0, 1.0), state
        if self.kind == "mixture":
            return np.clip(np.float32(1.0 - self.bound) * force + np.float32(self.bound) * outputs, -1.0, 1.0), state
        return np.where(outputs[:, -1:] < 0, force, outputs[:, :-1]), state

    def parameters(self, outputs: Floats) -> dict[str, NDArray[np.float64]]:
        """Return the rules' parameters by name, (R,) each, of outputs (R, P): piecewise linear in each, or in its log.

        It is the logarithm where the search also divides the range logarithmically.
        """
        u = np.asarray(outputs, np.float64).T
        values = as_dict(self.rules.rules).items()
        return {
            name: _within(share, value, *ends)
            for share, (name, value), ends in zip(u, values, self.ranges, strict=True)
        }

    def order(self, outputs: Floats) -> NDArray[np.intp]:
        """Return the behaviours by priority, (R, K) indices, of scores (R, K): the highest first.

        The rules' own order has scores from 0.5 down to -0.5, to which the outputs are added: 0 keeps it, and every
        order can be reached.
        """
        scores = np.linspace(0.5, -0.5, outputs.shape[1]) + outputs
        return np.argsort(-scores, axis=1, kind="stable")


class HybridPolicy(MlpPolicy):
    """A trained network whose outputs act through a hybrid; `MlpPolicy.load` returns it for such a card."""

    hybrid: Hybrid

    @classmethod
    def of(
        cls, tensors: Mapping[str, NDArray[Any]], card: Mapping[str, Any], task: Task | None, seed: int | None = 0
    ) -> HybridPolicy:
        """Return the policy of a task; raise ValueError, in one line, if card, weights and task do not fit.

        tensors: of the network, by name; card: see `read_card`; seed: of the generator that samples when not
        deterministic; None draws one.
        """
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
        """Return actions (R, A) for observations (R, O), or (A,) for one row (O,), and the state of the rules.

        observation: (R, O) or (O,) float32; state: what the last call returned, None at the start; episode_start: (R,),
        True for rows whose episode begins; deterministic: True for the mean action, if there is one.
        """
        outputs, _ = super().predict(observation, None, episode_start, deterministic)
        rows = np.atleast_2d(np.asarray(observation, np.float32))
        action, state = self.hybrid.act(rows, np.atleast_2d(outputs), state, episode_start)
        return (action[0] if outputs.ndim == 1 else action), state


def _base(task: Task, spec: str) -> RulesPlayer:
    """Return a hand-written player by name, with or without a search seed; raise ValueError if there is none."""
    if spec.partition("@")[0] not in PUBLISHED:
        return player(task, spec)
    found = load_player(spec, task)
    assert isinstance(found, RulesPlayer)
    return found


def _are_numbers(values: list[Any]) -> bool:
    return all(type(value) in (int, float) and np.isfinite(value) for value in values)


def _check_kind(key: str, kind: str, rules: RulesPlayer) -> None:
    """Raise ValueError, in one line, for an unknown kind, or for priorities of rules without an order."""
    if kind not in KINDS:
        raise ValueError(f"{key} = {kind!r}: unknown{nearest(kind, KINDS)}; allowed: {', '.join(KINDS)}")
    if kind == "priorities" and not rules.behaviours:
        tasks = [task for task, (function, _) in PLAYERS[rules.name].items() if function in ORDERED]
        raise ValueError(
            f"{key} = {kind!r}: {rules.name!r} of {rules.task.name!r} has no behaviours in an order; "
            f"tasks whose {rules.name!r} has them: {', '.join(tasks) or 'none'}"
        )


def _check_bound(key: str, kind: str, bound: Any) -> None:
    """Raise ValueError, in one line, for a bound out of its range: a mixture has shares of 1 in all."""
    most = 1 if kind == "mixture" else 2
    if not _are_numbers([bound]) or not 0 < bound <= most:
        raise ValueError(f"{key} = {bound!r}: must be above 0 and at most {most}")


def _ranges(rules: RulesPlayer) -> tuple[tuple[float, float], ...]:
    """Return the ranges of the rules' parameters, widened to hold each value."""
    values = as_dict(rules.rules)
    ranges = ranges_of(type(rules.rules))
    return tuple((min(ranges[name][0], value), max(ranges[name][1], value)) for name, value in values.items())


def _ranges_of_card(about: Any, values: Mapping[str, float]) -> tuple[tuple[float, float], ...]:
    """Return the ranges that a card lists, in the order of the parameters; raise ValueError if they do not fit."""
    if not isinstance(about, Mapping) or about.keys() != values.keys():
        raise ValueError(f"hybrid.ranges must hold both ends for each of {', '.join(values)}")
    for name, ends in about.items():
        fits = isinstance(ends, list) and len(ends) == 2 and _are_numbers(ends)
        if not fits or not ends[0] <= values[name] <= ends[1]:
            raise ValueError(f"hybrid.ranges.{name} = {printable(ends)}: must be two numbers around {values[name]!r}")
    return tuple((float(about[name][0]), float(about[name][1])) for name in values)


def _within(share: NDArray[np.float64], value: float, low: float, high: float) -> NDArray[np.float64]:
    """Return numbers between two ends: low for a share of -1, exactly `value` for 0, high for 1."""
    up, down = np.maximum(share, 0.0), np.maximum(-share, 0.0)
    if is_logarithmic(low, high):
        return np.clip(value * (high / value) ** up * (low / value) ** down, low, high)
    return np.clip(value + up * (high - value) - down * (value - low), low, high)
