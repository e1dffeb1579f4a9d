"""Blocks: equal cuboids, or rectangles in 2-D, as networks of their corners and centres."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from flockenv.geometry.shapes import Block
from flockenv.model.network import EDGE, Floats, Ints, Length, Network, Point, Springs, orient, springs_of

__all__ = ["Blocks"]

Turn = Annotated[tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...], Field(min_length=1, max_length=3)]

CORNERS = 1 / 3
"""Part of a block's mass that its corners carry; the rest is at its centre. It gives the inertia of a solid block."""


class Blocks(Network):
    """Equal solid blocks, each of its corners and its centre; the constraint `rigid_bodies` keeps them rigid.

    The corners carry a third of a block's mass and the centre the rest, so that mass, centre and tensor of inertia are
    those of a homogeneous cuboid, or in 2-D rectangle. Particles of a block are in order: its corners, along the first
    edge first, then its centre. `mass` of the group is the mean of particles: a ninth of a cuboid, a fifth of a
    rectangle.
    """

    kind: Literal["blocks"] = "blocks"
    sides: Annotated[tuple[Length, ...], Field(min_length=2, max_length=3)] = Field(description="m, edges of a block")
    centres: tuple[Point, ...] = Field(min_length=1, description="m, initial centre of each block")
    turns: tuple[Turn, ...] = Field(
        default=(),
        description="degrees, initial rotations, one for all or one for each: [angle] in 2-D, in 3-D a vector along "
        "the axis (default: none)",
    )
    spins: tuple[Turn, ...] = Field(
        default=(), description="rad/s, initial angular velocities, likewise (default: none)"
    )

    @property
    def size(self) -> int:
        """Number of particles: the corners and the centre of each block."""
        return len(self.centres) * self.each

    @property
    def each(self) -> int:
        """Number of particles of a block."""
        return (1 << len(self.sides)) + 1

    @property
    def dimension(self) -> int:
        """Dimension of space: the number of edges."""
        return len(self.sides)

    def _given_points(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        return ((f"centres[{k}]", centre) for k, centre in enumerate(self.centres))

    def _refuse_shape(self) -> None:
        d = len(self.sides)
        if len(self.centres[0]) != d:
            raise ValueError(f"sides = {self.sides}: must have {len(self.centres[0])} numbers, as centres have")
        for name in ("turns", "spins"):
            given: tuple[tuple[float, ...], ...] = getattr(self, name)
            if len(given) not in (0, 1, len(self.centres)):
                raise ValueError(f"{name}: there are {len(given)}; allowed: 0, 1 or {len(self.centres)}")
            for k, one in enumerate(given):
                if len(one) != 2 * d - 3:
                    raise ValueError(f"{name}[{k}] = {one}: must have {2 * d - 3} numbers in {d} dimensions")
        if self.pinned:
            raise ValueError(f"pinned = {self.pinned}: blocks move as a whole; one that does not is an obstacle")
        if self.moves:
            raise ValueError("moves: blocks move as a whole; a solid that moves at a constant velocity is an obstacle")
        if self.stretch != 1 or self.lumping != "equal":
            name = "lumping" if self.stretch == 1 else "stretch"
            raise ValueError(f"{name} = {getattr(self, name)}: must be left out, since blocks are rigid and solid")

    def _vectors(self, name: str) -> Floats:
        """Return a rotation of each block as a vector along its axis, (K, 3)."""
        given: tuple[tuple[float, ...], ...] = getattr(self, name)
        vectors = np.zeros((len(self.centres), 3))
        if given:
            vectors[:, 3 - len(given[0]) :] = given
        return vectors

    def _axes(self) -> Floats:
        """Return the edges of each block as unit vectors, rows of (K, D, D)."""
        d, found = len(self.sides), []
        for turn in self._vectors("turns"):
            angle = float(np.linalg.norm(turn))
            axis = tuple((turn / angle).tolist()) if angle > 0 else (0.0, 0.0, 1.0)
            if d == 2:
                angle, axis = float(turn[2]), (0.0, 0.0, 1.0)
            found.append(Block(centre=(0.0,) * d, size=(1.0,) * d, turn=angle, axis=axis).axes)
        return np.array(found)

    def offsets(self) -> Floats:
        """Return the particles of a block that is not turned, relative to its centre, (n, D) m."""
        d = len(self.sides)
        signs = [bit[::-1] for bit in itertools.product((-0.5, 0.5), repeat=d)]
        return np.array([*signs, (0.0,) * d]) * self.sides

    def points(self, dimension: int) -> Floats:
        """Return the corners and the centre of each block."""
        self._check_dimension(dimension)
        places = np.array(self.centres)[:, None] + self.offsets() @ self._axes()
        return np.asarray(places.reshape(-1, dimension))

    def velocities(self, dimension: int) -> Floats:
        """Return the velocities of particles by the spins of their blocks, (n, D) m/s."""
        off = np.zeros((len(self.centres), self.each, 3))
        off[:, :, :dimension] = self.points(dimension).reshape(-1, self.each, dimension)
        off[:, :, :dimension] -= np.array(self.centres)[:, None]
        speeds = np.cross(self._vectors("spins")[:, None], off)
        return np.asarray(speeds[:, :, :dimension].reshape(-1, dimension))

    def _of_all(self, one: list[tuple[int, ...]]) -> Ints:
        """Return rows of particles of each block, from those of the first."""
        first = self.each * np.arange(len(self.centres), dtype=np.int32)
        return np.concatenate([np.array(one, np.int32) + start for start in first])

    def springs(self, dimension: int) -> Springs:
        """Return the edges of each block."""
        self._check_dimension(dimension)
        pairs = [(i, i | 1 << k) for i in range(self.each - 1) for k in range(dimension) if not i & 1 << k]
        return springs_of([(self._of_all([*pairs]), EDGE)], self.rest_points(dimension))

    def elements(self, dimension: int) -> Ints:
        """Return elements from the centre to each edge of a rectangle, or to half of each side of a cuboid."""
        self._check_dimension(dimension)
        centre, found = self.each - 1, list[tuple[int, ...]]()
        for axis in range(dimension):
            for side in (0, 1 << axis):
                corners = [i for i in range(centre) if i & 1 << axis == side]
                found += [(centre, *part) for part in ([corners] if dimension == 2 else [corners[:3], corners[1:]])]
        return orient(self.rest_points(dimension), self._of_all(found))

    def masses(self, total: float, dimension: int) -> Floats:
        """Return the mass of each particle, (n,) kg, `total` in sum."""
        self._check_dimension(dimension)
        if not 0 < total < np.inf:
            raise ValueError(f"total = {total!r}: must be a number > 0 (kg)")
        own, corners = total / len(self.centres), self.each - 1
        one = [own * CORNERS / corners] * corners + [own * (1 - CORNERS)]
        return np.tile(np.array(one), len(self.centres))
