"""Checks of meshes that were made elsewhere: holes, flipped faces, elements that overlap, parts that only touch."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["check_mesh"]

Floats = NDArray[np.float64]
Ints = NDArray[Any]


class _Sides(NamedTuple):
    """The sides of E elements of k corners, E k of them: edges of triangles, faces of tetrahedra."""

    corners: Ints  # (E k, k - 1); those of a triangle in the direction in which it runs along them
    opposite: Ints  # (E k,) the other corner of the element
    order: Ints  # (E k,) sides with the same corners one after another, those of earlier elements first
    again: NDArray[np.bool_]  # (E k - 1,) True if a side has, in this order, the corners of the one before


def check_mesh(points: Floats, elements: Ints, closed: bool = False) -> None:
    """Raise ValueError, in one line, unless elements make up one or more sound bodies, sheets or networks.

    Every side belongs to at most two elements. Two triangles of a surface run along their common edge in opposite
    directions; two triangles of a plane, or tetrahedra, lie on opposite sides of what they share. What meets in a
    particle is joined by common sides there. `closed`: a surface has no border, either.

    points: (n, D); elements: (E, k) bars, which are not checked, triangles or tetrahedra, none of them degenerate.
    """
    k, dimension = elements.shape[1], points.shape[1]
    if closed and (k, dimension) != (3, 3):
        raise ValueError("closed: only a surface of triangles in 3-D is open or closed")
    if k == 2:
        return
    sides = _sides_of(elements)
    _refuse_crowded(points, sides)
    before, after = sides.order[:-1][sides.again], sides.order[1:][sides.again]
    if k == dimension + 1:
        _refuse_overlapping(points, sides, before, after)
    else:
        _refuse_flipped(points, sides, before, after)
    if closed:
        _refuse_holes(points, sides)
    _refuse_touching(points, elements, sides, before, after)


def _sides_of(elements: Ints) -> _Sides:
    k = elements.shape[1]
    turned = np.stack([np.roll(elements, -turn, axis=1) for turn in range(k)], axis=1).reshape(-1, k)
    corners, opposite = turned[:, :-1], turned[:, -1]
    key = np.sort(corners, axis=1)
    order = np.lexsort(key.T[::-1])
    again = (key[order[1:]] == key[order[:-1]]).all(axis=1)
    return _Sides(corners, opposite, order, again)


def _names(points: Floats, particles: Ints) -> str:
    """Return the positions of some particles, in words."""
    each = [_place(points[k]) for k in particles]
    return f"{', '.join(each[:-1])} and {each[-1]}"


def _place(point: Floats) -> str:
    return f"({', '.join(f'{x:.6g}' for x in point)})"


def _word(corners: Ints) -> tuple[str, str]:
    """Return what sides and their elements are called."""
    return ("edge", "triangles") if corners.shape[1] == 2 else ("face", "tetrahedra")


def _refuse_crowded(points: Floats, sides: _Sides) -> None:
    """Raise ValueError if a side belongs to three elements or more: the mesh is not a manifold there."""
    for at in np.flatnonzero(sides.again[1:] & sides.again[:-1]):
        corners = sides.corners[sides.order[at]]
        side, elements = _word(sides.corners)
        raise ValueError(f"the {side} of {_names(points, corners)} belongs to three {elements} or more; at most two do")


def _refuse_flipped(points: Floats, sides: _Sides, one: Ints, two: Ints) -> None:
    for at in np.flatnonzero(sides.corners[one, 0] == sides.corners[two, 0]):
        raise ValueError(
            f"triangles {one[at] // 3} and {two[at] // 3} face opposite directions at the edge of "
            f"{_names(points, sides.corners[one[at]])}: one of them is flipped"
        )


def _refuse_overlapping(points: Floats, sides: _Sides, one: Ints, two: Ints) -> None:
    base = points[sides.corners[one]]

    def height(opposite: Ints) -> Floats:
        edges = np.concatenate([base[:, 1:], points[opposite][:, None]], axis=1) - base[:, :1]
        return np.asarray(np.linalg.det(edges))

    k = base.shape[1] + 1
    for at in np.flatnonzero(height(sides.opposite[one]) * height(sides.opposite[two]) > 0):
        side, elements = _word(sides.corners)
        raise ValueError(
            f"{elements} {one[at] // k} and {two[at] // k} overlap: both are on the same side of their common {side}, "
            f"of {_names(points, sides.corners[one[at]])}"
        )


def _refuse_holes(points: Floats, sides: _Sides) -> None:
    alone = np.ones(len(sides.order), bool)
    alone[1:] &= ~sides.again
    alone[:-1] &= ~sides.again
    for at in np.sort(sides.order[alone]):
        edge = _names(points, sides.corners[at])
        raise ValueError(f"the surface has a hole: the edge of {edge} belongs to one triangle only")


def _refuse_touching(points: Floats, elements: Ints, sides: _Sides, one: Ints, two: Ints) -> None:
    """Raise ValueError if elements meet in a particle without being joined there by common sides."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    k, size = elements.shape[1], len(points)
    rows = []  # corners, by number in elements.ravel(), that are joined: the same particle of two elements
    for a, b in itertools.product(range(k), repeat=2):
        first, second = one // k * k + a, two // k * k + b
        rows.append(np.stack([first, second])[:, elements.ravel()[first] == elements.ravel()[second]])
    first, second = np.concatenate(rows, axis=1)
    links = coo_array((np.ones(len(first), bool), (first, second)), shape=(elements.size, elements.size))
    parts, label = connected_components(links, directed=False)
    particle = np.zeros(parts, np.int64)
    particle[label] = elements.ravel()
    for at in np.flatnonzero(np.bincount(particle, minlength=size) > 1):
        raise ValueError(
            f"parts of the mesh touch in vertex {at}, {_place(points[at])}, without a common "
            f"{_word(sides.corners)[0]}: give each part a vertex there"
        )
