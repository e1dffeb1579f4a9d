"""Contacts of a face and a point, or of two edges: found within a step, and resolved by impulses.

A contact is four vertices with weights, which add up to 0, and a normal: the weighted sum of positions, along the
normal, is the distance. Two things may not come nearer than the sum of their radii and the thickness.
Sources: Bridson, Fedkiw and Anderson 2002, Robust treatment of collisions, contact and friction for cloth animation;
Li, Kaufman and Jiang 2021, Codimensional incremental potential contact, section 5 (additive advancement).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.geometry.box_tree import find_overlaps, fit_parents
from flockenv.geometry.closest_points import closest_point_face, closest_segments, weighted
from flockenv.jit.decorators import Numbers, Vec, kernel, routine
from flockenv.maths.vectors import add, dot, norm, scale, sub
from flockenv.physics.constraints.broad_phase import vector_at

__all__ = [
    "EDGES", "FACE", "NEAR", "PUSH", "Contacts", "Motion", "Pairs", "add_contact", "apply_contact", "find_pairs",
    "first_contact",
]  # fmt: skip

EDGES, FACE = 0, 1
"""Kinds of pairs: two edges; a point and a face."""

NEAR = 2.0
"""Distance, in thicknesses, up to which pairs have a contact from the start of a step on."""

KEPT, KEPT_CLOSE, CLOSE = 0.1, 0.8, 1e-3
"""Part of the gap, or of the thickness, that each pair keeps within a step, and if the gap is below CLOSE of it."""

PUSH = 0.1
"""Part of the missing distance that is restored in each step, without a change of velocity (Bridson et al.)."""

ADVANCES = 200
"""Most advances along a path; a pair that is undecided after them counts as one that touches."""


class Motion(NamedTuple):
    """A step of V vertices: each moves from `start` along a straight line to start + move."""

    start: Any  # (V, 3) m
    move: Any  # (V, 3) m
    speed: Any  # (V, 3) m/s, at the end
    live: Any  # (V,)
    mark: Any  # (V,) clock of the last change of `move`
    touched: Any  # (V,) 1 if `move` or `speed` was changed in this step


class Pairs(NamedTuple):
    """Pairs whose boxes overlap, and scratch memory of the search."""

    who: Any  # (K, 4) vertices
    kind: Any  # (K,)
    stack: Any  # (DEEPEST,)
    found: Any  # (E or F,)
    box: Any  # (2, 3) m


class Contacts(NamedTuple):
    """Contacts of a step, in the order in which they were found."""

    who: Any  # (K, 4)
    weight: Any  # (K, 4)
    normal: Any  # (K, 3)
    least: Any  # (K,) m, smallest change of distance in the step
    used: Any  # (K,) 1 if it had to act


@kernel
def _fit_leaf(tree: Any, k: int, who: Any, whole: Any, motion: Any, radius: Any) -> None:
    """Set the box of element k to that of the paths of its vertices; an empty one if it is not whole."""
    at = tree.order.shape[0] - 1 + tree.leaf[k]
    for c in range(3):
        tree.box[at, c], tree.box[at, 3 + c] = np.inf, -np.inf
    if not whole[k]:
        return
    for j in range(who.shape[1]):
        i = who[k, j]
        if not motion.live[i]:
            for c in range(3):
                tree.box[at, c], tree.box[at, 3 + c] = np.inf, -np.inf
            return
        for c in range(3):
            a = motion.start[i, c]
            b = a + motion.move[i, c]
            tree.box[at, c] = min(tree.box[at, c], min(a, b) - radius[i])
            tree.box[at, 3 + c] = max(tree.box[at, 3 + c], max(a, b) + radius[i])


@kernel
def _write(pairs: Any, count: int, kind: int, a: int, b: int, c: int, d: int) -> int:
    """Append a pair if there is room; return the new count."""
    if count < pairs.kind.shape[0]:
        pairs.kind[count] = kind
        pairs.who[count, 0], pairs.who[count, 1], pairs.who[count, 2], pairs.who[count, 3] = a, b, c, d
    return count + 1


@kernel
def _fresh(motion: Any, light: Any, since: int, a: int, b: int, c: int, d: int) -> bool:
    """Return True if a vertex of a pair has changed since a clock, and one can move."""
    mark = motion.mark
    return (mark[a] >= since or mark[b] >= since or mark[c] >= since or mark[d] >= since) and (  # type: ignore[no-any-return]
        light[a] + light[b] + light[c] + light[d] > 0.0
    )


@kernel
def _refit(tree: Any, who: Any, whole: Any, motion: Any, radius: Any) -> None:
    """Fit all boxes to the paths of the elements."""
    for k in range(who.shape[0]):
        _fit_leaf(tree, k, who, whole, motion, radius)
    fit_parents(tree)


@kernel
def _pair_with_faces(mesh: Any, motion: Any, pairs: Any, reach: float, since: int) -> int:
    """Write the pairs of points and faces; return their number."""
    low, high, count = pairs.box[0], pairs.box[1], 0
    for k in range(mesh.points.shape[0]):
        p = mesh.points[k]
        if not motion.live[p]:
            continue
        for c in range(3):
            a = motion.start[p, c]
            b = a + motion.move[p, c]
            low[c], high[c] = min(a, b) - mesh.radius[p] - reach, max(a, b) + mesh.radius[p] + reach
        for q in range(find_overlaps(mesh.face_tree, low, high, pairs.stack, pairs.found)):
            f = mesh.faces[pairs.found[q]]
            if p != f[0] and p != f[1] and p != f[2] and _fresh(motion, mesh.light, since, p, f[0], f[1], f[2]):
                count = _write(pairs, count, FACE, p, f[0], f[1], f[2])
    return count


@kernel
def _pair_edges(mesh: Any, motion: Any, pairs: Any, reach: float, since: int, count: int) -> int:
    """Append the pairs of edges; return the number of all pairs."""
    low, high, tree = pairs.box[0], pairs.box[1], mesh.edge_tree
    for k in range(mesh.edges.shape[0]):
        a, b = mesh.edges[k, 0], mesh.edges[k, 1]
        at = tree.order.shape[0] - 1 + tree.leaf[k]
        for c in range(3):
            low[c], high[c] = tree.box[at, c] - reach, tree.box[at, 3 + c] + reach
        for q in range(find_overlaps(tree, low, high, pairs.stack, pairs.found)):
            o = pairs.found[q]
            c0, c1 = mesh.edges[o, 0], mesh.edges[o, 1]
            shared = o <= k or a in (c0, c1) or b in (c0, c1)
            if not shared and _fresh(motion, mesh.light, since, a, b, c0, c1):
                count = _write(pairs, count, EDGES, a, b, c0, c1)
    return count


@routine
def find_pairs(mesh: Any, motion: Any, pairs: Any, reach: float, since: int) -> int:
    """Write all pairs whose paths may come within `reach`, and that changed since a clock; return their number.

    Pairs with a common vertex are left out. More than there is room for are counted only.
    """
    _refit(mesh.face_tree, mesh.faces, mesh.whole_faces, motion, mesh.radius)
    _refit(mesh.edge_tree, mesh.edges, mesh.whole_edges, motion, mesh.radius)
    count = _pair_with_faces(mesh, motion, pairs, reach, since)
    return _pair_edges(mesh, motion, pairs, reach, since, count)


@kernel
def _closest(kind: int, a: Vec, b: Vec, c: Vec, d: Vec) -> Numbers:
    """Return the weights of the closest points of a pair."""
    if kind == FACE:
        return closest_point_face(a, b, c, d)
    return closest_segments(a, b, c, d)


@kernel
def _gap_to_keep(distance: float, rest: float, thickness: float) -> tuple[float, float]:
    """Return the distance that a pair keeps within a step, and the tolerance; rest: sum of radii; m."""
    gap = distance - rest
    if gap <= 0.0:
        return 0.5 * distance, 0.02 * distance
    room = min(gap, thickness)
    part = KEPT if gap > CLOSE * thickness else KEPT_CLOSE
    return rest + part * room, 0.02 * room


@routine
def first_contact(
    kind: int, who: Any, motion: Any, radius: Any, thickness: float
) -> tuple[int, float, float, Vec, Numbers]:
    """Return if a pair touches within a step: 1, 0, or -1 if it has no distance at the start.

    Then its distance at the start and the sum of its radii, m, and the offset and weights of its closest points at that
    time; if it does not touch, those of the start.

    Distances decrease at most as fast as the vertices move, less their common motion; so steps of the time that this
    leaves never miss a contact, and no cubic equation has to be solved.
    """
    size = (0.0, 0.0, 0.0)
    a, b = vector_at(size, motion.start, who[0]), vector_at(size, motion.start, who[1])
    c, d = vector_at(size, motion.start, who[2]), vector_at(size, motion.start, who[3])
    w = _closest(kind, a, b, c, d)
    off = weighted(w, a, b, c, d)
    first = norm(off)
    ua, ub = vector_at(size, motion.move, who[0]), vector_at(size, motion.move, who[1])
    uc, ud = vector_at(size, motion.move, who[2]), vector_at(size, motion.move, who[3])
    mean = scale(add(add(ua, ub), add(uc, ud)), 0.25)
    ua, ub, uc, ud = sub(ua, mean), sub(ub, mean), sub(uc, mean), sub(ud, mean)
    if kind == FACE:
        way, rest = norm(ua) + max(norm(ub), max(norm(uc), norm(ud))), radius[who[0]]
    else:
        way = max(norm(ua), norm(ub)) + max(norm(uc), norm(ud))
        rest = radius[who[0]] + radius[who[2]]
    if first <= 1e-9 * thickness:
        return -1, first, rest, off, w
    keep, little = _gap_to_keep(first, rest, thickness)
    if first - keep > way:
        return 0, first, rest, off, w
    far, t, distance = off, 0.0, first
    near = w
    for _ in range(ADVANCES):
        t += 0.9 * (distance - keep) / way
        if t >= 1.0:
            return 0, first, rest, off, w
        pa, pb = add(a, scale(ua, t)), add(b, scale(ub, t))
        pc, pd = add(c, scale(uc, t)), add(d, scale(ud, t))
        near = _closest(kind, pa, pb, pc, pd)
        far = weighted(near, pa, pb, pc, pd)
        distance = norm(far)
        if distance - keep < little:
            break
    return 1, first, rest, far, near


@routine
def add_contact(
    contacts: Any, count: int, who: Any, motion: Any, rest: float, off: Vec, w: Numbers, push: float
) -> int:
    """Append a contact along an offset of closest points; return the new count, or -1 if there is no room.

    rest: distance to keep, m; push: part of a missing distance that is restored.
    """
    if count >= contacts.least.shape[0]:
        return -1
    n, start = scale(off, 1.0 / norm(off)), 0.0
    for k in range(4):
        contacts.who[count, k], contacts.weight[count, k] = who[k], w[k]
        start += w[k] * dot(n, vector_at(n, motion.start, who[k]))
    for k in range(3):
        contacts.normal[count, k] = n[k]
    contacts.least[count] = rest - start if start >= rest else push * (rest - start)
    contacts.used[count] = 0
    return count + 1


@routine
def apply_contact(
    contacts: Any, k: int, array: Any, motion: Any, light: Any, friction: float, ends: bool, clock: int
) -> float:
    """Act on moves, or with `ends` on speeds, by an impulse and its friction; return the change along the normal.

    Opposite impulses on the two things conserve momentum. Of speeds only the approach is removed, so no energy is
    gained.
    """
    u, yields = (0.0, 0.0, 0.0), 0.0
    for j in range(4):
        u = add(u, scale(vector_at(u, array, contacts.who[k, j]), contacts.weight[k, j]))  # type: ignore[assignment]
    n = vector_at(u, contacts.normal, k)
    along = dot(n, u)
    slip = sub(u, scale(n, along))
    for j in range(4):
        yields += contacts.weight[k, j] * contacts.weight[k, j] * light[contacts.who[k, j]]
    least = 0.0 if ends else contacts.least[k]
    need = least - along
    if need <= 0.0 or yields <= 0.0:
        return 0.0
    speed, pressed = norm(slip), need - max(least, 0.0)
    held = min(friction * max(pressed, 0.0), speed) / speed if speed > 0.0 else 0.0
    change = sub(scale(n, need / yields), scale(slip, held / yields))
    for j in range(4):
        i = contacts.who[k, j]
        by = contacts.weight[k, j] * light[i]
        if by != 0.0:
            motion.mark[i], motion.touched[i] = clock, 1
            for c in range(3):
                array[i, c] += by * change[c]
    return need
