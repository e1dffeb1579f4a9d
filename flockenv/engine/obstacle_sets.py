"""The obstacles of a kernel plan: which forms there are, and which of them laws use."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flockenv.engine.parameters import NumberPlan
from flockenv.engine.shape_rows import FormPlan, Surroundings
from flockenv.geometry.shapes import pack_shapes
from flockenv.geometry.shapes.cells import CIRCLES, cells_of, fewest_rows
from flockenv.geometry.space import Space
from flockenv.physics.effects.effect import Effect, Sight

__all__ = ["ObstacleSets"]

MOST_NUMBERS = 2**24
"""Numbers of a form's rows and of their grid, up to which single precision represents indices exactly."""


class ObstacleSets:
    """The part of `KernelPlan` that is about obstacles."""

    dimension: int
    space: Space
    effects: tuple[Effect, ...]
    shapes: tuple[Any, ...]
    circles: tuple[Any, ...]

    if TYPE_CHECKING:

        @functools.cached_property
        def sights(self) -> list[Sight]:
            """See KernelPlan."""

        @property
        def number_plan(self) -> NumberPlan:
            """See KernelPlan."""

    @functools.cached_property
    def shape_table(self) -> tuple[NDArray[np.float64], dict[str, tuple[int, int]]]:
        """The table of shapes that are not in the state, and, by form, where the rows begin and how many there are."""
        if not self.reads_obstacles:
            return np.zeros(0), {}
        period = np.array(self.space.extent(self.dimension)) if self.space.periodic else None
        return pack_shapes(self.shapes, self.dimension, len(self.circles), period)

    @property
    def moving(self) -> bool:
        """True if any of them moves."""
        return any(shape.moves for shape in self.shapes)

    @functools.cached_property
    def bounded_forms(self) -> tuple[str, ...]:
        """The forms of shapes that are skipped if out of reach; empty if some fold has no reach.

        These are the forms whose laws loop over edges or cells. Laws of blocks and half-spaces are evaluated lane
        beside lane, so some lane would need the whole law anyhow: a test was not faster there, with rays or without.
        """
        return (
            tuple(form for form in ("chain", "distance_field") if form in self.shape_table[1]) if self.reaches else ()
        )

    @property
    def reaches(self) -> bool:
        """True if all folds over obstacles have a reach."""
        folds = [e for e in self.effects if e.obstacle_start is not None]
        return bool(folds) and all(e.obstacle_reach is not None for e in folds)

    @functools.cached_property
    def cells(self) -> dict[str, NDArray[np.float64]]:
        """Grids over the circles of the state and the shapes of each finite form, if many: see shapes/cells.py."""
        table, forms = self.shape_table
        period = np.array(self.space.extent(self.dimension)) if self.space.periodic else None
        found = {}
        for form, (begin, count) in forms.items():
            if form in ("chain", "block", "distance_field") and count >= fewest_rows(form, self.dimension):
                mine = [shape for shape in self.shapes if shape.form == form]
                lengths = [int(table[begin])]
                while len(lengths) < count:
                    lengths.append(int(table[begin + sum(lengths)]))
                rows = np.cumsum([0, *lengths[:-1]]).tolist()
                grid = cells_of(mine, rows, period)
                if max(rows[-1], len(grid)) < MOST_NUMBERS:
                    found[form] = grid
        if self.reads_obstacles and len(self.circles) >= fewest_rows(CIRCLES, self.dimension):
            grid = cells_of(self.circles, range(len(self.circles)), period)
            if len(grid) < MOST_NUMBERS:
                found[CIRCLES] = grid
        return found

    @property
    def gridded_forms(self) -> tuple[str, ...]:
        """The forms for which folds use only the shapes that may lie within reach, found by a grid."""
        return tuple(self.cells) if self.reaches else ()

    @property
    def only_rays(self) -> bool:
        """True if all folds over obstacles cast rays."""
        return all(e.obstacle_ray is not None for e in self.effects if e.obstacle_start is not None)

    @property
    def folds_obstacles(self) -> bool:
        """True if any effect has a fold over the obstacles."""
        return any(e.obstacle_start is not None for e in self.effects)

    @property
    def surroundings(self) -> Surroundings:
        """Constants of the code about obstacles."""
        plans = zip(self.shape_table[1], self.number_plan.forms, strict=True)
        forms = tuple(FormPlan(form, *plan) for form, plan in plans)
        circles = FormPlan(CIRCLES, self.number_plan.circles, True) if CIRCLES in self.cells else None
        return Surroundings(self.dimension, self.space.offset_law, self.moving, circles, forms)

    @property
    def reads_obstacles(self) -> bool:
        """True if some law depends on obstacles, or on what they hide."""
        return any(e.obstacle_law is not None for e in self.effects) or self.occludes

    @property
    def occludes(self) -> bool:
        """True if agents, or obstacles, may be hidden by obstacles."""
        return any(sight.occluded for sight in self.sights) or any(e.occluded_obstacles for e in self.effects)
