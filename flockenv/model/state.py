"""State and Body: every array of a simulation, its shape and its unit, written here once.

B worlds, N agents, D = 2 or 3 dimensions, M obstacles. Memory is one contiguous array per coordinate, (D, B, N);
people see (B, N, D) through a transposed view that costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.core.magnitudes import check_array
from flockenv.jit.memory import zeros
from flockenv.jit.section import entry
from flockenv.maths.heading import face

__all__ = ["COUNTED_BY_KERNELS", "WORK", "Body", "Floats", "Obstacles", "State"]

Floats = NDArray[np.floating[Any]]

WORK = (
    "evaluations", "neighbour_queries", "pairs", "obstacle_tests", "substeps", "rejected_steps", "newton_iterations",
    "linear_iterations", "impacts", "unsolved", "stopped", "births", "deaths", "births_refused",
)  # fmt: skip
"""What is counted in State.work: force evaluations, neighbour queries, candidate pairs met, agent-obstacle tests; and,
by methods that choose their own steps, those accepted and rejected; by methods that solve, their iterations; by
collisions, impacts, those that were cut short or left unsolved, and bodies that stopped within a step; of a population,
births, deaths, and births for which there was no free slot."""

COUNTED_BY_KERNELS = 8
"""How many of these the kernel of a scene counts: the first."""


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Round obstacles of every world, as views: they may differ from world to world, and stand still.

    Circles that move or are hollow are not among them: with the other shapes they are the scene's, `Scene.shapes`.
    """

    centre: Floats  # (B, M, D) m
    radius: Floats  # (B, M) m; 0 = no obstacle in this slot


@dataclass(frozen=True, eq=False)
class Body:
    """What does not change about agents, the same in every world."""

    mass: Floats  # (N,) kg
    radius: Floats  # (N,) m
    max_speed: Floats  # (N,) m/s, may be inf
    max_force: Floats  # (N,) N, bounds what an agent asks for (drive and steering), not what acts on it; may be inf
    desired_speed: Floats  # (N,) m/s, how fast it would like to go; 0 if nobody says
    max_turn_rate: Floats  # (N,) rad/s, may be inf; (0,) if nobody has a limit
    banking: Floats  # (N,) s, in which it leans into its turns; inf = it does not, (0,) if nobody does

    def astype(self, dtype: Any) -> Body:
        """Return the same bodies in another precision."""
        return Body(*(np.ascontiguousarray(a, dtype) for a in self.arrays()))

    def arrays(self) -> tuple[Floats, ...]:
        """Return the arrays."""
        return tuple(getattr(self, each.name) for each in fields(self))


@dataclass(frozen=True, eq=False)
class State:
    """What changes: where everybody is, how fast, who is alive, and how many steps have passed.

    The obstacles are here because a random field differs from world to world and from episode to episode.
    """

    x: Floats  # (D, B, N) m, positions, per coordinate
    v: Floats  # (D, B, N) m/s, velocities, per coordinate
    alive: NDArray[np.bool_]  # (B, N)
    tick: NDArray[np.int64]  # (B,) physics steps since the start
    key: NDArray[np.uint64]  # (B,) the world's random key, see noise.py
    obstacle_x: Floats  # (D, B, M) m
    obstacle_radius: Floats  # (B, M) m
    work: NDArray[np.int64]  # (B, len(WORK)) counters, see WORK
    frame: Floats  # (F, B, N) unit vectors: where everybody faces, in space which way is up; F = 0 if nobody keeps that
    inner: Floats  # (K, B, N) what goes on inside everybody: the numbers that effects keep, see Scene.inner
    identity: NDArray[np.int64]  # (B, N) who is in this slot, or was last, -1 = nobody; (B, 0) without a population
    born: NDArray[np.float64]  # (B, N) s, since when; (B, 0) without a population
    dies: NDArray[np.float64]  # (B, N) s, when its own lifetime ends, inf = never; (B, 0) without a population
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
    def carried(self) -> tuple[Floats, ...]:
        """Frames and inner states, if this state has some: what kernels are given of it."""
        return tuple(array for array in (self.frame, self.inner) if len(array))

    @property
    def heading(self) -> Floats:
        """Where everybody faces, unit vectors (B, N, D): a view if headings are kept.

        If not, along the velocity, and 0 at standstill.
        """
        if len(self.frame):
            return self.frame[: len(self.x)].transpose(1, 2, 0)
        speed = np.sqrt((self.vel**2).sum(axis=-1, keepdims=True))
        return np.asarray(np.divide(self.vel, speed, out=np.zeros_like(self.vel), where=speed > 0))

    @property
    def up(self) -> Floats:
        """Which way is up for everybody, unit vectors across the heading as a view, (B, N, 3); none in the plane."""
        if not len(self.frame) or len(self.x) == 2:
            raise ValueError("up: only states of scenes in 3-D have it in which a group is oriented")
        return self.frame[3:].transpose(1, 2, 0)

    @property
    def time(self) -> NDArray[np.float64]:
        """Time of each world, (B,) s: a whole number of steps times dt, so that it never drifts."""
        return np.asarray(self.tick * self.dt, np.float64)

    @property
    def age(self) -> NDArray[np.float64]:
        """How long everybody has lived, (B, N) s, of the living; all as old as the world without a population."""
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

    def counted(self, what: str) -> int:
        """Return one work counter summed over the worlds; `what` is a name in WORK."""
        return int(self.work[:, WORK.index(what)].sum())

    def copy(self) -> State:
        """Return a state that shares no memory with this one."""
        return replace(self, **{name: getattr(self, name).copy() for name in _ARRAYS})

    def copy_from(self, other: State) -> None:
        """Overwrite the arrays of this state with another's; refuses one of another shape or precision."""
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
        """Overwrite some worlds, (B,), with the same of another state of this shape."""
        for name in _ARRAYS:
            at = (slice(None), rows) if name in _PER_COORDINATE else rows
            getattr(self, name)[at] = getattr(other, name)[at]

    def with_motion(self, pos: ArrayLike, vel: ArrayLike) -> State:
        """Return a copy with other positions and velocities, each (B, N, D); refuses other shapes, and NaN.

        So it does numbers that are too large to be squared (flockenv.core.magnitudes).

        Where headings are kept, who moves faces along his new velocity.
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
        """Where headings are kept, let everybody face along his velocity, or as before if there is none."""
        for b in range(self.shape[0] if len(self.frame) else 0):
            entry(face)(self.v, self.frame, b, False)

    def with_dt(self, dt: float) -> State:
        """Return a copy whose clock counts steps of another length, s; refuses one that does not divide its time."""
        if not (dt > 0 and np.isfinite(dt)):
            raise ValueError(f"dt is {dt}, must be a positive number of seconds")
        ticks = self.time / dt
        whole = np.round(ticks)
        if (np.abs(ticks - whole) > 1e-9 * np.maximum(whole, 1)).any():
            world = int(np.argmax(np.abs(ticks - whole)))
            raise ValueError(f"dt is {dt:g} s: the time of world {world}, {self.time[world]:g} s, is no multiple of it")
        return replace(self.copy(), tick=whole.astype(np.int64), dt=float(dt))

    def worlds(self, rows: Sequence[int] | slice) -> State:
        """Return a copy of some of the worlds."""
        rows = rows if isinstance(rows, slice) else list(rows)
        arrays: dict[str, Any] = {
            name: np.ascontiguousarray(
                getattr(self, name)[:, rows] if name in _PER_COORDINATE else getattr(self, name)[rows]
            ).copy()
            for name in _ARRAYS
        }
        return replace(self, **arrays)


_PER_COORDINATE = ("x", "v", "obstacle_x", "frame", "inner")
_ARRAYS = (
    "x", "v", "alive", "tick", "key", "obstacle_x", "obstacle_radius", "work", "frame", "inner", "identity", "born",
    "dies",
)  # fmt: skip


def blank(
    worlds: int, agents: int, dimension: int, obstacles: int, dt: float, dtype: Any = np.float64, frame_rows: int = 0,
    population: bool = False, inner_rows: int = 0,
) -> State:  # fmt: skip
    """Return a state of zeros, everybody alive: what a spawn writes into; identities are numbers of slots, if kept."""
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
        dt=dt,
    )
