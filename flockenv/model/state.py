"""State and Body: every array of a simulation, with its shape and unit.

B worlds, N agents, D = 2 or 3 dimensions, M obstacles. Memory is one contiguous array per coordinate, (D, B, N);
users see (B, N, D) through transposed views, without a copy.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.core.magnitudes import check_array
from flockenv.jit.memory import zeros
from flockenv.jit.section import entry
from flockenv.maths.heading import face

__all__ = ["COUNTED_BY_KERNELS", "WORK", "Body", "Floats", "Obstacles", "State", "digest_arrays"]

Floats = NDArray[np.floating[Any]]
"""An array of floats of the scene's dtype."""

WORK = (
    "evaluations", "neighbour_queries", "pairs", "obstacle_tests", "substeps", "rejected_steps", "newton_iterations",
    "linear_iterations", "impacts", "unsolved", "stopped", "births", "deaths", "births_refused",
    "face_passes", "impact_zones", "largest_zone",
)  # fmt: skip
"""Counters in State.work: force evaluations, neighbour queries, candidate pairs tested, agent-obstacle tests; of
adaptive and linearly implicit methods, steps accepted and rejected; of implicit methods, iterations; of collisions,
impacts, cut or unsolved ones, and bodies that stopped within a step; of a population, births, deaths, and births
without a free slot; of faces, passes over impacts and over zones, impact zones, and the number of particles of the
largest."""

COUNTED_BY_KERNELS = 8
"""Number of these counters, the first ones, that the kernel of a scene updates."""


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Round obstacles of every world, as views; they may differ between worlds, and do not move.

    Circles that move or are hollow are not among them; like all other shapes they are in `Scene.shapes`.
    """

    centre: Floats  # (B, M, D) m
    radius: Floats  # (B, M) m; 0 = no obstacle in this slot


@dataclass(frozen=True, eq=False)
class Body:
    """Constant properties of agents, the same in every world."""

    mass: Floats  # (N,) kg
    radius: Floats  # (N,) m
    max_speed: Floats  # (N,) m/s, may be inf
    max_force: Floats  # (N,) N, limit of driving and steering forces only, not of other forces; may be inf
    desired_speed: Floats  # (N,) m/s, target speed of the driving force; 0 if not given
    max_turn_rate: Floats  # (N,) rad/s, may be inf; (0,) if no agent has a limit
    banking: Floats  # (N,) s, time constant of banking; inf: no banking; (0,) if no agent banks

    def astype(self, dtype: Any) -> Body:
        """Return the same bodies in another precision.

        dtype: `float32` or `float64`.
        """
        return Body(*(np.ascontiguousarray(a, dtype) for a in self.arrays()))

    def arrays(self) -> tuple[Floats, ...]:
        """Return all arrays, in the order of the fields."""
        return tuple(getattr(self, each.name) for each in fields(self))


@dataclass(frozen=True, eq=False)
class State:
    """The variables of a simulation: positions, velocities, living agents, number of steps, and more.

    Round obstacles are included because random ones differ between worlds and between episodes.
    """

    x: Floats  # (D, B, N) m, positions, per coordinate
    v: Floats  # (D, B, N) m/s, velocities, per coordinate
    alive: NDArray[np.bool_]  # (B, N)
    tick: NDArray[np.int64]  # (B,) physics steps since the start
    key: NDArray[np.uint64]  # (B,) the world's RNG key, see counter_rng.py
    obstacle_x: Floats  # (D, B, M) m
    obstacle_radius: Floats  # (B, M) m
    work: NDArray[np.int64]  # (B, len(WORK)) counters, see WORK
    frame: Floats  # (F, B, N) unit vectors: heading and, in 3-D, up; F = 0 if no group keeps them
    inner: Floats  # (K, B, N) inner states of agents, kept by effects, see Scene.inner
    identity: NDArray[np.int64]  # (B, N) agent in this slot, or the last one, -1 if none; (B, 0) without a population
    born: NDArray[np.float64]  # (B, N) s, time of birth; (B, 0) without a population
    dies: NDArray[np.float64]  # (B, N) s, when its lifetime ends, inf if never; (B, 0) without a population
    bonds: Floats  # (B, S) a number per spring of networks, see Effect.bond_keep_law; (B, 0) if none is kept
    dt: float  # s, one physics step: time = tick dt

    @property
    def pos(self) -> Floats:
        """Positions as a view, (B, N, D) m."""
        return self.x.transpose(1, 2, 0)

    @property
    def vel(self) -> Floats:
        """Velocities as a view, (B, N, D) m/s."""
        return self.v.transpose(1, 2, 0)

    @property
    def frame_and_inner(self) -> tuple[Floats, ...]:
        """Heading frames, inner states and numbers of bonds as passed to kernels, without empty ones."""
        kept = tuple(array for array in (self.frame, self.inner) if len(array))
        return (*kept, self.bonds) if self.bonds.shape[1] else kept

    @property
    def heading(self) -> Floats:
        """Headings, unit vectors (B, N, D): a view if they are kept.

        Otherwise they are the directions of velocities, 0 at standstill.
        """
        if len(self.frame):
            return self.frame[: len(self.x)].transpose(1, 2, 0)
        speed = np.sqrt((self.vel**2).sum(axis=-1, keepdims=True))
        return np.asarray(np.divide(self.vel, speed, out=np.zeros_like(self.vel), where=speed > 0))

    @property
    def up(self) -> Floats:
        """Up vectors, unit vectors perpendicular to the headings, a view (B, N, 3); ValueError if not kept."""
        if not len(self.frame) or len(self.x) == 2:
            raise ValueError("up: only scenes in 3-D with an oriented group have up vectors")
        return self.frame[3:].transpose(1, 2, 0)

    @property
    def time(self) -> NDArray[np.float64]:
        """Time of each world, (B,) s: number of steps times dt, without accumulated rounding."""
        return np.asarray(self.tick * self.dt, np.float64)

    @property
    def age(self) -> NDArray[np.float64]:
        """Age of living agents, (B, N) s; the world's time for all agents without a population."""
        born = self.born if self.born.shape[1] else 0.0
        return np.asarray(np.broadcast_to(self.time[:, None], self.alive.shape) - born, np.float64)

    @property
    def obstacles(self) -> Obstacles:
        """The obstacles as views."""
        return Obstacles(self.obstacle_x.transpose(1, 2, 0), self.obstacle_radius)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, N, D)."""
        d, b, n = self.x.shape
        return b, n, d

    def count_of(self, what: str) -> int:
        """Return a work counter, summed over the worlds (of sizes the largest); what: its name in WORK."""
        counts = self.work[:, WORK.index(what)]
        return int(counts.max() if what == "largest_zone" else counts.sum())

    @property
    def digest(self) -> str:
        """A digest of all that determines later states: every array but the work counters, and dt.

        Equal states have equal digests, in every process.
        """
        names = [name for name in _ARRAYS if name != "work" and (name != "bonds" or self.bonds.shape[1])]
        return digest_arrays({name: getattr(self, name) for name in names} | {"dt": self.dt})

    def copy(self) -> State:
        """Return a state that shares no memory with this one."""
        return replace(self, **{name: getattr(self, name).copy() for name in _ARRAYS})

    def copy_from(self, other: State) -> None:
        """Overwrite the arrays of this state with another's; raise ValueError if shape or precision differ.

        other: of the same shape and precision.
        """
        for name in _ARRAYS:
            mine, theirs = getattr(self, name), getattr(other, name)
            if (mine.shape, mine.dtype) != (theirs.shape, theirs.dtype):
                raise ValueError(
                    f"a state whose {name} is {theirs.shape} of {theirs.dtype} does not fit into one whose {name} is "
                    f"{mine.shape} of {mine.dtype}"
                )
        for name in _ARRAYS:
            getattr(self, name)[...] = getattr(other, name)

    def put(self, rows: NDArray[np.bool_], other: State) -> None:
        """Overwrite the worlds selected by `rows`, (B,), with those of another state of the same shape.

        other: B worlds, as this one.
        """
        for name in _ARRAYS:
            at = (slice(None), rows) if name in _PER_COORDINATE else rows
            getattr(self, name)[at] = getattr(other, name)[at]

    def with_motion(self, pos: ArrayLike, vel: ArrayLike) -> State:
        """Return a copy with other positions and velocities, each (B, N, D).

        pos: m; vel: m/s.

        If headings are kept, moving agents face along their new velocity. Raises ValueError on other shapes, NaN, and
        numbers too large to be squared (flockenv.core.magnitudes).
        """
        new = self.copy()
        for name, given, target in (("pos", pos, new.pos), ("vel", vel, new.vel)):
            array = np.asarray(given, float)
            if array.shape != self.shape:
                raise ValueError(f"{name} has shape {array.shape}, but the state has (B, N, D) = {self.shape}")
            check_array(name, array, target.dtype.name)
            target[...] = array
        new.face()
        return new

    def face(self) -> None:
        """Turn the headings, if kept, into the directions of velocities; at standstill a heading stays."""
        for b in range(self.shape[0] if len(self.frame) else 0):
            entry(face)(self.v, self.frame, b, False)

    def with_dt(self, dt: float) -> State:
        """Return a copy with another step length, s; raise ValueError unless each world's time is a multiple of it.

        dt: > 0.
        """
        if not (dt > 0 and np.isfinite(dt)):
            raise ValueError(f"dt is {dt}, must be a positive number of seconds")
        ticks = self.time / dt
        whole = np.round(ticks)
        if (np.abs(ticks - whole) > 1e-9 * np.maximum(whole, 1)).any():
            world = int(np.argmax(np.abs(ticks - whole)))
            raise ValueError(f"dt is {dt:g} s: the time of world {world}, {self.time[world]:g} s, is no multiple of it")
        return replace(self.copy(), tick=whole.astype(np.int64), dt=float(dt))

    def worlds(self, rows: Sequence[int] | slice) -> State:
        """Return a copy of some of the worlds.

        rows: their indices.
        """
        rows = rows if isinstance(rows, slice) else list(rows)
        arrays: dict[str, Any] = {
            name: np.ascontiguousarray(
                getattr(self, name)[:, rows] if name in _PER_COORDINATE else getattr(self, name)[rows]
            ).copy()
            for name in _ARRAYS
        }
        return replace(self, **arrays)


def digest_arrays(arrays: Mapping[str, Any]) -> str:
    """Return a digest of named arrays or numbers: of their names, types, shapes and bytes, 32 hexadecimal digits."""
    found = hashlib.sha256()
    for name, value in sorted(arrays.items()):
        array = np.ascontiguousarray(value)
        found.update(f"{name} {array.dtype} {array.shape} ".encode() + array.tobytes())
    return found.hexdigest()[:32]


_PER_COORDINATE = ("x", "v", "obstacle_x", "frame", "inner")
_ARRAYS = (
    "x", "v", "alive", "tick", "key", "obstacle_x", "obstacle_radius", "work", "frame", "inner", "identity", "born",
    "dies", "bonds",
)  # fmt: skip


def blank(
    worlds: int, agents: int, dimension: int, obstacles: int, dt: float, dtype: Any = np.float64, frame_rows: int = 0,
    population: bool = False, inner_rows: int = 0, bonds: int = 0,
) -> State:  # fmt: skip
    """Return a state of zeros with all agents alive, whose identities, if kept, are slot numbers."""
    slots = agents if population else 0
    return State(
        x=zeros((dimension, worlds, agents), dtype),
        v=zeros((dimension, worlds, agents), dtype),
        alive=np.ones((worlds, agents), np.bool_),
        tick=np.zeros(worlds, np.int64),
        key=np.zeros(worlds, np.uint64),
        obstacle_x=zeros((dimension, worlds, obstacles), dtype),
        obstacle_radius=zeros((worlds, obstacles), dtype),
        work=np.zeros((worlds, len(WORK)), np.int64),
        frame=zeros((frame_rows, worlds, agents), dtype),
        inner=zeros((inner_rows, worlds, agents), dtype),
        identity=np.tile(np.arange(slots), (worlds, 1)),
        born=np.zeros((worlds, slots)),
        dies=np.full((worlds, slots), np.inf),
        bonds=zeros((worlds, bonds), dtype),
        dt=dt,
    )
