"""The table of shapes that kernels read, one row each, and loops over points for Python.

A row is a header, the same for every form (see row_header.py), then the numbers of its form: see chain.py, block.py and
field.py. All positions are relative to the anchor, so that on a torus the nearest image is used, and float32 loses no
accuracy far from the origin. Rows of one form lie one after another.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.geometry.shapes.joints import joints
from flockenv.jit.decorators import Law
from flockenv.jit.section import entry_of, vector
from flockenv.maths.vectors import sub

__all__ = ["FORMS", "Floats", "hits", "law_of", "nearest", "pack_shapes"]

Floats = NDArray[np.float64]

FORMS = {
    "chain": "flockenv.geometry.shapes.chain",
    "block": "flockenv.geometry.shapes.block",
    "half_space": "flockenv.geometry.shapes.block",
    "distance_field": "flockenv.geometry.shapes.field",
    "hollow_chain": "flockenv.geometry.shapes.inverted",
    "hollow_block": "flockenv.geometry.shapes.inverted",
    "hollow_distance_field": "flockenv.geometry.shapes.inverted",
}
"""The forms of rows, and the modules of their laws `nearest_FORM` and `hit_FORM`."""


UP = 1 + 1e-6
"""Factor that enlarges bounds, so that points beyond are clear of the shape also with float32 rounding."""


def pack_shapes(
    shapes: Sequence[Any], dimension: int, first: int = 0, period: Floats | None = None
) -> tuple[Floats, dict[str, tuple[int, int]]]:
    """Return the table of some shapes, numbered from `first`, and (first index, number of rows) of each form.

    dimension: 2 or 3.

    period: the edges of a torus, m, across which walls may be joined.
    """
    rows: list[Floats] = []
    where: dict[str, tuple[int, int]] = {}
    at = 0
    chains = [k for k, shape in enumerate(shapes) if shape.form == "chain" and not shape.row(dimension)[2]]
    ends = joints(shapes, chains, period) if chains else {}
    for number, form in enumerate(FORMS):
        mine = [(first + k, shape) for k, shape in enumerate(shapes) if shape.form == form]
        if mine:
            where[form] = (at, len(mine))
        for who, shape in mine:
            body = [*shape.row(dimension), *ends.get(who - first, ())]
            row = np.concatenate([[0.0, who], _head(shape, number), body])
            row[0] = len(row)
            rows.append(row)
            at += len(row)
    return np.concatenate(rows) if rows else np.zeros(0), where


def _head(shape: Any, form: int) -> list[float]:
    """Return the header of a row without its length and number; see row_header.py."""
    bound = shape.bound
    middle = bound.centre - np.array(shape.anchor)
    return [*shape.anchor, float(form), *middle, *(bound.half * UP), bound.radius * UP, *shape.motion]


@functools.cache
def law_of(verb: str, form: str) -> Law:
    """Return the law `VERB_FORM` of a form, such as `nearest_chain` or `hit_chain`, from the form's module."""
    law: Law = getattr(importlib.import_module(FORMS[form]), f"{verb}_{form}")
    return law


@entry_of
def _nearest_of_points(law: Law, dimension: int) -> Callable[..., None]:
    row = vector(dimension)

    def nearest_of_points(table: Any, points: Any, gap: Any, normal: Any) -> None:
        for r in range(points.shape[0]):
            gap[r], out = law(table, 0, sub(row(points[r], 0), row(table, 2)))
            for k in range(dimension):
                normal[r, k] = out[k]

    return nearest_of_points


@entry_of
def _hits_along_rays(law: Law, dimension: int) -> Callable[..., None]:
    row = vector(dimension)

    def hits_along_rays(table: Any, points: Any, rays: Any, clearance: Any, distance: Any) -> None:
        for r in range(points.shape[0]):
            at = sub(row(points[r], 0), row(table, 2))
            distance[r] = law(table, 0, at, row(rays[r], 0), clearance[r])

    return hits_along_rays


def _flat(points: ArrayLike) -> tuple[Floats, tuple[int, ...]]:
    array = np.ascontiguousarray(points, np.float64)
    return array.reshape(-1, array.shape[-1]), array.shape[:-1]


def nearest(shape: Any, points: ArrayLike) -> tuple[Floats, Floats]:
    """Return the distances to the surface of points (..., D), (...) m, and the outward unit normals there (..., D)."""
    flat, lead = _flat(points)
    gap, normal = np.empty(len(flat)), np.empty_like(flat)
    _nearest_of_points(law_of("nearest", shape.form), flat.shape[1])(shape.table, flat, gap, normal)
    return gap.reshape(lead), normal.reshape((*lead, flat.shape[1]))


def hits(shape: Any, points: ArrayLike, directions: ArrayLike, clearance: ArrayLike) -> Floats:
    """Return the distances along unit directions (..., D) at which bodies touch it, (...) m; inf if never.

    clearance: the radii of the bodies, m.
    """
    flat, lead = _flat(np.broadcast_arrays(points, directions)[0])
    ways, _ = _flat(np.broadcast_arrays(points, directions)[1])
    room = np.ascontiguousarray(np.broadcast_to(np.asarray(clearance, np.float64), lead)).reshape(-1)
    out = np.empty(len(flat))
    _hits_along_rays(law_of("hit", shape.form), flat.shape[1])(shape.table, flat, ways, room, out)
    return out.reshape(lead)
