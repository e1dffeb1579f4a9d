"""Obstacles: circles, capsules, walls, polygons, blocks, half-spaces, distance fields and meshes, in 2-D and 3-D.

`round`, `chain`, `block`, `field` have the laws of one agent and one shape, `inverted` those of hollow shapes, `edges`
those of silhouettes; `row_header` reads bounds and motion, which rows of every form have; `dispatch` calls the law of a
row's form at run time; `table` packs shapes for kernels, `cells` sorts them into a grid, `joints` finds joined walls;
`shape` and `grid_shape` have the base classes, `records` and `triangle_mesh` the kinds that scenes list; `outlines` is
for pictures. Polygons are in 2-D only, meshes in 3-D.
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
    TriangleMesh,
    Wall,
    distance_to_shapes,
)
from flockenv.geometry.shapes.round import blocks, gap, normal, ray_hit, silhouette, touched_normal
from flockenv.geometry.shapes.table import FORMS, pack_shapes

__all__ = [
    "FORMS", "SHAPES", "AnyShape", "Block", "Bound", "Capsule", "Circle", "DistanceField", "HalfSpace", "Polygon",
    "Shape", "Sway", "TriangleMesh", "Wall", "blocks", "distance_to_shapes", "gap", "normal", "pack_shapes", "ray_hit",
    "silhouette", "touched_normal",
]  # fmt: skip
