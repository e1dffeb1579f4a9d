"""Obstacles: circles, capsules, walls, polygons, blocks, half-spaces, distance fields; in 2-D and (but polygons) 3-D.

`round`, `chain`, `block`, `field` hold the laws of one agent and one shape, `inverted` those of shapes that bodies stay
in, `edges` those of a silhouette; `row_header` reads what rows of every form share, bounds and motion; `dispatch` calls
the law of a row's form at run time; `table` packs shapes for kernels, `cells` puts them on a grid, `joints` finds
joined walls; `shape` has the base classes, `records` what scenes list; `outlines` are for pictures.
"""

from __future__ import annotations

from flockenv.geometry.shapes.records import (
    SHAPES,
    AnyShape,
    Block,
    Bound,
    Capsule,
    Circle,
    DistanceField,
    HalfSpace,
    Polygon,
    Shape,
    Sway,
    Wall,
    distance_to_shapes,
)
from flockenv.geometry.shapes.round import blocks, gap, normal, ray_hit, silhouette, touched_normal
from flockenv.geometry.shapes.table import FORMS, pack_shapes

__all__ = [
    "FORMS", "SHAPES", "AnyShape", "Block", "Bound", "Capsule", "Circle", "DistanceField", "HalfSpace", "Polygon",
    "Shape", "Sway", "Wall", "blocks", "distance_to_shapes", "gap", "normal", "pack_shapes", "ray_hit", "silhouette",
    "touched_normal",
]  # fmt: skip
