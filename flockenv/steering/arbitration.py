"""Arbitration: one steering force from those of several behaviours.

`forces` is a tuple of steering forces in order of priority, all in one unit; a zero vector is an idle behaviour.
`budget` bounds the result, in the same unit. The first laws need no scene, so players also call them. Each record below
can be the arbitration of a `Steer` effect: its law (p, me, forces) -> (force, shares) returns the resulting force, N,
and the share of each steering force in it.

Sources: Reynolds 1987 (prioritised acceleration allocation) and 1999 (blending, priority, dithering); Buckland,
"Programming Game AI by Example" (2004; the running sum); Fray, "Context Steering" (Game AI Pro 2, 2015).
"""

from __future__ import annotations

import functools
import operator
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numba.extending import overload
from pydantic import Field

from flockenv.core.record import Record
from flockenv.jit.decorators import OPTIONS, Law, Vec, law, like, replace_at
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import add, axis, cross, dot, limit, norm, perpendicular, scale, select, unit, zero
from flockenv.steering.motivation import INTENTIONS

__all__ = [
    "ARBITRATIONS", "Allocation", "AnyArbitration", "Arbitration", "Blend", "ContextSteering", "Dithering",
    "Intentions", "Priority", "RoundRobin", "RunningSum", "allocate", "allocate_running", "blend", "prioritise",
]  # fmt: skip

Forces = tuple[Vec, ...]
Shares = tuple[float, ...]

Chance = Annotated[float, Field(ge=0, le=1)]

ARBITRATIONS: dict[str, type[Arbitration]] = {}
"""Every arbitration by its kind; a class registers itself when it is defined."""


def _no_shares(forces: Forces) -> Shares:
    """Return a zero for each force."""
    return (0.0,) * len(forces)


@overload(_no_shares, jit_options=OPTIONS)
def _compiled_no_shares(forces):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    zeros = "".join("o, " for _ in range(len(forces)))
    namespace: dict[str, Any] = {"like": like}
    exec(f"def zeros(forces):\n    o = like(forces[0][0], 0.0)\n    return ({zeros})", namespace)  # noqa: S102  # K is a type's
    return namespace["zeros"]


@law
def _period_number(time: float, period: float) -> int:
    """Return the index of the period that contains a time.

    Each period begins a thousandth of its length early, because of rounding: 0.3 s in steps of 0.02 s and 0.3 s in
    steps of 0.05 s are two numbers, and 0.3 / 0.1 would be 2 or 3.
    """
    return np.int64(np.floor(time / period + like(period, 1e-3)))  # type: ignore[return-value]  # a number in a kernel


@law
def _total_share(forces: Forces, shares: Shares) -> Vec:
    """Return the sum of the forces times their shares."""
    total = zero(forces[0])
    for k in range(len(forces)):
        total = add(total, scale(forces[k], shares[k]))
    return total


# --- one law each -----------------------------------------------------------------------------------------------------


@law
def _blend_shares(forces: Forces, budget: float) -> Shares:
    total = zero(forces[0])
    for k in range(len(forces)):
        total = add(total, forces[k])
    length, shares = norm(total), _no_shares(forces)
    share = budget / length if length > budget else like(length, 1.0)
    for k in range(len(forces)):
        shares = replace_at(shares, k, share)
    return shares


@law
def _first_share(forces: Forces, threshold: float, budget: float) -> Shares:
    """Return the shares: that of the first force longer than the threshold, cut to the budget; 0 for all others."""
    shares, open_ = _no_shares(forces), True
    for k in range(len(forces)):
        length = norm(forces[k])
        takes = open_ and length > threshold
        cut = budget / length if length > budget else like(length, 1.0)
        shares = replace_at(shares, k, cut if takes else like(length, 0.0))
        open_ = open_ and not takes
    return shares


@law
def _allocate_shares(forces: Forces, budget: float) -> Shares:
    shares, left = _no_shares(forces), budget
    o = like(budget, 0.0)
    for k in range(len(forces)):
        length = norm(forces[k])
        fits = length <= left
        shares = replace_at(shares, k, like(length, 1.0) if fits else left / length)
        left = left - length if fits else o
    return shares


@law
def _running_shares(forces: Forces, budget: float) -> Shares:
    shares, total = _no_shares(forces), zero(forces[0])
    o = like(budget, 0.0)
    for k in range(len(forces)):
        length, left = norm(forces[k]), budget - norm(total)
        left = left if left > o else o
        share = like(length, 1.0) if length <= left else left / length
        shares = replace_at(shares, k, share)
        total = add(total, scale(forces[k], share))
    return shares


@law
def blend(forces: Forces, weights: Vec, budget: float) -> Vec:
    """Return the weighted sum, shortened to the budget (Reynolds 1999). Opposite forces cancel: +8 and -8 give 0.

    forces: in one unit; weights: a number for each, without a unit; budget: the longest result.
    """
    total = zero(forces[0])
    for k in range(len(forces)):
        total = add(total, scale(forces[k], weights[k]))
    return limit(total, budget)


@law
def prioritise(forces: Forces, threshold: float, budget: float) -> Vec:
    """Return the first force longer than the threshold, shortened to the budget; all others are ignored.

    forces: in order of priority, in one unit, as are threshold and budget, the longest result.
    """
    return _total_share(forces, _first_share(forces, threshold, budget))


@law
def allocate(forces: Forces, budget: float) -> Vec:
    """Add forces in order until their lengths have used up the budget; the last one is cut to the remainder.

    Prioritised acceleration allocation (Reynolds 1987): lengths add up as scalars, so the sum needs no shortening, and
    the most important force is never shortened by others. (8,0), (-8,0), (0,5) within 10 give (6, 0).
    """
    return _total_share(forces, _allocate_shares(forces, budget))


@law
def allocate_running(forces: Forces, budget: float) -> Vec:
    """Add forces in order, each cut to the budget less the length of the sum so far (Buckland 2004).

    Unlike in `allocate`, opposite forces free a part of the budget: (8,0), (-8,0), (0,5) within 10 give (6, 4).
    """
    return _total_share(forces, _running_shares(forces, budget))


# --- records, for scenes ----------------------------------------------------------------------------------------------


class Arbitration(Record):
    """Base class of the methods that combine forces; `law` is a law (p, me, forces) -> (force, shares)."""

    kind: str
    law: ClassVar[Law]
    exclusive: ClassVar[bool] = False
    """True if only one behaviour acts at a time."""
    recalls: ClassVar[tuple[str, ...]] = ()
    """Names of the inner numbers that the law reads as me.inner.NAME, and that some effect keeps."""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        kind = cls.model_fields["kind"].default
        if isinstance(kind, str):
            ARBITRATIONS[kind] = cls

    def parameters(self, forces: int) -> dict[str, float | Vec]:
        """Return the numbers passed to its law, by name, for a number of forces."""
        return {name: float(getattr(self, name)) for name in type(self).model_fields if name != "kind"}


@law
def _blend_forces(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return the sum of all forces; the caller cuts it to max_force."""
    total = zero(forces[0])
    for k in range(len(forces)):
        total = add(total, forces[k])
    return total, _blend_shares(forces, me.max_force)


class Blend(Arbitration):
    """The sum of all forces, shortened to max_force; opposite forces cancel. The behaviours have the weights.

    The result is the same as with the behaviours in the scene's list of effects.
    """

    kind: Literal["blend"] = "blend"
    law: ClassVar[Law] = _blend_forces


@law
def _take_first(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return the first force above the threshold, and the shares."""
    shares = _first_share(forces, p.threshold, me.max_force)
    return _total_share(forces, shares), shares


class Priority(Arbitration):
    """The first behaviour whose force exceeds the threshold acts alone (Reynolds 1999)."""

    kind: Literal["priority"] = "priority"
    threshold: float = Field(default=1e-3, ge=0, description="N, a force of at most this size counts as zero")
    law: ClassVar[Law] = _take_first
    exclusive: ClassVar[bool] = True


@law
def _take_at_random(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return the first force above the threshold whose behaviour is drawn, and the shares."""
    shares, open_ = _no_shares(forces), True
    frame, who = _period_number(me.time, p.period), int(me.who)
    for k in range(len(forces)):
        length = norm(forces[k])
        drawn = uniform(me.key, frame, who, 50_000 + k) < p.probability[k]
        takes = open_ and drawn and length > p.threshold
        cut = me.max_force / length if length > me.max_force else like(length, 1.0)
        shares = replace_at(shares, k, cut if takes else like(length, 0.0))
        open_ = open_ and not takes
    return _total_share(forces, shares), shares


class Dithering(Arbitration):
    """Prioritised dithering: in order, each behaviour is drawn with a probability; the first drawn and active one acts.

    The draw is a function of (world, time, agent) and lasts for `period`: it does not depend on dt.
    """

    kind: Literal["dithering"] = "dithering"
    probability: Chance | Annotated[tuple[Chance, ...], Field(min_length=1)] = Field(
        default=0.9, description="probability of a draw, for all behaviours or for each, 0 to 1 (Reynolds 1999: 0.9)"
    )
    period: float = Field(default=0.1, gt=0, description="s, duration of a draw")
    threshold: float = Field(default=1e-3, ge=0, description="N, a force of at most this size counts as zero")
    law: ClassVar[Law] = _take_at_random
    exclusive: ClassVar[bool] = True

    def parameters(self, forces: int) -> dict[str, float | Vec]:
        """Return period, threshold, and a probability for each force."""
        each = self.probability if isinstance(self.probability, tuple) else (self.probability,) * forces
        if len(each) != forces:
            raise ValueError(
                f"arbitration.probability = {self.probability}: must be one number, or one for each of "
                f"{forces} behaviours"
            )
        return {"period": self.period, "threshold": self.threshold, "probability": tuple(map(float, each))}


@law
def _allocate_force(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return the sum of forces whose lengths use up max_force in order, and the shares."""
    shares = _allocate_shares(forces, me.max_force)
    return _total_share(forces, shares), shares


class Allocation(Arbitration):
    """Prioritised acceleration allocation (Reynolds 1987): in order, until their lengths have used up max_force."""

    kind: Literal["allocation"] = "allocation"
    law: ClassVar[Law] = _allocate_force


@law
def _allocate_running_force(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return the sum of forces, each cut to max_force less the length of the sum so far, and the shares."""
    shares = _running_shares(forces, me.max_force)
    return _total_share(forces, shares), shares


class RunningSum(Arbitration):
    """Forces in order, as in `Allocation`, but the length of the sum so far uses up max_force (Buckland 2004)."""

    kind: Literal["running_sum"] = "running_sum"
    law: ClassVar[Law] = _allocate_running_force


@law
def _take_turns(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return the force of the behaviour that acts in this period, and the shares."""
    shares = _no_shares(forces)
    turn = _period_number(me.time, p.period) % len(forces)
    for k in range(len(forces)):
        length = norm(forces[k])
        cut = me.max_force / length if length > me.max_force else like(length, 1.0)
        shares = replace_at(shares, k, cut if k == turn else like(length, 0.0))
    return _total_share(forces, shares), shares


class RoundRobin(Arbitration):
    """One behaviour after another acts for a period, whatever its force: cheap, but the others react late."""

    kind: Literal["round_robin"] = "round_robin"
    period: float = Field(default=0.05, gt=0, description="s, duration of a turn")
    law: ClassVar[Law] = _take_turns
    exclusive: ClassVar[bool] = True


@law
def _spread_direction(ahead: Vec, j: int, n: int) -> Vec:
    """Return direction j of n evenly spread ones, of which `ahead` is the first."""
    e = like(ahead[0], 1.0)
    if len(ahead) == 2:
        angle = like(e, 2 * np.pi) * like(e, j) / like(e, n)
        c, s = np.cos(angle), np.sin(angle)
        return (ahead[0] * c - ahead[1] * s, ahead[0] * s + ahead[1] * c)
    else:  # rings about it, in steps of the golden angle
        height = e - like(e, 2.0) * like(e, j) / like(e, max(n - 1, 1))
        ring = np.sqrt(max(e - height * height, like(e, 0.0)))
        angle = like(e, 2.399963229728653) * like(e, j)
        side = perpendicular(ahead)
        around = add(scale(side, np.cos(angle)), scale(cross(ahead, side), np.sin(angle)))
        return add(scale(ahead, height), scale(around, ring))


@law
def _danger_and_interest(p: Any, forces: Forces, direction: Vec) -> tuple[float, float]:
    """Return the danger and the interest of a direction, N."""
    o = like(direction[0], 0.0)
    danger, interest = o, o
    for k in range(len(forces)):
        along = dot(forces[k], direction)
        interest += along if along > o else o
        danger -= along if (along < o) & (like(o, k) < p.dangers) else o
    return danger, interest


@law
def _choose_direction(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return a force in the most interesting of the least dangerous directions, and the shares."""
    o, e = like(forces[0][0], 0.0), like(forces[0][0], 1.0)
    total = zero(forces[0])
    for k in range(len(forces)):
        total = add(total, forces[k])
    ahead = unit(total)
    ahead = select(dot(ahead, ahead) > o, ahead, me.heading)
    ahead = select(dot(ahead, ahead) > o, ahead, axis(total, 0))
    least, most = like(o, np.inf), o
    count = int(p.directions)
    for j in range(count):
        danger, _ = _danger_and_interest(p, forces, _spread_direction(ahead, j, count))
        least, most = min(least, danger), max(most, danger)
    bound = least + like(o, 1e-3) * (most - least)  # as good as the least
    best, chosen = -e, zero(total)
    for j in range(count):
        direction = _spread_direction(ahead, j, count)
        danger, interest = _danger_and_interest(p, forces, direction)
        better = (danger <= bound) & (interest > best)
        best, chosen = interest if better else best, select(better, direction, chosen)
    force = limit(scale(chosen, best if best > o else o), me.max_force)
    shares = _no_shares(forces)
    for k in range(len(forces)):
        square = dot(forces[k], forces[k])
        share = dot(force, forces[k]) / square if square > o else o
        shares = replace_at(shares, k, min(max(share, o), e))
    return force, shares


class ContextSteering(Arbitration):
    """Directions are scored, not forces added: the best of those that are least dangerous (Fray 2015).

    The direction opposite to a force of the first `dangers` behaviours is dangerous; that of any force is interesting.
    The share of a force is the part of it that is in the result.
    """

    kind: Literal["context"] = "context"
    dangers: int = Field(default=1, ge=0, description="number of behaviours, from the first on, that avert a danger")
    directions: int = Field(default=24, ge=4, le=256, description="number of directions")
    law: ClassVar[Law] = _choose_direction


@law
def _take_by_intention(p: Any, me: Any, forces: Forces) -> tuple[Vec, Shares]:
    """Return the allocated sum of the forces that belong to the intention or always act, and the shares."""
    shares, left = _no_shares(forces), me.max_force
    o, e = like(left, 0.0), like(left, 1.0)
    for k in range(len(forces)):
        length = norm(forces[k])
        acts = (p.when[k] < o) | (p.when[k] == me.inner.intention)
        fits = length <= left
        share = e if fits else left / length
        shares = replace_at(shares, k, share if acts else o)
        left = left - (length if fits else left) if acts else left
    return _total_share(forces, shares), shares


class Intentions(Arbitration):
    """A finite state machine: each behaviour is active in one state, or always (avoid).

    An `intention` effect keeps the state. The active behaviours share max_force in order, as in allocation.
    """

    kind: Literal["intentions"] = "intentions"
    when: tuple[Literal["avoid", "escape", "eat", "mate", "school", "wander"], ...] = Field(
        min_length=1, description="state in which each behaviour is active; avoid = always"
    )
    law: ClassVar[Law] = _take_by_intention
    recalls: ClassVar[tuple[str, ...]] = ("intention",)

    def parameters(self, forces: int) -> dict[str, float | Vec]:
        """Return the index of the state in which each behaviour is active; -1 = always."""
        if len(self.when) != forces:
            raise ValueError(f"arbitration.when = {list(self.when)}: must be one for each of {forces} behaviours")
        return {"when": tuple(float(INTENTIONS.index(name)) if name != "avoid" else -1.0 for name in self.when)}


if TYPE_CHECKING:
    AnyArbitration = Arbitration
else:
    AnyArbitration = Annotated[functools.reduce(operator.or_, ARBITRATIONS.values()), Field(discriminator="kind")]
    """An arbitration of any kind, as a field of a record: read from a file, its `kind` selects the class."""
