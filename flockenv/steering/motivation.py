"""Laws of hunger, libido and fear, and of the intention that follows from them.

After Tu and Terzopoulos, "Artificial Fishes" (SIGGRAPH 1994). Theirs are: hunger H = 1 - n / a, of which the food n in
the stomach is digested at a constant rate (`grow_hunger`, as a rate of change); libido L = s(t) (1 - H) with s growing
evenly since the last mating (`desire`); fear of one predator min(D0 / d, 1), of all of them the sum, at most 1
(`fright`); and the order in which intentions are tested: collision, then fear (above one level flee, above a lower one
school), then the larger of hunger and libido above a level, then wander (`intention`). Ours are: effort increases
hunger, fear decays instead of ending at once, eaters share food by mass action, food grows logistically (Verhulst
1838), and levels are lower for the present intention (hysteresis), where they use a memory of the last one.
"""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import law, like

__all__ = [
    "EAT",
    "ESCAPE",
    "INTENTIONS",
    "MATE",
    "SCHOOL",
    "WANDER",
    "bite",
    "desire",
    "fright",
    "grow_hunger",
    "intention",
    "regrow",
    "update_fear",
]  # fmt: skip

INTENTIONS = ("wander", "school", "mate", "eat", "escape")
"""The intentions; agents keep the index of one."""

WANDER, SCHOOL, MATE, EAT, ESCAPE = range(5)


@law
def grow_hunger(hunger: float, rate: float, effort: float, pace: float, seconds: float) -> float:
    """Return hunger, 0 (full) to 1 (starved), after some seconds: dH/dt = rate + effort pace^2, 1/s.

    `pace` is speed over max_speed.
    """
    one = like(hunger, 1.0)
    later = hunger + (rate + effort * pace * pace) * seconds
    return later if later < one else one


@law
def bite(amount: float, hunger: float, rate: float, seconds: float) -> float:
    """Return the eaten part of an amount: rate x amount x hunger x seconds, also for sums of amounts or hungers."""
    return rate * amount * hunger * seconds


@law
def regrow(amount: float, growth: float, capacity: float, seconds: float) -> float:
    """Return an amount after logistic growth da/dt = r a (1 - a / K), in closed form, exact for any step."""
    share = amount / capacity
    return amount / (share + (like(amount, 1.0) - share) * np.exp(-growth * seconds))  # type: ignore[no-any-return]


@law
def desire(urge: float, hunger: float) -> float:
    """Return libido, L = min(s (1 - H), 1): it is low while the agent is hungry."""
    one = like(urge, 1.0)
    libido = urge * (one - hunger)
    return libido if libido < one else one


@law
def fright(distance: float, span: float) -> float:
    """Return the fear of one predator in sight, min(D0 / d, 1); `span` is D0, m."""
    return span / distance if distance > span else (like(span, 1.0) if span > like(span, 0.0) else span)


@law
def update_fear(fear: float, present: float, memory: float, seconds: float) -> float:
    """Return fear: the present one, or the previous one times exp(-t / memory) if that is more."""
    left = fear * np.exp(-seconds / memory)
    return present if present > left else left


@law
def intention(
    now: float, hunger: float, libido: float, fear: float, escape: float, school: float, need: float, calm: float,
    content: float,
) -> float:  # fmt: skip
    """Return the index of the intention in INTENTIONS: fear first, then the larger of two needs, else wander.

    `escape` and `school`: levels of fear; `need`: of hunger and libido. An intention ends when its
    cause is `calm` (fear) or `content` (needs) below its level, and one need replaces another only if it is larger by
    `content`.
    """
    o, e = like(fear, 0.0), like(fear, 1.0)
    eat, mate = like(fear, EAT), like(fear, MATE)
    flees = fear > escape - (calm if now == like(fear, ESCAPE) else o)
    joins = fear > school - (calm if now == like(fear, SCHOOL) else o)
    to_eat, to_mate = hunger + (content if now == eat else o), libido + (content if now == mate else o)
    calls = eat if to_eat >= to_mate else mate
    wants = calls if (to_eat if to_eat >= to_mate else to_mate) > need else o
    return like(fear, ESCAPE) if flees else (e if joins else wants)
