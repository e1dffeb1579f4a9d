"""Effect: what acts on a body. A frozen record that holds its laws; a scene composes the laws of its effects.

An effect is of one or more of three forms, each a law for one agent:

* `own_law(p, me) -> force`: by itself (drag, gravity, a field);
* `medium_law(p, me) -> velocity` of the medium where it is: all of them sum up to `me.medium` of the other laws of one
  agent; and `flow_law(p, me) -> velocity` with which the medium carries it, beside its own velocity;
* `pair_law(p, me, other) -> sums`, `finish_law(p, me, sums) -> force`: what one neighbour adds to K running sums, and
  the force they make; all pair laws of a scene share one sweep. With a `pair_start(p, me) -> acc` it is a fold instead,
  `pair_law(p, me, other, acc) -> acc`, over those in sight, in no order that it may rely on. A law that reads ties may
  have another form, `apart_law(p, me, other) -> sums`, the same where the two are not in one place (steering.others'
  ONE_PLACE): if all of a scene that read them have, by `pair_law` alone, and all are sums, ties are read of those in
  one place alone;
* `far_law(p, me, other) -> force`: of everybody else, however far, of whom groups far away are met as one; `other` is
  a `Far`, and of `me` it may read pos and mass alone; `p.opening` says how large such a group may look;
* `group_law(p, me, members) -> force`: of all living agents with numbers from p.first to before p.end, as one:
  `members` is a `Members`; the effect's `members` says which agents these are;
* `bond_law(p, me, others, numbers) -> force`: of one of the bonds that the effect's `bonds` lists, each between an
  agent and one or more partners (springs, hinges, finite elements);
* `kick_law(p, me, seconds, gauss) -> velocity`: added once per step, however often a method asks for forces, with one
  standard normal number per axis (fluctuations);
* `aim_law(p, me) -> direction` in which it wants to go: all of them sum up to `me.aim` of the other laws;
* `begin_law(p, me) -> numbers` and `keep_law(p, me, told, seconds) -> numbers`: what goes on inside an agent, the
  numbers that `keeps` names (how hungry it is, which door it heads for). The first are what they are when it comes into
  being; the others what they are after a step of so many seconds, from what they were, where it is then, and what
  `finish_law` has `told` of others in the last stage, a vector that is no force then (of an effect without a pair law:
  0). Changes by several effects add up. Laws read them as `me.inner.NAME` and `other.inner.NAME`, and say so in
  `recalls` if they do not keep them;
* `count_law(p, me) -> number` of the counter in which an agent counts, or a negative one for none: what all of a world
  are doing, in whole numbers, so that nobody's place in it matters. Its keep_law finds `counters` of them as
  `p.counted`: how many of the living it was for each when the step began. One pass over all agents per step;
* `obstacle_start(p, me)`, `obstacle_law(p, me, other, acc) -> acc`, `obstacle_finish(p, me, acc) -> force`: a fold over
  the obstacles, of whatever shape: `other` is an `Obstacle`. With an `obstacle_ray(p, me, k) -> (direction, margin)` it
  meets each obstacle for each of its rays, k = 0, 1, ...: where the agent's body, `margin` wider, would touch it first
  if it went along the unit vector `direction`. With an `obstacle_from(p, me) -> offset` it is met as from that place,
  so far from the agent, instead of from where the agent is. With an `obstacle_reach(p, me) -> m` it says that its law
  leaves acc as it is wherever the surface is farther than this from the agent: shapes that lie beyond are not looked
  at. A law that casts rays and has a reach leaves acc as it is, too, wherever no ray touches within that reach. With
  `obstacle_pieces` it meets walls, polygons and rooms side after side: each by its nearest place, a corner once, see
  shapes/chain.py. With `obstacle_edges` the first number of acc is how far ahead along ray 0 the body touches
  something, or inf, and the last D, which the law leaves 0, are then filled with the unit vector across the ray to the
  side where the silhouette edge of what is touched is nearest to the impact, of all that is one to the body
  (sweep/around.py); they stay 0 where there is none, or it overlaps already. Of an effect with a pair law too,
  `finish_law` gives no force but what it has found out about others, a vector that is told to `obstacle_start(p, me,
  told)` (hide). With no start of its own it meets circles alone, goes before a fold over neighbours and hands over to
  it, so that both are judged together (orca).

`p` holds the effect's `parameters()` by name, and, if it is `tabled`, an array of numbers as `p.table`: the points of a
path, the values of a grid. `me` and `other` are the records below.
A pair law says nothing of who is seen: it is evaluated for every candidate, and what it says of those outside the
effect's `sight` (of agents themselves too) is dropped; or, if it `vanishes`, `other.square` is infinite in steps.

Pair laws read the fields of `me` and `other` by name (`me.vel`), never by place (`me[2]`): the sweep sorts what some
law names, itself or in a law that it calls, and every other field is a stand-in without meaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.core.record import Record
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import dot
from flockenv.model.scene_view import SceneView

__all__ = [
    "EFFECTS", "LAWS", "Bonds", "Effect", "Far", "Me", "Members", "Obstacle", "Other", "Sight", "Vector", "all_masses",
    "demand_group", "in_view", "network_of", "ties",
]  # fmt: skip

Vector = Annotated[tuple[Annotated[float, Field(strict=True)], ...], Field(min_length=2, max_length=3)]
"""A parameter with a direction, or a place: as many numbers as the scene has dimensions."""

LAWS = (
    "own_law", "group_law", "medium_law", "flow_law", "far_law", "bond_law", "kick_law", "aim_law", "begin_law",
    "keep_law", "count_law", "pair_start", "pair_law", "apart_law", "finish_law", "obstacle_start", "obstacle_law",
    "obstacle_finish", "obstacle_ray", "obstacle_from", "obstacle_reach",
)  # fmt: skip
"""The slots that an effect may fill with a law."""

EFFECTS: dict[str, type[Effect]] = {}
"""Every effect by its kind; a class registers itself when it is defined."""


class Me(NamedTuple):
    """The agent a law acts on."""

    who: float  # which agent; a number in the precision of the scene
    pos: Vec  # m
    vel: Vec  # m/s
    heading: Vec  # unit(vel); 0 at standstill
    mass: float  # kg
    radius: float  # m
    max_speed: float  # m/s
    max_force: float  # N
    tie: Vec  # a unit vector of its own, see ties(); 0 outside pair laws
    time: float  # s, of the stage that is asked for
    medium: Vec  # m/s, velocity of the medium here; 0 in pair laws and bonds
    key: int  # of its world, for random numbers that are functions of time, see noise.py
    aim: Vec  # unit vector, where it wants to go: shorter if slower than it would like, 0 to stay, or if nobody says
    desired_speed: float  # m/s, how fast it would like to go
    inner: Any  # what goes on inside it, by name; see `Effect.keeps`


class Other(NamedTuple):
    """A neighbour that it meets."""

    who: float
    offset: Vec  # m, other minus me, the shortest way
    square: float  # m^2, |offset|^2
    vel: Vec  # m/s
    radius: float  # m
    tie: Vec  # a unit vector of its own
    mass: float  # kg; of what is no agent: inf
    inner: Any  # what goes on inside him, by name; of what is no agent: 0


class Obstacle(NamedTuple):
    """An obstacle that it meets: a circle or sphere of the state by its centre and radius, any other shape by a point.

    That point is the nearest of its surface; of a law that casts rays, the one that is touched first. Of a law that
    sees circles alone, every shape is so a circle of radius 0 where it matters. From inside, and where a ray begins at
    overlap, `offset` leads into the shape, from where `normal` leads out.

    It is where it is at the time of the stage. `hit` is along a straight ray, as if it stood still.
    """

    who: float  # circles of the state in its order, then the other shapes in the order of the scene
    offset: Vec  # m, to the centre, or to the point
    square: float  # m^2, |offset|^2
    vel: Vec  # m/s
    radius: float  # m; 0 of what is not in the state: no circle, or one that moves or is hollow
    tie: Vec  # 0
    gap: float  # m, how far the surface is; negative inside
    normal: Vec  # outward unit normal at the nearest point of the surface, or where the ray touches
    hit: float  # m, how far along the ray the body comes: 0 if it overlaps already, inf if it never touches
    ray: Vec  # the ray's direction; 0 where none is cast


class Far(NamedTuple):
    """Whom a far law meets: an agent, or several who are far away, at their centre."""

    offset: Vec  # m, from me; never 0
    square: float  # m^2, |offset|^2
    weight: float  # kg, their mass; or how many they are, see Effect.weighs_mass


class Sight(NamedTuple):
    """Whom an effect sees: who is nearer than radius, ahead of it, and (topological) among the nearest of those."""

    radius: float  # m
    fov: float = 360.0  # degrees, full angle; somebody at standstill has no heading and sees all around
    nearest: int | None = None  # at most so many (and whoever is exactly as far as the last); None = all
    group: int | None = None  # of this group alone; None = of all
    occluded: bool = False  # not whom an obstacle hides: none stands in the straight way to his centre


class Members(NamedTuple):
    """All living agents of a group, as an agent sees them."""

    size: float  # how many they are; 0: all that follows is 0, too
    centre: Vec  # m, the centre of all minus me; on a torus of those images that are nearest to the first of them
    vel: Vec  # m/s, the mean velocity
    farthest: Vec  # m, the one that is farthest from the centre minus me; of some that are as far, the first


class Bonds(NamedTuple):
    """Who is tied to whom: one row for each agent that a bond acts on, so that everybody gathers what acts on him."""

    agent: NDArray[np.int32]  # (R,)
    partner: NDArray[np.int32]  # (R, P)
    number: NDArray[np.float64]  # (R, C) what a law is given: stiffness, rest length, ...

    @classmethod
    def none(cls, partners: int, numbers: int) -> Bonds:
        """Return no bonds at all."""
        return cls(np.zeros(0, np.int32), np.zeros((0, partners), np.int32), np.zeros((0, numbers)))


@law
def in_view(view: float, heading: Vec, offset: Vec, square: float) -> bool:
    """Is `offset` within a cone around `heading` of half angle a? view = cos a |cos a|; no root is taken.

    offset . heading >= cos a |offset|, both sides squared with their signs. A heading of 0 sees all around.
    """
    ahead = dot(offset, heading)
    still = dot(heading, heading) <= like(ahead, 0.0)
    return (ahead * abs(ahead) >= view * square) | still


def ties(count: int, dimension: int) -> NDArray[np.float64]:
    """Return a unit vector for each agent, (count, D), all different, in no preferred direction.

    me.tie - other.tie is where two agents in one place should part to: opposite for the two, another for every pair.
    Directions in golden-ratio steps (heights too, in space).
    """
    who = np.arange(count)
    turn, height = 2 * np.pi * (who * 0.6180339887498949 % 1), 2 * (who * 0.7548776662466927 % 1) - 1
    ring = np.sqrt(1 - height**2) if dimension == 3 else np.ones(count)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), height][:dimension], axis=1)


def all_masses(groups: Sequence[Any], dimension: int) -> NDArray[np.float64]:
    """Return the masses of all agents of some groups, (N,) kg; infinite where one is held in place."""
    return np.concatenate([group.masses(dimension) for group in groups])


def demand_group(name: str, which: int | None, groups: Sequence[Any]) -> None:
    """Refuse the number of a group that is not there, by the name of the field that holds it; none is all of them."""
    if which is not None and not 0 <= which < len(groups):
        raise ValueError(f"{name} = {which}: there are {len(groups)} groups, counted from 0")


def network_of(groups: Sequence[Any], which: int, dimension: int) -> tuple[int, Any, NDArray[np.float64]]:
    """Return the first agent of a group, its network, and the masses of its particles, kg; refuses one without."""
    demand_group("group", which, groups)
    if groups[which].network is None:
        raise ValueError(f"group = {which}: has no network; give groups[{which}].network")
    first = sum(group.size for group in groups[:which])
    return first, groups[which].network, groups[which].masses(dimension)


class Effect(Record):
    """What acts on a body; see the module for the forms of its laws."""

    kind: str
    steering: ClassVar[bool] = False
    """True if it is something the agent wants (bounded by max_force together with its drive), False for physics."""
    own_law: ClassVar[Law | None] = None
    group_law: ClassVar[Law | None] = None
    medium_law: ClassVar[Law | None] = None
    flow_law: ClassVar[Law | None] = None
    far_law: ClassVar[Law | None] = None
    bond_law: ClassVar[Law | None] = None
    kick_law: ClassVar[Law | None] = None
    aim_law: ClassVar[Law | None] = None
    begin_law: ClassVar[Law | None] = None
    keep_law: ClassVar[Law | None] = None
    count_law: ClassVar[Law | None] = None
    keeps: ClassVar[tuple[str, ...]] = ()
    """Names of the numbers that it keeps of every agent, see State.inner."""
    recalls: ClassVar[tuple[str, ...]] = ()
    """Names of those that its laws read and that other effects keep."""
    pair_start: ClassVar[Law | None] = None
    pair_law: ClassVar[Law | None] = None
    apart_law: ClassVar[Law | None] = None
    finish_law: ClassVar[Law | None] = None
    vanishes: ClassVar[bool] = False
    """Does its pair law say nothing, zeros, where `other.square` is infinite, wherever `other.offset` leads?

    Then steps that ask for forces once tell it so of who is not seen; where he is stays true.
    """
    averages: ClassVar[bool] = False
    """Is its finish_law handed, after its sums, how many are in sight? They are counted once for equal sights."""
    obstacle_start: ClassVar[Law | None] = None
    obstacle_law: ClassVar[Law | None] = None
    obstacle_finish: ClassVar[Law | None] = None
    obstacle_ray: ClassVar[Law | None] = None
    obstacle_from: ClassVar[Law | None] = None
    obstacle_reach: ClassVar[Law | None] = None
    obstacle_edges: ClassVar[bool] = False
    """True if an agent that has something ahead is told on which side its nearest silhouette edge is."""
    obstacle_pieces: ClassVar[bool] = False
    """Are walls, polygons and rooms met side after side, each by its nearest place, instead of by one place?"""
    linear_drag: ClassVar[str | None] = None
    """Name of the parameter c, kg/s, of an own_law that is -c (v - medium): a method may treat it by itself."""
    weighs_mass: ClassVar[bool] = True
    """Is the weight of whom a far law meets their mass? Else it is their number."""
    partners: ClassVar[int] = 1
    """How many partners a bond has beside the agent it acts on."""
    tabled: ClassVar[bool] = False
    """Do its laws look numbers up in its `table`?"""
    places: ClassVar[tuple[str, ...]] = ()
    """Names of the parameters that are points: on a torus all but bonds and obstacles see the nearest images."""
    heads_for: ClassVar[bool] = True
    """Are its places what a behaviour heads for? Pictures show them."""
    always: ClassVar[bool] = True
    """True if its `rates` are those of a force that acts all the time and has no bounds: far beyond its limit a step
    must blow up, and is refused. Where it is False a step beyond the limit is warned of."""
    contact: ClassVar[bool] = False
    """Are its `rates` those of a contact, which is over after half of an oscillation?"""
    strengths: ClassVar[tuple[str, ...]] = ("weight",)
    """Names of the fields that make it nothing when they are 0."""
    conserves_momentum: ClassVar[bool] = False
    """True if what i does to j is the opposite of what j does to i."""
    demo: ClassVar[str | None] = None
    """A small scene that shows it, as YAML; docs/behaviours.md draws the trajectories of its first `demo_time` s."""
    demo_time: ClassVar[float] = 8.0

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        kind = cls.model_fields["kind"].default
        if isinstance(kind, str):
            EFFECTS[kind] = cls

    @property
    def sight(self) -> Sight | None:
        """Whom its pair law is about; None if it has none. Effects of equal sight share the test of who is seen."""
        return None

    @property
    def reach(self) -> float:
        """How far it looks for neighbours, m; 0 if it does not."""
        return self.sight.radius if self.sight else 0.0

    @property
    def occluded_obstacles(self) -> bool:
        """Does its obstacle law meet only what no other obstacle hides?"""
        return False

    def in_the_open(self) -> Effect | None:
        """Return what of it acts where there are no obstacles; none if nothing does."""
        return None if self.obstacle_law is not None and self.pair_law is None else self

    @property
    def joined(self) -> bool:
        """Is it one fold over obstacles and neighbours?"""
        return self.obstacle_law is not None and self.obstacle_start is None

    @property
    def wishes(self) -> tuple[Effect, ...]:
        """The effects whose wishes it reconciles, in order of priority; see Steer."""
        return ()

    @property
    def steer_law(self) -> Law:
        """The law (p, me, wishes) -> force by which it reconciles them."""
        raise TypeError(f"{type(self).__name__} reconciles no wishes")

    @property
    def recalled(self) -> tuple[str, ...]:
        """What it recalls, and whatever reconciles its wishes."""
        return self.recalls

    @property
    def counters(self) -> int:
        """Into how many counters its count_law sorts all agents."""
        return 0

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """More numbers for its laws: which agents it is about; starts[g] is the first agent of group g."""
        return {}

    def sums(self, dimension: int) -> int:
        """How many running sums its pair law fills."""
        return 0

    def folded(self, dimension: int) -> int:
        """How many numbers its fold over the obstacles carries from one to the next."""
        return 0

    def rays(self, dimension: int) -> int:
        """How many rays its obstacle_ray casts."""
        return 1

    def numbers(self, dimension: int) -> int:
        """How many numbers describe one of its bonds."""
        return 0

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return its bonds in a scene of these groups; ValueError, of one line, if they do not suit it."""
        return Bonds.none(self.partners, self.numbers(dimension))

    def idle(self) -> Effect:
        """Return the same effect, looking around in the same way and compiled the same, that does nothing."""
        fields = {name: getattr(self, name) for name in self.strengths if name in type(self).model_fields}
        return self.model_copy(
            update={
                name: (0.0,) * len(value) if isinstance(value, tuple) else 0.0
                for name, value in fields.items()
                if value is not None
            }
        )

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return the numbers that its laws look up as `p.table`, (T,), T >= 1: as many as the scene calls for.

        Asked for when a scene is built, after `check`; they are arguments, another table compiles nothing.
        """
        raise TypeError(f"{type(self).__name__} has no table")

    def way_shown(self, scene: SceneView) -> tuple[tuple[Vec, ...], float] | None:
        """Return the way that it is about, for pictures: places along it, m, and half its width, m; or none."""
        return None

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return bounds of w^2, 1/s^2, and of damping, 1/s, of every agent, (N,): how stiff it is, whatever happens.

        None if that depends on the state, or it is not stiff at all.
        """
        return None

    def potential(self, groups: Sequence[Any], state: Any, offset: Any) -> NDArray[np.float64] | None:
        """Return its potential energy in each world, (B,) J; none if it has none. `offset(a, b)` is the space's."""
        return None

    def lookahead(self, speed: float) -> float | None:
        """Return how far ahead somebody at this speed notices what he must avoid, m; none if it avoids nothing.

        What gives it is called `horizon`, s, in such an effect.
        """
        return None

    def check(self, scene: SceneView) -> None:
        """Refuse, with a ValueError that begins with the name of a field, a scene that does not suit it.

        Vectors have the dimension of the scene, and it sees a group that is there: whoever overrides this asks for that
        too.
        """
        for name, value in self.parameters().items():
            if isinstance(value, tuple) and len(value) != scene.dimension:
                raise ValueError(f"{name} = {value}: dimension = {scene.dimension}")
        if self.sight is not None:
            demand_group("group", self.sight.group, scene.groups)

    def check_start(self, scene: SceneView, state: Any) -> None:
        """Warn of what only the first instant of a scene shows: where its agents begin."""

    def parameters(self) -> dict[str, float | Vec]:
        """The numbers and vectors its laws are given, by name; what is none, or a word, is no number."""
        fields = {name: getattr(self, name) for name in type(self).model_fields if name != "kind"}
        return {
            name: tuple(map(float, value)) if isinstance(value, tuple) else float(value)
            for name, value in fields.items()
            if value is not None and not isinstance(value, str)
        }

    def calls_for(self) -> tuple[str, ...]:
        """What must be computed for it, in words: nothing, a neighbour query, a pass over the obstacles."""
        return tuple(
            text
            for text, law in (
                ("neighbour query", self.pair_law), ("all others", self.far_law),
                ("a group as one", self.group_law), ("bonds", self.bond_law),
                ("obstacles", self.obstacle_law or (self.sight and self.sight.occluded)),
                ("random numbers", self.kick_law),
            )
            if law
        )  # fmt: skip
