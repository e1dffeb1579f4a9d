"""Contacts with obstacles as constraints of a linearly implicit step: the solve, repeated until its contacts push.

Each contact prescribes the change of velocity of a body along a normal (`touching`); the filter of the solve removes
that direction. The residual of the equations is then the impulse of the surface. A contact whose impulse pulls is
released, and the solve continues without it (Baraff and Witkin 1998, section 5). With friction a body first sticks; if
the impulse that this takes is outside Coulomb's cone, it slides, and friction becomes part of the right-hand side. It
is found by projected steps: each adds the momentum along the surface, with the opposite sign, and shortens the sum to
the cone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.engine.conjugate_gradients import image_of, size_of, solve_from_of
from flockenv.engine.linear_equations import FIXED, SLIDES, System
from flockenv.jit.decorators import kernel
from flockenv.jit.section import entry
from flockenv.model.scene_view import SceneView
from flockenv.model.state import State
from flockenv.physics.constraints import Collisions
from flockenv.physics.constraints.touching import Touching, touching_of

__all__ = ["ContactSolver"]

Doubles = NDArray[np.float64]

MOST = 12
"""Solves of a step after which friction no longer changes; contacts that pull are still released, so it ends."""

SETTLED = 1e-3
"""Change of a friction impulse, relative to its limit, below which the solve is not repeated."""

DEPENDENT = 1e-6
"""Square of the part of a normal across those before it, and across a slide, below which the contact adds nothing."""


class Impulses(NamedTuple):
    """The state of the contacts of N bodies during a step."""

    active: Any  # (N, D) 1: in the solve; 2: adds nothing to those before it; 0: released, or none
    sticks: Any  # (N,) 1 if the body does not slide
    across: Any  # (N, D, D) the unit part of each active normal across those before it
    rub: Any  # (N, D) N s, friction of bodies that slide; part of the right-hand side
    work: Any  # (D,) scratch memory


@kernel
def begin(system: System, touching: Touching, impulses: Impulses, sticks: bool) -> None:
    """Activate all contacts of a step, and set the change of velocity to 0."""
    for i in range(touching.count.shape[0]):
        impulses.sticks[i] = 1 if sticks else 0
        for k in range(impulses.work.shape[0]):
            impulses.active[i, k] = 1 if k < touching.count[i] else 0
            impulses.rub[i, k] = 0.0
            system.change[i * impulses.work.shape[0] + k] = 0.0


@kernel
def _is_held(touching: Touching, impulses: Impulses, i: int, dormant: bool) -> bool:
    """Return True if body i has a contact in the solve; dormant: or one that adds nothing to others."""
    held = False
    for k in range(touching.count[i]):
        held = held or impulses.active[i, k] == 1 or (dormant and impulses.active[i, k] == 2)
    return held


@kernel
def _satisfy(system: System, touching: Touching, impulses: Impulses, base: Any, i: int, k: int) -> None:
    """Change the velocity of body i least, so that it satisfies contact k, and take its direction from the filter.

    The normal is projected onto the directions in which the body may move. A contact that adds none is left out, until
    another one of the body is released.
    """
    d, work, own, change = impulses.work.shape[0], impulses.work, i * impulses.work.shape[0] ** 2, system.change
    size, along = 0.0, 0.0
    for a in range(d):
        work[a] = 0.0
        for b in range(d):
            work[a] += base[own + a * d + b] * touching.normal[i, k, b]
    for a in range(d):
        across = 0.0
        for b in range(d):
            across += system.projection[own + a * d + b] * work[b]
        impulses.across[i, k, a], touching.normal[i, k, a] = across, work[a]
        size += across * across
        along += work[a] * change[i * d + a]
    impulses.active[i, k] = 2 if size < DEPENDENT else 1
    if size < DEPENDENT:
        return
    for a in range(d):
        change[i * d + a] += (touching.rise[i, k] - along) / size * impulses.across[i, k, a]
        impulses.across[i, k, a] /= np.sqrt(size)
    for a in range(d):
        for b in range(d):
            system.projection[own + a * d + b] -= impulses.across[i, k, a] * impulses.across[i, k, b]


@kernel
def impose(system: System, touching: Touching, impulses: Impulses, kinds: Any, base: Any) -> None:
    """Set filters and prescribed changes of velocity of bodies with contacts; kinds (N,), base (N D D): without them.

    Contacts of one body are satisfied one after another, each across those before it (Gram and Schmidt), nearest to the
    change that `system` holds.
    """
    d = impulses.work.shape[0]
    for i in range(touching.count.shape[0]):
        if touching.count[i] == 0:
            continue
        system.filter[i] = kinds[i]
        for k in range(i * d * d, (i + 1) * d * d):
            system.projection[k] = base[k]
        if impulses.sticks[i] > 0 and _is_held(touching, impulses, i, True):
            for a in range(i * d, (i + 1) * d):
                system.change[a] = 0.0
                for b in range(d):
                    system.change[a] += base[a * d + b] * touching.slip[i, b]
        for k in range(touching.count[i]):
            if impulses.active[i, k] > 0:
                _satisfy(system, touching, impulses, base, i, k)
        if _is_held(touching, impulses, i, False):
            system.filter[i] = FIXED if impulses.sticks[i] > 0 else SLIDES


@kernel
def _release(touching: Touching, impulses: Impulses, mass: Any, sticky: bool, i: int) -> tuple[bool, float]:
    """Deactivate the contacts of body i that pull, or bounce; return True if there are any, and the others' impulse.

    impulses.work: the impulse of all its contacts, from which those along normals are subtracted. A contact with
    restitution e > 0 rests by the rule of `collisions`, impact.comes_to_rest: the impulse stops the approach, and all
    further bounces end within the step.
    """
    d, work, total, released = impulses.work.shape[0], impulses.work, 0.0, False
    for back in range(touching.count[i]):
        k = touching.count[i] - 1 - back
        if impulses.active[i, k] != 1:
            continue
        push, lean = 0.0, 0.0
        for a in range(d):
            push += work[a] * impulses.across[i, k, a]
            lean += touching.normal[i, k, a] * impulses.across[i, k, a]
        push /= lean
        for a in range(d):
            work[a] -= push * touching.normal[i, k, a]
        e = touching.restitution[i, k]
        bounces = e > 0.0 and push * (1.0 - e) < mass[i] * abs(touching.approach[i, k]) * (1.0 + e)
        if (push < 0.0 or bounces) and not sticky:
            impulses.active[i, k], released = 0, True
        else:
            total += push
    return released, total


@kernel
def _set_rub(system: System, impulses: Impulses, i: int, by: float) -> None:
    """Set the friction impulse of body i to impulses.work times `by`."""
    d = impulses.work.shape[0]
    for a in range(d):
        rub = by * impulses.work[a] if by != 0.0 else 0.0
        system.right[i * d + a] += rub - impulses.rub[i, a]
        impulses.rub[i, a] = rub


@kernel
def _rub(system: System, touching: Touching, impulses: Impulses, mass: float, most: float, i: int) -> bool:
    """Let body i stick or slide under a friction impulse of at most `most` N s; return True if that has changed.

    impulses.work: the tangential impulse. A sliding body's friction is that of the last solve less its momentum along
    the surface, shortened to `most`: so it ends opposite to the motion, or holds the body with less.
    """
    d, work, size = impulses.work.shape[0], impulses.work, 0.0
    if impulses.sticks[i] > 0:
        for a in range(d):
            size += work[a] * work[a]
        if size <= most * most:
            return False
        impulses.sticks[i] = 0
        _set_rub(system, impulses, i, most / np.sqrt(size))
        return True
    for a in range(d):
        off = 0.0
        for b in range(d):
            off += system.projection[(i * d + a) * d + b] * (touching.slip[i, b] - system.change[i * d + b])
        work[a] = impulses.rub[i, a] + mass * off
        size += work[a] * work[a]
    by, change = most / np.sqrt(size) if size > most * most else 1.0, 0.0
    for a in range(d):
        change += (by * work[a] - impulses.rub[i, a]) ** 2
    if change <= (SETTLED * most) ** 2:
        return False
    _set_rub(system, impulses, i, by)
    return True


@kernel
def judge(
    system: System, touching: Touching, impulses: Impulses, base: Any, mass: Any, friction: float, sticky: bool,
    rubs: bool,
) -> bool:  # fmt: skip
    """Read the impulses of all contacts from A dv, in system.image; return True if some have changed.

    rubs: True if friction may still change.
    """
    d, work, changed = impulses.work.shape[0], impulses.work, False
    for i in range(touching.count.shape[0]):
        if not _is_held(touching, impulses, i, False):
            continue
        for a in range(d):
            work[a] = 0.0
            for b in range(d):
                given = system.right[i * d + b] - impulses.rub[i, b]
                work[a] += base[(i * d + a) * d + b] * (system.image[i * d + b] - given)
        released, total = _release(touching, impulses, mass, sticky, i)
        if released:
            changed = True
            _set_rub(system, impulses, i, 0.0)
        elif rubs and friction > 0.0 and not sticky:
            changed = _rub(system, touching, impulses, mass[i], friction * total, i) or changed
    return changed


class ContactSolver:
    """The contacts of a scene's steps, with memory for one thread."""

    def __init__(self, scene: SceneView, find: Callable[..., None], rules: Collisions, kinds: Any, base: Any) -> None:
        """Allocate memory. kinds (N,), base (N D D): filters without contacts, with 1 in the directions that are free.

        find: see Collisions.finder.
        """
        n, d = scene.agents, scene.dimension
        self.find, self.touching = find, touching_of(n, d)
        self.sticky, self.friction = rules.sticky, rules.friction
        self.kinds, self.base = kinds, base
        self.impulses = Impulses(
            np.zeros((n, d), np.int64), np.zeros(n, np.int64), np.zeros((n, d, d)), np.zeros((n, d)), np.zeros(d)
        )
        self.size, self.image, self.solve_from = size_of(d), image_of(d), solve_from_of(d)

    def look(
        self, system: System, state: State, x: Doubles, v: Doubles, flow: Doubles, begun: float, seconds: float
    ) -> bool:
        """Find the contacts of a step; return True if there are any. Arguments as for Collisions.finder."""
        np.copyto(system.projection, self.base)
        self.find(state, x, v, flow, begun, seconds, self.touching)
        return bool(self.touching.count.any())

    def solve(self, system: System, mass: Doubles, tolerance: float, most: int) -> tuple[int, float]:
        """Solve the equations, again and again; return the iterations of all solves, and the last relative norm."""
        first, total, turn = self.size(system), 0, 0
        entry(begin)(system, self.touching, self.impulses, self.sticky or self.friction > 0)
        while True:
            entry(impose)(system, self.touching, self.impulses, self.kinds, self.base)
            iterations, left = self.solve_from(system, first, tolerance, most - total)
            total, turn = total + int(iterations), turn + 1
            if not left <= tolerance:
                return total, left
            self.image(system)
            if not entry(judge)(
                system, self.touching, self.impulses, self.base, mass, self.friction, self.sticky, turn < MOST
            ):
                return total, left

    def pushes(self, system: System) -> Doubles:
        """Return the impulses of the contacts that were found by the last solve, (N, D) kg m/s: A dv less b.

        Of a particle that slides, only the part along its line or plane.
        """
        n, d = self.impulses.rub.shape
        left = (system.image - system.right).reshape(n, d) + self.impulses.rub
        along = np.einsum("iab,ib->ia", self.base.reshape(n, d, d), left)
        return np.where(self.held()[:, None], along, 0.0)

    def held(self) -> NDArray[np.bool_]:
        """Return which agents were in contact in the last step, (N,)."""
        return (self.impulses.active == 1).any(axis=1)  # type: ignore[no-any-return]
