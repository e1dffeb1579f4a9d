"""The largest stable step of a method and of a scene: measured on the method, from the effects' stiffness.

There is no table of methods: one step of a method is applied to a damped oscillator x'' = -w^2 x - 2 zeta w x', and is
stable if the amplitude does not grow. A method whose region of stability touches the imaginary axis at 0 alone
(explicit Euler, averaged velocity, midpoint, Heun) has no stable step for an undamped oscillator: its limit is 0, and a
warning gives the rate of growth, for the user to judge ((h w)^4 / 8 per step for the two-stage methods).
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
from flockenv.physics.integrators import ImplicitEuler, Integrator, LinearlyImplicitEuler, SemiImplicitEuler

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
    "drag_limit",
    "growth",
    "limit",
    "suggest_dt",
]

Floats = NDArray[np.float64]

ROUNDING = 1e-11
"""Growth of the amplitude per step that may be rounding: no method here grows that slowly at any h w of NEAR."""

NEAR = (0.05, 0.1, 0.2)
"""The h w at which growth near 0 is tested: there it is about (h w)^2 or (h w)^4, far above rounding."""

CERTAIN = 2.5
"""Multiple of the limit beyond which a scene raises ValueError: bounds of frequency overestimate by a smaller factor.

The fastest oscillation is at least as fast as that of any one agent while all others rest: by the mean over D axes,
w^2 is at least sum k / (D m), compared to a bound of 2 sum k / m; and sqrt(2 D) <= 2.45.
"""

WEAK = 0.1
"""The h w and h c below which a limit is useless: with little damping such a method needs tiny steps."""

STEADY = "semi_implicit_euler, velocity_verlet or rk4"
"""Methods with stable steps for undamped oscillations."""

ALTERNATIVES: tuple[Integrator, ...] = (SemiImplicitEuler(), LinearlyImplicitEuler(), ImplicitEuler())
"""Methods that are recommended where another one needs tiny steps, the cheapest first."""

SMALLEST, LARGEST, POINTS = 1e-7, 1e3, 300  # h w that are tested
ROUNDS = 3  # of refining the limit
FASTEST = 32
"""Most different oscillators of a scene that are tested."""


STEPS, STEPS_OF_ITS_OWN = 30, 4
"""Least number of steps per contact: with fewer, the speed after it depends on the time of touch within a step. For
adaptive methods: with fewer, they step over a contact that has just begun (measured at the default tolerance)."""

OFF = 1.048
"""Factor by which a method may change the speed in an undamped contact: 5 %, less the effect of the phase of a step."""

BOUNCY = 0.2
"""Damping, as a fraction of the critical one, below which a contact counts as bouncing: restitution of at least 1/2."""


class Suggestion(NamedTuple):
    """The largest stable step of a scene, and the effect that sets it."""

    dt: float  # s; inf if nothing in the scene sets a limit, 0 if no step is stable
    effect: str | None  # kind of the stiffest effect
    agent: int | None  # index of the agent it acts on
    frequency: float  # rad/s, of the fastest oscillation (a bound)
    damping: float  # 1/s, of velocity, there


def amplification(method: Integrator, y: Floats, zeta: float, drag_zeta: float = 0.0) -> Floats:
    """Return the amplification matrices of (x, v) in one step of h = 1 s, (K, 2, 2), for oscillators of h w = y, (K,).

    method: a method of integration.

    zeta, drag_zeta: damping as fractions of critical damping; `drag_zeta` belongs to drag, which some methods integrate
    separately.
    """
    y = np.asarray(y, float)
    state = blank(1, len(y), 2, 0, 1.0)
    state.x[0], state.v[1] = 1.0, 1.0  # two initial states at once: the axes are independent
    separate = drag_zeta if method.splits_drag else 0.0
    square, drag = (y * y)[:, None], (2 * (zeta + drag_zeta - separate) * y)[:, None]
    after = method(lambda x, v, t: -square * x - drag * v, state, 1.0, drag=np.tile(2 * separate * y, 2))
    return np.stack([after.pos[0], after.vel[0]], axis=1)  # (K, output, input)


def growth(method: Integrator, y: Floats, zeta: float, drag_zeta: float = 0.0) -> Floats:
    """Return the largest factor of the amplitude in one step, (K,): the spectral radius.

    method: a method of integration; y: (K,) values of h w; zeta, drag_zeta: damping as fractions of critical damping
    (see `amplification`).
    """
    with np.errstate(all="ignore"):
        matrices = amplification(method, y, zeta, drag_zeta)
        matrices[~np.isfinite(matrices)] = 1e300
        # in units in which position and velocity have equal weight
        scaled = matrices * np.stack(
            [np.stack([np.ones_like(y), y], -1), np.stack([1 / y, np.ones_like(y)], -1)], axis=1
        )
        return np.asarray(np.abs(np.linalg.eigvals(np.clip(scaled, -1e150, 1e150))).max(axis=1))


@functools.lru_cache(maxsize=1024)
def limit(method: Integrator, zeta: float, drag_zeta: float = 0.0) -> float:
    """Return the largest stable h w, for damping as fractions of critical damping (see amplification).

    method: a method of integration; zeta: damping of bonds and contacts; drag_zeta: of drag.

    inf: any h w is stable; 0: none is, as there is no damping and the method grows for arbitrarily small h w.
    """
    if method.stable_at_any_step:
        return math.inf
    if zeta <= 0 and drag_zeta <= 0 and (growth(method, np.array(NEAR), 0.0) > 1 + ROUNDING).all():
        return 0.0
    return _first_unstable(lambda y: growth(method, y, zeta, drag_zeta))


@functools.lru_cache(maxsize=64)
def drag_limit(method: Integrator) -> float:
    """Return the largest stable h c of x'' = -c x', which is not passed to the method as drag; inf: any is stable."""
    if method.stable_at_any_step:
        return math.inf

    def speed_factor(z: Floats) -> Floats:
        state = blank(1, len(z), 2, 0, 1.0)
        state.v[...] = 1.0
        return np.asarray(np.abs(method(lambda x, v, t: -z[:, None] * v, state, 1.0).vel[0, :, 0]))

    return _first_unstable(speed_factor)


def _first_unstable(growth_at: Callable[[Floats], Floats]) -> float:
    """Return the smallest argument at which the amplitude grows in a step."""
    y = np.geomspace(SMALLEST, LARGEST, POINTS)
    for _ in range(ROUNDS):
        grows = growth_at(y) > 1 + ROUNDING
        if not grows.any():
            return math.inf
        first = int(np.argmax(grows))
        if first == 0:
            return 0.0
        y = np.linspace(y[first - 1], y[first], POINTS)
    return float(y[0])


class _Rates(NamedTuple):
    """Stiffness of every agent, (N,) each."""

    square: Floats  # w^2, 1/s^2
    damping: Floats  # 1/s
    drag: Floats  # 1/s, damping that the method integrates separately

    def of(self, agent: int) -> tuple[float, float, float]:
        """Return the rates of one agent."""
        return float(self.square[agent]), float(self.damping[agent]), float(self.drag[agent])


def suggest_dt(scene: SceneView) -> Suggestion:
    """Return the largest stable step of a scene, from the stiffness of its effects, and the effect that sets it.

    Stiffness is an upper bound (Gershgorin's circles for springs), so the limit is conservative; stiffness in some
    states only (agents that touch more than one other) is not included. Damping is an upper bound too: with a method
    that needs damping to be stable (explicit Euler, Heun, midpoint), less damped motions may be unstable, such as
    springs across their length.
    """
    return _suggest(scene, _effect_rates(scene, scene.integrator), scene.integrator)


def _suggest(scene: SceneView, rates_of_effects: list[tuple[Effect, _Rates]], method: Integrator) -> Suggestion:
    """Return the largest stable step of a method under some effects of a scene."""
    if not rates_of_effects:
        return Suggestion(math.inf, None, None, 0.0, 0.0)
    total = _Rates(*(sum(rates[k] for _, rates in rates_of_effects) + np.zeros(scene.agents) for k in range(3)))
    dt, agent = _smallest_limit(method, total)
    if not math.isfinite(dt):
        most = (float(np.sqrt(total.square.max())), float((total.damping + total.drag).max()))
        return Suggestion(math.inf, None, None, *most)
    alone = [(*_urgency(method, *rates.of(agent)), effect.kind) for effect, rates in rates_of_effects]
    square, damping, drag = total.of(agent)
    return Suggestion(dt, min(alone)[-1], agent, math.sqrt(square), damping + drag)


def _urgency(method: Integrator, square: float, damping: float, drag: float) -> tuple[float, float]:
    """Return the largest stable step of one oscillator, and minus its rates: of equal steps the fastest comes first."""
    return _stable_step(method, square, damping, drag), -max(math.sqrt(square), damping + drag)


def _effect_rates(scene: SceneView, method: Integrator) -> list[tuple[Effect, _Rates]]:
    """Return the effects with a known stiffness that a method takes explicitly, and their rates."""
    out = []
    for k, effect in enumerate(scene.effects):
        if method.linearises and effect.derivative is not None:
            continue
        acting = effect if scene.obstacles else effect.without_obstacles()
        try:
            found = acting.rates(scene.groups, scene.dimension) if acting is not None else None
        except ValueError as error:
            raise ValueError(f"effects[{k}].{error}") from None
        if found is not None:
            square, damping = found
            zeros = np.zeros(len(damping))
            separate = method.splits_drag and effect.linear_drag is not None
            out.append((effect, _Rates(square, zeros, damping) if separate else _Rates(square, damping, zeros)))
    return out


def _smallest_limit(method: Integrator, rates: _Rates) -> tuple[float, int]:
    """Return the smallest limit of all agents, s, and the agent; of many different agents the FASTEST are tested."""
    table = np.stack(rates, axis=1)
    begins = np.flatnonzero(np.r_[True, (table[1:] != table[:-1]).any(axis=1)])  # of runs of equal agents
    kinds, among = np.unique(table[begins], axis=0, return_index=True)
    first = begins[among]
    fastest = np.argsort(np.maximum(np.sqrt(kinds[:, 0]), kinds[:, 1]), kind="stable")[-FASTEST:]
    dt, _, agent = min((*_urgency(method, *map(float, kinds[k])), int(first[k])) for k in fastest)
    return dt, agent


def _stable_step(method: Integrator, square: float, damping: float, drag: float) -> float:
    """Return the largest stable step of one oscillator, s."""
    if square <= 0 and damping <= 0:
        return math.inf
    if damping > 1e4 * math.sqrt(square):  # drag alone: x'' = -c x'
        return drag_limit(method) / damping
    frequency = math.sqrt(square)
    # to a few digits, so that agents of nearly the same damping are tested once
    zeta, drag_zeta = (float(f"{rate / (2 * frequency):.4g}") for rate in (damping, drag))
    return limit(method, zeta, drag_zeta) / frequency


def check_dt(scene: SceneView) -> None:
    """Warn if dt exceeds the largest stable step, naming limit and effect; raise ValueError if it must blow up.

    scene: its effects and its method are read.

    Effects that act at times, or with bounded forces, do not make it blow up: see `Effect.always`.
    """
    suggestion = suggest_dt(scene)
    if scene.dt <= suggestion.dt:
        return
    method = scene.integrator
    always = _suggest(scene, [found for found in _effect_rates(scene, method) if found[0].always], method)
    if scene.dt > CERTAIN * always.dt and _blows_up(scene, always):
        raise ValueError(_limit_message(scene, always))
    warnings.warn(_limit_message(scene, suggestion), UnstableStepWarning, stacklevel=2)


def _limit_message(scene: SceneView, suggestion: Suggestion) -> str:
    """Return a line with the largest stable step and what sets it."""
    kind = scene.integrator.kind
    text = f"{suggestion.frequency:.4g} rad/s, {suggestion.damping:.4g} 1/s at agent {suggestion.agent}"
    if suggestion.dt == 0:
        limit_text = (
            f"no step is stable, for nothing damps it (at this one the amplitude grows e-fold in "
            f"{_growth_time(scene, suggestion):.3g} s), so take another integrator ({STEADY}), or add damping"
        )
    elif suggestion.dt * max(suggestion.frequency, suggestion.damping) < WEAK or suggestion.dt < 1e-2 * scene.dt:
        most = _rounded_down(suggestion.dt)
        limit_text = f"at most {most} s is stable, so take dt <= {most} s{_stable_alternative(scene)}"
    else:
        limit_text = f"at most {suggestion.dt:.4g} s is stable"
    return f"dt = {scene.dt:g} s: {kind} with {suggestion.effect} ({text}): {limit_text}"


def _rounded_down(seconds: float) -> str:
    """Return a time with three digits, not above its value: advice that is followed must not warn again."""
    nearest = f"{seconds:.3g}"
    return nearest if float(nearest) <= seconds else f"{seconds * 0.995:.3g}"


def _stable_alternative(scene: SceneView) -> str:
    """Return ", or integrator: {...}" with the cheapest method that is stable and accepted at the scene's dt, or ""."""
    for method in ALTERNATIVES:
        if scene.dt <= _suggest(scene, _effect_rates(scene, method), method).dt and _is_accepted(scene, method):
            costs = " (it solves equations in each step, which takes far longer; not in tasks)" * method.solves
            return f", or integrator: {{kind: {method.kind}}}{costs}"
    return ""


def _is_accepted(scene: SceneView, method: Integrator) -> bool:
    """Return True if the scene is valid with another method."""
    with warnings.catch_warnings(action="ignore"):  # of contacts; the step itself is stable
        try:
            scene.model_copy(update={"integrator": method})
        except ValueError:
            return False
    return True


def _growth_time(scene: SceneView, suggestion: Suggestion) -> float:
    """Return the time in which an undamped oscillation grows e-fold at the scene's dt, s; inf if rounding hides it."""
    rate = math.log(float(growth(scene.integrator, np.array([scene.dt * suggestion.frequency]), 0.0)[0]))
    return scene.dt / rate if rate > 0 else math.inf


def _blows_up(scene: SceneView, suggestion: Suggestion) -> bool:
    """Return True if the amplitude grows a hundredfold in a hundred steps, even with rates far below their bounds."""
    y = np.array([scene.dt * suggestion.frequency / CERTAIN])
    if suggestion.damping > 1e4 * suggestion.frequency:
        return True  # drag alone, whose rates are exact
    zeta = suggestion.damping / (2 * suggestion.frequency)
    slowest = min(growth(scene.integrator, y, *shares)[0] for shares in ((zeta, 0.0), (0.0, zeta)))
    return bool(slowest > 100 ** (1 / 100))


@functools.lru_cache(maxsize=64)
def contact_limit(method: Integrator) -> float:
    """Return the largest h w at which half an undamped oscillation is resolved.

    method: a method of integration. w: the frequency of the contact, rad/s.

    Resolved means in at least STEPS steps, and with the same amplitude within OFF: explicit Euler multiplies it by
    (1 + y^2)^(pi / 2y), implicit Euler divides it, and both need 105 steps.
    """
    if method.adaptive:
        return math.pi / STEPS_OF_ITS_OWN
    low, high = 1e-3, math.pi / STEPS
    for _ in range(ROUNDS):
        y = np.linspace(low, high, FASTEST)  # few: implicit methods run in Python
        off = np.abs(np.log(growth(method, y, 0.0))) * math.pi / y > math.log(OFF)
        if not off.any():
            return high
        first = max(int(np.argmax(off)), 1)
        low, high = float(y[first - 1]), float(y[first])
    return low


def check_contact(scene: SceneView) -> None:
    """Warn if contacts of bouncing bodies last too few steps, naming the limit and the consequence.

    scene: its effects and its method are read.
    """
    for k, effect in enumerate(scene.effects):
        acting = effect if scene.obstacles else effect.without_obstacles()
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
                f"{_describe_consequence(scene, float(frequency[agent]), agent)}"
            )
            warnings.warn(message, CoarseContactWarning, stacklevel=2)


def _describe_consequence(scene: SceneView, frequency: float, agent: int) -> str:
    """Return the change of speed in an undamped contact at this dt, and the dt above which it is unstable, in words."""
    method, y = scene.integrator, scene.dt * frequency
    if method.adaptive:
        return ""
    rates = [each.of(agent) for _, each in _effect_rates(scene, method)]
    damping, drag = sum(each[1] for each in rates), sum(each[2] for each in rates)
    most = _stable_step(method, frequency**2, damping, drag)
    back = float(growth(method, np.array([y]), 0.0)[0]) ** (math.pi / y)
    text = f"; at this dt {back:.3g} times as fast as they went in" if abs(math.log(back)) > math.log(OFF) else ""
    if most == 0:
        return text + "; bodies that stay in it do not come to rest, whatever dt is"
    return text + (f"; bodies that stay in it do not come to rest above {most:.3g} s" if scene.dt > most else "")


def check_lookahead(scene: SceneView) -> None:
    """Warn if a lookahead is shorter than the stopping distance V^2 m/(2 F) plus the radius.

    scene: its behaviours are read.
    """
    for k, effect in enumerate(scene.effects):
        behaviours = [(f"effects[{k}].behaviours[{j}]", each) for j, each in enumerate(effect.components)]
        group_index = getattr(effect, "group", None) if behaviours else None
        for name, each in behaviours or [(f"effects[{k}]", effect)]:
            for g, group in enumerate(scene.groups):
                if group_index in (None, g):
                    _warn_short_lookahead(name, each, g, group)


def _warn_short_lookahead(name: str, effect: Effect, g: int, group: Group) -> None:
    """Warn if one effect detects too late for one group; skipped without a largest speed or force."""
    fastest, strongest = group.fastest, group.max_force
    if fastest is None or not strongest or (seen := effect.lookahead(fastest)) is None:
        return
    stopping = fastest**2 * group.heaviest / (2 * strongest) + group.widest
    if seen < stopping:
        message = (
            f"{name}.horizon = {seen / fastest:g}: groups[{g}] at {fastest:g} m/s sees {seen:.3g} m ahead, and needs "
            f"{stopping:.3g} m to stop (V^2 m/(2 max_force) + radius); at least {stopping / fastest:.3g} s is enough"
        )
        warnings.warn(message, LookaheadWarning, stacklevel=2)
