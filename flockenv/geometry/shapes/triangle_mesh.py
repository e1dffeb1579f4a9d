"""Obstacles given by a closed surface of triangles, in 3-D."""

from __future__ import annotations

import functools
import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.geometry.mesh_checks import check_facing, check_mesh, first_piercing
from flockenv.geometry.mesh_distance import distances_to_mesh
from flockenv.geometry.shapes.grid_shape import GridShape
from flockenv.geometry.shapes.shape import Bound
from flockenv.geometry.shapes.table import Floats
from flockenv.maths.grid import points_of

__all__ = ["TriangleMesh"]

Vertex = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]
Number = Annotated[int, Field(ge=0, strict=True)]

OFF = math.sqrt(3) / 2
"""Largest error of a distance interpolated in a cube whose corners have exact ones, in edges of the cube."""


class TriangleMesh(GridShape):
    """A solid bounded by triangles, in 3-D: its distances are those of a grid, so its cost does not depend on them.

    Distances at grid points are exact, and interpolated between them. The error is at most 0.87 `spacing`, next to
    vertices and edges; of order spacing^2 at round surfaces, and 0 at flat ones. Parts thinner than two spacings may be
    lost. Beyond the grid distances are up to some percent too large.
    """

    kind: Literal["mesh"] = "mesh"
    points: ClassVar[tuple[str, ...]] = ("vertices",)
    vertices: tuple[Vertex, ...] = Field(min_length=4, description="m, the corners of triangles")
    triangles: tuple[tuple[Number, Number, Number], ...] = Field(
        min_length=4, description="vertices of each triangle, by number from 0, counter-clockwise as seen from outside"
    )
    spacing: float = Field(gt=0, description="m, between grid points")
    margin: float | None = Field(
        default=None,
        ge=0,
        description="m, grid around the mesh, at least the largest radius of agents (default: a quarter of its longest "
        "extent, at least two spacings)",
    )

    @model_validator(mode="after")
    def _check_surface(self) -> TriangleMesh:
        """Raise ValueError unless triangles bound a solid, and some grid point lies in it."""
        points, rows, most = np.array(self.vertices), self._rows, len(self.vertices) - 1
        for k, at in np.argwhere(rows > most):
            raise ValueError(f"triangles[{k}]: there is no vertex {rows[k, at]}, they are 0 to {most}")
        corner = points[rows]
        sides = [np.linalg.norm(corner[:, k] - corner[:, k - 1], axis=1) for k in range(3)]
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        for k in np.flatnonzero(area <= 1e-10 * np.max(sides, axis=0) ** 2):
            raise ValueError(f"triangles[{k}] = {self.triangles[k]}: has no area")
        check_mesh(points, rows, closed=True)
        check_facing(points, rows)
        edges = np.unique(np.sort(np.concatenate([rows[:, :2], rows[:, 1:], rows[:, ::2]]), axis=1), axis=0)
        found = first_piercing(points, edges, rows)
        if found is not None:
            edge, triangle = edges[found[0]].tolist(), found[1]
            raise ValueError(f"triangles: the edge of vertices {edge[0]} and {edge[1]} passes through {triangle}")
        self._check_counts()
        if not (self.distances < 0).any():
            raise ValueError(f"spacing = {self.spacing:g}: no grid point is inside the mesh; give a smaller one")
        return self

    @functools.cached_property
    def _rows(self) -> NDArray[np.int64]:
        return np.array(self.triangles, np.int64)

    @functools.cached_property
    def _box(self) -> Floats:
        """The lowest and the highest corner of the triangles, (2, 3) m."""
        corners = np.array(self.vertices)[self._rows]
        return np.array([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])

    @property
    def grid_spacing(self) -> float:
        """Distance between grid points, m."""
        return self.spacing

    @functools.cached_property
    def grid_margin(self) -> float:
        """Least distance of the mesh to the edge of the grid, m."""
        given = max(0.25 * np.ptp(self._box, axis=0).max(), 2 * self.spacing) if self.margin is None else self.margin
        return float(given)

    @functools.cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of grid points along each axis."""
        edges = (np.ptp(self._box, axis=0) + 2 * self.grid_margin).tolist()
        return tuple(2 + math.ceil(edge / self.spacing - 1e-9) for edge in edges)

    @property
    def grid_low(self) -> Floats:
        """The lowest corner of the grid, whose middle is the anchor."""
        return np.asarray(self.anchor - 0.5 * self.spacing * (np.array(self.counts) - 1))

    @functools.cached_property
    def distances(self) -> Floats:
        """The distance at each grid point, (nx, ny, nz) m."""
        around = np.array(self.vertices) - self.anchor  # a mesh that is moved has the same distances
        low = (-0.5 * self.spacing * (np.array(self.counts) - 1)).tolist()
        places = points_of(low, self.spacing, self.counts)
        return distances_to_mesh(around, self._rows, places.reshape(-1, 3)).reshape(self.counts)

    @functools.cached_property
    def anchor(self) -> tuple[float, ...]:
        """The centre of the bounding box."""
        return tuple(self._box.mean(axis=0).tolist())

    @property
    def extremes(self) -> Floats:
        """The corners of the bounding box, enlarged by the largest error of a distance."""
        return self._box + OFF * self.spacing * np.array([[-1.0], [1.0]])

    @functools.cached_property
    def bound(self) -> Bound:
        """The bounding box, enlarged by the largest error of a distance."""
        if self.hollow:
            return super().bound
        half = np.ptp(self.extremes, axis=0) / 2
        return Bound(np.array(self.anchor), half, float(np.linalg.norm(half)))
