"""Networks: particles joined to each other (a rope, a cloth, a jelly, a mesh or blocks), as arrays of their joints.

A network defines the initial positions of its particles, the springs, hinges and finite elements that join them, which
particles are pinned, and their masses. The forces of springs are effects, defined elsewhere.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockenv.geometry.mesh_checks import check_mesh, refuse_coincident
from flockenv.model.blocks import Blocks
from flockenv.model.finite_elements import flat
from flockenv.model.network import (
    BEND,
    EDGE,
    MOST,
    SHEAR,
    Count,
    Floats,
    Ints,
    Length,
    Move,
    Network,
    Particle,
    Point,
    Springs,
    check_rows,
    element_edges,
    keys_of,
    orient,
    pairs_of,
    springs_of,
)
from flockenv.model.triangles import dihedrals

__all__ = [
    "BEND", "EDGE", "MOST", "SHEAR", "AnyNetwork", "Blocks", "Cloth", "Jelly", "Mesh", "Move", "Network", "Rope",
    "Springs",
]  # fmt: skip


class Rope(Network):
    """A chain of links from `start` to `end`, or in a direction.

    With both ends and a length it is either stretched, or slack along an arc of its rest lengths.
    """

    kind: Literal["rope"] = "rope"
    links: Count = Field(description="number of links; there is one more particle")
    start: Point | None = Field(default=None, description="m (default: the origin)")
    end: Point | None = Field(default=None, description="m (default: given by direction and length)")
    direction: Point | None = Field(default=None, description="from the start, of any length (default: along x)")
    length: Length | None = Field(default=None, description="m, at rest (default: distance of start and end / stretch)")
    sag: Point | None = Field(default=None, description="direction in which slack hangs (default: down the last axis)")
    bend: bool = Field(default=False, description="True: also springs that span two links")

    @property
    def size(self) -> int:
        """Number of particles: links + 1."""
        return self.links + 1

    @property
    def places(self) -> tuple[str, ...]:
        """Names of each end, and of both."""
        return ("start", "end", "ends")

    def _place(self, name: str) -> NDArray[Any]:
        return np.array({"start": [0], "end": [self.links], "ends": [0, self.links]}[name])

    def _given_points(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        for name in ("start", "end", "direction", "sag"):
            point = getattr(self, name)
            if point is not None:
                yield name, point

    def _refuse_shape(self) -> None:
        if self.end is None and self.length is None:
            raise ValueError("a rope needs an end or a length")
        if self.end is not None and self.direction is not None:
            raise ValueError("end and direction are redundant: give one of them")
        if self.end is not None and self.length is not None and self.stretch != 1:
            raise ValueError(f"stretch = {self.stretch:g}: start, end and length are redundant: give two of them")
        for name in ("direction", "sag"):
            way = getattr(self, name)
            if way is not None and not np.linalg.norm(way) > 0:
                raise ValueError(f"{name} = {way}: it has no length")
        if self.length is None and not self._reach() > 0:
            raise ValueError(f"end = {self.end}: it is the start, so the rope needs a length")

    def _ends(self, dimension: int) -> tuple[Floats, Floats]:
        """Return the start and the end of the rope, (D,) m each."""
        start = np.array(self.start or (0.0,) * dimension, float)
        if self.end is not None:
            return start, np.array(self.end, float)
        assert self.length is not None
        way = np.array(self.direction or np.eye(dimension)[0], float)
        return start, start + way * (self.length * self.stretch / np.linalg.norm(way))

    def _reach(self) -> float:
        """Return the distance from the start to the end of the rope, m."""
        start, end = self._ends(self.dimension or 2)
        return float(np.linalg.norm(end - start))

    def _link(self) -> float:
        """Return the rest length of a link, m."""
        return (self.length if self.length is not None else self._reach() / self.stretch) / self.links

    def points(self, dimension: int) -> Floats:
        """Return the positions of particles, evenly spaced from start to end, or on an arc if the rope is slack."""
        self._check_dimension(dimension)
        start, end = self._ends(dimension)
        slack = self.end is not None and self.length is not None and self._reach() < self.length
        if not slack or self.links == 1:
            return np.asarray(np.linspace(start, end, self.size))
        along, down = _frame(end - start, np.array(self.sag or -np.eye(dimension)[-1], float))
        angle = _arc(self._reach() / self._link(), self.links) * np.arange(self.links - 1, -self.links, -2)
        steps = self._link() * (np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * down)
        return np.concatenate([start[None], start + np.cumsum(steps[:-1], axis=0), end[None]])

    def rest_points(self, dimension: int) -> Floats:
        """Return the positions of particles on a straight line, at their rest lengths."""
        self._check_dimension(dimension)
        start, end = self._ends(dimension)
        along, _ = _frame(end - start, end - start)
        return np.asarray(np.linspace(start, start + along * (self._link() * self.links), self.size))

    def springs(self, dimension: int) -> Springs:
        """Return a spring for each link and, with `bend`, one across each two successive links."""
        self._check_dimension(dimension)
        ids = np.arange(self.size, dtype=np.int32)
        over = _runs(ids, 0, 3)[:, ::2] if self.bend else np.zeros((0, 2), np.int32)
        found = springs_of([(_runs(ids, 0, 2), EDGE), (over, BEND)], self.rest_points(dimension))
        return found._replace(rest=np.asarray(self._link() * (found.j - found.i)))

    def hinges(self, dimension: int) -> Ints:
        """Return a hinge for each three consecutive particles."""
        self._check_dimension(dimension)
        return _runs(np.arange(self.size, dtype=np.int32), 0, 3)

    def elements(self, dimension: int) -> Ints:
        """Return a bar for each link."""
        self._check_dimension(dimension)
        return _runs(np.arange(self.size, dtype=np.int32), 0, 2)


class _Lattice(Network):
    """A lattice of cells, common to cloth and jelly; particles are numbered along the first edge first."""

    cells: tuple[int, ...]
    origin: Point | None = Field(default=None, description="m, its first corner (default: the origin)")
    sides: tuple[Length, ...] | None = Field(default=None, description="m, of an axis-aligned box (or edges)")
    edges: tuple[Point, ...] | None = Field(default=None, description="m, vectors from the first corner (or sides)")
    diagonals: Literal["alternating", "parallel"] = Field(
        default="alternating", description="division of cells into elements: mirrored between neighbours, or all alike"
    )

    @property
    def size(self) -> int:
        """Number of particles; along each edge there is one more than cells."""
        return math.prod(count + 1 for count in self.cells)

    def _given_points(self) -> Iterator[tuple[str, tuple[float, ...]]]:
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
        """Names of each side, of each corner (two edges only), of all corners, and of the border."""
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
        """Return the index of the particle at each site of the lattice."""
        shape = tuple(count + 1 for count in self.cells)
        return np.arange(self.size, dtype=np.int32).reshape(shape, order="F")

    def points(self, dimension: int) -> Floats:
        """Return the sites of the lattice; the index along the first edge varies fastest."""
        self._check_dimension(dimension)
        points = np.tile(np.array(self.origin or (0.0,) * dimension, float), (self.size, 1))
        edges = self.edges if self.edges is not None else np.diag(self.sides or ()).tolist()
        place = np.unravel_index(np.arange(self.size), self._ids().shape, order="F")
        for along, count, edge in zip(place, self.cells, edges, strict=True):
            points[:, : len(edge)] += (along / count)[:, None] * np.array(edge, float)
        return points

    def _corners(self) -> tuple[Ints, NDArray[np.int64]]:
        """Return the corners of each cell, (C, 2^d), bit k of the column for edge k; and 1 for mirrored cells."""
        ids = self._ids()
        bits = itertools.product((0, 1), repeat=ids.ndim)  # the last edge's bit comes first
        shifted = [tuple(slice(b, b + n) for b, n in zip(bit[::-1], self.cells, strict=True)) for bit in bits]
        mirrored = sum(np.indices(self.cells)) % 2 if self.diagonals == "alternating" else np.zeros(self.cells, int)
        corners = np.stack([ids[part].ravel(order="F") for part in shifted], axis=1)
        return corners, np.asarray(mirrored, np.int64).ravel(order="F")

    def elements(self, dimension: int) -> Ints:
        """Return the elements of all cells: triangles or tetrahedra with conforming faces."""
        self._check_dimension(dimension)
        corners, mirrored = self._corners()
        cuts = _CUTS[len(self.cells), self.diagonals][mirrored]
        found = corners[np.arange(len(corners))[:, None, None], cuts].reshape(-1, cuts.shape[2])
        return orient(self.rest_points(dimension), found)


class Cloth(_Lattice):
    """A sheet of cells spanned by two edges; 2-D or 3-D.

    "left" is where the first edge begins, "bottom" where the second does.
    """

    kind: Literal["cloth"] = "cloth"
    cells: tuple[Count, Count] = Field(description="number of cells along the first and the second edge")
    shear: bool = Field(default=True, description="True: springs along the diagonals of cells")
    bend: bool = Field(default=True, description="True: springs across two successive edges of cells")

    def springs(self, dimension: int) -> Springs:
        """Return springs along the sides of cells, along both diagonals, and across two successive sides."""
        self._check_dimension(dimension)
        ids, (corners, _) = self._ids(), self._corners()
        groups = [(_runs(ids, axis, 2), EDGE) for axis in (0, 1)]
        if self.shear:
            groups += [(corners[:, [0, 3]], SHEAR), (corners[:, [1, 2]], SHEAR)]
        if self.bend:
            groups += [(_runs(ids, axis, 3)[:, ::2], BEND) for axis in (0, 1)]
        return springs_of(groups, self.rest_points(dimension))

    def hinges(self, dimension: int) -> Ints:
        """Return a hinge for each three consecutive particles along either edge."""
        self._check_dimension(dimension)
        return np.concatenate([_runs(self._ids(), axis, 3) for axis in (0, 1)])


class Jelly(_Lattice):
    """A box of tetrahedra, five per cell, or six with parallel `diagonals`; in 2-D a sheet of triangles.

    "left" is where the first edge begins, "bottom" where the last does, "front" where the one between them does.
    """

    kind: Literal["jelly"] = "jelly"
    cells: Annotated[tuple[Count, ...], Field(min_length=2, max_length=3)] = Field(description="along each edge")

    @property
    def dimension(self) -> int:
        """Dimension of space: the number of edges."""
        return len(self.cells)

    def _refuse_shape(self) -> None:
        super()._refuse_shape()
        for name, point in self._given_points():
            if len(point) != len(self.cells):
                raise ValueError(f"{name} = {point}: cells = {self.cells} lies in {len(self.cells)} dimensions")

    def springs(self, dimension: int) -> Springs:
        """Return a spring for each edge of the elements: EDGE along the sides of cells, SHEAR across cells."""
        self._check_dimension(dimension)
        along = np.concatenate([_runs(self._ids(), axis, 2) for axis in range(dimension)])
        every = element_edges(self.elements(dimension), self.size)
        across = np.setdiff1d(every, keys_of(along, self.size), assume_unique=True)
        return springs_of([(along, EDGE), (pairs_of(across, self.size), SHEAR)], self.rest_points(dimension))


class Mesh(Network):
    """Custom points with elements of one kind; springs are the edges of elements, or the given pairs.

    With `bend` there are also springs across each edge of two triangles, between their opposite corners, unless these
    are joined already.
    """

    kind: Literal["mesh"] = "mesh"
    vertices: tuple[Point, ...] = Field(min_length=1, description="m, initial positions of particles")
    pairs: tuple[tuple[Particle, Particle], ...] | None = Field(
        default=None, description="springs (default: the edges of its elements)"
    )
    rest: tuple[Annotated[float, Field(ge=0, le=1e100)], ...] | None = Field(
        default=None, description="m, of each pair (default: distance of its ends / stretch)"
    )
    bars: tuple[tuple[Particle, Particle], ...] = Field(default=(), description="elements of two corners")
    triangles: tuple[tuple[Particle, Particle, Particle], ...] = Field(
        default=(), description="elements of three corners"
    )
    tetrahedra: tuple[tuple[Particle, Particle, Particle, Particle], ...] = Field(
        default=(), description="elements of four corners"
    )
    angles: tuple[tuple[Particle, Particle, Particle], ...] = Field(default=(), description="hinges: end, apex, end")
    bend: bool = Field(default=False, description="True: also springs across the common edges of triangles")

    _ELEMENTS: ClassVar[tuple[str, ...]] = ("bars", "triangles", "tetrahedra")

    @property
    def size(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    def _given_points(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        return ((f"vertices[{k}]", point) for k, point in enumerate(self.vertices))

    def _refuse_shape(self) -> None:
        given = [name for name in self._ELEMENTS if getattr(self, name)]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)}: elements are of one kind; give one of them")
        if self.tetrahedra and self.dimension == 2:
            raise ValueError("tetrahedra: vertices have 2 coordinates, they need 3")
        for name in ("pairs", *self._ELEMENTS, "angles"):
            check_rows(name, getattr(self, name) or (), self.size)
        thin = flat(self.vertices, self._element_array())
        if len(thin):
            raise ValueError(f"{given[0]}[{thin[0]}] = {getattr(self, given[0])[thin[0]]}: it has no extent")
        if self.rest is not None and len(self.rest) != len(self.pairs or ()):
            raise ValueError(
                f"rest: {len(self.rest)} lengths for {len(self.pairs or ())} pairs; one for each is needed"
            )
        if self.rest is not None and self.stretch != 1:
            raise ValueError(
                f"stretch = {self.stretch:g}: rest already gives the lengths of the springs; give one of the two"
            )
        if self.bend:
            self._refuse_bend()
        if self.lumping == "geometric":
            self.masses(1.0, len(self.vertices[0]))  # raises ValueError if a particle is part of no element

    def _refuse_bend(self) -> None:
        """Raise ValueError if there are no triangles, or three at an edge, so that opposite corners are not defined."""
        if not self.triangles:
            raise ValueError("bend = True: needs triangles")
        try:
            dihedrals(self._element_array())
        except ValueError as error:
            raise ValueError(f"bend = True: {error}") from None

    def _element_array(self) -> Ints:
        """Return the elements as given; an empty array of bars if there are none."""
        given = next((rows for rows in (self.triangles, self.tetrahedra) if rows), self.bars)
        return np.array(given, np.int32) if given else np.zeros((0, 2), np.int32)

    def points(self, dimension: int) -> Floats:
        """Return the vertices."""
        self._check_dimension(dimension)
        return np.array(self.vertices, float)

    def springs(self, dimension: int) -> Springs:
        """Return the given pairs, or the edges of elements, as springs; with `bend` also those of opposite corners."""
        self._check_dimension(dimension)
        if self.pairs is None:
            pairs = pairs_of(element_edges(self._element_array(), self.size), self.size)
        else:
            pairs = np.array(self.pairs, np.int32).reshape(-1, 2)
        keys = keys_of(pairs, self.size)
        opposite = dihedrals(self._element_array())[:, 2:] if self.bend else np.zeros((0, 2), np.int32)
        across = pairs_of(np.setdiff1d(keys_of(opposite, self.size), keys), self.size)
        found = springs_of([(pairs, EDGE), (across, BEND)], self.rest_points(dimension))
        if self.rest is not None:
            found.rest[found.role == EDGE] = np.array(self.rest, float)[np.argsort(keys)]
        return found

    def hinges(self, dimension: int) -> Ints:
        """Return the given angles."""
        self._check_dimension(dimension)
        return np.array(self.angles, np.int32).reshape(-1, 3)

    def check_elements(self, dimension: int) -> None:
        """Raise ValueError if triangles make up no sound surface in 3-D, or tetrahedra no sound body; see check_mesh.

        Vertices in one place are allowed if a spring joins them. In 2-D triangles may be folded over each other.
        """
        if self.tetrahedra or (self.triangles and dimension == 3):
            points, springs = self.points(dimension), self.springs(dimension)
            refuse_coincident(points, np.stack([springs.i, springs.j], axis=1))
            check_mesh(points, self.elements(dimension))

    def elements(self, dimension: int) -> Ints:
        """Return the given bars, triangles or tetrahedra."""
        self._check_dimension(dimension)
        return orient(self.points(dimension), self._element_array())


AnyNetwork = Annotated[Rope | Cloth | Jelly | Mesh | Blocks, Field(discriminator="kind")]
"""A network of any kind, as a field of a record: read from a file, its `kind` selects the class."""


# --- lattices -------------------------------------------------------------------------------------------------------

_SIDES = {"left": (0, 0), "right": (0, -1), "bottom": (-1, 0), "top": (-1, -1), "front": (1, 0), "back": (1, -1)}
"""The axis perpendicular to each side, and the index of the side along it: first (0) or last (-1)."""

_FIVE = [(0, 3, 5, 6), (1, 0, 3, 5), (2, 0, 3, 6), (4, 0, 5, 6), (7, 3, 5, 6)]
"""Corners of a cell's five tetrahedra: one in the middle and four at corners of the cell."""

_SIX = [(0, 1 << a, (1 << a) | (1 << b), 7) for a, b in itertools.permutations(range(3), 2)]
"""Corners of a cell's six tetrahedra around its diagonal. Source: Kuhn 1960, IBM J. Res. Dev. 4, 518."""

_CUTS = {
    (2, "alternating"): np.array([[(0, 1, 3), (0, 3, 2)], [(0, 1, 2), (1, 3, 2)]]),
    (2, "parallel"): np.array([[(0, 1, 3), (0, 3, 2)]]),
    (3, "alternating"): np.array([_FIVE, [tuple(corner ^ 1 for corner in cut) for cut in _FIVE]]),
    (3, "parallel"): np.array([_SIX]),
}
"""Corners of the elements of a cell, and of its mirror image: bit k of a corner is its end of edge k."""


def _runs(ids: Ints, axis: int, length: int) -> Ints:
    """Return all runs of `length` consecutive particles along an axis of a lattice, (R, length)."""
    count = max(ids.shape[axis] - length + 1, 0)
    rows = np.moveaxis(ids, axis, -1)
    parts = [np.moveaxis(rows[..., k : k + count], -1, axis) for k in range(length)]
    return np.stack([part.ravel(order="F") for part in parts], axis=1)


def _refuse_edges(edges: tuple[tuple[float, ...], ...]) -> None:
    """Raise ValueError if an edge has length 0, two edges are parallel, or three in one plane."""
    lengths = np.linalg.norm(edges, axis=1)
    for k in np.flatnonzero(~(lengths > 0)):
        raise ValueError(f"edges[{k}] = {edges[k]}: it has no length")
    if np.linalg.svd(np.array(edges) / lengths[:, None], compute_uv=False)[-1] < 1e-9:
        raise ValueError(f"edges = {edges}: they are {'parallel' if len(edges) == 2 else 'in one plane'}")


def _frame(direction: Floats, lateral: Floats) -> tuple[Floats, Floats]:
    """Return unit vectors along `direction` and perpendicular to it, towards `lateral` unless that is parallel."""
    axes = np.eye(len(direction))
    along = direction / np.linalg.norm(direction) if direction.any() else axes[0]
    for towards in (lateral / np.linalg.norm(lateral) if lateral.any() else lateral, axes[np.argmin(np.abs(along))]):
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
