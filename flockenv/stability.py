"""The largest step that is stable, for a method and for a scene: measured on the method, from the effects' stiffness.

Nothing here is a table of methods: each is asked what one step of its own makes of a damped oscillator
x'' = -w^2 x - 2 zeta w x', and stable is what does not grow.
"""

from __future__ import annotations

import functools
import math
import warnings
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.integrators.base import Integrator
from flockenv.state import Floats as States
from flockenv.state import blank

if TYPE_CHECKING:
    from flockenv.scene import Scene

__all__ = ["Suggestion", "UnstableStepWarning", "amplification", "check_dt", "limit", "suggest_dt"]

Floats = NDArray[np.float64]

GROWTH = 1e-6
"""Of the amplitude in one step that still counts as stable: it takes a million steps to be seen."""

CERTAIN = 2.0
"""Times the limit beyond which a scene is refused: bounds of stiffness are less than that above the truth."""

SMALLEST, LARGEST, POINTS = 1e-4, 1e3, 400  # h w that are looked at
ROUNDS = 6  # of closing in on where it becomes unstable


class UnstableStepWarning(UserWarning):
    """A scene's dt is beyond the largest stable step."""


class Suggestion(NamedTuple):
    """The largest stable step of a scene, and what sets it."""

    dt: float  # s; inf if nothing in the scene sets a limit
    effect: str | None  # kind of the effect that is the stiffest
    agent: int | None  # whom it acts on
    frequency: float  # rad/s, of the fastest oscillation (a bound)
    damping: float  # 1/s, of velocity, there


def amplification(method: Integrator, y: Floats, zeta: float) -> Floats:
    """Return what one step of h = 1 s makes of (x, v), (K, 2, 2), of oscillators with h w = y, (K,)."""
    y = np.asarray(y, float)
    state = blank(1, len(y), 2, 0, 1.0)
    state.x[0], state.v[1] = 1.0, 1.0  # two beginnings side by side: the axes do not know of each other
    square, drag = (y * y)[:, None], (2 * zeta * y)[:, None]

    def law(x: States, v: States, time: float) -> States:
        return np.asarray(-square * x - (0.0 if method.splits_drag else drag * v))

    after = method(law, state, 1.0, drag=np.tile(drag[:, 0], 2))
    return np.stack([after.pos[0], after.vel[0]], axis=1)  # (K, what comes out, what went in)


def growth(method: Integrator, y: Floats, zeta: float) -> Floats:
    """Return by what the amplitude is multiplied in one step at worst, (K,): the spectral radius."""
    with np.errstate(all="ignore"):
        matrices = amplification(method, y, zeta)
        matrices[~np.isfinite(matrices)] = 1e300
        # in units in which position and velocity weigh the same
        scaled = matrices * np.stack(
            [np.stack([np.ones_like(y), y], -1), np.stack([1 / y, np.ones_like(y)], -1)], axis=1
        )
        return np.asarray(np.abs(np.linalg.eigvals(np.clip(scaled, -1e150, 1e150))).max(axis=1))


@functools.lru_cache(maxsize=1024)
def limit(method: Integrator, zeta: float) -> float:
    """Return the largest stable h w, for a damping of `zeta`, as a share of what is critical; inf = any."""
    if method.solves or method.adaptive:
        return math.inf
    y = np.geomspace(SMALLEST, LARGEST, POINTS)
    for _ in range(ROUNDS):
        grows = growth(method, y, zeta) > 1 + GROWTH
        if not grows.any():
            return math.inf
        first = int(np.argmax(grows))
        if first == 0:
            return 0.0
        y = np.linspace(y[first - 1], y[first], POINTS)
    return float(y[0])


def suggest_dt(scene: Scene) -> Suggestion:
    """Return the largest stable step of a scene, from its effects' own stiffness, and the effect that sets it.

    Stiffness is a bound (Gershgorin's circles for springs), so the limit is on the safe side; what is only stiff in
    some states (agents that touch) is not in it. Source: numerics.md 2.2 P02, 3.1, 3.3.
    """
    square, damping = np.zeros(scene.agents), np.zeros(scene.agents)
    alone: list[tuple[float, str]] = []
    for k, effect in enumerate(scene.effects):
        try:
            found = effect.rates(scene.groups, scene.dimension)
        except ValueError as error:
            raise ValueError(f"effects[{k}].{error}") from None
        if found is not None:
            alone.append((_tightest(scene.integrator, *found)[0], effect.kind))
            square += found[0]
            damping += found[1]
    dt, agent = _tightest(scene.integrator, square, damping)
    if not math.isfinite(dt):
        return Suggestion(math.inf, None, None, float(np.sqrt(square.max())), float(damping.max()))
    return Suggestion(dt, min(alone)[1], agent, math.sqrt(square[agent]), float(damping[agent]))


def _tightest(method: Integrator, square: Floats, damping: Floats) -> tuple[float, int]:
    """Return the least of all agents' limits, s, and whose it is."""
    dts = np.full(len(square), math.inf)
    kinds, which = np.unique(np.stack([square, damping], axis=1), axis=0, return_inverse=True)
    kept = kinds if len(kinds) <= POINTS else kinds[np.argsort(kinds.max(axis=1))[-POINTS:]]
    limits = {tuple(kind): _limit_of(method, *map(float, kind)) for kind in kept}
    for k, kind in enumerate(kinds):
        if tuple(kind) in limits:
            dts[which.ravel() == k] = limits[tuple(kind)]
    agent = int(np.argmin(dts))
    return float(dts[agent]), agent


def _limit_of(method: Integrator, square: float, damping: float) -> float:
    """Return the largest stable step of one oscillator, s."""
    if square <= 0 and damping <= 0:
        return math.inf
    if damping > 1e4 * math.sqrt(square):  # nothing but drag: x'' = -c x'
        return _drag_limit(method) / damping
    frequency = math.sqrt(square)
    return limit(method, round(damping / (2 * frequency), 6)) / frequency


@functools.lru_cache(maxsize=64)
def _drag_limit(method: Integrator) -> float:
    """Return the largest stable h c of x'' = -c x'."""
    if method.solves or method.adaptive or method.splits_drag:
        return math.inf
    z = np.geomspace(SMALLEST, LARGEST, POINTS)
    for _ in range(ROUNDS):
        state = blank(1, len(z), 2, 0, 1.0)
        state.v[...] = 1.0
        rate = z[:, None]
        after = method(lambda x, v, t, rate=rate: -rate * v, state, 1.0)  # type: ignore[misc]
        grows = np.abs(after.vel[0, :, 0]) > 1 + GROWTH
        if not grows.any():
            return math.inf
        first = int(np.argmax(grows))
        z = np.linspace(z[max(0, first - 1)], z[first], POINTS)
    return float(z[0])


def check_dt(scene: Scene) -> None:
    """Warn where dt is beyond the largest stable step, naming limit and effect; refuse where it must blow up."""
    found = suggest_dt(scene)
    if scene.dt <= found.dt:
        return
    kind, text = scene.integrator.kind, f"{found.frequency:.4g} rad/s, {found.damping:.4g} 1/s at agent {found.agent}"
    if found.dt < 1e-2 * scene.dt:
        limit_text = f"at most {found.dt:.3g} s is stable, so take another integrator"
    else:
        limit_text = f"at most {found.dt:.4g} s is stable"
    message = f"dt = {scene.dt:g} s: {kind} with {found.effect} ({text}): {limit_text}"
    if scene.dt > CERTAIN * found.dt and _blows_up(scene, found):
        raise ValueError(message)
    warnings.warn(message, UnstableStepWarning, stacklevel=2)


def _blows_up(scene: Scene, found: Suggestion) -> bool:
    """Would an amplitude grow a hundredfold within a hundred steps, even if stiffness is half of its bound?"""
    y = np.array([scene.dt * found.frequency / CERTAIN])
    if y[0] <= 0:
        return scene.dt * found.damping > CERTAIN * _drag_limit(scene.integrator)
    zeta = found.damping / (2 * found.frequency)
    return bool(growth(scene.integrator, y, zeta)[0] > 100 ** (1 / 100))
