"""Impulses of contacts with friction on rigid bodies, from zero in each step.

Sweeps over all contacts apply impulses one after the other (projected Gauss-Seidel: Catto 2006, Iterative dynamics
with temporal coherence). Between sweeps impulses are extrapolated from the results of the last ones (Anderson's
acceleration: Walker and Ni 2011, SIAM J. Numer. Anal. 49, 1715), as plain sweeps are slow in stacks. Friction is
Coulomb's cone: at a contact that slides it points against the velocity.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.jit.decorators import kernel, routine

__all__ = ["PAST", "apply_impulse", "slide_speed", "solve_contacts", "sum_impulses"]

PAST = 20
"""Number of earlier sweeps from which impulses are extrapolated."""

LAST = 30
"""Number of sweeps at the end without extrapolation, which may be far off where contacts change between sweeps."""

GROWS = 4.0
"""Growth of the square of a step, relative to the least one, after which extrapolation begins anew."""

SHIFT = 1e-10
"""Relative shift of the diagonal of the products of their steps, which may depend on each other."""


@kernel
def slide_speed(solids: Any, contacts: Any, c: int, k: int, speed: Any) -> float:
    """Return the speed of a contact's first body relative to the second along `way` k, m/s, or of another velocity."""
    i, j = contacts.body[c, 0], contacts.body[c, 1]
    total = 0.0
    for m in range(3):
        total += contacts.way[c, k, m] * (speed[0, i, m] - speed[0, j, m])
        total += contacts.arm[0, c, k, m] * speed[1, i, m] - contacts.arm[1, c, k, m] * speed[1, j, m]
    return float(total)


@kernel
def apply_impulse(solids: Any, contacts: Any, c: int, k: int, by: float) -> None:
    """Change the velocities of both bodies by an impulse along `way` k, kg m/s."""
    i, j, speed = contacts.body[c, 0], contacts.body[c, 1], solids.speed
    for m in range(3):
        speed[0, i, m] += by * solids.light[i] * contacts.way[c, k, m]
        speed[0, j, m] -= by * solids.light[j] * contacts.way[c, k, m]
        speed[1, i, m] += by * contacts.answer[0, c, k, m]
        speed[1, j, m] -= by * contacts.answer[1, c, k, m]


@kernel
def _in_cone(one: float, two: float, limit: float) -> tuple[float, float]:
    """Return friction along the tangents, shortened to a limit, kg m/s."""
    size = np.sqrt(one * one + two * two)
    return (one * limit / size, two * limit / size) if size > limit else (one, two)


@kernel
def _solve_contact(solids: Any, contacts: Any, c: int, friction: float, impulse: Any) -> float:
    """Bring one contact to its least speed apart and its friction to the cone; return the change of speed, m/s."""
    stays = impulse[c, 0]
    impulse[c, 0] = max(
        0.0, stays + (contacts.aim[c] - slide_speed(solids, contacts, c, 0, solids.speed)) * contacts.ease[c, 0]
    )
    by = impulse[c, 0] - stays
    contacts.step[c, 0] = by
    if by != 0.0:
        apply_impulse(solids, contacts, c, 0, by)
    most = abs(by) / contacts.ease[c, 0]
    if friction > 0.0:
        one = impulse[c, 1] - slide_speed(solids, contacts, c, 1, solids.speed) * contacts.ease[c, 1]
        two = impulse[c, 2] - slide_speed(solids, contacts, c, 2, solids.speed) * contacts.ease[c, 1]
        one, two = _in_cone(one, two, friction * impulse[c, 0])
        contacts.step[c, 1], contacts.step[c, 2] = one - impulse[c, 1], two - impulse[c, 2]
        impulse[c, 1], impulse[c, 2] = one, two
        for k in range(1, 3):
            if contacts.step[c, k] != 0.0:
                apply_impulse(solids, contacts, c, k, contacts.step[c, k])
                most = max(most, abs(contacts.step[c, k]) / contacts.ease[c, 1])
    return float(most)


@kernel
def _product(contacts: Any, count: int, a: Any, b: Any) -> float:
    """Return the product of two changes of impulses, (C, 3), weighted as energies, J."""
    total = 0.0
    for c in range(count):
        slide = a[c, 1] * b[c, 1] + a[c, 2] * b[c, 2]
        total += a[c, 0] * b[c, 0] / contacts.ease[c, 0] + slide / contacts.ease[c, 1]
    return total


@kernel
def _remember(contacts: Any, count: int, impulse: Any, slot: int, used: int) -> None:
    """Keep how the result of a sweep, and the sweep's change, differ from those of the sweep before."""
    past = contacts.past
    for c in range(count):
        for k in range(3):
            past.results[slot, c, k] = impulse[c, k] - past.result[c, k]
            past.steps[slot, c, k] = contacts.step[c, k] - past.step[c, k]
    for m in range(used):
        product = _product(contacts, count, past.steps[slot], past.steps[m])
        past.products[slot, m], past.products[m, slot] = product, product


@kernel
def _fit(contacts: Any, count: int, used: int) -> None:
    """Write the combination of kept steps that is nearest to the last one, by Cholesky's factors, to past.share."""
    past = contacts.past
    share, factor = past.share, past.factor
    for i in range(used):
        rest = _product(contacts, count, past.steps[i], contacts.step)
        for j in range(i + 1):
            entry = past.products[i, j] * (1.0 + (SHIFT if i == j else 0.0))
            for k in range(j):
                entry -= factor[i, k] * factor[j, k]
            if i == j:
                factor[i, i] = np.sqrt(entry) if entry > 0.0 else np.inf  # such a step is left out
            else:
                factor[i, j] = entry / factor[j, j]
        for j in range(i):
            rest -= factor[i, j] * share[j]
        share[i] = rest / factor[i, i]
    for i in range(used - 1, -1, -1):
        for j in range(i + 1, used):
            share[i] -= factor[j, i] * share[j]
        share[i] = share[i] / factor[i, i]


@kernel
def _jump(solids: Any, contacts: Any, count: int, friction: float, impulse: Any, kept: int) -> None:
    """Extrapolate impulses, by at most the largest one, and keep them in the cones of friction."""
    past, most, size = contacts.past, 0.0, 0.0
    for c in range(count):
        size = max(size, impulse[c, 0])
        for k in range(3):
            by = 0.0
            for m in range(kept):
                by -= past.share[m] * past.results[m, c, k]
            past.jump[c, k] = by
            most = max(most, abs(by))
    if not most > 0.0:
        return
    scale = min(1.0, size / most)
    for c in range(count):
        if contacts.aim[c] == -np.inf:
            continue
        normal = max(0.0, impulse[c, 0] + scale * past.jump[c, 0])
        one, two = impulse[c, 1] + scale * past.jump[c, 1], impulse[c, 2] + scale * past.jump[c, 2]
        one, two = _in_cone(one, two, friction * normal)
        for k in range(3):
            new = normal if k == 0 else (one if k == 1 else two)
            apply_impulse(solids, contacts, c, k, new - impulse[c, k])
            impulse[c, k] = new


@routine
def _extrapolate(solids: Any, contacts: Any, count: int, friction: float, impulse: Any, used: int) -> int:
    """Move impulses to where the kept steps vanish (Anderson's acceleration); return their number.

    used: number of steps that are kept, of which the oldest is replaced once there are PAST; -1 to begin anew.
    """
    past = contacts.past
    if used >= 0:
        _remember(contacts, count, impulse, used % PAST, min(used + 1, PAST))
    for c in range(count):
        for k in range(3):
            past.result[c, k], past.step[c, k] = impulse[c, k], contacts.step[c, k]
    kept = min(used + 1, PAST)
    if kept > 0:
        _fit(contacts, count, kept)
        _jump(solids, contacts, count, friction, impulse, kept)
    return used + 1


@routine
def solve_contacts(
    solids: Any, contacts: Any, count: int, stage: int, friction: float, sweeps: int, slight: float, report: Any
) -> float:
    """Change velocities by impulses until sweeps change speeds by less than `slight`; return the last change, m/s.

    stage: 0 for positions, 1 for velocities, from the impulses that are there. Adds the sweeps to report[0].
    """
    impulse, left, used, least = contacts.impulse[stage], 0.0, -1, np.inf
    for c in range(count):
        for k in range(3):
            contacts.step[c, k] = 0.0
    for sweep in range(sweeps):
        left = 0.0
        for c in range(count):
            if contacts.aim[c] > -np.inf:
                left = max(left, _solve_contact(solids, contacts, c, friction, impulse))
        report[0] += 1
        if left <= slight or sweep == sweeps - 1:
            break
        if sweep >= sweeps - LAST:
            continue
        size = _product(contacts, count, contacts.step, contacts.step)
        used = _extrapolate(solids, contacts, count, friction, impulse, used if size <= GROWS * least else -1)
        least = size if used == 0 else min(least, size)
    return left


@routine
def sum_impulses(solids: Any, contacts: Any, count: int, stage: int, out: Any) -> None:
    """Write the sum of impulses, and of their moments about the centre, on each body, (2, n, 3)."""
    out[:] = 0.0
    for c in range(count):
        i, j = contacts.body[c, 0], contacts.body[c, 1]
        for k in range(3):
            by = contacts.impulse[stage, c, k]
            for m in range(3):
                out[0, i, m] += by * contacts.way[c, k, m]
                out[0, j, m] -= by * contacts.way[c, k, m]
                out[1, i, m] += by * contacts.arm[0, c, k, m]
                out[1, j, m] -= by * contacts.arm[1, c, k, m]
