"""Snapshot: one world at one instant, as plain arrays; the whole input of a picture, a GIF or a replay."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.model.appearance import Appearance
from flockenv.model.surface import whole_faces

__all__ = ["KINDS", "ROLES", "Mark", "Snapshot"]

Floats = NDArray[np.float64]

ROLES: Final = (
    "pursuer", "evader", "learner", "learner 2", "flockmate", "agent", "agent 2", "agent 3", "agent 4"
)  # fmt: skip
"""Roles of agents in pictures; each has a colour."""

KINDS: Final = ("goal", "heading", "way")
"""Kinds of marks, see `Mark`."""


@dataclass(frozen=True, eq=False)
class Mark:
    """A mark in a picture that is not a body: a goal, a desired heading, a piece of a path.

    kind: "goal" (a disc of `radius` around `at`; `vector` is not read) or "heading" (an arrow that starts at `at` and
    points along `vector`; only its direction counts, and a zero vector draws nothing; `radius` is not read) or "way" (a
    pale disc of `radius`: many of them that overlap are a track; `vector` is not read).
    at, vector: (D,) with D = 2 or 3, at in m. radius: m, >= 0. Arrays are copied and read-only.
    Raises ValueError or TypeError, in one line, on an unknown kind, a wrong shape or a number that is not finite.
    """

    kind: str
    at: Floats
    vector: Floats
    radius: float

    def __post_init__(self) -> None:
        _check_name("Mark.kind", self.kind, KINDS)
        at = _array("Mark.at", self.at, (None,))
        _dimension("Mark.at", len(at))
        radius = float(_array("Mark.radius", self.radius, ()))
        _require(radius >= 0.0, "Mark.radius", "must be >= 0 m", radius)
        _fix(self, at=at, vector=_array("Mark.vector", self.vector, at.shape), radius=radius)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One world at one instant.

    time: s. pos (N, D): m. vel (N, D): m/s. alive (N,): bool. radius (N,): m. roles: N names out of ROLES.
    obstacle_centre (M, D), obstacle_radius (M,): m. marks: goals and headings. low, high (D,): the region to show, m.
    periodic: True if the region is periodic. title: one line. D = 2 or 3; N and M may be 0.
    outlines: polygons (n, 2), m, of obstacles that are not round, as seen from above.
    bonds (E, 2): int, pairs of agents joined by a line, the shortest one; none by default.
    broken (E,): True for bonds that are broken, which are not drawn; none by default.
    faces (F, 3): int, triangles of agents, which are drawn in place of their bonds; none by default. covered (N,): True
    for agents that are drawn as such a surface only; default: the corners of faces.
    heading (N, D): directions that agents face; default: those of the velocities.
    looks: appearances; look (N,): the index of each agent's own, -1 = none. age (N,): s, of the living; default: the
    time. identity (N,): int, the agent in each row; default: the same agents at all times.
    box (4, 3): of a world that was turned, a corner of its region and the three next to it along its axes, m.
    shown (N,): the strain or inner state of each agent that its look shows; none by default.
    Arrays are private copies and read-only. Positions and velocities may hold NaN or inf: such bodies of a run that
    diverged are not drawn.
    Raises ValueError or TypeError, in one line that names the field, for other values.
    """

    time: float
    pos: Floats
    vel: Floats
    alive: NDArray[np.bool_]
    radius: Floats
    roles: tuple[str, ...]
    obstacle_centre: Floats
    obstacle_radius: Floats
    marks: tuple[Mark, ...]
    low: Floats
    high: Floats
    periodic: bool
    title: str
    bonds: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    outlines: tuple[Floats, ...] = ()
    heading: Floats | None = None
    looks: tuple[Appearance, ...] = ()
    look: NDArray[np.int32] | None = None
    age: Floats | None = None
    identity: NDArray[np.int64] | None = None
    shown: Floats | None = None
    broken: NDArray[np.bool_] | None = None
    faces: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    box: Floats | None = None
    covered: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        pos = _array("Snapshot.pos", self.pos, (None, None), finite=False)
        agents, dimension = pos.shape
        _dimension("Snapshot.pos", dimension)
        obstacle_centre = _array("Snapshot.obstacle_centre", self.obstacle_centre, (None, dimension))
        _fix(
            self,
            time=float(_array("Snapshot.time", self.time, ())),
            pos=pos,
            vel=_array("Snapshot.vel", self.vel, (agents, dimension), finite=False),
            alive=_switches("Snapshot.alive", self.alive, agents),
            radius=_lengths("Snapshot.radius", self.radius, agents),
            roles=_names("Snapshot.roles", self.roles, agents),
            obstacle_centre=obstacle_centre,
            obstacle_radius=_lengths("Snapshot.obstacle_radius", self.obstacle_radius, len(obstacle_centre)),
            marks=_marks(self.marks, dimension),
            low=_array("Snapshot.low", self.low, (dimension,)),
            high=_array("Snapshot.high", self.high, (dimension,)),
            periodic=bool(self.periodic),
            heading=None if self.heading is None else _array("Snapshot.heading", self.heading, (agents, dimension)),
            bonds=_agents("Snapshot.bonds", self.bonds, 2, agents),
            outlines=tuple(_array("Snapshot.outlines", polygon, (None, 2)) for polygon in self.outlines),
            looks=tuple(self.looks),
            look=_integers("Snapshot.look", np.full(agents, -1) if self.look is None else self.look, agents),
            age=None if self.age is None else _array("Snapshot.age", self.age, (agents,)),
            identity=None if self.identity is None else _integers("Snapshot.identity", self.identity, agents),
            shown=None if self.shown is None else _array("Snapshot.shown", self.shown, (agents,)),
            broken=None if self.broken is None else _switches("Snapshot.broken", self.broken, len(self.bonds)),
            faces=_agents("Snapshot.faces", self.faces, 3, agents),
            covered=_switches("Snapshot.covered", self._corners if self.covered is None else self.covered, agents),
            box=None if self.box is None else _array("Snapshot.box", self.box, (4, 3)),
        )
        if self.look is not None and not (self.look < len(self.looks)).all():
            raise ValueError(f"Snapshot.look: must be below {len(self.looks)}, the number of looks")
        if not isinstance(self.title, str):
            raise TypeError(f"Snapshot.title: must be a str, got {type(self.title).__name__}")
        if not (self.low < self.high).all():
            raise ValueError(f"Snapshot.low: must be below high on every axis, got {self.low} and {self.high}")

    @property
    def agents(self) -> int:
        """Number of rows N, alive or not."""
        return len(self.pos)

    @property
    def dimension(self) -> int:
        """Dimension D, 2 or 3."""
        return int(self.pos.shape[1])

    @property
    def _corners(self) -> NDArray[np.bool_]:
        corner = np.zeros(self.agents, np.bool_)
        corner[_agents("Snapshot.faces", self.faces, 3, self.agents)] = True
        return corner

    @property
    def aim(self) -> Floats:
        """The direction in which each agent points, (N, D), of any length; zero if unknown."""
        return self.vel if self.heading is None else self.heading

    @property
    def shade(self) -> Floats:
        """The position of each agent's value in the range of its look, (N,) from 0 to 1; 0 without a look."""
        age = np.full(self.agents, self.time) if self.age is None else self.age
        return shades_of(self.looks, self.look, age, self.vel, self.shown)

    def is_same(self, other: Snapshot) -> NDArray[np.bool_]:
        """True for rows that hold the same agent in another snapshot, (N,) bool.

        other: of the same world.
        """
        if self.identity is None or other.identity is None:
            return np.ones(self.agents, np.bool_)
        return np.asarray(self.identity == other.identity)

    @property
    def whole_bonds(self) -> NDArray[np.int32]:
        """The bonds that are not broken, (E', 2)."""
        return self.bonds if self.broken is None else self.bonds[~self.broken]

    @property
    def whole_faces(self) -> NDArray[np.int32]:
        """The faces with no broken bond, (F', 3)."""
        return self.faces if self.broken is None else whole_faces(self.faces, self.bonds[self.broken])

    @property
    def has_bonds(self) -> NDArray[np.bool_]:
        """True for agents with bonds, (N,) bool: particles of a network, which are drawn as dots."""
        tied = np.zeros(self.agents, np.bool_)
        tied[self.bonds] = True
        return tied

    @property
    def visible(self) -> NDArray[np.bool_]:
        """True for bodies that can be drawn, at finite positions, (N,) bool."""
        return np.asarray(np.isfinite(self.pos).all(axis=1) & np.isfinite(self.vel).all(axis=1))


def shades_of(
    looks: Sequence[Appearance], look: NDArray[np.int32] | None, age: Floats, vel: Floats, shown: Floats | None
) -> Floats:
    """Return the position of each agent's value in the range of its look, (N,) from 0 to 1; 0 without a look.

    look (N,): index of the look of each agent; age (N,) s; vel (N, D) m/s; shown (N,): strain or inner state.
    """
    shade = np.zeros(len(vel))
    with np.errstate(over="ignore", invalid="ignore"):
        speed = np.linalg.norm(vel, axis=1)
    for k, each in enumerate(looks):
        mine = look == k
        shade[mine] = each.shade(age[mine], speed[mine], None if shown is None else shown[mine])
    return shade


def _fix(record: Mark | Snapshot, **fields: object) -> None:
    for name, value in fields.items():
        object.__setattr__(record, name, value)


def _require(good: bool | np.bool_, field: str, rule: str, value: object) -> None:
    if not good:
        raise ValueError(f"{field}: {rule}, got {value}")


def _check_name(field: str, name: object, names: tuple[str, ...]) -> None:
    if name in names:
        return
    near = get_close_matches(str(name), names, n=1)
    raise ValueError(
        f"{field}: unknown {name!r}; one of {', '.join(names)}" + (f" (did you mean {near[0]!r}?)" if near else "")
    )


def _dimension(field: str, dimension: int) -> None:
    _require(dimension in (2, 3), field, "must have 2 or 3 coordinates", dimension)


def _array(field: str, value: ArrayLike, shape: tuple[int | None, ...], *, finite: bool = True) -> Floats:
    """Return a read-only float64 copy of `value`; None in `shape` stands for any length."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{field}: must be numbers, got {type(value).__name__} ({error})") from None
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
    wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
    _require(fits, field, f"must have shape {wanted}", f"shape {array.shape}")
    if finite and not np.isfinite(array).all():
        raise ValueError(f"{field}: must be finite, got {array[~np.isfinite(array)][0]}")
    array.flags.writeable = False
    return array


def _lengths(field: str, value: ArrayLike, count: int) -> Floats:
    lengths = _array(field, value, (count,))
    _require((lengths >= 0.0).all(), field, "must be >= 0 m", lengths.min(initial=0.0))
    return lengths


def _switches(field: str, value: ArrayLike, count: int) -> NDArray[np.bool_]:
    switches = np.array(value)
    # numpy makes an empty list float64; a world without agents is valid
    if switches.dtype != np.bool_ and switches.size:
        raise TypeError(f"{field}: must be bool, got {switches.dtype}")
    _require(switches.shape == (count,), field, f"must have shape ({count},)", f"shape {switches.shape}")
    switches = switches.astype(np.bool_)
    switches.flags.writeable = False
    return switches


def _integers(field: str, value: ArrayLike, count: int) -> NDArray[np.int64]:
    numbers = np.array(value)
    if numbers.size and numbers.dtype.kind not in "iu":
        raise TypeError(f"{field}: must be integers, got {numbers.dtype}")
    _require(numbers.shape == (count,), field, f"must have shape ({count},)", f"shape {numbers.shape}")
    numbers = numbers.astype(np.int64)
    numbers.flags.writeable = False
    return numbers


def _agents(field: str, value: ArrayLike, each: int, count: int) -> NDArray[np.int32]:
    """Return rows of `each` numbers of agents."""
    rows = np.array(value)
    if rows.size and rows.dtype.kind not in "iu":
        raise TypeError(f"{field}: must be integers, got {rows.dtype}")
    _require(rows.ndim == 2 and rows.shape[1] == each, field, f"must have shape (any, {each})", f"shape {rows.shape}")
    outside = rows[(rows < 0) | (rows >= count)]
    _require(not len(outside), field, f"must be agents from 0 to {count - 1}", outside[:1])
    rows = rows.astype(np.int32)
    rows.flags.writeable = False
    return rows


def _names(field: str, value: Iterable[str], count: int) -> tuple[str, ...]:
    if isinstance(value, str):
        raise TypeError(f"{field}: must be a tuple of {count} names, got the one str {value!r}")
    names = tuple(value)
    _require(len(names) == count, field, f"must have {count} names, one per agent", len(names))
    for name in dict.fromkeys(names):
        _check_name(field, name, ROLES)
    return names


def _marks(value: Iterable[Mark], dimension: int) -> tuple[Mark, ...]:
    marks = tuple(value)
    for mark in marks:
        if not isinstance(mark, Mark):
            raise TypeError(f"Snapshot.marks: must hold Mark, got {type(mark).__name__}")
        _require(len(mark.at) == dimension, "Snapshot.marks", f"must have {dimension} coordinates", len(mark.at))
    return marks
