"""What goes on inside animals: hunger, libido, fear, intentions; food that grows and is eaten, prey that is caught.

None of these is a force. They keep numbers inside agents (`State.inner`), which an arbitration (`intentions`), a sink
(`threshold`) or a law of yours reads. The formulas, and whose they are, stand in `flockenv.steering.motivation`. What
passes between two agents is gathered from both sides, each from the same instant: what a fish eats is what its food
loses.
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
"""Of the draws of what agents begin with."""


@law
def _among(who: float, first: float, end: float) -> bool:
    """Is an agent one of [first, end)?"""
    inside: bool = (who >= first) & (who < end)
    return inside


@law
def _drawn(p: Any, me: Any, channel: int) -> float:
    """What it begins with: start, and up to half of `spread` more or less."""
    half = like(p.start, 0.5)
    share = like(p.start, uniform(me.key, 0, int(me.who), channel)) - half
    mine = p.start + p.spread * share
    return mine if _among(me.who, p.first, p.end) else like(p.start, 0.0)


class _Urge(Effect):
    """What these effects share: whom they are about."""

    conserves_momentum: ClassVar[bool] = True  # it pushes nobody

    group: int | None = Field(default=None, ge=0, description="who has it; none = everybody")

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """Whom it is about, [first, end); and the others, if there are any."""
        found: dict[str, float] = {}
        for name, first, end in (("group", "first", "end"), ("other", "from_other", "to_other")):
            which = getattr(self, name, None)
            low, high = (0, starts[-1]) if which is None else starts[which : which + 2]
            found |= {first: float(low), end: float(high)}
        return found

    def check(self, scene: SceneView) -> None:
        """Refuse groups that are not there."""
        for name in ("group", "other"):
            demand_group(name, getattr(self, name, None), scene.groups)
        super().check(scene)

    def given(self, *names: str) -> dict[str, float | Vec]:
        """Return some fields as the numbers of its laws."""
        return {name: float(getattr(self, name)) for name in names}


# --- hunger that grows ------------------------------------------------------------------------------------------------


@law
def hungry_from(p: Any, me: Me) -> Vec:
    """How hungry it begins."""
    return (_drawn(p, me, CHANNEL),)


@law
def digesting(p: Any, me: Me, told: Vec, seconds: float) -> Vec:
    """Time and effort make hungry."""
    o = like(me.max_speed, 0.0)
    pace = norm(me.vel) / me.max_speed if me.max_speed > o else o
    later = motivation.hungrier(me.inner.hunger, p.rate, p.effort, pace, seconds)
    return (later if _among(me.who, p.first, p.end) else me.inner.hunger,)


class Metabolism(_Urge):
    """Hunger, 0 (full) to 1 (starved), that grows with time and effort: dH/dt = rate + effort (v / max_speed)^2.

    The first term is Tu and Terzopoulos' (1994), the second ours.
    """

    kind: Literal["metabolism"] = "metabolism"
    rate: float = Field(default=0.02, ge=0, description="1/s, at rest")
    effort: float = Field(default=0.0, ge=0, description="1/s more at max_speed")
    start: float = Field(default=0.3, ge=0, le=1, description="hunger at the start, in the middle")
    spread: float = Field(default=0.0, ge=0, le=1, description="how far it differs from one to the next")
    begin_law: ClassVar[Law | None] = hungry_from
    keep_law: ClassVar[Law | None] = digesting
    keeps: ClassVar[tuple[str, ...]] = ("hunger",)
    strengths: ClassVar[tuple[str, ...]] = ("rate", "effort")

    @model_validator(mode="after")
    def _within(self) -> Metabolism:
        """Refuse who would begin beyond starved, or fuller than full."""
        _demand_range(self.start, self.spread, 1.0)
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """How fast, and from where."""
        return self.given("rate", "effort", "start", "spread")


def _demand_range(start: float, spread: float, most: float) -> None:
    """Refuse a start that spreads beyond 0 to `most`."""
    if spread / 2 > min(start, most - start) * (1 + 1e-12):
        raise ValueError(f"spread = {spread:g}: start = {start:g} leaves room for {2 * min(start, most - start):g}")


# --- food -------------------------------------------------------------------------------------------------------------


@law
def food_from(p: Any, me: Me) -> Vec:
    """How much there is of a patch; nobody has eaten."""
    o = like(p.capacity, 0.0)
    return o, (p.start * p.capacity if _among(me.who, p.from_other, p.to_other) else o), o


@law
def at_table(p: Any, me: Me, other: Other) -> Vec:
    """What there is for me, and how hungry those are who eat of me."""
    o = like(other.square, 0.0)
    eats = _among(me.who, p.first, p.end) & _among(other.who, p.from_other, p.to_other)
    eaten = _among(me.who, p.from_other, p.to_other) & _among(other.who, p.first, p.end)
    return (other.inner.food if eats else o), (other.inner.hunger if eaten else o)


@law
def told_both(p: Any, me: Me, sums: Vec) -> Vec:
    """Both sums, as a vector."""
    return planar(me.pos, sums[0], sums[1])


@law
def grazed(p: Any, me: Me, told: Vec, seconds: float) -> Vec:
    """Who eats gets less hungry; what is eaten of grows, and loses the same."""
    o = like(p.rate, 0.0)
    patch = _among(me.who, p.from_other, p.to_other)
    taken = motivation.bite(told[0], me.inner.hunger, p.rate, seconds)
    lost = motivation.bite(me.inner.food, told[1], p.rate, seconds)
    less = me.inner.hunger - taken / p.appetite
    grown = motivation.regrown(me.inner.food, p.growth, p.capacity, seconds) if patch else me.inner.food
    return (less if less > o else o), grown - lost, me.inner.eaten + taken


class Grazing(_Urge):
    """Food that grows in patches, each an agent of its group, and is eaten by who is within `radius` of one.

    A patch holds an amount a with da/dt = growth a (1 - a / capacity) minus what is eaten: rate a H of each who is
    there, H its hunger. Hunger falls by what is eaten over `appetite`. All of it is ours: in Tu and Terzopoulos (1994)
    food is particles. Amounts are in units of food: `food` of patches, `eaten` by each until now.
    """

    kind: Literal["grazing"] = "grazing"
    other: int = Field(ge=0, strict=True, description="the group whose agents are patches of food")
    radius: float = Field(gt=0, description="m, who is nearer to a patch's centre eats of it")
    rate: float = Field(default=0.5, ge=0, description="1/s, share of a patch that one eats who is starved")
    growth: float = Field(default=0.2, ge=0, description="r, 1/s")
    capacity: float = Field(default=3.0, gt=0, description="K, units of food in a full patch")
    start: float = Field(default=1.0, gt=0, le=1, description="how full patches begin")
    appetite: float = Field(default=1.0, gt=0, description="units of food that it takes from starved to full")
    pair_law: ClassVar[Law | None] = at_table
    finish_law: ClassVar[Law | None] = told_both
    begin_law: ClassVar[Law | None] = food_from
    keep_law: ClassVar[Law | None] = grazed
    keeps: ClassVar[tuple[str, ...]] = ("hunger", "food", "eaten")
    strengths: ClassVar[tuple[str, ...]] = ("rate", "growth")

    @property
    def sight(self) -> Sight:
        """Whoever is near."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """Food, and hunger."""
        return 2

    def parameters(self) -> dict[str, float | Vec]:
        """How fast what grows and is eaten."""
        return self.given("rate", "growth", "capacity", "start", "appetite")

    def check(self, scene: SceneView) -> None:
        """Refuse a step in which all together could eat more than there is, and patches that eat."""
        super().check(scene)
        if self.group in (None, self.other):
            raise ValueError(f"group = {self.group}: give the group that eats, another than other = {self.other}")
        assert self.group is not None
        share = self.rate * scene.dt * scene.groups[self.group].size
        if share > 1:
            all_ = f"all {scene.groups[self.group].size} of groups[{self.group}]"
            raise ValueError(
                f"rate = {self.rate:g}: {all_} could eat more than there is of a patch in a step of dt = {scene.dt:g} "
                f"s; at most {self.rate / share:g} 1/s is allowed"
            )


# --- who is caught ----------------------------------------------------------------------------------------------------


@law
def not_caught(p: Any, me: Me) -> Vec:
    """Nobody is caught at the start."""
    return like(me.mass, 0.0), like(me.mass, 0.0)


@law
def in_reach(p: Any, me: Me, other: Other) -> Vec:
    """Who has me, and whom I have: a hunter that is hungry enough."""
    o, e = like(other.square, 0.0), like(other.square, 1.0)
    mine = _among(me.who, p.from_other, p.to_other) & _among(other.who, p.first, p.end)
    prey = _among(me.who, p.first, p.end) & _among(other.who, p.from_other, p.to_other)
    has_me = mine & (other.inner.hunger > p.hungry) & (p.meal > o)
    return (e if has_me else o), (e if prey & (me.inner.hunger > p.hungry) & (p.meal > o) else o)


@law
def caught(p: Any, me: Me, told: Vec, seconds: float) -> Vec:
    """Who has caught somebody gets less hungry."""
    o = like(p.meal, 0.0)
    less = me.inner.hunger - p.meal * told[1]
    return (less if less > o else o), me.inner.caught + told[0]


class Predation(_Urge):
    """Hunters catch whom they come nearer than `radius`, if they are hungry; each catch takes `meal` off their hunger.

    What it does is counted: `caught`, by how many hunters one has been; a sink `threshold` at 1 makes it deadly. A prey
    that two catch in one step fills both. Ours.
    """

    kind: Literal["predation"] = "predation"
    other: int = Field(ge=0, strict=True, description="the group that is hunted")
    radius: float = Field(gt=0, description="m between centres")
    meal: float = Field(default=0.5, ge=0, le=1, description="hunger that a catch takes away")
    hungry: float = Field(default=0.3, ge=0, le=1, description="who is less hungry catches nobody")
    pair_law: ClassVar[Law | None] = in_reach
    finish_law: ClassVar[Law | None] = told_both
    begin_law: ClassVar[Law | None] = not_caught
    keep_law: ClassVar[Law | None] = caught
    keeps: ClassVar[tuple[str, ...]] = ("hunger", "caught")
    strengths: ClassVar[tuple[str, ...]] = ("meal",)

    @property
    def sight(self) -> Sight:
        """Whoever is near."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """By whom, and whom."""
        return 2

    def parameters(self) -> dict[str, float | Vec]:
        """How much it fills, and who hunts."""
        return self.given("meal", "hungry")

    def check(self, scene: SceneView) -> None:
        """Refuse who hunts itself."""
        super().check(scene)
        if self.group in (None, self.other):
            raise ValueError(f"group = {self.group}: give the group that hunts, another than other = {self.other}")


# --- fear -------------------------------------------------------------------------------------------------------------


@law
def unafraid(p: Any, me: Me) -> Vec:
    """Nobody begins with fear."""
    return (like(me.mass, 0.0),)


@law
def frightened(p: Any, me: Me, other: Other) -> Vec:
    """Fear of one of them."""
    return (motivation.fright(np.sqrt(other.square), p.span),)


@law
def told_one(p: Any, me: Me, sums: Vec) -> Vec:
    """The sum, as a vector."""
    return planar(me.pos, sums[0], like(sums[0], 0.0))


@law
def afraid(p: Any, me: Me, told: Vec, seconds: float) -> Vec:
    """Of all in sight together, at most 1; it fades."""
    one = like(p.span, 1.0)
    later = motivation.calmed(me.inner.fear, told[0] if told[0] < one else one, p.memory, seconds)
    return (later if _among(me.who, p.first, p.end) else me.inner.fear,)


class Fear(_Urge):
    """Fear of others in sight, F = min(sum of min(span / distance, 1), 1), that fades over `memory` seconds.

    Sight, sum and 1 / distance are Tu and Terzopoulos' (1994; they see 300 degrees); that it fades is ours.
    """

    kind: Literal["fear"] = "fear"
    other: int = Field(ge=0, strict=True, description="the group that is feared")
    radius: float = Field(default=10.0, gt=0, description="m, how far it sees")
    fov: float = Field(default=300.0, gt=0, le=360, description="degrees, full angle of the field of view")
    occluded: bool = Field(default=False, description="whom an obstacle hides is not seen")
    span: float = Field(default=2.0, ge=0, description="D0, m, within which fear of one is 1")
    memory: float = Field(default=3.0, gt=0, description="s, over which it falls to 1/e")
    pair_law: ClassVar[Law | None] = frightened
    finish_law: ClassVar[Law | None] = told_one
    begin_law: ClassVar[Law | None] = unafraid
    keep_law: ClassVar[Law | None] = afraid
    keeps: ClassVar[tuple[str, ...]] = ("fear",)
    strengths: ClassVar[tuple[str, ...]] = ("span",)

    @property
    def sight(self) -> Sight:
        """What it sees of those."""
        return Sight(self.radius, self.fov, group=self.other, occluded=self.occluded)

    def sums(self, dimension: int) -> int:
        """One."""
        return 1

    def parameters(self) -> dict[str, float | Vec]:
        """How near, and for how long."""
        return self.given("span", "memory")


# --- libido -----------------------------------------------------------------------------------------------------------


@law
def urge_from(p: Any, me: Me) -> Vec:
    """What it begins with; nobody has mated."""
    return _drawn(p, me, CHANNEL + 1), like(p.start, 0.0)


@law
def willing(p: Any, me: Me, other: Other) -> Vec:
    """One more who would."""
    o, e = like(other.square, 0.0), like(other.square, 1.0)
    would = motivation.desire(other.inner.libido, other.inner.hunger) > p.ready
    return (e if would & _among(other.who, p.first, p.end) else o,)


@law
def mating(p: Any, me: Me, told: Vec, seconds: float) -> Vec:
    """The urge grows; who would, and has somebody near who would, mates, and it begins anew."""
    o, e = like(p.rate, 0.0), like(p.rate, 1.0)
    mine = _among(me.who, p.first, p.end)
    mates = mine & (told[0] > o) & (motivation.desire(me.inner.libido, me.inner.hunger) > p.ready)
    grown = me.inner.libido + (p.rate * seconds if mine else o)
    return (o if mates else grown), me.inner.mated + (e if mates else o)


class Libido(_Urge):
    """An urge s that grows evenly since the last mating; libido is s (1 - H) (Tu and Terzopoulos 1994).

    Two mate who come nearer than `radius` while both have a libido above `ready`; `mated` counts. Of three who are all
    in reach of each other all three do. That, instead of their courtship, is ours; nobody is born of it.
    """

    kind: Literal["libido"] = "libido"
    radius: float = Field(gt=0, description="m, at which they mate")
    rate: float = Field(default=0.025, ge=0, description="1/s")
    ready: float = Field(default=0.4, ge=0, le=1, description="libido above which one would")
    start: float = Field(default=0.0, ge=0, description="urge at the start, in the middle")
    spread: float = Field(default=0.0, ge=0, description="how far it differs from one to the next")
    pair_law: ClassVar[Law | None] = willing
    finish_law: ClassVar[Law | None] = told_one
    begin_law: ClassVar[Law | None] = urge_from
    keep_law: ClassVar[Law | None] = mating
    keeps: ClassVar[tuple[str, ...]] = ("libido", "mated")
    recalls: ClassVar[tuple[str, ...]] = ("hunger",)
    strengths: ClassVar[tuple[str, ...]] = ("rate",)

    @model_validator(mode="after")
    def _within(self) -> Libido:
        """Refuse urges below 0."""
        _demand_range(self.start, self.spread, float("inf"))
        return self

    @property
    def sight(self) -> Sight:
        """Whoever is near."""
        return Sight(self.radius)

    def sums(self, dimension: int) -> int:
        """How many."""
        return 1

    def parameters(self) -> dict[str, float | Vec]:
        """How fast, from where, and when."""
        return self.given("rate", "ready", "start", "spread")


# --- what it intends --------------------------------------------------------------------------------------------------


@law
def no_intention(p: Any, me: Me) -> Vec:
    """Everybody begins wandering."""
    return (like(me.mass, motivation.WANDER),)


@law
def intending(p: Any, me: Me, told: Vec, seconds: float) -> Vec:
    """What follows from what one intends, and hunger, libido and fear."""
    libido = motivation.desire(me.inner.libido, me.inner.hunger)
    now = motivation.intention(
        me.inner.intention, me.inner.hunger, libido, me.inner.fear, p.escape, p.school, p.need, p.calm, p.content
    )
    return (now if _among(me.who, p.first, p.end) else me.inner.intention,)


class Intention(_Urge):
    """A finite state machine: escape, school, eat, mate or wander, from hunger, libido and fear, with hysteresis.

    Fear above `escape`: flee; above `school`: join the others; else the larger of hunger and libido, if above `need`;
    else wander (Tu and Terzopoulos 1994). Who is at it goes on until it is `calm` or `content` less, so that nobody
    dithers; that is ours. An arbitration `intentions` acts on it.
    """

    kind: Literal["intention"] = "intention"
    escape: float = Field(default=0.4, ge=0, le=1, description="fear above which one flees")
    school: float = Field(default=0.15, gt=0, le=1, description="fear above which one joins the others")
    need: float = Field(default=0.5, gt=0, le=1, description="hunger or libido above which one sees to it")
    calm: float = Field(default=0.1, ge=0, description="how much less fear ends either")
    content: float = Field(default=0.3, ge=0, description="how much less hunger or libido ends it")
    begin_law: ClassVar[Law | None] = no_intention
    keep_law: ClassVar[Law | None] = intending
    keeps: ClassVar[tuple[str, ...]] = ("intention",)
    recalls: ClassVar[tuple[str, ...]] = ("hunger", "libido", "fear")
    strengths: ClassVar[tuple[str, ...]] = ("calm", "content")

    @model_validator(mode="after")
    def _ordered(self) -> Intention:
        """Refuse levels that run backwards, and what would never end."""
        if self.school > self.escape:
            raise ValueError(f"school = {self.school:g}: must not be above escape = {self.escape:g}")
        if self.calm >= self.school or self.content >= self.need:
            name, most = ("calm", self.school) if self.calm >= self.school else ("content", self.need)
            raise ValueError(f"{name} = {getattr(self, name):g}: must be below {most:g}, or it would never end")
        return self

    def parameters(self) -> dict[str, float | Vec]:
        """The levels."""
        return self.given("escape", "school", "need", "calm", "content")
