"""Scene: a simulation as one frozen record, and its step.

scene = Scene(space=Torus(size=(40, 40)), groups=(Group(count=300, max_speed=2),), effects=(Separation(...), ...))
state = scene.start(seed=1)
state = scene.step(state)
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import operator
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, WrapValidator, model_validator

from flockenv.behaviours.steer import EVERY_EFFECT
from flockenv.core.magnitudes import check_numbers
from flockenv.core.record import Record, instance_of
from flockenv.engine import (
    KernelPlan,
    Table,
    flatten_effects,
    pack,
    scratch_bytes,
    worlds_of,
)
from flockenv.engine.implicit_step import coupling_of
from flockenv.engine.stepper import Stepper
from flockenv.geometry.barnes_hut import MOST_DIRECT
from flockenv.geometry.cell_list import FEWEST_AGENTS
from flockenv.geometry.shapes import AnyShape, Circle, HalfSpace, Shape, TriangleMesh
from flockenv.geometry.space import AnySpace, Box, Plane, Torus
from flockenv.maths.counter_rng import MASK, key_of
from flockenv.model import state as states
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.float_range import check_places
from flockenv.model.group import Group
from flockenv.model.networks import EDGE
from flockenv.model.snapshot import Snapshot
from flockenv.model.state import Body, Floats, State
from flockenv.physics.constraints import (
    CONSTRAINTS,
    BodyContacts,
    CollisionForces,
    Collisions,
    Constraint,
    FaceCollisions,
    PinForces,
    RigidBodies,
    RodForces,
    Rods,
)
from flockenv.physics.effects import EFFECTS, Effect
from flockenv.physics.effects.effect import all_masses
from flockenv.physics.integrators import INTEGRATORS, Adaptive, ImplicitEuler, Integrator, SemiImplicitEuler
from flockenv.physics.integrators.newton import Coupling
from flockenv.physics.population import POPULATION, Member, create_initial
from flockenv.physics.population.lifecycle import NUMBERS as POPULATION_NUMBERS
from flockenv.scene.placement import cells_of, place_groups
from flockenv.scene.stability import check_contact, check_dt, check_lookahead
from flockenv.scene.view import View

__all__ = ["Group", "Scene"]


EXACT = 2**24
"""Largest integer, and so number of agents, up to which float32 is exact."""

MEMORY_LIMIT = 8 * 2**30
"""Most bytes of a state and its scratch memory; a scene that needs more raises ValueError."""


if TYPE_CHECKING:
    AnyEffect = Effect
    AnyIntegrator = Integrator
    AnyConstraint = Constraint
    AnyMember = Member
else:
    AnyEffect = Annotated[
        Annotated[functools.reduce(operator.or_, EVERY_EFFECT), Field(discriminator="kind")],
        WrapValidator(instance_of(Effect)),
    ]
    """An effect of any kind, as a field of a record: read from a file, its `kind` selects the class."""
    AnyIntegrator = Annotated[
        Annotated[functools.reduce(operator.or_, INTEGRATORS.values()), Field(discriminator="kind")],
        WrapValidator(instance_of(Integrator)),
    ]
    """An integrator of any kind, as a field of a record: read from a file, its `kind` selects the class."""
    AnyConstraint = Annotated[
        Annotated[functools.reduce(operator.or_, CONSTRAINTS.values()), Field(discriminator="kind")],
        WrapValidator(instance_of(Constraint)),
    ]
    """A constraint of any kind, as a field of a record: read from a file, its `kind` selects the class."""
    AnyMember = Annotated[
        Annotated[functools.reduce(operator.or_, POPULATION.values()), Field(discriminator="kind")],
        WrapValidator(instance_of(Member)),
    ]
    """An emitter or sink of any kind, as a field of a record: read from a file, its `kind` selects the class."""


TURNING = ("max_turn_rate", "banking")
"""Numbers that bodies have only if some group sets them."""


def _check_integer(name: str, value: object, least: int, most: int | None = None) -> None:
    """Raise ValueError unless the value is an integer from `least` to `most`, and not a bool."""
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not is_integer or value < least or (most is not None and value > most):  # type: ignore[operator]  # is_integer
        allowed = f"from {least} to {most}" if most is not None else f">= {least}"
        raise ValueError(f"{name} is {value!r}, must be an integer {allowed}")


def _check_contiguous(out: State) -> None:
    """Raise ValueError if positions or velocities are not contiguous, as kernels need them."""
    for name, array in (("x", out.x), ("v", out.v)):
        if not array.flags.c_contiguous:
            raise ValueError(f"out.{name} is not contiguous (its strides are {array.strides}); use copy()")


class Scene(Record):
    """A simulation: agents, space, effects and integrator. Prints, compares, hashes, pickles, converts to YAML."""

    sentence: ClassVar[str] = "Time passes in steps of {dt}"

    dimension: Literal[2, 3] = Field(default=2, description="2 or 3")
    space: AnySpace = Field(default_factory=Plane)
    groups: tuple[Group, ...] = Field(min_length=1, description="groups of agents")
    effects: tuple[AnyEffect, ...] = Field(default=(), description="effects on agents; nothing else is computed")
    obstacles: tuple[AnyShape, ...] = Field(
        default=(), description="the same in every world; without a kind, with centre and radius, a circle"
    )
    integrator: AnyIntegrator = Field(default_factory=SemiImplicitEuler)
    constraints: tuple[AnyConstraint, ...] = Field(
        default=(), description="constraints enforced at the end of every step, in this order"
    )
    population: tuple[AnyMember, ...] = Field(
        default=(), description="deaths and births at the end of every step: sinks, in this order, and emitters"
    )
    dt: float = Field(default=0.02, gt=0, description="s, one physics step")
    dtype: Literal["float64", "float32"] = Field(default="float64", description="precision of all numbers")

    @model_validator(mode="after")
    def _check_fields(self) -> Scene:
        """Raise ValueError if fields do not fit each other: dimensions, reach on a torus, memory."""
        self._check_dimensions()
        check_places(self)
        if self.dtype == "float32":  # each record checks the bounds of float64 itself
            check_numbers(self, "float32")
        lists: dict[str, tuple[Effect | Constraint | Member, ...]] = {
            "effects": self.effects, "constraints": self.constraints, "population": self.population,
        }  # fmt: skip
        for name, members in lists.items():
            for k, member in enumerate(members):
                try:
                    member.check(self)
                except ValueError as error:
                    raise ValueError(f"{name}[{k}].{error}") from None
        self._check_inner_numbers()
        self._check_strain()
        self._check_space()
        if self.dtype == "float32":
            self._check_counts()
        needed = self.bytes_per_world()
        if needed > MEMORY_LIMIT:
            each = needed / self.agents
            raise ValueError(
                f"groups: {self.agents:,} agents need about {needed / 2**30:.3g} GiB; at most {MEMORY_LIMIT / 2**30:g} "
                f"GiB, {int(MEMORY_LIMIT / each):,} agents, are allowed"
            )
        self._cells  # noqa: B018  # raises ValueError for groups without room
        check_dt(self)
        check_contact(self)
        check_lookahead(self)
        return self

    def _check_inner_numbers(self) -> None:
        """Raise ValueError for laws and appearances that read inner numbers or strains which the scene lacks."""
        kept_numbers = {name for effect in self.effects for each in (*effect.components, effect) for name in each.keeps}
        for k, effect in enumerate(self.effects):
            for each in (*effect.components, effect):
                if missing := [name for name in each.required_inner if name not in kept_numbers]:
                    keepers = sorted(kind for kind, e in EFFECTS.items() if missing[0] in e.keeps)
                    raise ValueError(
                        f"effects[{k}].kind = {each.kind}: needs {missing[0]!r}, which no effect of this scene keeps; "
                        f"kinds that keep it: {', '.join(keepers) or 'none'}"
                    )
        for k, group in enumerate(self.groups):
            if group.appearance is not None and group.appearance.by == "strain" and group.network is None:
                raise ValueError(f"groups[{k}].appearance.by = strain: needs a network, whose edges are strained")
            if group.appearance is not None and group.appearance.of not in {None, *kept_numbers}:
                of = group.appearance.of
                raise ValueError(
                    f"groups[{k}].appearance.of = {of!r}: no effect of this scene keeps such an inner number"
                )

    def _check_strain(self) -> None:
        """Raise ValueError if a limit on strains would have no effect."""
        strain = getattr(self.integrator, "strain", 0)
        if strain > 0 and not any(effect.derivative and effect.strain_law for effect in self.effects):
            raise ValueError(
                f"integrator.strain = {strain:g}: limits nothing in this scene; needs a membrane or springs"
            )

    def _check_space(self) -> None:
        size = getattr(self.space, "size", None)
        if isinstance(self.space, Torus):
            for k, effect in enumerate(self.effects):
                if effect.far_law:
                    raise ValueError(
                        f"effects[{k}].kind = {effect.kind} reaches all agents, and on a torus each has infinitely "
                        "many images; only a plane or a box is allowed"
                    )
                if effect.reach > min(self.space.size) / 2:
                    raise ValueError(
                        f"effects[{k}].radius = {effect.reach:g} reaches around the torus; at most half its shortest "
                        f"edge, {min(self.space.size) / 2:g} m, is allowed"
                    )
        if isinstance(self.space, (Box, Torus)):
            for k, group in enumerate(self.groups):
                if 2 * group.widest > min(self.space.size):
                    raise ValueError(
                        f"groups[{k}].radius = {group.widest:g} does not fit into a {self.space.kind} of size {size}"
                    )

    def _check_counts(self) -> None:
        limit = f"float32 counts exactly up to {EXACT:,}; use dtype = float64"
        for key, count, what in (("groups", self.agents, "agents"), ("effects", self.parts.count, "numbers")):
            if count > EXACT:
                raise ValueError(f"{key}: {count:,} {what}: {limit}")

    def _check_dimensions(self) -> None:
        size = getattr(self.space, "size", None)
        if size is not None and len(size) != self.dimension:
            raise ValueError(f"space.size = {size} has {len(size)} edges, but dimension = {self.dimension}")
        for k, obstacle in enumerate(self.obstacles):
            if obstacle.dimension != self.dimension:
                where = f"centre = {obstacle.centre}" if isinstance(obstacle, Circle) else f"kind = {obstacle.kind}"
                raise ValueError(
                    f"obstacles[{k}].{where}: lies in {obstacle.dimension} dimensions, but dimension = {self.dimension}"
                )
            self._check_shape(k, obstacle)
        for k, group in enumerate(self.groups):
            if group.banking is not None and self.dimension == 2:
                raise ValueError(f"groups[{k}].banking = {group.banking:g}: needs dimension = 3")
            for name in ("low", "high", "heading"):
                value = getattr(group.spawn, name)
                if value is not None and len(value) != self.dimension:
                    raise ValueError(
                        f"groups[{k}].spawn.{name} = {value}: has {len(value)} numbers, "
                        f"but dimension = {self.dimension}"
                    )
            if group.network is not None:
                try:
                    group.network.rest_points(self.dimension)
                except ValueError as error:
                    raise ValueError(f"groups[{k}].network.{error}") from None
            elif size is None and group.spawn.low is None and self.living[k]:
                raise ValueError(f"groups[{k}].spawn.low: missing; a plane has no edges, so give low and high")

    def _check_shape(self, k: int, shape: Shape) -> None:
        """Raise ValueError if a shape reaches around a torus, or an agent touches a mesh from beyond its grid.

        On a torus only the nearest image of a shape is used.
        """
        widest = max(group.widest for group in self.groups)
        if isinstance(shape, TriangleMesh) and shape.grid_margin < widest:
            raise ValueError(
                f"obstacles[{k}].margin = {shape.grid_margin:g}: is less than the largest radius of agents, "
                f"{widest:g} m: give at least that, so that they touch the mesh where its grid is"
            )
        if not isinstance(self.space, Torus) or shape.in_state:
            return
        if isinstance(shape, HalfSpace):
            raise ValueError(
                f"obstacles[{k}].kind = {shape.kind}: on a torus a half-space has no inside; only a plane or a box "
                "is allowed"
            )
        edges = np.ptp(shape.extremes, axis=0)
        if (edges > np.array(self.space.size) / 2).any():
            raise ValueError(
                f"obstacles[{k}].kind = {shape.kind}: extends over {np.round(edges, 3).tolist()} m; at most half "
                f"of the torus, {(np.array(self.space.size) / 2).tolist()} m, is allowed"
            )

    # --- what follows from the fields -------------------------------------------------------------------------------

    @property
    def agents(self) -> int:
        """Number of agents, N."""
        return sum(group.size for group in self.groups)

    @property
    def starts(self) -> tuple[int, ...]:
        """Index of the first agent of each group, and N."""
        return (0, *itertools.accumulate(group.size for group in self.groups))

    @functools.cached_property
    def living(self) -> tuple[int, ...]:
        """Number of agents of each group that live at the start: its first ones."""
        fed_groups = (any(member.feeds(k) for member in self.population) for k in range(len(self.groups)))
        return tuple(
            group.alive if group.alive is not None else (0 if is_fed else group.size)
            for group, is_fed in zip(self.groups, fed_groups, strict=True)
        )

    @functools.cached_property
    def circles(self) -> tuple[Circle, ...]:
        """The fixed, solid, round obstacles: they are part of the state."""
        return tuple(shape for shape in self.obstacles if isinstance(shape, Circle) and shape.in_state)

    @functools.cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The other obstacles: the same in every world, a function of time."""
        return tuple(shape for shape in self.obstacles if not shape.in_state)

    @property
    def roles(self) -> tuple[str, ...]:
        """Role of each agent, (N,): groups of plain agents are "agent", "agent 2" to "agent 4", and again."""
        plain, names = 0, []
        for group in self.groups:
            number = plain % 4 + 1
            plain += group.role == "agent"
            names.append(f"agent {number}" if group.role == "agent" and number > 1 else group.role)
        return tuple(name for name, group in zip(names, self.groups, strict=True) for _ in range(group.size))

    def bytes_per_world(self) -> int:
        """Return the memory of one world's state and its scratch, in bytes, before anything is allocated."""
        real = 8 if self.dtype == "float64" else 4
        d, parts = self.dimension, self.parts
        reals, other_bytes = 2 * d + 5, 1  # positions, velocities, bodies; alive flags
        reals += parts.frame_rows + len(parts.inner)
        if self.constraints or self.population:
            reals += 4 * d + sum(constraint.numbers(self) for constraint in self.constraints)
        if self.population:
            other_bytes += 2 * 3 * 8 + 4 * POPULATION_NUMBERS  # identity, times, and their values before the step
        return self.agents * (reals * real + other_bytes) + scratch_bytes(parts, self.agents)

    @functools.cached_property
    def body(self) -> Body:
        """The bodies of all agents."""

        def per_agent(name: str) -> Floats:
            values = [math.inf if getattr(g, name) is None else getattr(g, name) for g in self.groups]
            return np.repeat(np.array(values, self.dtype), [g.size for g in self.groups])

        mass = all_masses(self.groups, self.dimension).astype(self.dtype)
        empty = np.zeros(0, self.dtype)
        turn_limits = (per_agent(name) if name in self.parts.frame_numbers else empty for name in TURNING)
        radius, fastest, pace = (
            np.concatenate([getattr(group, name) for group in self.groups]).astype(self.dtype)
            for name in ("radii", "max_speeds", "desired_speeds")
        )
        return Body(mass, radius, fastest, per_agent("max_force"), pace, *turn_limits)

    @functools.cached_property
    def parts(self) -> KernelPlan:
        """The kernel plan: all that the kernel is compiled from."""
        sorts = self.agents >= FEWEST_AGENTS
        crowded = self.agents > MOST_DIRECT
        effects = flatten_effects(self.effects)
        solid_walls = any(
            isinstance(each, RigidBodies) or (isinstance(each, Collisions) and each.obstacles)
            for each in self.constraints
        )
        space = Plane() if solid_walls and isinstance(self.space, Box) else self.space  # its walls are then obstacles
        return KernelPlan(
            self.dimension, space, effects, self.integrator, self.dtype, sorts, crowded=crowded,
            oriented=any(group.keeps_heading for group in self.groups),
            turns=any(group.max_turn_rate is not None for group in self.groups),
            leans=any(group.banking is not None for group in self.groups),
            starts=self.starts, shapes=self.shapes, circles=self.circles,
            touching=1.001 * self.contact_distance or 1e-300,
            tables=tuple(self.table_of(effect) for effect in effects if effect.tabled),
        )  # fmt: skip

    @property
    def contact_distance(self) -> float:
        """Sum of the two largest radii, m: agents farther apart do not touch."""
        return sum(sorted(group.widest for group in self.groups for _ in range(min(group.size, 2)))[-2:])

    def table_of(self, effect: Effect) -> NDArray[np.float64]:
        """Return the table that the laws of an effect look up; computed at the first call."""
        if effect not in self._tables:
            self._tables[effect] = effect.table(self)
        return self._tables[effect]

    @functools.cached_property
    def _tables(self) -> dict[Effect, NDArray[np.float64]]:
        return {}

    @functools.cached_property
    def table(self) -> Table:
        """The bonds of all effects, as the kernel reads them."""
        return pack(self.parts, self.agents, self.groups)

    @property
    def kept_bonds(self) -> int:
        """Number of springs whose present rest lengths are in State.bonds, S: 0 if none yields or breaks."""
        return len(self.table.kept) if self.parts.keeps_bonds else 0

    @functools.cached_property
    def edges(self) -> NDArray[np.int32]:
        """Pairs of agents along the edges of networks, (E, 2), for drawing."""
        found, first = [np.zeros((0, 2), np.int32)], 0
        for group in self.groups:
            if group.network is not None:
                springs = group.network.springs(self.dimension)
                found.append(first + np.stack([springs.i, springs.j], axis=1)[springs.role == EDGE])
            first += group.size
        return np.concatenate(found)

    @functools.cached_property
    def edge_springs(self) -> NDArray[np.int64]:
        """The springs of `edges`, (E,): their numbers among the springs of all networks, as State.bonds counts them."""
        roles = [g.network.springs(self.dimension).role for g in self.groups if g.network is not None]
        return np.flatnonzero(np.concatenate([np.zeros(0, np.int8), *roles]) == EDGE)

    @functools.cached_property
    def coupling(self) -> Coupling | None:
        """Sparsity of the accelerations, for implicit methods; None if it changes from step to step."""
        return coupling_of(self)

    @functools.cached_property
    def _cells(self) -> tuple[Floats | None, ...]:
        """Centres of the initial cells of each group with a cell per agent, (size, D) m; None for others."""
        return cells_of(self)

    @functools.cached_property
    def stepper(self) -> Stepper:
        """The kernels of this scene, and their scratch."""
        return Stepper(self)

    @functools.cached_property
    def view(self) -> View:
        """The scene as pictures show it."""
        return View(self)

    # --- running ----------------------------------------------------------------------------------------------------

    def start(self, seed: int, worlds: int = 1) -> State:
        """Return the initial state: world k is drawn from seed + k, independent of the batch.

        worlds: B >= 1.
        """
        _check_integer("seed", seed, 0, MASK)
        _check_integer("worlds", worlds, 1)
        if self.bytes_per_world() * worlds > MEMORY_LIMIT:
            need = self.bytes_per_world() * worlds / 2**30
            most = MEMORY_LIMIT / 2**30
            raise ValueError(f"worlds is {worlds}: needs about {need:.3g} GiB, at most {most:g} allowed")
        state = states.blank(
            worlds, self.agents, self.dimension, len(self.circles), self.dt, self.dtype, self.parts.frame_rows,
            population=bool(self.population), inner_rows=len(self.parts.inner),
            bonds=self.kept_bonds,
        )  # fmt: skip
        if self.kept_bonds:
            state.bonds[:] = self.table.kept
        state.key[:] = [key_of(seed + k, 0) for k in range(worlds)]
        for m, obstacle in enumerate(self.circles):
            state.obstacles.centre[:, m] = obstacle.centre
            state.obstacle_radius[:, m] = obstacle.radius
        place_groups(self, state, self._cells)
        create_initial(self, state)
        self.stepper.begin(state, np.ones_like(state.alive))
        for effect in self.effects:
            effect.check_start(self, state)
        return state

    def inner(self, state: State, name: str) -> Floats:
        """Return an inner number of every agent by name, as a view, (B, N); see `Effect.keeps`.

        state: of this scene.
        """
        if name not in self.parts.inner:
            raise ValueError(
                f"{name!r}: no effect of this scene keeps such an inner number; "
                f"they keep {self.parts.inner or 'nothing'}"
            )
        found: Floats = state.inner[self.parts.inner.index(name)]
        return found

    def step(self, state: State, drive: ArrayLike | None = None, out: State | None = None, steps: int = 1) -> State:
        """Advance every world by `steps` physics steps under a constant drive.

        drive: driving forces, (B, N, D) N, clipped to max_force together with steering effects; None: no drive.
        out: the state to write into (with `state` itself nothing is allocated); None: a new state.
        Raise SimulationDiverged, naming world, agent, step and effect, if a position or velocity is no longer finite;
        that world is left as it was, the others have made their steps.
        """
        self._check(state, steps)
        forces = self._drive(drive, state)
        if out is None:
            out = state.copy()
        else:
            _check_contiguous(out)
            if out is not state:
                out.copy_from(state)
        world, agent, reason = self.stepper.advance(out, forces, steps)
        if world >= 0:
            raise self._divergence_error(out, forces, world, agent, steps, reason)
        return out

    def _divergence_error(
        self, state: State, drive: Floats, world: int, agent: int, steps: int, reason: str
    ) -> SimulationDiverged:
        """Return the error for a world that could not make its steps; its last finite state is computed again."""
        single = state.worlds([world])
        single_drive = drive[:, world : world + 1].copy() if drive.shape[1] else drive
        done = 0
        while done < steps and (failure := self.stepper.advance(single, single_drive, 1))[0] < 0:
            done += 1
        agent = failure[1] if done < steps else agent
        last, effect = int(single.tick[0]) + 1, self._strongest_effect(single, agent)
        if isinstance(self.integrator, Adaptive):
            most, tolerance = self.integrator.most, self.integrator.tolerance
            reason = f"not finite, or not within tolerance = {tolerance:g} by {most:,} steps of its own"
        error = SimulationDiverged(world, agent, last, last * self.dt, effect, self.dt, self.integrator.kind, reason)
        error.state = state
        return error

    def _strongest_effect(self, state: State, agent: int) -> str | None:
        """Return the kind of the effect that accelerates an agent most, or by a value that is not finite.

        Positions and velocities are clipped: at very large ones an idle effect is not finite either (0 x infinity).
        """
        sizes: list[tuple[float, str]] = []
        most = float(np.finfo(self.dtype).max) ** 0.25
        clipped = dataclasses.replace(state, x=np.clip(state.x, -most, most), v=np.clip(state.v, -most, most))
        for k, effect in enumerate(self.effects):
            others = tuple(e if j == k else e.idle_copy() for j, e in enumerate(self.effects))
            # nothing is stepped: with a method without a limit no dt is warned of or rejected
            single = self.model_copy(update={"effects": others, "integrator": ImplicitEuler()})
            size = float(np.abs(single.acceleration(clipped)[0, agent]).max())
            sizes.append((size if math.isfinite(size) else math.inf, effect.kind))
        return max(sizes)[1] if sizes and max(sizes)[0] > 0 else None

    def acceleration(self, state: State, drive: ArrayLike | None = None) -> Floats:
        """Return the acceleration of every agent in this state, (B, N, D) m/s^2, without moving it.

        drive: (B, N, D) N, in addition to the effects (default: none).

        Drag is included, for any integrator; drives are bounded as in a step, speeds are not.
        """
        return self.rates(state, drive)[0]

    def rates(
        self, state: State, drive: ArrayLike | None = None, times: ArrayLike | None = None
    ) -> tuple[Floats, Floats | None]:
        """Return the acceleration, (B, N, D) m/s^2, and the velocity by which a medium carries agents, m/s, or None.

        drive: (B, N, D) N, in addition to the effects (default: none).

        times: of each world, (B,) s; None: those of the state.
        """
        return self._rates(state, drive, times)

    def _rates(
        self, state: State, drive: ArrayLike | None, times: ArrayLike | None, masses: Floats | None = None
    ) -> tuple[Floats, Floats | None]:
        """Return what `rates` does, if agents had other masses, (N,) kg."""
        self._check(state, 0)
        b, n, d = state.shape
        acc = np.empty((d, b, n), self.dtype)
        flow = np.empty((d, b, n) if self.parts.flows else (d, 0, 0), self.dtype)
        all_times = np.asarray(state.time if times is None else times, float)
        if all_times.shape not in ((), (b,)) or not np.isfinite(all_times).all():
            raise ValueError(f"times is {times!r}, must be a finite number for each of {b} worlds, or one for all")
        time, x = np.full(b, all_times, self.dtype), state.x
        if self.parts.confines:  # as at the start of a step; a given state may be outside the box
            with np.errstate(invalid="ignore"):  # an infinite position has no image, and is no neighbour
                x = np.ascontiguousarray(self.space.wrap(state.pos).transpose(2, 0, 1), self.dtype)
        self.stepper.accelerate(
            worlds_of(state)._replace(x=x), self._drive(drive, state), self.stepper.params(state), time, acc, flow,
            self.stepper.plain_scratch(masses),
        )  # fmt: skip
        return acc.transpose(1, 2, 0), flow.transpose(1, 2, 0) if self.parts.flows else None

    def _check(self, state: State, steps: int) -> None:
        """Raise ValueError if the state does not fit the scene: kernels trust the sizes of their arrays."""
        expected = (self.agents, self.dimension, np.dtype(self.dtype))
        if (*state.shape[1:], state.x.dtype) != expected:
            raise ValueError(
                f"the state holds (N, D) = {state.shape[1:]} of {state.x.dtype}, "
                f"but this scene has {expected[:2]} of {expected[2]}"
            )
        if len(state.frame) != self.parts.frame_rows:
            has, keeps = ("keeps" if rows else "keeps no" for rows in (len(state.frame), self.parts.frame_rows))
            raise ValueError(f"the state {has} headings, but this scene {keeps} headings")
        if len(state.inner) != len(self.parts.inner):
            keeps = ", ".join(self.parts.inner) or "nothing"
            raise ValueError(f"the state has {len(state.inner)} inner numbers, but effects of this scene keep {keeps}")
        if state.bonds.shape[1] != self.kept_bonds:
            raise ValueError(
                f"the state has rest lengths of {state.bonds.shape[1]} springs, but this scene keeps {self.kept_bonds}"
            )
        if state.identity.shape[1] != (self.agents if self.population else 0):
            has, keeps = ("identities" if k else "no identities" for k in (state.identity.size, self.population))
            raise ValueError(
                f"the state has {has}, but this scene has {keeps}: only scenes with a population have them"
            )
        if state.dt != self.dt:
            raise ValueError(
                f"the state counts steps of {state.dt:g} s, but this scene makes steps of {self.dt:g} s; "
                "state.with_dt(scene.dt) changes its clock"
            )
        _check_integer("steps", steps, 0)

    def run(self, state: State, steps: int) -> State:
        """Return the state after `steps` steps."""
        return self.step(state, steps=steps)

    def contacts(self, state: State, world: int = 0) -> BodyContacts:
        """Return the contacts of rigid bodies, with their forces, in the step of one world that begins at a state."""
        if not any(isinstance(each, RigidBodies) for each in self.constraints):
            raise ValueError("constraints: the scene has no rigid_bodies, which have contacts")
        self.step(state.worlds([world]))
        return self.stepper.body_contacts()

    def rod_forces(self, state: State, world: int = 0) -> RodForces:
        """Return the forces of rods and ropes in the step of one world that begins at a state."""
        if not any(isinstance(each, Rods) for each in self.constraints):
            raise ValueError("constraints: the scene has no rods, which have tensions")
        return self.stepper.rod_forces(lambda: self.step(state.worlds([world])))

    def collision_forces(self, state: State, world: int = 0) -> CollisionForces:
        """Return the forces of collisions on agents in the step of one world that begins at a state."""
        if not any(isinstance(each, Collisions | FaceCollisions) for each in self.constraints):
            raise ValueError("constraints: the scene has neither collisions nor face_collisions")
        return self.stepper.collision_forces(lambda: self.step(state.worlds([world])))

    def pin_forces(self, state: State, world: int = 0) -> PinForces:
        """Return the forces that hold pinned particles of networks, and those of `moves`, in one world at a state.

        They balance the effects at the state, weight included, and the rods in the step that begins at it. Effects see
        a particle's own mass, which changes the damping of `contact` with it. Collisions are not included.
        """
        pins = np.flatnonzero(np.isinf(self.body.mass))
        if not len(pins):
            raise ValueError("groups: no network has pinned particles or moves")
        mass = np.concatenate([group.own_masses(self.dimension) for group in self.groups]).astype(self.dtype)
        acc, _ = self._rates(state.worlds([world]), None, None, mass)
        force = -mass[:, None] * acc[0]
        if any(isinstance(each, Rods) for each in self.constraints):
            rods = self.rod_forces(state, world)
            np.subtract.at(force, rods.first, rods.force)
            np.add.at(force, rods.second, rods.force)
        return PinForces(pins, force[pins])

    def _drive(self, drive: ArrayLike | None, state: State) -> Floats:
        if drive is None:
            return np.zeros((self.dimension, 0, 0), self.dtype)
        forces = np.asarray(drive, self.dtype)
        if forces.shape != state.shape:
            raise ValueError(f"drive has shape {forces.shape}, but the state has (B, N, D) = {state.shape}")
        if not np.isfinite(forces).all():
            world, agent, axis = (int(k) for k in np.argwhere(~np.isfinite(forces))[0])
            number = forces[world, agent, axis]
            raise ValueError(f"drive of world {world}, agent {agent}, axis {axis} is {number}, must be finite")
        return np.ascontiguousarray(forces.transpose(2, 0, 1))

    # --- looking at it ----------------------------------------------------------------------------------------------

    def snapshot(self, state: State, world: int = 0, title: str = "") -> Snapshot:
        """Return one world at one instant, for pictures.

        state: of this scene; world: its index; title: text above the picture.
        """
        return self.view.snapshot(state, world, title)

    def with_effects(self, *effects: Effect) -> Scene:
        """Return the same scene with other effects."""
        return self.model_copy(update={"effects": effects})
