"""Obstacles: circles, capsules, walls, polygons, blocks, half-spaces, distance fields; in 2-D and (but polygons) 3-D.

`round`, `chain`, `block`, `field` hold the laws of one agent and one shape, `hollow` those of shapes that bodies stay
in; `head` what laws may ask whatever the form: bounds, and how it moves; `every` the laws of whatever form a row has;
`table` how kernels are handed shapes; `records` what scenes list; `outlines` what pictures show.
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
    clear_of,
)
from flockenv.geometry.shapes.round import blocks, gap, normal, ray_hit, silhouette, touched_normal
from flockenv.geometry.shapes.table import FORMS, packed

__all__ = [
    "FORMS", "SHAPES", "AnyShape", "Block", "Bound", "Capsule", "Circle", "DistanceField", "HalfSpace", "Polygon",
    "Shape", "Sway", "Wall", "blocks", "clear_of", "gap", "normal", "packed", "ray_hit", "silhouette", "touched_normal",
]  # fmt: skip
