"""Arbitration: one steering force from several behaviours that disagree.

`wishes` is a tuple of steering forces in order of priority, all in one unit; a zero vector is an idle behaviour.
`budget` bounds the result, in the same unit. The first laws need no scene, so players call them too. Each record below
can be the arbitration of a `Steer` effect: its law (p, me, wishes) -> (force, shares) returns the resulting force, N,
and the share of each steering force that is in it.

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


def no_shares(wishes: Forces) -> Shares:
    """Return a zero for each wish."""
    return (0.0,) * len(wishes)


@overload(no_shares, jit_options=OPTIONS)
def _no_shares(wishes):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    zeros = "".join("o, " for _ in range(len(wishes)))
    made: dict[str, Any] = {"like": like}
    exec(f"def zeros(wishes):\n    o = like(wishes[0][0], 0.0)\n    return ({zeros})", made)  # noqa: S102  # K is a type's
    return made["zeros"]


@law
def _period_number(time: float, period: float) -> int:
    """Number the periods: a thousandth of one early, so that no step that ends with a period misses it by a rounding.

    0.3 s in steps of 0.02 s and in steps of 0.05 s are two numbers: 0.3 / 0.1 is 2 or 3.
    """
    return np.int64(np.floor(time / period + like(period, 1e-3)))  # type: ignore[return-value]  # a number in a kernel


@law
def total_share(wishes: Forces, shares: Shares) -> Vec:
    """Return what the shares of all wishes come to."""
    total = zero(wishes[0])
    for k in range(len(wishes)):
        total = add(total, scale(wishes[k], shares[k]))
    return total


# --- one law each -----------------------------------------------------------------------------------------------------


@law
def _blend_shares(wishes: Forces, budget: float) -> Shares:
    total = zero(wishes[0])
    for k in range(len(wishes)):
        total = add(total, wishes[k])
    length, shares = norm(total), no_shares(wishes)
    share = budget / length if length > budget else like(length, 1.0)
    for k in range(len(wishes)):
        shares = replace_at(shares, k, share)
    return shares


@law
def _first_share(wishes: Forces, threshold: float, budget: float) -> Shares:
    """The first wish longer than the threshold, cut to the budget."""
    shares, open_ = no_shares(wishes), True
    for k in range(len(wishes)):
        length = norm(wishes[k])
        takes = open_ and length > threshold
        cut = budget / length if length > budget else like(length, 1.0)
        shares = replace_at(shares, k, cut if takes else like(length, 0.0))
        open_ = open_ and not takes
    return shares


@law
def _allocate_shares(wishes: Forces, budget: float) -> Shares:
    shares, left = no_shares(wishes), budget
    o = like(budget, 0.0)
    for k in range(len(wishes)):
        length = norm(wishes[k])
        whole = length <= left
        shares = replace_at(shares, k, like(length, 1.0) if whole else left / length)
        left = left - length if whole else o
    return shares


@law
def _running_shares(wishes: Forces, budget: float) -> Shares:
    shares, total = no_shares(wishes), zero(wishes[0])
    o = like(budget, 0.0)
    for k in range(len(wishes)):
        length, left = norm(wishes[k]), budget - norm(total)
        left = left if left > o else o
        share = like(length, 1.0) if length <= left else left / length
        shares = replace_at(shares, k, share)
        total = add(total, scale(wishes[k], share))
    return shares


@law
def blend(wishes: Forces, weights: Vec, budget: float) -> Vec:
    """Return the weighted sum, shortened to the budget (Reynolds 1999). Opposite wishes cancel: +8 and -8 give 0."""
    total = zero(wishes[0])
    for k in range(len(wishes)):
        total = add(total, scale(wishes[k], weights[k]))
    return limit(total, budget)


@law
def prioritise(wishes: Forces, threshold: float, budget: float) -> Vec:
    """Return the first wish longer than the threshold, shortened to the budget, and nothing of the others."""
    return total_share(wishes, _first_share(wishes, threshold, budget))


@law
def allocate(wishes: Forces, budget: float) -> Vec:
    """Grant wishes in order until their lengths have used up the budget; the last one served is cut to what is left.

    Prioritised acceleration allocation (Reynolds 1987): lengths add up as scalars, so the sum needs no shortening, and
    in an emergency the most pressing wish is served whole. (8,0), (-8,0), (0,5) within 10 give (6, 0).
    """
    return total_share(wishes, _allocate_shares(wishes, budget))


@law
def allocate_running(wishes: Forces, budget: float) -> Vec:
    """Grant wishes in order, each as far as the length of the sum so far leaves room (Buckland 2004).

    Unlike `allocate`, opposite wishes give room back: (8,0), (-8,0), (0,5) within 10 give (6, 4).
    """
    return total_share(wishes, _running_shares(wishes, budget))


# --- records, for scenes ----------------------------------------------------------------------------------------------


class Arbitration(Record):
    """How wishes are reconciled; `law` is a law (p, me, wishes) -> (force, shares)."""

    kind: str
    law: ClassVar[Law]
    exclusive: ClassVar[bool] = False
    """True if one behaviour at a time has what it asks for, and the others have nothing."""
    recalls: ClassVar[tuple[str, ...]] = ()
    """Names of the numbers inside agents that its law reads as me.inner.NAME, and that some effect keeps."""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        kind = cls.model_fields["kind"].default
        if isinstance(kind, str):
            ARBITRATIONS[kind] = cls

    def parameters(self, wishes: int) -> dict[str, float | Vec]:
        """Return the numbers its law is given, by name."""
        return {name: float(getattr(self, name)) for name in type(self).model_fields if name != "kind"}


@law
def blend_forces(p: Any, me: Any, wishes: Forces) -> tuple[Vec, Shares]:
    """All of them: the sum of whatever an agent wants is cut to max_force anyway, and only once."""
    total = zero(wishes[0])
    for k in range(len(wishes)):
        total = add(total, wishes[k])
    return total, _blend_shares(wishes, me.max_force)


class Blend(Arbitration):
    """Everything at once, shortened to max_force: weights are those of the behaviours. Opposite wishes cancel.

    It is as if the behaviours stood in the scene's list of effects.
    """

    kind: Literal["blend"] = "blend"
    law: ClassVar[Law] = blend_forces


@law
def take_first(p: Any, me: Any, wishes: Forces) -> tuple[Vec, Shares]:
    """One of them."""
    shares = _first_share(wishes, p.threshold, me.max_force)
    return total_share(wishes, shares), shares


class Priority(Arbitration):
    """The first behaviour that asks for more than the threshold has it all, the others nothing (Reynolds 1999)."""

    kind: Literal["priority"] = "priority"
    threshold: float = Field(default=1e-3, ge=0, description="N, a wish that is no longer asks for nothing")
    law: ClassVar[Law] = take_first
    exclusive: ClassVar[bool] = True


@law
def take_at_random(p: Any, me: Any, wishes: Forces) -> tuple[Vec, Shares]:
    """One of them, by lot."""
    shares, open_ = no_shares(wishes), True
    frame, who = _period_number(me.time, p.period), int(me.who)
    for k in range(len(wishes)):
        length = norm(wishes[k])
        drawn = uniform(me.key, frame, who, 50_000 + k) < p.probability[k]
        takes = open_ and drawn and length > p.threshold
        cut = me.max_force / length if length > me.max_force else like(length, 1.0)
        shares = replace_at(shares, k, cut if takes else like(length, 0.0))
        open_ = open_ and not takes
    return total_share(wishes, shares), shares


class Dithering(Arbitration):
    """Prioritised dithering: each behaviour in order is drawn with a probability; the first active one gets everything.

    The draw is a function of (world, time, agent) and lasts for `period`: it does not depend on dt.
    """

    kind: Literal["dithering"] = "dithering"
    probability: Chance | Annotated[tuple[Chance, ...], Field(min_length=1)] = Field(
        default=0.9, description="to be heard: of all behaviours, or of each, 0 to 1 (Reynolds 1999: 0.9)"
    )
    period: float = Field(default=0.1, gt=0, description="s, how long a draw lasts")
    threshold: float = Field(default=1e-3, ge=0, description="N, a wish that is no longer asks for nothing")
    law: ClassVar[Law] = take_at_random
    exclusive: ClassVar[bool] = True

    def parameters(self, wishes: int) -> dict[str, float | Vec]:
        """A probability for each wish."""
        each = self.probability if isinstance(self.probability, tuple) else (self.probability,) * wishes
        if len(each) != wishes:
            raise ValueError(
                f"arbitration.probability = {self.probability}: must be one number, or one for each of "
                f"{wishes} behaviours"
            )
        return {"period": self.period, "threshold": self.threshold, "probability": tuple(map(float, each))}


@law
def allocate_force(p: Any, me: Any, wishes: Forces) -> tuple[Vec, Shares]:
    """Lengths use up the budget."""
    shares = _allocate_shares(wishes, me.max_force)
    return total_share(wishes, shares), shares


class Allocation(Arbitration):
    """Prioritised acceleration allocation (Reynolds 1987): in order, until their lengths have used up max_force."""

    kind: Literal["allocation"] = "allocation"
    law: ClassVar[Law] = allocate_force


@law
def allocate_running_force(p: Any, me: Any, wishes: Forces) -> tuple[Vec, Shares]:
    """The length of their sum uses up the budget."""
    shares = _running_shares(wishes, me.max_force)
    return total_share(wishes, shares), shares


class RunningSum(Arbitration):
    """As allocation, but it is the length of the sum so far that uses up max_force (Buckland 2004)."""

    kind: Literal["running_sum"] = "running_sum"
    law: ClassVar[Law] = allocate_running_force


@law
def take_turns(p: Any, me: Any, wishes: Forces) -> tuple[Vec, Shares]:
    """Whose turn it is."""
    shares = no_shares(wishes)
    turn = _period_number(me.time, p.period) % len(wishes)
    for k in range(len(wishes)):
        length = norm(wishes[k])
        cut = me.max_force / length if length > me.max_force else like(length, 1.0)
        shares = replace_at(shares, k, cut if k == turn else like(length, 0.0))
    return total_share(wishes, shares), shares


class RoundRobin(Arbitration):
    """One behaviour after another has its turn, whatever it asks for: cheap, and late by as many turns."""

    kind: Literal["round_robin"] = "round_robin"
    period: float = Field(default=0.05, gt=0, description="s, how long a turn lasts")
    law: ClassVar[Law] = take_turns
    exclusive: ClassVar[bool] = True


@law
def _spread_direction(ahead: Vec, j: int, n: int) -> Vec:
    """Return direction j of n, spread evenly about `ahead`, which is the first."""
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
def _danger_and_interest(p: Any, wishes: Forces, way: Vec) -> tuple[float, float]:
    """Return how dangerous a direction is, and how much is to be said for it."""
    o = like(way[0], 0.0)
    danger, interest = o, o
    for k in range(len(wishes)):
        along = dot(wishes[k], way)
        interest += along if along > o else o
        danger -= along if (along < o) & (like(o, k) < p.dangers) else o
    return danger, interest


@law
def choose_direction(p: Any, me: Any, wishes: Forces) -> tuple[Vec, Shares]:
    """The best of the least dangerous directions."""
    o, e = like(wishes[0][0], 0.0), like(wishes[0][0], 1.0)
    total = zero(wishes[0])
    for k in range(len(wishes)):
        total = add(total, wishes[k])
    ahead = unit(total)
    ahead = select(dot(ahead, ahead) > o, ahead, me.heading)
    ahead = select(dot(ahead, ahead) > o, ahead, axis(total, 0))
    least, most = like(o, np.inf), o
    count = int(p.directions)
    for j in range(count):
        danger, _ = _danger_and_interest(p, wishes, _spread_direction(ahead, j, count))
        least, most = min(least, danger), max(most, danger)
    bound = least + like(o, 1e-3) * (most - least)  # as good as the least
    best, chosen = -e, zero(total)
    for j in range(count):
        way = _spread_direction(ahead, j, count)
        danger, interest = _danger_and_interest(p, wishes, way)
        better = (danger <= bound) & (interest > best)
        best, chosen = interest if better else best, select(better, way, chosen)
    force = limit(scale(chosen, best if best > o else o), me.max_force)
    shares = no_shares(wishes)
    for k in range(len(wishes)):
        square = dot(wishes[k], wishes[k])
        share = dot(force, wishes[k]) / square if square > o else o
        shares = replace_at(shares, k, min(max(share, o), e))
    return force, shares


class ContextSteering(Arbitration):
    """Directions are weighed, not wishes added: the best of those that are least dangerous (Fray 2015).

    Of the first `dangers` behaviours the opposite of a wish is dangerous; what all of them wish for is interesting. The
    share of a wish is how much of it lies in what is done.
    """

    kind: Literal["context"] = "context"
    dangers: int = Field(default=1, ge=0, description="how many behaviours, from the first on, avert a danger")
    directions: int = Field(default=24, ge=4, le=256, description="how many directions are weighed")
    law: ClassVar[Law] = choose_direction


@law
def take_by_intention(p: Any, me: Any, wishes: Forces) -> tuple[Vec, Shares]:
    """Those that are always heard and those of the intention, until their lengths have used up the budget."""
    shares, left = no_shares(wishes), me.max_force
    o, e = like(left, 0.0), like(left, 1.0)
    for k in range(len(wishes)):
        length = norm(wishes[k])
        heard = (p.when[k] < o) | (p.when[k] == me.inner.intention)
        whole = length <= left
        share = e if whole else left / length
        shares = replace_at(shares, k, share if heard else o)
        left = left - (length if whole else left) if heard else left
    return total_share(wishes, shares), shares


class Intentions(Arbitration):
    """A finite state machine: each behaviour is active in one state, or always (avoid); the others get nothing.

    An `intention` effect keeps the state. The active behaviours share max_force in order, as in allocation.
    """

    kind: Literal["intentions"] = "intentions"
    when: tuple[Literal["avoid", "escape", "eat", "mate", "school", "wander"], ...] = Field(
        min_length=1, description="state in which each behaviour is active; avoid = always"
    )
    law: ClassVar[Law] = take_by_intention
    recalls: ClassVar[tuple[str, ...]] = ("intention",)

    def parameters(self, wishes: int) -> dict[str, float | Vec]:
        """The number of a state for each wish; -1 = always."""
        if len(self.when) != wishes:
            raise ValueError(f"arbitration.when = {list(self.when)}: must be one for each of {wishes} behaviours")
        return {"when": tuple(float(INTENTIONS.index(name)) if name != "avoid" else -1.0 for name in self.when)}


if TYPE_CHECKING:
    AnyArbitration = Arbitration
else:
    AnyArbitration = Annotated[functools.reduce(operator.or_, ARBITRATIONS.values()), Field(discriminator="kind")]
