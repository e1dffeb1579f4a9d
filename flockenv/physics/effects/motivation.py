"""Motivation of animals: hunger, libido, fear, intentions; food that grows and is eaten, prey that is caught.

None of these is a force. They keep inner numbers of agents (`State.inner`), which an arbitration (`intentions`), a sink
(`threshold`) or a user's law reads. The formulas and their sources are in `flockenv.steering.motivation`. Transfers
between two agents are computed for both from the same instant: a fish eats as much as its food loses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import norm, planar
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Effect, Me, Other, Sight, demand_group
from flockenv.steering import motivation

__all__ = ["Fear", "Grazing", "Intention", "Libido", "Metabolism", "Predation"]

CHANNEL = 81_000
"""RNG channel of initial values."""


@law
def _is_member(who: float, first: float, end: float) -> bool:
    """Return True if an agent is one of [first, end)."""
    inside: bool = (who >= first) & (who < end)
    return inside


@law
def _draw_initial(p: Any, me: Any, channel: int) -> float:
    """Return an initial value, uniform in start +- spread / 2; 0 for agents outside the group."""
    half = like(p.start, 0.5)
    share = like(p.start, uniform(me.key, 0, int(me.who), channel)) - half
    mine = p.start + p.spread * share
    return mine if _is_member(me.who, p.first, p.end) else like(p.start, 0.0)


class _Urge(Effect):
    """Base class of these effects, with the group that they apply to."""

    conserves_momentum: ClassVar[bool] = True  # it exerts no force

    group: int | None = Field(default=None, ge=0, description="index of the group that it applies to (default: all)")

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """Return the agents it applies to, [first, end), and those of the other group, if any."""
        found: dict[str, float] = {}
        for name, first, end in (("group", "first", "end"), ("other", "from_other", "to_other")):
            which = getattr(self, name, None)
            low, high = (0, starts[-1]) if which is None else starts[which : which + 2]
            found |= {first: float(low), end: float(high)}
        return found

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if a group does not exist."""
        for name in ("group", "other"):
            demand_group(name, getattr(self, name, None), scene.groups)
        super().check(scene)

    def numbers_of(self, *names: str) -> dict[str, float | Vec]:
        """Return the values of some fields, by name, as floats for laws."""
        return {name: float(getattr(self, name)) for name in names}


# --- hunger that grows ------------------------------------------------------------------------------------------------


@law
def initial_hunger(p: Any, me: Me) -> Vec:
    """Return the initial hunger."""
    return (_draw_initial(p, me, CHANNEL),)


@law
def update_hunger(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return the hunger after a step: it grows with time and effort."""
    o = like(me.max_speed, 0.0)
    pace = norm(me.vel) / me.max_speed if me.max_speed > o else o
    later = motivation.grow_hunger(me.inner.hunger, p.rate, p.effort, pace, seconds)
    return (later if _is_member(me.who, p.first, p.end) else me.inner.hunger,)


class Metabolism(_Urge):
    """Hunger, 0 (full) to 1 (starved), that grows with time and effort: dH/dt = rate + effort (v / max_speed)^2.

    The first term is Tu and Terzopoulos' (1994), the second ours.

    Limits: hunger has an effect only through what reads it: an arbitration, a sink or a law. It grows by speed relative
    to max_speed, and for agents without one by time alone.
    """

    kind: Literal["metabolism"] = "metabolism"
    rate: float = Field(default=0.02, ge=0, description="1/s, at rest")
    effort: float = Field(default=0.0, ge=0, description="1/s more at max_speed")
    start: float = Field(default=0.3, ge=0, le=1, description="mean initial hunger")
    spread: float = Field(default=0.0, ge=0, le=1, description="width of the uniform distribution of initial values")
    begin_law: ClassVar[Law | None] = initial_hunger
    keep_law: ClassVar[Law | None] = update_hunger
    keeps: ClassVar[tuple[str, ...]] = ("hunger",)
    strengths: ClassVar[tuple[str, ...]] = ("rate", "effort")

    @model_validator(mode="after")
    def _check_initial(self) -> Metabolism:
        """Raise ValueError if the initial hunger may be outside 0 to 1."""
        _demand_range(self.start, self.spread, 1.0)
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """Return rates and initial values."""
        return self.numbers_of("rate", "effort", "start", "spread")


def _demand_range(start: float, spread: float, most: float) -> None:
    """Raise ValueError if start and spread reach outside 0 to `most`."""
    if spread / 2 > min(start, most - start) * (1 + 1e-12):
        raise ValueError(
            f"spread = {spread:g}: at most {2 * min(start, most - start):g} is allowed, so that values around "
            f"start = {start:g} lie between 0 and {most:g}"
        )


# --- food -------------------------------------------------------------------------------------------------------------


@law
def initial_food(p: Any, me: Me) -> Vec:
    """Return the initial numbers: a patch's amount of food; nothing eaten yet."""
    o = like(p.capacity, 0.0)
    return o, (p.start * p.capacity if _is_member(me.who, p.from_other, p.to_other) else o), o


@law
def food_and_hunger(p: Any, me: Me, other: Other) -> Vec:
    """Return the food of the neighbour if it is a patch in reach, and its hunger if it eats of this patch."""
    o = like(other.square, 0.0)
    eats = _is_member(me.who, p.first, p.end) & _is_member(other.who, p.from_other, p.to_other)
    eaten = _is_member(me.who, p.from_other, p.to_other) & _is_member(other.who, p.first, p.end)
    return (other.inner.food if eats else o), (other.inner.hunger if eaten else o)


@law
def both_sums(p: Any, me: Me, sums: Vec) -> Vec:
    """Return both sums, food and hunger, as a vector."""
    return planar(me.pos, sums[0], sums[1])


@law
def update_grazing(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return the numbers after a step: the hunger of eaters falls; patches regrow, and lose the eaten amount."""
    o = like(p.rate, 0.0)
    patch = _is_member(me.who, p.from_other, p.to_other)
    taken = motivation.bite(message[0], me.inner.hunger, p.rate, seconds)
    lost = motivation.bite(me.inner.food, message[1], p.rate, seconds)
    less = me.inner.hunger - taken / p.appetite
    grown = motivation.regrow(me.inner.food, p.growth, p.capacity, seconds) if patch else me.inner.food
    return (less if less > o else o), grown - lost, me.inner.eaten + taken


class Grazing(_Urge):
    """Food grows in patches, each an agent of a group, and is eaten by agents within `radius` of one.

    A patch holds an amount a with da/dt = growth a (1 - a / capacity) minus rate a H for each agent that eats there, H
    its hunger. Hunger falls by the amount eaten divided by `appetite`. The model is ours: in Tu and Terzopoulos (1994)
    food is particles. Amounts are in units of food: `food` of a patch, `eaten` by an agent since the start.

    Limits: patches are agents: they do not spread, and a patch that is eaten to 0 does not grow again. Eaters need no
    line of sight, and eat regardless of what else they do.
    """

    kind: Literal["grazing"] = "grazing"
    other: int = Field(ge=0, strict=True, description="the group whose agents are patches of food")
    radius: float = Field(gt=0, description="m, agents nearer than this to a patch's centre eat of it")
    rate: float = Field(default=0.5, ge=0, description="1/s, fraction of a patch eaten by a starved agent")
    growth: float = Field(default=0.2, ge=0, description="r, 1/s, growth of a small amount of food")
    capacity: float = Field(default=3.0, gt=0, description="K, units of food in a full patch")
    start: float = Field(default=1.0, gt=0, le=1, description="initial amount, as a fraction of capacity")
    appetite: float = Field(default=1.0, gt=0, description="units of food from starved to full")
    pair_law: ClassVar[Law | None] = food_and_hunger
    finish_law: ClassVar[Law | None] = both_sums
    begin_law: ClassVar[Law | None] = initial_food
    keep_law: ClassVar[Law | None] = update_grazing
    keeps: ClassVar[tuple[str, ...]] = ("hunger", "food", "eaten")
    strengths: ClassVar[tuple[str, ...]] = ("rate", "growth")

    @property
    def sight(self) -> Sight:
        """All neighbours within the radius."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """Return 2, for food and hunger."""
        return 2

    def parameters(self) -> dict[str, float | Vec]:
        """Return growth, feeding and initial amount."""
        return self.numbers_of("rate", "growth", "capacity", "start", "appetite")

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if all eaters together could eat more than a patch holds in one step, or if patches eat."""
        super().check(scene)
        if self.group in (None, self.other):
            raise ValueError(f"group = {self.group}: must be the group that eats, different from other = {self.other}")
        assert self.group is not None
        share = self.rate * scene.dt * scene.groups[self.group].size
        if share > 1:
            all_ = f"all {scene.groups[self.group].size} of groups[{self.group}]"
            raise ValueError(
                f"rate = {self.rate:g}: {all_} could eat more than a patch holds within a step of dt = {scene.dt:g} s; "
                f"at most {self.rate / share:g} 1/s is allowed"
            )


# --- predation --------------------------------------------------------------------------------------------------------


@law
def no_catches(p: Any, me: Me) -> Vec:
    """Return the initial numbers: 0 hunger and 0 catches."""
    return like(me.mass, 0.0), like(me.mass, 0.0)


@law
def catches(p: Any, me: Me, other: Other) -> Vec:
    """Return 1 if the other catches this agent, else 0, and the reverse; a hunter must be hungry enough."""
    o, e = like(other.square, 0.0), like(other.square, 1.0)
    mine = _is_member(me.who, p.from_other, p.to_other) & _is_member(other.who, p.first, p.end)
    prey = _is_member(me.who, p.first, p.end) & _is_member(other.who, p.from_other, p.to_other)
    has_me = mine & (other.inner.hunger > p.hungry) & (p.meal > o)
    return (e if has_me else o), (e if prey & (me.inner.hunger > p.hungry) & (p.meal > o) else o)


@law
def update_catches(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return the numbers after a step: each catch reduces the hunger of the hunter, and the prey counts it."""
    o = like(p.meal, 0.0)
    less = me.inner.hunger - p.meal * message[1]
    return (less if less > o else o), me.inner.caught + message[0]


class Predation(_Urge):
    """Hunters, if hungry, catch prey nearer than `radius`; each catch reduces their hunger by `meal`.

    `caught` counts the hunters that have caught an agent; with a sink `threshold` at 1 a caught agent dies. A prey
    caught by two in one step reduces the hunger of both. The model is ours.

    A hunter that catches n prey in a step has the hunger H = max(H - n `meal`, 0) after it.

    Limits: there is no chase and no failure: prey in reach of a hungry hunter is caught, through walls also, and stays
    alive unless a sink removes it.
    """

    kind: Literal["predation"] = "predation"
    other: int = Field(ge=0, strict=True, description="the group that is hunted")
    radius: float = Field(gt=0, description="m between centres")
    meal: float = Field(default=0.5, ge=0, le=1, description="reduction of hunger per catch")
    hungry: float = Field(default=0.3, ge=0, le=1, description="hunger above which a hunter catches prey")
    pair_law: ClassVar[Law | None] = catches
    finish_law: ClassVar[Law | None] = both_sums
    begin_law: ClassVar[Law | None] = no_catches
    keep_law: ClassVar[Law | None] = update_catches
    keeps: ClassVar[tuple[str, ...]] = ("hunger", "caught")
    strengths: ClassVar[tuple[str, ...]] = ("meal",)

    @property
    def sight(self) -> Sight:
        """All neighbours within the radius."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """Return 2: times caught, and catches."""
        return 2

    def parameters(self) -> dict[str, float | Vec]:
        """Return meal and hungry."""
        return self.numbers_of("meal", "hungry")

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if a group hunts itself."""
        super().check(scene)
        if self.group in (None, self.other):
            raise ValueError(f"group = {self.group}: must be the group that hunts, different from other = {self.other}")


# --- fear -------------------------------------------------------------------------------------------------------------


@law
def no_fear(p: Any, me: Me) -> Vec:
    """Return the initial fear, 0."""
    return (like(me.mass, 0.0),)


@law
def fear_of(p: Any, me: Me, other: Other) -> Vec:
    """Return the fear of one neighbour."""
    return (motivation.fright(np.sqrt(other.square), p.span),)


@law
def one_sum(p: Any, me: Me, sums: Vec) -> Vec:
    """Return the sum of fears as a vector."""
    return planar(me.pos, sums[0], like(sums[0], 0.0))


@law
def update_fear(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return the fear after a step: that of all in sight, at most 1, or the previous one after decay."""
    one = like(p.span, 1.0)
    later = motivation.update_fear(me.inner.fear, message[0] if message[0] < one else one, p.memory, seconds)
    return (later if _is_member(me.who, p.first, p.end) else me.inner.fear,)


class Fear(_Urge):
    """Fear of others in sight, F = min(sum of min(span / distance, 1), 1), which decays over `memory` seconds.

    Sight, sum and 1 / distance are from Tu and Terzopoulos (1994; a view of 300 degrees); the decay is ours.

    Limits: it is a sum over those in sight, cut at 1: two near predators are feared as much as one. What is out of
    sight is forgotten over `memory`.
    """

    kind: Literal["fear"] = "fear"
    other: int = Field(ge=0, strict=True, description="the group that is feared")
    radius: float = Field(default=10.0, gt=0, description="m, radius of sight")
    fov: float = Field(
        title="field of view", default=300.0, gt=0, le=360, description="degrees, full angle of the field of view"
    )
    occluded: bool = Field(default=False, description="True: obstacles hide agents")
    span: float = Field(default=2.0, ge=0, description="D0, m, distance within which the fear of one agent is 1")
    memory: float = Field(default=3.0, gt=0, description="s, over which fear falls to 1/e")
    pair_law: ClassVar[Law | None] = fear_of
    finish_law: ClassVar[Law | None] = one_sum
    begin_law: ClassVar[Law | None] = no_fear
    keep_law: ClassVar[Law | None] = update_fear
    keeps: ClassVar[tuple[str, ...]] = ("fear",)
    strengths: ClassVar[tuple[str, ...]] = ("span",)

    @property
    def sight(self) -> Sight:
        """The feared group, within radius and field of view."""
        return Sight(self.radius, self.fov, group=self.other, occluded=self.occluded)

    def sums(self, dimension: int) -> int:
        """Return 1, for the sum of fears."""
        return 1

    def parameters(self) -> dict[str, float | Vec]:
        """Return span and memory."""
        return self.numbers_of("span", "memory")


# --- libido -----------------------------------------------------------------------------------------------------------


@law
def initial_urge(p: Any, me: Me) -> Vec:
    """Return the initial urge, and 0 matings."""
    return _draw_initial(p, me, CHANNEL + 1), like(p.start, 0.0)


@law
def count_willing(p: Any, me: Me, other: Other) -> Vec:
    """Return 1 if the neighbour is willing to mate, else 0."""
    o, e = like(other.square, 0.0), like(other.square, 1.0)
    would = motivation.desire(other.inner.libido, other.inner.hunger) > p.ready
    return (e if would & _is_member(other.who, p.first, p.end) else o,)


@law
def update_urge(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return urge and count after a step: the urge grows; a willing agent near another mates, which resets it."""
    o, e = like(p.rate, 0.0), like(p.rate, 1.0)
    mine = _is_member(me.who, p.first, p.end)
    mates = mine & (message[0] > o) & (motivation.desire(me.inner.libido, me.inner.hunger) > p.ready)
    grown = me.inner.libido + (p.rate * seconds if mine else o)
    return (o if mates else grown), me.inner.mated + (e if mates else o)


class Libido(_Urge):
    """An urge s that grows linearly since the last mating; libido = s (1 - H) (Tu and Terzopoulos 1994).

    Two agents mate if they are nearer than `radius` and both have a libido above `ready`; `mated` counts matings. Three
    agents in reach of each other all mate. This replaces the paper's courtship and is ours; no agent is born.

    Limits: there are no sexes, no courtship and no births. Agents mate through walls.
    """

    kind: Literal["libido"] = "libido"
    radius: float = Field(gt=0, description="m, distance at which agents mate")
    rate: float = Field(default=0.025, ge=0, description="1/s, growth of the urge")
    ready: float = Field(default=0.4, ge=0, le=1, description="libido above which an agent is willing to mate")
    start: float = Field(default=0.0, ge=0, description="mean initial urge")
    spread: float = Field(default=0.0, ge=0, description="width of the uniform distribution of initial values")
    pair_law: ClassVar[Law | None] = count_willing
    finish_law: ClassVar[Law | None] = one_sum
    begin_law: ClassVar[Law | None] = initial_urge
    keep_law: ClassVar[Law | None] = update_urge
    keeps: ClassVar[tuple[str, ...]] = ("libido", "mated")
    recalls: ClassVar[tuple[str, ...]] = ("hunger",)
    strengths: ClassVar[tuple[str, ...]] = ("rate",)

    @model_validator(mode="after")
    def _check_initial(self) -> Libido:
        """Raise ValueError if the initial urge may be below 0."""
        _demand_range(self.start, self.spread, float("inf"))
        return self

    @property
    def sight(self) -> Sight:
        """All neighbours within the radius."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """Return 1, for the number of willing neighbours."""
        return 1

    def parameters(self) -> dict[str, float | Vec]:
        """Return rate, threshold and initial values."""
        return self.numbers_of("rate", "ready", "start", "spread")


# --- intention --------------------------------------------------------------------------------------------------------


@law
def initial_intention(p: Any, me: Me) -> Vec:
    """Return the initial intention: wander."""
    return (like(me.mass, motivation.WANDER),)


@law
def update_intention(p: Any, me: Me, message: Vec, seconds: float) -> Vec:
    """Return the next intention, from the present one, hunger, libido and fear."""
    libido = motivation.desire(me.inner.libido, me.inner.hunger)
    now = motivation.intention(
        me.inner.intention, me.inner.hunger, libido, me.inner.fear, p.escape, p.school, p.need, p.calm, p.content
    )
    return (now if _is_member(me.who, p.first, p.end) else me.inner.intention,)


class Intention(_Urge):
    """A finite state machine: escape, school, eat, mate or wander, from hunger, libido and fear, with hysteresis.

    With fear above `escape` the intention is to escape; above `school`, to school; else to eat or mate for the larger
    of hunger and libido, if above `need`; else to wander (Tu and Terzopoulos 1994). An intention ends only when its
    level has fallen by `calm` or `content` below the threshold, against rapid changes; that is ours. An arbitration
    `intentions` reads it. The level of eating is the hunger H, that of mating the libido L = s (1 - H).

    Limits: it only names what an agent would do: an arbitration `intentions` in a `steer` has to act on it. The order
    of its tests is fixed.
    """

    kind: Literal["intention"] = "intention"
    escape: float = Field(default=0.4, ge=0, le=1, description="fear above which an agent flees")
    school: float = Field(default=0.15, gt=0, le=1, description="fear above which an agent joins the others")
    need: float = Field(default=0.5, gt=0, le=1, description="hunger or libido above which an agent acts on it")
    calm: float = Field(default=0.1, ge=0, description="decrease of fear below the threshold that ends both")
    content: float = Field(default=0.3, ge=0, description="decrease of the need below the threshold that ends it")
    begin_law: ClassVar[Law | None] = initial_intention
    keep_law: ClassVar[Law | None] = update_intention
    keeps: ClassVar[tuple[str, ...]] = ("intention",)
    recalls: ClassVar[tuple[str, ...]] = ("hunger", "libido", "fear")
    strengths: ClassVar[tuple[str, ...]] = ("calm", "content")

    @model_validator(mode="after")
    def _check_order(self) -> Intention:
        """Raise ValueError if the levels are out of order, or an intention would never end."""
        if self.school > self.escape:
            raise ValueError(f"school = {self.school:g}: must not be above escape = {self.escape:g}")
        if self.calm >= self.school or self.content >= self.need:
            name, level = ("calm", "school") if self.calm >= self.school else ("content", "need")
            raise ValueError(
                f"{name} = {getattr(self, name):g}: must be below {level} = {getattr(self, level):g}, "
                "or the intention would never end"
            )
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """Return the levels."""
        return self.numbers_of("escape", "school", "need", "calm", "content")
