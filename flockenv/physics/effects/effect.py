"""Effect: a frozen record that acts on agents and holds its laws; a scene composes the laws of its effects.

An effect has one or more of these forms, each a law (a compiled function) for one agent:

* `own_law(p, me) -> force`: of the agent alone (drag, gravity, a field);
* `medium_law(p, me) -> velocity` of the medium at the agent's position: the sum over all effects is `me.medium` in the
  other laws of one agent; and `flow_law(p, me) -> velocity` with which the medium carries the agent, added to its own
  velocity;
* `pair_law(p, me, other) -> sums`, `finish_law(p, me, sums) -> force`: what one neighbour adds to K running sums, and
  the force computed from them; all pair laws of a scene share one pass over the neighbours. With a
  `pair_start(p, me) -> acc` it is a fold instead, `pair_law(p, me, other, acc) -> acc`, over the neighbours in sight,
  in an unspecified order. A law that reads ties may have a second form, `apart_law(p, me, other) -> sums`, equal to
  `pair_law` unless the two are in one place (ONE_PLACE in steering.others). Ties are read for agents in one place
  alone, if every law of the scene that reads them has that form, reads them in `pair_law` alone, and is a sum;
* `far_law(p, me, other) -> force`: of all other agents at any distance, with far groups combined into one; `other` is
  a `Far`. The law may read only pos and mass of `me`; `p.opening` bounds the apparent size of such a group;
* `group_law(p, me, members) -> force`: of all living agents with p.first <= index < p.end, combined: `members` is a
  `Members`; the effect's `members` method gives the range;
* `bond_law(p, me, others, numbers) -> force`: of one of the bonds listed by the effect's `bonds`, each between an
  agent and one or more partners (springs, hinges, finite elements);
* `bond_keep_law(p, me, others, numbers) -> number`: a number that each bond keeps (the rest length of a spring that
  yields): its value after a step, at the new positions. The last of `numbers`, here and in the bond law, is the present
  value; `Bonds.kept` says where each bond keeps it in State.bonds. It is written by the row of the bond whose agent has
  a lower index than its first partner;
* `kick_law(p, me, seconds, gauss) -> velocity`: added once per step, however often the method evaluates forces, from
  one standard normal number per axis (fluctuations);
* `aim_law(p, me) -> direction` of travel that is desired: the sum over all effects is `me.aim` in the other laws;
* `begin_law(p, me) -> numbers` and `keep_law(p, me, message, seconds) -> numbers`: the inner state of an agent, the
  numbers named in `keeps` (its hunger, the door it heads for). begin_law returns their values at the agent's start or
  birth. keep_law returns their values after a step of `seconds`, from the values before, the position after the step,
  and `message`: what `finish_law` returned in the last stage, here a vector that is not a force (0 without a pair law).
  Changes by several effects are added. Laws read the numbers as `me.inner.NAME` and `other.inner.NAME`; an effect lists
  in `recalls` those that it reads and does not keep;
* `count_law(p, me) -> number` of the counter in which an agent is counted, or a negative number for no counter: global
  counts per world, in integers, so that the order of agents does not matter. The effect's keep_law reads the `counters`
  totals as `p.counted`: the living agents in each counter when the step began. One pass over all agents per step;
* `obstacle_start(p, me)`, `obstacle_law(p, me, other, acc) -> acc`, `obstacle_finish(p, me, acc) -> force`: a fold over
  obstacles of any shape: `other` is an `Obstacle`.
  With an `obstacle_ray(p, me, k) -> (direction, margin)` the fold visits each obstacle once per ray k = 0, 1, ...; a
  hit is where the agent's body, enlarged by `margin`, first touches the obstacle along the unit vector `direction`.
  With an `obstacle_from(p, me) -> offset` obstacles are measured from the agent's position + offset.
  With an `obstacle_reach(p, me) -> m` shapes beyond that distance are skipped: the law must return acc unchanged if the
  surface is farther from the agent. A law that casts rays must also return acc unchanged if no ray hits within reach.
  With `obstacle_pieces` the fold visits each side of walls, polygons and rooms by its nearest point, a corner once (see
  geometry/shapes/chain.py).
  With `obstacle_edges` the first number of acc is the distance along ray 0 to the first contact, or inf. The last D
  numbers, which the law leaves 0, then receive the unit vector across the ray towards the nearest silhouette edge of
  the obstacle that is hit; obstacles with gaps too narrow for the body count as one (engine/silhouette.py). They stay 0
  without such an edge, or if the body overlaps already.
  If the effect also has a pair law, `finish_law` returns no force but a vector computed from the neighbours, which is
  passed to `obstacle_start(p, me, message)` (hide). Without an obstacle_start the fold visits circles alone, runs
  before a fold over neighbours and passes acc on to it: one fold over both (orca).

`p` holds the effect's `parameters()` by name, and, if the effect is `tabled`, an array of numbers as `p.table`: the
points of a path, the values of a grid. `me` and `other` are the records below. A pair law is evaluated for every
candidate, and its result is dropped for candidates outside the effect's `sight` (and for the agent itself); or, if it
`vanishes`, steps pass it an infinite `other.square`.

Pair laws read the fields of `me` and `other` by name (`me.vel`), never by index (`me[2]`): the engine loads the fields
that some law names, itself or in a law that it calls, and every other field is a meaningless placeholder.
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
    "EFFECTS", "LAWS", "Bonds", "Effect", "Far", "Me", "Members", "Obstacle", "Other", "Sight", "Stencils", "Vector",
    "all_masses", "demand_group", "in_view", "network_of", "separation_directions",
]  # fmt: skip

Vector = Annotated[tuple[Annotated[float, Field(strict=True)], ...], Field(min_length=2, max_length=3)]
"""A parameter that is a direction or a point: one number per dimension of the scene."""

LAWS = (
    "own_law", "group_law", "medium_law", "flow_law", "far_law", "bond_law", "bond_keep_law", "kick_law", "aim_law",
    "begin_law", "keep_law", "count_law", "pair_start", "pair_law", "apart_law", "finish_law", "obstacle_start",
    "obstacle_law", "obstacle_finish", "obstacle_ray", "obstacle_from", "obstacle_reach",
)  # fmt: skip
"""Names of the class variables in which an effect may have a law."""

EFFECTS: dict[str, type[Effect]] = {}
"""Every effect by its kind; a class registers itself when it is defined."""


class Me(NamedTuple):
    """The agent a law acts on."""

    who: float  # index of the agent, in the precision of the scene
    pos: Vec  # m
    vel: Vec  # m/s
    heading: Vec  # unit(vel); 0 at standstill
    mass: float  # kg
    radius: float  # m
    max_speed: float  # m/s
    max_force: float  # N
    tie: Vec  # a unit vector of its own, see separation_directions(); 0 outside pair laws
    time: float  # s, of the stage that is evaluated
    medium: Vec  # m/s, velocity of the medium here; 0 in pair laws and bonds
    key: int  # of its world, for random numbers that are functions of time, see maths/counter_rng.py
    aim: Vec  # desired direction: a unit vector, shorter for less than desired_speed; 0 to stay, or without an aim
    desired_speed: float  # m/s
    inner: Any  # its inner numbers, by name; see `Effect.keeps`


class Other(NamedTuple):
    """A neighbour of the agent."""

    who: float  # its index; of an obstacle, see `Obstacle`
    offset: Vec  # m, other minus me, by the nearest image
    square: float  # m^2, |offset|^2
    vel: Vec  # m/s
    radius: float  # m
    tie: Vec  # a unit vector of its own
    mass: float  # kg; inf if it is not an agent
    inner: Any  # its inner numbers, by name; 0 if it is not an agent


class Obstacle(NamedTuple):
    """An obstacle near the agent: a circle or sphere of the state by its centre and radius, any other shape by a point.

    The point is the nearest one of its surface or, in a law that casts rays, the point of first contact. For a law
    written for circles any other shape is thus a circle of radius 0 at that point. If the agent is inside, or a ray
    begins in overlap, `offset` points into the shape, and `normal` points out of it.

    The position is that at the time of the stage; `hit` assumes that the obstacle does not move.
    """

    who: float  # index: circles of the state in its order, then the other shapes in the order of the scene
    offset: Vec  # m, to the centre, or to the point
    square: float  # m^2, |offset|^2
    vel: Vec  # m/s
    radius: float  # m; 0 if it is not in the state: not a circle, or one that moves or is hollow
    tie: Vec  # 0
    gap: float  # m, distance to the surface; negative inside
    normal: Vec  # outward unit normal at the nearest point of the surface, or where the ray touches
    hit: float  # m, distance along the ray to contact: 0 if the body overlaps already, inf without contact
    ray: Vec  # the ray's direction; 0 without a ray


class Far(NamedTuple):
    """A source of a far law: one agent, or several far agents combined at their centre."""

    offset: Vec  # m, from me; never 0
    square: float  # m^2, |offset|^2
    weight: float  # kg, their mass; or their number, see Effect.weighs_mass


class Sight(NamedTuple):
    """Condition for neighbours of an effect: nearer than radius, within fov, and (topological) the nearest of those."""

    radius: float  # m
    fov: float = 360.0  # degrees, full angle; an agent at standstill has no heading and sees in all directions
    nearest: int | None = None  # at most this number, and any exactly as far as the last (default: all)
    group: int | None = None  # this group alone (default: all)
    occluded: bool = False  # True: without neighbours whose centre is hidden by an obstacle


class Members(NamedTuple):
    """All living agents of a group, relative to one agent."""

    size: float  # their number; if it is 0, all other fields are also 0
    centre: Vec  # m, their centre minus me; on a torus, of the images that are nearest to the first of them
    vel: Vec  # m/s, the mean velocity
    farthest: Vec  # m, the member farthest from the centre, minus me; of equals, the first


class Bonds(NamedTuple):
    """Bonds of agents: one row for each agent that a bond acts on, so that each agent gathers the forces on itself."""

    agent: NDArray[np.int32]  # (R,)
    partner: NDArray[np.int32]  # (R, P)
    number: NDArray[np.float64]  # (R, C) arguments of the law: stiffness, rest length, ...
    kept: NDArray[np.int64] | None = None  # (R,) where in State.bonds a number is kept, whose first value is the last

    @classmethod
    def empty(cls, partners: int, numbers: int) -> Bonds:
        """Return an empty table of bonds."""
        return cls(np.zeros(0, np.int32), np.zeros((0, partners), np.int32), np.zeros((0, numbers)))


class Stencils(NamedTuple):
    """Sets of agents whose forces depend on each other's motion, each with arguments of the effect's `derivative`."""

    agent: NDArray[np.int32]  # (S, P)
    number: NDArray[np.float64]  # (S, C)
    kept: NDArray[np.int64] | None = None  # (S,) where in State.bonds the present value of the last number is


@law
def in_view(view: float, heading: Vec, offset: Vec, square: float) -> bool:
    """Return True if `offset` is in a cone of half angle a around `heading`, without a root; view = cos a |cos a|.

    The condition is offset . heading >= cos a |offset|, both sides squared with their signs; always true for a heading
    of 0.
    """
    ahead = dot(offset, heading)
    still = dot(heading, heading) <= like(ahead, 0.0)
    return (ahead * abs(ahead) >= view * square) | still


def separation_directions(count: int, dimension: int) -> NDArray[np.float64]:
    """Return a unit vector for each agent, (count, D), all different and evenly distributed.

    me.tie - other.tie is the direction in which two agents in one place should part: opposite for the two, different
    for every pair. Directions are in golden-ratio steps (in 3-D heights also).
    """
    who = np.arange(count)
    turn, height = 2 * np.pi * (who * 0.6180339887498949 % 1), 2 * (who * 0.7548776662466927 % 1) - 1
    ring = np.sqrt(1 - height**2) if dimension == 3 else np.ones(count)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), height][:dimension], axis=1)


def all_masses(groups: Sequence[Any], dimension: int) -> NDArray[np.float64]:
    """Return the masses of all agents of some groups, (N,) kg; infinite for those held in place."""
    return np.concatenate([group.masses(dimension) for group in groups])


def demand_group(name: str, which: int | None, groups: Sequence[Any]) -> None:
    """Raise ValueError that names the field `name` if no group has this index; None means all groups."""
    if which is not None and not 0 <= which < len(groups):
        raise ValueError(f"{name} = {which}: there are {len(groups)} groups, counted from 0")


def network_of(groups: Sequence[Any], which: int, dimension: int) -> tuple[int, Any, NDArray[np.float64]]:
    """Return a group's first agent, network and particle masses, kg; raise ValueError if it has no network."""
    demand_group("group", which, groups)
    if groups[which].network is None:
        raise ValueError(f"group = {which}: has no network; give groups[{which}].network")
    first = sum(group.size for group in groups[:which])
    return first, groups[which].network, groups[which].masses(dimension)


class Effect(Record):
    """An effect on agents; see the module for the forms of its laws."""

    kind: str
    steering: ClassVar[bool] = False
    """True for steering (bounded by max_force together with the agent's drive), False for physics."""
    own_law: ClassVar[Law | None] = None
    group_law: ClassVar[Law | None] = None
    medium_law: ClassVar[Law | None] = None
    flow_law: ClassVar[Law | None] = None
    far_law: ClassVar[Law | None] = None
    bond_law: ClassVar[Law | None] = None
    bond_keep_law: ClassVar[Law | None] = None
    kick_law: ClassVar[Law | None] = None
    aim_law: ClassVar[Law | None] = None
    begin_law: ClassVar[Law | None] = None
    keep_law: ClassVar[Law | None] = None
    count_law: ClassVar[Law | None] = None
    keeps: ClassVar[tuple[str, ...]] = ()
    """Names of the inner numbers that the effect keeps for every agent, see State.inner."""
    recalls: ClassVar[tuple[str, ...]] = ()
    """Names of the inner numbers that the laws read and that other effects keep."""
    pair_start: ClassVar[Law | None] = None
    pair_law: ClassVar[Law | None] = None
    apart_law: ClassVar[Law | None] = None
    finish_law: ClassVar[Law | None] = None
    vanishes: ClassVar[bool] = False
    """True if the pair law returns zeros for an infinite `other.square` and any `other.offset`.

    Steps with one evaluation of the forces then pass it an infinite square for candidates out of sight, and their true
    offset.
    """
    averages: ClassVar[bool] = False
    """True if finish_law is passed, after its sums, the number of neighbours, shared by effects of equal sight."""
    obstacle_start: ClassVar[Law | None] = None
    obstacle_law: ClassVar[Law | None] = None
    obstacle_finish: ClassVar[Law | None] = None
    obstacle_ray: ClassVar[Law | None] = None
    obstacle_from: ClassVar[Law | None] = None
    obstacle_reach: ClassVar[Law | None] = None
    obstacle_edges: ClassVar[bool] = False
    """True if acc ends with the direction to the nearest silhouette edge of the obstacle ahead; see the module."""
    obstacle_pieces: ClassVar[bool] = False
    """True if each side of walls, polygons and rooms is visited by its nearest point, not the shape by one point."""
    linear_drag: ClassVar[str | None] = None
    """Name of the parameter c, kg/s, of an own_law that is -c (v - medium): a method may integrate it separately."""
    weighs_mass: ClassVar[bool] = True
    """True if `Far.weight` is a mass, False if it is a number of agents."""
    derivative: ClassVar[Law | None] = None
    """(local, number, s): write dF/dx, N/m, and dF/dv, kg/s, of stencil s into the arrays of a `Local`; see `stencils`.

    Both matrices must be symmetric and have no positive eigenvalue: what would violate this is left out.
    """
    strain_law: ClassVar[Law | None] = None
    """(local, number, s) -> (a, b): lengths in stencil s over those at rest, whose changes in a step may be limited."""
    partners: ClassVar[int] = 1
    """Number of partners of a bond, besides the agent it acts on."""
    tabled: ClassVar[bool] = False
    """True if the laws read numbers of `table`."""
    places: ClassVar[tuple[str, ...]] = ()
    """Names of the parameters that are points: on a torus nearest images, except in laws of bonds and obstacles."""
    heads_for: ClassVar[bool] = True
    """True if `places` are targets that agents head for, which pictures show."""
    always: ClassVar[bool] = True
    """True if `rates` are those of an unbounded force that acts all the time: a step far beyond its limit must diverge,
    and raises ValueError. If False, a step beyond the limit causes a warning."""
    contact: ClassVar[bool] = False
    """True if `rates` are those of a contact, which ends after half an oscillation."""
    strengths: ClassVar[tuple[str, ...]] = ("weight",)
    """Names of the fields that, if they are 0, disable the effect."""
    conserves_momentum: ClassVar[bool] = False
    """True if the force of i on j is the opposite of the force of j on i."""
    demo: ClassVar[str | None] = None
    """A small example scene as YAML, whose trajectories in the first `demo_time` s docs/behaviours.md shows."""
    demo_time: ClassVar[float] = 8.0

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        kind = cls.model_fields["kind"].default
        if isinstance(kind, str):
            EFFECTS[kind] = cls

    @property
    def sight(self) -> Sight | None:
        """Sight of its pair law, None without one. Effects of equal sight share the visibility test."""
        return None

    @property
    def reach(self) -> float:
        """Largest distance of neighbours that the pair law reads, m; 0 without one."""
        return self.sight.radius if self.sight else 0.0

    @property
    def occluded_obstacles(self) -> bool:
        """True if the obstacle law skips obstacles that another one hides."""
        return False

    def without_obstacles(self) -> Effect | None:
        """Return the effect as it acts in a scene without obstacles, or None if it then does nothing."""
        return None if self.obstacle_law is not None and self.pair_law is None else self

    @property
    def is_joint_fold(self) -> bool:
        """True if the effect is one fold over obstacles and neighbours."""
        return self.obstacle_law is not None and self.obstacle_start is None

    @property
    def components(self) -> tuple[Effect, ...]:
        """The component effects whose steering forces are combined, in order of priority; see Steer."""
        return ()

    @property
    def steer_law(self) -> Law:
        """The law (p, me, forces) -> force that combines the forces of its components."""
        raise TypeError(f"{type(self).__name__} combines no forces")

    @property
    def required_inner(self) -> tuple[str, ...]:
        """Names of the inner numbers that the laws read, see `recalls`; for Steer, those that its arbitration reads."""
        return self.recalls

    @property
    def counters(self) -> int:
        """Number of counters of the count_law."""
        return 0

    def members(self, starts: Sequence[int]) -> dict[str, float]:
        """Return parameters that select agents, such as those it applies to; starts[g]: first agent of group g."""
        return {}

    def sums(self, dimension: int) -> int:
        """Return how many running numbers the pair law has: sums, or whatever it keeps from neighbour to neighbour.

        dimension: 2 or 3.
        """
        return 0

    def fold_size(self, dimension: int) -> int:
        """Return the number of values that the fold over obstacles carries.

        dimension: 2 or 3.
        """
        return 0

    def rays(self, dimension: int) -> int:
        """Return the number of rays of the obstacle_ray.

        dimension: 2 or 3.
        """
        return 1

    def numbers(self, dimension: int) -> int:
        """Return the number of values of a bond.

        dimension: 2 or 3.
        """
        return 0

    def partner_count(self, dimension: int) -> int:
        """Return the number of partners of a bond in a world of this dimension."""
        return self.partners

    def bonds(self, groups: Sequence[Any], dimension: int) -> Bonds:
        """Return the bonds in a scene of these groups; raise ValueError, in one line, if the groups do not suit.

        dimension: 2 or 3.
        """
        return Bonds.empty(self.partner_count(dimension), self.numbers(dimension))

    def stencils(self, groups: Sequence[Any], dimension: int) -> Stencils:
        """Return the sets of agents that the `derivative` couples, for methods that solve linear equations.

        groups: of the scene, in its order; dimension: 2 or 3.
        """
        raise TypeError(f"{type(self).__name__} has no derivative")

    def idle_copy(self) -> Effect:
        """Return a copy with all strengths 0, which has no effect but the same sight and the same compiled code."""
        fields = {name: getattr(self, name) for name in self.strengths if name in type(self).model_fields}
        return self.model_copy(
            update={
                name: (0.0,) * len(value) if isinstance(value, tuple) else 0.0
                for name, value in fields.items()
                if value is not None
            }
        )

    def table(self, scene: SceneView) -> NDArray[np.float64]:
        """Return the numbers that laws read as `p.table`, (T,), T >= 1; T depends on the scene.

        It is called when a scene is built, after `check`. A table is an argument, so another one compiles nothing.
        """
        raise TypeError(f"{type(self).__name__} has no table")

    def path_to_draw(self, scene: SceneView) -> tuple[tuple[Vec, ...], float] | None:
        """Return a followed path for pictures: points along it, m, and half its width, m; None without a path.

        scene: that has the effect.
        """
        return None

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return upper bounds, in any state, of w^2, 1/s^2, and of damping, 1/s, for every agent, (N,).

        groups: of the scene, in its order; dimension: 2 or 3.

        Return None if there is no bound, or no stiffness.
        """
        return None

    def potential(self, groups: Sequence[Any], state: Any, offset: Any) -> NDArray[np.float64] | None:
        """Return the potential energy of each world, (B,) J, or None without one; `offset(a, b)`: that of the space.

        groups: of the scene, in its order; state: of B worlds; a, b: (..., D) m.
        """
        return None

    def lookahead(self, speed: float) -> float | None:
        """Return the distance, m, at which an agent of this speed detects obstacles ahead; None if it avoids none.

        An effect that avoids obstacles has a field `horizon`, s, which sets the distance.
        """
        return None

    def check(self, scene: SceneView) -> None:
        """Raise ValueError, beginning with the name of a field, if the scene does not suit the effect.

        Vectors must have the dimension of the scene, and the group of its sight must exist; overrides also call this
        method.
        """
        for name, value in self.parameters().items():
            if isinstance(value, tuple) and len(value) != scene.dimension:
                raise ValueError(f"{name} = {value}: has {len(value)} numbers, but dimension = {scene.dimension}")
        if self.sight is not None:
            demand_group("group", self.sight.group, scene.groups)

    def check_start(self, scene: SceneView, state: Any) -> None:
        """Warn of problems that depend on the initial state, such as the positions of agents.

        scene: that has the effect; state: its initial state.
        """

    def parameters(self) -> dict[str, float | Vec]:
        """Return the numbers and vectors passed to the laws, by name: all fields except None and strings."""
        fields = {name: getattr(self, name) for name in type(self).model_fields if name != "kind"}
        return {
            name: tuple(map(float, value)) if isinstance(value, tuple) else float(value)
            for name, value in fields.items()
            if value is not None and not isinstance(value, str)
        }

    def calls_for(self) -> tuple[str, ...]:
        """Return the names of what must be computed for the effect, such as "neighbour query" or "obstacles"."""
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
