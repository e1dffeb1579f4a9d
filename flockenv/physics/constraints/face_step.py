"""The end of a step of worlds with faces: contacts, impulses in passes, then rigid impact zones."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import finite, kernel, routine
from flockenv.physics.constraints.face_contacts import (
    NEAR,
    PUSH,
    Contacts,
    Motion,
    Pairs,
    add_contact,
    apply_contact,
    find_pairs,
    first_contact,
)
from flockenv.physics.constraints.face_mesh import FaceMesh
from flockenv.physics.constraints.face_zones import Zones, clear_zones, join, move_zones, root_of

__all__ = [
    "IMPACTS", "PASSES", "STOPPED", "UNSOLVED", "ZONES", "ZONE_SIZE", "FaceRules", "FaceScratch", "settle_faces",
]  # fmt: skip

PASSES, IMPACTS, ZONES, ZONE_SIZE, STOPPED, UNSOLVED = range(6)
"""Counters of a step, in the order of the indices that `settle_faces` is passed."""

SWEEPS = 10
"""Most sweeps over all contacts before each search for impacts, and at the end over speeds."""

SLIGHT = 1e-6
"""Change in a sweep, in thicknesses (of speeds: thicknesses per step), below which sweeps end."""


class FaceRules(NamedTuple):
    """Numbers of the constraint."""

    thickness: float  # m
    friction: float
    passes: int
    dt: float  # s


class FaceScratch(NamedTuple):
    """Scratch memory of one thread."""

    motion: Motion
    pairs: Pairs
    contacts: Contacts
    zones: Zones
    count: Any  # (6,) counters of the step


@kernel
def _load(
    x0: Any, x: Any, v: Any, alive: Any, circles: Any, radii: Any, tick: Any, b: int, mesh: Any, motion: Any, dt: float
) -> int:
    """Read the step of world b; return the first agent that is not finite, or -1."""
    n, m, bad = x.shape[2], radii.shape[1], -1
    for i in range(motion.live.shape[0]):
        motion.mark[i], motion.touched[i], motion.live[i] = 0, 0, 1
        for k in range(3):
            motion.move[i, k], motion.speed[i, k] = 0.0, 0.0
            if i < n:
                motion.start[i, k] = x0[k, b, i]
                motion.move[i, k], motion.speed[i, k] = x[k, b, i] - x0[k, b, i], v[k, b, i]
                if alive[b, i] and not finite(x[k, b, i] + v[k, b, i]) and bad < 0:
                    bad = i
            elif i < n + m:
                motion.start[i, k] = circles[k, b, i - n]
            else:
                _load_solid(mesh, i, k, (tick[b] - 1) * dt, tick[b] * dt, motion)
        if i < n:
            motion.live[i] = 1 if alive[b, i] else 0
        elif i < n + m:
            mesh.radius[i] = radii[b, i - n]
            motion.live[i] = 1 if radii[b, i - n] > 0.0 else 0
    return bad


@kernel
def _load_solid(mesh: Any, i: int, k: int, begun: float, ended: float, motion: Any) -> None:
    """Set coordinate k of an obstacle's vertex: where it begins and ends a step, and its velocity at the end."""
    course = mesh.motion[i]
    way, rate, phase = course[3 + k], course[6], course[7]
    here = course[k] * begun + way * np.sin(rate * begun + phase)
    motion.start[i, k] = mesh.place[i, k] + here
    motion.move[i, k] = course[k] * ended + way * np.sin(rate * ended + phase) - here
    motion.speed[i, k] = course[k] + way * rate * np.cos(rate * ended + phase)


@kernel
def _tear(bonds: Any, b: int, mesh: Any) -> None:
    """Mark the faces of world b of which no edge is broken, and the edges of these faces."""
    whole = mesh.whole_edges
    for e in range(mesh.bond.shape[0]):
        at = mesh.bond[e]
        whole[e] = 0 if 0 <= at < bonds.shape[1] and bonds[b, at] == np.inf else 1
    for f in range(mesh.sides.shape[0]):
        mesh.whole_faces[f] = whole[mesh.sides[f, 0]] * whole[mesh.sides[f, 1]] * whole[mesh.sides[f, 2]]
    whole[: mesh.bond.shape[0]] = 0
    for f in range(mesh.sides.shape[0]):
        for k in range(3):
            whole[mesh.sides[f, k]] = max(whole[mesh.sides[f, k]], mesh.whole_faces[f])


@kernel
def _store(x0: Any, x: Any, v: Any, b: int, motion: Any) -> None:
    """Write the agents that were changed."""
    for i in range(x.shape[2]):
        if motion.touched[i]:
            for k in range(3):
                x[k, b, i], v[k, b, i] = x0[k, b, i] + motion.move[i, k], motion.speed[i, k]


@routine
def _add_near(mesh: Any, scratch: Any, pairs: int, thickness: float) -> int:
    """Add a contact for each pair that is near at the start; return their number, or -1 if there is no room."""
    s, count = scratch, 0
    for k in range(pairs):
        who = s.pairs.who[k]
        hit, first, rest, off, w = first_contact(s.pairs.kind[k], who, s.motion, mesh.radius, thickness)
        if hit < 0:
            s.count[UNSOLVED] += 1
        elif first - rest < NEAR * thickness:
            if hit > 0:
                continue
            count = add_contact(s.contacts, count, who, s.motion, rest + thickness, off, w, PUSH)
            if count < 0:
                return -1
    return count


@routine
def _sweep(mesh: Any, scratch: Any, count: int, rules: Any, ends: bool, clock: int) -> None:
    """Sweep over all contacts, of speeds over those that acted, until they hardly change."""
    s = scratch
    slight = SLIGHT * rules.thickness * (1.0 / rules.dt if ends else 1.0)
    for _ in range(SWEEPS):
        most = 0.0
        for k in range(count):
            if ends and s.contacts.used[k] == 0:
                continue
            array = s.motion.speed if ends else s.motion.move
            by = apply_contact(s.contacts, k, array, s.motion, mesh.light, rules.friction, ends, clock)
            if by > 0.0:
                s.contacts.used[k] = 1
                most = max(most, by)
        if most <= slight:
            break


@routine
def _impacts(mesh: Any, scratch: Any, pairs: int, count: int, rules: Any, clock: int) -> int:
    """Add and apply a contact for each pair that touches within the step; return how many there are, or -1: no room."""
    s = scratch
    for k in range(pairs):
        who = s.pairs.who[k]
        hit, _, rest, off, w = first_contact(s.pairs.kind[k], who, s.motion, mesh.radius, rules.thickness)
        if hit > 0:
            new = add_contact(s.contacts, count, who, s.motion, rest + rules.thickness, off, w, 0.0)
            if new < 0:
                return -1
            apply_contact(s.contacts, count, s.motion.move, s.motion, mesh.light, rules.friction, False, clock)
            s.contacts.used[count] = 1
            count = new
    return count


@routine
def _resolve(mesh: Any, scratch: Any, rules: Any) -> int:
    """Resolve a step by contacts and impulses, and the rest by zones; return the room needed, or 0 if it was enough."""
    s, reach = scratch, NEAR * rules.thickness
    room, since, count, solved = s.pairs.kind.shape[0], 0, 0, False
    for p in range(rules.passes):
        pairs = find_pairs(mesh, s.motion, s.pairs, reach, since)
        if pairs > room:
            return pairs
        if p == 0:
            count = _add_near(mesh, s, pairs, rules.thickness)
            if count < 0:
                return 2 * room  # type: ignore[no-any-return]
            if count > 0:
                _sweep(mesh, s, count, rules, False, 0)
                pairs = find_pairs(mesh, s.motion, s.pairs, reach, 0)
                if pairs > room:
                    return pairs
        found = _impacts(mesh, s, pairs, count, rules, p + 1)
        s.count[PASSES] += 1
        if found < 0:
            return 2 * room  # type: ignore[no-any-return]
        if found == count:
            solved = True
            break
        s.count[IMPACTS] += found - count
        count, since = found, p + 1
        _sweep(mesh, s, count, rules, False, p + 1)
    _sweep(mesh, s, count, rules, True, rules.passes)
    return 0 if solved else _make_zones(mesh, s, rules, since)


@routine
def _make_zones(mesh: Any, scratch: Any, rules: Any, since: int) -> int:
    """Join what still touches into zones until nothing does; return the room needed, or 0 if it was enough."""
    s, clock, room = scratch, since, scratch.pairs.kind.shape[0]
    clear_zones(s.zones, mesh.light, s.motion)
    for _ in range(2 * mesh.light.shape[0] + 2):
        pairs = find_pairs(mesh, s.motion, s.pairs, rules.thickness, clock)
        if pairs > room:
            return pairs
        s.count[PASSES] += 1
        hits, changed = 0, 0
        for k in range(pairs):
            who = s.pairs.who[k]
            if first_contact(s.pairs.kind[k], who, s.motion, mesh.radius, rules.thickness)[0] > 0:
                hits += 1
                changed += join(s.zones, who)
        if hits == 0:
            break
        if changed == 0:
            s.count[UNSOLVED] += hits
            break
        clock += 1
        move_zones(s.zones, s.motion, mesh.light, False, clock)
    move_zones(s.zones, s.motion, mesh.light, True, clock)
    for i in range(mesh.light.shape[0]):
        r = root_of(s.zones, i)
        if r == i and s.zones.size[i] > 1:
            s.count[ZONES] += 1
            s.count[ZONE_SIZE] = max(s.count[ZONE_SIZE], s.zones.size[i])
        s.count[STOPPED] += s.zones.still[r] if mesh.light[i] > 0.0 else 0
    return 0


@kernel
def settle_faces(
    x0: Any, x: Any, v: Any, alive: Any, circles: Any, radii: Any, tick: Any, bonds: Any, mesh: FaceMesh,
    scratch: FaceScratch, rules: FaceRules, work: Any, where: Any, first: int, end: int, report: Any,
) -> int:  # fmt: skip
    """Correct the steps of worlds [first, end) in place; return the world for which there was no room, or -1.

    where: (6,) the column of `work` of each counter. report: (5,) first world and agent that are not finite, or -1s,
    room needed, and vertices that stopped and pairs that are unsolved in the worlds that were corrected.
    """
    report[0], report[1], report[2], report[3], report[4] = -1, -1, 0, 0, 0
    for b in range(first, end):
        bad = _load(x0, x, v, alive, circles, radii, tick, b, mesh, scratch.motion, rules.dt)
        if bad >= 0:
            if report[0] < 0:
                report[0], report[1] = b, bad
            continue
        if bonds.shape[1] > 0:
            _tear(bonds, b, mesh)
        for k in range(6):
            scratch.count[k] = 0
        needed = _resolve(mesh, scratch, rules)
        if needed > 0:
            report[2] = needed
            return b
        _store(x0, x, v, b, scratch.motion)
        for k in range(6):
            if k == ZONE_SIZE:
                work[b, where[k]] = max(work[b, where[k]], scratch.count[k])
            else:
                work[b, where[k]] += scratch.count[k]
        report[3] += scratch.count[STOPPED]
        report[4] += scratch.count[UNSOLVED]
    return -1
