"""Calls of the laws of a row's form, selected at run time, for kernels that are compiled once for all scenes.

The kernel of a scene is compiled for the forms in that scene, and calls their laws directly.
"""

from __future__ import annotations

from typing import Any

from flockenv.geometry.shapes.block import hit_block, hit_half_space, nearest_block, nearest_half_space
from flockenv.geometry.shapes.chain import hit_chain, nearest_chain
from flockenv.geometry.shapes.field import hit_distance_field, nearest_distance_field
from flockenv.geometry.shapes.inverted import (
    hit_hollow_block,
    hit_hollow_chain,
    hit_hollow_distance_field,
    nearest_hollow_block,
    nearest_hollow_chain,
    nearest_hollow_distance_field,
)
from flockenv.geometry.shapes.row_header import form_of
from flockenv.jit.decorators import Vec, law

__all__ = ["hit_shape", "nearest_shape"]


@law
def nearest_shape(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return the distance to the surface, m (negative in the solid), and the unit normal out of the solid.

    x: relative to the anchor. Forms are numbered in the order of `table.FORMS`.
    """
    form = form_of(table, at, x)
    if form == 0:
        return nearest_chain(table, at, x)
    elif form == 1:
        return nearest_block(table, at, x)
    elif form == 2:
        return nearest_half_space(table, at, x)
    elif form == 3:
        return nearest_distance_field(table, at, x)
    elif form == 4:
        return nearest_hollow_chain(table, at, x)
    elif form == 5:
        return nearest_hollow_block(table, at, x)
    else:
        return nearest_hollow_distance_field(table, at, x)


@law
def hit_shape(table: Any, at: int, x: Vec, direction: Vec, clearance: float) -> float:
    """Return the distance along a unit `direction` at which a body of radius `clearance` touches it, m; inf if never.

    It is 0 if the body already overlaps.
    """
    form = form_of(table, at, x)
    if form == 0:
        return hit_chain(table, at, x, direction, clearance)
    elif form == 1:
        return hit_block(table, at, x, direction, clearance)
    elif form == 2:
        return hit_half_space(table, at, x, direction, clearance)
    elif form == 3:
        return hit_distance_field(table, at, x, direction, clearance)
    elif form == 4:
        return hit_hollow_chain(table, at, x, direction, clearance)
    elif form == 5:
        return hit_hollow_block(table, at, x, direction, clearance)
    else:
        return hit_hollow_distance_field(table, at, x, direction, clearance)
