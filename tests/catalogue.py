"""Lists of all laws, effects, integrators, constraints, spaces and tasks: a new row inherits all tests of its kind.

A new effect, integrator, constraint, behaviour, task or space is one row below; `test_catalogue.py` fails while a row
is missing.
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flockenv import steering
from flockenv.behaviours import (
    Alignment,
    Arrive,
    AvoidObstacles,
    CircularRepulsion,
    Cohesion,
    Contain,
    Dock,
    Driving,
    EllipticalRepulsion,
    Evade,
    Explore,
    Face,
    Flee,
    FollowFlow,
    FollowLeader,
    FollowPath,
    FollowWall,
    FollowWay,
    Forage,
    ForceField,
    Formation,
    Friends,
    Heuristics,
    Hide,
    Interest,
    Interpose,
    LineUp,
    MatchVelocity,
    ObstacleRepulsion,
    OffsetPursue,
    Orca,
    Pursue,
    Queue,
    Seek,
    Separation,
    Shadow,
    Shepherd,
    Sidestep,
    StayOnPath,
    TargetSpeed,
    UnalignedAvoidance,
    WalkingGroup,
    Wander,
    Whiskers,
)
from flockenv.behaviours.steer import Steer
from flockenv.envs.table import ENVIRONMENTS
from flockenv.geometry.shapes import Circle, HalfSpace, Shape
from flockenv.geometry.space import Box, Plane, Space, Torus
from flockenv.geometry.targets import Target
from flockenv.model.networks import Blocks, Cloth, Mesh, Rope
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Collisions, Constraint, FaceCollisions, RigidBodies, Rods, Slide
from flockenv.physics.effects import EFFECTS as EFFECT_KINDS
from flockenv.physics.effects import (
    AltitudeSprings,
    AngularSprings,
    Antipode,
    Attraction,
    Bending,
    Carried,
    Contact,
    Course,
    Door,
    Drag,
    Effect,
    Elastic,
    Fear,
    Fluctuation,
    Goal,
    Gravitation,
    Gravity,
    Grazing,
    Intention,
    InverseSquare,
    Journey,
    Libido,
    Membrane,
    Metabolism,
    ObstacleContact,
    Predation,
    Pressure,
    QuadraticDrag,
    Routes,
    Sink,
    Source,
    SpeedLimit,
    Springs,
    Stage,
    SurfaceTension,
    Swing,
    Tether,
    Uniform,
    Vicsek,
    Viscosity,
    Vortex,
    WallRepulsion,
    Way,
    Wind,
)
from flockenv.physics.integrators import (
    RK4,
    AdaptiveRK4,
    AveragedVelocity,
    DormandPrince,
    ExplicitEuler,
    ExponentialDrag,
    Heun,
    ImplicitEuler,
    ImplicitMidpoint,
    Integrator,
    LinearlyImplicitEuler,
    Midpoint,
    SemiImplicitEuler,
    VelocityVerlet,
)
from flockenv.scene import Group, Scene
from flockenv.steering import arbitration
from flockenv.steering.arbitration import (
    Allocation,
    Blend,
    ContextSteering,
    Dithering,
    Intentions,
    Priority,
    RoundRobin,
    RunningSum,
)
from flockenv.tasks import (
    Bottleneck,
    Corridor,
    Crossing,
    CrowdNav,
    Flock,
    Herd,
    Obstacles,
    PathFollow,
    Pursuit,
    School,
    Task,
)
from flockenv.tasks import Evade as EvadeTask

Array = NDArray[np.float64]


# --- steering and arbitration -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Law:
    """A steering law and the kinds of its arguments, so that a test can generate and rotate them.

    Kinds of vectors: "vector" (any), "heading" (unit), both rotated with the world; "own" (unit, in the agent's frame,
    not rotated); "noise" (uniform in [-1, 1]); "walls" (distances to walls per axis, not rotated).
    Numbers: "positive" (around 1), "length" (m, around 3).
    """

    law: Any
    takes: tuple[str, ...]
    gives: str  # "vector", "positive" or "own"
    turns: str = "any"  # "any" rotation; "upright": about the vertical only in 3-D; "none": tied to the axes
    mirrors: bool = True

    @property
    def name(self) -> str:
        return str(self.law.py_func.__name__)


STEERING = (
    Law(steering.seek, ("vector", "vector", "positive"), "vector"),
    Law(steering.flee, ("vector", "vector", "positive"), "vector"),
    Law(steering.arrive, ("vector", "vector", "positive", "length"), "vector"),
    Law(steering.distance_time, ("vector", "positive", "positive"), "positive"),
    Law(steering.interception_time, ("vector", "vector", "positive"), "positive"),
    Law(steering.pursue, ("vector", "vector", "vector", "positive", "positive"), "vector"),
    Law(steering.evade, ("vector", "vector", "vector", "positive", "positive"), "vector"),
    Law(steering.wander_turn, ("vector", "noise", "positive", "positive"), "vector"),
    # left and right are exchanged in a mirror image
    Law(steering.wander, ("own", "vector", "positive", "positive"), "vector", turns="upright", mirrors=False),
    Law(steering.to_world_axes, ("own", "vector"), "vector", turns="upright", mirrors=False),
    Law(steering.match_velocity, ("vector", "vector"), "vector"),
    Law(steering.target_speed, ("vector", "positive"), "vector"),
    Law(steering.face, ("vector", "heading"), "vector"),
    Law(steering.dock, ("vector", "vector", "heading", "positive", "length", "positive", "length"), "vector"),
    Law(steering.approach_time, ("vector", "positive", "length"), "positive"),
    Law(steering.opensteer_time, ("vector", "vector", "vector", "length"), "positive"),
    Law(steering.passing_point, ("vector", "vector", "positive"), "vector"),
    Law(steering.offset_pursue, ("vector", "vector", "vector", "positive", "positive", "positive"), "vector"),
    Law(
        steering.keep_station, ("vector", "vector", "vector", "own", "positive", "length"), "vector", turns="upright",
        mirrors=False,
    ),
    Law(
        steering.follow_leader,
        ("vector", "vector", "vector", "positive", "length", "positive", "positive", "length"),
        "vector",
    ),
    Law(
        steering.interpose,
        ("vector", "vector", "vector", "vector", "vector", "positive", "positive", "length"),
        "vector",
    ),
    Law(
        steering.shadow, ("vector", "vector", "vector", "positive", "positive", "positive", "positive"), "vector"
    ),
    Law(steering.hiding_place, ("vector", "positive", "positive", "vector"), "vector"),
    Law(steering.separate, ("vector", "heading"), "vector"),
    Law(steering.align, ("vector", "vector"), "vector"),
    Law(steering.cohere, ("vector", "vector", "positive"), "vector"),
    Law(steering.threat, ("heading", "vector", "positive", "length"), "positive"),
    Law(steering.avoid, ("heading", "vector", "positive", "positive"), "vector"),
    Law(steering.unaligned_threat, ("vector", "vector", "vector", "positive", "length"), "positive"),
    Law(steering.give_way, ("vector", "vector", "vector", "positive", "positive"), "vector"),
    Law(steering.queue_gap, ("heading", "vector", "vector", "positive", "positive"), "positive"),
    Law(steering.queue, ("heading", "vector", "positive", "positive", "positive"), "vector"),
    Law(steering.explore, ("walls", "walls", "vector", "positive", "positive"), "vector", turns="none", mirrors=False),
    Law(steering.stay_on_path, ("positive", "vector", "vector", "positive"), "vector"),
    Law(steering.follow_path, ("positive", "positive", "vector", "vector", "positive"), "vector"),
    Law(steering.follow_flow, ("vector", "vector"), "vector"),
    Law(steering.contain, ("walls", "walls", "vector", "positive", "positive"), "vector", turns="none", mirrors=False),
    Law(steering.gaze_direction, ("heading", "heading"), "vector"),
    Law(steering.view_weight, ("heading", "vector", "positive"), "positive"),
    Law(steering.cone_weight, ("heading", "vector", "positive", "positive"), "positive"),
    Law(steering.repulsion, ("vector", "heading", "positive", "length"), "vector"),
    Law(steering.elliptical_repulsion, ("vector", "vector", "heading", "length"), "vector"),
    # it passes every neighbour on the same side
    Law(
        steering.sidestep, ("vector", "vector", "vector", "heading", *("positive",) * 5), "vector", turns="upright",
        mirrors=False,
    ),
    Law(steering.attraction, ("vector", "length"), "vector"),
    Law(steering.gaze_turn, ("heading", "vector", "positive"), "positive"),
    Law(steering.collision_distance, ("heading", "vector", "vector", "positive", "positive"), "positive"),
    Law(steering.sheep_direction, ("vector",) * 5 + ("positive",) * 5, "vector"),
    Law(steering.point_behind, ("vector", "vector", "length"), "vector"),
    Law(steering.herding_offset, ("vector", "vector", "vector", "length", "positive", "positive"), "vector"),
)  # fmt: skip

ARBITRATION = (arbitration.blend, arbitration.prioritise, arbitration.allocate, arbitration.allocate_running)
"""Laws that combine steering forces without a scene."""

ARBITRATIONS = (Blend(), Priority(), Dithering(), Allocation(), RunningSum(), RoundRobin(), ContextSteering())
"""Arbitrations of a `Steer` effect that need no inner state; tests/test_arbitration.py tests all of them."""

RECALLING = (Intentions(when=("avoid", "escape", "eat", "mate", "school", "wander")),)
"""Arbitrations that read inner states, which other effects must keep; see tests/test_school.py."""


# --- effects ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EffectRow:
    """An effect with parameters under which it acts, and the symmetries it must obey.

    Vectors are given in 3-D; in 2-D only their first two numbers are used, and `axis` is None.
    """

    effect: Effect
    beside: tuple[Effect, ...] = ()  # effects without which it moves no agent, such as drag
    obeys: frozenset[str] = frozenset({"translation", "rotation", "mirror", "relabelling"})
    signed: tuple[str, ...] = ()  # parameters that may be negative
    dimensions: tuple[int, ...] = (2, 3)  # in which it is defined
    family: str = ""  # rows of a family share a kernel: their scenes contain all of them, the others idle
    flat: Effect | None = None  # the effect in 2-D, if it is not enough to drop the third numbers

    @property
    def name(self) -> str:
        fov, nearest = getattr(self.effect, "fov", 360.0), getattr(self.effect, "nearest", None)
        words = ["cone"] * (fov < 360.0) + ([f"nearest_{nearest}"] if nearest else [])
        words += ["medium"] * (getattr(self.effect, "acts", "") == "medium")
        words += ["yielding"] * bool(getattr(self.effect, "lasts", False))
        words += ["corotated"] * (getattr(self.effect, "strain", "") == "corotated")
        return "_".join([self.effect.kind, *words])

    def at(self, dimension: int) -> tuple[Effect, ...]:
        """Return the effect in `dimension` and those beside it; skip the test if it is not defined there."""
        if dimension not in self.dimensions:
            pytest.skip(f"{self.name}: not in {dimension}-D")
        return tuple(in_dimension(effect, dimension) for effect in (self._own(dimension), *self.beside))

    def _own(self, dimension: int) -> Effect:
        return self.flat if self.flat is not None and dimension == 2 else self.effect

    def company(self, dimension: int, idle: bool = False) -> tuple[Effect, ...]:
        """Return the effect among the idle effects of its family, and those beside it; with `idle` it is idle too."""
        effect, *beside = self.at(dimension)
        if not self.family:
            return (effect.idle_copy() if idle else effect, *beside)
        family = [row for row in EFFECTS if row.family == self.family and dimension in row.dimensions]
        here = [(in_dimension(row._own(dimension), dimension), row is self and not idle) for row in family]
        return (*(effect if acts else effect.idle_copy() for effect, acts in here), *beside)


def vectors(effect: Effect) -> dict[str, tuple[Any, ...]]:
    """Return the parameters of an effect that are directions, places or lists of places."""
    given = effect.parameters() | {name: getattr(effect, name) for name in effect.places}
    return {name: value for name, value in given.items() if isinstance(value, tuple)}


def in_dimension(effect: Effect, dimension: int) -> Effect:
    """Return the effect with the first numbers of its vectors; in 2-D `axis` is None."""
    flat: dict[str, Any] = {
        name: None if name == "axis" and dimension == 2 else value[:dimension]
        for name, value in vectors(effect).items()
        if not isinstance(value[0], tuple)
    }
    flat |= {
        name: tuple(place[:dimension] for place in value)
        for name, value in vectors(effect).items()
        if isinstance(value[0], tuple)
    }
    within = getattr(effect, "within", None)
    if isinstance(within, Circle) and dimension == 3:
        flat["within"] = Circle(centre=(*within.centre[:2], 3.0), radius=within.radius)
    return effect.model_copy(update=flat)


def turned(effect: Effect, matrix: Array, shift: Array) -> Effect:
    """Return the effect with directions rotated, and places rotated about the point EDGE / 2 and shifted."""
    middle = EDGE / 2
    change = {
        name: (np.array(value) - middle) @ matrix.T + middle + shift if name in effect.places else value @ matrix.T
        for name, value in vectors(effect).items()
    }
    return effect.model_copy(update={name: _tuples(value.tolist()) for name, value in change.items()})


def _tuples(value: Any) -> Any:
    """Return nested lists as nested tuples."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


DRAG = Drag(rate=0.4)
WIND = Wind(velocity=(1.5, -0.7, 0.4), gust=(0.5, 1.0, -0.3), period=0.8)
CENTRE = (2.5, 2.5, 2.5)
UPRIGHT = frozenset({"translation", "relabelling"})
LOOP = ((1.0, 1.0, 2.5), (5.0, 1.5, 3.0), (4.5, 5.0, 2.0), (1.5, 4.0, 3.5))
FLOWS = tuple((0.3 * k % 2 - 1, 0.7 * k % 2 - 1, 0.9 * k % 2 - 1) for k in range(24))

DRIVING = Driving(tau=0.8)

EFFECTS = (
    EffectRow(DRAG),
    EffectRow(QuadraticDrag(rate=0.3), family="own"),
    EffectRow(Gravity(acceleration=(0.5, -3, 1)), family="own"),
    EffectRow(Uniform(strength=(0.8, -0.5, 0.3), period=2, phase=0.3), signed=("phase",), family="own"),
    EffectRow(Source(strength=2, centre=CENTRE, maximum=3), signed=("phase",), family="own"),
    EffectRow(
        Sink(strength=2, centre=CENTRE, maximum=3, acts="medium"), beside=(DRAG,), signed=("phase",), family="medium"
    ),
    EffectRow(
        Vortex(strength=-2, centre=CENTRE, maximum=3, axis=(0.6, 0, 0.8), acts="medium", period=3), beside=(DRAG,),
        obeys=frozenset({"translation", "rotation", "relabelling"}),  # its mirror image turns in the opposite direction
        signed=("strength", "phase"), family="medium",
    ),
    EffectRow(
        Vortex(strength=2, centre=CENTRE, maximum=3, axis=(0.6, 0, 0.8)),
        obeys=frozenset({"translation", "rotation", "relabelling"}), signed=("strength", "phase"), family="own",
    ),
    EffectRow(WIND, beside=(DRAG,), signed=("phase",), family="medium"),
    EffectRow(Carried(share=0.9), beside=(WIND, DRAG)),
    EffectRow(Attraction(strength=2, centre=CENTRE, softening=0.5), signed=("strength",), family="own"),
    EffectRow(Tether(centre=CENTRE, stiffness=0.8, damping=0.1, rest=0.5), family="own"),
    EffectRow(
        Swing(centre=CENTRE, strength=0.8, length=0.7), obeys=frozenset({"translation", "mirror", "relabelling"}),
        family="own",
    ),
    EffectRow(Goal(target=CENTRE, slow_radius=2), beside=(DRIVING,), family="aims"),
    EffectRow(Course(direction=(0.8, -0.5, 0.3), share=0.7), beside=(DRIVING,), family="aims"),
    EffectRow(  # the target is fixed at the start: an agent that is shifted later still goes there
        Antipode(centre=CENTRE[:2]), beside=(DRIVING,), dimensions=(2,), obeys=frozenset()
    ),
    EffectRow(DRIVING, beside=(Goal(target=CENTRE, slow_radius=2),)),
    EffectRow(  # its grid lies along the axes
        Way(targets=(Target(at=(3.0, 5.5)),), clearance=0.1, spacing=0.3, margin=1), beside=(DRIVING,),
        dimensions=(2,), obeys=frozenset({"relabelling"}),
    ),
    EffectRow(  # it keeps the last positions of agents
        Journey(stages=(Stage(at=(3.0, 5.5), radius=0.3, wait=0.1),), premovement=0.05, clearance=0.1, margin=1),
        beside=(DRIVING,), dimensions=(2,), obeys=frozenset(),
    ),
    EffectRow(  # it keeps positions and doors, and each agent decides at times of its own
        Routes(doors=(Door(ends=((3.0, 5.5), (4.0, 5.5))), Door(at=(1.0, 1.0), width=1)), clearance=0.1, margin=1),
        beside=(DRIVING,), dimensions=(2,), obeys=frozenset(),
    ),
    EffectRow(LineUp(margin=0.1, radius=2.5), beside=(Goal(target=CENTRE, slow_radius=2),)),
    # inner states move no agent; tests/test_school.py tests their values
    EffectRow(Metabolism(rate=0.1, effort=0.1, spread=0.4), family="urges", obeys=frozenset()),
    EffectRow(Grazing(group=0, other=1, radius=1.0, rate=0.3, appetite=0.8), family="urges", obeys=frozenset()),
    EffectRow(Predation(group=1, other=0, radius=0.8, meal=0.2), family="urges", obeys=frozenset()),
    EffectRow(Fear(group=0, other=1, radius=2.5), family="urges", obeys=frozenset()),
    EffectRow(Libido(radius=1.0, start=0.4, spread=0.6), family="urges", obeys=frozenset()),
    EffectRow(Intention(), family="urges", obeys=frozenset()),
    EffectRow(WallRepulsion(point=CENTRE, normal=(1.2, -0.7, 0.9), strength=2, decay=1.5), family="own"),
    EffectRow(ObstacleContact(stiffness=30, damping=4, friction=8, coulomb=0.6, most=5), family="around"),
    EffectRow(
        Contact(stiffness=20, ratio=0.3, damping=0.1, friction=6, coulomb=0.5, most=4, radius=0.5), family="pushes"
    ),
    EffectRow(SpeedLimit(speed=1.2, strength=0.8), family="own"),
    EffectRow(  # random per agent, drawn along the axes
        Fluctuation(strength=0.8), obeys=frozenset({"translation"}), family="own"
    ),
    EffectRow(Pressure(strength=1.5, density=1, radius=1.35), family="liquid"),
    EffectRow(Viscosity(viscosity=0.4, density=1, radius=2.2), family="liquid"),
    EffectRow(SurfaceTension(tension=0.8, density=1, radius=2.2), family="liquid"),
    EffectRow(  # random per agent, with the same sign in a mirror image
        Vicsek(speed=1.2, radius=2.5, noise=1, step=0.05), obeys=frozenset({"translation", "rotation"}), dimensions=(2,)
    ),
    EffectRow(Separation(weight=1.3, radius=2.5), family="flock"),
    EffectRow(Separation(weight=1.3, radius=2.5, fov=200, nearest=3)),
    EffectRow(Alignment(weight=0.7, radius=3, fov=270), family="flock"),
    EffectRow(Cohesion(weight=0.9, radius=2.8, fov=240), family="flock"),
    EffectRow(AvoidObstacles(weight=5, horizon=3, margin=0.1)),
    EffectRow(UnalignedAvoidance(weight=3, radius=4, horizon=2, margin=0.2), family="crowd"),
    EffectRow(Queue(weight=2, target=CENTRE, speed=1.2, margin=0.1), family="crowd"),
    # each agent searches for food along a random path of its own
    EffectRow(Forage(weight=2, food=0, speed=1.2, radius=2.4), obeys=frozenset({"translation"}), family="crowd"),
    EffectRow(
        Explore(weight=2, low=(-1, -1, -1), high=(7, 8, 7), speed=1.2, track=1.5),
        obeys=frozenset({"translation", "relabelling"}), signed=("low", "high"), family="goals",
    ),
    EffectRow(
        Orca(weight=5, target=CENTRE, speed=1.2), obeys=frozenset({"translation", "rotation", "relabelling"}),
        dimensions=(2,),  # agents keep left in a mirror image
    ),
    EffectRow(
        Steer(
            behaviours=(
                AvoidObstacles(weight=5, horizon=3), Separation(weight=1.3, radius=2.5), Alignment(weight=0.7, radius=3)
            )
        )
    ),
    EffectRow(Seek(weight=2, target=CENTRE, speed=1.5), family="goals"),
    EffectRow(Flee(weight=2, target=CENTRE, speed=1.5, radius=4), family="goals"),
    EffectRow(Arrive(weight=2, target=CENTRE, speed=1.5, slow_radius=2), family="goals"),
    EffectRow(
        Dock(weight=2, target=CENTRE, direction=(0.5, -1, 0.3), speed=1.5, gate=1, width=0.3, slow_radius=2),
        family="goals",
    ),
    EffectRow(Face(weight=2, heading=(1, 2, -0.5)), family="goals"),
    EffectRow(TargetSpeed(weight=2, speed=1.2), family="goals"),
    EffectRow(  # random per agent, and random turns are not mirrored
        Wander(weight=2, speed=1.5, strength=0.8), obeys=frozenset({"translation"}), family="goals"
    ),
    EffectRow(Pursue(weight=2, speed=1.5, group=0, radius=2.5), family="others"),
    EffectRow(Evade(weight=2, speed=1.5, group=0, radius=2.5, predictor="exact", fov=300), family="others"),
    EffectRow(OffsetPursue(weight=2, speed=1.5, radius=2.5, distance=0.3), family="others"),
    EffectRow(
        Shadow(weight=2, speed=1.5, group=0, radius=2.5, distance=0.5, predictor="opensteer"), family="others"
    ),
    EffectRow(MatchVelocity(weight=2, radius=2.5), family="others"),
    EffectRow(
        Formation(weight=2, speed=1.5, group=0, radius=2.5, ahead=-0.5, left=0.7, up=0.2, slow_radius=1),
        obeys=UPRIGHT, signed=("ahead", "left", "up"), family="others",  # `left` is right in a mirror image
    ),
    EffectRow(
        FollowLeader(weight=2, speed=1.5, group=0, radius=2.5, distance=0.5, headway=0.3, slow_radius=1),
        family="others",
    ),
    EffectRow(Shepherd(weight=2, speed=1.5, group=0, goal=CENTRE, spacing=0.4, slow_radius=2), family="pushes"),
    EffectRow(Interpose(weight=2, speed=1.5, group=0, other=0, radius=2.5, slow_radius=1), family="others"),
    EffectRow(Hide(weight=2, speed=1.5, group=0, radius=2.5, slow_radius=1), family="around"),
    EffectRow(Whiskers(weight=5, horizon=3), obeys=UPRIGHT, family="around"),  # some whiskers are horizontal
    EffectRow(ForceField(weight=0.5, range=2), family="around"),
    EffectRow(FollowWall(weight=2, speed=1.5, distance=0.7, range=4), family="around"),
    EffectRow(  # its circle is not moved with the scene
        Contain(weight=2, speed=1.5, within=Circle(centre=(3, 3), radius=2.5)), obeys=frozenset({"relabelling"}),
        family="paths",
    ),
    EffectRow(  # its grid lies along the axes
        FollowWay(weight=2, speed=1.5, target=(3.0, 5.5, 2.5), clearance=0.1, spacing=0.3, margin=1),
        obeys=frozenset({"relabelling"}),
    ),
    EffectRow(
        FollowPath(weight=2, points=LOOP, closed=True, radius=0.3, speed=1.5), signed=("way",), family="paths"
    ),
    EffectRow(StayOnPath(weight=2, points=LOOP[:3], radius=0.4, speed=1.5, time=1), family="paths"),
    EffectRow(
        FollowFlow(weight=1.5, centre=CENTRE, spacing=1.5, counts=(4, 3, 2), velocities=FLOWS),
        flat=FollowFlow(weight=1.5, centre=CENTRE[:2], spacing=1.5, counts=(4, 3),
                        velocities=tuple(flow[:2] for flow in FLOWS[:12])),
        obeys=frozenset({"translation", "relabelling"}), family="paths",  # its grid lies along the axes
    ),
    # exact for few agents; for many, see test_gravitation.py
    EffectRow(Gravitation(constant=0.3, softening=0.5), family="far"),
    EffectRow(InverseSquare(strength=-0.4, softening=0.3), signed=("strength",), family="far"),
    EffectRow(CircularRepulsion(strength=2, decay=0.8, anisotropy=0.3, radius=2.5), family="social"),
    EffectRow(
        EllipticalRepulsion(
            acceleration=1.5, decay=0.8, step=0.7, relative=True, anisotropy=0.4, fov=200, outside=0.5, radius=2.5
        ),
        family="social",
    ),
    EffectRow(  # it keeps right
        Sidestep(acceleration=2, radius=2.5, bias=0.1), obeys=UPRIGHT | {"rotation"}, family="social"
    ),
    EffectRow(ObstacleRepulsion(strength=3, decay=0.9), family="around"),
    EffectRow(Interest(target=CENTRE, strength=1, decay=2, fades=5), family="goals"),
    EffectRow(Friends(group=0, strength=1, decay=2, fades=5, radius=2.5), family="social"),
    EffectRow(  # members of a party have consecutive indices
        WalkingGroup(group=0, party=3, radius=2.5), obeys=frozenset({"translation", "rotation", "mirror"}),
        family="social",
    ),
    EffectRow(  # of two equally good directions it takes the one on the right
        Heuristics(radius=2.5), beside=(Goal(target=CENTRE, slow_radius=2),),
        obeys=frozenset({"translation", "rotation", "relabelling"}), dimensions=(2,),
    ),
    # agents of a network; see `tied`
    EffectRow(Springs(stiffness=3, damping=0.2), obeys=frozenset({"translation", "rotation", "mirror"})),
    EffectRow(
        Springs(stiffness=3, curve=((-1, -0.5), (0, 0), (0.05, 0.05), (1, 0.4)), yield_strain=0.1, break_strain=1),
        obeys=frozenset({"translation", "rotation", "mirror"})
    ),
    EffectRow(
        AngularSprings(stiffness=0.05, damping=0.005), beside=(Springs(stiffness=3),),  # a uniform stretch keeps angles
        obeys=frozenset({"translation", "rotation"}),  # in the plane an angle has a sign
    ),
    EffectRow(
        Membrane(stretch=0.1, shear=0.03, damping=0.01), obeys=frozenset({"translation", "rotation", "mirror"}),
    ),
    EffectRow(  # an angle at rest has a sign
        Bending(stiffness=0.03, damping=0.01), beside=(Springs(stiffness=3),),
        obeys=frozenset({"translation", "rotation"}), dimensions=(3,),
    ),
    EffectRow(Elastic(young=3, beta=0.1), obeys=frozenset({"translation"})),  # linear: rotations cause strain
    EffectRow(
        Elastic(young=3, beta=0.1, strain="corotated"), obeys=frozenset({"translation", "rotation"}),
        dimensions=(2,),  # in 3-D: test_corotated.py; a mirror image is inside out
    ),
    EffectRow(
        AltitudeSprings(stiffness=0.5, damping=0.02), obeys=frozenset({"translation", "rotation"}), dimensions=(3,),
    ),
)  # fmt: skip


# --- integrators, spaces, tasks ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class IntegratorRow:
    """A method and its closed-form results."""

    method: Integrator
    grown: float  # result for 100 with x' = v, v' = v / 10 after ten steps of 1 s
    real: float  # largest h |lambda| at which v' = lambda v, lambda < 0, does not grow
    imaginary: float  # largest h omega at which x'' = -omega^2 x does not grow

    @property
    def name(self) -> str:
        return self.method.kind

    @property
    def fixed(self) -> Integrator:
        """The method at fixed steps: an adaptive one gets a tolerance so large that it never splits a step."""
        return self.method.model_copy(update={"tolerance": 1e30}) if self.method.adaptive else self.method


INTEGRATORS = (
    IntegratorRow(ExplicitEuler(), 259.37425, 2, 0),
    IntegratorRow(SemiImplicitEuler(), 275.31167, 2, 2),
    IntegratorRow(AveragedVelocity(), 267.34296, 2, 0),
    IntegratorRow(Midpoint(), 271.40808, 2, 0),
    IntegratorRow(Heun(), 271.40808, 2, 0),
    IntegratorRow(VelocityVerlet(), 271.40808, 2, 2),
    IntegratorRow(RK4(), 271.82797, 2.7853, 2.8284),
    IntegratorRow(AdaptiveRK4(), 271.828169, 5.5705, 5.657),
    IntegratorRow(DormandPrince(), 271.828183, 3.3065, 0.997),
    IntegratorRow(ExponentialDrag(), 271.68016, 2, 2),  # for drag within the force; none for drag it is passed
    IntegratorRow(ImplicitEuler(), 286.79720, math.inf, math.inf),
    IntegratorRow(LinearlyImplicitEuler(), 275.31167, 2, 2),  # explicit for forces without a known derivative
    IntegratorRow(ImplicitMidpoint(), 272.055141, math.inf, math.inf),
)


@dataclass(frozen=True)
class ConstraintRow:
    """A constraint and what it acts on in 3-D, under gravity, from the first steps on; see `constrained`."""

    constraint: Constraint
    groups: tuple[Group, ...]
    obstacles: tuple[Shape, ...] = ()

    @property
    def name(self) -> str:
        return self.constraint.kind


FLOOR = HalfSpace(point=(0, 0, 0), direction=(0, 0, 1))
SHEET = Cloth(cells=(2, 2), origin=(0, 0, 0.11), sides=(0.5, 0.5))
CHAIN = Rope(links=4, length=1.0, direction=(1, 0, 0), pinned=("start",))
HEAP = Group(count=8, radius=0.1, spawn=Spawn(low=(0, 0, 0.1), high=(0.8, 0.8, 0.5), speed=(0, 2)))

CONSTRAINTS = (
    ConstraintRow(Collisions(restitution=0.5), (HEAP,), (FLOOR,)),
    ConstraintRow(Rods(group=0), (Group(network=CHAIN, radius=0.01),)),
    ConstraintRow(Slide(particles=("end",), along=((1, 0, 0),)), (Group(network=CHAIN, radius=0.01),)),
    ConstraintRow(
        FaceCollisions(friction=0.3), (Group(network=SHEET, mass=0.01, radius=0.01),),
        (Circle(centre=(0.3, 0.25, 0), radius=0.1),),
    ),
    ConstraintRow(
        RigidBodies(), (Group(network=Blocks(sides=(0.2, 0.2, 0.2), centres=((0, 0, 0.11), (0.1, 0, 0.33)))),), (FLOOR,)
    ),
)  # fmt: skip


def constrained(row: ConstraintRow) -> Scene:
    """Return the scene in which tests simulate a constraint; without it all have one kernel but for obstacles."""
    return Scene(
        dimension=3, groups=row.groups, effects=(Gravity(acceleration=(0, 0, -9.81)),), obstacles=row.obstacles,
        constraints=(row.constraint,), dt=0.01,
    )  # fmt: skip


SPACES = {
    "plane": {2: Plane(), 3: Plane()},
    "torus": {2: Torus(size=(9.0, 7.0)), 3: Torus(size=(9.0, 7.0, 8.0))},
    "box": {2: Box(size=(9.0, 7.0)), 3: Box(size=(9.0, 7.0, 8.0))},
}


@dataclass(frozen=True)
class TaskRow:
    """A task with common settings; `variant` distinguishes rows of the same task."""

    task: Task
    variant: str = ""

    @property
    def name(self) -> str:
        return self.task.name + self.variant


SINGLE = tuple(info.id for info in ENVIRONMENTS.values())
"""Ids of environments with one learner."""
TEAMS = tuple(info.id for info in ENVIRONMENTS.values() if info.team)
"""Ids of environments with several."""
RAISED = {name: info.version for name, info in ENVIRONMENTS.items() if info.version}
"""Versions of environments above 0."""

TASKS = (
    TaskRow(Pursuit()),
    TaskRow(Pursuit(pursuers=3, evaders=2, sides="both"), "_both"),
    TaskRow(Obstacles()),
    TaskRow(Flock()),
    TaskRow(Flock(learners=1), "_single"),
    TaskRow(Crossing()),
    TaskRow(Crossing(agents=8, learners=1), "_single"),
    TaskRow(CrowdNav()),
    TaskRow(Corridor()),
    TaskRow(Corridor(people=8, learners=1), "_single"),
    TaskRow(Bottleneck()),
    TaskRow(Bottleneck(people=8, learners=1), "_single"),
    TaskRow(EvadeTask()),
    TaskRow(PathFollow()),
    TaskRow(Herd()),
    TaskRow(Herd(dogs=3), "_team"),
    TaskRow(School()),
    TaskRow(School(learners=1), "_single"),
)


# --- scenes that many tests share: each set of laws, dimension, space, method and precision is compiled once ----------

EDGE = 6.0
"""m, edge of the square or cube in which agents of `scene_of` begin."""


SOLID = {"elastic", "altitude_springs"}
"""Effects that act on elements; with as many partners as dimensions, these fill space."""

FLAT = {"membrane", "bending"}
"""Effects that act on triangles, in space too."""


def tied(group: Group, dimension: int, filled: bool = False, triangles: bool = False) -> Group:
    """Return the group as a network of random positions, stretched: a chain, elements that fill space, or triangles."""
    count = group.size
    vertices = np.random.default_rng(5).uniform(0.2 * EDGE, 0.8 * EDGE, (count, dimension))
    runs = [tuple(tuple(range(i, i + k)) for i in range(count + 1 - k)) for k in (2, 3, 4)]
    strip = tuple((i, i + 1, i + 2) if i % 2 == 0 else (i + 1, i, i + 2) for i in range(count - 2))
    solid = {"triangles": strip} if dimension == 2 or triangles else {"tetrahedra": runs[2]}
    joined: dict[str, Any] = solid if filled or triangles else {"bars": runs[0], "angles": runs[1]}
    mesh = Mesh(vertices=tuple(map(tuple, vertices.tolist())), stretch=1.2, **joined)
    return Group(network=mesh, mass=group.mass, radius=group.radius)


def scene_of(*effects: Effect, dimension: int = 2, space: Space | None = None, **fields: Any) -> Scene:
    """Return a scene of two groups under some effects, with two obstacles if an effect needs obstacles."""
    low, high = (0.0,) * dimension, (EDGE,) * dimension
    spawn = Spawn(low=low, high=high, speed=(0.2, 1.5))
    paced = {"desired_speed": 1.2, "spawn": spawn}
    groups = (Group(count=14, mass=0.7, radius=0.1, **paced), Group(count=10, mass=2, radius=0.25, **paced))
    groups = fields.pop("groups", groups)
    if any(effect.bond_law for effect in effects) and groups[0].network is None:
        filled = any(effect.partner_count(dimension) == dimension for effect in effects if effect.kind in SOLID)
        groups = (tied(groups[0], dimension, filled, any(effect.kind in FLAT for effect in effects)), *groups[1:])
    asked = any("obstacles" in effect.calls_for() for effect in effects)
    centres = ((1.5, 2.0, 2.5)[:dimension], (4.5, 3.5, 3.0)[:dimension]) if asked else ()
    obstacles = tuple({"centre": centre, "radius": 0.6} for centre in centres)
    given: dict[str, Any] = {"groups": groups, "obstacles": obstacles, "dt": 0.05} | fields
    return Scene(dimension=dimension, space=space or Plane(), effects=effects, **given)


def scene_under(row: EffectRow, dimension: int) -> Scene:
    """Return the scene in which tests simulate a row."""
    return scene_of(*row.company(dimension), dimension=dimension)


FIRST = tuple({row.effect.kind: row for row in reversed(EFFECTS)}.values())[::-1]
"""The first row of each kind of effect."""


AMONG_ALL = {
    "drag", "wind", "carried", "fluctuation", "separation", "alignment", "cohesion", "avoid_obstacles",
}  # fmt: skip
"""At least one effect of each form that a torus and large worlds support; more would only compile longer."""


def everything(dimension: int, *chosen: Effect, **fields: Any) -> Scene:
    """Return a scene with effects of all forms (AMONG_ALL), on a torus unless another space is given.

    If some effects are chosen, the others are idle. Tests of different effects then share one kernel, as long as their
    sights are alike (KernelPlan.sights: which effects share a radius, and which have a view cone).
    """
    own = {effect.kind: effect for effect in chosen}
    others = [row.effect for row in FIRST if row.effect.kind in AMONG_ALL]
    rest = {effect.kind: in_dimension(effect, dimension) for effect in others}
    given = {"space": SPACES["torus"][dimension]} | fields
    effects = ({kind: effect.idle_copy() for kind, effect in rest.items()} if chosen else rest) | own
    return scene_of(*effects.values(), dimension=dimension, **given)


@dataclass(frozen=True)
class Variant:
    """A kernel that tests of batches, steps and threads share: laws, space, dimension, method and precision.

    `make(count, edge)` returns a scene of `count` agents in a region of that edge, m. The kernel is the same for all.
    """

    name: str
    effects: tuple[Effect, ...]  # empty: all forms, AMONG_ALL
    space: str
    dimension: int
    dtype: str = "float64"
    method: Integrator = field(default_factory=SemiImplicitEuler)

    def make(self, count: int, edge: float, **fields: Any) -> Scene:
        corner = (edge,) * self.dimension
        space = Plane() if self.space == "plane" else {"torus": Torus, "box": Box}[self.space](size=corner)
        spawn = Spawn(low=(0.0,) * self.dimension, high=corner, speed=(0.2, 1.5))
        given: dict[str, Any] = {
            "space": space, "dtype": self.dtype, "integrator": self.method, "dt": 0.05,
            "groups": (Group(count=count, max_speed=3, max_force=8, radius=0.05, desired_speed=1.2, spawn=spawn),),
        } | fields  # fmt: skip
        if self.effects:
            return scene_of(*self.effects, dimension=self.dimension, **given)
        return everything(self.dimension, **given)


NEAREST = (
    # here alignment and cohesion share one sight
    Variant("nearest_plane", (
        Separation(weight=1.3, radius=2.5, nearest=1),
        Alignment(weight=0.7, radius=3, nearest=6),
        Cohesion(weight=0.9, radius=3, nearest=6),
    ), "plane", 2),
    # here cohesion sees all neighbours within its radius
    Variant("nearest_plane_3", (
        Separation(weight=1.3, radius=2.5, fov=300, nearest=6),
        Alignment(weight=0.7, radius=3, nearest=32),
        Cohesion(weight=0.9, radius=2, fov=240),
    ), "plane", 3, method=ExplicitEuler()),
    Variant("nearest_torus_single", (
        Separation(weight=1.3, radius=2.5, nearest=6),
        Alignment(weight=0.7, radius=3, fov=270, nearest=1),
        Cohesion(weight=0.9, radius=2, nearest=7),
    ), "torus", 2, "float32"),
)  # fmt: skip
"""Behaviours with the nearest 1, 6, 7 or 32 neighbours, with and without a view cone, in planes and on toruses."""

NEAREST_MANY = Variant("nearest_torus_many", (
    Separation(weight=1.3, radius=2.5),
    Alignment(weight=0.7, radius=3, fov=270, nearest=30),  # a unit lattice has 32 neighbours within 2
    Cohesion(weight=0.9, radius=2),
), "torus", 3)  # fmt: skip
"""Almost the largest `nearest` that is allowed, with a view cone on a torus; it compiles for half a minute."""

VARIANTS = (
    Variant("torus", (), "torus", 2),
    Variant("torus_3", (), "torus", 3),
    Variant("torus_single", (), "torus", 2, "float32"),
    Variant("torus_single_rk4", (), "torus", 2, "float32", RK4()),
    Variant("plane_3_single", (), "plane", 3, "float32"),
    Variant("box", (Separation(weight=1.3, radius=1.0),), "box", 2),
    *NEAREST,
)
"""Every space, dimension and precision, three methods; slow tests try their combinations (test_scene.py)."""


def rotation(dimension: int, seed: int, upright: bool = False) -> Array:
    """Return a random rotation matrix; `upright` keeps the z axis."""
    rng = np.random.default_rng(seed)
    flat = 2 if upright else dimension
    q, r = np.linalg.qr(rng.normal(size=(flat, flat)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.sign(np.linalg.det(q))
    full = np.eye(dimension)
    full[:flat, :flat] = q
    return full


def mirror(dimension: int) -> Array:
    """Return the matrix of a reflection that reverses the x axis."""
    return np.diag([-1.0] + [1.0] * (dimension - 1))


# --- an effect outside the library ------------------------------------------------------------------------------------

TETHER = """
from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv.physics.effects import Effect, Me
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, dot, scale


@law
def swing(x: Vec, sine: float, rest: float) -> Vec:
    if len(x) == 2:
        return (rest - sine * np.sin(x[0]), rest - sine * np.sin(x[1]))
    else:
        return (rest - sine * np.sin(x[0]), rest - sine * np.sin(x[1]), rest - sine * np.sin(x[2]))


@law
def tether(p: Any, me: Me) -> Vec:
    square = max(dot(me.pos, me.pos), like(p.sun, 1e-12))
    pull = add(scale(me.pos, -p.stiffness - p.sun / (square * np.sqrt(square))), scale(me.vel, -p.damping))
    return add(pull, swing(me.pos, p.sine, p.weight + p.push * np.cos(me.time + me.time)))


class Tether(Effect):
    \"\"\"A damped spring to the origin and the forces of other textbook problems, so that one kernel serves them all.

    With m = 1 kg, x'' = -stiffness x - damping x' - sine sin x - sun x / |x|^3 + push cos 2t + weight.
    \"\"\"

    kind: Literal["users_tether"] = "users_tether"
    stiffness: float = Field(default=0.0, ge=0, description="N/m")
    damping: float = Field(default=0.0, ge=0, description="kg/s")
    sine: float = Field(default=0.0, ge=0, description="N, a pendulum along each axis")
    sun: float = Field(default=0.0, ge=0, description="N m^2")
    push: float = Field(default=0.0, description="N along each axis, with time")
    weight: float = Field(default=0.0, description="N along each axis")
    own_law: ClassVar[Law | None] = tether
"""
"""An effect as a user of the library would write it, in a separate file."""


@contextmanager
def users_module(folder: Path, text: str, name: str = "users_laws") -> Iterator[ModuleType]:
    """Import a module from outside the library; remove it and its effects afterwards."""
    (folder / f"{name}.py").write_text(text)
    sys.path.insert(0, str(folder))
    known = dict(EFFECT_KINDS)
    try:
        importlib.invalidate_caches()
        yield importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))
        sys.modules.pop(name, None)
        EFFECT_KINDS.clear()
        EFFECT_KINDS.update(known)
