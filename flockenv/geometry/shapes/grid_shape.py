"""Shapes whose distances are interpolated on a grid: the base of distance fields and of meshes."""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np

from flockenv.geometry.shapes import outlines
from flockenv.geometry.shapes.shape import Bound, Closed
from flockenv.geometry.shapes.table import Floats
from flockenv.maths.grid import MOST_POINTS, pack_grid

__all__ = ["GridShape"]


class GridShape(Closed):
    """A shape with signed distances at the points of a grid."""

    laws: ClassVar[str] = "distance_field"

    @property
    @abstractmethod
    def grid_low(self) -> Floats:
        """The lowest corner of the grid, (D,) m."""

    @property
    @abstractmethod
    def grid_spacing(self) -> float:
        """Distance between grid points, m."""

    @property
    @abstractmethod
    def counts(self) -> tuple[int, ...]:
        """Number of grid points along each axis."""

    @property
    @abstractmethod
    def distances(self) -> Floats:
        """The distance at each grid point, (nx, ny[, nz]) m."""

    def _check_counts(self) -> None:
        """Raise ValueError if the grid has too many points."""
        if math.prod(self.counts) > MOST_POINTS:
            raise ValueError(
                f"spacing = {self.grid_spacing:g}: {math.prod(self.counts):,} points; at most {MOST_POINTS:,} allowed"
            )

    @property
    def extremes(self) -> Floats:
        """The lower and the upper corner of the grid."""
        return np.array([self.grid_low, self.grid_low + self.grid_spacing * (np.array(self.counts) - 1)])

    @functools.cached_property
    def bound(self) -> Bound:
        """The box of the grid, enlarged by the greatest depth, as the solid may extend beyond the grid."""
        if self.hollow:
            return super().bound
        low, high = self.extremes
        half = (high - low) / 2 + max(0.0, -float(self.distances.min()))
        return Bound((low + high) / 2, half, float(np.linalg.norm(half)))

    @functools.cached_property
    def _grid(self) -> Floats:
        along: Any = np.gradient(self.distances, self.grid_spacing)
        slopes = np.stack(along, axis=-1)
        size = np.linalg.norm(slopes, axis=-1, keepdims=True)
        numbers = np.concatenate([self.distances[..., None], slopes / np.maximum(size, 1e-12)], axis=-1)
        return pack_grid(numbers, (self.grid_low - self.anchor).tolist(), self.grid_spacing)

    def row(self, dimension: int) -> Floats:
        """Return the grid with distances and unit gradients."""
        return self._grid

    def polygons(self, low: Floats, high: Floats) -> list[Floats]:
        """Return strips of grid cells inside the shape; in 3-D, inside its projection from above."""
        return outlines.strips(self._from_above, self.grid_low[:2].tolist(), self.grid_spacing)

    def outline(self, low: Floats, high: Floats) -> list[Floats]:
        """Return the shape's polygons; if it is hollow, strips along its surface."""
        edge = np.abs(self._from_above) - self.grid_spacing / 2
        strips = outlines.strips(edge, self.grid_low[:2].tolist(), self.grid_spacing)
        return strips if self.hollow else self.polygons(low, high)

    @property
    def _from_above(self) -> Floats:
        return self.distances if self.distances.ndim == 2 else np.asarray(self.distances.min(axis=2))
