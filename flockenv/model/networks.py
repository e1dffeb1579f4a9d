"""Networks: particles tied to each other, a rope, a cloth, a jelly or a mesh by hand, as the arrays that tie them.

Where particles begin, which springs, hinges and finite elements join them, who is pinned and what each weighs. What a
spring does is somebody else's business.
"""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from flockenv.core.errors import nearest
from flockenv.core.record import Record
from flockenv.model.finite_elements import contents, flat

__all__ = ["BEND", "EDGE", "MOST", "SHEAR", "AnyNetwork", "Cloth", "Jelly", "Mesh", "Network", "Rope", "Springs"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


MOST = 10_000_000
"""Particles of one network."""


def _plain(value: object) -> object:
    """Take numpy's whole numbers for whole numbers: they are what indices come as."""
    return int(value) if isinstance(value, np.integer) else value


Coordinate = Annotated[float, Field(ge=-1e100, le=1e100)]  # a box of wider ones has no volume in floating point
Length = Annotated[float, Field(gt=0, le=1e100)]
Point = Annotated[tuple[Coordinate, ...], Field(min_length=2, max_length=3)]
Count = Annotated[int, Field(ge=1, strict=True), BeforeValidator(_plain)]
Particle = Annotated[int, Field(ge=0, lt=MOST, strict=True), BeforeValidator(_plain)]  # by its number; True is none
Name = Annotated[str, Field(strict=True)]

EDGE, SHEAR, BEND = 0, 1, 2
"""Roles of springs: along an edge, across a cell, over two edges."""


class Springs(NamedTuple):
    """Pairs of particles, each once, i < j, in ascending order; E of them."""

    i: Ints  # (E,)
    j: Ints  # (E,)
    rest: Floats  # (E,) m
    role: NDArray[np.int8]  # (E,) EDGE, SHEAR or BEND


class Network(Record):
    """Particles tied to each other. A kind of network says where they are and what joins them.

    Everything but `size`, `dimension` and `pins` is asked for with the dimension D of the world, and refused with a
    ValueError if the network lies in another.
    """

    kind: str
    pinned: tuple[Particle | Name, ...] = Field(default=(), description="who is held: names of places, numbers")
    stretch: float = Field(default=1.0, ge=1e-6, le=1e6, description="lengths at the beginning over lengths at rest")
    lumping: Literal["equal", "geometric"] = Field(
        default="equal", description="shares of the mass: the same for all, or of the length, area or volume around it"
    )

    @model_validator(mode="after")
    def _sound(self) -> Self:
        """Refuse too many particles, points of different dimensions, impossible shapes, pins that are nowhere."""
        if self.size > MOST:
            raise ValueError(f"{self.size:,} particles: at most {MOST:,} are allowed")
        self._refuse_mixture()
        self._refuse_shape()
        for k, pin in enumerate(self.pinned):
            if isinstance(pin, str) and pin not in self.places:
                names = f"{', '.join(self.places)}{' or ' if self.places else ''}"
                hint = nearest(pin, self.places) or ";"
                raise ValueError(f"pinned[{k}] = {pin!r}: unknown{hint} allowed: {names}numbers 0 to {self.size - 1}")
            if isinstance(pin, int) and pin >= self.size:
                raise ValueError(f"pinned[{k}] = {pin}: there is no such particle, they are 0 to {self.size - 1}")
        return self

    def _refuse_mixture(self) -> None:
        first: tuple[str, tuple[float, ...]] | None = None
        for name, point in self._given():
            first = first or (name, point)
            if len(point) != len(first[1]):
                raise ValueError(
                    f"{name} = {point} has {len(point)} coordinates, {first[0]} = {first[1]} has {len(first[1])}"
                )

    def _refuse_shape(self) -> None:
        """Refuse fields that make no shape together."""

    def _given(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """The points that somebody wrote down, by name."""
        return iter(())

    def _demand(self, dimension: int) -> None:
        if dimension not in (2, 3):
            raise ValueError(f"dimension = {dimension!r}: must be 2 or 3")
        if self.dimension not in (None, dimension):
            raise ValueError(f"{self.kind}: lies in {self.dimension} dimensions, not in {dimension}")

    @property
    @abstractmethod
    def size(self) -> int:
        """How many particles, n."""

    @property
    def dimension(self) -> int | None:
        """2 or 3, whichever it was written down for; None if it fits into both."""
        return next((len(point) for _, point in self._given()), None)

    @property
    def places(self) -> tuple[str, ...]:
        """The names that `pinned` knows."""
        return ()

    def _place(self, name: str) -> NDArray[Any]:
        """The particles of a place."""
        raise ValueError(f"pinned: a {self.kind} has no place {name!r}; give numbers of particles")

    @abstractmethod
    def points(self, dimension: int) -> Floats:
        """Return where particles begin, (n, D) m."""

    def rest_points(self, dimension: int) -> Floats:
        """Return where particles are when nothing is strained, (n, D) m; the first one where it begins."""
        points = self.points(dimension)
        return np.asarray(points if self.stretch == 1 else points[0] + (points - points[0]) / self.stretch)

    @abstractmethod
    def springs(self, dimension: int) -> Springs:
        """Return who is tied to whom, and how long each spring is at rest."""

    def hinges(self, dimension: int) -> Ints:
        """Return which angles resist bending, (H, 3): end, apex, end."""
        self._demand(dimension)
        return np.zeros((0, 3), np.int32)

    @abstractmethod
    def elements(self, dimension: int) -> Ints:
        """Return finite elements, (E, k): bars (k = 2), triangles (k = 3) or tetrahedra (k = 4).

        Triangles in the plane and tetrahedra in space turn positively (det of the edges from the first corner > 0).
        """

    def pins(self) -> Ints:
        """Return who is held, (P,) ascending."""
        held = [self._place(pin) if isinstance(pin, str) else np.array([pin]) for pin in self.pinned]
        return np.unique(np.concatenate([np.zeros(0, np.int32), *held])).astype(np.int32)

    def masses(self, total: float, dimension: int) -> Floats:
        """Return what each particle weighs, (n,) kg, `total` together: equal shares, or those of `lumping`.

        Geometric: each element, or spring where there are none, divides its length, area or volume among its corners.
        Refuses particles left without mass.
        """
        self._demand(dimension)
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
            raise ValueError(f"lumping = geometric: particle {np.argmin(weight)} is part of nothing and would weigh 0")
        return np.asarray(total * weight / weight.sum())


class Rope(Network):
    """Links in a row, from `start` to `end`, or in a direction.

    With both ends and a length it hangs slack, in an arc of its rest lengths, or is drawn tight.
    """

    kind: Literal["rope"] = "rope"
    links: Count = Field(description="one less than its particles")
    start: Point | None = Field(default=None, description="m; none = the origin")
    end: Point | None = Field(default=None, description="m; none = where direction and length lead")
    direction: Point | None = Field(default=None, description="from the start, of any length; none = along x")
    length: Length | None = Field(default=None, description="m, at rest; none = from start to end over stretch")
    sag: Point | None = Field(default=None, description="way in which slack hangs; none = down the last axis")
    bend: bool = Field(default=False, description="springs over two links as well")

    @property
    def size(self) -> int:
        """Links and one."""
        return self.links + 1

    @property
    def places(self) -> tuple[str, ...]:
        """One end, the other, both."""
        return ("start", "end", "ends")

    def _place(self, name: str) -> NDArray[Any]:
        return np.array({"start": [0], "end": [self.links], "ends": [0, self.links]}[name])

    def _given(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        for name in ("start", "end", "direction", "sag"):
            point = getattr(self, name)
            if point is not None:
                yield name, point

    def _refuse_shape(self) -> None:
        if self.end is None and self.length is None:
            raise ValueError("a rope needs an end or a length")
        if self.end is not None and self.direction is not None:
            raise ValueError("end and direction say the same: give one of them")
        if self.end is not None and self.length is not None and self.stretch != 1:
            raise ValueError(f"stretch = {self.stretch:g}: start, end and length say the same: give two of them")
        for name in ("direction", "sag"):
            way = getattr(self, name)
            if way is not None and not np.linalg.norm(way) > 0:
                raise ValueError(f"{name} = {way}: it has no length")
        if self.length is None and not self._reach() > 0:
            raise ValueError(f"end = {self.end}: it is the start, so the rope needs a length")

    def _ends(self, dimension: int) -> tuple[Floats, Floats]:
        """Where it starts and where it ends, (D,) m each."""
        start = np.array(self.start or (0.0,) * dimension, float)
        if self.end is not None:
            return start, np.array(self.end, float)
        assert self.length is not None
        way = np.array(self.direction or np.eye(dimension)[0], float)
        return start, start + way * (self.length * self.stretch / np.linalg.norm(way))

    def _reach(self) -> float:
        """From its start to its end, m."""
        start, end = self._ends(self.dimension or 2)
        return float(np.linalg.norm(end - start))

    def _link(self) -> float:
        """A link at rest, m."""
        return (self.length if self.length is not None else self._reach() / self.stretch) / self.links

    def points(self, dimension: int) -> Floats:
        """Return its particles at equal distances on the way to its end, or on an arc where it is slack."""
        self._demand(dimension)
        start, end = self._ends(dimension)
        slack = self.end is not None and self.length is not None and self._reach() < self.length
        if not slack or self.links == 1:
            return np.asarray(np.linspace(start, end, self.size))
        along, down = _frame(end - start, np.array(self.sag or -np.eye(dimension)[-1], float))
        angle = _arc(self._reach() / self._link(), self.links) * np.arange(self.links - 1, -self.links, -2)
        steps = self._link() * (np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * down)
        return np.concatenate([start[None], start + np.cumsum(steps[:-1], axis=0), end[None]])

    def rest_points(self, dimension: int) -> Floats:
        """Return its particles on a straight line, at their rest lengths."""
        self._demand(dimension)
        start, end = self._ends(dimension)
        along, _ = _frame(end - start, end - start)
        return np.asarray(np.linspace(start, start + along * (self._link() * self.links), self.size))

    def springs(self, dimension: int) -> Springs:
        """Return a spring for each link, and with `bend` one over each two."""
        self._demand(dimension)
        ids = np.arange(self.size, dtype=np.int32)
        over = _runs(ids, 0, 3)[:, ::2] if self.bend else np.zeros((0, 2), np.int32)
        found = _springs([(_runs(ids, 0, 2), EDGE), (over, BEND)], self.rest_points(dimension))
        return found._replace(rest=np.asarray(self._link() * (found.j - found.i)))

    def hinges(self, dimension: int) -> Ints:
        """Return each three particles in a row."""
        self._demand(dimension)
        return _runs(np.arange(self.size, dtype=np.int32), 0, 3)

    def elements(self, dimension: int) -> Ints:
        """Return a bar for each link."""
        self._demand(dimension)
        return _runs(np.arange(self.size, dtype=np.int32), 0, 2)


class _Lattice(Network):
    """Cells in rows: what a cloth and a jelly have in common. Particles are counted along the first edge first."""

    cells: tuple[int, ...]
    origin: Point | None = Field(default=None, description="m, its first corner; none = the origin")
    sides: tuple[Length, ...] | None = Field(default=None, description="m, of a box along the axes; or give edges")
    edges: tuple[Point, ...] | None = Field(default=None, description="m, from the first corner; or give sides")
    diagonals: Literal["alternating", "parallel"] = Field(
        default="alternating", description="of elements: cells mirror each other, or are all alike"
    )

    @property
    def size(self) -> int:
        """One more than cells, along each edge."""
        return math.prod(count + 1 for count in self.cells)

    def _given(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        if self.origin is not None:
            yield "origin", self.origin
        yield from ((f"edges[{k}]", edge) for k, edge in enumerate(self.edges or ()))

    def _refuse_shape(self) -> None:
        if (self.sides is None) == (self.edges is None):
            raise ValueError("sides or edges: give one of them")
        for name, value in (("sides", self.sides), ("edges", self.edges)):
            if value is not None and len(value) != len(self.cells):
                raise ValueError(f"{name} = {value}: cells = {self.cells} needs {len(self.cells)} of them")
        if self.edges is not None:
            _refuse_edges(self.edges)

    @property
    def places(self) -> tuple[str, ...]:
        """Its sides, in the plane of two edges its corners by name, all corners, all that lies outside."""
        if len(self.cells) == 3:
            return (*_SIDES, "corners", "border")
        corners = [f"{row}_{column}" for row in ("bottom", "top") for column in ("left", "right")]
        return ("left", "right", "bottom", "top", *corners, "corners", "border")

    def _place(self, name: str) -> NDArray[Any]:
        ids = self._ids()
        if name == "corners":
            return np.asarray(ids[np.ix_(*[[0, -1]] * ids.ndim)].ravel())
        if name == "border":
            outside = np.ones(ids.shape, bool)
            outside[(slice(1, -1),) * ids.ndim] = False
            return np.asarray(ids[outside])
        here: list[int | slice] = [slice(None)] * ids.ndim
        for side in name.split("_"):
            axis, place = _SIDES[side]
            here[axis] = place
        return np.asarray(ids[tuple(here)]).ravel()

    def _ids(self) -> Ints:
        """The number of the particle at each place of the lattice."""
        shape = tuple(count + 1 for count in self.cells)
        return np.arange(self.size, dtype=np.int32).reshape(shape, order="F")

    def points(self, dimension: int) -> Floats:
        """Return corners of cells, the first edge's fastest."""
        self._demand(dimension)
        points = np.tile(np.array(self.origin or (0.0,) * dimension, float), (self.size, 1))
        edges = self.edges if self.edges is not None else np.diag(self.sides or ()).tolist()
        place = np.unravel_index(np.arange(self.size), self._ids().shape, order="F")
        for along, count, edge in zip(place, self.cells, edges, strict=True):
            points[:, : len(edge)] += (along / count)[:, None] * np.array(edge, float)
        return points

    def _corners(self) -> tuple[Ints, NDArray[np.int64]]:
        """The corners of each cell, (C, 2^d), bit k of a corner's place for edge k; and which cells are mirrored."""
        ids = self._ids()
        bits = itertools.product((0, 1), repeat=ids.ndim)  # the last edge's bit comes first
        shifted = [tuple(slice(b, b + n) for b, n in zip(bit[::-1], self.cells, strict=True)) for bit in bits]
        mirrored = sum(np.indices(self.cells)) % 2 if self.diagonals == "alternating" else np.zeros(self.cells, int)
        corners = np.stack([ids[part].ravel(order="F") for part in shifted], axis=1)
        return corners, np.asarray(mirrored, np.int64).ravel(order="F")

    def elements(self, dimension: int) -> Ints:
        """Return its cells cut into triangles or tetrahedra that share whole faces."""
        self._demand(dimension)
        corners, mirrored = self._corners()
        cuts = _CUTS[len(self.cells), self.diagonals][mirrored]
        found = corners[np.arange(len(corners))[:, None, None], cuts].reshape(-1, cuts.shape[2])
        return _turned(self.rest_points(dimension), found)


class Cloth(_Lattice):
    """A sheet of cells between two edges; in the plane or in space.

    "left" is where the first edge begins, "bottom" where the second does.
    """

    kind: Literal["cloth"] = "cloth"
    cells: tuple[Count, Count] = Field(description="along the first and the second edge")
    shear: bool = Field(default=True, description="springs across cells")
    bend: bool = Field(default=True, description="springs over two edges in a row")

    def springs(self, dimension: int) -> Springs:
        """Return springs along the sides of cells, both diagonals of each, and over two sides in a row."""
        self._demand(dimension)
        ids, (corners, _) = self._ids(), self._corners()
        groups = [(_runs(ids, axis, 2), EDGE) for axis in (0, 1)]
        if self.shear:
            groups += [(corners[:, [0, 3]], SHEAR), (corners[:, [1, 2]], SHEAR)]
        if self.bend:
            groups += [(_runs(ids, axis, 3)[:, ::2], BEND) for axis in (0, 1)]
        return _springs(groups, self.rest_points(dimension))

    def hinges(self, dimension: int) -> Ints:
        """Return each three particles in a row, along both edges."""
        self._demand(dimension)
        return np.concatenate([_runs(self._ids(), axis, 3) for axis in (0, 1)])


class Jelly(_Lattice):
    """A box of tetrahedra, five per cell or (parallel) six; in the plane a sheet of triangles.

    "left" is where the first edge begins, "bottom" where the last does, "front" where the one between them does.
    """

    kind: Literal["jelly"] = "jelly"
    cells: Annotated[tuple[Count, ...], Field(min_length=2, max_length=3)] = Field(description="along each edge")

    @property
    def dimension(self) -> int:
        """As many as it has edges."""
        return len(self.cells)

    def _refuse_shape(self) -> None:
        super()._refuse_shape()
        for name, point in self._given():
            if len(point) != len(self.cells):
                raise ValueError(f"{name} = {point}: cells = {self.cells} lies in {len(self.cells)} dimensions")

    def springs(self, dimension: int) -> Springs:
        """Return a spring for each edge of its elements: EDGE along the sides of cells, SHEAR across."""
        self._demand(dimension)
        along = np.concatenate([_runs(self._ids(), axis, 2) for axis in range(dimension)])
        every = _element_edges(self.elements(dimension), self.size)
        across = np.setdiff1d(every, _keys(along, self.size), assume_unique=True)
        return _springs([(along, EDGE), (_pairs(across, self.size), SHEAR)], self.rest_points(dimension))


class Mesh(Network):
    """Points, and what joins them, by hand: elements of one kind; springs are their edges, or the pairs given."""

    kind: Literal["mesh"] = "mesh"
    vertices: tuple[Point, ...] = Field(min_length=1, description="m, where particles begin")
    pairs: tuple[tuple[Particle, Particle], ...] | None = Field(
        default=None, description="springs; none = the edges of its elements"
    )
    rest: tuple[Annotated[float, Field(ge=0, le=1e100)], ...] | None = Field(
        default=None, description="m, of each pair; none = as far as its ends are, over stretch"
    )
    bars: tuple[tuple[Particle, Particle], ...] = Field(default=(), description="elements of two corners")
    triangles: tuple[tuple[Particle, Particle, Particle], ...] = Field(default=(), description="of three")
    tetrahedra: tuple[tuple[Particle, Particle, Particle, Particle], ...] = Field(default=(), description="of four")
    angles: tuple[tuple[Particle, Particle, Particle], ...] = Field(default=(), description="hinges: end, apex, end")

    _ELEMENTS: ClassVar[tuple[str, ...]] = ("bars", "triangles", "tetrahedra")

    @property
    def size(self) -> int:
        """As many as vertices."""
        return len(self.vertices)

    def _given(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        return ((f"vertices[{k}]", point) for k, point in enumerate(self.vertices))

    def _refuse_shape(self) -> None:
        given = [name for name in self._ELEMENTS if getattr(self, name)]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)}: elements are of one kind; give one of them")
        if self.tetrahedra and self.dimension == 2:
            raise ValueError("tetrahedra: vertices have 2 coordinates, they need 3")
        for name in ("pairs", *self._ELEMENTS, "angles"):
            _refuse_rows(name, getattr(self, name) or (), self.size)
        thin = flat(self.vertices, self._joined())
        if len(thin):
            raise ValueError(f"{given[0]}[{thin[0]}] = {getattr(self, given[0])[thin[0]]}: it has no extent")
        if self.rest is not None and len(self.rest) != len(self.pairs or ()):
            raise ValueError(
                f"rest: {len(self.rest)} lengths for {len(self.pairs or ())} pairs; one for each is needed"
            )
        if self.rest is not None and self.stretch != 1:
            raise ValueError(f"stretch = {self.stretch:g}: rest says how long springs are: give one of them")
        if self.lumping == "geometric":
            self.masses(1.0, len(self.vertices[0]))  # refuses who is part of nothing

    def _joined(self) -> Ints:
        """Its elements as they were given; bars, none of them, if there are none."""
        given = next((rows for rows in (self.triangles, self.tetrahedra) if rows), self.bars)
        return np.array(given, np.int32) if given else np.zeros((0, 2), np.int32)

    def points(self, dimension: int) -> Floats:
        """Return its vertices."""
        self._demand(dimension)
        return np.array(self.vertices, float)

    def springs(self, dimension: int) -> Springs:
        """Return its pairs, or the edges of its elements."""
        self._demand(dimension)
        if self.pairs is None:
            pairs = _pairs(_element_edges(self._joined(), self.size), self.size)
        else:
            pairs = np.array(self.pairs, np.int32).reshape(-1, 2)
        found = _springs([(pairs, EDGE)], self.rest_points(dimension))
        if self.rest is None:
            return found
        return found._replace(rest=np.array(self.rest, float)[np.argsort(_keys(pairs, self.size))])

    def hinges(self, dimension: int) -> Ints:
        """Return its angles."""
        self._demand(dimension)
        return np.array(self.angles, np.int32).reshape(-1, 3)

    def elements(self, dimension: int) -> Ints:
        """Return its bars, triangles or tetrahedra."""
        self._demand(dimension)
        return _turned(self.points(dimension), self._joined())


AnyNetwork = Annotated[Rope | Cloth | Jelly | Mesh, Field(discriminator="kind")]


# --- lattices -------------------------------------------------------------------------------------------------------

_SIDES = {"left": (0, 0), "right": (0, -1), "bottom": (-1, 0), "top": (-1, -1), "front": (1, 0), "back": (1, -1)}
"""Which edge a side is at the beginning (0) or the end (-1) of."""

_FIVE = [(0, 3, 5, 6), (1, 0, 3, 5), (2, 0, 3, 6), (4, 0, 5, 6), (7, 3, 5, 6)]
"""A cell cut into one tetrahedron in the middle and four that are corners of the cell."""

_SIX = [(0, 1 << a, (1 << a) | (1 << b), 7) for a, b in itertools.permutations(range(3), 2)]
"""A cell cut into six tetrahedra around its diagonal. Source: Kuhn 1960, IBM J. Res. Dev. 4, 518."""

_CUTS = {
    (2, "alternating"): np.array([[(0, 1, 3), (0, 3, 2)], [(0, 1, 2), (1, 3, 2)]]),
    (2, "parallel"): np.array([[(0, 1, 3), (0, 3, 2)]]),
    (3, "alternating"): np.array([_FIVE, [tuple(corner ^ 1 for corner in cut) for cut in _FIVE]]),
    (3, "parallel"): np.array([_SIX]),
}
"""Corners of the elements of a cell, and of its mirror image: bit k of a corner says on which side of edge k it is."""


def _runs(ids: Ints, axis: int, length: int) -> Ints:
    """Return each `length` particles in a row along an axis of a lattice, (R, length)."""
    count = max(ids.shape[axis] - length + 1, 0)
    rows = np.moveaxis(ids, axis, -1)
    parts = [np.moveaxis(rows[..., k : k + count], -1, axis) for k in range(length)]
    return np.stack([part.ravel(order="F") for part in parts], axis=1)


def _refuse_edges(edges: tuple[tuple[float, ...], ...]) -> None:
    """Refuse an edge of no length, edges on a line, edges in a plane."""
    lengths = np.linalg.norm(edges, axis=1)
    for k in np.flatnonzero(~(lengths > 0)):
        raise ValueError(f"edges[{k}] = {edges[k]}: it has no length")
    if np.linalg.svd(np.array(edges) / lengths[:, None], compute_uv=False)[-1] < 1e-9:
        raise ValueError(f"edges = {edges}: they are {'parallel' if len(edges) == 2 else 'in one plane'}")


# --- pairs and elements ---------------------------------------------------------------------------------------------


def _keys(pairs: NDArray[Any], size: int) -> NDArray[np.int64]:
    """Return a number for each pair, whichever of the two comes first: smaller index times size, plus the greater."""
    a, b = pairs[:, 0].astype(np.int64), pairs[:, 1]
    return np.asarray(np.minimum(a, b) * size + np.maximum(a, b))


def _pairs(keys: NDArray[np.int64], size: int) -> Ints:
    """Return the pairs that have these numbers, (E, 2), the smaller first."""
    first = keys // size
    return np.stack([first, keys - first * size], axis=1).astype(np.int32)


def _springs(groups: list[tuple[NDArray[Any], int]], rest_points: Floats) -> Springs:
    """Return pairs and their roles as springs in order, as long at rest as their ends are apart."""
    keys = np.concatenate([_keys(pairs, len(rest_points)) for pairs, _ in groups])
    role = np.repeat(np.array([role for _, role in groups], np.int8), [len(pairs) for pairs, _ in groups])
    order = np.argsort(keys, kind="stable")  # quick where runs are in order already
    i, j = np.ascontiguousarray(_pairs(keys[order], len(rest_points)).T)
    return Springs(i, j, np.linalg.norm(rest_points[j] - rest_points[i], axis=1), role[order])


def _element_edges(elements: Ints, size: int) -> NDArray[np.int64]:
    """Return the numbers of the pairs that are edges of elements, ascending, each once."""
    corners = itertools.combinations(range(elements.shape[1]), 2)
    keys = np.sort(np.concatenate([_keys(elements[:, pair], size) for pair in corners]))
    again = np.flatnonzero(keys[1:] == keys[:-1])
    return np.delete(keys, again)


def _turned(points: Floats, elements: Ints) -> Ints:
    """Return elements that fill their space with a positive determinant: two corners of the others change places."""
    elements = elements.astype(np.int32)
    if elements.shape[1] == points.shape[1] + 1:
        corners = points[elements]
        wrong = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
        elements[wrong, :2] = elements[wrong, 1::-1]
    return elements


def _refuse_rows(name: str, rows: tuple[tuple[int, ...], ...], size: int) -> None:
    """Refuse rows that name a particle that is not there, or one twice, or the same particles as another row."""
    if not rows:
        return
    who = np.array(rows, np.int64)
    for k in np.flatnonzero((who >= size).any(axis=1)):
        raise ValueError(f"{name}[{k}] = {rows[k]}: there is no such particle, they are 0 to {size - 1}")
    ordered = np.sort(who, axis=1)
    for k in np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1)):
        raise ValueError(f"{name}[{k}] = {rows[k]}: the same particle twice")
    if name == "angles":  # the same three may meet at another apex
        ordered = np.concatenate([ordered, who[:, 1:2]], axis=1)
    order = np.lexsort(ordered.T)
    for k in np.flatnonzero((ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)):
        first, second = order[k], order[k + 1]  # lexsort keeps equal rows in their order
        raise ValueError(f"{name}[{second}] = {rows[second]}: the same as {name}[{first}]")


# --- ropes ----------------------------------------------------------------------------------------------------------


def _frame(way: Floats, aside: Floats) -> tuple[Floats, Floats]:
    """Return unit vectors along `way` and, at right angles to it, towards `aside`; if that is along it, some other."""
    axes = np.eye(len(way))
    along = way / np.linalg.norm(way) if way.any() else axes[0]
    for towards in (aside / np.linalg.norm(aside) if aside.any() else aside, axes[np.argmin(np.abs(along))]):
        across = towards - (towards @ along) * along
        if np.linalg.norm(across) > 1e-9:
            break
    return along, across / np.linalg.norm(across)


def _arc(chord: float, links: int) -> float:
    """Return half the turn between two links, rad, at which N unit links span a chord: sin(N a) / sin a = chord."""
    low, high = 0.0, np.pi / links
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if np.sin(links * middle) > chord * np.sin(middle) else (low, middle)
    return (low + high) / 2
