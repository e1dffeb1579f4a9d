"""Checks of meshes that were made elsewhere.

Holes, flipped faces, elements that overlap, parts that only touch or face inwards, edges that pass through faces.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.box_tree import build_tree, overlapping_pairs, set_boxes

__all__ = ["check_facing", "check_mesh", "first_piercing", "refuse_coincident"]

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


def refuse_coincident(points: Floats, joined: Ints | None = None) -> None:
    """Raise ValueError if two points, (n, D), that are no pair of `joined`, (E, 2), are in one place."""
    from scipy.spatial import KDTree

    near = KDTree(points).query_pairs(0.0, output_type="ndarray")
    if joined is not None and len(near):
        found, known = (np.sort(pairs, axis=1).astype(np.int64) @ (len(points), 1) for pairs in (near, joined))
        near = near[~np.isin(found, known)]
    if len(near):
        one, two = near[np.lexsort(near.T[::-1])[0]].tolist()
        raise ValueError(
            f"vertices {one} and {two} are in one place, {_place(points[one])} m, so nothing joins them; merge them"
        )


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


# --- surfaces that separate inside from outside -------------------------------------------------------------------


def check_facing(points: Floats, triangles: Ints) -> None:
    """Raise ValueError unless the parts of a closed surface (n, 3), (T, 3) separate a solid from what is outside it.

    The winding number is 1 in the solid and 0 elsewhere, so half of that on each part: a part that faces inwards bounds
    a cavity in another part, and one that faces outwards lies outside all others.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]]).T
    label = connected_components(coo_array((np.ones(ends.shape[1], bool), tuple(ends)), (len(points),) * 2))[1]
    corners = points[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    order = np.argsort(-area, kind="stable")
    for at in np.sort(order[np.unique(label[triangles[order, 0]], return_index=True)[1]]):  # the largest of each part
        turns = _winding_number(np.delete(corners, at, axis=0), corners[at].mean(axis=0))
        if abs(turns - 0.5) > 0.25:
            why = "faces inwards: reverse its triangles" if turns < 0.5 else "lies inside another part: leave it out"
            raise ValueError(f"the part of triangle {at}, at {_place(corners[at, 0])}, {why}")


def _winding_number(corners: Floats, x: Floats) -> float:
    """Return how often triangles (T, 3, 3) m wind around a point: the sum of solid angles / 4 pi.

    Source: van Oosterom and Strackee 1983.
    """
    a, b, c = (corners - x).transpose(1, 0, 2)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    over = (a * np.cross(b, c)).sum(axis=1)
    under = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return float(np.arctan2(over, under).sum() / (2 * np.pi))


def first_piercing(
    points: Floats, edges: Ints, triangles: Ints, count: int | None = None
) -> tuple[int, int] | None:  # fmt: skip
    """Return an edge, of (E, 2), and a triangle, of (T, 3), that have a point but no corner in common; None if none.

    count: edges and triangles of which all corners have this number or a higher one are not compared with each other.
    """
    corners, ends = points[triangles], points[edges]
    tree = build_tree(corners.mean(axis=1))
    set_boxes(tree, corners)
    edge, triangle = overlapping_pairs(tree, np.concatenate([ends.min(axis=1), ends.max(axis=1)], axis=1))
    own = (edges[edge][:, :, None] == triangles[triangle][:, None, :]).any(axis=(1, 2))
    if count is not None:
        own |= (edges[edge, 0] >= count) & (triangles[triangle, 0] >= count)
    edge, triangle = edge[~own], triangle[~own]
    found = np.flatnonzero(_pierces(ends[edge], corners[triangle]))
    return (int(edge[found[0]]), int(triangle[found[0]])) if len(found) else None


def _pierces(ends: Floats, corners: Floats) -> NDArray[np.bool_]:
    """Return True for each pair of a segment, (K, 2, 3) m, and a triangle, (K, 3, 3) m, that have a point in common.

    Those in one plane count if an end is in the triangle, or edges cross. So must the shadows of all others on a plane:
    for points that are in one plane but for rounding, volumes alone decide nothing.
    """
    p, q, (a, b, c) = ends[:, 0], ends[:, 1], corners.transpose(1, 0, 2)
    size = np.abs(corners - p[:, None]).max(axis=(1, 2)) if len(p) else np.zeros(0)
    little = 1e-12 * size**3

    def volume(*points: Floats) -> Floats:
        first = points[0]
        return np.asarray(np.linalg.det(np.stack([x - first for x in points[1:]], axis=1)))

    over, under = volume(a, b, c, p), volume(a, b, c, q)
    sides = np.stack([volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)])
    inside = (sides >= -little).all(axis=0) | (sides <= little).all(axis=0)
    flat = (np.abs(over) <= little) & (np.abs(under) <= little)
    crossing = ((over >= -little) & (under <= little)) | ((over <= little) & (under >= -little))
    return np.asarray((flat | (inside & crossing)) & _meet_from_above(ends, corners))


def _meet_from_above(ends: Floats, corners: Floats) -> NDArray[np.bool_]:
    """Return True for each segment and triangle that have a point in common, seen along the axis next to its normal."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    dropped = np.abs(normal).argmax(axis=1)
    kept = np.array([(1, 2), (0, 2), (0, 1)])[dropped][:, None]
    s, t = np.take_along_axis(ends, kept, axis=2), np.take_along_axis(corners, kept, axis=2)
    apart = np.zeros(len(s), bool)
    for tips in (s, t):  # convex shapes are apart if an edge of one separates them
        for k in range(tips.shape[1]):
            edge = tips[:, (k + 1) % tips.shape[1]] - tips[:, k]
            across = np.stack([-edge[:, 1], edge[:, 0]], axis=1)[:, :, None]
            x, y = (s @ across)[:, :, 0], (t @ across)[:, :, 0]
            apart |= (x.max(axis=1) < y.min(axis=1)) | (x.min(axis=1) > y.max(axis=1))
    along = (s[:, 1] - s[:, 0])[:, :, None]
    x, y = (s @ along)[:, :, 0], (t @ along)[:, :, 0]
    return np.asarray(~(apart | (x.max(axis=1) < y.min(axis=1)) | (x.min(axis=1) > y.max(axis=1))))
