"""The largest step that is stable, for a method and for a scene: measured on the method, from the effects' stiffness.

Nothing here is a table of methods: one step of each is applied to a damped oscillator x'' = -w^2 x - 2 zeta w x', and
stable is what does not grow. A method whose region of stability touches the imaginary axis at 0 alone (explicit Euler,
averaged velocity, midpoint, Heun) has no stable step for an undamped oscillator: its limit is 0, and a warning says how
slowly it grows, which is for the reader to judge (of the two-stage methods as (h w)^4 / 8 in a step).
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.core.warnings import CoarseContactWarning, LookaheadWarning, UnstableStepWarning
from flockenv.model.scene_view import SceneView
from flockenv.model.state import blank
from flockenv.physics.integrators.integrator import Integrator

if TYPE_CHECKING:
    from flockenv.model.group import Group
    from flockenv.physics.effects.effect import Effect

__all__ = [
    "Suggestion",
    "amplification",
    "check_contact",
    "check_dt",
    "check_lookahead",
    "contact_limit",
    "limit",
    "suggest_dt",
]

Floats = NDArray[np.float64]

ROUNDING = 1e-11
"""Growth of the amplitude in one step that is rounding: no method here grows so slowly at any h w of NEAR."""

NEAR = (0.05, 0.1, 0.2)
"""The h w at which a method shows whether it grows near 0: as (h w)^2 or (h w)^4, of which rounding is far below."""

CERTAIN = 2.5
"""Times the limit beyond which a scene is refused: bounds of frequency are less than that above the truth.

The fastest oscillation is at least as fast as anybody's while all others rest: by the mean over D axes, w^2 is at least
sum k / (D m), of a bound of 2 sum k / m; and sqrt(2 D) <= 2.45.
"""

WEAK = 0.1
"""The h w and h c below which a limit is no use: with so little damping such a method is stable in tiny steps alone."""

STEADY = "semi_implicit_euler, velocity_verlet or rk4"
"""What has stable steps for undamped oscillations."""

SMALLEST, LARGEST, POINTS = 1e-7, 1e3, 300  # h w that are looked at
ROUNDS = 3  # of closing in on where it becomes unstable
FASTEST = 32
"""Different oscillators of a scene that are looked at."""


STEPS, STEPS_OF_ITS_OWN = 30, 4
"""That a contact should last: with fewer, how fast a body comes out hangs by where in a step it touched. Under a method
with steps of its own within dt: or it steps over what has hardly begun (measured at the default tolerance)."""

OFF = 1.048
"""By which factor a method may change the speed in an undamped contact: 5 %, less what the phase of a step does."""

BOUNCY = 0.2
"""Damping as a share of what is critical, below which a contact is there to bounce: it gives back half, or more."""


class Suggestion(NamedTuple):
    """The largest stable step of a scene, and what sets it."""

    dt: float  # s; inf if nothing in the scene sets a limit, 0 if no step is stable
    effect: str | None  # kind of the effect that is the stiffest
    agent: int | None  # whom it acts on
    frequency: float  # rad/s, of the fastest oscillation (a bound)
    damping: float  # 1/s, of velocity, there


def amplification(method: Integrator, y: Floats, zeta: float, told: float = 0.0) -> Floats:
    """Return what one step of h = 1 s makes of (x, v), (K, 2, 2), of oscillators with h w = y, (K,).

    zeta, told: damping as shares of what is critical; of the second the method is told, if it treats drag by itself.
    """
    y = np.asarray(y, float)
    state = blank(1, len(y), 2, 0, 1.0)
    state.x[0], state.v[1] = 1.0, 1.0  # two beginnings side by side: the axes do not know of each other
    own = told if method.splits_drag else 0.0
    square, drag = (y * y)[:, None], (2 * (zeta + told - own) * y)[:, None]
    after = method(lambda x, v, t: -square * x - drag * v, state, 1.0, drag=np.tile(2 * own * y, 2))
    return np.stack([after.pos[0], after.vel[0]], axis=1)  # (K, what comes out, what went in)


def growth(method: Integrator, y: Floats, zeta: float, told: float = 0.0) -> Floats:
    """Return by what the amplitude is multiplied in one step at worst, (K,): the spectral radius."""
    with np.errstate(all="ignore"):
        matrices = amplification(method, y, zeta, told)
        matrices[~np.isfinite(matrices)] = 1e300
        # in units in which position and velocity weigh the same
        scaled = matrices * np.stack(
            [np.stack([np.ones_like(y), y], -1), np.stack([1 / y, np.ones_like(y)], -1)], axis=1
        )
        return np.asarray(np.abs(np.linalg.eigvals(np.clip(scaled, -1e150, 1e150))).max(axis=1))


@functools.lru_cache(maxsize=1024)
def limit(method: Integrator, zeta: float, told: float = 0.0) -> float:
    """Return the largest stable h w, for damping as shares of what is critical (see amplification).

    inf = any; 0 = none, where nothing damps and the method grows however small h w is.
    """
    if method.solves or method.adaptive:
        return math.inf
    if zeta <= 0 and told <= 0 and (growth(method, np.array(NEAR), 0.0) > 1 + ROUNDING).all():
        return 0.0
    return _first_unstable(lambda y: growth(method, y, zeta, told))


@functools.lru_cache(maxsize=64)
def drag_limit(method: Integrator) -> float:
    """Return the largest stable h c of x'' = -c x', of which the method is not told; inf = any."""
    if method.solves or method.adaptive:
        return math.inf

    def slowed(z: Floats) -> Floats:
        state = blank(1, len(z), 2, 0, 1.0)
        state.v[...] = 1.0
        return np.asarray(np.abs(method(lambda x, v, t: -z[:, None] * v, state, 1.0).vel[0, :, 0]))

    return _first_unstable(slowed)


def _first_unstable(grown: Callable[[Floats], Floats]) -> float:
    """Return the least number at which an amplitude is more after a step than before it."""
    y = np.geomspace(SMALLEST, LARGEST, POINTS)
    for _ in range(ROUNDS):
        grows = grown(y) > 1 + ROUNDING
        if not grows.any():
            return math.inf
        first = int(np.argmax(grows))
        if first == 0:
            return 0.0
        y = np.linspace(y[first - 1], y[first], POINTS)
    return float(y[0])


class _Rates(NamedTuple):
    """How stiff everybody is, (N,) each."""

    square: Floats  # w^2, 1/s^2
    damping: Floats  # 1/s
    told: Floats  # 1/s, damping that the method is told of

    def of(self, agent: int) -> tuple[float, float, float]:
        """Return one agent's."""
        return float(self.square[agent]), float(self.damping[agent]), float(self.told[agent])


def suggest_dt(scene: SceneView) -> Suggestion:
    """Return the largest stable step of a scene, from its effects' own stiffness, and the effect that sets it.

    Stiffness is a bound (Gershgorin's circles for springs), so the limit is on the safe side; what is only stiff in
    some states (agents that touch more than one other) is not in it. Damping is a bound too: a method that needs
    damping to be stable (explicit Euler, Heun, midpoint) may find motions that are damped less, springs across their
    length for one.
    Source: numerics.md 2.2 P02, 3.1, 3.3.
    """
    return _suggested(scene, _found(scene))


def _suggested(scene: SceneView, found: list[tuple[Effect, _Rates]]) -> Suggestion:
    """Return the largest step that is stable under some effects of a scene."""
    if not found:
        return Suggestion(math.inf, None, None, 0.0, 0.0)
    whole = _Rates(*(sum(rates[k] for _, rates in found) + np.zeros(scene.agents) for k in range(3)))
    dt, agent = _tightest(scene.integrator, whole)
    if not math.isfinite(dt):
        most = (float(np.sqrt(whole.square.max())), float((whole.damping + whole.told).max()))
        return Suggestion(math.inf, None, None, *most)
    alone = [(*_urgency(scene.integrator, *rates.of(agent)), effect.kind) for effect, rates in found]
    square, damping, told = whole.of(agent)
    return Suggestion(dt, min(alone)[-1], agent, math.sqrt(square), damping + told)


def _urgency(method: Integrator, square: float, damping: float, told: float) -> tuple[float, float]:
    """Return the largest stable step of one oscillator, and minus its rates: of those without one the fastest leads."""
    return _limit_of(method, square, damping, told), -max(math.sqrt(square), damping + told)


def _found(scene: SceneView) -> list[tuple[Effect, _Rates]]:
    """Return those effects that know how stiff they are, and how stiff that is."""
    out = []
    for k, effect in enumerate(scene.effects):
        acting = effect if scene.obstacles else effect.in_the_open()
        try:
            found = acting.rates(scene.groups, scene.dimension) if acting is not None else None
        except ValueError as error:
            raise ValueError(f"effects[{k}].{error}") from None
        if found is not None:
            square, damping = found
            none = np.zeros(len(damping))
            own = scene.integrator.splits_drag and effect.linear_drag is not None
            out.append((effect, _Rates(square, none, damping) if own else _Rates(square, damping, none)))
    return out


def _tightest(method: Integrator, rates: _Rates) -> tuple[float, int]:
    """Return the least of all agents' limits, s, and whose it is; of very many different ones, among the fastest."""
    table = np.stack(rates, axis=1)
    begins = np.flatnonzero(np.r_[True, (table[1:] != table[:-1]).any(axis=1)])  # of agents in a row who are alike
    kinds, among = np.unique(table[begins], axis=0, return_index=True)
    first = begins[among]
    fastest = np.argsort(np.maximum(np.sqrt(kinds[:, 0]), kinds[:, 1]), kind="stable")[-FASTEST:]
    dt, _, agent = min((*_urgency(method, *map(float, kinds[k])), int(first[k])) for k in fastest)
    return dt, agent


def _limit_of(method: Integrator, square: float, damping: float, told: float) -> float:
    """Return the largest stable step of one oscillator, s."""
    if square <= 0 and damping <= 0:
        return math.inf
    if damping > 1e4 * math.sqrt(square):  # nothing but drag: x'' = -c x'
        return drag_limit(method) / damping
    frequency = math.sqrt(square)
    # to a few digits, so that agents of nearly the same damping are looked at once
    zeta, own = (float(f"{rate / (2 * frequency):.4g}") for rate in (damping, told))
    return limit(method, zeta, own) / frequency


def check_dt(scene: SceneView) -> None:
    """Warn where dt is beyond the largest stable step, naming limit and effect; refuse where it must blow up.

    Behaviours that act now and then, or within bounds, do not make it blow up: see `Effect.always`.
    """
    found = suggest_dt(scene)
    if scene.dt <= found.dt:
        return
    always = _suggested(scene, [(effect, rates) for effect, rates in _found(scene) if effect.always])
    if scene.dt > CERTAIN * always.dt and _blows_up(scene, always):
        raise ValueError(_too_long(scene, always))
    warnings.warn(_too_long(scene, found), UnstableStepWarning, stacklevel=2)


def _too_long(scene: SceneView, found: Suggestion) -> str:
    """Say which step is stable, and what sets it, in one line."""
    kind, text = scene.integrator.kind, f"{found.frequency:.4g} rad/s, {found.damping:.4g} 1/s at agent {found.agent}"
    if found.dt == 0:
        limit_text = (
            f"no step is stable, for nothing damps it (at this one the amplitude grows e-fold in "
            f"{_growing(scene, found):.3g} s), so take another integrator ({STEADY}), or add damping"
        )
    elif found.dt * max(found.frequency, found.damping) < WEAK or found.dt < 1e-2 * scene.dt:
        limit_text = f"at most {found.dt:.3g} s is stable, so take another integrator"
    else:
        limit_text = f"at most {found.dt:.4g} s is stable"
    return f"dt = {scene.dt:g} s: {kind} with {found.effect} ({text}): {limit_text}"


def _growing(scene: SceneView, found: Suggestion) -> float:
    """Return the time in which an undamped oscillation grows e-fold at the scene's dt, s; inf if rounding hides it."""
    rate = math.log(float(growth(scene.integrator, np.array([scene.dt * found.frequency]), 0.0)[0]))
    return scene.dt / rate if rate > 0 else math.inf


def _blows_up(scene: SceneView, found: Suggestion) -> bool:
    """True if an amplitude grows a hundredfold within a hundred steps, even if all rates are far below their bounds."""
    y = np.array([scene.dt * found.frequency / CERTAIN])
    if found.damping > 1e4 * found.frequency:
        return True  # nothing but drag, of which nothing is a bound
    zeta = found.damping / (2 * found.frequency)
    slowest = min(growth(scene.integrator, y, *shares)[0] for shares in ((zeta, 0.0), (0.0, zeta)))
    return bool(slowest > 100 ** (1 / 100))


@functools.lru_cache(maxsize=64)
def contact_limit(method: Integrator) -> float:
    """Return the largest h w at which half an undamped oscillation is resolved.

    At least STEPS steps (numerics.md P17), and the amplitude is the same within OFF: explicit Euler multiplies it by
    (1 + y^2)^(pi / 2y), implicit Euler divides it, and both take 105 steps for that.
    """
    if method.adaptive:
        return math.pi / STEPS_OF_ITS_OWN
    low, high = 1e-3, math.pi / STEPS
    for _ in range(ROUNDS):
        y = np.linspace(low, high, FASTEST)  # few: methods that solve do so in Python
        off = np.abs(np.log(growth(method, y, 0.0))) * math.pi / y > math.log(OFF)
        if not off.any():
            return high
        first = max(int(np.argmax(off)), 1)
        low, high = float(y[first - 1]), float(y[first])
    return low


def check_contact(scene: SceneView) -> None:
    """Warn where bodies that should bounce are in contact for too few steps, naming the limit, and what comes of it."""
    for k, effect in enumerate(scene.effects):
        acting = effect if scene.obstacles else effect.in_the_open()
        found = acting.rates(scene.groups, scene.dimension) if acting is not None and effect.contact else None
        if found is None:
            continue
        frequency = np.sqrt(found[0])
        frequency[found[1] > 2 * BOUNCY * frequency] = 0.0
        agent = int(np.argmax(frequency))
        if scene.dt * frequency[agent] > contact_limit(scene.integrator) * (1 + 1e-9):
            most, lasts = contact_limit(scene.integrator) / frequency[agent], math.pi / frequency[agent]
            message = (
                f"dt = {scene.dt:g} s: effects[{k}].{effect.kind} lasts {lasts:.3g} s at agent {agent}; bodies come "
                f"out of it at the right speed with {scene.integrator.kind} if dt is at most {most:.3g} s"
                f"{_what_comes_of_it(scene, float(frequency[agent]), agent)}"
            )
            warnings.warn(message, CoarseContactWarning, stacklevel=2)


def _what_comes_of_it(scene: SceneView, frequency: float, agent: int) -> str:
    """Say how much faster bodies come out of an undamped contact at this dt, and from where on it is unstable."""
    method, y = scene.integrator, scene.dt * frequency
    if method.adaptive:
        return ""
    rates = [each.of(agent) for _, each in _found(scene)]
    most = _limit_of(method, frequency**2, sum(damping for _, damping, _ in rates), sum(told for _, _, told in rates))
    back = float(growth(method, np.array([y]), 0.0)[0]) ** (math.pi / y)
    text = f"; at this dt {back:.3g} times as fast as they went in" if abs(math.log(back)) > math.log(OFF) else ""
    if most == 0:
        return text + "; bodies that stay in it do not come to rest, whatever dt is"
    return text + (f"; bodies that stay in it do not come to rest above {most:.3g} s" if scene.dt > most else "")


def check_lookahead(scene: SceneView) -> None:
    """Warn of those who look ahead less far than it takes them to stop: V^2 m/(2 F), and their radius."""
    for k, effect in enumerate(scene.effects):
        several = [(f"effects[{k}].behaviours[{j}]", each) for j, each in enumerate(effect.wishes)]
        only = getattr(effect, "group", None) if several else None
        for name, each in several or [(f"effects[{k}]", effect)]:
            for g, group in enumerate(scene.groups):
                if only in (None, g):
                    _warn_late(name, each, g, group)


def _warn_late(name: str, effect: Effect, g: int, group: Group) -> None:
    """Warn if one group sees too late by one effect; who has no top speed, or no bounds of force, is not judged."""
    fastest, strongest = group.fastest, group.max_force
    if fastest is None or not strongest or (sees := effect.lookahead(fastest)) is None:
        return
    needs = fastest**2 * group.heaviest / (2 * strongest) + group.widest
    if sees < needs:
        message = (
            f"{name}.horizon = {sees / fastest:g}: groups[{g}] at {fastest:g} m/s sees {sees:.3g} m ahead, and needs "
            f"{needs:.3g} m to stop (V^2 m/(2 max_force) + radius); at least {needs / fastest:.3g} s is enough"
        )
        warnings.warn(message, LookaheadWarning, stacklevel=2)
