"""Network: the base class of particles that are joined to each other, and the arrays of their joints."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from flockenv.core.errors import nearest
from flockenv.core.record import Record
from flockenv.model.finite_elements import contents

__all__ = [
    "BEND", "EDGE", "MOST", "SHEAR", "Move", "Network", "Springs", "check_rows", "element_edges", "keys_of", "orient",
    "pairs_of", "springs_of",
]  # fmt: skip

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


MOST = 10_000_000
"""Most particles of one network."""


def _plain(value: object) -> object:
    """Return a numpy integer, as indices often are, as an int; any other value unchanged."""
    return int(value) if isinstance(value, np.integer) else value


Coordinate = Annotated[float, Field(ge=-1e100, le=1e100)]  # the volume of a larger box overflows
Length = Annotated[float, Field(gt=0, le=1e100)]
Point = Annotated[tuple[Coordinate, ...], Field(min_length=2, max_length=3)]
Count = Annotated[int, Field(ge=1, strict=True), BeforeValidator(_plain)]
Particle = Annotated[int, Field(ge=0, lt=MOST, strict=True), BeforeValidator(_plain)]  # its index; bool is rejected
Name = Annotated[str, Field(strict=True)]

EDGE, SHEAR, BEND = 0, 1, 2
"""Roles of springs: along an edge, across a cell, across two edges."""


class Springs(NamedTuple):
    """Pairs of particles, each once, i < j, in ascending order; E of them."""

    i: Ints  # (E,)
    j: Ints  # (E,)
    rest: Floats  # (E,) m
    role: NDArray[np.int8]  # (E,) EDGE, SHEAR or BEND


class Move(Record):
    """A constant velocity, on which some particles of a network are held: no force changes it."""

    particles: tuple[Particle | Name, ...] = Field(min_length=1, description="names of places, or indices")
    velocity: Point = Field(description="m/s")


class Network(Record):
    """Particles joined to each other; each kind of network defines their positions and joints.

    Most methods take the dimension D of the world, and raise ValueError if the network has another.
    """

    kind: str
    pinned: tuple[Particle | Name, ...] = Field(
        default=(), description="particles held in place: names of places, or indices"
    )
    moves: tuple[Move, ...] = Field(default=(), description="particles held at a constant velocity, from the start")
    stretch: float = Field(default=1.0, ge=1e-6, le=1e6, description="ratio of initial lengths to rest lengths")
    lumping: Literal["equal", "geometric"] = Field(
        default="equal", description="mass of each particle: equal, or by length, area or volume around it"
    )

    @model_validator(mode="after")
    def _check_fields(self) -> Self:
        """Raise ValueError on too many particles, points of mixed dimensions, invalid shapes or unknown pins."""
        if self.size > MOST:
            raise ValueError(f"{self.size:,} particles: at most {MOST:,} are allowed")
        self._refuse_mixture()
        self._refuse_shape()
        self._check_particles("pinned", self.pinned)
        self._check_moves()
        return self

    def _check_moves(self) -> None:
        """Raise ValueError if a particle has two velocities, or one beside its pin."""
        if not self.moves:  # the particles of a place are found only if they are needed
            return
        held = dict.fromkeys(self.particles("pinned", self.pinned).tolist(), "pinned")
        for k, (name, _, who) in enumerate(self._moved()):
            for one in who.tolist():
                if one in held:
                    raise ValueError(f"{name}: particle {one} is held by {held[one]}, too; it can have one velocity")
                held[one] = f"moves[{k}]"

    def _moved(self) -> Iterator[tuple[str, Move, Ints]]:
        """Yield the moves, each with the name of its field and its particles."""
        for k, move in enumerate(self.moves):
            name = f"moves[{k}].particles"
            yield name, move, self.particles(name, move.particles)

    def _check_particles(self, name: str, given: tuple[int | str, ...]) -> None:
        """Raise ValueError, with the field's name, on an unknown place or particle."""
        for k, one in enumerate(given):
            if isinstance(one, str) and one not in self.places:
                names = f"{', '.join(self.places)}{' or ' if self.places else ''}"
                hint = nearest(one, self.places) or ";"
                raise ValueError(f"{name}[{k}] = {one!r}: unknown{hint} allowed: {names}numbers 0 to {self.size - 1}")
            if isinstance(one, int) and one >= self.size:
                raise ValueError(f"{name}[{k}] = {one}: there is no such particle, they are 0 to {self.size - 1}")

    def _refuse_mixture(self) -> None:
        first: tuple[str, tuple[float, ...]] | None = None
        velocities = ((f"moves[{k}].velocity", move.velocity) for k, move in enumerate(self.moves))
        for name, point in itertools.chain(self._given_points(), velocities):
            first = first or (name, point)
            if len(point) != len(first[1]):
                raise ValueError(
                    f"{name} = {point} has {len(point)} coordinates, {first[0]} = {first[1]} has {len(first[1])}"
                )

    def _refuse_shape(self) -> None:
        """Raise ValueError if the fields together do not define a shape."""

    def _given_points(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """Yield the names and points of the fields that were given."""
        return iter(())

    def _check_dimension(self, dimension: int) -> None:
        if dimension not in (2, 3):
            raise ValueError(f"dimension = {dimension!r}: must be 2 or 3")
        if self.dimension not in (None, dimension):
            raise ValueError(f"{self.kind}: lies in {self.dimension} dimensions, not in {dimension}")

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of particles, n."""

    @property
    def dimension(self) -> int | None:
        """Dimension of the given points or velocities, 2 or 3; None if both are possible."""
        given = itertools.chain((point for _, point in self._given_points()), (move.velocity for move in self.moves))
        return next((len(vector) for vector in given), None)

    @property
    def places(self) -> tuple[str, ...]:
        """Names of sets of particles that `pinned` accepts."""
        return ()

    def _place(self, name: str) -> NDArray[Any]:
        """Return the indices of the particles that a name of `places` stands for."""
        raise ValueError(f"pinned: a {self.kind} has no place {name!r}; give numbers of particles")

    @abstractmethod
    def points(self, dimension: int) -> Floats:
        """Return the initial positions of particles, (n, D) m.

        dimension: 2 or 3.
        """

    def rest_points(self, dimension: int) -> Floats:
        """Return the unstrained positions of particles, (n, D) m; the first is at its initial position.

        dimension: 2 or 3.
        """
        points = self.points(dimension)
        return np.asarray(points if self.stretch == 1 else points[0] + (points - points[0]) / self.stretch)

    def velocities(self, dimension: int) -> Floats:
        """Return the initial velocities of particles, (n, D) m/s: relative to that of the group, unless held.

        dimension: 2 or 3.
        """
        self._check_dimension(dimension)
        out = np.zeros((self.size, dimension))
        for _, move, who in self._moved():
            out[who] = move.velocity
        return out

    @abstractmethod
    def springs(self, dimension: int) -> Springs:
        """Return the springs: pairs of particles, rest lengths and roles.

        dimension: 2 or 3.
        """

    def hinges(self, dimension: int) -> Ints:
        """Return the angles that resist bending, (H, 3): end, apex, end.

        dimension: 2 or 3.
        """
        self._check_dimension(dimension)
        return np.zeros((0, 3), np.int32)

    @abstractmethod
    def elements(self, dimension: int) -> Ints:
        """Return finite elements, (E, k): bars (k = 2), triangles (k = 3) or tetrahedra (k = 4).

        dimension: 2 or 3.

        Triangles in 2-D and tetrahedra in 3-D are positively oriented (det of the edges from the first corner > 0).
        """

    def check_elements(self, dimension: int) -> None:
        """Raise ValueError, in one line, if triangles make up no sound surface in 3-D, or tetrahedra no sound body.

        dimension: 2 or 3.
        """

    def pins(self) -> Ints:
        """Return the particles that no force moves: pinned ones, and those of `moves`; (P,) ascending."""
        held = [self.particles("pinned", self.pinned), *(who for _, _, who in self._moved())]
        return np.unique(np.concatenate(held)).astype(np.int32)

    def particles(self, name: str, given: tuple[int | str, ...]) -> Ints:
        """Return the particles that names of places and indices stand for, (P,) ascending, each once.

        name: of the field, for messages; given: names of places, such as `left`, and indices.

        Raises ValueError, with the name of the field that holds them, on an unknown place or particle.
        """
        self._check_particles(name, given)
        found = [self._place(one) if isinstance(one, str) else np.array([one]) for one in given]
        return np.unique(np.concatenate([np.zeros(0, np.int32), *found])).astype(np.int32)

    def masses(self, total: float, dimension: int) -> Floats:
        """Return the mass of each particle, (n,) kg, `total` in sum, distributed according to `lumping`.

        dimension: 2 or 3.

        Geometric: each element, or spring if there are no elements, divides its length, area or volume equally among
        its corners. Raises ValueError if a particle has no mass.
        """
        self._check_dimension(dimension)
        if not 0 < total < np.inf:
            raise ValueError(f"total = {total!r}: must be a number > 0 (kg)")
        if self.lumping == "equal":
            return np.full(self.size, total / self.size)
        joined = self.elements(dimension)
        if not len(joined):
            joined = np.stack(self.springs(dimension)[:2], axis=1)
        share = np.repeat(contents(self.rest_points(dimension), joined), joined.shape[1])
        weight = np.bincount(joined.ravel(), share, minlength=self.size)
        if not weight.all():
            raise ValueError(
                f"lumping = geometric: particle {np.argmin(weight)} is part of no element or spring and would weigh 0"
            )
        return np.asarray(total * weight / weight.sum())


def keys_of(pairs: NDArray[Any], size: int) -> NDArray[np.int64]:
    """Return a key for each pair, independent of its order: smaller index times `size`, plus the larger one."""
    a, b = pairs[:, 0].astype(np.int64), pairs[:, 1]
    return np.asarray(np.minimum(a, b) * size + np.maximum(a, b))


def pairs_of(keys: NDArray[np.int64], size: int) -> Ints:
    """Return the pairs with these keys, (E, 2), the smaller index first."""
    first = keys // size
    return np.stack([first, keys - first * size], axis=1).astype(np.int32)


def springs_of(groups: list[tuple[NDArray[Any], int]], rest_points: Floats) -> Springs:
    """Return pairs and their roles as sorted springs; rest lengths are the distances of their ends."""
    keys = np.concatenate([keys_of(pairs, len(rest_points)) for pairs, _ in groups])
    role = np.repeat(np.array([role for _, role in groups], np.int8), [len(pairs) for pairs, _ in groups])
    order = np.argsort(keys, kind="stable")  # fast for runs that are in order
    i, j = np.ascontiguousarray(pairs_of(keys[order], len(rest_points)).T)
    return Springs(i, j, np.linalg.norm(rest_points[j] - rest_points[i], axis=1), role[order])


def element_edges(elements: Ints, size: int) -> NDArray[np.int64]:
    """Return the keys of the pairs that are edges of elements, ascending, each once."""
    corners = itertools.combinations(range(elements.shape[1]), 2)
    keys = np.sort(np.concatenate([keys_of(elements[:, pair], size) for pair in corners]))
    again = np.flatnonzero(keys[1:] == keys[:-1])
    return np.delete(keys, again)


def orient(points: Floats, elements: Ints) -> Ints:
    """Return elements with positive determinant (k = D + 1 only): two corners are swapped if it is negative."""
    elements = elements.astype(np.int32)
    if elements.shape[1] == points.shape[1] + 1:
        corners = points[elements]
        wrong = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
        elements[wrong, :2] = elements[wrong, 1::-1]
    return elements


def check_rows(name: str, rows: tuple[tuple[int, ...], ...], size: int) -> None:
    """Raise ValueError if a row has an unknown or a repeated particle, or the same particles as another row."""
    if not rows:
        return
    who = np.array(rows, np.int64)
    for k in np.flatnonzero((who >= size).any(axis=1)):
        raise ValueError(f"{name}[{k}] = {rows[k]}: there is no such particle, they are 0 to {size - 1}")
    ordered = np.sort(who, axis=1)
    for k in np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1)):
        raise ValueError(f"{name}[{k}] = {rows[k]}: the same particle twice")
    if name == "angles":  # the same three particles may have another apex
        ordered = np.concatenate([ordered, who[:, 1:2]], axis=1)
    order = np.lexsort(ordered.T)
    for k in np.flatnonzero((ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)):
        first, second = order[k], order[k + 1]  # lexsort keeps equal rows in their order
        raise ValueError(f"{name}[{second}] = {rows[second]}: the same as {name}[{first}]")


# --- ropes ----------------------------------------------------------------------------------------------------------
